"""Laws of camera models: projection and its inverse, pixel conventions, messages."""

from __future__ import annotations

import cv2
import numpy as np
import pycolmap
import pytest

from fieldkit.cameras import MODELS, Camera, camera_from_info, camera_info_fields
from fieldkit.errors import CameraError

PARAMS = {
    "SIMPLE_PINHOLE": (500.0, 320.0, 240.0),
    "PINHOLE": (500.0, 510.0, 320.0, 240.0),
    "SIMPLE_RADIAL": (500.0, 320.0, 240.0, -0.1),
    "RADIAL": (500.0, 320.0, 240.0, -0.1, 0.02),
    "OPENCV": (500.0, 510.0, 320.0, 240.0, -0.148, 0.11, 0.001, -0.002),
    "OPENCV_FISHEYE": (300.0, 310.0, 320.0, 240.0, 0.02, -0.01, 0.003, -0.001),
    "FULL_OPENCV": (500.0, 510.0, 320.0, 240.0, -0.1, 0.02, 0.001, -0.002, 0.01, 0.02, 0.01, 0.001),
}
CAMERAS = [Camera(model, 640, 480, params) for model, params in PARAMS.items()]
each_model = pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.model)


def test_every_model_is_tested() -> None:
    assert set(PARAMS) == set(MODELS)


@each_model
def test_unproject_inverts_project(camera: Camera, rng: np.random.Generator) -> None:
    pixels = rng.uniform((0, 0), (640, 480), (200, 2))
    back, inside = camera.project(camera.unproject(pixels) * rng.uniform(0.5, 9.0, (200, 1)))
    np.testing.assert_allclose(back, pixels, atol=1e-9)
    assert inside.all()


@each_model
def test_projects_as_colmap_does(camera: Camera, rng: np.random.Generator) -> None:
    points = rng.uniform((-1, -1, 2), (1, 1, 5), (50, 3))
    theirs = pycolmap.Camera(model=camera.model, width=640, height=480, params=camera.params)
    np.testing.assert_allclose(camera.project(points)[0], theirs.img_from_cam(points), atol=1e-9)


def test_opencv_pixels_are_half_a_pixel_lower(rng: np.random.Generator) -> None:
    camera = CAMERAS[4]
    points = rng.uniform((-1, -1, 2), (1, 1, 5), (50, 3))
    theirs, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), camera.matrix(opencv=True), np.array(camera.opencv_distortion)
    )
    np.testing.assert_allclose(camera.project(points)[0], theirs[:, 0] + 0.5, atol=1e-9)


@each_model
def test_camera_info_round_trip(camera: Camera, rng: np.random.Generator) -> None:
    k, d, model = camera_info_fields(camera)
    back = camera_from_info(640, 480, k, d, distortion_model=model)
    points = rng.uniform((-1, -1, 2), (1, 1, 5), (50, 3))
    np.testing.assert_allclose(back.project(points)[0], camera.project(points)[0], atol=1e-9)


def test_points_behind_the_camera_have_no_pixel() -> None:
    pixels, inside = CAMERAS[1].project([[0, 0, -1], [0, 0, 0], [0, 0, 1]])
    assert np.isnan(pixels[:2]).all()
    assert inside.tolist() == [False, False, True]


def test_distortion_does_not_fold_far_points_into_the_image() -> None:
    camera = Camera("OPENCV", 640, 480, (500.0, 500.0, 320.0, 240.0, -0.2, 0.0, 0.0, 0.0))
    assert not camera.project([[3.0, 0.0, 1.6]])[1][0]


def test_a_resized_camera_keeps_the_image_corners_in_place() -> None:
    camera, small = CAMERAS[4], CAMERAS[4].scaled(0.25)
    corners = np.array([[0, 0], [640, 0], [640, 480], [0, 480]], dtype=float)
    np.testing.assert_allclose(small.unproject(corners / 4), camera.unproject(corners), atol=1e-9)


def test_an_unknown_model_is_refused_with_a_suggestion() -> None:
    with pytest.raises(CameraError, match=r"unknown camera model 'PINHOL'; did you mean 'PINHOLE'"):
        Camera("PINHOL", 640, 480, (1.0, 2.0, 3.0))


def test_a_wrong_number_of_params_is_refused() -> None:
    with pytest.raises(CameraError, match="has 3 params; expected 4"):
        Camera("PINHOLE", 640, 480, (1.0, 2.0, 3.0))


def test_an_uncalibrated_camera_info_is_refused() -> None:
    with pytest.raises(CameraError, match="calibrated camera"):
        camera_from_info(640, 480, [0.0] * 9, [])
