"""What every policy is worth: trials, recall with intervals, medians, bounds.

A policy's choice at a visit is a distribution over views: tied views share the weight, so the outcome of
`random` is its exact expectation. A failed estimate has infinite errors and stays in the denominator.

Best possible has one row per allowed candidate. For curves and medians its weight lies on the view that
minimises ``max(e_position / t_position, e_rotation / t_rotation)`` at the protocol's tightest threshold, for the
pose (camera or body) that the protocol scores. For recall a visit counts as a hit when any of its rows is inside
both thresholds.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldkit.errors import ScoreError, suggestion
from fieldkit.frames import Pose, pose_error
from fieldkit.protocol import Protocol, Threshold
from fieldkit.trust import BEST_POSSIBLE as BEST_POSSIBLE
from fieldkit.trust import open_shares, open_words, trust, trust_dict, truths_of
from fieldkit.types import Run, Trial, Truth, ViewResult, VisitPlan

Array = NDArray[np.float64]
PoseName = Literal["cam", "body"]
ODOMETRY = "odometry"
NO_CANDIDATE = "no_candidate"
INFINITE = (math.inf, math.inf)
Z_95 = 1.959963984540054


def _thresholds(*pairs: tuple[float, float]) -> tuple[Threshold, ...]:
    return tuple(Threshold(position_m, rotation_deg) for position_m, rotation_deg in pairs)


# Thresholds (m, deg) that others report, for comparison with their tables; all are taken as strict.
PRESETS: dict[str, tuple[Threshold, ...]] = {
    "visuallocalization": _thresholds((0.25, 2.0), (0.5, 5.0), (5.0, 10.0)),
    "actloc": _thresholds((0.05, 0.4), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0)),
    "lamar": _thresholds((0.1, 1.0), (1.0, 5.0)),
    "paper_real": _thresholds((0.25, 2.0), (0.5, 3.5), (1.0, 5.0)),
    "paper_sim": _thresholds((0.025, 1.0), (0.05, 1.0), (0.075, 1.0), (0.1, 1.0), (0.25, 2.0), (1.0, 5.0)),
}


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


@dataclasses.dataclass(frozen=True)
class Table:
    """A table of strings: a caption that says what is counted, one header cell per column, and the rows."""

    caption: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclasses.dataclass(frozen=True)
class _Scored:
    """A view's outcome in one visit: status of its estimate and errors (m, rad) of camera and body."""

    status: str
    cam_error: tuple[float, float]
    body_error: tuple[float, float]
    truth_sigma: tuple[float, float]


def preset(name: str) -> tuple[Threshold, ...]:
    """Return the thresholds of a preset; raises ScoreError for an unknown name."""
    if name not in PRESETS:
        raise ScoreError(f"unknown preset {name!r}", hint=suggestion(name, list(PRESETS)))
    return PRESETS[name]


def tightest(thresholds: Sequence[Threshold]) -> Threshold:
    """Return the threshold with the smallest position bound, and among those the smallest rotation bound."""
    return min(thresholds, key=lambda t: (t.position_m, t.rotation_deg))


def excess(error: tuple[float, float], threshold: Threshold) -> float:
    """Return the larger of both errors (m, rad) in units of the threshold; below 1 is inside."""
    return max(error[0] / threshold.position_m, math.degrees(error[1]) / threshold.rotation_deg)


def inside(error: tuple[float, float], threshold: Threshold) -> bool:
    """Tell whether an error (m, rad) is strictly below both bounds of a threshold."""
    return error[0] < threshold.position_m and math.degrees(error[1]) < threshold.rotation_deg


def error_of(trial: Trial, *, pose: PoseName) -> tuple[float, float]:
    """Return a trial's error (m, rad) of the camera or of the body."""
    return trial.cam_error if pose == "cam" else trial.body_error


def make_trials(
    plan: VisitPlan,
    results: Mapping[str, ViewResult],
    truths: Mapping[str, Truth],
    *,
    protocol: Protocol,
    odometry_view: str | None = None,
) -> tuple[Trial, ...]:
    """Score every policy's choice at one visit.

    ``results`` and ``truths`` are keyed by view. Views with equal utility share the weight; a policy without
    an allowed view gives one failed trial. The protocol's "odometry" is the prior scored as a pose, its camera
    at ``odometry_view`` (else the stowed view, the forward view, or the first allowed one): it depends on no
    image. "best_possible" is described at the top of this module. Rows come in the protocol's order of
    policies, without occlusion before with. Raises ScoreError where a chosen view has no result or no truth.
    """
    reference = _reference(plan, truths, wanted=odometry_view)
    variants: list[tuple[str, bool | None]] = [*plan.utilities]
    variants += [(name, None) for name in (ODOMETRY, BEST_POSSIBLE) if name in protocol.policies]
    trials: list[Trial] = []
    for policy, occlusion in _ordered(variants, protocol.policies):
        if policy == ODOMETRY:
            rows = [(reference, 1.0, 0.0, _score_prior(plan, reference, truths[reference]))]
        elif policy == BEST_POSSIBLE:
            rows = _best_rows(plan, results, truths, protocol=protocol)
        else:
            chosen = _choose(plan, policy, occlusion)
            rows = [
                (view, weight, utility, _score_view(plan, view, results, truths)) for view, weight, utility in chosen
            ]
        if not rows:
            rows = [("", 1.0, -math.inf, _Scored(NO_CANDIDATE, INFINITE, INFINITE, truths[reference].sigma))]
        trials += [_trial(plan, (policy, occlusion), row) for row in rows]
    return tuple(trials)


