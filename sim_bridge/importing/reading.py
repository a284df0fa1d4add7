"""Read a mesh file: triangles in the file's own frame and unit, and what each part of it looks like."""

from __future__ import annotations

import codecs
import dataclasses
import io
import json
import logging
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.resolvers import FilePathResolver

from sim_bridge.errors import SynthesisError
from sim_bridge.mesh import Rgb

Array = NDArray[np.float64]

SUFFIXES = (".glb", ".obj", ".ply")
# Compression of geometry that is not read; images in another compression are only missing.
_PACKED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_mesh_quantization")
# The header of a PLY is shorter.
_HEADER_BYTES = 1 << 16


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


@dataclasses.dataclass(frozen=True, eq=False)
class _File:
    """What is known of a file while its parts are read: names of materials without their image, pixels of images."""

    path: Path
    lost: frozenset[str]
    images: dict[int, Rgb | None]

    @property
    def is_gltf(self) -> bool:
        return self.path.suffix.lower() == ".glb"


def read_parts(path: Path) -> list[Part]:
    """Return the parts of a GLB, OBJ or PLY file; raises SynthesisError when it cannot be read or has no faces."""
    if path.suffix.lower() not in SUFFIXES:
        raise SynthesisError(
            f"{path}: unknown kind of mesh {path.suffix!r}; expected {', '.join(SUFFIXES)}",
            hint="save the mesh as GLB, OBJ or PLY",
        )
    try:
        if not path.is_file():
            raise SynthesisError(f"{path}: no such file; expected a mesh", hint="check the path")
        lost = _check_packing(path) if path.suffix.lower() == ".glb" else _lost_images(path)
    except OSError as error:
        raise SynthesisError(
            f"{path}: cannot be read ({error.strerror or error}); expected a mesh",
            hint="check the path and its permissions",
        ) from error
    scene = _load(path)
    parts = [part for part in _parts(scene, _File(path, lost, {})) if len(part.faces)]
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
        source, resolver = _as_utf8(path), _Neighbours(str(path))
        return trimesh.load_scene(source, file_type=path.suffix[1:].lower(), resolver=resolver, process=False)
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


class _Neighbours(FilePathResolver):  # type: ignore[misc]
    """The files beside a mesh, its materials as UTF-8."""

    def get(self, name: str) -> bytes:
        """Return a file's bytes; raises FileNotFoundError where there is none."""
        data = cast(bytes, super().get(name))
        return _recoded(data) if name.strip().lower().endswith(".mtl") else data


def _as_utf8(path: Path) -> Path | io.BytesIO:
    """Return what to read a mesh from: its file, or a copy where its text is in an older encoding than UTF-8."""
    if path.suffix.lower() == ".obj" and _encoding(path) != "utf-8":
        return io.BytesIO(_recoded(path.read_bytes()))
    if path.suffix.lower() == ".ply":
        with path.open("rb") as file:
            head, end, _ = file.read(_HEADER_BYTES).partition(b"end_header")
        if end and _recoded(head) != head:
            return io.BytesIO(_recoded(head) + path.read_bytes()[len(head) :])
    return path


def _recoded(text: bytes) -> bytes:
    try:
        text.decode("utf-8")
    except UnicodeDecodeError:
        return text.decode("latin-1").encode()
    return text


def _encoding(path: Path) -> str:
    """Return utf-8, or latin-1 for a text that is no UTF-8: comments and names of older programs."""
    decoder = codecs.getincrementaldecoder("utf-8")()
    try:
        with path.open("rb") as file:
            while block := file.read(1 << 20):
                decoder.decode(block)
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8"


def _check_packing(path: Path) -> frozenset[str]:
    """Raise SynthesisError for a GLB whose geometry is compressed; what else is wrong the reader tells."""
    with path.open("rb") as file:
        head = file.read(20)
        if len(head) == 20 and head[:4] == b"glTF":
            try:
                required = json.loads(file.read(struct.unpack("<I", head[12:16])[0])).get("extensionsRequired", [])
            except (ValueError, AttributeError):
                return frozenset()
            # What is no list here is as good as none.
            packed = [name for name in _PACKED if isinstance(required, list) and name in required]
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
        for key, value in _lines(materials) if _is_there(materials) else ():
            if key == "newmtl":
                name = value
            elif key == "map_kd" and not _is_there(path.parent / value.replace("\\", "/")):
                lost.add(name)
    return frozenset(lost)


def _is_there(path: Path) -> bool:
    """Return whether a file can be read."""
    try:
        with path.open("rb"):
            return True
    except OSError:
        return False


def _values(path: Path, key: str) -> list[str]:
    return [value for name, value in _lines(path) if name == key]


def _lines(path: Path) -> Iterator[tuple[str, str]]:
    with path.open(encoding=_encoding(path)) as file:
        for line in file:
            key, _, value = line.strip().partition(" ")
            if key[:1].isalpha():
                yield key.lower(), value.strip()


