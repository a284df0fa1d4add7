"""Tags: drawing, detection against exact renders, both solutions, fusion."""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
import pytest
from pupil_apriltags import Detector
from scipy.spatial.transform import Rotation
from tag_scenes import SIZE_M, VGA, look_at_tag, render_tag

from fieldkit.cameras import Camera
from fieldkit.errors import TagError
from fieldkit.frames import Array, Pose, exp, log, pose_error
from fieldkit.tags import Sighting, TagDetection, detect, draw_tag, fuse_sightings, solve, tag_corners
from fieldkit.types import Image

DISTORTED = Camera("OPENCV", 640, 480, (552.0, 550.0, 322.0, 238.0, -0.2, 0.08, 0.001, -0.001))


def exact(camera: Camera, cam_from_tag: Pose, size_m: float = SIZE_M) -> Array:
    return camera.project(cam_from_tag.apply(tag_corners(size_m)))[0]


def noisy(rng: np.random.Generator, cam_from_tag: Pose, sigma_px: float, camera: Camera = VGA) -> TagDetection:
    corners = exact(camera, cam_from_tag)
    return TagDetection(2, "tag36h11", corners + rng.normal(0, sigma_px, corners.shape), sigma_px)


def upright(family: str, tag_id: int) -> Image:
    return np.pad(draw_tag(family, tag_id, cell_px=20), 60, constant_values=200)


@pytest.mark.parametrize("family", ["tag36h11", "tag25h9", "tag16h5", "tag36h10"])
def test_corners_of_an_upright_tag_start_at_the_bottom_left_and_run_counter_clockwise(family: str) -> None:
    image = upright(family, 3)
    size = image.shape[0]
    camera = Camera("PINHOLE", size, size, (400.0, 400.0, size / 2, size / 2))
    (found,) = detect(image, camera, families=(family,))
    low, high = 80.0, size - 80.0
    assert (found.id, found.family) == (3, family)
    np.testing.assert_allclose(found.corners_px, [[low, high], [high, high], [high, low], [low, low]], atol=0.05)


def test_drawn_tag_is_upright_for_the_apriltag_project_and_turned_for_opencv() -> None:
    image = upright("tag36h11", 3)
    (theirs,) = Detector(families="tag36h11", quad_decimate=1).detect(image)
    assert theirs.corners[0] == pytest.approx([80, 240], abs=1)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    turned = cv2.aruco.generateImageMarker(dictionary, 3, 8 * 20)
    np.testing.assert_array_equal(image[80:-80, 80:-80][::-1, ::-1], turned)


def test_frontal_upright_tag_has_x_right_y_up_z_towards_the_camera() -> None:
    image = np.full((480, 640), 200, np.uint8)
    tag = upright("tag36h11", 3)
    image[80 : 80 + len(tag), 160 : 160 + len(tag)] = tag
    (found,) = detect(image, VGA)
    cam_from_tag = solve(found, VGA, SIZE_M).cam_from_tag
    np.testing.assert_allclose(cam_from_tag.rotation.as_matrix(), np.diag([1.0, -1.0, -1.0]), atol=0.02)
    np.testing.assert_allclose(cam_from_tag.translation, [0, 0, 552 * SIZE_M / 160], atol=0.002)


@pytest.mark.parametrize("camera", [VGA, DISTORTED], ids=["pinhole", "distorted"])
@pytest.mark.parametrize(("noise", "blur_px"), [(0.0, 0.0), (2.0, 0.7)])
def test_corners_of_renders_have_no_bias(
    rng: np.random.Generator, camera: Camera, noise: float, blur_px: float
) -> None:
    errors, sigmas = [], []
    for _ in range(15 if camera.is_pinhole else 8):
        cam_from_tag = look_at_tag(rng, camera=camera)
        image = render_tag(camera, cam_from_tag, samples=5, noise=noise, blur_px=blur_px, rng=rng)
        (found,) = detect(image, camera)
        errors.append(found.corners_px - exact(camera, cam_from_tag))
        sigmas.append(found.sigma_px)
    assert np.abs(np.mean(errors, axis=(0, 1))).max() < 0.02
    assert np.sqrt(np.mean(np.square(errors))) < 0.03
    assert 0.02 < np.median(sigmas) < 0.03


