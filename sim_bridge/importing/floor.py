"""Find the floor of a mesh: its level, and where a robot and a person can stand on it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, distance_transform_edt, gaussian_filter1d, label

from sim_bridge.importing.shelter import Shelter, faces_agree, look_around
from sim_bridge.mesh import Clearance, Scene
from sim_bridge.rendering.kernels import kernel

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CELL_M = 0.05
# What rises higher than a sill and begins lower than a head is in the way.
SILL_M, HEAD_M = 0.05, 1.75
# Scanned floors are not flat: so far below the level the floor may lie.
SAG_M = 0.08
# A robot that drives is a disc of this radius.
ROBOT_RADIUS_M = 0.36
LEVEL_BIN_M = 0.02
# Levels closer than 0.3 m are one.
APART_BINS = 15
MOST_LEVELS = 8
SMALLEST_M2 = 1.0
# What lies by more than this share above a room is its ceiling.
ROOF_SHARE = 0.25
STOREY_M = 0.5


@dataclasses.dataclass(frozen=True, eq=False)
class Floor:
    """A floor: its ``level_m``, the clearance on its largest connected part, and that part's rectangle and area.

    ``driven_m2`` is the area of the places where the middle of a robot can be, ``widest_m`` the largest free radius.
    ``area_m2`` is the area of the whole level, all parts with what stands on them; ``height_m`` the room above it.
    """

    level_m: float
    clearance: Clearance
    bounds: tuple[float, float, float, float]
    free_m2: float
    driven_m2: float
    widest_m: float
    area_m2: float
    height_m: float


def find_floor(scene: Scene) -> Floor | None:
    """Return the floor with the largest connected area for a robot, None where there is no floor at all.

    Levels are where much of the mesh is horizontal. Floor is free where nothing lies between SILL_M and HEAD_M above
    it. Floor indoors, with walls around, is preferred to any other; a roof is none, and neither is the inside of
    something solid, unless the whole mesh shows its backs.
    """
    corners = scene.vertices[scene.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    twice = np.linalg.norm(cross, axis=1)
    lying = np.abs(cross[:, 2]) > 0.7 * twice
    levels = _levels(corners[lying, :, 2].mean(axis=1), 0.5 * twice[lying])
    plans = [_Plan.of(corners, corners[lying], level) for level in levels]
    shelters = _shelters(scene, plans)
    best: Floor | None = None
    for allowed in _preferences(plans, shelters):
        for plan, shelter, where in zip(plans, shelters, allowed, strict=True):
            floor = plan.floor(where, shelter.room_m)
            if best is None or _rank(floor) > _rank(best):
                best = floor
        if best is not None and best.driven_m2 >= SMALLEST_M2:
            break
    return best


def _rank(floor: Floor) -> tuple[float, float, float]:
    return floor.driven_m2, floor.widest_m, floor.area_m2


def _shelters(scene: Scene, plans: Sequence[_Plan]) -> list[Shelter]:
    """Return what is around each plan; nothing is hollow where the mesh's faces do not agree about their fronts."""
    found = [
        look_around(scene, p.ground, free=p.free, level_m=p.level_m, origin_xy=p.origin_xy, cell_m=CELL_M)
        for p in plans
    ]
    if not any(s.hollow.any() for s in found) or faces_agree(scene):
        return found
    return [dataclasses.replace(s, indoors=s.indoors | s.hollow, hollow=np.zeros_like(s.hollow)) for s in found]


def _preferences(plans: Sequence[_Plan], shelters: Sequence[Shelter]) -> Iterator[list[Mask]]:
    """Yield where on each plan the floor may be: indoors, else not on a roof; last inside, for a mesh inside out."""
    yield [s.indoors for s in shelters]
    yield [p.ground & ~s.hollow & ~_roof(p, plans, shelters) for p, s in zip(plans, shelters, strict=True)]
    if max((float(s.indoors.sum()) * CELL_M**2 for s in shelters), default=0.0) < SMALLEST_M2:
        yield [s.indoors | s.hollow for s in shelters]


