"""A tag's pattern as a blurred image shows it, pixel by pixel."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Beyond so many deviations a Gaussian has no weight
FAR = 5.5


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _step(d: float, s: float, width: float) -> tuple[float, float, float]:
    """Return a step at distance d, blurred by a Gaussian and averaged over a width; its slopes by d and -log s."""
    high, low = (d + 0.5 * width) / s, (d - 0.5 * width) / s
    above, below = 0.5 * math.erfc(-high / math.sqrt(2.0)), 0.5 * math.erfc(-low / math.sqrt(2.0))
    peak = 1.0 / math.sqrt(2.0 * math.pi)
    at_high, at_low = peak * math.exp(-0.5 * high * high), peak * math.exp(-0.5 * low * low)
    value = s / width * (high * above + at_high - low * below - at_low)
    return value, (above - below) / width, -s / width * (at_high - at_low)


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def blurred_pattern(
    cells: Array,
    places: Array,
    axial: Array,
    lens: Array,
    widths: Array,
    aslant: Array,
    nodes: Array,
    weights: Array,
) -> tuple[Array, Array, Array]:
    """Return a pattern (t, t) blurred at places (n, 2) in cells from its top left, and its derivatives.

    The blur along each axis is a Gaussian of deviation ``axial`` (n, 2), averaged over a pixel's ``widths`` (n, 2), and
    summed over ``nodes`` along ``aslant`` (n, 2) with ``weights``. What lies outside goes on as the outermost cells.
    Derivatives are by place (n, 2), and (n,) by the logarithm of the lens's blur, whose share of the axial variance
    is ``lens`` (n, 2).
    """
    value, by_place, by_blur = np.zeros(len(places)), np.zeros((len(places), 2)), np.zeros(len(places))
    share, at, grown = np.zeros((2, len(cells))), np.zeros((2, len(cells))), np.zeros((2, len(cells)))
    first, last = np.zeros(2, dtype=np.int64), np.zeros(2, dtype=np.int64)
    for i in range(len(places)):
        for k in range(len(nodes)):
            for axis in range(2):
                x, s, width = places[i, axis] + nodes[k] * aslant[i, axis], axial[i, axis], widths[i, axis]
                reach = FAR * s + 0.5 * width
                first[axis] = min(max(math.floor(x - reach), 0), len(cells) - 1)
                last[axis] = min(max(math.floor(x + reach), 0), len(cells) - 1)
                below, density, moment = 0.0, 0.0, 0.0
                for c in range(first[axis], last[axis] + 1):
                    above, next_density, next_moment = 1.0, 0.0, 0.0
                    if c < last[axis]:
                        above, next_density, next_moment = _step(c + 1 - x, s, width)
                    share[axis, c] = above - below
                    at[axis, c] = density - next_density
                    grown[axis, c] = (moment - next_moment) * lens[i, axis]
                    below, density, moment = above, next_density, next_moment
            total, du, dv, blur = 0.0, 0.0, 0.0, 0.0
            for r in range(first[1], last[1] + 1):
                for c in range(first[0], last[0] + 1):
                    if cells[r, c] != 0.0:
                        total += cells[r, c] * share[0, c] * share[1, r]
                        du += cells[r, c] * at[0, c] * share[1, r]
                        dv += cells[r, c] * share[0, c] * at[1, r]
                        blur += cells[r, c] * (grown[0, c] * share[1, r] + share[0, c] * grown[1, r])
            value[i] += weights[k] * total
            by_place[i, 0] += weights[k] * du
            by_place[i, 1] += weights[k] * dv
            by_blur[i] += weights[k] * (blur + nodes[k] * (du * aslant[i, 0] + dv * aslant[i, 1]))
    return value, by_place, by_blur
