"""The main line: record once, localize every view once, let every policy choose among the same views.

recording -> prior at each visit -> candidate views at the prior -> utilities -> trials
                                    the same views' images -> estimates ----------^
                                    tripod tag or pose topic -> truth ------------^
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from fieldkit import maps, policies, scores, store
from fieldkit.bags import open_recording
from fieldkit.errors import FrameError, PriorError, ReplayError, TagError, TruthError
from fieldkit.frames import pose_error
from fieldkit.localize import Localizer, Query, default_threads, in_threads
from fieldkit.odometry import offset_fault, summarize_faults
from fieldkit.prior import estimate_prior, odometry_clock
from fieldkit.protocol import Protocol
from fieldkit.tags import check_families
from fieldkit.trust import trust
from fieldkit.truth import estimate_truths
from fieldkit.types import (
    Applied,
    Candidates,
    Estimate,
    Excluded,
    Image,
    Prior,
    Recording,
    Run,
    SceneMap,
    TagMap,
    Trial,
    Truth,
    View,
    ViewResult,
    Visit,
    VisitPlan,
)
from fieldkit.views import forward_directions, plan_view, recorded_candidates

log = logging.getLogger(__name__)
Progress = Callable[[str, int, int], None]
THUMBNAIL_PX = 240
# What leaves a visit out, with its reason; any other error ends the replay.
EXCLUDING = (PriorError, TruthError, FrameError, ReplayError, TagError)


@dataclasses.dataclass(frozen=True)
class _Session:
    """What one recording yields."""

    trials: tuple[Trial, ...] = ()
    results: tuple[ViewResult, ...] = ()
    truths: tuple[Truth, ...] = ()
    plans: tuple[VisitPlan, ...] = ()
    thumbnails: Mapping[str, bytes] = dataclasses.field(default_factory=dict)
    excluded: tuple[Excluded, ...] = ()


def replay(
    recordings: Sequence[Path],
    *,
    map_path: Path,
    protocol: Protocol,
    out: Path,
    tags_path: Path | None = None,
    camera_path: Path | None = None,
    hand_path: Path | None = None,
    policy_weights: Sequence[Path] = (),
    force: bool = False,
    progress: Progress | None = None,
) -> Run:
    """Replay recordings through every policy of a protocol and write the run folder ``out``.

    camera.toml and hand.toml, where given, take the place of what every recording states of its camera. Views are
    localized once and kept in a cache beside ``out`` until the run is complete, so that a second start after a kill
    resumes. Raises FieldkitError where map, tags, corrections, recordings and protocol do not fit together; a visit
    without prior, truth or candidates is excluded with its reason, and so is a view without truth or odometry.
    """
    store.refuse_existing(Path(out), force=force, marker="run.json")
    checkpoints, unweighted = policies.find_checkpoints(protocol.policies, given=policy_weights)
    if not recordings:
        raise ReplayError("no recording given; expected at least one", hint="name a bag or a session folder")
    given = store.read_corrections(camera=camera_path, hand=hand_path)
    scene_map = maps.load_map(map_path)
    policies.check_map(scene_map, protocol)
    tags = _load_tags(tags_path, scene_map)
    cache = store.EstimateCache(Path(out).parent / f".{Path(out).name}.estimates.jsonl")
    opened = [open_recording(path, corrections=given) for path in recordings]
    _check_names(opened)
    for file in given.applied:
        log.info("%s takes the place of what the recordings state of the %s", file.path, file.kind)
    look = policies.Looker(scene_map, protocol, checkpoints=checkpoints)
    excluded = _excluded_rows(scene_map, protocol, (*unweighted, *look.excluded))
    sessions = [
        _replay_session(r, look, scene_map, tags, protocol, applied=given.applied, cache=cache, progress=progress)
        for r in opened
    ]
    run = _collect(opened, sessions, scene_map=scene_map, tags=tags, applied=given.applied, protocol=protocol)
    run = dataclasses.replace(
        run,
        map_seconds=maps.map_info(map_path).get("seconds", {}),
        excluded=(*excluded, *run.excluded),
        weights=look.weights,
        trained_on=look.trained_on,
    )
    if not run.trials:
        reasons = "; ".join(f"{e.what}: {e.reason}" for e in run.excluded[:3]) or "there is no visit"
        raise ReplayError(f"{recordings[0]}: no visit could be scored: {reasons}", hint="see the reasons")
    trusted = trust(run)
    if trusted is not None and trusted.warning:
        log.warning("%s", trusted.warning)
    store.write_run(out, run, force=force)
    cache.remove()
    return run


def _excluded_rows(scene_map: SceneMap, protocol: Protocol, learned: Sequence[Excluded]) -> tuple[Excluded, ...]:
    """Return the rows that weights or map leave out, with a warning for each reason."""
    unfiltered = policies.unfiltered(scene_map, protocol)
    result = (*(() if unfiltered is None else (unfiltered,)), *learned)
    policies.warn_excluded(result)
    return result


def _load_tags(path: Path | None, scene_map: SceneMap) -> TagMap:
    if path is None:
        return TagMap((), (), scene_map.digest)
    tags = store.read_tags(path)
    if tags.map_digest != scene_map.digest:
        raise ReplayError(
            f"{path}: calibrated in the map {tags.map_digest[:12]}; expected {scene_map.digest[:12]}, the digest of "
            f"{scene_map.path}",
            hint="calibrate the tags in this map",
        )
    check_families(tags)
    return tags


def _check_names(recordings: Sequence[Recording]) -> None:
    names = [r.name for r in recordings]
    for r in recordings:
        if names.count(r.name) > 1:
            raise ReplayError(
                f"{r.path}: another recording is named {r.name!r} too; expected different session names",
                hint="give each recording once, or name one in a session.toml beside it",
            )


def _check_tags(recording: Recording, tags: TagMap) -> None:
    """Raise ReplayError for a tag that the recording names and the tag file lacks, before any work is done."""
    wanted: list[tuple[int, str | None, str]] = []
    for visit in recording.visits:
        own = [s for s in recording.starts if s.visit == visit.id] or [s for s in recording.starts if s.visit is None]
        wanted += [(s.tag_id, visit.id, "start tag") for s in own if s.tag_id is not None]
        if recording.reference is None and visit.truth_tag_id is not None:
            wanted.append((visit.truth_tag_id, visit.id, "tripod tag"))
    known = ", ".join(f"{t.id} ({t.visit or 'every visit'})" for t in tags.tags)
    doubtful = set()
    for tag_id, visit_id, what in wanted:
        tag = tags.find(tag_id, visit=visit_id)
        if tag is None:
            named = f"tag {tag_id}, the {what} of visit {visit_id} in {recording.path}"
            if not tags.path:
                raise ReplayError(f"no tag file was given; expected one with {named}", hint="give --tags")
            raise ReplayError(
                f"{tags.path} has no {named}; expected it for this visit or every visit among {known}",
                hint="photograph and calibrate this tag, or correct the ids of tag and visit",
            )
        if tag.verdict != "pass":
            doubtful.add(f"the {what} {tag_id} has the verdict {tag.verdict!r}")
    for doubt in sorted(doubtful):
        log.warning("%s: %s: take more photos of it", tags.path, doubt)


@dataclasses.dataclass(frozen=True)
class _Ready:
    """A visit that can be scored: the candidates are its views whose truth is known."""

    prior: Prior
    truths: Mapping[str, Truth]
    candidates: Candidates


def _replay_session(
    recording: Recording,
    look: policies.Looker,
    scene_map: SceneMap,
    tags: TagMap,
    protocol: Protocol,
    *,
    applied: Sequence[Applied],
    cache: store.EstimateCache,
    progress: Progress | None,
) -> _Session:
    _check_tags(recording, tags)
    if not recording.frames:
        raise ReplayError(
            f"{recording.path}: has tag detections but no image; expected images of the arm camera to localize",
            hint="record the arm camera's images",
        )
    clock = offset_fault(odometry_clock(recording, tags))
    for warning in (*recording.warnings, *summarize_faults(() if clock is None else (clock,))):
        log.warning("%s: %s", recording.path, warning)
    ready, excluded = _prepare(recording, tags, protocol)
    localizer = Localizer(scene_map, protocol.localizer, seed=protocol.seed)
    parts = []
    for number, (visit_id, known) in enumerate(ready.items(), start=1):
        if progress is not None:
            progress(f"replay {recording.name}", number, len(ready))
        prior_error = _prior_error(recording, known.prior, known.truths)
        utilities = look.utilities(known.candidates)
        reasons = look.reasons(known.candidates, utilities)
        plan = VisitPlan(recording.name, known.prior, prior_error, known.candidates, utilities, reasons)
        views = next(v for v in recording.visits if v.id == visit_id).views
        chosen = {v.id: v for v in views if v.id in known.candidates.view_ids}
        parts.append(
            _score_visit(
                plan,
                chosen,
                known.truths,
                protocol,
                made_of=(scene_map.digest, localizer.weights_digest, *(file.digest for file in applied)),
                localizer=localizer,
                cache=cache,
            )
        )
    return _Session(
        trials=tuple(t for p in parts for t in p.trials),
        results=tuple(r for p in parts for r in p.results),
        truths=tuple(t for known in ready.values() for t in known.truths.values()),
        plans=tuple(p for part in parts for p in part.plans),
        thumbnails={k: v for p in parts for k, v in p.thumbnails.items()},
        excluded=tuple(excluded),
    )


def _prepare(recording: Recording, tags: TagMap, protocol: Protocol) -> tuple[dict[str, _Ready], list[Excluded]]:
    """Find prior, truth and candidates of every visit before anything is localized; say what is left out and why."""
    priors: dict[str, Prior] = {}
    ready: dict[str, _Ready] = {}
    excluded: list[Excluded] = []
    for visit in recording.visits:
        try:
            priors[visit.id] = estimate_prior(recording, visit, tags, noise=protocol.odometry, arm=protocol.arm)
        except EXCLUDING as error:
            excluded.append(Excluded(f"{recording.name}/{visit.id}", str(error)))
    for prior in priors.values():
        for note in prior.notes:
            log.warning("%s: visit %s: %s", recording.path, prior.visit, note)
    located = [v for v in recording.visits if v.id in priors]
    # The way goes on to the next waypoint whether or not its truth is known.
    ahead = forward_directions(located, [priors[v.id] for v in located], rules=protocol.candidates)
    for visit, direction in zip(located, ahead, strict=True):
        try:
            truths = estimate_truths(recording, visit, tags, noise=protocol.odometry, arm=protocol.arm)
            usable, dropped = _usable_views(recording, visit, truths)
            candidates = recorded_candidates(
                recording, usable, priors[visit.id], rules=protocol.candidates, forward_in_map=direction
            )
        except EXCLUDING as error:
            excluded.append(Excluded(f"{recording.name}/{visit.id}", str(error)))
            continue
        excluded += dropped
        ready[visit.id] = _Ready(priors[visit.id], truths, candidates)
    for item in excluded:
        log.warning("%s: %s is excluded: %s", recording.path, item.what, item.reason)
    return ready, excluded


def _usable_views(recording: Recording, visit: Visit, truths: Mapping[str, Truth]) -> tuple[Visit, list[Excluded]]:
    """Return the visit with the views whose truth and odometry are known, and what was left out."""
    kept, dropped = [], []
    for view in visit.views:
        reason = None if view.id in truths else "its truth is not known"
        try:
            recording.odometry.at(view.frame.t_ns)
        except FrameError as error:
            reason = error.message
        if reason is None:
            kept.append(view)
        else:
            dropped.append(Excluded(f"{recording.name}/{visit.id}/{view.id}", reason))
    return dataclasses.replace(visit, views=tuple(kept)), dropped


def _prior_error(recording: Recording, prior: Prior, truths: Mapping[str, Truth]) -> tuple[float, float]:
    """Return the error (m, rad) of the prior against the true body, carried to the prior's time by odometry."""
    times = {v.id: v.frame.t_ns for visit in recording.visits if visit.id == prior.visit for v in visit.views}
    nearest = min(truths, key=lambda view: (abs(times[view] - prior.t_ns), view))
    truth = truths[nearest]
    map_from_body = truth.map_from_cam * truth.body_from_cam.inv()
    moved = recording.odometry.at(times[nearest]).inv() * recording.odometry.at(prior.t_ns)
    return pose_error(prior.map_from_body, map_from_body * moved)


