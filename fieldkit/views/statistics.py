"""How mapping saw each landmark: from where, at which angles, and where in its images."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from fieldkit.types import LandmarkStatistics, SceneMap

Array = NDArray[np.float64]
# Cells per side of the map of where mapping images saw a landmark, as in the paper
HEAT_CELLS = 8


def landmark_statistics(scene_map: SceneMap) -> LandmarkStatistics:
    """Collect from where mapping saw each landmark.

    Angles to the principal axis are in the camera frame (the paper's features). ``mean_direction`` and ``spread_rad``
    are directions at the landmark (Davison and Murray, 2002, section 4.2), which the policy "angle" uses.
    """
    n = len(scene_map.xyz)
    landmark, image = scene_map.observation_landmark, scene_map.observation_image
    centres = np.array([p.translation for p in scene_map.map_from_image]).reshape(-1, 3)
    axes = np.array([p.rotation.as_matrix()[:, 2] for p in scene_map.map_from_image]).reshape(-1, 3)
    ray = scene_map.xyz[landmark] - centres[image]
    distance = np.linalg.norm(ray, axis=1)
    ray = ray / np.maximum(distance, 1e-9)[:, None]
    angle = np.arccos(np.clip(np.sum(ray * axes[image], axis=1), -1.0, 1.0))
    mean = np.zeros((n, 3))
    np.add.at(mean, landmark, -ray)
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-9)[:, None]
    deviation = np.arccos(np.clip(np.sum(-ray * mean[landmark], axis=1), -1.0, 1.0))
    return LandmarkStatistics(
        min_distance_m=_extreme(np.minimum, landmark, distance, n),
        max_distance_m=_extreme(np.maximum, landmark, distance, n),
        min_angle_rad=_extreme(np.minimum, landmark, angle, n),
        max_angle_rad=_extreme(np.maximum, landmark, angle, n),
        mean_direction=mean,
        spread_rad=_extreme(np.maximum, landmark, deviation, n),
        n_observations=np.bincount(landmark, minlength=n).astype(np.int32),
    )


class HeatMaps:
    """Where in their images the mapping cameras saw each landmark of a map; made once per map and when first asked for.

    Rows of a heat map go down the image and columns to the right.
    """

    def __init__(self, scene_map: SceneMap, *, cells: int = HEAT_CELLS) -> None:
        self._map, self._cells = scene_map, cells

    @functools.cached_property
    def _rows(self) -> tuple[NDArray[np.int64], NDArray[np.integer]]:
        """Where each landmark's observations begin and end, and the cells of all observations in that order."""
        known, cells = self._map, self._cells
        sizes = np.array([(c.width, c.height) for c in known.image_cameras], dtype=np.float32).reshape(-1, 2)
        place = known.observation_px / sizes[known.observation_image]
        column, line = np.clip((place * cells).astype(np.int32), 0, cells - 1).T
        counts = np.bincount(known.observation_landmark, minlength=len(known.xyz))
        order = np.argsort(known.observation_landmark, kind="stable")
        cell = (line * cells + column).astype(np.uint8 if cells <= 16 else np.int32)
        return np.concatenate([[0], np.cumsum(counts)]), cell[order]

    def counts(self, landmarks: NDArray[np.integer]) -> NDArray[np.int64]:
        """Return int64[k, cells, cells]: how many mapping images saw each of some landmarks (k) in each cell."""
        starts, cell = self._rows
        begin, end = starts[landmarks], starts[np.asarray(landmarks) + 1]
        number = end - begin
        owner = np.repeat(np.arange(len(number)), number)
        within = np.arange(len(owner)) - np.repeat(np.cumsum(number) - number, number)
        size = self._cells**2
        index = owner * size + cell[begin[owner] + within]
        counted = np.bincount(index, minlength=len(number) * size)
        return counted.reshape(len(number), self._cells, self._cells)


def _extreme(ufunc: np.ufunc, landmark: NDArray[np.int32], values: Array, n: int) -> Array:
    result = np.full(n, np.inf if ufunc is np.minimum else -np.inf)
    ufunc.at(result, landmark, values)
    return result
