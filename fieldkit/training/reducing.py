"""Reduce what a network of appearance sees at landmarks to three numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fieldkit.learned.checkpoint import Reduction

_KEPT = 3
# The numbers 0 and 1 stand for these percentiles of the landmarks; what lies beyond is cut off.
_LOW, _HIGH = 1.0, 99.0


def fit_reduction(vectors: Sequence[NDArray[np.floating]]) -> Reduction:
    """Find the three directions in which the landmarks' vectors [n, w] of all training scenes differ most.

    Principal components of all landmarks, each scene counting the same however many it has; the largest part of each
    direction is positive, so that the same vectors give the same numbers.
    """
    rows = [np.asarray(v, dtype=np.float64) for v in vectors if len(v)]
    mean = np.mean([v.mean(axis=0) for v in rows], axis=0)
    spread = np.mean([(v - mean).T @ (v - mean) / len(v) for v in rows], axis=0)
    directions = np.linalg.eigh(spread)[1].T[::-1][:_KEPT]
    largest = np.take_along_axis(directions, np.abs(directions).argmax(axis=1)[:, None], axis=1)
    components = directions * np.sign(largest)
    ends = np.mean([np.percentile((v - mean) @ components.T, [_LOW, _HIGH], axis=0) for v in rows], axis=0)
    mean32, components32, ends32 = (np.ascontiguousarray(a, dtype=np.float32) for a in (mean, components, ends))
    return Reduction(mean32, components32, ends32[0], ends32[1])
