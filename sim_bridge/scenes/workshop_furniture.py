"""Furniture of the workshop. Each piece stands in a frame, z up; against a wall, the wall is y = 0 and +y the room."""

from __future__ import annotations

import dataclasses

import numpy as np

from fieldkit.frames import Pose
from sim_bridge.scenes import textures
from sim_bridge.scenes import workshop_prints as prints
from sim_bridge.scenes.blueprint import Builder
from sim_bridge.scenes.forms import hang, moved, paint, prism, upright
from sim_bridge.scenes.office_prints import fronts

BENCH_TOP_M = 0.88
_PRINT_PX_PER_M = 330


@dataclasses.dataclass(frozen=True)
class Gear:
    """The make of the furniture, as texture numbers; ``lacquer`` is the machines' colour (RGB)."""

    wood: int
    steel: int
    dark: int
    machine: int
    drawers: int
    cloth: int
    lacquer: tuple[int, int, int]


def px(size_m: tuple[float, float], *, px_per_m: float = _PRINT_PX_PER_M) -> tuple[int, int]:
    """Return (height, width) in pixels of a print of (width, height) in m."""
    return max(round(size_m[1] * px_per_m), 8), max(round(size_m[0] * px_per_m), 8)


def gear(build: Builder, rng: np.random.Generator) -> Gear:
    """Choose a make and add its textures."""
    tone = np.array(((78, 112, 100), (88, 104, 132), (120, 126, 120))[int(rng.integers(3))]) + rng.normal(0, 4, 3)
    tray = np.array(((150, 40, 38), (44, 74, 124), (86, 90, 96))[int(rng.integers(3))])
    return Gear(
        wood=build.plain(np.array([176, 140, 98]) + rng.normal(0, 4, 3)),
        steel=build.plain((150, 153, 158)),
        dark=build.plain((44, 46, 50)),
        machine=build.plain(tone),
        drawers=build.texture(fronts(px((0.5, 0.7), px_per_m=220), base=tray, cols=1, rows=4, px_per_m=220)),
        cloth=build.plain((150, 60, 46)),
        lacquer=(int(tone[0]), int(tone[1]), int(tone[2])),
    )


def workbench(build: Builder, look: Gear, place: Pose, *, width_m: float = 1.8) -> None:
    """Add a workbench of 0.7 m depth against a wall: a thick top, drawers on the left, a shelf, a vice."""
    with build.thing("workbench", place, kind="fixed"):
        build.box(place, [0.0, 0.35, BENCH_TOP_M - 0.03], [width_m, 0.7, 0.06], look.wood, cell_m=0.2)
        build.box(place, [-width_m / 2 + 0.3, 0.34, 0.46], [0.5, 0.6, 0.7], look.dark, front=look.drawers)
        for y in (0.08, 0.62):
            build.box(place, [width_m / 2 - 0.06, y, 0.41], [0.07, 0.07, 0.82], look.dark)
            build.box(place, [-width_m / 2 + 0.06, y, 0.055], [0.07, 0.07, 0.11], look.dark)
        build.box(place, [0.26, 0.35, 0.2], [width_m - 0.64, 0.5, 0.03], look.wood)
        build.box(place, [width_m / 2 - 0.25, 0.6, BENCH_TOP_M + 0.07], [0.14, 0.2, 0.14], look.machine)
        build.box(place, [width_m / 2 - 0.25, 0.74, BENCH_TOP_M + 0.09], [0.16, 0.06, 0.1], look.steel)
        build.block(moved(place, y_m=0.37), (width_m + 0.01, 0.78))


def tool_wall(
    build: Builder, rng: np.random.Generator, place: Pose, *, width_m: float = 1.7, up_m: float = 1.55
) -> None:
    """Hang a pegboard of 0.9 m height with tools."""
    size = (width_m, 0.9)
    base = np.array(((206, 190, 160), (196, 200, 204), (70, 86, 110))[int(rng.integers(3))])
    image = prints.pegboard(rng, px(size), base=base, px_per_m=_PRINT_PX_PER_M)
    hang(build, place, size, image, up_m=up_m, name="pegboard", frame=paint(build, (84, 70, 56)))


