"""Policies that count visible landmarks: max and angle."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fieldkit.policies.scene import Scene
from fieldkit.views import ANGLE_SLACK_RAD

Array = NDArray[np.float64]


def most_visible(scene: Scene) -> Array:
    """Count the visible landmarks of each allowed view; f64[v], -inf where not allowed."""
    counts = np.array([len(i) for i in scene.visible.landmarks], dtype=np.float64)
    return np.where(scene.candidates.allowed, counts, -np.inf)


def viewing_angle(scene: Scene) -> Array:
    """Count the visible landmarks that are seen from a direction from which mapping saw them; f64[v].

    The direction is the one at the landmark: a landmark counts when the direction from it to the candidate lies
    within ``spread_rad`` of the mean mapping direction (Davison and Murray 2002). The learned features use angles in
    the camera frame instead.
    """
    known = scene.statistics
    counts = []
    for map_from_cam, index, x_in_cam in zip(
        scene.candidates.map_from_cam, scene.visible.landmarks, scene.visible.x_in_cam, strict=True
    ):
        towards_cam = -map_from_cam.rotation.apply(x_in_cam) if len(index) else np.zeros((0, 3))
        towards_cam /= np.maximum(np.linalg.norm(towards_cam, axis=1), 1e-9)[:, None]
        cosine = np.sum(towards_cam * known.mean_direction[index], axis=1)
        counts.append(
            np.count_nonzero(np.arccos(np.clip(cosine, -1.0, 1.0)) <= known.spread_rad[index] + ANGLE_SLACK_RAD)
        )
    return np.where(scene.candidates.allowed, np.array(counts, dtype=np.float64), -np.inf)
