"""Pieces of furniture. Each stands in a frame with z up; against a wall, the wall is y = 0 and +y the room.

Each function adds its footprint and returns its height in m.
"""

from __future__ import annotations

import numpy as np

from fieldkit.frames import Pose, yaw_pose
from sim_bridge.scenes import textures
from sim_bridge.scenes.blueprint import Builder

_WOODS = ((178, 140, 98), (120, 84, 58), (205, 190, 165), (92, 70, 55), (150, 150, 150))


def _wood(build: Builder, rng: np.random.Generator) -> int:
    base = np.array(_WOODS[int(rng.integers(len(_WOODS)))]) + rng.normal(0, 8, 3)
    return build.texture(textures.wood(rng, (128, 384), base=base))


def door(build: Builder, rng: np.random.Generator, place: Pose) -> float:
    """Add a closed door of 0.9 x 2.05 m with its frame."""
    frame = build.plain((120, 110, 100))
    leaf = build.texture(textures.wood(rng, (300, 140), base=(165, 150, 130)))
    build.box(place, [0.0, 0.015, 1.06], [1.02, 0.03, 2.12], frame)
    build.box(place, [0.0, 0.025, 1.025], [0.9, 0.04, 2.05], leaf)
    build.box(place, [-0.38, 0.07, 1.02], [0.12, 0.03, 0.025], build.plain((190, 190, 195)))
    return 2.12


def cupboard(build: Builder, rng: np.random.Generator, place: Pose, *, width_m: float, height_m: float) -> float:
    """Add a cupboard with doors and something on top."""
    with build.thing("cupboard", place, kind="fixed"):
        depth = 0.45
        base = np.array(_WOODS[int(rng.integers(len(_WOODS)))])
        front = build.texture(textures.doors(rng, (int(height_m * 450), int(width_m * 450)), base=base))
        side = build.texture(textures.wood(rng, (200, 200), base=base))
        build.box(place, [0.0, depth / 2, height_m / 2], [width_m, depth, height_m], side, front=front)
        build.block(place * yaw_pose([0.0, depth / 2, 0.0], 0.0), (width_m, depth))
    if height_m < 1.0:
        at = place * yaw_pose([rng.uniform(-0.25, 0.25), 0.02, height_m], 0.0)
        with build.thing("carton", at):
            _carton(build, rng, at, 0.26, turn_rad=float(rng.uniform(-0.1, 0.1)))
        return height_m + 0.3
    return height_m


def bookshelf(build: Builder, rng: np.random.Generator, place: Pose, *, width_m: float) -> float:
    """Add a shelf of 2 m with rows of books and boxes."""
    with build.thing("shelf", place, kind="fixed"):
        _shelf(build, rng, place * yaw_pose([0.0, 0.17, 0.0], 0.0), width_m=width_m, height_m=2.0)
    return 2.0


def divider(build: Builder, rng: np.random.Generator, place: Pose) -> float:
    """Add a shelf across an island that shows books to both sides and hides what is behind."""
    height = float(rng.uniform(1.35, 1.7))
    with build.thing("divider", place, kind="fixed"):
        for yaw in (0.0, np.pi):
            turned = place * yaw_pose([0.0, 0.0, 0.0], yaw)
            _shelf(build, rng, turned * yaw_pose([0.0, 0.171, 0.0], 0.0), width_m=2.1, height_m=height)
    return height


def _shelf(build: Builder, rng: np.random.Generator, place: Pose, *, width_m: float, height_m: float) -> None:
    """Add a shelf centred on a place, 0.34 m deep, open to +y."""
    depth, board = 0.34, 0.025
    wood = _wood(build, rng)
    for side in (-1, 1):
        x = side * (width_m / 2 - board / 2)
        build.box(place, [x, 0.0, height_m / 2], [board, depth, height_m], wood)
    build.box(place, [0.0, -depth / 2 + 0.006, height_m / 2], [width_m - 2 * board, 0.012, height_m], wood)
    rows = int(height_m / 0.36)
    step = (height_m - board - 0.06) / rows
    for i in range(rows + 1):
        z = 0.06 + i * step
        build.box(place, [0.0, 0.006, z], [width_m - 2 * board, depth - 0.014, board], wood)
        if i < rows:
            _books(
                build,
                rng,
                place * yaw_pose([0.0, 0.0, z + board / 2], 0.0),
                width_m - 2 * board,
                step - board,
            )
    build.block(place, (width_m, depth))


