"""What the query is matched against: the landmarks of all retrieved images at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fieldkit.features import Descriptors, FeatureKind
from fieldkit.localize.retrieval import Index
from fieldkit.types import SceneMap

# A landmark that many retrieved images observe is described by the most similar of them: further descriptors cost
# as much and find hardly another match.
PER_LANDMARK = 3
# Standard deviation (px per axis) of keypoints: of blobs by the size at which they are found, as the residuals of
# rendered queries at their true poses show it from 2 to 30 px; of networks, which find all at one scale
BLOB_SIGMA_PX, BLOB_SIGMA_PER_SIZE = 0.2, 0.055
NETWORK_SIGMA_PX = 0.6


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
