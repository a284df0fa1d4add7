"""Paths of the robot through free floor, and motion along them in time."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter1d
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from sim_bridge.errors import SynthesisError
from sim_bridge.mesh import Scene

Array = NDArray[np.float64]

CELL_M = 0.1
SPACING_M = 0.02
# Costs of a step grow up to threefold towards obstacles within this distance, so that paths keep off them.
COMFORT_M = 0.5


@dataclasses.dataclass(frozen=True)
class FloorGraph:
    """Free floor as a graph: centres (n, 2) in m of the free cells, and the cost of steps to neighbouring ones."""

    centres: Array
    steps: csr_array

    def nearest(self, xy: ArrayLike) -> int:
        """Return the index of the free cell nearest to a point (2,)."""
        return int(np.argmin(np.linalg.norm(self.centres - np.asarray(xy, dtype=np.float64), axis=1)))

    def connects(self, points_xy: Sequence[ArrayLike]) -> bool:
        """Return whether points (2,) lie on free floor, give or take a cell, and ways lead from the first to all."""
        nodes = [self.nearest(xy) for xy in points_xy]
        off = np.linalg.norm(self.centres[nodes] - np.asarray(points_xy, dtype=np.float64), axis=1)
        _, component = connected_components(self.steps, directed=False)
        return bool(off.max() < 1.5 * CELL_M and (component[nodes] == component[nodes[0]]).all())


def floor_graph(scene: Scene, radius_m: float) -> FloorGraph:
    """Return the graph of the floor where a disc of this radius is free; raises SynthesisError when there is none."""
    x0, y0, x1, y1 = scene.floor_bounds
    xs, ys = np.arange(x0 + CELL_M / 2, x1, CELL_M), np.arange(y0 + CELL_M / 2, y1, CELL_M)
    grid = np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1)
    free = scene.free_floor(grid.reshape(-1, 2), radius_m).reshape(len(xs), len(ys))
    if not free.any():
        raise SynthesisError(f"the scene has no free floor for a disc of {radius_m:g} m", hint="use another scene")
    room = np.asarray(distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1]) * CELL_M
    price = 1.0 + 2.0 * np.clip(1.0 - room / COMFORT_M, 0.0, 1.0)
    index = np.full(free.shape, -1)
    index[free] = np.arange(int(free.sum()))
    rows, columns, costs = [], [], []
    for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
        a = (slice(0, len(xs) - dx), slice(max(0, -dy), len(ys) - max(0, dy)))
        b = (slice(dx, len(xs)), slice(max(0, dy), len(ys) - max(0, -dy)))
        both = free[a] & free[b]
        rows.append(index[a][both])
        columns.append(index[b][both])
        costs.append(np.hypot(dx, dy) * CELL_M * 0.5 * (price[a][both] + price[b][both]))
    count = int(free.sum())
    steps = coo_array((np.concatenate(costs), (np.concatenate(rows), np.concatenate(columns))), shape=(count, count))
    return FloorGraph(grid[free], csr_array(steps))


def plan_path(scene: Scene, graph: FloorGraph, ends_xy: tuple[ArrayLike, ArrayLike], *, radius_m: float) -> Array:
    """Return a smooth path (n, 2) in m through free floor between two points, about SPACING_M apart.

    Raises SynthesisError when no path exists.
    """
    start, goal = (np.asarray(end, dtype=np.float64) for end in ends_xy)
    first, last = graph.nearest(start), graph.nearest(goal)
    cost, previous = dijkstra(graph.steps, directed=False, indices=np.array(first), return_predecessors=True)
    if not np.isfinite(cost[last]):
        raise SynthesisError(
            f"no free path from {start.round(2).tolist()} to {goal.round(2).tolist()} for a robot of radius "
            f"{radius_m:g} m",
            hint="use another scene or seed",
        )
    cells = [last]
    while cells[-1] != first:
        cells.append(int(previous[cells[-1]]))
    corners = np.vstack([start, graph.centres[cells[::-1]][1:-1], goal])
    return _smoothed(scene, _shortened(scene, corners, radius_m), radius_m)


def _shortened(scene: Scene, corners: Array, radius_m: float) -> Array:
    """Leave out corners where the straight way is free."""
    kept, at = [0], 0
    while at < len(corners) - 1:
        ahead = len(corners) - 1
        while ahead > at + 1 and not scene.free_floor(spaced(corners[[at, ahead]], CELL_M / 2), radius_m).all():
            ahead -= 1
        kept.append(ahead)
        at = ahead
    return corners[kept]


def _smoothed(scene: Scene, corners: Array, radius_m: float) -> Array:
    """Round the corners as far as the floor is free; the ends stay where they are."""
    sharp = spaced(corners, SPACING_M)
    for sigma_m in (0.4, 0.25, 0.15, 0.08):
        width = int(np.ceil(4 * sigma_m / SPACING_M))
        # Mirrored through the ends, the filter leaves them in place.
        head = 2 * sharp[0] - sharp[min(width, len(sharp) - 1) : 0 : -1]
        tail = 2 * sharp[-1] - sharp[-2 : -min(width, len(sharp) - 1) - 2 : -1]
        smooth = gaussian_filter1d(np.vstack([head, sharp, tail]), sigma_m / SPACING_M, axis=0)
        smooth = smooth[len(head) : len(head) + len(sharp)]
        smooth[0], smooth[-1] = sharp[0], sharp[-1]
        if scene.free_floor(smooth, radius_m).all():
            return spaced(smooth, SPACING_M)
    return sharp


def spaced(corners: Array, spacing_m: float) -> Array:
    """Return points (n, 2) evenly along a polyline (k, 2), about ``spacing_m`` apart, with both ends."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    count = max(int(np.ceil(along[-1] / spacing_m)), 1) + 1
    at = np.linspace(0.0, along[-1], count)
    return np.column_stack([np.interp(at, along, corners[:, k]) for k in range(corners.shape[1])])


