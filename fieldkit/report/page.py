"""What the page shows, as plain values: every number is formatted here, the template only places it."""

from __future__ import annotations

import base64
import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import Literal

import numpy as np
from markupsafe import Markup

from fieldkit import protocol as protocols
from fieldkit.protocol import Threshold
from fieldkit.report import figures
from fieldkit.report.palette import Style, style
from fieldkit.report.reasons import reasons_svg, strongest
from fieldkit.report.tags import TagSection, tag_section
from fieldkit.report.visits import VisitRows, visit_rows
from fieldkit.scores import (
    BEST_POSSIBLE,
    ODOMETRY,
    Summary,
    error_of,
    group,
    inside,
    summarize_run,
    weighted_median,
)
from fieldkit.trust import open_words, trust
from fieldkit.types import Run, Trial, Truth, ViewResult

# Up to this many tied views are shown one by one; more are summed up as an expectation.
MOST_TIED = 3
TRUTH_NOTES = {
    "tag": "The truth is relative to the map: tag photos and views share map and feature, so part of the map's warp "
    "cancels. Neither the prior nor any estimate gates or initialises it; prior and truth still share the camera's "
    "calibration, the kinematics and the odometry.",
    "topic": "The truth is the pose topic of the recording, taken to be in the frame of the map; an offset between the "
    "two counts as error of every policy.",
    "simulation": "The truth is the simulator's own pose; part of every error is the warp of the map.",
}
POSES = {"cam": "camera", "body": "body"}


@dataclasses.dataclass(frozen=True)
class Cell:
    """One recall with its interval, in %; ``best`` marks the highest of its column without the oracle."""

    recall: str
    low: float
    high: float
    value: float
    best: bool


@dataclasses.dataclass(frozen=True)
class TableRow:
    """A row of the recall table."""

    style: Style
    n: int
    cells: tuple[Cell, ...]
    median_m: str
    median_deg: str


@dataclasses.dataclass(frozen=True)
class Choice:
    """What one or several policies got at a waypoint: the view they chose, or an expectation over many.

    ``grade`` is "good" (inside the tightest threshold), "fair" (inside another), "poor" (outside all) or "failed".
    """

    policies: tuple[tuple[Style, str], ...]
    view: str
    picture: str | None
    inliers: str
    cam: str
    body: str
    verdict: str
    grade: Literal["good", "fair", "poor", "failed"]


@dataclasses.dataclass(frozen=True)
class Waypoint:
    """A section of the page."""

    anchor: str
    title: str
    facts: tuple[tuple[str, str], ...]
    choices: tuple[Choice, ...]
    views: tuple[Choice, ...]
    why: Markup | None
    why_words: tuple[tuple[str, str], ...]


@dataclasses.dataclass(frozen=True)
class Chapter:
    """Everything the page says about one run."""

    anchor: str
    title: str
    subtitle: str
    facts: tuple[tuple[str, str], ...]
    notes: tuple[str, ...]
    protocol_json: str
    thresholds: tuple[str, ...]
    pose: str
    rows: tuple[TableRow, ...]
    oracle: tuple[TableRow, ...]
    legend: tuple[Style, ...]
    plan_legend: tuple[Style, ...]
    curves: tuple[Markup, ...]
    plan: Markup | None
    waypoints: tuple[Waypoint, ...]
    tags: TagSection | None
    excluded: tuple[tuple[str, str], ...]


