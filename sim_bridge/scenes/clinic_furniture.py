"""Furniture of the clinic: rows of seats, couches, curtains, cupboards, trolleys, counters, racks of leaflets."""

from __future__ import annotations

import numpy as np

from fieldkit.frames import Pose
from sim_bridge.scenes.blueprint import Builder
from sim_bridge.scenes.heldout_charts import readout
from sim_bridge.scenes.heldout_parts import COARSE_M, Solid, Tone, legs, monitor, pillar, solids, spot, tone
from sim_bridge.scenes.heldout_prints import cover, notice
from sim_bridge.scenes.heldout_surfaces import Rgb, pleats
from sim_bridge.scenes.plan import on_wall

WHITE: Tone = (228, 230, 230)
STEEL: Tone = (150, 156, 160)
TEAL: Tone = (70, 122, 128)
BEECH: Tone = (204, 176, 138)
RAIL_M = 2.05


def seat_row(build: Builder, place: Pose, *, seats: int, rgb: Tone = TEAL) -> None:
    """Stand a beam with moulded seats along x; one sits facing +y."""
    metal, shell = tone(build, STEEL), tone(build, rgb)
    width = 0.56 * seats
    with build.thing("seat row", place):
        solids(build, place, [((0, 0, 0.34), (width - 0.1, 0.06, 0.05))], metal)
        for x in (-width / 2 + 0.3, width / 2 - 0.3):
            solids(build, place, [((x, 0, 0.17), (0.05, 0.05, 0.3)), ((x, 0, 0.012), (0.06, 0.5, 0.024))], metal)
        for x in (np.arange(seats) + 0.5 - seats / 2) * 0.56:
            build.box(place, [x, 0.02, 0.42], [0.48, 0.46, 0.05], shell, cell_m=0.24)
            build.box(place, [x, -0.22, 0.66], [0.48, 0.04, 0.42], shell, cell_m=0.24)
        build.block(place, (width, 0.56))


def couch(build: Builder, place: Pose) -> None:
    """Stand an examination couch along x, its head at +x, with a sheet of paper over it."""
    frame, cover_tone, paper = tone(build, WHITE), tone(build, (52, 78, 96)), tone(build, (240, 240, 236))
    with build.thing("couch", place, kind="fixed"):
        solids(build, place, legs((1.8, 0.6), 0.56, thick_m=0.05, inset_m=0.05), frame)
        build.box(place, [0, 0, 0.4], [1.7, 0.5, 0.2], frame, cell_m=0.4)
        build.box(place, [-0.25, 0, 0.62], [1.36, 0.66, 0.12], cover_tone, cell_m=0.3)
        build.box(place, [-0.25, 0, 0.683], [1.34, 0.5, 0.006], paper, cell_m=0.3)
        build.box(place, [0.68, 0, 0.69], [0.48, 0.66, 0.14], cover_tone, cell_m=0.3)
        build.block(place, (1.9, 0.68))


def curtain(build: Builder, place: Pose, *, length_m: float, rgb: Tone) -> None:
    """Hang a curtain in equal folds on a rail, along x, down to 0.25 m above the floor."""
    count = round(length_m / 0.14)
    cloth = build.shared(("pleats", rgb, count), lambda: pleats((8, 24 * count), base=rgb, count=count))
    metal = tone(build, STEEL)
    with build.thing("curtain", place):
        centre, size = [0, 0, (RAIL_M + 0.25) / 2], [length_m, 0.06, RAIL_M - 0.25]
        build.box(place, centre, size, tone(build, rgb), sides={2: cloth, 3: cloth}, cell_m=0.25)
        solids(build, place, [((0, 0, RAIL_M + 0.02), (length_m + 0.06, 0.03, 0.03))], metal)
        posts: list[Solid] = [((s * (length_m / 2 + 0.02), 0, RAIL_M / 2), (0.03, 0.03, RAIL_M)) for s in (-1, 1)]
        solids(build, place, posts, metal)
        build.block(place, (length_m + 0.08, 0.1))


