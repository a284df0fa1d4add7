"""What the query is matched against: the landmarks of all retrieved images at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fieldkit.features import Descriptors
from fieldkit.localize.retrieval import Index
from fieldkit.types import SceneMap


def stored_descriptors(
    scene_map: SceneMap, index: Index, images: NDArray[np.int32]
) -> tuple[Descriptors, NDArray[np.int32]]:
    """Return the descriptors (m, w) of the landmarks that these images observe, each once, and their landmarks (m,)."""
    if not len(images):
        return scene_map.descriptors[:0], scene_map.descriptor_landmark[:0]
    rows = np.unique(np.concatenate([index.rows[int(i)] for i in images]))
    return scene_map.descriptors[rows], scene_map.descriptor_landmark[rows]
