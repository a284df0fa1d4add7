"""Meshes of others as scenes: GLB, OBJ and PLY files with textures or vertex colours, checked before they are used."""

from __future__ import annotations

import dataclasses
import logging
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_bridge.errors import SynthesisError
from sim_bridge.mesh import Array, Rgb, Scene
from sim_bridge.scenes.appearance import Skin, copies, cut, skin_of, wrapped

Up = Literal["z", "y"]
Unit = Literal["m", "cm", "mm"]

SUFFIXES = (".glb", ".gltf", ".obj", ".ply")
UNITS_M: dict[Unit, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001}
# A building's extents in m: more than the first, less than the second.
LEAST_EXTENT_M, MOST_EXTENT_M = 1.5, 500.0
# Textures are made smaller until they have no more texels than this in all.
MOST_TEXELS = 100_000_000
# Another axis than z is up when this many times more of the mesh lies in one plane across it.
UP_RATIO = 1.5

_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class MeshOptions:
    """How a mesh file is read: its unit, and which axis points up; None checks that it is in m with z up."""

    unit: Unit | None = None
    up: Up | None = None


@dataclasses.dataclass(frozen=True)
class _Part:
    """A part of a mesh file in m, z up: ``vertices`` f64[n,3], ``faces`` int64[m,3], and what it looks like."""

    vertices: Array
    faces: NDArray[np.int64]
    skin: Skin


def is_mesh(name: str) -> bool:
    """Return whether a scene's name is that of a mesh file."""
    return Path(name).suffix.lower() in SUFFIXES


def import_mesh(path: Path, options: MeshOptions | None = None) -> Scene:
    """Read a mesh file as a scene without blocks or walk; its floor bounds are the mesh's.

    Colours are taken as they are: a scan brings its own light. Missing textures are grey, with a warning in the log.
    Raises SynthesisError, in one line, for a file that cannot be read, has no faces or NaN vertices, or whose unit or
    up axis is not what it should be.
    """
    chosen, path = options or MeshOptions(), Path(path)
    parts = list(_parts(path))
    if not sum(len(part.faces) for part in parts):
        raise SynthesisError(f"{path}: no faces; expected a mesh of triangles", hint="make a mesh of the points first")
    bad = sum(int((~np.isfinite(part.vertices)).any(axis=1).sum()) for part in parts)
    if bad:
        count = sum(len(part.vertices) for part in parts)
        raise SynthesisError(
            f"{path}: {bad} of {count} vertices are not numbers; expected coordinates in m",
            hint="remove them, for example with MeshLab's 'Remove duplicate and degenerate' filters",
        )
    parts = [dataclasses.replace(part, vertices=_in_world(part.vertices, chosen)) for part in parts]
    _check_extent(path, parts, chosen)
    if chosen.up is None:
        _check_up(path, parts)
    _warn_missing(path, parts)
    return _scene(path, parts)


