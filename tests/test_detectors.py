"""Tag detectors behind one interface: the same corners from each, in every family, with the noise that they have."""

from __future__ import annotations

import math
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tag_scenes import SIZE_M, VGA, look_at_tag, look_from, render_tag, slanted

from fieldkit.cameras import Camera
from fieldkit.errors import TagError
from fieldkit.frames import Array, Pose
from fieldkit.tags import DETECTORS, FAMILIES, TagDetection, detect, draw_tag, tag_corners
from fieldkit.tags.families import PupilDetector, pattern
from fieldkit.types import Image

BOTH = [f for f in FAMILIES if all(f in d.families for d in DETECTORS.values())]
STRONG = Camera("OPENCV", 640, 480, (420.0, 418.0, 322.0, 238.0, -0.32, 0.11, 0.003, -0.002))
FISHEYE = Camera("OPENCV_FISHEYE", 640, 600, (215.0, 215.2, 318.0, 299.0, -0.0067, 0.0393, -0.0356, 0.0055))


def exact(camera: Camera, cam_from_tag: Pose) -> Array:
    return camera.project(cam_from_tag.apply(tag_corners(SIZE_M)))[0]


def upright(family: str, tag_id: int) -> tuple[Image, Array]:
    """Return a drawn tag, 20 px per cell, and its corners from the bottom left counter-clockwise."""
    layout = FAMILIES[family]
    around = (layout.total - layout.cells) // 2
    image = np.pad(draw_tag(family, tag_id, cell_px=20, border_cells=around), 50, constant_values=255)
    low, high = 50.0 + 20 * around, 50.0 + 20 * (around + layout.cells)
    return image, np.array([[low, high], [high, high], [high, low], [low, low]])


def pinhole(image: Image) -> Camera:
    height, width = image.shape
    return Camera("PINHOLE", width, height, (400.0, 400.0, width / 2, height / 2))


def test_every_family_has_a_detector_and_pupil_comes_first() -> None:
    assert list(DETECTORS) == ["pupil", "opencv"]
    assert set(DETECTORS["opencv"].families) == {"tag16h5", "tag25h9", "tag36h10", "tag36h11"}
    assert set(FAMILIES) - set(DETECTORS["pupil"].families) == {"tag36h10"}
    assert BOTH == ["tag36h11", "tag25h9", "tag16h5"]


@pytest.mark.parametrize(("name", "family"), [(d.name, f) for d in DETECTORS.values() for f in d.families])
def test_every_detector_finds_an_upright_tag_of_its_families_with_our_corners(name: str, family: str) -> None:
    image, corners = upright(family, 7)
    (found,) = detect(image, pinhole(image), families=(family,), detector=name)
    assert (found.id, found.family) == (7, family)
    np.testing.assert_allclose(found.corners_px, corners, atol=0.02)


@pytest.mark.parametrize("family", BOTH)
def test_both_detectors_agree_on_the_same_render(family: str, rng: np.random.Generator) -> None:
    layout, raw = FAMILIES[family], {name: [] for name in DETECTORS}
    for _ in range(6):
        cam_from_tag = look_at_tag(rng, distance_m=(0.5, 0.9), slant_deg=(0, 45))
        image = render_tag(VGA, cam_from_tag, family=family, samples=4, noise=2.0, blur_px=0.7, rng=rng)
        refined = []
        for name, detector in DETECTORS.items():
            (coarse,) = [t for t in detector.find(image, layout) if t.id == 2]
            raw[name].append(coarse.corners_px - exact(VGA, cam_from_tag))
            refined += [d.corners_px for d in detect(image, VGA, families=(family,), detector=name) if d.id == 2]
        np.testing.assert_allclose(refined[0], refined[1], atol=0.01)
    for errors in raw.values():
        # One corner further along would be tens of pixels, the first pixel's centre at (0, 0) half of one
        assert np.abs(np.mean(errors, axis=(0, 1))).max() < 0.2
        assert np.abs(errors).max() < 3.0


@pytest.mark.parametrize("family", ["tagStandard41h12", "tagCircle21h7"])
def test_families_of_white_squares_are_fitted_like_the_others(family: str, rng: np.random.Generator) -> None:
    for _ in range(4):
        cam_from_tag = look_at_tag(rng, distance_m=(0.5, 0.9), slant_deg=(0, 45))
        image = render_tag(VGA, cam_from_tag, family=family, samples=5, noise=2.0, blur_px=0.7, rng=rng)
        (found,) = [d for d in detect(image, VGA, families=(family,)) if d.id == 2]
        assert found.covariance_px is not None
        np.testing.assert_allclose(found.corners_px, exact(VGA, cam_from_tag), atol=0.08)


def test_pupil_alone_finds_each_of_its_families_drawn_tags() -> None:
    for family in DETECTORS["pupil"].families:
        for tag_id in (0, 11):
            image, _ = upright(family, tag_id)
            found = PupilDetector(FAMILIES[family], quad_decimate=1.0).detect(image)
            assert [(t.tag_id, t.hamming) for t in found] == [(tag_id, 0)]


