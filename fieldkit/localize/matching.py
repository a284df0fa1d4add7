"""What the query is matched against: the landmarks of all retrieved images at once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldkit.features import Descriptors, FeatureKind, Features
from fieldkit.features.matching import match_groups
from fieldkit.localize.retrieval import Index
from fieldkit.protocol import LocalizerRules
from fieldkit.types import SceneMap

# A landmark that many retrieved images observe is described by the most similar of them: further descriptors cost
# as much and find hardly another match.
PER_LANDMARK = 3
# LightGlue takes about 2 s for two images of 1024 keypoints on two processors
LIGHTGLUE_IMAGES = 3
# Standard deviation (px per axis) of keypoints: of blobs by the size at which they are found, as the residuals of
# rendered queries at their true poses show it from 2 to 30 px; of networks, which find all at one scale
BLOB_SIGMA_PX, BLOB_SIGMA_PER_SIZE = 0.2, 0.055
NETWORK_SIGMA_PX = 0.6
# Blobs of this size and more are located worse than most, in the mapping images as in the query
_USUAL_SIGMA_PX = 0.35

Ints = NDArray[np.int32]
# (features, (width, height), index, retrieved images best first, threads) -> keypoints, landmarks
Matcher = Callable[[Features, tuple[int, int], Index, Ints, int], tuple[Ints, Ints]]


def open_matcher(
    scene_map: SceneMap, kind: FeatureKind, rules: LocalizerRules, *, weights: Path | None = None
) -> Matcher:
    """Return what matches a query with the landmarks of retrieved images, every landmark and keypoint at most once.

    Raises FeatureError for "lightglue" of a feature that has none, and WeightsError without its weights.
    """
    if rules.matcher == "lightglue":
        return _open_lightglue(scene_map, weights)

    def by_nearest(
        features: Features, size: tuple[int, int], index: Index, images: Ints, threads: int
    ) -> tuple[Ints, Ints]:
        stored, landmark = stored_descriptors(scene_map, index, images)
        by_ratio = kind.matching == "ratio"
        keypoint, found, _ = match_groups(
            features.descriptors,
            stored,
            landmark,
            ratio=rules.ratio if by_ratio else 1.0,
            mutual=not by_ratio,
            max_squared=2.0 - 2.0 * kind.min_cosine if kind.min_cosine > -1.0 else np.inf,
            threads=threads,
        )
        return keypoint, found

    return by_nearest


def _open_lightglue(scene_map: SceneMap, weights: Path | None) -> Matcher:
    # Loads torch
    from fieldkit.features.lightglue import LightGlue

    network = LightGlue(scene_map.feature, weights=weights)

    def by_network(
        features: Features, size: tuple[int, int], index: Index, images: Ints, threads: int
    ) -> tuple[Ints, Ints]:
        pairs, scores = [], []
        for image in images[:LIGHTGLUE_IMAGES]:
            seen, landmark = features_of(scene_map, index, int(image))
            camera = scene_map.image_cameras[image]
            found, score = network.match(features, size, seen, (camera.width, camera.height))
            pairs.append(np.column_stack([found[:, 0], landmark[found[:, 1]]]).astype(np.int32))
            scores.append(score)
        if not pairs:
            return np.zeros(0, dtype=np.int32), np.zeros(0, dtype=np.int32)
        return _merged(np.concatenate(pairs), np.concatenate(scores))

    return by_network


def features_of(scene_map: SceneMap, index: Index, image: int) -> tuple[Features, Ints]:
    """Return the landmarks that a mapping image observes as its features, and which landmarks (n,) these are."""
    begin, end = np.searchsorted(scene_map.observation_image, [image, image + 1])
    landmark, first = np.unique(scene_map.observation_landmark[begin:end], return_index=True)
    rows = index.rows[image]
    rows = rows[np.isin(scene_map.descriptor_landmark[rows], landmark)]
    owner = scene_map.descriptor_landmark[rows]
    pixels = scene_map.observation_px[begin:end][first[np.searchsorted(landmark, owner)]]
    ones = np.ones(len(rows), dtype=np.float32)
    return Features(pixels, ones, ones, scene_map.descriptors[rows]), owner


def _merged(pairs: Ints, scores: NDArray[np.float32]) -> tuple[Ints, Ints]:
    """Return (keypoints, landmarks) of pairs int32[n, 2], the best first, where neither has a better one."""
    pairs, at = np.unique(pairs, axis=0, return_inverse=True)
    best = np.zeros(len(pairs), dtype=np.float32)
    np.maximum.at(best, at.ravel(), scores)
    for column in (0, 1):
        order = np.lexsort((pairs[:, 1], pairs[:, 0], -best))
        pairs, best = pairs[order], best[order]
        _, first = np.unique(pairs[:, column], return_index=True)
        pairs, best = pairs[np.sort(first)], best[np.sort(first)]
    order = np.argsort(pairs[:, 0], kind="stable")
    return pairs[order, 0], pairs[order, 1]


def stored_descriptors(
    scene_map: SceneMap, index: Index, images: NDArray[np.int32]
) -> tuple[Descriptors, NDArray[np.int32]]:
    """Return descriptors (m, w) of the landmarks that these images (best first) observe, and their landmarks (m,).

    Every landmark has up to three, those of the best images.
    """
    if not len(images):
        return scene_map.descriptors[:0], scene_map.descriptor_landmark[:0]
    rows = np.concatenate([index.rows[int(i)] for i in images])
    _, first = np.unique(rows, return_index=True)
    rows = rows[np.sort(first)]
    order = np.argsort(scene_map.descriptor_landmark[rows], kind="stable")
    owner = scene_map.descriptor_landmark[rows[order]]
    position = np.arange(len(order))
    begins = np.concatenate([[True], owner[1:] != owner[:-1]])
    begin = np.maximum.accumulate(np.where(begins, position, 0))
    kept = np.sort(rows[order[position - begin < PER_LANDMARK]])
    return scene_map.descriptors[kept], scene_map.descriptor_landmark[kept]


def expected_noise(kind: FeatureKind, scales_px: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return f64[n], the standard deviation per axis of keypoints found at scales f32[n], all in px."""
    if kind.matching == "ratio":
        return np.hypot(BLOB_SIGMA_PX, BLOB_SIGMA_PER_SIZE * scales_px.astype(np.float64))
    return np.full(len(scales_px), NETWORK_SIGMA_PX)


def landmark_noise(kind: FeatureKind, sigma_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return f64[n]: by how much more than usual the keypoints vary of which matched landmarks were made."""
    return np.maximum(sigma_px / _USUAL_SIGMA_PX, 1.0) if kind.matching == "ratio" else np.ones(len(sigma_px))
