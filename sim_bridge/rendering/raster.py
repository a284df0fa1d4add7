"""Numba kernels of the rasteriser: which triangle every sample of a pinhole image sees, and the image from that.

The image is drawn in tiles; a tile takes the clusters that may touch it nearest first and stops at the first that lies
behind all it has. A cluster is set up when the first tile asks for it: what is hidden costs nothing.

fastmath stays off, and a tile depends on no other: any number of threads gives the same bits.
"""

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from sim_bridge.rendering.cull import TILE_H, TILE_W, Mesh, Set, View, set_up
from sim_bridge.rendering.fragments import CHUNK
from sim_bridge.rendering.kernels import inlined, inner, kernel, parallel_kernel
from sim_bridge.rendering.shade import DX, DY, Picture, Textures, new_scratch, resolve

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
Longs = NDArray[np.int64]
Bytes = NDArray[np.uint8]

# After so many pixels are drawn into a tile, its farthest depth is looked up again.
_REFRESH_PX = 256


class Bins(NamedTuple):
    """Clusters that may be seen, nearest first: cluster i32[k] and largest 1/z f64[k]; per tile those that touch it."""

    cluster: Ints
    near: Floats
    starts: Longs
    members: Ints


class Tile(NamedTuple):
    """The visibility buffer of a tile: the largest 1/z so far, who has it (-1 nobody), offsets of its
    samples, and scratch."""

    w: Floats
    owner: Ints
    x: Floats
    y: Floats
    farthest: Floats
    corners: Floats


