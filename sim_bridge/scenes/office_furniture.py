"""Furniture of the office. Each piece stands in a frame with z up; against a wall, the wall is y = 0 and +y the room.

All desks, chairs, screens and cupboards of a scene are of one make: they share their textures.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from fieldkit.frames import Pose, yaw_pose
from sim_bridge.scenes import office_prints, textures
from sim_bridge.scenes.blueprint import Builder, Kind
from sim_bridge.scenes.plan import on_wall
from sim_bridge.scenes.textures import Rgb

DESK_M = (1.6, 0.8)
DESK_TOP_M = 0.74
_PRINT_PX_PER_M = 240


@dataclasses.dataclass(frozen=True)
class Style:
    """The make of the furniture: colours of wood, cloth, screens' cloth, metal and cupboards, as texture numbers."""

    board: int
    cloth: int
    screen: int
    metal: int
    dark: int
    white: int
    cupboard: tuple[int, int, int]


def style(build: Builder, rng: np.random.Generator) -> Style:
    """Choose a make and add its textures."""
    board = np.array(((214, 200, 176), (226, 224, 218), (188, 158, 122))[int(rng.integers(3))]) + rng.normal(0, 4, 3)
    cloth = np.array(((52, 62, 84), (84, 50, 46), (56, 70, 58), (60, 60, 64))[int(rng.integers(4))])
    screen = np.array(((138, 146, 154), (150, 140, 126), (122, 138, 130))[int(rng.integers(3))])
    tone = np.array(((206, 206, 204), (196, 190, 178), (178, 184, 188))[int(rng.integers(3))])
    return Style(
        board=build.texture(office_prints.laminate(rng, (240, 480), base=board)),
        cloth=build.texture(office_prints.fabric(rng, (96, 96), base=cloth)),
        screen=build.texture(office_prints.fabric(rng, (320, 400), base=screen)),
        metal=build.plain((122, 124, 128)),
        dark=build.plain((34, 34, 37)),
        white=build.plain((226, 226, 224)),
        cupboard=(int(tone[0]), int(tone[1]), int(tone[2])),
    )


def moved(place: Pose, x: float = 0.0, y: float = 0.0, z: float = 0.0, *, yaw_rad: float = 0.0) -> Pose:
    """Return a frame moved and turned within a place."""
    return place * yaw_pose([x, y, z], yaw_rad)


def hang(
    build: Builder,
    at: Pose,
    size_m: tuple[float, float],
    image: Rgb | int,
    *,
    name: str = "poster",
    frame: ArrayLike = (60, 60, 62),
    kind: Kind = "picture",
) -> None:
    """Hang a picture of (width, height) whose back is at z = 0 of a pose (x right, y up, z into the room)."""
    texture = image if isinstance(image, int) else build.texture(image)
    r, g, b = (int(v) for v in np.clip(np.asarray(frame), 0, 255))
    rim = build.shared(("rim", r, g, b), lambda: np.full((1, 1, 3), (r, g, b), np.uint8))
    with build.thing(name, at, kind=kind):
        build.box(at, [0.0, 0.0, 0.008], [size_m[0] + 0.024, size_m[1] + 0.024, 0.014], rim, solid=False)
        front = at * Pose.from_components([0.0, 0.0, 0.0165], Rotation.identity())
        build.panel(front, size_m, texture, solid=False)


