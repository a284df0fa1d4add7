"""Replay a dataset like a recording: its views are localized already, policies only rank them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import cast

import numpy as np

from fieldkit import maps, policies, scores, store
from fieldkit.errors import DatasetError
from fieldkit.frames import pose_error
from fieldkit.learned.checkpoint import Checkpoint
from fieldkit.protocol import Protocol
from fieldkit.store.datasets import (
    DatasetFile,
    DatasetRules,
    SceneFile,
    Shard,
    map_path,
    read_dataset,
    read_gauge,
    read_scene,
    read_scene_shard,
    row_pose,
    scene_path,
    shard_path,
)
from fieldkit.types import (
    Candidates,
    Estimate,
    Excluded,
    PlanView,
    Prior,
    Run,
    SceneMap,
    Trial,
    Truth,
    ViewKind,
    ViewResult,
    Visit,
    VisitPlan,
)
from fieldkit.views import forward_directions, plan_view

Progress = Callable[[str, int, int], None]


@dataclasses.dataclass(frozen=True)
class _Scene:
    """A scene of a dataset: where it lies, what scene.toml says, and its session name in the run."""

    folder: Path
    entry: SceneFile
    session: str


@dataclasses.dataclass(frozen=True)
class _Part:
    """What one scene yields."""

    map_digest: str
    plan_view: PlanView
    trials: tuple[Trial, ...]
    results: tuple[ViewResult, ...]
    truths: tuple[Truth, ...]
    plans: tuple[VisitPlan, ...]


def replay_datasets(
    datasets: Sequence[Path],
    *,
    protocol: Protocol,
    out: Path,
    policy_weights: Sequence[Path] = (),
    force: bool = False,
    progress: Progress | None = None,
) -> Run:
    """Replay dataset folders through every policy of a protocol and write the run folder ``out``.

    A session is a scene, in its own map. Raises DatasetError for a dataset that is not finished, or that was localized
    otherwise than the protocol says.
    """
    store.refuse_existing(Path(out), force=force, marker="run.json")
    checkpoints, unweighted = policies.find_checkpoints(protocol.policies, given=policy_weights)
    scenes = [scene for path in datasets for scene in _scenes(Path(path), protocol)]
    twice = [s.session for s in scenes if [o.session for o in scenes].count(s.session) > 1]
    if twice:
        raise DatasetError(
            f"{', '.join(str(d) for d in datasets)}: hold the scene {twice[0]!r} twice; expected it once",
            hint="replay the datasets one by one",
        )
    checkpoints, lacking = _servable(scenes, checkpoints)
    excluded = (*unweighted, *lacking)
    policies.warn_excluded(excluded)
    policies.warn_known(checkpoints, [s.session for s in scenes])
    parts = [_replay_scene(scene, protocol, checkpoints, progress=progress) for scene in scenes]
    run = Run(
        protocol=protocol,
        map_digest=parts[0].map_digest if len(parts) == 1 else store.digest(*(p.map_digest for p in parts)),
        tags_digest="",
        recordings=tuple(str(d) for d in datasets),
        sessions=tuple(s.session for s in scenes),
        seed=protocol.seed,
        versions=store.library_versions(),
        trials=tuple(t for p in parts for t in p.trials),
        results=tuple(r for p in parts for r in p.results),
        truths=tuple((s.session, t) for s, p in zip(scenes, parts, strict=True) for t in p.truths),
        plans=tuple(v for p in parts for v in p.plans),
        # Maps of several scenes have nothing in common that could be drawn in one picture.
        plan_view=parts[0].plan_view if len(parts) == 1 else PlanView(*2 * (np.zeros((0, 3), np.float32),)),
        thumbnails={},
        excluded=excluded,
        weights={name: checkpoint.digest for name, checkpoint in checkpoints.items()},
        trained_on={name: checkpoint.about.scenes for name, checkpoint in checkpoints.items()},
    )
    store.write_run(out, run, force=force)
    return run


def _servable(
    scenes: Sequence[_Scene], checkpoints: Mapping[str, Checkpoint]
) -> tuple[dict[str, Checkpoint], tuple[Excluded, ...]]:
    """Return the checkpoints that all maps can serve, and which are left out: some scenes alone would mislead."""
    lacking: dict[str, Excluded] = {}
    for name, checkpoint in checkpoints.items():
        network = checkpoint.about.appearance
        for scene in scenes:
            path = map_path(scene.folder, scene.entry)
            if network is not None and network not in maps.known_appearances(path):
                reason = f"{path} lacks the appearance {network} of its landmarks"
                lacking.setdefault(
                    name, Excluded(name, f"{reason}; add it with `sim-bridge dataset --appearance {network}`")
                )
    return {n: c for n, c in checkpoints.items() if n not in lacking}, tuple(lacking.values())


def _scenes(path: Path, protocol: Protocol) -> list[_Scene]:
    """Return the scenes of a dataset; raises DatasetError unless it is finished and fits the protocol."""
    head: DatasetFile = read_dataset(path)
    _refuse_other(path, head.rules, protocol)
    result = []
    for name in head.scenes:
        entry = read_scene(path, name) if scene_path(path, name).is_file() else None
        planned = () if entry is None else entry.waypoints
        done = sum(shard_path(path, name, w).is_file() for w in planned)
        if entry is None or done < len(planned):
            raise DatasetError(
                f"{path}: scene {name!r} has {done} of {len(planned) or 'its'} waypoints; expected all of them",
                hint="give the command that makes the dataset again: it goes on where it was; a scene without "
                "waypoints is left out where it is not named",
            )
        result.append(_Scene(path, entry, name))
    return result


def _refuse_other(path: Path, rules: DatasetRules, protocol: Protocol) -> None:
    """Raise DatasetError when the views were localized otherwise than a protocol says."""
    pairs = (
        ("feature", rules.feature, protocol.feature),
        ("localizer", rules.localizer, protocol.localizer),
        ("seed", rules.seed, protocol.seed),
    )
    for what, stored, wanted in pairs:
        if stored != wanted:
            raise DatasetError(
                f"{path}: was localized with {what} {stored!r}; the protocol {protocol.name} says {wanted!r}",
                hint="use the protocol paper_sim, or one with the same feature, localizer and seed",
            )


def _replay_scene(
    scene: _Scene, protocol: Protocol, checkpoints: Mapping[str, Checkpoint], *, progress: Progress | None
) -> _Part:
    folder, entry = scene.folder, scene.entry
    scene_map = _load_map(scene)
    policies.check_map(scene_map, protocol)
    gauge = read_gauge(map_path(folder, entry))
    look = policies.Looker(scene_map, protocol, checkpoints=checkpoints)
    shards = [read_scene_shard(folder, entry, w) for w in entry.waypoints]
    priors = [_prior(shard) for shard in shards]
    visits = [Visit(s.waypoint, 0, 0, (), s.next) for s in shards]
    ahead = forward_directions(visits, priors, rules=protocol.candidates)
    plans: list[VisitPlan] = []
    trials: list[Trial] = []
    results: list[ViewResult] = []
    truths: list[Truth] = []
    for number, (shard, prior, forward) in enumerate(zip(shards, priors, ahead, strict=True)):
        if progress is not None:
            progress(f"replay {scene.session}", number + 1, len(shards))
        candidates = _candidates(shard, protocol, forward=forward)
        error = pose_error(prior.map_from_body, row_pose(shard.body))
        plan = VisitPlan(scene.session, prior, error, candidates, look.utilities(candidates))
        found = _results(shard, scene.session, number)
        known = _truths(shard, rms_m=gauge.rms_m)
        trials += scores.make_trials(plan, found, known, protocol=protocol)
        plans.append(plan)
        results += found.values()
        truths += known.values()
    view = plan_view(scene_map, seed=protocol.seed)
    return _Part(scene_map.digest, view, tuple(trials), tuple(results), tuple(truths), tuple(plans))


def _load_map(scene: _Scene) -> SceneMap:
    scene_map = maps.load_map(map_path(scene.folder, scene.entry))
    if scene_map.digest != scene.entry.map_digest:
        raise DatasetError(
            f"{scene_map.path}: has the digest {scene_map.digest[:12]}; expected {scene.entry.map_digest[:12]}, the "
            f"one that {scene.entry.name} was localized in",
            hint="make the dataset again",
        )
    return scene_map


def _prior(shard: Shard) -> Prior:
    return Prior(shard.waypoint, row_pose(shard.prior), shard.prior_covariance, 0, 0.0, 0)


def _candidates(shard: Shard, protocol: Protocol, *, forward: np.ndarray) -> Candidates:
    return Candidates(
        visit=shard.waypoint,
        view_ids=shard.view_ids,
        kinds=cast(tuple[ViewKind, ...], shard.kinds),
        map_from_cam=tuple(row_pose(row) for row in shard.candidate),
        camera=shard.camera,
        allowed=np.array([kind in protocol.candidates.kinds for kind in shard.kinds]),
        forward_in_map=forward,
    )


def _results(shard: Shard, session: str, number: int) -> Mapping[str, ViewResult]:
    """Return the stored estimates; a view's time only counts the views of the scene, in ms."""
    result = {}
    for i, view in enumerate(shard.view_ids):
        known = bool(np.isfinite(shard.estimate[i]).all())
        estimate = Estimate(
            map_from_cam=row_pose(shard.estimate[i]) if known else None,
            covariance=shard.covariance[i] if known else None,
            n_matches=int(shard.matches[i]),
            n_inliers=int(shard.inliers[i]),
            status=shard.status[i],
            confidence=float(shard.confidence[i]),
            seconds={},
        )
        t_ns = (number * len(shard.view_ids) + i) * 1_000_000
        kind = cast(ViewKind, shard.kinds[i])
        result[view] = ViewResult(session, shard.waypoint, view, kind, t_ns, estimate)
    return result


def _truths(shard: Shard, *, rms_m: float) -> Mapping[str, Truth]:
    """Return the true cameras; their uncertainty is what the map's warp leaves after the rigid fit."""
    covariance = np.diag([0.0] * 3 + [rms_m**2 / 3.0] * 3)
    return {
        view: Truth(
            shard.waypoint, view, row_pose(shard.truth[i]), row_pose(shard.body_from_cam[i]), covariance, "simulation"
        )
        for i, view in enumerate(shard.view_ids)
    }