def cupboards(build: Builder, wall_place: Pose, *, units: int, tall: bool) -> None:
    """Stand equal white cupboards along a wall: tall ones, or low ones with a worktop and others above."""
    face = build.shared(("cupboard", tall), lambda: _cupboard_face(190 if tall else 78))
    body, width = tone(build, WHITE), 0.6 * units
    with build.thing("cupboards", wall_place, kind="fixed"):
        for x in (np.arange(units) + 0.5 - units / 2) * 0.6:
            if tall:
                build.box(wall_place, [x, 0.25, 1.05], [0.595, 0.46, 1.9], body, front=face, cell_m=0.3)
                continue
            build.box(wall_place, [x, 0.27, 0.48], [0.595, 0.5, 0.78], body, front=face, cell_m=0.3)
            build.box(wall_place, [x, 0.17, 1.75], [0.595, 0.32, 0.7], body, front=face, cell_m=0.3)
        if not tall:
            top = tone(build, (120, 126, 130))
            build.box(wall_place, [0, 0.29, 0.89], [width, 0.56, 0.04], top, cell_m=0.3)
        build.box(wall_place, [0, 0.24, 0.045], [width, 0.4, 0.09], tone(build, STEEL), cell_m=0.5)
        build.block(wall_place * spot(0.0, 0.28), (width, 0.58))


def _cupboard_face(height_px: int) -> Rgb:
    image = np.empty((height_px, 60, 3), np.uint8)
    image[:] = WHITE
    image[:1], image[-1:], image[:, :1], image[:, -1:] = (170,) * 3, (170,) * 3, (170,) * 3, (170,) * 3
    middle = image.shape[0] // 2
    image[middle - 6 : middle + 6, 51:54] = (110, 114, 118)
    return image


def worktop_clutter(build: Builder, rng: np.random.Generator, wall_place: Pose, *, width_m: float) -> None:
    """Put boxes, bottles and a basin on a worktop along a wall."""
    with build.thing("supplies", wall_place, kind="fixed"):
        x = -width_m / 2 + 0.15
        while x < width_m / 2 - 0.15:
            wide, tall = float(rng.uniform(0.08, 0.26)), float(rng.uniform(0.08, 0.28))
            label = build.texture(notice(rng, (round(350 * tall) + 20, round(350 * wide) + 20)))
            centre = [x + wide / 2, float(rng.uniform(0.1, 0.3)), 0.91 + tall / 2]
            if rng.random() < 0.75:
                build.box(wall_place, centre, [wide, 0.12, tall], tone(build, WHITE), front=label, cell_m=0.3)
            x += wide + float(rng.uniform(0.06, 0.5))


def basin(build: Builder, wall_place: Pose) -> None:
    """Hang a wash basin on a wall, with the soap and towel boxes that hang in every room."""
    white, metal = tone(build, (238, 240, 240)), tone(build, STEEL)
    with build.thing("basin", wall_place, kind="fixed"):
        build.box(wall_place, [0, 0.22, 0.82], [0.5, 0.4, 0.14], white, cell_m=0.25)
        build.box(wall_place, [0, 0.18, 0.4], [0.16, 0.16, 0.7], white, cell_m=0.4)
        solids(build, wall_place, [((0, 0.08, 0.98), (0.04, 0.04, 0.18)), ((0, 0.14, 1.07), (0.04, 0.16, 0.03))], metal)
        splash = tone(build, (206, 216, 218))
        build.panel(on_wall(wall_place, 0.0, 1.15, off_m=0.004), (0.8, 0.5), splash, cell_m=0.25)
        dispensers(build, wall_place * spot(0.55, 0.0))
        build.block(wall_place * spot(0.0, 0.22), (0.5, 0.42))


def dispensers(build: Builder, wall_place: Pose) -> None:
    """Hang a soap and a towel box on a wall; all are alike."""
    with build.thing("dispenser", wall_place, kind="fixed"):
        build.box(wall_place, [0, 0.08, 1.4], [0.28, 0.14, 0.36], tone(build, WHITE), cell_m=COARSE_M)
        build.box(wall_place, [-0.28, 0.05, 1.33], [0.1, 0.1, 0.26], tone(build, (120, 160, 190)), cell_m=COARSE_M)


