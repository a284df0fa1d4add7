"""Numba kernels that list what a tile sees as few fragments: runs of pixels on one surface, and parts of pixels.

Neighbouring triangles that continue each other (cells of a wall, faces of a fine mesh) are one surface here: their
texture coordinates agree to 1/32 texel wherever one stands for the other.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_bridge.rendering.cull import TILE_W, Mesh, Set
from sim_bridge.rendering.kernels import inlined, inner

Ints = NDArray[np.int32]
Longs = NDArray[np.int64]

# A tile's samples lie in memory by row, then by chunk of 8 pixels, then by sample, then by pixel of the chunk.
CHUNK = 8
# A fragment is at most so many pixels long: one filter serves it.
LONGEST = 16
# Texels, and levels of light, by which one triangle may stand for another.
_TEXELS, _LIGHT = 1.0 / 32.0, 1.0 / 512.0


class Tile(NamedTuple):
    """What is known of the samples of a tile: who is seen i32[...], how many per pixel count for colour (4 or 1) and
    how many there are (5 or 1, the last is the centre), the first pixel, and how many rows and columns are used."""

    owner: Ints
    samples: int
    layers: int
    x: int
    y: int
    rows: int
    cols: int


@inlined
def place(row: int, col: int, layers: int) -> int:
    """Return where the first sample of a tile's pixel lies; the next is CHUNK further."""
    return ((row * TILE_W + col) // CHUNK * layers) * CHUNK + col % CHUNK


@inlined
def _ready(k: int, mesh: Mesh, out: Set) -> None:
    """Set up u/z, v/z and shade/z of a triangle behind its edges and 1/z, unless it was done."""
    if k >= 0 and out.texture[k] < 0:
        _set_up_texture(k, mesh, out)


@inner
def _set_up_texture(k: int, mesh: Mesh, out: Set) -> None:
    planes, f = out.planes, out.face[k]
    out.texture[k] = mesh.texture[f]
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


@inlined
def _alike(a: int, b: int, x: float, y: float, out: Set, levels: Longs, light: int) -> bool:
    """Return whether two triangles agree at (x, y) in their texture and, when ``light`` is 1, in their light."""
    if a == b:
        return True
    if a < 0 or b < 0 or out.texture[a] != out.texture[b]:
        return False
    p = out.planes
    wa, wb = p[a, 9] * x + p[a, 10] * y + p[a, 11], p[b, 9] * x + p[b, 10] * y + p[b, 11]
    if wa <= 0.0 or wb <= 0.0:
        return False
    texture, bound = out.texture[a], _TEXELS * (wa * wb)
    ua, ub = p[a, 12] * x + p[a, 13] * y + p[a, 14], p[b, 12] * x + p[b, 13] * y + p[b, 14]
    va, vb = p[a, 15] * x + p[a, 16] * y + p[a, 17], p[b, 15] * x + p[b, 16] * y + p[b, 17]
    if abs(ua * wb - ub * wa) * levels[texture, 0, 1] > bound or abs(va * wb - vb * wa) * levels[texture, 0, 2] > bound:
        return False
    if light == 0:
        return True
    la, lb = p[a, 18] * x + p[a, 19] * y + p[a, 20], p[b, 18] * x + p[b, 19] * y + p[b, 20]
    return bool(abs(la * wb - lb * wa) <= _LIGHT * (wa * wb))


@inlined
def _stands_for(k: int, other: int, x: float, y: float, rest: int, out: Set, levels: Longs) -> bool:
    """Return whether triangle k may be drawn for another at (x, y) and in ``rest`` pixels more, but for its light."""
    return _alike(k, other, x, y, out, levels, 0) and _alike(k, other, x + rest, y, out, levels, 0)


@inner
def _continues(k: int, others: Ints, tile: Tile, x: float, y: float, rest: int, out: Set, levels: Longs) -> bool:
    """Return whether all that a pixel sees (its samples are CHUNK apart in ``others``) may be drawn as triangle k,
    there and in as many pixels more as may follow."""
    previous = k
    for s in range(tile.samples):
        other = others[s * CHUNK]
        if other != previous:
            if not _stands_for(k, other, x, y, rest, out, levels):
                return False
            if s > 0 and not _alike(others[0], other, x, y, out, levels, 1):
                return False
            previous = other
    return True


@inner
def _parts(others: Ints, row: int, col: int, tile: Tile, out: Set, levels: Longs, n: int, into: Ints) -> int:
    """Add the fragments of a pixel, one per surface."""
    x, y = tile.x + col + 0.5, tile.y + row + 0.5
    left = (1 << tile.samples) - 1
    first = 0
    while left != 0:
        while left >> first & 1 == 0:
            first += 1
        k, mask = others[first * CHUNK], 1 << first
        for s in range(first + 1, tile.samples):
            if left >> s & 1 and _alike(k, others[s * CHUNK], x, y, out, levels, 1):
                mask |= 1 << s
        left &= ~mask
        into[n, 0], into[n, 1], into[n, 2], into[n, 3], into[n, 4] = k, row, col, 1, mask
        n += 1
    return n


@inner
def list_fragments(tile: Tile, mesh: Mesh, levels: Longs, out: Set, into: Ints) -> int:
    """List what a tile sees: i32[n,5] of triangle, row, column, number of pixels and which samples as bits.

    The fragments of a pixel follow each other. One with all samples may be several pixels long; its further pixels
    see its triangle or others that continue it.
    """
    everything = (1 << tile.samples) - 1
    stride, size = tile.layers * CHUNK, tile.samples * CHUNK
    n = 0
    for row in range(tile.rows):
        run, last = 0, -2
        for col in range(0, tile.cols, CHUNK):
            start = (row * (TILE_W // CHUNK) + col // CHUNK) * stride
            seen = tile.owner[start : start + size]
            k, length = seen[0], min(CHUNK, tile.cols - col)
            different = 0
            for i in range(size):
                different |= seen[i] ^ k
            if different == 0 and k == last and 0 < run <= LONGEST - length:
                run += length
                into[n - 1, 3] = run
                continue
            for i in range(length):
                k = seen[i]
                one = different == 0
                if not one:
                    one = True
                    for s in range(1, tile.samples):
                        one = one and seen[i + s * CHUNK] == k
                on = 0 < run < LONGEST
                x, y, rest = tile.x + col + i + 0.5, tile.y + row + 0.5, LONGEST - run
                if one and k != last:
                    _ready(k, mesh, out)
                    on = on and _stands_for(into[n - 1, 0], k, x, y, rest, out, levels)
                elif not one:
                    for s in range(tile.samples):
                        _ready(seen[i + s * CHUNK], mesh, out)
                    on = on and _continues(into[n - 1, 0], seen[i:], tile, x, y, rest, out, levels)
                if on:
                    run += 1
                elif one:
                    into[n, 0], into[n, 1], into[n, 2], into[n, 4] = k, row, col + i, everything
                    n, run = n + 1, 1
                else:
                    n = _parts(seen[i:], row, col + i, tile, out, levels, n, into)
                    run = 1 if into[n - 1, 4] == everything else 0
                if run > 0:
                    into[n - 1, 3] = run
                    into[n - 1, 4] |= 0 if k == into[n - 1, 0] else everything + 1
                last = k
    return n
