"""Views of different numbers of landmarks as arrays of one shape."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


def padded(tokens: Sequence[Floats], *, width: int) -> tuple[Floats, NDArray[np.bool_]]:
    """Stack tokens f32[k, width] of b views to f32[b, n, width], and bool[b, n]: which rows are landmarks.

    A view that sees nothing has one token of zeros: networks need one, and its score is then that of seeing nothing.
    """
    longest = max([1, *(len(t) for t in tokens)])
    result = np.zeros((len(tokens), longest, width), dtype=np.float32)
    there = np.zeros((len(tokens), longest), dtype=bool)
    for i, own in enumerate(tokens):
        result[i, : len(own)] = own
        there[i, : max(len(own), 1)] = True
    return result, there
