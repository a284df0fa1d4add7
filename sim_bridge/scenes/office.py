"""The office: an open plan with rows of equal desks, two offices, a meeting room, a corridor and a kitchenette.

The plan, in metres, with x to the east (0..14.9) and y to the north (0..11.0):

    +-----------+-----------+--------------+  11.0
    |  office   |  office   |   meeting    |
    +---   -----+---   -----+---   --------+   7.7
    |  corridor                            |
    +---   ------------------   -+---   ---+   6.2
    |   |===|     |===|    |===| |         |
    |   |===|     |===|    |===|   kitchen |
    |   |===|     |===|    |===| |         |
    +----------------------------+---------+   0
    0                          11.4      14.9
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from fieldkit.frames import Pose, yaw_pose
from sim_bridge.mesh import Rgb
from sim_bridge.scenes import office_furniture as furniture
from sim_bridge.scenes import office_prints as prints
from sim_bridge.scenes import textures
from sim_bridge.scenes.blueprint import Blueprint, Builder
from sim_bridge.scenes.office_furniture import Style, hang, moved, px
from sim_bridge.scenes.plan import Opening, on_wall, outside, slab, wall, wall_frame, window

LENGTH_M, WIDTH_M, HEIGHT_M = 14.9, 11.0, 2.7
KITCHEN_X, CORRIDOR_Y, ROOMS_Y = 11.4, 6.2, 7.7
_PX_PER_M, _FLOOR_PX_PER_M = 110, 120
_DOWN = Rotation.from_euler("x", np.pi)
# The share of a stretch of wall that prints cover.
_HUNG_SHARE = 0.95
_WINDOW_POWER, _LAMP_POWER = 3.0, 4.2


@dataclasses.dataclass(frozen=True)
class Paints:
    """Texture numbers of the walls' faces: common paint, two coloured ones, stripes; and of the skirting."""

    plain: int
    accent: int
    warm: int
    striped: int
    trim: int


@dataclasses.dataclass(frozen=True)
class Line:
    """A wall in plan, from start to end."""

    start: tuple[float, float]
    end: tuple[float, float]

    def left(self, at_m: float) -> Pose:
        """Return the frame on the left face, at_m from the start."""
        return wall_frame(self.start, self.end, at_m)

    def right(self, at_m: float) -> Pose:
        """Return the frame on the right face, at_m from the start."""
        return wall_frame(self.start, self.end, at_m, side="right")


SOUTH = Line((0.0, 0.0), (LENGTH_M, 0.0))
EAST = Line((LENGTH_M, 0.0), (LENGTH_M, WIDTH_M))
NORTH = Line((LENGTH_M, WIDTH_M), (0.0, WIDTH_M))
WEST = Line((0.0, WIDTH_M), (0.0, 0.0))
FRONT = Line((0.0, CORRIDOR_Y), (LENGTH_M, CORRIDOR_Y))
BACK = Line((0.0, ROOMS_Y), (LENGTH_M, ROOMS_Y))
KITCHEN = Line((KITCHEN_X, 0.0), (KITCHEN_X, CORRIDOR_Y))
# The rooms behind the corridor: their walls' x, from west to east.
_ROOM_XS = (0.0, 4.4, 8.8, LENGTH_M)


def office(seed: int) -> Blueprint:
    """Make the office of 14.9 x 11.0 x 2.7 m; the same seed gives the same office."""
    rng = np.random.default_rng([seed, 90801])
    build = Builder()
    look = furniture.style(build, rng)
    paints = _paints(build, rng)
    _shell(build, rng, paints)
    _floors(build, rng)
    _ceilings(build, rng)
    _open_plan(build, rng, look)
    _corridor(build, rng, look)
    _galleries(build, rng)
    for i, room in enumerate(rng.permutation(2)):
        _single_office(build, rng, look, x0=_ROOM_XS[i], variant=int(room))
    _meeting_room(build, rng, look)
    _kitchenette(build, rng, look)
    bounds = (0.0, 0.0, LENGTH_M, WIDTH_M)
    outside(build, bounds, [bounds])
    return build.blueprint(floor_bounds=bounds)


def _paints(build: Builder, rng: np.random.Generator) -> Paints:
    size = (round(HEIGHT_M * _PX_PER_M), round(6 * _PX_PER_M))
    white = np.array([224, 222, 216]) + rng.normal(0, 3, 3)
    accent = np.array(((134, 156, 172), (168, 178, 140), (186, 140, 110))[int(rng.integers(3))]) + rng.normal(0, 5, 3)
    warm = np.array([214, 204, 184]) + rng.normal(0, 4, 3)
    wide = (size[0], round((LENGTH_M + 0.12) * _PX_PER_M))
    return Paints(
        plain=build.texture(prints.paint(rng, size, base=white)),
        accent=build.texture(prints.paint(rng, size, base=accent)),
        warm=build.texture(prints.paint(rng, size, base=warm)),
        striped=build.texture(prints.stripes(rng, wide, base=white - 14, px_per_m=_PX_PER_M, pitch_m=0.3)),
        trim=build.plain(white - 90),
    )


