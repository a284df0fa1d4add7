"""The loops of pose refinement over all matches, compiled: they cost less than a dozen array passes each."""

from __future__ import annotations

import math

import numba
import numpy as np

# A point nearer than this, or behind the camera, counts as this deep.
MIN_DEPTH_M = 0.05


@numba.njit(cache=True, nogil=True)
def linearise(  # type: ignore[no-untyped-def]
    pixels,
    variance,
    xyz,
    covariance,
    focal_px,
    camera,
    rig_rotation,
    rig_position,
    rotation,
    position,
    rows,
    by_landmark,
):
    """Fill whitened ``rows`` f64[n, 2, 7] and ``by_landmark`` f64[n, 2, 3] of matches at a pose map_from_rig.

    Match n is seen by the camera ``camera[n]``, of which rig_from_cam is in ``rig_rotation`` f64[c, 3, 3] and
    ``rig_position`` f64[c, 3]; ``focal_px`` f64[n, 2]. A row is a residual's derivative by the right perturbation of
    the pose, rotation first (x_in_rig of map_from_rig * Exp(w, v) is x_in_rig + [x_in_rig]x w - v to first order), and
    the residual itself, whitened by its own 2x2 covariance: ``variance`` f64[n] (px^2) of the pixel plus the
    landmark's uncertainty in the image.
    """
    by_point = np.zeros((2, 3))
    by_rig = np.zeros((2, 3))
    spread = np.zeros((2, 2))
    x_in_rig = np.zeros(3)
    x_in_cam = np.zeros(3)
    for n in range(len(xyz)):
        turn, shift = rig_rotation[camera[n]], rig_position[camera[n]]
        for i in range(3):
            x_in_rig[i] = 0.0
            for k in range(3):
                x_in_rig[i] += rotation[k, i] * (xyz[n, k] - position[k])
        for i in range(3):
            x_in_cam[i] = 0.0
            for k in range(3):
                x_in_cam[i] += turn[k, i] * (x_in_rig[k] - shift[k])
        x, y = x_in_cam[0], x_in_cam[1]
        z = max(x_in_cam[2], MIN_DEPTH_M)
        fx, fy = focal_px[n, 0], focal_px[n, 1]
        by_point[0, 0] = fx / z
        by_point[1, 1] = fy / z
        by_point[0, 2] = -fx * x / (z * z)
        by_point[1, 2] = -fy * y / (z * z)
        for i in range(2):
            for k in range(3):
                by_rig[i, k] = by_point[i, 0] * turn[k, 0] + by_point[i, 1] * turn[k, 1] + by_point[i, 2] * turn[k, 2]
        for i in range(2):
            for k in range(3):
                by_landmark[n, i, k] = (
                    by_rig[i, 0] * rotation[k, 0] + by_rig[i, 1] * rotation[k, 1] + by_rig[i, 2] * rotation[k, 2]
                )
        for i in range(2):
            for j in range(i + 1):
                total = variance[n] if i == j else 0.0
                for k in range(3):
                    for m in range(3):
                        total += by_landmark[n, i, k] * covariance[n, k, m] * by_landmark[n, j, m]
                spread[i, j] = total
            # By [x]x: columns of the rotation part.
            rows[n, i, 0] = by_rig[i, 1] * x_in_rig[2] - by_rig[i, 2] * x_in_rig[1]
            rows[n, i, 1] = by_rig[i, 2] * x_in_rig[0] - by_rig[i, 0] * x_in_rig[2]
            rows[n, i, 2] = by_rig[i, 0] * x_in_rig[1] - by_rig[i, 1] * x_in_rig[0]
            rows[n, i, 3] = -by_rig[i, 0]
            rows[n, i, 4] = -by_rig[i, 1]
            rows[n, i, 5] = -by_rig[i, 2]
        rows[n, 0, 6] = x / z * fx - pixels[n, 0]
        rows[n, 1, 6] = y / z * fy - pixels[n, 1]
        first = math.sqrt(spread[0, 0])
        below = spread[1, 0] / first
        # Of a landmark with one long axis the difference is lost in rounding; it is not below the pixel's own noise.
        second = math.sqrt(max(spread[1, 1] - below * below, variance[n]))
        for k in range(7):
            rows[n, 0, k] /= first
            rows[n, 1, k] = (rows[n, 1, k] - below * rows[n, 0, k]) / second
        for k in range(3):
            by_landmark[n, 0, k] /= first
            by_landmark[n, 1, k] = (by_landmark[n, 1, k] - below * by_landmark[n, 0, k]) / second


