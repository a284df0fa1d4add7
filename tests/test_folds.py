"""Maps fold where rooms look alike: pairs of images whose own relative pose contradicts SLAM's are told."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
from synthetic_map import CAMERA, looking

from fieldkit.errors import MapError
from fieldkit.features import Features
from fieldkit.frames import Pose, exp
from fieldkit.maps.options import MapOptions, SlamRules
from fieldkit.maps.sources.source import MapSource, SourceImage
from fieldkit.maps.stages import Stages
from fieldkit.maps.structure.placing import Matched, place_once, unfolded
from fieldkit.maps.structure.plausible import plausible_pairs
from fieldkit.maps.structure.sfm import relative_poses
from fieldkit.maps.structure.strays import contradicting, folded, strays

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


def corridor() -> tuple[list[SourceImage], dict[int, Pose]]:
    """A walk of 10 m to a dead end and back, in steps of 0.4 m."""
    way = [*np.arange(0.0, 10.0, 0.4), *np.arange(10.0, 0.0, -0.4)]
    places = [looking(np.array([x, 0.0, 1.5]), 0.0) for x in way]
    images = [SourceImage(f"{k:03d}.jpg", Path(), CAMERA, "", f"{k:03d}", p) for k, p in enumerate(places)]
    return images, dict(enumerate(places))


def test_the_end_of_a_corridor_that_lies_on_its_beginning_is_told(rng: np.random.Generator) -> None:
    images, true = corridor()
    assert strays(images, true, threshold_m=0.05) == []
    end = [i for i, p in true.items() if p.translation[0] > 6.0]
    back = Pose.from_translation([-5.0, 0.0, 0.0])
    moved = true | {i: back * true[i] for i in end}
    assert strays(images, moved, threshold_m=0.05) == end
    assert folded(images, moved, threshold_m=0.05) == set(end)
    last = list(range(46, 50))
    open_end = true | {i: Pose.from_translation([3.0, 0.0, 0.0]) * true[i] for i in last}
    assert strays(images, open_end, threshold_m=0.05) == last


def test_a_stretch_that_slam_has_elsewhere_stays_in_the_map(rng: np.random.Generator) -> None:
    images, true = corridor()
    jump = Pose.from_translation([-4.0, 1.0, 0.0])
    lost = [replaced(image, jump) if 20 <= i < 33 else image for i, image in enumerate(images)]
    assert strays(lost, true, threshold_m=0.05) == []
    assert len(contradicting(lost, true, threshold_m=0.05)) == 13
    assert folded(lost, true, threshold_m=0.05) == set()
    wrong = rng.random(len(images)) < 0.3
    off = [Pose.from_translation(rng.normal(0, 2.0, 3)) for _ in images]
    scattered = [replaced(image, off[i]) if wrong[i] else image for i, image in enumerate(images)]
    assert strays(scattered, true, threshold_m=0.05) == []
    assert folded(scattered, true, threshold_m=0.05) == set()


def replaced(image: SourceImage, moved: Pose) -> SourceImage:
    assert image.slam_from_cam is not None
    return dataclasses.replace(image, slam_from_cam=moved * image.slam_from_cam)


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
    first = place_once(found, stages, options, seed=0, progress=quiet)
    assert first.contradicting > 0.05 * len(first.sfm_poses)
    less = unfolded(found, SlamRules(), stages, options, seed=0, progress=quiet)
    again = place_once(less, stages, options, seed=0, progress=quiet, name="unfolded")
    assert again.contradicting == 0
    assert len(again.sfm_poses) == len(found.walk.images)


def quiet(step: str, done: int, total: int) -> None:
    pass


def test_two_places_that_nothing_connects_are_named(tmp_path: Path, rng: np.random.Generator) -> None:
    rooms = [rng.uniform([x - 1.5, 2.2, 0.6], [x + 1.5, 3.6, 2.4], (220, 3)) for x in (0.0, 40.0)]
    points = np.vstack(rooms)
    images, seen, ids = [], [], []
    for k, x in enumerate([*np.arange(-1.0, 1.1, 0.25), *np.arange(39.4, 40.7, 0.25)]):
        place = looking(np.array([x, 0.05 * rng.normal(), 1.5]), np.pi / 2)
        pixels, inside = CAMERA.project(place.inv().apply(points))
        visible = np.flatnonzero(inside & (np.abs(points[:, 0] - x) < 10.0))
        pixels = pixels[visible] + rng.normal(0.0, 0.3, (len(visible), 2))
        unused = np.zeros(len(visible), np.float32)
        seen.append(Features(pixels.astype(np.float32), unused, unused, np.zeros((len(visible), 128), np.float32)))
        images.append(SourceImage(f"{k:03d}.jpg", Path(), CAMERA, "", f"{k:03d}", place))
        ids.append({int(i): n for n, i in enumerate(visible)})
    pairs = list(itertools.combinations(range(len(images)), 2))
    matches = [
        np.array([(ids[a][i], ids[b][i]) for i in ids[a] if i in ids[b]], np.uint32).reshape(-1, 2) for a, b in pairs
    ]
    found = Matched(MapSource(Path("flats"), tuple(images), None, ()), seen, pairs, matches)
    placing = place_once(found, Stages(tmp_path, {}), MapOptions(n_threads=1), seed=0, progress=quiet)
    assert len(placing.sfm_poses) == 9
    (told,) = [w for w in placing.warnings if "registered" in w]
    assert "9 of 15 images registered, without 009.jpg, 010.jpg, 011.jpg, 012.jpg, ..." in told
    assert "6 others (009.jpg, 010.jpg, 011.jpg, 012.jpg, ...) hang together by themselves" in told
    assert "map each by itself" in told
    strict = MapOptions(n_threads=1, min_registered=0.7)
    with pytest.raises(MapError, match=r"9 of 15 images registered; 6 others .* hang together by themselves; expected"):
        place_once(found, Stages(tmp_path, {}), strict, seed=0, progress=quiet)
    unposed = tuple(dataclasses.replace(image, slam_from_cam=None) for image in images[:9])
    halves = dataclasses.replace(found, walk=MapSource(Path("flats"), unposed + tuple(images[9:]), None, ()))
    told = (
        r"0 of the 9 in the largest have a SLAM pose, but 6 of 6 others \(009.jpg, .*map the piece with poses by itself"
    )
    with pytest.raises(MapError, match=told):
        place_once(halves, Stages(tmp_path, {}), MapOptions(n_threads=1), seed=0, progress=quiet)
