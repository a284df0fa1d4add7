"""Whether one policy is better than another: paired over visits, since both looked from the same places."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import ScoreError
from fieldkit.protocol import HEURISTICS, LEARNED, Threshold
from fieldkit.scores.bounds import Array, PoseName
from fieldkit.scores.summary import group, hits
from fieldkit.types import Trial

Variant = tuple[str, bool | None]
Numbers = NDArray[np.integer]
SIGNIFICANT = 0.05
# Of so few visits a session's own spread is not known.
_SHORT = 5
# Resamples at once: bounds the memory
_CHUNK = 1000


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Variant ``a`` against ``b``, both (policy, occlusion), over the n visits that both were scored at.

    ``n_a_only`` and ``n_b_only`` are visits (expected ones where views tie) that only one localizes inside
    ``threshold``; ``difference`` is recall of a less that of b with its 95 % ``interval``; ``p`` of no difference at
    all, two-sided, and ``p_corrected`` for all comparisons made together.
    """

    a: Variant
    b: Variant
    threshold: Threshold
    n: int
    n_a_only: float
    n_b_only: float
    difference: float
    interval: tuple[float, float]
    p: float
    p_corrected: float


def compare(
    trials: Sequence[Trial],
    pairs: Sequence[tuple[Variant, Variant]],
    *,
    thresholds: Sequence[Threshold],
    pose: PoseName,
    seed: int = 0,
    resamples: int = 10_000,
) -> tuple[Comparison, ...]:
    """Compare pairs of variants at thresholds.

    Intervals are percentiles of the paired bootstrap, visits drawn anew within their sessions (Efron and Tibshirani
    1993, chapters 13 and 16): they hold for these sessions, not for sessions of other buildings. Sessions of fewer
    than five visits count as one together; a single visit says nothing, and its interval is everything. p is that
    of the paired permutation test by random signs, and is corrected by Holm's method (1979) over all pairs and
    thresholds. The same seed gives the same numbers, whatever else is compared. Raises ScoreError where a variant has
    no trials, or two share no visit.
    """
    groups = group(trials)
    found: list[Comparison] = []
    for a, b in pairs:
        for variant in (a, b):
            if variant not in groups:
                raise ScoreError(f"no row {_words(variant)}; expected it, to compare {_words(a)} with {_words(b)}")
        for threshold in thresholds:
            ours, theirs = (hits(groups[v], threshold, pose=pose) for v in (a, b))
            visits = sorted(set(ours) & set(theirs))
            if not visits:
                raise ScoreError(f"{_words(a)} and {_words(b)} share no visit; expected some, to compare them")
            first, second = (np.array([h[v] for v in visits]) for h in (ours, theirs))
            sessions = np.unique([session for session, _ in visits], return_inverse=True)[1]
            rng = np.random.default_rng([seed, *repr((a, b, threshold.position_m, threshold.rotation_deg)).encode()])
            delta = first - second
            interval = _bootstrap(delta, sessions, rng=rng, resamples=resamples)
            p = _random_signs(delta, rng=rng, resamples=resamples)
            a_only, b_only = float((first * (1 - second)).sum()), float((second * (1 - first)).sum())
            found.append(Comparison(a, b, threshold, len(visits), a_only, b_only, float(delta.mean()), interval, p, p))
    corrected = holm([c.p for c in found])
    return tuple(dataclasses.replace(c, p_corrected=p) for c, p in zip(found, corrected, strict=True))


def verdict(found: Comparison, *, margin: float) -> str:
    """Say in words what a comparison shows: better or worse by the corrected p at 5 %, else whether a is not worse.

    Not worse means by less than ``margin``: the interval ends above it.
    """
    points = f"{100 * margin:g} points"
    if found.p_corrected < SIGNIFICANT:
        if found.difference > 0.0:
            return "better"
        return f"worse, by less than {points}" if found.interval[0] > -margin else "worse"
    return f"not worse by {points}" if found.interval[0] > -margin else "open"


def learned_pairs(trials: Sequence[Trial]) -> list[tuple[Variant, Variant]]:
    """Return every learned policy of some trials with every heuristic that has the same occlusion."""
    variants = list(group(trials))
    return [(a, b) for a in variants for b in variants if a[0] in LEARNED and b[0] in HEURISTICS and a[1] == b[1]]


def holm(p: Sequence[float]) -> list[float]:
    """Return p values corrected for being many, in their order: Holm, "A simple sequentially rejective multiple test
    procedure", 1979."""
    order = np.argsort(p, kind="stable")
    stepped = np.asarray(p, dtype=np.float64)[order] * np.arange(len(p), 0, -1)
    result = np.empty(len(p))
    result[order] = np.minimum(np.maximum.accumulate(stepped), 1.0)
    return [float(v) for v in result]


def _bootstrap(delta: Array, sessions: Numbers, *, rng: np.random.Generator, resamples: int) -> tuple[float, float]:
    """Return the 95 % interval of the mean of delta.

    Draws of n visits vary less than the visits do, by (n - 1) / n: they are spread by so much around their mean, which
    counts where sessions are short (Rao and Wu, "Resampling inference with complex survey data", 1988).
    """
    if len(delta) < 2:
        return -1.0, 1.0
    strata = _strata(sessions)
    sums = np.zeros(resamples)
    for stratum in np.unique(strata):
        own = delta[strata == stratum]
        spread, mean = np.sqrt(len(own) / (len(own) - 1)), own.mean()
        for begin in range(0, resamples, _CHUNK):
            size = min(_CHUNK, resamples - begin)
            drawn = rng.integers(0, len(own), (size, len(own)))
            sums[begin : begin + size] += (mean + spread * (own[drawn] - mean)).sum(axis=1)
    low, high = np.clip(np.percentile(sums / len(delta), [2.5, 97.5]), -1.0, 1.0)
    return float(low), float(high)


def _strata(sessions: Numbers) -> Numbers:
    """Return a stratum per visit: its session, or that of all short sessions together, with one more if need be."""
    counts = np.bincount(sessions)
    result = np.where(counts[sessions] >= _SHORT, sessions, -1)
    if 0 < np.count_nonzero(result == -1) < _SHORT:
        result[result == -1] = result.max()
    return result


def _random_signs(delta: Array, *, rng: np.random.Generator, resamples: int) -> float:
    """Return the share of random signs that give as large a sum, the sum itself counted (Phipson and Smyth 2010)."""
    differing, seen = delta[np.abs(delta) > 1e-12], abs(float(delta.sum()))
    reached = 0
    for begin in range(0, resamples, _CHUNK):
        size = min(_CHUNK, resamples - begin)
        signs = rng.integers(0, 2, (size, len(differing))) * 2 - 1
        reached += int((np.abs(signs @ differing) >= seen - 1e-9).sum())
    return (reached + 1) / (resamples + 1)


def _words(variant: Variant) -> str:
    policy, occlusion = variant
    return policy + ("" if occlusion is None else " with occlusion" if occlusion else " without occlusion")
