"""Recall with intervals, medians and curves of trials."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from fieldkit.errors import ScoreError
from fieldkit.protocol import Threshold
from fieldkit.scores.bounds import Array, PoseName, error_of, inside
from fieldkit.trust import BEST_POSSIBLE
from fieldkit.types import Run, Trial

Z_95 = 1.959963984540054


@dataclasses.dataclass(frozen=True)
class Summary:
    """What one policy reached over n visits: recall per threshold with its Wilson interval, weighted medians.

    ``recall`` and ``interval`` are fractions in 0..1; ``median`` is (m, rad), infinite where too many failed.
    """

    policy: str
    occlusion: bool | None
    n: int
    recall: tuple[float, ...]
    interval: tuple[tuple[float, float], ...]
    median: tuple[float, float]


def wilson(recall: float, n: int, *, z: float = Z_95) -> tuple[float, float]:
    """Return Wilson's score interval (95 %) of a fraction of n trials; the fraction need not be k / n.

    E. B. Wilson, "Probable inference, the law of succession, and statistical inference", 1927.
    """
    if n <= 0:
        return 0.0, 1.0
    centre = (recall + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(recall * (1 - recall) / n + z * z / (4 * n * n))
    return min(max(centre - half, 0.0), recall), max(min(centre + half, 1.0), recall)


def weighted_median(values: ArrayLike, weights: ArrayLike) -> float:
    """Return the median of values (n,) with weights (n,); halfway between two where the weight splits evenly."""
    x, w = np.asarray(values, dtype=np.float64), np.asarray(weights, dtype=np.float64)
    x, w = x[w > 0], w[w > 0]
    if not len(x):
        return math.inf
    order = np.argsort(x, kind="stable")
    x, share = x[order], np.cumsum(w[order]) / w.sum()
    first = int(np.flatnonzero(share >= 0.5 - 1e-9)[0])
    if abs(share[first] - 0.5) < 1e-9 and first + 1 < len(x):
        return float((x[first] + x[first + 1]) / 2)
    return float(x[first])


def hits(trials: Sequence[Trial], threshold: Threshold, *, pose: PoseName) -> dict[tuple[str, str], float]:
    """Return by (session, visit) how much of one policy's choice is inside a threshold, 0..1; any for best possible."""
    inside_of: dict[tuple[str, str], list[float]] = {}
    for trial in trials:
        hit = inside(error_of(trial, pose=pose), threshold)
        inside_of.setdefault((trial.session, trial.visit), []).append(
            float(hit) if trial.policy == BEST_POSSIBLE else trial.weight * hit
        )
    best = bool(trials) and trials[0].policy == BEST_POSSIBLE
    return {visit: min(max(v) if best else math.fsum(v), 1.0) for visit, v in inside_of.items()}


def recall(trials: Sequence[Trial], threshold: Threshold, *, pose: PoseName) -> float:
    """Return one policy's fraction of visits inside a threshold: weighted hits, any hit for best possible."""
    per_visit = hits(trials, threshold, pose=pose).values()
    return math.fsum(per_visit) / len(per_visit) if per_visit else 0.0


def check_weights(trials: Iterable[Trial]) -> None:
    """Raise ScoreError where the choices of a policy at a visit do not add up to one: the recall would be wrong."""
    total: dict[tuple[str, str, str, bool | None], float] = {}
    for t in trials:
        key = (t.session, t.visit, t.policy, t.occlusion)
        total[key] = total.get(key, 0.0) + t.weight
    for (session, visit, policy, _), weight in total.items():
        if not math.isclose(weight, 1.0, abs_tol=1e-6):
            raise ScoreError(
                f"{session}/{visit}: the weights of {policy} add up to {weight:g}; expected 1",
                hint="replay the recording again",
            )


def cumulative(
    trials: Sequence[Trial], *, pose: PoseName, part: Literal["position", "rotation"]
) -> tuple[Array, Array]:
    """Return one policy's sorted finite errors (m or rad) and the fraction of visits at or below each.

    The fraction ends below 1 where estimates failed.
    """
    index = 0 if part == "position" else 1
    n = len({(t.session, t.visit) for t in trials})
    rows = sorted((error_of(t, pose=pose)[index], t.weight) for t in trials if t.weight > 0)
    finite = [(error, weight) for error, weight in rows if math.isfinite(error)]
    errors = np.array([error for error, _ in finite], dtype=np.float64)
    return errors, np.cumsum([weight for _, weight in finite]) / max(n, 1)


def group(trials: Iterable[Trial], *, order: Sequence[str] = ()) -> dict[tuple[str, bool | None], list[Trial]]:
    """Return trials per (policy, occlusion), policies in the given order, without occlusion before with."""
    groups: dict[tuple[str, bool | None], list[Trial]] = {}
    for trial in trials:
        groups.setdefault((trial.policy, trial.occlusion), []).append(trial)
    return {variant: groups[variant] for variant in ordered(groups, order or [v[0] for v in groups])}


def summarize(
    trials: Iterable[Trial], *, thresholds: Sequence[Threshold], pose: PoseName, order: Sequence[str] = ()
) -> tuple[Summary, ...]:
    """Summarize trials per (policy, occlusion): recall at strict thresholds, intervals, weighted medians.

    Raises ScoreError when the weights of a policy at a visit do not add up to one.
    """
    trials, summaries = list(trials), []
    check_weights(trials)
    for (policy, occlusion), rows in group(trials, order=order).items():
        n = len({(t.session, t.visit) for t in rows})
        recalls = tuple(recall(rows, threshold, pose=pose) for threshold in thresholds)
        weights = [t.weight for t in rows]
        position, rotation = (weighted_median([error_of(t, pose=pose)[i] for t in rows], weights) for i in (0, 1))
        intervals = tuple(wilson(r, n) for r in recalls)
        summaries.append(Summary(policy, occlusion, n, recalls, intervals, (position, rotation)))
    return tuple(summaries)


def summarize_run(run: Run, *, thresholds: Sequence[Threshold] | None = None) -> tuple[Summary, ...]:
    """Summarize a run with its protocol's pose and order, at its thresholds or at others.

    Raises ScoreError when no visit of the run could be scored.
    """
    if not run.trials:
        reason = f"{run.excluded[0].what}: {run.excluded[0].reason}" if run.excluded else "it holds no visit"
        raise ScoreError(f"{run.path or 'run'}: no visit was scored ({reason})", hint="see its list of exclusions")
    chosen = run.protocol.thresholds if thresholds is None else thresholds
    return summarize(run.trials, thresholds=chosen, pose=run.protocol.pose, order=run.protocol.policies)


def ordered(variants: Iterable[tuple[str, bool | None]], order: Sequence[str]) -> list[tuple[str, bool | None]]:
    rank = {name: i for i, name in enumerate(order)}
    return sorted(variants, key=lambda v: (rank.get(v[0], len(rank)), v[1] is not None, bool(v[1])))
