"""Policies that do not look at the map: stowed, forward, random."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fieldkit.policies.scene import Scene

Array = NDArray[np.float64]


def stowed(scene: Scene) -> Array:
    """Choose the recorded view with the arm folded; utilities f64[v], all -inf where there is none."""
    return np.where([k == "stowed" for k in scene.candidates.kinds], 0.0, -np.inf)


def forward(scene: Scene) -> Array:
    """Choose the recorded forward view, else the allowed view nearest to the direction of the path; f64[v].

    The utility is the negative angle (rad) between optical axis and path, so a recording without a forward view
    still has the row.
    """
    recorded = np.array([k == "forward" for k in scene.candidates.kinds])
    if recorded.any():
        return np.where(recorded, 0.0, -np.inf)
    if scene.candidates.forward_in_map is None:
        return np.full(len(scene.candidates.view_ids), -np.inf)
    axes = np.array([p.rotation.as_matrix()[:, 2] for p in scene.candidates.map_from_cam])
    angle = np.arccos(np.clip(axes @ scene.candidates.forward_in_map, -1.0, 1.0))
    return np.where(scene.candidates.allowed, -angle, -np.inf)


def random(scene: Scene) -> Array:
    """Tie all allowed views: scored as the exact expectation over them, without a dice; f64[v]."""
    return np.where(scene.candidates.allowed, 0.0, -np.inf)
