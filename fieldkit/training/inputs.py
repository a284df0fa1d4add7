"""Batches of views as what a network takes, with the changes that keep it from learning the scenes by heart."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fieldkit.learned.batches import padded
from fieldkit.training.examples import Examples, Progress
from fieldkit.training.rules import TrainingRules
from fieldkit.views import HEAT_CELLS, HISTOGRAM_WIDTH, TOKEN_WIDTH, landmark_tokens, thinned, view_histograms
from fieldkit.views.features import BINS

Floats = NDArray[np.float32]
Arrays = tuple[NDArray[np.generic], ...]
# In training, by how much (1 sigma) a landmark's distances are off, relatively, and its angles and image position, as
# shares of pi and of the image: where mapping saw it otherwise names the landmark, and with it the scene's views.
_DISTANCE_JITTER, _PLACE_JITTER = 0.1, 0.02
# In training, noise (1 sigma) on the histograms, which are logarithms of counts: a count is off by a third.
_COUNT_JITTER = 0.035
# In training, the share of the cells of the landmarks' heat maps that are emptied, for the same reason.
_HEAT_DROPOUT = 0.3
_DISTANCES, _PLACES = slice(0, 3), slice(3, 9)


class Inputs(Protocol):
    """Views of several scenes by one number, and their labels bool[v]."""

    label: NDArray[np.bool_]

    def plain(self, views: NDArray[np.int64], *, occlusion: bool) -> Arrays:
        """Return the network's inputs for views as they are scored."""

    def varied(self, views: NDArray[np.int64], occlusion: NDArray[np.bool_], rng: np.random.Generator) -> Arrays:
        """Return the network's inputs for views as it learns them."""


class HistogramInputs:
    """Histograms f32[v, 146], computed once with and without the landmarks behind the surface."""

    def __init__(self, scenes: Sequence[Examples], rules: TrainingRules, *, progress: Progress | None = None) -> None:
        self.label = np.concatenate([s.label for s in scenes])
        self._jitter = rules.jitter
        self._histograms = {
            use: np.concatenate([_histograms(s, occlusion=use, progress=progress) for s in scenes])
            for use in (False, True)
        }

    def plain(self, views: NDArray[np.int64], *, occlusion: bool) -> Arrays:
        """Return histograms f32[b, 146]."""
        return (self._histograms[occlusion][views],)

    def varied(self, views: NDArray[np.int64], occlusion: NDArray[np.bool_], rng: np.random.Generator) -> Arrays:
        """Return histograms f32[b, 146]: with noise on every count, every second batch in a mirror."""
        chosen = np.where(occlusion[:, None], self._histograms[True][views], self._histograms[False][views])
        in_mirror = rng.random() < 0.5
        noise = rng.standard_normal(chosen.shape, dtype=np.float32) * np.float32(_COUNT_JITTER * self._jitter)
        chosen = np.where(chosen > 0.0, np.clip(chosen + noise, 0.0, 1.0), 0.0)
        return (_mirrored(chosen) if in_mirror else chosen,)


def _histograms(scene: Examples, *, occlusion: bool, progress: Progress | None) -> Floats:
    rows = np.zeros((len(scene.label), HISTOGRAM_WIDTH), dtype=np.float32)
    for i in range(len(rows)):
        rows[i] = view_histograms(scene.view(i, occlusion=occlusion), scene.statistics, camera=scene.camera)
        if progress is not None and (i + 1 == len(rows) or i % 100 == 99):
            progress(f"histograms of {scene.scene}{', occlusion filter' if occlusion else ''}", i + 1, len(rows))
    return rows


def _mirrored(histograms: Floats) -> Floats:
    """Return histograms of views mirrored left to right: the cells of the image and, behind them, the bins of u."""
    result = histograms.copy()
    u = slice(HISTOGRAM_WIDTH - 2 * BINS, HISTOGRAM_WIDTH - BINS)
    cells = slice(u.start - HEAT_CELLS**2, u.start)
    image = histograms[:, cells].reshape(-1, HEAT_CELLS, HEAT_CELLS)
    result[:, cells] = image[:, :, ::-1].reshape(len(histograms), -1)
    result[:, u] = histograms[:, u][:, ::-1]
    return result


