"""Small parts of which the test scenes' furniture is made: frames, solids of one colour, pictures, doors, lamps."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fieldkit.frames import Pose
from sim_bridge.scenes.blueprint import Builder
from sim_bridge.scenes.heldout_surfaces import coat
from sim_bridge.scenes.plan import Opening, Rect, on_wall, slab, wall
from sim_bridge.scenes.textures import fractal, tinted

Rgb = NDArray[np.uint8]
Tone = tuple[int, int, int]
Solid = tuple[tuple[float, float, float], tuple[float, float, float]]
XY = tuple[float, float]

# One cell per side: what is this small or this far from others needs no shadows of its own.
COARSE_M = 3.0


def spot(x: float, y: float, yaw_deg: float = 0.0, *, z: float = 0.0) -> Pose:
    """Return the frame of a thing that stands at (x, y, z): its front is +y, turned by yaw about z."""
    return Pose.from_components([x, y, z], Rotation.from_euler("z", yaw_deg, degrees=True))


def tone(build: Builder, rgb: Tone) -> int:
    """Return the texture of one colour, made once."""
    return build.shared(("tone", rgb), lambda: np.full((1, 1, 3), rgb, np.uint8))


def solids(build: Builder, place: Pose, parts: Sequence[Solid], texture: int, *, cell_m: float = COARSE_M) -> None:
    """Add boxes given as (centre, size) in a place's frame, all of one texture."""
    for centre, size in parts:
        build.box(place, centre, size, texture, cell_m=cell_m)


def legs(size_xy: XY, height_m: float, *, thick_m: float, inset_m: float = 0.0) -> list[Solid]:
    """Return four legs under a rectangle."""
    x, y = (s / 2 - thick_m / 2 - inset_m for s in size_xy)
    size = (thick_m, thick_m, height_m)
    return [((i * x, j * y, height_m / 2), size) for i in (-1, 1) for j in (-1, 1)]


