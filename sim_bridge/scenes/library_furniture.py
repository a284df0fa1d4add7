"""Furniture of the library: book stacks, reading tables and chairs, carrels, the issue desk, racks."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from fieldkit.frames import Pose
from sim_bridge.scenes.blueprint import Builder
from sim_bridge.scenes.heldout_charts import readout
from sim_bridge.scenes.heldout_parts import COARSE_M, Tone, hang, legs, monitor, solids, spot, tone
from sim_bridge.scenes.heldout_prints import cover, notice, number_sign, spines
from sim_bridge.scenes.heldout_surfaces import Rgb, veneer
from sim_bridge.scenes.plan import on_wall

STEEL: Tone = (176, 178, 172)
OAK: Tone = (168, 132, 92)
DARK_OAK: Tone = (104, 74, 50)
BAY_M, SHELF_DENSITY = 0.9, 320.0
_COMMON_ROWS = 14
_SERIES_ROWS = 6


def oak(build: Builder, rgb: Tone, *, upright: bool = False) -> int:
    """Return the veneer of all furniture of one wood."""
    make = np.random.default_rng(rgb[0])
    return build.shared(("oak", rgb, upright), lambda: veneer(make, (200, 200), base=rgb, upright=upright))


def _row_of_books(build: Builder, rng: np.random.Generator, height_m: float) -> int | None:
    """Return the texture of a bay's books: bound series and popular rows recur, few are unique, some are missing."""
    size = (round(height_m * SHELF_DENSITY), round((BAY_M - 0.03) * SHELF_DENSITY))
    choice = rng.random()
    if choice < 0.07:
        return None
    if choice < 0.4:
        number = int(rng.integers(_SERIES_ROWS))
        make = np.random.default_rng([811, number])
        return build.shared(("series", number, size), lambda: spines(make, size, series=True))
    if choice < 0.82:
        number = int(rng.integers(_COMMON_ROWS))
        make = np.random.default_rng([812, number])
        full = 1.0 if number % 3 else 0.7
        return build.shared(("common", number, size), lambda: spines(make, size, series=False, full=full))
    return build.texture(spines(rng, size, series=False, full=float(rng.uniform(0.5, 1.0))))


def stack(
    build: Builder,
    rng: np.random.Generator,
    place: Pose,
    *,
    bays: int,
    height_m: float,
    levels: int,
    faces: int = 2,
    ends: Tone = STEEL,
) -> None:
    """Stand a book stack along x, centred on a place, with books on one face (+y, its back at y = 0) or two."""
    length, half = bays * BAY_M + 0.04, 0.3
    steel, end, dark = tone(build, STEEL), tone(build, ends), tone(build, (70, 66, 62))
    low, high = (-half, half) if faces == 2 else (0.0, half)
    depth, middle = high - low, (high + low) / 2
    with build.thing("stack", place, kind="fixed"):
        for side in (-1, 1):
            at = [side * (length / 2 - 0.01), middle, height_m / 2]
            build.box(place, at, [0.02, depth, height_m], end, cell_m=0.35)
        build.box(place, [0, middle, height_m - 0.015], [length - 0.04, depth - 0.01, 0.02], steel, cell_m=0.5)
        build.box(place, [0, middle, 0.05], [length - 0.04, depth - 0.02, 0.1], dark, cell_m=0.5)
        back = 0.0 if faces == 2 else 0.006
        build.box(place, [0, back, height_m / 2 + 0.04], [length - 0.04, 0.01, height_m - 0.12], steel, cell_m=0.5)
        for k in range(faces):
            _shelves(build, rng, place * spot(0.0, 0.0, 180.0 * k), bays=bays, height_m=height_m, levels=levels)
        build.block(place * spot(0.0, middle), (length, depth))


def _shelves(build: Builder, rng: np.random.Generator, place: Pose, *, bays: int, height_m: float, levels: int) -> None:
    steel, pitch = tone(build, STEEL), (height_m - 0.12) / levels
    for x in (np.arange(1, bays) - bays / 2) * BAY_M:
        build.box(place, [x, 0.15, height_m / 2 + 0.04], [0.02, 0.28, height_m - 0.12], steel, cell_m=0.7)
    for level in range(levels):
        up = 0.1 + level * pitch
        build.box(place, [0, 0.15, up + 0.01], [bays * BAY_M - 0.01, 0.27, 0.02], steel, cell_m=0.9)
        for x in (np.arange(bays) + 0.5 - bays / 2) * BAY_M:
            books = _row_of_books(build, rng, pitch - 0.03)
            if books is not None:
                set_back = 0.22 if level % 2 else 0.235
                centre = on_wall(place, x, up + 0.02 + (pitch - 0.03) / 2, off_m=set_back)
                build.panel(centre, (BAY_M - 0.03, pitch - 0.03), books, cell_m=0.3)


