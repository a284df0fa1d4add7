"""Compiled loops of a query: sums over its matches, and words of its descriptors. No BLAS: its threads would wait."""

from __future__ import annotations

import math

import numba
import numpy as np

# A point nearer than this, or behind the camera, counts as this deep.
MIN_DEPTH_M = 0.05


@numba.njit(cache=True, nogil=True)
def linearise(pixels, xyz, covariance, focal_px, variance, rotation, position, rows, by_landmark):  # type: ignore[no-untyped-def]
    """Fill whitened ``rows`` f64[n, 2, 7] and ``by_landmark`` f64[n, 2, 3] of matches at a pose map_from_cam.

    A row is a residual's derivative by the right perturbation of the pose, rotation first (x_in_cam of
    map_from_cam * Exp(w, v) is x_in_cam + [x_in_cam]x w - v to first order), and the residual itself, whitened by its
    own 2x2 covariance: ``variance`` f64[n] (px^2) of the pixel plus the landmark's uncertainty in the image.
    """
    by_point = np.zeros((2, 3))
    spread = np.zeros((2, 2))
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
                by_landmark[n, i, k] = (
                    by_point[i, 0] * rotation[k, 0] + by_point[i, 1] * rotation[k, 1] + by_point[i, 2] * rotation[k, 2]
                )
        for i in range(2):
            for j in range(2):
                total = variance[n] if i == j else 0.0
                for k in range(3):
                    for m in range(3):
                        total += by_landmark[n, i, k] * covariance[n, k, m] * by_landmark[n, j, m]
                spread[i, j] = total
            # By [x]x: columns of the rotation part.
            rows[n, i, 0] = by_point[i, 1] * depth - by_point[i, 2] * y
            rows[n, i, 1] = by_point[i, 2] * x - by_point[i, 0] * depth
            rows[n, i, 2] = by_point[i, 0] * y - by_point[i, 1] * x
            rows[n, i, 3] = -by_point[i, 0]
            rows[n, i, 4] = -by_point[i, 1]
            rows[n, i, 5] = -by_point[i, 2]
        rows[n, 0, 6] = x / z * focal_px[0] - pixels[n, 0]
        rows[n, 1, 6] = y / z * focal_px[1] - pixels[n, 1]
        first = math.sqrt(spread[0, 0])
        below = spread[1, 0] / first
        second = math.sqrt(spread[1, 1] - below * below)
        for k in range(7):
            rows[n, 0, k] /= first
            rows[n, 1, k] = (rows[n, 1, k] - below * rows[n, 0, k]) / second
        for k in range(3):
            by_landmark[n, 0, k] /= first
            by_landmark[n, 1, k] = (by_landmark[n, 1, k] - below * by_landmark[n, 0, k]) / second


@numba.njit(cache=True, nogil=True)
def weighted_sums(rows, squared_scale, information, gradient):  # type: ignore[no-untyped-def]
    """Add Cauchy weighted information (6, 6) and gradient (6,) of whitened rows; return their Cauchy cost.

    Weights are 1 / (1 + r^2 / ``squared_scale``).
    """
    cost = 0.0
    for n in range(len(rows)):
        squared = rows[n, 0, 6] * rows[n, 0, 6] + rows[n, 1, 6] * rows[n, 1, 6]
        gain = 1.0 / (1.0 + squared / squared_scale)
        cost += squared_scale * math.log1p(squared / squared_scale)
        for i in range(6):
            gradient[i] += gain * (rows[n, 0, i] * rows[n, 0, 6] + rows[n, 1, i] * rows[n, 1, 6])
            for j in range(6):
                information[i, j] += gain * (rows[n, 0, i] * rows[n, 0, j] + rows[n, 1, i] * rows[n, 1, j])
    return cost
