"""The localizer: an image and a map in, a camera pose with covariance and seconds per stage out."""

from __future__ import annotations

import dataclasses
import time

import numpy as np
from numpy.typing import NDArray

from fieldkit.cameras import Camera
from fieldkit.errors import LocalizeError
from fieldkit.features import extract, feature_kind, working_factor
from fieldkit.features.matching import match_groups
from fieldkit.localize.kernels import NOISE_PX
from fieldkit.localize.matching import stored_descriptors
from fieldkit.localize.pose import PosedPoints, confidence, estimate_pose
from fieldkit.localize.retrieval import build_index, most_similar
from fieldkit.protocol import LocalizerRules
from fieldkit.types import Estimate, Image, SceneMap

__all__ = ["Inliers", "Localizer"]

_MAX_KEYPOINTS = 2048
_MAX_SIDE_PX = 1600


@dataclasses.dataclass(frozen=True)
class Inliers:
    """The matches that an estimate rests on: landmarks int[n] of the map, where they are seen f64[n, 2] in the image's
    pixels, and the noise of these per axis.
    """

    landmark: NDArray[np.int32]
    pixels: NDArray[np.float64]
    noise_px: float


class Localizer:
    """Localize images in one map: retrieval, matching against landmarks, PnP.

    The map is indexed once, here. ``localize`` keeps no state: the same image gives the same pose bit for bit,
    whatever was localized before.
    """

    def __init__(self, scene_map: SceneMap, rules: LocalizerRules | None = None, *, seed: int = 0) -> None:
        if not len(scene_map.xyz) or not len(scene_map.descriptors):
            raise LocalizeError(
                f"{scene_map.path}: the map has no landmarks with descriptors", hint="build the map again"
            )
        self._map = scene_map
        self._rules = LocalizerRules() if rules is None else rules
        self._seed = seed
        self._kind = feature_kind(scene_map.feature)
        self._index = build_index(scene_map, seed=seed)

    def localize(self, image: Image, camera: Camera) -> Estimate:
        """Find map_from_cam of an image uint8[h, w] or RGB; a failure is an Estimate without a pose and its reason.

        Raises LocalizeError when the image does not have the camera's size.
        """
        return self.localize_with_inliers(image, camera)[0]

    def localize_with_inliers(self, image: Image, camera: Camera) -> tuple[Estimate, Inliers | None]:
        """Localize as `localize` does; also return the matches that the pose rests on, None without a pose."""
        if image.shape[:2] != (camera.height, camera.width):
            raise LocalizeError(
                f"image is {image.shape[1]}x{image.shape[0]}; its camera says {camera.width}x{camera.height}",
                hint="give the camera with which the image was taken",
            )
        rules, seconds, start = self._rules, {}, time.perf_counter()
        features = extract(image, feature=self._map.feature, max_keypoints=_MAX_KEYPOINTS, max_side_px=_MAX_SIDE_PX)
        seconds["extract"], start = time.perf_counter() - start, time.perf_counter()
        if len(features) < rules.min_inliers:
            return _failed("no_features", 0, 0, seconds), None
        images = most_similar(self._index, features.descriptors, count=rules.top_k)
        seconds["retrieve"], start = time.perf_counter() - start, time.perf_counter()
        stored, landmark = stored_descriptors(self._map, self._index, images)
        ratio = rules.ratio if self._kind.matching == "ratio" else 1.0
        keypoint, found, _ = match_groups(features.descriptors, stored, landmark, ratio=ratio)
        seconds["match"], start = time.perf_counter() - start, time.perf_counter()
        if len(found) < rules.min_inliers:
            return _failed("no_matches", len(found), 0, seconds), None
        # Thresholds and noise are meant in pixels of the image in which the keypoints were found.
        factor = working_factor(image.shape[:2], max_side_px=_MAX_SIDE_PX)
        focal_px = np.asarray(camera.focal_px) * factor
        points = PosedPoints(
            camera.unproject(features.keypoints_px[keypoint])[:, :2] * focal_px,
            self._map.xyz[found],
            self._map.xyz_covariance[found],
            (float(focal_px[0]), float(focal_px[1])),
        )
        solved = estimate_pose(points, max_error_px=rules.max_reprojection_px, seed=self._seed)
        seconds["pnp"] = time.perf_counter() - start
        if solved is None:
            return _failed("no_pose", len(found), 0, seconds), None
        n_inliers = int(solved.inliers.sum())
        if n_inliers < rules.min_inliers:
            return _failed("few_inliers", len(found), n_inliers, seconds), None
        pixels = features.keypoints_px[keypoint[solved.inliers]]
        sure = confidence(pixels, (camera.width, camera.height))
        inliers = Inliers(found[solved.inliers], pixels.astype(np.float64), NOISE_PX / factor)
        return Estimate(solved.map_from_cam, solved.covariance, len(found), n_inliers, "ok", sure, seconds), inliers


def _failed(status: str, n_matches: int, n_inliers: int, seconds: dict[str, float]) -> Estimate:
    return Estimate(None, None, n_matches, n_inliers, status, 0.0, seconds)
