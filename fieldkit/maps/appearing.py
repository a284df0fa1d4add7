"""Adding to a map what a network of appearance sees at its landmarks, from the mapping images."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from fieldkit.errors import MapError
from fieldkit.features.appearance import open_appearance
from fieldkit.maps.appearance import write_appearance
from fieldkit.maps.io import load_map
from fieldkit.maps.sources.source import MapSource, read_image
from fieldkit.maps.sources.streamrecorder import open_source

Progress = Callable[[str, int, int], None]


def add_appearance(
    path: Path,
    source: Path | MapSource,
    *,
    network: str = "efficientnet",
    weights: Path | None = None,
    progress: Progress | None = None,
) -> None:
    """Compute what a network sees at each landmark of the map folder ``path`` and write it there.

    ``source`` holds the mapping images. A landmark's vector is the mean of the network's unit vectors at its pixels in
    all mapping images that observe it, made a unit vector again. Raises MapError when an image of the map is not in
    the source or has another size, WeightsError when the network's weights are not found.
    """
    scene_map = load_map(Path(path))
    walk = source if isinstance(source, MapSource) else open_source(Path(source))
    by_name = {image.name: image for image in walk.images}
    missing = next((name for name in scene_map.image_names if name not in by_name), None)
    if missing is not None:
        raise MapError(
            f"{walk.path}: has no image {missing!r} of the map {path}; expected the images that it was made of",
            hint="name the folder from which the map was built",
        )
    seeing = open_appearance(network, weights=weights)
    bounds = np.searchsorted(scene_map.observation_image, np.arange(len(scene_map.image_names) + 1))
    total = np.zeros((len(scene_map.xyz), seeing.kind.dense_width), dtype=np.float32)
    for i, name in enumerate(scene_map.image_names):
        if progress is not None:
            progress("appearance", i + 1, len(scene_map.image_names))
        image, camera = read_image(by_name[name], colour=True), scene_map.image_cameras[i]
        if image.shape[:2] != (camera.height, camera.width):
            raise MapError(
                f"{by_name[name].file}: is {image.shape[1]}x{image.shape[0]}; expected {camera.width}x{camera.height}, "
                f"as in the map {path}",
                hint="name the folder from which the map was built",
            )
        rows = slice(bounds[i], bounds[i + 1])
        seen = seeing.dense(image, scene_map.observation_px[rows])
        np.add.at(total, scene_map.observation_landmark[rows], seen)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    vectors = (total / np.maximum(length, 1e-9)).astype(np.float16)
    write_appearance(Path(path), network, vectors, digest=scene_map.digest)
