"""The furnished room: walls with pictures, one almost blank wall, shelves, desks, chairs, cupboards and cartons.

The plan, in metres, with x to the east (0..9) and y to the north (0..7):

    +-----------------------------------+   furniture along the walls is at most 0.6 deep
    |  . . . . . . . . . . . . . . . .  |   the dots are the walk: free floor at least 0.9 wide,
    |  . +---------+   +---------+   .  |   around two islands of furniture and between them
    |  . |  west   | . |  east   |   .  |
    |  . |  island | . |  island |   .  |
    |  . +---------+ . +---------+   .  |
    |  . . . . . . . . . . . . . . . .  |
    +-----------------------------------+
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from fieldkit.frames import Pose, yaw_pose
from sim_bridge.mesh import Array
from sim_bridge.scenes import furniture, textures
from sim_bridge.scenes.blueprint import Blueprint, Builder
from sim_bridge.scenes.plan import on_wall

LENGTH_M, WIDTH_M, HEIGHT_M = 9.0, 7.0, 3.0
# Centre line of the corridor along the walls, and of the passage between the islands.
_LOOP_M = 1.17
_MIDDLE_M = LENGTH_M / 2
# Plan-view rectangles (x0, y0, x1, y1) of the two islands.
_ISLANDS = ((1.75, 1.75, 3.95, 5.25), (5.05, 1.75, 7.25, 5.25))


def furnished_room(seed: int) -> Blueprint:
    """Make the room of 9 x 7 x 3 m; the same seed gives the same room.

    The floor is at z = 0 and the walls stand at x = 0, 9 and y = 0, 7. `Scene.walk_xy` runs around both islands and
    through the passage between them; a strip of 0.9 m along it is free.
    """
    rng = np.random.default_rng([seed, 90703])
    build = Builder()
    _shell(build, rng)
    blank = int(rng.integers(4))
    for wall in range(4):
        _furnish_wall(build, rng, wall, kind="blank" if wall == blank else "rich")
    for island in _ISLANDS:
        _furnish_island(build, rng, island)
    _lamps(build)
    return build.blueprint(floor_bounds=(0.0, 0.0, LENGTH_M, WIDTH_M), walk_xy=_walk())


def _wall_place(wall: int) -> tuple[Pose, float]:
    """Return the frame of a wall (origin in its middle on the floor, y into the room, z up) and the wall's length."""
    x, y = LENGTH_M / 2, WIDTH_M / 2
    origin = [(x, 0.0, 0.0), (LENGTH_M, y, 0.0), (x, WIDTH_M, 0.0), (0.0, y, 0.0)][wall]
    return yaw_pose(origin, wall * np.pi / 2), (LENGTH_M, WIDTH_M)[wall % 2]


def _shell(build: Builder, rng: np.random.Generator) -> None:
    px = 300
    floor = build.texture(textures.planks(rng, (int(WIDTH_M * px), int(LENGTH_M * px)), px_per_m=px))
    middle = [LENGTH_M / 2, WIDTH_M / 2, 0.0]
    size = (LENGTH_M, WIDTH_M)
    build.panel(Pose.from_components(middle, Rotation.identity()), size, floor, cell_m=0.125)
    px = 150
    above = build.texture(textures.ceiling(rng, (int(WIDTH_M * px), int(LENGTH_M * px)), px_per_m=px))
    over = Pose.from_components([middle[0], middle[1], HEIGHT_M], Rotation.from_euler("x", np.pi))
    build.panel(over, size, above, cell_m=0.5)
    for wall in range(4):
        place, length = _wall_place(wall)
        tone = np.array([205, 200, 188]) + rng.normal(0, 12, 3)
        paint = textures.plaster(rng, (int(HEIGHT_M * 160), int(length * 160)), base=tone)
        build.panel(on_wall(place, 0.0, HEIGHT_M / 2, off_m=0.0), (length, HEIGHT_M), build.texture(paint))
        skirting = build.plain(tone - 70)
        build.box(place, [0.0, 0.006, 0.04], [length, 0.012, 0.08], skirting)
    rug = build.texture(textures.carpet(rng, (700, 1000)))
    spot = Pose.from_components([rng.uniform(2.5, 6.5), _LOOP_M, 0.004], Rotation.from_euler("z", rng.normal(0, 0.1)))
    build.panel(spot, (1.4, 0.95), rug, cell_m=0.125, solid=False)


def _lamps(build: Builder) -> None:
    for x, y in [(x, y) for x in (1.8, 4.5, 7.2) for y in (1.9, 5.1)]:
        under = Pose.from_components([x, y, HEIGHT_M - 0.03], Rotation.from_euler("x", np.pi))
        build.lamp(under, (1.2, 0.3), samples=(1, 1))


