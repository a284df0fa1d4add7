"""Nearest neighbours among descriptors, compiled: as fast as BLAS on one core, without its threads.

Every product is summed in the same order whatever is looked for beside it, so that one or several threads, on the same
machine, give the same bits; 8-bit descriptors are exact on any.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses

import numba
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]
Any8OrFloat = NDArray[np.uint8] | NDArray[np.float32]

# Stored descriptors that are looked at together: their panel of 128 dimensions fits into the first cache
_PANEL = 64
# Queries that a thread takes at a time
_BLOCK = 256


@dataclasses.dataclass(frozen=True)
class Nearest:
    """Per query (n): the nearest stored descriptor, its squared distance, and that of the nearest of other groups."""

    index: Ints
    squared: Floats
    other: Floats


def nearest(query: Any8OrFloat, stored: Any8OrFloat, group: Ints, *, threads: int = 1) -> Nearest:
    """Find the nearest of stored descriptors (m, w) to each query (n, w), and the nearest one of another group.

    ``group`` int32[m] says who owns a stored descriptor. Distances are infinite where there is none.
    """
    width = -(-query.shape[1] // 4) * 4
    rows = np.zeros((len(query), width), dtype=np.float32)
    rows[:, : query.shape[1]] = query
    panels = np.zeros((-(-len(stored) // _PANEL), width, _PANEL), dtype=np.float32)
    squares = np.full(len(panels) * _PANEL, np.inf, dtype=np.float32)
    _pack(stored, panels, squares)
    owner = np.full(len(squares), -1, dtype=np.int32)
    owner[: len(group)] = group
    own = np.zeros(len(rows), dtype=np.float32)
    _squares(rows, own)
    index = np.zeros(len(rows), dtype=np.int32)
    squared, other = np.full(len(rows), np.inf, dtype=np.float32), np.full(len(rows), np.inf, dtype=np.float32)

    def block(begin: int) -> None:
        part = slice(begin, begin + _BLOCK)
        _search(rows[part], panels, squares, owner, index[part], squared[part], other[part])

    begins = range(0, len(rows), _BLOCK)
    if threads > 1 and len(begins) > 1:
        with concurrent.futures.ThreadPoolExecutor(threads) as pool:
            list(pool.map(block, begins))
    else:
        for begin in begins:
            block(begin)
    return Nearest(index, squared + own, other + own)


@dataclasses.dataclass(frozen=True)
class Shelves:
    """Descriptors on shelves, packed once for `nearest_on_shelves`.

    Shelf i has the panels ``bounds[i]:bounds[i + 1]`` of ``panels`` f32[p, w, 64]; ``squares`` f32[64 p] and ``owner``
    int32[64 p] are of their descriptors.
    """

    panels: Floats
    squares: Floats
    owner: Ints
    bounds: NDArray[np.int64]


def fill_shelves(stored: Any8OrFloat, group: Ints, shelf: Ints, *, count: int) -> Shelves:
    """Pack descriptors (m, w) that groups int32[m] own onto ``count`` shelves int32[m]."""
    width = -(-stored.shape[1] // 4) * 4
    order = np.argsort(shelf, kind="stable")
    starts = np.searchsorted(shelf[order], np.arange(count + 1))
    bounds = np.concatenate([[0], np.cumsum(-(-np.diff(starts) // _PANEL))])
    panels = np.zeros((bounds[-1], width, _PANEL), dtype=np.float32)
    squares = np.full(len(panels) * _PANEL, np.inf, dtype=np.float32)
    owner = np.full(len(squares), -1, dtype=np.int32)
    for i in range(count):
        mine, first, last = order[starts[i] : starts[i + 1]], int(bounds[i]), int(bounds[i + 1])
        _pack(stored[mine], panels[first:last], squares[first * _PANEL : last * _PANEL])
        owner[first * _PANEL : first * _PANEL + len(mine)] = group[mine]
    return Shelves(panels, squares, owner, bounds)


def nearest_on_shelves(query: Any8OrFloat, shelf: Ints, shelves: Shelves) -> Nearest:
    """Find per query (n, w) the nearest descriptor on its shelf int32[n]; ``index`` is who owns it, -1 for none."""
    order = np.argsort(shelf, kind="stable")
    rows = np.zeros((len(query), shelves.panels.shape[1]), dtype=np.float32)
    rows[:, : query.shape[1]] = query[order]
    own = np.zeros(len(rows), dtype=np.float32)
    _squares(rows, own)
    starts = np.searchsorted(shelf[order], np.arange(len(shelves.bounds)))
    owner = np.full(len(rows), -1, dtype=np.int32)
    squared, other = np.full(len(rows), np.inf, dtype=np.float32), np.full(len(rows), np.inf, dtype=np.float32)
    _search_shelves(rows, starts, shelves.panels, shelves.squares, shelves.owner, shelves.bounds, owner, squared, other)
    back = np.argsort(order, kind="stable")
    return Nearest(owner[back], (squared + own)[back], (other + own)[back])


def two_nearest(rows: Floats, centres: Floats) -> Ints:
    """Return int32[2, n]: which of the centres f32[k, w] are nearest to rows f32[n, w], and second nearest.

    The same one twice where there is one centre only.
    """
    found = np.zeros((2, len(rows)), dtype=np.int32)
    squares = np.zeros(len(centres), dtype=np.float32)
    _squares(np.ascontiguousarray(centres), squares)
    _two_nearest(np.ascontiguousarray(rows), np.ascontiguousarray(centres.T), squares, found)
    return found


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _pack(stored, panels, squares):  # type: ignore[no-untyped-def]
    for j in range(len(stored)):
        total = np.float32(0.0)
        for k in range(stored.shape[1]):
            value = np.float32(stored[j, k])
            panels[j // _PANEL, k, j % _PANEL] = value
            total += value * value
        squares[j] = total


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _squares(rows, squares):  # type: ignore[no-untyped-def]
    for i in range(len(rows)):
        for k in range(rows.shape[1]):
            squares[i] += rows[i, k] * rows[i, k]


# Four rows against a panel, four dimensions at a time: the compiler keeps the vector units busy with that.
@numba.njit(cache=True, nogil=True, fastmath={"contract", "nnan", "nsz"}, error_model="numpy")
def _search(rows, panels, squares, owner, index, squared, other):  # type: ignore[no-untyped-def]
    last = len(rows) - 1
    owners = np.full(len(rows), -1, dtype=np.int32)
    sums = np.empty((4, _PANEL), dtype=np.float32)
    first_sums, second_sums, third_sums, fourth_sums = sums[0], sums[1], sums[2], sums[3]
    for p in range(len(panels)):
        panel = panels[p]
        start = p * _PANEL
        for i in range(0, len(rows), 4):
            sums[:] = 0.0
            a, b, c, d = rows[i], rows[min(i + 1, last)], rows[min(i + 2, last)], rows[min(i + 3, last)]
            for k in range(0, rows.shape[1], 4):
                p0, p1, p2, p3 = panel[k], panel[k + 1], panel[k + 2], panel[k + 3]
                a0, a1, a2, a3 = a[k], a[k + 1], a[k + 2], a[k + 3]
                b0, b1, b2, b3 = b[k], b[k + 1], b[k + 2], b[k + 3]
                c0, c1, c2, c3 = c[k], c[k + 1], c[k + 2], c[k + 3]
                d0, d1, d2, d3 = d[k], d[k + 1], d[k + 2], d[k + 3]
                for j in range(_PANEL):
                    w, x, y, z = p0[j], p1[j], p2[j], p3[j]
                    first_sums[j] += a0 * w + a1 * x + a2 * y + a3 * z
                    second_sums[j] += b0 * w + b1 * x + b2 * y + b3 * z
                    third_sums[j] += c0 * w + c1 * x + c2 * y + c3 * z
                    fourth_sums[j] += d0 * w + d1 * x + d2 * y + d3 * z
            for q in range(min(4, len(rows) - i)):
                row = i + q
                distance = sums[q]
                least = np.float32(1e30)
                for j in range(_PANEL):
                    distance[j] = squares[start + j] - np.float32(2.0) * distance[j]
                    least = min(least, distance[j])
                first, second = squared[row], other[row]
                if least >= second:
                    continue
                best, mine = index[row], owners[row]
                for j in range(_PANEL):
                    here = distance[j]
                    if here < second:
                        if owner[start + j] == mine:
                            if here < first:
                                first = here
                                best = start + j
                        elif here < first:
                            second = first
                            first = here
                            best = start + j
                            mine = owner[start + j]
                        else:
                            second = here
                squared[row], other[row], index[row], owners[row] = first, second, best, mine


@numba.njit(cache=True, nogil=True)
def _search_shelves(rows, starts, panels, squares, owners, bounds, owner, squared, other):  # type: ignore[no-untyped-def]
    index = np.zeros(len(rows), dtype=np.int32)
    for s in range(len(bounds) - 1):
        a, b, first, last = starts[s], starts[s + 1], bounds[s], bounds[s + 1]
        if a == b or first == last:
            continue
        mine = owners[first * _PANEL : last * _PANEL]
        _search(
            rows[a:b],
            panels[first:last],
            squares[first * _PANEL : last * _PANEL],
            mine,
            index[a:b],
            squared[a:b],
            other[a:b],
        )
        for i in range(a, b):
            owner[i] = mine[index[i]]


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _two_nearest(rows, columns, squares, found):  # type: ignore[no-untyped-def]
    sums = np.empty(columns.shape[1], dtype=np.float32)
    for i in range(len(rows)):
        sums[:] = 0.0
        for k in range(rows.shape[1]):
            value, column = rows[i, k], columns[k]
            for j in range(len(sums)):
                sums[j] += value * column[j]
        first = second = np.float32(np.inf)
        for j in range(len(sums)):
            here = squares[j] - np.float32(2.0) * sums[j]
            if here < first:
                found[1, i], second = found[0, i], first
                found[0, i], first = j, here
            elif here < second:
                found[1, i], second = j, here