def _trial(plan: VisitPlan, variant: tuple[str, bool | None], row: tuple[str, float, float, _Scored]) -> Trial:
    view, weight, utility, scored = row
    return Trial(
        session=plan.session,
        visit=plan.prior.visit,
        policy=variant[0],
        occlusion=variant[1],
        view=view,
        weight=weight,
        utility=utility,
        status=scored.status,
        cam_error=scored.cam_error,
        body_error=scored.body_error,
        truth_sigma=scored.truth_sigma,
        prior_error=plan.prior_error,
    )


def _ordered(variants: Iterable[tuple[str, bool | None]], order: Sequence[str]) -> list[tuple[str, bool | None]]:
    rank = {name: i for i, name in enumerate(order)}
    return sorted(variants, key=lambda v: (rank.get(v[0], len(rank)), v[1] is not None, bool(v[1])))


def _share(utilities: Array) -> Array:
    best = utilities == utilities.max()
    return np.asarray(best / np.count_nonzero(best), dtype=np.float64)


def _choose(plan: VisitPlan, policy: str, occlusion: bool | None) -> list[tuple[str, float, float]]:
    utilities = np.asarray(plan.utilities[policy, occlusion], dtype=np.float64)
    views = plan.candidates.view_ids
    if utilities.shape != (len(views),) or np.isnan(utilities).any():
        raise ScoreError(
            f"visit {plan.prior.visit}: policy {policy} gave utilities of shape {utilities.shape}, "
            f"{int(np.isnan(utilities).sum())} of them nan; expected {len(views)} numbers (-inf: not allowed)",
            hint="correct the policy",
        )
    if not len(views) or utilities.max() == -math.inf:
        return []
    weights = _share(utilities)
    return [(views[i], float(weights[i]), float(utilities[i])) for i in np.flatnonzero(weights)]


def _best_rows(
    plan: VisitPlan, results: Mapping[str, ViewResult], truths: Mapping[str, Truth], *, protocol: Protocol
) -> list[tuple[str, float, float, _Scored]]:
    views = [plan.candidates.view_ids[i] for i in np.flatnonzero(plan.candidates.allowed)]
    if not views:
        return []
    scored = [_score_view(plan, view, results, truths) for view in views]
    bound = tightest(protocol.thresholds)
    errors = [s.cam_error if protocol.pose == "cam" else s.body_error for s in scored]
    utilities = np.array([-excess(error, bound) for error in errors])
    weights = _share(utilities)
    return [(v, float(w), float(u), s) for v, w, u, s in zip(views, weights, utilities, scored, strict=True)]


def _reference(plan: VisitPlan, truths: Mapping[str, Truth], *, wanted: str | None) -> str:
    visit, candidates = plan.prior.visit, plan.candidates
    if wanted is not None:
        if wanted not in truths or wanted not in candidates.view_ids:
            raise ScoreError(f"visit {visit}: view {wanted!r} has no truth", hint="name a candidate that has one")
        return wanted
    by_kind = [
        v
        for kind in ("stowed", "forward")
        for v, k in zip(candidates.view_ids, candidates.kinds, strict=True)
        if k == kind
    ]
    allowed = [candidates.view_ids[i] for i in np.flatnonzero(candidates.allowed)]
    for view in (*by_kind, *allowed, *candidates.view_ids):
        if view in truths:
            return view
    raise ScoreError(
        f"visit {visit}: none of its {len(candidates.view_ids)} views has a truth", hint="exclude the visit"
    )


def _score_view(plan: VisitPlan, view: str, results: Mapping[str, ViewResult], truths: Mapping[str, Truth]) -> _Scored:
    for what, known in (("result", results), ("truth", truths)):
        if view not in known:
            raise ScoreError(
                f"visit {plan.prior.visit}: view {view!r} has no {what}",
                hint="leave the view out of the candidates",
            )
    truth, estimate = truths[view], results[view].estimate
    cam_error, body_error = _errors(estimate.map_from_cam, truth)
    return _Scored(estimate.status, cam_error, body_error, truth.sigma)


def _score_prior(plan: VisitPlan, view: str, truth: Truth) -> _Scored:
    """Score the prior where odometry has carried it since: the candidate pose of the view."""
    cam_error, body_error = _errors(plan.candidates.map_from_cam[plan.candidates.view_ids.index(view)], truth)
    return _Scored("ok", cam_error, body_error, truth.sigma)


