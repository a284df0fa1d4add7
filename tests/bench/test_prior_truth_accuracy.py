"""How true the covariances of prior and truth are on simulated sightings and odometry: `make bench`.

Every scenario has 400 seeded sessions; corners, arm, tags and odometry have the noise that is stated, and everything
runs through `estimate_prior` and `estimate_truths`. Nothing here passes or fails.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from standing_scenes import Settings, stand

from fieldkit.frames import Array, Pose, log
from fieldkit.prior import estimate_prior
from fieldkit.truth import estimate_truths

TRIALS = 400
SCENARIOS = {
    "8 at the start, 12 at the waypoint": Settings(),
    "3 start tags": Settings(n_start_tags=3),
    "2 at the start, 1 at the waypoint": Settings(n_start=2, n_truth=1),
    "corner noise not stated": Settings(states_sigma=False, corner_px=0.4),
    "arm 5 times better than stated": Settings(image_factor=0.2),
    "arm 2 times worse than stated": Settings(image_factor=2.0),
    "a step of 0.1 m in the visit": Settings(step_m=0.1),
    "no walk: the start alone": Settings(walk_m=0.0),
    "40 m walk": Settings(walk_m=40.0),
}


@dataclasses.dataclass(frozen=True)
class Judged:
    """One estimate: its normalised error squared per degree of freedom, per axis, and in m and rad."""

    nees: float
    axes: Array
    error: tuple[float, float]
    sigma: tuple[float, float]


def judged(estimate: Pose, true: Pose, covariance: Array) -> Judged:
    delta = log(estimate.inv() * true)
    axes = delta / np.sqrt(np.diag(covariance))
    nees = float(delta @ np.linalg.solve(covariance, delta)) / 6
    sigma = math.sqrt(np.trace(covariance[3:, 3:])), math.sqrt(np.trace(covariance[:3, :3]))
    return Judged(nees, axes, (float(np.linalg.norm(delta[3:])), float(np.linalg.norm(delta[:3]))), sigma)


def run(seed: int, settings: Settings) -> tuple[Judged, Judged]:
    """Return the prior's and one view's truth, judged."""
    rng = np.random.default_rng(seed)
    scene = stand(rng, settings)
    prior = estimate_prior(scene.recording, scene.visit, scene.tags, noise=settings.odometry, arm=settings.arm)
    truths = estimate_truths(scene.recording, scene.visit, scene.tags, noise=settings.odometry, arm=settings.arm)
    view = sorted(truths)[int(rng.integers(len(truths)))]
    truth = truths[view]
    return (
        judged(prior.map_from_body, scene.map_from_body, prior.covariance),
        judged(truth.map_from_cam, scene.map_from_cam[view], truth.covariance),
    )


def line(name: str, found: list[Judged]) -> str:
    nees = np.sort([j.nees for j in found])
    axes = np.abs(np.concatenate([j.axes for j in found]))
    error, sigma = (np.median([getattr(j, k) for j in found], axis=0) for k in ("error", "sigma"))
    cells = [
        name,
        f"{1e3 * error[0]:.2f} mm {math.degrees(error[1]):.3f} deg",
        f"{1e3 * sigma[0]:.2f} mm {math.degrees(sigma[1]):.3f} deg",
        f"{nees[: math.ceil(0.98 * len(nees))].mean():.2f}",
        f"{nees.mean():.2f}",
        f"{100 * np.mean(nees > 22.46 / 6):.1f} %",
        f"{100 * np.mean(axes < 2):.1f} %",
    ]
    return "| " + " | ".join(cells) + " |"


HEAD = (
    "| scenario | median error | stated (root of the trace) | NEES/6, 2 % trimmed | untrimmed "
    "| outliers (0.1 % expected) | within 2 sigma |\n|---|---|---|---|---|---|---|"
)


@pytest.mark.parametrize("name", SCENARIOS)
def test_accuracy_of_prior_and_truth(benchmark: Any, capsys: pytest.CaptureFixture[str], name: str) -> None:
    settings = SCENARIOS[name]
    found = benchmark.pedantic(lambda: [run(seed, settings) for seed in range(TRIALS)], rounds=1)
    with capsys.disabled():
        lines = [line(f"{what}: {name}", [pair[k] for pair in found]) for k, what in enumerate(("prior", "truth"))]
        print("\n".join(["", HEAD, *lines]))  # noqa: T201
