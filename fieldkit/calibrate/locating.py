"""From a photo to its pose in the map and the landmarks that it rests on."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from fieldkit.calibrate.geometry import Bearings, Poses, bearings, project
from fieldkit.calibrate.photos import Shot, describe_blur, read_photo
from fieldkit.cameras import Camera
from fieldkit.features import to_grey
from fieldkit.frames import Pose
from fieldkit.localize import Inliers, Localizer
from fieldkit.protocol import LocalizerRules
from fieldkit.tags import TagDetection
from fieldkit.types import Image, SceneMap, TagPhoto

Progress = Callable[[str, int, int], None]

# Photos are localized at this multiple of the mapping images' focal length in pixels: the many keypoints of finer
# texture, which mapping could not see, find no match and crowd out those that do
FOCAL_RATIO = 1.5
# Squared deviation of a match (2 degrees of freedom) beyond which it is a wrong one: one right match in a thousand
MATCH_GATE = 13.8
# Fewer leave a pose nearly undetermined
MIN_MATCHES = 8
# Median of chi-square with 2 degrees of freedom
MEDIAN_CHI2 = 1.386


@dataclasses.dataclass(frozen=True)
class LocatedPhoto:
    """A localized photo: its pose, what it knows it from, and the tags in it.

    ``landmark`` int[n] are rows of the map, ``bearings`` (n) where they are seen.
    """

    file: str
    visit: str | None
    camera: Camera
    map_from_cam: Pose
    landmark: NDArray[np.int64]
    bearings: Bearings
    detections: tuple[TagDetection, ...]


def locate(
    shots: Sequence[Shot], scene_map: SceneMap, rules: LocalizerRules | None, progress: Progress | None
) -> tuple[list[LocatedPhoto], list[TagPhoto]]:
    """Localize photos with their tags painted over; also return a verdict on every tag of those that fail."""
    localizer = Localizer(scene_map, rules or LocalizerRules())
    finest_px = FOCAL_RATIO * float(np.median([c.focal_px[0] for c in scene_map.image_cameras]))
    located: list[LocatedPhoto] = []
    failed: list[TagPhoto] = []
    for number, shot in enumerate(shots):
        if progress is not None:
            progress("localize photos", number + 1, len(shots))
        photo, image = shot.photo, read_photo(shot.photo, colour=localizer.colour)
        assert image is not None
        small, camera = _reduced(_without_tags(image, shot.found), photo.camera, finest_px)
        estimate, inliers = localizer.localize_with_inliers(small, camera)
        if estimate.map_from_cam is None or inliers is None:
            reason = f"not localized ({estimate.status}, {estimate.n_inliers} inliers{describe_blur(to_grey(image))})"
            failed += [TagPhoto(photo.file, d.id, used=False, reason=reason, visit=photo.visit) for d in shot.usable]
            continue
        landmark, seen = right_matches(inliers, camera, estimate.map_from_cam, scene_map)
        if len(landmark) < MIN_MATCHES:
            reason = f"not localized ({len(landmark)} of {estimate.n_inliers} inliers fit their noise)"
            failed += [TagPhoto(photo.file, d.id, used=False, reason=reason, visit=photo.visit) for d in shot.usable]
            continue
        located.append(
            LocatedPhoto(
                photo.file, photo.visit, photo.camera, estimate.map_from_cam, landmark, seen,
                shot.usable,
            )
        )  # fmt: skip
    return located, failed


def right_matches(
    inliers: Inliers, camera: Camera, map_from_cam: Pose, scene_map: SceneMap
) -> tuple[NDArray[np.int64], Bearings]:
    """Return the landmarks (n,) and bearings (n) of matches whose residuals fit their noise.

    The pixels' noise is what half of the residuals show, at least the localizer's: a blurred photo counts less. The
    localizer's inlier bound, which is wide to find a pose, admits wrong matches that least squares must not see.
    """
    seen = bearings(camera, inliers.pixels, inliers.noise_px)
    pose = Poses.of([map_from_cam])
    x_in_cam = (scene_map.xyz[inliers.landmark] - pose.position[0]) @ pose.rotation[0]
    xy, slope = project(x_in_cam)
    slope = seen.whitening @ slope @ pose.rotation[0].T
    residual = np.einsum("nij,nj->ni", seen.whitening, seen.xy - xy)
    spread = slope @ scene_map.xyz_covariance[inliers.landmark] @ slope.transpose(0, 2, 1)
    factor = 1.0
    for _ in range(5):
        total = spread + factor * np.eye(2)
        chi2 = np.einsum("ni,ni->n", residual, np.linalg.solve(total, residual[..., None])[..., 0])
        factor = max(1.0, factor * float(np.median(chi2)) / MEDIAN_CHI2)
    right = chi2 < MATCH_GATE
    kept = seen[right]
    return inliers.landmark[right].astype(np.int64), Bearings(kept.xy, kept.whitening / np.sqrt(factor))


def _without_tags(image: Image, detections: Sequence[TagDetection]) -> Image:
    """Return the photo, grey or RGB, with its tags painted over, margin included.

    A tag that hung elsewhere while mapping would otherwise pull the photo there.
    """
    covered = image.copy()
    for d in detections:
        centre = d.corners_px.mean(axis=0)
        quad = np.round(centre + 1.3 * (d.corners_px - centre)).astype(np.int32)
        cv2.fillConvexPoly(covered, quad, np.atleast_1d(np.median(image, axis=(0, 1))).tolist())
    return covered


def _reduced(image: Image, camera: Camera, focal_px: float) -> tuple[Image, Camera]:
    """Return image and camera, made smaller where the focal length is longer than ``focal_px``."""
    factor = focal_px / camera.focal_px[0]
    if factor >= 1.0:
        return image, camera
    small = camera.scaled(factor)
    resized = cv2.resize(image, (small.width, small.height), interpolation=cv2.INTER_AREA)
    return np.asarray(resized, dtype=np.uint8), small
