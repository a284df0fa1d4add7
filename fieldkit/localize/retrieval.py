"""Which mapping images look like the query: by descriptors of the map's own landmarks, or by a network's of images."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from fieldkit.features import Descriptors
from fieldkit.features.nearest import Shelves, fill_shelves, nearest_on_shelves
from fieldkit.features.vlad import Vocabulary, global_descriptor, train_vocabulary, two_words
from fieldkit.types import SceneMap

Ints = NDArray[np.int32]
# A landmark of the query's word votes when its descriptor is this much nearer than any other's
_VOTING_RATIO = 0.85
# Landmarks of one word that may vote, those that most images saw: large maps stay quick
_VOTERS = 1024


@dataclasses.dataclass(frozen=True)
class Index:
    """A global descriptor f32[k, w] per mapping image, and the rows of ``descriptors`` that describe it.

    In a full map these are the image's own descriptors. In a compact map, where a landmark keeps one descriptor,
    they are those of the landmarks that the image observes.

    ``voters`` holds one descriptor of each voting landmark, word by word of the vocabulary. The landmark of number i
    is seen by the images ``seen[starts[i]:starts[i + 1]]`` when it votes, by none otherwise.
    """

    vocabulary: Vocabulary
    vectors: NDArray[np.float32]
    rows: tuple[Ints, ...]
    voters: Shelves
    seen: Ints
    starts: NDArray[np.int64]


def build_index(scene_map: SceneMap, *, seed: int) -> Index:
    """Index a map for `most_similar`; the vocabulary is trained on its own descriptors."""
    rows = image_rows(scene_map)
    vocabulary = train_vocabulary(scene_map.descriptors, seed=seed)
    # Written in place: a list of them and its stack would take twice the memory
    vectors = np.empty((len(rows), vocabulary.centres.size), dtype=np.float32)
    for i, mine in enumerate(rows):
        vectors[i] = global_descriptor(vocabulary, scene_map.descriptors[mine])
    return Index(vocabulary, vectors, rows, *_voters(scene_map, vocabulary))


def _voters(scene_map: SceneMap, vocabulary: Vocabulary) -> tuple[Shelves, Ints, NDArray[np.int64]]:
    landmark, first = np.unique(scene_map.descriptor_landmark, return_index=True)
    word = np.concatenate([two_words(vocabulary, scene_map.descriptors[part])[0] for part in _parts(first)])
    n_seen = np.bincount(scene_map.observation_landmark, minlength=len(scene_map.xyz))
    order = np.lexsort((-n_seen[landmark], word))
    rank = np.arange(len(order)) - np.searchsorted(word[order], word[order])
    kept = np.sort(order[rank < _VOTERS])
    shelves = fill_shelves(
        scene_map.descriptors[first[kept]], landmark[kept], word[kept], count=len(vocabulary.centres)
    )
    votes = np.zeros(len(scene_map.xyz), dtype=bool)
    votes[landmark[kept]] = True
    cast = np.flatnonzero(votes[scene_map.observation_landmark])
    cast = cast[np.argsort(scene_map.observation_landmark[cast], kind="stable")]
    starts = np.searchsorted(scene_map.observation_landmark[cast], np.arange(len(scene_map.xyz) + 1))
    return shelves, scene_map.observation_image[cast], starts


def _parts(rows: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Return rows int[n] in parts that take little memory."""
    return np.array_split(rows, -(-len(rows) // 20_000))


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
    words = two_words(index.vocabulary, descriptors)
    similarity = _similarity(index.vectors, global_descriptor(index.vocabulary, descriptors, words=words[0]))
    by_likeness, by_votes = (np.argsort(-v, kind="stable") for v in (similarity, _votes(index, descriptors, words)))
    # In turns: either finds places that the other does not
    both = np.column_stack([by_votes, by_likeness]).ravel()
    _, first = np.unique(both, return_index=True)
    return _first(both[np.sort(first)], count, among)


def nearest_vectors(
    vectors: NDArray[np.float32],
    vector: NDArray[np.float32],
    *,
    count: int,
    among: NDArray[np.bool_] | None = None,
) -> Ints:
    """Return the indices of the unit vectors f32[k, w] nearest to one f32[w], best first, as `most_similar` does."""
    return _first(np.argsort(-_similarity(vectors, vector), kind="stable"), count, among)


def _similarity(vectors: NDArray[np.float32], vector: NDArray[np.float32]) -> NDArray[np.float32]:
    # Summed by numpy itself: BLAS would start threads for it
    return np.asarray(np.einsum("kw,w->k", vectors, vector))


def _first(order: NDArray[np.int64], count: int, among: NDArray[np.bool_] | None) -> Ints:
    return (order if among is None else order[among[order]])[:count].astype(np.int32)


def _votes(index: Index, descriptors: Descriptors, words: Ints) -> NDArray[np.float64]:
    """Return f64[k]: how many of the landmarks that an image saw are the nearest to a descriptor of the query.

    Only landmarks of its two nearest ``words`` int32[2, n] are compared, and those count that are clearly nearer than
    any other.
    """
    found = [nearest_on_shelves(descriptors, w, index.voters) for w in words]
    owner, squared, other = (np.stack([getattr(f, n) for f in found]) for n in ("index", "squared", "other"))
    rival = np.where(owner[0] != owner[1], np.maximum(squared[0], squared[1]), np.inf)
    least, second = squared.min(axis=0), np.minimum(other.min(axis=0), rival)
    good = least < _VOTING_RATIO**2 * second
    landmark = np.unique(owner[squared.argmin(axis=0), np.arange(len(descriptors))][good])
    counts = index.starts[landmark + 1] - index.starts[landmark]
    before = np.cumsum(counts) - counts
    rows = np.repeat(index.starts[landmark] - before, counts) + np.arange(counts.sum())
    return np.bincount(index.seen[rows], minlength=len(index.vectors)).astype(np.float64)


def _grouped(owner: Ints, count: int) -> list[NDArray[np.int64]]:
    order = np.argsort(owner, kind="stable")
    return np.split(order, np.searchsorted(owner[order], np.arange(1, count)))
