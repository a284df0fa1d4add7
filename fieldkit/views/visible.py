"""Which landmarks each candidate would see: map and geometry only, never an image."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fieldkit.frames import Pose
from fieldkit.protocol import CandidateRules
from fieldkit.surface import RayCaster
from fieldkit.types import Candidates, SceneMap

Array = NDArray[np.float64]
_SAME_PLACE_M = 1e-6


@dataclasses.dataclass(frozen=True)
class Visibility:
    """What each of v candidates sees: landmark indices int32[k], and where they are in its camera and image.

    ``x_in_cam`` f64[k, 3] in m, ``uv_px`` f32[k, 2].
    """

    landmarks: tuple[NDArray[np.int32], ...]
    x_in_cam: tuple[Array, ...]
    uv_px: tuple[NDArray[np.float32], ...]


def visibility(
    scene_map: SceneMap,
    candidates: Candidates,
    *,
    rules: CandidateRules,
    rays: RayCaster | None = None,
    tolerance_m: float = 0.0,
) -> Visibility:
    """Tell which landmarks each candidate sees: inside the image and the distance limits, and not behind the surface.

    ``rays`` switches the occlusion filter on: a landmark is hidden when the surface is hit more than ``tolerance_m``
    before it. One ray is cast per landmark and distinct camera centre. At a centre inside a closed surface every
    landmark is hidden, all utilities tie, and the choice is the same as random's.
    """
    views = [_in_view(scene_map.xyz, pose, candidates, rules) for pose in candidates.map_from_cam]
    if rays is not None:
        kept = _unhidden(scene_map.xyz, [v[0] for v in views], candidates.map_from_cam, rays, tolerance_m)
        views = [(i[keep], x[keep], uv[keep]) for (i, x, uv), keep in zip(views, kept, strict=True)]
    return Visibility(*(tuple(part) for part in zip(*views, strict=True))) if views else Visibility((), (), ())


def _in_view(
    xyz: Array, map_from_cam: Pose, candidates: Candidates, rules: CandidateRules
) -> tuple[NDArray[np.int32], Array, NDArray[np.float32]]:
    """Return the landmarks in view, their positions in the camera, and their pixels."""
    x_in_cam = (xyz - map_from_cam.translation) @ map_from_cam.rotation.as_matrix()
    squared = np.einsum("ij,ij->i", x_in_cam, x_in_cam)
    # What lies behind the camera is in no image: half of a map need not be projected.
    ahead = (x_in_cam[:, 2] > 0.0) & (squared >= rules.min_distance_m**2) & (squared <= rules.max_distance_m**2)
    near = np.flatnonzero(ahead)
    pixels, in_image = candidates.camera.project(x_in_cam[near])
    seen = near[in_image]
    return seen.astype(np.int32), x_in_cam[seen], pixels[in_image].astype(np.float32)


def _unhidden(
    xyz: Array,
    inside: Sequence[NDArray[np.int32]],
    poses: Sequence[Pose],
    rays: RayCaster,
    tolerance_m: float,
) -> list[NDArray[np.bool_]]:
    """Tell for each view which of its landmarks the surface does not hide."""
    groups: dict[tuple[int, ...], list[int]] = {}
    for index, pose in enumerate(poses):
        # Centres that differ by rounding only, far below a voxel, are one
        place = np.rint(pose.translation / _SAME_PLACE_M).astype(np.int64)
        groups.setdefault(tuple(place.tolist()), []).append(index)
    result = [np.ones(len(i), dtype=bool) for i in inside]
    for members in groups.values():
        targets = np.unique(np.concatenate([inside[m] for m in members]))
        if not len(targets):
            continue
        seen = rays.visible(poses[members[0]].translation, xyz[targets], tolerance_m=tolerance_m)
        visible = np.zeros(len(xyz), dtype=bool)
        visible[targets[seen]] = True
        for m in members:
            result[m] = visible[inside[m]]
    return result
