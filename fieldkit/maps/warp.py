"""How far a map may be bent: what errors of the mapping images' poses do to many landmarks together.

A landmark's own covariance takes the mapping images as known. They are not: their poses were adjusted to the same
keypoints, and a wrong one displaces all landmarks that it saw. No number of landmarks averages that out.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from numpy.typing import NDArray

from fieldkit.frames import skew
from fieldkit.maps.landmarks import PRIOR_M, observations_of, projection_jacobian, reprojection_errors
from fieldkit.types import SceneMap

Array = NDArray[np.float64]

# SLAM knows every mapping image this well by itself: keeps images with few landmarks finite
SLAM_SIGMA_RAD, SLAM_SIGMA_M = 0.1, 1.0
# Images with fewer landmarks, and than half of the others, say nothing about where the map lies in the world
MIN_OBSERVATIONS = 30
# Noise of a keypoint where a map has no redundancy to show it
UNSHOWN_SIGMA_PX = 1.0


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
        # The map is laid on SLAM's positions: what moves all images together is no error (Baarda's S-transformation)
        back = np.linalg.pinv(self.held.T @ self.free) @ self.held.T
        by_images = by_images - by_images @ self.free @ back
        spread = by_images @ self.factor.solve(np.ascontiguousarray(by_images.T))
        return np.asarray(self.sigma_px**2 * (spread + spread.T) / 2)


def map_warp(scene_map: SceneMap) -> MapWarp:
    """Linearise the map's bundle adjustment: Triggs et al. 2000, Bundle Adjustment, sections 6 and 9.

    Cameras' calibration, and which keypoint belongs to which landmark, are taken as right.
    """
    k, n = len(scene_map.image_names), len(scene_map.xyz)
    by_landmark, by_image = _derivatives(scene_map)
    landmark, image = scene_map.observation_landmark, scene_map.observation_image
    points = np.tile(np.eye(3) / PRIOR_M**2, (n, 1, 1))
    np.add.at(points, landmark, by_landmark.transpose(0, 2, 1) @ by_landmark)
    poses = np.tile(np.diag([SLAM_SIGMA_RAD**-2] * 3 + [SLAM_SIGMA_M**-2] * 3), (k, 1, 1))
    np.add.at(poses, image, by_image.transpose(0, 2, 1) @ by_image)
    mixed = _blocks(by_landmark.transpose(0, 2, 1) @ by_image, landmark, image, (n, k))
    pulls = -(_diagonal(np.asarray(np.linalg.inv(points), dtype=np.float64)) @ mixed)
    information = _diagonal(poses) + mixed.T @ pulls
    factor = scipy.sparse.linalg.splu(
        information.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.01, options={"SymmetricMode": True}
    )
    free = _similarities(scene_map)
    seen = np.bincount(image, minlength=k)
    held = free * np.repeat(seen >= min(MIN_OBSERVATIONS, np.median(seen)), 6)[:, None]
    held.reshape(k, 6, 7)[:, :3] = 0.0
    return MapWarp(_sigma_px(scene_map), pulls, factor, free, held)


def _derivatives(scene_map: SceneMap) -> tuple[Array, Array]:
    """Return the derivatives of every observation by its landmark (o, 2, 3) and by its image's pose (o, 2, 6)."""
    count = len(scene_map.observation_image)
    by_landmark, by_image = np.zeros((count, 2, 3)), np.zeros((count, 2, 6))
    for i, rows in observations_of(scene_map.observation_image, len(scene_map.image_names)):
        xyz = scene_map.xyz[scene_map.observation_landmark[rows]]
        pose = scene_map.map_from_image[i]
        by_landmark[rows] = projection_jacobian(xyz, pose, scene_map.image_cameras[i])
        by_point = by_landmark[rows] @ pose.rotation.as_matrix()
        turned = np.stack([skew(v) for v in pose.inv().apply(xyz)])
        by_image[rows] = np.concatenate([by_point @ turned, -by_point], axis=2)
    return by_landmark, by_image


def _similarities(scene_map: SceneMap) -> Array:
    """Return f64[6k, 7]: how images move when the map turns, shifts and grows about their mean position."""
    centres = np.stack([np.asarray(p.translation) for p in scene_map.map_from_image])
    result = np.zeros((len(centres), 6, 7))
    for i, offset in enumerate(centres - centres.mean(axis=0)):
        back = scene_map.map_from_image[i].rotation.as_matrix().T
        result[i, :3, :3] = back
        result[i, 3:, :3] = -back @ skew(offset)
        result[i, 3:, 3:6] = back
        result[i, 3:, 6] = back @ offset
    return result.reshape(-1, 7)


def _sigma_px(scene_map: SceneMap) -> float:
    errors = reprojection_errors(scene_map)
    errors = errors[np.isfinite(errors)]
    freedom = 2 * len(errors) - 3 * len(scene_map.xyz) - 6 * len(scene_map.image_names)
    return float(np.sqrt((errors**2).sum() / freedom)) if freedom > 0 else UNSHOWN_SIGMA_PX


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
