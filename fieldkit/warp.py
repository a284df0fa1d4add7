"""How far a map may be bent: what errors of the mapping images' poses do to many landmarks together.

A landmark's own covariance takes the mapping images as known. They are not: their poses were adjusted to the same
keypoints, and a wrong one displaces all landmarks that it saw. No number of landmarks averages that out.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from numpy.typing import NDArray

from fieldkit.frames import Pose, skew
from fieldkit.observations import PRIOR_M, errors_by_image
from fieldkit.types import SceneMap

Array = NDArray[np.float64]

# SLAM knows every mapping image this well by itself: keeps images with few landmarks finite
SLAM_SIGMA_RAD, SLAM_SIGMA_M = 0.1, 1.0
# Images with fewer landmarks, and than half of the others, say nothing about where the map lies in the world
MIN_OBSERVATIONS = 30
# Noise of a keypoint where a map has no redundancy to show it
UNSHOWN_SIGMA_PX = 1.0
# A point nearer than this, or behind the camera, counts as this deep
MIN_DEPTH_M = 1e-3
# More images take seconds to factorize, and a query 20 ms and more
MAX_IMAGES = 2000
LANDMARKS_AT_ONCE = 8_000


@dataclasses.dataclass(frozen=True, eq=False)
class MapWarp:
    """The mapping images' pose errors of a bundle adjustment, once the map lies on SLAM's positions.

    ``sigma_px`` is the noise of keypoints that the map's own residuals show. ``pulls`` (3n, 6k) is how landmarks (n)
    follow images (k); ``factor`` the factorized information of the images, landmarks eliminated, in units of
    1 / sigma_px^2; ``free`` (6k, 7) moves all images as one, and ``held`` (6k, 7) is what then stays in place.
    """

    sigma_px: float
    pulls: scipy.sparse.csr_array
    factor: scipy.sparse.linalg.SuperLU
    free: Array
    held: Array

    def covariance(self, landmark: NDArray[np.integer], response: Array) -> Array:
        """Return the covariance f64[m, m] of quantities that follow landmarks int[l] by ``response`` f64[m, 3l].

        By the images' errors alone; those of each landmark by itself are its own covariance. A wrong scale of the
        SLAM poses is in neither.
        """
        rows = (3 * np.asarray(landmark, dtype=np.int64)[:, None] + np.arange(3)).ravel()
        by_images = np.asarray((self.pulls[rows].T @ response.T).T)
        return self.sigma_px**2 * _spread(by_images, self.factor, self.free, self.held)


@dataclasses.dataclass(frozen=True, eq=False)
class SharedErrors:
    """What a `MapWarp` says, with little memory: how landmarks follow images is worked out for those asked for.

    ``image_row`` int[k] numbers the images that are taken into account, -1 for the others; ``rows`` are their
    observations, landmark by landmark, those of landmark i in ``starts[i]:starts[i + 1]``.
    """

    sigma_px: float
    image_row: NDArray[np.int32]
    rows: NDArray[np.int32]
    starts: NDArray[np.int64]
    views: _Views
    factor: scipy.sparse.linalg.SuperLU
    free: Array
    held: Array

    def covariance(self, landmark: NDArray[np.integer], response: Array) -> Array:
        """Return the same as `MapWarp.covariance`; every landmark at most once."""
        counts = (self.starts[1:] - self.starts[:-1])[landmark]
        position = np.repeat(self.starts[landmark] - np.concatenate([[0], np.cumsum(counts)[:-1]]), counts)
        rows, owner = self.rows[position + np.arange(counts.sum())], np.repeat(np.arange(len(landmark)), counts)
        by_landmark, by_image = self.views.derivatives(rows)
        points = np.tile(np.eye(3) / PRIOR_M**2, (len(landmark), 1, 1))
        np.add.at(points, owner, by_landmark.transpose(0, 2, 1) @ by_landmark)
        carried = -response.reshape(len(response), -1, 3).transpose(1, 0, 2) @ np.linalg.inv(points)
        moved = carried[owner] @ by_landmark.transpose(0, 2, 1) @ by_image
        by_images = np.zeros((len(self.free) // 6, len(response), 6))
        np.add.at(by_images, self.image_row[self.views.image[rows]], moved)
        flat = by_images.transpose(1, 0, 2).reshape(len(response), -1)
        return self.sigma_px**2 * _spread(flat, self.factor, self.free, self.held)


def _spread(by_images: Array, factor: scipy.sparse.linalg.SuperLU, free: Array, held: Array) -> Array:
    # The map is laid on SLAM's positions: what moves all images together is no error (Baarda's S-transformation)
    back = np.linalg.pinv(held.T @ free) @ held.T
    by_images = by_images - by_images @ free @ back
    spread = by_images @ factor.solve(np.ascontiguousarray(by_images.T))
    return np.asarray((spread + spread.T) / 2)


def map_warp(scene_map: SceneMap) -> MapWarp:
    """Linearise the map's bundle adjustment: Triggs et al. 2000, Bundle Adjustment, sections 6 and 9.

    Cameras' calibration, and which keypoint belongs to which landmark, are taken as right.
    """
    k, n = len(scene_map.image_names), len(scene_map.xyz)
    views = _Views.of(scene_map)
    image = scene_map.observation_image
    pulls, information = _linearised(*views.derivatives(slice(None)), scene_map.observation_landmark, image, (n, k))
    free, held = _gauge(scene_map, np.arange(k), np.bincount(image, minlength=k))
    return MapWarp(_sigma_px(scene_map), pulls, _factorized(information + _slam(k)), free, held)


def shared_errors(scene_map: SceneMap, *, max_images: int = MAX_IMAGES) -> SharedErrors:
    """Linearise the map's bundle adjustment as `map_warp` does, landmarks in parts that fit into little memory.

    Of a map of more than ``max_images`` images, only every second, third, ... is taken into account, as if the others
    had seen nothing: the errors are then overstated.
    """
    step = -(-len(scene_map.image_names) // max_images)
    chosen = np.arange(0, len(scene_map.image_names), step)
    image_row = np.full(len(scene_map.image_names), -1, dtype=np.int32)
    image_row[chosen] = np.arange(len(chosen), dtype=np.int32)
    # Observations are sorted by image; an index of them all would be as large as four of their arrays
    counts = np.diff(np.searchsorted(scene_map.observation_image, np.arange(len(image_row) + 1)))
    used = np.flatnonzero(np.repeat(image_row >= 0, counts)).astype(np.int32)
    rows: NDArray[np.int32] = used[np.argsort(scene_map.observation_landmark[used], kind="stable")]
    landmark = scene_map.observation_landmark[rows]
    starts = np.searchsorted(landmark, np.arange(len(scene_map.xyz) + 1)).astype(np.int64)
    views = _Views.of(scene_map)
    information = _slam(len(chosen))
    for begin in range(0, len(scene_map.xyz), LANDMARKS_AT_ONCE):
        end = min(begin + LANDMARKS_AT_ONCE, len(scene_map.xyz))
        part = rows[starts[begin] : starts[end]]
        owner, image = scene_map.observation_landmark[part] - begin, image_row[scene_map.observation_image[part]]
        information = information + _linearised(*views.derivatives(part), owner, image, (end - begin, len(chosen)))[1]
    seen = np.bincount(image_row[scene_map.observation_image[rows]], minlength=len(chosen))
    free, held = _gauge(scene_map, chosen, seen)
    factor = _factorized(information)
    return SharedErrors(_sigma_px(scene_map), image_row, rows, starts, views, factor, free, held)


@dataclasses.dataclass(frozen=True, eq=False)
class _Views:
    """All observations of a map as arrays: landmarks, and the images' poses and focal lengths."""

    xyz: Array
    landmark: NDArray[np.int32]
    image: NDArray[np.int32]
    rotation: Array
    position: Array
    focal_px: Array

    @staticmethod
    def of(scene_map: SceneMap) -> _Views:
        return _Views(
            scene_map.xyz,
            scene_map.observation_landmark,
            scene_map.observation_image,
            np.stack([p.rotation.as_matrix() for p in scene_map.map_from_image]),
            np.stack([np.asarray(p.translation) for p in scene_map.map_from_image]),
            np.array([c.focal_px for c in scene_map.image_cameras], dtype=np.float64),
        )

    def derivatives(self, rows: NDArray[np.int32] | slice) -> tuple[Array, Array]:
        """Return the derivatives of observations by their landmark (o, 2, 3) and by their image's pose (o, 2, 6)."""
        image = self.image[rows]
        back = self.rotation[image].transpose(0, 2, 1)
        offset = self.xyz[self.landmark[rows]] - self.position[image]
        x, y, depth = (back @ offset[:, :, None])[:, :, 0].T
        z = np.maximum(depth, MIN_DEPTH_M)
        by_point = np.zeros((len(z), 2, 3))
        by_point[:, 0, 0], by_point[:, 1, 1] = (self.focal_px[image] / z[:, None]).T
        by_point[:, 0, 2], by_point[:, 1, 2] = -by_point[:, 0, 0] * x / z, -by_point[:, 1, 1] * y / z
        by_image = np.empty((len(z), 2, 6))
        # By the right perturbation: x_in_cam + [x_in_cam]x w - v
        by_image[:, :, 0] = by_point[:, :, 1] * depth[:, None] - by_point[:, :, 2] * y[:, None]
        by_image[:, :, 1] = by_point[:, :, 2] * x[:, None] - by_point[:, :, 0] * depth[:, None]
        by_image[:, :, 2] = by_point[:, :, 0] * y[:, None] - by_point[:, :, 1] * x[:, None]
        by_image[:, :, 3:] = -by_point
        return by_point @ back, by_image


