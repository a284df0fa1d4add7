"""How the features of two whole images are matched: nearest neighbours, or LightGlue."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import FeatureError
from fieldkit.features import Features, feature_kind
from fieldkit.features.lightglue import LightGlue
from fieldkit.features.matching import match_pair

MatcherName = Literal["nearest", "lightglue"]
Size = tuple[int, int]


@dataclasses.dataclass(frozen=True)
class PairMatcher:
    """An opened matcher: ``match(first, size, second, size)`` gives uint32[k, 2]; sizes are (width, height).

    ``n_similar`` is to how many similar images an image is worth matching by default: LightGlue takes a tenth of a
    second and more for a pair, nearest neighbours milliseconds.
    """

    name: MatcherName
    match: Callable[[Features, Size, Features, Size], NDArray[np.uint32]] = dataclasses.field(repr=False)
    n_similar: int


def open_matcher(
    feature: str, matcher: MatcherName = "nearest", *, ratio: float = 0.8, weights: Path | None = None
) -> PairMatcher:
    """Open a matcher for a feature; ``ratio`` is the distance ratio of features that are told apart by it.

    Raises FeatureError for an unknown feature or a matcher that it does not have, WeightsError without its weights.
    """
    kind = feature_kind(feature)
    if matcher == "lightglue":
        network = LightGlue(feature, weights=weights)
        return PairMatcher("lightglue", lambda a, m, b, n: network.match(a, m, b, n)[0], 14)
    if matcher != "nearest":
        raise FeatureError(f"unknown matcher {matcher!r}", hint="known: nearest, lightglue")
    least = ratio if kind.matching == "ratio" else 1.0

    def nearest(first: Features, _: Size, second: Features, __: Size) -> NDArray[np.uint32]:
        return match_pair(first.descriptors, second.descriptors, ratio=least, min_cosine=kind.min_cosine)

    return PairMatcher("nearest", nearest, 20)
