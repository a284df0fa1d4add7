"""Nearest neighbours among descriptors, exact: 8-bit dot products fit float32, so every machine gives the same bits."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from fieldkit.features import Descriptors

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]
# Queries whose products with all stored descriptors are looked at together.
_BLOCK = 256


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
    query: Descriptors, stored: Descriptors, group: Ints, *, ratio: float
) -> tuple[Ints, Ints, NDArray[np.float32]]:
    """Match query descriptors (n, w) to groups (landmarks) that own several stored descriptors (m, w).

    The ratio test compares the best descriptor with the best one of ANOTHER group, so that a landmark seen in
    many images does not compete with itself. Every group keeps only its nearest query. Returns query indices
    (sorted), groups, and squared distances.
    """
    empty = np.zeros(0, dtype=np.int32)
    if not len(query) or not len(stored):
        return empty, empty, np.zeros(0, dtype=np.float32)
    best, best_distance, other_distance = _nearest_blockwise(query, stored, group)
    kept = np.flatnonzero(best_distance < np.float32(ratio * ratio) * other_distance)
    order = kept[np.lexsort((kept, best_distance[kept], group[best[kept]]))]
    groups = group[best[order]]
    first = np.ones(len(order), dtype=bool)
    first[1:] = groups[1:] != groups[:-1]
    chosen = np.sort(order[first])
    return chosen.astype(np.int32), group[best[chosen]], best_distance[chosen]


def _nearest_blockwise(query: Descriptors, stored: Descriptors, group: Ints) -> tuple[Ints, Floats, Floats]:
    """Return per query the nearest stored descriptor, its squared distance, and that of the nearest of other groups.

    A block of products stays in the processor's cache; the whole table would go through memory four times.
    """
    a, b = np.asarray(query, dtype=np.float32), np.asarray(stored, dtype=np.float32)
    a_squares, b_squares = np.einsum("ij,ij->i", a, a), np.einsum("ij,ij->i", b, b)
    best = np.zeros(len(a), dtype=np.int32)
    nearest, other = np.empty(len(a), dtype=np.float32), np.empty(len(a), dtype=np.float32)
    products = np.empty((min(_BLOCK, len(a)), len(b)), dtype=np.float32)
    for begin in range(0, len(a), _BLOCK):
        rows = slice(begin, min(begin + _BLOCK, len(a)))
        block = np.matmul(a[rows], b.T, out=products[: rows.stop - begin])
        _nearest_groups(block, a_squares[rows], b_squares, group, best[rows], nearest[rows], other[rows])
    return best, nearest, other


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


@numba.njit(cache=True, nogil=True)
def _nearest_groups(product, row_squares, column_squares, group, best, nearest, other):  # type: ignore[no-untyped-def]
    """Fill per row the nearest column, its distance, and the nearest distance among columns of other groups.

    ``product`` holds the dot products of rows and columns.
    """
    n, m = product.shape
    for i in range(n):
        first = np.float32(np.inf)
        second = np.float32(np.inf)
        index = 0
        owner = -1
        for j in range(m):
            d = np.float32(-2.0) * product[i, j] + row_squares[i] + column_squares[j]
            if d < second:
                if group[j] == owner:
                    if d < first:
                        first = d
                        index = j
                elif d < first:
                    second = first
                    first = d
                    index = j
                    owner = group[j]
                else:
                    second = d
        best[i] = index
        nearest[i] = first
        other[i] = second