def _score_visit(
    plan: VisitPlan,
    views: Mapping[str, View],
    truths: Mapping[str, Truth],
    protocol: Protocol,
    *,
    made_of: Sequence[str],
    localizer: Localizer,
    cache: store.EstimateCache,
) -> _Session:
    results: dict[str, ViewResult] = {}
    thumbnails: dict[str, bytes] = {}
    settings = repr((*made_of, protocol.feature, protocol.localizer, protocol.seed, store.library_versions()))
    keyed = (_keyed(view, settings, cache) for view in views.values())
    for seen in in_threads(lambda s: _localized(s, localizer), keyed, threads=default_threads()):
        view, estimate = seen.view, cache.get(seen.key)
        if estimate is None:
            assert seen.estimate is not None
            estimate = cache.put(seen.key, seen.estimate)
        results[view.id] = ViewResult(plan.session, plan.prior.visit, view.id, view.kind, view.frame.stamp_ns, estimate)
        thumbnails[f"{plan.session}/{plan.prior.visit}/{view.id}"] = _thumbnail(seen.image)
    trials = scores.make_trials(plan, results, truths, protocol=protocol)
    return _Session(trials, tuple(results.values()), tuple(truths.values()), (plan,), thumbnails)


@dataclasses.dataclass(frozen=True)
class _Seen:
    """A view's image, the key of its estimate, and the estimate once it is there."""

    view: View
    image: Image
    key: str
    estimate: Estimate | None