def _roof(plan: _Plan, plans: Sequence[_Plan], shelters: Sequence[Shelter]) -> Mask:
    """Return the parts of a plan that lie above a room, or above what would be one in a mesh inside out."""
    above = np.zeros(plan.free.shape, np.bool_)
    middle = [o + (np.arange(n) + 0.5) * CELL_M for o, n in zip(plan.origin_xy, plan.free.shape, strict=True)]
    for lower, shelter in zip(plans, shelters, strict=True):
        if lower.level_m > plan.level_m - STOREY_M:
            continue
        room = shelter.indoors | (shelter.hollow & lower.free)
        cells = [np.floor((m - o) / CELL_M).astype(int) for m, o in zip(middle, lower.origin_xy, strict=True)]
        i, j = (np.flatnonzero((c >= 0) & (c < n)) for c, n in zip(cells, room.shape, strict=True))
        above[np.ix_(i, j)] |= room[np.ix_(cells[0][i], cells[1][j])]
    parts, count = label(plan.free, np.ones((3, 3)))
    over, whole = (np.bincount(parts.ravel(), weights=w, minlength=count + 1) for w in (above.ravel(), None))
    roof: Mask = (over > ROOF_SHARE * whole)[parts]
    return np.where(parts > 0, roof, above)


def _levels(heights: Array, areas: Array) -> list[float]:
    """Return heights at which horizontal faces have the most area, APART_BINS bins apart."""
    if not len(heights):
        return []
    low = float(heights.min()) - 0.5
    bins = ((heights - low) / LEVEL_BIN_M).astype(int)
    total = np.bincount(bins, weights=areas, minlength=int(bins.max()) + 25).astype(np.float64)
    area: Array = gaussian_filter1d(total, 1.5)
    found: list[float] = []
    least = 0.1 * area.max()
    while len(found) < MOST_LEVELS and area.max() > least:
        peak = _upper(area, int(np.argmax(area)))
        near = np.abs(heights - (low + (peak + 0.5) * LEVEL_BIN_M)) < 3 * LEVEL_BIN_M
        found.append(_surface(heights[near], areas[near]))
        area[max(0, peak - APART_BINS) : peak + APART_BINS + 1] = 0.0
    return found


def _upper(area: Array, peak: int) -> int:
    """Return the bin of the highest level near a peak with half of its area: the top of a slab, not its underside."""
    for k in range(min(peak + APART_BINS, len(area) - 2), peak, -1):
        if area[k] >= max(0.5 * area[peak], area[k - 1]) and area[k] > area[k + 1]:
            return k
    return peak


def _surface(heights: Array, areas: Array) -> float:
    """Return the height of a level: the median of its faces, or of the upper ones where they are those of a slab."""
    middle = _median(heights, areas)
    upper = heights > middle + 0.75 * LEVEL_BIN_M
    if areas[upper].sum() >= 0.5 * areas[~upper].sum():
        return _median(heights[upper], areas[upper])
    return middle


def _median(values: Array, weights: Array) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(total, 0.5 * total[-1])]])


@dataclasses.dataclass(frozen=True, eq=False)
class _Plan:
    """A level of a mesh from above: which cells are floor, ``ground``, and which of them are free, bool[nx,ny]."""

    level_m: float
    origin_xy: tuple[float, float]
    ground: Mask
    free: Mask

    @classmethod
    def of(cls, corners: Array, lying: Array, level_m: float) -> _Plan:
        near = lying[np.abs(lying[:, :, 2] - level_m).min(axis=1) < 0.5]
        low, high = near[:, :, :2].min(axis=(0, 1)), near[:, :, :2].max(axis=(0, 1))
        origin = (float(low[0]) - CELL_M, float(low[1]) - CELL_M)
        shape = tuple(int(n) for n in np.ceil((high - low) / CELL_M) + 2)
        floor, taken = np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
        _mark(lying, (level_m - SAG_M, level_m + SILL_M), origin, CELL_M, floor)
        _mark(corners, (level_m + SILL_M, level_m + HEAD_M), origin, CELL_M, taken)
        # A scan has holes where nobody looked.
        floor |= np.asarray(binary_closing(np.pad(floor, 3), np.ones((3, 3), np.bool_), iterations=3))[3:-3, 3:-3]
        return cls(level_m, origin, floor, floor & ~taken)

    def floor(self, allowed: Mask, room_m: Array) -> Floor:
        """Return the largest part of where it is allowed through which a robot can drive."""
        free, whole = self.free & allowed, self.ground & allowed
        drivable = _room(free) >= ROBOT_RADIUS_M
        parts, count = label(drivable, np.ones((3, 3)))
        sizes = np.bincount(parts.ravel(), minlength=count + 1)[1:]
        best = int(np.argmax(sizes)) + 1 if count else 0
        if count:
            # Nooks too narrow for a robot stay; what only belongs to other parts goes.
            near = [
                np.asarray(distance_transform_edt(~chosen)) * CELL_M <= ROBOT_RADIUS_M + CELL_M
                for chosen in (parts == best, drivable & (parts != best))
                if chosen.any()
            ]
            free = free & ~(near[1] & ~near[0]) if len(near) == 2 else free
            islands, _ = label(free, np.ones((3, 3)))
            free = np.isin(islands, np.unique(islands[parts == best]))
        room = np.maximum(_room(free), 0.0)
        x, y = self.origin_xy
        cells = np.argwhere(free) if free.any() else np.zeros((1, 2))
        (x0, y0), (x1, y1) = cells.min(axis=0) * CELL_M, (cells.max(axis=0) + 1) * CELL_M
        return Floor(
            level_m=self.level_m,
            clearance=Clearance(room.astype(np.float32), self.origin_xy, CELL_M),
            bounds=(float(x + x0), float(y + y0), float(x + x1), float(y + y1)),
            free_m2=float(free.sum()) * CELL_M**2,
            driven_m2=float(sizes[best - 1]) * CELL_M**2 if count else 0.0,
            widest_m=float(room.max()),
            area_m2=float(whole.sum()) * CELL_M**2,
            # Where tables stand there is less.
            height_m=float(np.percentile(room_m[whole], 75)) if whole.any() else 0.0,
        )


