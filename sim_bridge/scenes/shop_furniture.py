"""Furniture of the shop. Against a wall, the wall is y = 0 and +y the room; free pieces stand in their middle."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator

import numpy as np

from fieldkit.frames import Pose, yaw_pose
from sim_bridge.scenes import forms, prints
from sim_bridge.scenes import shop_pictures as pictures
from sim_bridge.scenes.blueprint import Builder
from sim_bridge.scenes.forms import moved, paint, shell
from sim_bridge.scenes.shop_pictures import Product
from sim_bridge.scenes.textures import Rgb

UNIT_M = 1.0
DEPTH_M = 0.44
_STEEL = (186, 188, 190)
_SIZES = ((0.09, 0.22), (0.12, 0.17), (0.16, 0.25), (0.2, 0.15), (0.08, 0.13), (0.24, 0.26), (0.14, 0.2))


@dataclasses.dataclass(frozen=True)
class Facing:
    """Some packages of one article beside each other: where they begin on a board and how many there are."""

    article: int
    start_m: float
    count: int


# What stands on each board of a shelf unit, lowest first.
Plan = tuple[tuple[Facing, ...], ...]


def catalogue(rng: np.random.Generator, count: int) -> list[Product]:
    """Draw the articles of a shop."""
    return [pictures.product(rng, _SIZES[int(rng.integers(len(_SIZES)))]) for _ in range(count)]


def deck(rng: np.random.Generator, count: int) -> Iterator[int]:
    """Deal articles by number without end: each once before any comes again, so that few stand in many places.

    Structure from motion would fold aisles together whose units are alike.
    """
    while True:
        yield from (int(i) for i in rng.permutation(count))


def plan(rng: np.random.Generator, articles: list[Product], dealt: Iterator[int], *, boards: int) -> Plan:
    """Draw what stands on the boards of a unit: a few articles on each, many packages of one side by side."""
    rows: list[tuple[Facing, ...]] = []
    for _ in range(boards):
        row: list[Facing] = []
        x, stop = 0.04, UNIT_M - 0.04
        while True:
            article = next(dealt)
            wide = articles[article].size_m[0]
            count = min(int(rng.integers(2, 6)), int((stop - x) / wide))
            if count < 1:
                break
            row.append(Facing(article, x, count))
            x += count * wide + 0.012
        rows.append(tuple(row))
    return tuple(rows)


def shelf_unit(
    build: Builder,
    rng: np.random.Generator,
    place: Pose,
    articles: list[Product],
    content: Plan,
    *,
    height_m: float,
    sold_out: float = 0.05,
) -> None:
    """Add one unit of shelves with its back on y = 0; ``sold_out`` is the share of facings that are missing."""
    steel, rail = paint(build, _STEEL), build.shared("rail", lambda: pictures.price_rail(UNIT_M))
    inner = UNIT_M - 0.01
    step = (height_m - 0.16) / len(content)
    with build.thing("shelf unit", place, kind="fixed"):
        shell(
            build,
            place,
            [0.0, 0.01, height_m / 2],
            [UNIT_M, 0.02, height_m],
            dict.fromkeys(("+y", "-y", "+x", "-x", "+z"), steel),
        )
        plinth = paint(build, (96, 98, 100))
        shell(
            build,
            place,
            [0.0, DEPTH_M / 2, 0.06],
            [inner, DEPTH_M - 0.03, 0.12],
            dict.fromkeys(("+y", "+x", "-x"), plinth),
        )
        for i, row in enumerate(content):
            z = 0.14 + i * step
            deep = DEPTH_M if i == 0 else DEPTH_M - 0.06
            faces = {"+z": steel, "+y": rail, "-z": steel, "+x": steel, "-x": steel}
            shell(build, place, [0.0, deep / 2, z - 0.018], [inner, deep, 0.036], faces)
            for stock in row:
                if rng.random() >= sold_out:
                    _goods(build, rng, moved(place, -inner / 2, deep, z), articles, stock)
        build.block(moved(place, y_m=DEPTH_M / 2), (UNIT_M, DEPTH_M))


def header(build: Builder, rng: np.random.Generator, place: Pose, *, up_m: float) -> None:
    """Put a sign on top of a unit that stands with its back on y = 0."""
    size = (float(rng.uniform(0.6, 0.95)), float(rng.uniform(0.22, 0.34)))
    board = paint(build, (150, 152, 154))
    image = pictures.promotion(rng, size)
    at = moved(place, float(rng.uniform(-0.02, 0.02)), 0.03)
    forms.hang(build, at, size, image, up_m=up_m + size[1] / 2 + 0.016, frame=board, name="promotion", off_m=0.02)


def _goods(build: Builder, rng: np.random.Generator, place: Pose, articles: list[Product], stock: Facing) -> None:
    """Add packages on a board whose front edge is y = 0; they stand a little back from it."""
    article = articles[stock.article]
    front = build.shared(("facing", article.name, stock.count), lambda: pictures.facing(article, stock.count))
    side = paint(build, article.side)
    wide, tall = stock.count * article.size_m[0], article.size_m[1]
    deep = 0.28
    back = 0.02 + float(rng.choice([0.0, 0.0, 0.0, 0.05, 0.1]))
    centre = [stock.start_m + wide / 2, -back - deep / 2, tall / 2]
    faces = {"+y": front, "+z": side, "+x": side, "-x": side}
    shell(build, place, centre, [wide, deep, tall], faces, cell_m=0.35)


def gondola(
    build: Builder,
    rng: np.random.Generator,
    place: Pose,
    articles: list[Product],
    sides: tuple[list[Plan], list[Plan]],
    *,
    height_m: float,
) -> None:
    """Add two rows of units back to back along x of a place, with plain ends; +y shows the first row."""
    count = len(sides[0])
    for row, yaw in zip(sides, (0.0, np.pi), strict=True):
        for i, content in enumerate(row):
            at = moved(place, yaw_rad=yaw) * moved(_origin(), (i - (count - 1) / 2) * UNIT_M)
            shelf_unit(build, rng, at, articles, content, height_m=height_m)
    end = build.shared(("end", height_m), lambda: prints.sheet((8, 8), (205, 205, 200)))
    with build.thing("gondola ends", place, kind="fixed"):
        for sign, side in ((1, "+x"), (-1, "-x")):
            inside = "-x" if side == "+x" else "+x"
            centre = [sign * (count * UNIT_M / 2 + 0.015), 0.0, height_m / 2]
            size = [0.03, 2 * DEPTH_M, height_m]
            faces = {side: end, inside: end, "+y": end, "-y": end, "+z": end}
            shell(build, place, centre, size, faces, cell_m=0.2)


def _origin() -> Pose:
    return yaw_pose([0.0, 0.0, 0.0], 0.0)


def endcap(
    build: Builder, rng: np.random.Generator, place: Pose, articles: list[Product], content: Plan, *, height_m: float
) -> None:
    """Add a unit across the end of a gondola, under a promotional sign of its own."""
    shelf_unit(build, rng, place, articles, content, height_m=height_m, sold_out=0.0)
    size = (0.9, float(rng.uniform(0.32, 0.5)))
    board = paint(build, (150, 152, 154))
    forms.hang(
        build, moved(place, y_m=0.03), size, pictures.promotion(rng, size), up_m=height_m + size[1] / 2, frame=board,
        name="promotion", off_m=0.02,
    )  # fmt: skip


def fridge(build: Builder, place: Pose, doors: list[int]) -> None:
    """Add a tall fridge with glass doors of 0.75 m, of textures by number, and a plain fascia above them."""
    wide, deep, high = 0.75 * len(doors), 0.72, 2.1
    white, dark = paint(build, (206, 210, 212)), paint(build, (66, 70, 74))
    with build.thing("fridge", place, kind="fixed"):
        faces = {"+x": white, "-x": white, "+z": white}
        shell(build, place, [0.0, deep / 2, high / 2], [wide, deep, high], faces, cell_m=0.2)
        shell(build, place, [0.0, deep / 2, 0.09], [wide, deep, 0.18], {"+y": dark})
        shell(build, place, [0.0, deep / 2, high - 0.14], [wide, deep, 0.28], {"+y": white})
        for i, texture in enumerate(doors):
            x = (i - (len(doors) - 1) / 2) * 0.75
            shell(build, place, [x, deep / 2, 1.0], [0.75, deep, 1.64], {"+y": texture}, cell_m=0.4)
        build.block(moved(place, y_m=deep / 2), (wide, deep))


def checkout(build: Builder, rng: np.random.Generator, place: Pose) -> None:
    """Add a checkout of 2.0 x 0.7 m along x: belt, till with its screen, a plain front of grey boards."""
    front = build.shared("checkout", lambda: prints.sheet((8, 8), (170, 174, 180)))
    dark, steel = paint(build, (44, 46, 50)), paint(build, (160, 162, 166))
    with build.thing("checkout", place, kind="fixed"):
        build.box(place, [0.0, 0.0, 0.43], [2.0, 0.62, 0.86], front, cell_m=0.2)
        belt = build.shared("belt", lambda: pictures.belt(1.2))
        shell(build, place, [-0.3, 0.0, 0.87], [1.3, 0.5, 0.02], {"+z": belt, "+y": steel, "-y": steel})
        build.box(place, [0.62, 0.0, 0.91], [0.4, 0.4, 0.1], steel)
        build.box(place, [0.62, 0.0, 1.06], [0.05, 0.05, 0.22], dark)
        show = build.texture(pictures.screen(rng, (0.34, 0.26)))
        build.box(place, [0.62, 0.0, 1.28], [0.36, 0.04, 0.28], dark, sides={2: show, 3: show})
        forms.bar(build, place, [0.93, 0.24, 0.86], [0.93, 0.24, 1.95], 0.05, dark)
        build.box(place, [0.93, 0.24, 2.05], [0.3, 0.08, 0.24], paint(build, (238, 240, 232)))
        build.block(place, (2.0, 0.66))


def bin_of_goods(build: Builder, rng: np.random.Generator, place: Pose, articles: list[Product]) -> None:
    """Add a wire bin full of packages that lie as they fell."""
    mesh = build.shared("mesh", _mesh)
    with build.thing("bin", place):
        for yaw in np.arange(4) * np.pi / 2:
            build.panel(forms.upright(moved(place, yaw_rad=yaw), 0.0, 0.31, 0.4), (0.62, 0.8), mesh, solid=False)
        build.box(place, [0.0, 0.0, 0.36], [0.6, 0.6, 0.7], paint(build, (90, 92, 96)))
        for i in range(9):
            article = articles[int(rng.integers(len(articles)))]
            x, y = float(i % 3 - 1) * 0.19, float(i // 3 - 1) * 0.19
            at = moved(place, x, y, 0.68 + float(rng.uniform(0, 0.06)), yaw_rad=float(rng.uniform(-3, 3)))
            front = build.shared(("facing", article.name, 1), functools.partial(pictures.facing, article, 1))
            deep = min(article.size_m[1], 0.2)
            faces = {"+z": front, "+x": front, "-x": front, "+y": front, "-y": front}
            shell(build, at, [0.0, 0.0, 0.06], [article.size_m[0], deep, 0.12], faces)
        build.block(place, (0.64, 0.64))


def _mesh() -> Rgb:
    image = prints.sheet((96, 96), (120, 124, 128))
    for k in range(0, 96, 12):
        image[k : k + 3] = (196, 198, 200)
        image[:, k : k + 3] = (196, 198, 200)
    return image


def fruit_stand(build: Builder, rng: np.random.Generator, place: Pose, *, columns: int) -> None:
    """Add a sloping stand of crates of fruit, its back on y = 0, and a plain front."""
    wood = paint(build, (118, 88, 58))
    wide = 0.62 * columns
    with build.thing("fruit stand", place, kind="fixed"):
        for row in range(2):
            y, z = 0.25 + 0.42 * row, 0.92 - 0.22 * row
            faces = {"+y": wood, "+x": wood, "-x": wood}
            shell(build, place, [0.0, y, z / 2], [wide, 0.44, z], faces, cell_m=0.2)
            for i in range(columns):
                at = moved(place, (i - (columns - 1) / 2) * 0.62, y, z)
                top = build.texture(pictures.crate_of_fruit(rng, (0.58, 0.4)))
                faces = {"+z": top, "+y": wood, "+x": wood, "-x": wood, "-y": wood}
                shell(build, at, [0.0, 0.0, 0.06], [0.58, 0.4, 0.12], faces)
        build.block(moved(place, y_m=0.44), (wide, 0.88))


def pallet_of_goods(build: Builder, place: Pose, article: Product, *, layers: int) -> None:
    """Add a pallet with layers of one article in trays."""
    wood, tray = paint(build, (168, 136, 94)), paint(build, article.side)
    across = max(int(0.8 / article.size_m[0]), 1)
    wide, tall = across * article.size_m[0], article.size_m[1] + 0.02
    front = build.shared(("facing", article.name, across), lambda: pictures.facing(article, across))
    with build.thing("pallet of goods", place):
        build.box(place, [0.0, 0.0, 0.07], [0.84, 0.64, 0.14], wood)
        for i in range(layers):
            z = 0.14 + i * tall + tall / 2
            faces = {"+y": front, "-y": front, "+x": tray, "-x": tray, "+z": tray}
            shell(build, place, [0.0, 0.0, z], [wide, 0.6, tall], faces)
        build.block(place, (0.86, 0.66))


def stand(build: Builder, rng: np.random.Generator, place: Pose) -> None:
    """Add an A-shaped sign that stands on the floor and shows a promotion to both sides."""
    size = (0.55, 0.85)
    rim = paint(build, (50, 50, 54))
    with build.thing("sign", place):
        for yaw in (0.0, np.pi):
            side = moved(place, yaw_rad=yaw)
            build.panel(forms.leaning(side, 0.0, 0.15, 0.46, back_rad=0.22), (0.61, 0.93), rim, solid=False)
            image = build.texture(pictures.promotion(rng, size))
            build.panel(forms.leaning(side, 0.0, 0.157, 0.462, back_rad=0.22), size, image, solid=False)
        build.block(place, (0.62, 0.52))


def baskets(build: Builder, place: Pose, *, count: int) -> None:
    """Add a stack of shopping baskets."""
    red = paint(build, (166, 34, 40))
    with build.thing("baskets", place):
        for i in range(count):
            size = [0.44 - 0.004 * (i % 2), 0.3 - 0.004 * (i % 2), 0.075]
            build.box(place, [0.0, 0.0, 0.04 + 0.08 * i], size, red)
        build.block(place, (0.46, 0.32))


def trolley(build: Builder, place: Pose) -> None:
    """Add a shopping trolley."""
    mesh, dark = build.shared("mesh", _mesh), paint(build, (60, 62, 66))
    with build.thing("trolley", place):
        faces = dict.fromkeys(("+x", "-x", "+y", "-y", "+z"), mesh)
        shell(build, place, [0.0, 0.0, 0.72], [0.5, 0.78, 0.44], faces)
        shell(build, place, [0.0, 0.0, 0.52], [0.5, 0.78, 0.02], {"+z": mesh, "-z": mesh})
        forms.legs(build, place, (0.44, 0.7), 0.5, 0.04, dark)
        forms.bar(build, place, [-0.26, -0.42, 1.0], [0.26, -0.42, 1.0], 0.04, paint(build, (166, 34, 40)))
        build.block(place, (0.54, 0.86))
