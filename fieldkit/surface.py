"""Surfaces: depth images fused into a TSDF, its mesh, PLY files, and rays against it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from pathlib import Path

import numba
import numpy as np
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh
from numpy.typing import ArrayLike, NDArray
from skimage.measure import marching_cubes

from fieldkit.cameras import Camera
from fieldkit.errors import SurfaceError
from fieldkit.frames import Pose
from fieldkit.store import atomic_write
from fieldkit.types import Surface

Array = NDArray[np.float64]
Depth = NDArray[np.uint16]
# Read on demand, so that a long walk does not have to fit into memory: map_from_cam, and the image in mm (0 = none).
DepthView = tuple[Pose, Callable[[], Depth]]

MESH_SUFFIXES = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off")
_MAX_VOXELS = 200_000_000
_CHUNK_RAYS = 1_000_000


def fuse_depth(
    views: Iterable[DepthView],
    camera: Camera,
    *,
    voxel_m: float = 0.04,
    truncation_m: float | None = None,
    max_depth_m: float = 6.0,
    progress: Callable[[int], None] | None = None,
) -> Surface:
    """Fuse depth images (16-bit mm along z, 0 = none) into a signed distance volume and return its zero surface.

    Projective TSDF with weights 1/z^2 (Curless and Levoy, SIGGRAPH 1996); truncation 3.5 voxels unless given.
    Lens distortion is respected. Raises SurfaceError when there is no valid depth, or the volume needs more
    than 200 million voxels.
    """
    views = list(views)
    truncation = 3.5 * voxel_m if truncation_m is None else truncation_m
    rays = _pixel_rays(camera)
    low, high = _extent(views, camera, max_depth_m)
    # Voxels stand at multiples of their size: the last bits of the extent do not move the surface.
    low, high = np.floor((low - 2 * truncation) / voxel_m) * voxel_m, high + 2 * truncation
    shape = np.ceil((high - low) / voxel_m).astype(int) + 1
    if float(np.prod(shape.astype(float))) > _MAX_VOXELS:
        raise SurfaceError(
            f"the depth images span {' x '.join(f'{v:.1f}' for v in high - low)} m: too many voxels of {voxel_m:g} m",
            hint="choose larger voxels, or check the scale of the poses",
        )
    distance, weight = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32)
    lookup, scale = _inverse_lookup(camera)
    for done, (map_from_cam, read) in enumerate(views, start=1):
        cam_from_map = map_from_cam.inv()
        box = _frustum_box(map_from_cam, rays, max_depth_m + truncation, low, voxel_m, shape)
        _integrate(
            distance, weight, low, voxel_m, box, cam_from_map.rotation.as_matrix(), cam_from_map.translation,
            lookup, scale, read(), np.float32(truncation), np.float32(max_depth_m),
        )  # fmt: skip
        if progress is not None:
            progress(done)
    return _mesh(distance, weight, low, voxel_m)


def _pixel_rays(camera: Camera) -> Array:
    """Return (n, 3) directions with z = 1 along the border and a coarse grid of the image."""
    u, v = np.meshgrid(np.linspace(0, camera.width, 9), np.linspace(0, camera.height, 9))
    return camera.unproject(np.column_stack([u.ravel(), v.ravel()]))


def _extent(views: list[DepthView], camera: Camera, max_depth_m: float) -> tuple[Array, Array]:
    """Return the lowest and highest corner (3,) of all measured points: what lies beyond them needs no voxels."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = camera.unproject(np.column_stack([u.ravel(), v.ravel()])).astype(np.float32)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for map_from_cam, read in views:
        depth = read().ravel()
        valid = (depth > 0) & (depth <= 1000 * max_depth_m)
        if valid.any():
            points = rays[valid] * (depth[valid, None] * np.float32(0.001))
            points = points @ map_from_cam.rotation.as_matrix().T.astype(np.float32)
            low = np.minimum(low, points.min(axis=0) + map_from_cam.translation)
            high = np.maximum(high, points.max(axis=0) + map_from_cam.translation)
    if not np.isfinite(low).all():
        raise SurfaceError(
            "no depth image has a valid depth", hint="depth is 16-bit PNG in mm along the optical axis, 0 = none"
        )
    return low, high


def _frustum_box(
    map_from_cam: Pose, rays: Array, reach_m: float, low: Array, voxel_m: float, shape: NDArray[np.int_]
) -> NDArray[np.int64]:
    """Return int64[2, 3]: the voxels from .. to that a view can reach."""
    corners = map_from_cam.apply(np.concatenate([[[0.0, 0.0, 0.0]], rays * reach_m]))
    first = np.floor((corners.min(axis=0) - low) / voxel_m).astype(np.int64)
    last = np.ceil((corners.max(axis=0) - low) / voxel_m).astype(np.int64) + 1
    return np.stack([np.clip(first, 0, shape), np.clip(last, 0, shape)])


