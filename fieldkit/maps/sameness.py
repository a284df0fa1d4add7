"""Whether images are those that a map was made of: another walk may have images of the same names and sizes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fieldkit.errors import MapError, WeightsError
from fieldkit.features import Extractor, open_extractor
from fieldkit.maps.options import MapOptions
from fieldkit.maps.sources.source import SourceImage, read_image
from fieldkit.types import Image, SceneMap

# Images that are looked at, and observations that tell something in one
_ASKED, _LEAST = 3, 20
# Share of an image's observations that a keypoint is near to. In red kitchen frames it is 1 for sift, aliked, xfeat and
# akaze as maps are built here, 0.84 or more for COLMAP's own sift, and 0.22 or less in the next frame of the video.
_MIN_SHARE = 0.3
# What is near is a pixel, and more where another tool may have found the keypoints in a smaller image
_SURE_SIDE_PX = 1024
# Other tools keep more keypoints, of larger images, than maps that are built here
_MAX_KEYPOINTS, _MAX_SIDE_PX = 16384, 3200
_HINT = "name the folder from which the map was built"


def read_mapping_image(scene_map: SceneMap, images: Sequence[SourceImage], i: int, *, colour: bool) -> Image:
    """Read the file of the map's image ``i``; raises MapError when it has another size than in the map."""
    image, camera = read_image(images[i], colour=colour), scene_map.image_cameras[i]
    if image.shape[:2] != (camera.height, camera.width):
        raise MapError(
            f"{images[i].file}: is {image.shape[1]}x{image.shape[0]}; expected {camera.width}x{camera.height}, "
            f"as in the map {scene_map.path}",
            hint=_HINT,
        )
    return image


def refuse_other_images(scene_map: SceneMap, images: Sequence[SourceImage], *, weights: Path | None = None) -> None:
    """Raise MapError when the map's feature is not found where the map has it, in the images that observe most.

    ``images`` are those of the map's names, in its order. Where the weights of the map's feature are not found, or its
    images observe hardly anything, nothing can be told, and nothing is refused.
    """
    built = MapOptions()
    limits = ((built.max_keypoints, built.max_image_size), (_MAX_KEYPOINTS, _MAX_SIDE_PX))
    try:
        opened = [open_extractor(scene_map.feature, weights=weights, max_keypoints=n, max_side_px=s) for n, s in limits]
    except WeightsError:
        return
    # Of a foreign map's observations, those without a descriptor are where the feature was not found
    counts = np.bincount(scene_map.descriptor_image, minlength=len(images))
    for i in np.argsort(-counts, kind="stable")[:_ASKED]:
        if counts[i] < _LEAST:
            continue
        image = read_mapping_image(scene_map, images, int(i), colour=opened[0].kind.colour)
        pixels = _described(scene_map, int(i))
        share = 0.0
        for extractor in opened:
            share = max(share, _share(extractor, image, pixels))
            if share >= _MIN_SHARE:
                break
        else:
            raise MapError(
                f"{images[i].file}: is not the image that the map {scene_map.path} was made of: {100 * share:.0f} % of "
                f"its {scene_map.feature} keypoints are there; expected the mapping images",
                hint=_HINT,
            )


def _described(scene_map: SceneMap, i: int) -> NDArray[np.float32]:
    """Return the pixels (n, 2) of an image's observations of landmarks that have a descriptor from it."""
    rows = scene_map.observation_image == i
    described = scene_map.descriptor_landmark[scene_map.descriptor_image == i]
    return np.asarray(scene_map.observation_px[rows][np.isin(scene_map.observation_landmark[rows], described)])


def _share(extractor: Extractor, image: Image, pixels: NDArray[np.float32]) -> float:
    """Return the share of pixels (n, 2) to which a keypoint of the image is near."""
    found = extractor.extract(image).keypoints_px
    if not len(found) or not len(pixels):
        return 0.0
    away, _ = cKDTree(found).query(pixels)
    return float((np.asarray(away) <= max(1.0, max(image.shape[:2]) / _SURE_SIDE_PX)).mean())
