"""The features F of the learned policies: what a view would see, and how mapping saw that; numpy only.

A *token* is one landmark in one view, a *histogram* the whole view. Everything is scaled to 0..1 and defined for views
that see nothing. It is made from the map and the candidate's pose alone, whether these come from a recording's
candidates (`seen_landmarks`) or from a stored waypoint of a dataset (`seen_in_shard`).
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from fieldkit.cameras import Camera
from fieldkit.frames import Pose
from fieldkit.store.datasets import Shard, row_pose
from fieldkit.types import Candidates, LandmarkStatistics
from fieldkit.views.statistics import HEAT_CELLS, HeatMaps
from fieldkit.views.visible import Visibility

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
TOKEN_WIDTH = 9 + HEAT_CELLS**2
BINS = 10
HISTOGRAM_WIDTH = 2 + 6 * BINS + HEAT_CELLS**2 + 2 * BINS
# Distances are divided by this, as in the paper.
FULL_DISTANCE_M = 5.0
# Counts c become log(1 + c) / log(1 + full): one of ten and ten of a hundred are told apart, and so are ten and a
# hundred. Images that saw a landmark in a cell, and landmarks of a view.
FULL_OBSERVATIONS, FULL_LANDMARKS = 32, 4096
# Angles to the principal axis beyond this (corners of a wide mapping camera) share the last bin.
FULL_ANGLE_DEG = 60.0
# How much nearer or farther than mapping a view is, and how far off the mean mapping direction: what the bins span.
FULL_OCTAVES, FULL_OFF_MEAN_DEG = 2.0, 90.0
# A direction exactly on the border of the mapped range counts, whatever the last bits of its angle are.
ANGLE_SLACK_RAD = 1e-6


def normalisation() -> dict[str, float]:
    """Return the constants of the features by name: a network only understands those that it was trained with."""
    return {
        "full_distance_m": FULL_DISTANCE_M,
        "full_observations": FULL_OBSERVATIONS,
        "full_landmarks": FULL_LANDMARKS,
        "full_angle_deg": FULL_ANGLE_DEG,
        "full_octaves": FULL_OCTAVES,
        "full_off_mean_deg": FULL_OFF_MEAN_DEG,
    }


@dataclasses.dataclass(frozen=True)
class SeenLandmarks:
    """The k landmarks that a view would see from the prior.

    ``landmark`` int32[k] index in the map; ``uv_px`` f32[k, 2]; ``distance_m`` f32[k] from the camera; ``angle_rad``
    f32[k] between the viewing ray and the principal axis; ``off_mean_rad`` f32[k], at the landmark, between the
    direction to the camera and the mean direction from which mapping saw it. ``visible`` is how many the view would
    see before some were chosen among them.
    """

    landmark: NDArray[np.int32]
    uv_px: Floats
    distance_m: Floats
    angle_rad: Floats
    off_mean_rad: Floats
    visible: int

    def without(self, index: int) -> SeenLandmarks:
        """Return what would be seen if one of the landmarks were not there."""
        left = self.rows(np.delete(np.arange(len(self.landmark)), index))
        return dataclasses.replace(left, visible=self.visible - 1)

    def rows(self, rows: NDArray[np.integer]) -> SeenLandmarks:
        """Return some of the landmarks, chosen among all."""
        return SeenLandmarks(
            self.landmark[rows],
            self.uv_px[rows],
            self.distance_m[rows],
            self.angle_rad[rows],
            self.off_mean_rad[rows],
            self.visible,
        )


def seen_landmarks(
    visible: Visibility, candidates: Candidates, *, statistics: LandmarkStatistics
) -> tuple[SeenLandmarks, ...]:
    """Return what each candidate would see."""
    views = zip(visible.landmarks, visible.x_in_cam, visible.uv_px, candidates.map_from_cam, strict=True)
    return tuple(_seen(*view, statistics) for view in views)


def seen_in_shard(
    shard: Shard, view: int, *, xyz: Array, statistics: LandmarkStatistics, occlusion: bool
) -> SeenLandmarks:
    """Return what a view of a dataset's waypoint would see from the prior, in its map's landmarks ``xyz`` f64[n, 3].

    With ``occlusion`` the landmarks behind the map's surface are left out.
    """
    rows = np.arange(shard.starts[view], shard.starts[view + 1])
    if occlusion:
        rows = rows[~shard.occluded[rows]]
    map_from_cam = row_pose(shard.candidate[view])
    landmark = shard.landmark[rows]
    return _seen(landmark, map_from_cam.inv().apply(xyz[landmark]), shard.uv_px[rows], map_from_cam, statistics)


def _seen(
    landmark: NDArray[np.int32], x_in_cam: Array, uv_px: Floats, map_from_cam: Pose, statistics: LandmarkStatistics
) -> SeenLandmarks:
    distance = np.sqrt(np.einsum("ij,ij->i", x_in_cam, x_in_cam))
    ray = x_in_cam / np.maximum(distance, 1e-9)[:, None]
    mean_in_cam = statistics.mean_direction[landmark] @ map_from_cam.rotation.as_matrix()
    towards = -np.einsum("ij,ij->i", ray, mean_in_cam)
    return SeenLandmarks(
        landmark=landmark.astype(np.int32, copy=False),
        uv_px=uv_px,
        distance_m=distance.astype(np.float32),
        angle_rad=np.arccos(np.clip(ray[:, 2], -1.0, 1.0)).astype(np.float32),
        off_mean_rad=np.arccos(np.clip(towards, -1.0, 1.0)).astype(np.float32),
        visible=len(landmark),
    )


def thinned(seen: SeenLandmarks, *, cap: int, seed: int = 0) -> SeenLandmarks:
    """Return at most ``cap`` of the landmarks, the same whenever map and seed are.

    Every landmark of the map has one random rank per seed, and a view keeps those that rank first: views that overlap
    keep the same landmarks, so that chance does not tell them apart.
    """
    if len(seen.landmark) <= cap:
        return seen
    return seen.rows(np.sort(np.argpartition(_ranks(seen.landmark, seed), cap)[:cap]))


def _ranks(landmark: NDArray[np.int32], seed: int) -> NDArray[np.uint64]:
    """Return a random number per landmark and seed (splitmix64, Steele et al. 2014), without one for all of the map."""
    z = landmark.astype(np.uint64) + np.uint64(seed * 0xD1342543DE82EF95 % 2**64)
    z = (z + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(z ^ (z >> np.uint64(31)), dtype=np.uint64)


def landmark_tokens(
    seen: SeenLandmarks,
    statistics: LandmarkStatistics,
    *,
    heat_maps: HeatMaps,
    camera: Camera,
    appearance: Floats | None = None,
) -> Floats:
    """Return a token per landmark, f32[k, 73], or f32[k, 76] with the ``appearance`` f32[n, 3] of the map's landmarks.

    Columns, all 0..1: 0 distance, 1, 2 the smallest and largest distance of mapping, / 5 m; 3 angle to the principal
    axis, 4, 5 the smallest and largest one of mapping, 6 angle off the mean mapping direction at the landmark, / pi;
    7 u / width, 8 v / height; 9..72 how many mapping images saw it in each of 8x8 cells, row by row, as
    log(1 + count) / log(33); 73..75 appearance.
    """
    i = seen.landmark
    tokens = np.empty((len(i), TOKEN_WIDTH + (0 if appearance is None else appearance.shape[1])), dtype=np.float32)
    tokens[:, 0] = seen.distance_m / FULL_DISTANCE_M
    tokens[:, 1] = statistics.min_distance_m[i] / FULL_DISTANCE_M
    tokens[:, 2] = statistics.max_distance_m[i] / FULL_DISTANCE_M
    tokens[:, 3] = seen.angle_rad / np.pi
    tokens[:, 4] = statistics.min_angle_rad[i] / np.pi
    tokens[:, 5] = statistics.max_angle_rad[i] / np.pi
    tokens[:, 6] = seen.off_mean_rad / np.pi
    tokens[:, 7:9] = seen.uv_px / (camera.width, camera.height)
    tokens[:, 9:TOKEN_WIDTH] = _log_share(heat_maps.counts(i).reshape(len(i), HEAT_CELLS**2), FULL_OBSERVATIONS)
    if appearance is not None:
        tokens[:, TOKEN_WIDTH:] = appearance[i]
    return np.clip(tokens, 0.0, 1.0, out=tokens)


def view_histograms(seen: SeenLandmarks, statistics: LandmarkStatistics, *, camera: Camera) -> Floats:
    """Return the features f32[146] of a whole view, all log(1 + number of landmarks) / log(4097).

    0 all landmarks; 1 those seen from a direction from which mapping saw them (at the landmark, as the policy "angle"
    counts); 2..41 histograms of ten bins: smallest and largest distance of mapping over 0..5 m, smallest and largest
    angle to the principal axis over 0..60 deg; 42..51 the view's distance against that of mapping, as octaves of
    distance / sqrt(smallest * largest) over -2..2; 52..61 its angle against that of mapping, at the landmark off the
    mean direction, over 0..90 deg; 62..125 image positions in 8x8 cells, row by row; 126..145 histograms of u and v.
    What lies beyond the bins counts in the first or last.
    """
    i = seen.landmark
    nearest, farthest = statistics.min_distance_m[i], statistics.max_distance_m[i]
    least, most = statistics.min_angle_rad[i], statistics.max_angle_rad[i]
    # A landmark without an observation, as a foreign map may have one, is no nearer or farther than mapping.
    middle = np.where(nearest * farthest > 0.0, nearest * farthest, np.square(seen.distance_m, dtype=np.float64))
    octaves = np.log2(seen.distance_m / np.sqrt(np.maximum(middle, 1e-18)))
    u, v = (seen.uv_px / (camera.width, camera.height)).T
    cells = HEAT_CELLS
    column, line = (np.clip((x * cells).astype(np.int64), 0, cells - 1) for x in (u, v))
    places = [
        BINS * nearest / FULL_DISTANCE_M,
        BINS * farthest / FULL_DISTANCE_M,
        BINS * least / np.radians(FULL_ANGLE_DEG),
        BINS * most / np.radians(FULL_ANGLE_DEG),
        BINS * (octaves / FULL_OCTAVES + 1.0) / 2.0,
        BINS * seen.off_mean_rad / np.radians(FULL_OFF_MEAN_DEG),
        line * cells + column,
        BINS * u,
        BINS * v,
    ]
    bins = [BINS] * 6 + [cells**2, BINS, BINS]
    inside = np.count_nonzero(seen.off_mean_rad <= statistics.spread_rad[i] + ANGLE_SLACK_RAD)
    counts = [np.array([len(i), inside])]
    for place, n in zip(places, bins, strict=True):
        counts.append(np.bincount(np.clip(place, 0, n - 1).astype(np.int64), minlength=n))
    return _log_share(np.concatenate(counts), FULL_LANDMARKS)


def _log_share(counts: NDArray[np.integer], full: int) -> Floats:
    shares: Floats = np.log1p(counts, dtype=np.float32) / np.float32(np.log1p(full))
    return np.minimum(shares, np.float32(1.0))