class TokenInputs:
    """Tokens of the landmarks of views, at most ``cap`` a view: others each time in training, the same in scoring."""

    def __init__(self, scenes: Sequence[Examples], rules: TrainingRules, *, appearance: Sequence[Floats] = ()) -> None:
        assert rules.cap is not None, "a model of landmarks has a cap"
        assert rules.drawn is not None, "the rules are settled"
        self._cap, self._drawn, self._jitter = rules.cap, rules.drawn, np.float32(rules.jitter)
        self.label = np.concatenate([s.label for s in scenes])
        self._scenes, self._appearance = scenes, appearance
        self._scene = np.repeat(np.arange(len(scenes)), [len(s.label) for s in scenes])
        self._first = np.cumsum([0, *(len(s.label) for s in scenes)])

    @property
    def width(self) -> int:
        """How many numbers a token has."""
        return TOKEN_WIDTH + (self._appearance[0].shape[1] if self._appearance else 0)

    def plain(self, views: NDArray[np.int64], *, occlusion: bool) -> Arrays:
        """Return tokens f32[b, n, width] and the weight f32[b, n] of each."""
        found = [self._tokens(v, occlusion=occlusion, cap=self._cap) for v in views]
        return padded([t for t, _ in found], visible=[n for _, n in found], width=self.width)

    def varied(self, views: NDArray[np.int64], occlusion: NDArray[np.bool_], rng: np.random.Generator) -> Arrays:
        """Return tokens f32[b, n, width] and their weights: landmarks with jitter, every second batch in a mirror."""
        seed, in_mirror = int(rng.integers(2**31)), rng.random() < 0.5
        found = [
            self._tokens(v, occlusion=bool(o), cap=self._drawn, seed=seed)
            for v, o in zip(views, occlusion, strict=True)
        ]
        counts = [len(t) for t, _ in found]
        tokens = np.concatenate([t for t, _ in found])
        noise = rng.standard_normal((len(tokens), _PLACES.stop), dtype=np.float32) * self._jitter
        tokens[:, _DISTANCES] *= np.exp(_DISTANCE_JITTER * noise[:, _DISTANCES])
        tokens[:, _PLACES] += _PLACE_JITTER * noise[:, _PLACES]
        heat = tokens[:, _PLACES.stop : TOKEN_WIDTH]
        heat *= rng.random(heat.shape, dtype=np.float32) >= _HEAT_DROPOUT * self._jitter
        if in_mirror:
            _mirror(tokens)
        np.clip(tokens, 0.0, 1.0, out=tokens)
        return padded(np.split(tokens, np.cumsum(counts)[:-1]), visible=[n for _, n in found], width=self.width)

    def _tokens(self, view: np.int64, *, occlusion: bool, cap: int, seed: int = 0) -> tuple[Floats, int]:
        """Return the tokens of a view, and how many landmarks it sees."""
        number = int(self._scene[view])
        scene = self._scenes[number]
        seen = scene.view(int(view - self._first[number]), occlusion=occlusion)
        kept = thinned(seen, cap=cap, seed=seed)
        tokens = landmark_tokens(
            kept,
            scene.statistics,
            heat_maps=scene.heat_maps,
            camera=scene.camera,
            appearance=self._appearance[number] if self._appearance else None,
        )
        return tokens, kept.visible


def _mirror(tokens: Floats) -> None:
    """Mirror landmarks left to right in place: where they are seen, and where mapping saw them."""
    u = _PLACES.stop - 2
    tokens[:, u] = 1.0 - tokens[:, u]
    heat = tokens[:, _PLACES.stop : TOKEN_WIDTH].reshape(-1, HEAT_CELLS, HEAT_CELLS)
    tokens[:, _PLACES.stop : TOKEN_WIDTH] = heat[:, :, ::-1].reshape(-1, HEAT_CELLS**2)
