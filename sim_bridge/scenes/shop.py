"""The shop: aisles between rows of equal shelf units, fridges, checkouts, fruit, promotional signs, a stock room.

The plan, in metres, with x to the east (0..12) and y to the north (0..10):

    +--f--f--f--f--f--f--f--f--f--f--+------+   f fridges along the north wall
    |w                               | cold |   w wall shelves, identical along the west wall
    |w   ||    ||    ||    |         |store |   || rows of shelf units, 0.9 wide; aisles of 1.3
    |w   ||    ||    ||    ||        +------+   o  checkouts
    |w   ||    ||    ||    ||              e|   e  shelves along the east wall
    |w   ==    ==    ==    ==              e|   =  a unit across the end, under a sign of its own
    |    fruit  bins  pallets    o    o     +------+
    |                            o    o       stock|
    +-----window-----window--------door-----+------+
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fieldkit.frames import Pose, yaw_pose
from sim_bridge.scenes import forms, prints
from sim_bridge.scenes import shop_furniture as furniture
from sim_bridge.scenes import shop_pictures as pictures
from sim_bridge.scenes.blueprint import Blueprint, Builder
from sim_bridge.scenes.forms import moved, paint
from sim_bridge.scenes.halls import EAST, NORTH, SOUTH, WEST, Hall, lamps, outer_walls
from sim_bridge.scenes.plan import THICKNESS_M, Opening, outside, slab
from sim_bridge.scenes.shop_pictures import Product
from sim_bridge.scenes.side_rooms import Finish, SideRoom, side_room, union
from sim_bridge.scenes.textures import Rgb, to_bytes

_HALL = Hall(12.0, 10.0, 3.4)
_BANDS = [(0.0, 0.25, (120, 124, 120)), (2.35, 2.5, (76, 128, 96)), (2.56, 2.6, (76, 128, 96))]
_ROWS_X = (2.25, 4.55, 6.85, 9.15)
_ROW_START_M = 3.85
_STOCK = SideRoom((_HALL.length_m + THICKNESS_M, 0.6, 15.7, 3.5), WEST, ((13.46, 1.7), (13.46, 3.5)), 2.8)
_STOCK_DOOR = Opening(2.85, 1.1)
_WINDOWS = (Opening(1.6, 1.8, 2.5, 0.9), Opening(4.6, 1.8, 2.5, 0.9))


def shop(seed: int) -> Blueprint:
    """Make the shop of 12 x 10 m, 3.4 m high; the same seed gives the same shop."""
    rng = np.random.default_rng([seed, 41801])
    build = Builder()
    _shell(build, rng)
    articles = furniture.catalogue(rng, 150)
    dealt = furniture.deck(rng, len(articles))
    _aisles(build, rng, articles, dealt)
    _walls(build, rng, articles, dealt)
    _fridges(build, rng, articles)
    _front(build, rng, articles)
    _signs(build, rng)
    _stock_room(build, rng, articles)
    bounds = union(_HALL.bounds, _STOCK.floor)
    outside(build, bounds, [_HALL.bounds, _STOCK.floor])
    return build.blueprint(floor_bounds=bounds)


def _shell(build: Builder, rng: np.random.Generator) -> None:
    size = (_HALL.length_m, _HALL.width_m)
    floor = prints.tiled(rng, size, tile_m=0.4, base=(176, 172, 164), joint=(156, 152, 146))
    slab(build, _HALL.bounds, z_m=0.0, texture=build.texture(floor), up=True, cell_m=0.14)
    above = prints.ceiling_grid((0.6, 0.6), base=(214, 214, 212), step_m=0.6)
    slab(build, _HALL.bounds, z_m=_HALL.height_m, texture=build.texture(above), up=False, cell_m=0.6, tile_m=(0.6, 0.6))
    faces = []
    for side in range(4):
        face = (_HALL.side_m(side), _HALL.height_m)
        tone = np.array([206, 204, 196]) + rng.normal(0, 3, 3)
        faces.append(build.texture(prints.banded(prints.blank(rng, face, base=tone), face, _BANDS)))
    openings = {SOUTH: _WINDOWS, EAST: (_STOCK_DOOR,)}
    street = build.texture(_street(rng))
    outer_walls(build, _HALL, faces, openings=openings, trim=None, power=1.1, view=street, cell_m=0.2)
    spots = [(x, y) for x in (1.1, 3.4, 5.7, 8.0, 10.6) for y in (1.6, 5.0, 8.4)]
    lamps(build, spots, z_m=3.1, size_m=(0.16, 1.6), power=1.9, housing=paint(build, (150, 150, 152)))


def _street(rng: np.random.Generator) -> Rgb:
    """Draw the bright street that is seen through the windows: hardly anything."""
    fade = np.linspace(255, 226, 64)[:, None, None]
    return to_bytes(np.broadcast_to(fade, (64, 64, 3)) + rng.normal(0, 0.5, (64, 64, 1)))


def _aisles(build: Builder, rng: np.random.Generator, articles: list[Product], dealt: Iterator[int]) -> None:
    """Add the rows of units, all of one make; a sign stands on one or two units of each row."""
    for i, x in enumerate(_ROWS_X):
        count = 4 if i < 3 else 2
        first, second = ([furniture.plan(rng, articles, dealt, boards=4) for _ in range(count)] for _ in range(2))
        middle = _ROW_START_M + count / 2
        at = yaw_pose([x, middle, 0.0], np.pi / 2)
        furniture.gondola(build, rng, at, articles, (first, second), height_m=1.5)
        for unit, side in zip(rng.permutation(count)[: count // 2], (0.0, np.pi), strict=False):
            top = moved(moved(at, float(unit) - (count - 1) / 2), yaw_rad=side)
            furniture.header(build, rng, top, up_m=1.5)
        end = yaw_pose([x, _ROW_START_M - 0.035, 0.0], np.pi)
        content = furniture.plan(rng, articles, dealt, boards=4)
        furniture.endcap(build, rng, end, articles, content, height_m=1.4)


def _walls(build: Builder, rng: np.random.Generator, articles: list[Product], dealt: Iterator[int]) -> None:
    """Add the shelves along the west and the east wall; a neighbouring pair of units holds the same."""
    content = furniture.plan(rng, articles, dealt, boards=5)
    for i in range(6):
        if i != 3:
            content = furniture.plan(rng, articles, dealt, boards=5)
        furniture.shelf_unit(build, rng, _HALL.on(WEST, 1.6 + i), articles, content, height_m=2.0)
    for i in range(3):
        content = furniture.plan(rng, articles, dealt, boards=5)
        furniture.shelf_unit(build, rng, _HALL.on(EAST, 4.2 + i), articles, content, height_m=2.0)


def _fridges(build: Builder, rng: np.random.Generator, articles: list[Product]) -> None:
    cold = articles[::3]
    doors = [build.texture(pictures.fridge_door(rng, (0.75, 1.64), cold)) for _ in range(8)]
    for i in range(3):
        at = _HALL.on(NORTH, _HALL.length_m - 2.0 - 2.3 * i)
        furniture.fridge(build, at, doors[3 * i : 3 * i + 3] if i < 2 else [*doors[6:], doors[7]])
    white = build.texture(pictures.cold_panel((2.1, 2.6)))
    store = yaw_pose([_HALL.length_m - 1.06, _HALL.width_m - 1.21, 0.0], 0.0)
    with build.thing("cold store", store, kind="fixed"):
        forms.shell(build, store, [0.0, 0.0, 1.3], [2.1, 2.4, 2.6], {"-x": white, "-y": white, "+z": white}, cell_m=0.2)
        grey = paint(build, (176, 180, 182))
        build.box(store, [-0.2, -1.215, 1.0], [1.0, 0.03, 2.0], grey, cell_m=0.2)
        build.box(store, [0.2, -1.26, 1.05], [0.04, 0.06, 0.3], paint(build, (60, 62, 66)))
        build.block(store, (2.1, 2.44))
    sign = prints.sheet((120, 170), (40, 90, 160))
    prints.lettering(sign, prints.word(rng), (8, 8, 162, 60), ink=(240, 240, 240))
    prints.lines(rng, sign, (10, 62, 160, 116), line_px=12, ink=(240, 240, 240))
    forms.hang(build, moved(store, -1.05, -0.2, yaw_rad=np.pi / 2), (0.5, 0.35), sign, up_m=1.7, name="sign")


def _front(build: Builder, rng: np.random.Generator, articles: list[Product]) -> None:
    """Add checkouts, fruit, bins, pallets and signs in front of the aisles."""
    for x in (8.25, 9.95):
        furniture.checkout(build, rng, yaw_pose([x, 1.02, 0.0], np.pi / 2))
    furniture.fruit_stand(build, rng, _HALL.on(SOUTH, 3.1), columns=4)
    for x in _ROWS_X[:2]:
        furniture.bin_of_goods(build, rng, yaw_pose([x, 3.03, 0.0], rng.normal(0, 0.03)), articles)
    picked = [articles[int(i)] for i in rng.permutation(len(articles))[:3]]
    furniture.pallet_of_goods(build, yaw_pose([_ROWS_X[2], 3.02, 0.0], rng.normal(0, 0.03)), picked[0], layers=4)
    furniture.pallet_of_goods(build, yaw_pose([6.35, 0.38, 0.0], rng.normal(0, 0.03)), picked[2], layers=3)
    furniture.pallet_of_goods(build, yaw_pose([11.55, 7.15, 0.0], rng.normal(0, 0.03)), picked[1], layers=5)
    furniture.pallet_of_goods(build, yaw_pose([0.44, 9.62, 0.0], 0.0), picked[0], layers=6)
    furniture.baskets(build, yaw_pose([11.7, 1.35, 0.0], np.pi / 2), count=9)
    furniture.baskets(build, yaw_pose([11.7, 1.9, 0.0], np.pi / 2), count=6)
    furniture.stand(build, rng, yaw_pose([11.6, 0.4, 0.0], 0.9))
    for i in range(3):
        furniture.trolley(build, yaw_pose([0.52, 0.34 + 0.56 * i, 0.0], -np.pi / 2))
    furniture.stand(build, rng, yaw_pose([10.5, 7.22, 0.0], 0.05))


def _signs(build: Builder, rng: np.random.Generator) -> None:
    """Hang signs over the aisles, promotions in a few places, a notice board and posters."""
    for i, x in enumerate((1.15, 3.4, 5.7, 8.0, 10.4)):
        size = (1.0, 0.34)
        texture = build.texture(pictures.category(rng, size, i + 1))
        at = yaw_pose([x, 4.0, 0.0], np.pi)
        with build.thing("aisle sign", moved(at, z_m=2.45), kind="picture"):
            for yaw in (0.0, np.pi):
                build.panel(forms.upright(moved(at, yaw_rad=yaw), 0.0, 0.008, 2.45), size, texture, solid=False)
            build.box(at, [0.0, 0.0, 2.45], [1.02, 0.012, 0.36], paint(build, (40, 60, 50)), solid=False)
    dark = paint(build, (52, 52, 56))
    for place, size, up in _poster_places(rng):
        forms.hang(build, place, size, pictures.promotion(rng, size), up_m=up, frame=dark, name="promotion")
    board = (1.3, 0.9)
    forms.hang(build, _HALL.on(SOUTH, 6.55), board, pictures.notices(rng, board), up_m=1.5, name="notice board")


def _poster_places(rng: np.random.Generator) -> list[tuple[Pose, tuple[float, float], float]]:
    """Return wall frames, sizes and heights of the posters: in clusters, a good part of the walls stays blank."""
    places: list[tuple[Pose, tuple[float, float], float]] = []
    for side, at in ((WEST, 8.6), (SOUTH, 8.85), (SOUTH, 11.0), (EAST, 1.3), (NORTH, 2.6)):
        size = (float(rng.uniform(0.6, 0.9)), float(rng.uniform(0.7, 1.1)))
        places.append((_HALL.on(side, at), size, 1.55))
    # Banners above the shelves and fridges, for whoever looks up.
    for side, at in ((WEST, 2.6), (WEST, 5.6), (NORTH, 5.5), (NORTH, 9.6), (EAST, 5.2), (SOUTH, 9.9)):
        size = (float(rng.uniform(1.0, 1.5)), float(rng.uniform(0.4, 0.55)))
        places.append((_HALL.on(side, at), size, 2.5))
    # Two of the plain ends of rows.
    for x in (_ROWS_X[0], _ROWS_X[2]):
        end = yaw_pose([x, _ROW_START_M + 4.03, 0.0], 0.0)
        places.append((end, (float(rng.uniform(0.5, 0.7)), float(rng.uniform(0.7, 0.9))), 0.95))
    return places


def _stock_room(build: Builder, rng: np.random.Generator, articles: list[Product]) -> None:
    """Add the stock room: bare walls, pallets of one article."""
    white = build.texture(prints.blank(rng, (3.0, _STOCK.height_m), base=(200, 198, 192)))
    ground = build.texture(prints.tiled(rng, (2.4, 2.4), tile_m=0.4, base=(150, 148, 144), joint=(132, 130, 126)))
    above = build.texture(prints.ceiling_grid((2.4, 2.4), base=(214, 214, 212), step_m=0.6))
    side_room(build, _STOCK, Finish(white, ground, above, build.plain((110, 110, 108))), lamp_power=1.9)
    _, _, x1, y1 = _STOCK.rect
    article = articles[int(rng.integers(len(articles)))]
    for y in (y1 - 0.45, y1 - 1.15):
        furniture.pallet_of_goods(build, yaw_pose([x1 - 0.45, y, 0.0], rng.normal(0, 0.03)), article, layers=4)