def gallery(
    build: Builder,
    rng: np.random.Generator,
    face: Callable[[float], Pose],
    spans: Sequence[tuple[float, float]],
    *,
    share: float,
    up_m: float = 1.5,
) -> None:
    """Hang prints side by side on stretches of a wall, so that they cover a share of its length.

    ``face`` gives the wall's frame at a distance from its start; the prints' middles are about ``up_m`` high, and
    some have a smaller one below.
    """
    for start, stop in spans:
        at = start + float(rng.uniform(0.0, 0.3))
        while True:
            width = float(rng.uniform(0.5, 1.0))
            width = min(width, stop - at - 0.06)
            if width < 0.3:
                break
            height = min(width * float(rng.uniform(0.8, 1.4)), 1.15)
            middle = up_m + float(rng.uniform(-0.08, 0.1))
            place = face(at + width / 2)
            hang(build, on_wall(place, 0.0, middle, off_m=0.0), (width, height), _print(rng, (width, height)))
            below = middle - height / 2 - 0.08
            if rng.random() < 0.35 and below > 0.75:
                small = (min(width, 0.55), min(0.42, below - 0.4))
                low = on_wall(place, 0.0, below - small[1] / 2, off_m=0.0)
                hang(build, low, small, _print(rng, small))
            at += width + max(0.08, width * (1.0 - share) / share * float(rng.uniform(0.4, 1.6)))


def _print(rng: np.random.Generator, size_m: tuple[float, float]) -> Rgb:
    return office_prints.printed(rng, px(size_m))


def px(size_m: tuple[float, float], *, px_per_m: float = _PRINT_PX_PER_M) -> tuple[int, int]:
    """Return (height, width) in pixels of a print of (width, height) in m."""
    return max(round(size_m[1] * px_per_m), 8), max(round(size_m[0] * px_per_m), 8)


def desk(build: Builder, look: Style, place: Pose) -> None:
    """Add a desk of 1.6 x 0.8 m with a drawer unit; one sits at +y."""
    w, d = DESK_M
    with build.thing("desk", place, kind="fixed"):
        build.box(place, [0.0, d / 2, DESK_TOP_M - 0.015], [w - 0.01, d - 0.02, 0.03], look.board, cell_m=0.2)
        for side in (-1, 1):
            build.box(place, [side * (w / 2 - 0.04), d / 2, 0.355], [0.03, d - 0.14, 0.709], look.board)
        build.box(place, [0.0, 0.1, 0.47], [w - 0.12, 0.02, 0.47], look.board)
        front = build.shared(
            "pedestal",
            lambda: office_prints.fronts((200, 150), base=look.cupboard, cols=1, rows=3, px_per_m=360),
        )
        side = build.shared("pedestal side", lambda: np.full((1, 1, 3), look.cupboard, np.uint8))
        build.box(place, [w / 2 - 0.29, 0.42, 0.3], [0.42, 0.56, 0.56], side, front=front)
        build.block(moved(place, y=d / 2), (w, d))


def chair(build: Builder, look: Style, place: Pose) -> None:
    """Add a swivel chair whose back is at +y."""
    with build.thing("chair", place):
        build.box(place, [0.0, 0.0, 0.46], [0.48, 0.46, 0.07], look.cloth, cell_m=0.2)
        build.box(place, [0.0, 0.235, 0.8], [0.44, 0.05, 0.52], look.cloth, cell_m=0.2)
        build.box(place, [0.0, 0.2, 0.52], [0.07, 0.03, 0.24], look.dark)
        build.box(place, [0.0, 0.0, 0.25], [0.06, 0.06, 0.36], look.metal)
        for yaw in (0.0, np.pi / 3, 2 * np.pi / 3):
            build.box(moved(place, yaw_rad=yaw), [0.0, 0.0, 0.05 + 0.002 * yaw], [0.56, 0.05, 0.04], look.dark)
        for side in (-1, 1):
            build.box(place, [side * 0.26, 0.02, 0.66], [0.05, 0.26, 0.03], look.dark)
            build.box(place, [side * 0.26, 0.06, 0.56], [0.03, 0.03, 0.18], look.dark)
        build.block(place, (0.54, 0.54))