def chapter(run: Run, number: int) -> Chapter:
    """Return what the page shows of a run; ``number`` keeps the anchors of several runs apart."""
    anchor = f"r{number}"
    summaries = summarize_run(run) if run.trials else ()
    visits = visit_rows(run)
    best = _best(summaries)
    rows = [(s.policy, _table_row(s, best)) for s in summaries]
    name = PurePath(run.path).name or run.protocol.name
    curves = tuple(
        Markup(figures.curve_svg(run, part, name=f"{anchor}{part[0]}"))
        for part in ("position", "rotation")
        if run.trials
    )
    return Chapter(
        anchor=anchor,
        title=name,
        subtitle=_subtitle(run),
        facts=_provenance(run),
        notes=_notes(run),
        protocol_json=json.dumps(protocols.to_dict(run.protocol), indent=2),
        thresholds=tuple(_words(t) for t in run.protocol.thresholds),
        pose=POSES[run.protocol.pose],
        rows=tuple(row for policy, row in rows if policy != BEST_POSSIBLE),
        oracle=tuple(row for policy, row in rows if policy == BEST_POSSIBLE),
        legend=tuple(style(s.policy, s.occlusion) for s in summaries),
        plan_legend=tuple(style(s.policy, s.occlusion) for s in summaries if s.policy not in (ODOMETRY, "random")),
        curves=curves,
        plan=Markup(figures.plan_svg(run, visits, name=f"{anchor}m")) if visits and _one_map(run) else None,
        waypoints=tuple(_waypoint(run, visit, f"{anchor}w{i}") for i, visit in enumerate(visits)),
        tags=None if run.tags is None else tag_section(run.tags, name=f"{anchor}t"),
        excluded=tuple((e.what, e.reason) for e in run.excluded),
    )


def _one_map(run: Run) -> bool:
    """Tell whether all waypoints lie in one map: several scenes of a dataset cannot be drawn in one picture."""
    return len(run.sessions) < 2 or len(run.plan_view.cameras) > 0


def _words(threshold: Threshold) -> str:
    return f"{threshold.position_m:g} m / {threshold.rotation_deg:g}°"


def _metres(value: float) -> str:
    return "∞" if math.isinf(value) else f"{value:.3f}" if value < 100 else f"{value:.3g}"


def _degrees(value_rad: float) -> str:
    return "∞" if math.isinf(value_rad) else f"{math.degrees(value_rad):.2f}"


def _both(error: Sequence[float]) -> str:
    """Position (m) and rotation (rad) in words; a failure is one sign, not two."""
    if math.isinf(error[0]) and math.isinf(error[1]):
        return "∞"
    return f"{_metres(error[0])} m, {_degrees(error[1])}°"


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def _subtitle(run: Run) -> str:
    visits = _count(len(run.plans), "waypoint")
    names = f"{'session' if len(run.sessions) == 1 else 'sessions'} {', '.join(run.sessions)}"
    where = names if len(run.sessions) <= 3 else f"{len(run.sessions)} sessions"
    return f"{visits} in {where} · protocol {run.protocol.name}"


def _provenance(run: Run) -> tuple[tuple[str, str], ...]:
    return (
        ("Scored pose", f"{POSES[run.protocol.pose]} in the map; both are listed per waypoint"),
        ("Thresholds", ", ".join(_words(t) for t in run.protocol.thresholds) + " (both errors strictly below)"),
        ("Truth", _truth_words(run)),
        ("Localizer", _localizer_words(run)),
        ("Time per view", _time_words(run)),
        ("Protocol", f"{run.protocol.name}, version {run.protocol.version}"),
        ("Recordings", ", ".join(run.recordings) or "none"),
        ("Sessions", ", ".join(run.sessions) or "none"),
        ("Run folder", run.path or "not saved"),
        ("Map digest", run.map_digest or "none"),
        ("Tags digest", run.tags_digest or "none"),
        ("Corrections", "; ".join(f"{c.kind}: {c.path} ({c.digest})" for c in run.corrections) or "none"),
        ("Seconds of building the map", _seconds_words(run)),
        ("Weights of policies", ", ".join(f"{name} {digest}" for name, digest in run.weights.items()) or "none"),
        ("Seed", str(run.seed)),
        ("Versions", ", ".join(f"{name} {version}" for name, version in sorted(run.versions.items())) or "none"),
    )  # fmt: skip


def _seconds_words(run: Run) -> str:
    return ", ".join(f"{stage} {value:.3g}" for stage, value in run.map_seconds.items()) or "not known"


def _localizer_words(run: Run) -> str:
    rules = run.protocol.localizer
    bounds = f"reprojection {rules.max_reprojection_px:g} px, at least {rules.min_inliers} inliers"
    return f"{run.protocol.feature}, top {rules.top_k} retrieved, {bounds}, confidence {rules.min_confidence:g}"


