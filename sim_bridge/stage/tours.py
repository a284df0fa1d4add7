"""A mapping walk through free floor: a short closed tour, and the floor area that is seen on the way."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from sim_bridge.errors import SynthesisError
from sim_bridge.mesh import Scene
from sim_bridge.stage.paths import CELL_M, FloorGraph, floor_graph, spaced

Array = NDArray[np.float64]

# A person who carries a camera needs a disc of this radius; where that leads nowhere, less.
WALKER_RADII_M = (0.36, 0.28, 0.2)
EYE_M = 1.65
STEP_M = 0.05
# Free floor this near to the tour counts as covered; steps beside furniture count up to threefold.
REACH_M = 1.35
# Nooks of free floor smaller than this are seen from outside.
NOOK_M2 = 0.25


def tour(scene: Scene, *, covers: float = 1.0) -> Array:
    """Return a closed polyline (n, 2) in m, about STEP_M apart, a short way past the free floor.

    The last point leads to the first. ``covers`` is the share of the connected free floor that lies within REACH_M of
    it: who walks less leaves out what costs most steps for its area, as dead ends do. Raises SynthesisError for a
    scene without free floor.
    """
    graph, radius_m = walkable(scene)
    loop = _loop(graph, _stops(graph, covers=covers))
    return smoothed_loop(scene, loop, radius_m=radius_m)


def walkable(scene: Scene) -> tuple[FloorGraph, float]:
    """Return the largest connected part of the free floor as a graph, and the walker's radius in m.

    Raises SynthesisError where not even a narrow walker finds free floor.
    """
    for radius_m in WALKER_RADII_M:
        try:
            graph = largest_part(floor_graph(scene, radius_m))
        except SynthesisError:
            if radius_m == WALKER_RADII_M[-1]:
                raise
            continue
        if len(graph.centres) * CELL_M**2 > 1.0 or radius_m == WALKER_RADII_M[-1]:
            return graph, radius_m
    raise AssertionError("unreachable")


def largest_part(graph: FloorGraph) -> FloorGraph:
    """Return the largest connected part of a floor."""
    _, part = connected_components(graph.steps, directed=False)
    kept = np.flatnonzero(part == np.argmax(np.bincount(part)))
    return FloorGraph(graph.centres[kept], csr_array(graph.steps[kept][:, kept]))


def shown_area_m2(scene: Scene, graph: FloorGraph) -> float:
    """Return the area in m2 inside the floor's bounds that is seen at eye height from the free floor.

    Furniture lower than the eyes counts, what lies behind walls does not.
    """
    x0, y0, x1, y1 = scene.floor_bounds
    if not len(scene.faces):
        return (x1 - x0) * (y1 - y0)
    cell = 0.2
    shape = (int(np.ceil((x1 - x0) / cell)), int(np.ceil((y1 - y0) / cell)))
    seen = np.zeros(shape, np.bool_)
    # Every free cell's eye would show no more than one per square of half a metre.
    _, spots = np.unique(np.floor(graph.centres / 0.5).astype(int), axis=0, return_index=True)
    angles = np.linspace(0.0, 2 * np.pi, 240, endpoint=False)
    rays = np.column_stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)])
    steps = np.arange(0.0, 12.0, cell / 2)
    for spot in graph.centres[spots]:
        free = scene.intersect([*spot, EYE_M], rays)
        along = spot + steps[:, None, None] * rays[None, :, :2]
        index = np.floor((along[steps[:, None] < free[None]] - [x0, y0]) / cell).astype(int)
        inside = ((index >= 0) & (index < shape)).all(axis=1)
        seen[tuple(index[inside].T)] = True
    return float(seen.sum()) * cell**2


def _stops(graph: FloorGraph, *, covers: float) -> NDArray[np.intp]:
    """Choose cells (k,) such that a share of all cells lies within a walk of REACH_M of one.

    First those that reach most, until all is reached; then those are left out again whose detour is the longest for
    the floor that only they reach.
    """
    # A quarter of the cells is enough to choose from.
    cells = np.round(graph.centres / CELL_M).astype(int)
    candidates = np.flatnonzero((cells % 2 == 0).all(axis=1))
    if not len(candidates):
        candidates = np.arange(len(cells))
    reached: list[NDArray[np.intp]] = []
    for chunk in np.array_split(candidates, max(1, len(candidates) // 200)):
        cost = dijkstra(graph.steps, directed=False, indices=chunk, limit=1.5 * REACH_M)
        reached += [np.flatnonzero(np.isfinite(row)) for row in cost]
    left = np.ones(len(cells), np.bool_)
    gains = np.array([len(r) for r in reached], dtype=np.float64)
    chosen: list[int] = []
    while True:
        # Gains only shrink: the best one that is still up to date is the best of all.
        best = int(np.argmax(gains))
        gain = float(left[reached[best]].sum())
        if gain < gains[best]:
            gains[best] = gain
            continue
        if chosen and gain * CELL_M**2 < NOOK_M2:
            break
        chosen.append(best)
        left[reached[best]] = False
        gains[best] = 0.0
    stops = candidates[chosen]
    if covers >= 1.0:
        return stops
    return stops[_worthwhile(graph, stops, [reached[k] for k in chosen], covers=covers)]


def _worthwhile(
    graph: FloorGraph, stops: NDArray[np.intp], reached: Sequence[NDArray[np.intp]], *, covers: float
) -> list[int]:
    """Return which stops remain when those are left out that cost the longest detour for the floor they reach."""
    cost = dijkstra(graph.steps, directed=False, indices=stops)[:, stops]
    times = np.zeros(len(graph.centres), np.intp)
    for cells in reached:
        times[cells] += 1
    least = covers * float((times > 0).sum())
    trip = round_trip(cost)
    while len(trip) > 3:
        before, after = np.roll(trip, 1), np.roll(trip, -1)
        detour = cost[before, trip] + cost[trip, after] - cost[before, after]
        alone = np.array([float((times[reached[k]] == 1).sum()) for k in trip])
        allowed = float((times > 0).sum()) - alone >= least
        if not allowed.any():
            break
        gone = int(np.argmax(np.where(allowed, detour / np.maximum(alone * CELL_M**2, NOOK_M2), -1.0)))
        times[reached[trip.pop(gone)]] -= 1
    return sorted(trip)


def _loop(graph: FloorGraph, stops: NDArray[np.intp]) -> Array:
    """Return the cells (n, 2) of a short closed walk through all stops."""
    cost, previous = dijkstra(graph.steps, directed=False, indices=stops, return_predecessors=True)
    order = round_trip(cost[:, stops])
    cells: list[int] = []
    for k, first in enumerate(order):
        last = order[(k + 1) % len(order)]
        way = [int(stops[last])]
        while way[-1] != stops[first]:
            way.append(int(previous[first, way[-1]]))
        cells += way[:0:-1] if len(way) > 1 else way
    return graph.centres[cells]


def round_trip(cost: Array) -> list[int]:
    """Return the order of a short round trip: cheapest insertion, then turning stretches around while it helps."""
    count = len(cost)
    trip, rest = [0], set(range(1, count))
    near = cost[0].copy()
    while rest:
        # The farthest stop is inserted next, where it costs least.
        stop = max(rest, key=lambda s: (near[s], s))
        after = np.roll(trip, -1)
        detour = cost[trip, stop] + cost[stop, after] - cost[trip, after]
        trip.insert(int(np.argmin(detour)) + 1, stop)
        rest.remove(stop)
        near = np.minimum(near, cost[stop])
    better = True
    while better and count > 3:
        better = False
        for i in range(count - 1):
            a, b = trip[i], trip[i + 1]
            js = np.arange(i + 2, count if i else count - 1)
            if not len(js):
                continue
            ends, nexts = np.array(trip)[js], np.array(trip)[(js + 1) % count]
            gain = cost[a, b] + cost[ends, nexts] - cost[a, ends] - cost[b, nexts]
            best = int(np.argmax(gain))
            if gain[best] > 1e-9:
                j = int(js[best])
                trip[i + 1 : j + 1] = trip[i + 1 : j + 1][::-1]
                better = True
    return trip


def smoothed_loop(scene: Scene, corners: Array, *, radius_m: float, rounds: int = 120) -> Array:
    """Return a closed polyline (n, 2), STEP_M apart, rounded wherever a disc of this radius stays on free floor."""
    path = spaced(np.vstack([corners, corners[:1]]), STEP_M)[:-1]
    for _ in range(rounds):
        moved = 0.25 * np.roll(path, 1, axis=0) + 0.5 * path + 0.25 * np.roll(path, -1, axis=0)
        free = scene.free_floor(moved, radius_m)
        path = np.where(free[:, None], moved, path)
    return spaced(np.vstack([path, path[:1]]), STEP_M)[:-1]
