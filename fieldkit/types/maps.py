"""A map: landmarks, who saw them from where, and the surface."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fieldkit.cameras import Camera
from fieldkit.frames import Pose

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Surface:
    """A triangle mesh in the map frame: vertices float[n, 3] in m, faces int[m, 3]; the voxel size it was made with."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    voxel_m: float


@dataclasses.dataclass(frozen=True)
class SceneMap:
    """Landmarks in the metric, gravity aligned map frame, who saw them from where, and their descriptors.

    Landmarks (n): ``xyz`` f64[n, 3] in m; ``xyz_covariance`` f64[n, 3, 3] in m^2, f32 in large maps.
    Mapping images (k): ``image_names``, ``image_cameras``, ``map_from_image`` poses (camera in the map).
    Observations (o), sorted by image: ``observation_landmark`` int32[o], ``observation_image`` int32[o],
    ``observation_px`` f32[o, 2].
    Descriptors (d): ``descriptors`` uint8 or float32[d, width], ``descriptor_landmark`` int32[d],
    ``descriptor_image`` int32[d]; a compact map has one per landmark.
    ``retrieval``: the network that made ``image_vectors`` f32[k, w], unit vectors of whole mapping images; None where
    images are compared by their landmarks' descriptors.
    ``appearance``: what networks of appearance see at the landmarks, f16[n, width] by the network's name.
    """

    path: str
    digest: str
    feature: str
    xyz: Array
    xyz_covariance: Array | NDArray[np.float32]
    image_names: tuple[str, ...]
    image_cameras: tuple[Camera, ...]
    map_from_image: tuple[Pose, ...]
    observation_landmark: NDArray[np.int32]
    observation_image: NDArray[np.int32]
    observation_px: NDArray[np.float32]
    descriptors: NDArray[np.uint8] | NDArray[np.float32]
    descriptor_landmark: NDArray[np.int32]
    descriptor_image: NDArray[np.int32]
    surface: Surface | None = None
    retrieval: str | None = None
    image_vectors: NDArray[np.float32] | None = None
    appearance: Mapping[str, NDArray[np.float16]] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class LandmarkStatistics:
    """From where mapping saw each landmark (n), as the paper's features and policies need it.

    Distances in m. ``*_angle_rad``: smallest and largest angle between the viewing ray and the principal axis of the
    observing images (camera frame). ``mean_direction`` f64[n, 3]: unit mean of the directions landmark -> camera;
    ``spread_rad``: largest angle between it and an observing direction (Davison and Murray 2002, at the landmark).
    """

    min_distance_m: Array
    max_distance_m: Array
    min_angle_rad: Array
    max_angle_rad: Array
    mean_direction: Array
    spread_rad: Array
    n_observations: NDArray[np.int32]
