"""The scene: a textured triangle mesh in the world frame (metres, z up), with rays and free floor."""

from __future__ import annotations

import dataclasses
import functools
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates

from fieldkit.frames import Pose
from sim_bridge.clusters import Clusters, clusters
from sim_bridge.texels import Mips, mips

if TYPE_CHECKING:
    from trimesh.ray.ray_pyembree import RayMeshIntersector

Array = NDArray[np.float64]
Rgb = NDArray[np.uint8]

# A texture smaller than this is enlarged without smoothing, so that the edges of its cells stay sharp in photos.
MIN_TEXTURE_PX = 1024


@dataclasses.dataclass(frozen=True, eq=False)
class Clearance:
    """Distances f32[nx,ny] in m to the nearest obstacle at the middles of square cells; ``corner_xy`` is the grid's."""

    distance_m: NDArray[np.float32]
    corner_xy: tuple[float, float]
    cell_m: float

    def at(self, points: Array) -> Array:
        """Return the distances f64[n] at points (n, 2), linear between the cells; 0 outside of the grid."""
        index = (points - np.asarray(self.corner_xy)) / self.cell_m - 0.5
        found: Array = map_coordinates(self.distance_m, index.T, output=np.float64, order=1, mode="constant")
        return found


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """A textured mesh. Faces are seen from both sides, except those marked ``closed``.

    ``vertices`` float64[n,3] in m, z up; ``faces`` int32[m,3]; ``uv`` float32[m,3,2] per face corner, (0, 0) at the
    top left of the texture and v downwards, clamped outside 0..1; ``texture`` int32[m] per face; ``textures`` RGB
    images; ``closed`` bool[m] marks faces of closed bodies, whose corners run clockwise seen from outside and whose
    backs the renderer skips; ``shade`` float32[m,3] baked brightness per face corner (1 leaves the texture as it is).
    ``blocks`` float64[k,8] are the plan-view footprints of what stands on the floor, four corners x, y in turn.
    ``walk_xy`` float64[j,2] is a closed polyline (the last point leads to the first) through free floor for a
    mapping walk. ``floor_bounds`` (x0, y0, x1, y1) is the floor's rectangle. ``clearance`` says, beside ``blocks``,
    how far off the next obstacle is, where that was measured on the mesh.
    """

    vertices: Array
    faces: NDArray[np.int32]
    uv: NDArray[np.float32]
    texture: NDArray[np.int32]
    textures: tuple[Rgb, ...]
    closed: NDArray[np.bool_]
    shade: NDArray[np.float32]
    blocks: Array
    walk_xy: Array
    floor_bounds: tuple[float, float, float, float]
    background: tuple[int, int, int] = (128, 128, 128)
    clearance: Clearance | None = None

    @functools.cached_property
    def bounds(self) -> Array:
        """Lowest and highest corner of the mesh, float64[2,3] in m."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @property
    def _origin(self) -> Scene | None:
        """The scene to which `with_quad` and the like added; its faces, vertices and textures are the first here."""
        origin: Scene | None = self.__dict__.get("_derived_from")
        return origin

    @functools.cached_property
    def mips(self) -> Mips:
        """Mip chains of the textures, made at first use; what a scene was derived from is not made again."""
        origin = self._origin
        if origin is None:
            return mips(self.textures)
        added = self.textures[len(origin.textures) :]
        return origin.mips.extended(added) if added else origin.mips

    @functools.cached_property
    def clusters(self) -> Clusters:
        """The faces in clusters of neighbours, made at first use."""
        origin = self._origin
        if origin is None:
            return clusters(self.vertices, self.faces)
        first = len(origin.faces)
        added = self.faces[first:]
        return origin.clusters.joined(clusters(self.vertices, added, first=first)) if len(added) else origin.clusters

    @functools.cached_property
    def _rays(self) -> RayMeshIntersector:
        """Rays against the faces of this scene that its origin has not."""
        import trimesh
        from trimesh.ray.ray_pyembree import RayMeshIntersector

        first = len(self._origin.faces) if self._origin is not None else 0
        used, faces = np.unique(self.faces[first:], return_inverse=True)
        mesh = trimesh.Trimesh(self.vertices[used], faces.reshape(-1, 3), process=False, validate=False)
        return RayMeshIntersector(mesh, scale_to_box=False)

    def intersect(self, origins: ArrayLike, directions: ArrayLike) -> Array:
        """Return the distance f64[n] in m along rays (n, 3) to the first surface, inf where there is none.

        Directions need not have unit length; the distance is metric. The face is found by Embree (single precision)
        and the distance computed from its plane in double precision.
        """
        return self._first_hits(*_rays(origins, directions))[0]

    def intersect_sides(self, origins: ArrayLike, directions: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Return the distances of `intersect` and whether surfaces are met from behind, their corners clockwise."""
        start, unit = _rays(origins, directions)
        distance, normal = self._first_hits(start, unit)
        return distance, (normal * unit).sum(axis=1) > 0.0

    def trace(self, origins: ArrayLike, directions: ArrayLike) -> tuple[Array, Array]:
        """Return the distances of `intersect` and the surfaces' unit normals f64[n,3] that face the rays' origins.

        Normals are zero where there is no surface.
        """
        start, unit = _rays(origins, directions)
        distance, normal = self._first_hits(start, unit)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        towards = np.where((normal * unit).sum(axis=1, keepdims=True) > 0, -1.0, 1.0)
        return distance, towards * normal / np.where(length > 0, length, 1.0)

    def _first_hits(self, start: Array, unit: Array) -> tuple[Array, Array]:
        """Return the distances of rays to the first surface, and normals of any length and sign."""
        origin = self._origin
        first = len(origin.faces) if origin is not None else 0
        if origin is not None:
            nearest, normals = origin._first_hits(start, unit)
        else:
            nearest, normals = np.full(len(start), np.inf), np.zeros((len(start), 3))
        if first == len(self.faces):
            return nearest, normals
        face = self._rays.intersects_first(start, unit)
        hit = np.flatnonzero(face >= 0)
        a, b, c = (self.vertices[self.faces[first + face[hit], i]] for i in range(3))
        normal = np.cross(b - a, c - a)
        distance = ((a - start[hit]) * normal).sum(axis=1) / (unit[hit] * normal).sum(axis=1)
        # A ray that grazes a face may come out with no distance.
        nearer = distance < nearest[hit]
        nearest[hit] = np.fmin(distance, nearest[hit])
        normals[hit[nearer]] = normal[nearer]
        return nearest, normals

    def free_floor(self, xy: ArrayLike, radius_m: float) -> NDArray[np.bool_]:
        """Return bool[n]: whether a disc of this radius around points (n, 2) touches neither furniture nor walls."""
        points = np.atleast_2d(np.asarray(xy, dtype=np.float64))
        x0, y0, x1, y1 = self.floor_bounds
        low, high = np.array([x0, y0]) + radius_m, np.array([x1, y1]) - radius_m
        free: NDArray[np.bool_] = np.all((points >= low) & (points <= high), axis=1)
        if self.clearance is not None:
            free &= self.clearance.at(points) >= radius_m
        near = np.flatnonzero(free)
        if not len(near) or not len(self.blocks):
            return free
        # Most blocks are far away from most points: only pairs that are near by their bounds are looked at closely.
        corners = self.blocks.reshape(-1, 4, 2)
        for some in np.array_split(near, len(near) * len(corners) // 2_000_000 + 1):
            below = (points[some, None] >= corners.min(axis=1) - radius_m).all(axis=2)
            point, block = np.nonzero(below & (points[some, None] <= corners.max(axis=1) + radius_m).all(axis=2))
            touched = _distance_to_blocks(points[some[point]], corners[block]) < radius_m
            free[some[point[touched]]] = False
        return free

    def with_quad(self, world_from_quad: Pose, width_m: float, height_m: float, texture: Rgb) -> Scene:
        """Return the scene with a textured rectangle centred on a pose: x right, y up, facing +z.

        The texture's first row is at the top (+y), and its borders are exactly the rectangle's. It is drawn from
        both sides: put a box behind it. ``texture`` is grey (h, w) or RGB (h, w, 3), uint8.
        """
        x, y = width_m / 2, height_m / 2
        corners = np.array([[-x, y, 0.0], [x, y, 0.0], [x, -y, 0.0], [-x, -y, 0.0]])
        uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        return self._with_quads(world_from_quad.apply(corners)[None], uv[None], _enlarged(texture), 1.0, closed=False)

    def with_box(self, world_from_box: Pose, size_m: ArrayLike, *, rgb: tuple[int, int, int]) -> Scene:
        """Return the scene with a box of one colour centred on a pose, of size (x, y, z) in m; no footprint."""
        half = np.asarray(size_m, dtype=np.float64) / 2
        quads = box_quads()[0] * half
        corners = world_from_box.apply(quads.reshape(-1, 3)).reshape(6, 4, 3)
        normals = world_from_box.rotation.apply(quads.mean(axis=1) / half)
        uv = np.tile(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), (6, 1, 1))
        shade = 0.78 + 0.2 * normals[:, 2] - 0.05 * normals[:, 0]
        return self._with_quads(corners, uv, np.full((1, 1, 3), rgb, np.uint8), shade[:, None], closed=True)

    def with_block(self, corners_xy: ArrayLike) -> Scene:
        """Return the scene with a further footprint, four corners (4, 2) in turn, that `free_floor` avoids."""
        block = np.asarray(corners_xy, dtype=np.float64).reshape(1, 8)
        return self._derived(blocks=np.concatenate([self.blocks, block]))

    def _with_quads(self, corners: Array, uv: Array, texture: Rgb, shade: float | Array, *, closed: bool) -> Scene:
        count = len(corners)
        first = len(self.vertices) + 4 * np.arange(count)[:, None]
        faces = np.concatenate([first + [0, 1, 2], first + [0, 2, 3]])
        corner_uv = np.concatenate([uv[:, [0, 1, 2]], uv[:, [0, 2, 3]]])
        values = np.broadcast_to(shade, (count, 3))
        return self._derived(
            vertices=np.concatenate([self.vertices, corners.reshape(-1, 3)]),
            faces=np.concatenate([self.faces, faces.astype(np.int32)]),
            uv=np.concatenate([self.uv, corner_uv.astype(np.float32)]),
            texture=np.concatenate([self.texture, np.full(2 * count, len(self.textures), np.int32)]),
            textures=(*self.textures, texture),
            closed=np.concatenate([self.closed, np.full(2 * count, closed)]),
            shade=np.concatenate([self.shade, np.tile(values, (2, 1)).astype(np.float32)]),
        )

    def _derived(self, **changes: Any) -> Scene:
        """Return the scene with additions; it shares this one's mips, clusters and rays, or those of its origin.

        The link is no field: `dataclasses.replace` may change anything and so does not keep it.
        """
        result = dataclasses.replace(self, **changes)
        result.__dict__["_derived_from"] = self._origin or self
        return result


