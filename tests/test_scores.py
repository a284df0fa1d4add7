"""Laws of scoring: weights, denominators, intervals, best possible, and independence of the map's frame."""

from __future__ import annotations

import dataclasses
import json
import math
from collections import defaultdict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from synthetic_run import KINDS, VIEWS, VisitInputs, make_run, make_visit

from fieldkit import protocol as protocols
from fieldkit.errors import ScoreError
from fieldkit.frames import Pose
from fieldkit.protocol import Expect, Protocol, Threshold
from fieldkit.scores import (
    PRESETS,
    check_expect,
    cumulative,
    error_of,
    excess,
    inside,
    make_trials,
    preset,
    recall,
    score_dict,
    summarize,
    summarize_run,
    table,
    tightest,
    weighted_median,
    wilson,
)
from fieldkit.types import Trial

seeds = st.integers(0, 2**32 - 1)
PROTOCOL = protocols.load("paper_real")


def trials_of(visit: VisitInputs, protocol: Protocol = PROTOCOL) -> tuple[Trial, ...]:
    return make_trials(visit.plan, visit.results, visit.truths, protocol=protocol)


def trial(visit: str, error: tuple[float, float], *, policy: str = "max", weight: float = 1.0) -> Trial:
    zero = (0.0, 0.0)
    return Trial("s", visit, policy, None, "v", weight, 0.0, "ok", error, error, zero, zero)


def moved(visit: VisitInputs, new_from_map: Pose) -> VisitInputs:
    plan = visit.plan
    prior = dataclasses.replace(plan.prior, map_from_body=new_from_map * plan.prior.map_from_body)
    candidates = dataclasses.replace(
        plan.candidates, map_from_cam=tuple(new_from_map * p for p in plan.candidates.map_from_cam)
    )
    results = {}
    for view, result in visit.results.items():
        found = result.estimate.map_from_cam
        estimate = dataclasses.replace(result.estimate, map_from_cam=None if found is None else new_from_map * found)
        results[view] = dataclasses.replace(result, estimate=estimate)
    truths = {v: dataclasses.replace(t, map_from_cam=new_from_map * t.map_from_cam) for v, t in visit.truths.items()}
    return VisitInputs(dataclasses.replace(plan, prior=prior, candidates=candidates), results, truths)


@settings(max_examples=15, deadline=None)
@given(seeds)
def test_weights_sum_to_one_per_visit_and_policy(seed: int) -> None:
    sums: defaultdict[tuple[str, bool | None], float] = defaultdict(float)
    for t in trials_of(make_visit(np.random.default_rng(seed), "w01", fail=0.5)):
        sums[t.policy, t.occlusion] += t.weight
    assert set(sums) == {
        ("stowed", None), ("forward", None), ("odometry", None), ("random", None), ("max", False), ("max", True),
        ("angle", False), ("angle", True), ("fim", False), ("fim", True), ("best_possible", None),
        *((name, use) for name in ("mlp", "vpt", "vpt_appearance", "vpt_dino") for use in (False, True)),
    }  # fmt: skip
    assert list(sums.values()) == pytest.approx([1.0] * len(sums))


def test_random_is_one_row_per_candidate_with_equal_weight(rng: np.random.Generator) -> None:
    rows = [t for t in trials_of(make_visit(rng, "w01")) if t.policy == "random"]
    assert [t.view for t in rows] == [v for v, k in zip(VIEWS, KINDS, strict=True) if k == "sweep"]
    assert {t.weight for t in rows} == {1 / 12}


def test_random_recall_is_the_mean_over_candidates(rng: np.random.Generator) -> None:
    visit = make_visit(rng, "w01")
    rows = [t for t in trials_of(visit) if t.policy == "random"]
    bound = PROTOCOL.thresholds[-1]
    hits = [inside(t.body_error, bound) for t in rows]
    assert 0 < sum(hits) < 12
    assert recall(rows, bound, pose="body") == pytest.approx(np.mean(hits))


def test_tied_views_share_the_weight_and_the_outcome(rng: np.random.Generator) -> None:
    visit = make_visit(rng, "w01", fail=0.0)
    utilities = np.full(len(VIEWS), -np.inf)
    utilities[[2, 5]] = 7.0
    plan = dataclasses.replace(visit.plan, utilities={("max", True): utilities})
    rows = [t for t in make_trials(plan, visit.results, visit.truths, protocol=PROTOCOL) if t.policy == "max"]
    assert [(t.view, t.weight, t.utility) for t in rows] == [("02", 0.5, 7.0), ("05", 0.5, 7.0)]


