"""Map folders on disk: a COLMAP model, features as hloc writes them, a surface, and map.toml."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import h5py
import msgspec
import numpy as np

from fieldkit.errors import MapError, suggestion
from fieldkit.features import FEATURES, Features
from fieldkit.maps import whole
from fieldkit.maps.appearance import Appearances, known_appearances
from fieldkit.maps.colmap import read_model
from fieldkit.maps.descriptors import MAX_BYTES, read_landmark_descriptors
from fieldkit.maps.landmarks import landmark_covariance
from fieldkit.maps.record import read_record
from fieldkit.store import digest, read_toml, write_toml
from fieldkit.surface import read_ply
from fieldkit.types import SceneMap, Surface

_MODEL_FILES = ("cameras.bin", "rigs.bin", "frames.bin", "images.bin", "points3D.bin")


class AlignmentEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[alignment] of map.toml; residuals in m, gravity in deg."""

    source: Literal["slam", "tags", "depth", "known"]
    scale: float
    n_used: int
    n_total: int
    rms_m: float
    p95_m: float
    gravity_deg: float
    verdict: Literal["pass", "warn", "fail"]
    scale_sigma: float | None = None
    gravity_from: Literal["slam", "floor", "verticals", "cameras", "known"] | None = None
    reprojection_px: float | None = None
    match_share: float | None = None


class SurfaceEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[surface] of map.toml."""

    voxel_m: float
    truncation_m: float
    file: Literal["surface.ply"]


class MapFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """map.toml."""

    version: Literal[1]
    digest: str
    feature: str
    n_images: int
    n_registered: int
    n_landmarks: int
    alignment: AlignmentEntry
    surface: SurfaceEntry | None = None


def write_features(
    path: Path, features: Mapping[str, Features], sizes: Mapping[str, tuple[int, int]], *, compress: bool = False
) -> None:
    """Write features.h5 in hloc's layout: per image name keypoints (n, 2) without COLMAP's half pixel,
    descriptors (w, n), scores (n,) and image_size (2,) = width, height."""
    options: dict[str, Any] = {"compression": "gzip", "compression_opts": 9, "shuffle": True} if compress else {}
    with h5py.File(path, "w", libver="v110") as file:
        for name in sorted(features):
            found = features[name]
            group = file.create_group(name)
            filled = options if len(found) else {}
            group.create_dataset("keypoints", data=found.keypoints_px - np.float32(0.5), **filled)
            group.create_dataset("descriptors", data=np.ascontiguousarray(found.descriptors.T), **filled)
            group.create_dataset("scores", data=found.scores, **filled)
            group.create_dataset("image_size", data=np.array(sizes[name], dtype=np.int32))


def positive(name: str, value: float) -> None:
    """Raise MapError unless a setting is a finite number above zero."""
    if not (math.isfinite(value) and value > 0):
        raise MapError(f"{name} is {value:g}; expected a positive number", hint=f"choose another {name}")


def content_digest(folder: Path) -> str:
    """Return the digest over model, features, surface and global descriptors of a map folder."""
    names = (*(f"sparse/{name}" for name in _MODEL_FILES), "features.h5", "surface.ply", whole.FILE)
    files = [folder / name for name in names]
    parts: list[bytes | str | Path] = []
    for file in files:
        if file.is_file():
            parts += [file.name, file]
    return digest(*parts)


def read_map_file(path: Path) -> MapFile:
    """Read map.toml of a map folder; raises MapError when the folder is not a map."""
    path = Path(path)
    if not path.is_dir():
        raise MapError(f"{path}: no such folder; expected a map folder", hint="build one with `fieldkit map build`")
    if not (path / "map.toml").is_file():
        raise MapError(f"{path}: no map.toml in it; expected a map folder", hint="build one with `fieldkit map build`")
    _refuse_old(path / "map.toml")
    entry = read_toml(path / "map.toml", MapFile, what="map.toml of fieldkit")
    _refuse_wrong_numbers(path / "map.toml", entry)
    return entry


def _refuse_old(path: Path) -> None:
    """Raise MapError for a map.toml of an older version than any that is read; newer ones `read_toml` refuses."""
    try:
        version = tomllib.loads(path.read_text(encoding="utf-8")).get("version")
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError):
        return
    if not isinstance(version, int) or version < 1:
        found = "has no version" if version is None else f"version {version!r}"
        raise MapError(f"{path}: {found}; this fieldkit reads version 1", hint="build or import the map again")


def _refuse_wrong_numbers(path: Path, entry: MapFile) -> None:
    a, s = entry.alignment, entry.surface
    sizes = {"alignment.scale": a.scale}
    if s is not None:
        sizes |= {"surface.voxel_m": s.voxel_m, "surface.truncation_m": s.truncation_m}
    measured = {"alignment.rms_m": a.rms_m, "alignment.p95_m": a.p95_m, "alignment.gravity_deg": a.gravity_deg}
    for name, value in {**sizes, **measured}.items():
        if not math.isfinite(value) or value < 0 or (value == 0 and name in sizes):
            raise MapError(
                f"{path}: {name} is {value:g}; expected a {'positive' if name in sizes else 'finite'} number",
                hint="copy or build the map again",
            )


def load_map(path: Path) -> SceneMap:
    """Load a map folder: landmarks with covariance, who saw them, their descriptors, and the surface if it has one.

    Of a map with millions of observations every landmark keeps the descriptors of its most different views.
    Raises MapError when a file is missing, damaged or changed, or the map's feature is unknown here.
    """
    path = Path(path)
    entry = read_map_file(path)
    if entry.feature not in FEATURES:
        raise MapError(f"{path}: built with feature {entry.feature!r}", hint=suggestion(entry.feature, list(FEATURES)))
    refuse_changed(path, entry)
    model = read_model(path / "sparse")
    width = FEATURES[entry.feature].width
    descriptors, rows = read_landmark_descriptors(path / "features.h5", model, width=width)
    every = len(rows) == len(model.observation_landmark)
    retrieval, vectors = whole.read_global(path / whole.FILE, model.image_names) or (None, None)
    covariance = landmark_covariance(
        model.xyz, model.observation_landmark, model.observation_image, model.map_from_image, model.image_cameras
    )
    return SceneMap(
        path=str(path),
        digest=entry.digest,
        feature=entry.feature,
        xyz=model.xyz,
        xyz_covariance=covariance if descriptors.nbytes < MAX_BYTES // 2 else covariance.astype(np.float32),
        image_names=model.image_names,
        image_cameras=model.image_cameras,
        map_from_image=model.map_from_image,
        observation_landmark=model.observation_landmark,
        observation_image=model.observation_image,
        observation_px=model.observation_px,
        descriptors=descriptors,
        descriptor_landmark=model.observation_landmark if every else model.observation_landmark[rows],
        descriptor_image=model.observation_image if every else model.observation_image[rows],
        surface=_read_surface(path, entry.surface),
        retrieval=retrieval,
        image_vectors=vectors,
        appearance=Appearances(path, digest=entry.digest, count=len(model.xyz)),
    )


def refuse_changed(path: Path, entry: MapFile) -> None:
    """Raise MapError when files are missing or are not those that map.toml's digest was made of.

    COLMAP may read a cut-off model without an error, and results name the digest as what they were made with.
    """
    needed = [path / "sparse" / "images.bin", path / "sparse" / "points3D.bin", path / "features.h5"]
    if entry.surface is not None:
        needed.append(path / entry.surface.file)
    for file in needed:
        if not file.is_file():
            raise MapError(f"{file}: no such file; expected a whole map folder", hint="copy or build the map again")
    if content_digest(path) != entry.digest:
        raise MapError(
            f"{path}: its files have another digest than map.toml names ({entry.digest}); they are damaged or changed",
            hint="copy or build the map again",
        )
    if entry.surface is None and (path / "surface.ply").exists():
        raise MapError(
            f"{path / 'map.toml'}: has no [surface]; expected it, since there is a surface.ply",
            hint="copy or build the map again",
        )


def changed(path: Path) -> str | None:
    """Return in one line what of a map's files is missing or not what map.toml says; None where nothing is.

    Every file is read once, as it is for its digest.
    """
    try:
        refuse_changed(Path(path), read_map_file(path))
    except MapError as error:
        return str(error)
    return None


def _read_surface(path: Path, entry: SurfaceEntry | None) -> Surface | None:
    """Return the surface; its voxel size is that of the digested mesh file, with which map.toml has to agree."""
    if entry is None:
        return None
    surface = read_ply(path / entry.file)
    if not math.isclose(surface.voxel_m, entry.voxel_m, rel_tol=1e-6):
        raise MapError(
            f"{path / 'map.toml'}: surface.voxel_m is {entry.voxel_m:g}; expected {surface.voxel_m:g} as in "
            f"{entry.file}",
            hint="copy or build the map again",
        )
    return surface


def map_info(path: Path) -> dict[str, Any]:
    """Return what map.toml says of a map, as plain values, with its path, and how it was built where that is kept."""
    entry, record = read_map_file(path), read_record(Path(path))
    built = {} if record is None else {"seconds": record.seconds, "versions": record.versions}
    seen = known_appearances(path)
    return {"path": str(path), **msgspec.to_builtins(entry), **built, **({"appearance": list(seen)} if seen else {})}


def write_map_file(path: Path, entry: MapFile) -> None:
    """Write map.toml."""
    write_toml(path / "map.toml", entry)
