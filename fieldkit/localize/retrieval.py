"""Which mapping images look like the query: by descriptors of the map's own landmarks, or by a network's of images."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from fieldkit.features import Descriptors
from fieldkit.features.vlad import Vocabulary, global_descriptor, train_vocabulary
from fieldkit.types import SceneMap

Ints = NDArray[np.int32]


@dataclasses.dataclass(frozen=True)
class Index:
    """A global descriptor f32[k, w] per mapping image, and the rows of ``descriptors`` that describe it.

    In a full map these are the image's own descriptors. In a compact map, where a landmark keeps one descriptor,
    they are those of the landmarks that the image observes.
    """

    vocabulary: Vocabulary
    vectors: NDArray[np.float32]
    rows: tuple[Ints, ...]


def build_index(scene_map: SceneMap, *, seed: int) -> Index:
    """Index a map for `most_similar`; the vocabulary is trained on its own descriptors."""
    rows = image_rows(scene_map)
    vocabulary = train_vocabulary(scene_map.descriptors, seed=seed)
    # Written in place: a list of them and its stack would take twice the memory
    vectors = np.empty((len(rows), vocabulary.centres.size), dtype=np.float32)
    for i, mine in enumerate(rows):
        vectors[i] = global_descriptor(vocabulary, scene_map.descriptors[mine])
    return Index(vocabulary, vectors, rows)


def image_rows(scene_map: SceneMap) -> tuple[Ints, ...]:
    """Return per mapping image the descriptor of every landmark it observes: its own, else the landmark's first."""
    first = np.full(len(scene_map.xyz), -1, dtype=np.int32)
    landmarks, positions = np.unique(scene_map.descriptor_landmark, return_index=True)
    first[landmarks] = positions
    count = len(scene_map.image_names)
    bounds = np.searchsorted(scene_map.observation_image, np.arange(count + 1))
    own = _grouped(scene_map.descriptor_image, count)
    result = []
    for i in range(count):
        chosen = first[np.unique(scene_map.observation_landmark[bounds[i] : bounds[i + 1]])]
        borrowed = chosen[chosen >= 0]
        described = scene_map.descriptor_landmark[own[i]]
        borrowed = borrowed[~np.isin(scene_map.descriptor_landmark[borrowed], described)]
        result.append(np.concatenate([own[i], borrowed]).astype(np.int32))
    return tuple(result)


def most_similar(index: Index, descriptors: Descriptors, *, count: int, among: NDArray[np.bool_] | None = None) -> Ints:
    """Return the indices of the mapping images most similar to an image with these descriptors, best first.

    Only those in ``among`` bool[k], where it is given.
    """
    vector = global_descriptor(index.vocabulary, descriptors)
    return nearest_vectors(index.vectors, vector, count=count, among=among)


def nearest_vectors(
    vectors: NDArray[np.float32],
    vector: NDArray[np.float32],
    *,
    count: int,
    among: NDArray[np.bool_] | None = None,
) -> Ints:
    """Return the indices of the unit vectors f32[k, w] nearest to one f32[w], best first, as `most_similar` does."""
    # Summed by numpy itself: BLAS would start threads for it
    similarity = np.einsum("kw,w->k", vectors, vector)
    order = np.argsort(-similarity, kind="stable")
    return (order if among is None else order[among[order]])[:count].astype(np.int32)


def _grouped(owner: Ints, count: int) -> list[NDArray[np.int64]]:
    order = np.argsort(owner, kind="stable")
    return np.split(order, np.searchsorted(owner[order], np.arange(1, count)))
