"""Descriptors for a model that another tool made: from hloc's features, COLMAP's database, or the images anew."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fieldkit.errors import MapError
from fieldkit.features import FEATURES, feature_kind, open_extractor, read_image
from fieldkit.maps.landmarks import Model
from fieldkit.maps.structure.sfm import threads
from fieldkit.observations import observations_of

Pixels = NDArray[np.float32]
# Keypoints (n, 2) in COLMAP pixels and descriptors (n, w) of one image
Found = tuple[Pixels, NDArray[Any]]

SIFT = ("sift", "sift_l2")
# More of the image's keypoints than a query gets: only those at the model's own are kept
_MAX_KEYPOINTS = 16384
_MAX_SIDE_PX = 3200
_NEAR_PX = 1.0
# Share of an image file's observations that have to lie at keypoints of the features file
_MIN_SHARE = 0.98
# RootSIFT's components sum to 8 (median over images), those of SIFT's own normalisation to 6
_ROOT_SUM = 7.0


def hloc_descriptors(path: Path, model: Model, *, feature: str) -> NDArray[Any]:
    """Return the descriptors (o, w) of a model's observations from the features.h5 with which hloc made it.

    The file's keypoints lack COLMAP's half pixel and may be rounded to 16 bits. Raises MapError when the file is
    missing or damaged, holds other keypoints than the model's, or another feature's descriptors.
    """
    path = Path(path)
    if not path.is_file():
        raise MapError(f"{path}: no such file; expected features as hloc writes them", hint="check the path")

    def images() -> Iterator[tuple[Pixels, NDArray[Any], float]]:
        with h5py.File(path, "r") as file:
            for name in model.image_names:
                if name not in file:
                    raise MapError(
                        f"{path}: no features of {name}; expected those of the model's images",
                        hint="give the features file with which this model was made",
                    )
                stored = file[name]["keypoints"][()]
                descriptors = file[name]["descriptors"][()]
                if descriptors.ndim != 2 or stored.ndim != 2 or descriptors.shape[1] != len(stored):
                    raise MapError(
                        f"{path}: {name}: keypoints {stored.shape}, descriptors {descriptors.shape}; expected (n, 2) "
                        "and (w, n)",
                        hint="extract the features again",
                    )
                step = float(np.spacing(stored.max(initial=1))) if stored.dtype.kind == "f" else 0.0
                yield stored[:, :2].astype(np.float32) + np.float32(0.5), descriptors.T, step

    try:
        return _at_keypoints(path, model, images(), feature)
    except (OSError, KeyError, AttributeError) as error:
        raise MapError(
            f"{path}: cannot be read: {error}; expected features as hloc writes them", hint="check the file"
        ) from error


def database_descriptors(path: Path, model: Model, *, feature: str) -> NDArray[Any]:
    """Return the descriptors (o, w) of a model's observations from the COLMAP database with which it was made.

    Raises MapError as `hloc_descriptors` does. The database is only read.
    """
    path = Path(path)
    if not path.is_file():
        raise MapError(f"{path}: no such file; expected a COLMAP database", hint="check the path")

    def images() -> Iterator[tuple[Pixels, NDArray[Any], float]]:
        with contextlib.closing(sqlite3.connect(f"file:{path.absolute().as_posix()}?mode=ro", uri=True)) as database:
            ids = dict(database.execute("SELECT name, image_id FROM images"))
            for name in model.image_names:
                keypoints = _blob(database, "keypoints", ids.get(name, -1), np.float32)
                descriptors = _blob(database, "descriptors", ids.get(name, -1), np.uint8)
                if keypoints is None or descriptors is None or len(keypoints) != len(descriptors):
                    what = f"{name}: no image of that name" if name not in ids else f"{name}: no descriptors"
                    raise MapError(
                        f"{path}: {what}; expected keypoints and descriptors of the model's images",
                        hint="give the database with which this model was made, or leave --database away",
                    )
                yield keypoints[:, :2].astype(np.float32), descriptors, 0.0

    try:
        return _at_keypoints(path, model, images(), feature)
    except sqlite3.Error as error:
        raise MapError(f"{path}: cannot be read: {error}; expected a COLMAP database", hint="check the file") from error


def _blob(database: sqlite3.Connection, table: str, image_id: int, dtype: type) -> NDArray[Any] | None:
    row = database.execute(f"SELECT rows, cols, data FROM {table} WHERE image_id = ?", (image_id,)).fetchone()
    if row is None:
        return None
    values: NDArray[Any] = np.frombuffer(row[2] or b"", dtype=dtype)
    return values.reshape(row[0], row[1]) if values.size == row[0] * row[1] else None


def _at_keypoints(
    path: Path, model: Model, images: Iterable[tuple[Pixels, NDArray[Any], float]], feature: str
) -> NDArray[Any]:
    """Take the descriptor of every observation's keypoint; ``images`` also say to what (px) positions are rounded."""
    parts: list[NDArray[Any]] = []
    bounds = np.searchsorted(model.observation_image, np.arange(len(model.image_names) + 1))
    for i, (keypoints, descriptors, step) in enumerate(images):
        rows = slice(int(bounds[i]), int(bounds[i + 1]))
        row = model.observation_keypoint[rows]
        if not len(row):
            continue
        name = model.image_names[i]
        if row.max() >= len(keypoints):
            raise _other_model(path, f"{name} has {len(keypoints)} keypoints, the model uses number {row.max() + 1}")
        away = np.linalg.norm(keypoints[row] - model.observation_px[rows], axis=1)
        if (away <= 0.02 + 2 * step).mean() < _MIN_SHARE:
            raise _other_model(path, f"in {name} they lie {np.median(away):.3g} px from those of the model")
        parts.append(np.ascontiguousarray(descriptors[row]))
    return as_stored(path, np.concatenate(parts) if parts else np.zeros((0, FEATURES[feature].width)), feature)


