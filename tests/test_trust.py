"""What the truth's own uncertainty leaves open."""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

import msgspec
import numpy as np
import pytest
from synthetic_run import make_run

from fieldkit.protocol import Protocol, Threshold
from fieldkit.scores import score_dict, summarize_run, table
from fieldkit.trust import largest_sigma, open_shares, open_words, outcomes, trust, truths_of
from fieldkit.types import Run

BOUND = Threshold(0.25, 2.0)


def with_sigma(run: Run, metres: float, degrees: float) -> Run:
    covariance = np.diag([math.radians(degrees) ** 2] * 3 + [metres**2] * 3)
    return dataclasses.replace(
        run, truths=tuple((s, dataclasses.replace(t, covariance=covariance)) for s, t in run.truths)
    )


@pytest.mark.parametrize(
    ("error", "sigma", "expected"),
    [
        ((0.1, 0.01), (0.01, 0.001), (True, False)),
        ((0.24, 0.01), (0.01, 0.001), (True, True)),
        ((0.26, 0.01), (0.01, 0.001), (True, True)),
        ((0.28, 0.01), (0.01, 0.001), (False, True)),
        ((0.24, 0.5), (0.01, 0.001), (False, True)),
        ((0.1, math.radians(1.99)), (0.0, math.radians(0.01)), (True, True)),
        ((math.inf, math.inf), (1.0, 1.0), (False, True)),
    ],
)
def test_a_trial_is_open_where_its_error_is_within_two_sigma_of_a_bound_that_decides(
    error: tuple[float, float], sigma: tuple[float, float], expected: tuple[bool, bool]
) -> None:
    assert outcomes(error, sigma, BOUND) == expected


def test_an_exact_truth_leaves_nothing_open_and_a_useless_one_every_estimate() -> None:
    run = make_run(3)
    exact, useless = trust(with_sigma(run, 0.0, 0.0)), trust(with_sigma(run, 100.0, 180.0))
    assert exact is not None
    assert useless is not None
    assert exact.open_share == (0.0, 0.0, 0.0)
    assert exact.warning == ""
    for policy in summarize_run(run):
        trials = [t for t in run.trials if (t.policy, t.occlusion) == (policy.policy, policy.occlusion)]
        (share,) = open_shares(trials, truths_of(with_sigma(run, 100.0, 180.0)), thresholds=[BOUND], pose="body")
        failed = math.fsum(t.weight for t in trials if t.status != "ok") / policy.n
        if policy.policy != "best_possible":
            assert share == pytest.approx(1 - failed)


def test_a_coarser_truth_leaves_more_open() -> None:
    run = make_run(4, n_visits=8)
    shares = [np.sum(trust(with_sigma(run, s, 10 * s)).open_share) for s in (0.0, 0.01, 0.05, 0.2)]  # type: ignore[union-attr]
    assert shares == sorted(shares)
    assert shares[-1] > shares[0]


def test_truth_is_coarse_where_two_sigma_exceed_a_third_of_the_tightest_bound() -> None:
    run = make_run(5)
    tight = run.protocol.thresholds[0]
    just = with_sigma(run, tight.position_m / 6 * 0.99, 0.0)
    over = with_sigma(run, tight.position_m / 6 * 1.01, 0.0)
    turned = with_sigma(run, 0.0, tight.rotation_deg / 6 * 1.01)
    fine, coarse, twisted = (trust(dataclasses.replace(r, protocol=_scored("cam", r))) for r in (just, over, turned))
    assert fine is not None
    assert coarse is not None
    assert twisted is not None
    assert (fine.n_coarse, fine.warning) == (0, "")
    assert coarse.n_coarse == twisted.n_coarse == len(run.truths)
    assert f"the truth of {len(run.truths)} of {len(run.truths)} views is coarse" in coarse.warning
    assert "over a third of the tightest threshold, 0.25 m / 2 deg" in coarse.warning


def _scored(pose: Literal["cam", "body"], run: Run) -> Protocol:
    return msgspec.structs.replace(run.protocol, pose=pose)


def test_the_body_is_less_certain_than_the_camera_by_the_arm_between_them() -> None:
    _, truth = with_sigma(make_run(6), 0.001, 1.0).truths[0]
    camera, body = (largest_sigma(truth, pose=p) for p in ("cam", "body"))
    assert camera == pytest.approx((0.001, math.radians(1.0)))
    reach = float(np.linalg.norm(truth.body_from_cam.translation))
    assert body[0] == pytest.approx(math.hypot(0.001, math.radians(1.0) * reach), rel=1e-6)


def test_score_says_what_is_open() -> None:
    run = with_sigma(make_run(7), 0.1, 0.5)
    values = score_dict(run)
    trusted = trust(run)
    assert trusted is not None
    assert values["truth"]["open"] == list(trusted.open_share)
    assert values["truth"]["warning"] == trusted.warning
    assert all(len(p["open"]) == len(values["thresholds"]) for p in values["policies"])
    assert open_words(trusted, run.protocol.thresholds) in table(run).caption
    assert score_dict(dataclasses.replace(run, truths=()))["truth"] is None
