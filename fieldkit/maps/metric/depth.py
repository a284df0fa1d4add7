"""Metric scale from depth images: drifting SLAM positions leave a per mille or more, a depth camera less."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from fieldkit.cameras import Camera
from fieldkit.frames import Pose, mean_pose
from fieldkit.maps.landmarks import Model
from fieldkit.maps.metric.align import Alignment, Similarity, doubted
from fieldkit.maps.sources.source import DepthFrame, MapSource

Array = NDArray[np.float64]
ReadDepth = Callable[[DepthFrame], NDArray[np.uint16]]

_MIN_SAMPLES, _MIN_OF_FRAME = 200, 20
# A scale that depth changes by more contradicts it: depth cameras are a per cent or two off by calibration
MAX_CHANGE = 0.05
_RANGE_M = (0.4, 5.0)
# Depth may change this much around a landmark; more is an edge, where landmark and pixel may lie on two surfaces.
_FLAT = 0.02


@dataclasses.dataclass(frozen=True)
class DepthScale:
    """Measured depth over mapped depth: median ratio over n landmarks, and the relative standard deviation of that.

    ``n_used`` of them are within three standard deviations; ``rms_m`` of those and ``p95_m`` of all are how far
    measured and mapped depth differ after scaling, in m.
    """

    ratio: float
    sigma: float
    n: int
    n_used: int = 0
    rms_m: float = 0.0
    p95_m: float = 0.0


def depth_views(walk: MapSource, mapped: Mapping[int, Pose]) -> list[tuple[DepthFrame, Pose]]:
    """Return the depth images that belong to mapped images, with map_from_depth."""
    views = []
    for frame in walk.depth:
        anchors = [mapped[i] * cam_from_depth for i, cam_from_depth in frame.anchors if i in mapped]
        if anchors:
            views.append((frame, mean_pose(anchors)[0]))
    return views


def depth_scale(walk: MapSource, model: Model, mapped: Mapping[int, Pose], *, read: ReadDepth) -> DepthScale | None:
    """Compare the depth of landmarks in the map with what the depth images measured at their pixels.

    A landmark is compared in the depth images of the frames that observe it, where the depth around its pixel is
    smooth. Returns None where there are too few of them, or no depth.
    """
    camera = walk.depth_camera
    if camera is None:
        return None
    row = {name: i for i, name in enumerate(model.image_names)}
    seen_by = _landmarks_of_images(model)
    ratios = []
    for frame, map_from_depth in depth_views(walk, mapped):
        names = [walk.images[i].name for i, _ in frame.anchors if i in mapped]
        seen = [seen_by[row[name]] for name in names if name in row]
        if seen:
            xyz = model.xyz[np.unique(np.concatenate(seen))]
            ratios.append(_ratios(xyz, map_from_depth, camera, read(frame)))
    values, measured = np.concatenate(ratios, axis=1) if ratios else np.zeros((2, 0))
    if len(values) < _MIN_SAMPLES:
        return None
    ratio = float(np.median(values))
    spread = 1.4826 * float(np.median(np.abs(values - ratio)))
    off = np.abs(measured - ratio * measured / values)
    used = np.abs(values - ratio) <= 3.0 * max(spread, 1e-9)
    return DepthScale(
        ratio,
        _sigma([r[0] for r in ratios], spread) / ratio,
        len(values),
        int(used.sum()),
        float(np.sqrt(np.mean(off[used] ** 2))),
        float(np.percentile(off, 95)),
    )


def _sigma(by_frame: list[Array], spread: float) -> float:
    """Return the standard deviation of the median of all ratios.

    As if each were by itself, or, where that is more, as the medians of the frames differ: what a depth image is off
    by, its landmarks share.
    """
    alone = 1.2533 * spread / float(np.sqrt(sum(map(len, by_frame))))
    medians = np.array([np.median(r) for r in by_frame if len(r) >= _MIN_OF_FRAME])
    if len(medians) < 3:
        return alone
    apart = 1.4826 * float(np.median(np.abs(medians - np.median(medians))))
    return max(alone, 1.2533 * apart / float(np.sqrt(len(medians))))


def with_depth_scale(
    alignment: Alignment, found: DepthScale, *, sfm_centres: Array, slam_centres: Array, anyway: bool = False
) -> tuple[Alignment, list[str]]:
    """Scale an alignment by depth; one that depth contradicts is kept, unless scaled ``anyway``, and does not pass.

    ``sfm_centres`` and ``slam_centres`` are the same camera centres (n, 3) in SfM's frame and as SLAM tracked them;
    frame and gravity stay SLAM's, and the residuals are those to its positions after scaling.
    """
    told = []
    if abs(found.ratio - 1.0) > MAX_CHANGE:
        told = [
            f"depth images say that the SLAM poses are {100 * (1.0 / found.ratio - 1):+.1f} % off in scale "
            f"({found.n} landmarks); {'depth is' if anyway else 'the poses are'} believed: check the units and the "
            "calibration of both"
        ]
        alignment = doubted(alignment, found.ratio)
        if not anyway:
            return alignment, told
    scaled = rescaled(alignment, found.ratio, sfm_centres=sfm_centres, slam_centres=slam_centres)
    return dataclasses.replace(scaled, source="depth", scale_sigma=found.sigma), told


def rescaled(alignment: Alignment, ratio: float, *, sfm_centres: Array, slam_centres: Array) -> Alignment:
    """Scale an alignment about the middle of its cameras; residuals are those to SLAM's positions after scaling."""
    old = alignment.map_from_sfm
    middle = old.points(sfm_centres).mean(axis=0)
    moved = middle + ratio * (old.translation - middle)
    similarity = Similarity(old.scale * ratio, old.rotation, moved)
    residual = np.linalg.norm(similarity.points(sfm_centres) - slam_centres, axis=1)
    used = residual[residual <= alignment.threshold_m]
    return dataclasses.replace(
        alignment,
        map_from_sfm=similarity,
        n_used=len(used),
        rms_m=float(np.sqrt(np.mean((used if len(used) else residual) ** 2))),
        p95_m=float(np.percentile(residual, 95)),
    )


def _landmarks_of_images(model: Model) -> list[NDArray[np.int32]]:
    borders = np.searchsorted(model.observation_image, np.arange(len(model.image_names) + 1))
    return [model.observation_landmark[a:b] for a, b in itertools.pairwise(borders)]


def _ratios(xyz: Array, map_from_depth: Pose, camera: Camera, depth_mm: NDArray[np.uint16]) -> Array:
    """Return (2, n): measured over mapped depth of landmarks, and the measured depth in m."""
    x_in_depth = map_from_depth.inv().apply(xyz)
    pixels, inside = camera.project(x_in_depth)
    inside &= (pixels >= 1).all(axis=1) & (pixels < (camera.width - 1, camera.height - 1)).all(axis=1)
    column, line = pixels[inside].astype(int).T
    around = np.stack([depth_mm[line + dy, column + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)]).astype(np.float64)
    around /= 1000.0
    measured = around[4]
    good = (around.min(axis=0) > _RANGE_M[0]) & (around.max(axis=0) < _RANGE_M[1])
    good &= np.ptp(around, axis=0) < _FLAT * measured
    return np.stack([measured[good] / x_in_depth[inside, 2][good], measured[good]])
