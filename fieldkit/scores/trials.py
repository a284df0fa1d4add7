"""What became of every policy's choice at a visit."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import numpy as np

from fieldkit.errors import ScoreError
from fieldkit.frames import Pose, pose_error
from fieldkit.protocol import Protocol
from fieldkit.scores.bounds import Array, excess, tightest
from fieldkit.scores.summary import ordered
from fieldkit.trust import BEST_POSSIBLE
from fieldkit.types import Trial, Truth, ViewResult, VisitPlan

ODOMETRY = "odometry"
NO_CANDIDATE = "no_candidate"
INFINITE = (math.inf, math.inf)


@dataclasses.dataclass(frozen=True)
class _Scored:
    """A view's outcome in one visit: status of its estimate and errors (m, rad) of camera and body."""

    status: str
    cam_error: tuple[float, float]
    body_error: tuple[float, float]
    truth_sigma: tuple[float, float]


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
    for policy, occlusion in ordered(variants, protocol.policies):
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
