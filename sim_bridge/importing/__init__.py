"""Scenes from meshes of one's own: scans and models as GLB, OBJ or PLY."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sim_bridge.errors import SynthesisError
from sim_bridge.importing.colours import paint
from sim_bridge.importing.floor import ROBOT_RADIUS_M, SMALLEST_M2, Floor, find_floor
from sim_bridge.importing.reading import Part, read_parts
from sim_bridge.mesh import Scene

__all__ = ["Axis", "MeshOptions", "Unit", "import_scene", "is_mesh"]

Array = NDArray[np.float64]
Axis = Literal["y", "z"]
Unit = Literal["m", "mm", "cm"]

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
# A building's smallest side is less than the first, its largest side within the others.
TALLEST_M, SMALLEST_M, LARGEST_M = 40.0, 1.2, 1000.0
# Coordinates far from zero (of a map's grid) lose their last digits.
FAR_M = 1000.0
# No face shows so many repeats of its texture: a floor of 100 m with tiles of 10 cm.
MOST_SPAN = 1000.0
# How much more y than z has to look like up before that is said, and before it is refused.
DOUBT, SURE = 0.1, 0.6
# Rooms are this high and more, and hardly higher than that.
LOW_M, HIGH_M = 2.2, 3.5

_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class MeshOptions:
    """Which axis of a mesh is up and the unit of its coordinates; None where that is to be metres and z, checked."""

    up: Axis | None = None
    unit: Unit | None = None


def is_mesh(name: str) -> bool:
    """Return whether the name of a scene is the path of a file."""
    path = Path(name)
    return bool(path.suffix) or len(path.parts) > 1


def import_scene(path: Path, options: MeshOptions | None = None) -> Scene:
    """Return the scene of a mesh file: metres, z up, its largest floor at z = 0; lit as its textures are.

    Raises SynthesisError, with what to give instead, for a file that is none or has no faces, for coordinates that
    are no numbers, not in metres or have y up, and where no floor is wide enough for a robot.
    """
    chosen = options or MeshOptions()
    parts = _checked(path, read_parts(path))
    parts = [dataclasses.replace(p, vertices=p.vertices * METRES[chosen.unit or "m"]) for p in parts]
    bounds = _bounds(parts)
    _check_size(path, bounds[1] - bounds[0], chosen)
    if chosen.up == "y":
        parts = [dataclasses.replace(p, vertices=_raised(p.vertices)) for p in parts]
    parts = _near_zero(path, parts)
    _warn_of_missing(path, parts)
    painted = paint(parts)
    scene = Scene(
        vertices=painted.vertices,
        faces=painted.faces,
        uv=painted.uv,
        texture=painted.texture,
        textures=painted.textures,
        closed=np.zeros(len(painted.faces), np.bool_),
        shade=painted.shade,
        blocks=np.zeros((0, 8)),
        walk_xy=np.zeros((0, 2)),
        floor_bounds=(0.0, 0.0, 0.0, 0.0),
    )
    floor = find_floor(scene)
    if chosen.up is None:
        _check_axis(path, scene, floor)
    return _on_floor(path, scene, floor)


def _on_floor(path: Path, scene: Scene, floor: Floor | None) -> Scene:
    """Return the scene moved so that its floor lies at z = 0, with what is free on it."""
    if floor is None or floor.driven_m2 < SMALLEST_M2:
        found = "no floor" if floor is None else f"largest free disc {floor.widest_m:.2f} m in radius"
        raise SynthesisError(
            f"{path}: no free floor above the robot's width ({found}); expected {SMALLEST_M2:g} m2 and more for a "
            f"disc of {ROBOT_RADIUS_M:g} m",
            hint="check the mesh's floor, its unit (--unit) and up axis (--up)",
        )
    low, high = scene.bounds
    size = " x ".join(f"{s:.2f}" for s in high - low)
    # Zero has no sign.
    where = f"floor at z = {round(floor.level_m, 2) + 0.0:.2f} m with {floor.free_m2:.0f} m2 free"
    _log.info("%s: %d faces, %s m, %s", path, len(scene.faces), size, where)
    return dataclasses.replace(
        scene,
        vertices=scene.vertices - [0.0, 0.0, floor.level_m],
        floor_bounds=floor.bounds,
        clearance=floor.clearance,
    )


def _checked(path: Path, parts: list[Part]) -> list[Part]:
    """Return parts without faces that have no area; raises SynthesisError where a vertex is no number."""
    wrong = sum(int((~np.isfinite(p.vertices)).any(axis=1).sum()) for p in parts)
    if wrong:
        total = sum(len(p.vertices) for p in parts)
        raise SynthesisError(
            f"{path}: {wrong} of {total} vertices are not finite; expected numbers", hint="repair or export it again"
        )
    _check_repeats(path, parts)
    kept = [_with_area(p) for p in parts]
    kept = [p for p in kept if len(p.faces)]
    if not kept:
        raise SynthesisError(f"{path}: a mesh whose faces have no area; expected triangles", hint="export it again")
    return kept


def _check_repeats(path: Path, parts: Sequence[Part]) -> None:
    """Raise SynthesisError for texture coordinates that cannot be meant: a face with too many repeats of its image."""
    spans = [np.zeros(0)]
    for part in parts:
        if part.uv is not None:
            low, high = part.uv.min(axis=1), part.uv.max(axis=1)
            # An endless coordinate is no number less itself.
            with np.errstate(invalid="ignore"):
                spans.append(np.nan_to_num((high - low).max(axis=1), nan=np.inf, posinf=np.inf))
    every = np.concatenate(spans)
    wrong = int((every > MOST_SPAN).sum())
    if wrong:
        raise SynthesisError(
            f"{path}: {wrong} of {len(every)} faces repeat their texture up to {every.max():.3g} times; "
            f"expected {MOST_SPAN:g} at most",
            hint="repair the texture coordinates, or export it again",
        )


def _with_area(part: Part) -> Part:
    a, b, c = (part.vertices[part.faces[:, k]] for k in range(3))
    good = np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0.0
    if good.all():
        return part
    uv = None if part.uv is None else part.uv[good]
    colours = None if part.corner_rgb is None else part.corner_rgb[good]
    return dataclasses.replace(part, faces=part.faces[good], uv=uv, corner_rgb=colours)


def _bounds(parts: Sequence[Part]) -> Array:
    """Return the lowest and highest corner f64[2,3] of what faces use."""
    used = [p.vertices[np.unique(p.faces)] for p in parts]
    return np.stack([np.min([v.min(axis=0) for v in used], axis=0), np.max([v.max(axis=0) for v in used], axis=0)])


def _near_zero(path: Path, parts: list[Part]) -> list[Part]:
    """Return parts whose coordinates keep their digits in single precision: a mesh far from zero is moved there."""
    middle = np.rint(_bounds(parts).mean(axis=0))
    if np.abs(middle).max() < FAR_M:
        return parts
    _log.info("%s: moved by (%.0f, %.0f, %.0f) m to where coordinates are small", path, *-middle)
    return [dataclasses.replace(p, vertices=p.vertices - middle) for p in parts]


def _check_size(path: Path, size: Array, options: MeshOptions) -> None:
    unit = options.unit or "m"
    said = f"{path}: {' x '.join(f'{s:.4g}' for s in size)} m" + ("" if unit == "m" else f" after --unit {unit}")
    if size.max() > LARGEST_M or size.min() > TALLEST_M:
        # A storey is 2 m and more: hardly less than 1500 mm, hardly 1500 cm.
        better = "mm" if np.sort(size)[0] > 1500.0 else "cm"
        hint = f"--unit {better}" if options.unit is None else "another --unit"
        raise SynthesisError(f"{said}, too large for a building; expected metres", hint=f"give {hint}")
    if size.max() < SMALLEST_M:
        hint = "give another --unit" if unit != "m" else "scale the mesh to metres"
        raise SynthesisError(f"{said}, too small for a room; expected metres", hint=hint)


def _check_axis(path: Path, scene: Scene, floor: Floor | None) -> None:
    """Raise SynthesisError where y is clearly up: with it there is more floor, and a likelier ceiling above it."""
    other = find_floor(dataclasses.replace(scene, vertices=_raised(scene.vertices)))
    if other is None or other.driven_m2 < SMALLEST_M2:
        return
    area, height = (floor.area_m2, floor.height_m) if floor is not None else (0.0, LOW_M)
    evidence = np.log(other.area_m2 / max(area, 0.1)) + _unlikely(height) - _unlikely(other.height_m)
    seems = f"{other.area_m2:.0f} m2 of floor {other.height_m:.1f} m high; with z up {area:.0f} m2, {height:.1f} m"
    if evidence > SURE:
        raise SynthesisError(
            f"{path}: y seems to be up ({seems}); expected z up", hint="give --up y, or --up z if z is up"
        )
    if evidence > DOUBT and floor is not None and floor.driven_m2 >= SMALLEST_M2:
        _log.warning("%s: taken with z up, but y may be up (%s): then give --up y", path, seems)


def _unlikely(height_m: float) -> float:
    """Return how unlikely a room of this height is: steeply so below LOW_M, slowly above HIGH_M."""
    return float(3.0 * np.log(max(LOW_M / max(height_m, 0.1), 1.0)) + np.log(max(height_m / HIGH_M, 1.0)))


def _raised(vertices: Array) -> Array:
    """Return vertices (n, 3) with y up turned so that z is up."""
    return np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]], axis=1)


def _warn_of_missing(path: Path, parts: Sequence[Part]) -> None:
    missing = [p for p in parts if p.missing]
    if missing:
        faces = sum(len(p.faces) for p in missing)
        share = 100.0 * faces / sum(len(p.faces) for p in parts)
        _log.warning(
            "%s: no texture for %d of %d parts (%d faces, %.1f %%): they are grey", path, len(missing), len(parts),
            faces, share,
        )  # fmt: skip
