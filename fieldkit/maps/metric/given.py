"""Poses that were given: the frame is theirs, and the residuals of the points in the images judge it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fieldkit.frames import Pose
from fieldkit.maps.landmarks import Model, model_arrays
from fieldkit.maps.metric.align import Alignment, Similarity, Verdict
from fieldkit.observations import reprojection_errors

Array = NDArray[np.float64]

_UP_DEG = 5.0
# Points that say whether an image's pose fits the others'
_LEAST_POINTS = 15
# Shares of the matches that poses have to fit: to be believed, to be doubted
_PASS_SHARE, _WARN_SHARE = 0.85, 0.6


def known_alignment(
    model: pycolmap.Reconstruction, poses: Mapping[int, Pose], *, share: float, tilt: tuple[float, float]
) -> Alignment:
    """Return the alignment of a map whose poses were given, judged by what its points' residuals in the images are.

    ``rms_m`` and ``p95_m`` are those residuals at the points' distances, ``n_used`` of ``n_total`` images see
    enough points, ``share`` of the matches fit the poses. ``tilt`` is the angle between the z axis and what the images
    show as up, and its sigma (deg): frames that are not upright are told, not turned.
    """
    arrays = model_arrays(model)
    errors = reprojection_errors(arrays)
    metres = errors * _metres_per_px(arrays)
    counts = np.bincount(arrays.observation_image, minlength=len(arrays.image_names))
    n_used = int((counts >= _LEAST_POINTS).sum())
    rms_px = float(np.sqrt(np.mean(errors**2)))
    return Alignment(
        Similarity(1.0, Rotation.identity(), np.zeros(3)),
        "known",
        n_used,
        len(poses),
        float(np.sqrt(np.mean(metres**2))),
        float(np.percentile(metres, 95)),
        tilt[0],
        0.0,
        _verdict(n_used / max(len(poses), 1), share, tilt),
        gravity_from="known",
        reprojection_px=rms_px,
        match_share=share,
    )


def _metres_per_px(model: Model) -> Array:
    centres = np.stack([p.translation for p in model.map_from_image])
    focal = np.array([np.mean(camera.focal_px) for camera in model.image_cameras])
    away = model.xyz[model.observation_landmark] - centres[model.observation_image]
    return np.asarray(np.linalg.norm(away, axis=1) / focal[model.observation_image])


def _verdict(share_used: float, share: float, tilt: tuple[float, float]) -> Verdict:
    # An angle counts as far as it is known: the images of a blank corridor say little about up
    leaning = tilt[0] - 3.0 * tilt[1]
    if share_used < 0.5 or share < _WARN_SHARE or leaning > _UP_DEG:
        return "fail"
    return "pass" if share_used >= 0.9 and share >= _PASS_SHARE and leaning <= 1.0 else "warn"
