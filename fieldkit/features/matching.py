"""Nearest neighbours among descriptors, exact: 8-bit dot products fit float32, so every machine gives the same bits."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from fieldkit.features import Descriptors
from fieldkit.features.nearest import nearest

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]


def match_pair(
    first: Descriptors, second: Descriptors, *, ratio: float, min_cosine: float = -1.0
) -> NDArray[np.uint32]:
    """Match descriptors (n, w) and (m, w): mutual nearest neighbours that pass the distance ratio in both images.

    Returns uint32[k, 2] of indices, sorted by the first. A ratio of 1 switches that test off; ``min_cosine`` is the
    least similarity of unit descriptors.
    """
    if len(first) < 2 or len(second) < 2:
        return np.zeros((0, 2), dtype=np.uint32)
    squared_ratio = np.float32(ratio * ratio)
    if first.dtype == np.uint8 and second.dtype == np.uint8:
        found = _mutual_bytes(first.astype(np.int16), second.astype(np.int16), squared_ratio)
    else:
        found = _mutual(_squared_distances(first, second), squared_ratio)
    forward, forward_ok, backward, backward_ok = found
    rows = np.arange(len(first))
    kept = (backward[forward] == rows) & forward_ok & backward_ok[forward]
    if min_cosine > -1.0:
        kept[kept] = np.einsum("ij,ij->i", first[kept], second[forward[kept]]) >= np.float32(min_cosine)
    return np.column_stack([rows[kept], forward[kept]]).astype(np.uint32)


def match_groups(
    query: Descriptors,
    stored: Descriptors,
    group: Ints,
    *,
    ratio: float = 1.0,
    mutual: bool = False,
    max_squared: float = np.inf,
    threads: int = 1,
) -> tuple[Ints, Ints, Floats]:
    """Match query descriptors (n, w) to groups (landmarks) that own several stored descriptors (m, w).

    The ratio test compares the best descriptor with the best one of ANOTHER group, so that a landmark seen in
    many images does not compete with itself. Every group keeps only its nearest query; where ``mutual``, only if no
    other query at all is nearer. Returns query indices (sorted), groups, and squared distances of at most
    ``max_squared``.
    """
    if not len(query) or not len(stored):
        empty = np.zeros(0, dtype=np.int32)
        return empty, empty, np.zeros(0, dtype=np.float32)
    found = nearest(query, stored, group, threads=threads)
    kept = np.flatnonzero((found.squared < np.float32(ratio * ratio) * found.other) & (found.squared <= max_squared))
    order = kept[np.lexsort((kept, found.squared[kept], group[found.index[kept]]))]
    groups = group[found.index[order]]
    first = np.ones(len(order), dtype=bool)
    first[1:] = groups[1:] != groups[:-1]
    chosen = np.sort(order[first])
    if mutual and len(chosen):
        matched = np.flatnonzero(np.isin(group, group[found.index[chosen]]))
        back = nearest(stored[matched], query, np.arange(len(query), dtype=np.int32), threads=threads)
        of_group = np.full(int(group.max()) + 1, np.inf, dtype=np.float32)
        np.minimum.at(of_group, group[matched], back.squared)
        # A hair of room: the two directions sum the same products in another order
        chosen = chosen[found.squared[chosen] <= of_group[group[found.index[chosen]]] * 1.0001 + 1e-6]
    return chosen.astype(np.int32), group[found.index[chosen]], found.squared[chosen]


def _squared_distances(first: Descriptors, second: Descriptors) -> Floats:
    a, b = np.asarray(first, dtype=np.float32), np.asarray(second, dtype=np.float32)
    product = a @ b.T
    product *= -2.0
    product += np.einsum("ij,ij->i", a, a)[:, None]
    product += np.einsum("ij,ij->i", b, b)[None, :]
    return np.asarray(product, dtype=np.float32)


@numba.njit(cache=True, nogil=True)
def _mutual(distance, squared_ratio):  # type: ignore[no-untyped-def]
    """Return for rows and columns the nearest index and whether it passes the ratio test, in one pass."""
    n, m = distance.shape
    row_best = np.zeros(n, dtype=np.int32)
    row_ok = np.zeros(n, dtype=np.bool_)
    column_best = np.zeros(m, dtype=np.int32)
    column_first = np.full(m, np.inf, dtype=np.float32)
    column_second = np.full(m, np.inf, dtype=np.float32)
    for i in range(n):
        first = np.float32(np.inf)
        second = np.float32(np.inf)
        best = 0
        for j in range(m):
            d = distance[i, j]
            if d < second:
                if d < first:
                    second = first
                    first = d
                    best = j
                else:
                    second = d
            if d < column_second[j]:
                if d < column_first[j]:
                    column_second[j] = column_first[j]
                    column_first[j] = d
                    column_best[j] = i
                else:
                    column_second[j] = d
        row_best[i] = best
        row_ok[i] = first < squared_ratio * second
    return row_best, row_ok, column_best, column_first < squared_ratio * column_second


@numba.njit(cache=True, nogil=True)
def _mutual_bytes(first, second, squared_ratio):  # type: ignore[no-untyped-def]
    """Do as `_mutual` for descriptors of small integers, whose dot products the compiler turns into vector code.

    As fast as BLAS on one core, without its threads: many pairs are matched at once, each on one core.
    """
    n, m, width = first.shape[0], second.shape[0], first.shape[1]
    first_square = np.zeros(n, dtype=np.int32)
    second_square = np.zeros(m, dtype=np.int32)
    for i in range(n):
        for k in range(width):
            first_square[i] += np.int32(first[i, k]) * np.int32(first[i, k])
    for j in range(m):
        for k in range(width):
            second_square[j] += np.int32(second[j, k]) * np.int32(second[j, k])
    far = np.int32(2**31 - 1)
    row_best = np.zeros(n, dtype=np.int32)
    row_first, row_second = np.full(n, far), np.full(n, far)
    column_best = np.zeros(m, dtype=np.int32)
    column_first, column_second = np.full(m, far), np.full(m, far)
    dots = np.zeros(64, dtype=np.int32)
    for begin in range(0, m, 64):
        end = min(begin + 64, m)
        for i in range(n):
            for j in range(begin, end):
                dot = np.int32(0)
                for k in range(width):
                    dot += np.int32(first[i, k]) * np.int32(second[j, k])
                dots[j - begin] = dot
            for j in range(begin, end):
                d = first_square[i] + second_square[j] - np.int32(2) * dots[j - begin]
                if d < row_second[i]:
                    if d < row_first[i]:
                        row_second[i] = row_first[i]
                        row_first[i] = d
                        row_best[i] = j
                    else:
                        row_second[i] = d
                if d < column_second[j]:
                    if d < column_first[j]:
                        column_second[j] = column_first[j]
                        column_first[j] = d
                        column_best[j] = i
                    else:
                        column_second[j] = d
    row_ok = row_first < squared_ratio * row_second
    column_ok = column_first < squared_ratio * column_second
    return row_best, row_ok, column_best, column_ok