@kernel
def _new_tile(samples: int) -> Tile:
    """Make a buffer with ``samples`` per pixel: 5 (rotated grid and centre) or 1 (centre)."""
    chunk = CHUNK * samples
    row = TILE_W * samples
    x, y = np.empty(row), np.empty(row)
    for i in range(row):
        s = (i % chunk) // CHUNK + 5 - samples
        x[i] = (i // chunk) * CHUNK + i % CHUNK + 0.5 + DX[s]
        y[i] = 0.5 + DY[s]
    return Tile(np.empty(row * TILE_H), np.empty(row * TILE_H, np.int32), x, y, np.empty(chunk), np.empty((3, 3)))


@inner
def _farthest(tile: Tile) -> float:
    """Return the smallest 1/z of a tile: what lies behind it is hidden."""
    least = tile.farthest
    count = least.shape[0]
    least[:] = np.inf
    for first in range(0, tile.w.shape[0], count):
        here = tile.w[first : first + count]
        for i in range(count):
            least[i] = here[i] if here[i] < least[i] else least[i]
    result = float(least[0])
    for i in range(1, count):
        result = min(result, least[i])
    return result


@inlined
def _span(plane: Floats, i: int, x0: float, y0: float) -> tuple[float, float, float, float]:
    """Return where edge i lets a triangle begin and end in the row at y of a tile: from slope * y + start on, and up
    to slope * y + end, with half a pixel to spare; an edge along the rows limits nothing."""
    a, b = plane[3 * i], plane[3 * i + 1]
    if abs(a) * 1e6 <= abs(b):
        return 0.0, -np.inf, 0.0, np.inf
    slope = -b / a
    at = -(plane[3 * i + 2] + a * x0 + b * y0) / a + 0.5 * slope
    margin = 0.5 * abs(slope) + 1.0
    if a > 0.0:
        return slope, at - margin, 0.0, np.inf
    return 0.0, -np.inf, slope, at + margin


@inlined
def _cover(plane: Floats, k: int, box: Ints, tx: int, ty: int, tile: Tile) -> int:
    """Enter one triangle into a tile; return about how many pixels it may cover there."""
    row_size = tile.x.shape[0]
    chunk_size = row_size // (TILE_W // CHUNK)
    top, bottom = max(box[1] - ty, 0), min(box[3] - ty, TILE_H - 1)
    first, last = max(box[0] - tx, 0) // CHUNK, min(box[2] - tx, TILE_W - 1) // CHUNK
    a0, b0, a1, b1, a2, b2 = plane[0], plane[1], plane[3], plane[4], plane[6], plane[7]
    a3, b3 = plane[9], plane[10]
    # Relative to the tile; the same sums for both neighbours of an edge, so exactly negated.
    c0, c1 = plane[2] + a0 * tx + b0 * ty, plane[5] + a1 * tx + b1 * ty
    c2, c3 = plane[8] + a2 * tx + b2 * ty, plane[11] + a3 * tx + b3 * ty
    narrow = last == first or bottom - top < 2
    s0, l0, t0, h0 = (0.0, -np.inf, 0.0, np.inf) if narrow else _span(plane, 0, tx, ty)
    s1, l1, t1, h1 = (0.0, -np.inf, 0.0, np.inf) if narrow else _span(plane, 1, tx, ty)
    s2, l2, t2, h2 = (0.0, -np.inf, 0.0, np.inf) if narrow else _span(plane, 2, tx, ty)
    touched = 0
    for row in range(top, bottom + 1):
        low = max(max(s0 * row + l0, s1 * row + l1), max(s2 * row + l2, 0.0))
        high = min(min(t0 * row + h0, t1 * row + h1), min(t2 * row + h2, TILE_W - 1.0))
        if high < low:
            continue
        begin, end = max(first, int(low) // CHUNK), min(last, int(high) // CHUNK) + 1
        if end <= begin:
            continue
        touched += end - begin
        lo, hi = begin * chunk_size, end * chunk_size
        at = row * row_size
        w_row, owners = tile.w[at + lo : at + hi], tile.owner[at + lo : at + hi]
        xs, ys = tile.x[lo:hi], tile.y[lo:hi]
        for i in range(hi - lo):
            x, y = xs[i], row + ys[i]
            w = a3 * x + (b3 * y + c3)
            seen = (a0 * x + (b0 * y + c0) >= 0.0) & (a1 * x + (b1 * y + c1) >= 0.0)
            seen = seen & (a2 * x + (b2 * y + c2) >= 0.0) & (w > w_row[i])
            w_row[i] = w if seen else w_row[i]
            owners[i] = k if seen else owners[i]
    return touched * (CHUNK // 2)


@inner
def _fill(
    number: int, area: tuple[int, int], mesh: Mesh, view: View, bins: Bins, out: Set, places: Longs, tile: Tile
) -> None:
    """Enter all triangles into one tile; places i64[k+1,2] are the first and last place of clusters set up in ``out``,
    -1 for those that are not; in the last row, how many places are used."""
    tx, ty = area
    tile.w[:] = 0.0
    tile.owner[:] = -1
    farthest, drawn = 0.0, 0
    used = places.shape[0] - 1
    for at in range(bins.starts[number], bins.starts[number + 1]):
        c = bins.members[at]
        if bins.near[c] <= farthest:
            break
        if places[c, 0] < 0:
            places[c, 0] = places[used, 0]
            places[used, 0] = places[c, 1] = set_up(mesh, bins.cluster[c], view, out, places[used, 0], tile.corners)
        for k in range(places[c, 0], places[c, 1]):
            box = out.boxes[k]
            if box[0] >= tx + TILE_W or box[2] < tx or box[1] >= ty + TILE_H or box[3] < ty or out.near[k] <= farthest:
                continue
            drawn += _cover(out.planes[k], k, box, tx, ty, tile)
            if drawn >= _REFRESH_PX:
                farthest, drawn = _farthest(tile), 0


@kernel
def _band(
    first: int,
    stop: int,
    mesh: Mesh,
    view: View,
    bins: Bins,
    textures: Textures,
    samples: int,
    out: Set,
    offset: int,
    picture: Picture,
) -> None:
    """Draw the tiles first..stop of an image, with a set of triangles of their own."""
    across = (view.width + TILE_W - 1) // TILE_W
    tile = _new_tile(5 if samples > 1 else 1)
    places = np.full((bins.cluster.shape[0] + 1, 2), -1, np.int64)
    places[-1, 0] = offset
    scratch = new_scratch()
    for number in range(first, stop):
        area = ((number % across) * TILE_W, (number // across) * TILE_H)
        _fill(number, area, mesh, view, bins, out, places, tile)
        resolve(area[0], area[1], mesh, textures, out, tile.w, tile.owner, samples, scratch, picture)


@parallel_kernel
def draw(mesh: Mesh, view: View, bins: Bins, textures: Textures, samples: int, bands: int, picture: Picture) -> Floats:
    """Draw binned clusters into a picture; ``samples`` is 4 (rotated grid), 1 (pixel centre) or 0 (no
    colour).

    Bands of tiles are drawn in parallel. Returns the planes f64[k,21] of the triangles that picture.seen names.
    """
    room = 0
    for c in bins.cluster:
        room += mesh.starts[c + 1] - mesh.starts[c]
    # Memory that is not written costs nothing, so there is room for everything.
    total = bands * room
    out = Set(
        np.empty((total, 21)),
        np.empty((total, 4), np.int32),
        np.empty(total),
        np.empty(total, np.int32),
        np.empty(total, np.int32),
    )
    tiles = bins.starts.shape[0] - 1
    for band in prange(bands):
        _band(
            tiles * band // bands,
            tiles * (band + 1) // bands,
            mesh,
            view,
            bins,
            textures,
            samples,
            out,
            band * room,
            picture,
        )
    return out.planes
