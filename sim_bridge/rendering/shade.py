"""Numba kernels that colour what was found visible: textures filtered by mip maps along the pixel's footprint.

fastmath stays off, and filters add whole numbers: the same bits everywhere.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_bridge.rendering.cull import TILE_H, TILE_W, Mesh, Set
from sim_bridge.rendering.fragments import CHUNK, LONGEST, Tile, list_fragments, place
from sim_bridge.rendering.kernels import inlined, inner, kernel

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int32]
Longs = NDArray[np.int64]
Bytes = NDArray[np.uint8]
Words = NDArray[np.uint32]

MAX_TAPS = 8
# A level of detail half a level finer than the footprint asks for: 2 ** -0.5.
LOD_FACTOR = 0.7071067811865476
# Taps are the rounded-up ratio of the footprint's axes, but a quarter too long still gets no further tap.
_TAP_ROUNDING = 0.75

# The rotated grid, then the centre: sample k of a pixel lies at its centre plus (DX[k], DY[k]).
DX = (-0.125, 0.375, 0.125, -0.375, 0.0)
DY = (-0.375, -0.125, 0.375, 0.125, 0.0)

# Positions in a texture are whole numbers of 2 ** -16 texels; weights use the upper 8 bits of the fraction.
_ONE, _HALF = 65536.0, 32768.0
# Colours of the image are added up in 2 ** -32 levels; a half is rounded up whatever a sum's last bits are.
_BITS = 32
_UNIT, _ROUND = 2.0**_BITS, 2 ** (_BITS - 1) + 2 ** (_BITS - 10)
# Red, blue and green of a texel, spread to 21 bits each; weights of one filter add up to at most 2 ** 13.
_SPREAD = 0x3FC001FE000FF
_LANE = (1 << 21) - 1
_FULL = 8192


class Textures(NamedTuple):
    """Mip chains as in `sim_bridge.texels.Mips`, and the colour of nothing f64[3]."""

    texels: Words
    added: Words
    levels: Longs
    base: int
    background: Floats


class Picture(NamedTuple):
    """What is drawn: rgb u8[h,w,3], depth f32[h,w] along the camera's axis (0 where nothing is) and the triangle
    i32[h,w] at each pixel centre (-1 where none is)."""

    rgb: Bytes
    depth: Singles
    seen: Ints


class Scratch(NamedTuple):
    """Room for the fragments of a tile i32[4*pixels,5], and for the pixels of one: packed colours i64[LONGEST], and
    texture coordinates and light f64[LONGEST]."""

    fragments: Ints
    total: Longs
    u: Floats
    v: Floats
    light: Floats


class Filter(NamedTuple):
    """How a texture is filtered: taps, the finer mip level (the next is the coarser), the whole-number weights of one
    tap in both, and the step from tap to tap in texture coordinates."""

    taps: int
    level: int
    near: int
    far: int
    step_u: float
    step_v: float


@inlined
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


@inlined
def _filter(levels: Longs, texture: int, j: tuple[float, float, float, float]) -> Filter:
    """Choose the filter of a texture from j = du/dx, dv/dx, du/dy, dv/dy: trilinear, with
    up to MAX_TAPS taps along the longer axis of the footprint."""
    width, height = levels[texture, 0, 1], levels[texture, 0, 2]
    long, short, dx, dy = _footprint(j[0] * width, j[1] * height, j[2] * width, j[3] * height)
    # A face whose corners share one place of the texture has no footprint at all.
    taps = MAX_TAPS if long > MAX_TAPS * short else max(1, int(long / max(short, 1e-300) + _TAP_ROUNDING))
    level, size = 0, LOD_FACTOR * long / taps
    while size >= 2.0 and level < levels.shape[1] - 1:
        size *= 0.5
        level += 1
    # A parabola through log2 at 1 and 2: a hundredth of a level off at most, and the same on every machine.
    blend = (2.0 - size / 3.0) * size - 5.0 / 3.0 if size > 1.0 else 0.0
    whole = _FULL // taps
    far = 0 if level == levels.shape[1] - 1 else int(blend * whole + 0.5)
    return Filter(taps, level, whole - far, far, long * dx / (width * taps), long * dy / (height * taps))


@inlined
def _bilinear(texels: Words, start: int, width: int, height: int, x: int, y: int, weight: int) -> int:
    """Return ``weight`` times a mip level at (x, y) in 2 ** -16 texels, clamped at its border: red, green << 21 and
    blue << 42. Whole numbers add up in any order to the same bits."""
    x = min(max(x, 0), (width - 1) << 16)
    y = min(max(y, 0), (height - 1) << 16)
    fx, fy = x >> 8 & 255, y >> 8 & 255
    at = start + (y >> 16) * width + (x >> 16)
    w11 = fx * fy * weight >> 16
    w10, w01 = (fx * weight >> 8) - w11, (fy * weight >> 8) - w11
    w00 = weight - w10 - w01 - w11
    top = w00 * _spread(texels[np.uint64(at)]) + w10 * _spread(texels[np.uint64(at + 1)])
    at += width
    return int(top + w01 * _spread(texels[np.uint64(at)]) + w11 * _spread(texels[np.uint64(at + 1)]))


@inlined
def _spread(texel: np.uint32) -> np.int64:
    """Give each colour of a texel (red, blue << 10, green << 21) room to be multiplied by 2 ** 13."""
    wide = np.int64(texel)
    return (wide | wide << 32) & _SPREAD


@inner
def _sample(texels: Words, levels: Longs, texture: int, how: Filter, count: int, scratch: Scratch) -> None:
    """Filter a texture at scratch.u, scratch.v in 0..1: packed colours times how.taps * (how.near + how.far)."""
    u, v, total = scratch.u, scratch.v, scratch.total
    total[:count] = 0
    level, weight = how.level, how.near
    for _ in range(2):
        if weight > 0:
            start, width, height = levels[texture, level, 0], levels[texture, level, 1], levels[texture, level, 2]
            wide, high = _ONE * width, _ONE * height
            for k in range(how.taps):
                along = k + 0.5 - 0.5 * how.taps
                dx, dy = along * how.step_u * wide - _HALF, along * how.step_v * high - _HALF
                for i in range(count):
                    x, y = int(u[i] * wide + dx), int(v[i] * high + dy)
                    total[i] += _bilinear(texels, start, width, height, x, y, weight)
        level, weight = level + 1, how.far


@inner
def _surface(
    k: int, length: int, x0: float, y: float, share: float, out: Set, textures: Textures, scratch: Scratch
) -> None:
    """Fill scratch.total and scratch.light for ``length`` pixels of triangle k from (x0, y) on: packed colours, and
    what they have to be multiplied by, beside shade/z, for ``share`` of a pixel in 2 ** -32 levels."""
    p, u, v, light = out.planes, scratch.u, scratch.v, scratch.light
    aw, au, av = p[k, 9], p[k, 12], p[k, 15]
    bw, bu, bv = p[k, 10], p[k, 13], p[k, 16]
    cw, cu, cv = bw * y + p[k, 11], bu * y + p[k, 14], bv * y + p[k, 17]
    middle = x0 + 0.5 * (length - 1)
    z = 1.0 / (aw * middle + cw)
    s, t = (au * middle + cu) * z, (av * middle + cv) * z
    texture = out.texture[k]
    how = _filter(
        textures.levels, texture, ((au - s * aw) * z, (av - t * aw) * z, (bu - s * bw) * z, (bv - t * bw) * z)
    )
    unit = share * _UNIT / (how.taps * (how.near + how.far))
    for i in range(length):
        x = x0 + i
        z = 1.0 / (aw * x + cw)
        u[i], v[i], light[i] = (au * x + cu) * z, (av * x + cv) * z, unit * z
    texels = textures.added if texture >= textures.base else textures.texels
    _sample(texels, textures.levels, texture, how, length, scratch)


@inlined
def _write(pixel: Bytes, red: int, green: int, blue: int) -> None:
    pixel[0] = np.uint8(min(255, red + _ROUND >> _BITS))
    pixel[1] = np.uint8(min(255, green + _ROUND >> _BITS))
    pixel[2] = np.uint8(min(255, blue + _ROUND >> _BITS))


@inner
def _brighten(fragment: Ints, x0: float, y: float, several: bool, tile: Tile, planes: Floats, light: Floats) -> None:
    """Multiply what `_surface` left in ``light`` by the baked light: where the triangle of a fragment stands for
    ``several``, by that of each pixel's own triangle."""
    m, row, col, length = fragment[0], fragment[1], fragment[2], fragment[3]
    for i in range(length):
        if several:
            m = tile.owner[place(row, col + i, tile.layers)]
        light[i] *= max(planes[m, 18] * (x0 + i) + planes[m, 19] * y + planes[m, 20], 0.0)


