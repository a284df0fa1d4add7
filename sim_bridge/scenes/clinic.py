"""A clinic, a test scene: a corridor of equal doors, six treatment rooms of one plan, a waiting area, a counter."""

from __future__ import annotations

import numpy as np

from fieldkit.frames import Pose
from sim_bridge.scenes import clinic_furniture as furniture
from sim_bridge.scenes.blueprint import Blueprint, Builder
from sim_bridge.scenes.heldout_charts import anatomy, clock, eye_chart, timetable
from sim_bridge.scenes.heldout_parts import (
    COARSE_M,
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
from sim_bridge.scenes.heldout_surfaces import bands, flecked, grid_ceiling, two_tone
from sim_bridge.scenes.plan import Opening, wall_frame, window

LENGTH_M, WIDTH_M, HEIGHT_M = 13.0, 10.0, 2.7
HALL_X, ROOM_X, ROOM_Y = 8.8, 8.8 / 3, 4.1
_SOUTH = ((0.0, 0.0), (LENGTH_M, 0.0))
_EAST = ((LENGTH_M, 0.0), (LENGTH_M, WIDTH_M))
_NORTH = ((LENGTH_M, WIDTH_M), (0.0, WIDTH_M))
_WEST = ((0.0, WIDTH_M), (0.0, 0.0))
_CORRIDOR_SOUTH = ((0.0, ROOM_Y), (HALL_X, ROOM_Y))
_CORRIDOR_NORTH = ((HALL_X, WIDTH_M - ROOM_Y), (0.0, WIDTH_M - ROOM_Y))
_HALL_WALL = ((HALL_X, 0.0), (HALL_X, WIDTH_M))
_DOOR_AT, _DOOR_M = 0.97, 1.2
_GREEN: Tone = (196, 214, 206)
_PALE: Tone = (224, 226, 222)
_LEAF: Tone = (188, 160, 122)
_LAMP_POWER = 3.8


def clinic(seed: int) -> Blueprint:
    """Make the clinic, 13 m x 10 m."""
    build, rng = Builder(), np.random.default_rng([seed, 4102])
    _building(build, rng)
    sorts = ["treatment"] * 4 + ["office", "supplies"]
    order = rng.permutation(6)
    for k in range(6):
        _room(build, rng, _room_frame(k), number=k, sort=sorts[int(order[k])])
    _corridor(build, rng)
    _waiting(build, rng)
    _reception(build, rng)
    _lamps(build)
    return build.blueprint(floor_bounds=(0.0, 0.0, LENGTH_M, WIDTH_M))


def _room_frame(number: int) -> Pose:
    """Return the frame of a room: its far left corner seen from the door; the door is at y = ROOM_Y."""
    if number < 3:
        return spot(number * ROOM_X, 0.0)
    return spot((number - 2) * ROOM_X, WIDTH_M, 180.0)


def _building(build: Builder, rng: np.random.Generator) -> None:
    paint = WallPaint(HEIGHT_M, 120.0, left=_PALE, right=_PALE, trim=(96, 110, 112))
    floor = flecked(rng, (1300, 1690), base=(150, 160, 158), tile_px=130)
    ceiling = grid_ceiling((500, 650), base=(232, 234, 232), cell_px=30)
    shell(build, (0.0, 0.0, LENGTH_M, WIDTH_M), height_m=HEIGHT_M, floor=floor, ceiling=ceiling, cell_m=0.12)
    at_south = [Opening(k * ROOM_X + 0.75, 0.8, 2.25, 1.35) for k in range(3)]
    at_north = [Opening(LENGTH_M - (k + 1) * ROOM_X + 0.75, 0.8, 2.25, 1.35) for k in range(3)]
    at_east = [Opening(y, 1.3, 2.3, 1.0) for y in (1.6, 4.3, 7.0)]
    doors = [Opening(k * ROOM_X + _DOOR_AT, _DOOR_M) for k in range(3)]
    lower: Tone = (120, 158, 152)

    def half(line: tuple[tuple[float, float], tuple[float, float]]) -> Rgb:
        return two_tone(rng, paint.pixels(line), upper=_GREEN, lower=lower, share=0.37)

    lined = bands(rng, paint.pixels(_EAST), base=_GREEN, period_px=30.0, depth=4.0, upright=False)
    paint.stand(build, rng, _SOUTH, at_south)
    paint.stand(build, rng, _EAST, at_east, left=lined)
    paint.stand(build, rng, _NORTH, at_north)
    paint.stand(build, rng, _WEST)
    paint.stand(build, rng, _CORRIDOR_SOUTH, doors, left=half(_CORRIDOR_SOUTH))
    paint.stand(build, rng, _CORRIDOR_NORTH, doors, left=half(_CORRIDOR_NORTH))
    passage = Opening(WIDTH_M / 2, WIDTH_M - 2 * ROOM_Y - 0.14, 2.3)
    paint.stand(build, rng, _HALL_WALL, (passage,), right=half(_HALL_WALL))
    for k in (1, 2):
        paint.stand(build, rng, ((k * ROOM_X, 0.0), (k * ROOM_X, ROOM_Y)))
        paint.stand(build, rng, ((k * ROOM_X, WIDTH_M - ROOM_Y), (k * ROOM_X, WIDTH_M)))
    frame = tone(build, (240, 240, 238))
    for line, openings, power in ((_SOUTH, at_south, 1.6), (_NORTH, at_north, 1.6), (_EAST, at_east, 3.0)):
        for opening in openings:
            window(build, *line, opening, power=power, frame=frame, bars=1, samples=(1, 1))


def _room(build: Builder, rng: np.random.Generator, room: Pose, *, number: int, sort: str) -> None:
    """Furnish a room of one plan: behind a curtain on the left, at work on the right, cupboards across."""
    right = ROOM_X - 0.06
    far = room * spot(right - 0.68, 0.06)
    hinge = room * spot(0.2, ROOM_Y - 0.07, -90.0)
    open_leaf(build, hinge, _door(build), rim=_LEAF, size_m=(1.04, 2.06))
    if sort == "supplies":
        furniture.cupboards(build, room * spot(0.06, 1.35, -90.0), units=4, tall=True)
        furniture.cupboards(build, far * spot(-0.2, 0.0), units=2, tall=True)
        for x, y in ((2.4, 2.6), (2.4, 3.4)):
            furniture.trolley(build, rng, room * spot(x, y, 90.0 + float(rng.normal(0, 6))))
        hang(build, room * spot(right, 3.2, 90.0), (0.0, 1.6), (0.7, 0.5), _sheet(build, rng, timetable, (0.7, 0.5)))
        return
    furniture.cupboards(build, far, units=2, tall=False)
    furniture.worktop_clutter(build, rng, far, width_m=1.1)
    desk = room * spot(right, 3.12, 90.0)
    furniture.doctors_desk(build, rng, desk)
    furniture.stool(build, desk * spot(float(rng.uniform(-0.2, 0.2)), 0.78, float(rng.uniform(0, 90))))
    furniture.pedal_bin(build, room * spot(right - 0.25, 0.95))
    if sort == "office":
        furniture.cupboards(build, room * spot(0.06, 1.3, -90.0), units=3, tall=True)
    else:
        furniture.couch(build, room * spot(0.45, 1.1, 90.0))
        furniture.curtain(build, room * spot(1.0, 1.1, 90.0), length_m=1.6, rgb=(170, 196, 206))
        furniture.vital_signs(build, rng, room * spot(0.06, 1.0, -90.0))
    basin = room * spot(2.1, ROOM_Y - 0.06, 180.0)
    furniture.dispensers(build, basin * spot(0.35, 0.0))
    makers = (anatomy, eye_chart, notice, anatomy)
    for along, up, width, height in ((3.2, 1.62, 0.6, 0.82), (1.75, 1.55, 0.5, 0.7)):
        make = makers[int(rng.integers(4))]
        picture = _sheet(build, rng, make, (width, height))
        hang(
            build, room * spot(right, along + float(rng.uniform(-0.2, 0.2)), 90.0), (0.0, up), (width, height), picture
        )
    if number % 2:
        picture = _sheet(build, rng, notice, (0.42, 0.6))
        hang(build, room * spot(0.06, 2.75, -90.0), (0.0, 1.6), (0.42, 0.6), picture)


def _sheet(build: Builder, rng: np.random.Generator, make: Picture, size_m: tuple[float, float]) -> int:
    return build.texture(make(rng, (round(size_m[1] * 350), round(size_m[0] * 350))))


def _door(build: Builder) -> int:
    return build.shared("clinic door", lambda: door_face(_LEAF, window=False))


def _corridor(build: Builder, rng: np.random.Generator) -> None:
    rail = tone(build, (150, 118, 84))
    for k, line in enumerate((_CORRIDOR_SOUTH, _CORRIDOR_NORTH)):
        for room in range(3):
            start = room * ROOM_X
            shut = wall_frame(*line, start + 2.36)
            closed_door(build, shut, _door(build), rim=(206, 206, 200))
            by_door = wall_frame(*line, start + _DOOR_AT + _DOOR_M / 2 + 0.12)
            label = f"{3 * k + room + 1:02d}"
            sign = build.texture(number_sign(rng, (70, 70), text=label, base=(34, 92, 110)))
            hang(build, by_door, (0.0, 1.6), (0.17, 0.17), sign, name="door sign")
            edge = wall_frame(*line, start + 0.2)
            build.box(edge, [0, 0.05, 0.92], [0.26, 0.03, 0.12], rail, cell_m=COARSE_M, solid=False)
    end = wall_frame(*_WEST, WIDTH_M / 2)
    board = build.texture(pinboard(rng, (300, 400), base=(78, 100, 130), sheets=11))
    hang(build, end, (0.0, 1.5), (1.2, 0.9), board, name="board", depth_m=0.03, rim=(150, 152, 156))


def _waiting(build: Builder, rng: np.random.Generator) -> None:
    for x, y, yaw, seats in (
        (HALL_X + 0.4, 2.1, -90.0, 4),
        (10.88, 2.2, 90.0, 4),
        (11.46, 2.2, -90.0, 4),
        (12.62, 6.1, 90.0, 3),
        (HALL_X + 0.4, 6.75, -90.0, 2),
    ):
        furniture.seat_row(build, spot(x, y + float(rng.normal(0, 0.03)), yaw), seats=seats)
    furniture.low_table(build, rng, spot(11.15, 3.95, float(rng.normal(0, 4))))
    furniture.drip_stand(build, spot(0.35, 5.0))
    plant(build, rng, spot(12.4, 0.6), height_m=1.5, pot=(204, 204, 200))
    west = wall_frame(*_HALL_WALL, 2.2, side="right")
    board = build.texture(pinboard(rng, (290, 450), base=(92, 122, 96), sheets=12))
    hang(build, west, (float(rng.uniform(-0.4, 0.4)), 1.55), (1.4, 0.9), board, name="board", depth_m=0.03)
    for at in (3.65, 6.35):
        furniture.dispensers(build, wall_frame(*_HALL_WALL, at, side="right"))
    furniture.leaflet_rack(build, rng, wall_frame(*_HALL_WALL, 9.2, side="right"))
    east = wall_frame(*_EAST, 5.65)
    hang(build, east, (0.0, 1.65), (0.7, 1.0), _sheet(build, rng, notice, (0.7, 1.0)))
    south = wall_frame(*_SOUTH, 10.2 + float(rng.uniform(-0.5, 0.8)))
    make = anatomy if rng.random() < 0.5 else notice
    hang(build, south, (0.0, 1.6), (0.6, 0.85), _sheet(build, rng, make, (0.6, 0.85)))


def _reception(build: Builder, rng: np.random.Generator) -> None:
    furniture.counter(build, rng, spot(11.7, 8.35, 180.0), length_m=2.3)
    back = wall_frame(*_NORTH, LENGTH_M - 11.6)
    furniture.cupboards(build, back, units=4, tall=True)
    hang(build, back, (0.0, 2.35), (0.32, 0.32), build.texture(clock(rng, (100, 100))), name="clock", depth_m=0.05)
    hang(build, back, (1.75, 1.6), (0.6, 0.84), _sheet(build, rng, notice, (0.6, 0.84)))


def _lamps(build: Builder) -> None:
    for k in range(6):
        x, y = _room_frame(k).apply([ROOM_X / 2 + 0.1, 2.2, 0.0])[:2]
        ceiling_lamp(build, (float(x), float(y)), z_m=HEIGHT_M - 0.02, size_m=(1.18, 0.58), power=_LAMP_POWER)
    for x in (1.2, 3.4, 5.6, 7.8):
        ceiling_lamp(build, (x, 5.0), z_m=HEIGHT_M - 0.02, size_m=(0.58, 0.58), power=0.7 * _LAMP_POWER)
    for x in (9.9, 12.0):
        for y in (1.5, 3.9, 6.3, 8.7):
            ceiling_lamp(build, (x, y), z_m=HEIGHT_M - 0.02, size_m=(0.58, 0.58), power=0.8 * _LAMP_POWER)