def _inverse_lookup(camera: Camera) -> tuple[NDArray[np.float32], Array]:
    """Return a table from normalised coordinates to pixels f32[h, w, 2] and its scale (x0, y0, step).

    One table serves every camera model, so that the voxel loop needs no distortion formula.
    """
    edge = _pixel_rays(camera)[:, :2]
    step = 0.5 / max(camera.focal_px)
    x0, y0 = edge.min(axis=0)
    nx, ny = (np.ceil((edge.max(axis=0) - edge.min(axis=0)) / step).astype(int) + 1).tolist()
    x, y = np.meshgrid(x0 + step * np.arange(nx), y0 + step * np.arange(ny))
    pixels = camera.distort(np.column_stack([x.ravel(), y.ravel()])) * camera.focal_px + camera.centre_px
    return pixels.reshape(ny, nx, 2).astype(np.float32), np.array([x0, y0, step])


@numba.njit(cache=True, nogil=True)
def _integrate(  # type: ignore[no-untyped-def]
    distance, weight, low, voxel_m, box, rotation, translation, lookup, scale, depth, truncation, max_depth
):
    rows, columns = lookup.shape[0], lookup.shape[1]
    height, width = depth.shape
    for i in range(box[0, 0], box[1, 0]):
        for j in range(box[0, 1], box[1, 1]):
            for k in range(box[0, 2], box[1, 2]):
                a = low[0] + voxel_m * i
                b = low[1] + voxel_m * j
                c = low[2] + voxel_m * k
                z = rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2] * c + translation[2]
                if z <= 0.05 or z > max_depth + truncation:
                    continue
                x = (rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2] * c + translation[0]) / z
                y = (rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2] * c + translation[1]) / z
                column = math.floor((x - scale[0]) / scale[2] + 0.5)
                row = math.floor((y - scale[1]) / scale[2] + 0.5)
                if row < 0 or column < 0 or row >= rows or column >= columns:
                    continue
                u = math.floor(lookup[row, column, 0])
                v = math.floor(lookup[row, column, 1])
                if u < 0 or v < 0 or u >= width or v >= height:
                    continue
                measured = depth[v, u] * 0.001
                if measured <= 0.0 or measured > max_depth:
                    continue
                behind = measured - z
                if behind < -truncation:
                    continue
                value = min(behind / truncation, 1.0)
                gain = 1.0 / (measured * measured)
                total = weight[i, j, k] + gain
                distance[i, j, k] += (value - distance[i, j, k]) * gain / total
                weight[i, j, k] = total


def _mesh(distance: NDArray[np.float32], weight: NDArray[np.float32], low: Array, voxel_m: float) -> Surface:
    seen = weight > 0
    if not seen.any() or not (distance[seen] < 0).any():
        raise SurfaceError("the depth images contain no surface", hint="check the depth camera and the poses")
    # Only cubes whose eight corners were all seen have a surface; skimage's mask marks a cube by its last corner.
    corners = seen.copy()
    for axis in range(3):
        corners &= np.roll(corners, 1, axis=axis)
    vertices, faces, _, _ = marching_cubes(distance, 0.0, mask=corners, allow_degenerate=False)
    return Surface(low + voxel_m * vertices.astype(np.float64), faces.astype(np.int32), voxel_m)


