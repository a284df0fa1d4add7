"""A run's rows gathered per waypoint, once."""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Mapping

from fieldkit.frames import Pose
from fieldkit.types import Run, Trial, Truth, ViewResult, VisitPlan


@dataclasses.dataclass(frozen=True)
class VisitRows:
    """One waypoint: what was planned, every trial, and result and truth per view."""

    plan: VisitPlan
    trials: tuple[Trial, ...]
    results: Mapping[str, ViewResult]
    truths: Mapping[str, Truth]

    @property
    def map_from_body(self) -> Pose | None:
        """The true body pose (of the first view that has one), or None."""
        for truth in self.truths.values():
            return truth.map_from_cam * truth.body_from_cam.inv()
        return None


def visit_rows(run: Run) -> tuple[VisitRows, ...]:
    """Gather the rows of every waypoint, in the run's order."""
    trials: defaultdict[tuple[str, str], list[Trial]] = defaultdict(list)
    results: defaultdict[tuple[str, str], dict[str, ViewResult]] = defaultdict(dict)
    truths: defaultdict[tuple[str, str], dict[str, Truth]] = defaultdict(dict)
    for trial in run.trials:
        trials[trial.session, trial.visit].append(trial)
    for result in run.results:
        results[result.session, result.visit][result.view] = result
    for session, truth in run.truths:
        truths[session, truth.visit][truth.view] = truth
    keys = [(plan, (plan.session, plan.prior.visit)) for plan in run.plans]
    return tuple(VisitRows(plan, tuple(trials[key]), results[key], truths[key]) for plan, key in keys)