def pillar(
    build: Builder,
    place: Pose,
    radius_m: float,
    levels: tuple[float, float],
    texture: int,
    *,
    sides: int = 8,
    rows: XY = (0.0, 1.0),
) -> None:
    """Add an upright prism of an even number of sides about a place's z axis.

    The texture goes once around it; ``rows`` is the part of its height that shows.
    """
    low, high = levels
    width = 2 * radius_m * np.tan(np.pi / sides)
    for k in range(sides):
        side = place * spot(0.0, 0.0, 360.0 * k / sides)
        part = (k / sides, rows[0], (k + 1) / sides, rows[1])
        centre = on_wall(side, 0.0, (low + high) / 2, off_m=radius_m)
        build.panel(centre, (width, high - low), texture, cell_m=COARSE_M, uv=part)
    part = (0.0, rows[0], 0.25, (rows[0] + rows[1]) / 2)
    for k in range(sides // 2):
        # Strips from side to side cover the ends; each lies a little inside the last, or they would flicker.
        strip = place * spot(0.0, 0.0, 360.0 * k / sides, z=high - 0.0008 * k)
        build.panel(strip, (width, 2 * radius_m), texture, cell_m=COARSE_M, uv=part)
        if low > 0.0:
            over = Pose.from_components([0.0, 0.0, low - high + 0.0016 * k], Rotation.from_euler("x", np.pi))
            build.panel(strip * over, (width, 2 * radius_m), texture, cell_m=COARSE_M, uv=part)


def hang(
    build: Builder,
    wall_place: Pose,
    at: XY,
    size_m: tuple[float, float],
    texture: int,
    *,
    name: str = "poster",
    depth_m: float = 0.015,
    rim: Tone = (238, 236, 230),
) -> None:
    """Hang a picture of (width, height) on a wall: its middle is at (along, up); a thin box with a picture in front."""
    along, up = at
    place = wall_place * spot(along, 0.0, z=up)
    with build.thing(name, place, kind="picture"):
        size = [size_m[0], depth_m, size_m[1]]
        # It casts no shadow: on the coarse cells of a wall that would be a dark cloud around it.
        build.box(place, [0.0, depth_m / 2 + 0.001, 0.0], size, tone(build, rim), front=texture, solid=False)


def closed_door(build: Builder, wall_place: Pose, face: int, *, rim: Tone, size_m: XY = (0.94, 2.06)) -> None:
    """Put a shut door with its frame on a wall; all of one face look alike."""
    width, height = size_m
    with build.thing("door", wall_place, kind="fixed"):
        build.box(wall_place, [0.0, 0.015, height / 2], [width, 0.03, height], tone(build, rim), front=face, cell_m=0.5)
        jambs: list[Solid] = [
            ((side * (width / 2 + 0.035), 0.025, (height + 0.07) / 2), (0.07, 0.05, height + 0.07)) for side in (-1, 1)
        ]
        solids(build, wall_place, [*jambs, ((0.0, 0.025, height + 0.035), (width, 0.05, 0.07))], tone(build, rim))


def open_leaf(
    build: Builder, hinge: Pose, face: int, *, rim: Tone, size_m: XY = (1.1, 2.06), stands_clear_m: float = 0.06
) -> None:
    """Stand an open door's leaf along a wall: the hinge is a place's origin and the leaf lies along its x."""
    width, height = size_m
    with build.thing("door", hinge, kind="fixed"):
        sides = {2: face, 3: face}
        centre = [width / 2, stands_clear_m, height / 2 + 0.005]
        build.box(hinge, centre, [width, 0.04, height], tone(build, rim), sides=sides, cell_m=0.5)
        build.block(hinge * spot(width / 2, stands_clear_m), (width, 0.05))


def monitor(build: Builder, place: Pose, picture: int, *, width_m: float = 0.5) -> None:
    """Put a monitor on what it stands on (the place's origin), its picture towards +y."""
    dark, height = tone(build, (36, 36, 40)), 0.6 * width_m
    build.box(place, [0.0, 0.0, 0.01], [0.22, 0.16, 0.02], dark, cell_m=COARSE_M)
    build.box(place, [0.0, 0.0, 0.08], [0.05, 0.03, 0.14], dark, cell_m=COARSE_M)
    centre = [0.0, 0.0, 0.13 + height / 2]
    build.box(place, centre, [width_m + 0.03, 0.03, height + 0.03], dark, cell_m=COARSE_M)
    face = on_wall(place, 0.0, centre[2], off_m=0.0155)
    build.panel(face, (width_m, height), picture, solid=False, glow=0.85)


def plant(build: Builder, rng: np.random.Generator, place: Pose, *, height_m: float, pot: Tone) -> None:
    """Stand a plant of long leaves in a pot; it can be moved."""
    with build.thing("plant", place):
        pillar(build, place, 0.16, (0.0, 0.34), tone(build, pot))
        green = build.shared("leaf", lambda: _leaf(np.random.default_rng(71)))
        for yaw, tilt, share in zip(
            np.linspace(0, 360, 9, endpoint=False) + rng.uniform(-15, 15, 9),
            rng.uniform(6, 24, 9),
            rng.uniform(0.6, 1.0, 9),
            strict=True,
        ):
            turn = Rotation.from_euler("ZX", [yaw, tilt], degrees=True)
            length = share * (height_m - 0.34)
            middle = np.array([0.0, 0.0, 0.34]) + turn.apply([0.0, 0.0, length / 2])
            leaf = place * Pose.from_components(middle, turn)
            build.box(leaf, [0.0, 0.0, 0.0], [0.09, 0.004, length], green, cell_m=COARSE_M, solid=False)
        build.block(place, (0.34, 0.34))


def _leaf(rng: np.random.Generator) -> Rgb:
    image = tinted((58, 104, 52), 14 * fractal(rng, (120, 24), cell_px=12, octaves=3))
    image[:, 11:13] = (96, 140, 84)
    return image


def door_face(rgb: Tone, *, window: bool, size_px: tuple[int, int] = (320, 150)) -> Rgb:
    """Draw a door: plain, with a handle, a kick plate and perhaps a narrow pane."""
    height, width = size_px
    image = np.empty((height, width, 3), np.uint8)
    image[:] = rgb
    image[int(0.9 * height) :] = np.asarray(rgb) * 0.8
    image[int(0.5 * height) : int(0.52 * height), int(0.84 * width) : int(0.95 * width)] = (90, 92, 96)
    if window:
        image[int(0.16 * height) : int(0.44 * height), int(0.66 * width) : int(0.8 * width)] = (178, 190, 196)
    return image


def ceiling_lamp(
    build: Builder, at: XY, *, z_m: float, size_m: XY, power: float, group: str = "ceiling", samples: XY = (1, 1)
) -> None:
    """Hang a glowing panel that shines down."""
    pose = Pose.from_components([*at, z_m], Rotation.from_euler("x", np.pi))
    build.lamp(pose, size_m, power=power, group=group, samples=(int(samples[0]), int(samples[1])))


def spotlight(
    build: Builder, at: tuple[float, float, float], target: tuple[float, float, float], *, power: float
) -> None:
    """Hang a small lamp of the group "spot" that shines at a target, in a black can."""
    ray = np.asarray(target) - np.asarray(at)
    turn, _ = Rotation.align_vectors(ray[None] / np.linalg.norm(ray), [[0.0, 0.0, 1.0]])
    pose = Pose.from_components(at, turn)
    build.lamp(pose, (0.11, 0.11), power=power, group="spot", samples=(1, 1))
    build.box(pose, [0.0, 0.0, -0.11], [0.13, 0.13, 0.2], tone(build, (28, 28, 30)), cell_m=COARSE_M, solid=False)


@dataclasses.dataclass(frozen=True)
class WallPaint:
    """How walls are painted: height, pixels per metre, and the two faces' colours."""

    height_m: float
    density: float
    left: Tone
    right: Tone
    trim: Tone

    def stand(
        self,
        build: Builder,
        rng: np.random.Generator,
        line: tuple[XY, XY],
        openings: Sequence[Opening] = (),
        *,
        left: Rgb | None = None,
        right: Rgb | None = None,
    ) -> None:
        """Build a wall along a line; a face is nearly blank in its colour unless an image is given."""
        left_face = coat(rng, self.pixels(line), base=self.left) if left is None else left
        right_face = coat(rng, self.pixels(line), base=self.right) if right is None else right
        wall(
            build,
            *line,
            height_m=self.height_m,
            openings=openings,
            left=build.texture(left_face),
            right=build.texture(right_face),
            trim=tone(build, self.trim),
            cell_m=0.16,
        )

    def pixels(self, line: tuple[XY, XY]) -> tuple[int, int]:
        """Return the size in pixels (height, width) of a face of a wall along a line."""
        length = float(np.hypot(*np.subtract(line[1], line[0])))
        return round(self.height_m * self.density), round(length * self.density)


def shell(build: Builder, rect: Rect, *, height_m: float, floor: Rgb, ceiling: Rgb, cell_m: float) -> None:
    """Add the floor and the ceiling over a rectangle."""
    slab(build, rect, z_m=0.0, texture=build.texture(floor), up=True, cell_m=cell_m)
    slab(build, rect, z_m=height_m, texture=build.texture(ceiling), up=False, cell_m=0.2)