def _time_words(run: Run) -> str:
    """Return the median and the 95th percentile of the time that each stage took, in ms."""
    words = []
    for stage in ("extract", "retrieve", "match", "pnp"):
        ms = [1e3 * r.estimate.seconds[stage] for r in run.results if stage in r.estimate.seconds]
        if ms:
            median, slow = np.percentile(ms, (50, 95))
            words.append(f"{stage} {median:.0f} ({slow:.0f})")
    return f"{', '.join(words)} ms: median (95th percentile)" if words else "not known"


def _notes(run: Run) -> tuple[str, ...]:
    """Return what must be known about the truth: where it comes from, what it leaves open, and where it is coarse."""
    sources = {t.source for _, t in run.truths}
    notes = [note for source, note in TRUTH_NOTES.items() if source in sources]
    trusted = trust(run)
    if trusted is not None:
        notes.append(open_words(trusted, run.protocol.thresholds))
        if trusted.warning:
            notes.append(f"Caution: {trusted.warning}.")
    return tuple(notes)


def _truth_words(run: Run) -> str:
    words = []
    for source, what in (
        ("tag", "tripod tag seen by the arm camera, its pose in the map, and arm kinematics"),
        ("topic", "pose topic of the recording"),
        ("simulation", "the simulator's own poses"),
    ):
        mine = [t for _, t in run.truths if t.source == source]
        if mine:
            position, rotation = np.median([t.sigma for t in mine], axis=0)
            words.append(f"{what} ({_count(len(mine), 'view')}; median sigma {_both((position, rotation))})")
    return "; ".join(words) or "none"


def _best(summaries: Sequence[Summary]) -> tuple[float, ...]:
    rows = [s.recall for s in summaries if s.policy != BEST_POSSIBLE]
    return tuple(max(column) for column in zip(*rows, strict=True))


def _table_row(summary: Summary, best: tuple[float, ...]) -> TableRow:
    cells = tuple(
        Cell(
            recall=f"{100 * value:.1f}",
            low=100 * low,
            high=100 * high,
            value=round(100 * value, 1),
            best=summary.policy != BEST_POSSIBLE and value > 0 and value >= top - 1e-12,
        )
        for value, (low, high), top in zip(
            summary.recall, summary.interval, best or (0.0,) * len(summary.recall), strict=True
        )
    )
    how = style(summary.policy, summary.occlusion)
    return TableRow(how, summary.n, cells, _metres(summary.median[0]), _degrees(summary.median[1]))


def _waypoint(run: Run, visit: VisitRows, anchor: str) -> Waypoint:
    plan, prior = visit.plan, visit.plan.prior
    seen = f", {_count(prior.n_sightings, 'sighting')} of the start tag" if prior.n_sightings else ""
    spread = [math.sqrt(float(np.trace(prior.covariance[i : i + 3, i : i + 3]))) for i in (3, 0)]
    facts = (
        ("Prior error", _both(plan.prior_error)),
        ("Prior's own sigma", _both(spread)),
        ("Travelled since the start", f"{prior.travelled_m:.1f} m{seen}"),
        ("Truth", _truth_of(tuple(visit.truths.values()))),
        ("Candidates", f"{int(plan.candidates.allowed.sum())} of {_count(len(visit.results), 'recorded view')}"),
    )
    title = f"{plan.session} · {prior.visit}" if len(run.sessions) > 1 else prior.visit
    why = reasons_svg(plan, run.plan_view, order=run.protocol.policies, name=f"{anchor}y")
    return Waypoint(
        anchor=anchor,
        title=title,
        facts=facts,
        choices=_choices(run, visit),
        views=_all_views(run, visit),
        why=None if why is None else Markup(why),
        why_words=strongest(plan.reasons),
    )


def _truth_of(truths: Sequence[Truth]) -> str:
    if not truths:
        return "none"
    position, rotation = np.median([t.sigma for t in truths], axis=0)
    return f"{', '.join(sorted({t.source for t in truths}))}; median sigma {_both((position, rotation))}"


