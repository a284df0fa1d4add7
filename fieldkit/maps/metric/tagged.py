"""Metric scale from AprilTags of known size: their corners are seen in mapping images that SfM has placed."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from fieldkit.cameras import Camera
from fieldkit.frames import Pose
from fieldkit.maps.metric.align import Similarity, umeyama
from fieldkit.maps.sources.source import MapSource, read_image
from fieldkit.tags import TagDetection, detect, tag_corners

Array = NDArray[np.float64]

# A corner farther off than this, in pixels and in its own standard deviations, is another tag's or a moved one's
_FAR_PX, _FAR_SIGMAS = 4.0, 6.0
# What SfM's poses and keypoints are off by, however sharp a corner is
_SFM_SIGMA_PX = 0.3
MIN_IMAGES = 3
# No printed tag and no ruler is better than this
_LEAST_SIGMA = 0.001
_MOST_PAIRS = 100


def find_tags(
    walk: MapSource, sizes_m: Mapping[int | None, float], families: Sequence[str], *, progress: Callable[[int], None]
) -> dict[int, list[TagDetection]]:
    """Return the tags of known size in every mapping image (by index) that shows any."""
    result: dict[int, list[TagDetection]] = {}
    for i, image in enumerate(walk.images):
        seen = detect(read_image(image), image.camera, families=families)
        if known := [d for d in seen if d.id in sizes_m or None in sizes_m]:
            result[i] = known
        progress(i + 1)
    return result


@dataclasses.dataclass(frozen=True)
class TagScale:
    """Metres per unit of SfM by tags, its relative standard deviation, and what of the sightings it explains.

    ``n_used`` of ``n_total`` sightings agree; residuals are those of corners, at the tag, in m; ``apart`` is the
    largest relative difference of one tag's own scale to the result, over the tags ``ids``.
    """

    scale: float
    sigma: float
    n_used: int
    n_total: int
    rms_m: float
    p95_m: float
    ids: tuple[int, ...]
    apart: float


@dataclasses.dataclass(frozen=True)
class _Seen:
    """One tag in one placed image."""

    sfm_from_cam: Pose
    camera: Camera
    detection: TagDetection

    def residual_px(self, corners_in_sfm: Array) -> Array:
        """Return (4, 2): corners in the image less those of the tag, undistorted; far off behind the camera."""
        x = self.sfm_from_cam.inv().apply(corners_in_sfm)
        if (x[:, 2] <= 1e-9).any():
            return np.full((4, 2), 1e3)
        return np.asarray((self.flat - x[:, :2] / x[:, 2:]) * self.camera.focal_px)

    @property
    def flat(self) -> Array:
        return self.camera.unproject(self.detection.corners_px)[:, :2]

    @property
    def sigma_px(self) -> float:
        return float(np.hypot(self.detection.sigma_px, _SFM_SIGMA_PX))


@dataclasses.dataclass(frozen=True)
class _TagFit:
    log_scale: float
    sigma: float
    used: int
    residual_m: Array


def tag_scale(
    sightings: Sequence[tuple[Pose, Camera, TagDetection]], sizes_m: Mapping[int | None, float], *, seed: int
) -> TagScale | None:
    """Find the scale from tags seen from several places (sfm_from_cam, camera, detection each).

    A tag's corners, as a square of unknown place and size, are adjusted to all images that see it; images in which
    it is elsewhere, as another one of the same number is, do not count. ``sizes_m`` gives the edge by tag, or by None
    for all others. Returns None where no tag of known size is seen in three images from different places.
    """
    tags: dict[int, list[_Seen]] = {}
    for pose, camera, detection in sightings:
        tags.setdefault(detection.id, []).append(_Seen(pose, camera, detection))
    fits: dict[int, _TagFit] = {}
    for tag_id, seen in sorted(tags.items()):
        size_m = sizes_m.get(tag_id, sizes_m.get(None, np.nan))
        found = _fit(seen, size_m, rng=np.random.default_rng([seed, tag_id]))
        if found is not None:
            fits[tag_id] = found
    if not fits:
        return None
    logs, sigmas = (np.array([getattr(f, name) for f in fits.values()]) for name in ("log_scale", "sigma"))
    middle, sigma = _combined(logs, sigmas)
    residual = np.concatenate([f.residual_m for f in fits.values()])
    return TagScale(
        float(np.exp(middle)),
        sigma,
        sum(f.used for f in fits.values()),
        sum(map(len, tags.values())),
        float(np.sqrt(np.mean(residual**2))),
        float(np.percentile(residual, 95)),
        tuple(fits),
        float(np.abs(np.expm1(logs - middle)).max()),
    )


def _combined(logs: Array, sigmas: Array) -> tuple[float, float]:
    """Return the weighted mean, tags far from their median left out, and its sigma, widened by how they differ."""
    total = np.hypot(sigmas, _LEAST_SIGMA)
    middle = float(np.median(logs))
    near = np.abs(logs - middle) <= np.maximum(5.0 * total, 0.01)
    near = near if near.any() else np.ones(len(logs), dtype=bool)
    weight = 1.0 / total[near] ** 2
    mean = float((weight * logs[near]).sum() / weight.sum())
    chi2 = float((weight * (logs[near] - mean) ** 2).sum() / max(near.sum() - 1, 1))
    return mean, float(np.sqrt(max(chi2, 1.0) / weight.sum()))


def _fit(seen: Sequence[_Seen], size_m: float, *, rng: np.random.Generator) -> _TagFit | None:
    start = _start(seen, rng)
    if start is None:
        return None
    square = tag_corners(1.0)
    near = _near(seen, start.points(square))
    for _ in range(3):
        used = [s for s, keep in zip(seen, near, strict=True) if keep]
        if len(used) < MIN_IMAGES:
            return None
        similarity, sigma = _adjusted(used, start)
        again = _near(seen, similarity.points(square))
        if (again == near).all():
            break
        near, start = again, similarity
    corners = similarity.points(square)
    scale = size_m / similarity.scale
    depth = [float(np.mean(s.sfm_from_cam.inv().apply(corners)[:, 2])) for s in used]
    residual = [
        scale * z * np.linalg.norm(s.residual_px(corners), axis=1) / float(np.mean(s.camera.focal_px))
        for z, s in zip(depth, used, strict=True)
    ]
    return _TagFit(float(np.log(scale)), sigma, len(used), np.concatenate(residual))


def _near(seen: Sequence[_Seen], corners: Array) -> NDArray[np.bool_]:
    off = np.array([np.sqrt(np.mean(s.residual_px(corners) ** 2)) for s in seen])
    return np.asarray(off <= np.array([max(_FAR_PX, _FAR_SIGMAS * s.sigma_px) for s in seen]))


def _start(seen: Sequence[_Seen], rng: np.random.Generator) -> Similarity | None:
    """Return sfm_from_tag (of unit size) by the pair of images whose corners fit the most other images."""
    pairs = list(itertools.combinations(range(len(seen)), 2))
    if len(pairs) > _MOST_PAIRS:
        pairs = [pairs[k] for k in rng.choice(len(pairs), _MOST_PAIRS, replace=False)]
    best, most = None, (MIN_IMAGES - 1, 0.0)
    for a, b in pairs:
        corners = _triangulated([seen[a], seen[b]])
        if corners is None:
            continue
        similarity = umeyama(tag_corners(1.0), corners)
        if not similarity.scale > 0:
            continue
        near = _near(seen, similarity.points(tag_corners(1.0)))
        apart = float(np.linalg.norm(seen[a].sfm_from_cam.translation - seen[b].sfm_from_cam.translation))
        if (int(near.sum()), apart) > most:
            best, most = similarity, (int(near.sum()), apart)
    return best


def _triangulated(seen: Sequence[_Seen]) -> Array | None:
    """Return the corners (4, 3) nearest to the rays of all images; None where the rays are all but parallel."""
    result = []
    for corner in range(4):
        total, right = np.zeros((3, 3)), np.zeros(3)
        for s in seen:
            ray = s.sfm_from_cam.rotation.apply([*s.flat[corner], 1.0])
            ray = ray / np.linalg.norm(ray)
            square = np.eye(3) - np.outer(ray, ray)
            total += square
            right += square @ s.sfm_from_cam.translation
        if np.linalg.eigvalsh(total)[0] < 1e-3:
            return None
        result.append(np.linalg.solve(total, right))
    return np.stack(result)


def _adjusted(seen: Sequence[_Seen], start: Similarity) -> tuple[Similarity, float]:
    """Return sfm_from_tag by robust least squares over all corners, and the sigma of the logarithm of its size.

    The corners of one image share the errors of its pose: the covariance is the sandwich over images, or the inverse
    of the information where that is larger.
    """
    unit = start.scale

    def moved(step: Array) -> Similarity:
        return Similarity(
            start.scale * float(np.exp(step[6])),
            start.rotation * Rotation.from_rotvec(step[:3]),
            start.translation + unit * step[3:6],
        )

    def residuals(step: Array) -> Array:
        corners = moved(step).points(tag_corners(1.0))
        return np.concatenate([(s.residual_px(corners) / s.sigma_px).ravel() for s in seen])

    found = least_squares(residuals, np.zeros(7), loss="cauchy", f_scale=2.0)
    slope, residual = np.asarray(found.jac), residuals(found.x)
    inverse = np.linalg.pinv(slope.T @ slope)
    scores = np.einsum("nki,nk->ni", slope.reshape(len(seen), 8, 7), residual.reshape(len(seen), 8))
    clusters = inverse @ (scores.T @ scores) @ inverse * len(seen) / max(len(seen) - 1, 1)
    excess = max(1.0, float(residual @ residual) / max(len(residual) - 7, 1))
    variance = max(float(clusters[6, 6]), excess * float(inverse[6, 6]))
    return moved(np.asarray(found.x)), float(np.sqrt(variance))