def test_a_photo_of_twelve_megapixels_is_as_exact_as_a_small_one(rng: np.random.Generator) -> None:
    camera = Camera("OPENCV", 4000, 3000, (2900.0, 2897.0, 2010.0, 1490.0, -0.148, 0.11, 0.0005, 0.0003))
    cam_from_tag = look_at_tag(rng, camera=camera, distance_m=(1.5, 1.6), slant_deg=(30, 50))
    image = render_tag(camera, cam_from_tag, samples=4, noise=3.0, blur_px=1.2, rng=rng)
    (found,) = detect(image, camera)
    assert np.abs(found.corners_px - exact(camera, cam_from_tag)).max() < 0.06


def test_a_photo_with_a_glare_over_an_edge_keeps_its_corners(rng: np.random.Generator) -> None:
    cam_from_tag = look_at_tag(rng, distance_m=(0.6, 0.6), slant_deg=(20, 20))
    image = render_tag(VGA, cam_from_tag, noise=2.0, rng=rng)
    start, end = exact(VGA, cam_from_tag)[:2]
    x, y = (start + 0.4 * (end - start)).astype(int)
    image[y - 4 : y + 4, x - 4 : x + 4] = 250
    (found,) = detect(image, VGA)
    assert np.abs(found.corners_px - exact(VGA, cam_from_tag)).max() < 0.3


def test_an_image_without_a_tag_gives_none(rng: np.random.Generator) -> None:
    assert detect(rng.integers(0, 255, (480, 640), dtype=np.uint8), VGA) == []


def test_colour_and_grey_images_give_the_same_detection(rng: np.random.Generator) -> None:
    image = render_tag(VGA, look_at_tag(rng))
    (grey,), (colour,) = detect(image, VGA), detect(np.dstack([image] * 3), VGA)
    np.testing.assert_array_equal(grey.corners_px, colour.corners_px)


def test_bad_input_is_named() -> None:
    image = np.zeros((480, 640), np.uint8)
    with pytest.raises(TagError, match="did you mean 'tag36h11'"):
        detect(image, VGA, families=("tag36h12",))
    with pytest.raises(TagError, match="640x480 pixels with a camera of 320x240"):
        detect(image, VGA.scaled(0.5))
    with pytest.raises(TagError, match=r"has no tag 587; expected an id in 0\.\.586"):
        draw_tag("tag36h11", 587)
    with pytest.raises(TagError, match="no sighting"):
        fuse_sightings([], SIZE_M)


def test_solve_without_noise_is_exact_through_distortion(rng: np.random.Generator) -> None:
    for _ in range(10):
        cam_from_tag = look_at_tag(rng, camera=DISTORTED, slant_deg=(10, 60))
        detection = dataclasses.replace(noisy(rng, cam_from_tag, 0.1), corners_px=exact(DISTORTED, cam_from_tag))
        solution = solve(detection, DISTORTED, SIZE_M)
        assert pose_error(solution.cam_from_tag, cam_from_tag) == pytest.approx((0, 0), abs=1e-6)
        assert solution.ambiguity < 1e-3


def test_solve_states_its_covariance_and_keeps_the_other_solution(rng: np.random.Generator) -> None:
    squared, n_both = [], 0
    for _ in range(150):
        cam_from_tag = look_at_tag(rng, slant_deg=(25, 60))
        solution = solve(noisy(rng, cam_from_tag, 0.1), VGA, SIZE_M)
        error = log(cam_from_tag.inv() * solution.cam_from_tag)
        squared.append(float(error @ np.linalg.solve(solution.covariance, error)))
        assert solution.rms_px <= solution.alternative_rms_px
        n_both += solution.alternative is not None
    # From near and at a slant perspective alone can leave a single solution
    assert n_both > 120
    assert 0.8 < np.mean(np.sort(squared)[:-3]) / 6 < 1.25


def test_a_small_frontal_tag_is_called_ambiguous(rng: np.random.Generator) -> None:
    views = [look_at_tag(rng, distance_m=(3, 4), slant_deg=(5, 15)) for _ in range(40)]
    solutions = [solve(noisy(rng, v, 0.3), VGA, SIZE_M) for v in views]
    wrong = [pose_error(s.cam_from_tag, v)[1] > math.radians(12) for s, v in zip(solutions, views, strict=True)]
    assert any(wrong)
    assert all(s.ambiguity > 0.2 for s, w in zip(solutions, wrong, strict=True) if w)


