"""Which reconstructed points become landmarks, and how uncertain their positions are."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import pycolmap
from numpy.typing import NDArray

from fieldkit.cameras import Camera
from fieldkit.frames import Pose
from fieldkit.observations import PRIOR_M, observations_of, projection_jacobian, reprojection_errors

Array = NDArray[np.float64]

_INVERTED_TOGETHER = 1 << 16


@dataclasses.dataclass(frozen=True)
class LandmarkRules:
    """The paper's filter: observing images, distance of the nearest observation, mean reprojection error."""

    min_images: int = 4
    min_distance_m: float = 0.1
    max_distance_m: float = 8.0
    max_reprojection_px: float = 4.0


@dataclasses.dataclass(frozen=True)
class Model:
    """A COLMAP model as arrays: images sorted by name; observations sorted by image, then by keypoint.

    ``observation_keypoint`` is the row of the observation among the image's keypoints.
    """

    image_names: tuple[str, ...]
    image_cameras: tuple[Camera, ...]
    map_from_image: tuple[Pose, ...]
    xyz: Array
    point_ids: NDArray[np.int64]
    observation_landmark: NDArray[np.int32]
    observation_image: NDArray[np.int32]
    observation_keypoint: NDArray[np.int32]
    observation_px: NDArray[np.float32]


def model_arrays(model: pycolmap.Reconstruction) -> Model:
    """Read the registered images, points and observations of a COLMAP model into arrays."""
    images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)
    cameras = {i: _camera(c) for i, c in model.cameras.items()}
    point_ids = np.array(sorted(model.point3D_ids()), dtype=np.int64)
    row = {int(p): i for i, p in enumerate(point_ids)}
    xyz = np.array([model.point3D(int(p)).xyz for p in point_ids], dtype=np.float64).reshape(-1, 3)
    landmark, owner, keypoint, pixels = [], [], [], []
    for i, image in enumerate(images):
        for k, point in enumerate(image.points2D):
            if point.has_point3D():
                landmark.append(row[point.point3D_id])
                owner.append(i)
                keypoint.append(k)
                pixels.append(point.xy)
    return Model(
        tuple(image.name for image in images),
        tuple(cameras[image.camera_id] for image in images),
        tuple(Pose.from_matrix(np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])).inv() for image in images),
        xyz,
        point_ids,
        np.array(landmark, dtype=np.int32),
        np.array(owner, dtype=np.int32),
        np.array(keypoint, dtype=np.int32),
        np.array(pixels, dtype=np.float32).reshape(-1, 2),
    )


def model_from_arrays(model: Model, pixels: Sequence[NDArray[np.float32]]) -> pycolmap.Reconstruction:
    """Make a COLMAP model of arrays; ``pixels`` f32[m, 2] are all keypoints of each image, in COLMAP pixels."""
    result = pycolmap.Reconstruction()
    camera_ids: dict[Camera, int] = {}
    for i, (name, camera, pose) in enumerate(
        zip(model.image_names, model.image_cameras, model.map_from_image, strict=True), start=1
    ):
        if camera not in camera_ids:
            camera_ids[camera] = len(camera_ids) + 1
            result.add_camera_with_trivial_rig(colmap_camera(camera, camera_ids[camera]))
        points = pycolmap.Point2DList([pycolmap.Point2D(xy.astype(np.float64)) for xy in pixels[i - 1]])
        image = pycolmap.Image(name=name, camera_id=camera_ids[camera], image_id=i, points2D=points)
        matrix = pose.inv().as_matrix()
        result.add_image_with_trivial_frame(image, pycolmap.Rigid3d(matrix[:3]))
    order = np.argsort(model.observation_landmark, kind="stable")
    bounds = np.searchsorted(model.observation_landmark[order], np.arange(len(model.xyz) + 1))
    for k, xyz in enumerate(model.xyz):
        track = pycolmap.Track()
        for o in order[bounds[k] : bounds[k + 1]]:
            track.add_element(int(model.observation_image[o]) + 1, int(model.observation_keypoint[o]))
        result.add_point3D(xyz, track)
    result.update_point_3d_errors()
    return result


def colmap_camera(camera: Camera, camera_id: int = 1) -> pycolmap.Camera:
    """Return COLMAP's camera with the same model, size and parameters."""
    return pycolmap.Camera(
        camera_id=camera_id,
        model=camera.model,
        width=camera.width,
        height=camera.height,
        params=list(camera.params),
        has_prior_focal_length=True,
    )


def _camera(camera: pycolmap.Camera) -> Camera:
    return Camera(camera.model_name, camera.width, camera.height, tuple(float(v) for v in camera.params))


def good_landmarks(model: Model, rules: LandmarkRules) -> NDArray[np.bool_]:
    """Return bool[n]: the points that pass the filter."""
    n = len(model.xyz)
    centres = np.stack([p.translation for p in model.map_from_image])
    seen = np.unique(np.column_stack([model.observation_landmark, model.observation_image]), axis=0)
    n_images = np.bincount(seen[:, 0], minlength=n)
    distance = np.linalg.norm(model.xyz[model.observation_landmark] - centres[model.observation_image], axis=1)
    nearest = np.full(n, np.inf)
    np.minimum.at(nearest, model.observation_landmark, distance)
    total = np.zeros(n)
    np.add.at(total, model.observation_landmark, reprojection_errors(model))
    mean = total / np.maximum(np.bincount(model.observation_landmark, minlength=n), 1)
    return np.asarray(
        (n_images >= rules.min_images)
        & (nearest >= rules.min_distance_m)
        & (nearest <= rules.max_distance_m)
        & (mean <= rules.max_reprojection_px)
    )


def landmark_covariance(
    xyz: Array,
    observation_landmark: NDArray[np.int32],
    observation_image: NDArray[np.int32],
    map_from_image: Sequence[Pose],
    image_cameras: Sequence[Camera],
    *,
    noise_px: float = 1.0,
    prior_m: float = PRIOR_M,
) -> Array:
    """Return f64[n, 3, 3] in m^2: the inverse of the summed information of each landmark's observations.

    Every observation has ``noise_px`` of independent noise per axis and an exact camera pose; a weak prior of
    ``prior_m`` keeps landmarks seen along one ray finite. Hartley and Zisserman, Multiple View Geometry, 5.2.
    """
    information = np.tile(np.eye(3) / prior_m**2, (len(xyz), 1, 1))
    for i, rows in observations_of(observation_image, len(map_from_image)):
        jacobian = projection_jacobian(xyz[observation_landmark[rows]], map_from_image[i], image_cameras[i])
        np.add.at(information, observation_landmark[rows], np.einsum("nki,nkj->nij", jacobian, jacobian) / noise_px**2)
    # In parts: of a million landmarks two copies are a seventh of a gigabyte
    for begin in range(0, len(xyz), _INVERTED_TOGETHER):
        part = slice(begin, begin + _INVERTED_TOGETHER)
        information[part] = np.linalg.inv(information[part])
    return information
