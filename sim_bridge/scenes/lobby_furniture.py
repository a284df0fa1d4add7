"""Furniture of the lobby. Each piece stands in a frame with z up; against a wall, the wall is y = 0 and +y the room."""

from __future__ import annotations

import dataclasses

import numpy as np

from fieldkit.frames import Pose
from sim_bridge.scenes import lobby_prints as prints
from sim_bridge.scenes import textures
from sim_bridge.scenes.blueprint import Builder
from sim_bridge.scenes.office_furniture import hang, moved, px
from sim_bridge.scenes.office_prints import fabric
from sim_bridge.scenes.plan import on_wall
from sim_bridge.scenes.textures import Rgb

COUNTER_M = 1.1


@dataclasses.dataclass(frozen=True)
class Make:
    """The make of the furniture: cloth, wood, steel, dark and white, as texture numbers, and the front's slats."""

    cloth: int
    wood: int
    steel: int
    dark: int
    white: int
    slats: int


def make(build: Builder, rng: np.random.Generator) -> Make:
    """Choose a make and add its textures."""
    cloth = np.array(((92, 78, 70), (70, 84, 98), (112, 106, 98))[int(rng.integers(3))]) + rng.normal(0, 4, 3)
    wood = np.array(((150, 116, 82), (112, 82, 60), (178, 150, 116))[int(rng.integers(3))]) + rng.normal(0, 4, 3)
    return Make(
        cloth=build.texture(fabric(rng, (128, 128), base=cloth)),
        wood=build.plain(wood),
        steel=build.plain((158, 160, 164)),
        dark=build.plain((40, 40, 43)),
        white=build.plain((224, 223, 219)),
        slats=build.texture(prints.slats(rng, (132, 480), base=wood, px_per_m=160)),
    )


def pillar(build: Builder, place: Pose, texture: int, *, radius_m: float, height_m: float, sides: int = 12) -> None:
    """Add a pillar of equal flat sides from floor to ceiling."""
    flat, half = 2 * radius_m * np.tan(np.pi / sides), radius_m
    for i in range(sides):
        turned = moved(place, yaw_rad=2 * np.pi * i / sides)
        at = on_wall(turned, 0.0, height_m / 2, off_m=half)
        build.panel(at, (flat, height_m), texture, uv=(i / sides, 0.0, (i + 1) / sides, 1.0))
    build.block(place, (1.8 * radius_m, 1.8 * radius_m))
    build.block(moved(place, yaw_rad=np.pi / 4), (1.8 * radius_m, 1.8 * radius_m))


def sofa(build: Builder, look: Make, place: Pose, *, width_m: float = 1.7) -> None:
    """Add a sofa centred on a place, whose back is at +y."""
    with build.thing("sofa", place):
        build.box(place, [0.0, 0.0, 0.2], [width_m, 0.8, 0.28], look.cloth, cell_m=0.2)
        build.box(place, [0.0, 0.32, 0.55], [width_m, 0.17, 0.46], look.cloth, cell_m=0.2)
        for side in (-1, 1):
            build.box(place, [side * (width_m / 2 - 0.08), -0.07, 0.45], [0.159, 0.66, 0.24], look.cloth)
            x = side * (width_m - 0.34) / 4
            build.box(place, [x, -0.08, 0.4], [(width_m - 0.36) / 2, 0.6, 0.13], look.cloth, cell_m=0.2)
            build.box(place, [side * (width_m / 2 - 0.1), 0.0, 0.03], [0.05, 0.6, 0.06], look.dark)
        build.block(place, (width_m + 0.02, 0.84))


def armchair(build: Builder, look: Make, place: Pose) -> None:
    """Add an armchair centred on a place, whose back is at +y."""
    with build.thing("armchair", place):
        build.box(place, [0.0, 0.0, 0.28], [0.7, 0.66, 0.3], look.cloth, cell_m=0.2)
        build.box(place, [0.0, 0.27, 0.6], [0.7, 0.13, 0.36], look.cloth, cell_m=0.2)
        for side in (-1, 1):
            build.box(place, [side * 0.3, -0.06, 0.5], [0.1, 0.53, 0.16], look.cloth)
            build.box(place, [side * 0.28, 0.0, 0.06], [0.04, 0.5, 0.119], look.dark)
        build.block(place, (0.72, 0.7))


