"""Find the floor of a mesh: its level, and where a robot and a person can stand on it."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, distance_transform_edt, gaussian_filter1d, label

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
MOST_LEVELS = 8
# Floor lies indoors where this share of level rays ends at something: a roof or a lawn does not.
ENCLOSED_SHARE = 0.66
SMALLEST_M2 = 1.0


@dataclasses.dataclass(frozen=True, eq=False)
class Floor:
    """A floor: its ``level_m``, the clearance on its largest connected part, and that part's rectangle and area.

    ``driven_m2`` is the area of the places where the middle of a robot can be, ``widest_m`` the largest free radius.
    """

    level_m: float
    clearance: Clearance
    bounds: tuple[float, float, float, float]
    free_m2: float
    driven_m2: float
    widest_m: float


def find_floor(scene: Scene) -> Floor | None:
    """Return the floor with the largest connected area for a robot, None where there is no floor at all.

    Levels are where much of the mesh is horizontal. Floor is free where nothing lies between SILL_M and HEAD_M above
    it. Floor indoors, with walls around, is preferred to any other.
    """
    corners = scene.vertices[scene.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    twice = np.linalg.norm(cross, axis=1)
    lying = np.abs(cross[:, 2]) > 0.7 * twice
    levels = _levels(corners[lying, :, 2].mean(axis=1), 0.5 * twice[lying])
    plans = [_Plan.of(corners, corners[lying], level) for level in levels]
    best: Floor | None = None
    for indoors in (True, False):
        for plan in plans:
            floor = plan.floor(scene if indoors else None)
            if best is None or (floor.driven_m2, floor.widest_m) > (best.driven_m2, best.widest_m):
                best = floor
        if best is not None and best.driven_m2 >= SMALLEST_M2:
            break
    return best


def _levels(heights: Array, areas: Array) -> list[float]:
    """Return heights at which horizontal faces have the most area, at least 0.3 m apart."""
    if not len(heights):
        return []
    low = float(heights.min()) - 0.5
    bins = ((heights - low) / LEVEL_BIN_M).astype(int)
    area = gaussian_filter1d(np.bincount(bins, weights=areas, minlength=int(bins.max()) + 25), 1.5)
    found: list[float] = []
    least = 0.1 * area.max()
    while len(found) < MOST_LEVELS and area.max() > least:
        peak = int(np.argmax(area))
        near = np.abs(heights - (low + (peak + 0.5) * LEVEL_BIN_M)) < 3 * LEVEL_BIN_M
        found.append(_median(heights[near], areas[near]))
        area[max(0, peak - 15) : peak + 16] = 0.0
    return found


def _median(values: Array, weights: Array) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(total, 0.5 * total[-1])]])


@dataclasses.dataclass(frozen=True, eq=False)
class _Plan:
    """A level of a mesh from above: which cells are free floor, bool[nx,ny]."""

    level_m: float
    origin_xy: tuple[float, float]
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
        return cls(level_m, origin, floor & ~taken)

    def floor(self, walls: Scene | None) -> Floor:
        """Return the largest part through which a robot can drive; with ``walls`` only what they enclose."""
        free = self.free if walls is None else self.free & self._enclosed(walls)
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
        )

    def _enclosed(self, walls: Scene) -> Mask:
        """Return whether cells lie indoors, judged on squares of five cells."""
        step = 5
        shape = self.free.shape
        blocks = np.pad(self.free, [(0, -n % step) for n in shape])
        squares = blocks.reshape(blocks.shape[0] // step, step, blocks.shape[1] // step, step).any(axis=(1, 3))
        where = np.argwhere(squares)
        angles = np.linspace(0.0, 2 * np.pi, 16, endpoint=False) + 0.1
        rays = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(16)])
        middle = np.asarray(self.origin_xy) + (where + 0.5) * step * CELL_M
        eyes = np.column_stack([middle, np.full(len(middle), self.level_m + 1.1)])
        inside = np.zeros(squares.shape, np.bool_)
        hit = np.isfinite(walls.intersect(np.repeat(eyes, 16, axis=0), np.tile(rays, (len(eyes), 1))))
        inside[tuple(where.T)] = hit.reshape(-1, 16).mean(axis=1) >= ENCLOSED_SHARE
        return np.repeat(np.repeat(inside, step, axis=0), step, axis=1)[: shape[0], : shape[1]]


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