def _parts(scene: trimesh.Scene, file: _File) -> Iterator[Part]:
    for node in scene.graph.nodes_geometry:
        file_from_part, name = scene.graph[node]
        mesh = scene.geometry[name]
        if not isinstance(mesh, trimesh.Trimesh):
            continue
        matrix = np.asarray(file_from_part, dtype=np.float64)
        # What is not finite is refused with the whole scene, in one line.
        with np.errstate(invalid="ignore"):
            vertices = np.asarray(mesh.vertices, dtype=np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        wanted = np.asarray(mesh.faces).reshape(-1, 3)
        _check_corners(file.path, wanted, len(vertices))
        faces = np.ascontiguousarray(wanted, dtype=np.int32)
        yield _oriented(Part(vertices, faces, **_look(mesh, faces, file)), matrix)


def _check_corners(path: Path, faces: NDArray[Any], count: int) -> None:
    wrong = faces[(faces < 0) | (faces >= count)]
    if len(wrong):
        raise SynthesisError(
            f"{path}: a face has vertex {wrong[0]} of {count}; expected 0..{count - 1}",
            hint="repair the mesh, or export it again",
        )


def _oriented(part: Part, matrix: Array) -> Part:
    """Return a part whose faces have their front where the file has it, although its matrix mirrors."""
    if np.linalg.det(matrix[:3, :3]) >= 0.0:
        return part
    uv = None if part.uv is None else part.uv[:, ::-1]
    colours = None if part.corner_rgb is None else part.corner_rgb[:, ::-1]
    return dataclasses.replace(part, faces=np.ascontiguousarray(part.faces[:, ::-1]), uv=uv, corner_rgb=colours)


def _look(mesh: trimesh.Trimesh, faces: NDArray[np.int32], file: _File) -> dict[str, Any]:
    """Return the fields of a part that say what it looks like."""
    visual = mesh.visual
    if visual.kind in ("vertex", "face"):
        colours = np.asarray(visual.vertex_colors if visual.kind == "vertex" else visual.face_colors, np.uint8)[:, :3]
        if file.is_gltf:
            colours = _bytes(_encoded(colours / 255.0))
        each = colours[faces] if visual.kind == "vertex" else np.repeat(colours[:, None], 3, axis=1)
        return {"corner_rgb": np.ascontiguousarray(each)}
    material = getattr(visual, "material", None)
    uv = getattr(visual, "uv", None)
    if material is None or _is_stand_in(material):
        return {"missing": True}
    picture = material.baseColorTexture if hasattr(material, "baseColorTexture") else getattr(material, "image", None)
    factor = _factor(material)
    if picture is not None and uv is not None:
        if id(picture) not in file.images:
            file.images[id(picture)] = _pixels(picture)
        image = file.images[id(picture)]
        if image is not None:
            # What is no number shows some texel; what is infinite is refused later.
            corners = np.nan_to_num(np.asarray(uv, dtype=np.float64)[faces], posinf=np.inf, neginf=-np.inf)
            return {"image": _tinted(image, factor), "uv": corners * (1.0, -1.0) + (0.0, 1.0)}
        return {"missing": True}
    beside = getattr(visual, "vertex_attributes", {}).get("color") if file.is_gltf and picture is None else None
    if beside is not None:
        return {"corner_rgb": _bytes(_encoded(_linear(beside)) * (factor or (1.0, 1.0, 1.0)))[faces]}
    # White with texture coordinates is what remains where an image was not found.
    white = factor is None or min(factor) > 0.999
    if picture is not None or material.name in file.lost or (white and uv is not None):
        return {"missing": True}
    return {"rgb": tuple(round(255 * c) for c in factor) if factor else (255, 255, 255)}


def _is_stand_in(material: Any) -> bool:
    """Return whether the reader made a material up, as it does for an OBJ or PLY whose own is not there."""
    image = getattr(material, "image", None)
    return image is not None and getattr(image, "format", None) is None


def _factor(material: Any) -> tuple[float, float, float] | None:
    """Return the colour of a material, gamma encoded, 0..1; None where it has none."""
    if hasattr(material, "baseColorFactor"):
        value = material.baseColorFactor
        if value is None:
            return None
        # glTF's factors are linear.
        r, g, b = _encoded(np.asarray(value, dtype=np.float64)[:3] / 255.0)
        return float(r), float(g), float(b)
    if getattr(material, "image", None) is not None or getattr(material, "diffuse", None) is None:
        return None
    r, g, b = np.asarray(material.diffuse, dtype=np.float64)[:3] / 255.0
    return float(r), float(g), float(b)


def _linear(colours: NDArray[Any]) -> Array:
    """Return the red, green and blue of glTF's colours per vertex, 0..1, of whichever type they are stored in."""
    most = np.iinfo(colours.dtype).max if colours.dtype.kind in "iu" else 1.0
    return np.clip(np.nan_to_num(colours[:, :3].astype(np.float64)) / most, 0.0, 1.0)


def _encoded(linear: Array) -> Array:
    """Return linear colours 0..1 gamma encoded, as sRGB (IEC 61966-2-1) has it."""
    return np.where(linear < 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def _bytes(colours: Array) -> Rgb:
    return np.rint(255.0 * colours).astype(np.uint8)


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
