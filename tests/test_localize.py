"""The localizer: poses and covariances from synthetic matches, retrieval, and clear failures."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from synthetic_map import CAMERA, looking, make_map, room_points, write_map

from fieldkit.errors import LocalizeError
from fieldkit.features.matching import match_groups
from fieldkit.frames import Pose, exp, log, pose, pose_error
from fieldkit.localize import Localizer
from fieldkit.localize.matching import stored_descriptors
from fieldkit.localize.pose import PosedPoints, estimate_pose, refine_pose
from fieldkit.localize.retrieval import build_index, image_rows, most_similar
from fieldkit.maps import compact_map, load_map

FOCAL = (550.0, 545.0)


def scene(rng: np.random.Generator, n: int = 60, *, sigma_m: float = 0.0) -> tuple[Pose, PosedPoints]:
    """Return a true map_from_cam and exact matches of landmarks whose stored positions are off by ``sigma_m``."""
    truth = looking(np.array([0.3, -0.2, 0.8]), 0.4, 0.1)
    xyz = truth.apply(rng.uniform([-1.2, -0.9, 1.5], [1.2, 0.9, 5.0], size=(n, 3)))
    x_in_cam = truth.inv().apply(xyz)
    pixels = x_in_cam[:, :2] / x_in_cam[:, 2:] * FOCAL
    shapes = sigma_m**2 * np.einsum("nij,nkj->nik", *(2 * [rng.normal(size=(n, 3, 3))])) / 3 + 1e-12 * np.eye(3)
    moved = xyz + np.einsum("nij,nj->ni", np.linalg.cholesky(shapes), rng.normal(size=(n, 3)))
    return truth, PosedPoints(pixels, np.ones(n), moved, shapes, FOCAL)


def noisy(points: PosedPoints, rng: np.random.Generator, *, outliers: int = 0) -> PosedPoints:
    pixels = points.pixels + rng.normal(size=points.pixels.shape)
    pixels[:outliers] = rng.uniform(-300, 300, size=(outliers, 2))
    return dataclasses.replace(points, pixels=pixels)


def test_exact_matches_give_the_exact_pose(rng: np.random.Generator) -> None:
    truth, points = scene(rng)
    found = estimate_pose([points], max_error_px=12.0, seed=0)
    assert found is not None
    assert found.inliers[0].all()
    assert max(pose_error(found.map_from_rig, truth)) < 1e-6


def test_half_of_the_matches_may_be_wrong(rng: np.random.Generator) -> None:
    truth, points = scene(rng, 120, sigma_m=0.01)
    found = estimate_pose([noisy(points, rng, outliers=60)], max_error_px=12.0, seed=0)
    assert found is not None
    assert pose_error(found.map_from_rig, truth)[0] < 0.03
    assert found.inliers[0][60:].sum() >= 58
    assert found.inliers[0][:60].sum() <= 3


@pytest.mark.parametrize("sigma_m", [0.0, 0.02])
def test_the_covariance_predicts_the_error_in_right_perturbations_rotation_first(
    rng: np.random.Generator, sigma_m: float
) -> None:
    nees, blocks = [], []
    for _ in range(150):
        truth, points = scene(rng, sigma_m=sigma_m)
        start = truth * exp(rng.normal(0, 0.01, 6))
        estimate, covariance, _ = refine_pose([noisy(points, rng)], start, noise=1.0)
        d = log(estimate.inv() * truth)
        nees.append(d @ np.linalg.solve(covariance, d))
        blocks.append(
            [d[:3] @ np.linalg.solve(covariance[:3, :3], d[:3]), d[3:] @ np.linalg.solve(covariance[3:, 3:], d[3:])]
        )
    assert 5.0 < np.mean(nees) < 7.2
    assert (np.abs(np.mean(blocks, axis=0) - 3.0) < 0.8).all(), (
        "rotation and translation each have 3 degrees of freedom"
    )


def test_a_direction_that_matches_leave_open_is_unknown_not_certain(rng: np.random.Generator) -> None:
    truth, points = scene(rng, 12)
    on_a_line = np.column_stack([np.linspace(-1.0, 1.0, 12), np.zeros(12), np.full(12, 3.0)])
    pixels = on_a_line[:, :2] / on_a_line[:, 2:] * FOCAL
    row = dataclasses.replace(points, xyz=truth.apply(on_a_line), pixels=pixels)
    _, covariance, _ = refine_pose([row], truth, noise=1.0)
    # Turned about the line, and seen from where it looks the same
    about = np.array([1.0, 0.0, 0.0, 0.0, 3.0, 0.0]) / np.sqrt(10.0)
    assert about @ covariance @ about > 100.0
    assert np.diag(covariance)[[1, 2]].max() < 0.01


def test_certain_landmarks_count_more_than_uncertain_ones(rng: np.random.Generator) -> None:
    weighted, plain = [], []
    for _ in range(40):
        truth, points = scene(rng)
        spread = np.where(np.arange(60) < 40, 0.08, 0.002)
        covariance = spread[:, None, None] ** 2 * np.eye(3)
        points = dataclasses.replace(
            noisy(points, rng), xyz=points.xyz + spread[:, None] * rng.normal(size=(60, 3)), xyz_covariance=covariance
        )
        same = dataclasses.replace(points, xyz_covariance=np.tile(0.03**2 * np.eye(3), (60, 1, 1)))
        weighted.append(pose_error(refine_pose([points], truth, noise=1.0)[0], truth)[0])
        plain.append(pose_error(refine_pose([same], truth, noise=1.0)[0], truth)[0])
    assert np.mean(weighted) < 0.7 * np.mean(plain)


def test_turning_and_shifting_the_map_turns_the_pose_and_keeps_the_covariance(rng: np.random.Generator) -> None:
    _, points = scene(rng, sigma_m=0.01)
    points = noisy(points, rng)
    turn = pose([4.0, -2.0, 1.0], [0.2, -0.4, 0.1, 0.888])
    matrix = turn.rotation.as_matrix()
    turned = dataclasses.replace(
        points, xyz=turn.apply(points.xyz), xyz_covariance=matrix @ points.xyz_covariance @ matrix.T
    )
    first = estimate_pose([points], max_error_px=12.0, seed=0)
    second = estimate_pose([turned], max_error_px=12.0, seed=0)
    assert first is not None
    assert second is not None
    assert max(pose_error(second.map_from_rig, turn * first.map_from_rig)) < 1e-6
    np.testing.assert_allclose(second.covariance, first.covariance, rtol=1e-3, atol=1e-9)


def test_the_same_matches_give_the_same_bits_whatever_came_between(rng: np.random.Generator) -> None:
    _, points = scene(rng, 100, sigma_m=0.01)
    points = noisy(points, rng, outliers=50)
    first = estimate_pose([points], max_error_px=12.0, seed=3)
    for seed in range(5):
        estimate_pose([noisy(scene(rng)[1], rng, outliers=20)], max_error_px=12.0, seed=seed)
    again = estimate_pose([points], max_error_px=12.0, seed=3)
    assert first is not None
    assert again is not None
    np.testing.assert_array_equal(first.map_from_rig.as_matrix(), again.map_from_rig.as_matrix())
    np.testing.assert_array_equal(first.covariance, again.covariance)


def test_random_matches_have_few_inliers(rng: np.random.Generator) -> None:
    _, points = scene(rng, 200)
    wild = dataclasses.replace(points, pixels=rng.uniform(-320, 320, size=(200, 2)))
    found = estimate_pose([wild], max_error_px=12.0, seed=0)
    assert found is None or found.inliers[0].sum() < 12


def query(rng: np.random.Generator, scene_map: object, view: Pose) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pixels, descriptors and landmarks of what a camera of the map would see."""
    projected, seen = CAMERA.project(view.inv().apply(scene_map.xyz))  # type: ignore[attr-defined]
    known = np.isin(np.arange(len(seen)), scene_map.descriptor_landmark)  # type: ignore[attr-defined]
    landmarks = np.flatnonzero(seen & known)
    first = np.searchsorted(np.sort(scene_map.descriptor_landmark), landmarks)  # type: ignore[attr-defined]
    order = np.argsort(scene_map.descriptor_landmark, kind="stable")  # type: ignore[attr-defined]
    descriptors = scene_map.descriptors[order[first]]  # type: ignore[attr-defined]
    return projected[landmarks], descriptors, landmarks