def low_table(build: Builder, rng: np.random.Generator, look: Make, place: Pose) -> None:
    """Add a low table of 1.0 x 0.6 m with magazines."""
    with build.thing("low table", place):
        build.box(place, [0.0, 0.0, 0.4], [1.0, 0.6, 0.04], look.wood, cell_m=0.2)
        build.box(place, [0.0, 0.0, 0.19], [0.7, 0.3, 0.38], look.dark)
        build.block(place, (1.0, 0.6))
    for _ in range(int(rng.integers(2, 5))):
        x, y = rng.uniform(-0.35, 0.35), rng.uniform(-0.16, 0.16)
        at = moved(place, float(x), float(y), 0.42, yaw_rad=float(rng.uniform(-np.pi, np.pi)))
        with build.thing("magazine", at):
            cover = build.texture(textures.page(rng, (140, 104)))
            build.box(at, [0.0, 0.0, 0.006], [0.21, 0.28, 0.012], look.white, sides={4: cover}, solid=False)


def counter(build: Builder, rng: np.random.Generator, look: Make, place: Pose, *, length_m: float) -> None:
    """Add a reception counter along x: a high front of slats at +y, a desk behind it at -y, screens on the desk."""
    with build.thing("counter", place, kind="fixed"):
        build.box(place, [0.0, 0.25, COUNTER_M / 2], [length_m, 0.08, COUNTER_M], look.white, front=look.slats)
        build.box(place, [0.0, 0.2, COUNTER_M + 0.02], [length_m + 0.04, 0.3, 0.04], look.wood, cell_m=0.2)
        build.box(place, [0.0, -0.12, 0.725], [length_m - 0.12, 0.66, 0.03], look.wood, cell_m=0.2)
        for side in (-1, 1):
            build.box(place, [side * (length_m / 2 - 0.03), -0.1, 0.55], [0.06, 0.62, 1.1], look.white)
        build.block(place, (length_m + 0.04, 0.92))
    for x in (-length_m / 4, length_m / 4):
        at = moved(place, x + float(rng.normal(0, 0.1)), -0.02, 0.74, yaw_rad=np.pi + float(rng.normal(0, 0.15)))
        with build.thing("screen", at, kind="picture"):
            build.box(at, [0.0, 0.0, 0.01], [0.24, 0.18, 0.02], look.dark)
            build.box(at, [0.0, -0.03, 0.14], [0.05, 0.03, 0.26], look.dark)
            build.box(at, [0.0, 0.0, 0.38], [0.56, 0.035, 0.34], look.dark)
            image = build.texture(textures.screen(rng, (180, 300)))
            build.panel(on_wall(at, 0.0, 0.38, off_m=0.0185), (0.54, 0.32), image, solid=False)
    at = moved(place, float(rng.uniform(-0.4, 0.4)) * length_m, 0.2, COUNTER_M + 0.04)
    stand = build.texture(prints.leaflets(rng, px((0.42, 0.26)), cols=4))
    with build.thing("leaflets", at):
        build.box(at, [0.0, 0.0, 0.13], [0.42, 0.12, 0.26], look.dark, front=stand, solid=False)


def turnstile(build: Builder, look: Make, place: Pose) -> None:
    """Add one pedestal of a row of gates, 1.3 m long along y."""
    with build.thing("turnstile", place, kind="fixed"):
        build.box(place, [0.0, 0.0, 0.48], [0.24, 1.3, 0.96], look.steel)
        build.box(place, [0.0, 0.0, 0.98], [0.26, 1.32, 0.04], look.dark)
        build.box(place, [0.0, 0.0, 0.05], [0.25, 1.31, 0.1], look.dark)
        sign = build.shared("reader", lambda: prints.lift_panel((48, 36)))
        for yaw in (0.0, np.pi):
            front = on_wall(moved(place, yaw_rad=yaw), 0.0, 0.8, off_m=0.655)
            build.panel(front, (0.12, 0.16), sign, solid=False)
        build.block(place, (0.26, 1.32))


def fence(build: Builder, look: Make, place: Pose, *, length_m: float) -> None:
    """Add a low fence along x beside the gates."""
    with build.thing("fence", place, kind="fixed"):
        build.box(place, [0.0, 0.0, 0.55], [length_m, 0.03, 0.8], look.white)
        build.box(place, [0.0, 0.0, 0.97], [length_m, 0.05, 0.04], look.steel)
        build.block(place, (length_m, 0.08))


def lift(build: Builder, look: Make, place: Pose) -> None:
    """Add a closed lift of 1.1 x 2.15 m with its frame, button panel and lamp, each like the other."""
    door = build.shared("lift", lambda: prints.lift_door((344, 176)))
    buttons = build.shared("lift panel", lambda: prints.lift_panel((80, 40)))
    build.box(place, [0.0, 0.03, 1.13], [1.36, 0.06, 2.26], look.dark)
    build.box(place, [0.0, 0.034, 1.08], [1.1, 0.06, 2.15], look.steel, front=door)
    build.box(place, [-0.86, 0.01, 1.1], [0.12, 0.02, 0.24], look.steel, front=buttons, solid=False)
    build.box(place, [0.0, 0.02, 2.4], [0.4, 0.04, 0.14], look.dark, solid=False)


