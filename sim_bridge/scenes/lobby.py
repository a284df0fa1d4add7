"""The lobby: a high hall with a glazed front, a reception, pillars, gates before the lifts, two side rooms.

The plan, in metres, with x to the east (0..12.4) and y to the north (0..9):

             +----------------+-- lift --- lift --- lift --+   9.0
             | waiting room   |                            |
    +--------+---------   ----+ o  gate gate gate gate gate|   6.3
    | cloak-                                               |
    |  room  | counter  o    sofas                display  |
    +--------+   |           sofas    o                    |
             |                              sofa  table  sofa
             +-------------   glazed front   --------------+   0
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from fieldkit.frames import Pose, yaw_pose
from sim_bridge.scenes import lobby_furniture as furniture
from sim_bridge.scenes import lobby_prints as prints
from sim_bridge.scenes import office_prints, textures
from sim_bridge.scenes.blueprint import Blueprint, Builder
from sim_bridge.scenes.halls import EAST
from sim_bridge.scenes.lobby_furniture import Make
from sim_bridge.scenes.office_furniture import gallery, hang, moved, plant, px
from sim_bridge.scenes.plan import Opening, on_wall, outside, slab, wall, wall_frame, window
from sim_bridge.scenes.side_rooms import Finish, SideRoom, side_room, union

LENGTH_M, WIDTH_M, HEIGHT_M = 12.4, 9.0, 3.9
WAITING_X, GATES_Y = 4.4, 6.3
_PX_PER_M, _FLOOR_PX_PER_M = 110, 130
_HUNG_SHARE = 0.75
_WINDOW_POWER, _LAMP_POWER, _SPOT_POWER = 9.0, 2.6, 1.2

Line = tuple[tuple[float, float], tuple[float, float]]

_SOUTH = ((0.0, 0.0), (LENGTH_M, 0.0))
_EAST = ((LENGTH_M, 0.0), (LENGTH_M, WIDTH_M))
_NORTH = ((LENGTH_M, WIDTH_M), (0.0, WIDTH_M))
_WEST = ((0.0, WIDTH_M), (0.0, 0.0))
_WAITING_SOUTH = ((0.0, GATES_Y), (WAITING_X, GATES_Y))
_WAITING_EAST = ((WAITING_X, GATES_Y), (WAITING_X, WIDTH_M))
_CLOAKS = SideRoom((-3.4, 3.1, -0.06, 6.1), EAST, ((-1.35, 4.2), (-1.35, 6.1)), 2.6, threshold_m=0.06)
_CLOAKS_DOOR = Opening(WIDTH_M - 5.5, 1.1)
_PILLARS = ((3.3, 3.1), (8.3, 3.6), (5.45, GATES_Y))


# Stretches of walls (from, to in m from their start) on which prints hang, and how high.
_GALLERIES: tuple[tuple[Line, Literal["left", "right"], float, tuple[tuple[float, float], ...]], ...] = (
    (_SOUTH, "left", 1.5, ((0.2, 1.4), (2.4, 3.25), (9.4, 12.1))),
    (_EAST, "left", 1.65, ((0.4, 3.7), (6.0, 8.8))),
    (_NORTH, "left", 1.75, ((2.8, 3.2), (4.75, 5.2), (9.3, 10.0))),
    (_WEST, "left", 1.5, ((6.6, 8.7),)),
    (_WAITING_EAST, "left", 1.5, ((0.2, 1.9),)),
    (_WAITING_EAST, "right", 1.5, ((0.3, 2.5),)),
    (_WAITING_SOUTH, "left", 1.5, ((1.0, 2.5),)),
    (_WAITING_SOUTH, "right", 1.5, ((0.3, 2.5),)),
)


def lobby(seed: int) -> Blueprint:
    """Make the lobby of 12.4 x 9 x 3.9 m; the same seed gives the same lobby."""
    rng = np.random.default_rng([seed, 90802])
    build = Builder()
    look = furniture.make(build, rng)
    _walls(build, rng)
    _floor(build, rng)
    _lamps(build, rng)
    _reception(build, rng, look)
    _gates_and_lifts(build, rng, look)
    _seats(build, rng, look)
    _boards(build, rng, look)
    _waiting_room(build, rng, look)
    _galleries(build, rng)
    _cloakroom(build, rng)
    hall = (0.0, 0.0, LENGTH_M, WIDTH_M)
    bounds = union(hall, _CLOAKS.floor)
    outside(build, bounds, [hall, _CLOAKS.floor])
    return build.blueprint(floor_bounds=bounds)


@dataclasses.dataclass(frozen=True)
class _Side:
    """A wall in plan, the textures of its faces, and its openings."""

    line: Line
    left: int
    right: int | None
    openings: Sequence[Opening] = ()


def _walls(build: Builder, rng: np.random.Generator) -> None:
    size = (round(HEIGHT_M * _PX_PER_M), round(6 * _PX_PER_M))
    long = (size[0], round(LENGTH_M * _PX_PER_M))
    white = np.array([226, 223, 216]) + rng.normal(0, 3, 3)
    grey = np.array(((150, 154, 158), (168, 160, 148), (146, 156, 150))[int(rng.integers(3))]) + rng.normal(0, 4, 3)
    plain = build.texture(office_prints.paint(rng, size, base=white))
    striped = build.texture(office_prints.stripes(rng, long, base=white - 18, px_per_m=_PX_PER_M, pitch_m=0.4))
    clad = build.texture(prints.cladding(rng, long, base=grey, px_per_m=_PX_PER_M, panel_m=(1.2, 1.3)))
    slatted = build.texture(prints.slats(rng, long, base=grey - 25, px_per_m=_PX_PER_M, pitch_m=0.2))
    trim = build.plain(white - 110)
    panes = [Opening(s, 1.9, top_m=2.9, bottom_m=0.12) for s in (4.3, 6.3, 8.3)]
    sides = [_Side(_SOUTH, plain, None, panes), _Side(_EAST, striped, None), _Side(_NORTH, clad, None)]
    sides += [_Side(_WEST, plain, plain, [_CLOAKS_DOOR]), _Side(_WAITING_EAST, plain, clad)]
    for side in (*sides, _Side(_WAITING_SOUTH, plain, slatted, [Opening(3.3, 1.25)])):
        wall(build, *side.line, height_m=HEIGHT_M, openings=side.openings, left=side.left, right=side.right, trim=trim)
    view, rim = build.texture(prints.street(rng, (160, 128))), build.plain((74, 78, 84))
    for hole in panes:
        window(build, *_SOUTH, hole, power=_WINDOW_POWER, texture=view, frame=rim, samples=(2, 2))
    for x, y in _PILLARS:
        furniture.pillar(build, yaw_pose([x, y, 0.0], 0.0), plain, radius_m=0.27, height_m=HEIGHT_M)


def _floor(build: Builder, rng: np.random.Generator) -> None:
    size = (round(WIDTH_M * _FLOOR_PX_PER_M), round(LENGTH_M * _FLOOR_PX_PER_M))
    tone = np.array([172, 168, 160]) + rng.normal(0, 4, 3)
    floor = build.texture(prints.terrazzo(rng, size, base=tone, px_per_m=_FLOOR_PX_PER_M))
    above = build.texture(office_prints.ceiling_tiles(rng, (288, 288), px_per_m=120))
    whole = (0.0, 0.0, LENGTH_M, WIDTH_M)
    slab(build, whole, z_m=0.0, texture=floor, up=True, cell_m=0.13)
    slab(build, whole, z_m=HEIGHT_M, texture=above, up=False, cell_m=0.6, tile_m=(2.4, 2.4))
    mat = build.texture(prints.mat((240, 560)))
    spot = Pose.from_components([6.3, 0.95, 0.004], Rotation.identity())
    build.panel(spot, (2.8, 1.3), mat, cell_m=0.13, solid=False)


def _lamps(build: Builder, rng: np.random.Generator) -> None:
    """Add lamps in a grid, vents here and there, and spots over the reception."""
    turn = Rotation.from_euler("x", np.pi)
    for x in (np.arange(6) + 0.5) * LENGTH_M / 6:
        for y in (1.1, 3.35, 5.6, 7.85):
            under = Pose.from_components([x, y, HEIGHT_M - 0.01], turn)
            build.lamp(under, (0.6, 0.6), power=_LAMP_POWER, samples=(1, 1))
    vent = build.texture(office_prints.grille((96, 96)))
    for x, y in rng.uniform((0.8, 0.8), (LENGTH_M - 0.8, WIDTH_M - 0.8), (9, 2)):
        above = Pose.from_components([x, y, HEIGHT_M - 0.004], turn)
        build.panel(above, (0.58, 0.58), vent, solid=False)
    for y in (2.7, 3.65, 4.6):
        under = Pose.from_components([2.3, y, HEIGHT_M - 0.02], turn)
        build.lamp(under, (0.15, 0.15), power=_SPOT_POWER, group="spot", samples=(1, 1))


def _hang(
    build: Builder,
    line: Line,
    at_m: float,
    size_m: tuple[float, float],
    image: textures.Rgb,
    *,
    up_m: float = 1.5,
    name: str = "poster",
) -> None:
    """Hang a picture on the left face of a wall, its middle up_m above the floor."""
    hang(build, on_wall(wall_frame(*line, at_m), 0.0, up_m, off_m=0.0), size_m, image, name=name)


def _picture(rng: np.random.Generator, size_m: tuple[float, float]) -> textures.Rgb:
    return office_prints.printed(rng, px(size_m))


def _reception(build: Builder, rng: np.random.Generator, look: Make) -> None:
    place = yaw_pose([2.35, 3.65, 0.0], -np.pi / 2)
    furniture.counter(build, rng, look, place, length_m=2.7)
    for x in (-0.7, 0.75):
        spot = moved(place, x + float(rng.normal(0, 0.1)), -0.75, yaw_rad=np.pi + float(rng.normal(0, 0.4)))
        furniture.armchair(build, look, spot)
    size = (2.2, 0.6)
    image = prints.logo(rng, px(size, px_per_m=250), base=(226, 223, 216))
    _hang(build, _WEST, WIDTH_M - 3.6, size, image, up_m=2.1, name="logo")


def _gates_and_lifts(build: Builder, rng: np.random.Generator, look: Make) -> None:
    for x in (6.6, 8.0, 9.4, 10.8, 12.2):
        furniture.turnstile(build, look, yaw_pose([x, GATES_Y, 0.0], 0.0))
    for x0, x1 in itertools.pairwise((WAITING_X + 0.06, 5.2, 5.7, 6.48)):
        if x0 != 5.2:
            furniture.fence(build, look, yaw_pose([(x0 + x1) / 2, GATES_Y, 0.0], 0.0), length_m=x1 - x0)
    for x in (6.4, 8.4, 10.4):
        furniture.lift(build, look, wall_frame(*_NORTH, LENGTH_M - x))
    size = (0.8, 1.1)
    _hang(build, _NORTH, LENGTH_M - 11.75, size, prints.directory(rng, px(size)), up_m=1.55, name="directory")


def _seats(build: Builder, rng: np.random.Generator, look: Make) -> None:
    """Add equal sofas: two back to back in the middle, two about a table in the corner; plants."""
    middle = yaw_pose([6.0, 3.6, 0.0], 0.0)
    for yaw in (0.0, np.pi):
        furniture.sofa(build, look, moved(moved(middle, yaw_rad=yaw), 0.0, -0.43))
    corner = yaw_pose([10.5, 2.0, 0.0], np.pi / 2)
    furniture.low_table(build, rng, look, moved(corner, 0.0, 0.1, yaw_rad=float(rng.normal(0, 0.08))))
    for yaw, off in ((0.0, 1.45), (np.pi, 1.42)):
        furniture.sofa(build, look, moved(moved(corner, yaw_rad=yaw), 0.0, off))
    furniture.armchair(build, look, yaw_pose([10.35, 0.5, 0.0], np.pi + float(rng.normal(0, 0.15))))
    for x, y in ((0.45, 0.45), (12.0, 3.5), (12.0, 0.45)):
        plant(build, rng, yaw_pose([x, y, 0.0], float(rng.uniform(0, np.pi))), height_m=float(rng.uniform(1.3, 1.7)))


def _boards(build: Builder, rng: np.random.Generator, look: Make) -> None:
    """Add free-standing boards, a rack, an information screen, and pictures on the large walls."""
    spots = ((10.2, 3.95, 2.6), (7.3, 1.3, 1.5), (3.1, 0.55, 0.2))
    for i, (x, y, yaw) in enumerate(spots):
        front = _picture(rng, (0.94, 1.34))
        back = _picture(rng, (0.94, 1.34)) if i != 2 else None
        spot = yaw_pose([x, y, 0.0], yaw + float(rng.normal(0, 0.15)))
        furniture.display(build, look, spot, front, back)
    furniture.rack(build, rng, look, wall_frame(*_SOUTH, 1.9))
    furniture.kiosk(build, rng, look, yaw_pose([4.3, 5.95, 0.0], np.pi))
    size = (1.9, 1.3)
    _hang(build, _EAST, 4.9, size, prints.painting(rng, px(size, px_per_m=300)), up_m=1.75, name="painting")
    for (x, y), yaw in zip(_PILLARS, (-1.4, 2.4, -2.8), strict=True):
        size = (0.42, 0.8)
        at = on_wall(yaw_pose([x, y, 0.0], yaw + float(rng.normal(0, 0.2))), 0.0, 1.45, off_m=0.28)
        hang(build, at, size, _picture(rng, size))
    for x, y, yaw in (
        (5.3, 5.0, 0.2),
        (9.6, 5.1, -0.3),
        (7.0, 2.1, 1.4),
        (3.0, 2.0, 1.9),
        (8.4, 7.9, 1.57),
        (11.2, 7.8, 0.9),
    ):
        furniture.banner(build, rng, look, yaw_pose([x, y, 0.0], yaw), ceiling_m=HEIGHT_M)


def _galleries(build: Builder, rng: np.random.Generator) -> None:
    """Hang prints along some stretches of the walls; the rest stays blank or striped."""
    for line, side, up, spans in _GALLERIES:
        gallery(build, rng, functools.partial(wall_frame, *line, side=side), spans, share=_HUNG_SHARE, up_m=up)


def _waiting_room(build: Builder, rng: np.random.Generator, look: Make) -> None:
    furniture.lockers(build, wall_frame(*_NORTH, LENGTH_M - 1.2), columns=6)
    for y in (6.95, 7.75):
        furniture.armchair(build, look, yaw_pose([0.48, y, 0.0], np.pi / 2 + float(rng.normal(0, 0.1))))
    size = (1.1, 0.75)
    _hang(build, _WEST, WIDTH_M - 7.4, size, office_prints.cork(rng, px(size)), up_m=1.5, name="notices")
    furniture.kiosk(build, rng, look, yaw_pose([3.4, 8.5, 0.0], np.pi + 0.2))


def _cloakroom(build: Builder, rng: np.random.Generator) -> None:
    """Add the cloakroom behind the reception: bare walls, lockers of which each looks like the other."""
    white = build.texture(office_prints.paint(rng, (286, 330), base=(218, 216, 210)))
    grey = build.texture(prints.terrazzo(rng, (312, 312), base=(150, 148, 144), px_per_m=_FLOOR_PX_PER_M))
    above = build.texture(office_prints.ceiling_tiles(rng, (288, 288), px_per_m=120))
    side_room(build, _CLOAKS, Finish(white, grey, above, build.plain((110, 110, 106))), lamp_power=_LAMP_POWER)
    x0, _, _, y1 = _CLOAKS.rect
    furniture.lockers(build, yaw_pose([x0 + 0.95, y1, 0.0], np.pi), columns=4)
