"""Places all over the free floor at which a robot looks around, and a round trip that leads from each to the next."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from fieldkit.frames import Pose
from fieldkit.types import ViewKind
from sim_bridge import robot
from sim_bridge.errors import SynthesisError
from sim_bridge.mesh import Scene
from sim_bridge.stage.paths import FloorGraph, floor_graph
from sim_bridge.stage.tours import largest_part, round_trip

Array = NDArray[np.float64]

# Two places at least so far apart are two.
LEAST_APART_M = 0.2


@dataclasses.dataclass(frozen=True)
class LookoutOptions:
    """How many places and directions: ``views`` arm poses in full yaw and ``pitch_deg``, one per stratum.

    The robot drives as a disc of ``drive_radius_m`` and stands as one of ``stand_radius_m``; the camera keeps
    ``clearance_m`` from everything, stowed and in the sweep. Forward looks along the way to the next place,
    ``lookahead_m`` ahead.
    """

    count: int = 100
    views: int = 50
    pitch_deg: tuple[float, float] = (-10.0, 45.0)
    drive_radius_m: float = 0.36
    stand_radius_m: float = 0.5
    clearance_m: float = 0.1
    lookahead_m: float = 1.5


@dataclasses.dataclass(frozen=True)
class Lookout:
    """A place where the robot stands, and the arm's pose per view: name, kind, joints."""

    id: str
    world_from_body: Pose
    arms: tuple[tuple[str, ViewKind, robot.ArmJoints], ...]
    next: str


def find_lookouts(scene: Scene, options: LookoutOptions, *, rng: np.random.Generator) -> tuple[Lookout, ...]:
    """Choose places spread evenly over the free floor, in the order of a short round trip through all of them.

    Raises SynthesisError when the free floor has no room for them.
    """
    graph = largest_part(floor_graph(scene, options.drive_radius_m))
    roomy = np.flatnonzero(scene.free_floor(graph.centres, options.stand_radius_m))
    if len(roomy) < options.count:
        raise SynthesisError(
            f"the scene has {len(roomy)} places where the robot can stand; expected at least {options.count}",
            hint="ask for fewer waypoints",
        )
    regions = _regions(graph.centres[roomy], options.count, rng=rng)
    places = []
    for region in range(options.count):
        cells = roomy[rng.permutation(np.flatnonzero(regions == region))]
        found = _free_place(scene, graph, cells, options, rng=rng)
        if found is not None:
            places.append(found)
    # Where the arm finds no room in a region, another one has one more.
    while len(places) < options.count:
        found = None
        if places:
            far, _ = cKDTree(graph.centres[[place.cell for place in places]]).query(graph.centres[roomy])
            farthest_first = np.argsort(-far, kind="stable")[: int(np.count_nonzero(far > LEAST_APART_M))]
            found = _free_place(scene, graph, roomy[farthest_first], options, rng=rng)
        if found is None:
            raise SynthesisError(
                f"the scene has room for {len(places)} of {options.count} waypoints: elsewhere the arm would touch "
                "furniture",
                hint="ask for fewer waypoints",
            )
        places.append(found)
    return _toured(graph, places, options)


@dataclasses.dataclass(frozen=True)
class _Place:
    """A free cell, the robot in it, and the arm's poses of its sweep."""

    cell: int
    world_from_body: Pose
    sweep: tuple[robot.ArmJoints, ...]


