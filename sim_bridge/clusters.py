"""Sort a mesh's triangles into clusters of neighbours, so that a renderer can skip many of them at once."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
Longs = NDArray[np.int64]

# So many triangles are set up together or not at all.
CLUSTER_SIZE = 64
# Bits per axis of the Morton code: 2 ** 16 cells along the longest side of a mesh.
_BITS = 16


@dataclasses.dataclass(frozen=True, eq=False)
class Clusters:
    """Triangles in an order of clusters: ``order`` int32[m] of face indices, ``starts`` int64[c+1] into it.

    ``boxes`` float64[c,6] are the clusters' bounds in the world: lowest x, y, z, then highest.
    """

    order: Ints
    starts: Longs
    boxes: Floats

    def joined(self, other: Clusters) -> Clusters:
        """Return the clusters of both."""
        return Clusters(
            np.concatenate([self.order, other.order]),
            np.concatenate([self.starts, other.starts[1:] + self.starts[-1]]),
            np.concatenate([self.boxes, other.boxes]),
        )


def clusters(vertices: Floats, faces: Ints, *, first: int = 0) -> Clusters:
    """Cut faces int32[m,3] into clusters along a Morton curve through their centres; ``first`` is the first's index."""
    count = len(faces)
    corners = vertices[faces] if count else np.zeros((0, 3, 3))
    low, high = corners.min(axis=1), corners.max(axis=1)
    order = np.argsort(_morton(0.5 * (low + high)), kind="stable")
    at = np.arange(0, count, CLUSTER_SIZE)
    boxes = np.zeros((0, 6))
    if count:
        boxes = np.hstack([np.minimum.reduceat(low[order], at), np.maximum.reduceat(high[order], at)])
    return Clusters((order + first).astype(np.int32), np.append(at, count).astype(np.int64), boxes)


def _morton(points: Floats) -> NDArray[np.uint64]:
    """Interleave the bits of points (n, 3) within their bounds: neighbours in space get neighbouring numbers."""
    if len(points) == 0:
        return np.zeros(0, np.uint64)
    low = points.min(axis=0)
    size = max(float((points - low).max()), 1e-9)
    cells = ((points - low) * ((2**_BITS - 1) / size)).astype(np.uint64)
    code = np.zeros(len(points), np.uint64)
    for bit in range(_BITS):
        for axis in range(3):
            code |= (cells[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return code