def box_quads() -> tuple[Array, Array]:
    """Return the six sides of the cube -1..1: corners f64[6,4,3] (top left first, clockwise from outside), normals."""
    sides = {
        (1, 0, 0): [(1, -1, 1), (1, 1, 1), (1, 1, -1), (1, -1, -1)],
        (-1, 0, 0): [(-1, 1, 1), (-1, -1, 1), (-1, -1, -1), (-1, 1, -1)],
        (0, 1, 0): [(1, 1, 1), (-1, 1, 1), (-1, 1, -1), (1, 1, -1)],
        (0, -1, 0): [(-1, -1, 1), (1, -1, 1), (1, -1, -1), (-1, -1, -1)],
        (0, 0, 1): [(-1, 1, 1), (1, 1, 1), (1, -1, 1), (-1, -1, 1)],
        (0, 0, -1): [(-1, -1, -1), (1, -1, -1), (1, 1, -1), (-1, 1, -1)],
    }
    return np.array(list(sides.values()), dtype=np.float64), np.array(list(sides), dtype=np.float64)


def _enlarged(texture: Rgb) -> Rgb:
    image = texture if texture.ndim == 3 else np.repeat(texture[:, :, None], 3, axis=2)
    factor = 1
    while max(image.shape[:2]) * factor < MIN_TEXTURE_PX:
        factor *= 2
    return np.ascontiguousarray(np.repeat(np.repeat(image, factor, axis=0), factor, axis=1))


def _rays(origins: ArrayLike, directions: ArrayLike) -> tuple[Array, Array]:
    start = np.atleast_2d(np.asarray(origins, dtype=np.float64))
    ray = np.atleast_2d(np.asarray(directions, dtype=np.float64))
    start, ray = np.broadcast_arrays(start, ray)
    return start, ray / np.linalg.norm(ray, axis=1, keepdims=True)


def _distance_to_blocks(points: Array, corners: Array) -> Array:
    """Return the distance f64[n] of points (n, 2) to convex polygons (n, k, 2), one each; 0 inside."""
    edges = np.roll(corners, -1, axis=1) - corners
    delta = points[:, None] - corners
    along = np.clip((delta * edges).sum(axis=2) / (edges**2).sum(axis=2), 0.0, 1.0)
    distance = np.linalg.norm(delta - along[..., None] * edges, axis=2).min(axis=1)
    side = edges[..., 0] * delta[..., 1] - edges[..., 1] * delta[..., 0]
    inside = (side >= 0).all(axis=1) | (side <= 0).all(axis=1)
    return np.where(inside, 0.0, distance)
