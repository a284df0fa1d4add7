"""Read a mesh file: triangles in the file's own frame and unit, and what each part of it looks like."""

from __future__ import annotations

import dataclasses
import json
import logging
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from sim_bridge.errors import SynthesisError
from sim_bridge.mesh import Rgb

Array = NDArray[np.float64]

SUFFIXES = (".glb", ".obj", ".ply")
# Compression of geometry that is not read; images in another compression are only missing.
_PACKED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_mesh_quantization")


@dataclasses.dataclass(frozen=True, eq=False)
class Part:
    """A part of a mesh with one look: vertices f64[n,3], faces i32[m,3], and one of the following.

    An ``image`` with ``uv`` f64[m,3,2] per face corner, v downwards, repeated outside 0..1; colours ``corner_rgb``
    uint8[m,3,3] per face corner; else one colour ``rgb``. ``missing`` says that an image should be there and is not.
    """

    vertices: Array
    faces: NDArray[np.int32]
    image: Rgb | None = None
    uv: Array | None = None
    corner_rgb: Rgb | None = None
    rgb: tuple[int, int, int] | None = None
    missing: bool = False


def read_parts(path: Path) -> list[Part]:
    """Return the parts of a GLB, OBJ or PLY file; raises SynthesisError when it cannot be read or has no faces."""
    if path.suffix.lower() not in SUFFIXES:
        raise SynthesisError(
            f"{path}: unknown kind of mesh {path.suffix!r}; expected {', '.join(SUFFIXES)}",
            hint="save the mesh as GLB, OBJ or PLY",
        )
    if not path.is_file():
        raise SynthesisError(f"{path}: no such file; expected a mesh", hint="check the path")
    lost = _check_packing(path) if path.suffix.lower() == ".glb" else _lost_images(path)
    scene = _load(path)
    parts = [part for part in _parts(scene, lost) if len(part.faces)]
    if not parts:
        points = sum(len(g.vertices) for g in scene.geometry.values() if hasattr(g, "vertices"))
        raise SynthesisError(
            f"{path}: a mesh without faces ({points} points); expected triangles",
            hint="give the textured mesh, not the point cloud",
        )
    return parts


def _load(path: Path) -> trimesh.Scene:
    quiet = logging.getLogger("trimesh")
    level = quiet.level
    # What trimesh has to say is said here in one line.
    quiet.setLevel(logging.CRITICAL)
    try:
        return trimesh.load_scene(path, process=False)
    except MemoryError:
        raise
    except Exception as error:
        reason = (str(error).strip().splitlines() or [""])[0][:120]
        raise SynthesisError(
            f"{path}: cannot be read as {path.suffix[1:].upper()} ({type(error).__name__}: {reason})",
            hint="open it in a mesh viewer, and save it again",
        ) from error
    finally:
        quiet.setLevel(level)


def _check_packing(path: Path) -> frozenset[str]:
    """Raise SynthesisError for a GLB whose geometry is compressed; what else is wrong the reader tells."""
    with path.open("rb") as file:
        head = file.read(20)
        if len(head) == 20 and head[:4] == b"glTF":
            try:
                required = json.loads(file.read(struct.unpack("<I", head[12:16])[0])).get("extensionsRequired", [])
            except (ValueError, AttributeError):
                return frozenset()
            packed = [name for name in required if name in _PACKED]
            if packed:
                raise SynthesisError(
                    f"{path}: geometry is compressed ({packed[0]}); expected plain triangles",
                    hint="export it again without compression",
                )
    return frozenset()


def _lost_images(path: Path) -> frozenset[str]:
    """Return the names of an OBJ's materials whose image is not there."""
    if path.suffix.lower() != ".obj":
        return frozenset()
    lost = set()
    for library in _values(path, "mtllib"):
        name, materials = "", path.parent / library
        for key, value in _lines(materials) if materials.is_file() else ():
            if key == "newmtl":
                name = value
            elif key == "map_kd" and not (path.parent / value.replace("\\", "/")).is_file():
                lost.add(name)
    return frozenset(lost)