def _shell(build: Builder, rng: np.random.Generator, paints: Paints) -> None:
    view = build.texture(prints.window_view(rng, (128, 192)))
    rim = build.plain((206, 206, 204))

    def put(line: Line, left: int | None, right: int | None, *openings: Opening) -> None:
        wall(
            build,
            line.start,
            line.end,
            height_m=HEIGHT_M,
            openings=openings,
            left=left,
            right=right,
            trim=paints.trim,
            cell_m=0.2,
        )
        for hole in openings:
            if hole.bottom_m > 0.0:
                window(build, line.start, line.end, hole, power=_WINDOW_POWER, texture=view, frame=rim, samples=(1, 1))

    def panes(*at: float, width_m: float = 1.7) -> list[Opening]:
        return [Opening(s, width_m, top_m=2.25, bottom_m=0.9) for s in at]

    put(SOUTH, paints.plain, None, *panes(2.25, 5.7, 9.15), *panes(13.4, width_m=1.4))
    put(EAST, paints.plain, None)
    put(NORTH, paints.plain, None, *panes(*(LENGTH_M - x for x in (2.2, 6.6, 11.9))))
    put(WEST, paints.accent, None)
    put(FRONT, paints.striped, paints.plain, Opening(2.1, 1.3), Opening(9.3, 1.3), Opening(12.4, 1.2))
    put(BACK, paints.plain, paints.warm, Opening(1.2, 1.15), Opening(7.8, 1.15), Opening(10.0, 1.15))
    put(KITCHEN, paints.plain, paints.warm, Opening(5.35, 1.2))
    for x in _ROOM_XS[1:3]:
        put(Line((x, ROOMS_Y), (x, WIDTH_M)), paints.plain, paints.accent if x > 5 else paints.plain)


def _rooms() -> list[tuple[float, float, float, float]]:
    """Return the rooms' rectangles: open plan, corridor, kitchenette, then the rooms behind."""
    rooms = [(0.0, 0.0, KITCHEN_X, CORRIDOR_Y), (0.0, CORRIDOR_Y, LENGTH_M, ROOMS_Y)]
    rooms.append((KITCHEN_X, 0.0, LENGTH_M, CORRIDOR_Y))
    return rooms + [(a, ROOMS_Y, b, WIDTH_M) for a, b in itertools.pairwise(_ROOM_XS)]


def _floors(build: Builder, rng: np.random.Generator) -> None:
    tone = np.array(((96, 100, 106), (112, 104, 96), (88, 98, 100))[int(rng.integers(3))])
    for i, (x0, y0, x1, y1) in enumerate(_rooms()):
        size = (round((y1 - y0) * _FLOOR_PX_PER_M), round((x1 - x0) * _FLOOR_PX_PER_M))
        if i == 2:
            image = textures.planks(rng, size, px_per_m=_FLOOR_PX_PER_M)
        else:
            image = prints.carpet(rng, size, base=tone, px_per_m=_FLOOR_PX_PER_M)
        slab(build, (x0, y0, x1, y1), z_m=0.0, texture=build.texture(image), up=True, cell_m=0.13)


def _ceilings(build: Builder, rng: np.random.Generator) -> None:
    """Add ceilings and lamps, which are alike everywhere, and vents, of which each looks like the other."""
    panels = build.texture(prints.ceiling_tiles(rng, (288, 288), px_per_m=120))
    vent = build.texture(prints.grille((96, 96)))
    for rect, (across, down) in zip(_rooms(), ((4, 3), (5, 1), (2, 2), (2, 1), (2, 1), (2, 1)), strict=True):
        slab(build, rect, z_m=HEIGHT_M, texture=panels, up=False, cell_m=0.6, tile_m=(2.4, 2.4))
        wide, deep = (rect[2] - rect[0]) / across, (rect[3] - rect[1]) / down
        for i in range(across):
            for j in range(down):
                x, y = rect[0] + wide * (i + 0.5), rect[1] + deep * (j + 0.5)
                under = Pose.from_components([x, y, HEIGHT_M - 0.01], _DOWN)
                build.lamp(under, (1.2, 0.3), power=_LAMP_POWER, samples=(1, 1))
                if rng.random() < 0.3:
                    beside = Pose.from_components([x + 0.35 * wide, y, HEIGHT_M - 0.004], _DOWN)
                    build.panel(beside, (0.58, 0.58), vent, solid=False)


def _picture(rng: np.random.Generator, size_m: tuple[float, float]) -> Rgb:
    return prints.printed(rng, px(size_m))