def bin_wall(build: Builder, rng: np.random.Generator, place: Pose, *, width_m: float = 1.2) -> None:
    """Add a louvred panel of bins, 1.0 m high, above a bench."""
    tone = ((40, 80, 150), (176, 44, 40), (210, 170, 50))[int(rng.integers(3))]
    front = build.texture(prints.bins(rng, px((width_m, 1.0), px_per_m=280), cols=8, rows=6, tone=tone))
    with build.thing("bins", place, kind="fixed"):
        build.box(place, [0.0, 0.1, 1.6], [width_m, 0.18, 1.0], paint(build, tone), front=front)


def lathe(build: Builder, rng: np.random.Generator, look: Gear, place: Pose) -> None:
    """Add a lathe of 2.0 x 0.75 m centred on a place, worked from +y; its back is plain."""
    front = build.texture(prints.controls(rng, px((0.56, 0.6)), base=look.lacquer))
    with build.thing("lathe", place, kind="fixed"):
        for x in (-0.68, 0.68):
            build.box(place, [x, 0.0, 0.36], [0.6, 0.6, 0.72], look.machine)
        build.box(place, [0.0, 0.0, 0.76], [2.0, 0.7, 0.08], look.dark)
        build.box(place, [0.1, 0.0, 0.87], [1.7, 0.3, 0.14], look.steel)
        build.box(place, [-0.7, 0.0, 1.1], [0.56, 0.5, 0.6], look.machine, front=front)
        build.box(place, [0.72, 0.0, 1.04], [0.26, 0.24, 0.2], look.machine)
        build.box(place, [0.1, 0.1, 1.0], [0.3, 0.34, 0.12], look.steel)
        build.box(place, [-0.37, 0.0, 1.12], [0.1, 0.24, 0.24], look.steel)
        build.box(place, [0.0, -0.36, 1.15], [1.9, 0.03, 0.7], look.machine)
        build.block(place, (2.02, 0.78))
    back = moved(moved(place, yaw_rad=np.pi), y_m=0.376)
    if rng.random() < 0.7:
        size = (0.6, 0.45)
        hang(build, back, size, prints.warning(rng, px(size)), along_m=float(rng.uniform(-0.5, 0.5)), up_m=1.15)


def mill(build: Builder, rng: np.random.Generator, look: Gear, place: Pose) -> None:
    """Add a milling machine of 1.0 x 0.9 x 2.0 m centred on a place, worked from +y."""
    front = build.texture(prints.controls(rng, px((0.44, 0.7)), base=look.lacquer))
    with build.thing("mill", place, kind="fixed"):
        build.box(place, [0.0, 0.0, 0.1], [0.7, 0.86, 0.2], look.machine)
        build.box(place, [0.0, -0.24, 1.0], [0.44, 0.4, 1.61], look.machine)
        build.box(place, [0.0, 0.14, 0.5], [0.3, 0.36, 0.61], look.machine)
        build.box(place, [0.0, 0.18, 0.86], [1.04, 0.34, 0.1], look.steel)
        build.box(place, [0.0, 0.04, 1.66], [0.44, 0.56, 0.7], look.machine, front=front)
        build.box(place, [0.0, 0.18, 1.18], [0.12, 0.12, 0.27], look.steel)
        build.block(place, (1.06, 0.9))
    size = (0.38, 0.5)
    side = float(rng.choice([-1.0, 1.0]))
    at = moved(moved(place, y_m=-0.24, yaw_rad=-side * np.pi / 2), y_m=0.22)
    hang(build, at, size, prints.warning(rng, px(size)), up_m=1.0, name="sign")


def drill(build: Builder, rng: np.random.Generator, look: Gear, place: Pose) -> None:
    """Add a pillar drill of 1.8 m, all of one make, with a maker's plate."""
    with build.thing("drill", place, kind="fixed"):
        plate = build.shared("drill", lambda: prints.controls(rng, px((0.3, 0.4)), base=look.lacquer))
        build.box(place, [0.0, 0.0, 0.05], [0.44, 0.6, 0.1], look.dark)
        prism(build, moved(place, y_m=-0.15, z_m=0.1), 0.05, 1.4, look.steel, count=8)
        build.box(place, [0.0, 0.06, 0.88], [0.36, 0.36, 0.05], look.steel)
        build.box(place, [0.0, 0.02, 1.55], [0.3, 0.6, 0.4], look.machine, front=plate)
        build.box(place, [0.0, 0.16, 1.27], [0.06, 0.06, 0.2], look.steel)
        build.block(place, (0.46, 0.66))


