"""The features F of learned policies: what each number is, its range, and what cannot change it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_policies import CAMERA, RULES, look, make_candidates, make_map

from fieldkit import maps
from fieldkit.frames import Pose
from fieldkit.store.datasets import map_path, read_dataset, read_scene, read_scene_shard, row_pose
from fieldkit.surface import RayCaster
from fieldkit.types import Candidates, SceneMap
from fieldkit.views import (
    HISTOGRAM_WIDTH,
    TOKEN_WIDTH,
    HeatMaps,
    SeenLandmarks,
    landmark_statistics,
    landmark_tokens,
    seen_in_shard,
    seen_landmarks,
    thinned,
    view_histograms,
    visibility,
)


@pytest.fixture
def scene_map(rng: np.random.Generator) -> SceneMap:
    """Three hundred landmarks about the origin, each seen by all of five mapping cameras at random pixels."""
    xyz = rng.uniform([-4, -4, -1], [4, 4, 1], (300, 3))
    mapping = [look([*rng.uniform(-2, 2, 2), 0], yaw) for yaw in (0, 70, 140, 210, 280)]
    return dataclasses.replace(
        make_map(xyz, mapping), observation_px=rng.uniform([0, 0], [640, 480], (1500, 2)).astype(np.float32)
    )


def see(scene_map: SceneMap, *poses: Pose) -> tuple[SeenLandmarks, ...]:
    candidates = make_candidates(*poses)
    seen = visibility(scene_map, candidates, rules=RULES)
    return seen_landmarks(seen, candidates, statistics=landmark_statistics(scene_map))


def tokens_of(scene_map: SceneMap, seen: SeenLandmarks) -> np.ndarray:
    return landmark_tokens(seen, landmark_statistics(scene_map), heat_maps=HeatMaps(scene_map), camera=CAMERA)


def histograms_of(scene_map: SceneMap, seen: SeenLandmarks) -> np.ndarray:
    return view_histograms(seen, landmark_statistics(scene_map), camera=CAMERA)


def counts(histograms: np.ndarray) -> np.ndarray:
    """Return the numbers of landmarks that were scaled to 0..1."""
    return np.rint(np.expm1(histograms.astype(np.float64) * np.log(4097))).astype(int)


def test_every_column_of_a_token_is_what_is_documented() -> None:
    landmark = np.array([[3.0, 0.4, 0.3]])
    mapping = [look([1.0, 0.0, 0.0], 0), look([0.0, 0.0, 0.0], 10)]
    pixels = np.array([[0.5, 0.5], [639.0, 479.0]], np.float32)
    scene_map = dataclasses.replace(make_map(landmark, mapping), observation_px=pixels)
    (seen,) = see(scene_map, look([-1.0, 0.0, 0.0], 0))
    token = tokens_of(scene_map, seen)[0]

    near, far, here = (np.linalg.norm(landmark[0] - at) for at in ([1, 0, 0], [0, 0, 0], [-1, 0, 0]))
    np.testing.assert_allclose(token[:3], np.array([here, near, far]) / 5.0, rtol=1e-6)
    axis = np.array([np.cos(np.radians(10)), np.sin(np.radians(10)), 0.0])
    first, second = np.arccos(2.0 / near), np.arccos(axis @ landmark[0] / far)
    angles = np.array([np.arccos(4.0 / here), min(first, second), max(first, second)])
    np.testing.assert_allclose(token[3:6], angles / np.pi, atol=1e-6)
    towards = [(np.array(at) - landmark[0]) / d for at, d in (([1, 0, 0], near), ([0, 0, 0], far))]
    mean = np.mean(towards, axis=0) / np.linalg.norm(np.mean(towards, axis=0))
    off = np.arccos(mean @ (np.array([-1, 0, 0]) - landmark[0]) / here)
    assert token[6] == pytest.approx(off / np.pi, abs=1e-6)
    u, v = 320 - 552.03 * 0.4 / 4.0, 240 - 552.03 * 0.3 / 4.0
    np.testing.assert_allclose(token[7:9], [u / 640, v / 480], atol=1e-6)
    heat = np.zeros((8, 8))
    heat[0, 0] = heat[7, 7] = np.log(2) / np.log(33)
    np.testing.assert_allclose(token[9:].reshape(8, 8), heat, atol=1e-6)


def test_histograms_count_the_landmarks_of_a_view(scene_map: SceneMap) -> None:
    (seen,) = see(scene_map, look([-1, 0, 0], 20))
    n = len(seen.landmark)
    assert n > 20
    numbers = counts(histograms_of(scene_map, seen))
    assert numbers[0] == n
    parts = [*(slice(2 + 10 * i, 12 + 10 * i) for i in range(6)), slice(62, 126), slice(126, 136), slice(136, 146)]
    assert [int(numbers[part].sum()) for part in parts] == [n] * 9
    u, v = (seen.uv_px / (640, 480)).T
    np.testing.assert_array_equal(numbers[126:136], np.histogram(u, bins=10, range=(0, 1))[0])
    np.testing.assert_array_equal(numbers[62:126].reshape(8, 8), np.histogram2d(v, u, bins=8, range=[[0, 1]] * 2)[0])
    known = landmark_statistics(scene_map)
    bins = np.clip(known.min_distance_m[seen.landmark] / 0.5, 0, 9).astype(int)
    np.testing.assert_array_equal(numbers[2:12], np.bincount(bins, minlength=10))
    assert numbers[1] == np.count_nonzero(seen.off_mean_rad <= known.spread_rad[seen.landmark])


def test_all_features_are_in_0_to_1_and_finite(scene_map: SceneMap) -> None:
    odd = dataclasses.replace(scene_map, xyz=scene_map.xyz * 30.0)
    for known in (scene_map, odd):
        for seen in see(known, *(look([x, 0.1, 0], yaw) for x in (-2, 0, 3) for yaw in range(0, 360, 40))):
            for features in (tokens_of(known, seen), histograms_of(known, seen)):
                assert np.isfinite(features).all()
                assert features.min(initial=0.0) >= 0.0
                assert features.max(initial=0.0) <= 1.0


def test_a_landmark_that_mapping_never_saw_has_features_too(scene_map: SceneMap) -> None:
    keep = scene_map.observation_landmark % 2 == 0
    fields = ("observation_landmark", "observation_image", "observation_px")
    half = dataclasses.replace(scene_map, **{f: getattr(scene_map, f)[keep] for f in fields})
    (seen,) = see(half, look([-1, 0, 0], 20))
    assert (seen.landmark % 2 == 1).any()
    for features in (tokens_of(half, seen), histograms_of(half, seen)):
        assert np.isfinite(features).all()
        assert features.min() >= 0.0
        assert features.max() <= 1.0
    assert counts(histograms_of(half, seen))[42:52].sum() == len(seen.landmark)


def test_a_view_that_sees_nothing_has_no_token_and_zero_histograms(scene_map: SceneMap) -> None:
    (seen,) = see(scene_map, look([50, 0, 0], 0))
    assert tokens_of(scene_map, seen).shape == (0, TOKEN_WIDTH)
    assert histograms_of(scene_map, seen).tolist() == [0.0] * HISTOGRAM_WIDTH


def test_turning_and_shifting_the_whole_map_changes_no_feature(scene_map: SceneMap, rng: np.random.Generator) -> None:
    shift = Pose.from_components(rng.normal(size=3) * 5, Rotation.from_rotvec(rng.normal(size=3)))
    moved = dataclasses.replace(
        scene_map, xyz=shift.apply(scene_map.xyz), map_from_image=tuple(shift * p for p in scene_map.map_from_image)
    )
    at = look([0.3, 0.2, 0], 33)
    (here,), (there,) = see(scene_map, at), see(moved, shift * at)
    np.testing.assert_allclose(tokens_of(scene_map, here), tokens_of(moved, there), atol=1e-5)
    np.testing.assert_array_equal(histograms_of(scene_map, here), histograms_of(moved, there))


def test_a_shard_has_the_features_of_its_candidates(whole: Path) -> None:
    entry = read_scene(whole, read_dataset(whole).scenes[0])
    scene_map = maps.load_map(map_path(whole, entry))
    known, rays = landmark_statistics(scene_map), RayCaster(scene_map.surface)  # type: ignore[arg-type]
    shard = read_scene_shard(whole, entry, entry.waypoints[0])
    poses = tuple(row_pose(row) for row in shard.candidate)
    allowed = np.ones(len(poses), dtype=bool)
    candidates = Candidates("w", shard.view_ids, shard.kinds, poses, shard.camera, allowed)  # type: ignore[arg-type]
    rules, tolerance_m = read_dataset(whole).rules, 2.0 * scene_map.surface.voxel_m  # type: ignore[union-attr]
    for occlusion in (False, True):
        seen = visibility(
            scene_map, candidates, rules=rules.candidates, rays=rays if occlusion else None, tolerance_m=tolerance_m
        )
        for i, one in enumerate(seen_landmarks(seen, candidates, statistics=known)):
            other = seen_in_shard(shard, i, xyz=scene_map.xyz, statistics=known, occlusion=occlusion)
            np.testing.assert_array_equal(one.landmark, other.landmark)
            pair = [landmark_tokens(s, known, heat_maps=HeatMaps(scene_map), camera=shard.camera) for s in (one, other)]
            np.testing.assert_allclose(*pair, atol=1e-6)


def test_thinned_views_keep_the_same_landmarks_where_they_overlap(scene_map: SceneMap) -> None:
    one, two = see(scene_map, look([-2, 0, 0], 0), look([-2, 0, 0], 8))
    shared = np.intersect1d(one.landmark, two.landmark)
    few = [thinned(s, cap=20) for s in (one, two)]
    assert [len(s.landmark) for s in few] == [20, 20]
    assert [s.visible for s in few] == [len(one.landmark), len(two.landmark)]
    kept = [np.intersect1d(s.landmark, shared) for s in few]
    # One view may keep a few more of the shared ones, never others in their place.
    assert set(kept[0]) <= set(kept[1]) or set(kept[1]) <= set(kept[0])
    again, other = thinned(one, cap=20), thinned(one, cap=20, seed=1)
    np.testing.assert_array_equal(again.landmark, few[0].landmark)
    assert set(other.landmark) != set(again.landmark)
    assert thinned(one, cap=len(one.landmark)) is one


def test_every_landmark_is_kept_about_equally_often(scene_map: SceneMap) -> None:
    (seen,) = see(scene_map, look([-2, 0, 0], 0))
    n, cap = len(seen.landmark), 10
    times = np.zeros(300)
    for seed in range(400):
        times[thinned(seen, cap=cap, seed=seed).landmark] += 1
    expected = 400 * cap / n
    assert np.abs(times[seen.landmark] - expected).max() < 5 * np.sqrt(expected)


def test_a_landmark_less_is_what_the_view_sees_without_it(scene_map: SceneMap) -> None:
    (seen,) = see(scene_map, look([-2, 0, 0], 0))
    less = seen.without(3)
    assert less.visible == seen.visible - 1
    np.testing.assert_array_equal(less.landmark, np.delete(seen.landmark, 3))
    assert counts(histograms_of(scene_map, less))[0] == len(seen.landmark) - 1