def _galleries(build: Builder, rng: np.random.Generator) -> None:
    """Hang prints along the walls wherever no furniture, board or opening is in the way; some walls stay blank."""
    d1, d2 = (Line((x, ROOMS_Y), (x, WIDTH_M)) for x in _ROOM_XS[1:3])
    faces: tuple[tuple[Callable[[float], Pose], float, tuple[tuple[float, float], ...]], ...] = (
        (SOUTH.left, 1.5, ((3.25, 4.7), (6.7, 8.15), (10.15, 11.0), (11.6, 12.6))),
        (WEST.left, 1.55, ((0.55, 3.1), (5.0, 7.2), (9.0, 10.4))),
        (KITCHEN.left, 1.5, ((2.0, 4.6),)),
        (KITCHEN.right, 1.5, ((0.4, 3.2),)),
        (FRONT.left, 1.45, ((2.9, 6.6), (11.0, 11.65), (13.15, 14.7))),
        (FRONT.right, 1.5, ((7.8, 8.5), (10.1, 11.2), (13.1, 14.7))),
        (BACK.right, 1.45, ((2.12, 2.7), (5.8, 6.85), (8.5, 9.3), (10.95, 12.5), (13.7, 14.7))),
        (BACK.left, 1.45, ((1.95, 4.1), (4.7, 7.1), (10.8, 14.4))),
        (NORTH.left, 1.5, ((0.3, 1.9), (4.1, 5.8))),
        (EAST.left, 1.5, ((4.7, 6.0), (6.4, 7.5), (7.85, 8.5), (10.2, 10.8))),
        (d1.left, 1.55, ((0.2, 2.9),)),
        (d1.right, 1.55, ((0.2, 2.9),)),
        (d2.left, 1.65, ((0.2, 2.4),)),
        (d2.right, 1.5, ((2.6, 3.1),)),
    )
    for face, up, spans in faces:
        furniture.gallery(build, rng, face, spans, share=_HUNG_SHARE, up_m=up)


def _board(build: Builder, rng: np.random.Generator, place: Pose, *, width_m: float, up_m: float = 1.5) -> None:
    """Hang a notice board on a wall's frame."""
    size = (width_m, 0.66 * width_m)
    hang(build, on_wall(place, 0.0, up_m, off_m=0.0), size, prints.cork(rng, px(size)), name="notices")


def _open_plan(build: Builder, rng: np.random.Generator, look: Style) -> None:
    """Add three double rows of desks across the room, cupboards along its north wall, and what hangs on the walls."""
    for x in (2.25, 5.7, 9.15):
        place = yaw_pose([x, 2.92, 0.0], np.pi / 2)
        furniture.bench(build, rng, look, place, desks=2)
        ends = [-np.pi / 2, np.pi / 2]
        for yaw in ends if rng.random() < 0.4 else [float(rng.choice(ends))]:
            outwards = moved(place, yaw_rad=yaw)
            _board(build, rng, moved(outwards, float(rng.uniform(-0.35, 0.35)), 1.656), width_m=0.9, up_m=0.92)
    for i, x in enumerate(np.arange(3.6, 8.2, 0.9)):
        tall = i in (0, 1, 4)
        front = FRONT.right(float(x))
        furniture.cupboard(build, look, front, height_m=2.0 if tall else 1.1)
        if not tall:
            furniture.litter(build, rng, moved(front, y=0.22), (0.85, 0.5), up_m=1.1, count=3)
        elif i != 1:
            size = (0.5, 0.7)
            up = float(rng.uniform(1.2, 1.5))
            hang(build, on_wall(front, 0.0, up, off_m=0.45), size, _picture(rng, size))
    _board(build, rng, FRONT.right(5.85), width_m=1.4, up_m=1.75)
    size = (1.6, 1.0)
    board = on_wall(WEST.left(WIDTH_M - 2.9), 0.0, 1.45, off_m=0.0)
    hang(build, board, size, prints.whiteboard(rng, px(size)), name="board")
    size = (1.1, 0.62)
    image = textures.screen(rng, px(size))
    hang(build, on_wall(KITCHEN.left(1.3), 0.0, 1.5, off_m=0.03), size, image, name="television")
    spots = ((3.97, 1.6, 0.0), (7.4, 4.0, 0.0), (2.1, 5.4, np.pi / 2), (10.6, 3.4, np.pi / 2))
    for x, y, yaw in (*spots, (0.8, 3.0, 0.0), (5.7, 0.9, 0.0), (7.6, 1.2, np.pi / 2), (9.15, 5.5, np.pi / 2)):
        furniture.hanging_sign(build, rng, yaw_pose([x, y, 0.0], yaw), ceiling_m=HEIGHT_M)
    for x, y in ((10.95, 0.5), (0.5, 5.7)):
        furniture.plant(build, rng, yaw_pose([x, y, 0.0], float(rng.uniform(0, np.pi))))
    furniture.bin_(build, yaw_pose([8.4, 5.9, 0.0], float(rng.uniform(0, np.pi))))


