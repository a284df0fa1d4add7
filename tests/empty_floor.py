"""A floor for tests: footprints that stand in the way, and nothing to see."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from sim_bridge.mesh import Scene


def empty_floor(
    size: tuple[float, float], blocks: Sequence[tuple[float, float, float, float]], *, walk_xy: ArrayLike = ()
) -> Scene:
    """Return a floor of (x, y) in m with rectangular footprints (x0, y0, x1, y1)."""
    corners = [[x0, y0, x1, y0, x1, y1, x0, y1] for x0, y0, x1, y1 in blocks]
    return Scene(
        vertices=np.zeros((0, 3)),
        faces=np.zeros((0, 3), np.int32),
        uv=np.zeros((0, 3, 2), np.float32),
        texture=np.zeros(0, np.int32),
        textures=(),
        closed=np.zeros(0, np.bool_),
        shade=np.zeros((0, 3), np.float32),
        blocks=np.array(corners, dtype=np.float64).reshape(-1, 8),
        walk_xy=np.asarray(walk_xy, dtype=np.float64).reshape(-1, 2),
        floor_bounds=(0.0, 0.0, *size),
    )
