"""Furniture of the school: desks and chairs, lockers, blackboards, coats on hooks, shelves, map stands, easels."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from fieldkit.frames import Pose
from sim_bridge.scenes.blueprint import Builder
from sim_bridge.scenes.heldout_charts import chalked, land_map
from sim_bridge.scenes.heldout_parts import COARSE_M, Solid, Tone, legs, monitor, pillar, solids, spot, tone
from sim_bridge.scenes.heldout_prints import cover, ink, notice, spines
from sim_bridge.scenes.heldout_surfaces import Rgb, veneer
from sim_bridge.scenes.plan import on_wall

TUBE: Tone = (70, 76, 84)
MAPLE: Tone = (206, 180, 140)
LOCKER: Tone = (86, 116, 138)
PINE: Tone = (190, 154, 108)


def maple(build: Builder) -> int:
    """Return the veneer of desk tops and shelves."""
    return build.shared("maple", lambda: veneer(np.random.default_rng(41), (160, 220), base=MAPLE, upright=False))


def pupil_desk(build: Builder, rng: np.random.Generator, place: Pose, *, used: bool) -> None:
    """Stand a desk for two; pupils sit at -y and look towards +y. On a used one lie books and paper."""
    tube = tone(build, TUBE)
    with build.thing("pupil desk", place):
        build.box(place, [0, 0, 0.7], [1.3, 0.52, 0.025], maple(build), cell_m=0.22)
        build.box(place, [0, 0.2, 0.52], [1.2, 0.015, 0.28], tone(build, (150, 154, 150)), cell_m=0.4)
        solids(build, place, legs((1.28, 0.5), 0.685, thick_m=0.03), tube)
        feet: list[Solid] = [((s * 0.625, 0, 0.1), (0.03, 0.44, 0.03)) for s in (-1, 1)]
        solids(build, place, feet, tube)
        for x in (-0.32, 0.34) if used else ():
            sheet = build.texture((cover if rng.random() < 0.6 else notice)(rng, (86, 64)))
            lying = place * spot(x, float(rng.uniform(-0.1, 0.1)), float(rng.uniform(-30, 30)), z=0.722)
            thick = float(rng.uniform(0.008, 0.04))
            edge = tone(build, (232, 228, 216))
            build.box(lying, [0, 0, thick / 2], [0.21, 0.29, thick], edge, sides={4: sheet}, cell_m=COARSE_M)
        build.block(place, (1.3, 0.52))


def pupil_chair(build: Builder, place: Pose) -> None:
    """Stand a chair of bent tube with a shell; one sits facing +y."""
    shell, tube = tone(build, (176, 62, 48)), tone(build, TUBE)
    with build.thing("pupil chair", place):
        build.box(place, [0, 0, 0.43], [0.4, 0.38, 0.025], shell, cell_m=COARSE_M)
        back = place * Pose.from_components([0.0, -0.2, 0.68], Rotation.from_euler("x", 9, degrees=True))
        build.box(back, [0, 0, 0], [0.4, 0.02, 0.26], shell, cell_m=COARSE_M)
        solids(build, place, legs((0.38, 0.36), 0.418, thick_m=0.022), tube)
        posts: list[Solid] = [((s * 0.17, -0.19, 0.5), (0.02, 0.02, 0.12)) for s in (-1, 1)]
        solids(build, place, posts, tube)
        build.block(place, (0.4, 0.42))


def teachers_desk(build: Builder, rng: np.random.Generator, place: Pose) -> None:
    """Stand the teacher's desk; the teacher sits at -y, the plain front is towards the class (+y)."""
    with build.thing("teacher's desk", place, kind="fixed"):
        build.box(place, [0, 0, 0.74], [1.5, 0.68, 0.03], maple(build), cell_m=0.22)
        build.box(place, [0, 0.3, 0.37], [1.44, 0.02, 0.7], tone(build, PINE), cell_m=0.3)
        for x in (-0.55, 0.55):
            build.box(place, [x, -0.02, 0.37], [0.34, 0.6, 0.7], tone(build, PINE), cell_m=0.4)
        monitor(build, place * spot(0.42, 0.05, 170.0, z=0.755), build.texture(notice(rng, (180, 300))))
        for _ in range(3):
            sheet = build.texture(cover(rng, (90, 66)))
            lying = place * spot(float(rng.uniform(-0.6, 0.1)), float(rng.uniform(-0.2, 0.2)), z=0.756)
            turned = lying * spot(0, 0, float(rng.uniform(-40, 40)))
            build.box(turned, [0, 0, 0.012], [0.2, 0.28, 0.024], tone(build, MAPLE), sides={4: sheet}, cell_m=COARSE_M)
        build.block(place, (1.5, 0.68))