def _regions(points: Array, count: int, *, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return to which of ``count`` regions of about equal size each point (n, 2) belongs."""
    chosen = [int(rng.integers(len(points)))]
    far = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(far)))
        far = np.minimum(far, np.linalg.norm(points - points[chosen[-1]], axis=1))
    centres = points[chosen]
    owner = np.asarray(cKDTree(centres).query(points)[1], dtype=np.intp)
    for _ in range(8):
        size = np.maximum(np.bincount(owner, minlength=count), 1)[:, None]
        sums = np.stack([np.bincount(owner, weights=points[:, k], minlength=count) for k in range(2)], axis=1)
        after = np.asarray(cKDTree(sums / size).query(points)[1], dtype=np.intp)
        if len(np.unique(after)) < count:
            break
        owner = after
    return owner


def _free_place(
    scene: Scene, graph: FloorGraph, cells: NDArray[np.intp], options: LookoutOptions, *, rng: np.random.Generator
) -> _Place | None:
    """Return the first of these cells in which the arm can look around, the robot turned at random."""
    for cell in cells:
        body = robot.standing(graph.centres[cell], float(rng.uniform(-np.pi, np.pi)))
        sweep = _sweep(options, rng=rng)
        if _clear(scene, body, [robot.STOWED, *sweep], radius_m=options.clearance_m):
            return _Place(int(cell), body, sweep)
    return None


def _sweep(options: LookoutOptions, *, rng: np.random.Generator) -> tuple[robot.ArmJoints, ...]:
    """Return the arm's poses of a sweep: every stratum of yaw and every stratum of pitch is hit once."""
    share = (np.arange(options.views) + rng.random(options.views)) / options.views
    low, high = np.radians(options.pitch_deg)
    pitch = low + (high - low) * (rng.permutation(options.views) + rng.random(options.views)) / options.views
    return tuple(robot.looking(float(y), float(p)) for y, p in zip(-np.pi + 2 * np.pi * share, pitch, strict=True))


def _clear(scene: Scene, body: Pose, arms: Sequence[robot.ArmJoints], *, radius_m: float) -> bool:
    """Return whether nothing lies within a radius of the camera in any of these poses, by rays in 26 directions."""
    grid = np.stack(np.meshgrid(*[(-1.0, 0.0, 1.0)] * 3), axis=-1).reshape(-1, 3)
    rays = grid[np.abs(grid).sum(axis=1) > 0]
    eyes = np.array([(body * robot.body_from_camera(arm)).translation for arm in arms])
    origins, directions = np.repeat(eyes, len(rays), axis=0), np.tile(rays, (len(eyes), 1))
    return bool((scene.intersect(origins, directions) > radius_m).all())


def _toured(graph: FloorGraph, places: Sequence[_Place], options: LookoutOptions) -> tuple[Lookout, ...]:
    """Put places into the order of a short round trip and add the views stowed and forward."""
    cells = np.array([place.cell for place in places])
    cost, previous = dijkstra(graph.steps, directed=False, indices=cells, return_predecessors=True)
    order = round_trip(cost[:, cells]) if len(places) > 1 else [0]
    names = [f"w{k + 1:03d}" for k in range(len(order))]
    result = []
    for k, index in enumerate(order):
        place, following = places[index], (k + 1) % len(order)
        ahead = _ahead(graph, previous[index], place.cell, int(cells[order[following]]), options.lookahead_m)
        here = place.world_from_body
        step = here.inv().rotation.apply([*(ahead - here.translation[:2]), 0.0])
        forward = robot.looking(float(np.arctan2(step[1], step[0])), 0.0)
        arms: list[tuple[str, ViewKind, robot.ArmJoints]] = [("stowed", "stowed", robot.STOWED)]
        arms.append(("forward", "forward", forward))
        arms += [(f"s{i:03d}", "sweep", arm) for i, arm in enumerate(place.sweep)]
        result.append(Lookout(names[k], here, tuple(arms), names[following]))
    return tuple(result)


def _ahead(graph: FloorGraph, previous: NDArray[np.int32], first: int, last: int, lookahead_m: float) -> Array:
    """Return the point (2,) at which a robot looks that sets out from one cell to another."""
    way = [last]
    while way[-1] != first:
        way.append(int(previous[way[-1]]))
    path = graph.centres[way[::-1]]
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    return np.asarray(path[min(int(np.searchsorted(along, lookahead_m)), len(path) - 1)])
