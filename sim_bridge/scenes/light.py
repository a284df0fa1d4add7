"""Light a blueprint: cut its rectangles into cells and bake lamps, shadows and dark corners into their corners."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sim_bridge.mesh import Array, Scene
from sim_bridge.scenes.blueprint import Blueprint, Lamp, Quad


@dataclasses.dataclass(frozen=True)
class Light:
    """How a scene is lit: the lamps' share of all light, the reach of the corners' darkening, overall brightness.

    ``groups`` scales the power of groups of lamps (0 switches off); a group that is not named keeps its power.
    """

    lamp_share: float = 0.55
    exposure: float = 1.12
    occlusion_reach_m: float = 1.2
    rays: int = 24
    groups: Mapping[str, float] = dataclasses.field(default_factory=dict)


def lit(blueprint: Blueprint, light: Light | None = None, *, rng: np.random.Generator) -> Scene:
    """Return the scene of a blueprint under a light."""
    chosen = light or Light()
    grids = [_grid(quad) for quad in blueprint.quads]
    scene = _meshed(blueprint, grids)
    per_quad = [len(g.points) for g in grids]
    normals = np.repeat([q.normal for q in blueprint.quads], per_quad, axis=0)
    pairs = list(zip(blueprint.quads, grids, strict=True))
    inward = np.concatenate([q.corners.mean(axis=0) - g.points for q, g in pairs])
    # A flat picture would cast, through the coarse cells of the wall behind it, a halo far too large.
    casts = [q.solid and blueprint.things[q.thing].kind != "picture" for q in blueprint.quads]
    solid = np.repeat(casts, [len(g.faces) for g in grids])
    origins = scene.vertices + 2e-3 * normals + 0.01 * inward
    blockers = dataclasses.replace(scene, faces=scene.faces[solid])
    brightness = bake(blockers, origins, normals, blueprint.lamps, chosen, rng=rng)
    glow = np.repeat([np.nan if q.glow is None else q.glow for q in blueprint.quads], per_quad)
    brightness = np.where(np.isnan(glow), brightness, glow)
    return dataclasses.replace(scene, shade=brightness[scene.faces].astype(np.float32))


def unlit(blueprint: Blueprint) -> Scene:
    """Return the scene of a blueprint with its textures as they are: its shape, quickly."""
    return _meshed(blueprint, [_grid(quad) for quad in blueprint.quads])


def _meshed(blueprint: Blueprint, grids: list[_Grid]) -> Scene:
    offsets = np.cumsum([0] + [len(g.points) for g in grids])
    faces = np.concatenate([g.faces + start for g, start in zip(grids, offsets[:-1], strict=True)])
    uv = np.concatenate([g.uv for g in grids])
    counts = [len(g.faces) for g in grids]
    return Scene(
        vertices=np.concatenate([g.points for g in grids]),
        faces=faces.astype(np.int32),
        uv=uv[faces].astype(np.float32),
        texture=np.repeat([q.texture for q in blueprint.quads], counts).astype(np.int32),
        textures=blueprint.textures,
        closed=np.repeat([q.closed for q in blueprint.quads], counts),
        shade=np.ones((len(faces), 3), np.float32),
        blocks=np.array([b.corners_xy.reshape(8) for b in blueprint.blocks]).reshape(-1, 8),
        walk_xy=blueprint.walk_xy,
        floor_bounds=blueprint.floor_bounds,
    )


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
    left, top, right, bottom = quad.uv
    uv = np.stack([left + u * (right - left), top + v * (bottom - top)], axis=1)
    return _Grid(points, uv, np.concatenate([upper, lower]))


def bake(
    scene: Scene,
    points: Array,
    normals: Array,
    lamps: tuple[Lamp, ...],
    light: Light,
    *,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Return the brightness f64[n] at surface points: lamps with shadows plus ambient light darkened in corners.

    Brightness multiplies gamma-encoded texels: it is the 1/2.2 power of the light.
    """
    ambient = _openness(scene, points, normals, light, rng=rng)
    direct = np.zeros(len(points))
    for lamp in lamps:
        power = lamp.power * light.groups.get(lamp.group, 1.0) / len(lamp.points)
        for spot in lamp.points if power > 0.0 else ():
            direct += power * _from_lamp(scene, points, normals, spot, lamp.normal)
    direct *= 3.0 / max(len(lamps), 1)
    total = light.lamp_share * direct + (1.0 - light.lamp_share) * ambient
    return np.clip(light.exposure * total ** (1 / 2.2), 0.08, 1.15)


def _from_lamp(scene: Scene, points: Array, normals: Array, spot: Array, lamp_normal: Array) -> Array:
    """Return the light f64[n] that reaches surface points from a spot that shines by the cosine, with shadows."""
    to_lamp = spot - points
    distance = np.linalg.norm(to_lamp, axis=1)
    towards = to_lamp / distance[:, None]
    falling = np.clip((towards * normals).sum(axis=1), 0.0, None) * np.clip(-towards @ lamp_normal, 0.0, None)
    lit_up = np.flatnonzero(falling > 0)
    seen = scene.intersect(points[lit_up], towards[lit_up]) >= distance[lit_up] - 0.05
    result = np.zeros(len(points))
    result[lit_up] = np.where(seen, falling[lit_up] / distance[lit_up] ** 2, 0.0)
    return result


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
