"""Where things of a blueprint may stand: not in each other, on something, and leaving all ways open."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from fieldkit.frames import Pose
from sim_bridge.errors import SynthesisError
from sim_bridge.mesh import Array, Scene
from sim_bridge.scenes.blueprint import Block, Blueprint, Kind, Quad, Thing
from sim_bridge.scenes.light import unlit

CELL_M = 0.1
# Floor that may be cut off from the rest by a change: a corner behind a chair.
LOST_CELLS = 30
# Things keep this far from each other, and what lies on something may reach over its edge by this share.
GAP_M = 0.015
OVERHANG = 0.8
# Something lies on a surface at most this far below it.
TOUCH_M = 0.015
# A sheet is no obstacle.
FLAT_M = 0.01


@dataclasses.dataclass(frozen=True, eq=False)
class Item:
    """A thing with all that belongs to it: its outlines in plan f64[k,4,2], and its lowest and highest point.

    ``on`` is the index of the thing that it lies on, None for what stands on the floor or hangs.
    """

    thing: Thing
    quads: tuple[Quad, ...]
    blocks: tuple[Block, ...]
    outlines: Array
    low_m: float
    high_m: float
    on: int | None = None

    @property
    def stands(self) -> bool:
        """Whether it stands on the floor."""
        return self.on is None and self.low_m < 0.05

    def carried(self, new_from_old: Pose) -> Item:
        """Return the thing moved by a turn about the vertical and a step in plan."""
        turned = new_from_old.rotation
        quads = tuple(
            dataclasses.replace(q, corners=new_from_old.apply(q.corners), normal=turned.apply(q.normal))
            for q in self.quads
        )
        blocks = tuple(dataclasses.replace(b, corners_xy=_in_plan(new_from_old, b.corners_xy)) for b in self.blocks)
        outlines = _in_plan(new_from_old, self.outlines.reshape(-1, 2)).reshape(-1, 4, 2)
        thing = dataclasses.replace(self.thing, world_from_thing=new_from_old * self.thing.world_from_thing)
        return dataclasses.replace(self, thing=thing, quads=quads, blocks=blocks, outlines=outlines)


class Items:
    """All things of a blueprint while they are moved about; number 0 is the building."""

    def __init__(self, items: list[Item | None]) -> None:
        self._items = items
        self._circles = np.array([_circle(item) for item in items]).reshape(-1, 3)

    @classmethod
    def of(cls, blueprint: Blueprint) -> Items:
        """Sort rectangles and footprints by the things they belong to, and find what lies on what."""
        quads: list[list[Quad]] = [[] for _ in blueprint.things]
        blocks: list[list[Block]] = [[] for _ in blueprint.things]
        for quad in blueprint.quads:
            quads[quad.thing].append(quad)
        for block in blueprint.blocks:
            blocks[block.thing].append(block)
        items: list[Item | None] = [_item(*parts) for parts in zip(blueprint.things, quads, blocks, strict=True)]
        tops = _Tops.of(blueprint.quads)
        for index, item in enumerate(items):
            if item is not None and index and item.low_m > 0.05:
                items[index] = dataclasses.replace(item, on=tops.below(item.outlines[0], item.low_m, but=index))
        return cls(items)

    def __getitem__(self, index: int) -> Item:
        item = self._items[index]
        assert item is not None
        return item

    def __contains__(self, index: int) -> bool:
        return self._items[index] is not None

    def indices(self, kind: Kind) -> list[int]:
        """Return the numbers of the things of a kind that can be changed: they stand or lie somewhere."""
        found = [(n, item) for n, item in enumerate(self._items) if item is not None and item.thing.kind == kind]
        return [n for n, item in found if item.stands or item.on is not None]

    def fits(self, item: Item, *, but: int | None = None) -> bool:
        """Return whether a thing at its place touches no other, except ``but``, and lies on what it lay on."""
        if item.on is not None:
            holder = self._items[item.on]
            if holder is None or _Tops.of(holder.quads).below(item.outlines[0], item.low_m, but=-1) is None:
                return False
        if item.high_m - item.low_m < FLAT_M:
            return True
        middle = item.outlines.reshape(-1, 2).mean(axis=0)
        away = np.linalg.norm(self._circles[:, :2] - middle, axis=1) - self._circles[:, 2] - _circle(item)[2]
        passed = {but, item.on, *(() if but is None else self._riders(but))}
        for number in np.flatnonzero(away < GAP_M):
            other = self._items[number]
            if other is None or number in passed:
                continue
            if other.high_m - FLAT_M < item.low_m or other.low_m > item.high_m - FLAT_M:
                continue
            if any(overlaps(outline, other.outlines, gap_m=GAP_M).any() for outline in item.outlines):
                return False
        return True

    def put(self, index: int, there: Item) -> None:
        """Put a thing elsewhere, with all that lies on it."""
        before = self[index].thing.world_from_thing
        new_from_old = there.thing.world_from_thing * before.inv()
        for rider in self._riders(index):
            self._set(rider, self[rider].carried(new_from_old))
        self._set(index, there)

    def remove(self, index: int) -> None:
        """Take a thing away, with all that lies on it."""
        for rider in self._riders(index):
            self._set(rider, None)
        self._set(index, None)

    def add(self, item: Item) -> None:
        """Add a thing; what lies on it is not copied."""
        number = len(self._items)
        quads = tuple(dataclasses.replace(q, thing=number) for q in item.quads)
        blocks = tuple(dataclasses.replace(b, thing=number) for b in item.blocks)
        self._items.append(None)
        self._circles = np.vstack([self._circles, _circle(item)])
        self._set(number, dataclasses.replace(item, quads=quads, blocks=blocks))

    def built(self) -> tuple[list[Quad], list[Block], list[Thing]]:
        """Return all rectangles, footprints and things; removed things keep their numbers, with nothing of theirs."""
        there = [item for item in self._items if item is not None]
        nothing = self[0].thing
        things = [nothing if item is None else item.thing for item in self._items]
        return [q for i in there for q in i.quads], [b for i in there for b in i.blocks], things

    def _set(self, index: int, item: Item | None) -> None:
        self._items[index] = item
        self._circles[index] = _circle(item)

    def _riders(self, index: int) -> tuple[int, ...]:
        """Return what lies on a thing, and on that, and so on."""
        direct = [n for n, item in enumerate(self._items) if item is not None and item.on == index]
        return (*direct, *(r for n in direct for r in self._riders(n)))


@dataclasses.dataclass(frozen=True, eq=False)
class _Tops:
    """The level rectangles on which something may lie."""

    corners: Array
    thing: NDArray[np.int64]

    @classmethod
    def of(cls, quads: tuple[Quad, ...]) -> _Tops:
        level = [q for q in quads if q.normal[2] > 0.99]
        corners = np.array([q.corners for q in level]).reshape(-1, 4, 3)
        return cls(corners, np.array([q.thing for q in level], dtype=np.int64))

    def below(self, outline: Array, low_m: float, *, but: int) -> int | None:
        """Return the thing whose top is just below an outline (4, 2) and carries it; None where there is none."""
        heights = self.corners[:, 0, 2]
        near = (heights <= low_m + 0.003) & (heights >= low_m - TOUCH_M) & (self.thing != but) & (self.thing != 0)
        middle = outline.mean(axis=0)
        shrunk = middle + OVERHANG * (outline - middle)
        for number in np.flatnonzero(near):
            if _inside(shrunk, self.corners[number, :, :2]):
                return int(self.thing[number])
        return None


@dataclasses.dataclass(eq=False)
class Floor:
    """The floor where a disc of some radius is free, as cells; it shrinks by what is put on it.

    ``cells`` (n, 2) are the centres of those that were connected at first.
    """

    cells: Array
    _scene: Scene
    _radius_m: float
    _grid: Array
    _free: NDArray[np.bool_]
    _connected: NDArray[np.bool_]

    @classmethod
    def of(cls, blueprint: Blueprint, radius_m: float) -> Floor:
        """Find the free floor of a blueprint; raises SynthesisError where there is none."""
        scene = unlit(blueprint)
        x0, y0, x1, y1 = blueprint.floor_bounds
        axes = (np.arange(low + CELL_M / 2, high, CELL_M) for low, high in ((x0, x1), (y0, y1)))
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        free = scene.free_floor(grid.reshape(-1, 2), radius_m).reshape(grid.shape[:2])
        if not free.any():
            raise SynthesisError(
                f"no floor is free for a disc of {radius_m:g} m; expected passages of this radius",
                hint="choose a smaller passage_m",
            )
        connected = _largest(free)
        return cls(grid[connected], scene, radius_m, grid, free, connected)

    def take(self, item: Item) -> bool:
        """Let a thing take its floor and return True, or False where that would cut a way off or leave the floor."""
        if not item.blocks:
            return not item.stands or self._on_floor(item)
        if not self._on_floor(item):
            return False
        blocks = np.array([b.corners_xy.reshape(8) for b in item.blocks])
        corners = blocks.reshape(-1, 2)
        low, high = corners.min(axis=0) - self._radius_m, corners.max(axis=0) + self._radius_m
        near = ((self._grid >= low) & (self._grid <= high)).all(axis=2)
        free = self._free.copy()
        alone = dataclasses.replace(self._scene, blocks=blocks)
        free[near] &= alone.free_floor(self._grid[near], self._radius_m)
        left = free & self._connected
        if int((left & ~_largest(left)).sum()) > LOST_CELLS:
            return False
        self._free = free
        return True

    def _on_floor(self, item: Item) -> bool:
        """Return whether a thing stands inside the floor's bounds, and where the floor can be reached."""
        x0, y0, x1, y1 = self._scene.floor_bounds
        points = item.outlines.reshape(-1, 2)
        inside = bool((points > [x0, y0]).all() and (points < [x1, y1]).all())
        middle = points.mean(axis=0)
        return inside and bool(np.linalg.norm(self.cells - middle, axis=1).min() < 0.8)


