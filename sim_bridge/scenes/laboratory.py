"""The laboratory: a wet laboratory with fume hoods and two islands, an instrument room, a short corridor, a dark room.

The plan, in metres, with x to the east (0..11.4) and y to the north (0..8):

    +-- glass cupboards -- board ---+--------------+   8.0
    | h                                  stools    |
    | o   [ island 2 ]          b   | c  [===]  b  |
    | o                         e   | a  [===]  e  |
    | d   [ island 1 ]          n   | b  [===]  n  |
    | s                         c   |           c  |
    |                           h   +-------   --h-+   1.8
    | gas                              corridor    |
    +------ windows ----------------+--   ----+----+   0
                                    | dark room |
                                    +-----------+     -3.4
    0                              7.0         9.9 11.4
"""

from __future__ import annotations

import numpy as np

from fieldkit.frames import Pose, yaw_pose
from sim_bridge.mesh import Rgb
from sim_bridge.scenes import laboratory_furniture as furniture
from sim_bridge.scenes import laboratory_prints as prints
from sim_bridge.scenes import textures
from sim_bridge.scenes.blueprint import Blueprint, Builder
from sim_bridge.scenes.forms import hang, moved, paint, upright
from sim_bridge.scenes.halls import EAST, NORTH, SOUTH, WEST, Hall, lamps, outer_walls
from sim_bridge.scenes.laboratory_furniture import Ware, px
from sim_bridge.scenes.office_prints import cork, fronts
from sim_bridge.scenes.plan import THICKNESS_M, Opening, outside, slab, wall, wall_frame
from sim_bridge.scenes.prints import blank, ceiling_grid, upright_stripes
from sim_bridge.scenes.side_rooms import Finish, SideRoom, side_room, union

HALL = Hall(11.4, 8.0, 3.0)
DIVIDER_X, FRONT_Y = 7.0, 1.8
_FLOOR_PX_PER_M = 140
_WINDOW_POWER, _LAMP_POWER = 1.5, 4.0
_DARK = SideRoom((7.0, -3.4, 9.9, -THICKNESS_M), NORTH, ((7.0, -1.46), (8.8, -1.46)), HALL.height_m)
_DARK_DOOR = Opening(8.0, 1.1)
_DIVIDER = ((DIVIDER_X, 0.0), (DIVIDER_X, HALL.width_m))
_FRONT = ((DIVIDER_X, FRONT_Y), (HALL.length_m, FRONT_Y))


def laboratory(seed: int) -> Blueprint:
    """Make the laboratory of 11.4 x 8.0 x 3.0 m; the same seed gives the same laboratory."""
    rng = np.random.default_rng([seed, 90804])
    build = Builder()
    look = furniture.ware(build, rng)
    _walls(build, rng)
    _floors(build, rng)
    _wet_laboratory(build, rng, look)
    _wet_walls(build, rng, look)
    _instrument_room(build, rng, look)
    _corridor(build, rng, look)
    _dark_room(build, rng, look)
    bounds = union(HALL.bounds, _DARK.floor)
    outside(build, bounds, [HALL.bounds, _DARK.floor])
    return build.blueprint(floor_bounds=bounds)


def _walls(build: Builder, rng: np.random.Generator) -> None:
    white = np.array([226, 227, 223]) + rng.normal(0, 2, 3)
    cool = np.array(((176, 196, 204), (184, 200, 182), (206, 200, 184))[int(rng.integers(3))]) + rng.normal(0, 4, 3)
    size = (6.0, HALL.height_m)
    plain = build.texture(blank(rng, size, base=white, px_per_m=110))
    tinted = build.texture(blank(rng, size, base=cool, px_per_m=110))
    striped = build.texture(upright_stripes(blank(rng, (11.4, 3.0), base=white - 12), period_px=30.0, change=6.0))
    trim = build.plain(white - 100)
    panes = {SOUTH: [Opening(x, 1.5, top_m=2.4, bottom_m=1.0) for x in (1.75, 5.0)]}
    panes[NORTH] = [Opening(HALL.length_m - 9.3, 1.6, top_m=2.4, bottom_m=1.0)]
    panes[SOUTH].append(_DARK_DOOR)
    outer_walls(build, HALL, (plain, tinted, striped, plain), openings=panes, trim=trim, power=_WINDOW_POWER)
    passages = [Opening(0.9, 1.2), Opening(6.9, 1.2)]
    wall(build, *_DIVIDER, height_m=HALL.height_m, openings=passages, left=plain, right=plain, trim=trim)
    way = [Opening(2.75, 1.2)]
    wall(build, *_FRONT, height_m=HALL.height_m, openings=way, left=plain, right=tinted, trim=trim)