@pytest.mark.parametrize("compact", [False, True])
def test_retrieval_finds_images_of_the_same_place_and_matching_their_landmarks(
    tmp_path: Path, rng: np.random.Generator, compact: bool
) -> None:
    scene_map = make_map(rng)
    if compact:
        write_map(tmp_path / "room.map", scene_map)
        compact_map(tmp_path / "room.map", tmp_path / "small.map")
        scene_map = load_map(tmp_path / "small.map")
    index = build_index(scene_map, seed=0)
    for i in (3, 11, 20):
        view = scene_map.map_from_image[i] * exp([0.02, 0.05, 0.0, 0.05, 0.0, 0.05])
        pixels, descriptors, landmarks = query(rng, scene_map, view)
        images = most_similar(index, descriptors, count=5)
        assert i in images
        stored, owner = stored_descriptors(scene_map, index, images)
        rows, found, _ = match_groups(descriptors, stored, owner, ratio=0.8)
        np.testing.assert_array_equal(found, landmarks[rows])
        assert len(found) > 0.7 * len(landmarks)
        focal = np.asarray(CAMERA.focal_px)
        points = PosedPoints(
            CAMERA.unproject(pixels[rows])[:, :2] * focal,
            np.ones(len(rows)),
            scene_map.xyz[found],
            scene_map.xyz_covariance[found],
            CAMERA.focal_px,
        )
        solved = estimate_pose([points], max_error_px=12.0, seed=0)
        assert solved is not None
        assert max(pose_error(solved.map_from_rig, view)) < 1e-4