def seat(build: Builder, look: Style, place: Pose) -> None:
    """Add a simple chair on four legs whose back is at +y."""
    with build.thing("seat", place):
        build.box(place, [0.0, 0.0, 0.45], [0.43, 0.43, 0.03], look.cloth, cell_m=0.2)
        build.box(place, [0.0, 0.205, 0.73], [0.41, 0.025, 0.3], look.cloth, cell_m=0.2)
        for sx in (-1, 1):
            build.box(place, [sx * 0.19, 0.2, 0.3], [0.025, 0.025, 0.6], look.metal)
            build.box(place, [sx * 0.19, -0.19, 0.217], [0.025, 0.025, 0.434], look.metal)
        build.block(place, (0.44, 0.46))


def monitor(build: Builder, look: Style, place: Pose, image: int) -> None:
    """Add a screen of 0.56 x 0.33 m on its stand, which faces +y."""
    with build.thing("screen", place, kind="picture"):
        build.box(place, [0.0, 0.0, 0.008], [0.24, 0.18, 0.016], look.dark)
        build.box(place, [0.0, -0.03, 0.13], [0.05, 0.03, 0.24], look.dark)
        build.box(place, [0.0, 0.0, 0.36], [0.57, 0.035, 0.34], look.dark)
        build.panel(on_wall(place, 0.0, 0.36, off_m=0.0185), (0.555, 0.325), image, solid=False)


def screen_image(build: Builder, rng: np.random.Generator) -> int:
    """Return what a screen shows: nothing, the common login, or someone's work."""
    kind = rng.random()
    if kind < 0.2:
        return build.shared("screen off", lambda: np.full((1, 1, 3), (20, 21, 24), np.uint8))
    if kind < 0.4:
        return build.shared("login", lambda: office_prints.login((150, 260)))
    return build.texture(textures.screen(rng, (180, 300)))


def workplace(build: Builder, rng: np.random.Generator, look: Style, place: Pose, *, pinned: bool = False) -> None:
    """Add a desk with a screen, a keyboard, a chair and someone's things; ``pinned`` prints hang behind it."""
    desk(build, look, place)
    x = float(rng.uniform(-0.25, 0.05))
    top = DESK_TOP_M
    monitor(build, look, moved(place, x, 0.22, top, yaw_rad=float(rng.normal(0, 0.08))), screen_image(build, rng))
    keys = build.shared("keyboard", lambda: office_prints.keyboard((60, 180)))
    at = moved(place, x, 0.5, top, yaw_rad=float(rng.normal(0, 0.05)))
    with build.thing("keyboard", at):
        build.box(at, [0.0, 0.0, 0.01], [0.43, 0.14, 0.02], look.dark, sides={4: keys}, solid=False)
    litter(build, rng, moved(place, y=0.4), (1.5, 0.7), up_m=top, count=int(rng.choice([1, 2, 3, 4, 6])))
    if pinned:
        for side in (-1, 1):
            if rng.random() < 0.75:
                size = (float(rng.uniform(0.3, 0.5)), float(rng.uniform(0.28, 0.38)))
                along = float(np.clip(x + side * 0.48, -0.54, 0.54))
                spot = on_wall(place, along, 0.97, off_m=-0.01)
                hang(build, spot, size, office_prints.printed(rng, px(size)), name="pinned")
    back = moved(place, float(rng.normal(0, 0.1)), 0.8, yaw_rad=float(rng.normal(0, 0.3)))
    chair(build, look, back)