def blackboard(build: Builder, rng: np.random.Generator, wall_place: Pose, *, width_m: float) -> None:
    """Hang a blackboard with two wings on a wall; what is written on it changes."""
    place = wall_place * spot(0.0, 0.0, z=1.5)
    for x, share in ((0.0, 0.5), (-0.375, 0.25), (0.375, 0.25)):
        wing = place * spot(x * width_m, 0.03)
        with build.thing("blackboard", wing, kind="picture"):
            size = (round(1.15 * 240), round(share * width_m * 240))
            board = build.texture(chalked(rng, size))
            part = [share * width_m - 0.02, 0.04, 1.15]
            build.box(wing, [0, 0, 0], part, tone(build, (150, 152, 148)), front=board, cell_m=0.4, solid=False)
    ledge = tone(build, (150, 152, 148))
    build.box(place, [0, 0.1, -0.6], [0.5 * width_m, 0.12, 0.03], ledge, cell_m=COARSE_M, solid=False)


def lockers(build: Builder, wall_place: Pose, *, units: int) -> None:
    """Stand steel lockers along a wall, all with the same two doors."""
    face = build.shared("locker", _locker_face)
    width = 0.4 * units
    with build.thing("lockers", wall_place, kind="fixed"):
        for x in (np.arange(units) + 0.5 - units / 2) * 0.4:
            build.box(wall_place, [x, 0.22, 0.97], [0.395, 0.42, 1.74], tone(build, LOCKER), front=face, cell_m=0.25)
        build.box(wall_place, [0, 0.2, 0.05], [width, 0.36, 0.1], tone(build, TUBE), cell_m=0.5)
        build.block(wall_place * spot(0.0, 0.22), (width, 0.44))


def _locker_face() -> Rgb:
    image = np.empty((226, 52, 3), np.uint8)
    image[:] = LOCKER
    for top in (0, 113):
        image[top : top + 2], image[top : top + 113, :1], image[top : top + 113, -1:] = (50,) * 3, (50,) * 3, (50,) * 3
        for slit in range(4):
            image[top + 14 + 6 * slit : top + 17 + 6 * slit, 16:38] = (58, 80, 96)
        image[top + 54 : top + 66, 41:46] = (196, 200, 204)
        image[top + 36 : top + 44, 18:34] = (222, 220, 208)
    return image


def coat_hooks(build: Builder, rng: np.random.Generator, wall_place: Pose, *, length_m: float, coats: int) -> None:
    """Fix a board of hooks on a wall over a bench, with coats and bags on some of them."""
    pine, count = tone(build, PINE), round(length_m / 0.25)
    with build.thing("wardrobe", wall_place, kind="fixed"):
        build.box(wall_place, [0, 0.02, 1.5], [length_m, 0.03, 0.14], pine, cell_m=0.5, solid=False)
        build.box(wall_place, [0, 0.12, 1.72], [length_m, 0.24, 0.025], pine, cell_m=0.4)
        build.box(wall_place, [0, 0.18, 0.4], [length_m, 0.32, 0.04], pine, cell_m=0.3)
        for x in (-length_m / 2 + 0.1, 0.0, length_m / 2 - 0.1):
            build.box(wall_place, [x, 0.18, 0.19], [0.05, 0.28, 0.38], tone(build, TUBE), cell_m=COARSE_M)
        hooks = (np.arange(count) + 0.5 - count / 2) * 0.25
        for x in hooks:
            build.box(wall_place, [x, 0.06, 1.47], [0.02, 0.06, 0.02], tone(build, TUBE), cell_m=COARSE_M, solid=False)
        build.block(wall_place * spot(0.0, 0.18), (length_m, 0.36))
    for x in rng.choice(hooks, coats, replace=False):
        _coat(build, rng, wall_place * spot(float(x), 0.0))


def _coat(build: Builder, rng: np.random.Generator, wall_place: Pose) -> None:
    rgb = ink(rng, saturation=0.6, value=0.5)
    with build.thing("coat", wall_place, kind="fixed"):
        cloth, length = tone(build, rgb), float(rng.uniform(0.6, 0.85))
        build.box(wall_place, [0, 0.1, 1.44 - length / 2], [0.24, 0.1, length], cloth, cell_m=0.3, solid=False)
        for side in (-1, 1):
            sleeve = Pose.from_components([0.14 * side, 0.1, 1.14], Rotation.from_euler("y", -6 * side, degrees=True))
            build.box(wall_place * sleeve, [0, 0, 0], [0.07, 0.08, 0.5], cloth, cell_m=COARSE_M, solid=False)
        trim = tone(build, ink(rng, saturation=0.4, value=0.85))
        height = 1.44 - float(rng.uniform(0.2, 0.45))
        build.box(wall_place, [0, 0.1, height], [0.245, 0.105, 0.05], trim, cell_m=COARSE_M, solid=False)


