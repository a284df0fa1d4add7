"""The sums of pose refinement over all matches, compiled: a loop over points costs less than a dozen array passes."""

from __future__ import annotations

import math

import numba
import numpy as np

# A point nearer than this, or behind the camera, counts as this deep.
MIN_DEPTH_M = 0.05
NOISE_PX = 1.0


@numba.njit(cache=True, nogil=True)
def normal_equations(pixels, xyz, covariance, focal_px, rotation, position):  # type: ignore[no-untyped-def]
    """Return information f64[6, 6], gradient f64[6] and Cauchy cost of matches at a pose map_from_cam.

    A residual is whitened by its own 2x2 covariance: the pixel's noise plus the landmark's uncertainty projected into
    the image. Jacobians are by the right perturbation, rotation first: x_in_cam of map_from_cam * Exp(w, v) is
    x_in_cam + [x_in_cam]x w - v to first order.
    """
    information = np.zeros((6, 6))
    gradient = np.zeros(6)
    cost = 0.0
    by_point = np.zeros((2, 3))
    by_landmark = np.zeros((2, 3))
    spread = np.zeros((2, 2))
    rows = np.zeros((2, 7))
    for n in range(len(xyz)):
        a = xyz[n, 0] - position[0]
        b = xyz[n, 1] - position[1]
        c = xyz[n, 2] - position[2]
        x = rotation[0, 0] * a + rotation[1, 0] * b + rotation[2, 0] * c
        y = rotation[0, 1] * a + rotation[1, 1] * b + rotation[2, 1] * c
        depth = rotation[0, 2] * a + rotation[1, 2] * b + rotation[2, 2] * c
        z = max(depth, MIN_DEPTH_M)
        by_point[0, 0] = focal_px[0] / z
        by_point[1, 1] = focal_px[1] / z
        by_point[0, 2] = -focal_px[0] * x / (z * z)
        by_point[1, 2] = -focal_px[1] * y / (z * z)
        for i in range(2):
            for k in range(3):
                by_landmark[i, k] = (
                    by_point[i, 0] * rotation[k, 0] + by_point[i, 1] * rotation[k, 1] + by_point[i, 2] * rotation[k, 2]
                )
        for i in range(2):
            for j in range(2):
                total = NOISE_PX * NOISE_PX if i == j else 0.0
                for k in range(3):
                    for m in range(3):
                        total += by_landmark[i, k] * covariance[n, k, m] * by_landmark[j, m]
                spread[i, j] = total
            # By [x]x: columns of the rotation part.
            rows[i, 0] = by_point[i, 1] * depth - by_point[i, 2] * y
            rows[i, 1] = by_point[i, 2] * x - by_point[i, 0] * depth
            rows[i, 2] = by_point[i, 0] * y - by_point[i, 1] * x
            rows[i, 3] = -by_point[i, 0]
            rows[i, 4] = -by_point[i, 1]
            rows[i, 5] = -by_point[i, 2]
        rows[0, 6] = x / z * focal_px[0] - pixels[n, 0]
        rows[1, 6] = y / z * focal_px[1] - pixels[n, 1]
        first = math.sqrt(spread[0, 0])
        below = spread[1, 0] / first
        second = math.sqrt(spread[1, 1] - below * below)
        for k in range(7):
            rows[0, k] /= first
            rows[1, k] = (rows[1, k] - below * rows[0, k]) / second
        squared = rows[0, 6] * rows[0, 6] + rows[1, 6] * rows[1, 6]
        gain = 1.0 / (1.0 + squared)
        cost += math.log1p(squared)
        for i in range(6):
            gradient[i] += gain * (rows[0, i] * rows[0, 6] + rows[1, i] * rows[1, 6])
            for j in range(6):
                information[i, j] += gain * (rows[0, i] * rows[0, j] + rows[1, i] * rows[1, j])
    return information, gradient, cost
