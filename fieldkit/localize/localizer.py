"""The localizer: an image and a map in, a camera pose with covariance and seconds per stage out."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldkit.cameras import Camera
from fieldkit.errors import LocalizeError
from fieldkit.features import Descriptors, open_extractor, working_factor
from fieldkit.features.appearance import open_appearance
from fieldkit.features.used import weight_files
from fieldkit.frames import Pose, compose_covariance
from fieldkit.localize.chance import Agreement, confidence
from fieldkit.localize.matching import expected_noise, landmark_noise, open_matcher
from fieldkit.localize.narrowing import CameraPrior, plausible_images
from fieldkit.localize.parallel import default_threads, in_threads
from fieldkit.localize.pose import PosedPoints, Solved, estimate_pose, residuals_px
from fieldkit.localize.retrieval import build_index, most_similar, nearest_vectors
from fieldkit.protocol import LocalizerRules
from fieldkit.store import digest
from fieldkit.store.inputs import RigCamera
from fieldkit.types import Estimate, Image, SceneMap
from fieldkit.warp import shared_errors

Array = NDArray[np.float64]

# What `Inliers` say of the noise of pixels of the image worked on
NOISE_PX = 1.0
_MAX_KEYPOINTS = 2048
_MAX_SIDE_PX = 1600
# A pixel is undistorted rightly when its ray is seen this near to it again
_SAME_PX = 0.1
# At the rim of a fisheye's half space the plane has no end
_MOST_STRETCH = 1000.0


@dataclasses.dataclass(frozen=True)
class Query:
    """An image uint8[h, w] or RGB, the camera that took it, and where that camera is believed to be."""

    image: Image
    camera: Camera
    prior: CameraPrior | None = None


@dataclasses.dataclass(frozen=True)
class Inliers:
    """The matches that an estimate rests on: landmarks int[n] of the map, where they are seen f64[n, 2] in the image's
    pixels, and a bound on the noise of these per axis.
    """

    landmark: NDArray[np.int32]
    pixels: NDArray[np.float64]
    noise_px: float


@dataclasses.dataclass(frozen=True)
class RigEstimate:
    """A localized rig: map_from_rig or None, its 6x6 covariance, and the rest as of `Estimate`.

    Matches and inliers are counted by the name of the camera.
    """

    map_from_rig: Pose | None
    covariance: Array | None
    n_matches: Mapping[str, int]
    n_inliers: Mapping[str, int]
    status: str
    confidence: float
    seconds: Mapping[str, float]


@dataclasses.dataclass(frozen=True)
class _Matched:
    """What one image says: matched landmarks, their keypoints' pixels, and both in the working image."""

    landmark: NDArray[np.int32]
    pixels: NDArray[np.float32]
    points: PosedPoints
    factor: float
    area_px: float
    n_keypoints: int


@dataclasses.dataclass(frozen=True)
class _Found:
    """A pose with its covariance, or the reason why there is none; the inliers of each image."""

    status: str
    map_from_rig: Pose | None
    covariance: Array | None
    inliers: tuple[NDArray[np.bool_], ...]
    confidence: float