def headings(path: Array) -> Array:
    """Return the heading (n,) in rad along a path (n, 2), unwrapped and smoothed over a robot's length."""
    delta = np.gradient(path, axis=0)
    raw = np.unwrap(np.arctan2(delta[:, 1], delta[:, 0]))
    return gaussian_filter1d(raw, 0.15 / SPACING_M, mode="nearest")


@dataclasses.dataclass(frozen=True)
class Track:
    """Values over time, linear between samples: ``t_s`` f64[n] increasing, ``values`` f64[n, k]."""

    t_s: Array
    values: Array

    def at(self, t_s: ArrayLike) -> Array:
        """Return the values (m, k) at times (m,); constant before the first and after the last sample."""
        times = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        return np.column_stack([np.interp(times, self.t_s, self.values[:, k]) for k in range(self.values.shape[1])])


class TrackBuilder:
    """Collect motion piece by piece: hold, move, follow."""

    def __init__(self, values: ArrayLike, *, t_s: float = 0.0) -> None:
        self._t = [t_s]
        self._values = [np.asarray(values, dtype=np.float64)]

    @property
    def t_s(self) -> float:
        """Time at the end of what was collected."""
        return self._t[-1]

    @property
    def values(self) -> Array:
        """Values at the end of what was collected."""
        return self._values[-1]

    def hold(self, seconds: float) -> None:
        """Stay for a while."""
        if seconds > 0:
            self._append(self.t_s + seconds, self.values)

    def hold_until(self, t_s: float) -> None:
        """Stay until a time."""
        self.hold(t_s - self.t_s)

    def move(self, values: ArrayLike, *, seconds: float) -> None:
        """Go to other values in a time, smoothly starting and stopping."""
        goal = np.asarray(values, dtype=np.float64)
        if np.array_equal(goal, self.values):
            self.hold(seconds)
        else:
            self.follow(np.stack([self.values, goal]), seconds=seconds)

    def follow(self, values: Array, *, seconds: float) -> None:
        """Go through rows (n, k) in a time, evenly spaced in progress, smoothly starting and stopping."""
        begin = self.t_s
        steps = max(round(seconds * 50), 2)
        progress = np.linspace(0.0, 1.0, len(values))
        for i in range(1, steps + 1):
            u = i / steps
            at = u * u * (3.0 - 2.0 * u)
            row = np.array([np.interp(at, progress, values[:, k]) for k in range(values.shape[1])])
            self._append(begin + seconds * u, row)

    def build(self) -> Track:
        """Return what was collected."""
        return Track(np.array(self._t), np.stack(self._values))

    def _append(self, t_s: float, values: Array) -> None:
        self._t.append(t_s)
        self._values.append(values)