def litter(
    build: Builder, rng: np.random.Generator, place: Pose, size: tuple[float, float], *, up_m: float, count: int
) -> None:
    """Strew papers, books and mugs over a surface centred on a place."""
    for i in range(count):
        x, y = rng.uniform(-0.5, 0.5, 2) * (np.asarray(size) - 0.36)
        at = moved(place, float(x), float(y), up_m + 0.001 * (i + 1), yaw_rad=float(rng.uniform(-np.pi, np.pi)))
        kind = rng.random()
        if kind < 0.4:
            with build.thing("sheet", at):
                build.panel(at, (0.21, 0.297), build.texture(textures.page(rng, (130, 92))), solid=False)
        elif kind < 0.75:
            thick = float(rng.uniform(0.02, 0.06))
            cover = build.texture(textures.shapes(rng, (96, 70)))
            with build.thing("book", at):
                page = build.shared("pages", lambda: np.full((1, 1, 3), (222, 216, 200), np.uint8))
                build.box(at, [0.0, 0.0, thick / 2], [0.17, 0.24, thick], page, sides={4: cover})
        else:
            mug = build.plain(textures.colour(rng))
            with build.thing("mug", at):
                build.box(at, [0.0, 0.0, 0.05], [0.075, 0.075, 0.1], mug, solid=False)


def bench(build: Builder, rng: np.random.Generator, look: Style, place: Pose, *, desks: int) -> None:
    """Add desks in two rows face to face along x, with cloth screens between them and at both ends."""
    w, d = DESK_M
    length = desks * w
    with build.thing("partition", place, kind="fixed"):
        build.box(place, [0.0, 0.0, 0.64], [length, 0.04, 1.08], look.screen)
        for side in (-1, 1):
            build.box(place, [side * (length / 2 + 0.03), 0.0, 0.65], [0.05, 2 * d + 0.04, 1.22], look.screen)
            build.box(place, [side * (length / 2 + 0.03), 0.0, 1.27], [0.055, 2 * d + 0.05, 0.02], look.metal)
        build.block(place, (length + 0.12, 0.1))
        for side in (-1, 1):
            build.block(moved(place, side * (length / 2 + 0.03)), (0.06, 2 * d + 0.05))
    for yaw in (0.0, np.pi):
        for i in range(desks):
            at = moved(moved(place, yaw_rad=yaw), (i - (desks - 1) / 2) * w, 0.03)
            workplace(build, rng, look, at, pinned=True)


def cupboard(build: Builder, look: Style, place: Pose, *, width_m: float = 0.9, height_m: float = 2.0) -> None:
    """Add a plain cupboard of two doors, 0.45 m deep."""
    depth = 0.45
    key = ("cupboard", width_m, height_m)
    front = build.shared(
        key,
        lambda: office_prints.fronts(
            px((width_m, height_m), px_per_m=240), base=look.cupboard, cols=2, rows=1, px_per_m=240
        ),
    )
    side = build.shared("cupboard side", lambda: np.full((1, 1, 3), np.asarray(look.cupboard) - 6, np.uint8))
    with build.thing("cupboard", place, kind="fixed"):
        build.box(place, [0.0, depth / 2, height_m / 2], [width_m - 0.004, depth, height_m], side, front=front)
        build.block(moved(place, y=depth / 2), (width_m, depth))


def bookcase(build: Builder, rng: np.random.Generator, look: Style, place: Pose, *, width_m: float = 0.9) -> None:
    """Add an open shelf of 1.9 m with rows of folders, of which there are only three sorts, and one row of books."""
    height, depth, board, rows = 1.9, 0.36, 0.025, 5
    step, books = (height - board) / rows, int(rng.integers(2, 5))
    with build.thing("bookcase", place, kind="fixed"):
        for side in (-1, 1):
            build.box(place, [side * (width_m - board) / 2, depth / 2, height / 2], [board, depth, height], look.board)
        build.box(place, [0.0, 0.01, height / 2], [width_m - 2 * board, 0.02, height - 0.01], look.board)
        for i in range(rows + 1):
            z = board / 2 + i * step
            build.box(place, [0.0, depth / 2, z], [width_m - 2 * board, depth - 0.004, board], look.board)
            if i == rows:
                break
            share = float(rng.choice([0.55, 0.8, 1.0]))
            sort = int(rng.integers(3))
            if i == books:
                row = build.texture(office_prints.binders(rng, (110, 300), count=int(rng.integers(15, 22))))
            else:
                row = build.shared(("folders", sort), lambda: office_prints.binders(rng, (110, 300), count=11))
            wide = share * (width_m - 2 * board - 0.02)
            x = -(width_m - 2 * board - 0.02 - wide) / 2
            top = look.dark
            build.box(place, [x, 0.16, z + 0.17], [wide, 0.27, 0.315], top, front=row)
        build.block(moved(place, y=depth / 2), (width_m, depth))