def pallet(build: Builder, look: Gear, place: Pose) -> None:
    """Add a pallet of 1.2 x 0.8 x 0.14 m."""
    for y in (-0.34, 0.0, 0.34):
        build.box(place, [0.0, y, 0.05], [1.2, 0.1, 0.098], look.wood)
    for x in np.linspace(-0.54, 0.54, 6):
        build.box(place, [float(x), 0.0, 0.12], [0.14, 0.8, 0.04], look.wood)
    build.block(place, (1.2, 0.8))


def crate(build: Builder, rng: np.random.Generator, place: Pose, size: tuple[float, float, float]) -> None:
    """Add a crate of (width, depth, height) whose long sides are stencilled alike, one of three sorts."""
    wide, deep, high = size
    sort = int(rng.integers(3))
    long = build.shared(("crate", sort), lambda: prints.crate_side(rng, px((wide, high), px_per_m=240)))
    short = build.shared(("crate end", sort), lambda: prints.crate_side(rng, px((deep, high), px_per_m=240)))
    with build.thing("crate", place):
        top = paint(build, (178, 142, 96))
        sides = {0: short, 1: short, 2: long, 3: long}
        build.box(place, [0.0, 0.0, high / 2], [wide, deep, high], top, sides=sides, cell_m=0.2)
        build.block(place, (wide, deep))


def loaded_pallet(build: Builder, rng: np.random.Generator, look: Gear, place: Pose, *, layers: int) -> None:
    """Add a pallet with crates or cartons of about 0.4 m in layers, askew."""
    with build.thing("pallet", place):
        pallet(build, look, place)
        for layer in range(layers):
            for x in (-0.3, 0.3):
                at = moved(
                    place, x, float(rng.normal(0, 0.01)), 0.141 + 0.401 * layer, yaw_rad=float(rng.normal(0, 0.03))
                )
                if rng.random() < 0.75:
                    crate(build, rng, at, (0.55, 0.7, 0.4))
                else:
                    face = build.texture(textures.cardboard(rng, px((0.55, 0.4), px_per_m=240)))
                    build.box(at, [0.0, 0.0, 0.2], [0.55, 0.7, 0.4], face, cell_m=0.2)


def rack(build: Builder, rng: np.random.Generator, look: Gear, place: Pose, *, width_m: float = 1.8) -> None:
    """Add a rack of 2.1 m with three boards against a wall: boxes of equal sorts, and some that differ."""
    deep = 0.55
    orange = paint(build, (206, 104, 36))
    with build.thing("rack", place, kind="fixed"):
        for x in (-width_m / 2 + 0.03, width_m / 2 - 0.03):
            for y in (0.03, deep - 0.03):
                build.box(place, [x, y, 1.05], [0.055, 0.055, 2.1], paint(build, (48, 74, 120)))
        for z in (0.15, 0.78, 1.42):
            build.box(place, [0.0, deep / 2, z], [width_m - 0.06, deep - 0.002, 0.03], look.wood)
            build.box(place, [0.0, deep - 0.01, z - 0.05], [width_m - 0.12, 0.018, 0.068], orange)
        build.block(moved(place, y_m=deep / 2), (width_m, deep))
    for z in (0.166, 0.796, 1.436):
        x = -width_m / 2 + 0.1
        while x < width_m / 2 - 0.42:
            wide, high = float(rng.choice([0.36, 0.5])), float(rng.choice([0.3, 0.42]))
            at = moved(place, x + wide / 2, 0.28, z)
            x += wide + float(rng.uniform(0.02, 0.2))
            if x > width_m / 2 - 0.05:
                break
            _stored(build, rng, at, (wide, high))


def _stored(build: Builder, rng: np.random.Generator, at: Pose, size: tuple[float, float]) -> None:
    """Add a box on a rack: a grey one as there are many, a crate, a carton."""
    wide, high = size
    with build.thing("stored box", at):
        kind = rng.random()
        if kind < 0.7:
            tone = (92, 100, 110)
            front = build.shared(
                ("grey box", size), lambda: prints.bins(rng, px(size, px_per_m=220), cols=1, rows=1, tone=tone)
            )
            build.box(at, [0.0, 0.0, high / 2], [wide, 0.44, high], paint(build, tone), front=front)
        else:
            draw = prints.crate_side if kind < 0.85 else textures.cardboard
            front = build.texture(draw(rng, px(size, px_per_m=260)))
            build.box(at, [0.0, 0.0, high / 2], [wide, 0.44, high], paint(build, (170, 134, 92)), front=front)


