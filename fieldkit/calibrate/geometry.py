"""Arrays of the joint problem: poses that move on their manifold, and image points with their noise."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from fieldkit.cameras import Camera
from fieldkit.frames import Array, Pose

# A point nearer than this, or behind the camera, counts as this deep
MIN_DEPTH_M = 0.05


@dataclasses.dataclass(frozen=True)
class Poses:
    """n poses map_from_x as arrays: rotation f64[n, 3, 3], position f64[n, 3] in m."""

    rotation: Array
    position: Array

    @staticmethod
    def of(poses: Sequence[Pose]) -> Poses:
        """Stack poses."""
        if not poses:
            return Poses(np.zeros((0, 3, 3)), np.zeros((0, 3)))
        return Poses(
            np.stack([p.rotation.as_matrix() for p in poses]), np.stack([np.asarray(p.translation) for p in poses])
        )

    def __len__(self) -> int:
        return len(self.position)

    def __getitem__(self, rows: slice | NDArray[Any]) -> Poses:
        return Poses(self.rotation[rows], self.position[rows])

    def pose(self, index: int) -> Pose:
        """Return one of them."""
        return Pose.from_components(self.position[index], Rotation.from_matrix(self.rotation[index]))

    def moved(self, step: Array) -> Poses:
        """Return T * Exp(d) for every row d (6,) of ``step`` f64[n, 6]: rotation, then translation."""
        if not len(self):
            return self
        turn = Rotation.from_rotvec(step[:, :3]).as_matrix()
        return Poses(self.rotation @ turn, self.position + np.einsum("nij,nj->ni", self.rotation, step[:, 3:]))

    def difference(self, others: Poses) -> Array:
        """Return f64[n, 6]: the d with self * Exp(d) = others."""
        if not len(self):
            return np.zeros((0, 6))
        back = self.rotation.transpose(0, 2, 1)
        turn = Rotation.from_matrix(back @ others.rotation).as_rotvec()
        return np.concatenate([turn, np.einsum("nij,nj->ni", back, others.position - self.position)], axis=1)


@dataclasses.dataclass(frozen=True)
class Bearings:
    """n image points without distortion: xy f64[n, 2] at depth 1, and whitening f64[n, 2, 2].

    ``whitening`` turns a small difference of xy into standard deviations of the pixel's noise.
    """

    xy: Array
    whitening: Array

    def __getitem__(self, rows: slice | NDArray[Any]) -> Bearings:
        return Bearings(self.xy[rows], self.whitening[rows])


def bearings(camera: Camera, pixels: ArrayLike, sigma_px: float) -> Bearings:
    """Return pixels (n, 2) of a camera, with ``sigma_px`` of noise per axis in the distorted image, as Bearings."""
    xy, slope = _unbent(camera, pixels)
    return Bearings(xy, slope / sigma_px)


def corner_bearings(camera: Camera, corners_px: Array, noise_px: Array) -> tuple[Array, Array]:
    """Return corners (4, 2) of a tag as bearings (4, 2), and the whitening f64[8, 8] of their covariance (8, 8)."""
    xy, slope = _unbent(camera, corners_px)
    whitening = np.linalg.inv(np.linalg.cholesky(noise_px))
    return xy, np.asarray(whitening @ scipy.linalg.block_diag(*slope), dtype=np.float64)


def _unbent(camera: Camera, pixels: ArrayLike) -> tuple[Array, Array]:
    """Return pixels (n, 2) as bearings xy (n, 2), and the derivative (n, 2, 2) of pixels by xy."""
    xy, step = camera.unproject(pixels)[:, :2], 1e-6
    columns = [
        (camera.distort(xy + shift) - camera.distort(xy - shift)) / (2 * step) * camera.focal_px
        for shift in ((step, 0.0), (0.0, step))
    ]
    return xy, np.stack(columns, axis=2)


def skews(v: Array) -> Array:
    """Return f64[n, 3, 3], the matrices of the cross product with v (n, 3)."""
    result = np.zeros((len(v), 3, 3))
    result[:, 0, 1], result[:, 0, 2], result[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return result - result.transpose(0, 2, 1)


def project(x_in_cam: Array) -> tuple[Array, Array]:
    """Return xy (n, 2) of points (n, 3) in their cameras and its derivative (n, 2, 3)."""
    z = np.maximum(x_in_cam[:, 2], MIN_DEPTH_M)
    xy = x_in_cam[:, :2] / z[:, None]
    derivative = np.zeros((len(z), 2, 3))
    derivative[:, 0, 0] = derivative[:, 1, 1] = 1.0 / z
    derivative[:, :, 2] = -xy / z[:, None]
    return xy, derivative
