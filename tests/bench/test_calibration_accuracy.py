"""How accurate tag calibration is on simulated residuals, beside the bound and the plain mean: `make bench`.

Every scenario has 400 seeded trials of one tag: 8 photos from 1.2 to 2.2 m, 90 landmarks in each with 1 px of noise,
corners with 0.4 px, unequal and correlated. Nothing here passes or fails.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from calibration_scenes import SIZE_M, Scene, flip, localize_wrongly, photograph, tilt_deg
from calibration_table import Outcome, errors, table

from fieldkit.calibrate.adjustment import Landmarks, adjust, adjust_cameras
from fieldkit.calibrate.geometry import Poses
from fieldkit.calibrate.locating import LocatedPhoto
from fieldkit.calibrate.solving import SolvedTag, solve_tags
from fieldkit.frames import Array, Pose, mean_pose
from fieldkit.frames import log as pose_log

TRIALS = 400
DRAWS = 50


def run(seed: int, make: Callable[[np.random.Generator], Scene], *, spoil: bool) -> Outcome:
    rng = np.random.default_rng([seed, int(spoil)])
    scene = make(rng)
    photos, wrong = list(scene.photos), set()
    if spoil:
        order = [int(i) for i in rng.permutation(len(photos))]
        tilted = [i for i in order if tilt_deg(scene, i) > 15.0]
        flipped = tilted[0] if tilted else order[0]
        wrong = {flipped, *[i for i in order if i != flipped][:2]}
        for i in wrong - {flipped}:
            photos[i] = localize_wrongly(rng, scene, i, distance_m=float(rng.uniform(0.3, 2.0)))
        photos[flipped] = flip(rng, scene, flipped)
    (tag,) = solve_tags(photos, scene.xyz, scene.covariance, sizes_m={None: SIZE_M}).tags
    true = scene.map_from_tags[0]
    good = [p for i, p in enumerate(scene.photos) if i not in wrong]
    alone = tag
    if spoil:
        (alone,) = solve_tags(good, scene.xyz, scene.covariance, sizes_m={None: SIZE_M}).tags
    error = pose_log(true.inv() * tag.map_from_tag)
    rejected = {s.sighted.photo for s in tag.sightings if not s.used}
    named = rejected | {s.sighted.photo for s in tag.sightings if s.flipped}
    bound = np.linalg.cholesky(crb(dataclasses.replace(scene, photos=tuple(good)), wrong))
    return Outcome(
        errors(tag.map_from_tag, true),
        errors(alone.map_from_tag, true),
        errors(plain_mean(scene, photos, tag), true),
        rng.normal(size=(DRAWS, 6)) @ bound.T,
        error / np.sqrt(np.diag(tag.covariance)),
        float(error @ np.linalg.solve(tag.covariance, error)) / 6,
        len(wrong - named),
        len(rejected - wrong),
    )


def crb(scene: Scene, left_out: set[int]) -> Array:
    """Return the tag's covariance by the Cramer-Rao bound: the inverse information of the good photos at the truth."""
    landmarks, corners, state = scene.joint()
    cams = [p for i, p in enumerate(scene.map_from_cams) if i not in left_out]
    state = dataclasses.replace(state, cameras=Poses.of(cams))
    return adjust(landmarks, corners, state, used=np.ones(len(corners), dtype=bool), iterations=0).tag_covariance(0)


def plain_mean(scene: Scene, photos: list[LocatedPhoto], tag: SolvedTag) -> Pose:
    """Return the mean of the photos' own tag poses, each localized by itself, as published pipelines take it."""
    poses = []
    for sighting in tag.sightings:
        photo = photos[sighting.sighted.photo]
        alone = Landmarks.of([(photo.landmark, photo.bearings)], scene.xyz, scene.covariance)
        cam = adjust_cameras(alone, Poses.of([photo.map_from_cam])).centre.pose(0)
        poses.append(cam * sighting.sighted.solution.cam_from_tag)
    return mean_pose(poses)[0]


SCENARIOS: dict[str, tuple[Callable[[np.random.Generator], Scene], bool]] = {
    "5 mm map": (lambda rng: photograph(rng), False),
    "20 mm map": (lambda rng: photograph(rng, map_sigma_m=0.02), False),
    "5 mm, own landmarks": (lambda rng: photograph(rng, shared=False), False),
    "3 photos": (lambda rng: photograph(rng, n_photos=3), False),
    "5 mm, corners 0.03 px": (lambda rng: photograph(rng, corner_px=0.03), False),
    "5 mm, photos off 3 mm": (lambda rng: photograph(rng, warp_m=0.003), False),
    "5 mm, own, off 5 mm": (lambda rng: photograph(rng, shared=False, warp_m=0.005), False),
    "5 mm, 3 wrong": (lambda rng: photograph(rng), True),
    "5 mm, 0.03 px, 3 wrong": (lambda rng: photograph(rng, corner_px=0.03), True),
    "20 mm, 3 wrong": (lambda rng: photograph(rng, map_sigma_m=0.02), True),
}


@pytest.mark.parametrize("name", SCENARIOS)
def test_accuracy_of_calibration(benchmark: Any, capsys: pytest.CaptureFixture[str], name: str) -> None:
    make, spoil = SCENARIOS[name]
    trials = benchmark.pedantic(lambda: [run(seed, make, spoil=spoil) for seed in range(TRIALS)], rounds=1)
    with capsys.disabled():
        print("\n" + table({name: trials}))  # noqa: T201


def test_optimise_twenty_photos(benchmark: Any) -> None:
    scene = photograph(np.random.default_rng(0), n_photos=20, n_landmarks=400)
    args = (scene.photos, scene.xyz, scene.covariance)
    benchmark.pedantic(lambda: solve_tags(*args, sizes_m={None: SIZE_M}), rounds=3, warmup_rounds=1)
