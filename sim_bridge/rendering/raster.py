"""Numba kernels of the rasteriser: triangle setup, binning, visibility and texturing of pinhole images.

A triangle is rasterised in 2-D homogeneous coordinates (Olano and Greer, "Triangle scan conversion using 2D
homogeneous coordinates", 1997), so nothing is clipped. With p_i = K x_i the edge functions are e_0 = p_1 x p_2 and
cyclically; a pixel q = (u, v, 1) lies inside when all e_i . q have the sign of det [p_0 p_1 p_2], and there
1 / z = sum(e_i) . q / det.
Two triangles that share an edge compute exactly negated edge functions, so no sample falls between them.

fastmath stays off and every tile is written by one thread alone: any number of threads gives the same bits.
"""

import math

import numpy as np
from numba import prange
from numpy.typing import NDArray

from sim_bridge.rendering.kernels import kernel, parallel_kernel

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int32]
Longs = NDArray[np.int64]
Bytes = NDArray[np.uint8]
Words = NDArray[np.uint32]
Flags = NDArray[np.bool_]
Tile = tuple[int, int, int, int]
Colour = tuple[float, float, float]

TILE = 32
NEAR_M = 1e-3
MAX_TAPS = 8
# A level of detail half a level finer than the footprint asks for: 2 ** -0.5.
LOD_FACTOR = 0.7071067811865476
# Taps are the rounded-up ratio of the footprint's axes, but a quarter too long still gets no further tap.
_TAP_ROUNDING = 0.75

# The rotated grid, then the centre: sample k of a pixel lies at its centre plus (DX[k], DY[k]).
_DX = (-0.125, 0.375, 0.125, -0.375, 0.0)
_DY = (-0.375, -0.125, 0.375, 0.125, 0.0)
# No sample lies further than this from the pixel centre along either axis.
_REACH = 0.375


@kernel
def _transform(vertices: Floats, matrix: Floats) -> Floats:
    out = np.empty((vertices.shape[0], 3))
    for i in range(vertices.shape[0]):
        x, y, z = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        for r in range(3):
            out[i, r] = matrix[r, 0] * x + matrix[r, 1] * y + matrix[r, 2] * z + matrix[r, 3]
    return out


@kernel
def _bounds(p: Floats, face: Ints, limit: float) -> tuple[float, float, float, float]:
    """Return the pixel bounds (x0, y0, x1, y1) of the part of a triangle beyond the near plane."""
    x0, y0, x1, y1 = np.inf, np.inf, -np.inf, -np.inf
    for i in range(3):
        a = face[i]
        b = face[(i + 1) % 3]
        za, zb = p[a, 2], p[b, 2]
        if za >= NEAR_M:
            x, y = p[a, 0] / za, p[a, 1] / za
            x0, x1, y0, y1 = min(x0, x), max(x1, x), min(y0, y), max(y1, y)
        if (za < NEAR_M) != (zb < NEAR_M):
            s = (NEAR_M - za) / (zb - za)
            x = (p[a, 0] + s * (p[b, 0] - p[a, 0])) / NEAR_M
            y = (p[a, 1] + s * (p[b, 1] - p[a, 1])) / NEAR_M
            x0, x1, y0, y1 = min(x0, x), max(x1, x), min(y0, y), max(y1, y)
    return max(x0, -limit), max(y0, -limit), min(x1, limit), min(y1, limit)