def test_policy_without_an_allowed_view_is_one_failed_trial_in_the_denominator(rng: np.random.Generator) -> None:
    visit = make_visit(rng, "w01")
    plan = dataclasses.replace(visit.plan, utilities={("stowed", None): np.full(len(VIEWS), -np.inf)})
    rows = [t for t in make_trials(plan, visit.results, visit.truths, protocol=PROTOCOL) if t.policy == "stowed"]
    assert [(t.view, t.status, t.weight, t.cam_error) for t in rows] == [
        ("", "no_candidate", 1.0, (math.inf, math.inf))
    ]
    (summary,) = summarize(rows, thresholds=PROTOCOL.thresholds, pose="body")
    assert (summary.n, summary.recall) == (1, (0.0, 0.0, 0.0))


def test_failed_estimate_is_infinitely_wrong_and_keeps_its_status(rng: np.random.Generator) -> None:
    rows = [t for t in trials_of(make_visit(rng, "w01", fail=1.0)) if t.policy not in ("odometry",)]
    assert {(t.status, t.cam_error, t.body_error) for t in rows} == {
        ("few_inliers", (math.inf, math.inf), (math.inf, math.inf))
    }


@settings(max_examples=15, deadline=None)
@given(seeds, st.integers(0, 10), st.integers(1, 10))
def test_failures_stay_in_the_denominator(seed: int, n_good: int, n_failed: int) -> None:
    good = [trial(f"g{i}", (0.01, 0.001)) for i in range(n_good)]
    failed = [trial(f"f{i}", (math.inf, math.inf)) for i in range(n_failed)]
    rows = np.random.default_rng(seed).permutation(np.array(good + failed, dtype=object)).tolist()
    (summary,) = summarize(rows, thresholds=PROTOCOL.thresholds, pose="cam")
    assert summary.n == n_good + n_failed
    assert summary.recall[0] == pytest.approx(n_good / (n_good + n_failed))
    _, fraction = cumulative(rows, pose="cam", part="position")
    assert (fraction[-1] if n_good else 0.0) == pytest.approx(n_good / (n_good + n_failed))


@settings(max_examples=15, deadline=None)
@given(seeds)
def test_moving_the_map_changes_no_trial(seed: int) -> None:
    rng = np.random.default_rng(seed)
    visit = make_visit(rng, "w01")
    new_from_map = Pose.from_components(rng.uniform(-50, 50, 3), Rotation.random(rng=rng))
    for before, after in zip(trials_of(visit), trials_of(moved(visit, new_from_map)), strict=True):
        assert (before.policy, before.view, before.weight, before.status) == (
            after.policy, after.view, after.weight, after.status,
        )  # fmt: skip
        assert before.cam_error == pytest.approx(after.cam_error, abs=1e-7)
        assert before.body_error == pytest.approx(after.body_error, abs=1e-7)


def test_body_error_is_the_camera_error_carried_through_the_arm(rng: np.random.Generator) -> None:
    visit = make_visit(rng, "w01", fail=0.0)
    view = "03"
    truth, found = visit.truths[view], visit.results[view].estimate.map_from_cam
    assert found is not None
    row = next(t for t in trials_of(visit) if t.policy == "random" and t.view == view)
    arm = truth.body_from_cam
    expected = np.linalg.norm((found * arm.inv()).translation - (truth.map_from_cam * arm.inv()).translation)
    assert row.body_error[0] == pytest.approx(expected)
    assert row.cam_error[0] == pytest.approx(np.linalg.norm(found.translation - truth.map_from_cam.translation))
    assert row.body_error[1] == pytest.approx(row.cam_error[1])


def test_odometry_is_the_prior_and_depends_on_no_image(rng: np.random.Generator) -> None:
    visit = make_visit(rng, "w01")
    failed = {
        v: dataclasses.replace(r, estimate=dataclasses.replace(r.estimate, map_from_cam=None, status="no_pose"))
        for v, r in visit.results.items()
    }
    (row,) = (t for t in trials_of(visit) if t.policy == "odometry")
    (same,) = (t for t in trials_of(dataclasses.replace(visit, results=failed)) if t.policy == "odometry")
    assert row == same
    assert (row.view, row.status) == ("stowed", "ok")
    assert row.body_error == pytest.approx(visit.plan.prior_error)


def test_odometry_camera_falls_back_to_forward_and_then_the_first_candidate(rng: np.random.Generator) -> None:
    visit = make_visit(rng, "w01")
    plan = dataclasses.replace(visit.plan, utilities={})
    for missing, expected in ((("stowed",), "forward"), (("stowed", "forward"), "00")):
        truths = {v: t for v, t in visit.truths.items() if v not in missing}
        rows = make_trials(plan, visit.results, truths, protocol=PROTOCOL)
        assert next(t.view for t in rows if t.policy == "odometry") == expected