def end_sign(build: Builder, rng: np.random.Generator, stack_end: Pose, *, text: str, rgb: Tone) -> None:
    """Hang the sign of a stack on its end (the wall frame of that end): a number and what stands there."""
    picture = number_sign(rng, (110, 84), text=text, base=rgb)
    hang(build, stack_end, (0.0, 1.62), (0.28, 0.37), build.texture(picture), name="stack sign")
    if rng.random() < 0.5:
        sheet = build.texture(notice(rng, (125, 90)))
        hang(build, stack_end, (float(rng.uniform(-0.08, 0.08)), 1.17), (0.26, 0.36), sheet, name="sheet")


def reading_table(build: Builder, rng: np.random.Generator, place: Pose, *, clutter: int) -> None:
    """Stand a long table with a screen board and two shaded lamps along its middle, and some books left on it."""
    wood, brass, shade = oak(build, OAK), tone(build, (150, 122, 66)), tone(build, (34, 92, 70))
    with build.thing("reading table", place, kind="fixed"):
        build.box(place, [0, 0, 0.73], [1.8, 0.95, 0.04], wood, cell_m=0.2)
        solids(build, place, legs((1.76, 0.9), 0.71, thick_m=0.07), oak(build, DARK_OAK, upright=True))
        solids(build, place, [((0, 0.4, 0.66), (1.62, 0.025, 0.1)), ((0, -0.4, 0.66), (1.62, 0.025, 0.1))], wood)
        build.box(place, [0, 0, 0.9], [1.7, 0.03, 0.3], oak(build, DARK_OAK), cell_m=0.4)
        for x in (-0.45, 0.45):
            solids(build, place, [((x, 0, 1.12), (0.02, 0.02, 0.14))], brass)
            build.box(place, [x, 0, 1.2], [0.5, 0.18, 0.07], shade, cell_m=COARSE_M)
        for _ in range(clutter):
            side = rng.choice([-1.0, 1.0])
            at = place * spot(float(rng.uniform(-0.75, 0.75)), side * float(rng.uniform(0.16, 0.36)), z=0.75)
            pile(build, rng, at * spot(0, 0, float(rng.uniform(-40, 40))))
        build.block(place, (1.8, 0.95))


def pile(build: Builder, rng: np.random.Generator, place: Pose) -> None:
    """Lay one to four books on one another, covers up."""
    up = 0.0
    for _ in range(int(rng.integers(1, 5))):
        wide, deep, thick = rng.uniform(0.14, 0.22), rng.uniform(0.19, 0.28), rng.uniform(0.015, 0.045)
        top = build.texture(cover(rng, (90, 70)))
        here = place * spot(0.0, 0.0, float(rng.uniform(-14, 14)), z=up)
        edge = tone(build, (226, 218, 198))
        build.box(here, [0, 0, thick / 2], [wide, deep, thick], edge, sides={4: top}, cell_m=COARSE_M)
        up += thick


def reading_chair(build: Builder, place: Pose) -> None:
    """Stand a wooden chair with a barred back; one sits facing +y."""
    wood = oak(build, DARK_OAK, upright=True)
    with build.thing("reading chair", place):
        build.box(place, [0, 0, 0.45], [0.43, 0.42, 0.03], tone(build, (120, 44, 40)), cell_m=COARSE_M)
        solids(build, place, legs((0.43, 0.42), 0.435, thick_m=0.035), wood)
        posts = [((x, -0.19, 0.69), (0.035, 0.035, 0.46)) for x in (-0.195, 0.195)]
        bars = [((0.0, -0.19, z), (0.35, 0.02, 0.06)) for z in (0.62, 0.75, 0.88)]
        solids(build, place, [*posts, *bars], wood, cell_m=0.12)
        build.block(place, (0.43, 0.42))


def carrel(build: Builder, rng: np.random.Generator, wall_place: Pose, *, used: bool) -> None:
    """Stand a study desk against a wall between two plain screens; all are alike, few are in use."""
    wood, board = oak(build, OAK), tone(build, (150, 156, 138))
    with build.thing("carrel", wall_place, kind="fixed"):
        build.box(wall_place, [0, 0.31, 0.72], [0.96, 0.58, 0.03], wood, cell_m=0.25)
        for x in (-0.5, 0.5):
            build.box(wall_place, [x, 0.34, 0.66], [0.035, 0.68, 1.32], board, cell_m=0.3)
        build.box(wall_place, [0, 0.015, 0.98], [0.96, 0.02, 0.68], board, cell_m=0.4)
        build.box(wall_place, [0, 0.13, 1.2], [0.96, 0.22, 0.02], wood, cell_m=0.4)
        if used:
            sheet = build.texture(notice(rng, (100, 75)))
            build.panel(on_wall(wall_place, float(rng.uniform(-0.3, 0.3)), 1.0, off_m=0.03), (0.21, 0.29), sheet)
            pile(build, rng, wall_place * spot(float(rng.uniform(-0.3, 0.3)), 0.3, 10.0, z=0.735))
        build.block(wall_place * spot(0.0, 0.34), (1.04, 0.68))


