"""A school, a test scene: two classrooms of one plan, a corridor of lockers, a cloakroom, a room for painting."""

from __future__ import annotations

import numpy as np

from fieldkit.frames import Pose
from sim_bridge.scenes import school_furniture as furniture
from sim_bridge.scenes.blueprint import Blueprint, Builder
from sim_bridge.scenes.heldout_art import landscape, pupil_drawing, still_life, strokes
from sim_bridge.scenes.heldout_charts import anatomy, clock, land_map, timetable
from sim_bridge.scenes.heldout_parts import (
    XY,
    Tone,
    WallPaint,
    ceiling_lamp,
    closed_door,
    door_face,
    hang,
    open_leaf,
    plant,
    shell,
    spot,
    tone,
)
from sim_bridge.scenes.heldout_prints import Picture, Rgb, notice, number_sign, pinboard
from sim_bridge.scenes.heldout_surfaces import basket, grid_ceiling, two_tone
from sim_bridge.scenes.plan import Opening, wall_frame, window

LENGTH_M, WIDTH_M, HEIGHT_M = 15.0, 12.2, 3.3
CLASS_X, LOW_Y, HIGH_Y = 8.8, 5.05, 7.15
_SOUTH = ((0.0, 0.0), (LENGTH_M, 0.0))
_EAST = ((LENGTH_M, 0.0), (LENGTH_M, WIDTH_M))
_NORTH = ((LENGTH_M, WIDTH_M), (0.0, WIDTH_M))
_WEST = ((0.0, WIDTH_M), (0.0, 0.0))
_LOW = ((0.0, LOW_Y), (LENGTH_M, LOW_Y))
_HIGH = ((LENGTH_M, HIGH_Y), (0.0, HIGH_Y))
_PARTS = (((CLASS_X, 0.0), (CLASS_X, LOW_Y)), ((CLASS_X, HIGH_Y), (CLASS_X, WIDTH_M)))
_DOOR_M = 1.2
_LOW_DOORS = (Opening(7.95, _DOOR_M), Opening(9.8, _DOOR_M))
_HIGH_DOORS = (Opening(LENGTH_M - 9.8, _DOOR_M), Opening(LENGTH_M - 0.85, _DOOR_M))
_CREAM: Tone = (228, 222, 204)
_OCHRE: Tone = (196, 170, 120)
_BLUE: Tone = (108, 132, 150)
_LAMP_POWER = 6.0
_FLOOR_DENSITY = 130


def school(seed: int) -> Blueprint:
    """Make the school, 15 m x 12.2 m."""
    build, rng = Builder(), np.random.default_rng([seed, 4103])
    _building(build, rng)
    # Both classrooms have one plan; the second is turned by half a turn.
    for room in (spot(0.0, 0.0), spot(CLASS_X, WIDTH_M, 180.0)):
        _classroom(build, rng, room)
    _cloakroom(build, rng)
    _art_room(build, rng)
    _corridor(build, rng)
    _drawings(build, rng)
    _lamps(build)
    return build.blueprint(floor_bounds=(0.0, 0.0, LENGTH_M, WIDTH_M))


def _building(build: Builder, rng: np.random.Generator) -> None:
    paint = WallPaint(HEIGHT_M, 110.0, left=_CREAM, right=_CREAM, trim=(84, 62, 46))
    size = (round(WIDTH_M * _FLOOR_DENSITY), round(LENGTH_M * _FLOOR_DENSITY))
    floor = basket(rng, size, base=(146, 108, 70), cell_px=26)
    ceiling = grid_ceiling((720, 900), base=(234, 232, 226), cell_px=72)
    shell(build, (0.0, 0.0, LENGTH_M, WIDTH_M), height_m=HEIGHT_M, floor=floor, ceiling=ceiling, cell_m=0.12)

    def lined(line: tuple[XY, XY]) -> Rgb:
        return two_tone(rng, paint.pixels(line), upper=_CREAM, lower=_OCHRE, share=0.42)

    at_south = [Opening(x, 1.5, 2.7, 1.0) for x in (2.2, 4.6, 7.0, 11.9)]
    at_north = [Opening(x, 1.5, 2.7, 1.0) for x in (3.1, 8.0, 10.4, 12.8)]
    at_west = [Opening(WIDTH_M / 2, 1.1, 2.6, 1.1)]
    paint.stand(build, rng, _SOUTH, at_south)
    paint.stand(build, rng, _EAST)
    paint.stand(build, rng, _NORTH, at_north)
    paint.stand(build, rng, _WEST, at_west)
    paint.stand(build, rng, _LOW, _LOW_DOORS, left=lined(_LOW))
    paint.stand(build, rng, _HIGH, _HIGH_DOORS, left=lined(_HIGH))
    for line in _PARTS:
        paint.stand(build, rng, line)
    frame = tone(build, (214, 208, 192))
    for line, openings in ((_SOUTH, at_south), (_NORTH, at_north), (_WEST, at_west)):
        for opening in openings:
            window(build, *line, opening, power=3.4, frame=frame, bars=2, samples=(1, 1))


