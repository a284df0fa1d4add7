"""Adding to a map what a network of appearance sees at its landmarks, from the mapping images."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from fieldkit.errors import MapError, StoreError
from fieldkit.features.appearance import open_appearance
from fieldkit.maps.appearance import appearance_path, write_appearance
from fieldkit.maps.io import load_map
from fieldkit.maps.sameness import read_mapping_image, refuse_other_images
from fieldkit.maps.sources.source import MapSource
from fieldkit.maps.sources.streamrecorder import open_source
from fieldkit.store import refuse_existing

Progress = Callable[[str, int, int], None]


def add_appearance(
    path: Path,
    source: Path | MapSource,
    *,
    network: str = "efficientnet",
    weights: Path | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> None:
    """Compute what a network sees at each landmark of the map folder ``path`` and write it there.

    ``source`` holds the mapping images. A landmark's vector is the mean of the network's unit vectors at its pixels in
    all mapping images that observe it, made a unit vector again. Raises MapError when an image of the map is not in
    the source, has another size, or is another image; StoreError when the map has the network's view already and
    ``force`` is not set; WeightsError when the network's weights are not found.
    """
    target = appearance_path(path, network)
    if target.is_file() and not force:
        raise StoreError(f"{target}: exists already; expected no such file", hint="give --force to replace it")
    refuse_existing(target, force=True, kind="file")
    scene_map = load_map(Path(path))
    walk = source if isinstance(source, MapSource) else open_source(Path(source))
    by_name = {image.name: image for image in walk.images}
    missing = next((name for name in scene_map.image_names if name not in by_name), None)
    if missing is not None:
        raise MapError(
            f"{walk.path}: has no image {missing!r} of the map {path}; expected the images that it was made of",
            hint="name the folder from which the map was built",
        )
    images = [by_name[name] for name in scene_map.image_names]
    seeing = open_appearance(network, weights=weights)
    refuse_other_images(scene_map, images, weights=weights)
    bounds = np.searchsorted(scene_map.observation_image, np.arange(len(images) + 1))
    total = np.zeros((len(scene_map.xyz), seeing.kind.dense_width), dtype=np.float32)
    for i in range(len(images)):
        if progress is not None:
            progress("appearance", i + 1, len(images))
        rows = slice(bounds[i], bounds[i + 1])
        image = read_mapping_image(scene_map, images, i, colour=True)
        seen = seeing.dense(image, scene_map.observation_px[rows])
        np.add.at(total, scene_map.observation_landmark[rows], seen)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    vectors = (total / np.maximum(length, 1e-9)).astype(np.float16)
    write_appearance(Path(path), network, vectors, digest=scene_map.digest)
