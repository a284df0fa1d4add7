"""Forms that furniture is put together from: shells, prisms, bars, boards with things on them, hung pictures.

A place is a frame with z up; against a wall, the wall is y = 0 and +y the room.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from fieldkit.frames import Pose, yaw_pose
from sim_bridge.mesh import Rgb
from sim_bridge.scenes.blueprint import Builder

# Columns: the right, up and outward axes of a panel that faces +y, in a place's frame.
_UPRIGHT = Rotation.from_matrix([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
# A panel's turn about the vertical by which it faces each side, instead of +y.
_YAWS = {"+x": -np.pi / 2, "-x": np.pi / 2, "+y": 0.0, "-y": np.pi}


def moved(place: Pose, x_m: float = 0.0, y_m: float = 0.0, z_m: float = 0.0, *, yaw_rad: float = 0.0) -> Pose:
    """Return a frame moved and turned within a place."""
    return place * yaw_pose([x_m, y_m, z_m], yaw_rad)


def upright(place: Pose, x_m: float = 0.0, y_m: float = 0.0, z_m: float = 0.0) -> Pose:
    """Return the pose of a standing panel that faces +y of a place."""
    return place * Pose.from_components([x_m, y_m, z_m], _UPRIGHT)


def leaning(place: Pose, x_m: float, y_m: float, z_m: float, *, back_rad: float) -> Pose:
    """Return the pose of a panel that faces +y of a place and leans backwards by an angle."""
    return place * Pose.from_components([x_m, y_m, z_m], Rotation.from_euler("x", back_rad) * _UPRIGHT)


def paint(build: Builder, rgb: ArrayLike) -> int:
    """Return the number of a texture of one colour, shared by all that have this colour."""
    r, g, b = (int(v) for v in np.clip(np.asarray(rgb), 0, 255))
    return build.shared(("paint", r, g, b), lambda: np.full((1, 1, 3), (r, g, b), np.uint8))


def shell(
    build: Builder,
    place: Pose,
    centre: ArrayLike,
    size: ArrayLike,
    faces: Mapping[str, int],
    *,
    cell_m: float = 0.25,
) -> None:
    """Add only the named sides of a box ("+x", "-y", "+z" ...), each with its texture: hidden sides cost nothing."""
    x, y, z = (float(v) for v in np.asarray(centre))
    w, d, h = (float(v) for v in np.asarray(size))
    middle = moved(place, x, y, z)
    for side, texture in faces.items():
        if side[1] == "z":
            turn = Rotation.identity() if side == "+z" else Rotation.from_euler("x", np.pi)
            at = middle * Pose.from_components([0.0, 0.0, h / 2 if side == "+z" else -h / 2], turn)
            build.panel(at, (w, d), texture, cell_m=cell_m)
            continue
        off, wide = (w / 2, d) if side[1] == "x" else (d / 2, w)
        build.panel(upright(moved(middle, yaw_rad=_YAWS[side]), y_m=off), (wide, h), texture, cell_m=cell_m)


def prism(
    build: Builder,
    place: Pose,
    radius_m: float,
    height_m: float,
    side: int | Sequence[int],
    *,
    top: int | None = None,
    count: int = 8,
    cell_m: float = 0.4,
) -> None:
    """Add a prism standing on a place, of an even count of sides; ``side`` may give each its own texture.

    The cap is the union of rectangles between opposite sides, which covers a regular polygon exactly.
    """
    wide = 2 * radius_m * np.tan(np.pi / count)
    for i in range(count):
        texture = side if isinstance(side, int) else side[i % len(side)]
        at = upright(moved(place, yaw_rad=2 * np.pi * i / count), 0.0, radius_m, height_m / 2)
        build.panel(at, (wide, height_m), texture, cell_m=cell_m)
    cap = (side if isinstance(side, int) else side[0]) if top is None else top
    for i in range(count // 2):
        build.panel(moved(place, z_m=height_m, yaw_rad=2 * np.pi * i / count), (wide, 2 * radius_m), cap, cell_m=cell_m)


def sideways(place: Pose, x_m: float, y_m: float, z_m: float) -> Pose:
    """Return a frame whose z axis is a place's x axis: a prism built there lies along x."""
    lying = Rotation.from_matrix([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    return place * Pose.from_components([x_m, y_m, z_m], lying)


def bar(build: Builder, place: Pose, start: ArrayLike, end: ArrayLike, thick_m: float, texture: int) -> None:
    """Add a square bar between two points (3,) of a place."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    along = (b - a) / np.linalg.norm(b - a)
    helper = np.array([0.0, 0.0, 1.0]) if abs(along[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    side = np.cross(helper, along)
    side /= np.linalg.norm(side)
    turn = Rotation.from_matrix(np.column_stack([along, side, np.cross(along, side)]))
    at = place * Pose.from_components((a + b) / 2, turn)
    build.box(at, [0.0, 0.0, 0.0], [float(np.linalg.norm(b - a)), thick_m, thick_m], texture, cell_m=0.5)


def legs(build: Builder, place: Pose, size: tuple[float, float], height_m: float, thick_m: float, texture: int) -> None:
    """Add four legs under the corners of a rectangle centred on a place."""
    for sx in (-1, 1):
        for sy in (-1, 1):
            x, y = sx * (size[0] - thick_m) / 2, sy * (size[1] - thick_m) / 2
            faces = dict.fromkeys(("+x", "-x", "+y", "-y"), texture)
            shell(build, place, [x, y, height_m / 2], [thick_m, thick_m, height_m], faces, cell_m=0.5)


def hang(
    build: Builder,
    place: Pose,
    size: tuple[float, float],
    image: Rgb | int,
    *,
    along_m: float = 0.0,
    up_m: float = 1.5,
    off_m: float = 0.006,
    name: str = "poster",
    frame: int | None = None,
    glow: float | None = None,
) -> None:
    """Hang a picture on a wall's frame: a thing of its own; with ``frame``, a texture, on a board 3 cm larger."""
    centre = moved(place, along_m, 0.0, up_m)
    texture = image if isinstance(image, int) else build.texture(image)
    with build.thing(name, centre, kind="picture"):
        if frame is not None:
            wide, high = size[0] + 0.03, size[1] + 0.03
            build.box(centre, [0.0, off_m / 2, 0.0], [wide, off_m, high], frame, solid=False)
        build.panel(upright(centre, 0.0, off_m + 0.003, 0.0), size, texture, solid=False, glow=glow)
