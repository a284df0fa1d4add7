"""Who saw which landmark, and what pixels say about points: derivatives and residuals of observations."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fieldkit.cameras import Camera
from fieldkit.frames import Pose

Array = NDArray[np.float64]

# Keeps a landmark that is seen along one ray finite
PRIOR_M = 10.0


class Observed(Protocol):
    """Landmarks, the images that saw them, and where in these: a map, or a COLMAP model as arrays."""

    @property
    def xyz(self) -> Array: ...
    @property
    def image_names(self) -> tuple[str, ...]: ...
    @property
    def image_cameras(self) -> tuple[Camera, ...]: ...
    @property
    def map_from_image(self) -> tuple[Pose, ...]: ...
    @property
    def observation_landmark(self) -> NDArray[np.int32]: ...
    @property
    def observation_image(self) -> NDArray[np.int32]: ...
    @property
    def observation_px(self) -> NDArray[np.float32]: ...


def reprojection_errors(model: Observed) -> Array:
    """Return the distance (px) between every observation and its projected landmark; inf behind the camera."""
    errors = np.full(len(model.observation_image), np.inf)
    for rows, distance in errors_by_image(model):
        errors[rows] = distance
    return errors


def errors_by_image(model: Observed) -> Iterator[tuple[slice, Array]]:
    """Yield what `reprojection_errors` returns, image by image, with the observations' rows."""
    for i, rows in observations_of(model.observation_image, len(model.image_names)):
        x_in_cam = model.map_from_image[i].inv().apply(model.xyz[model.observation_landmark[rows]])
        pixels, _ = model.image_cameras[i].project(x_in_cam)
        distance = np.linalg.norm(pixels - model.observation_px[rows], axis=1)
        yield rows, np.where(np.isfinite(distance), distance, np.inf)


def projection_jacobian(xyz: Array, map_from_cam: Pose, camera: Camera) -> Array:
    """Return f64[n, 2, 3]: derivative of the undistorted pixel by the point in the map."""
    cam_from_map = map_from_cam.inv()
    x, y, z = cam_from_map.apply(xyz).T
    z = np.maximum(z, 1e-3)
    fx, fy = camera.focal_px
    zero = np.zeros_like(z)
    inner = np.stack(
        [np.stack([fx / z, zero, -fx * x / z**2], axis=1), np.stack([zero, fy / z, -fy * y / z**2], axis=1)], axis=1
    )
    return np.asarray(inner @ cam_from_map.rotation.as_matrix())


def observations_of(observation_image: NDArray[np.int32], count: int) -> list[tuple[int, slice]]:
    """Return (image, its rows) for observations that are sorted by image."""
    bounds = np.searchsorted(observation_image, np.arange(count + 1))
    return [(i, slice(int(bounds[i]), int(bounds[i + 1]))) for i in range(count) if bounds[i] < bounds[i + 1]]
