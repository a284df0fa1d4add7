"""The descriptors of a map's landmarks, read from features.h5 image by image, within a bound of memory."""

from __future__ import annotations

import contextlib
import ctypes
import math
from pathlib import Path
from typing import Any

import h5py
import numba
import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import MapError
from fieldkit.maps.landmarks import Model
from fieldkit.observations import observations_of

# Room for one 8-bit SIFT descriptor of each of a million landmarks: all of such a map then fits into a gigabyte.
# Landmarks of a map of 350,000 keep the three with which the localizer matches.
MAX_BYTES = 128 << 20
_MAX_RANK = 255
# glibc, malloc.h
_M_MMAP_THRESHOLD = -3


def read_landmark_descriptors(
    path: Path, model: Model, *, width: int, max_bytes: int = MAX_BYTES
) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Return descriptors (d, width) of a model's observations and their rows int64[d] among these, ascending.

    Observations whose descriptor is zero have none. Where all do not fit into ``max_bytes``, every landmark keeps as
    many as fit, but at least one: those of the most different views. Raises MapError when the file is missing or
    damaged, is of other images or keypoints, or of a feature of another width.
    """
    if Path(path).is_file() and Path(path).stat().st_size > max_bytes:
        _give_back_freed_memory()
    try:
        with h5py.File(path, "r") as file:
            dtype = _check(path, file, model, width)
            n = len(model.observation_landmark)
            if n * width * dtype.itemsize <= max_bytes:
                values, filled = _read(file, model, np.arange(n), dtype, width)
                return (values, np.arange(n)) if filled.all() else (values[filled], np.flatnonzero(filled))
            described = _described(file, model)
            rows = _chosen(model, described, max_bytes // (width * dtype.itemsize))
            return _read(file, model, rows, dtype, width)[0], rows
    except (OSError, KeyError, AttributeError) as error:
        raise MapError(
            f"{path}: cannot be read: {error}; expected features as hloc writes them", hint="build the map again"
        ) from error


def _give_back_freed_memory() -> None:
    """Have the C library return freed arrays to the system at once: by itself glibc keeps those below 32 MB."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, 1 << 18)


def _check(path: Path, file: h5py.File, model: Model, width: int) -> np.dtype[Any]:
    """Return the type of the descriptors, which is one for all images."""
    dtypes = set()
    for i, rows in observations_of(model.observation_image, len(model.image_names)):
        name = model.image_names[i]
        if name not in file:
            raise MapError(
                f"{path}: no features of {name}", hint="the file belongs to another map; build the map again"
            )
        keypoints, descriptors = file[name]["keypoints"].shape, file[name]["descriptors"].shape
        if len(descriptors) != 2 or descriptors[1] != keypoints[0]:
            raise MapError(
                f"{path}: {name}: {keypoints[0]} keypoints, descriptors {descriptors}; expected (w, n)",
                hint="build the map again",
            )
        if descriptors[0] != width:
            raise MapError(
                f"{path}: descriptors of width {descriptors[0]}; the map's feature has {width}",
                hint="the file belongs to another feature",
            )
        if keypoints[0] <= model.observation_keypoint[rows].max():
            raise MapError(
                f"{path}: {name}: {keypoints[0]} keypoints; the model has more", hint="the file belongs to another map"
            )
        dtypes.add(file[name]["descriptors"].dtype)
    if len(dtypes) > 1:
        raise MapError(
            f"{path}: descriptors of several types: {', '.join(sorted(map(str, dtypes)))}; expected one",
            hint="build the map again",
        )
    return np.dtype(dtypes.pop()) if dtypes else np.dtype(np.uint8)


def _read(
    file: h5py.File, model: Model, rows: NDArray[np.int64], dtype: np.dtype[Any], width: int
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Return the descriptors of observations int64[d], ascending, and which of them are not zero."""
    values, filled = np.empty((len(rows), width), dtype=dtype), np.zeros(len(rows), dtype=bool)
    for i, part in observations_of(model.observation_image[rows], len(model.image_names)):
        found = file[model.image_names[i]]["descriptors"][()]
        values[part] = found.T[model.observation_keypoint[rows[part]]]
        filled[part] = values[part].any(axis=1)
    return values, filled


def _described(file: h5py.File, model: Model) -> NDArray[np.int64]:
    filled = np.zeros(len(model.observation_image), dtype=bool)
    for i, rows in observations_of(model.observation_image, len(model.image_names)):
        found = file[model.image_names[i]]["descriptors"][()]
        filled[rows] = found.any(axis=0)[model.observation_keypoint[rows]]
    return np.flatnonzero(filled)


def _chosen(model: Model, described: NDArray[np.int64], room: int) -> NDArray[np.int64]:
    """Return the observations, ascending, whose descriptors fit into ``room`` rows: at least one per landmark.

    Of what room is left, the landmarks that most images saw get one more.
    """
    owned = np.bincount(model.observation_landmark[described], minlength=len(model.xyz))
    count = 1
    while count < _MAX_RANK and np.minimum(owned, count + 1).sum() <= room:
        count += 1
    rank = _view_rank(model, described)
    kept = rank < count
    left = room - int(kept.sum())
    if left > 0:
        further = np.flatnonzero(rank == count)
        seen = owned[model.observation_landmark[described[further]]]
        kept[further[np.argsort(-seen, kind="stable")[:left]]] = True
    return described[kept]


def _view_rank(model: Model, rows: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Rank observations int64[d] among those of their landmark: the most usual view first, then the most different.

    Views differ by direction and by the logarithm of their distance. Ranks end at 255.
    """
    landmark = model.observation_landmark[rows]
    ends = np.cumsum(np.bincount(landmark, minlength=len(model.xyz)))
    order = np.argsort(landmark, kind="stable").astype(np.int32)
    del landmark
    centres = np.stack([p.translation for p in model.map_from_image])
    rank = np.zeros(len(rows), dtype=np.uint8)
    _rank_views(model.xyz, centres, model.observation_image, rows, order, ends, rank)
    return rank


@numba.njit(cache=True)
def _rank_views(xyz, centres, image, rows, order, ends, rank):  # type: ignore[no-untyped-def]
    begin = 0
    for landmark in range(len(ends)):
        end = ends[landmark]
        n = end - begin
        if n > 1:
            views = np.zeros((n, 4))
            mean = np.zeros(4)
            for k in range(n):
                i = image[rows[order[begin + k]]]
                length = 0.0
                for j in range(3):
                    views[k, j] = centres[i, j] - xyz[landmark, j]
                    length += views[k, j] ** 2
                length = max(math.sqrt(length), 1e-6)
                for j in range(3):
                    views[k, j] /= length
                views[k, 3] = math.log(length)
                for j in range(4):
                    mean[j] += views[k, j] / n
            _rank_one(views, mean, order[begin:end], rank)
        begin = end


@numba.njit(cache=True)
def _rank_one(views, mean, members, rank):  # type: ignore[no-untyped-def]
    n = len(views)
    away = np.full(n, np.inf)
    chosen, least = 0, np.inf
    for k in range(n):
        d = 0.0
        for j in range(4):
            d += (views[k, j] - mean[j]) ** 2
        if d < least:
            chosen, least = k, d
    for number in range(n):
        rank[members[chosen]] = min(number, _MAX_RANK)
        away[chosen] = -1.0
        following, most = chosen, -1.0
        for k in range(n):
            if away[k] >= 0.0:
                d = 0.0
                for j in range(4):
                    d += (views[k, j] - views[chosen, j]) ** 2
                away[k] = min(away[k], d)
                if away[k] > most:
                    following, most = k, away[k]
        chosen = following
