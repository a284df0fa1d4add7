"""Which mapping images may show what a query shows, by where its camera is believed to be."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from fieldkit.cameras import Camera
from fieldkit.errors import LocalizeError
from fieldkit.frames import Pose
from fieldkit.types import SceneMap

Array = NDArray[np.float64]

# Standard deviations by which the camera may be elsewhere
_SIGMAS = 3.0
# Mapping images that saw fewer of the landmarks that may be in view are left out
_LEAST_SEEN = 4
# A corner's ray is seen this near to it again
_SAME_PX = 0.1


@dataclasses.dataclass(frozen=True)
class CameraPrior:
    """Where a camera is believed to be: map_from_cam, and its 6x6 covariance (right perturbation, rotation first)."""

    map_from_cam: Pose
    covariance: Array


def plausible_images(scene_map: SceneMap, prior: CameraPrior, camera: Camera) -> NDArray[np.bool_]:
    """Return bool[k]: the mapping images that saw landmarks which may lie in the camera's view.

    The view is a cone about the principal axis that holds the whole image, or all that is in front, wider by three
    standard deviations of rotation and position. Walls do not hide anything: images of the next room stay. Raises
    LocalizeError for a prior whose covariance is not finite.
    """
    if not np.isfinite(prior.covariance).all():
        raise LocalizeError("the prior's covariance is not finite", hint="leave the prior out where nothing is known")
    corners = np.array([[0.0, 0.0], [camera.width, 0.0], [0.0, camera.height], [camera.width, camera.height]])
    rays = camera.unproject(corners)
    again, _ = camera.project(rays)
    # Corners that a fisheye sees at 90 degrees or more, or beyond the fold of a distortion, have no ray
    seen_again = float(np.linalg.norm(again - corners, axis=1).max()) < _SAME_PX
    half = float(np.arctan(np.linalg.norm(rays[:, :2], axis=1).max())) if seen_again else np.pi / 2
    turned, moved = (
        _SIGMAS * float(np.sqrt(max(np.linalg.eigvalsh(prior.covariance[part, part])[-1], 0.0)))
        for part in (slice(0, 3), slice(3, 6))
    )
    x_in_cam = prior.map_from_cam.inv().apply(scene_map.xyz)
    distance = np.linalg.norm(x_in_cam, axis=1)
    angle = np.arctan2(np.linalg.norm(x_in_cam[:, :2], axis=1), x_in_cam[:, 2])
    shifted = np.arcsin(np.minimum(moved / np.maximum(distance, 1e-9), 1.0))
    in_view = (angle <= half + turned + shifted) | (distance <= moved)
    seen = np.bincount(
        scene_map.observation_image[in_view[scene_map.observation_landmark]], minlength=len(scene_map.image_names)
    )
    return np.asarray(seen >= _LEAST_SEEN)
