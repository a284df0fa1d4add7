"""Furniture of the museum: plinths with pots and carvings, showcases without glass, benches, partitions, barriers."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from fieldkit.frames import Pose
from sim_bridge.scenes.blueprint import Builder
from sim_bridge.scenes.heldout_art import framed, glaze, painting
from sim_bridge.scenes.heldout_charts import readout
from sim_bridge.scenes.heldout_parts import COARSE_M, Solid, Tone, hang, legs, monitor, pillar, solids, spot, tone
from sim_bridge.scenes.heldout_prints import cover, filled, ink, paragraph, speckled
from sim_bridge.scenes.heldout_surfaces import Rgb, coat
from sim_bridge.scenes.plan import on_wall

CHALK: Tone = (226, 224, 218)
GRAPHITE: Tone = (62, 62, 66)
FRAMES: tuple[Tone, ...] = ((170, 136, 74), (60, 48, 40), (196, 194, 188), (120, 84, 52))
_DENSITY = 300.0


def plinth(build: Builder, place: Pose, *, height_m: float, side_m: float = 0.46) -> None:
    """Stand a plain plinth; all are alike but for their height."""
    build.box(place, [0, 0, height_m / 2], [side_m, side_m, height_m], tone(build, CHALK), cell_m=0.25)


def exhibit(build: Builder, rng: np.random.Generator, place: Pose, *, height_m: float = 1.0) -> None:
    """Stand a plinth with a pot, a carving or a stack of stones on it."""
    with build.thing("exhibit", place):
        plinth(build, place, height_m=height_m)
        top = place * spot(0.0, 0.0, float(rng.uniform(0, 360)), z=height_m)
        kind = int(rng.integers(3))
        if kind == 0:
            pot(build, rng, top, height_m=float(rng.uniform(0.35, 0.6)))
        elif kind == 1:
            carving(build, rng, top, height_m=float(rng.uniform(0.4, 0.65)))
        else:
            stones(build, rng, top, height_m=float(rng.uniform(0.35, 0.6)))
        build.block(place, (0.48, 0.48))


def pot(build: Builder, rng: np.random.Generator, place: Pose, *, height_m: float) -> None:
    """Put a painted pot on a place: a profile of rings."""
    picture = build.texture(glaze(rng, (round(height_m * _DENSITY), 300)))
    rings, belly = 7, rng.uniform(0.3, 0.7)
    up = (np.arange(rings) + 0.5) / rings
    radius = 0.16 * (0.45 + 0.55 * np.exp(-(((up - belly) / 0.33) ** 2)))
    radius[-1] = radius[-2] * rng.uniform(0.7, 1.25)
    for k in range(rings):
        levels = (k * height_m / rings, (k + 1) * height_m / rings)
        part = (1 - (k + 1) / rings, 1 - k / rings)
        pillar(build, place, float(radius[k]), levels, picture, sides=12, rows=part)


def _stone(build: Builder, rng: np.random.Generator) -> int:
    base = ink(rng, saturation=0.2, value=0.55)
    return build.texture(speckled(rng, (160, 160), base=base))


def carving(build: Builder, rng: np.random.Generator, place: Pose, *, height_m: float) -> None:
    """Put a carved head or figure of stone on a place."""
    stone, unit = _stone(build, rng), height_m / 4
    solids(build, place, [((0, 0, 0.25 * unit), (1.5 * unit, 1.2 * unit, 0.5 * unit))], stone)
    pillar(build, place, 0.35 * unit, (0.5 * unit, 1.4 * unit), stone)
    pillar(build, place, 0.8 * unit, (1.4 * unit, 3.2 * unit), stone, sides=10)
    pillar(build, place, 0.6 * unit, (3.2 * unit, 3.8 * unit), stone, sides=10)
    nose = float(rng.uniform(0.2, 0.45)) * unit
    solids(build, place, [((0, 0.8 * unit, 2.2 * unit), (0.25 * unit, nose, 0.7 * unit))], stone)
    dark = tone(build, (40, 36, 34))
    eyes: list[Solid] = [((s * 0.3 * unit, 0.8 * unit, 2.6 * unit), (0.28 * unit, 0.06, 0.12 * unit)) for s in (-1, 1)]
    solids(build, place, eyes, dark)


def stones(build: Builder, rng: np.random.Generator, place: Pose, *, height_m: float) -> None:
    """Put blocks of different colours on one another, each turned."""
    up = 0.0
    for share in rng.dirichlet(np.full(4, 4.0)):
        thick, wide = float(share) * height_m, float(rng.uniform(0.12, 0.32))
        turn = place * spot(0.0, 0.0, float(rng.uniform(0, 90)), z=up + thick / 2)
        size = [wide, float(rng.uniform(0.1, 0.3)), thick]
        texture = _stone(build, rng) if rng.random() < 0.5 else tone(build, ink(rng))
        build.box(turn, [0, 0, 0], size, texture, cell_m=COARSE_M)
        up += thick


def statue(build: Builder, rng: np.random.Generator, place: Pose) -> None:
    """Stand a figure of stone, larger than life, on a low base."""
    stone = build.texture(speckled(rng, (160, 160), base=(150, 146, 136)))
    with build.thing("statue", place, kind="fixed"):
        build.box(place, [0, 0, 0.2], [0.9, 0.9, 0.4], tone(build, GRAPHITE), cell_m=0.3)
        for x in (-0.14, 0.14):
            pillar(build, place * spot(x, 0.0), 0.12, (0.4, 1.25), stone)
        pillar(build, place, 0.29, (1.25, 1.6), stone, sides=10)
        pillar(build, place, 0.34, (1.6, 2.05), stone, sides=10)
        pillar(build, place, 0.1, (2.05, 2.15), stone)
        pillar(build, place, 0.16, (2.15, 2.5), stone, sides=10)
        for side, tilt in ((-1, float(rng.uniform(5, 40))), (1, float(rng.uniform(5, 70)))):
            turn = Rotation.from_euler("y", -side * tilt, degrees=True)
            arm = place * Pose.from_components([side * 0.36, 0.0, 1.98], turn)
            build.box(arm, [0, 0, -0.36], [0.13, 0.14, 0.72], stone, cell_m=0.4)
        build.block(place, (0.92, 0.92))


def showcase(build: Builder, rng: np.random.Generator, place: Pose, *, items: int) -> None:
    """Stand a showcase on a closed base: corner posts and a lid, things inside, no glass."""
    body, metal = tone(build, (198, 196, 190)), tone(build, GRAPHITE)
    wide, deep, base, top = 1.2, 0.7, 0.86, 1.5
    with build.thing("showcase", place, kind="fixed"):
        build.box(place, [0, 0, base / 2], [wide, deep, base], body, cell_m=0.25)
        build.box(place, [0, 0, top + 0.03], [wide, deep, 0.06], metal, cell_m=0.3)
        posts = legs((wide, deep), 1.0, thick_m=0.025)
        raised: list[Solid] = [((c[0], c[1], (base + top) / 2), (s[0], s[1], top - base)) for c, s in posts]
        solids(build, place, raised, metal)
        cloth = tone(build, (112, 30, 40))
        build.box(place, [0, 0, base + 0.004], [wide - 0.08, deep - 0.08, 0.008], cloth, cell_m=0.25)
        for x in (np.arange(items) + 0.5 - items / 2) * (wide - 0.2) / items:
            at = place * spot(float(x), float(rng.uniform(-0.12, 0.12)), float(rng.uniform(0, 360)), z=base + 0.008)
            make = (pot, carving, stones)[int(rng.integers(3))]
            make(build, rng, at, height_m=float(rng.uniform(0.16, 0.34)))
        for turn in (0.0, 180.0):
            side = place * spot(0.0, 0.0, turn)
            label = build.texture(_label(rng, (50, 130)))
            build.panel(on_wall(side, float(rng.uniform(-0.3, 0.3)), 0.76, off_m=deep / 2 + 0.002), (0.36, 0.14), label)
        build.block(place, (wide, deep))


def _label(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    image = filled(size, (240, 238, 230))
    paragraph(rng, image, (6, 2, size[1] - 6, size[0] - 2), line_px=max(size[0] / 5, 11), rgb=(40, 40, 44))
    return image


def hang_painting(
    build: Builder, rng: np.random.Generator, wall_place: Pose, *, width_m: float, height_m: float, up_m: float
) -> None:
    """Hang a framed painting on a wall, its label beside it."""
    rim = round(float(rng.uniform(0.03, 0.08)) * _DENSITY)
    size = (round(height_m * _DENSITY) - 2 * rim, round(width_m * _DENSITY) - 2 * rim)
    frame = FRAMES[int(rng.integers(len(FRAMES)))]
    picture = build.texture(framed(painting(rng, size), rim_px=rim, rgb=frame))
    hang(build, wall_place, (0.0, up_m), (width_m, height_m), picture, name="painting", depth_m=0.05, rim=frame)
    label = build.texture(_label(rng, (50, 75)))
    hang(build, wall_place, (-width_m / 2 - 0.25, 1.3), (0.2, 0.13), label, name="label", depth_m=0.008)


def text_panel(build: Builder, rng: np.random.Generator, wall_place: Pose, *, base: Tone) -> None:
    """Hang a large panel of text at a hall's entrance."""
    image = filled((420, 270), base)
    paragraph(rng, image, (20, 60, 250, 400), line_px=18, rgb=(244, 242, 236))
    paragraph(rng, image, (20, 10, 250, 55), line_px=40, rgb=(244, 226, 160))
    hang(build, wall_place, (0.0, 1.6), (0.9, 1.4), build.texture(image), name="text", rim=base)


