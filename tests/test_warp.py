"""How far a map may be bent: against a dense bundle adjustment, what is left out, and what it does to tags."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from calibration_scenes import photograph
from scipy.spatial.transform import Rotation
from synthetic_map import make_map

from fieldkit.calibrate.adjustment import Corners, Landmarks, adjust, adjust_cameras
from fieldkit.calibrate.geometry import Poses
from fieldkit.frames import Array
from fieldkit.maps import MapWarp, map_warp
from fieldkit.types import SceneMap
from fieldkit.warp import MIN_OBSERVATIONS, shared_errors


@pytest.fixture(scope="module")
def room() -> SceneMap:
    """A map of few landmarks, each seen three times at least."""
    full = make_map(np.random.default_rng(0), n_landmarks=250, n_images=30)
    kept = np.bincount(full.observation_landmark, minlength=len(full.xyz)) >= 3
    rows = kept[full.observation_landmark]
    return dataclasses.replace(
        full,
        xyz=full.xyz[kept],
        xyz_covariance=full.xyz_covariance[kept],
        observation_landmark=(np.cumsum(kept) - 1)[full.observation_landmark[rows]].astype(np.int32),
        observation_image=full.observation_image[rows],
        observation_px=full.observation_px[rows],
    )


@pytest.fixture(scope="module")
def warp(room: SceneMap) -> MapWarp:
    return dataclasses.replace(map_warp(room), sigma_px=1.0)


def dense_jacobian(room: SceneMap) -> Array:
    """Return the numeric derivative of all undistorted pixels by image poses (6k) and landmarks (3n)."""
    k, n, step = len(room.map_from_image), len(room.xyz), 1e-6

    def pixels(poses: Poses, xyz: Array) -> Array:
        offset = xyz[room.observation_landmark] - poses.position[room.observation_image]
        x = np.einsum("oji,oj->oi", poses.rotation[room.observation_image], offset)
        return np.asarray((x[:, :2] / x[:, 2:] * room.image_cameras[0].focal_px).ravel())

    images = Poses.of(room.map_from_image)
    columns = []
    for d in np.eye(6 * k) * step:
        pair = [pixels(images.moved(s * d.reshape(k, 6)), room.xyz) for s in (1, -1)]
        columns.append((pair[0] - pair[1]) / (2 * step))
    for d in np.eye(3 * n) * step:
        pair = [pixels(images, room.xyz + s * d.reshape(n, 3)) for s in (1, -1)]
        columns.append((pair[0] - pair[1]) / (2 * step))
    return np.column_stack(columns)


def laid_on(positions: Array, true: Array, points: Array) -> Array:
    """Return points after the similarity that lays positions on the true ones (Umeyama 1991)."""
    a, b = positions - positions.mean(axis=0), true - true.mean(axis=0)
    turn, _ = Rotation.align_vectors(b, a)
    scale = float((b * turn.apply(a)).sum() / (a**2).sum())
    return np.asarray(scale * turn.apply(points - positions.mean(axis=0)) + true.mean(axis=0))


def test_landmarks_move_together_as_in_a_dense_bundle_adjustment(room: SceneMap, warp: MapWarp) -> None:
    jacobian, k = dense_jacobian(room), len(room.map_from_image)
    chosen = np.random.default_rng(1).choice(len(room.xyz), 12, replace=False)
    # All adjusted maps that noise may give, as directions of one sigma; each is laid on SLAM's positions again
    values, vectors = np.linalg.eigh(jacobian.T @ jacobian)
    steps = (vectors[:, 7:] / np.sqrt(values[7:])).T
    seen = np.bincount(room.observation_image) >= MIN_OBSERVATIONS
    images, small = Poses.of(room.map_from_image), 1e-4
    drawn = np.zeros((3, 3))
    for step in small * steps:
        moved = images.moved(step[: 6 * k].reshape(k, 6))
        points = (room.xyz + step[6 * k :].reshape(-1, 3))[chosen]
        shift = laid_on(moved.position[seen], images.position[seen], points).mean(axis=0)
        shift = (shift - room.xyz[chosen].mean(axis=0)) / small
        drawn += np.outer(shift, shift)
    mean = np.tile(np.eye(3) / len(chosen), (1, len(chosen)))
    own = room.xyz_covariance[chosen].sum(axis=0) / len(chosen) ** 2
    shared = warp.covariance(chosen, mean)
    assert np.trace(shared) > 5 * np.trace(own)
    # SLAM's own knowledge of the images, which the dense adjustment lacks, makes this weak map a little stiffer
    np.testing.assert_allclose(own + shared, drawn, atol=0.08 * np.trace(drawn))


def test_landmarks_follow_when_all_images_move_as_one(room: SceneMap, warp: MapWarp) -> None:
    # Landmarks follow when all images turn, shift or grow
    moved = (warp.pulls @ warp.free).reshape(-1, 3, 7)
    about = room.xyz - np.mean([p.translation for p in room.map_from_image], axis=0)
    np.testing.assert_allclose(moved[:, :, 3:6], np.tile(np.eye(3), (len(about), 1, 1)), atol=1e-3)
    np.testing.assert_allclose(moved[:, :, 6], about, atol=1e-2)


def test_noise_is_that_of_the_map_s_own_residuals() -> None:
    quiet, loud = (map_warp(make_map(np.random.default_rng(2), noise_px=s)).sigma_px for s in (0.3, 1.2))
    assert loud / quiet == pytest.approx(4, rel=0.01)
    # The synthetic map is not adjusted to its noisy keypoints, so that its residuals exceed the noise a little
    assert 0.3 < quiet < 0.45


def test_photos_follow_landmarks_as_response_says() -> None:
    scene = photograph(np.random.default_rng(3), n_photos=3, n_landmarks=40)
    landmarks, _, state = scene.joint()
    found = adjust_cameras(landmarks, state.cameras)
    response = landmarks.response(found.centre, found.normal)
    shift = np.random.default_rng(4).normal(0, 1e-4, landmarks.xyz.shape)
    moved = adjust_cameras(dataclasses.replace(landmarks, xyz=landmarks.xyz + shift), found.centre).centre
    step = found.centre.difference(moved).ravel()
    np.testing.assert_allclose(response @ shift.ravel(), step, atol=0.05 * np.abs(step).max())
    assert len(landmarks.rows) == len(landmarks.xyz)


def test_what_moves_all_photos_together_moves_the_tag_and_is_added_once() -> None:
    scene = photograph(np.random.default_rng(5), n_photos=6, n_landmarks=40)
    landmarks, corners, state = scene.joint()
    fixed = adjust_cameras(landmarks, state.cameras)
    shift = np.array([0.002, -0.001, 0.003])
    by_photo = np.concatenate([np.concatenate([np.zeros(3), r.T @ shift]) for r in fixed.centre.rotation])
    covariance = [_tag_covariance(f, corners, state) for f in (fixed, fixed.warped(np.outer(by_photo, by_photo)))]
    in_tag = state.tags.rotation[0].T @ shift
    np.testing.assert_allclose((covariance[1] - covariance[0])[3:, 3:], np.outer(in_tag, in_tag), atol=2e-7)


def _tag_covariance(landmarks: object, corners: Corners, state: object) -> Array:
    used = np.ones(len(corners), dtype=bool)
    return adjust(landmarks, corners, state, used=used).tag_covariance(0)  # type: ignore[arg-type]


def test_landmarks_of_photos_are_rows_of_the_map() -> None:
    scene = photograph(np.random.default_rng(6), n_photos=2, n_landmarks=20)
    photo = scene.photos[0]
    found = Landmarks.of([(photo.landmark, photo.bearings)], scene.xyz, scene.covariance)
    np.testing.assert_array_equal(scene.xyz[found.rows], found.xyz)
    assert len(Poses.of(scene.map_from_cams)) == 2


def test_with_little_memory_the_shared_errors_are_the_same_and_of_fewer_images_larger(
    room: SceneMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fieldkit.warp.LANDMARKS_AT_ONCE", 17)
    landmark = np.arange(5, 40, 3)
    response = np.random.default_rng(1).normal(size=(6, 3 * len(landmark)))
    whole = map_warp(room).covariance(landmark, response)
    np.testing.assert_allclose(shared_errors(room).covariance(landmark, response), whole, rtol=1e-7, atol=1e-12)
    fewer = shared_errors(room, max_images=15).covariance(landmark, response)
    assert np.trace(fewer) > 1.2 * np.trace(whole)