@pytest.mark.parametrize("pose", ["cam", "body"])
def test_best_possible_weighs_the_smallest_normalised_error_of_the_scored_pose(
    rng: np.random.Generator, pose: str
) -> None:
    protocol = changed(PROTOCOL, pose=pose)
    rows = [t for t in trials_of(make_visit(rng, "w01"), protocol) if t.policy == "best_possible"]
    ratios = [excess(error_of(t, pose=protocol.pose), protocol.thresholds[0]) for t in rows]
    assert len(rows) == 12
    assert [t.weight for t in rows] == [float(i == int(np.argmin(ratios))) for i in range(12)]


def test_best_possible_is_a_hit_when_any_view_is_inside_both_thresholds() -> None:
    # The weighted view is inside the tight threshold's ratio but not inside the wide, flat one; the other view is.
    rows = [
        trial("w1", (0.30, 0.001), policy="best_possible", weight=1.0),
        trial("w1", (0.05, 0.08), policy="best_possible", weight=0.0),
    ]
    assert recall(rows, Threshold(0.1, 5.0), pose="cam") == 1.0
    assert recall(rows, Threshold(0.1, 1.0), pose="cam") == 0.0


@settings(max_examples=15, deadline=None)
@given(seeds)
def test_best_possible_is_at_least_as_good_as_any_choice_among_the_same_candidates(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = [t for i in range(4) for t in trials_of(make_visit(rng, f"w{i}"))]
    recalls = {(s.policy, s.occlusion): s.recall for s in summarize(rows, thresholds=PROTOCOL.thresholds, pose="body")}
    best = recalls.pop(("best_possible", None))
    for (policy, _), values in recalls.items():
        if policy not in ("stowed", "forward", "odometry"):
            assert all(v <= b + 1e-12 for v, b in zip(values, best, strict=True))


def test_thresholds_are_strict() -> None:
    bound = Threshold(0.25, 2.0)
    assert inside((0.2499, math.radians(1.99)), bound)
    assert not inside((0.25, 0.0), bound)
    assert not inside((0.0, math.radians(2.0)), bound)


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_recall_is_monotone_in_the_thresholds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = [t for i in range(3) for t in trials_of(make_visit(rng, f"w{i}"))]
    grid = [Threshold(p, r) for p, r in zip(np.geomspace(1e-3, 2, 8), np.geomspace(0.05, 90, 8), strict=True)]
    for summary in summarize(rows, thresholds=grid, pose="body"):
        assert all(a <= b + 1e-12 for a, b in zip(summary.recall, summary.recall[1:], strict=False))


@given(st.floats(0, 1), st.integers(1, 10_000))
def test_wilson_contains_the_estimate_and_stays_in_the_unit_interval(fraction: float, n: int) -> None:
    low, high = wilson(fraction, n)
    assert 0 <= low <= fraction <= high <= 1
    assert low < high


def test_wilson_reproduces_known_intervals() -> None:
    assert wilson(10 / 12, 12) == pytest.approx((0.552, 0.953), abs=5e-4)
    assert wilson(8 / 12, 12) == pytest.approx((0.391, 0.862), abs=5e-4)
    assert wilson(0.0, 0) == (0.0, 1.0)


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=30))
def test_weighted_median_with_equal_weights_is_the_median(values: list[float]) -> None:
    assert weighted_median(values, np.full(len(values), 0.1)) == pytest.approx(float(np.median(values)))


def test_weighted_median_follows_the_weights() -> None:
    assert weighted_median([1.0, 2.0, 9.0], [0.2, 0.2, 0.6]) == 9.0
    assert weighted_median([1.0, math.inf], [0.5, 0.5]) == math.inf
    assert weighted_median([1.0, math.inf], [0.6, 0.4]) == 1.0
    assert weighted_median([5.0, 1.0], [0.0, 1.0]) == 1.0


def test_rows_come_in_the_protocols_order_and_without_occlusion_first() -> None:
    run = make_run(0)
    names = [(s.policy, s.occlusion) for s in summarize_run(run)]
    assert names == [
        ("stowed", None), ("forward", None), ("odometry", None), ("random", None), ("max", False), ("max", True),
        ("angle", False), ("angle", True), ("fim", False), ("fim", True),
        *((name, use) for name in ("mlp", "vpt", "vpt_appearance", "vpt_dino") for use in (False, True)),
        ("best_possible", None),
    ]  # fmt: skip