def _floors(build: Builder, rng: np.random.Generator) -> None:
    tone = np.array(((150, 160, 164), (164, 158, 146), (146, 158, 146))[int(rng.integers(3))]) + rng.normal(0, 3, 3)
    size = (round(HALL.width_m * _FLOOR_PX_PER_M), round(HALL.length_m * _FLOOR_PX_PER_M))
    floor = build.texture(prints.vinyl(rng, size, base=tone, px_per_m=_FLOOR_PX_PER_M))
    above = build.texture(ceiling_grid((2.4, 2.4), base=(230, 230, 226), step_m=0.6))
    slab(build, HALL.bounds, z_m=0.0, texture=floor, up=True, cell_m=0.13)
    slab(build, HALL.bounds, z_m=HALL.height_m, texture=above, up=False, cell_m=0.6, tile_m=(2.4, 2.4))
    spots = [(x, y) for x in (1.2, 3.5, 5.8) for y in (1.0, 3.0, 5.0, 7.0)]
    spots += [(x, y) for x in (8.15, 10.3) for y in (2.85, 4.95, 7.0)] + [(x, 0.9) for x in (7.8, 9.2, 10.6)]
    lamps(build, spots, z_m=HALL.height_m - 0.01, size_m=(1.2, 0.3), power=_LAMP_POWER)


def _print(
    build: Builder, rng: np.random.Generator, place: Pose, size: tuple[float, float], *, up_m: float = 1.5,
    image: Rgb | None = None, name: str = "poster",
) -> None:  # fmt: skip
    """Hang a print, or one of the laboratory's posters, on a wall's frame."""
    shown = prints.picture(rng, px(size)) if image is None else image
    hang(build, place, size, shown, up_m=up_m, name=name, frame=paint(build, (70, 72, 76)))


def _wet_laboratory(build: Builder, rng: np.random.Generator, look: Ware) -> None:
    """Add two equal islands with stools, fume hoods along the west wall, gas bottles in the corner."""
    for y in (2.4, 5.3):
        place = yaw_pose([3.65, y, 0.0], 0.0)
        furniture.island(build, rng, look, place, units=5)
        for side in (0.0, np.pi):
            turned = moved(place, yaw_rad=side)
            front = moved(turned, 0.0, 0.45, furniture.BENCH_TOP_M)
            furniture.clutter(build, rng, look, front, width_m=2.6, count=int(rng.integers(2, 4)))
            for x in (-1.05, 0.0, 1.05):
                if rng.random() < 0.75:
                    spot = moved(turned, x + float(rng.normal(0, 0.1)), 0.68, yaw_rad=float(rng.uniform(0, 3)))
                    furniture.stool(build, look, spot)
        end = moved(moved(place, yaw_rad=float(rng.choice([-1, 1])) * np.pi / 2), y_m=1.5)
        _print(build, rng, end, (0.62, 0.5), up_m=0.52)
    for y in (2.1, 3.65, 5.2):
        furniture.hood(build, rng, look, HALL.on(WEST, HALL.width_m - y))
    furniture.gas_bottles(build, rng, HALL.on(WEST, HALL.width_m - 0.55), count=3)