def _errors(map_from_cam: Pose | None, truth: Truth) -> tuple[tuple[float, float], tuple[float, float]]:
    if map_from_cam is None:
        return INFINITE, INFINITE
    cam_from_body = truth.body_from_cam.inv()
    cam_error = pose_error(map_from_cam, truth.map_from_cam)
    return cam_error, pose_error(map_from_cam * cam_from_body, truth.map_from_cam * cam_from_body)


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


def recall(trials: Sequence[Trial], threshold: Threshold, *, pose: PoseName) -> float:
    """Return one policy's fraction of visits inside a threshold: weighted hits, any hit for best possible."""
    hits: dict[tuple[str, str], list[float]] = {}
    for trial in trials:
        hit = inside(error_of(trial, pose=pose), threshold)
        hits.setdefault((trial.session, trial.visit), []).append(
            float(hit) if trial.policy == BEST_POSSIBLE else trial.weight * hit
        )
    best = bool(trials) and trials[0].policy == BEST_POSSIBLE
    per_visit = [max(values) if best else math.fsum(values) for values in hits.values()]
    return min(math.fsum(per_visit) / len(per_visit), 1.0) if per_visit else 0.0


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
    return {variant: groups[variant] for variant in _ordered(groups, order or [v[0] for v in groups])}


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


def score_dict(run: Run, *, thresholds: Sequence[Threshold] | None = None) -> dict[str, Any]:
    """Return the values of ``fieldkit score --json``: fractions, m and deg, null for an infinite median."""
    chosen = run.protocol.thresholds if thresholds is None else thresholds
    truths, groups = truths_of(run), group(run.trials)
    return {
        "version": 1,
        "protocol": run.protocol.name,
        "pose": run.protocol.pose,
        "thresholds": [{"position_m": t.position_m, "rotation_deg": t.rotation_deg} for t in chosen],
        "policies": [
            {
                "name": s.policy,
                "occlusion": s.occlusion,
                "n": s.n,
                "recall": list(s.recall),
                "interval": [list(pair) for pair in s.interval],
                "median_position_m": _finite(s.median[0]),
                "median_rotation_deg": _finite(math.degrees(s.median[1])),
                "open": list(
                    open_shares(groups[s.policy, s.occlusion], truths, thresholds=chosen, pose=run.protocol.pose)
                ),
            }
            for s in summarize_run(run, thresholds=chosen)
        ],
        "comparisons": [],
        "truth": trust_dict(trust(run, thresholds=chosen)),
    }


def check_expect(run: Run) -> list[str]:
    """Return one line per missed ``[[expect]]`` bound of the protocol; a policy without a row is a miss.

    A bound that does not say ``occlusion`` holds for every variant of its policy.
    """
    misses = []
    summaries = summarize_run(run)
    for bound in run.protocol.expect:
        where = f"{bound.policy} at {bound.position_m:g} m / {bound.rotation_deg:g} deg"
        rows = [s for s in summaries if s.policy == bound.policy and bound.occlusion in (None, s.occlusion)]
        if not rows:
            misses.append(f"{where}: no row in this run; expected recall {bound.min_recall:g} .. {bound.max_recall:g}")
        column = run.protocol.thresholds.index(Threshold(bound.position_m, bound.rotation_deg))
        for row in rows:
            value = row.recall[column]
            if not bound.min_recall - 1e-12 <= value <= bound.max_recall + 1e-12:
                misses.append(
                    f"{where}{_occlusion_words(row.occlusion)}: recall {value:.4f} of {row.n} visits; "
                    f"expected {bound.min_recall:g} .. {bound.max_recall:g}"
                )
    return misses


def table(run: Run, *, thresholds: Sequence[Threshold] | None = None) -> Table:
    """Return the recall table as strings: recall and 95 % interval in % per threshold, then median errors."""
    chosen = run.protocol.thresholds if thresholds is None else thresholds
    pose = "camera" if run.protocol.pose == "cam" else "body"
    columns = [f"{t.position_m:g} m / {t.rotation_deg:g} deg" for t in chosen]
    rows = []
    for s in summarize_run(run, thresholds=chosen):
        cells = [
            f"{100 * value:.1f} [{100 * low:.0f}, {100 * high:.0f}]"
            for value, (low, high) in zip(s.recall, s.interval, strict=True)
        ]
        median = [format_number(s.median[0]), format_number(math.degrees(s.median[1]))]
        occlusion = "-" if s.occlusion is None else "yes" if s.occlusion else "no"
        rows.append((s.policy, occlusion, str(s.n), *cells, *median))
    trusted = trust(run, thresholds=chosen)
    caption = f"Recall in % of visits, {pose} pose strictly inside both bounds [Wilson 95 %]; failures count."
    return Table(
        caption=caption if trusted is None else f"{caption} {open_words(trusted, chosen)}",
        header=("policy", "occlusion", "n", *columns, "median m", "median deg"),
        rows=tuple(rows),
    )


def format_number(value: float) -> str:
    """Return a number with three significant digits, or "failed" when it is infinite."""
    return f"{value:.3g}" if math.isfinite(value) else "failed"


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _occlusion_words(occlusion: bool | None) -> str:
    return "" if occlusion is None else " with occlusion" if occlusion else " without occlusion"
