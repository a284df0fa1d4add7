"""The joint problem: derivatives, elimination of landmarks, covariance, and what must not change a result."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from calibration_scenes import MAP_FROM_TAG, PHOTO, SIZE_M, Scene, corner_noise, drawn, photograph

from fieldkit.calibrate.adjustment import Corners, Landmarks, State, adjust, adjust_cameras
from fieldkit.calibrate.geometry import Poses, bearings, corner_bearings
from fieldkit.calibrate.solving import SolvedTag, solve_tags
from fieldkit.frames import Array, Pose, exp, log, pose_error

TWO_TAGS = (MAP_FROM_TAG, MAP_FROM_TAG * exp([0.1, 0.0, 0.2, 0.3, 0.1, 0.02]))
TURN = exp([0.3, -0.5, 1.1, 4.0, -2.0, 0.7])


def small(seed: int = 0, **options: object) -> Scene:
    rng = np.random.default_rng(seed)
    return photograph(rng, n_photos=3, n_landmarks=25, tags=TWO_TAGS, **options)  # type: ignore[arg-type]


def everything(corners: Corners) -> np.ndarray:
    return np.ones(len(corners), dtype=bool)


def solve(scene: Scene) -> tuple[SolvedTag, ...]:
    return solve_tags(scene.photos, scene.xyz, scene.covariance, sizes_m={None: SIZE_M}).tags


def test_whitening_is_the_distorted_pixel_in_sigmas() -> None:
    pixels = np.array([[3.0, 5.0], [800.0, 600.0], [1500.0, 100.0]])
    shift = np.array([0.02, -0.01])
    one, two = bearings(PHOTO, pixels, 0.5), bearings(PHOTO, pixels + shift, 0.5)
    whitened = np.einsum("nij,nj->ni", one.whitening, two.xy - one.xy)
    np.testing.assert_allclose(whitened, np.tile(shift / 0.5, (3, 1)), atol=1e-5)


def test_corners_are_whitened_by_their_covariance(rng: np.random.Generator) -> None:
    pixels, shift = (
        np.array([[30.0, 50.0], [800.0, 600.0], [1500.0, 100.0], [700.0, 90.0]]),
        rng.normal(0, 0.01, (4, 2)),
    )
    noise = corner_noise(rng, 0.4)
    (one, whitening), (two, _) = (corner_bearings(PHOTO, p, noise) for p in (pixels, pixels + shift))
    whitened = whitening @ (two - one).ravel()
    assert whitened @ whitened == pytest.approx(shift.ravel() @ np.linalg.solve(noise, shift.ravel()), rel=1e-3)


def test_derivatives_of_corners_are_the_numeric_ones() -> None:
    _, corners, state = small().joint()
    residual, derivative = corners.linearise(state)
    step = 1e-6
    for i in range(derivative.shape[2]):
        d = np.zeros(derivative.shape[2])
        d[i] = step
        numeric = (corners.residuals(state.moved(d)) - corners.residuals(state.moved(-d))) / (2 * step)
        np.testing.assert_allclose(-numeric, derivative[:, :, i], atol=1e-4 * np.abs(derivative).max())
    assert np.abs(residual).max() < 6


def test_the_gradient_of_the_landmarks_is_the_numeric_one() -> None:
    landmarks, _, state = small().joint()
    # A little off, where the gradient is not zero
    cameras = state.cameras.moved(np.full((3, 6), 1e-3))
    downhill, step = landmarks.reduced(cameras).gradient, 1e-6
    for i in range(18):
        d = np.zeros(18)
        d[i] = step
        ahead, behind = (landmarks.reduced(cameras.moved(s * d.reshape(3, 6))).chi2 for s in (1, -1))
        assert -(ahead - behind) / (2 * step) / 2 == pytest.approx(downhill[i], abs=1e-3 * np.abs(downhill).max())


def test_eliminated_landmarks_leave_what_the_dense_problem_leaves() -> None:
    landmarks, _, state = small().joint()
    xyz = landmarks.xyz
    reduced = landmarks.reduced(state.cameras)
    rows, n, prior = len(landmarks.photo), len(xyz), np.linalg.cholesky(landmarks.information)
    dense, step = np.zeros((2 * rows + 3 * n, 18 + 3 * n)), 1e-6

    def residuals(cameras: Poses, points: Array) -> Array:
        back = cameras.rotation.transpose(0, 2, 1)[landmarks.photo]
        x = np.einsum("oij,oj->oi", back, points[landmarks.landmark] - cameras.position[landmarks.photo])
        seen = np.einsum("oij,oj->oi", landmarks.bearings.whitening, x[:, :2] / x[:, 2:] - landmarks.bearings.xy)
        return np.concatenate([seen.ravel(), np.einsum("lji,lj->li", prior, points - xyz).ravel()])

    best = xyz.copy()
    for _ in range(4):
        for i in range(3 * n):
            d = np.zeros(3 * n)
            d[i] = step
            pair = [residuals(state.cameras, best + s * d.reshape(n, 3)) for s in (1, -1)]
            dense[:, 18 + i] = (pair[0] - pair[1]) / (2 * step)
        best = best - np.linalg.lstsq(dense[:, 18:], residuals(state.cameras, best))[0].reshape(n, 3)
    for i in range(18):
        d = np.zeros(18)
        d[i] = step
        pair = [residuals(state.cameras.moved(s * d.reshape(3, 6)), best) for s in (1, -1)]
        dense[:, i] = (pair[0] - pair[1]) / (2 * step)
    expected = np.linalg.inv(np.linalg.inv(dense.T @ dense)[:18, :18])
    np.testing.assert_allclose(reduced.normal, expected, rtol=1e-3, atol=1e-5 * np.abs(expected).max())
    assert reduced.chi2 == pytest.approx(float((residuals(state.cameras, best) ** 2).sum()), rel=1e-6)


def test_without_noise_the_tags_are_exact() -> None:
    scene = small()
    photos = []
    for photo, cam in zip(scene.photos, scene.map_from_cams, strict=True):
        pixels = PHOTO.project(cam.inv().apply(scene.xyz[photo.landmark]))[0]
        corners = [
            dataclasses.replace(d, corners_px=PHOTO.project((cam.inv() * t).apply(_corners()))[0])
            for d, t in zip(photo.detections, TWO_TAGS, strict=True)
        ]
        photos.append(dataclasses.replace(photo, bearings=bearings(PHOTO, pixels, 1.0), detections=tuple(corners)))
    for tag, true in zip(solve(dataclasses.replace(scene, photos=tuple(photos))), TWO_TAGS, strict=True):
        assert pose_error(tag.map_from_tag, true) == pytest.approx((0, 0), abs=1e-7)
        assert tag.rms_px < 1e-5


def _corners() -> Array:
    h = SIZE_M / 2
    return np.array([[-h, -h, 0], [h, -h, 0], [h, h, 0], [-h, h, 0]])


def test_the_covariance_is_that_of_the_errors() -> None:
    scene = small()
    landmarks, corners, state = scene.joint()
    truth = adjust(landmarks, corners, state, used=everything(corners), iterations=0)
    rng, errors = np.random.default_rng(1), []
    exact = _noiseless(scene)
    for _ in range(150):
        drawn = _noisy(rng, scene, exact)
        found = adjust(*drawn, state, used=everything(corners), iterations=8)
        errors.append(state.tags.difference(found.state.tags).ravel())
    block = slice(18, 30)
    root = np.linalg.cholesky(truth.covariance[block, block])
    whitened = np.linalg.solve(root, np.array(errors).T)
    # 12 standardised errors, correlations included: their squares have mean 12, within 3 sigma of 150 draws
    assert float((whitened**2).sum(axis=0).mean()) == pytest.approx(12, abs=3 * np.sqrt(24 / 150))
    np.testing.assert_allclose((whitened**2).mean(axis=1), 1.0, atol=4 * np.sqrt(2 / 150))


def _noiseless(scene: Scene) -> tuple[list[Array], list[Array]]:
    pixels = [
        PHOTO.project(c.inv().apply(scene.xyz_true[p.landmark]))[0]
        for c, p in zip(scene.map_from_cams, scene.photos, strict=True)
    ]
    corners = [
        PHOTO.project((c.inv() * t).apply(_corners()))[0] for c in scene.map_from_cams for t in scene.map_from_tags
    ]
    return pixels, corners


def _noisy(rng: np.random.Generator, scene: Scene, exact: tuple[list[Array], list[Array]]) -> tuple[Landmarks, Corners]:
    xyz = scene.xyz_true + rng.normal(0, np.sqrt(scene.covariance[0, 0, 0]), scene.xyz.shape)
    seen = [
        (photo.landmark, bearings(PHOTO, px + rng.normal(0, 1.0, px.shape), 1.0))
        for photo, px in zip(scene.photos, exact[0], strict=True)
    ]
    detections = [(i, d) for i, photo in enumerate(scene.photos) for d in photo.detections]
    corners = [
        (i, d.id, PHOTO, dataclasses.replace(d, corners_px=drawn(rng, px, d.noise_px)))
        for (i, d), px in zip(detections, exact[1], strict=True)
    ]
    return Landmarks.of(seen, xyz, scene.covariance), Corners.of(corners)


def test_landmarks_as_one_quadratic_give_the_result_of_landmarks_as_parameters() -> None:
    landmarks, corners, state = small().joint()
    full = adjust(landmarks, corners, state, used=everything(corners))
    fixed = adjust_cameras(landmarks, state.cameras)
    fast = adjust(fixed, corners, State(fixed.centre, state.tags, state.sizes_m), used=everything(corners))
    for tag in range(2):
        sigma = np.sqrt(np.diag(full.tag_covariance(tag)))
        difference = full.state.tags.difference(fast.state.tags)[tag]
        assert np.abs(difference / sigma).max() < 0.02
        np.testing.assert_allclose(np.sqrt(np.diag(fast.tag_covariance(tag))), sigma, rtol=0.02)


def test_turning_the_whole_map_turns_the_result() -> None:
    scene = photograph(np.random.default_rng(3), n_photos=5, n_landmarks=60, tags=TWO_TAGS)
    rotation = TURN.rotation.as_matrix()
    turned = dataclasses.replace(
        scene,
        xyz=TURN.apply(scene.xyz),
        covariance=rotation @ scene.covariance @ rotation.T,
        photos=tuple(dataclasses.replace(p, map_from_cam=TURN * p.map_from_cam) for p in scene.photos),
    )
    for one, two in zip(solve(scene), solve(turned), strict=True):
        np.testing.assert_allclose(log((TURN * one.map_from_tag).inv() * two.map_from_tag), 0, atol=1e-7)
        np.testing.assert_allclose(two.covariance, one.covariance, atol=1e-4 * np.abs(one.covariance).max())


def test_the_order_of_photos_changes_nothing() -> None:
    scene = photograph(np.random.default_rng(4), n_photos=6, n_landmarks=60, tags=TWO_TAGS)
    order = [3, 0, 5, 1, 4, 2]
    shuffled = dataclasses.replace(scene, photos=tuple(scene.photos[i] for i in order))
    for one, two in zip(solve(scene), solve(shuffled), strict=True):
        np.testing.assert_allclose(log(one.map_from_tag.inv() * two.map_from_tag), 0, atol=1e-9)
        np.testing.assert_allclose(two.covariance, one.covariance, atol=1e-6 * np.abs(one.covariance).max())


def test_several_tags_in_the_same_photos_help_each_other() -> None:
    scene = photograph(np.random.default_rng(5), n_photos=4, n_landmarks=40, tags=TWO_TAGS)
    alone = [dataclasses.replace(p, detections=p.detections[:1]) for p in scene.photos]
    together = solve(scene)[0]
    (single,) = solve(dataclasses.replace(scene, photos=tuple(alone)))
    assert np.trace(together.covariance) < np.trace(single.covariance)


def test_a_pose_and_its_difference_are_inverse() -> None:
    rng = np.random.default_rng(6)
    poses = Poses.of([Pose.identity(), exp(rng.normal(size=6))])
    d = rng.normal(0, 0.3, (2, 6))
    np.testing.assert_allclose(poses.difference(poses.moved(d)), d, atol=1e-12)