def _linearised(
    by_landmark: Array,
    by_image: Array,
    landmark: NDArray[np.int32],
    image: NDArray[np.int32],
    shape: tuple[int, int],
) -> tuple[scipy.sparse.csr_array, scipy.sparse.csr_array]:
    """Return how landmarks follow images, and the information of the images with the landmarks eliminated."""
    n, k = shape
    points = np.tile(np.eye(3) / PRIOR_M**2, (n, 1, 1))
    np.add.at(points, landmark, by_landmark.transpose(0, 2, 1) @ by_landmark)
    poses = np.zeros((k, 6, 6))
    np.add.at(poses, image, by_image.transpose(0, 2, 1) @ by_image)
    mixed = _blocks(by_landmark.transpose(0, 2, 1) @ by_image, landmark, image, shape)
    pulls = -(_diagonal(np.asarray(np.linalg.inv(points), dtype=np.float64)) @ mixed)
    return pulls, scipy.sparse.csr_array(_diagonal(poses) + mixed.T @ pulls)


def _slam(count: int) -> scipy.sparse.csr_array:
    return _diagonal(np.tile(np.diag([SLAM_SIGMA_RAD**-2] * 3 + [SLAM_SIGMA_M**-2] * 3), (count, 1, 1)))


def _factorized(information: scipy.sparse.csr_array) -> scipy.sparse.linalg.SuperLU:
    return scipy.sparse.linalg.splu(
        information.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.01, options={"SymmetricMode": True}
    )