def _classroom(build: Builder, rng: np.random.Generator, room: Pose) -> None:
    """Furnish a classroom: its board is at x = 0, windows at y = 0, its door near (7.95, LOW_Y)."""
    front = room * spot(0.06, LOW_Y / 2, -90.0)
    furniture.blackboard(build, rng, front * spot(float(rng.uniform(-0.2, 0.2)), 0.0), width_m=3.0)
    furniture.teachers_desk(build, rng, room * spot(1.55, 1.2 + float(rng.normal(0, 0.04)), -90.0))
    for x in (3.0, 4.3, 5.6, 6.9)[: 4 if rng.random() < 0.5 else 3]:
        for y in (0.76, 3.14):
            desk = room * spot(x, y, 90.0 + float(rng.normal(0, 1.0)))
            furniture.pupil_desk(build, rng, desk, used=bool(rng.random() < 0.35))
            for dx in (-0.32, 0.32):
                at = desk * spot(dx + float(rng.normal(0, 0.02)), -0.42 - float(rng.uniform(0.0, 0.1)))
                furniture.pupil_chair(build, at * spot(0.0, 0.0, float(rng.normal(0, 7))))
    furniture.map_stand(build, rng, room * spot(0.55, 4.2, -75.0 + float(rng.normal(0, 6))))
    hang(build, front, (-2.0, 2.55), (0.34, 0.34), build.texture(clock(rng, (100, 100))), name="clock", depth_m=0.05)
    back = room * spot(CLASS_X - 0.06, 0.0, 90.0)
    furniture.tall_cabinet(build, back * spot(0.65, 0.0))
    strip = back * spot(2.6, 0.0)
    for k in np.flatnonzero(rng.random(5) < 0.75):
        drawing = _sheet(build, rng, pupil_drawing, (0.42, 0.3))
        place = (0.52 * (float(k) - 2), 1.65 + float(rng.uniform(-0.06, 0.06)))
        hang(build, strip, place, (0.42, 0.3), drawing, name="drawing", depth_m=0.008)
    aside = room * spot(4.4, LOW_Y - 0.06, 180.0)
    hang(build, aside, (2.2, 1.7), (1.2, 0.85), _sheet(build, rng, land_map, (1.2, 0.85)), name="map")
    make: Picture = (anatomy, notice, timetable)[int(rng.integers(3))]
    hang(build, aside, (-0.9 + float(rng.uniform(-0.4, 0.4)), 1.65), (0.6, 0.84), _sheet(build, rng, make, (0.6, 0.84)))
    open_leaf(build, room * spot(7.3 - 1.1, LOW_Y - 0.06, 0.0), _door(build), rim=_BLUE, stands_clear_m=-0.06)


def _sheet(build: Builder, rng: np.random.Generator, make: Picture, size_m: XY) -> int:
    return build.texture(make(rng, (round(size_m[1] * 340), round(size_m[0] * 340))))


def _door(build: Builder) -> int:
    return build.shared("school door", lambda: door_face(_BLUE, window=True))


def _cloakroom(build: Builder, rng: np.random.Generator) -> None:
    furniture.coat_hooks(build, rng, wall_frame(*_EAST, 2.4), length_m=4.0, coats=7)
    furniture.coat_hooks(build, rng, wall_frame(*_SOUTH, 10.2), length_m=1.75, coats=3)
    island = spot(11.8, 2.7)
    for turn in (0.0, 180.0):
        furniture.lockers(build, island * spot(0.0, 0.0, turn), units=7)
    west = wall_frame(*_PARTS[0], 2.9, side="right")
    furniture.low_shelf(build, rng, west, bays=2)
    furniture.globe(build, rng, west * spot(float(rng.uniform(-0.6, 0.6)), 0.17, z=0.875))
    board = build.texture(pinboard(rng, (290, 420), base=(160, 116, 80), sheets=12))
    hang(build, west, (0.0, 1.6), (1.3, 0.9), board, name="board", depth_m=0.03, rim=(120, 88, 58))
    hall = wall_frame(*_LOW, 13.2, side="right")
    hang(build, hall, (float(rng.uniform(-0.5, 0.5)), 1.6), (0.7, 1.0), _sheet(build, rng, notice, (0.7, 1.0)))
    plant(build, rng, spot(14.2, 0.6), height_m=1.4, pot=(120, 70, 54))


