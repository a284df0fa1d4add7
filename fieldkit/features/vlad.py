"""A global descriptor of an image from its local ones: VLAD over a small vocabulary (Jegou et al., CVPR 2010)."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from fieldkit.features import Descriptors
from fieldkit.features.nearest import Ints, two_nearest

Floats = NDArray[np.float32]


@dataclasses.dataclass(frozen=True)
class Vocabulary:
    """Cluster centres f32[k, w] of unit-length local descriptors."""

    centres: Floats


def train_vocabulary(descriptors: Descriptors, *, seed: int, size: int = 64, max_samples: int = 20_000) -> Vocabulary:
    """Cluster descriptors (n, w) by seeded k-means; fewer descriptors than ``size`` become the centres themselves."""
    rng = np.random.default_rng(seed)
    if len(descriptors) > max_samples:
        descriptors = descriptors[np.sort(rng.choice(len(descriptors), max_samples, replace=False))]
    points = _unit(descriptors)
    size = min(size, len(points))
    centres = points[np.sort(rng.choice(len(points), size, replace=False))]
    for _ in range(12):
        nearest = _assign(points, centres)
        sums = np.zeros_like(centres)
        np.add.at(sums, nearest, points)
        counts = np.bincount(nearest, minlength=size)
        filled = counts > 0
        centres = centres.copy()
        centres[filled] = sums[filled] / counts[filled, None]
    return Vocabulary(centres)


def global_descriptor(vocabulary: Vocabulary, descriptors: Descriptors, *, words: Ints | None = None) -> Floats:
    """Return the unit VLAD vector f32[k * w] of one image: residuals per centre, each normalised, square-rooted.

    ``words`` int32[n] are the descriptors' nearest centres where they are known. An image without descriptors gives
    zeros, which is equally far from every image.
    """
    size, width = vocabulary.centres.shape
    result = np.zeros((size, width), dtype=np.float32)
    if len(descriptors):
        points = _unit(descriptors)
        nearest = _assign(points, vocabulary.centres) if words is None else words
        order = np.argsort(nearest, kind="stable")
        words, starts = np.unique(nearest[order], return_index=True)
        residuals = points[order] - vocabulary.centres[nearest[order]]
        result[words] = np.add.reduceat(residuals, starts, axis=0)
    result = np.sign(result) * np.sqrt(np.abs(result))
    result /= np.maximum(np.linalg.norm(result, axis=1, keepdims=True), 1e-12)
    flat = result.ravel()
    return np.asarray(flat / max(float(np.linalg.norm(flat)), 1e-12), dtype=np.float32)


def two_words(vocabulary: Vocabulary, descriptors: Descriptors) -> Ints:
    """Return int32[2, n]: the nearest and the second nearest word (row of the vocabulary) of each descriptor (n, w)."""
    return two_nearest(_unit(descriptors), vocabulary.centres)


def _unit(descriptors: Descriptors) -> Floats:
    values = np.asarray(descriptors, dtype=np.float32)
    return np.asarray(values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-12), dtype=np.float32)


def _assign(points: Floats, centres: Floats) -> Ints:
    return np.asarray(two_nearest(points, centres)[0])