def _books(build: Builder, rng: np.random.Generator, place: Pose, width_m: float, height_m: float) -> None:
    x, stop = -width_m / 2 + 0.01, width_m / 2 - 0.01
    while x < stop - 0.06:
        if rng.random() < 0.12:
            x += float(rng.uniform(0.08, 0.3))
            continue
        if rng.random() < 0.12 and x < stop - 0.34:
            at = place * yaw_pose([x + 0.155, -0.11, 0.0], 0.0)
            _carton(build, rng, at, 0.24, width_m=0.28, turn_rad=float(rng.uniform(-0.03, 0.03)))
            x += 0.31
            continue
        thick = float(rng.uniform(0.025, 0.07))
        tall = height_m * float(rng.uniform(0.68, 0.94))
        deep = float(rng.uniform(0.17, 0.24))
        back = build.texture(textures.spine(rng, (int(tall * 800), int(thick * 800))))
        cover = build.plain(textures.colour(rng))
        y = 0.15 - deep / 2 - float(rng.uniform(0.0, 0.05))
        build.box(place, [x + thick / 2, y, tall / 2], [thick - 0.001, deep, tall], cover, front=back)
        x += thick


def _carton(
    build: Builder,
    rng: np.random.Generator,
    place: Pose,
    height_m: float,
    *,
    width_m: float | None = None,
    turn_rad: float = 0.0,
    on: str = "furniture",
) -> float:
    """Add a carton, turned, whose hindmost corner is at y = 0 of a place; on the ``floor`` it marks its footprint."""
    width = float(rng.uniform(0.3, 0.5)) if width_m is None else width_m
    depth = float(rng.uniform(0.28, 0.4)) if width_m is None else 0.24
    back = (abs(np.sin(turn_rad)) * width + np.cos(turn_rad) * depth) / 2 + 0.002
    at = place * yaw_pose([0.0, back, 0.0], turn_rad)
    sides = {
        i: build.texture(textures.cardboard(rng, (int(height_m * 600), int(side * 600))))
        for i, side in ((0, depth), (1, depth), (2, width), (3, width))
    }
    top = build.texture(textures.cardboard(rng, (int(depth * 400), int(width * 400))))
    build.box(at, [0.0, 0.0, height_m / 2], [width, depth, height_m], top, sides=sides)
    if on == "floor":
        build.block(at, (width, depth))
    return height_m


def _stack(build: Builder, rng: np.random.Generator, place: Pose, *, turn_rad: float) -> float:
    """Pile up to three cartons and return the height."""
    z = 0.0
    with build.thing("stack of cartons", place):
        for _ in range(int(rng.integers(1, 4))):
            at = place * yaw_pose([rng.normal(0, 0.015), 0.0, z], 0.0)
            turn = float(np.clip(rng.normal(0, turn_rad), -0.25, 0.25))
            z += _carton(build, rng, at, float(rng.uniform(0.25, 0.4)), turn_rad=turn, on="floor")
    return z


def cartons(build: Builder, rng: np.random.Generator, place: Pose, *, width_m: float) -> float:
    """Add two stacks of cartons against a wall."""
    sides = (-width_m / 4, width_m / 4)
    return max(_stack(build, rng, place * yaw_pose([x, 0.0, 0.0], 0.0), turn_rad=0.06) for x in sides)


def pile(build: Builder, rng: np.random.Generator, place: Pose) -> float:
    """Add stacks of cartons in the open, and a low cupboard beside them."""
    spots = ((-0.83, -0.5), (-0.32, -0.48), (-0.83, -0.02), (-0.32, 0.0))
    highest = max(_stack(build, rng, place * yaw_pose([x, y, 0.0], 0.0), turn_rad=0.1) for x, y in spots)
    cupboard(build, rng, place * yaw_pose([0.62, -0.3, 0.0], 0.0), width_m=0.85, height_m=0.95)
    return highest


def desk(build: Builder, rng: np.random.Generator, place: Pose, *, width_m: float) -> float:
    """Add a desk with a monitor and things on it."""
    centre = place * yaw_pose([0.0, 0.3, 0.0], 0.0)
    top = _table(build, rng, centre, (width_m, 0.6), height_m=0.74)
    _monitor(build, rng, centre * yaw_pose([rng.uniform(-0.3, 0.3), -0.12, top], rng.normal(0, 0.15)))
    _litter(build, rng, centre, (width_m, 0.6), height_m=top, count=4)
    return 1.2