def plant(build: Builder, rng: np.random.Generator, place: Pose, *, height_m: float = 1.3) -> None:
    """Add a plant in a tub: long leaves that rise and bend outwards."""
    pot = build.shared("pot", lambda: np.full((1, 1, 3), (92, 86, 80), np.uint8))
    greens = [
        build.shared(("leaf", i), lambda i=i: np.full((1, 1, 3), (48 + 14 * i, 84 + 18 * i, 42 + 8 * i), np.uint8))  # type: ignore[misc]
        for i in range(3)
    ]
    with build.thing("plant", place):
        build.box(place, [0.0, 0.0, 0.17], [0.34, 0.34, 0.34], pot)
        for _ in range(26):
            yaw, lean = float(rng.uniform(0, 2 * np.pi)), float(rng.uniform(0.05, 0.36))
            length = (height_m - 0.34) * float(rng.uniform(0.55, 1.0))
            turn = Rotation.from_euler("ZX", [yaw, -lean]) * Rotation.from_euler("x", np.pi / 2)
            middle = np.array([0.0, 0.0, 0.33]) + turn.apply([0.0, length / 2, 0.0])
            leaf = place * Pose.from_components(middle, turn)
            build.panel(leaf, (0.07, length), greens[int(rng.integers(3))], solid=False)
        build.block(place, (0.62, 0.62))


def hanging_sign(build: Builder, rng: np.random.Generator, place: Pose, *, ceiling_m: float) -> None:
    """Hang a sign of 1.2 x 0.35 m from the ceiling, written on both sides, which faces +y."""
    size = (1.2, 0.35)
    up = ceiling_m - 0.3
    with build.thing("hanging sign", place, kind="picture"):
        rim = build.shared("sign rim", lambda: np.full((1, 1, 3), (48, 50, 54), np.uint8))
        build.box(place, [0.0, 0.0, up], [size[0] + 0.02, 0.02, size[1] + 0.02], rim, solid=False)
        for x in (-0.5, 0.5):
            build.box(place, [x, 0.0, ceiling_m - 0.06], [0.012, 0.012, 0.12], rim, solid=False)
        base = textures.colour(rng, low=40, high=140)
        for yaw in (0.0, np.pi):
            letters = "".join(rng.choice(list("ABCDEFGHKLMNPRSTUVW"), 7))
            image = build.texture(office_prints.sign(rng, px(size), text=letters, base=base))
            build.panel(on_wall(moved(place, yaw_rad=yaw), 0.0, up, off_m=0.012), size, image, solid=False)


def bin_(build: Builder, place: Pose) -> None:
    """Add a waste-paper bin."""
    grey = build.shared("bin", lambda: np.full((1, 1, 3), (74, 76, 80), np.uint8))
    with build.thing("bin", place):
        build.box(place, [0.0, 0.0, 0.16], [0.25, 0.25, 0.32], grey)
        build.block(place, (0.26, 0.26))


def carton(build: Builder, rng: np.random.Generator, place: Pose, *, height_m: float) -> None:
    """Add a carton that stands on the floor."""
    width, depth = float(rng.uniform(0.35, 0.5)), float(rng.uniform(0.3, 0.4))
    sides = {
        i: build.texture(textures.cardboard(rng, px((side, height_m), px_per_m=260)))
        for i, side in ((0, depth), (1, depth), (2, width), (3, width))
    }
    top = build.texture(textures.cardboard(rng, px((width, depth), px_per_m=200)))
    with build.thing("carton", place):
        build.box(place, [0.0, 0.0, height_m / 2], [width, depth, height_m], top, sides=sides)
        build.block(place, (width, depth))