def test_a_landmark_is_matched_by_the_descriptors_of_the_best_images_only(rng: np.random.Generator) -> None:
    scene_map = make_map(rng, n_landmarks=60, n_images=12)
    index = build_index(scene_map, seed=0)
    order = np.array([7, 6, 8, 5, 9, 4], dtype=np.int32)
    _, owner = stored_descriptors(scene_map, index, order)
    observers = [
        np.isin(order, scene_map.descriptor_image[scene_map.descriptor_landmark == k]).sum() for k in range(60)
    ]
    np.testing.assert_array_equal(np.bincount(owner, minlength=60), np.minimum(observers, 3))
    best, owner_of_best = stored_descriptors(scene_map, index, order[:1])
    stored, owner = stored_descriptors(scene_map, index, order)
    for descriptor, landmark in zip(best, owner_of_best, strict=True):
        assert (stored[owner == landmark] == descriptor).all(axis=1).any()


def test_every_observed_landmark_describes_its_image_in_a_compact_map_too(rng: np.random.Generator) -> None:
    scene_map = make_map(rng, n_landmarks=80, n_images=6)
    _, first = np.unique(scene_map.descriptor_landmark, return_index=True)
    small = dataclasses.replace(
        scene_map,
        descriptors=scene_map.descriptors[first],
        descriptor_landmark=scene_map.descriptor_landmark[first],
        descriptor_image=scene_map.descriptor_image[first],
    )
    for some_map in (scene_map, small):
        for i, rows in enumerate(image_rows(some_map)):
            observed = scene_map.observation_landmark[scene_map.observation_image == i]
            np.testing.assert_array_equal(np.sort(some_map.descriptor_landmark[rows]), np.sort(observed))


def test_an_image_without_texture_is_a_failure_with_a_reason_and_no_pose(rng: np.random.Generator) -> None:
    localizer = Localizer(make_map(rng))
    blank = localizer.localize(np.full((640, 480), 100, dtype=np.uint8), CAMERA)
    assert (blank.map_from_cam, blank.covariance, blank.status, blank.confidence) == (None, None, "no_features", 0.0)
    noise = localizer.localize(rng.integers(0, 255, size=(640, 480)).astype(np.uint8), CAMERA)
    assert noise.map_from_cam is None
    assert noise.status in ("no_matches", "no_pose", "few_inliers")
    assert noise.n_inliers < 12


def test_an_image_of_another_size_than_its_camera_is_refused(rng: np.random.Generator) -> None:
    localizer = Localizer(make_map(rng, n_landmarks=50, n_images=4))
    with pytest.raises(LocalizeError, match="image is 480x600; its camera says 480x640"):
        localizer.localize(np.zeros((600, 480), dtype=np.uint8), CAMERA)


def test_a_map_without_descriptors_is_refused(rng: np.random.Generator) -> None:
    empty = dataclasses.replace(make_map(rng, n_landmarks=50, n_images=4), descriptors=np.zeros((0, 128), np.uint8))
    with pytest.raises(LocalizeError, match="no landmarks with descriptors"):
        Localizer(empty)


def test_synthetic_rooms_have_landmarks_on_walls(rng: np.random.Generator) -> None:
    points = room_points(rng, 200)
    on_wall = np.isclose(np.abs(points[:, 0]), 3.0) | np.isclose(np.abs(points[:, 1]), 2.0)
    assert on_wall.all()