def _furnish_wall(build: Builder, rng: np.random.Generator, wall: int, *, kind: str) -> None:
    """Put furniture and pictures along a wall; the first 0.7 m belong to the neighbouring wall's corner."""
    place, length = _wall_place(wall)
    along = -length / 2 + 0.7
    if kind == "blank":
        furniture.door(build, rng, place * yaw_pose([along + 0.9, 0.0, 0.0], 0.0))
        low = place * yaw_pose([length / 2 - 1.5, 0.0, 0.0], 0.0)
        furniture.cupboard(build, rng, low, width_m=1.0, height_m=0.8)
        return
    pieces: dict[str, Callable[[Pose], float]] = {
        "shelf": lambda at: furniture.bookshelf(build, rng, at, width_m=1.1),
        "cupboard": lambda at: furniture.cupboard(build, rng, at, width_m=1.0, height_m=float(rng.uniform(0.8, 1.1))),
        "desk": lambda at: furniture.desk(build, rng, at, width_m=1.3),
        "cartons": lambda at: furniture.cartons(build, rng, at, width_m=1.0),
        "free": lambda at: 1.0,
    }
    widths = {"shelf": 1.1, "cupboard": 1.0, "desk": 1.3, "cartons": 1.0, "free": 1.0}
    order: list[str] = []
    while True:
        if not order:
            order = [str(name) for name in rng.permutation(list(pieces))]
        name = order.pop()
        if along + widths[name] > length / 2 - 0.1:
            break
        top = pieces[name](place * yaw_pose([along + widths[name] / 2, 0.0, 0.0], 0.0))
        if name != "shelf":
            _pictures(build, rng, place, span=(along, along + widths[name]), above_m=max(top, 0.75) + 0.1)
        along += widths[name] + float(rng.uniform(0.05, 0.3))


def _pictures(
    build: Builder, rng: np.random.Generator, place: Pose, *, span: tuple[float, float], above_m: float
) -> None:
    """Hang one picture, or two beside each other, over a stretch of wall."""
    count = int(rng.integers(1, 3))
    room = (span[1] - span[0]) / count
    for i in range(count):
        width = room * float(rng.uniform(0.7, 0.92))
        height = min(float(rng.uniform(0.6, 1.3)) * (1.0 if count == 1 else 0.9), 2.5 - above_m)
        along = span[0] + room * (i + 0.5)
        up = above_m + height / 2 + float(rng.uniform(0.0, max(2.5 - above_m - height, 0.0)))
        kind = str(rng.choice(list(textures.PICTURES)))
        image = textures.PICTURES[kind](rng, (int(height * 700), int(width * 700)))
        at = on_wall(place, along, up, off_m=0.012)
        frame = build.plain(rng.integers(20, 90, 3))
        with build.thing("picture", at, kind="picture"):
            build.box(at, [0.0, 0.0, -0.0065], [width + 0.03, height + 0.03, 0.011], frame, solid=False)
            build.panel(at, (width, height), build.texture(image), solid=False)


def _furnish_island(build: Builder, rng: np.random.Generator, island: tuple[float, float, float, float]) -> None:
    """Fill an island with three rows of furniture, each 2.2 m wide and about 1.1 m deep."""
    x0, y0, x1, y1 = island
    rows = {
        "desks": furniture.desk_pair,
        "divider": furniture.divider,
        "table": furniture.table_with_chairs,
        "pile": furniture.pile,
    }
    names = ["divider", *(str(n) for n in rng.permutation(["desks", "table", "pile"]))][:3]
    order = [names[1], names[0], names[2]]
    depth = (y1 - y0) / 3
    for i, name in enumerate(order):
        at = yaw_pose([(x0 + x1) / 2, y0 + depth * (i + 0.5), 0.0], 0.0)
        rows[name](build, rng, at)


def _walk() -> Array:
    """Return the walk, a closed polyline f64[k,2]: a figure of eight around the islands with its corners cut."""
    near, far = _LOOP_M, LENGTH_M - _LOOP_M
    south, north = _LOOP_M, WIDTH_M - _LOOP_M
    eight = [
        (_MIDDLE_M, south), (far, south), (far, north), (_MIDDLE_M, north),
        (_MIDDLE_M, south), (near, south), (near, north), (_MIDDLE_M, north),
    ]  # fmt: skip
    corners = np.array(eight)
    before = np.roll(corners, 1, axis=0) - corners
    after = np.roll(corners, -1, axis=0) - corners
    cut = 0.35
    ends = [corners + cut * d / np.linalg.norm(d, axis=1, keepdims=True) for d in (before, after)]
    return np.stack(ends, axis=1).reshape(-1, 2)