def overlaps(outline: Array, others: Array, *, gap_m: float = 0.0) -> NDArray[np.bool_]:
    """Return bool[k]: whether a convex outline (4, 2) overlaps others (k, 4, 2), by separating axes."""
    apart = np.zeros(len(others), dtype=bool)
    for edges in (_normals(outline)[None], _normals(others)):
        axes = np.broadcast_to(edges, (len(others), 4, 2))
        own = np.einsum("kaj,cj->kac", axes, outline)
        their = np.einsum("kaj,kcj->kac", axes, others)
        gap = np.maximum(their.min(axis=2) - own.max(axis=2), own.min(axis=2) - their.max(axis=2))
        apart |= (gap > gap_m).any(axis=1)
    return ~apart


def _normals(outlines: Array) -> Array:
    edges = np.roll(outlines, -1, axis=-2) - outlines
    unit = edges / np.maximum(np.linalg.norm(edges, axis=-1, keepdims=True), 1e-12)
    return np.stack([unit[..., 1], -unit[..., 0]], axis=-1)


def _item(thing: Thing, quads: list[Quad], blocks: list[Block]) -> Item | None:
    """Return a thing with its parts; its outlines are its footprints, or else its extent in its own directions."""
    if not quads and not blocks:
        return None
    points = np.concatenate([q.corners for q in quads]) if quads else np.zeros((1, 3))
    outlines = np.zeros((0, 4, 2))
    if blocks:
        outlines = np.array([b.corners_xy for b in blocks])
    elif thing.kind != "building":
        x, y, _ = thing.world_from_thing.rotation.apply([1.0, 0.0, 0.0])
        along = np.array([x, y]) / max(float(np.hypot(x, y)), 1e-9)
        axes = np.stack([along, [-along[1], along[0]]])
        spread = points[:, :2] @ axes.T
        (a, b), (c, d) = spread.min(axis=0), spread.max(axis=0)
        outlines = (np.array([[a, b], [c, b], [c, d], [a, d]]) @ axes)[None]
    low, high = (float(v) for v in (points[:, 2].min(), points[:, 2].max()))
    return Item(thing, tuple(quads), tuple(blocks), outlines, low, high)