def _parts(path: Path) -> Iterator[_Part]:
    import trimesh

    if path.suffix.lower() not in SUFFIXES:
        raise SynthesisError(f"{path}: unknown kind of mesh; expected one of {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise SynthesisError(f"{path}: no such file", hint="give the path of a mesh or the name of a scene")
    _refuse_bad_text(path)
    try:
        loaded = trimesh.load_scene(path, process=False)
    # The readers of many formats raise whatever they stumble over.
    except Exception as error:
        reason = " ".join(str(error).split())[:100]
        raise SynthesisError(
            f"{path}: cannot be read as {path.suffix[1:]} ({reason})", hint="export it again"
        ) from error
    gone = _gone_textures(path)
    for node in loaded.graph.nodes_geometry:
        world_from_part, name = loaded.graph[node]
        geometry: Any = loaded.geometry[name]
        if not isinstance(geometry, trimesh.Trimesh) or not len(geometry.faces):
            continue
        material = getattr(getattr(geometry.visual, "material", None), "name", None)
        vertices = trimesh.transform_points(geometry.vertices, world_from_part)
        faces = np.asarray(geometry.faces, dtype=np.int64)
        yield _Part(np.asarray(vertices), faces, skin_of(geometry, missing=material in gone))


def _refuse_bad_text(path: Path) -> None:
    """Refuse an OBJ file with coordinates that are not numbers: its reader leaves such lines out."""
    if path.suffix.lower() != ".obj":
        return
    with path.open(encoding="utf-8", errors="replace") as lines:
        bad = sum(1 for line in lines if line.startswith("v ") and re.search(r"nan|inf", line, re.IGNORECASE))
    if bad:
        raise SynthesisError(
            f"{path}: {bad} vertices are not numbers; expected coordinates in m", hint="remove them with a mesh editor"
        )


def _gone_textures(path: Path) -> set[str]:
    """Return the names of an OBJ file's materials whose textures are not where they should be."""
    gone: set[str] = set()
    if path.suffix.lower() != ".obj":
        return gone
    with path.open(encoding="utf-8", errors="replace") as lines:
        libraries = [line.split(maxsplit=1)[1].strip() for line in lines if line.startswith("mtllib ")]
    for library in libraries:
        file = path.parent / library
        material = ""
        for line in file.read_text("utf-8", "replace").splitlines() if file.is_file() else ():
            words = line.split()
            if len(words) > 1 and words[0] == "newmtl":
                material = line.split(maxsplit=1)[1].strip()
            elif len(words) > 1 and words[0].lower() == "map_kd" and not (path.parent / words[-1]).is_file():
                gone.add(material)
    return gone


def _in_world(vertices: Array, options: MeshOptions) -> Array:
    metres = vertices * UNITS_M[options.unit or "m"]
    return metres if options.up != "y" else np.stack([metres[:, 0], -metres[:, 2], metres[:, 1]], axis=1)


def _check_extent(path: Path, parts: Sequence[_Part], options: MeshOptions) -> None:
    """Refuse what is too large or too small for rooms in m, and say which unit would make sense."""
    points = [part.vertices[part.faces.ravel()] for part in parts]
    low, high = np.min([p.min(axis=0) for p in points], axis=0), np.max([p.max(axis=0) for p in points], axis=0)
    extent = np.sort(high - low)
    if extent[0] >= 0.5 and extent[1] >= LEAST_EXTENT_M and extent[2] <= MOST_EXTENT_M and extent[0] <= 60.0:
        return
    size = " x ".join(f"{e:.3g}" for e in high - low)
    hint = "scale it to metres"
    if options.unit is None:
        # Storeys are about 3 m high.
        guesses: dict[Unit, float] = {unit: abs(float(np.log(extent[0] * m / 3.0))) for unit, m in UNITS_M.items()}
        likely = min(guesses, key=lambda unit: guesses[unit])
        if likely != "m":
            hint = f"if it is in {likely}, say --unit {likely}"
    raise SynthesisError(f"{path}: {size} m is no size of a building; expected metres", hint=hint)


def _check_up(path: Path, parts: Sequence[_Part]) -> None:
    """Refuse a mesh whose largest level plane, which should be the floor, lies across another axis than z."""
    corners = np.concatenate([part.vertices[part.faces] for part in parts])
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1)
    middle = corners.mean(axis=1)
    largest = np.zeros(3)
    for axis in range(3):
        across = np.abs(normal[:, axis]) > 0.95 * np.maximum(length, 1e-12)
        if across.any():
            bins = np.floor((middle[across, axis] - middle[across, axis].min()) / 0.15).astype(int)
            largest[axis] = np.bincount(bins, weights=length[across]).max()
    extent = np.ptp(middle, axis=0)
    axis = int(np.argmax(largest))
    if axis != 2 and largest[axis] > UP_RATIO * largest[2] and extent[axis] < extent[2]:
        raise SynthesisError(
            f"{path}: {'xy'[axis]} seems to be up; expected z up",
            hint="say --up y, or --up z if it is right as it is" if axis == 1 else "turn the mesh, or say --up z",
        )


