"""Numba kernels that find the clusters of triangles an image may show, nearest first, and set up their triangles.

A triangle is rasterised in 2-D homogeneous coordinates (Olano and Greer, "Triangle scan conversion using 2D
homogeneous coordinates", 1997), so nothing is clipped. With p_i = K x_i the edge functions are e_0 = p_1 x p_2 and
cyclically; a pixel q = (u, v, 1) lies inside when all e_i . q have the sign of det [p_0 p_1 p_2], and there
1 / z = sum(e_i) . q / det.
Two triangles that share an edge compute exactly negated edge functions, so no sample falls between them.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_bridge.rendering.kernels import inlined, inner, kernel

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int32]
Longs = NDArray[np.int64]
Flags = NDArray[np.bool_]

TILE_W, TILE_H = 32, 16
NEAR_M = 1e-3
# Projections further out than this many pixels are as good as there.
_FAR_OUT = 1e6
# Samples lie at multiples of 1/8 px: what spans none of them along an axis covers no sample.
_GRID, _GRID_SLACK = 8.0, 1e-5


class Mesh(NamedTuple):
    """A scene's faces as kernels take them, in the order of its clusters: see `sim_bridge.mesh.Scene`."""

    vertices: Floats
    faces: Ints
    closed: Flags
    uv: Singles
    shade: Singles
    texture: Ints
    order: Ints
    starts: Longs


class View(NamedTuple):
    """K cam_from_world f64[3,4] and the size of the image."""

    matrix: Floats
    width: int
    height: int


class Set(NamedTuple):
    """Triangles that are set up: edges and 1/z (four times a, b, c of a*x + b*y + c) and room for u/z, v/z and
    shade/z f64[k,21]; the first and last pixel column and row i32[k,4] (x0, y0, x1, y1); the largest 1/z f64[k]; the
    index of the face i32[k]; and its texture i32[k], -1 until the room is filled."""

    planes: Floats
    boxes: Ints
    near: Floats
    face: Ints
    texture: Ints


@kernel
def visible(boxes: Floats, view: View) -> tuple[Ints, Ints, Floats]:
    """Return the boxes (lowest, highest corner: f64[c,6]) that may be in the image: index i32[k], the pixels each
    may touch i32[k,4] (x0, y0, x1, y1) and the largest 1/z in it f64[k]."""
    m, width, height = view.matrix, view.width, view.height
    count = boxes.shape[0]
    index, bounds, near = np.empty(count, np.int32), np.empty((count, 4), np.int32), np.empty(count)
    k = 0
    for c in range(count):
        x0, y0, x1, y1 = np.inf, np.inf, -np.inf, -np.inf
        left = right = above = below = True
        z_min, z_max = np.inf, -np.inf
        for i in range(8):
            x, y, z = boxes[c, 3 * (i & 1)], boxes[c, 1 + 3 * (i >> 1 & 1)], boxes[c, 2 + 3 * (i >> 2)]
            px = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
            py = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
            pz = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
            z_min, z_max = min(z_min, pz), max(z_max, pz)
            left, right = left and px < 0.0, right and px > width * pz
            above, below = above and py < 0.0, below and py > height * pz
            if pz >= NEAR_M:
                x0, x1, y0, y1 = min(x0, px / pz), max(x1, px / pz), min(y0, py / pz), max(y1, py / pz)
        if z_max < NEAR_M or left or right or above or below:
            continue
        whole = z_min < NEAR_M
        index[k] = c
        near[k] = np.inf if whole else (1.0 + 1e-12) / z_min
        bounds[k, 0] = 0 if whole else math.floor(min(max(x0, 0.0), width - 1.0))
        bounds[k, 1] = 0 if whole else math.floor(min(max(y0, 0.0), height - 1.0))
        bounds[k, 2] = width - 1 if whole else math.floor(min(max(x1, 0.0), width - 1.0))
        bounds[k, 3] = height - 1 if whole else math.floor(min(max(y1, 0.0), height - 1.0))
        k += 1
    return index[:k].copy(), bounds[:k].copy(), near[:k].copy()


