"""Numba kernels that colour what was found visible: textures filtered by mip maps along the pixel's footprint.

fastmath stays off, and filters add whole numbers: the same bits everywhere.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_bridge.rendering.cull import TILE_H, TILE_W, Mesh, Set
from sim_bridge.rendering.fragments import CHUNK, Tile, list_fragments, place
from sim_bridge.rendering.kernels import inlined, inner

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
    taps = MAX_TAPS if long > MAX_TAPS * short else max(1, int(long / short + _TAP_ROUNDING))
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


@inlined
def _sample(texels: Words, levels: Longs, texture: int, how: Filter, u: float, v: float) -> int:
    """Filter a texture at (u, v) in 0..1: packed colours times taps * (how.near + how.far)."""
    first = 0.5 * (1 - how.taps)
    s, t = u + first * how.step_u, v + first * how.step_v
    total = 0
    level, weight = how.level, how.near
    for _ in range(2):
        if weight > 0:
            start, width, height = levels[texture, level, 0], levels[texture, level, 1], levels[texture, level, 2]
            x, y = int(_ONE * (s * width) - _HALF), int(_ONE * (t * height) - _HALF)
            dx, dy = int(_ONE * (how.step_u * width)), int(_ONE * (how.step_v * height))
            for _ in range(how.taps):
                total += _bilinear(texels, start, width, height, x, y, weight)
                x, y = x + dx, y + dy
        level, weight = level + 1, how.far
    return total


@inner
def _colour(fragments: Ints, tile: Tile, out: Set, textures: Textures, rgb: Bytes) -> None:
    """Colour the fragments of a tile. One filter serves a fragment, that of its middle.

    Shading at the mean of the samples of one surface keeps off a texture's outside.
    """
    planes, levels, owner, samples = out.planes, textures.levels, tile.owner, tile.samples
    first = 4 if samples == 1 else 0
    red = green = blue = done = 0
    for n in range(fragments.shape[0]):
        k, row, col, length = fragments[n, 0], fragments[n, 1], fragments[n, 2], fragments[n, 3]
        count, dx, dy = 0, 0.0, 0.0
        for s in range(samples):
            if fragments[n, 4] >> s & 1:
                count, dx, dy = count + 1, dx + DX[first + s], dy + DY[first + s]
        x0, y0 = tile.x + col + 0.5 + dx / count, tile.y + row + 0.5 + dy / count
        texels, texture, how, unit = textures.texels, 0, Filter(1, 0, 0, 0, 0.0, 0.0), 0.0
        aw = au = av = cw = cu = cv = 0.0
        if k >= 0:
            texture = out.texture[k]
            aw, au, av = planes[k, 9], planes[k, 12], planes[k, 15]
            bw, bu, bv = planes[k, 10], planes[k, 13], planes[k, 16]
            cw, cu, cv = bw * y0 + planes[k, 11], bu * y0 + planes[k, 14], bv * y0 + planes[k, 17]
            middle = x0 + 0.5 * (length - 1)
            z = 1.0 / (aw * middle + cw)
            u, v = (au * middle + cu) * z, (av * middle + cv) * z
            j = ((au - u * aw) * z, (av - v * aw) * z, (bu - u * bw) * z, (bv - v * bw) * z)
            how = _filter(levels, texture, j)
            texels = textures.added if texture >= textures.base else textures.texels
            unit = _UNIT * count / (samples * how.taps * (how.near + how.far))
        for i in range(length):
            if k >= 0:
                x = x0 + i
                z = 1.0 / (aw * x + cw)
                packed = _sample(texels, levels, texture, how, (au * x + cu) * z, (av * x + cv) * z)
                # The light is that of the pixel's own triangle, not of the one that stands for it.
                m = k if length == 1 else owner[place(row, col + i, tile.layers)]
                bright = planes[m, 18] * x + planes[m, 19] * y0 + planes[m, 20]
                light = int(unit * (bright * z))
                red, green = red + light * (packed & _LANE), green + light * (packed >> 21 & _LANE)
                blue += light * (packed >> 42)
            else:
                part = _UNIT * count / samples
                red += int(part * textures.background[0])
                green += int(part * textures.background[1])
                blue += int(part * textures.background[2])
            done += count
            if done == samples:
                rgb[tile.y + row, tile.x + col + i, 0] = np.uint8(min(255, red + _ROUND >> _BITS))
                rgb[tile.y + row, tile.x + col + i, 1] = np.uint8(min(255, green + _ROUND >> _BITS))
                rgb[tile.y + row, tile.x + col + i, 2] = np.uint8(min(255, blue + _ROUND >> _BITS))
                red = green = blue = done = 0


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
    room: Ints,
    picture: Picture,
) -> None:
    """Turn the visibility buffer of the tile at pixel (x, y) into colour and depth; room i32[4*pixels,5] is scratch."""
    height, width = picture.depth.shape
    layers = 5 if samples > 1 else 1
    tile = Tile(owner, samples, layers, x, y, min(TILE_H, height - y), min(TILE_W, width - x))
    for row in range(tile.rows):
        for col in range(tile.cols):
            at = place(row, col, layers) + (layers - 1) * CHUNK
            picture.depth[y + row, x + col] = 1.0 / w[at] if w[at] > 0.0 else 0.0
            picture.seen[y + row, x + col] = owner[at]
    n = list_fragments(tile, mesh, textures.levels, out, room)
    _colour(room[:n], tile, out, textures, picture.rgb)