@kernel
def setup(
    vertices: Floats,
    faces: Ints,
    closed: Flags,
    uv: Singles,
    shade: Singles,
    matrix: Floats,
    width: int,
    height: int,
) -> tuple[Floats, Ints, Ints]:
    """Set up the triangles that may touch the image.

    vertices f64[n,3]; faces i32[m,3]; closed bool[m]; uv f32[m,3,2]; shade f32[m,3];
    matrix f64[3,4] = K cam_from_world.
    Returns planes f64[k,21] (three edges, 1/z, u/z, v/z, shade/z; each a, b, c of a*x + b*y + c), boxes i32[k,4]
    (first and last pixel column and row: x0, y0, x1, y1) and the index of the face i32[k].
    """
    p = _transform(vertices, matrix)
    m = faces.shape[0]
    planes = np.empty((m, 21))
    boxes = np.empty((m, 4), np.int32)
    source = np.empty(m, np.int32)
    edges = np.empty((3, 3))
    k = 0
    limit = 1e6
    for f in range(m):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if p[a, 2] < NEAR_M and p[b, 2] < NEAR_M and p[c, 2] < NEAR_M:
            continue
        x0, y0, x1, y1 = _bounds(p, faces[f], limit)
        if x1 < 0.0 or y1 < 0.0 or x0 >= width or y0 >= height:
            continue
        for i in range(3):
            s, t = faces[f, (i + 1) % 3], faces[f, (i + 2) % 3]
            edges[i, 0] = p[s, 1] * p[t, 2] - p[s, 2] * p[t, 1]
            edges[i, 1] = p[s, 2] * p[t, 0] - p[s, 0] * p[t, 2]
            edges[i, 2] = p[s, 0] * p[t, 1] - p[s, 1] * p[t, 0]
        det = p[a, 0] * edges[0, 0] + p[a, 1] * edges[0, 1] + p[a, 2] * edges[0, 2]
        if det == 0.0 or (closed[f] and det < 0.0):
            continue
        sign = 1.0 if det > 0.0 else -1.0
        size = abs(det)
        for j in range(3):
            e0, e1, e2 = sign * edges[0, j], sign * edges[1, j], sign * edges[2, j]
            planes[k, j] = e0
            planes[k, 3 + j] = e1
            planes[k, 6 + j] = e2
            planes[k, 9 + j] = (e0 + e1 + e2) / size
            planes[k, 12 + j] = (e0 * uv[f, 0, 0] + e1 * uv[f, 1, 0] + e2 * uv[f, 2, 0]) / size
            planes[k, 15 + j] = (e0 * uv[f, 0, 1] + e1 * uv[f, 1, 1] + e2 * uv[f, 2, 1]) / size
            planes[k, 18 + j] = (e0 * shade[f, 0] + e1 * shade[f, 1] + e2 * shade[f, 2]) / size
        boxes[k, 0] = max(0, math.floor(x0))
        boxes[k, 1] = max(0, math.floor(y0))
        boxes[k, 2] = min(width - 1, math.floor(x1))
        boxes[k, 3] = min(height - 1, math.floor(y1))
        source[k] = f
        k += 1
    return planes[:k].copy(), boxes[:k].copy(), source[:k].copy()


@kernel
def _misses(plane: Floats, x0: float, y0: float, x1: float, y1: float) -> bool:
    """Return whether a triangle lies wholly outside a rectangle, judged by its edges (may return False for a miss)."""
    for i in range(3):
        a, b, c = plane[3 * i], plane[3 * i + 1], plane[3 * i + 2]
        x = x1 if a > 0.0 else x0
        y = y1 if b > 0.0 else y0
        if a * x + b * y + c < 0.0:
            return True
    return False


@kernel
def bin_tiles(planes: Floats, boxes: Ints, width: int, height: int) -> tuple[Longs, Ints]:
    """Sort triangles into tiles, in the order of the faces: starts i64[tiles+1] and the triangle list i32[...]."""
    across = (width + TILE - 1) // TILE
    down = (height + TILE - 1) // TILE
    starts = np.zeros(across * down + 1, np.int64)
    fill = np.zeros(across * down, np.int64)
    members = np.empty(0, np.int32)
    for step in range(2):
        for k in range(boxes.shape[0]):
            tx0, tx1 = boxes[k, 0] // TILE, boxes[k, 2] // TILE
            ty0, ty1 = boxes[k, 1] // TILE, boxes[k, 3] // TILE
            many = tx1 > tx0 or ty1 > ty0
            for ty in range(ty0, ty1 + 1):
                for tx in range(tx0, tx1 + 1):
                    x, y = float(tx * TILE), float(ty * TILE)
                    if many and _misses(planes[k], x, y, x + TILE, y + TILE):
                        continue
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


@kernel
def _floor(value: float, low: int, high: int) -> int:
    """Round down into low..high; clamped first, since a huge value has no whole number."""
    return low if value <= low else high if value >= high else math.floor(value)


@kernel
def _ceil(value: float, low: int, high: int) -> int:
    """Round up into low..high."""
    return low if value <= low else high if value >= high else math.ceil(value)