class _Stopwatch:
    """Seconds per stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def stop(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
        self._last = now


class Localizer:
    """Localize images in one map: retrieval, matching against landmarks, PnP.

    The map is indexed once, here, and the networks of its feature, if it has any, are loaded: ``weights`` is a folder
    where these are looked for first. ``localize`` keeps no state: the same image gives the same pose bit for bit,
    whatever was localized before, and with one or several threads.
    """

    def __init__(
        self,
        scene_map: SceneMap,
        rules: LocalizerRules | None = None,
        *,
        seed: int = 0,
        weights: Path | None = None,
    ) -> None:
        if not len(scene_map.xyz) or not len(scene_map.descriptors):
            raise LocalizeError(
                f"{scene_map.path}: the map has no landmarks with descriptors", hint="build the map again"
            )
        self._map = scene_map
        self._rules = LocalizerRules() if rules is None else rules
        self._seed = seed
        self._extractor = open_extractor(
            scene_map.feature, weights=weights, max_keypoints=_MAX_KEYPOINTS, max_side_px=_MAX_SIDE_PX
        )
        self._kind = self._extractor.kind
        self._match = open_matcher(scene_map, self._kind, self._rules, weights=weights)
        self._index = build_index(scene_map, seed=seed)
        stated = scene_map.retrieval
        self._appearance = None if stated is None else open_appearance(stated, weights=weights)
        self._shared = shared_errors(scene_map)
        used = weight_files(scene_map.feature, matcher=self._rules.matcher, retrieval=stated, folder=weights)
        self._weights = digest(*used) if used else ""

    @property
    def colour(self) -> bool:
        """Whether the map's feature or retrieval looks at colours: give it RGB images then."""
        return self._kind.colour or self._appearance is not None

    @property
    def weights_digest(self) -> str:
        """The digest of the networks' weight files, empty without networks: other weights give other estimates."""
        return self._weights

    def localize(self, image: Image, camera: Camera, *, prior: CameraPrior | None = None) -> Estimate:
        """Find map_from_cam of an image uint8[h, w] or RGB; a failure is an Estimate without a pose and its reason.

        With a ``prior``, only mapping images that may show the same are looked at; the pose itself does not lean on
        it. Raises LocalizeError when the image does not have the camera's size.
        """
        return self.localize_with_inliers(image, camera, prior=prior)[0]

    def localize_with_inliers(
        self, image: Image, camera: Camera, *, prior: CameraPrior | None = None
    ) -> tuple[Estimate, Inliers | None]:
        """Localize as `localize` does; also return the matches that the pose rests on, None without a pose."""
        return self._localize(Query(image, camera, prior), threads=default_threads())

    def localize_many(self, queries: Iterable[Query], *, threads: int | None = None) -> Iterator[Estimate]:
        """Localize images in several threads, in their order and with the same bits as one by one.

        Images are taken from ``queries`` as they are needed. Raises as `localize` does.
        """
        return in_threads(self.localize_query, queries, threads=threads or default_threads())

    def localize_query(self, query: Query) -> Estimate:
        """Localize as `localize` does, in the calling thread alone: for callers that have several."""
        return self._localize(query, threads=1)[0]

    def localize_rig(
        self,
        images: Mapping[str, Image],
        rig: Sequence[RigCamera],
        *,
        map_from_rig: CameraPrior | None = None,
    ) -> RigEstimate:
        """Find map_from_rig from images taken at once, uint8[h, w] or RGB by the name of the rig's camera.

        Cameras without an image are left out; the matches of all others make one pose. Raises LocalizeError for an
        image of a camera that the rig does not have, or of another size.
        """
        unknown = sorted(set(images) - {c.name for c in rig})
        if unknown:
            raise LocalizeError(
                f"an image of the camera {unknown[0]!r}; the rig has {', '.join(c.name for c in rig)}",
                hint="give the rig with which the images were taken",
            )
        watch, seen = _Stopwatch(), [c for c in rig if c.name in images]
        matched = []
        for member in seen:
            prior = None if map_from_rig is None else _prior_of(map_from_rig, member.rig_from_cam)
            query = Query(images[member.name], member.camera, prior)
            matched.append(self._matches(query, member.rig_from_cam, watch, threads=default_threads()))
        found = self._pose(matched)
        watch.stop("pnp")
        return RigEstimate(
            found.map_from_rig,
            found.covariance,
            {c.name: len(m.landmark) for c, m in zip(seen, matched, strict=True)},
            {c.name: int(i.sum()) for c, i in zip(seen, found.inliers, strict=True)},
            found.status,
            found.confidence,
            watch.seconds,
        )

    def _localize(self, query: Query, *, threads: int) -> tuple[Estimate, Inliers | None]:
        watch = _Stopwatch()
        matched = self._matches(query, None, watch, threads=threads)
        found = self._pose([matched])
        if "match" in watch.seconds:
            watch.stop("pnp")
        n_inliers = int(sum(i.sum() for i in found.inliers))
        estimate = Estimate(
            found.map_from_rig,
            found.covariance,
            len(matched.landmark),
            n_inliers,
            found.status,
            found.confidence,
            watch.seconds,
        )
        if found.map_from_rig is None:
            return estimate, None
        rows = found.inliers[0]
        inliers = Inliers(matched.landmark[rows], matched.pixels[rows].astype(np.float64), NOISE_PX / matched.factor)
        return estimate, inliers

    def _matches(self, query: Query, rig_from_cam: Pose | None, watch: _Stopwatch, *, threads: int) -> _Matched:
        """Extract, retrieve and match; thresholds and noise are meant in pixels of the image worked on."""
        image, camera = query.image, query.camera
        if image.shape[:2] != (camera.height, camera.width):
            raise LocalizeError(
                f"image is {image.shape[1]}x{image.shape[0]}; its camera says {camera.width}x{camera.height}",
                hint="give the camera with which the image was taken",
            )
        rules = self._rules
        features = self._extractor.extract(image)
        watch.stop("extract")
        keypoint, landmark = np.zeros(0, dtype=np.int32), np.zeros(0, dtype=np.int32)
        if len(features) >= rules.min_inliers:
            among = None if query.prior is None else plausible_images(self._map, query.prior, camera)
            images = self._retrieve(image, features.descriptors, among)
            watch.stop("retrieve")
            size = camera.width, camera.height
            keypoint, landmark = self._match(features, size, self._index, images, threads)
            sharp = _on_the_plane(camera, features.keypoints_px[keypoint])
            keypoint, landmark = keypoint[sharp], landmark[sharp]
            watch.stop("match")
        factor = working_factor(image.shape[:2], max_side_px=_MAX_SIDE_PX)
        focal_px = np.asarray(camera.focal_px) * factor
        sigma_px = expected_noise(self._kind, features.scales[keypoint] * factor)
        grown = self._shared.sigma_px * landmark_noise(self._kind, sigma_px)
        xy = camera.unproject(features.keypoints_px[keypoint])[:, :2]
        stretch = undistortion_stretch(camera, xy)
        points = PosedPoints(
            xy * focal_px,
            sigma_px if stretch is None else sigma_px * stretch,
            self._map.xyz[landmark],
            self._map.xyz_covariance[landmark] * grown[:, None, None] ** 2,
            (float(focal_px[0]), float(focal_px[1])),
            rig_from_cam,
            stretch,
        )
        area_px = camera.width * camera.height * factor**2
        return _Matched(landmark, features.keypoints_px[keypoint], points, factor, area_px, len(features))

    def _retrieve(self, image: Image, descriptors: Descriptors, among: NDArray[np.bool_] | None) -> NDArray[np.int32]:
        count, vectors = self._rules.top_k, self._map.image_vectors
        if self._appearance is None or vectors is None:
            return most_similar(self._index, descriptors, count=count, among=among)
        return nearest_vectors(vectors, self._appearance.whole(image), count=count, among=among)

    def _pose(self, matched: Sequence[_Matched]) -> _Found:
        rules, none = self._rules, tuple(np.zeros(len(m.landmark), dtype=bool) for m in matched)
        if max((m.n_keypoints for m in matched), default=0) < rules.min_inliers:
            return _Found("no_features", None, None, none, 0.0)
        if sum(len(m.landmark) for m in matched) < rules.min_inliers:
            return _Found("no_matches", None, None, none, 0.0)
        solved = estimate_pose([m.points for m in matched], max_error_px=rules.max_reprojection_px, seed=self._seed)
        if solved is None:
            return _Found("no_pose", None, None, none, 0.0)
        if sum(int(i.sum()) for i in solved.inliers) < rules.min_inliers:
            return _Found("few_inliers", None, None, solved.inliers, 0.0)
        agreements = [_agreement(m, residuals_px(m.points, solved.map_from_rig)) for m in matched]
        sure = confidence(agreements, max_error_px=rules.max_reprojection_px)
        if sure < rules.min_confidence:
            return _Found("low_confidence", None, None, solved.inliers, sure)
        covariance = solved.covariance + self._shared_covariance(matched, solved)
        return _Found("ok", solved.map_from_rig, covariance, solved.inliers, sure)

    def _shared_covariance(self, matched: Sequence[_Matched], solved: Solved) -> Array:
        """Return what the landmarks are wrong by together does to the pose (6, 6)."""
        rows = np.concatenate([m.landmark for m in matched])
        landmark, position = np.unique(rows, return_inverse=True)
        response = np.zeros((len(landmark), 6, 3))
        np.add.at(response, position, solved.response.reshape(6, -1, 3).transpose(1, 0, 2))
        moved = response.any(axis=(1, 2))
        return self._shared.covariance(landmark[moved], response[moved].transpose(1, 0, 2).reshape(6, -1))