def _keyed(view: View, settings: str, cache: store.EstimateCache) -> _Seen:
    image = view.frame.read()
    key = store.digest(np.ascontiguousarray(image).tobytes(), repr(image.shape), repr(view.frame.camera), settings)
    return _Seen(view, image, key, cache.get(key))


def _localized(seen: _Seen, localizer: Localizer) -> _Seen:
    if seen.estimate is not None:
        return seen
    return dataclasses.replace(seen, estimate=localizer.localize_query(Query(seen.image, seen.view.frame.camera)))


def _thumbnail(image: Image) -> bytes:
    height, width = image.shape[:2]
    size = (THUMBNAIL_PX, max(round(height * THUMBNAIL_PX / width), 1))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    if small.ndim == 3:
        small = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 80])
    return bytes(data)


def _collect(
    recordings: Sequence[Recording],
    sessions: Sequence[_Session],
    *,
    scene_map: SceneMap,
    tags: TagMap,
    applied: tuple[Applied, ...],
    protocol: Protocol,
) -> Run:
    return Run(
        protocol=protocol,
        map_digest=scene_map.digest,
        tags_digest=tags.digest,
        recordings=tuple(r.path for r in recordings),
        sessions=tuple(r.name for r in recordings),
        seed=protocol.seed,
        versions=store.library_versions(),
        trials=tuple(t for s in sessions for t in s.trials),
        results=tuple(r for s in sessions for r in s.results),
        truths=tuple((r.name, t) for r, s in zip(recordings, sessions, strict=True) for t in s.truths),
        plans=tuple(p for s in sessions for p in s.plans),
        plan_view=plan_view(scene_map, seed=protocol.seed),
        thumbnails={k: v for s in sessions for k, v in s.thumbnails.items()},
        excluded=tuple(e for s in sessions for e in s.excluded),
        tags=tags if tags.tags else None,
        corrections=applied,
    )