def test_score_dict_has_the_schema_and_no_infinity() -> None:
    run = make_run(0)
    failed = tuple(dataclasses.replace(t, cam_error=(math.inf,) * 2, body_error=(math.inf,) * 2) for t in run.trials)
    for values in (score_dict(run), score_dict(dataclasses.replace(run, trials=failed))):
        json.dumps(values, allow_nan=False)
        assert list(values) == [
            "version",
            "protocol",
            "pose",
            "thresholds",
            "policies",
            "comparisons",
            "truth",
            "in_sample",
        ]
        for policy in values["policies"]:
            assert list(policy) == [
                "name", "occlusion", "n", "recall", "interval", "median_position_m", "median_rotation_deg", "open",
            ]  # fmt: skip
            assert len(policy["recall"]) == len(policy["interval"]) == 3
    assert values["policies"][0]["median_position_m"] is None


@pytest.mark.parametrize("name", list(PRESETS))
def test_presets_replace_the_columns_of_a_stored_run(name: str) -> None:
    run = make_run(0, n_visits=2)
    rendered = table(run, thresholds=preset(name))
    columns = rendered.header[3:-2]
    assert columns == tuple(f"{t.position_m:g} m / {t.rotation_deg:g} deg" for t in PRESETS[name])
    assert {len(row) for row in rendered.rows} == {len(rendered.header)}


def test_unknown_preset_names_the_known_ones() -> None:
    with pytest.raises(ScoreError, match=r"unknown preset 'lamarr'; did you mean 'lamar'\? known: visual"):
        preset("lamarr")


def test_presets_of_the_paper_are_the_shipped_protocols() -> None:
    for name in ("paper_real", "paper_sim"):
        assert preset(name) == protocols.load(name).thresholds


def test_tightest_threshold_does_not_depend_on_the_order() -> None:
    assert tightest(PROTOCOL.thresholds[::-1]) == Threshold(0.25, 2.0)


def test_expect_bounds_name_what_was_missed() -> None:
    run = make_run(0)
    bounds = (
        Expect("best_possible", 1.0, 5.0, min_recall=0.5),
        Expect("max", 1.0, 5.0, min_recall=1.0, occlusion=True),
        Expect("vpt", 1.0, 5.0, min_recall=0.1),
    )
    without = tuple(t for t in run.trials if t.policy != "vpt")
    run = dataclasses.replace(run, protocol=changed(run.protocol, expect=bounds), trials=without)
    (missed, absent) = check_expect(run)
    assert missed.startswith("max at 1 m / 5 deg with occlusion: recall 0.")
    assert missed.endswith("of 6 visits; expected 1 .. 1")
    assert absent == "vpt at 1 m / 5 deg: no row in this run; expected recall 0.1 .. 1"


def test_expect_without_occlusion_holds_for_every_variant() -> None:
    run = make_run(0)
    bounds = (Expect("max", 1.0, 5.0, min_recall=0.0, max_recall=0.0),)
    run = dataclasses.replace(run, protocol=changed(run.protocol, expect=bounds))
    assert len(check_expect(run)) == 2


def test_run_in_which_nothing_was_scored_is_an_error_with_the_reason() -> None:
    run = dataclasses.replace(make_run(0, n_visits=1), trials=())
    with pytest.raises(ScoreError, match=r"build/run: no visit was scored \(visit w99: tripod tag 2 was not seen\)"):
        score_dict(run)


def test_missing_results_and_truths_are_named(rng: np.random.Generator) -> None:
    visit = make_visit(rng, "w07")
    with pytest.raises(ScoreError, match="visit w07: none of its 14 views has a truth"):
        make_trials(visit.plan, visit.results, {}, protocol=PROTOCOL)
    results = {v: r for v, r in visit.results.items() if v != "03"}
    with pytest.raises(ScoreError, match="visit w07: view '03' has no result"):
        make_trials(visit.plan, results, visit.truths, protocol=PROTOCOL)
    with pytest.raises(ScoreError, match="visit w07: view 'x' has no truth"):
        make_trials(visit.plan, visit.results, visit.truths, protocol=PROTOCOL, odometry_view="x")


def test_nan_utilities_are_refused(rng: np.random.Generator) -> None:
    visit = make_visit(rng, "w01")
    plan = dataclasses.replace(visit.plan, utilities={("max", True): np.full(len(VIEWS), np.nan)})
    with pytest.raises(ScoreError, match="policy max gave utilities of shape \\(14,\\), 14 of them nan"):
        make_trials(plan, visit.results, visit.truths, protocol=PROTOCOL)


def changed(protocol: Protocol, **changes: object) -> Protocol:
    """Return a protocol with some settings replaced."""
    values = {name: getattr(protocol, name) for name in protocol.__struct_fields__}
    return Protocol(**{**values, **changes})


def test_weights_that_do_not_add_up_to_one_are_refused(rng: np.random.Generator) -> None:
    rows = trials_of(make_visit(rng, "w01"))
    with pytest.raises(ScoreError, match="the weights of stowed add up to 2; expected 1"):
        summarize((*rows, rows[0]), thresholds=PROTOCOL.thresholds, pose=PROTOCOL.pose)
