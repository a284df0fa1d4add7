"""Run folders: what a replay leaves, so that scoring and the report open neither image, bag nor map."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, cast
from urllib.parse import quote, unquote

import msgspec
import numpy as np

from fieldkit import protocol as protocols
from fieldkit.cameras import Camera
from fieldkit.errors import FieldkitError, StoreError
from fieldkit.frames import Pose, pose
from fieldkit.store.arrays import RunArrays, read_arrays, refuse_unfitting, write_arrays
from fieldkit.store.files import atomic_folder, atomic_write, digest, plain_json, read_json, saving
from fieldkit.store.inputs import write_tum
from fieldkit.store.tables import (
    COVARIANCE,
    POSE,
    Row,
    covariance_cells,
    covariance_of,
    needed_pose,
    optional_bool,
    pose_cells,
    pose_of,
    read_table,
    write_table,
)
from fieldkit.store.tags import read_tags, write_tags
from fieldkit.types import (
    VIEW_KINDS,
    Applied,
    Candidates,
    Estimate,
    Excluded,
    Prior,
    Run,
    Trial,
    Truth,
    ViewKind,
    ViewResult,
    VisitPlan,
)

TAGS_FILE = "tags.toml"
TRIALS = (
    "session", "visit", "policy", "occlusion", "view", "weight", "utility", "status", "cam_position_m",
    "cam_rotation_deg", "body_position_m", "body_rotation_deg", "truth_sigma_m", "truth_sigma_deg", "prior_error_m",
    "prior_error_deg",
)  # fmt: skip
STAGES = ("extract", "retrieve", "match", "pnp")
ESTIMATES = (
    "session", "visit", "view", "t_ns", "kind", "status", "matches", "inliers", "confidence", *POSE, *COVARIANCE,
    *(f"s_{s}" for s in STAGES),
)  # fmt: skip
BODY = tuple(f"body_{name}" for name in POSE)
TRUTHS = ("session", "visit", "view", "source", *POSE, *BODY, *COVARIANCE)
PRIORS = (
    "session", "visit", "t_ns", "travelled_m", "n_sightings", *POSE, *COVARIANCE, "prior_error_m", "prior_error_deg",
)  # fmt: skip
CANDIDATES = (
    "session", "visit", "view", "kind", "allowed", *POSE, "forward_x", "forward_y", "forward_z", "camera_model",
    "camera_width", "camera_height", "camera_params",
)  # fmt: skip


class _RunFile(msgspec.Struct, forbid_unknown_fields=True):
    version: Literal[1]
    protocol: dict[str, Any]
    map_digest: str
    tags_digest: str
    recordings: list[str]
    seed: int
    versions: dict[str, str]
    sessions: list[str]
    excluded: list[Excluded]
    corrections: list[Applied] = []
    map_seconds: dict[str, float] = {}
    weights: dict[str, str] = {}
    trained_on: dict[str, tuple[str, ...]] = {}


def write_run(path: Path, run: Run, *, force: bool = False) -> None:
    """Write a run folder (run.json and tables); raises StoreError when it exists and ``force`` is not set."""
    with atomic_folder(Path(path), force=force, marker="run.json") as folder:
        head = _RunFile(
            1, protocols.to_dict(run.protocol), run.map_digest, run.tags_digest, list(run.recordings), run.seed,
            dict(run.versions), list(run.sessions), list(run.excluded), list(run.corrections),
            dict(run.map_seconds), dict(run.weights), dict(run.trained_on),
        )  # fmt: skip
        write_table(folder / "trials.csv", TRIALS, (_trial_cells(t) for t in run.trials))
        write_table(folder / "estimates.csv", ESTIMATES, (_result_cells(r) for r in run.results))
        write_table(folder / "truth.csv", TRUTHS, (_truth_cells(s, t) for s, t in run.truths))
        write_table(folder / "priors.csv", PRIORS, (_prior_cells(p) for p in run.plans))
        write_table(folder / "candidates.csv", CANDIDATES, (row for p in run.plans for row in _candidate_cells(p)))
        write_arrays(folder, run.plans, run.plan_view)
        _write_poses(folder, run)
        _write_tags(folder, run)
        for key, jpeg in run.thumbnails.items():
            atomic_write(folder / "thumbs" / f"{quote(key, safe='')}.jpg", jpeg)
        atomic_write(folder / "run.json", plain_json(head))


def read_run(path: Path) -> Run:
    """Read a run folder; raises StoreError with the file and line of what is missing or damaged."""
    path = Path(path)
    if not (path / "run.json").is_file():
        raise StoreError(f"{path}: not a run folder; expected run.json in it", hint="make one with `fieldkit replay`")
    head = read_json(path / "run.json", _RunFile, what="run.json of a run folder")
    protocol = protocols.from_dict(head.protocol, source=f"{path / 'run.json'}: protocol")
    arrays = read_arrays(path)
    trials = tuple(read_table(path / "trials.csv", TRIALS, _trial))
    plans = _read_plans(path, arrays)
    refuse_unfitting(path, arrays, plans, protocol)
    _check_complete(path, trials, plans, protocol, excluded={e.what for e in head.excluded})
    return Run(
        protocol=protocol,
        map_digest=head.map_digest,
        tags_digest=head.tags_digest,
        recordings=tuple(head.recordings),
        sessions=tuple(head.sessions),
        seed=head.seed,
        versions=head.versions,
        trials=trials,
        results=tuple(read_table(path / "estimates.csv", ESTIMATES, _result)),
        truths=tuple(read_table(path / "truth.csv", TRUTHS, _truth)),
        plans=plans,
        plan_view=arrays.plan_view,
        thumbnails={unquote(p.stem): p.read_bytes() for p in sorted((path / "thumbs").glob("*.jpg"))},
        excluded=tuple(head.excluded),
        path=str(path),
        tags=read_tags(path / TAGS_FILE) if (path / TAGS_FILE).is_file() else None,
        corrections=tuple(head.corrections),
        map_seconds=head.map_seconds,
        weights=head.weights,
        trained_on=head.trained_on,
    )


def _write_tags(folder: Path, run: Run) -> None:
    """Put the tags beside the run, byte for byte where their file is still the one that was read."""
    if run.tags is None:
        return
    source = Path(run.tags.path) if run.tags.path else None
    if source is not None and source.is_file() and digest(source) == run.tags.digest:
        atomic_write(folder / TAGS_FILE, source.read_bytes())
    else:
        write_tags(folder / TAGS_FILE, run.tags)


def _check_complete(
    path: Path, trials: Sequence[Trial], plans: Sequence[VisitPlan], protocol: protocols.Protocol, *, excluded: set[str]
) -> None:
    """Raise StoreError when trials.csv lacks a policy of the protocol at a visit: rows were lost.

    A policy that was excluded by its name, since it has no weights, has no rows.
    """
    there = {(t.session, t.visit, t.policy) for t in trials}
    for plan in plans:
        for policy in protocol.policies:
            if policy not in excluded and (plan.session, plan.prior.visit, policy) not in there:
                raise StoreError(
                    f"{path / 'trials.csv'}: has no row of {policy} at {plan.session}/{plan.prior.visit}; expected "
                    "every policy at every visit",
                    hint="replay the recording again",
                )


def _trial_cells(t: Trial) -> dict[str, object]:
    deg = float(np.degrees(1.0))
    return {
        "session": t.session, "visit": t.visit, "policy": t.policy, "occlusion": t.occlusion, "view": t.view,
        "weight": t.weight, "utility": t.utility, "status": t.status,
        "cam_position_m": t.cam_error[0], "cam_rotation_deg": t.cam_error[1] * deg,
        "body_position_m": t.body_error[0], "body_rotation_deg": t.body_error[1] * deg,
        "truth_sigma_m": t.truth_sigma[0], "truth_sigma_deg": t.truth_sigma[1] * deg,
        "prior_error_m": t.prior_error[0], "prior_error_deg": t.prior_error[1] * deg,
    }  # fmt: skip


def _trial(row: Row) -> Trial:
    def pair(name: str) -> tuple[float, float]:
        middle = "_position" if name in ("cam", "body") else ""
        turn = "_rotation" if middle else ""
        return float(row[f"{name}{middle}_m"]), float(np.radians(float(row[f"{name}{turn}_deg"])))

    return Trial(
        row["session"], row["visit"], row["policy"], optional_bool(row["occlusion"]), row["view"],
        float(row["weight"]), float(row["utility"]), row["status"], pair("cam"), pair("body"), pair("truth_sigma"),
        pair("prior_error"),
    )  # fmt: skip


def estimate_cells(e: Estimate) -> dict[str, object]:
    """Return the cells of an estimate."""
    return {
        "status": e.status, "matches": e.n_matches, "inliers": e.n_inliers, "confidence": e.confidence,
        **pose_cells(e.map_from_cam), **covariance_cells(e.covariance),
        **{f"s_{s}": e.seconds.get(s) for s in STAGES},
    }  # fmt: skip


def estimate_of(row: Row) -> Estimate:
    """Read the cells of an estimate."""
    return Estimate(
        pose_of(row), covariance_of(row), int(row["matches"]), int(row["inliers"]), row["status"],
        float(row["confidence"]), {s: float(row[f"s_{s}"]) for s in STAGES if row[f"s_{s}"]},
    )  # fmt: skip


def _kind(cell: str) -> ViewKind:
    if cell not in VIEW_KINDS:
        raise ValueError(f"unknown kind of view {cell!r}; expected one of {', '.join(VIEW_KINDS)}")
    return cell


def _result_cells(r: ViewResult) -> dict[str, object]:
    cells = {"session": r.session, "visit": r.visit, "view": r.view, "t_ns": r.t_ns, "kind": r.kind}
    return {**cells, **estimate_cells(r.estimate)}


def _result(row: Row) -> ViewResult:
    return ViewResult(
        row["session"], row["visit"], row["view"], _kind(row["kind"]), int(row["t_ns"]), estimate_of(row)
    )  # fmt: skip


def _truth_cells(session: str, t: Truth) -> dict[str, object]:
    return {
        "session": session, "visit": t.visit, "view": t.view, "source": t.source, **pose_cells(t.map_from_cam),
        **pose_cells(t.body_from_cam, prefix="body_"), **covariance_cells(t.covariance),
    }  # fmt: skip


def _truth(row: Row) -> tuple[str, Truth]:
    source, covariance = row["source"], covariance_of(row)
    if source not in ("tag", "topic", "simulation") or covariance is None:
        raise ValueError(f"source {source!r} or its covariance is not one that fieldkit writes")
    body_from_cam = needed_pose(row, prefix="body_")
    kind = cast(Literal["tag", "topic", "simulation"], source)
    return row["session"], Truth(row["visit"], row["view"], needed_pose(row), body_from_cam, covariance, kind)


def _prior_cells(p: VisitPlan) -> dict[str, object]:
    prior = p.prior
    return {
        "session": p.session, "visit": prior.visit, "t_ns": prior.t_ns, "travelled_m": prior.travelled_m,
        "n_sightings": prior.n_sightings, **pose_cells(prior.map_from_body), **covariance_cells(prior.covariance),
        "prior_error_m": p.prior_error[0], "prior_error_deg": float(np.degrees(p.prior_error[1])),
    }  # fmt: skip


def _prior(row: Row) -> tuple[str, Prior, tuple[float, float]]:
    covariance = covariance_of(row)
    if covariance is None:
        raise ValueError("the prior's covariance is missing")
    prior = Prior(
        row["visit"], needed_pose(row), covariance, int(row["t_ns"]), float(row["travelled_m"]),
        int(row["n_sightings"]),
    )  # fmt: skip
    return (
        row["session"],
        prior,
        (float(row["prior_error_m"]), float(np.radians(float(row["prior_error_deg"])))),
    )


def _candidate_cells(p: VisitPlan) -> list[dict[str, object]]:
    c = p.candidates
    forward = [None] * 3 if c.forward_in_map is None else [float(v) for v in c.forward_in_map]
    shared: dict[str, object] = {
        "session": p.session, "visit": c.visit,
        "forward_x": forward[0], "forward_y": forward[1], "forward_z": forward[2],
        "camera_model": c.camera.model, "camera_width": c.camera.width, "camera_height": c.camera.height,
        "camera_params": " ".join(repr(float(v)) for v in c.camera.params),
    }  # fmt: skip
    return [
        {**shared, "view": view, "kind": kind, "allowed": bool(allowed), **pose_cells(map_from_cam)}
        for view, kind, allowed, map_from_cam in zip(c.view_ids, c.kinds, c.allowed, c.map_from_cam, strict=True)
    ]


def _read_plans(path: Path, arrays: RunArrays) -> tuple[VisitPlan, ...]:
    rows = read_table(path / "candidates.csv", CANDIDATES, dict)
    plans = []
    for session, prior, error in read_table(path / "priors.csv", PRIORS, _prior):
        mine = [r for r in rows if (r["session"], r["visit"]) == (session, prior.visit)]
        try:
            candidates = _candidates(prior.visit, mine)
        except (ValueError, IndexError, FieldkitError) as error_:
            raise StoreError(
                f"{path / 'candidates.csv'}: visit {prior.visit}: {error_}", hint="replay the recording again"
            ) from error_
        key = session, prior.visit
        utilities, reasons = arrays.utilities.get(key, {}), arrays.reasons.get(key, {})
        plans.append(VisitPlan(session, prior, error, candidates, utilities, reasons))
    return tuple(plans)


def _candidates(visit: str, rows: list[dict[str, str]]) -> Candidates:
    first = rows[0]
    params = tuple(float(v) for v in first["camera_params"].split())
    camera = Camera(first["camera_model"], int(first["camera_width"]), int(first["camera_height"]), params)
    forward = None if first["forward_x"] == "" else np.array([float(first[f"forward_{a}"]) for a in "xyz"])
    return Candidates(
        visit, tuple(r["view"] for r in rows), tuple(_kind(r["kind"]) for r in rows),
        tuple(needed_pose(r) for r in rows), camera, np.array([r["allowed"] == "true" for r in rows]), forward,
    )  # fmt: skip


def _write_poses(folder: Path, run: Run) -> None:
    estimated: dict[str, list[tuple[str, Pose]]] = {}
    for r in run.results:
        if r.estimate.map_from_cam is not None:
            estimated.setdefault(r.session, []).append((str(r.t_ns), r.estimate.map_from_cam))
    for session, rows in estimated.items():
        write_tum(folder / "poses" / f"{quote(session, safe='')}.txt", rows)


class EstimateCache:
    """Estimates of an unfinished replay, one JSON line each, so that a second start does not localize again.

    ``path`` lies beside the run folder and is removed when the run is complete; lines that a killed process left
    half-written are ignored. Raises StoreError when the file cannot be read or written.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self._known: dict[str, Estimate] | None = None

    def get(self, key: str) -> Estimate | None:
        """Return the stored estimate of a key, or None."""
        if self._known is None:
            self._known = self._load()
        return self._known.get(key)

    def put(self, key: str, estimate: Estimate) -> Estimate:
        """Append an estimate and return it as a second start will read it, to the last bit."""
        # The line break in front ends a line that a kill may have cut off.
        line = "\n" + json.dumps({"key": key, **_estimate_plain(estimate)}) + "\n"
        with saving(self.path):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("a", encoding="utf-8") as stream:
                stream.write(line)
        return _estimate_from_plain(_estimate_plain(estimate))

    def remove(self) -> None:
        """Remove the file: the run is complete."""
        with saving(self.path):
            self.path.unlink(missing_ok=True)

    def _load(self) -> dict[str, Estimate]:
        known: dict[str, Estimate] = {}
        with saving(self.path):
            if not os.path.lexists(self.path):
                return known
            text = self.path.read_text(encoding="utf-8", errors="replace")
        for line in text.splitlines():
            try:
                entry = json.loads(line)
                key = entry.pop("key")
                known[key] = _estimate_from_plain(entry)
            except (ValueError, KeyError, TypeError, AttributeError, FieldkitError):
                continue
        return known


def _estimate_plain(e: Estimate) -> dict[str, Any]:
    found = e.map_from_cam
    return {
        "pose": None if found is None else [*map(float, found.translation), *map(float, found.rotation.as_quat())],
        "covariance": None if e.covariance is None else e.covariance.tolist(),
        "n_matches": e.n_matches, "n_inliers": e.n_inliers, "status": e.status, "confidence": e.confidence,
        "seconds": dict(e.seconds),
    }  # fmt: skip


def _estimate_from_plain(entry: dict[str, Any]) -> Estimate:
    values = entry.pop("pose")
    covariance = entry.pop("covariance")
    return Estimate(
        map_from_cam=None if values is None else pose(values[:3], values[3:]),
        covariance=None if covariance is None else np.asarray(covariance),
        **entry,
    )