def sightings(
    rng: np.random.Generator, ref_from_tag: Pose, n: int, *, noise: float, stated: float, n_wrong: int = 0
) -> list[Sighting]:
    result = []
    for i in range(n):
        cam_from_tag = look_at_tag(rng, distance_m=(0.6, 1.5))
        d = rng.normal(0, noise, 6) if i >= n_wrong else rng.normal(0, 1, 6) * [0.1, 0.1, 0.1, 0.4, 0.4, 0.4]
        ref_from_cam = ref_from_tag * cam_from_tag.inv() * exp(d).inv()
        result.append(Sighting(noisy(rng, cam_from_tag, 0.1), VGA, ref_from_cam, np.eye(6) * stated**2))
    return result


def test_fused_sightings_are_as_wrong_as_they_say(rng: np.random.Generator) -> None:
    squared = []
    for _ in range(25):
        ref_from_tag = exp(rng.normal(0, 1, 6))
        fix = fuse_sightings(sightings(rng, ref_from_tag, 6, noise=0.002, stated=0.002), SIZE_M)
        error = log(ref_from_tag.inv() * fix.ref_from_tag)
        squared.append(float(error @ np.linalg.solve(fix.covariance, error)))
        assert fix.is_certain
    assert 0.5 < np.mean(np.sort(squared)[:-2]) / 6 < 1.4


def test_wrong_camera_poses_are_found_and_left_out(rng: np.random.Generator) -> None:
    for _ in range(10):
        ref_from_tag = exp(rng.normal(0, 1, 6))
        seen = sightings(rng, ref_from_tag, 8, noise=0.004, stated=0.002, n_wrong=3)
        fix = fuse_sightings(seen, SIZE_M, scales=(1.0, 2.0, 3.0))
        assert fix.used == (False,) * 3 + (True,) * 5
        assert min(fix.sigmas[:3]) > max(fix.sigmas[3:])
        position, angle = pose_error(fix.ref_from_tag, ref_from_tag)
        assert position < 0.015
        assert angle < math.radians(0.6)


def test_sightings_from_several_directions_resolve_flips(rng: np.random.Generator) -> None:
    n_flipped = 0
    for _ in range(10):
        ref_from_tag = exp(rng.normal(0, 1, 6))
        seen = []
        for _ in range(6):
            cam_from_tag = look_at_tag(rng, distance_m=(2.5, 3.5), slant_deg=(5, 25))
            seen.append(
                Sighting(noisy(rng, cam_from_tag, 0.3), VGA, ref_from_tag * cam_from_tag.inv(), np.eye(6) * 1e-6)
            )
        fix = fuse_sightings(seen, SIZE_M)
        n_flipped += sum(fix.flipped)
        assert pose_error(fix.ref_from_tag, ref_from_tag)[1] < math.radians(5)
    assert n_flipped > 0


def test_a_flip_is_never_called_certain(rng: np.random.Generator) -> None:
    wrong = []
    for _ in range(60):
        cam_from_tag = look_at_tag(rng, distance_m=(2, 4), slant_deg=(5, 20))
        fix = fuse_sightings([Sighting(noisy(rng, cam_from_tag, 0.3), VGA, Pose.identity(), np.zeros((6, 6)))], SIZE_M)
        if pose_error(fix.ref_from_tag, cam_from_tag)[1] > math.radians(10):
            wrong.append(fix)
    assert wrong
    assert not any(f.is_certain for f in wrong)


def test_fusion_does_not_depend_on_the_reference_frame(rng: np.random.Generator) -> None:
    seen = sightings(rng, Pose.identity(), 6, noise=0.002, stated=0.002)
    turned = Pose.from_components([3.0, -2.0, 1.0], Rotation.from_euler("xyz", [0.3, -0.2, 2.0]))
    fix = fuse_sightings(seen, SIZE_M)
    moved = fuse_sightings([dataclasses.replace(s, ref_from_cam=turned * s.ref_from_cam) for s in seen], SIZE_M)
    assert pose_error(turned * fix.ref_from_tag, moved.ref_from_tag) == pytest.approx((0, 0), abs=1e-6)
    np.testing.assert_allclose(moved.covariance, fix.covariance, rtol=1e-3, atol=1e-12)
