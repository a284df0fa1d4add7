"""A museum, a test scene: a hall of paintings, a hall of showcases, a striped hall of pots, a foyer."""

from __future__ import annotations

import numpy as np

from fieldkit.frames import Pose
from sim_bridge.scenes import museum_furniture as furniture
from sim_bridge.scenes.blueprint import Blueprint, Builder
from sim_bridge.scenes.heldout_art import banner
from sim_bridge.scenes.heldout_charts import land_map
from sim_bridge.scenes.heldout_parts import XY, Tone, WallPaint, ceiling_lamp, hang, shell, spot, spotlight, tone
from sim_bridge.scenes.heldout_surfaces import Rgb, bands, coat, flecked, slabs, veneer
from sim_bridge.scenes.plan import Opening, Rect, wall_frame

LENGTH_M, WIDTH_M, HEIGHT_M = 16.0, 10.0, 4.0
WEST_X, CROSS_Y, FOYER_X = 6.0, 4.6, 11.5
_SOUTH = ((0.0, 0.0), (LENGTH_M, 0.0))
_EAST = ((LENGTH_M, 0.0), (LENGTH_M, WIDTH_M))
_NORTH = ((LENGTH_M, WIDTH_M), (0.0, WIDTH_M))
_WEST = ((0.0, WIDTH_M), (0.0, 0.0))
_LONG = ((WEST_X, 0.0), (WEST_X, WIDTH_M))
_CROSS = ((WEST_X, CROSS_Y), (LENGTH_M, CROSS_Y))
_SHORT = ((FOYER_X, 0.0), (FOYER_X, CROSS_Y))
_PAINTINGS: Rect = (0.0, 0.0, WEST_X, WIDTH_M)
_CASES: Rect = (WEST_X, CROSS_Y, LENGTH_M, WIDTH_M)
_STRIPES: Rect = (WEST_X, 0.0, FOYER_X, CROSS_Y)
_FOYER: Rect = (FOYER_X, 0.0, LENGTH_M, CROSS_Y)
_WHITE: Tone = (218, 216, 210)
_ROSE: Tone = (190, 172, 164)
_LAMP_POWER = 8.0
_SPOT_POWER = 3.4


def museum(seed: int) -> Blueprint:
    """Make the museum, 16 m x 10 m."""
    build, rng = Builder(), np.random.default_rng([seed, 4104])
    _floors(build, rng)
    _walls(build, rng)
    _hall_of_paintings(build, rng)
    _hall_of_cases(build, rng)
    _striped_hall(build, rng)
    _foyer(build, rng)
    _lamps(build)
    return build.blueprint(floor_bounds=(0.0, 0.0, LENGTH_M, WIDTH_M))


def _floors(build: Builder, rng: np.random.Generator) -> None:
    def size(rect: Rect) -> tuple[int, int]:
        return round((rect[3] - rect[1]) * 130), round((rect[2] - rect[0]) * 130)

    boards = veneer(rng, (520, 520), base=(150, 118, 84), upright=True)
    boards[:, ::65] = (96, 72, 50)
    stone = flecked(rng, size(_CASES), base=(168, 164, 156), tile_px=156)
    chess = slabs(rng, size(_FOYER), base=(196, 190, 178), other=(84, 80, 78), cell_px=52)
    carpet = coat(rng, size(_STRIPES), base=(92, 52, 56))
    repeated = np.tile(boards, (3, 2, 1))[: size(_PAINTINGS)[0], : size(_PAINTINGS)[1]]
    for rect, floor in ((_PAINTINGS, repeated), (_CASES, stone), (_STRIPES, carpet), (_FOYER, chess)):
        plain = coat(rng, (60, 90), base=(214, 212, 206))
        shell(build, rect, height_m=HEIGHT_M, floor=floor, ceiling=plain, cell_m=0.12)


