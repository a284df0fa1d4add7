"""The workshop: one high hall with benches, machine tools, racks, pallets, a roller door, a planning office, a store.

The plan, in metres, with x to the east (0..10.2) and y to the north (0..8):

    +-- bench -- bench -- bench -- bench --+------+ 8.0
    |                                        store|
    | d   mill   lathe    screen           r------+
    | d   mill   lathe    pallets          o
    |                                      l
    +-------+    pallets    drums          l
    | office      cart                     |
    |       +                              |
    +-------+-- rack -- rack -- rack ------+   0
    0      2.6                           10.2
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from fieldkit.frames import Pose, yaw_pose
from sim_bridge.mesh import Rgb
from sim_bridge.scenes import workshop_furniture as furniture
from sim_bridge.scenes import workshop_prints as prints
from sim_bridge.scenes.blueprint import Blueprint, Builder
from sim_bridge.scenes.forms import hang, moved, paint, upright
from sim_bridge.scenes.halls import EAST, NORTH, SOUTH, WEST, Hall, lamps, outer_walls
from sim_bridge.scenes.office_prints import cork
from sim_bridge.scenes.plan import THICKNESS_M, Opening, outside, slab, wall, wall_frame
from sim_bridge.scenes.prints import banded, blank, ceiling_grid
from sim_bridge.scenes.side_rooms import Finish, SideRoom, side_room, union
from sim_bridge.scenes.workshop_furniture import Gear, px

HALL = Hall(10.2, 8.0, 3.9)
OFFICE_M = (2.6, 2.6)
_FLOOR_PX_PER_M = 140
_WINDOW_POWER, _LAMP_POWER = 1.6, 5.5
_STORE = SideRoom((HALL.length_m + THICKNESS_M, 5.0, 13.5, 7.9), WEST, ((11.66, 5.0), (11.66, 6.8)), HALL.height_m)
_STORE_DOOR = Opening(6.1, 1.1)
_OFFICE_EAST = ((OFFICE_M[0], 0.0), OFFICE_M)
_OFFICE_NORTH = ((0.0, OFFICE_M[1]), OFFICE_M)


def workshop(seed: int) -> Blueprint:
    """Make the workshop of 10.2 x 8.0 x 3.9 m; the same seed gives the same workshop."""
    rng = np.random.default_rng([seed, 90805])
    build = Builder()
    look = furniture.gear(build, rng)
    _walls(build, rng)
    _floor(build, rng)
    _benches(build, rng, look)
    _machines(build, rng, look)
    _stores(build, rng, look)
    _gate(build, rng, look)
    _office(build, rng, look)
    _store(build, rng)
    bounds = union(HALL.bounds, _STORE.floor)
    outside(build, bounds, [HALL.bounds, _STORE.floor])
    return build.blueprint(floor_bounds=bounds)


def _walls(build: Builder, rng: np.random.Generator) -> None:
    white = np.array([216, 214, 206]) + rng.normal(0, 3, 3)
    tone = ((112, 130, 120), (120, 132, 146), (150, 138, 118))[int(rng.integers(3))]
    faces = []
    for side in (SOUTH, EAST, NORTH, WEST):
        size = (HALL.side_m(side), HALL.height_m)
        faces.append(build.texture(banded(blank(rng, size, base=white), size, [(0.0, 1.15, tone)])))
    trim = build.plain(np.asarray(tone) - 50)
    high = {SOUTH: [Opening(x, 1.9, top_m=3.5, bottom_m=2.5) for x in (4.2, 6.5, 8.8)]}
    high[WEST] = [Opening(HALL.width_m - y, 1.7, top_m=3.5, bottom_m=2.5) for y in (4.1, 6.4)]
    high[EAST] = [_STORE_DOOR]
    outer_walls(build, HALL, faces, openings=high, trim=trim, power=_WINDOW_POWER)
    plain = build.texture(blank(rng, (2.6, HALL.height_m), base=white - 8))
    look_in = [Opening(1.3, 1.2, top_m=1.9, bottom_m=1.05)]
    wall(
        build, *_OFFICE_EAST, height_m=HALL.height_m, openings=[Opening(1.75, 1.2)], left=plain, right=plain, trim=trim
    )
    wall(build, *_OFFICE_NORTH, height_m=HALL.height_m, openings=look_in, left=plain, right=plain, trim=trim)


def _floor(build: Builder, rng: np.random.Generator) -> None:
    tone = np.array(((134, 134, 130), (122, 128, 126), (144, 138, 130))[int(rng.integers(3))]) + rng.normal(0, 3, 3)
    size = (round(HALL.width_m * _FLOOR_PX_PER_M), round(HALL.length_m * _FLOOR_PX_PER_M))
    ground = build.texture(prints.concrete(rng, size, base=tone, px_per_m=_FLOOR_PX_PER_M))
    above = build.texture(ceiling_grid((2.0, 2.0), base=(196, 196, 190), step_m=1.0))
    slab(build, HALL.bounds, z_m=0.0, texture=ground, up=True, cell_m=0.13)
    slab(build, HALL.bounds, z_m=HALL.height_m, texture=above, up=False, cell_m=0.6, tile_m=(2.0, 2.0))
    beam = paint(build, (120, 122, 124))
    for x in (2.6, 5.1, 7.6):
        place = yaw_pose([x, HALL.width_m / 2, 0.0], 0.0)
        build.box(place, [0.0, 0.0, HALL.height_m - 0.12], [0.16, HALL.width_m - 0.002, 0.238], beam)
    spots = [(x, y) for x in (1.3, 3.85, 6.35, 8.9) for y in (1.3, 4.0, 6.7)]
    lamps(build, spots, z_m=3.5, size_m=(1.2, 0.25), power=_LAMP_POWER, housing=beam)
    _markings(build)


def _markings(build: Builder) -> None:
    """Paint striped lines along the aisles, all of them alike."""
    stripes = build.shared("stripes", lambda: prints.hazard_stripes((24, 480), pitch_px=48.0))
    for x, y, yaw, length in (
        (5.2, 6.75, 0.0, 8.4), (5.2, 3.66, 0.0, 5.2), (6.3, 0.95, 0.0, 7.0), (8.95, 3.5, np.pi / 2, 3.4),
        (1.2, 5.2, np.pi / 2, 3.0),
    ):  # fmt: skip
        for part in np.arange(round(length / 1.7)):
            turn = Rotation.from_euler("z", yaw)
            off = turn.apply([1.7 * (part + 0.5) - length / 2, 0.0, 0.0])
            at = Pose.from_components(np.array([x, y, 0.003]) + off, turn)
            build.panel(at, (1.7, 0.09), stripes, solid=False, cell_m=0.3)


def _print(
    build: Builder, rng: np.random.Generator, place: Pose, size: tuple[float, float], *, up_m: float = 1.55,
    image: Rgb | None = None, name: str = "poster",
) -> None:  # fmt: skip
    """Hang a print, or one of the workshop's posters, on a wall's frame."""
    shown = prints.picture(rng, px(size)) if image is None else image
    hang(build, place, size, shown, up_m=up_m, name=name, frame=paint(build, (58, 58, 60)))


def _benches(build: Builder, rng: np.random.Generator, look: Gear) -> None:
    """Add four equal workbenches along the north wall with tools and bins above them."""
    for i, x in enumerate((1.2, 3.5, 5.8, 8.1)):
        place = HALL.on(NORTH, HALL.length_m - x)
        furniture.workbench(build, look, place)
        top = moved(place, -0.2, 0.36, furniture.BENCH_TOP_M)
        furniture.parts(build, rng, look, top, width_m=1.2, count=int(rng.integers(1, 3)))
        if i == 2:
            furniture.bin_wall(build, rng, place, width_m=1.4)
        else:
            furniture.tool_wall(build, rng, place)
        if rng.random() < 0.8:
            spot = moved(place, float(rng.uniform(-0.2, 0.5)), 0.95, yaw_rad=float(rng.normal(0, 0.3)))
            furniture.stool(build, look, spot)
    for x in (4.65, 9.6):
        _print(build, rng, HALL.on(NORTH, HALL.length_m - x), (0.5, 0.7), up_m=1.5)


def _machines(build: Builder, rng: np.random.Generator, look: Gear) -> None:
    """Add two mills and two lathes in the middle, two drills on the west wall, posters behind them."""
    for y, yaw in ((4.45, np.pi), (5.4, 0.0)):
        furniture.mill(build, rng, look, yaw_pose([2.55, y, 0.0], yaw))
        furniture.lathe(build, rng, look, yaw_pose([4.85, y + (0.07 if yaw else -0.05), 0.0], yaw))
    for y in (4.3, 5.55):
        furniture.drill(build, rng, look, moved(HALL.on(WEST, HALL.width_m - y), y_m=0.4))
    _print(build, rng, HALL.on(WEST, HALL.width_m - 3.45), (0.9, 1.15), up_m=1.5)
    _print(build, rng, HALL.on(WEST, HALL.width_m - 4.92), (0.75, 0.9), up_m=1.6)
    _print(build, rng, HALL.on(WEST, HALL.width_m - 6.9), (0.85, 1.15), up_m=1.5)
    furniture.tool_cart(build, rng, look, yaw_pose([8.15, 4.2, 0.0], float(rng.normal(np.pi / 2, 0.1))))


def _stores(build: Builder, rng: np.random.Generator, look: Gear) -> None:
    """Add racks along the south wall, loaded pallets, crates, drums, welding screens."""
    for x in (3.95, 5.85, 7.75):
        furniture.rack(build, rng, look, HALL.on(SOUTH, x))
    for x, y, yaw, layers in ((5.1, 2.4, 0.0, 2), (7.35, 2.4, 0.1, 3), (7.4, 4.35, np.pi / 2, 2)):
        spot = yaw_pose([x, y, 0.0], yaw + float(rng.normal(0, 0.04)))
        furniture.loaded_pallet(build, rng, look, spot, layers=layers)
    furniture.screen(build, rng, look, yaw_pose([7.35, 5.55, 0.0], np.pi + float(rng.normal(0, 0.05))))
    for x, y in ((9.85, 0.4), (9.2, 0.35), (9.85, 7.0)):
        furniture.drum(build, rng, yaw_pose([x, y, 0.0], float(rng.uniform(0.5, 2.2))))
    _print(build, rng, HALL.on(SOUTH, 5.85), (1.3, 0.38), up_m=1.95, name="banner")
    _print(build, rng, HALL.on(SOUTH, 9.4), (0.8, 1.05), up_m=1.65)


def _gate(build: Builder, rng: np.random.Generator, look: Gear) -> None:
    """Add the closed roller door in the east wall, its rails striped, with posters on either side of it."""
    wide, high = 3.0, 3.0
    place = HALL.on(EAST, 3.6)
    slats = build.texture(prints.roller(px((wide, high), px_per_m=160), px_per_m=160))
    with build.thing("roller door", place, kind="fixed"):
        build.box(place, [0.0, 0.02, high / 2], [wide, 0.04, high], look.steel, front=slats)
        build.box(place, [0.0, 0.16, high + 0.18], [wide + 0.2, 0.32, 0.36], look.steel)
        rail = build.shared("rail", lambda: prints.hazard_stripes((480, 24), pitch_px=48.0))
        for x in (-wide / 2 - 0.06, wide / 2 + 0.06):
            build.box(place, [x, 0.05, high / 2], [0.12, 0.1, high - 0.002], look.dark, front=rail)
    for at, size in ((1.2, (0.9, 1.2)), (7.3, (0.95, 1.2))):
        _print(build, rng, HALL.on(EAST, at), size, up_m=1.5)
    size = (0.75, 0.55)
    _print(build, rng, moved(place, y_m=0.04), size, image=prints.warning(rng, px(size)), up_m=1.35, name="sign")
    for x, y, yaw in ((3.7, 3.65, np.pi / 2), (6.6, 2.4, 0.0), (8.6, 5.6, np.pi / 2)):
        _hanging_sign(build, rng, yaw_pose([x, y, 0.0], yaw))


def _office(build: Builder, rng: np.random.Generator, look: Gear) -> None:
    """Add the planning corner: a table, a planning board, drawings on the walls inside and out."""
    size = (1.5, 1.0)
    _print(build, rng, HALL.on(WEST, HALL.width_m - 1.3), size, image=prints.schedule(rng, px(size)), name="schedule")
    furniture.workbench(build, look, HALL.on(SOUTH, 0.95))
    top = moved(HALL.on(SOUTH, 0.85), 0.0, 0.35, furniture.BENCH_TOP_M)
    furniture.parts(build, rng, look, top, width_m=1.3, count=3)
    size = (1.1, 0.75)
    _print(build, rng, HALL.on(SOUTH, 0.95), size, image=cork(rng, px(size)), name="notices", up_m=1.75)
    _print(build, rng, wall_frame(*_OFFICE_EAST, 0.6), (0.7, 0.95))
    _print(build, rng, wall_frame(*_OFFICE_NORTH, 2.2, side="right"), (0.45, 0.6))
    _print(build, rng, wall_frame(*_OFFICE_NORTH, 0.35, side="right"), (0.45, 0.6))
    _print(build, rng, wall_frame(*_OFFICE_EAST, 0.8, side="right"), (0.45, 0.65), up_m=1.75)
    size = (0.55, 0.75)
    _print(build, rng, wall_frame(*_OFFICE_NORTH, 0.35), size, image=prints.drawing(rng, px(size)))
    _print(build, rng, wall_frame(*_OFFICE_NORTH, 2.25), size, image=prints.advert(rng, px(size)))


def _hanging_sign(build: Builder, rng: np.random.Generator, place: Pose) -> None:
    """Hang a sign of 1.1 x 0.5 m on rods from the ceiling, printed alike on both sides."""
    size, up = (1.1, 0.5), 2.55
    image = build.texture(prints.advert(rng, px(size, px_per_m=240)))
    rim = paint(build, (50, 52, 56))
    with build.thing("hanging sign", place, kind="picture"):
        for x in (-0.45, 0.45):
            build.box(
                place, [x, 0.0, (up + HALL.height_m) / 2], [0.012, 0.012, HALL.height_m - up - 0.01], rim, solid=False
            )
        build.box(place, [0.0, 0.0, up], [size[0] + 0.02, 0.02, size[1] + 0.02], rim, solid=False)
        for yaw in (0.0, np.pi):
            build.panel(upright(moved(place, yaw_rad=yaw), 0.0, 0.012, up), size, image, solid=False)


def _store(build: Builder, rng: np.random.Generator) -> None:
    """Add the store beside the roller door: bare walls and a few drums."""
    white = build.texture(blank(rng, (3.0, HALL.height_m), base=(206, 204, 198)))
    ground = build.texture(prints.concrete(rng, (336, 336), base=(136, 136, 132), px_per_m=_FLOOR_PX_PER_M))
    above = build.texture(ceiling_grid((2.0, 2.0), base=(196, 196, 190), step_m=1.0))
    side_room(build, _STORE, Finish(white, ground, above, build.plain((100, 100, 98))), lamp_power=_LAMP_POWER)
    _, y0, x1, _ = _STORE.rect
    for x, y in ((x1 - 0.32, y0 + 0.32), (x1 - 0.95, y0 + 0.32), (x1 - 0.32, y0 + 0.95)):
        furniture.drum(build, rng, yaw_pose([x, y, 0.0], float(rng.uniform(0.5, 2.2))))
