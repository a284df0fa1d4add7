"""A library, a test scene: book stacks in rows, reading tables, carrels along a wall, an issue desk, a study room."""

from __future__ import annotations

import numpy as np

from fieldkit.frames import Pose
from sim_bridge.scenes import library_furniture as furniture
from sim_bridge.scenes.blueprint import Blueprint, Builder
from sim_bridge.scenes.heldout_art import landscape, portrait
from sim_bridge.scenes.heldout_charts import clock, land_map
from sim_bridge.scenes.heldout_parts import (
    XY,
    Tone,
    WallPaint,
    ceiling_lamp,
    door_face,
    hang,
    open_leaf,
    plant,
    shell,
    spot,
    tone,
)
from sim_bridge.scenes.heldout_prints import cover, notice, pinboard
from sim_bridge.scenes.heldout_surfaces import bands, flecked, grid_ceiling
from sim_bridge.scenes.plan import Opening, wall_frame, window

LENGTH_M, WIDTH_M, HEIGHT_M = 15.0, 10.0, 3.2
_SOUTH = ((0.0, 0.0), (LENGTH_M, 0.0))
_EAST = ((LENGTH_M, 0.0), (LENGTH_M, WIDTH_M))
_NORTH = ((LENGTH_M, WIDTH_M), (0.0, WIDTH_M))
_WEST = ((0.0, WIDTH_M), (0.0, 0.0))
_STUDY_WEST = ((11.4, WIDTH_M), (11.4, 6.6))
_STUDY_SOUTH = ((11.4, 6.6), (LENGTH_M, 6.6))
_STUDY_DOOR = Opening(at_m=2.5, width_m=1.2)
_WINDOWS = tuple(Opening(at_m=y, width_m=1.5, top_m=2.5, bottom_m=0.95) for y in (1.5, 3.6, 5.5))
_STACK_ROWS = ((1.95, 2.1, 6), (3.75, 2.1, 6), (5.55, 2.1, 6), (7.3, 1.34, 3))
_LAMP_POWER = 4.2


def library(seed: int) -> Blueprint:
    """Make the library, 15 m x 10 m."""
    build, rng = Builder(), np.random.default_rng([seed, 4101])
    _building(build, rng)
    _stacks(build, rng)
    _reading_area(build, rng)
    _desk_area(build, rng)
    _study(build, rng)
    _pictures(build, rng)
    _lamps(build)
    return build.blueprint(floor_bounds=(0.0, 0.0, LENGTH_M, WIDTH_M))


def _building(build: Builder, rng: np.random.Generator) -> None:
    paint = WallPaint(HEIGHT_M, 120.0, left=(222, 216, 200), right=(222, 216, 200), trim=(92, 66, 46))
    bound = (0.0, 0.0, LENGTH_M, WIDTH_M)
    hall = flecked(rng, (1300, 1950), base=(112, 108, 116), tile_px=156)
    ceiling = grid_ceiling((600, 900), base=(226, 226, 222), cell_px=36)
    shell(build, bound, height_m=HEIGHT_M, floor=hall, ceiling=ceiling, cell_m=0.12)
    paper = bands(rng, paint.pixels(_EAST), base=(204, 190, 160), period_px=36.0, depth=5.0, upright=True)
    paint.stand(build, rng, _SOUTH)
    paint.stand(build, rng, _EAST, _WINDOWS, left=paper)
    paint.stand(build, rng, _NORTH)
    paint.stand(build, rng, _WEST)
    paint.stand(build, rng, _STUDY_WEST, (_STUDY_DOOR,))
    paper = bands(rng, paint.pixels(_STUDY_SOUTH), base=(204, 190, 160), period_px=36.0, depth=5.0, upright=True)
    paint.stand(build, rng, _STUDY_SOUTH, right=paper)
    for opening in _WINDOWS:
        window(build, *_EAST, opening, power=5.0, frame=tone(build, (236, 234, 228)), bars=1, samples=(2, 1))
    face = build.shared("study door", lambda: door_face((150, 118, 82), window=True))
    hinge = wall_frame(*_STUDY_WEST, _STUDY_DOOR.start_m - 1.1)
    open_leaf(build, hinge, face, rim=(150, 118, 82), size_m=(1.1, 2.06))


def _stacks(build: Builder, rng: np.random.Generator) -> None:
    signs: tuple[Tone, ...] = ((40, 70, 116), (122, 50, 48), (54, 92, 66), (96, 72, 120))
    rgb = signs[int(rng.integers(4))]
    for row, (y, height, levels) in enumerate(_STACK_ROWS):
        place = spot(4.6, y)
        furniture.stack(build, rng, place, bays=6, height_m=height, levels=levels)
        half = (6 * furniture.BAY_M + 0.04) / 2
        for side in (-1, 1) if height > 2.0 else ():
            end = place * spot(side * half, 0.0, -90.0 * side)
            furniture.end_sign(build, rng, end, text=f"{2 * row + (side + 3) // 2}", rgb=rgb)
    furniture.stack(build, rng, wall_frame(*_SOUTH, 4.7), bays=7, height_m=2.1, levels=6, faces=1)
    for x, y in ((2.6, 2.6), (6.4, 4.42), (3.6, 6.22)):
        furniture.step_stool(build, spot(x + float(rng.uniform(-0.4, 0.4)), y, float(rng.uniform(-9, 9))))