def _wet_walls(build: Builder, rng: np.random.Generator, look: Ware) -> None:
    """Add glass cupboards, boards, posters, and a bench with screens along the divider."""
    for x in (0.95, 1.97, 2.99):
        furniture.glass_cupboard(build, rng, look, HALL.on(NORTH, HALL.length_m - x), same=x > 1.0)
    size = (1.7, 1.1)
    board = HALL.on(NORTH, HALL.length_m - 4.6)
    _print(build, rng, board, size, image=prints.formulae(rng, px(size)), name="board", up_m=1.45)
    _print(build, rng, HALL.on(NORTH, HALL.length_m - 6.1), (0.7, 0.95))
    _print(build, rng, HALL.on(WEST, HALL.width_m - 6.6), (0.8, 1.05), up_m=1.45)
    _print(build, rng, HALL.on(WEST, HALL.width_m - 0.65), (0.7, 0.5), up_m=1.78)
    for x in (0.5, 3.4, 6.4):
        _print(build, rng, HALL.on(SOUTH, x), (0.75, 1.0), up_m=1.45)
    side = wall_frame(*_DIVIDER, 3.85)
    furniture.bench(build, look, side, units=4, depth_m=0.55)
    for x in (-0.75, 0.7):
        spot = moved(side, x + float(rng.normal(0, 0.05)), 0.26, furniture.BENCH_TOP_M)
        furniture.computer(build, rng, look, moved(spot, yaw_rad=float(rng.normal(0, 0.1))))
    top = moved(side, 0.0, 0.26, furniture.BENCH_TOP_M)
    furniture.instrument(build, rng, look, top, size=(0.5, 0.4, 0.36))
    size = (1.6, 1.0)
    _print(build, rng, side, size, image=prints.periodic_table(rng, px(size)), up_m=2.1, name="periodic table")
    _print(build, rng, wall_frame(*_DIVIDER, 2.05), (0.75, 1.0))
    _print(build, rng, wall_frame(*_DIVIDER, 5.65), (0.75, 1.0))
    _print(build, rng, wall_frame(*_DIVIDER, 7.72), (0.36, 0.5), image=prints.escape_plan(rng, px((0.36, 0.5))))


def _instrument_room(build: Builder, rng: np.random.Generator, look: Ware) -> None:
    """Add benches of instruments along the east wall and in the middle, equal cabinets, posters."""
    east = HALL.on(EAST, 5.0)
    furniture.bench(build, look, east, units=6)
    for i, x in enumerate((-1.5, -0.9, -0.3, 0.4, 1.0, 1.5)):
        spot = moved(east, x, 0.36, furniture.BENCH_TOP_M, yaw_rad=float(rng.normal(0, 0.08)))
        if i in (0, 4):
            furniture.computer(build, rng, look, spot)
        elif i in (1, 5):
            furniture.microscope(build, look, spot)
        else:
            high = float(rng.uniform(0.3, 0.55))
            furniture.instrument(build, rng, look, spot, size=(0.52, 0.5, high))
    for yaw in (-np.pi / 2, np.pi / 2):
        half = yaw_pose([9.1, 4.75, 0.0], yaw)
        furniture.bench(build, look, half, units=4, depth_m=0.46)
        for x in (-0.85, 0.0, 0.85):
            spot = moved(half, x, 0.22, furniture.BENCH_TOP_M, yaw_rad=float(rng.normal(0, 0.06)))
            size = (float(rng.uniform(0.45, 0.6)), 0.34, float(rng.uniform(0.3, 0.6)))
            furniture.instrument(build, rng, look, spot, size=size)
    _print(build, rng, yaw_pose([9.1, 5.96, 0.0], 0.0), (0.62, 0.5), up_m=0.52)
    for x, y in ((8.75, 6.25), (9.4, 6.28), (9.1, 3.2)):
        furniture.stool(build, look, yaw_pose([x, y, 0.0], float(rng.uniform(0, 3))))
    for at in (3.0, 3.92, 4.84):
        furniture.cabinet(build, look, wall_frame(*_DIVIDER, at, side="right"))
    _print(build, rng, moved(wall_frame(*_DIVIDER, 3.92, side="right"), y_m=0.45), (0.55, 0.75), up_m=1.4)
    _instrument_walls(build, rng, look)


def _instrument_walls(build: Builder, rng: np.random.Generator, look: Ware) -> None:
    for at, size, up in (
        (2.5, (0.8, 1.05), 1.45),
        (4.1, (0.8, 0.6), 1.75),
        (5.7, (0.8, 0.6), 1.75),
        (7.4, (0.8, 1.0), 1.5),
    ):
        _print(build, rng, HALL.on(EAST, at), size, up_m=up)
    _print(build, rng, HALL.on(NORTH, HALL.length_m - 7.95), (0.75, 1.0))
    furniture.glass_cupboard(build, rng, look, HALL.on(NORTH, HALL.length_m - 10.72), same=True)
    _print(build, rng, wall_frame(*_DIVIDER, 5.75, side="right"), (0.65, 0.9))
    _print(build, rng, wall_frame(*_DIVIDER, 2.2, side="right"), (0.5, 0.7))
    size = (1.2, 0.85)
    _print(build, rng, wall_frame(*_FRONT, 1.15), size, image=prints.formulae(rng, px(size)), name="board")
    _print(build, rng, wall_frame(*_FRONT, 3.9), (0.65, 0.9))


