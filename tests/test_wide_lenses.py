"""Localization with distorting lenses: noise and bounds are those of the image, not of its undistorted plane."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from synthetic_map import looking, make_map

from fieldkit.cameras import Camera
from fieldkit.frames import exp, log
from fieldkit.localize.localizer import undistortion_stretch
from fieldkit.localize.narrowing import CameraPrior, plausible_images
from fieldkit.localize.pose import PosedPoints, refine_pose, residuals_px

FISHEYE = Camera("OPENCV_FISHEYE", 800, 800, (290.0, 290.0, 400.0, 400.0, 0.0, 0.0, 0.0, 0.0))
BARREL = Camera("OPENCV", 640, 480, (400.0, 410.0, 320.0, 240.0, -0.2, 0.03, 0.001, -0.001))


def test_the_stretch_of_an_equidistant_fisheye_is_that_of_the_tangent() -> None:
    angle = np.linspace(0.01, 1.3, 40)
    xy = np.column_stack([np.tan(angle) * 0.6, np.tan(angle) * 0.8])
    along, across = 1.0 / np.cos(angle) ** 2, np.tan(angle) / angle
    np.testing.assert_allclose(undistortion_stretch(FISHEYE, xy), np.sqrt((along**2 + across**2) / 2), rtol=1e-4)
    assert undistortion_stretch(Camera("PINHOLE", 640, 480, (400.0, 400.0, 320.0, 240.0)), xy) is None


@pytest.mark.parametrize(
    ("camera", "up_to_deg"), [(FISHEYE, 60.0), (FISHEYE, 80.0), (BARREL, 60.0)], ids=["fisheye", "half space", "barrel"]
)
def test_the_covariance_of_a_wide_lens_predicts_the_error(
    camera: Camera, up_to_deg: float, rng: np.random.Generator
) -> None:
    focal, truth, nees, missed = np.asarray(camera.focal_px), looking(np.array([0.3, -0.2, 0.8]), 0.4), [], []
    for _ in range(120):
        exact = rng.uniform(0.03, 0.97, (400, 2)) * (camera.width, camera.height)
        rays = camera.unproject(exact)
        shown = np.flatnonzero(np.hypot(*(exact - camera.centre_px).T) < np.radians(up_to_deg) * focal[0])[:80]
        exact, rays = exact[shown], rays[shown]
        xyz = truth.apply(rays / np.linalg.norm(rays, axis=1, keepdims=True) * rng.uniform(1.5, 5.0, (80, 1)))
        seen = camera.unproject(exact + rng.normal(size=exact.shape))[:, :2]
        stretch = undistortion_stretch(camera, seen)
        assert stretch is not None
        points = PosedPoints(seen * focal, stretch, xyz, np.zeros((80, 3, 3)), (focal[0], focal[1]), None, stretch)
        estimate, covariance, _ = refine_pose([points], truth * exp(rng.normal(0, 0.01, 6)), noise=1.0)
        d = log(estimate.inv() * truth)
        nees.append(d @ np.linalg.solve(covariance, d) / 6.0)
        missed.append(residuals_px(points, truth))
    assert 0.75 < np.mean(nees) < 1.35
    # One pixel of the image along each of its axes
    assert np.mean(np.concatenate(missed) ** 2) == pytest.approx(2.0, rel=0.1)


def test_a_lens_that_sees_all_that_is_in_front_leaves_images_of_it(rng: np.random.Generator) -> None:
    scene_map = make_map(rng)
    widest = dataclasses.replace(FISHEYE, params=(240.0, 240.0, *FISHEYE.params[2:]))
    prior = CameraPrior(looking(np.array([0.0, 0.0, 1.5]), 0.4), 1e-6 * np.eye(6))
    narrow, wide = plausible_images(scene_map, prior, BARREL), plausible_images(scene_map, prior, widest)
    assert wide[narrow].all()
    assert wide.sum() > narrow.sum()
