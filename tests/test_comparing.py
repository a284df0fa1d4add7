"""Paired comparisons of policies: intervals, p values, and their correction."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy import stats

from fieldkit.errors import ScoreError
from fieldkit.protocol import Threshold
from fieldkit.scores import Comparison, compare, holm, learned_pairs, verdict
from fieldkit.types import Trial

BOUND = Threshold(0.1, 1.0)
ZERO = (0.0, 0.0)


def trials(policy: str, hits: np.ndarray, *, sessions: int = 2, occlusion: bool | None = True) -> list[Trial]:
    """Return a trial per visit; a share between 0 and 1 is that of a good view tied with a bad one."""
    rows = []
    for i, hit in enumerate(hits):
        for inside, weight in ((True, float(hit)), (False, 1.0 - float(hit))):
            if weight:
                error = ZERO if inside else (math.inf, math.inf)
                visit = (f"s{i % sessions}", f"w{i}")
                rows.append(Trial(*visit, policy, occlusion, f"v{inside}", weight, 1.0, "ok", error, error, ZERO, ZERO))
    return rows


def versus(a: np.ndarray, b: np.ndarray, *, seed: int = 0) -> Comparison:
    rows = trials("vpt", a) + trials("max", b)
    (found,) = compare(rows, [(("vpt", True), ("max", True))], thresholds=[BOUND], pose="cam", seed=seed)
    return found


def test_the_difference_is_that_of_the_recalls_and_counts_what_only_one_localizes() -> None:
    found = versus(np.array([1, 1, 0, 0.5]), np.array([0, 1, 1, 0.0]))
    assert (found.n, found.n_a_only, found.n_b_only) == (4, 1.5, 1.0)
    assert found.difference == pytest.approx(0.125)
    assert found.interval[0] <= found.difference <= found.interval[1]


def test_p_of_whole_hits_is_that_of_mcnemar_s_exact_test() -> None:
    a, b = np.zeros(60), np.zeros(60)
    a[:16], b[12:22] = 1, 1
    found = versus(a, b)
    exact = stats.binomtest(12, 18, 0.5).pvalue
    assert found.p == pytest.approx(exact, abs=0.02)


def test_the_interval_covers_the_true_difference_in_95_of_100_experiments() -> None:
    rng = np.random.default_rng(1)
    covered, false, widths = 0, 0, []
    for seed in range(200):
        base = rng.random(120)
        a, b = (base < 0.6).astype(float), ((base + 0.15 * rng.standard_normal(120)) < 0.5).astype(float)
        rows = trials("vpt", a) + trials("max", b)
        pair = (("vpt", True), ("max", True))
        (found,) = compare(rows, [pair], thresholds=[BOUND], pose="cam", seed=seed, resamples=500)
        covered += found.interval[0] <= 0.1005 <= found.interval[1]
        # A normal interval, with the variance of visits drawn within their two sessions
        deviation = np.sqrt(np.mean([np.var((a - b)[session::2]) for session in (0, 1)]) / 120)
        widths.append((found.interval[1] - found.interval[0]) / (2 * deviation))
        same = rng.permuted(np.stack([a, b], axis=1), axis=1)
        rows = trials("vpt", same[:, 0]) + trials("max", same[:, 1])
        (found,) = compare(rows, [pair], thresholds=[BOUND], pose="cam", seed=seed, resamples=500)
        false += found.p < 0.05
    assert 0.92 <= covered / 200 <= 0.99
    # 1.64 for an interval of 90 %, 2.58 for one of 99 %
    assert np.mean(widths) == pytest.approx(stats.norm.ppf(0.975), rel=0.05)
    assert 0.01 < false / 200 < 0.09


def test_visits_are_drawn_within_their_sessions() -> None:
    # One session gains everywhere, the other loses everywhere: within sessions nothing varies
    a, b = np.tile([1.0, 0.0], 20), np.tile([0.0, 1.0], 20)
    assert versus(a, b).interval == (0.0, 0.0)


def test_the_same_seed_gives_the_same_numbers() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.integers(0, 2, 50).astype(float), rng.integers(0, 2, 50).astype(float)
    assert versus(a, b, seed=4) == versus(a, b, seed=4)
    assert versus(a, b, seed=4).p != versus(a, b, seed=5).p


def test_no_difference_at_all_has_p_1() -> None:
    found = versus(np.ones(9), np.ones(9))
    assert (found.difference, found.interval, found.p) == (0.0, (0.0, 0.0), 1.0)


def test_holm_s_correction_is_that_of_the_paper_s_example() -> None:
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []


def test_learned_policies_are_paired_with_heuristics_of_the_same_occlusion() -> None:
    rows = trials("vpt", np.ones(2)) + trials("max", np.ones(2)) + trials("max", np.ones(2), occlusion=False)
    rows += trials("forward", np.ones(2), occlusion=None)
    assert learned_pairs(rows) == [(("vpt", True), ("max", True))]


def test_what_is_not_there_is_not_compared() -> None:
    rows = trials("vpt", np.ones(2))
    with pytest.raises(ScoreError, match=r"no row fim without occlusion; expected it"):
        compare(rows, [(("vpt", True), ("fim", False))], thresholds=[BOUND], pose="cam")


@pytest.mark.parametrize(("sessions", "visits"), [(12, 1), (6, 2), (13, 1)])
def test_short_sessions_leave_the_interval_its_width(sessions: int, visits: int) -> None:
    rng = np.random.default_rng(3)
    covered = 0
    for seed in range(200):
        hits = rng.integers(0, 2, (2, sessions * visits)).astype(float)
        rows = trials("vpt", hits[0], sessions=sessions) + trials("max", hits[1], sessions=sessions)
        pair = (("vpt", True), ("max", True))
        (found,) = compare(rows, [pair], thresholds=[BOUND], pose="cam", seed=seed, resamples=500)
        covered += found.interval[0] <= 0.0 <= found.interval[1]
    assert covered / 200 >= 0.9


def test_one_visit_says_nothing() -> None:
    rows = trials("vpt", np.ones(1)) + trials("max", np.zeros(1))
    (found,) = compare(rows, [(("vpt", True), ("max", True))], thresholds=[BOUND], pose="cam")
    assert (found.difference, found.interval) == (1.0, (-1.0, 1.0))


def test_a_comparison_does_not_depend_on_what_else_is_compared() -> None:
    rng = np.random.default_rng(0)
    names = ("vpt", "max", "angle")
    rows = [t for name in names for t in trials(name, rng.integers(0, 2, 50).astype(float))]
    alone, among = (("vpt", True), ("max", True)), [(("vpt", True), (name, True)) for name in ("angle", "max")]
    (one,) = compare(rows, [alone], thresholds=[BOUND], pose="cam")
    many = compare(rows, among, thresholds=[Threshold(1.0, 5.0), BOUND], pose="cam")
    (same,) = [c for c in many if c.b == ("max", True) and c.threshold == BOUND]
    assert (one.interval, one.p) == (same.interval, same.p)


def test_a_verdict_holds_p_and_interval_against_the_margin() -> None:
    base = versus(np.ones(9), np.ones(9))

    def said(difference: float, interval: tuple[float, float], p: float) -> str:
        found = dataclasses.replace(base, difference=difference, interval=interval, p_corrected=p)
        return verdict(found, margin=0.03)

    assert said(0.05, (0.01, 0.09), 0.01) == "better"
    assert said(0.05, (0.01, 0.09), 0.2) == "not worse by 3 points"
    assert said(-0.15, (-0.18, -0.11), 0.001) == "worse"
    assert said(-0.02, (-0.029, -0.01), 0.01) == "worse, by less than 3 points"
    assert said(0.01, (-0.04, 0.06), 0.7) == "open"
