"""Local features behind one small interface: a visible dict of kinds, one file each, and `extract`."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import FeatureError, suggestion
from fieldkit.features.akaze import detect_akaze
from fieldkit.features.sift import detect_sift
from fieldkit.types import Image

Descriptors = NDArray[np.uint8] | NDArray[np.float32]


@dataclasses.dataclass(frozen=True)
class Features:
    """Keypoints of one image, strongest first, in COLMAP pixels (centre of the first pixel is (0.5, 0.5)).

    ``keypoints_px`` f32[n, 2], ``scores`` f32[n], ``scales`` f32[n] in px, ``descriptors`` uint8 or f32[n, width].
    """

    keypoints_px: NDArray[np.float32]
    scores: NDArray[np.float32]
    scales: NDArray[np.float32]
    descriptors: Descriptors

    def __len__(self) -> int:
        return len(self.keypoints_px)


Detected = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], Descriptors]


@dataclasses.dataclass(frozen=True)
class FeatureKind:
    """How a feature is found and matched.

    ``detect(grey, max_keypoints)`` returns keypoints (COLMAP pixels), scores, scales and descriptors, strongest
    first. ``matching`` says whether the distance ratio of the two nearest separates right matches from wrong ones,
    or only mutual nearest neighbours do.
    """

    detect: Callable[[Image, int], Detected]
    width: int
    matching: Literal["ratio", "mutual"]


FEATURES: dict[str, FeatureKind] = {
    "sift": FeatureKind(detect_sift, 128, "ratio"),
    "akaze": FeatureKind(detect_akaze, 64, "ratio"),
}


def feature_kind(feature: str) -> FeatureKind:
    """Return the kind of a feature by name; raises FeatureError with a suggestion when it is unknown."""
    if feature not in FEATURES:
        raise FeatureError(f"unknown feature {feature!r}", hint=suggestion(feature, list(FEATURES)))
    return FEATURES[feature]


def extract(
    image: Image, *, feature: str = "sift", max_keypoints: int = 2048, max_side_px: int | None = 1600
) -> Features:
    """Find the strongest keypoints of an image uint8[h, w] (grey) or uint8[h, w, 3] (RGB).

    An image whose longer side exceeds ``max_side_px`` is reduced first (area average), and its keypoints are
    scaled back: with pixel centres at (0.5, 0.5) that is a plain multiplication. An image without texture gives
    no keypoints. Raises FeatureError for an unknown feature or an array that is no such image.
    """
    kind = feature_kind(feature)
    grey = to_grey(image)
    height, width = grey.shape
    factor = working_factor((height, width), max_side_px=max_side_px)
    if factor < 1.0:
        size = max(round(width * factor), 1), max(round(height * factor), 1)
        grey = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    keypoints, scores, scales, descriptors = kind.detect(grey, max_keypoints)
    if factor < 1.0:
        sx, sy = width / grey.shape[1], height / grey.shape[0]
        keypoints = keypoints * np.array([sx, sy], dtype=np.float32)
        scales = scales * np.float32(math.sqrt(sx * sy))
    return Features(keypoints, scores, scales, descriptors)


def working_factor(shape: tuple[int, ...], *, max_side_px: int | None) -> float:
    """Return by how much `extract` reduces an image of shape (h, w) first: 1 or less."""
    return 1.0 if max_side_px is None else min(1.0, max_side_px / max(shape[:2]))


def to_grey(image: Image) -> Image:
    """Return uint8[h, w] of a grey or RGB image; raises FeatureError for any other array."""
    if (
        image.dtype != np.uint8
        or image.ndim not in (2, 3)
        or image.size == 0
        or (image.ndim == 3 and image.shape[2] != 3)
    ):
        raise FeatureError(
            f"image is {image.dtype}{list(image.shape)}; expected uint8[h, w] grey or uint8[h, w, 3] RGB"
        )
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return np.ascontiguousarray(grey, dtype=np.uint8)


def read_grey(path: Path) -> Image:
    """Read an image file as uint8[h, w], as stored: a camera's calibration knows nothing of EXIF turns.

    Raises FeatureError when the file is missing or no readable image.
    """
    if not Path(path).is_file():
        raise FeatureError(f"{path}: no such file; expected an image", hint="check the path")
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise FeatureError(f"{path}: cannot be read as an image; expected JPEG or PNG", hint="check or remove the file")
    return np.asarray(image, dtype=np.uint8)