def display(build: Builder, look: Make, place: Pose, front: Rgb, back: Rgb | None) -> None:
    """Add a free-standing board of 1.0 x 1.5 m that faces +y; a back without a picture is blank."""
    with build.thing("display", place):
        build.box(place, [0.0, 0.0, 1.15], [1.06, 0.03, 1.56], look.white)
        for side in (-1, 1):
            build.box(place, [side * 0.5, 0.0, 0.96], [0.04, 0.045, 1.92], look.steel)
            build.box(place, [side * 0.5, 0.0, 0.015], [0.06, 0.5, 0.03], look.steel)
        for yaw, image in ((0.0, front), (np.pi, back)):
            if image is not None:
                at = on_wall(moved(place, yaw_rad=yaw), 0.0, 1.18, off_m=0.017)
                build.panel(at, (0.94, 1.34), build.texture(image), solid=False)
        build.block(place, (1.08, 0.5))


def banner(build: Builder, rng: np.random.Generator, look: Make, place: Pose, *, ceiling_m: float) -> None:
    """Hang a banner of 0.8 x 1.5 m from the ceiling, printed differently on its two sides, which faces +y."""
    size = (0.8, 1.5)
    up = ceiling_m - 0.35 - size[1] / 2
    with build.thing("banner", place, kind="picture"):
        for z in (up + size[1] / 2, up - size[1] / 2):
            build.box(place, [0.0, 0.0, z], [size[0] + 0.06, 0.02, 0.02], look.dark, solid=False)
        for x in (-0.35, 0.35):
            build.box(place, [x, 0.0, ceiling_m - 0.17], [0.008, 0.008, 0.34], look.dark, solid=False)
        for yaw in (0.0, np.pi):
            image = build.texture(prints.banner(rng, px(size)))
            build.panel(on_wall(moved(place, yaw_rad=yaw), 0.0, up, off_m=0.002), size, image, solid=False)


def rack(build: Builder, rng: np.random.Generator, look: Make, place: Pose) -> None:
    """Add a rack of leaflets against a wall: four stepped rows, 0.8 m wide, 1.5 m high."""
    with build.thing("rack", place):
        for i in range(4):
            y, z = 0.3 - 0.06 * i, 0.32 + 0.32 * i
            image = build.texture(prints.leaflets(rng, px((0.8, 0.28), px_per_m=320), cols=6))
            build.box(place, [0.0, y / 2, z], [0.8, y, 0.318], look.dark, front=image)
        build.box(place, [0.0, 0.16, 0.08], [0.8, 0.3, 0.158], look.dark)
        build.block(moved(place, y=0.16), (0.82, 0.34))


def kiosk(build: Builder, rng: np.random.Generator, look: Make, place: Pose) -> None:
    """Add an upright information screen that faces +y."""
    with build.thing("kiosk", place, kind="fixed"):
        build.box(place, [0.0, 0.0, 0.85], [0.6, 0.14, 1.7], look.dark)
        build.box(place, [0.0, 0.0, 0.02], [0.7, 0.5, 0.04], look.steel)
        build.block(place, (0.7, 0.5))
    at = on_wall(place, 0.0, 1.15, off_m=0.07)
    hang(
        build, at, (0.52, 0.92), textures.screen(rng, px((0.52, 0.92), px_per_m=320)), name="screen", frame=(24, 24, 26)
    )


def lockers(build: Builder, place: Pose, *, columns: int) -> None:
    """Add equal lockers in two rows, 0.35 m wide each and 0.5 m deep."""
    front = build.shared("locker", lambda: _locker((216, 84)))
    side = build.shared("locker side", lambda: np.full((1, 1, 3), (150, 156, 160), np.uint8))
    width = 0.35 * columns
    with build.thing("lockers", place, kind="fixed"):
        for i in range(columns):
            for z in (0.5, 1.4):
                x = (i - (columns - 1) / 2) * 0.35
                build.box(place, [x, 0.25, z], [0.349, 0.5, 0.899], side, front=front)
        build.box(place, [0.0, 0.24, 0.025], [width, 0.46, 0.05], side)
        build.block(moved(place, y=0.25), (width, 0.5))


def _locker(size: tuple[int, int]) -> Rgb:
    height, width = size
    image = np.full((height, width, 3), (172, 178, 182), np.uint8)
    image[:2], image[-2:], image[:, :2], image[:, -2:] = 96, 96, 96, 96
    for y in range(height // 12, height // 5, 5):
        image[y : y + 2, width // 4 : -width // 4] = 110
    image[height // 2 : height // 2 + 14, -14:-8] = 60
    return image