def _corridor(build: Builder, rng: np.random.Generator, look: Style) -> None:
    """Add closed doors of which each looks like the other, signs, and pictures here and there."""
    for x in (3.3, 5.2, 13.1):
        furniture.door(build, look, BACK.right(x))
    for i, x in enumerate((1.95, 4.05, 7.0, 10.8)):
        size = (0.22, 0.16)
        text = f"{int(rng.integers(1, 4))}.{i + 11}"
        image = prints.sign(rng, px(size), text=text, base=(70, 78, 90))
        hang(build, on_wall(BACK.right(x), 0.0, 1.55, off_m=0.0), size, image, name="sign")
    _board(build, rng, WEST.left(WIDTH_M - 6.95), width_m=1.2)
    for x in (1.0, 3.2, 5.9, 8.6, 11.9):
        furniture.hanging_sign(build, rng, yaw_pose([x, 6.95, 0.0], np.pi / 2), ceiling_m=HEIGHT_M)


def _single_office(build: Builder, rng: np.random.Generator, look: Style, *, x0: float, variant: int) -> None:
    """Add one of two alike offices: a desk, a cupboard and folders along the walls, a picture."""
    x1 = x0 + 4.4
    divider = Line((4.4, ROOMS_Y), (4.4, WIDTH_M))
    # Towards the wall between the two offices, or away from it.
    inner = divider.left(2.0) if x0 == 0.0 else divider.right(2.0)
    outer = WEST.left(1.4) if x0 == 0.0 else Line((8.8, ROOMS_Y), (8.8, WIDTH_M)).left(1.6)
    corner = yaw_pose([3.9 if x0 == 0.0 else 4.9, ROOMS_Y + 0.45, 0.0], 0.3)
    furniture.workplace(build, rng, look, inner)
    furniture.bookcase(build, rng, look, NORTH.left(LENGTH_M - (x0 + 0.6)))
    furniture.cupboard(build, look, NORTH.left(LENGTH_M - (x1 - 0.6)))
    furniture.cupboard(build, look, outer, height_m=1.1)
    if variant == 0:
        furniture.carton(build, rng, corner * yaw_pose([0.0, 0.0, 0.0], 0.2), height_m=0.35)
    else:
        furniture.plant(build, rng, corner)


def _meeting_room(build: Builder, rng: np.random.Generator, look: Style) -> None:
    """Add a long table with eight equal chairs, a screen, a board."""
    middle = yaw_pose([12.0, WIDTH_M - 1.22, 0.0], 0.0)
    furniture.table(build, look, middle, (2.6, 0.9))
    furniture.litter(build, rng, middle, (2.4, 0.8), up_m=furniture.DESK_TOP_M, count=4)
    for yaw in (0.0, np.pi):
        for x in (-0.85, 0.0, 0.85):
            spot = moved(moved(middle, yaw_rad=yaw), x + float(rng.normal(0, 0.04)), 0.55)
            furniture.seat(build, look, moved(spot, yaw_rad=float(rng.normal(0, 0.12))))
    size = (1.4, 0.8)
    image = textures.screen(rng, px(size, px_per_m=300))
    hang(build, on_wall(EAST.left(9.4), 0.0, 1.45, off_m=0.02), size, image, name="television")
    size = (1.8, 1.1)
    divider = Line((8.8, ROOMS_Y), (8.8, WIDTH_M))
    hang(build, on_wall(divider.right(1.6), 0.0, 1.45, off_m=0.0), size, prints.whiteboard(rng, px(size)), name="board")


def _kitchenette(build: Builder, rng: np.random.Generator, look: Style) -> None:
    """Add a counter with equal fronts along the east wall, two tables with chairs, notices."""
    furniture.kitchen_counter(build, rng, look, EAST.left(2.6), units=6)
    for y in (1.65, 3.95):
        spot = yaw_pose([12.15, y, 0.0], float(rng.normal(0, 0.1)))
        furniture.table(build, look, spot, (0.8, 0.8), kind="movable")
        for yaw in (0.0, -np.pi / 2, np.pi):
            near = moved(moved(spot, yaw_rad=yaw), float(rng.normal(0, 0.04)), 0.5)
            if rng.random() < 0.8:
                furniture.seat(build, look, moved(near, yaw_rad=float(rng.normal(0, 0.2))))
    _board(build, rng, KITCHEN.right(3.9), width_m=1.1)
    size = (0.45, 0.7)
    hang(build, on_wall(FRONT.right(13.6), 0.0, 1.5, off_m=0.0), size, prints.calendar(rng, px(size)), name="calendar")
