"""Scoring views with a checkpoint, and which landmarks made a score."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from fieldkit.errors import WeightsError
from fieldkit.features.weights import fill_network
from fieldkit.learned.batches import padded
from fieldkit.learned.checkpoint import Checkpoint
from fieldkit.views import HISTOGRAM_WIDTH, TOKEN_WIDTH

if TYPE_CHECKING:
    import torch

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
APPEARANCE_WIDTH = 3
_DIGITS = 5
# Views of one batch have together at most this many pairs of landmarks: their attention stays in the cache.
_MOST_PAIRS = 1 << 20


def token_width(checkpoint: Checkpoint) -> int | None:
    """Return how many numbers a landmark's token has; None where whole views are scored by their histograms."""
    if checkpoint.about.kind == "mlp":
        return None
    return TOKEN_WIDTH + (APPEARANCE_WIDTH if checkpoint.about.appearance is not None else 0)


def open_network(checkpoint: Checkpoint) -> torch.nn.Module:
    """Return the network of a checkpoint with its weights, ready to score.

    Raises WeightsError that names the first weight that is missing, unknown, not finite, or of another shape.
    """
    import torch

    from fieldkit.learned.networks import Mlp, Vpt

    width = token_width(checkpoint)
    with torch.device("meta"):
        network = Mlp() if width is None else Vpt(tokens=width)
    network.to_empty(device="cpu")
    state = {name: torch.from_numpy(value.copy()) for name, value in checkpoint.weights.items()}
    try:
        fill_network(network, state, path=Path(checkpoint.path or "checkpoint"))
    except WeightsError as error:
        raise WeightsError(error.message, hint="copy the file again, or train again") from error
    return network


class Scorer:
    """A checkpoint opened once, to score many views. Torch's threads are left as they are."""

    def __init__(self, checkpoint: Checkpoint) -> None:
        self.checkpoint = checkpoint
        self._width = token_width(checkpoint)
        self._network = open_network(checkpoint)

    def scores(self, views: Sequence[Floats], *, visible: Sequence[int] | None = None, filtered: bool = True) -> Array:
        """Return for each view the probability f64[v] that it localizes.

        ``views`` are histograms f32[146] for an MLP, else tokens f32[k, 73 or 76] of landmarks, k may be 0. ``visible``
        is how many landmarks each view sees where its tokens are of some of them only; ``filtered`` whether those
        behind the surface were left out. Raises WeightsError where a score is not finite.
        """
        return np.asarray(expit(self.log_odds(views, visible=visible, filtered=filtered)))

    def log_odds(
        self, views: Sequence[Floats], *, visible: Sequence[int] | None = None, filtered: bool = True
    ) -> Array:
        """Return the logarithm f64[v] of each view's odds to localize; see `scores`."""
        import torch

        result = np.empty(len(views), dtype=np.float64)
        about = self.checkpoint.about
        temperature, bias = about.temperature, about.bias
        if not filtered:
            temperature, bias = about.temperature_unfiltered, about.bias_unfiltered
        with torch.inference_mode():
            for members, inputs in self._batches(views, [len(v) for v in views] if visible is None else visible):
                logits = self._network(*map(torch.from_numpy, inputs)).double()
                result[members] = ((logits[:, 1] - logits[:, 0]) / temperature + bias).numpy()
        if not np.isfinite(result).all():
            raise WeightsError(
                f"{self.checkpoint.path or 'checkpoint'}: gives scores that are not finite; expected numbers",
                hint="train it again, or get the file again",
            )
        # The last bits depend on batches and threads: views that show the same nearly always tie
        return np.round(result, _DIGITS)

    def _batches(
        self, views: Sequence[Floats], visible: Sequence[int]
    ) -> Iterator[tuple[NDArray[np.int64], tuple[Floats, ...]]]:
        """Yield batches with the indices of their views: of nearly the same length, so that little is filled up."""
        if self._width is None:
            if len(views):
                yield np.arange(len(views)), (np.stack(views).reshape(len(views), HISTOGRAM_WIDTH),)
            return
        lengths = np.array([len(v) + 1 for v in views], dtype=np.int64)
        order = np.argsort(lengths, kind="stable")
        start = 0
        while start < len(order):
            stop = start + 1
            while stop < len(order) and (stop + 1 - start) * lengths[order[stop]] ** 2 <= _MOST_PAIRS:
                stop += 1
            members = order[start:stop]
            chosen = [views[i] for i in members]
            yield members, padded(chosen, visible=[visible[i] for i in members], width=self._width)
            start = stop