def _room(free: Mask) -> Array:
    """Return the distance in m from the middle of each cell to the near side of one that is not free."""
    return CELL_M * (np.asarray(distance_transform_edt(np.pad(free, 1)))[1:-1, 1:-1] - 0.5)


@kernel
def _mark(corners: Array, between: tuple[float, float], origin: tuple[float, float], cell: float, marked: Mask) -> None:
    """Mark the cells over which triangles f64[m,3,3] lie, as far as they are between two heights.

    A triangle is clipped at the heights; what is left touches a cell unless a side of either separates them.
    """
    cut, poly = np.empty((8, 3)), np.empty((8, 3))
    for m in range(corners.shape[0]):
        if min(corners[m, 0, 2], corners[m, 1, 2], corners[m, 2, 2]) > between[1]:
            continue
        if max(corners[m, 0, 2], corners[m, 1, 2], corners[m, 2, 2]) < between[0]:
            continue
        poly[:3] = corners[m]
        n = 3
        for side in range(2):
            sign, bound = (1.0, between[0]) if side == 0 else (-1.0, between[1])
            kept = 0
            for i in range(n):
                j = (i + 1) % n
                a, b = sign * (poly[i, 2] - bound), sign * (poly[j, 2] - bound)
                if a >= 0.0:
                    cut[kept] = poly[i]
                    kept += 1
                if (a > 0.0 and b < 0.0) or (a < 0.0 and b > 0.0):
                    for k in range(3):
                        cut[kept, k] = poly[i, k] + (poly[j, k] - poly[i, k]) * a / (a - b)
                    kept += 1
            n = kept
            poly[:n] = cut[:n]
        if n > 0:
            _mark_polygon(poly[:n], origin, cell, marked)


@kernel
def _mark_polygon(poly: Array, origin: tuple[float, float], cell: float, marked: Mask) -> None:
    n, half = poly.shape[0], 0.5 * cell
    i0 = max(0, int(np.floor((poly[:, 0].min() - origin[0]) / cell)))
    i1 = min(marked.shape[0] - 1, int(np.floor((poly[:, 0].max() - origin[0]) / cell)))
    j0 = max(0, int(np.floor((poly[:, 1].min() - origin[1]) / cell)))
    j1 = min(marked.shape[1] - 1, int(np.floor((poly[:, 1].max() - origin[1]) / cell)))
    for i in range(i0, i1 + 1):
        x = origin[0] + (i + 0.5) * cell
        for j in range(j0, j1 + 1):
            if marked[i, j]:
                continue
            y = origin[1] + (j + 0.5) * cell
            apart = False
            for a in range(n):
                b = (a + 1) % n
                nx, ny = poly[b, 1] - poly[a, 1], poly[a, 0] - poly[b, 0]
                reach = half * (abs(nx) + abs(ny))
                low, high = np.inf, -np.inf
                for c in range(n):
                    value = nx * (poly[c, 0] - x) + ny * (poly[c, 1] - y)
                    low, high = min(low, value), max(high, value)
                if low > reach or high < -reach:
                    apart = True
                    break
            marked[i, j] = not apart