def _door(build: Builder, place: Pose) -> None:
    """Add a closed door of 0.95 x 2.08 m with its frame."""
    leaf = build.shared("door", lambda: fronts((416, 190), base=(120, 140, 150), cols=1, rows=1, px_per_m=200))
    build.box(place, [0.0, 0.018, 1.06], [1.07, 0.036, 2.12], paint(build, (96, 98, 102)))
    build.box(place, [0.0, 0.023, 1.04], [0.95, 0.036, 2.07], leaf, front=leaf)


def _corridor(build: Builder, rng: np.random.Generator, look: Ware) -> None:
    """Add coats, an emergency shower, closed doors, notices and signs."""
    _door(build, HALL.on(SOUTH, 10.8))
    _print(build, rng, HALL.on(SOUTH, 9.25), (1.0, 0.75), image=cork(rng, px((1.0, 0.75))), name="notices")
    _print(build, rng, HALL.on(SOUTH, 7.3), (0.34, 0.46), image=prints.hazards(rng, px((0.34, 0.46))), name="sign")
    size = (1.1, 0.8)
    _print(build, rng, HALL.on(EAST, 0.88), size, image=prints.rules(rng, px(size)), up_m=1.45)
    for at in (0.45, 0.85, 1.25):
        furniture.coat(build, rng, look, wall_frame(*_FRONT, at, side="right"))
    _print(build, rng, wall_frame(*_FRONT, 1.75, side="right"), (0.5, 0.7))
    low = wall_frame(*_FRONT, 3.9, side="right")
    furniture.cabinet(build, look, low, height_m=1.0)
    furniture.clutter(build, rng, look, moved(low, 0.0, 0.22, 1.0), width_m=0.8, count=2)
    _print(build, rng, low, (0.6, 0.75), image=textures.page(rng, px((0.6, 0.75))), up_m=1.75)
    furniture.shower(build, look, HALL.on(SOUTH, 10.03))
    spots = ((7.75, 0.9, np.pi / 2), (9.1, 7.0, 0.0), (3.65, 3.9, 0.0), (1.4, 1.2, np.pi / 2), (5.9, 1.0, np.pi / 2))
    for x, y, yaw in (*spots, (5.9, 6.6, 0.0), (10.3, 4.2, 0.0), (8.0, 4.9, np.pi / 2)):
        _hanging_sign(build, rng, yaw_pose([x, y, 0.0], yaw))


def _hanging_sign(build: Builder, rng: np.random.Generator, place: Pose) -> None:
    """Hang a sign of 1.0 x 0.4 m from the ceiling, printed alike on both sides."""
    size, up = (1.0, 0.4), HALL.height_m - 0.45
    image = build.texture(prints.rules(rng, px(size, px_per_m=260)))
    rim = paint(build, (60, 62, 66))
    with build.thing("hanging sign", place, kind="picture"):
        for x in (-0.4, 0.4):
            build.box(place, [x, 0.0, HALL.height_m - 0.12], [0.012, 0.012, 0.23], rim, solid=False)
        build.box(place, [0.0, 0.0, up], [size[0] + 0.02, 0.02, size[1] + 0.02], rim, solid=False)
        for yaw in (0.0, np.pi):
            build.panel(upright(moved(place, yaw_rad=yaw), 0.0, 0.012, up), size, image, solid=False)


def _dark_room(build: Builder, rng: np.random.Generator, look: Ware) -> None:
    """Add the dark room off the corridor: bare walls, two plain cabinets, little light."""
    white = build.texture(blank(rng, (3.0, HALL.height_m), base=(204, 204, 200)))
    ground = build.texture(prints.vinyl(rng, (336, 336), base=(140, 144, 146), px_per_m=_FLOOR_PX_PER_M))
    above = build.texture(ceiling_grid((2.4, 2.4), base=(230, 230, 226), step_m=0.6))
    side_room(build, _DARK, Finish(white, ground, above, build.plain((120, 120, 118))), lamp_power=1.5)
    x0, y0, _, _ = _DARK.rect
    for y in (y0 + 0.47, y0 + 1.38):
        furniture.cabinet(build, look, yaw_pose([x0, y, 0.0], -np.pi / 2))