def bench(build: Builder, place: Pose) -> None:
    """Stand a bench without a back."""
    with build.thing("bench", place):
        build.box(place, [0, 0, 0.41], [1.7, 0.46, 0.1], tone(build, (52, 44, 40)), cell_m=0.3)
        solids(build, place, [((x, 0, 0.18), (0.06, 0.42, 0.36)) for x in (-0.7, 0.7)], tone(build, GRAPHITE))
        build.block(place, (1.7, 0.46))


def partition(build: Builder, rng: np.random.Generator, place: Pose, *, width_m: float, height_m: float) -> None:
    """Stand a free partition along x; pictures are hung on it by its frames at y = 0.1 and -0.1."""
    with build.thing("partition", place, kind="fixed"):
        face = build.texture(coat(rng, (round(110 * height_m), round(110 * width_m)), base=(214, 208, 196)))
        body = tone(build, (206, 200, 188))
        centre, size = [0, 0, height_m / 2], [width_m, 0.2, height_m]
        build.box(place, centre, size, body, sides={2: face, 3: face}, cell_m=0.2)
        build.block(place, (width_m, 0.2))


def barrier(build: Builder, place: Pose, *, length_m: float) -> None:
    """Stand two posts with a cord between them."""
    with build.thing("barrier", place):
        metal = tone(build, (176, 150, 90))
        for x in (-length_m / 2, length_m / 2):
            pillar(build, place * spot(x, 0.0), 0.13, (0.0, 0.03), metal)
            solids(build, place, [((x, 0, 0.48), (0.04, 0.04, 0.92))], metal)
        cord = tone(build, (110, 24, 34))
        along = np.linspace(-length_m / 2, length_m / 2, 7)
        up = 0.68 + 0.2 * (2 * along / length_m) ** 2
        for k in range(6):
            run, rise = float(along[k + 1] - along[k]), float(up[k + 1] - up[k])
            turn = Rotation.from_euler("y", -np.arctan2(rise, run))
            part = Pose.from_components([(along[k] + along[k + 1]) / 2, 0.0, (up[k] + up[k + 1]) / 2], turn)
            build.box(place * part, [0, 0, 0], [np.hypot(run, rise) + 0.015, 0.03, 0.03], cord, cell_m=COARSE_M)
        build.block(place, (length_m + 0.26, 0.26))