@inner
def _colour(count: int, tile: Tile, out: Set, textures: Textures, scratch: Scratch, rgb: Bytes) -> None:
    """Colour the fragments of a tile. One filter serves a fragment, that of its middle.

    Shading at the mean of the samples of one surface keeps off a texture's outside.
    """
    samples, fragments, light, total = tile.samples, scratch.fragments, scratch.light, scratch.total
    first = 4 if samples == 1 else 0
    everything = (1 << samples) - 1
    red = green = blue = 0
    missing = everything
    for n in range(count):
        k, row, col, length = fragments[n, 0], fragments[n, 1], fragments[n, 2], fragments[n, 3]
        mask, parts, dx, dy = fragments[n, 4] & everything, samples, 0.0, 0.0
        if mask != everything:
            parts = 0
            for s in range(samples):
                if mask >> s & 1:
                    parts, dx, dy = parts + 1, dx + DX[first + s], dy + DY[first + s]
        x, y = tile.x + col + 0.5 + dx / parts, tile.y + row + 0.5 + dy / parts
        share = parts / samples
        if k >= 0:
            _surface(k, length, x, y, share, out, textures, scratch)
            _brighten(fragments[n], x, y, fragments[n, 4] > everything, tile, out.planes, light)
        missing &= ~mask
        for i in range(length):
            if k >= 0:
                packed, bright = total[i], int(light[i])
                red, green = red + bright * (packed & _LANE), green + bright * (packed >> 21 & _LANE)
                blue += bright * (packed >> 42)
            else:
                red += int(share * _UNIT * textures.background[0])
                green += int(share * _UNIT * textures.background[1])
                blue += int(share * _UNIT * textures.background[2])
            if missing == 0:
                _write(rgb[tile.y + row, tile.x + col + i], red, green, blue)
                red = green = blue = 0
        missing = everything if missing == 0 else missing


