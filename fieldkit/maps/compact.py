"""A map small enough to ship as a sample: one 8-bit descriptor per landmark, a coarser surface."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import MapError
from fieldkit.features import Features
from fieldkit.maps.appearance import write_appearance
from fieldkit.maps.io import content_digest, load_map, positive, read_map_file, write_features, write_map_file
from fieldkit.maps.landmarks import Model, model_from_arrays
from fieldkit.maps.whole import FILE, write_global
from fieldkit.store import atomic_folder, refuse_existing
from fieldkit.surface import coarsen, write_ply
from fieldkit.types import SceneMap

# Keypoints are rounded to this fraction of a pixel, far below their noise, so that gzip finds something to do.
_PIXEL_STEP = 1.0 / 32.0


def compact_map(path: Path, out: Path, *, voxel_m: float = 0.1, force: bool = False) -> None:
    """Write a smaller copy of a map folder that localizes almost as well.

    Only keypoints that observe a landmark stay; of a landmark's descriptors the one nearest to their mean stays and
    the others become zero; the surface is merged to ``voxel_m``; the landmarks' appearance stays. It is a map of its
    own, with its own digest.
    Raises MapError when the map's descriptors are not 8-bit or ``voxel_m`` is no size.
    """
    refuse_existing(Path(out), force=force, marker="map.toml", kind="folder")
    positive("voxel_m", voxel_m)
    scene_map, entry = load_map(Path(path)), read_map_file(Path(path))
    if scene_map.descriptors.dtype != np.uint8:
        raise MapError(f"{path}: {scene_map.feature} descriptors are not 8-bit", hint="compact a map of feature sift")
    surface = None if scene_map.surface is None else coarsen(scene_map.surface, voxel_m=voxel_m)
    appearance = dict(scene_map.appearance)
    with atomic_folder(Path(out), force=force, marker="map.toml") as folder:
        _write_model(folder, scene_map)
        if scene_map.retrieval is not None and scene_map.image_vectors is not None:
            vectors = dict(zip(scene_map.image_names, scene_map.image_vectors, strict=True))
            write_global(folder / FILE, scene_map.retrieval, vectors)
        surface_entry = entry.surface
        if surface is not None and surface_entry is not None:
            write_ply(folder / "surface.ply", surface)
            surface_entry = msgspec.structs.replace(surface_entry, voxel_m=surface.voxel_m, file="surface.ply")
        digest = content_digest(folder)
        for network, seen in appearance.items():
            write_appearance(folder, network, seen, digest=digest)
        write_map_file(folder, msgspec.structs.replace(entry, version=1, digest=digest, surface=surface_entry))


def _write_model(folder: Path, scene_map: SceneMap) -> None:
    """Write sparse/ and features.h5 with the keypoints that observe landmarks, and a descriptor of each landmark."""
    keypoint, pixels, features = _features(scene_map, central_descriptors(scene_map))
    model = Model(
        scene_map.image_names,
        scene_map.image_cameras,
        scene_map.map_from_image,
        scene_map.xyz,
        np.arange(1, len(scene_map.xyz) + 1),
        scene_map.observation_landmark,
        scene_map.observation_image,
        keypoint,
        scene_map.observation_px,
    )
    sizes = {n: (c.width, c.height) for n, c in zip(scene_map.image_names, scene_map.image_cameras, strict=True)}
    (folder / "sparse").mkdir()
    model_from_arrays(model, pixels).write_binary(folder / "sparse")
    write_features(folder / "features.h5", features, sizes, compress=True)


def central_descriptors(scene_map: SceneMap) -> NDArray[np.int64]:
    """Return one row of ``descriptors`` per described landmark: the one nearest to the landmark's mean descriptor."""
    owner, values = scene_map.descriptor_landmark, scene_map.descriptors.astype(np.float32)
    count = np.maximum(np.bincount(owner, minlength=len(scene_map.xyz)), 1)
    mean = np.zeros((len(scene_map.xyz), values.shape[1]), dtype=np.float32)
    np.add.at(mean, owner, values)
    mean /= count[:, None]
    away = ((values - mean[owner]) ** 2).sum(axis=1)
    order = np.lexsort((np.arange(len(owner)), away, owner))
    first = np.ones(len(order), dtype=bool)
    first[1:] = owner[order[1:]] != owner[order[:-1]]
    return np.sort(order[first])


def _features(
    scene_map: SceneMap, kept: NDArray[np.int64]
) -> tuple[NDArray[np.int32], list[NDArray[np.float32]], dict[str, Features]]:
    """Return the observations' new keypoint numbers, the keypoints per image, and the features per image."""
    keypoint = np.zeros(len(scene_map.observation_image), dtype=np.int32)
    described = {(int(scene_map.descriptor_image[r]), int(scene_map.descriptor_landmark[r])): r for r in kept}
    pixels: list[NDArray[np.float32]] = []
    features: dict[str, Features] = {}
    for i, name in enumerate(scene_map.image_names):
        rows = np.flatnonzero(scene_map.observation_image == i)
        keypoint[rows] = np.arange(len(rows))
        px = (np.rint(scene_map.observation_px[rows] / _PIXEL_STEP) * _PIXEL_STEP).astype(np.float32)
        descriptors = np.zeros((len(rows), scene_map.descriptors.shape[1]), dtype=np.uint8)
        for k, row in enumerate(rows):
            source = described.pop((i, int(scene_map.observation_landmark[row])), None)
            if source is not None:
                descriptors[k] = scene_map.descriptors[source]
        ones = np.ones(len(rows), dtype=np.float32)
        pixels.append(px)
        features[name] = Features(px, ones, ones, descriptors)
    return keypoint, pixels, features