def _gauge(scene_map: SceneMap, images: NDArray[np.int64], seen: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return ``free`` and ``held`` of `MapWarp` for images int[k] that have ``seen`` int[k] landmarks."""
    free = _similarities([scene_map.map_from_image[i] for i in images])
    held = free * np.repeat(seen >= min(MIN_OBSERVATIONS, np.median(seen)), 6)[:, None]
    held.reshape(len(images), 6, 7)[:, :3] = 0.0
    return free, held


def _similarities(map_from_image: Sequence[Pose]) -> Array:
    """Return f64[6k, 7]: how images move when the map turns, shifts and grows about their mean position."""
    centres = np.stack([np.asarray(p.translation) for p in map_from_image])
    result = np.zeros((len(centres), 6, 7))
    for i, offset in enumerate(centres - centres.mean(axis=0)):
        back = map_from_image[i].rotation.as_matrix().T
        result[i, :3, :3] = back
        result[i, 3:, :3] = -back @ skew(offset)
        result[i, 3:, 3:6] = back
        result[i, 3:, 6] = back @ offset
    return result.reshape(-1, 7)


def _sigma_px(scene_map: SceneMap) -> float:
    count, total = 0, 0.0
    for _, errors in errors_by_image(scene_map):
        finite = errors[np.isfinite(errors)]
        count, total = count + len(finite), total + float((finite**2).sum())
    freedom = 2 * count - 3 * len(scene_map.xyz) - 6 * len(scene_map.image_names)
    return float(np.sqrt(total / freedom)) if freedom > 0 else UNSHOWN_SIGMA_PX


def _blocks(
    values: Array, row: NDArray[np.int32], column: NDArray[np.int32], shape: tuple[int, int]
) -> scipy.sparse.csr_array:
    """Return a sparse matrix of blocks f64[o, a, b] at block rows and columns int[o]; those at one place are summed."""
    _, a, b = values.shape
    rows = np.broadcast_to(a * row[:, None, None].astype(np.int64) + np.arange(a)[:, None], values.shape)
    columns = np.broadcast_to(b * column[:, None, None].astype(np.int64) + np.arange(b), values.shape)
    flat = (values.ravel(), (rows.ravel(), columns.ravel()))
    return scipy.sparse.csr_array(flat, shape=(a * shape[0], b * shape[1]))


def _diagonal(values: Array) -> scipy.sparse.csr_array:
    rows = np.arange(len(values), dtype=np.int32)
    return _blocks(values, rows, rows, (len(values), len(values)))