def low_shelf(build: Builder, rng: np.random.Generator, wall_place: Pose, *, bays: int) -> None:
    """Stand a low shelf with exercise books and boxes against a wall."""
    width = 0.8 * bays
    with build.thing("low shelf", wall_place, kind="fixed"):
        solids(build, wall_place, [((0, 0.17, z), (width, 0.34, 0.025)) for z in (0.06, 0.46, 0.86)], maple(build))
        ends = [((x, 0.17, 0.44), (0.025, 0.335, 0.86)) for x in (np.arange(bays + 1) - bays / 2) * 0.8]
        solids(build, wall_place, [((float(c[0]), c[1], c[2]), size) for c, size in ends], maple(build), cell_m=0.4)
        back = tone(build, (150, 130, 100))
        build.box(wall_place, [0, 0.01, 0.44], [width - 0.03, 0.01, 0.84], back, cell_m=0.5)
        for bay in range(bays):
            for up in (0.075, 0.475):
                if rng.random() < 0.2:
                    continue
                row = build.texture(spines(rng, (90, 220), series=bool(rng.random() < 0.4), full=0.9))
                x = (bay + 0.5 - bays / 2) * 0.8
                build.panel(on_wall(wall_place, x, up + 0.15, off_m=0.26), (0.74, 0.3), row, cell_m=0.4)
        build.block(wall_place * spot(0.0, 0.17), (width, 0.35))


def map_stand(build: Builder, rng: np.random.Generator, place: Pose) -> None:
    """Stand a wall map that hangs from a tripod."""
    with build.thing("map stand", place):
        metal = tone(build, TUBE)
        solids(build, place, [((0, -0.04, 1.05), (0.03, 0.03, 2.1)), ((0, -0.02, 2.08), (1.3, 0.03, 0.03))], metal)
        solids(build, place, [((0, -0.04, 0.02), (0.6, 0.04, 0.03)), ((0, -0.04, 0.022), (0.04, 0.5, 0.03))], metal)
        picture = build.texture(land_map(rng, (360, 400)))
        build.box(place, [0, 0, 1.5], [1.25, 0.012, 1.12], tone(build, (216, 206, 180)), front=picture, cell_m=0.4)
        build.block(place, (1.25, 0.3))


def globe(build: Builder, rng: np.random.Generator, place: Pose) -> None:
    """Put a globe on what it stands on: three rings of a sphere around an axis."""
    with build.thing("globe", place, kind="fixed"):
        picture = build.texture(land_map(rng, (90, 260)))
        solids(build, place, [((0, 0, 0.05), (0.14, 0.14, 0.1))], tone(build, TUBE))
        for radius, low, high in ((0.11, 0.1, 0.15), (0.16, 0.15, 0.31), (0.11, 0.31, 0.36)):
            pillar(build, place, radius, (low, high), picture, sides=10)


def easel(build: Builder, rng: np.random.Generator, place: Pose, picture: Rgb) -> None:
    """Stand an easel with a picture towards +y."""
    wood, tilt = tone(build, PINE), Rotation.from_euler("x", 8, degrees=True)
    board = place * Pose.from_components([0.0, 0.06, 0.0], tilt)
    with build.thing("easel", place):
        posts: list[Solid] = [((x, -0.05, 0.915), (0.035, 0.035, 1.8)) for x in (-0.25, 0.25)]
        posts += [((0, -0.03, 0.75), (0.7, 0.05, 0.03))]
        solids(build, board, posts, wood)
        rear = place * Pose.from_components([0.0, -0.5, 0.0], Rotation.from_euler("x", -10, degrees=True))
        solids(build, rear, [((0, 0, 0.81), (0.035, 0.035, 1.6))], wood)
        edge = tone(build, (238, 236, 228))
        build.box(board, [0, 0, 1.2], [0.66, 0.02, 0.86], edge, front=build.texture(picture), cell_m=0.4)
        build.block(place * spot(0.0, -0.2), (0.72, 0.76))


def work_table(build: Builder, rng: np.random.Generator, place: Pose, *, jars: int) -> None:
    """Stand a large table with pots of paint and jars."""
    with build.thing("work table", place, kind="fixed"):
        build.box(place, [0, 0, 0.74], [1.8, 1.0, 0.04], tone(build, (196, 190, 178)), cell_m=0.22)
        solids(build, place, legs((1.76, 0.96), 0.72, thick_m=0.07), tone(build, PINE))
        for _ in range(jars):
            at = place * spot(float(rng.uniform(-0.75, 0.75)), float(rng.uniform(-0.4, 0.4)), z=0.76)
            tall = float(rng.uniform(0.08, 0.2))
            pillar(build, at, float(rng.uniform(0.03, 0.06)), (0.0, tall), tone(build, ink(rng)), sides=6)
        build.block(place, (1.8, 1.0))


def tall_cabinet(build: Builder, wall_place: Pose) -> None:
    """Stand a plain cabinet of two doors against a wall."""
    face = build.shared("cabinet", _cabinet_face)
    with build.thing("cabinet", wall_place, kind="fixed"):
        build.box(wall_place, [0, 0.23, 0.95], [1.0, 0.44, 1.9], tone(build, MAPLE), front=face, cell_m=0.3)
        build.block(wall_place * spot(0.0, 0.23), (1.0, 0.46))


def _cabinet_face() -> Rgb:
    image = np.empty((190, 100, 3), np.uint8)
    image[:] = MAPLE
    image[:, 49:51] = image[:1] = image[-1:] = (140, 116, 84)
    image[88:102, 44:46] = image[88:102, 54:56] = (80, 80, 84)
    return image