def _art_room(build: Builder, rng: np.random.Generator) -> None:
    for y in (9.0, 10.1):
        furniture.work_table(build, rng, spot(11.4, y, float(rng.normal(0, 1.0))), jars=9)
    makers = (still_life, landscape, strokes)
    for x, y, yaw in ((14.3, 8.3, 80.0), (14.3, 9.7, 92.0), (14.3, 11.1, 105.0)):
        make = makers[int(rng.integers(3))]
        furniture.easel(build, rng, spot(x, y, yaw + float(rng.normal(0, 8))), make(rng, (290, 220)))
    furniture.tall_cabinet(build, wall_frame(*_PARTS[1], 3.9, side="right"))
    furniture.tall_cabinet(build, wall_frame(*_PARTS[1], 2.9, side="right"))
    for k in range(4):
        make_one: Picture = pupil_drawing if rng.random() < 0.7 else strokes
        place = wall_frame(*_EAST, 8.0 + 0.95 * k)
        drawing = _sheet(build, rng, make_one, (0.6, 0.42))
        hang(build, place, (0.0, 1.7 + float(rng.uniform(-0.1, 0.1))), (0.6, 0.42), drawing, name="drawing")
    wall = wall_frame(*_HIGH, LENGTH_M - 12.0, side="right")
    hang(build, wall, (0.0, 1.6), (0.9, 0.65), _sheet(build, rng, timetable, (0.9, 0.65)), name="timetable")


def _corridor(build: Builder, rng: np.random.Generator) -> None:
    for at, units in ((2.2, 8), (5.4, 6)):
        furniture.lockers(build, wall_frame(*_LOW, at), units=units)
    furniture.lockers(build, wall_frame(*_LOW, 12.6), units=8)
    for at in (3.0, 8.2):
        furniture.coat_hooks(build, rng, wall_frame(*_HIGH, at + 0.1), length_m=2.0, coats=int(rng.integers(2, 5)))
    for line, at, text in ((_LOW, 7.12, "1a"), (_LOW, 10.62, "K"), (_HIGH, 4.38, "M"), (_HIGH, 13.33, "1b")):
        sign = build.texture(number_sign(rng, (76, 76), text=text, base=(140, 64, 40)))
        hang(build, wall_frame(*line, at), (0.0, 1.65), (0.2, 0.2), sign, name="door sign")
    for line, at in ((_HIGH, 6.1), (_HIGH, 11.4)):
        closed_door(build, wall_frame(*line, at), _door(build), rim=(120, 92, 66), size_m=(0.9, 2.06))
    hang(build, wall_frame(*_HIGH, 9.95), (0.0, 1.6), (1.1, 0.8), _sheet(build, rng, land_map, (1.1, 0.8)), name="map")
    board = build.texture(pinboard(rng, (300, 400), base=(70, 84, 66), sheets=10))
    hang(build, wall_frame(*_EAST, 6.0), (0.0, 1.55), (1.25, 0.95), board, name="board", depth_m=0.03)


def _drawings(build: Builder, rng: np.random.Generator) -> None:
    """Hang pupils' work in a row above doors and lockers, on both sides of the corridor's walls, with some gaps."""
    size = (0.6, 0.42)
    for line in (_LOW, _HIGH):
        for side in ("left", "right"):
            for at in np.arange(0.8, LENGTH_M - 0.6, 0.95):
                make: Picture = (pupil_drawing, pupil_drawing, strokes, still_life)[int(rng.integers(4))]
                near_part = side == "right" and abs(at - (CLASS_X if line is _LOW else LENGTH_M - CLASS_X)) < 0.5
                if rng.random() < 0.2 or near_part:
                    continue
                place = wall_frame(*line, float(at + rng.uniform(-0.12, 0.12)), side=side)
                up = 2.55 + float(rng.uniform(-0.05, 0.05))
                hang(build, place, (0.0, up), size, _sheet(build, rng, make, size), name="drawing", depth_m=0.008)


def _lamps(build: Builder) -> None:
    for room in (spot(0.0, 0.0), spot(CLASS_X, WIDTH_M, 180.0)):
        for x in (1.6, 4.4, 7.2):
            for y in (1.3, 3.6):
                at = room.apply([x, y, 0.0])
                _tube(build, (float(at[0]), float(at[1])), power=0.8)
    for x in (1.5, 4.5, 7.5, 10.5, 13.5):
        _tube(build, (x, 6.0), power=0.7)
    for at_xy in ((10.4, 1.6), (13.4, 1.6), (11.8, 3.9), (10.6, 9.4), (13.3, 8.2), (13.3, 10.8)):
        _tube(build, at_xy, power=0.9)


def _tube(build: Builder, at: XY, *, power: float) -> None:
    place = spot(*at)
    build.box(place, [0, 0, HEIGHT_M - 0.18], [1.3, 0.16, 0.08], tone(build, (200, 200, 196)), cell_m=0.5, solid=False)
    ceiling_lamp(build, at, z_m=HEIGHT_M - 0.225, size_m=(1.24, 0.12), power=power * _LAMP_POWER)
