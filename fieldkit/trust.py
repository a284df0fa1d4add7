"""How far scores can be trusted: which successes and failures the truth's own uncertainty leaves open.

A trial is open at a threshold where the truth's uncertainty could turn its success into a failure or back: its error
lies within 2 sigma of a bound, and no other bound decides. Sigma is the truth's largest standard deviation along any
direction, of position and of rotation, for the pose that is scored. Success is certain where both errors plus 2 sigma
are inside their bounds, failure where one error less 2 sigma is not; a failed estimate is a certain failure.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from fieldkit.frames import compose_covariance
from fieldkit.protocol import Threshold
from fieldkit.types import Run, Trial, Truth

BEST_POSSIBLE = "best_possible"
SIGMAS = 2.0
# The truth is a measure where 2 sigma are at most this share of the tightest threshold
SHARE = 1 / 3
_Key = tuple[str, str, str]


@dataclasses.dataclass(frozen=True)
class TruthTrust:
    """What the truth allows to say: its sigmas (m, rad; largest axis), medians and maxima over the views.

    ``open_share`` per threshold: share of the trials of all policies but best possible, by weight, that are open.
    ``n_coarse`` counts views whose 2 sigma exceed a third of the tightest threshold, ``warning`` says so or is "".
    """

    median_sigma: tuple[float, float]
    max_sigma: tuple[float, float]
    n_views: int
    n_coarse: int
    open_share: tuple[float, ...]
    warning: str


def largest_sigma(truth: Truth, *, pose: Literal["cam", "body"]) -> tuple[float, float]:
    """Return the truth's standard deviations (m, rad) along its least certain directions, of camera or body."""
    covariance = truth.covariance
    if pose == "body":
        covariance = compose_covariance(covariance, truth.body_from_cam.inv())
    rotation, position = (float(np.linalg.eigvalsh(covariance[i : i + 3, i : i + 3])[-1]) for i in (0, 3))
    return math.sqrt(max(position, 0.0)), math.sqrt(max(rotation, 0.0))


def outcomes(error: tuple[float, float], sigma: tuple[float, float], threshold: Threshold) -> tuple[bool, bool]:
    """Return whether an error (m, rad) could be inside a threshold, and whether it could be outside."""
    bounds = (threshold.position_m, math.radians(threshold.rotation_deg))
    low = all(e - SIGMAS * s < b for e, s, b in zip(error, sigma, bounds, strict=True))
    high = all(e + SIGMAS * s < b for e, s, b in zip(error, sigma, bounds, strict=True))
    return low, not high


def open_shares(
    trials: Iterable[Trial],
    truths: Mapping[_Key, Truth],
    *,
    thresholds: Sequence[Threshold],
    pose: Literal["cam", "body"],
) -> tuple[float, ...]:
    """Return per threshold the share of one policy's trials, by weight over visits, that the truth leaves open.

    Best possible is open at a visit where no candidate is a certain success and at least one may be one. A trial whose
    truth is not among ``truths`` is decided.
    """
    visits: dict[tuple[str, str], list[Trial]] = {}
    for trial in trials:
        visits.setdefault((trial.session, trial.visit), []).append(trial)
    sigmas = {key: largest_sigma(truth, pose=pose) for key, truth in truths.items()}
    shares = []
    for threshold in thresholds:
        total = 0.0
        for rows in visits.values():
            found = []
            for trial in rows:
                sigma = sigmas.get((trial.session, trial.visit, trial.view), (0.0, 0.0))
                error = trial.cam_error if pose == "cam" else trial.body_error
                found.append((trial.weight, *outcomes(error, sigma, threshold)))
            if rows[0].policy == BEST_POSSIBLE:
                certain = any(inside and not outside for _, inside, outside in found)
                total += float(not certain and any(inside for _, inside, _ in found))
            else:
                total += math.fsum(weight for weight, inside, outside in found if inside and outside)
        shares.append(min(total / len(visits), 1.0) if visits else 0.0)
    return tuple(shares)


def truths_of(run: Run) -> dict[_Key, Truth]:
    """Return a run's truths by session, visit and view."""
    return {(session, truth.visit, truth.view): truth for session, truth in run.truths}


def trust(run: Run, *, thresholds: Sequence[Threshold] | None = None) -> TruthTrust | None:
    """Tell how far the truth of a run reaches, at the protocol's thresholds or at others; None without any truth."""
    truths, pose = truths_of(run), run.protocol.pose
    if not truths:
        return None
    chosen = run.protocol.thresholds if thresholds is None else tuple(thresholds)
    sigmas = np.array([largest_sigma(truth, pose=pose) for truth in truths.values()])
    tight = min(t.position_m for t in chosen), math.radians(min(t.rotation_deg for t in chosen))
    coarse = int((SIGMAS * sigmas > SHARE * np.array(tight)).any(axis=1).sum())
    policies: dict[tuple[str, bool | None], list[Trial]] = {}
    for trial in run.trials:
        if trial.policy != BEST_POSSIBLE:
            policies.setdefault((trial.policy, trial.occlusion), []).append(trial)
    shares = [open_shares(t, truths, thresholds=chosen, pose=pose) for t in policies.values()]
    share = tuple(float(v) for v in np.mean(shares, axis=0)) if shares else (0.0,) * len(chosen)
    median, largest = np.median(sigmas, axis=0), sigmas.max(axis=0)
    warning = ""
    if coarse:
        warning = (
            f"the truth of {coarse} of {len(truths)} views is coarse: 2 sigma are up to {SIGMAS * largest[0]:.3g} m, "
            f"{math.degrees(SIGMAS * largest[1]):.3g} deg, over a third of the tightest threshold, {tight[0]:g} m / "
            f"{math.degrees(tight[1]):g} deg"
        )
    return TruthTrust(
        median_sigma=(float(median[0]), float(median[1])),
        max_sigma=(float(largest[0]), float(largest[1])),
        n_views=len(truths),
        n_coarse=coarse,
        open_share=share,
        warning=warning,
    )


def open_words(trusted: TruthTrust, thresholds: Sequence[Threshold]) -> str:
    """Return one sentence with the share of trials left open per threshold."""
    shares = ", ".join(
        f"{100 * share:.1f} % at {t.position_m:g} m / {t.rotation_deg:g} deg"
        for share, t in zip(trusted.open_share, thresholds, strict=True)
    )
    return f"The truth leaves open (error within 2 sigma of a bound): {shares}."


def trust_dict(trusted: TruthTrust | None) -> dict[str, Any] | None:
    """Return the values of `score --json` about the truth: shares, m and deg; None without any."""
    if trusted is None:
        return None
    return {
        "n_views": trusted.n_views,
        "median_sigma_m": trusted.median_sigma[0],
        "median_sigma_deg": math.degrees(trusted.median_sigma[1]),
        "max_sigma_m": trusted.max_sigma[0],
        "max_sigma_deg": math.degrees(trusted.max_sigma[1]),
        "open": list(trusted.open_share),
        "warning": trusted.warning or None,
    }