def _agreement(matched: _Matched, residual_px: Array) -> Agreement:
    return Agreement(matched.pixels.astype(np.float64) * matched.factor, residual_px, matched.area_px)


def _on_the_plane(camera: Camera, pixels: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return bool[n]: which pixels have a ray that meets the plane before the camera, where poses are estimated.

    Beyond the fold of a polynomial distortion, and at 90 degrees and more from a fisheye's axis, there is none.
    """
    if camera.is_pinhole:
        return np.ones(len(pixels), dtype=bool)
    again, inside = camera.project(camera.unproject(pixels))
    with np.errstate(invalid="ignore"):
        return np.asarray(inside & (np.linalg.norm(again - pixels, axis=1) < _SAME_PX))


def undistortion_stretch(camera: Camera, xy: Array) -> Array | None:
    """Return f64[n]: by how much undistorting magnifies the image at xy (n, 2); None where nothing is distorted.

    It is the root mean square over directions: along the radius a fisheye is magnified more than across it.
    """
    if camera.is_pinhole:
        return None
    focal, step = np.asarray(camera.focal_px), 1e-6
    columns = [
        (camera.distort(xy + shift) - camera.distort(xy - shift)) * focal / (2 * step * focal[axis])
        for axis, shift in enumerate(((step, 0.0), (0.0, step)))
    ]
    pixel_by_plane = np.stack(columns, axis=2)
    size = np.sqrt(0.5 * (pixel_by_plane**2).sum(axis=(1, 2)))
    # The inverse of a 2x2 matrix is as large as the matrix itself, over its determinant
    return np.asarray(size / np.maximum(np.abs(np.linalg.det(pixel_by_plane)), size / _MOST_STRETCH))


def _prior_of(map_from_rig: CameraPrior, rig_from_cam: Pose) -> CameraPrior:
    covariance = compose_covariance(map_from_rig.covariance, rig_from_cam)
    return CameraPrior(map_from_rig.map_from_cam * rig_from_cam, covariance)