def _warn_missing(path: Path, parts: Sequence[_Part]) -> None:
    missing = [part for part in parts if part.skin.missing]
    if missing:
        faces = sum(len(part.faces) for part in missing)
        share = 100.0 * faces / sum(len(part.faces) for part in parts)
        _log.warning(
            "%s: %d of %d parts have no texture or colour and become grey (%.1f %% of the faces)",
            path, len(missing), len(parts), share,
        )  # fmt: skip


def _scene(path: Path, parts: Sequence[_Part]) -> Scene:
    """Join parts; textures that repeat are repeated, and triangles cut where that is not enough."""
    numbers: dict[object, int] = {}
    spans: dict[object, NDArray[np.int64]] = {}
    images: list[Rgb] = []
    for part in parts:
        key = part.skin.key
        if key not in numbers:
            numbers[key] = len(images)
            images.append(part.skin.image)
        span = wrapped(part.skin.uv)[1].max(axis=0, initial=1)[None]
        spans[key] = np.maximum(spans.get(key, span), span)
    images = _within_budget(path, images)
    tiles = {key: copies(images[number], spans[key]) for key, number in numbers.items()}
    textures = tuple(np.tile(images[number], (tiles[key][1], tiles[key][0], 1)) for key, number in numbers.items())
    first = 0
    joined: list[tuple[Array, NDArray[np.int64], Array, Array, NDArray[np.int32]]] = []
    for part in parts:
        vertices, faces, uv, shade = _unwrapped(part, tiles[part.skin.key])
        joined.append((vertices, faces + first, uv, shade, np.full(len(faces), numbers[part.skin.key], np.int32)))
        first += len(vertices)
    vertices, faces, uv, shade, texture = (np.concatenate([j[i] for j in joined]) for i in range(5))
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return Scene(
        vertices=vertices,
        faces=faces.astype(np.int32),
        uv=uv.astype(np.float32),
        texture=texture,
        textures=textures,
        closed=np.zeros(len(faces), np.bool_),
        shade=shade.astype(np.float32),
        blocks=np.zeros((0, 8)),
        walk_xy=np.zeros((0, 2)),
        floor_bounds=(float(low[0]), float(low[1]), float(high[0]), float(high[1])),
    )


def _unwrapped(part: _Part, tiles: tuple[int, int]) -> tuple[Array, NDArray[np.int64], Array, Array]:
    """Return vertices, faces, texture coordinates in 0..1 and shades; faces without area are left out."""
    corners = part.vertices[part.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    kept = part.skin.kept & (area > 1e-12)
    faces, shade = part.faces[kept], part.skin.shade[kept]
    shifted = wrapped(part.skin.uv[kept])[0] / np.asarray(tiles, dtype=np.float64)
    _, span = wrapped(shifted)
    beyond = (span > 1).any(axis=1)
    if not beyond.any():
        return part.vertices, faces, shifted, shade
    values = np.concatenate([shifted, shade[..., None]], axis=2)
    pieces, values, _ = cut(corners[kept][beyond], values[beyond])
    count = len(part.vertices)
    more = count + np.arange(3 * len(pieces)).reshape(-1, 3)
    return (
        np.concatenate([part.vertices, pieces.reshape(-1, 3)]),
        np.concatenate([faces[~beyond], more]),
        np.concatenate([shifted[~beyond], values[..., :2]]),
        np.concatenate([shade[~beyond], values[..., 2]]),
    )


def _within_budget(path: Path, images: list[Rgb]) -> list[Rgb]:
    """Halve textures until all fit into memory."""
    halvings = 0
    while sum(image.shape[0] * image.shape[1] for image in images) > MOST_TEXELS:
        sizes = [(max(1, image.shape[1] // 2), max(1, image.shape[0] // 2)) for image in images]
        images = [
            np.asarray(cv2.resize(i, s, interpolation=cv2.INTER_AREA)) for i, s in zip(images, sizes, strict=True)
        ]
        halvings += 1
    if halvings:
        _log.warning("%s: textures are too large for memory and become %d times smaller", path, 2**halvings)
    return images