def _other_model(path: Path, what: str) -> MapError:
    return MapError(
        f"{path}: its keypoints are not the model's: {what}; expected those with which the model was made",
        hint="give that file, or leave it away to extract the features from --images",
    )


def as_stored(path: Path, values: NDArray[Any], feature: str) -> NDArray[Any]:
    """Return descriptors (n, w) as maps store them: 8 bits of SIFT, float32 of others.

    Raises MapError when width or values show that they are of another feature.
    """
    width = feature_kind(feature).width
    if values.shape[1] != width:
        raise _other_feature(path, f"descriptors of width {values.shape[1]}; {feature} has {width}", feature)
    if feature not in SIFT:
        if values.dtype == np.uint8:
            raise _other_feature(path, f"8-bit descriptors, as of SIFT; {feature} has numbers", feature)
        return values.astype(np.float32)
    if values.dtype == np.uint8:
        return np.ascontiguousarray(values)
    if not len(values):
        return values.astype(np.uint8)
    numbers = values.astype(np.float32)
    length, total = np.linalg.norm(numbers, axis=1), numbers.sum(axis=1)
    if (numbers < 0).any() or abs(float(np.median(length)) - 1.0) > 0.05:
        raise _other_feature(path, "descriptors that are negative or not of length 1; SIFT's are neither", feature)
    if (float(np.median(total)) > _ROOT_SUM) != (feature == "sift"):
        raise _other_feature(path, f"SIFT of {'another' if feature == 'sift' else 'root'} normalisation", feature)
    return np.asarray(np.clip(np.rint(512.0 * numbers), 0, 255), dtype=np.uint8)


def _other_feature(path: Path, what: str, feature: str) -> MapError:
    return MapError(
        f"{path}: {what}; expected {feature} descriptors", hint="give --feature with the feature of the file"
    )


def image_descriptors(
    folder: Path,
    model: Model,
    *,
    feature: str,
    progress: Callable[[str, int, int], None],
    weights: Path | None = None,
) -> NDArray[Any]:
    """Return descriptors (o, w) of a model's observations, extracted from its images; zero where there is none.

    An observation takes the descriptor of the nearest keypoint found within a pixel. Raises MapError when images are
    missing or of another size than their camera.
    """
    refuse_missing(folder, model)
    bounds = observations_of(model.observation_image, len(model.image_names))
    extractor = open_extractor(feature, weights=weights, max_keypoints=_MAX_KEYPOINTS, max_side_px=_MAX_SIDE_PX)
    width, result = extractor.kind.width, None

    def one(i: int) -> Found:
        file, camera = Path(folder) / model.image_names[i], model.image_cameras[i]
        image = read_image(file, colour=extractor.kind.colour)
        if image.shape[:2] != (camera.height, camera.width):
            raise MapError(
                f"{file}: is {image.shape[1]}x{image.shape[0]}; its camera says {camera.width}x{camera.height}",
                hint="give the images with which the model was made",
            )
        found = extractor.extract(image)
        return found.keypoints_px, found.descriptors

    with ThreadPoolExecutor(threads()) as pool:
        extracted = pool.map(one, [i for i, _ in bounds])
        for done, ((_, rows), (keypoints, descriptors)) in enumerate(zip(bounds, extracted, strict=True), start=1):
            if result is None:
                result = np.zeros((len(model.observation_image), width), dtype=descriptors.dtype)
            if len(keypoints):
                away, nearest = cKDTree(keypoints).query(model.observation_px[rows])
                near = np.asarray(away) <= _NEAR_PX
                result[rows] = np.where(near[:, None], descriptors[nearest], np.zeros(1, dtype=result.dtype))
            progress("describe", done, len(bounds))
    return np.zeros((0, width), dtype=np.float32) if result is None else result


def refuse_missing(folder: Path, model: Model) -> None:
    """Raise MapError when images of a model are not in a folder."""
    folder = Path(folder)
    if not folder.is_dir():
        raise MapError(f"{folder}: no such folder; expected the images of the model", hint="check --images")
    missing = [name for name in model.image_names if not (folder / name).is_file()]
    if missing:
        raise MapError(
            f"{folder}: {len(missing)} of the model's {len(model.image_names)} images are missing: "
            f"{', '.join(missing[:3])}{', ..' if len(missing) > 3 else ''}; expected every name below this folder",
            hint="give the folder that the model's image names start from",
        )