def desk_pair(build: Builder, rng: np.random.Generator, place: Pose) -> float:
    """Add two desks back to back with monitors, and a chair at each."""
    for x, yaw in ((-0.45, 0.0), (0.45, np.pi)):
        centre = place * yaw_pose([x * 0.3, 0.0, 0.0], yaw)
        half = centre * yaw_pose([0.0, 0.29, 0.0], 0.0)
        top = _table(build, rng, half, (1.5, 0.56), height_m=0.74)
        _monitor(build, rng, half * yaw_pose([rng.uniform(-0.4, 0.4), -0.15, top], rng.normal(0, 0.1)))
        _litter(build, rng, half, (1.5, 0.56), height_m=top, count=3)
    chair(build, rng, place * yaw_pose([-0.9, 0.1, 0.0], np.pi / 2 + rng.normal(0, 0.2)))
    return 1.2


def table_with_chairs(build: Builder, rng: np.random.Generator, place: Pose) -> float:
    """Add a meeting table with chairs at its ends and papers on it."""
    top = _table(build, rng, place, (1.2, 0.95), height_m=0.74)
    _litter(build, rng, place, (1.2, 0.95), height_m=top, count=8)
    chair(build, rng, place * yaw_pose([-0.82, rng.uniform(-0.2, 0.2), 0.0], np.pi / 2 + rng.normal(0, 0.25)))
    chair(build, rng, place * yaw_pose([0.82, rng.uniform(-0.2, 0.2), 0.0], -np.pi / 2 + rng.normal(0, 0.25)))
    return 0.9


def _table(
    build: Builder, rng: np.random.Generator, place: Pose, size: tuple[float, float], *, height_m: float
) -> float:
    wood, leg = _wood(build, rng), build.plain((70, 70, 74))
    with build.thing("table", place, kind="fixed"):
        build.box(place, [0.0, 0.0, height_m - 0.015], [size[0], size[1], 0.03], wood, cell_m=0.15)
        for sx in (-1, 1):
            for sy in (-1, 1):
                x, y = sx * (size[0] / 2 - 0.04), sy * (size[1] / 2 - 0.04)
                build.box(place, [x, y, (height_m - 0.03) / 2], [0.045, 0.045, height_m - 0.03], leg)
        build.block(place, size)
    return height_m


def _monitor(build: Builder, rng: np.random.Generator, place: Pose) -> None:
    dark = build.plain((28, 28, 30))
    with build.thing("screen", place, kind="picture"):
        build.box(place, [0.0, 0.0, 0.008], [0.24, 0.18, 0.016], dark)
        build.box(place, [0.0, -0.03, 0.1], [0.05, 0.03, 0.18], dark)
        image = build.texture(textures.screen(rng, (360, 600)))
        build.box(place, [0.0, 0.0, 0.3], [0.56, 0.035, 0.34], dark, front=image)


def _litter(
    build: Builder,
    rng: np.random.Generator,
    place: Pose,
    size: tuple[float, float],
    *,
    height_m: float,
    count: int,
) -> None:
    """Strew papers, books and mugs over a table top."""
    for i in range(count):
        x, y = rng.uniform(-0.5, 0.5, 2) * (np.asarray(size) - 0.38)
        at = place * yaw_pose([x, y, height_m + 0.0005 * (i + 1)], rng.uniform(-np.pi, np.pi))
        kind = rng.random()
        with build.thing("litter", at):
            if kind < 0.5:
                build.panel(at, (0.21, 0.297), build.texture(textures.page(rng, (300, 212))), solid=False)
            elif kind < 0.8:
                cover = build.texture(textures.shapes(rng, (180, 130)))
                thick = float(rng.uniform(0.015, 0.05))
                build.box(
                    at, [0.0, 0.0, thick / 2], [0.17, 0.24, thick], build.plain((225, 220, 205)), sides={4: cover}
                )
            else:
                build.box(at, [0.0, 0.0, 0.05], [0.075, 0.075, 0.1], build.texture(textures.shapes(rng, (80, 60))))


def chair(build: Builder, rng: np.random.Generator, place: Pose) -> float:
    """Add a chair whose back is at +y."""
    cloth = build.texture(
        textures.tinted(textures.colour(rng, high=150), 8 * textures.fractal(rng, (128, 128), cell_px=3, octaves=2))
    )
    leg = build.plain((60, 60, 62))
    with build.thing("chair", place):
        build.box(place, [0.0, 0.0, 0.45], [0.42, 0.42, 0.045], cloth, cell_m=0.15)
        build.box(place, [0.0, 0.2, 0.74], [0.4, 0.03, 0.4], cloth, cell_m=0.15)
        for sx in (-1, 1):
            for sy in (-1, 1):
                build.box(place, [sx * 0.19, sy * 0.19, 0.215], [0.03, 0.03, 0.43], leg)
            build.box(place, [sx * 0.17, 0.205, 0.55], [0.025, 0.02, 0.2], leg)
        build.block(place, (0.44, 0.46))
    return 0.94
