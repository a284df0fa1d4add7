"""Numba kernels that colour what was found visible: textures filtered by mip maps along the pixel's footprint.

fastmath stays off, and filters add whole numbers: the same bits everywhere.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_bridge.rendering.cull import TILE_H, TILE_W, Mesh, Set
from sim_bridge.rendering.kernels import kernel

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int32]
Longs = NDArray[np.int64]
Bytes = NDArray[np.uint8]
Words = NDArray[np.uint32]
Colour = tuple[float, float, float]

MAX_TAPS = 8
# A level of detail half a level finer than the footprint asks for: 2 ** -0.5.
LOD_FACTOR = 0.7071067811865476
# Taps are the rounded-up ratio of the footprint's axes, but a quarter too long still gets no further tap.
_TAP_ROUNDING = 0.75

# The rotated grid, then the centre: sample k of a pixel lies at its centre plus (DX[k], DY[k]).
DX = (-0.125, 0.375, 0.125, -0.375, 0.0)
DY = (-0.375, -0.125, 0.375, 0.125, 0.0)

_CHUNK = 8
# Positions in a texture are whole numbers of 2 ** -16 texels; weights use the upper 8 bits of the fraction.
_ONE, _HALF = 65536.0, 32768.0
_ROUND = 0.5 + 1e-9
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
def _filter(levels: Longs, texture: int, ux: float, vx: float, uy: float, vy: float) -> Filter:
    """Choose the filter of a texture from the derivatives of its coordinates: trilinear, with
    up to MAX_TAPS taps along the longer axis of the footprint."""
    width, height = levels[texture, 0, 1], levels[texture, 0, 2]
    long, short, dx, dy = _footprint(ux * width, vx * height, uy * width, vy * height)
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


@kernel
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


@kernel
def _spread(texel: np.uint32) -> np.int64:
    """Give each colour of a texel (red, blue << 10, green << 21) room to be multiplied by 2 ** 13."""
    wide = np.int64(texel)
    return (wide | wide << 32) & _SPREAD


@kernel
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


@kernel
def _attributes(k: int, f: int, mesh: Mesh, planes: Floats) -> None:
    """Write u/z, v/z and shade/z of a triangle behind its edges and 1/z: a, b, c of a*x + b*y + c each."""
    big = 0
    for j in range(1, 3):
        if abs(planes[k, 9 + j]) > abs(planes[k, 9 + big]):
            big = j
    # The sum of the edges is 1/z times the determinant.
    scale = planes[k, 9 + big] / (planes[k, big] + planes[k, 3 + big] + planes[k, 6 + big])
    for j in range(3):
        e0, e1, e2 = scale * planes[k, j], scale * planes[k, 3 + j], scale * planes[k, 6 + j]
        planes[k, 12 + j] = e0 * mesh.uv[f, 0, 0] + e1 * mesh.uv[f, 1, 0] + e2 * mesh.uv[f, 2, 0]
        planes[k, 15 + j] = e0 * mesh.uv[f, 0, 1] + e1 * mesh.uv[f, 1, 1] + e2 * mesh.uv[f, 2, 1]
        planes[k, 18 + j] = e0 * mesh.shade[f, 0] + e1 * mesh.shade[f, 1] + e2 * mesh.shade[f, 2]


@kernel
def _fragments(owner: Ints, samples: int, rows: int, cols: int, mesh: Mesh, out: Set, into: Ints) -> int:
    """List what a tile sees: i32[n,5] of triangle, row, column, number of pixels and which samples as bits.

    The fragments of a pixel follow each other; up to 8 pixels that see one triangle wholly are one fragment.
    """
    layers = 5 if samples > 1 else 1
    everything = (1 << samples) - 1
    n = 0
    for row in range(rows):
        run, last = 0, -2
        for col in range(cols):
            at = ((row * TILE_W + col) // _CHUNK * layers) * _CHUNK + col % _CHUNK
            left = everything
            while left != 0:
                first = 0
                while left >> first & 1 == 0:
                    first += 1
                k, mask = owner[at + first * _CHUNK], 0
                for s in range(first, samples):
                    mask |= (1 if owner[at + s * _CHUNK] == k else 0) << s
                left &= ~mask
                if mask == everything and k == last and 0 < run < _CHUNK:
                    run += 1
                    into[n - 1, 3] = run
                    continue
                run = 1 if mask == everything else 0
                last = k
                into[n, 0], into[n, 1], into[n, 2], into[n, 3], into[n, 4] = k, row, col, 1, mask
                n += 1
                if k >= 0 and out.texture[k] < 0:
                    _attributes(k, out.face[k], mesh, out.planes)
                    out.texture[k] = mesh.texture[out.face[k]]
    return n


@kernel
def _colour(fragments: Ints, area: tuple[int, int], out: Set, textures: Textures, samples: int, rgb: Bytes) -> None:
    """Colour the fragments of a tile. One filter serves a fragment, that of its middle.

    Shading at the mean of the samples of one triangle keeps off a texture's outside.
    """
    planes, levels, background = out.planes, textures.levels, textures.background
    first = 4 if samples == 1 else 0
    red = green = blue = 0.0
    done = 0
    for n in range(fragments.shape[0]):
        k, y, x0, length = fragments[n, 0], fragments[n, 1] + area[1], fragments[n, 2] + area[0], fragments[n, 3]
        count, dx, dy = 0, 0.0, 0.0
        for s in range(samples):
            if fragments[n, 4] >> s & 1:
                count, dx, dy = count + 1, dx + DX[first + s], dy + DY[first + s]
        if k < 0:
            red, green, blue = red + count * background[0], green + count * background[1], blue + count * background[2]
            done += count
            if done == samples:
                for x in range(x0, x0 + length):
                    _write(rgb, y, x, red / samples, green / samples, blue / samples)
                red = green = blue = 0.0
                done = 0
            continue
        v0 = y + 0.5 + dy / count
        aw, au, av, al = planes[k, 9], planes[k, 12], planes[k, 15], planes[k, 18]
        bw, bu, bv = planes[k, 10], planes[k, 13], planes[k, 16]
        cw, cu, cv = bw * v0 + planes[k, 11], bu * v0 + planes[k, 14], bv * v0 + planes[k, 17]
        cl = planes[k, 19] * v0 + planes[k, 20]
        shift = dx / count
        middle = x0 + 0.5 * length + shift
        z = 1.0 / (aw * middle + cw)
        u, v = (au * middle + cu) * z, (av * middle + cv) * z
        texture = out.texture[k]
        how = _filter(levels, texture, (au - u * aw) * z, (av - v * aw) * z, (bu - u * bw) * z, (bv - v * bw) * z)
        texels = textures.added if texture >= textures.base else textures.texels
        share = count / (how.taps * (how.near + how.far))
        for x in range(x0, x0 + length):
            q = x + 0.5 + shift
            z = 1.0 / (aw * q + cw)
            packed = _sample(texels, levels, texture, how, (au * q + cu) * z, (av * q + cv) * z)
            light = (al * q + cl) * z * share
            red, green = red + light * (packed & _LANE), green + light * (packed >> 21 & _LANE)
            blue += light * (packed >> 42)
            done += count
            if done == samples:
                _write(rgb, y, x, red / samples, green / samples, blue / samples)
                red = green = blue = 0.0
                done = 0


@kernel
def _write(rgb: Bytes, y: int, x: int, red: float, green: float, blue: float) -> None:
    """Round a colour; a half goes up, whatever a sum's last bits are."""
    rgb[y, x, 0] = np.uint8(min(255.0, red + _ROUND))
    rgb[y, x, 1] = np.uint8(min(255.0, green + _ROUND))
    rgb[y, x, 2] = np.uint8(min(255.0, blue + _ROUND))


@kernel
def resolve(
    area: tuple[int, int],
    mesh: Mesh,
    textures: Textures,
    out: Set,
    w: Floats,
    owner: Ints,
    samples: int,
    room: Ints,
    picture: Picture,
) -> None:
    """Turn the visibility buffer of a tile (see `raster`) into colour and depth; room i32[4*pixels,5] is scratch."""
    height, width = picture.depth.shape
    layers = 5 if samples > 1 else 1
    rows, cols = min(TILE_H, height - area[1]), min(TILE_W, width - area[0])
    for row in range(rows):
        y = area[1] + row
        for col in range(cols):
            at = ((row * TILE_W + col) // _CHUNK * layers + layers - 1) * _CHUNK + col % _CHUNK
            picture.depth[y, area[0] + col] = 1.0 / w[at] if w[at] > 0.0 else 0.0
            picture.seen[y, area[0] + col] = owner[at]
    n = _fragments(owner, samples, rows, cols, mesh, out, room)
    _colour(room[:n], area, out, textures, samples, picture.rgb)
