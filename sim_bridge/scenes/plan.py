"""The parts of a building that every scene has: walls with openings, windows, floors, ceilings, what is outside."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from fieldkit.frames import Pose, yaw_pose
from sim_bridge.scenes.blueprint import Builder

Rect = tuple[float, float, float, float]

THICKNESS_M = 0.12
_SKIRTING_M = (0.012, 0.08)


@dataclasses.dataclass(frozen=True)
class Opening:
    """A hole in a wall: its middle from the wall's start, width, top and bottom in m; bottom 0 is a passage."""

    at_m: float
    width_m: float
    top_m: float = 2.1
    bottom_m: float = 0.0

    @property
    def start_m(self) -> float:
        """Where it begins, in m from the wall's start."""
        return self.at_m - self.width_m / 2

    @property
    def stop_m(self) -> float:
        """Where it ends, in m from the wall's start."""
        return self.at_m + self.width_m / 2


def on_wall(place: Pose, along_m: float, up_m: float, *, off_m: float) -> Pose:
    """Return the pose of a picture on a wall: x right, y up, z into the room, off the wall by off_m.

    ``place`` is the wall's frame: x along it, y into the room, z up.
    """
    facing = Rotation.from_matrix([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    return place * Pose.from_components([along_m, off_m, up_m], facing)


def wall_frame(
    start_xy: ArrayLike,
    end_xy: ArrayLike,
    at_m: float,
    *,
    thickness_m: float = THICKNESS_M,
    side: Literal["left", "right"] = "left",
) -> Pose:
    """Return a frame on a face of a wall: origin on the floor ``at_m`` from the start, y off the wall, z up.

    On the left face (left as one walks from start to end) x runs from start to end, on the right face back.
    """
    middle = _frame(start_xy, end_xy) * yaw_pose([at_m, 0.0, 0.0], 0.0 if side == "left" else np.pi)
    return middle * yaw_pose([0.0, thickness_m / 2, 0.0], 0.0)


def _frame(start_xy: ArrayLike, end_xy: ArrayLike) -> Pose:
    start, end = (np.asarray(p, dtype=np.float64) for p in (start_xy, end_xy))
    yaw = float(np.arctan2(end[1] - start[1], end[0] - start[0]))
    return yaw_pose([start[0], start[1], 0.0], yaw)


def wall(
    build: Builder,
    start_xy: ArrayLike,
    end_xy: ArrayLike,
    *,
    height_m: float,
    thickness_m: float = THICKNESS_M,
    openings: Sequence[Opening] = (),
    left: int | None,
    right: int | None,
    trim: int | None = None,
    cell_m: float = 0.25,
) -> None:
    """Add a wall from floor to ceiling along a line in plan, with the footprints of its closed parts.

    ``left`` and ``right`` are the textures of its faces as one walks from start to end. A texture spans the whole
    face (seen from its own side, first row at the ceiling), and a part of the wall shows its part. ``trim`` is the
    texture of a skirting board. A face that nobody sees may be None. Walls of one thickness may end on each other's
    line: both ends reach half a thickness (less 1 mm, so that no faces coincide) beyond it. Raises ValueError for
    openings that do not fit.
    """
    line = np.asarray(end_xy, dtype=np.float64) - np.asarray(start_xy, dtype=np.float64)
    body = _Wall(_frame(start_xy, end_xy), float(np.hypot(*line)), height_m, thickness_m)
    holes = sorted(openings, key=lambda o: o.at_m)
    edges = [-body.reach_m, *(s for o in holes for s in (o.start_m, o.stop_m)), body.length_m + body.reach_m]
    if any(b < a for a, b in itertools.pairwise(edges)):
        raise ValueError(f"openings overlap or leave the wall of {body.length_m:.2f} m")
    inner = left if left is not None else right
    if inner is None:
        raise ValueError("a wall needs at least one face")
    for along, up in body.closed_parts(holes):
        body.faces(build, along, up, textures=(left, right), cell_m=cell_m)
    for hole in holes:
        body.reveal(build, hole, inner)
    body.caps(build, inner)
    passages = [s for o in holes if o.bottom_m == 0.0 for s in (o.start_m, o.stop_m)]
    ends = [edges[0], *passages, edges[-1]]
    for start, stop in zip(ends[::2], ends[1::2], strict=True):
        if stop > start:
            body.footprint(build, (start, stop), trim)


def _inside(along_m: float, opening: Opening) -> bool:
    return opening.start_m < along_m < opening.stop_m


@dataclasses.dataclass(frozen=True)
class _Wall:
    """A wall's frame (at its start, x along, y left, z up) and size."""

    frame: Pose
    length_m: float
    height_m: float
    thickness_m: float

    @property
    def reach_m(self) -> float:
        return self.thickness_m / 2 - 0.001

    def uv(self, along: tuple[float, float], up: tuple[float, float]) -> Rect:
        """Return the part of the right face's texture; the left face's runs the other way."""
        left, right = ((s + self.reach_m) / (self.length_m + 2 * self.reach_m) for s in along)
        return left, 1.0 - up[1] / self.height_m, right, 1.0 - up[0] / self.height_m

    def closed_parts(self, holes: Sequence[Opening]) -> list[tuple[tuple[float, float], tuple[float, float]]]:
        """Return the rectangles that remain beside, above and below openings: (along, up) intervals in m."""
        # The parts that other walls' ends cover are cut off, or their darkness would bleed into the rest.
        near, far = self.thickness_m / 2, self.length_m - self.thickness_m / 2
        cuts = {s for s in (near, far) if not any(_inside(s, o) for o in holes)}
        cuts |= {-self.reach_m, self.length_m + self.reach_m}
        cuts |= {s for o in holes for s in (o.start_m, o.stop_m)}
        parts = []
        for along in itertools.pairwise(sorted(cuts)):
            hole = next((o for o in holes if _inside(sum(along) / 2, o)), None)
            if hole is None:
                parts.append((along, (0.0, self.height_m)))
                continue
            sides = ((0.0, hole.bottom_m), (min(hole.top_m, self.height_m), self.height_m))
            parts += [(along, up) for up in sides if up[1] - up[0] > 1e-6]
        return parts

    def faces(
        self,
        build: Builder,
        along: tuple[float, float],
        up: tuple[float, float],
        *,
        textures: tuple[int | None, int | None],
        cell_m: float,
    ) -> None:
        s, z = sum(along) / 2, sum(up) / 2
        size = (along[1] - along[0], up[1] - up[0])
        u0, v0, u1, v1 = self.uv(along, up)
        off = self.thickness_m / 2
        if textures[0] is not None:
            front = on_wall(self.frame, s, z, off_m=off)
            build.panel(front, size, textures[0], cell_m=cell_m, uv=(1 - u1, v0, 1 - u0, v1))
        if textures[1] is not None:
            back = self.frame * yaw_pose([s, 0.0, 0.0], np.pi)
            build.panel(on_wall(back, 0.0, z, off_m=off), size, textures[1], cell_m=cell_m, uv=(u0, v0, u1, v1))

    def reveal(self, build: Builder, hole: Opening, texture: int) -> None:
        top = min(hole.top_m, self.height_m)
        self._across(build, hole.start_m, -np.pi / 2, (hole.bottom_m, top), texture)
        self._across(build, hole.stop_m, np.pi / 2, (hole.bottom_m, top), texture)
        size = (hole.width_m, self.thickness_m)
        u0, v0, u1, v1 = self.uv((hole.start_m, hole.stop_m), (hole.bottom_m, top))
        levels = [(top, np.pi, v0)] if top < self.height_m else []
        levels += [(hole.bottom_m, 0.0, v1)] if hole.bottom_m > 0.0 else []
        for z, tilt, v in levels:
            at = self.frame * Pose.from_components([hole.at_m, 0.0, z], Rotation.from_euler("x", tilt))
            build.panel(at, size, texture, uv=(1 - u1, v, 1 - u0, v))

    def caps(self, build: Builder, texture: int) -> None:
        self._across(build, -self.reach_m, np.pi / 2, (0.0, self.height_m), texture)
        self._across(build, self.length_m + self.reach_m, -np.pi / 2, (0.0, self.height_m), texture)

    def _across(self, build: Builder, s: float, yaw: float, up: tuple[float, float], texture: int) -> None:
        """Add a face across the wall, which shows one column of the left face's texture."""
        at = on_wall(self.frame * yaw_pose([s, 0.0, 0.0], yaw), 0.0, sum(up) / 2, off_m=0.0)
        u, v0, _, v1 = self.uv((s, s), up)
        build.panel(at, (self.thickness_m, up[1] - up[0]), texture, uv=(1 - u, v0, 1 - u, v1))

    def footprint(self, build: Builder, along: tuple[float, float], trim: int | None) -> None:
        place = self.frame * yaw_pose([sum(along) / 2, 0.0, 0.0], 0.0)
        length = along[1] - along[0]
        build.block(place, (length, self.thickness_m))
        if trim is not None:
            deep, high = _SKIRTING_M
            for y in (-1, 1):
                centre = [0.0, y * (self.thickness_m + deep) / 2, high / 2]
                build.box(place, centre, [length, deep - 0.001, high], trim)


def window(
    build: Builder,
    start_xy: ArrayLike,
    end_xy: ArrayLike,
    opening: Opening,
    *,
    thickness_m: float = THICKNESS_M,
    side: Literal["left", "right"] = "left",
    power: float = 1.0,
    texture: int | None = None,
    frame: int | None = None,
    bars: int = 1,
    samples: tuple[int, int] = (2, 2),
) -> None:
    """Close an opening of a wall with a pane that glows with daylight towards one side (lamps of the group "window").

    ``texture`` is what one sees outside (white by default); ``frame`` the texture of the window's frame and of its
    upright ``bars``, which stand between it and the room.
    """
    place = wall_frame(start_xy, end_xy, opening.at_m, thickness_m=0.0, side=side)
    width, height = opening.width_m, opening.top_m - opening.bottom_m
    middle = (opening.top_m + opening.bottom_m) / 2
    pane = on_wall(place, 0.0, middle, off_m=-thickness_m / 4)
    build.lamp(pane, (width, height), power=power, group="window", samples=samples, texture=texture)
    if frame is None:
        return
    y, bar = -thickness_m / 4 + 0.03, 0.05
    for x in np.linspace(-(width - bar) / 2, (width - bar) / 2, bars + 2):
        build.box(place, [x, y, middle], [bar, 0.03, height - 0.002], frame, solid=False)
    for z in (opening.bottom_m + bar / 2, opening.top_m - bar / 2):
        build.box(place, [0.0, y + 0.001, z], [width - 0.002, 0.03, bar], frame, solid=False)


def slab(
    build: Builder,
    rect_xy: Rect,
    *,
    z_m: float,
    texture: int,
    up: bool,
    cell_m: float = 0.25,
    tile_m: tuple[float, float] | None = None,
) -> None:
    """Add a floor (seen from above, ``up``) or a ceiling (seen from below) over a rectangle (x0, y0, x1, y1).

    The texture spans it, or repeats in tiles of (x, y) in m that start at (x0, y1). Its first row lies at y1; on a
    ceiling it is mirrored in x, as one sees it. Rooms' slabs may meet on the lines of the walls between them.
    """
    x0, y0, x1, y1 = rect_xy
    step_x, step_y = tile_m or (x1 - x0, y1 - y0)
    turn = Rotation.identity() if up else Rotation.from_euler("y", np.pi)
    for left in np.arange(x0, x1 - 1e-6, step_x):
        right = min(left + step_x, x1)
        for top in np.arange(y1, y0 + 1e-6, -step_y):
            bottom = max(top - step_y, y0)
            centre = [(left + right) / 2, (top + bottom) / 2, z_m]
            u, v = float((right - left) / step_x), float((top - bottom) / step_y)
            part = (0.0, 0.0, u, v) if up else (1.0 - u, 0.0, 1.0, v)
            at = Pose.from_components(centre, turn)
            build.panel(at, (right - left, top - bottom), texture, cell_m=cell_m, uv=part)


def outside(build: Builder, floor_bounds: Rect, rooms: Sequence[Rect]) -> None:
    """Add footprints for what lies inside the floor's bounds but in none of the rooms (x0, y0, x1, y1)."""
    x0, y0, x1, y1 = floor_bounds
    xs = np.unique(np.clip([x0, x1, *(x for r in rooms for x in (r[0], r[2]))], x0, x1))
    ys = np.unique(np.clip([y0, y1, *(y for r in rooms for y in (r[1], r[3]))], y0, y1))
    for left, right in itertools.pairwise(xs):
        x, start = (left + right) / 2, None
        for bottom, top in itertools.pairwise(ys):
            covered = any(r[0] < x < r[2] and r[1] < (bottom + top) / 2 < r[3] for r in rooms)
            if not covered and start is None:
                start = bottom
            if start is not None and (covered or top == ys[-1]):
                end = bottom if covered else top
                size = (float(right - left), float(end - start))
                build.block(yaw_pose([x, (start + end) / 2, 0.0], 0.0), size)
                start = None