def doctors_desk(build: Builder, rng: np.random.Generator, place: Pose) -> None:
    """Stand a desk with its back at y = 0; one sits at its front: monitor, papers, a drawer unit."""
    top = tone(build, BEECH)
    with build.thing("desk", place, kind="fixed"):
        build.box(place, [0, 0.31, 0.73], [1.4, 0.6, 0.03], top, cell_m=0.25)
        build.box(place, [0.48, 0.3, 0.36], [0.4, 0.52, 0.7], tone(build, WHITE), cell_m=0.4)
        build.box(place, [-0.68, 0.3, 0.36], [0.03, 0.54, 0.7], top, cell_m=0.4)
        monitor(build, place * spot(-0.1, 0.2, float(rng.uniform(-20, 20)), z=0.745), _picture(build, rng))
        sheet = build.texture(notice(rng, (110, 80)))
        for x, y in ((0.45, 0.36), (-0.5, 0.4)):
            turn = float(rng.uniform(-25, 25))
            build.box(place * spot(x, y, turn, z=0.75), [0, 0, 0], [0.21, 0.3, 0.01], top, sides={4: sheet})
        build.block(place * spot(0.0, 0.31), (1.4, 0.62))


def _picture(build: Builder, rng: np.random.Generator) -> int:
    return build.texture(readout(rng, (180, 300)))


def stool(build: Builder, place: Pose) -> None:
    """Stand a round stool on castors."""
    metal = tone(build, STEEL)
    with build.thing("stool", place):
        pillar(build, place, 0.18, (0.5, 0.58), tone(build, (40, 44, 52)))
        solids(build, place, [((0, 0, 0.28), (0.05, 0.05, 0.44))], metal)
        solids(build, place, [((0, 0, 0.05), (0.46, 0.05, 0.04)), ((0, 0, 0.052), (0.05, 0.46, 0.04))], metal)
        build.block(place, (0.44, 0.44))


def trolley(build: Builder, rng: np.random.Generator, place: Pose) -> None:
    """Stand a drawer trolley with boxes on top."""
    face = build.shared("trolley", _trolley_face)
    with build.thing("trolley", place):
        build.box(place, [0, 0, 0.5], [0.6, 0.42, 0.8], tone(build, WHITE), sides={2: face, 3: face}, cell_m=0.3)
        solids(build, place, legs((0.56, 0.4), 0.1, thick_m=0.05), tone(build, (50, 52, 56)))
        for x in (-0.18, 0.08):
            tall = float(rng.uniform(0.06, 0.2))
            label = build.texture(notice(rng, (70, 80)))
            centre, size = [x, 0.0, 0.9 + tall / 2], [0.2, 0.16, tall]
            build.box(place, centre, size, tone(build, STEEL), sides={2: label, 3: label}, cell_m=COARSE_M)
        build.block(place, (0.62, 0.46))


def _trolley_face() -> Rgb:
    image = np.empty((100, 75, 3), np.uint8)
    image[:] = (86, 120, 150)
    for row in range(4):
        image[25 * row : 25 * row + 2] = (54, 74, 94)
        image[25 * row + 9 : 25 * row + 13, 24:51] = (200, 204, 208)
    return image


def drip_stand(build: Builder, place: Pose) -> None:
    """Stand a drip stand."""
    metal = tone(build, STEEL)
    with build.thing("drip stand", place):
        solids(build, place, [((0, 0, 0.05), (0.5, 0.05, 0.04)), ((0, 0, 0.052), (0.05, 0.5, 0.04))], metal)
        solids(build, place, [((0, 0, 0.95), (0.03, 0.03, 1.8)), ((0, 0, 1.86), (0.3, 0.02, 0.02))], metal)
        build.box(place, [0.12, 0, 1.68], [0.12, 0.04, 0.22], tone(build, (214, 220, 214)), cell_m=COARSE_M)
        build.block(place, (0.46, 0.46))