def _reading_area(build: Builder, rng: np.random.Generator) -> None:
    for x in (10.05, 12.95):
        for y in (1.3, 4.35):
            table = spot(x, y)
            furniture.reading_table(build, rng, table, clutter=int(rng.integers(0, 5)))
            for dx in (-0.45, 0.45):
                for side in (-1, 1):
                    _chair(build, rng, table * spot(dx, 0.0, 90.0 - 90.0 * side), out_m=0.66)
    furniture.card_cabinet(build, wall_frame(*_SOUTH, 8.42))
    furniture.magazine_rack(build, rng, wall_frame(*_WEST, 5.4), columns=5)
    plant(build, rng, spot(14.55, 6.1), height_m=1.3, pot=(146, 84, 60))
    plant(build, rng, spot(0.5, 0.5), height_m=1.5, pot=(146, 84, 60))


def _chair(build: Builder, rng: np.random.Generator, seat: Pose, *, out_m: float) -> None:
    """Put a chair behind a seat at a table (the table lies towards -y), drawn out and turned a little."""
    drawn = out_m + float(rng.uniform(-0.05, 0.06))
    furniture.reading_chair(build, seat * spot(float(rng.normal(0, 0.02)), drawn, 180.0 + float(rng.normal(0, 6))))


def _desk_area(build: Builder, rng: np.random.Generator) -> None:
    furniture.issue_desk(build, rng, spot(9.15, 8.15, 180.0), length_m=1.9)
    furniture.reading_chair(build, spot(9.3, 8.9, -90.0))
    for x in (1.6, 2.7, 3.8, 4.9, 6.0):
        place = wall_frame(*_NORTH, LENGTH_M - x)
        furniture.carrel(build, rng, place, used=bool(rng.random() < 0.3))
        _chair(build, rng, place, out_m=0.72)
    furniture.book_trolley(build, rng, spot(7.6, 9.6, 4.0))
    furniture.book_trolley(build, rng, spot(10.75, 9.7, -6.0))


def _study(build: Builder, rng: np.random.Generator) -> None:
    table = spot(14.2, 8.3, 90.0)
    furniture.reading_table(build, rng, table, clutter=3)
    for dx in (-0.45, 0.45):
        _chair(build, rng, table * spot(dx, 0.0), out_m=0.7)
    stack = wall_frame(*_STUDY_SOUTH, 1.6)
    furniture.stack(build, rng, stack, bays=2, height_m=1.34, levels=3, faces=1, ends=furniture.DARK_OAK)
    board = build.texture(pinboard(rng, (280, 420), base=(226, 228, 226), sheets=5))
    hang(build, wall_frame(*_NORTH, 1.9), (0.0, 1.5), (1.4, 0.94), board, name="board")
    hang(build, wall_frame(*_EAST, 7.35), (0.0, 1.55), (0.6, 0.8), build.texture(notice(rng, (280, 210))))


def _pictures(build: Builder, rng: np.random.Generator) -> None:
    board = pinboard(rng, (300, 440), base=(132, 92, 62), sheets=13)
    west = wall_frame(*_STUDY_WEST, 1.0, side="right")
    hang(build, west, (0.05, 1.5), (1.4, 0.95), build.texture(board), name="board", depth_m=0.03, rim=(90, 64, 44))
    behind = wall_frame(*_NORTH, LENGTH_M - 9.4)
    hang(build, behind, (0.0, 1.75), (1.3, 0.9), build.texture(land_map(rng, (310, 450))), name="map")
    hang(build, behind, (-1.2, 2.3), (0.34, 0.34), build.texture(clock(rng, (110, 110))), name="clock", depth_m=0.05)
    south: tuple[XY, ...] = ((10.0, 0.7), (12.9, 0.62))
    for x, width in south:
        place = wall_frame(*_SOUTH, x + float(rng.uniform(-0.3, 0.3)))
        make = portrait if rng.random() < 0.7 else landscape
        size = (round(1.25 * width * 330), round(width * 330))
        picture = build.texture(make(rng, size))
        hang(build, place, (0.0, 1.65), (width, 1.25 * width), picture, name="painting", depth_m=0.04, rim=(96, 70, 36))
    for at in (1.4, 3.6, 8.6):
        place = wall_frame(*_WEST, at + float(rng.uniform(-0.2, 0.2)))
        make_sheet = notice if rng.random() < 0.6 else cover
        size_m = (0.5, 0.7) if rng.random() < 0.5 else (0.42, 0.6)
        picture = build.texture(make_sheet(rng, (round(size_m[1] * 350), round(size_m[0] * 350))))
        hang(build, place, (0.0, float(rng.uniform(1.4, 1.65))), size_m, picture)
    place = wall_frame(*_NORTH, LENGTH_M - float(rng.uniform(2.5, 5.2)))
    hang(build, place, (0.0, 1.85), (0.6, 0.84), build.texture(notice(rng, (290, 210))))


def _lamps(build: Builder) -> None:
    long_rows = [(x, y) for y in (1.15, 2.85, 4.65, 6.45, 8.5) for x in (2.6, 5.6, 8.4)]
    for at in long_rows:
        ceiling_lamp(build, at, z_m=HEIGHT_M - 0.03, size_m=(1.2, 0.18), power=_LAMP_POWER)
    for at in [(10.05, 1.4), (10.05, 4.4), (12.95, 1.4), (12.95, 4.4), (10.3, 7.0), (13.2, 8.3)]:
        ceiling_lamp(build, at, z_m=HEIGHT_M - 0.03, size_m=(0.58, 0.58), power=1.2 * _LAMP_POWER)
