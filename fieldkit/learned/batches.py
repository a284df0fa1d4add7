"""Views of different numbers of landmarks as arrays of one shape."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float32]
# The paper gives its network 1024 tokens a view: views with fewer landmarks are filled up with zeros, which take part
# like landmarks and so tell the network, whose attention cannot count, how few there are.
FULL_VIEW = 1024


def padded(tokens: Sequence[Floats], *, visible: ArrayLike, width: int) -> tuple[Floats, Floats]:
    """Stack tokens f32[k, width] of b views to f32[b, n, width], and return the weight f32[b, n] of each row.

    ``visible`` int[b] is how many landmarks a view sees, of which k were kept. A view is to count as `FULL_VIEW`
    tokens: its kept landmarks stand for those visible, at most for all of them, and one token of zeros behind them
    stands for the rest. Rows that only give all views one length have weight 0. The attention of the network is the
    same with these weights as with the tokens repeated.
    """
    longest = max([0, *(len(t) for t in tokens)]) + 1
    result = np.zeros((len(tokens), longest, width), dtype=np.float32)
    weight = np.zeros((len(tokens), longest), dtype=np.float32)
    for i, (own, seen) in enumerate(zip(tokens, np.asarray(visible).tolist(), strict=True)):
        counted = min(seen, FULL_VIEW)
        result[i, : len(own)] = own
        weight[i, : len(own)] = counted / max(len(own), 1)
        weight[i, len(own)] = FULL_VIEW - counted
    if len(tokens) and not weight[:, -1].any():
        return result[:, :-1], weight[:, :-1]
    return result, weight