@kernel
def bin_tiles(bounds: Ints, across: int, down: int) -> tuple[Longs, Ints]:
    """Sort boxes i32[k,4] into tiles, keeping their order: starts i64[tiles+1] and the list of boxes i32[...]."""
    starts = np.zeros(across * down + 1, np.int64)
    fill = np.zeros(across * down, np.int64)
    members = np.empty(0, np.int32)
    for step in range(2):
        for k in range(bounds.shape[0]):
            for ty in range(bounds[k, 1] // TILE_H, bounds[k, 3] // TILE_H + 1):
                for tx in range(bounds[k, 0] // TILE_W, bounds[k, 2] // TILE_W + 1):
                    tile = ty * across + tx
                    if step == 0:
                        starts[tile + 1] += 1
                    else:
                        members[fill[tile]] = k
                        fill[tile] += 1
        if step == 0:
            for tile in range(across * down):
                starts[tile + 1] += starts[tile]
                fill[tile] = starts[tile]
            members = np.empty(starts[across * down], np.int32)
    return starts, members


@inlined
def _bounds(p: Floats) -> tuple[float, float, float, float]:
    """Return the pixel bounds (x0, y0, x1, y1) of the part of a triangle f64[3,3] beyond the near plane."""
    x0, y0, x1, y1 = np.inf, np.inf, -np.inf, -np.inf
    for a in range(3):
        b = (a + 1) % 3
        za, zb = p[a, 2], p[b, 2]
        if za >= NEAR_M:
            x, y = p[a, 0] / za, p[a, 1] / za
            x0, x1, y0, y1 = min(x0, x), max(x1, x), min(y0, y), max(y1, y)
        if (za < NEAR_M) != (zb < NEAR_M):
            s = (NEAR_M - za) / (zb - za)
            x = (p[a, 0] + s * (p[b, 0] - p[a, 0])) / NEAR_M
            y = (p[a, 1] + s * (p[b, 1] - p[a, 1])) / NEAR_M
            x0, x1, y0, y1 = min(x0, x), max(x1, x), min(y0, y), max(y1, y)
    return max(x0, -_FAR_OUT), max(y0, -_FAR_OUT), min(x1, _FAR_OUT), min(y1, _FAR_OUT)


@inlined
def _covers_none(low: float, high: float, size: float) -> bool:
    """Return whether no sample's column (or row) of 0..size lies between two pixel positions."""
    if high < 0.0 or low >= size:
        return True
    return high - low < 1.0 and math.ceil(low * _GRID - _GRID_SLACK) > math.floor(high * _GRID + _GRID_SLACK)


@inner
def set_up(mesh: Mesh, cluster: int, view: View, out: Set, first: int, p: Floats) -> int:
    """Set up the triangles of a cluster that may touch the image, from place ``first`` of ``out``.

    p f64[3,3] is room for the corners. Returns the first place that is still free.
    """
    m, width, height = view.matrix, view.width, view.height
    k = first
    for at in range(mesh.starts[cluster], mesh.starts[cluster + 1]):
        f = mesh.order[at]
        for i in range(3):
            vertex = mesh.faces[f, i]
            x, y, z = mesh.vertices[vertex, 0], mesh.vertices[vertex, 1], mesh.vertices[vertex, 2]
            for r in range(3):
                p[i, r] = m[r, 0] * x + m[r, 1] * y + m[r, 2] * z + m[r, 3]
        z_min, z_max = min(p[0, 2], p[1, 2], p[2, 2]), max(p[0, 2], p[1, 2], p[2, 2])
        a0, b0, c0 = _cross(p, 1, 2)
        det = p[0, 0] * a0 + p[0, 1] * b0 + p[0, 2] * c0
        if z_max < NEAR_M or det == 0.0 or (mesh.closed[f] and det < 0.0):
            continue
        x0, y0, x1, y1 = _bounds(p)
        if _covers_none(x0, x1, width) or _covers_none(y0, y1, height):
            continue
        a1, b1, c1 = _cross(p, 2, 0)
        a2, b2, c2 = _cross(p, 0, 1)
        sign = 1.0 if det > 0.0 else -1.0
        size = abs(det)
        plane = out.planes[k]
        plane[0], plane[1], plane[2] = sign * a0, sign * b0, sign * c0
        plane[3], plane[4], plane[5] = sign * a1, sign * b1, sign * c1
        plane[6], plane[7], plane[8] = sign * a2, sign * b2, sign * c2
        for j in range(3):
            plane[9 + j] = (plane[j] + plane[3 + j] + plane[6 + j]) / size
        out.boxes[k, 0] = max(0, math.floor(x0))
        out.boxes[k, 1] = max(0, math.floor(y0))
        out.boxes[k, 2] = min(width - 1, math.floor(x1))
        out.boxes[k, 3] = min(height - 1, math.floor(y1))
        out.near[k] = np.inf if z_min < NEAR_M else (1.0 + 1e-12) / z_min
        out.face[k] = f
        out.texture[k] = -1
        k += 1
    return k


@inlined
def _cross(p: Floats, s: int, t: int) -> tuple[float, float, float]:
    return (
        p[s, 1] * p[t, 2] - p[s, 2] * p[t, 1],
        p[s, 2] * p[t, 0] - p[s, 0] * p[t, 2],
        p[s, 0] * p[t, 1] - p[s, 1] * p[t, 0],
    )