def test_patterns_have_a_closed_ring_around_them() -> None:
    for family, layout in FAMILIES.items():
        cells, around = pattern(family, 5), (layout.total - layout.cells) // 2
        assert cells.shape == (layout.total, layout.total)
        ring = cells[around:-around, around:-around]
        inside = np.concatenate([ring[0], ring[-1], ring[:, 0], ring[:, -1]])
        assert set(inside) == ({1} if layout.is_reversed else {0})


def test_a_detector_that_does_not_find_a_family_is_named() -> None:
    image, camera = np.zeros((480, 640), np.uint8), VGA
    with pytest.raises(TagError, match=r"pupil finds no tag36h10; expected one of tag36h11, .*take opencv"):
        detect(image, camera, families=("tag36h10",), detector="pupil")
    with pytest.raises(TagError, match="unknown tag detector 'openvc'; did you mean 'opencv'"):
        detect(image, camera, detector="openvc")


def found_in(image: Image, camera: Camera, **options: str) -> TagDetection | None:
    found = [d for d in detect(image, camera, **options) if d.id == 2]
    return found[0] if found else None


def normalised(errors: list[Array], found: list[TagDetection], *, floor: bool) -> Array:
    """Return the normalised squared errors per degree of freedom; without the floor, of the image's noise alone."""
    from fieldkit.tags.detect import UNSEEN_SIGMA_PX

    unseen = 0.0 if floor else UNSEEN_SIGMA_PX**2
    return np.array(
        [e @ np.linalg.solve(d.noise_px - unseen * np.eye(8), e) / 8 for e, d in zip(errors, found, strict=True)]
    )


@pytest.mark.parametrize(
    ("distance_m", "slant_deg", "noise", "blur_px"),
    [
        (0.6, (0, 30), 3.0, 0.7),
        (2.0, (0, 30), 3.0, 0.7),
        (2.0, (0, 30), 3.0, 1.5),
        (3.5, (0, 20), 3.0, 0.7),
        (0.8, (55, 68), 3.0, 0.7),
    ],
)
def test_corner_noise_is_what_the_corners_err_by(
    rng: np.random.Generator, distance_m: float, slant_deg: tuple[float, float], noise: float, blur_px: float
) -> None:
    errors, found = [], []
    while len(found) < 10:
        cam_from_tag = look_from(rng, slanted(rng, slant_deg), distance_m)
        image = render_tag(VGA, cam_from_tag, samples=5, noise=noise, blur_px=blur_px, rng=rng)
        detection = found_in(image, VGA)
        if detection is not None:
            assert detection.covariance_px is not None
            found.append(detection)
            errors.append((detection.corners_px - exact(VGA, cam_from_tag)).ravel())
    squared = normalised(errors, found, floor=False)
    # 80 degrees of freedom: the mean is known to 16 % where the model is exact
    assert 0.35 < np.mean(squared) < 2.2
    assert normalised(errors, found, floor=True).max() < 4.0


def test_noisier_and_smaller_tags_state_more_noise(rng: np.random.Generator) -> None:
    def sigma(distance_m: float, noise: float) -> float:
        cam_from_tag = look_from(rng, np.array([0.2, 0.1, 1.0]), distance_m)
        found = found_in(render_tag(VGA, cam_from_tag, samples=5, noise=noise, blur_px=0.7, rng=rng), VGA)
        assert found is not None
        return found.sigma_px

    assert sigma(0.6, 2.0) < sigma(0.6, 12.0)
    assert sigma(0.6, 6.0) < sigma(3.0, 6.0)


@pytest.mark.parametrize("distance_m", [0.6, 1.5])
def test_white_does_not_grow_into_black_where_a_lens_blurs_light(rng: np.random.Generator, distance_m: float) -> None:
    inwards = []
    for _ in range(4):
        cam_from_tag = look_from(rng, slanted(rng, (0, 40)), distance_m)
        image = render_tag(VGA, cam_from_tag, samples=5, noise=2.0, blur_px=0.7, rng=rng, in_light=True)
        corners = exact(VGA, cam_from_tag)
        outwards = corners - corners.mean(axis=0)
        found = found_in(image, VGA)
        assert found is not None
        along = ((found.corners_px - corners) * outwards).sum(axis=1) / np.linalg.norm(outwards, axis=1)
        inwards.append(-along.mean())
    # Lines fitted to the edges of grey values lie half a pixel further in
    assert abs(np.mean(inwards)) < 0.03


