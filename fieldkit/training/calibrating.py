"""From log-odds to probabilities: the temperature, and how well what is said holds."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import gammaln

Array = NDArray[np.float64]
Labels = NDArray[np.bool_]
# A network that separates every view, or none, would otherwise be trusted without bound
_LOG_SLOPES = (-np.log(10.0), np.log(10.0))


@dataclasses.dataclass(frozen=True)
class Calibration:
    """The score is the probability of log-odds / ``temperature`` + ``bias`` (Guo et al., ICML 2017, with a bias)."""

    temperature: float
    bias: float

    def log_odds(self, log_odds: Array) -> Array:
        """Return calibrated log-odds f64[v]."""
        return log_odds / self.temperature + self.bias

    def apply(self, log_odds: Array) -> Array:
        """Return probabilities f64[v]."""
        return probability(self.log_odds(log_odds))


def probability(log_odds: Array) -> Array:
    """Return the probabilities f64[v] of log-odds."""
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * np.asarray(log_odds, dtype=np.float64))))


def log_loss(log_odds: Array, label: Labels) -> float:
    """Return the mean negative log likelihood of labels."""
    return float(np.mean(np.logaddexp(0.0, np.where(label, -log_odds, log_odds))))


def fit_calibration(log_odds: Array, label: Labels) -> Calibration:
    """Find temperature and bias under which the labels are most likely.

    A bias is needed beside the temperature where classes were balanced in training: then log-odds are off by a
    constant.
    """

    def cost(x: Array) -> float:
        return log_loss(np.exp(x[0]) * log_odds + x[1], label)

    rate = float(np.clip(np.mean(label), 1e-3, 1.0 - 1e-3))
    start = np.array([0.0, np.log(rate / (1.0 - rate)) - float(np.mean(log_odds))])
    found = minimize(cost, start, method="L-BFGS-B", bounds=(_LOG_SLOPES, (None, None)))
    return Calibration(float(np.exp(-found.x[0])), float(found.x[1]))


@dataclasses.dataclass(frozen=True)
class Reliability:
    """Views by what was said of them: per bin ``views``, the mean ``said`` and the share that ``localized``."""

    brier: float
    brier_of_rate: float
    log_loss: float
    views: tuple[int, ...]
    said: tuple[float, ...]
    localized: tuple[float, ...]


def reliability(said: Array, label: Labels, *, bins: int = 10) -> Reliability:
    """Hold probabilities f64[v] against labels: Brier score, and that of always saying the mean rate; bins."""
    place = np.clip((said * bins).astype(np.int64), 0, bins - 1)
    views = np.bincount(place, minlength=bins)
    there = np.maximum(views, 1)
    rate = float(np.mean(label))
    odds = np.log(np.clip(said, 1e-12, 1.0)) - np.log(np.clip(1.0 - said, 1e-12, 1.0))
    return Reliability(
        brier=float(np.mean((said - label) ** 2)),
        brier_of_rate=rate * (1.0 - rate),
        log_loss=log_loss(odds, label),
        views=tuple(int(v) for v in views),
        said=tuple(float(x) for x in np.bincount(place, said, minlength=bins) / there),
        localized=tuple(float(x) for x in np.bincount(place, label.astype(np.float64), minlength=bins) / there),
    )


def chosen_share(score: Array, label: Labels, waypoint: NDArray[np.integer], *, of: int | None = None) -> float:
    """Return the share of waypoints whose best scored view localizes; tied views share the choice.

    With ``of`` the best of so many views drawn at random: the expectation over all draws, which knows more of the
    order than the single best does and so tells networks apart with less chance.
    """
    shares = []
    for number in np.unique(waypoint):
        own = waypoint == number
        shares.append(_expected(score[own], label[own], of))
    return float(np.mean(shares))


def _expected(score: Array, label: Labels, of: int | None) -> float:
    order = np.argsort(-score, kind="stable")
    group = np.concatenate([[0], np.cumsum(np.diff(score[order]) != 0)])
    tied = np.bincount(group, label[order].astype(np.float64)) / np.bincount(group)
    n = len(score)
    m = n if of is None else min(of, n)
    before = np.arange(n - m + 1)
    # The best of m drawn from n has rank r with the probability C(n - r - 1, m - 1) / C(n, m).
    log = gammaln(n - before) - gammaln(m) - gammaln(n - before - m + 1)
    log -= gammaln(n + 1) - gammaln(m + 1) - gammaln(n - m + 1)
    return float(np.sum(np.exp(log) * tied[group][: n - m + 1]))
