"""A mapping walk through free floor: a closed tour that comes near everything, and the floor area that it shows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from sim_bridge.errors import SynthesisError
from sim_bridge.mesh import Scene
from sim_bridge.stage.network import walk_network
from sim_bridge.stage.paths import CELL_M, FloorGraph, floor_graph, spaced

Array = NDArray[np.float64]

# A person who carries a camera needs a disc of this radius; where that leads nowhere, less.
WALKER_RADII_M = (0.36, 0.28, 0.2)
EYE_M = 1.65
STEP_M = 0.05
# The tour passes all free floor within about this distance.
REACH_M = 1.4


def tour(scene: Scene) -> Array:
    """Return a closed polyline (n, 2) in m, about STEP_M apart, along all passages of the free floor, once each way.

    The last point leads to the first. Raises SynthesisError for a scene without free floor.
    """
    graph, radius_m = walkable(scene)
    return smoothed_loop(scene, walk_network(graph, reach_m=REACH_M), radius_m=radius_m)


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