def _circle(item: Item | None) -> tuple[float, float, float]:
    """Return a circle x, y, radius around the outlines of a thing; one that touches nothing for none."""
    if item is None or not len(item.outlines):
        return 0.0, 0.0, -np.inf
    points = item.outlines.reshape(-1, 2)
    x, y = points.mean(axis=0)
    return float(x), float(y), float(np.linalg.norm(points - (x, y), axis=1).max())


def _in_plan(new_from_old: Pose, points_xy: Array) -> Array:
    flat = np.column_stack([points_xy, np.zeros(len(points_xy))])
    moved: Array = new_from_old.apply(flat)[:, :2]
    return moved


def _inside(points: Array, corners: Array) -> bool:
    """Return whether points (n, 2) all lie in a convex outline (4, 2)."""
    edges = np.roll(corners, -1, axis=0) - corners
    delta = points[:, None] - corners[None]
    side = edges[:, 0] * delta[..., 1] - edges[:, 1] * delta[..., 0]
    return bool((side >= -1e-9).all() or (side <= 1e-9).all())


def _largest(free: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the largest connected part of a grid."""
    numbers, count = label(free)
    if count == 0:
        return free
    sizes = np.bincount(numbers.ravel())
    sizes[0] = 0
    result: NDArray[np.bool_] = numbers == int(sizes.argmax())
    return result