def screen(build: Builder, rng: np.random.Generator, look: Gear, place: Pose, *, width_m: float = 1.6) -> None:
    """Add a welding screen of 1.9 m, plain, with a sign on one side of it."""
    with build.thing("welding screen", place):
        build.box(place, [0.0, 0.0, 1.05], [width_m, 0.03, 1.6], look.cloth, cell_m=0.3)
        for x in (-width_m / 2, width_m / 2):
            build.box(place, [x, 0.0, 0.95], [0.04, 0.04, 1.9], look.dark)
            build.box(place, [x, 0.0, 0.03], [0.05, 0.5, 0.05], look.dark)
        build.block(place, (width_m + 0.05, 0.5))
    if rng.random() < 0.8:
        size = (0.55, 0.7)
        at = moved(place, y_m=0.015)
        hang(build, at, size, prints.warning(rng, px(size)), along_m=float(rng.uniform(-0.4, 0.4)), up_m=1.2)


def drum(build: Builder, rng: np.random.Generator, place: Pose) -> None:
    """Add an oil drum of 0.88 m in one of three colours, with a label."""
    r, g, b = ((36, 70, 130), (150, 46, 40), (60, 64, 68))[int(rng.integers(3))]
    with build.thing("drum", place):
        prism(build, place, 0.28, 0.88, paint(build, (r, g, b)), count=12)
        label = build.texture(prints.warning(rng, px((0.3, 0.36))))
        build.panel(upright(place, 0.0, 0.284, 0.5), (0.146, 0.36), label, solid=False)
        build.block(place, (0.56, 0.56))


def stool(build: Builder, look: Gear, place: Pose) -> None:
    """Add a square stool of 0.6 m."""
    with build.thing("stool", place):
        build.box(place, [0.0, 0.0, 0.58], [0.34, 0.34, 0.04], look.wood)
        for sx in (-1, 1):
            for sy in (-1, 1):
                build.box(place, [0.14 * sx, 0.14 * sy, 0.28], [0.03, 0.03, 0.56], look.dark)
        build.block(place, (0.36, 0.36))


def tool_cart(build: Builder, rng: np.random.Generator, look: Gear, place: Pose) -> None:
    """Add a cart with drawers, 0.7 x 0.45 x 0.9 m, things lying on it."""
    with build.thing("cart", place):
        build.box(place, [0.0, 0.0, 0.5], [0.66, 0.42, 0.7], look.dark, front=look.drawers)
        for sx in (-1, 1):
            for sy in (-1, 1):
                build.box(place, [0.26 * sx, 0.15 * sy, 0.075], [0.05, 0.09, 0.15], look.dark)
        build.block(place, (0.68, 0.46))
    parts(build, rng, look, moved(place, z_m=0.85), width_m=0.5, count=2)


def parts(build: Builder, rng: np.random.Generator, look: Gear, place: Pose, *, width_m: float, count: int) -> None:
    """Strew boxes, cases and workpieces along x of a place, on a top."""
    for i in range(count):
        x = ((i + float(rng.uniform(0.25, 0.75))) / count - 0.5) * width_m
        at = moved(place, x, float(rng.normal(0, 0.04)), yaw_rad=float(rng.normal(0, 0.25)))
        kind = rng.random()
        with build.thing("workpiece", at):
            if kind < 0.35:
                size = (float(rng.uniform(0.26, 0.42)), float(rng.uniform(0.16, 0.3)))
                face = build.texture(textures.cardboard(rng, px(size)))
                build.box(at, [0.0, 0.0, size[1] / 2], [size[0], 0.24, size[1]], face)
            elif kind < 0.7:
                size = (float(rng.uniform(0.3, 0.45)), 0.26)
                tone = tuple(int(v) for v in rng.integers(40, 200, 3))
                face = build.texture(prints.controls(rng, px(size), base=tone))
                build.box(at, [0.0, 0.0, 0.13], [size[0], 0.2, 0.26], paint(build, tone), sides={2: face, 3: face})
                build.box(at, [0.0, 0.0, 0.29], [0.14, 0.03, 0.06], look.dark)
            else:
                build.box(at, [0.0, 0.0, 0.05], [0.3, 0.2, 0.1], look.steel)
                build.box(at, [0.03, 0.0, 0.16], [0.12, 0.12, 0.12], look.steel)
