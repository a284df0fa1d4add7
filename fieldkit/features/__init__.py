"""Local features behind one small interface: a visible dict of kinds, one file each, `open_extractor` and `extract`."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import FeatureError, suggestion
from fieldkit.features import aliked
from fieldkit.features.akaze import detect_akaze
from fieldkit.features.images import read_grey, read_image, to_colour, to_grey
from fieldkit.features.sift import detect_sift, detect_sift_l2
from fieldkit.features.superpoint import load_superpoint
from fieldkit.features.xfeat import load_xfeat
from fieldkit.types import Image

__all__ = [
    "ALIASES",
    "FEATURES",
    "Descriptors",
    "Extractor",
    "FeatureKind",
    "Features",
    "extract",
    "feature_kind",
    "feature_name",
    "open_extractor",
    "read_grey",
    "read_image",
    "to_colour",
    "to_grey",
    "working_factor",
]

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
Detect = Callable[[Image, int], Detected]


@dataclasses.dataclass(frozen=True)
class FeatureKind:
    """How a feature is found and matched.

    ``load(folder)`` returns ``detect(image, max_keypoints)``, which returns keypoints (COLMAP pixels), scores, scales
    and descriptors [n, width] of ``dtype``, strongest first; a network finds its weights there, see `find_weights`.
    The image is uint8[h, w], or RGB uint8[h, w, 3] where ``colour``. ``matching`` says whether the distance ratio of
    the two nearest separates right matches from wrong ones, or only mutual nearest neighbours do; such neighbours
    need a cosine of at least ``min_cosine``. ``weights`` names those of the network, ``lightglue`` those of a LightGlue
    for this feature.
    """

    load: Callable[[Path | None], Detect]
    width: int
    matching: Literal["ratio", "mutual"]
    dtype: Literal["uint8", "float32"] = "float32"
    colour: bool = False
    min_cosine: float = -1.0
    lightglue: str | None = None
    weights: str | None = None


def _aliked(variant: aliked.AlikedVariant, *, lightglue: str | None = None) -> FeatureKind:
    return FeatureKind(
        functools.partial(aliked.load_aliked, variant),
        variant.width,
        "mutual",
        colour=True,
        min_cosine=0.6,
        lightglue=lightglue,
        weights=variant.weights,
    )


# Least similarities: ALIKED's by eight pairs of red kitchen frames (19 of 20 right matches pass, a third of the wrong
# ones do not), XFeat's as published, SuperPoint's as hloc has it (a distance of 0.7).
FEATURES: dict[str, FeatureKind] = {
    "sift": FeatureKind(lambda folder: detect_sift, 128, "ratio", dtype="uint8"),
    "sift_l2": FeatureKind(lambda folder: detect_sift_l2, 128, "ratio", dtype="uint8"),
    "akaze": FeatureKind(lambda folder: detect_akaze, 64, "ratio"),
    "aliked": _aliked(aliked.N16ROT, lightglue="lightglue-aliked"),
    "aliked_n16": _aliked(aliked.N16, lightglue="lightglue-aliked"),
    "aliked_t16": _aliked(aliked.T16),
    "xfeat": FeatureKind(load_xfeat, 64, "mutual", colour=True, min_cosine=0.82, weights="xfeat"),
    "superpoint": FeatureKind(load_superpoint, 256, "mutual", min_cosine=0.755, weights="superpoint"),
}

# Other accepted names: COLMAP and hloc store RootSIFT as SIFT.
ALIASES: dict[str, str] = {"rootsift": "sift"}


def feature_name(feature: str) -> str:
    """Return the name under which a feature is stored; raises FeatureError with a suggestion when it is unknown."""
    name = ALIASES.get(feature, feature)
    if name not in FEATURES:
        raise FeatureError(f"unknown feature {feature!r}", hint=suggestion(feature, [*FEATURES, *ALIASES]))
    return name


def feature_kind(feature: str) -> FeatureKind:
    """Return the kind of a feature by name; raises FeatureError with a suggestion when it is unknown."""
    return FEATURES[feature_name(feature)]


@dataclasses.dataclass(frozen=True)
class Extractor:
    """An opened feature: its network, if it has one, is loaded once. May be used from several threads."""

    feature: str
    kind: FeatureKind
    detect: Detect = dataclasses.field(repr=False)
    max_keypoints: int
    max_side_px: int | None

    def extract(self, image: Image) -> Features:
        """Find the strongest keypoints of an image uint8[h, w] (grey) or uint8[h, w, 3] (RGB).

        An image whose longer side exceeds ``max_side_px`` is reduced first (area average), and its keypoints are
        scaled back: with pixel centres at (0.5, 0.5) that is a plain multiplication. An image without texture gives
        no keypoints. Raises FeatureError for an array that is no such image.
        """
        ready = to_colour(image) if self.kind.colour else to_grey(image)
        height, width = ready.shape[:2]
        factor = working_factor((height, width), max_side_px=self.max_side_px)
        if factor < 1.0:
            size = max(round(width * factor), 1), max(round(height * factor), 1)
            ready = np.asarray(cv2.resize(ready, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        keypoints, scores, scales, descriptors = self.detect(ready, self.max_keypoints)
        if factor < 1.0:
            sx, sy = width / ready.shape[1], height / ready.shape[0]
            keypoints = keypoints * np.array([sx, sy], dtype=np.float32)
            scales = scales * np.float32(math.sqrt(sx * sy))
        return Features(keypoints, scores, scales, descriptors)


def open_extractor(
    feature: str, *, weights: Path | None = None, max_keypoints: int = 2048, max_side_px: int | None = 1600
) -> Extractor:
    """Open a feature for many images; ``weights`` is a folder where weight files are looked for first.

    Raises FeatureError for an unknown feature, and WeightsError when a network's weights are not found or not its own.
    """
    name = feature_name(feature)
    kind = FEATURES[name]
    return Extractor(name, kind, kind.load(weights), max_keypoints, max_side_px)


def extract(
    image: Image, *, feature: str = "sift", max_keypoints: int = 2048, max_side_px: int | None = 1600
) -> Features:
    """Find the strongest keypoints of one image, as `Extractor.extract` does; a network is loaded for this image."""
    return open_extractor(feature, max_keypoints=max_keypoints, max_side_px=max_side_px).extract(image)


def working_factor(shape: tuple[int, ...], *, max_side_px: int | None) -> float:
    """Return by how much `extract` reduces an image of shape (h, w) first: 1 or less."""
    return 1.0 if max_side_px is None else min(1.0, max_side_px / max(shape[:2]))
