"""Furniture of the laboratory. Each piece stands in a frame, z up; against a wall, the wall is y = 0, +y the room."""

from __future__ import annotations

import dataclasses

import numpy as np

from fieldkit.frames import Pose
from sim_bridge.scenes import laboratory_prints as prints
from sim_bridge.scenes import textures
from sim_bridge.scenes.blueprint import Builder
from sim_bridge.scenes.forms import moved, prism, upright
from sim_bridge.scenes.office_prints import fronts
from sim_bridge.scenes.textures import Rgb

BENCH_TOP_M = 0.9
_UNIT_M = 0.6
_PRINT_PX_PER_M = 340


@dataclasses.dataclass(frozen=True)
class Ware:
    """The make of the furniture, as texture numbers: bench top, cupboard side and front, steel, dark, white, glass."""

    top: int
    side: int
    front: int
    steel: int
    dark: int
    white: int
    glass: int


def px(size_m: tuple[float, float], *, px_per_m: float = _PRINT_PX_PER_M) -> tuple[int, int]:
    """Return (height, width) in pixels of a print of (width, height) in m."""
    return max(round(size_m[1] * px_per_m), 8), max(round(size_m[0] * px_per_m), 8)


def ware(build: Builder, rng: np.random.Generator) -> Ware:
    """Choose a make and add its textures."""
    tone = np.array(((214, 218, 220), (196, 206, 196), (222, 214, 198))[int(rng.integers(3))]) + rng.normal(0, 3, 3)
    top = np.array(((62, 64, 68), (150, 156, 158), (96, 104, 100))[int(rng.integers(3))]) + rng.normal(0, 3, 3)
    front = fronts(px((_UNIT_M, 0.74), px_per_m=220), base=tone.astype(int), cols=1, rows=3, px_per_m=220)
    return Ware(
        top=build.plain(top),
        side=build.plain(tone - 6),
        front=build.texture(front),
        steel=build.plain((168, 172, 176)),
        dark=build.plain((38, 40, 43)),
        white=build.plain((228, 229, 226)),
        glass=build.plain((186, 204, 206)),
    )


def stool(build: Builder, look: Ware, place: Pose) -> None:
    """Add a round stool of 0.62 m on four legs."""
    with build.thing("stool", place):
        for i in range(3):
            turned = moved(place, yaw_rad=i * np.pi / 6)
            build.box(turned, [0.0, 0.0, 0.59], [0.3, 0.3, 0.05 + 0.001 * i], look.dark)
        for sx in (-1, 1):
            for sy in (-1, 1):
                build.box(place, [0.12 * sx, 0.12 * sy, 0.28], [0.025, 0.025, 0.56], look.steel)
        build.box(place, [0.0, 0.0, 0.2], [0.22, 0.03, 0.02], look.steel)
        build.block(place, (0.36, 0.36))


def bench(build: Builder, look: Ware, place: Pose, *, units: int, depth_m: float = 0.7) -> None:
    """Add a bench of equal drawer units against a wall, centred on a place."""
    width = units * _UNIT_M
    with build.thing("bench", place, kind="fixed"):
        for i in range(units):
            x = (i - (units - 1) / 2) * _UNIT_M
            build.box(
                place,
                [x, depth_m / 2 - 0.03, 0.48],
                [_UNIT_M - 0.004, depth_m - 0.06, 0.76],
                look.side,
                front=look.front,
            )
        build.box(place, [0.0, depth_m / 2 - 0.06, 0.05], [width, depth_m - 0.13, 0.1], look.dark)
        build.box(place, [0.0, depth_m / 2, BENCH_TOP_M - 0.02], [width + 0.01, depth_m, 0.04], look.top, cell_m=0.2)
        build.block(moved(place, y_m=depth_m / 2), (width + 0.02, depth_m + 0.01))