def vital_signs(build: Builder, rng: np.random.Generator, wall_place: Pose) -> None:
    """Hang a monitor with traces on a wall."""
    place = wall_place * spot(0.0, 0.12, z=1.35)
    with build.thing("monitor", place, kind="picture"):
        build.box(place, [0, -0.06, 0.15], [0.06, 0.12, 0.06], tone(build, STEEL), cell_m=COARSE_M, solid=False)
        build.box(place, [0, 0.02, 0.15], [0.43, 0.04, 0.31], tone(build, (52, 54, 60)), cell_m=COARSE_M, solid=False)
        face = on_wall(place, 0.0, 0.15, off_m=0.0405)
        build.panel(face, (0.39, 0.27), build.texture(readout(rng, (150, 216))), solid=False, glow=0.9)


def counter(build: Builder, rng: np.random.Generator, place: Pose, *, length_m: float) -> None:
    """Stand a reception counter along x, its plain front towards +y, a lower desk behind, two monitors."""
    front, top = tone(build, BEECH), tone(build, WHITE)
    with build.thing("counter", place, kind="fixed"):
        build.box(place, [0, 0, 0.55], [length_m, 0.12, 1.1], front, cell_m=0.25)
        build.box(place, [0, 0, 1.115], [length_m + 0.04, 0.3, 0.03], top, cell_m=0.3)
        build.box(place, [0, -0.4, 0.73], [length_m, 0.68, 0.03], top, cell_m=0.3)
        for x in (-length_m / 2 + 0.02, length_m / 2 - 0.02):
            build.box(place, [x, -0.4, 0.36], [0.04, 0.66, 0.7], front, cell_m=0.4)
        for x in (-0.25 * length_m, 0.22 * length_m):
            monitor(build, place * spot(x, -0.3, 180.0, z=0.745), _picture(build, rng))
        for x in rng.uniform(-0.4, 0.4, 2) * length_m:
            leaflet = build.texture(cover(rng, (80, 60)))
            build.box(place * spot(float(x), 0.0, z=1.2), [0, 0, 0], [0.17, 0.08, 0.14], top, front=leaflet)
        build.block(place * spot(0.0, -0.3), (length_m + 0.04, 0.9))


def leaflet_rack(build: Builder, rng: np.random.Generator, wall_place: Pose) -> None:
    """Hang a rack of leaflets on a wall, four by four, some pockets empty."""
    with build.thing("leaflet rack", wall_place, kind="fixed"):
        build.box(wall_place, [0, 0.02, 1.4], [0.72, 0.03, 1.0], tone(build, (196, 200, 204)), solid=False)
        for row in range(4):
            for col in range(4):
                if rng.random() < 0.8:
                    sheet = build.texture(cover(rng, (76, 52)))
                    centre = [(col - 1.5) * 0.17, 0.05, 1.03 + 0.24 * row]
                    build.box(wall_place, centre, [0.14, 0.02, 0.21], tone(build, WHITE), front=sheet, solid=False)


def low_table(build: Builder, rng: np.random.Generator, place: Pose) -> None:
    """Stand a low table with magazines."""
    with build.thing("low table", place):
        build.box(place, [0, 0, 0.4], [0.8, 0.55, 0.03], tone(build, BEECH), cell_m=0.25)
        solids(build, place, legs((0.8, 0.55), 0.385, thick_m=0.05), tone(build, STEEL))
        for x in (-0.26, 0.0, 0.26):
            sheet = build.texture(cover(rng, (90, 68)))
            lying = place * spot(x, float(rng.uniform(-0.08, 0.08)), float(rng.uniform(-40, 40)), z=0.42)
            build.box(lying, [0, 0, 0], [0.2, 0.27, 0.008], tone(build, WHITE), sides={4: sheet}, cell_m=COARSE_M)
        build.block(place, (0.8, 0.55))


def pedal_bin(build: Builder, place: Pose) -> None:
    """Stand a pedal bin."""
    with build.thing("bin", place):
        pillar(build, place, 0.15, (0.0, 0.5), tone(build, (180, 184, 186)))
        build.block(place, (0.3, 0.3))
