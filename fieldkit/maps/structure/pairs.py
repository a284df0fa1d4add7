"""Which mapping images are matched, and their matches: from the images alone, never from poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from fieldkit.features import Features
from fieldkit.features.matchers import PairMatcher
from fieldkit.features.vlad import global_descriptor, train_vocabulary
from fieldkit.maps.sources.source import SourceImage

Pair = tuple[int, int]


def choose_pairs(
    images: Sequence[SourceImage],
    features: Sequence[Features],
    *,
    seed: int,
    n_similar: int = 20,
    n_neighbours: int = 3,
) -> list[Pair]:
    """Choose image pairs (i < j): the most similar by global descriptor, and neighbours in the sequence.

    Neighbours are the next images of the same camera, and the other cameras' images of the same and the next frame.
    """
    pairs: set[Pair] = set()
    frames = sorted({image.frame for image in images})
    index = {frame: i for i, frame in enumerate(frames)}
    for i, first in enumerate(images):
        for j, second in enumerate(images[i + 1 :], start=i + 1):
            reach = n_neighbours if first.sequence == second.sequence else 1
            if abs(index[first.frame] - index[second.frame]) <= reach:
                pairs.add((i, j))
    pairs |= _similar_pairs(features, seed=seed, count=n_similar)
    return sorted(pairs)


def _similar_pairs(features: Sequence[Features], *, seed: int, count: int) -> set[Pair]:
    if not any(len(f) for f in features):
        return set()
    vocabulary = train_vocabulary(np.concatenate([f.descriptors for f in features]), seed=seed)
    vectors = np.stack([global_descriptor(vocabulary, f.descriptors) for f in features])
    similarity = vectors @ vectors.T
    np.fill_diagonal(similarity, -np.inf)
    nearest = np.argsort(-similarity, axis=1, kind="stable")[:, : min(count, len(features) - 1)]
    return {(min(i, int(j)), max(i, int(j))) for i, row in enumerate(nearest) for j in row}


def match_pairs(
    pairs: Sequence[Pair],
    features: Sequence[Features],
    *,
    sizes: Sequence[tuple[int, int]],
    matcher: PairMatcher,
    progress: Callable[[int], None] | None = None,
    n_threads: int = 2,
) -> list[NDArray[np.uint32]]:
    """Match the features of every pair of images, whose ``sizes`` are (width, height).

    The result does not depend on the number of threads.
    """

    def one(pair: Pair) -> NDArray[np.uint32]:
        i, j = pair
        return matcher.match(features[i], sizes[i], features[j], sizes[j])

    results = []
    with ThreadPoolExecutor(n_threads) as pool:
        for done, found in enumerate(pool.map(one, pairs), start=1):
            results.append(found)
            if progress is not None:
                progress(done)
    return results
