"""Numba kernels that bend a pinhole image into one of a camera with lens distortion."""

import math

import numpy as np
from numba import prange
from numpy.typing import NDArray

from sim_bridge.rendering.kernels import kernel, parallel_kernel

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int32]
Bytes = NDArray[np.uint8]


@kernel
def _lagrange(t: float) -> tuple[float, float, float, float]:
    """Return the weights of four nodes at -1, 0, 1, 2 for a position t in 0..1: exact for cubics."""
    return (
        -t * (t - 1.0) * (t - 2.0) / 6.0,
        (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0,
        -(t + 1.0) * t * (t - 2.0) / 2.0,
        (t + 1.0) * t * (t - 1.0) / 6.0,
    )


@kernel
def _keys(t: float) -> tuple[float, float, float, float]:
    """Return the weights of the cubic convolution of Keys (1981), a = -1/2, for a position t in 0..1."""
    return (
        ((-0.5 * t + 1.0) * t - 0.5) * t,
        (1.5 * t - 2.5) * t * t + 1.0,
        ((-1.5 * t + 2.0) * t + 0.5) * t,
        (0.5 * t - 0.5) * t * t,
    )


@kernel
def _row_map(nodes: Floats, step: int, y: int) -> Floats:
    """Return the nodes of a row y, interpolated between the rows of nodes: f64[cols,2]."""
    first = y // step
    w = _lagrange((y - first * step) / step)
    out = np.zeros((nodes.shape[1], 2))
    for k in range(4):
        for i in range(nodes.shape[1]):
            out[i, 0] += w[k] * nodes[first + k, i, 0]
            out[i, 1] += w[k] * nodes[first + k, i, 1]
    return out


@kernel
def _depth_at(x: float, y: float, seen: Ints, planes: Floats) -> float:
    """Return the exact depth at a pinhole pixel position: the nearest triangle there of those seen around it."""
    col, row = math.floor(x - 0.5), math.floor(y - 0.5)
    best = 0.0
    for dy in range(2):
        for dx in range(2):
            k = seen[row + dy, col + dx]
            if k < 0:
                continue
            p = planes[k]
            inside = True
            for i in range(3):
                inside = inside and p[3 * i] * x + p[3 * i + 1] * y + p[3 * i + 2] >= 0.0
            w = p[9] * x + (p[10] * y + p[11])
            if inside and w > best:
                best = w
    if best == 0.0:
        k = seen[int(y), int(x)]
        best = planes[k, 9] * x + (planes[k, 10] * y + planes[k, 11]) if k >= 0 else 0.0
    return 1.0 / best if best > 0.0 else 0.0


@parallel_kernel
def bend(
    rgb: Bytes, seen: Ints, planes: Floats, nodes: Floats, step: int, width: int, height: int
) -> tuple[Bytes, Singles]:
    """Resample a pinhole image by cubic convolution: rgb u8[h,w,3] and exact depth f32[h,w].

    rgb u8[hp,wp,3] and seen i32[hp,wp] (triangle at the pixel centre) are the pinhole's; planes f64[k,21] the
    triangles'; nodes f64[r,c,2] pinhole pixel positions of every step-th pixel centre of the bent image, from one
    step before its first to two steps after its last.
    """
    out = np.empty((height, width, 3), np.uint8)
    depth = np.empty((height, width), np.float32)
    for y in prange(height):
        line = _row_map(nodes, step, y)
        for x in range(width):
            first = x // step
            w = _lagrange((x - first * step) / step)
            u = w[0] * line[first, 0] + w[1] * line[first + 1, 0] + w[2] * line[first + 2, 0]
            v = w[0] * line[first, 1] + w[1] * line[first + 1, 1] + w[2] * line[first + 2, 1]
            u += w[3] * line[first + 3, 0]
            v += w[3] * line[first + 3, 1]
            col, row = math.floor(u - 0.5), math.floor(v - 0.5)
            wx, wy = _keys(u - 0.5 - col), _keys(v - 0.5 - row)
            red = green = blue = 0.0
            for j in range(4):
                for i in range(4):
                    weight = wx[i] * wy[j]
                    red += weight * rgb[row + j - 1, col + i - 1, 0]
                    green += weight * rgb[row + j - 1, col + i - 1, 1]
                    blue += weight * rgb[row + j - 1, col + i - 1, 2]
            out[y, x, 0] = np.uint8(min(max(red + 0.5, 0.0), 255.0))
            out[y, x, 1] = np.uint8(min(max(green + 0.5, 0.0), 255.0))
            out[y, x, 2] = np.uint8(min(max(blue + 0.5, 0.0), 255.0))
            depth[y, x] = _depth_at(u, v, seen, planes)
    return out, depth