def island(build: Builder, rng: np.random.Generator, look: Ware, place: Pose, *, units: int) -> None:
    """Add a bench of 1.4 m depth with drawers on both sides (x along), shelves of bottles above its middle, a sink."""
    width, half = units * _UNIT_M, 0.7
    with build.thing("island", place, kind="fixed"):
        for yaw in (0.0, np.pi):
            turned = moved(place, yaw_rad=yaw)
            for i in range(units):
                x = (i - (units - 1) / 2) * _UNIT_M
                build.box(turned, [x, 0.25, 0.48], [_UNIT_M - 0.004, 0.498, 0.76], look.side, front=look.front)
        build.box(place, [0.0, 0.0, 0.05], [width - 0.04, 0.86, 0.1], look.dark)
        build.box(place, [0.0, 0.0, BENCH_TOP_M - 0.02], [width + 0.02, 2 * half, 0.04], look.top, cell_m=0.2)
        for x in (-width / 2 + 0.02, 0.0, width / 2 - 0.02):
            build.box(place, [x, 0.0, 1.2], [0.03, 0.26, 0.6], look.steel)
        for z in (1.12, 1.48):
            build.box(place, [0.0, 0.0, z], [width, 0.28, 0.02], look.white)
        _reagents(build, rng, look, place, width)
        build.block(place, (width + 0.02, 2 * half + 0.01))


def _reagents(build: Builder, rng: np.random.Generator, look: Ware, place: Pose, width: float) -> None:
    """Add rows of bottles on an island's lower shelf, most of two sorts, and a closed unit on half of the upper one."""
    wide, closed = width / 2 - 0.08, float(rng.choice([-1.0, 1.0]))
    for x in (-width / 4, width / 4):
        rows = []
        for _ in range(2):
            sort = int(rng.integers(3))
            key = ("reagents", sort if sort < 2 else len(build.textures))
            rows.append(build.shared(key, lambda: prints.bottles(rng, px((wide, 0.26)), rows=1, full=0.9)))
        build.box(place, [x, 0.0, 1.26], [wide, 0.2, 0.26], look.glass, sides={2: rows[0], 3: rows[1]})
        if x * closed > 0:
            build.box(place, [x, 0.0, 1.73], [wide + 0.06, 0.28, 0.48], look.side, sides={2: look.front, 3: look.front})


def hood(build: Builder, rng: np.random.Generator, look: Ware, place: Pose) -> None:
    """Add a fume hood of 1.5 x 0.85 x 2.4 m with its things behind the pane, all hoods of the same make."""
    wide, deep = 1.5, 0.85
    with build.thing("fume hood", place, kind="fixed"):
        low = build.shared(
            "hood low",
            lambda: fronts(px((wide, 0.8), px_per_m=200), base=(206, 208, 204), cols=2, rows=1, px_per_m=200),
        )
        build.box(place, [0.0, deep / 2, 0.44], [wide - 0.01, deep - 0.06, 0.88], look.white, front=low)
        build.box(place, [0.0, deep / 2, 0.9], [wide, deep, 0.04], look.top)
        inside = build.texture(prints.hood_inside(rng, px((wide - 0.2, 0.9), px_per_m=260)))
        build.box(place, [0.0, deep / 2 - 0.06, 1.37], [wide - 0.19, deep - 0.13, 0.9], look.glass, front=inside)
        for side in (-1, 1):
            build.box(place, [side * (wide / 2 - 0.05), deep / 2, 1.37], [0.098, deep, 0.9], look.white)
        build.box(place, [0.0, deep / 2, 2.11], [wide - 0.002, deep, 0.58], look.white)
        build.box(place, [0.0, 0.3, 2.69], [0.34, 0.34, 0.58], look.steel)
        build.box(
            place, [0.0, deep - 0.03, 1.3 + 0.1 * float(rng.integers(0, 4))], [wide - 0.2, 0.03, 0.05], look.steel
        )
        build.block(moved(place, y_m=deep / 2), (wide, deep + 0.02))