def _choices(run: Run, visit: VisitRows) -> tuple[Choice, ...]:
    """One row per distinct outcome, in the order of the policies; those that chose the same view share a row."""
    rows: dict[tuple[str, str], list[tuple[Trial, str]]] = {}
    expectations: dict[tuple[str, str], list[Trial]] = {}
    for (policy, occlusion), mine in group(visit.trials, order=run.protocol.policies).items():
        weighted = [t for t in mine if t.weight > 0]
        if len(weighted) > MOST_TIED:
            rows[f"{policy} {occlusion}", "expectation"] = []
            expectations[f"{policy} {occlusion}", "expectation"] = weighted
            continue
        for trial in weighted:
            share = "" if trial.weight > 0.999 else f" (weight {trial.weight:.2g})"
            special = policy if policy == ODOMETRY or not trial.view else "view"
            rows.setdefault((trial.view, special), []).append((trial, share))
    return tuple(
        _expectation(run, expectations[key]) if key in expectations else _choice(run, chosen, visit.results)
        for key, chosen in rows.items()
    )


def _choice(run: Run, chosen: Sequence[tuple[Trial, str]], results: Mapping[str, ViewResult]) -> Choice:
    trial = chosen[0][0]
    by_prior = trial.policy == ODOMETRY
    result = None if by_prior else results.get(trial.view)
    inliers = "-"
    if result is not None:
        inliers = f"{result.estimate.n_inliers} of {result.estimate.n_matches}"
    verdict, grade = _verdict(run, trial)
    what = "prior as pose" if by_prior else trial.view or "none allowed"
    if result is not None and result.kind != trial.view:
        what = f"{trial.view} ({result.kind})"
    return Choice(
        policies=tuple((style(t.policy, t.occlusion), share) for t, share in chosen),
        view=what,
        picture=None if by_prior else _picture(run, trial),
        inliers=inliers,
        cam=_both(trial.cam_error),
        body=_both(trial.body_error),
        verdict=verdict,
        grade=grade,
    )


def _expectation(run: Run, trials: Sequence[Trial]) -> Choice:
    weights = [t.weight for t in trials]
    medians = {
        pose: [weighted_median([error_of(t, pose=pose)[i] for t in trials], weights) for i in (0, 1)]
        for pose in ("cam", "body")
    }
    bound = max(run.protocol.thresholds, key=lambda t: (t.position_m, t.rotation_deg))
    share = math.fsum(t.weight * inside(error_of(t, pose=run.protocol.pose), bound) for t in trials)
    failed = sum(not math.isfinite(t.cam_error[0]) for t in trials)
    return Choice(
        policies=((style(trials[0].policy, trials[0].occlusion), ""),),
        view=f"expectation over {len(trials)} views, {failed} failed; medians",
        picture=None,
        inliers="-",
        cam=_both(medians["cam"]),
        body=_both(medians["body"]),
        verdict=f"{100 * share:.0f} % within {_words(bound)}",
        grade="fair" if share > 0 else "poor",
    )


def _verdict(run: Run, trial: Trial) -> tuple[str, Literal["good", "fair", "poor", "failed"]]:
    error = error_of(trial, pose=run.protocol.pose)
    if not math.isfinite(error[0]):
        return f"failed: {trial.status.replace('_', ' ')}", "failed"
    ordered = sorted(run.protocol.thresholds, key=lambda t: (t.position_m, t.rotation_deg))
    for i, bound in enumerate(ordered):
        if inside(error, bound):
            return f"within {_words(bound)}", "good" if i == 0 else "fair"
    return "outside all thresholds", "poor"


def _all_views(run: Run, visit: VisitRows) -> tuple[Choice, ...]:
    """Every candidate with its outcome, as far as the run holds it: the rows of best possible."""
    rows = [t for t in visit.trials if t.policy == BEST_POSSIBLE and t.view]
    return tuple(dataclasses.replace(_choice(run, [(t, "")], visit.results), picture=None) for t in rows)


def _picture(run: Run, trial: Trial) -> str | None:
    jpeg = run.thumbnails.get(thumbnail_key(trial.session, trial.visit, trial.view))
    return None if jpeg is None else f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode('ascii')}"


def thumbnail_key(session: str, visit: str, view: str) -> str:
    """Return the key of a view's thumbnail in `Run.thumbnails`."""
    return f"{session}/{visit}/{view}"
