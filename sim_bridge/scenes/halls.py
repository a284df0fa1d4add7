"""Shells of rectangular buildings: four outer walls around a floor, frames on them, rows of equal lamps."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from fieldkit.frames import Pose
from sim_bridge.scenes.blueprint import Builder
from sim_bridge.scenes.forms import paint
from sim_bridge.scenes.plan import THICKNESS_M, Opening, wall, wall_frame, window

# The outer walls in turn, counter-clockwise: south, east, north, west.
SOUTH, EAST, NORTH, WEST = range(4)


@dataclasses.dataclass(frozen=True)
class Hall:
    """A rectangular building with its inner faces at x = 0, length and y = 0, width; heights in m."""

    length_m: float
    width_m: float
    height_m: float

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """The floor's rectangle (x0, y0, x1, y1)."""
        return 0.0, 0.0, self.length_m, self.width_m

    def side_m(self, side: int) -> float:
        """Return the length of the inner face of an outer wall."""
        return self.length_m if side in (SOUTH, NORTH) else self.width_m

    def line(self, side: int) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return start and end of an outer wall's centre line; the inside lies on its left."""
        t, x, y = THICKNESS_M / 2, self.length_m, self.width_m
        lines = (((0.0, -t), (x, -t)), ((x + t, 0.0), (x + t, y)), ((x, y + t), (0.0, y + t)), ((-t, y), (-t, 0.0)))
        return lines[side]

    def on(self, side: int, at_m: float) -> Pose:
        """Return the frame on an outer wall's inner face, ``at_m`` along it: y into the room, z up."""
        start, end = self.line(side)
        return wall_frame(start, end, at_m)


def outer_walls(
    build: Builder,
    hall: Hall,
    faces: Sequence[int],
    *,
    openings: Mapping[int, Sequence[Opening]],
    trim: int | None,
    power: float,
    view: int | None = None,
    cell_m: float = 0.25,
) -> None:
    """Add the four outer walls with textures of their inner faces; openings above the floor become windows.

    ``power`` is a window's light per m2.
    """
    outside = paint(build, (120, 120, 120))
    rim = paint(build, (88, 90, 94))
    for side in range(4):
        start, end = hall.line(side)
        holes = openings.get(side, ())
        wall(
            build, start, end, height_m=hall.height_m, openings=holes, left=faces[side], right=outside, trim=trim,
            cell_m=cell_m,
        )  # fmt: skip
        for hole in (hole for hole in holes if hole.bottom_m > 0.0):
            area = hole.width_m * (hole.top_m - hole.bottom_m)
            bars = max(round(hole.width_m / 1.1) - 1, 0)
            window(build, start, end, hole, power=power * area, texture=view, frame=rim, bars=bars)


def lamps(
    build: Builder,
    spots: Sequence[tuple[float, float]],
    *,
    z_m: float,
    size_m: tuple[float, float],
    power: float,
    yaw_rad: float = 0.0,
    group: str = "ceiling",
    housing: int | None = None,
) -> None:
    """Hang equal lamps over spots (x, y), shining downwards; ``housing`` is the texture of the box above each."""
    for x, y in spots:
        turn = Rotation.from_euler("z", yaw_rad)
        under = Pose.from_components([x, y, z_m], turn * Rotation.from_euler("x", np.pi))
        build.lamp(under, size_m, power=power, samples=(1, 1), group=group)
        if housing is not None:
            over = Pose.from_components([x, y, z_m], turn)
            build.box(over, [0.0, 0.0, 0.035], [size_m[0] + 0.03, size_m[1] + 0.03, 0.06], housing, solid=False)