def glass_cupboard(build: Builder, rng: np.random.Generator, look: Ware, place: Pose, *, same: bool = False) -> None:
    """Add a cupboard of 1.0 x 0.4 x 2.0 m with glass doors; with ``same`` its contents are those of all such."""
    size = (0.99, 1.9)
    key = "glass front" if same else ("glass front", len(build.things))
    front = build.shared(key, lambda: prints.glass_front(rng, px(size, px_per_m=260)))
    with build.thing("glass cupboard", place, kind="fixed"):
        build.box(place, [0.0, 0.2, 1.05], [size[0], 0.4, size[1]], look.side, front=front)
        build.box(place, [0.0, 0.19, 0.05], [0.95, 0.36, 0.1], look.dark)
        build.block(moved(place, y_m=0.2), (1.0, 0.42))


def cabinet(build: Builder, look: Ware, place: Pose, *, height_m: float = 1.9) -> None:
    """Add a plain cabinet of two doors, 0.9 x 0.45 m."""
    tone = (196, 200, 204)
    front = build.shared(
        ("cabinet", height_m),
        lambda: fronts(px((0.9, height_m), px_per_m=200), base=tone, cols=2, rows=1, px_per_m=200),
    )
    with build.thing("cabinet", place, kind="fixed"):
        build.box(place, [0.0, 0.225, height_m / 2], [0.896, 0.45, height_m], look.side, front=front)
        build.block(moved(place, y_m=0.225), (0.9, 0.46))


def instrument(
    build: Builder, rng: np.random.Generator, look: Ware, place: Pose, *, size: tuple[float, float, float]
) -> None:
    """Add an instrument of (width, depth, height) standing on a place, its panel at +y."""
    wide, deep, high = size
    front = build.texture(prints.panel_front(rng, px((wide, high))))
    with build.thing("instrument", place):
        build.box(place, [0.0, 0.0, high / 2 + 0.02], [wide, deep, high], look.white, front=front)
        build.box(place, [0.0, 0.0, 0.01], [0.8 * wide, 0.8 * deep, 0.02], look.dark)


def computer(build: Builder, rng: np.random.Generator, look: Ware, place: Pose) -> None:
    """Add a screen of 0.56 x 0.36 m that shows a measurement, standing on a place."""
    with build.thing("screen", place):
        image = build.texture(prints.readout(rng, px((0.56, 0.36), px_per_m=320)))
        build.box(place, [0.0, 0.0, 0.3], [0.56, 0.04, 0.36], look.dark)
        build.panel(upright(place, 0.0, 0.023, 0.3), (0.56, 0.36), image, solid=False, glow=0.9)
        build.box(place, [0.0, -0.05, 0.1], [0.06, 0.05, 0.2], look.dark)
        build.box(place, [0.0, 0.0, 0.008], [0.24, 0.2, 0.016], look.dark)


def microscope(build: Builder, look: Ware, place: Pose) -> None:
    """Add a microscope, all of which look alike."""
    with build.thing("microscope", place):
        build.box(place, [0.0, 0.0, 0.025], [0.2, 0.28, 0.05], look.white)
        build.box(place, [0.0, -0.1, 0.2], [0.08, 0.06, 0.3], look.white)
        build.box(place, [0.0, 0.0, 0.35], [0.09, 0.24, 0.08], look.white)
        build.box(place, [0.0, 0.02, 0.16], [0.14, 0.14, 0.02], look.dark)
        build.box(place, [0.0, 0.05, 0.25], [0.05, 0.05, 0.12], look.dark)
        build.box(place, [0.0, -0.02, 0.44], [0.05, 0.05, 0.1], look.dark)