def issue_desk(build: Builder, rng: np.random.Generator, place: Pose, *, length_m: float) -> None:
    """Stand the issue desk: a plain front along x towards +y, a short arm, a monitor, piles of books."""
    wood, top = oak(build, DARK_OAK), tone(build, (206, 200, 188))
    with build.thing("issue desk", place, kind="fixed"):
        build.box(place, [0, 0, 0.52], [length_m, 0.5, 1.04], wood, cell_m=0.3)
        build.box(place, [0, 0.02, 1.06], [length_m + 0.06, 0.6, 0.04], top, cell_m=0.3)
        arm = place * spot(length_m / 2 - 0.25, -0.85)
        build.box(arm, [0, 0, 0.4], [0.5, 1.2, 0.8], wood, cell_m=0.3)
        screen = build.texture(readout(rng, (180, 300)))
        monitor(build, place * spot(-0.3 * length_m, -0.05, 180.0, z=1.08), screen)
        for x in rng.uniform(-0.15, 0.42, 3) * length_m:
            pile(build, rng, place * spot(float(x), 0.08, z=1.08))
        pile(build, rng, arm * spot(0.0, -0.3, z=0.8))
        sheet = build.texture(notice(rng, (160, 230)))
        build.panel(on_wall(place, -0.15 * length_m, 0.72, off_m=0.251), (0.66, 0.46), sheet)
        build.block(place, (length_m + 0.06, 0.6))
        build.block(arm, (0.5, 1.2))


def magazine_rack(build: Builder, rng: np.random.Generator, wall_place: Pose, *, columns: int) -> None:
    """Stand a rack of sloping shelves against a wall, with the covers of magazines."""
    width, wood = columns * 0.29 + 0.05, oak(build, OAK)
    with build.thing("magazine rack", wall_place, kind="fixed"):
        build.box(wall_place, [0, 0.12, 0.8], [width, 0.24, 1.6], wood, cell_m=0.3)
        for row in range(4):
            ledge = [0.0, 0.3, 0.3 + 0.36 * row]
            build.box(wall_place, ledge, [width, 0.12, 0.02], wood, cell_m=0.5)
            for col in range(columns):
                if rng.random() < 0.2:
                    continue
                tilt = Rotation.from_euler("x", 12, degrees=True)
                at = Pose.from_components([(col + 0.5) * 0.29 - width / 2 + 0.025, 0.28, ledge[2] + 0.17], tilt)
                picture = build.texture(cover(rng, (108, 84)))
                build.box(wall_place * at, [0, 0, 0], [0.24, 0.008, 0.31], tone(build, STEEL), front=picture)
        build.block(wall_place * spot(0.0, 0.18), (width, 0.36))


def card_cabinet(build: Builder, wall_place: Pose) -> None:
    """Stand a cabinet of many equal drawers against a wall."""
    face = build.shared("drawers", _drawers)
    wood = oak(build, DARK_OAK)
    with build.thing("card cabinet", wall_place, kind="fixed"):
        build.box(wall_place, [0, 0.25, 0.2], [0.9, 0.4, 0.4], wood, cell_m=0.4)
        build.box(wall_place, [0, 0.25, 0.83], [0.94, 0.48, 0.86], wood, front=face, cell_m=0.3)
        build.block(wall_place * spot(0.0, 0.25), (0.94, 0.5))


def _drawers() -> Rgb:
    tile = np.empty((40, 62, 3), np.uint8)
    tile[:] = DARK_OAK
    tile[:2], tile[:, :2] = (60, 42, 28), (60, 42, 28)
    tile[10:20, 18:44] = (224, 214, 190)
    tile[24:30, 27:35] = (176, 150, 84)
    return np.tile(tile, (6, 4, 1))


def book_trolley(build: Builder, rng: np.random.Generator, place: Pose) -> None:
    """Stand a trolley with two rows of returned books on each side."""
    frame = tone(build, (124, 40, 44))
    with build.thing("book trolley", place):
        for x in (-0.43, 0.43):
            build.box(place, [x, 0, 0.58], [0.03, 0.42, 0.92], frame, cell_m=COARSE_M)
        for up in (0.3, 0.7):
            build.box(place, [0, 0, up], [0.83, 0.42, 0.02], frame, cell_m=0.5)
            build.box(place, [0, 0, up + 0.17], [0.83, 0.02, 0.32], frame, cell_m=0.5)
            for turn in (0.0, 180.0):
                books = build.texture(spines(rng, (88, 260), series=False, full=float(rng.uniform(0.6, 1.0))))
                side = place * spot(0.0, 0.0, turn)
                build.panel(on_wall(side, 0.0, up + 0.145, off_m=0.17), (0.82, 0.27), books, cell_m=0.4)
        solids(build, place, legs((0.86, 0.42), 0.12, thick_m=0.05), tone(build, (40, 40, 42)))
        build.block(place, (0.9, 0.44))


def step_stool(build: Builder, place: Pose) -> None:
    """Stand a round-cornered step stool, as there is one in every aisle."""
    grey = tone(build, (96, 100, 104))
    with build.thing("step stool", place):
        solids(build, place, [((0, 0, 0.12), (0.4, 0.4, 0.24)), ((0, 0, 0.33), (0.3, 0.3, 0.18))], grey)
        build.block(place, (0.4, 0.4))
