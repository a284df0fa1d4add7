"""The gauge between a map and the world in which it was made: one rigid transform, scale not refitted."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from fieldkit.errors import JudgeError
from fieldkit.frames import Pose
from fieldkit.types import SceneMap


@dataclasses.dataclass(frozen=True)
class Gauge:
    """The rigid transform world_from_map, and what it leaves of the mapping cameras' positions (m)."""

    world_from_map: Pose
    rms_m: float
    max_m: float
    scale_error: float


def fit_gauge(scene_map: SceneMap, true_cameras: Mapping[str, Pose]) -> Gauge:
    """Fit world_from_map to the positions of the mapping cameras (Kabsch, no scale); scale is only measured.

    ``true_cameras`` are world_from_cam by image name. Raises JudgeError when the map shares fewer than 3 of them.
    """
    pairs = [
        (p.translation, true_cameras[name].translation)
        for name, p in zip(scene_map.image_names, scene_map.map_from_image, strict=True)
        if name in true_cameras
    ]
    if len(pairs) < 3:
        raise JudgeError(
            f"{scene_map.path}: shares {len(pairs)} images with the session's truth; expected its mapping images",
            hint="judge a map that was built from this session's mapping/ folder",
        )
    mapped, true = (np.array(side) for side in zip(*pairs, strict=True))
    centred, target = mapped - mapped.mean(axis=0), true - true.mean(axis=0)
    rotation, _ = Rotation.align_vectors(target, centred)
    world_from_map = Pose.from_components(true.mean(axis=0) - rotation.apply(mapped.mean(axis=0)), rotation)
    residual = np.linalg.norm(world_from_map.apply(mapped) - true, axis=1)
    scale = float(np.sum(target * rotation.apply(centred)) / np.sum(centred**2))
    return Gauge(world_from_map, float(np.sqrt(np.mean(residual**2))), float(residual.max()), 1.0 / scale - 1.0)
