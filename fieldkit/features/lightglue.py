"""LightGlue (Lindenberger et al., ICCV 2023) by kornia: matches of two images by attention among their keypoints."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import FeatureError
from fieldkit.features import FEATURES, Features, feature_name
from fieldkit.features.networks import one_at_a_time
from fieldkit.features.weights import WEIGHTS, fill_network, find_weights, read_weights

if TYPE_CHECKING:
    import torch

Matches = tuple[NDArray[np.uint32], NDArray[np.float32]]


class LightGlue:
    """A network that matches the features of two images; loaded once, and usable from several threads.

    Raises FeatureError when there is no LightGlue for the feature, and WeightsError without its weights.
    """

    def __init__(self, feature: str, *, weights: Path | None = None) -> None:
        name = feature_name(feature)
        stored = FEATURES[name].lightglue
        if stored is None:
            known = ", ".join(n for n, k in FEATURES.items() if k.lightglue is not None)
            raise FeatureError(f"no LightGlue for feature {name!r}; expected one of: {known}", hint="match by nearest")
        path = find_weights(WEIGHTS[stored], folder=weights)
        from kornia.feature.lightglue import LightGlue as Network

        network = Network(features=None, input_dim=FEATURES[name].width)  # type: ignore[arg-type]
        fill_network(network, _renamed(read_weights(path)), path=path)
        self._run = one_at_a_time(network)

    def match(
        self, first: Features, first_size: tuple[int, int], second: Features, second_size: tuple[int, int]
    ) -> Matches:
        """Match two images whose sizes are (width, height).

        Returns uint32[k, 2] of indices, sorted by the first, each index at most once, and scores f32[k] in 0..1.
        """
        if not len(first) or not len(second):
            return np.zeros((0, 2), dtype=np.uint32), np.zeros(0, dtype=np.float32)
        found = self._run({"image0": _batch(first, first_size), "image1": _batch(second, second_size)})
        pairs = found["matches"][0].numpy().astype(np.uint32)
        order = np.argsort(pairs[:, 0], kind="stable")
        return pairs[order], found["scores"][0].numpy().astype(np.float32)[order]


def _batch(features: Features, size: tuple[int, int]) -> dict[str, Any]:
    """Return one image as the network takes it: the centre of the first pixel at (0, 0)."""
    import torch

    return {
        "keypoints": torch.from_numpy(features.keypoints_px - np.float32(0.5))[None],
        "descriptors": torch.from_numpy(np.ascontiguousarray(features.descriptors, dtype=np.float32))[None],
        "image_size": torch.tensor([size], dtype=torch.float32),
    }


def _renamed(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return weights under the names of kornia's layers: files differ in whether a block's index comes first."""
    return {re.sub(r"^(self_attn|cross_attn)\.(\d+)\.", r"transformers.\2.\1.", k): v for k, v in state.items()}