def door(build: Builder, look: Style, place: Pose) -> None:
    """Add a closed door of 0.95 x 2.08 m with its frame."""
    leaf = build.shared(
        "door", lambda: office_prints.fronts((416, 190), base=(168, 160, 148), cols=1, rows=1, px_per_m=200)
    )
    build.box(place, [0.0, 0.018, 1.06], [1.07, 0.036, 2.12], look.metal)
    build.box(place, [0.0, 0.023, 1.04], [0.95, 0.036, 2.07], leaf, front=leaf)


def table(build: Builder, look: Style, place: Pose, size: tuple[float, float], *, kind: Kind = "fixed") -> None:
    """Add a table of (x, y) centred on a place."""
    with build.thing("table", place, kind=kind):
        build.box(place, [0.0, 0.0, DESK_TOP_M - 0.015], [size[0], size[1], 0.03], look.board, cell_m=0.2)
        for sx in (-1, 1):
            for sy in (-1, 1):
                centre = [sx * (size[0] / 2 - 0.06), sy * (size[1] / 2 - 0.06), 0.355]
                build.box(place, centre, [0.05, 0.05, 0.709], look.metal)
        build.block(place, size)


def kitchen_counter(build: Builder, rng: np.random.Generator, look: Style, place: Pose, *, units: int) -> None:
    """Add a kitchen counter of equal units of 0.6 m centred on a place, wall units above, a fridge, machines."""
    width, depth = 0.6 * units, 0.6
    low = build.shared(
        "kitchen low", lambda: office_prints.fronts((180, 144), base=look.cupboard, cols=1, rows=1, px_per_m=240)
    )
    high = build.shared(
        "kitchen high", lambda: office_prints.fronts((156, 144), base=look.cupboard, cols=1, rows=1, px_per_m=240)
    )
    tiles = build.texture(
        office_prints.wall_tiles(rng, px((width, 0.55), px_per_m=160), base=(226, 228, 226), tile_px=24)
    )
    with build.thing("counter", place, kind="fixed"):
        for i in range(units):
            x = (i - (units - 1) / 2) * 0.6
            build.box(place, [x, depth / 2, 0.48], [0.598, depth - 0.02, 0.76], look.white, front=low)
            build.box(place, [x, 0.17, 1.82], [0.598, 0.34, 0.66], look.white, front=high)
        build.box(place, [0.0, depth / 2 - 0.03, 0.05], [width, depth - 0.1, 0.1], look.dark)
        build.box(place, [0.0, depth / 2, 0.88], [width + 0.01, depth + 0.02, 0.04], look.board, cell_m=0.2)
        build.panel(on_wall(place, 0.0, 1.195, off_m=0.004), (width, 0.55), tiles)
        build.block(moved(place, y=depth / 2), (width + 0.02, depth + 0.03))
    tower = moved(place, -width / 2 - 0.33)
    with build.thing("fridge", tower, kind="fixed"):
        build.box(tower, [0.0, 0.31, 0.93], [0.62, 0.62, 1.86], look.white)
        build.box(tower, [0.24, 0.64, 1.1], [0.03, 0.03, 0.5], look.metal)
        build.block(moved(tower, y=0.31), (0.64, 0.66))
    for x, size in ((-0.9, (0.32, 0.4, 0.42)), (0.5, (0.46, 0.34, 0.28)), (1.2, (0.18, 0.18, 0.26))):
        at = moved(place, x + float(rng.uniform(-0.1, 0.1)), 0.3, 0.9)
        panel = build.texture(textures.shapes(rng, px((size[0], size[2]), px_per_m=300)))
        with build.thing("machine", at):
            build.box(at, [0.0, 0.0, size[2] / 2], list(size), look.dark, front=panel, solid=False)