@kernel
def _row_spans(plane: Floats, y: float, first: int, stop: int) -> tuple[int, int, int, int]:
    """Return columns [lo, hi) a triangle may touch in the row at y, and [inner_lo, inner_hi) it covers wholly."""
    lo, hi, inner_lo, inner_hi = first, stop, first, stop
    for i in range(3):
        a, b = plane[3 * i], plane[3 * i + 1]
        r = b * y + plane[3 * i + 2]
        m = _REACH * (abs(a) + abs(b))
        if a > 0.0:
            lo = max(lo, _floor((-r - m) / a - 0.5 - 1e-6, first, stop))
            inner_lo = max(inner_lo, _ceil((-r + m) / a - 0.5 + 1e-6, first, stop))
        elif a < 0.0:
            hi = min(hi, _floor((-r - m) / a + 0.5 + 1e-6, first, stop))
            inner_hi = min(inner_hi, _ceil((-r + m) / a - 0.5 - 1e-6, first, stop))
        else:
            if r + m < 0.0:
                hi = lo
            if r - m < 0.0:
                inner_hi = inner_lo
    if inner_hi <= inner_lo:
        return lo, hi, hi, hi
    return lo, hi, inner_lo, inner_hi


@kernel
def _partial(plane: Floats, k: int, x: int, y: int, col: int, row: int, w_max: Floats, owner: Ints) -> None:
    """Test the five samples of one pixel against the edges and the nearest surface so far."""
    for s in range(5):
        u = x + 0.5 + _DX[s]
        v = y + 0.5 + _DY[s]
        if plane[0] * u + plane[1] * v + plane[2] < 0.0:
            continue
        if plane[3] * u + plane[4] * v + plane[5] < 0.0:
            continue
        if plane[6] * u + plane[7] * v + plane[8] < 0.0:
            continue
        w = plane[9] * u + (plane[10] * v + plane[11])
        if w > w_max[s, row, col]:
            w_max[s, row, col] = w
            owner[s, row, col] = k


@kernel
def _cover(plane: Floats, k: int, box: Ints, tile: Tile, w_max: Floats, owner: Ints) -> None:
    """Enter one triangle into the visibility buffer of a tile (x0, y0, x1, y1)."""
    tx, ty, tx1, ty1 = tile
    first, stop = max(box[0], tx), min(box[2] + 1, tx1)
    for y in range(max(box[1], ty), min(box[3] + 1, ty1)):
        lo, hi, inner_lo, inner_hi = _row_spans(plane, y + 0.5, first, stop)
        row = y - ty
        for x in range(lo, min(inner_lo, hi)):
            _partial(plane, k, x, y, x - tx, row, w_max, owner)
        for x in range(max(inner_hi, lo), hi):
            _partial(plane, k, x, y, x - tx, row, w_max, owner)
        for s in range(5):
            # The same order of sums as in _partial: a surface has one depth whichever way a sample is reached.
            base = plane[10] * (y + 0.5 + _DY[s]) + plane[11]
            # Slices from their start, so that the loop needs no test for negative indices and becomes SIMD.
            nearest = w_max[s, row, inner_lo - tx : inner_hi - tx]
            owners = owner[s, row, inner_lo - tx : inner_hi - tx]
            for i in range(inner_hi - inner_lo):
                w = plane[9] * (inner_lo + i + 0.5 + _DX[s]) + base
                nearer = w > nearest[i]
                nearest[i] = w if nearer else nearest[i]
                owners[i] = k if nearer else owners[i]


@kernel
def _bilinear(texels: Words, start: int, width: int, height: int, u: float, v: float) -> tuple[int, int]:
    """Return a mip level at (u, v) in 0..1, clamped at its border: red | green << 32, and blue, times 65536.

    Weights are multiples of 1/256, as on graphics processors; whole numbers add up in any order to the same bits.
    """
    x = min(max(256.0 * (u * width) - 128.0, 0.0), 256.0 * (width - 1)) + 0.5
    y = min(max(256.0 * (v * height) - 128.0, 0.0), 256.0 * (height - 1)) + 0.5
    ix, iy = int(x), int(y)
    fx, fy = ix & 255, iy & 255
    at = start + (iy >> 8) * width + (ix >> 8)
    right = 1 if fx > 0 else 0
    below = width if fy > 0 else 0
    p00, p10 = np.int64(texels[np.uint64(at)]), np.int64(texels[np.uint64(at + right)])
    p01, p11 = np.int64(texels[np.uint64(at + below)]), np.int64(texels[np.uint64(at + below + right)])
    w00, w10, w01, w11 = (256 - fx) * (256 - fy), fx * (256 - fy), (256 - fx) * fy, fx * fy
    red_green = w00 * (p00 & 255 | (p00 & 0xFF00) << 24) + w10 * (p10 & 255 | (p10 & 0xFF00) << 24)
    red_green += w01 * (p01 & 255 | (p01 & 0xFF00) << 24) + w11 * (p11 & 255 | (p11 & 0xFF00) << 24)
    blue = w00 * (p00 >> 16) + w10 * (p10 >> 16) + w01 * (p01 >> 16) + w11 * (p11 >> 16)
    return int(red_green), int(blue)