def _walls(build: Builder, rng: np.random.Generator) -> None:
    paint = WallPaint(HEIGHT_M, 100.0, left=_WHITE, right=_WHITE, trim=(70, 66, 62))

    def striped(line: tuple[XY, XY]) -> Rgb:
        return bands(rng, paint.pixels(line), base=_ROSE, period_px=40.0, depth=6.0, upright=True)

    def split(line: tuple[XY, XY], at_m: float, *, first: Rgb, second: Rgb) -> Rgb:
        edge = round(at_m * paint.density)
        return np.ascontiguousarray(np.concatenate([first[:, :edge], second[:, edge:]], axis=1))

    plain = coat(rng, paint.pixels(_SOUTH), base=_WHITE)
    # Walls are seen from inside with their start on the right: images run from the end to the start.
    south = split(_SOUTH, LENGTH_M - FOYER_X, first=plain, second=striped(_SOUTH))
    south = split(_SOUTH, LENGTH_M - WEST_X, first=south, second=plain)
    paint.stand(build, rng, _SOUTH, left=south)
    paint.stand(build, rng, _EAST)
    paint.stand(build, rng, _NORTH)
    paint.stand(build, rng, _WEST)
    side = split(_LONG, CROSS_Y, first=striped(_LONG), second=coat(rng, paint.pixels(_LONG), base=_WHITE))
    paint.stand(build, rng, _LONG, (Opening(2.3, 1.6, 2.6), Opening(7.4, 1.8, 2.8)), right=side)
    under = coat(rng, paint.pixels(_CROSS), base=_WHITE)
    below = split(_CROSS, FOYER_X - WEST_X, first=striped(_CROSS), second=under)
    paint.stand(build, rng, _CROSS, (Opening(2.75, 1.6, 2.6), Opening(7.6, 1.6, 2.6)), right=below)
    paint.stand(build, rng, _SHORT, (Opening(2.3, 1.6, 2.6),), left=striped(_SHORT))


def _some_painting(build: Builder, rng: np.random.Generator, place: Pose, *, widest_m: float) -> None:
    width = float(rng.uniform(0.5, widest_m))
    height = float(np.clip(width * rng.uniform(0.65, 1.4), 0.5, 1.5))
    furniture.hang_painting(build, rng, place, width_m=width, height_m=height, up_m=float(rng.uniform(1.55, 1.75)))


def _hall_of_paintings(build: Builder, rng: np.random.Generator) -> None:
    for line, places, widest in (
        (_WEST, (1.3, 3.6, 6.2, 8.6), 1.5),
        (_LONG, (4.6, 9.2), 1.0),
        (_SOUTH, (3.0,), 1.4),
        (_NORTH, (LENGTH_M - 3.0,), 1.5),
    ):
        for at in places:
            place = wall_frame(*line, at + float(rng.uniform(-0.25, 0.25)))
            _some_painting(build, rng, place, widest_m=widest)
    middle = spot(3.0, 5.0, float(rng.normal(0, 2)))
    furniture.partition(build, rng, middle, width_m=2.4, height_m=2.5)
    for turn in (0.0, 180.0):
        _some_painting(build, rng, middle * spot(0.0, 0.0, turn) * spot(0.0, 0.1), widest_m=1.1)
    for y in (2.7, 7.4):
        furniture.bench(build, spot(3.0, y, 90.0 + float(rng.normal(0, 3))))
    furniture.barrier(build, spot(0.75, 5.0, -90.0), length_m=1.5)
    furniture.text_panel(build, rng, wall_frame(*_LONG, 6.0), base=(92, 40, 44))


