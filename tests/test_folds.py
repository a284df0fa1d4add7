"""Maps fold where rooms look alike: pairs of images whose own relative pose contradicts SLAM's are told."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
from synthetic_map import CAMERA, looking

from fieldkit.features import Features
from fieldkit.frames import Pose, exp
from fieldkit.maps.options import MapOptions
from fieldkit.maps.placing import Matched, place_once, unfolded
from fieldkit.maps.plausible import SlamRules, plausible_pairs
from fieldkit.maps.sfm import relative_poses
from fieldkit.maps.source import MapSource, SourceImage
from fieldkit.maps.stages import Stages
from fieldkit.maps.strays import contradicting

PLACES = [looking(np.array([x, 0.0, 1.5]), np.pi / 2) for x in (0.0, 1.0)]
ELSEWHERE = PLACES[1] * exp([0.0, 0.0, 0.0, 0.0, 0.0, 3.0])
TURNED = PLACES[1] * exp([0.0, np.radians(12.0), 0.0, 0.0, 0.0, 0.0])


def own_pose(rng: np.random.Generator, *, pair: tuple[int, int] = (0, 1), n_matches: int = 150) -> Pose | None:
    """Let COLMAP find the relative pose of two images of one room from their keypoints alone."""
    points = rng.uniform([-0.5, 2.5, 0.8], [1.5, 5.0, 2.2], (150, 3))
    images, seen = [], []
    for k, place in enumerate(PLACES):
        pixels, _ = CAMERA.project(place.inv().apply(points))
        pixels = pixels + rng.normal(0.0, 0.3, pixels.shape)
        unused = np.zeros(len(points), np.float32)
        seen.append(Features(pixels.astype(np.float32), unused, unused, np.zeros((len(points), 128), np.float32)))
        images.append(SourceImage(f"{k}.jpg", Path(), CAMERA, "", str(k), None))
    matches = np.arange(n_matches, dtype=np.uint32)[:, None].repeat(2, axis=1)
    (found,) = relative_poses(images, seen, [pair], [matches], seed=0)
    return found


def agrees(slam: list[Pose | None], b_from_a: Pose | None) -> bool:
    images = [SourceImage(f"{k}.jpg", Path(), CAMERA, "", str(k), pose) for k, pose in enumerate(slam)]
    (agreed,) = plausible_pairs(images, [(0, 1)], [b_from_a], rules=SlamRules()).tolist()
    return bool(agreed)


def test_a_pair_stays_where_slam_saw_it_and_goes_where_slam_was_elsewhere(rng: np.random.Generator) -> None:
    relative = own_pose(rng)
    assert relative is not None
    drifted = PLACES[1] * exp([0.0, 0.02, 0.0, 0.1, 0.0, 0.1])
    assert agrees([*PLACES], relative)
    assert agrees([PLACES[0], drifted], relative)
    assert not agrees([PLACES[0], ELSEWHERE], relative)
    assert not agrees([PLACES[0], TURNED], relative)
    assert agrees([PLACES[0], None], relative)
    assert agrees([PLACES[0], ELSEWHERE], None)


def test_the_relative_pose_of_a_pair_follows_its_order_and_needs_enough_matches(rng: np.random.Generator) -> None:
    forth, back = own_pose(rng), own_pose(rng, pair=(1, 0))
    assert forth is not None
    assert back is not None
    step = PLACES[1].inv() * PLACES[0]
    assert forth.translation @ step.translation > 0.99
    assert back.translation @ step.inv().translation > 0.99
    assert own_pose(rng, n_matches=10) is None


def test_an_image_contradicts_where_it_is_farther_from_slam_than_drift_goes() -> None:
    images = [SourceImage(f"{k}.jpg", Path(), CAMERA, "", str(k), pose) for k, pose in enumerate(PLACES)]
    images.append(SourceImage("2.jpg", Path(), CAMERA, "", "2", None))
    mapped = {0: PLACES[0], 1: ELSEWHERE, 2: ELSEWHERE}
    assert contradicting(images, mapped, threshold_m=0.05) == {1}
    assert contradicting(images, mapped, threshold_m=1.1) == set()


def two_rooms(rng: np.random.Generator) -> Matched:
    """Return a walk past two identical rooms 6 m apart with little between them, with the matches of both kinds."""
    room = rng.uniform([-0.8, 2.2, 0.6], [0.8, 3.4, 2.4], (150, 3))
    wall = rng.uniform([0.5, 2.6, 0.6], [5.5, 3.2, 2.4], (70, 3))
    points = np.vstack([room, room + [6.0, 0.0, 0.0], wall])
    images, seen, ids = [], [], []
    for k, x in enumerate(np.arange(-0.6, 6.7, 0.3)):
        place = looking(np.array([x, 0.03 * rng.normal(), 1.5 + 0.03 * rng.normal()]), np.pi / 2)
        pixels, inside = CAMERA.project(place.inv().apply(points))
        visible = np.flatnonzero(inside & ((pixels > 0) & (pixels < (CAMERA.width, CAMERA.height))).all(axis=1))
        pixels = pixels[visible] + rng.normal(0.0, 0.3, (len(visible), 2))
        unused = np.zeros(len(visible), np.float32)
        seen.append(Features(pixels.astype(np.float32), unused, unused, np.zeros((len(visible), 128), np.float32)))
        images.append(SourceImage(f"{k:03d}.jpg", Path(), CAMERA, "", f"{k:03d}", place))
        ids.append(visible)
    pairs, matches = [], []
    for a, b in itertools.combinations(range(len(images)), 2):
        # Far apart along the walk a point's twin in the other room is taken for it; neighbours see the point itself.
        twin = 12 < b - a < 20
        other = {int(i) - 150 * (twin and 150 <= i < 300): n for n, i in enumerate(ids[b]) if not twin or i < 300}
        common = [(n, other[int(i)]) for n, i in enumerate(ids[a]) if int(i) in other and (twin or b - a < 5)]
        pairs.append((a, b))
        matches.append(np.array(common, np.uint32).reshape(-1, 2))
    return Matched(MapSource(Path("two rooms"), tuple(images), None, ()), seen, pairs, matches)


def test_a_map_in_which_one_room_lies_on_the_next_is_unfolded(tmp_path: Path, rng: np.random.Generator) -> None:
    found, options, stages = two_rooms(rng), MapOptions(n_threads=1), Stages(tmp_path, {})
    folded = place_once(found, stages, options, seed=0, progress=quiet)
    assert folded.contradicting > 0.05 * len(folded.sfm_poses)
    less = unfolded(found, SlamRules(), stages, options, seed=0, progress=quiet)
    again = place_once(less, stages, options, seed=0, progress=quiet, name="unfolded")
    assert again.contradicting == 0
    assert len(again.sfm_poses) == len(found.walk.images)


def quiet(step: str, done: int, total: int) -> None:
    pass