@kernel
def _footprint(ux: float, vx: float, uy: float, vy: float) -> tuple[float, float, float, float]:
    """Return the axes of a pixel in texels: long and short length, and the unit direction of the long one.

    The columns of J = [[ux, uy], [vx, vy]] are steps of the texture for one pixel right and down; the axes are the
    singular values of J and its first left singular vector.
    """
    a, b, d = ux * ux + uy * uy, ux * vx + uy * vy, vx * vx + vy * vy
    mean, half = 0.5 * (a + d), 0.5 * (a - d)
    root = math.sqrt(half * half + b * b)
    long = math.sqrt(mean + root)
    short = abs(ux * vy - uy * vx) / long if long > 0.0 else 0.0
    # Of the two columns of J J^T - short^2, both along the long axis, the one that does not vanish.
    dx, dy = (half + root, b) if half >= 0.0 else (b, root - half)
    norm = math.sqrt(dx * dx + dy * dy)
    if norm > 0.0:
        return long, short, dx / norm, dy / norm
    return long, short, 1.0, 0.0


@kernel
def _texture(
    texels: Words, levels: Longs, texture: int, u: float, v: float, j: tuple[float, float, float, float]
) -> Colour:
    """Filter a texture at (u, v): trilinear, with up to MAX_TAPS taps along the longer axis of the footprint.

    levels i64[t,l,3] (start, width, height); j = du/dx, dv/dx, du/dy, dv/dy.
    """
    width, height = levels[texture, 0, 1], levels[texture, 0, 2]
    long, short, dx, dy = _footprint(j[0] * width, j[1] * height, j[2] * width, j[3] * height)
    taps = MAX_TAPS if long > MAX_TAPS * short else max(1, int(long / short + _TAP_ROUNDING))
    low, size = 0, LOD_FACTOR * long / taps
    while size >= 2.0 and low < levels.shape[1] - 1:
        size *= 0.5
        low += 1
    # A parabola through log2 at 1 and 2: a hundredth of a level off at most, and the same on every machine.
    blend = (2.0 - size / 3.0) * size - 5.0 / 3.0 if size > 1.0 else 0.0
    blend = 0.0 if low == levels.shape[1] - 1 else blend
    near_rg = near_b = far_rg = far_b = 0
    next_low = min(low + 1, levels.shape[1] - 1)
    start0, width0, height0 = levels[texture, low, 0], levels[texture, low, 1], levels[texture, low, 2]
    start1, width1, height1 = (
        levels[texture, next_low, 0],
        levels[texture, next_low, 1],
        levels[texture, next_low, 2],
    )
    step_u, step_v = long * dx / width, long * dy / height
    for k in range(taps):
        along = (k + 0.5) / taps - 0.5
        s, t = u + along * step_u, v + along * step_v
        rg, b = _bilinear(texels, start0, width0, height0, s, t)
        near_rg, near_b = near_rg + rg, near_b + b
        if blend > 0.0:
            rg, b = _bilinear(texels, start1, width1, height1, s, t)
            far_rg, far_b = far_rg + rg, far_b + b
    near, far = (1.0 - blend) / (65536.0 * taps), blend / (65536.0 * taps)
    red = near * (near_rg & 0xFFFFFFFF) + far * (far_rg & 0xFFFFFFFF)
    green = near * (near_rg >> 32) + far * (far_rg >> 32)
    return red, green, near * near_b + far * far_b


