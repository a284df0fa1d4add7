"""Find the floor of a mesh nobody has described: its level, and where a robot has room on it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, distance_transform_edt, label

from sim_bridge.errors import SynthesisError
from sim_bridge.mesh import Clearance, Scene

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

CELL_M = 0.05
# What lies this high above the floor is in the way; a robot steps over what is lower, and goes below what is higher.
STEP_M, HEAD_M = 0.10, 1.75
# Floor may be this uneven around its level.
UNEVEN_M = 0.07
# Faces tilted less than this are floor.
FLAT_COS = 0.95
# Of several floors the lowest is taken that has this share of the largest one's free area: a roof is free, too.
NEARLY = 0.5
MOST_LEVELS = 12
LEAST_AREA_M2 = 1.0
_CHUNK_POINTS = 2_000_000


@dataclasses.dataclass(frozen=True)
class _Level:
    """A height at which much of the mesh is flat, and what of the plan is floor there, and in the way."""

    z_m: float
    floor: Flags
    blocked: Flags


def with_free_floor(scene: Scene, *, name: str, radius_m: float) -> Scene:
    """Return the scene with its floor at z = 0, and as free floor what a disc of this radius reaches on it.

    Of several floors the one with most connected free floor is taken, or a lower one that has nearly as much.
    ``name`` is the scene's in messages. Raises SynthesisError where there is no room for the disc.
    """
    found = [(level, *_reached(level, radius_m)) for level in _levels(scene)]
    areas = [float(middles.sum()) * CELL_M**2 for _, _, middles in found]
    most = max(areas, default=0.0)
    if most < LEAST_AREA_M2:
        raise SynthesisError(
            f"{name}: no free floor for a robot {2 * radius_m:g} m wide: at most {most:.1f} m2 in one piece; "
            f"expected at least {LEAST_AREA_M2:g} m2",
            hint="check that the mesh has a floor, is in metres and z is up",
        )
    level, distance_m, middles = next(f for f, area in zip(found, areas, strict=True) if area >= NEARLY * most)
    # Whatever a disc on connected free floor touches is free floor, too; the rest cannot be reached.
    reached = distance_transform_edt(~middles) * CELL_M <= radius_m
    corner = scene.bounds[0, :2] - 2 * CELL_M
    cells = np.argwhere(reached)
    low, high = corner + cells.min(axis=0) * CELL_M, corner + (cells.max(axis=0) + 1) * CELL_M
    return dataclasses.replace(
        scene,
        vertices=scene.vertices - [0.0, 0.0, level.z_m],
        floor_bounds=(float(low[0]), float(low[1]), float(high[0]), float(high[1])),
        clearance=Clearance(
            np.where(reached, distance_m, 0.0).astype(np.float32), (float(corner[0]), float(corner[1])), CELL_M
        ),
    )


def _reached(level: _Level, radius_m: float) -> tuple[Array, Flags]:
    """Return the distances in m to what is not free, and the largest connected part where a disc's middle may be."""
    # Scans have small holes in their floors.
    floor = binary_closing(level.floor, np.ones((3, 3), np.bool_), iterations=2)
    distance_m = np.asarray(distance_transform_edt(floor & ~level.blocked)) * CELL_M - CELL_M / 2
    parts, count = label(distance_m >= radius_m, np.ones((3, 3)))
    if not count:
        return distance_m, np.zeros_like(floor)
    return distance_m, parts == 1 + int(np.argmax(np.bincount(parts.ravel())[1:]))


def _levels(scene: Scene) -> list[_Level]:
    """Return the heights at which most of the mesh is flat, from the lowest to the highest."""
    a, b, c = (scene.vertices[scene.faces[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    double_area = np.linalg.norm(normal, axis=1)
    flat = np.abs(normal[:, 2]) > FLAT_COS * np.maximum(double_area, 1e-12)
    heights = (a[flat, 2] + b[flat, 2] + c[flat, 2]) / 3
    if not len(heights):
        return []
    step = UNEVEN_M
    first = float(heights.min()) - step
    bins = np.floor((heights - first) / step).astype(int)
    area = np.bincount(bins, weights=double_area[flat] / 2, minlength=int(bins.max()) + 2)
    padded = np.pad(area, 1)
    peaks = np.flatnonzero((area >= padded[:-2]) & (area > padded[2:]) & (area > LEAST_AREA_M2))
    levels = []
    for peak in sorted(peaks[np.argsort(-area[peaks])][:MOST_LEVELS]):
        near = np.abs(bins - peak) <= 1
        z = float(np.average(heights[near], weights=double_area[flat][near]))
        levels.append(z)
    return _plans(scene, levels, flat)


def _plans(scene: Scene, levels: list[float], flat: Flags) -> list[_Level]:
    """Mark in plan, for each level, the cells with floor and those with something in the way."""
    corner = scene.bounds[0, :2] - 2 * CELL_M
    shape = tuple(int(n) for n in np.ceil((scene.bounds[1, :2] - corner) / CELL_M) + 2)
    made = [_Level(z, np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)) for z in levels]
    for points, on_flat in _samples(scene, flat):
        index = np.floor((points[:, :2] - corner) / CELL_M).astype(np.int64)
        cell = np.ravel_multi_index((index[:, 0], index[:, 1]), shape)
        for level in made:
            above = points[:, 2] - level.z_m
            level.floor.ravel()[cell[on_flat & (np.abs(above) < UNEVEN_M)]] = True
            level.blocked.ravel()[cell[(above > STEP_M) & (above < HEAD_M)]] = True
    return made


def _samples(scene: Scene, flat: Flags) -> Iterator[tuple[Array, Flags]]:
    """Yield points (n, 3) all over the faces, closer together than a cell, and which lie on flat faces."""
    corners = scene.vertices[scene.faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    # Faces are cut alike whose number of cuts rounds up to the same power of two.
    power = np.ceil(np.log2(np.maximum(longest / (0.7 * CELL_M), 1.0))).astype(int)
    for p in np.unique(power):
        cuts = 2 ** int(p)
        s, t = (g.ravel() for g in np.meshgrid(np.arange(cuts + 1), np.arange(cuts + 1), indexing="ij"))
        inside = s + t <= cuts
        weights = np.stack([cuts - s - t, s, t], axis=1)[inside] / cuts
        members = np.flatnonzero(power == p)
        per_chunk = max(1, _CHUNK_POINTS // len(weights))
        for k in range(0, len(members), per_chunk):
            some = members[k : k + per_chunk]
            points = np.einsum("wc,fcx->fwx", weights, corners[some]).reshape(-1, 3)
            yield points, np.repeat(flat[some], len(weights))