def _hall_of_cases(build: Builder, rng: np.random.Generator) -> None:
    for x in (8.1, 10.5, 12.9):
        for y in (6.5, 8.3):
            furniture.showcase(build, rng, spot(x, y), items=int(rng.integers(2, 5)))
    furniture.statue(build, rng, spot(15.0, 7.5, 90.0))
    for x in (6.6, 15.4):
        furniture.exhibit(build, rng, spot(x, 9.4, float(rng.uniform(-4, 4))), height_m=1.1)
    for at in (3.4, 7.2):
        place = wall_frame(*_NORTH, at + float(rng.uniform(-0.4, 0.4)))
        _some_painting(build, rng, place, widest_m=1.5)
    chart = build.texture(land_map(rng, (360, 480)))
    hang(build, wall_frame(*_CROSS, 5.2), (0.0, 1.6), (1.5, 1.1), chart, name="map", depth_m=0.03)
    furniture.text_panel(build, rng, wall_frame(*_EAST, 5.6), base=(44, 62, 84))


def _striped_hall(build: Builder, rng: np.random.Generator) -> None:
    for x in (7.3, 10.2):
        for y in (0.8, 3.8):
            furniture.exhibit(build, rng, spot(x, y, float(rng.uniform(-3, 3))))
    place = wall_frame(*_SOUTH, 8.75 + float(rng.uniform(-0.3, 0.3)))
    _some_painting(build, rng, place, widest_m=1.2)
    furniture.bench(build, spot(8.75, 0.62))


def _foyer(build: Builder, rng: np.random.Generator) -> None:
    furniture.ticket_desk(build, rng, spot(14.85, 1.7, 90.0))
    furniture.bag_lockers(build, wall_frame(*_EAST, 1.7), columns=7)
    furniture.bag_lockers(build, wall_frame(*_SHORT, 0.75, side="right"), columns=3)
    for x, width in ((12.9, 0.9),):
        picture = banner(rng, (round(1.9 * 260), round(width * 260)))
        place = wall_frame(*_SOUTH, x + float(rng.uniform(-0.2, 0.2)))
        hang(build, place, (0.0, 1.75), (width, 1.9), build.texture(picture), name="banner", depth_m=0.01)
    picture = banner(rng, (round(1.6 * 260), round(0.8 * 260)))
    hang(build, wall_frame(*_EAST, 3.75), (0.0, 1.7), (0.8, 1.6), build.texture(picture), name="banner", depth_m=0.01)
    furniture.bench(build, spot(12.4, 4.2))


def _lamps(build: Builder) -> None:
    rim = tone(build, (236, 236, 232))
    for x, y, size in ((3.0, 2.6, (3.0, 1.6)), (3.0, 7.4, (3.0, 1.6)), (8.9, 7.3, (2.6, 1.4)), (13.1, 7.3, (2.6, 1.4))):
        ceiling_lamp(build, (x, y), z_m=HEIGHT_M - 0.1, size_m=size, power=_LAMP_POWER, group="window", samples=(2, 1))
        for side in (-1, 1):
            at = spot(x, y)
            edge = [0.0, side * (size[1] / 2 + 0.04), HEIGHT_M - 0.06]
            build.box(at, edge, [size[0] + 0.16, 0.08, 0.12], rim, cell_m=0.5, solid=False)
            edge = [side * (size[0] / 2 + 0.04), 0.0, HEIGHT_M - 0.06]
            build.box(at, edge, [0.08, size[1], 0.12], rim, cell_m=0.5, solid=False)
    for x in (12.6, 14.6):
        for y in (1.3, 3.3):
            ceiling_lamp(build, (x, y), z_m=HEIGHT_M - 0.03, size_m=(0.5, 0.5), power=0.6 * _LAMP_POWER)
    for x, y in ((7.3, 0.8), (10.2, 0.8), (7.3, 3.8), (10.2, 3.8)):
        spotlight(build, (8.75 + 0.35 * (x - 8.75), y, HEIGHT_M - 0.35), (x, y, 1.0), power=_SPOT_POWER)
    for y in (1.8, 5.0, 8.3):
        spotlight(build, (1.9, y, HEIGHT_M - 0.35), (0.0, y, 1.6), power=_SPOT_POWER)
    ceiling_lamp(build, (8.75, 2.3), z_m=HEIGHT_M - 0.03, size_m=(0.6, 0.6), power=0.8 * _LAMP_POWER)
