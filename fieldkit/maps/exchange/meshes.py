"""A mesh that another tool made as the surface of a map: read, moved into the map, and held against the landmarks."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import FieldkitError, MapError, SurfaceError
from fieldkit.frames import pose
from fieldkit.maps.io import positive
from fieldkit.maps.landmarks import Model
from fieldkit.store.files import read_text
from fieldkit.surface import RayCaster, read_mesh
from fieldkit.types import Surface

Array = NDArray[np.float64]

UNITS_M: dict[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048, "in": 0.0254}
# The surface's stated resolution, where nobody states it: CAD meshes have edges as long as a wall
_VOXEL_M = (0.01, 0.10)
# Median distance between landmarks and mesh, along the rays of the mapping images: a warning, a refusal
_WARN_M, _REFUSE_M = 0.10, 0.50
_HIDDEN = 0.3
_MAX_RAYS = 20_000


@dataclasses.dataclass(frozen=True)
class ForeignMesh:
    """A mesh file (PLY, OBJ, GLB, STL) and what takes it into the map.

    ``transform`` is a file with map_from_mesh: 16 numbers of a 4x4 matrix, row by row, with a uniform scale if need
    be, or a TUM line; it acts after ``unit`` and ``up`` have made the mesh metric and z up. ``voxel_m`` is its
    resolution, by which the tolerance of occlusion is measured; by default its median edge, within 0.01..0.10 m.
    """

    file: Path
    transform: Path | None = None
    unit: Literal["m", "cm", "mm", "ft", "in"] = "m"
    up: Literal["y", "z"] = "z"
    voxel_m: float | None = None


@dataclasses.dataclass(frozen=True)
class MeshFit:
    """How landmarks lie to a mesh: median distance (m) along the rays that saw them, shares hidden and not hit."""

    median_m: float
    hidden: float
    missed: float


def fit_mesh(mesh: ForeignMesh, model: Model) -> tuple[Surface, list[str]]:
    """Read a mesh, move it into the map and hold it against the landmarks; return it and what a user should know.

    Raises SurfaceError when it cannot be read, and MapError when it lies elsewhere than the landmarks: where another
    unit or axis would fit, the hint says which.
    """
    if mesh.voxel_m is not None:
        positive("mesh voxel_m", mesh.voxel_m)
    found = read_mesh(mesh.file)
    turned = moved(found, _matrix(mesh.unit, mesh.up), mesh)
    fit = mesh_fit(turned, model)
    if fit.median_m > _REFUSE_M:
        raise MapError(
            f"{mesh.file}: half of the landmarks lie {_length(fit.median_m)} or more off its surface; expected a mesh "
            "of this place in the frame of the map",
            hint=_better(found, mesh, model) or "give --mesh-transform with map_from_mesh",
        )
    told = [f"mesh: landmarks lie {100 * fit.median_m:.1f} cm off it (median), voxel_m {turned.voxel_m:.3g}"]
    if fit.median_m > _WARN_M or fit.hidden > _HIDDEN:
        told[0] += f", {100 * fit.hidden:.0f} % of them hidden by it: check --mesh-transform and --mesh-unit"
    return turned, told


def mesh_fit(surface: Surface, model: Model, *, seed: int = 0) -> MeshFit:
    """Follow rays from mapping images to the landmarks they saw, at most 20,000, until they meet the surface.

    A ray that meets nothing counts as infinitely far; a landmark more than 0.25 m behind the surface as hidden.
    """
    centres = np.stack([p.translation for p in model.map_from_image])
    rows = np.arange(len(model.observation_landmark))
    if len(rows) > _MAX_RAYS:
        rows = np.sort(np.random.default_rng(seed).choice(len(rows), _MAX_RAYS, replace=False))
    origins = centres[model.observation_image[rows]]
    rays = model.xyz[model.observation_landmark[rows]] - origins
    distance = np.linalg.norm(rays, axis=1)
    hit = RayCaster(surface).hit_distance(origins, rays / np.maximum(distance, 1e-9)[:, None])
    return MeshFit(
        float(np.median(np.abs(hit - distance))), float((hit < distance - 0.25).mean()), float(np.isinf(hit).mean())
    )


def moved(surface: Surface, matrix: Array, mesh: ForeignMesh) -> Surface:
    """Return a mesh after ``matrix`` (4, 4) and then the mesh's own transform, with its resolution."""
    if mesh.transform is not None:
        matrix = read_transform(mesh.transform) @ matrix
    vertices = surface.vertices @ matrix[:3, :3].T + matrix[:3, 3]
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    voxel_m = mesh.voxel_m or float(np.clip(scale * surface.voxel_m, *_VOXEL_M))
    return Surface(vertices, surface.faces, voxel_m)


def read_transform(path: Path) -> Array:
    """Read map_from_mesh f64[4, 4]: 16 numbers of a matrix with a uniform scale, or a TUM line with or without stamp.

    Raises MapError when it is neither, or a matrix that shears or mirrors.
    """
    text = read_text(path, what="a 4x4 matrix or a TUM line")
    lines = [line for line in text.replace(",", " ").splitlines() if line.split() and not line.lstrip().startswith("#")]
    words = " ".join(lines).replace("[", " ").replace("]", " ").split()
    expected = "expected the 16 numbers of a 4x4 matrix, or a TUM line tx ty tz qx qy qz qw"
    try:
        values = [float(w) for w in (words[1:] if len(words) == 8 else words)]
        if len(values) == 7:
            return np.asarray(pose(values[:3], values[3:]).as_matrix())
    except (ValueError, FieldkitError) as error:
        raise MapError(f"{path}: {error}; {expected}", hint="correct the file") from error
    matrix = np.asarray(values).reshape(4, 4) if len(values) == 16 else np.zeros((4, 4))
    if len(values) != 16 or not np.isfinite(matrix).all() or not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6):
        raise MapError(f"{path}: {len(values)} numbers; {expected}", hint="its last row is 0 0 0 1")
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    if scale <= 0 or not np.allclose(matrix[:3, :3].T @ matrix[:3, :3], scale**2 * np.eye(3), atol=0.01 * scale**2):
        raise MapError(
            f"{path}: its 3x3 part is no rotation times a scale; expected neither mirroring nor shear",
            hint="give map_from_mesh: x_in_map = T x_in_mesh",
        )
    return matrix


def _matrix(unit: str, up: str) -> Array:
    matrix = np.diag([*[UNITS_M[unit]] * 3, 1.0])
    if up == "y":
        matrix[:3, :3] = matrix[:3, :3] @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    return matrix


def _better(found: Surface, mesh: ForeignMesh, model: Model) -> str | None:
    """Return a hint when another unit or axis fits."""
    for unit in UNITS_M:
        for up in ("z", "y"):
            try:
                fit = mesh_fit(moved(found, _matrix(unit, up), mesh), model)
            except SurfaceError:
                continue
            if fit.median_m < _WARN_M:
                return f"it fits with --mesh-unit {unit} --mesh-up {up}"
    return None


def _length(value_m: float) -> str:
    return f"{value_m:.2f} m" if np.isfinite(value_m) else "infinitely far"