@numba.njit(cache=True, nogil=True)
def cauchy_cost(rows, squared_scale):  # type: ignore[no-untyped-def]
    """Return the Cauchy cost of whitened rows: of residuals r, ``squared_scale`` log(1 + r^2 / squared_scale)."""
    cost = 0.0
    for n in range(len(rows)):
        squared = rows[n, 0, 6] * rows[n, 0, 6] + rows[n, 1, 6] * rows[n, 1, 6]
        cost += squared_scale * math.log1p(squared / squared_scale)
    return cost


@numba.njit(cache=True, nogil=True)
def refine(  # type: ignore[no-untyped-def]
    pixels,
    variance,
    xyz,
    covariance,
    focal_px,
    camera,
    rig_rotation,
    rig_position,
    rotation,
    position,
    squared_scale,
    iterations,
    rows,
    by_landmark,
):
    """Move ``rotation`` (3, 3) and ``position`` (3) to the least Cauchy cost by reweighted Gauss-Newton.

    Weights are 1 / (1 + r^2 / ``squared_scale``) of whitened residuals r; ``rows`` and ``by_landmark`` as of
    `linearise`.
    """
    information = np.zeros((6, 6))
    step = np.zeros(6)
    for _ in range(iterations):
        linearise(
            pixels, variance, xyz, covariance, focal_px, camera, rig_rotation, rig_position, rotation, position, rows,
            by_landmark,
        )  # fmt: skip
        information[:] = 0.0
        step[:] = 0.0
        for n in range(len(rows)):
            squared = rows[n, 0, 6] * rows[n, 0, 6] + rows[n, 1, 6] * rows[n, 1, 6]
            gain = 1.0 / (1.0 + squared / squared_scale)
            for i in range(6):
                a, b = gain * rows[n, 0, i], gain * rows[n, 1, i]
                step[i] -= a * rows[n, 0, 6] + b * rows[n, 1, 6]
                for j in range(i + 1):
                    information[i, j] += a * rows[n, 0, j] + b * rows[n, 1, j]
        _solve(information, step)
        largest = 0.0
        for i in range(6):
            largest = max(largest, abs(step[i]))
        for i in range(3):
            position[i] += rotation[i, 0] * step[3] + rotation[i, 1] * step[4] + rotation[i, 2] * step[5]
        _turn(rotation, step[0], step[1], step[2])
        if not largest > 1e-8:
            break


@numba.njit(cache=True, nogil=True)
def _solve(lower, step):  # type: ignore[no-untyped-def]
    """Solve in place by Cholesky's factorization of the lower triangle; what is not determined does not move."""
    for i in range(6):
        whole = lower[i, i]
        for j in range(i + 1):
            total = lower[i, j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i > j:
                lower[i, j] = total / lower[j, j]
            else:
                lower[i, i] = math.sqrt(total) if total > 1e-12 * whole and total > 0.0 else 1e15
    for i in range(6):
        for k in range(i):
            step[i] -= lower[i, k] * step[k]
        step[i] /= lower[i, i]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            step[i] -= lower[k, i] * step[k]
        step[i] /= lower[i, i]


@numba.njit(cache=True, nogil=True)
def _turn(rotation, x, y, z):  # type: ignore[no-untyped-def]
    """Multiply a rotation (3, 3) from the right by that of the rotation vector (x, y, z), in place: Rodrigues."""
    angle = math.sqrt(x * x + y * y + z * z)
    a = 1.0 - angle * angle / 6.0 if angle < 1e-4 else math.sin(angle) / angle
    b = 0.5 - angle * angle / 24.0 if angle < 1e-4 else (1.0 - math.cos(angle)) / (angle * angle)
    for i in range(3):
        r0, r1, r2 = rotation[i, 0], rotation[i, 1], rotation[i, 2]
        # r [v]x, and that once more
        c0, c1, c2 = r1 * z - r2 * y, r2 * x - r0 * z, r0 * y - r1 * x
        d0, d1, d2 = c1 * z - c2 * y, c2 * x - c0 * z, c0 * y - c1 * x
        rotation[i, 0] = r0 + a * c0 + b * d0
        rotation[i, 1] = r1 + a * c1 + b * d1
        rotation[i, 2] = r2 + a * c2 + b * d2
