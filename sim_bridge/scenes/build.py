"""Build scenes out of textured rectangles and boxes, and bake light into their corners."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldkit.frames import Pose
from sim_bridge.mesh import Array, Rgb, Scene, box_quads

FULL_UV = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))


@dataclasses.dataclass(frozen=True)
class Light:
    """How a scene is lit: lamps f64[l,3] in m, their share of the light, and reach of the corners' darkening."""

    lamps: Array
    lamp_share: float = 0.55
    exposure: float = 1.12
    occlusion_reach_m: float = 1.2
    rays: int = 24


@dataclasses.dataclass(frozen=True)
class Quad:
    """A rectangle: corners f64[4,3] (top left first, then right, clockwise as seen), normal, texture and light."""

    corners: Array
    normal: Array
    texture: int
    cell_m: float
    solid: bool
    closed: bool
    glow: float | None


class Builder:
    """Collects rectangles, textures and footprints; `build` makes the scene of them."""

    def __init__(self) -> None:
        self.quads: list[Quad] = []
        self.textures: list[Rgb] = []
        self.blocks: list[Array] = []

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
    ) -> None:
        """Add a rectangle of (width, height) centred on a pose, x right, y up, facing +z.

        A panel that is not ``solid`` casts no shadow and is seen from both sides (a picture); ``glow`` is a
        fixed brightness.
        """
        x, y = size_m[0] / 2, size_m[1] / 2
        corners = world_from_quad.apply(np.array([[-x, y, 0.0], [x, y, 0.0], [x, -y, 0.0], [-x, -y, 0.0]]))
        normal = world_from_quad.rotation.apply([0.0, 0.0, 1.0])
        self.quads.append(Quad(corners, normal, texture, cell_m, solid, closed=solid, glow=glow))

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
            self.quads.append(Quad(here, normal, special.get(i, texture), cell_m, solid, closed=True, glow=None))

    def block(self, world_from_place: Pose, size_xy: tuple[float, float]) -> None:
        """Mark a footprint of (x, y) in m, centred on a place, as not free."""
        x, y = size_xy[0] / 2, size_xy[1] / 2
        corners = world_from_place.apply(np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]]))
        self.blocks.append(corners[:, :2].reshape(8))

    def build(
        self,
        rng: np.random.Generator,
        light: Light,
        *,
        walk_xy: Array,
        floor_bounds: tuple[float, float, float, float],
    ) -> Scene:
        """Cut the rectangles into cells, bake the light into their corners and return the scene."""
        grids = [_grid(quad) for quad in self.quads]
        offsets = np.cumsum([0] + [len(g.points) for g in grids])
        points = np.concatenate([g.points for g in grids])
        normals = np.repeat([q.normal for q in self.quads], [len(g.points) for g in grids], axis=0)
        inward = np.concatenate([q.corners.mean(axis=0) - g.points for q, g in zip(self.quads, grids, strict=True)])
        faces = np.concatenate([g.faces + start for g, start in zip(grids, offsets[:-1], strict=True)])
        uv = np.concatenate([g.uv for g in grids])
        counts = [len(g.faces) for g in grids]
        scene = Scene(
            vertices=points,
            faces=faces.astype(np.int32),
            uv=uv[faces].astype(np.float32),
            texture=np.repeat([q.texture for q in self.quads], counts).astype(np.int32),
            textures=tuple(self.textures),
            closed=np.repeat([q.closed for q in self.quads], counts),
            shade=np.ones((len(faces), 3), np.float32),
            blocks=np.stack(self.blocks) if self.blocks else np.zeros((0, 8)),
            walk_xy=walk_xy,
            floor_bounds=floor_bounds,
        )
        solid = np.repeat([q.solid for q in self.quads], counts)
        origins = points + 2e-3 * normals + 0.01 * inward
        brightness = bake(dataclasses.replace(scene, faces=scene.faces[solid]), origins, normals, light, rng=rng)
        glow = np.repeat([np.nan if q.glow is None else q.glow for q in self.quads], [len(g.points) for g in grids])
        brightness = np.where(np.isnan(glow), brightness, glow)
        return dataclasses.replace(scene, shade=brightness[scene.faces].astype(np.float32))


@dataclasses.dataclass(frozen=True)
class _Grid:
    points: Array
    uv: Array
    faces: NDArray[np.int64]


def _grid(quad: Quad) -> _Grid:
    """Cut a rectangle into cells of about cell_m."""
    a, b, _, d = quad.corners
    cols = max(1, int(np.ceil(np.linalg.norm(b - a) / quad.cell_m - 1e-9)))
    rows = max(1, int(np.ceil(np.linalg.norm(d - a) / quad.cell_m - 1e-9)))
    v, u = (g.ravel() for g in np.meshgrid(np.arange(rows + 1) / rows, np.arange(cols + 1) / cols, indexing="ij"))
    points = a + u[:, None] * (b - a) + v[:, None] * (d - a)
    first = (np.arange(rows)[:, None] * (cols + 1) + np.arange(cols)).ravel()
    step = cols + 1
    upper = np.stack([first, first + 1, first + step + 1], axis=1)
    lower = np.stack([first, first + step + 1, first + step], axis=1)
    return _Grid(points, np.stack([u, v], axis=1), np.concatenate([upper, lower]))


def bake(scene: Scene, points: Array, normals: Array, light: Light, *, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return the brightness f64[n] at surface points: lamps with shadows plus ambient light darkened in corners.

    Brightness multiplies gamma-encoded texels: it is the 1/2.2 power of the light.
    """
    ambient = _openness(scene, points, normals, light, rng=rng)
    direct = np.zeros(len(points))
    for lamp in light.lamps:
        to_lamp = lamp - points
        distance = np.linalg.norm(to_lamp, axis=1)
        towards = to_lamp / distance[:, None]
        falling = np.clip((towards * normals).sum(axis=1), 0.0, None) * np.clip(towards[:, 2], 0.0, None)
        facing = np.flatnonzero(falling > 0)
        seen = scene.intersect(points[facing], towards[facing]) >= distance[facing] - 0.05
        direct[facing] += np.where(seen, falling[facing] / distance[facing] ** 2, 0.0)
    direct *= 3.0 / max(len(light.lamps), 1)
    total = light.lamp_share * direct + (1.0 - light.lamp_share) * ambient
    return np.clip(light.exposure * total ** (1 / 2.2), 0.08, 1.15)


def _openness(
    scene: Scene, points: Array, normals: Array, light: Light, *, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Return how much of the hemisphere over each point is open, f64[n] in 0..1, weighted by the cosine."""
    total = np.zeros(len(points))
    # A golden spiral on the disc, lifted to the hemisphere, is spread by the cosine; a random turn hides its pattern.
    k = np.arange(light.rays) + 0.5
    radius = np.sqrt(k / light.rays)
    turn = rng.uniform(0, 2 * np.pi, len(points))
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    across = np.cross(helper, normals)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(normals, across)
    for i in range(light.rays):
        angle = turn + k[i] * np.pi * (3.0 - np.sqrt(5.0))
        direction = radius[i] * (np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * along)
        direction += np.sqrt(1.0 - radius[i] ** 2) * normals
        distance = scene.intersect(points, direction)
        # A ray that grazes a face may come out with no distance or one a rounding below zero.
        total += np.fmax(np.fmin(distance / light.occlusion_reach_m, 1.0), 0.0)
    return total / light.rays