@kernel
def _shade(planes: Floats, k: int, x: float, y: float, texels: Words, levels: Longs, texture: int) -> Colour:
    """Return red, green, blue 0..255 of a triangle seen at pixel position (x, y)."""
    w = planes[k, 9] * x + planes[k, 10] * y + planes[k, 11]
    u = (planes[k, 12] * x + planes[k, 13] * y + planes[k, 14]) / w
    v = (planes[k, 15] * x + planes[k, 16] * y + planes[k, 17]) / w
    light = (planes[k, 18] * x + planes[k, 19] * y + planes[k, 20]) / w
    j = (
        (planes[k, 12] - u * planes[k, 9]) / w,
        (planes[k, 15] - v * planes[k, 9]) / w,
        (planes[k, 13] - u * planes[k, 10]) / w,
        (planes[k, 16] - v * planes[k, 10]) / w,
    )
    red, green, blue = _texture(texels, levels, texture, u, v, j)
    return light * red, light * green, light * blue


@kernel
def _pixel(owner: Ints, row: int, col: int, samples: int) -> tuple[int, int, float, float]:
    """Take the next surface that owns samples of a pixel: its index (-1 none), the count and the mean offset.

    The samples taken are marked with -2. Shading at the mean of the covered samples keeps off a texture's outside.
    """
    first = 4 if samples == 1 else 0
    found, count, dx, dy = -2, 0, 0.0, 0.0
    for s in range(first, first + samples):
        k = owner[s, row, col]
        if k == -2 or (count > 0 and k != found):
            continue
        found = k
        count += 1
        dx += _DX[s]
        dy += _DY[s]
        owner[s, row, col] = -2
    return found, count, dx / max(count, 1), dy / max(count, 1)


@kernel
def _resolve(
    tile: Tile,
    samples: int,
    planes: Floats,
    texture_of: Ints,
    texels: Words,
    levels: Longs,
    background: Floats,
    w_max: Floats,
    owner: Ints,
    rgb: Bytes,
    depth: Singles,
    seen: Ints,
) -> None:
    """Shade the visibility buffer of a tile into the image."""
    tx, ty, tx1, ty1 = tile
    for y in range(ty, ty1):
        for x in range(tx, tx1):
            row, col = y - ty, x - tx
            depth[y, x] = 1.0 / w_max[4, row, col] if w_max[4, row, col] > 0.0 else 0.0
            seen[y, x] = owner[4, row, col]
            red = green = blue = 0.0
            done = 0
            while done < samples:
                k, count, dx, dy = _pixel(owner, row, col, samples)
                if k < 0:
                    r, g, b = background[0], background[1], background[2]
                else:
                    at_x, at_y = x + 0.5 + dx, y + 0.5 + dy
                    r, g, b = _shade(planes, k, at_x, at_y, texels, levels, texture_of[k])
                red, green, blue = red + count * r, green + count * g, blue + count * b
                done += count
            rgb[y, x, 0] = np.uint8(min(255.0, red / samples + 0.5))
            rgb[y, x, 1] = np.uint8(min(255.0, green / samples + 0.5))
            rgb[y, x, 2] = np.uint8(min(255.0, blue / samples + 0.5))


@parallel_kernel
def draw(
    planes: Floats,
    boxes: Ints,
    texture_of: Ints,
    starts: Longs,
    members: Ints,
    texels: Words,
    levels: Longs,
    background: Floats,
    width: int,
    height: int,
    samples: int,
) -> tuple[Bytes, Singles, Ints]:
    """Draw binned triangles: rgb u8[h,w,3], depth f32[h,w] along the camera's axis (0 where nothing is) and the
    triangle i32[h,w] at each pixel centre (-1 where none is).

    texture_of i32[k] per triangle; texels u32[...] packed blue-green-red; levels i64[t,l,3] per texture and mip
    level (start, width, height); samples 4 (rotated grid) or 1 (pixel centre).
    """
    rgb = np.empty((height, width, 3), np.uint8)
    depth = np.empty((height, width), np.float32)
    seen = np.empty((height, width), np.int32)
    across = (width + TILE - 1) // TILE
    for tile in prange(starts.shape[0] - 1):
        tx, ty = (tile % across) * TILE, (tile // across) * TILE
        area = (tx, ty, min(tx + TILE, width), min(ty + TILE, height))
        w_max = np.zeros((5, TILE, TILE))
        owner = np.full((5, TILE, TILE), -1, np.int32)
        for i in range(starts[tile], starts[tile + 1]):
            _cover(planes[members[i]], members[i], boxes[members[i]], area, w_max, owner)
        _resolve(area, samples, planes, texture_of, texels, levels, background, w_max, owner, rgb, depth, seen)
    return rgb, depth, seen