def coarsen(surface: Surface, *, voxel_m: float) -> Surface:
    """Merge all vertices inside each cell of a grid of ``voxel_m`` into their mean, and drop triangles that vanish."""
    cells = np.floor(surface.vertices / voxel_m).astype(np.int64)
    _, owner = np.unique(cells, axis=0, return_inverse=True)
    owner = owner.ravel()
    count = np.bincount(owner).astype(np.float64)
    vertices = np.stack([np.bincount(owner, weights=surface.vertices[:, k]) / count for k in range(3)], axis=1)
    faces = owner[surface.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return Surface(vertices, faces[np.sort(first)].astype(np.int32), max(voxel_m, surface.voxel_m))


def write_ply(path: Path, surface: Surface) -> None:
    """Write a binary PLY (float32 vertices, int32 triangles)."""
    header = (
        f"ply\nformat binary_little_endian 1.0\ncomment voxel_m {surface.voxel_m:.9g}\n"
        f"element vertex {len(surface.vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(surface.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.zeros(len(surface.faces), dtype=_FACE)
    faces["n"], faces["v"] = 3, surface.faces
    atomic_write(path, header.encode("ascii") + surface.vertices.astype("<f4").tobytes() + faces.tobytes())


_FACE = np.dtype([("n", "u1"), ("v", "<i4", 3)])


def read_ply(path: Path) -> Surface:
    """Read a triangle mesh from a PLY file; raises SurfaceError when it is missing or not a triangle mesh.

    Files of `write_ply` carry their voxel size; for others it is the median edge length.
    """
    path = Path(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise SurfaceError(
            f"{path}: cannot be read: {error.strerror}; expected a PLY mesh", hint="check the path"
        ) from error
    own = _read_own_ply(content)
    return _read_foreign(path) if own is None else own


def _read_own_ply(content: bytes) -> Surface | None:
    end = content.find(b"end_header\n")
    lines = content[: max(end, 0)].decode("ascii", errors="replace").splitlines()
    if len(lines) != 9 or not lines[2].startswith("comment voxel_m "):
        return None
    n, m = int(lines[3].split()[-1]), int(lines[7].split()[-1])
    body = memoryview(content)[end + len(b"end_header\n") :]
    if len(body) != 12 * n + _FACE.itemsize * m:
        return None
    vertices = np.frombuffer(body, dtype="<f4", count=3 * n).reshape(-1, 3)
    faces = np.frombuffer(body, dtype=_FACE, count=m, offset=12 * n)["v"]
    return Surface(
        vertices.astype(np.float64), np.ascontiguousarray(faces, dtype=np.int32), float(lines[2].split()[-1])
    )


def _read_foreign(path: Path) -> Surface:
    import trimesh

    try:
        loaded = trimesh.load(path, process=False, skip_materials=True)
        mesh = loaded.to_mesh() if isinstance(loaded, trimesh.Scene) else loaded
        vertices = np.asarray(mesh.vertices, dtype=np.float64)
        # A cloud of points has no faces at all
        faces = np.asarray(getattr(mesh, "faces", ()), dtype=np.int32)
    except Exception as error:  # trimesh raises many types for damaged files
        raise SurfaceError(f"{path}: not a readable mesh: {error}", hint="check the file") from error
    if faces.ndim != 2 or not len(faces):
        raise SurfaceError(f"{path}: has no triangles; expected a triangle mesh", hint="export the mesh with faces")
    edges = np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1)
    return Surface(vertices, faces, float(np.median(edges)))


def read_mesh(path: Path) -> Surface:
    """Read a triangle mesh of any tool (PLY, OBJ, GLB, GLTF, STL, OFF) as its file has it, without unit or axes.

    Raises SurfaceError when it is missing or has no triangles.
    """
    path = Path(path)
    if path.suffix.lower() == ".ply":
        return read_ply(path)
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise SurfaceError(
            f"{path}: is no mesh file known here; expected {', '.join(MESH_SUFFIXES)}", hint="convert the mesh"
        )
    if not path.is_file():
        raise SurfaceError(f"{path}: no such file; expected a mesh", hint="check the path")
    return _read_foreign(path)


class RayCaster:
    """Rays against a surface, by Embree."""

    def __init__(self, surface: Surface) -> None:
        if not len(surface.faces):
            raise SurfaceError("the surface has no triangles", hint="build the map with depth images")
        self._scene = rtcore_scene.EmbreeScene(robust=True)
        TriangleMesh(self._scene, surface.vertices.astype(np.float32), surface.faces.astype(np.int32))

    def hit_distance(self, origins: ArrayLike, directions: ArrayLike) -> Array:
        """Return the distance (m) from origins (n, 3) along unit directions (n, 3) to the first triangle, or inf."""
        start = np.ascontiguousarray(origins, dtype=np.float32)
        towards = np.ascontiguousarray(directions, dtype=np.float32)
        distance = np.full(len(start), np.inf)
        for first in range(0, len(start), _CHUNK_RAYS):
            rows = slice(first, first + _CHUNK_RAYS)
            found = self._scene.run(start[rows], towards[rows], query="DISTANCE")
            distance[rows] = np.where(found < 1e30, found, np.inf)
        return distance

    def visible(self, origins: ArrayLike, targets: ArrayLike, *, tolerance_m: float) -> NDArray[np.bool_]:
        """Return bool[n]: no surface between origin and target, up to ``tolerance_m`` before the target.

        ``origins`` (n, 3) or one (3,); ``targets`` (n, 3), both in m in the map frame.
        """
        points = np.asarray(targets, dtype=np.float64).reshape(-1, 3)
        start = np.broadcast_to(np.asarray(origins, dtype=np.float64), points.shape)
        away = points - start
        length = np.linalg.norm(away, axis=1)
        hit = self.hit_distance(start, away / np.maximum(length, 1e-12)[:, None])
        return np.asarray(hit >= length - tolerance_m)
