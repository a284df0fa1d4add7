"""`export_map`: a map folder for other tools, as a COLMAP model, as hloc's files, or as poses in TUM text."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import h5py
import numpy as np
import pycolmap
import scipy.sparse

from fieldkit.errors import MapError, suggestion
from fieldkit.features import FEATURES
from fieldkit.maps.colmap import read_model, write_model
from fieldkit.maps.io import read_map_file, refuse_changed
from fieldkit.maps.landmarks import Model
from fieldkit.maps.quiet import quiet_colmap
from fieldkit.store import atomic_folder, refuse_existing, write_tum

Format = Literal["colmap", "hloc", "tum"]
# The file of an export by which --force knows that a folder may be replaced
_MARKERS: dict[str, str] = {"colmap": "cameras.bin", "hloc": "features.h5", "tum": "poses.txt"}
# Divides 8-bit SIFT into the unit vectors that hloc stores
_SIFT_UNIT = 512.0
_N_PAIRS = 20


@dataclasses.dataclass(frozen=True)
class Exported:
    """What was written: the files, and how many images and landmarks they hold."""

    files: tuple[str, ...]
    n_images: int
    n_landmarks: int


def export_map(path: Path, out: Path, *, to: Format, force: bool = False) -> Exported:
    """Write a map for another tool into a folder; units and frame stay the map's (m, z up).

    "colmap": the model, binary and text. "hloc": ``sfm/`` (binary model), ``features.h5`` (keypoints without COLMAP's
    half pixel, unit descriptors) and ``pairs-db-covis20.txt``. "tum": ``poses.txt``, map_from_cam per mapping image.
    Raises MapError when the map is missing, damaged or changed, and StoreError when ``out`` is in the way.
    """
    path, out = Path(path), Path(out)
    if to not in _WRITERS:
        raise MapError(f"unknown format {to!r}", hint=suggestion(to, list(_WRITERS)))
    refuse_existing(out, force=force, marker=_MARKERS[to], kind="folder")
    refuse_changed(path, read_map_file(path))
    model = read_model(path / "sparse")
    with atomic_folder(out, force=force, marker=_MARKERS[to]) as folder:
        _WRITERS[to](path, folder, model)
        files = tuple(sorted(f.relative_to(folder).as_posix() for f in folder.rglob("*") if f.is_file()))
    return Exported(files, len(model.image_names), len(model.xyz))


def _write_colmap(path: Path, folder: Path, model: Model) -> None:
    # As COLMAP reads and writes it: rigs and all keypoints stay
    with quiet_colmap():
        stored = pycolmap.Reconstruction(path / "sparse")
        stored.write_binary(folder)
        stored.write_text(folder)


def _write_hloc(path: Path, folder: Path, model: Model) -> None:
    feature = read_map_file(path).feature
    scale = _SIFT_UNIT if FEATURES[feature].width == 128 else 1.0
    pixels = []
    with (
        h5py.File(path / "features.h5", "r") as source,
        h5py.File(folder / "features.h5", "w", libver="v110") as target,
    ):
        for name in model.image_names:
            group = target.create_group(name)
            keypoints = source[name]["keypoints"][()]
            pixels.append(keypoints + np.float32(0.5))
            descriptors = source[name]["descriptors"][()]
            if descriptors.dtype == np.uint8:
                descriptors = descriptors.astype(np.float32) / np.float32(scale)
            group.create_dataset("keypoints", data=keypoints)
            group.create_dataset("descriptors", data=descriptors)
            group.create_dataset("scores", data=source[name]["scores"][()])
            group.create_dataset("image_size", data=source[name]["image_size"][()].astype(np.int64))
    write_model(folder / "sfm", model, pixels)
    lines = [f"{model.image_names[i]} {model.image_names[j]}\n" for i, j in covisible_pairs(model, count=_N_PAIRS)]
    (folder / "pairs-db-covis20.txt").write_text("".join(lines), encoding="utf-8")


def _write_tum(path: Path, folder: Path, model: Model) -> None:
    spaced = next((name for name in model.image_names if " " in name), None)
    if spaced is not None:
        raise MapError(
            f"{path}: {spaced!r} has a space, which TUM text cannot hold; expected none", hint="rename the image"
        )
    write_tum(folder / "poses.txt", zip(model.image_names, model.map_from_image, strict=True))


_WRITERS: dict[str, Callable[[Path, Path, Model], None]] = {
    "colmap": _write_colmap,
    "hloc": _write_hloc,
    "tum": _write_tum,
}


def covisible_pairs(model: Model, *, count: int) -> list[tuple[int, int]]:
    """Return per image (i) the up to ``count`` images (j) that share the most landmarks with it, best first."""
    shape = (len(model.image_names), len(model.xyz))
    ones = np.ones(len(model.observation_image), dtype=np.int32)
    seen = scipy.sparse.csr_array((ones, (model.observation_image, model.observation_landmark)), shape=shape)
    shared = (seen @ seen.T).tocsr()
    pairs = []
    for i in range(shape[0]):
        row = shared[[i]].tocoo()
        others = row.coords[1] != i
        columns, values = row.coords[1][others], row.data[others]
        best = np.lexsort((columns, -values))[:count]
        pairs += [(i, int(j)) for j in columns[best]]
    return pairs