@pytest.mark.parametrize("camera", [STRONG, FISHEYE], ids=["radial-tangential", "fisheye"])
def test_strong_distortion_is_handled_at_the_corners(camera: Camera, rng: np.random.Generator) -> None:
    errors, found = [], []
    while len(found) < 6:
        ray = camera.unproject(rng.uniform((60, 60), (camera.width - 60, camera.height - 60))[None])[0]
        if np.hypot(*ray[:2]) > math.tan(math.radians(60)):
            continue
        z = -ray / np.linalg.norm(ray)
        x = np.cross([0.0, 1.0, 0.0], z) / np.linalg.norm(np.cross([0.0, 1.0, 0.0], z))
        tilt = Rotation.from_euler("xyz", [*rng.uniform(-35, 35, 2), rng.uniform(-180, 180)], degrees=True)
        facing = Rotation.from_matrix(np.column_stack([x, np.cross(z, x), z])) * tilt
        cam_from_tag = Pose.from_components(-z * rng.uniform(0.3, 0.6), facing)
        image = render_tag(camera, cam_from_tag, samples=4, noise=2.0, blur_px=0.7, rng=rng)
        detection = found_in(image, camera)
        if detection is not None:
            found.append(detection)
            errors.append((detection.corners_px - exact(camera, cam_from_tag)).ravel())
    assert np.sqrt(np.mean(np.square(errors))) < 0.06
    assert normalised(errors, found, floor=True).max() < 4.0


def test_a_tag_that_reaches_over_the_image_s_border_is_never_called_exact(rng: np.random.Generator) -> None:
    n_found = 0
    for outside_px in np.arange(-3.0, 9.0, 1.5):
        distance = VGA.focal_px[0] * SIZE_M / 100
        cam_from_tag = Pose.from_components(
            [(-320 + 50 - outside_px) / VGA.focal_px[0] * distance, 0.02, distance],
            Rotation.from_rotvec([0.15, 0.2, 0.0]) * Rotation.from_rotvec([np.pi, 0, 0]),
        )
        for name in DETECTORS:
            image = render_tag(VGA, cam_from_tag, samples=5, noise=2.0, blur_px=0.7, rng=rng)
            found = found_in(image, VGA, detector=name)
            if found is not None:
                n_found += 1
                off = (found.corners_px - exact(VGA, cam_from_tag)).ravel()
                assert np.abs(off / np.sqrt(np.diag(found.noise_px))).max() < 5.0
    assert n_found >= 4


def test_a_bent_tag_says_that_its_corners_are_uncertain(rng: np.random.Generator) -> None:
    cam_from_tag = look_from(rng, np.array([0.2, 0.1, 1.0]), 0.8)
    image = render_tag(VGA, cam_from_tag, samples=5, noise=2.0, blur_px=0.7, rng=rng)
    flat = found_in(image, VGA)
    assert flat is not None
    corners = flat.corners_px
    middle = corners.mean(axis=0)
    # Bend the picture: what is inside moves by up to 2 px, the rim stays
    y, x = np.mgrid[0:480, 0:640].astype(np.float32)
    reach = np.linalg.norm(corners - middle, axis=1).mean() / math.sqrt(2)
    near = np.clip(1 - np.maximum(np.abs(x - middle[0]), np.abs(y - middle[1])) / (1.1 * reach), 0, 1)
    bent = cv2.remap(image, (x + 4 * near).astype(np.float32), y, cv2.INTER_CUBIC)
    found = found_in(bent, VGA)
    assert found is not None
    assert found.sigma_px > 4 * flat.sigma_px


def test_expected_corners_of_real_photos_are_pupil_s_unrefined_ones(shared_data: Path) -> None:
    """So the photos' pixels are AprilTag's, which are ours: the centre of the first pixel is (0.5, 0.5)."""
    unrefined, refined, n_expected, n_other = [], [], 0, 0
    for path in sorted((shared_data / "apriltag_photos").glob("*.txt")):
        image = cv2.imread(str(path.with_suffix(".jpg")), cv2.IMREAD_GRAYSCALE)
        coarse = DETECTORS["pupil"].find(image, FAMILIES["tag36h11"])
        fine = detect(image, pinhole(image))
        n_other += len(fine)
        for line in path.read_text().splitlines():
            tag_id, *numbers = (float(x) for x in re.findall(r"[-\d.]+", line))
            corners = np.reshape(numbers, (4, 2))
            n_expected += 1
            for found, errors in ((coarse, unrefined), (fine, refined)):
                near = [t for t in found if np.abs(t.corners_px.mean(axis=0) - corners.mean(axis=0)).max() < 5]
                errors += [t.corners_px - corners for t in near if t.id == tag_id]
    assert n_expected == len(unrefined) == len(refined) == n_other == 47
    assert np.median(np.abs(unrefined)) < 0.001
    assert np.abs(unrefined).max() < 0.2
    assert np.abs(np.mean(unrefined, axis=(0, 1))).max() < 0.001
    # Refined ones differ by what unrefined ones err by
    assert np.median(np.abs(refined)) < 0.3
    assert np.quantile(np.abs(refined), 0.95) < 1.0