@kernel
def new_scratch() -> Scratch:
    """Make the room that `resolve` needs."""
    fragments = np.empty((4 * TILE_W * TILE_H, 5), np.int32)
    return Scratch(fragments, np.empty(LONGEST, np.int64), np.empty(LONGEST), np.empty(LONGEST), np.empty(LONGEST))


@inner
def resolve(
    x: int,
    y: int,
    mesh: Mesh,
    textures: Textures,
    out: Set,
    w: Floats,
    owner: Ints,
    samples: int,
    scratch: Scratch,
    picture: Picture,
) -> None:
    """Turn the visibility buffer of the tile at pixel (x, y) into depth and, unless samples is 0, colour."""
    height, width = picture.depth.shape
    layers = 5 if samples > 1 else 1
    tile = Tile(owner, samples, layers, x, y, min(TILE_H, height - y), min(TILE_W, width - x))
    for row in range(tile.rows):
        for col in range(0, tile.cols, CHUNK):
            at, length = place(row, col, layers) + (layers - 1) * CHUNK, min(CHUNK, tile.cols - col)
            near, owners = w[at : at + length], owner[at : at + length]
            depth = picture.depth[y + row, x + col : x + col + length]
            seen = picture.seen[y + row, x + col : x + col + length]
            for i in range(length):
                depth[i] = 1.0 / near[i] if near[i] > 0.0 else 0.0
                seen[i] = owners[i]
    if samples > 0:
        count = list_fragments(tile, mesh, textures.levels, out, scratch.fragments)
        _colour(count, tile, out, textures, scratch, picture.rgb)
