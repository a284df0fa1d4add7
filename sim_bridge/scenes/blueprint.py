"""The plan of a scene before it is lit: textured rectangles, the things they belong to, lamps, and footprints."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Hashable, Iterator, Mapping
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from fieldkit.frames import Pose
from sim_bridge.mesh import Array, Rgb, box_quads

# Left, top, right and bottom of the whole of a texture.
FULL_UV = (0.0, 0.0, 1.0, 1.0)


# What a change of the world may do: nothing to the building and fixed things; move, remove or add movable things;
# take down, exchange or hang pictures.
Kind = Literal["building", "fixed", "movable", "picture"]


@dataclasses.dataclass(frozen=True)
class Thing:
    """What belongs together: a name of its sort ("chair"), its kind, and the frame it stands in (z up)."""

    name: str
    kind: Kind
    world_from_thing: Pose


@dataclasses.dataclass(frozen=True, eq=False)
class Lamp:
    """A source of light: points f64[k,3] spread over it, its power (1 is an office lamp), the unit vector (3,) along
    which it shines most, and a group ("ceiling", "window", ...) that is switched together."""

    points: Array
    power: float
    normal: Array
    group: str


@dataclasses.dataclass(frozen=True)
class Quad:
    """A rectangle: corners f64[4,3] (top left first, then right, clockwise as seen), normal, texture and light.

    ``thing`` is the index of what it belongs to; ``uv`` the part of the texture that it shows.
    """

    corners: Array
    normal: Array
    texture: int
    cell_m: float
    solid: bool
    closed: bool
    glow: float | None
    thing: int = 0
    uv: tuple[float, float, float, float] = FULL_UV


@dataclasses.dataclass(frozen=True)
class Block:
    """A footprint that is not free: four corners f64[4,2] in turn, and the thing it belongs to."""

    corners_xy: Array
    thing: int = 0


@dataclasses.dataclass(frozen=True)
class Blueprint:
    """A scene without its light. ``things[0]`` is the building itself.

    ``walk_xy`` f64[j,2] is a closed polyline for the mapping walk, or empty where the walk is to be found by itself.
    """

    quads: tuple[Quad, ...]
    textures: tuple[Rgb, ...]
    blocks: tuple[Block, ...]
    things: tuple[Thing, ...]
    lamps: tuple[Lamp, ...]
    floor_bounds: tuple[float, float, float, float]
    walk_xy: Array


class Builder:
    """Collects rectangles, textures, lamps and footprints; `blueprint` returns what was collected."""

    def __init__(self) -> None:
        self.quads: list[Quad] = []
        self.textures: list[Rgb] = []
        self.blocks: list[Block] = []
        self.lamps: list[Lamp] = []
        self.things = [Thing("building", "building", Pose.from_components(np.zeros(3), Rotation.identity()))]
        self._thing = 0
        self._shared: dict[Hashable, int] = {}

    @contextlib.contextmanager
    def thing(self, name: str, world_from_thing: Pose, *, kind: Kind = "movable") -> Iterator[None]:
        """Let all that is added inside the block belong to a thing; inside another thing it belongs to that one."""
        if self._thing:
            yield
            return
        self.things.append(Thing(name, kind, world_from_thing))
        self._thing = len(self.things) - 1
        try:
            yield
        finally:
            self._thing = 0

    def shared(self, key: Hashable, make: Callable[[], Rgb]) -> int:
        """Return the number of a texture that is made once per key: identical things look identical."""
        if key not in self._shared:
            self._shared[key] = self.texture(make())
        return self._shared[key]

    def texture(self, image: Rgb) -> int:
        """Add a texture and return its number."""
        self.textures.append(np.ascontiguousarray(image))
        return len(self.textures) - 1

    def plain(self, rgb: ArrayLike) -> int:
        """Add a texture of one colour and return its number."""
        return self.texture(np.clip(np.asarray(rgb), 0, 255).astype(np.uint8).reshape(1, 1, 3))

    def panel(
        self,
        world_from_quad: Pose,
        size_m: tuple[float, float],
        texture: int,
        *,
        cell_m: float = 0.25,
        solid: bool = True,
        glow: float | None = None,
        uv: tuple[float, float, float, float] = FULL_UV,
    ) -> None:
        """Add a rectangle of (width, height) centred on a pose, x right, y up, facing +z.

        A panel that is not ``solid`` casts no shadow and is seen from both sides (a picture); ``glow`` is a
        fixed brightness. ``uv`` (left, top, right, bottom) is the part of the texture that it shows.
        """
        x, y = size_m[0] / 2, size_m[1] / 2
        corners = world_from_quad.apply(np.array([[-x, y, 0.0], [x, y, 0.0], [x, -y, 0.0], [-x, -y, 0.0]]))
        normal = world_from_quad.rotation.apply([0.0, 0.0, 1.0])
        self.quads.append(
            Quad(corners, normal, texture, cell_m, solid, closed=solid, glow=glow, thing=self._thing, uv=uv)
        )

    def box(
        self,
        world_from_place: Pose,
        centre: ArrayLike,
        size: ArrayLike,
        texture: int,
        *,
        front: int | None = None,
        sides: Mapping[int, int] | None = None,
        cell_m: float = 0.25,
        solid: bool = True,
    ) -> None:
        """Add a box at ``centre`` (3,) of a place's frame; ``front`` is the texture of its side +y.

        ``sides`` gives textures of single sides in the order +x -x +y -y +z -z.
        """
        quads, normals = box_quads()
        corners = quads * (np.asarray(size, dtype=np.float64) / 2) + np.asarray(centre, dtype=np.float64)
        special = dict(sides or {})
        if front is not None:
            special[2] = front
        for i in range(6):
            normal = world_from_place.rotation.apply(normals[i])
            here = world_from_place.apply(corners[i])
            self.quads.append(
                Quad(here, normal, special.get(i, texture), cell_m, solid, closed=True, glow=None, thing=self._thing)
            )

    def block(self, world_from_place: Pose, size_xy: tuple[float, float]) -> None:
        """Mark a footprint of (x, y) in m, centred on a place, as not free."""
        x, y = size_xy[0] / 2, size_xy[1] / 2
        corners = world_from_place.apply(np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]]))
        self.blocks.append(Block(corners[:, :2], self._thing))

    def lamp(
        self,
        world_from_lamp: Pose,
        size_m: tuple[float, float],
        *,
        power: float = 1.0,
        group: str = "ceiling",
        samples: tuple[int, int] = (2, 1),
        texture: int | None = None,
    ) -> None:
        """Add a glowing panel of (width, height) that shines along +z of a pose.

        Its light comes from a grid of ``samples`` points just in front of it. ``texture`` is white by default.
        """
        white = self.shared("lamp", lambda: np.full((1, 1, 3), (255, 253, 246), np.uint8))
        self.panel(world_from_lamp, size_m, white if texture is None else texture, solid=False, glow=1.0)
        across, down = (((np.arange(n) + 0.5) / n - 0.5) * s for n, s in zip(samples, size_m, strict=True))
        grid = np.array([[x, y, 0.02] for x in across for y in down])
        normal = world_from_lamp.rotation.apply([0.0, 0.0, 1.0])
        self.lamps.append(Lamp(world_from_lamp.apply(grid), power, normal, group))

    def blueprint(self, *, floor_bounds: tuple[float, float, float, float], walk_xy: ArrayLike = ()) -> Blueprint:
        """Return what was collected; ``floor_bounds`` (x0, y0, x1, y1) encloses all floor."""
        walk = np.asarray(walk_xy, dtype=np.float64).reshape(-1, 2)
        return Blueprint(
            tuple(self.quads),
            tuple(self.textures),
            tuple(self.blocks),
            tuple(self.things),
            tuple(self.lamps),
            floor_bounds,
            walk,
        )