def ticket_desk(build: Builder, rng: np.random.Generator, place: Pose) -> None:
    """Stand the ticket desk along x, its plain front towards +y, with a till, a monitor and cards for sale."""
    with build.thing("ticket desk", place, kind="fixed"):
        build.box(place, [0, 0, 0.5], [2.2, 0.5, 1.0], tone(build, GRAPHITE), cell_m=0.25)
        build.box(place, [0, 0.02, 1.02], [2.26, 0.6, 0.04], tone(build, CHALK), cell_m=0.3)
        monitor(build, place * spot(-0.6, -0.08, 180.0, z=1.04), build.texture(readout(rng, (170, 280))), width_m=0.42)
        stand = place * spot(0.65, 0.1, z=1.04)
        build.box(stand, [0, 0, 0.2], [0.5, 0.05, 0.4], tone(build, CHALK), cell_m=0.4)
        for row in range(2):
            for col in range(4):
                card = build.texture(cover(rng, (58, 38)))
                at = on_wall(stand, (col - 1.5) * 0.12, 0.1 + 0.19 * row, off_m=0.027)
                build.panel(at, (0.1, 0.16), card, solid=False)
        build.block(place, (2.26, 0.6))


def bag_lockers(build: Builder, wall_place: Pose, *, columns: int) -> None:
    """Stand lockers for bags along a wall: equal small doors in four rows."""
    face = build.shared("bag locker", _bag_locker_face)
    width = 0.36 * columns
    with build.thing("bag lockers", wall_place, kind="fixed"):
        for x in (np.arange(columns) + 0.5 - columns / 2) * 0.36:
            build.box(wall_place, [x, 0.22, 0.85], [0.355, 0.42, 1.7], tone(build, CHALK), front=face, cell_m=0.3)
        build.block(wall_place * spot(0.0, 0.22), (width, 0.44))


def _bag_locker_face() -> Rgb:
    tile = np.empty((50, 42, 3), np.uint8)
    tile[:] = (188, 90, 52)
    tile[:2], tile[:, :1], tile[:, -1:] = (70, 50, 40), (70, 50, 40), (70, 50, 40)
    tile[22:30, 32:37] = (210, 210, 206)
    return np.tile(tile, (4, 1, 1))