def clutter(build: Builder, rng: np.random.Generator, look: Ware, place: Pose, *, width_m: float, count: int) -> None:
    """Strew racks, boxes, bottles and papers over a bench top: along x of a place, a little to either side."""
    for i in range(count):
        x = ((i + float(rng.uniform(0.2, 0.8))) / count - 0.5) * width_m
        at = moved(place, x, float(rng.normal(0, 0.04)), yaw_rad=float(rng.normal(0, 0.2)))
        kind = rng.random()
        with build.thing("clutter", at):
            if kind < 0.3:
                wide, high = float(rng.uniform(0.22, 0.36)), float(rng.uniform(0.16, 0.3))
                sides = build.texture(textures.cardboard(rng, px((wide, high), px_per_m=300)))
                build.box(at, [0.0, 0.0, high / 2], [wide, 0.22, high], sides)
            elif kind < 0.65:
                wide, high = float(rng.uniform(0.3, 0.5)), 0.24
                row = build.texture(prints.bottles(rng, px((wide, high)), rows=1))
                build.box(at, [0.0, 0.0, high / 2], [wide, 0.14, high], look.glass, sides={2: row, 3: row})
            elif kind < 0.85:
                binder = build.texture(np.concatenate([_spine(rng) for _ in range(5)], axis=1))
                build.box(at, [0.0, 0.0, 0.155], [0.32, 0.24, 0.31], look.white, sides={2: binder, 3: binder})
            else:
                sheet = build.texture(textures.page(rng, px((0.3, 0.42))))
                build.panel(moved(at, z_m=0.004), (0.3, 0.42), sheet, solid=False)


def _spine(rng: np.random.Generator) -> Rgb:
    return textures.spine(rng, px((0.064, 0.31)))


def coat(build: Builder, rng: np.random.Generator, look: Ware, place: Pose) -> None:
    """Hang a white coat on a hook 1.7 m up a wall."""
    with build.thing("coat", place):
        wide = float(rng.uniform(0.3, 0.42))
        build.box(place, [0.0, 0.1, 1.15], [wide, 0.12, 0.95], look.white)
        for side in (-1, 1):
            build.box(place, [side * (wide / 2 + 0.04), 0.09, 1.3], [0.09, 0.1, 0.6], look.white)
        build.box(place, [0.0, 0.05, 1.68], [0.03, 0.09, 0.03], look.dark)
        badge = build.texture(prints.panel_front(rng, (40, 60)))
        build.panel(upright(place, 0.08, 0.163, 1.4), (0.1, 0.07), badge, solid=False)


def gas_bottles(build: Builder, rng: np.random.Generator, place: Pose, *, count: int) -> None:
    """Add gas bottles in a row against a wall, 1.5 m high, with coloured shoulders."""
    grey = build.shared("gas grey", lambda: np.full((1, 1, 3), (112, 116, 120), np.uint8))
    for i in range(count):
        at = moved(place, (i - (count - 1) / 2) * 0.28, 0.15)
        r, g, b = ((40, 90, 160), (150, 40, 40), (40, 120, 70), (200, 170, 40))[int(rng.integers(4))]
        ring = build.shared(("gas", r, g, b), lambda r=r, g=g, b=b: np.full((1, 1, 3), (r, g, b), np.uint8))  # type: ignore[misc]
        with build.thing("gas bottle", at, kind="fixed"):
            prism(build, at, 0.11, 1.15, grey, count=10)
            prism(build, moved(at, z_m=1.15), 0.105, 0.18, ring, count=10)
            prism(build, moved(at, z_m=1.33), 0.035, 0.14, grey, count=8)
            label = build.texture(prints.rules(rng, px((0.14, 0.2))))
            build.panel(upright(at, 0.0, 0.112, 0.85), (0.06, 0.2), label, solid=False)
            build.block(at, (0.24, 0.24))


def shower(build: Builder, look: Ware, place: Pose) -> None:
    """Add an emergency shower on a wall: a pipe, an arm, a head, a green board behind."""
    green = build.shared("shower", lambda: np.full((1, 1, 3), (30, 130, 74), np.uint8))
    with build.thing("shower", place, kind="fixed"):
        build.box(place, [0.0, 0.06, 1.1], [0.05, 0.05, 2.2], green)
        build.box(place, [0.0, 0.3, 2.2], [0.045, 0.52, 0.045], green)
        build.box(place, [0.0, 0.55, 2.14], [0.2, 0.2, 0.06], look.steel)
        build.box(place, [0.0, 0.2, 0.95], [0.3, 0.28, 0.06], look.steel)
        build.block(moved(place, y_m=0.18), (0.32, 0.36))