def _values(path: Path, key: str) -> list[str]:
    return [value for name, value in _lines(path) if name == key]


def _lines(path: Path) -> Iterator[tuple[str, str]]:
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            key, _, value = line.strip().partition(" ")
            if key[:1].isalpha():
                yield key.lower(), value.strip()


def _parts(scene: trimesh.Scene, lost: frozenset[str]) -> Iterator[Part]:
    images: dict[int, Rgb | None] = {}
    for node in scene.graph.nodes_geometry:
        file_from_part, name = scene.graph[node]
        mesh = scene.geometry[name]
        if not isinstance(mesh, trimesh.Trimesh):
            continue
        matrix = np.asarray(file_from_part, dtype=np.float64)
        vertices = np.asarray(mesh.vertices, dtype=np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        faces = np.ascontiguousarray(mesh.faces, dtype=np.int32).reshape(-1, 3)
        yield Part(vertices, faces, **_look(mesh, faces, images, lost))


def _look(
    mesh: trimesh.Trimesh, faces: NDArray[np.int32], images: dict[int, Rgb | None], lost: frozenset[str]
) -> dict[str, Any]:
    """Return the fields of a part that say what it looks like."""
    visual = mesh.visual
    if visual.kind in ("vertex", "face"):
        colours = np.asarray(visual.vertex_colors if visual.kind == "vertex" else visual.face_colors, np.uint8)[:, :3]
        each = colours[faces] if visual.kind == "vertex" else np.repeat(colours[:, None], 3, axis=1)
        return {"corner_rgb": np.ascontiguousarray(each)}
    material = getattr(visual, "material", None)
    uv = getattr(visual, "uv", None)
    if material is None:
        return {"missing": True}
    picture = material.baseColorTexture if hasattr(material, "baseColorTexture") else getattr(material, "image", None)
    factor = _factor(material)
    if picture is not None and uv is not None:
        if id(picture) not in images:
            images[id(picture)] = _pixels(picture)
        image = images[id(picture)]
        if image is not None:
            corners = np.nan_to_num(np.asarray(uv, dtype=np.float64)[faces])
            return {"image": _tinted(image, factor), "uv": corners * (1.0, -1.0) + (0.0, 1.0)}
        return {"missing": True}
    # White with texture coordinates is what remains where an image was not found.
    white = factor is None or min(factor) > 0.999
    if picture is not None or material.name in lost or (white and uv is not None):
        return {"missing": True}
    return {"rgb": tuple(round(255 * c) for c in factor) if factor else (255, 255, 255)}


def _factor(material: Any) -> tuple[float, float, float] | None:
    """Return the colour of a material, gamma encoded, 0..1; None where it has none."""
    if hasattr(material, "baseColorFactor"):
        value = material.baseColorFactor
        if value is None:
            return None
        # glTF's factors are linear.
        linear = np.asarray(value, dtype=np.float64)[:3] / 255.0
        r, g, b = np.where(linear < 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        return float(r), float(g), float(b)
    if getattr(material, "image", None) is not None or getattr(material, "diffuse", None) is None:
        return None
    r, g, b = np.asarray(material.diffuse, dtype=np.float64)[:3] / 255.0
    return float(r), float(g), float(b)


def _pixels(picture: Any) -> Rgb | None:
    """Return the RGB pixels of a picture, None where it is broken."""
    try:
        return np.ascontiguousarray(picture.convert("RGB"), dtype=np.uint8)
    except (OSError, SyntaxError, ValueError):
        return None


def _tinted(image: Rgb, factor: tuple[float, float, float] | None) -> Rgb:
    if factor is None or min(factor) > 0.999:
        return image
    tinted: Rgb = np.rint(image * np.asarray(factor)).astype(np.uint8)
    return tinted
