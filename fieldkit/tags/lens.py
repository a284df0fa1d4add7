"""Pixels with and without the lens's distortion, where straight edges are straight."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fieldkit.cameras import Camera

Array = NDArray[np.float64]


def flatten(camera: Camera, pixels: Array) -> Array:
    """Return pixels (n, 2) without distortion: in units of pixels, about the principal point."""
    flat: Array = camera.unproject(pixels)[:, :2] * camera.focal_px
    return flat


def bend(camera: Camera, flat: Array) -> Array:
    """Return undistorted pixels (n, 2), about the principal point, where the lens puts them in the image."""
    bent: Array = camera.distort(flat / camera.focal_px) * camera.focal_px + camera.centre_px
    return bent


def bend_slope(camera: Camera, flat: Array) -> Array:
    """Return the derivative (n, 2, 2) of pixels in the image by undistorted pixels (n, 2)."""
    step = 1e-3
    columns = [(bend(camera, flat + s) - bend(camera, flat - s)) / (2 * step) for s in ((step, 0.0), (0.0, step))]
    return np.stack(columns, axis=2)


def flat_covariance(camera: Camera, pixels: Array, covariance: Array) -> Array:
    """Carry the covariance (2n, 2n) of pixels (n, 2) in the image to undistorted pixels."""
    inverse: Array = np.linalg.inv(bend_slope(camera, flatten(camera, pixels))).astype(np.float64)
    return _carry(inverse, covariance)


def bent_covariance(camera: Camera, flat: Array, covariance: Array) -> Array:
    """Carry the covariance (2n, 2n) of undistorted pixels (n, 2) to pixels in the image."""
    return _carry(bend_slope(camera, flat), covariance)


def _carry(slopes: Array, covariance: Array) -> Array:
    n = len(slopes)
    blocks = covariance.reshape(n, 2, n, 2)
    carried: Array = np.einsum("iab,ibjc,jdc->iajd", slopes, blocks, slopes).reshape(2 * n, 2 * n)
    return carried
