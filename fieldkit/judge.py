"""Measure what was estimated against the truth of a synthesized session; the only reader of its ``truth/`` folder.

A map made from drifting SLAM poses is not the world. One rigid transform, scale not refitted, is fitted between the
true and the mapped mapping cameras; its residual is the gauge, and everything else is measured after it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fieldkit import maps, store
from fieldkit.errors import FrameError, JudgeError
from fieldkit.frames import Pose, Trajectory, log, pose_error
from fieldkit.maps import Gauge, fit_gauge
from fieldkit.surface import read_ply
from fieldkit.types import Run, SceneMap, Surface, TagMap, ViewResult

Array = NDArray[np.float64]
# world_from_cam by session, visit and view.
Cameras = Mapping[tuple[str, str, str], Pose]
LANDMARK_SAMPLE = 5000


def judge(session: Path, *, map_path: Path, tags_path: Path | None, run_path: Path | None = None) -> dict[str, Any]:
    """Compare map, tags and optionally a run with the truth; return the values of ``fieldkit judge --json``.

    Errors are in m and deg; ``nees`` is the normalised estimation error squared (6 degrees of freedom). An entry's
    ``id`` is that of what it judges: a tag, a visit, a view. Without tags or run their parts are empty. Raises
    JudgeError when the session holds no truth, or map, tags, run and session do not belong together.
    """
    truth = Path(session) / "truth"
    if not truth.is_dir():
        raise JudgeError(f"{session}: has no truth/ folder; expected a session from `sim-bridge synthesize`")
    scene_map = maps.load_map(map_path)
    tags = None if tags_path is None else store.read_tags(tags_path)
    run = None if run_path is None else store.read_run(run_path)
    if tags is not None:
        _refuse_other_map(f"{tags_path}: calibrated", tags.map_digest, scene_map, hint="calibrate the tags in this map")
    if run is not None:
        _refuse_other_map(f"{run_path}: replayed", run.map_digest, scene_map, hint="replay the session in this map")
    gauge = fit_gauge(scene_map, dict(store.read_tum(truth / "mapping_poses.txt")))
    cameras = {} if run is None else _true_cameras(run, truth / "view_poses.txt")
    up = gauge.world_from_map.rotation.apply([0.0, 0.0, 1.0])
    return {
        "version": 1,
        "gauge": {"rms_m": gauge.rms_m, "max_m": gauge.max_m},
        "map": {
            "scale_error": gauge.scale_error,
            "gravity_deg": float(np.degrees(np.arccos(np.clip(up[2], -1.0, 1.0)))),
            "landmark_median_m": _landmark_median(scene_map, gauge, truth / "surface.ply"),
        },
        "tags": [] if tags is None else _judge_tags(tags, truth, gauge),
        "priors": [] if run is None else _judge_priors(run, truth, gauge),
        "truths": [] if run is None else _judge_truths(run, cameras, gauge),
        "estimates": _judge_estimates(() if run is None else run.results, cameras, gauge),
    }


def _refuse_other_map(what: str, digest: str, scene_map: SceneMap, *, hint: str) -> None:
    """Raise JudgeError unless something was made with this map: its frame is this map's alone."""
    if digest != scene_map.digest:
        raise JudgeError(
            f"{what} in the map {digest[:12]}; expected {scene_map.digest[:12]}, the digest of {scene_map.path}",
            hint=hint,
        )


def _landmark_median(scene_map: SceneMap, gauge: Gauge, path: Path) -> float | None:
    if not path.is_file() or not len(scene_map.xyz):
        return None
    rng = np.random.default_rng(0)
    points = gauge.world_from_map.apply(scene_map.xyz[rng.permutation(len(scene_map.xyz))[:LANDMARK_SAMPLE]])
    return float(np.median(nearest_distance(read_ply(path), points, rng=rng)))


def nearest_distance(surface: Surface, points: Array, *, rng: np.random.Generator) -> Array:
    """Return the distances (n,) in m of points (n, 3) to the nearest of the triangles near them.

    The triangles of the 16 nearest of a million samples on the surface are tested exactly.
    """
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    share = mesh.area_faces / mesh.area
    face = rng.choice(len(share), size=1_000_000, p=share)
    corner = rng.random((len(face), 2))
    corner = np.where(corner.sum(axis=1, keepdims=True) > 1, 1 - corner, corner)
    a, b, c = (mesh.vertices[mesh.faces[face, k]] for k in range(3))
    samples = a + corner[:, :1] * (b - a) + corner[:, 1:] * (c - a)
    _, near = cKDTree(samples).query(points, k=16)
    triangles = mesh.triangles[face[near]].reshape(-1, 3, 3)
    repeated = np.repeat(points, near.shape[1], axis=0)
    closest = trimesh.triangles.closest_point(triangles, repeated)
    distances: Array = np.linalg.norm(closest - repeated, axis=1).reshape(near.shape).min(axis=1)
    return distances


def _entry(keys: Mapping[str, Any], estimate: Pose, true: Pose, covariance: Array) -> dict[str, Any]:
    position, rotation = pose_error(estimate, true)
    delta = log(estimate.inv() * true)
    nees = float(delta @ np.linalg.pinv(covariance) @ delta)
    return {**keys, "position_m": position, "rotation_deg": float(np.degrees(rotation)), "nees": nees}


def _judge_tags(tags: TagMap, truth: Path, gauge: Gauge) -> list[dict[str, Any]]:
    true = store.read_tags(truth / "tags.toml")
    result = []
    for tag in tags.tags:
        same_id = [t for t in true.tags if t.id == tag.id]
        if not same_id:
            raise JudgeError(f"{truth / 'tags.toml'}: has no tag {tag.id}", hint="judge with the session's own tags")
        known = true.find(tag.id, visit=tag.visit)
        if known is None and tag.visit is None and len(same_id) == 1:
            known = same_id[0]
        if known is None:
            continue  # another visit's tag, seen in passing: the truth does not say where it stood then
        estimate = gauge.world_from_map * tag.map_from_tag
        result.append(_entry({"id": tag.id, "visit": tag.visit}, estimate, known.map_from_tag, tag.covariance))
    return result


def _judge_priors(run: Run, truth: Path, gauge: Gauge) -> list[dict[str, Any]]:
    rows = sorted(_stamped(truth / "body_poses.txt").items(), key=lambda row: row[0])
    times = np.array([t_ns for t_ns, _ in rows], dtype=np.int64)
    bodies = Trajectory(times, tuple(p for _, p in rows), "world", "body", max_gap_ns=2_000_000_000)
    result = []
    for plan in run.plans:
        prior = plan.prior
        try:
            true = bodies.at(prior.t_ns)
        except FrameError as error:
            raise JudgeError(
                f"{truth / 'body_poses.txt'}: no pose at {prior.t_ns} ns, the prior of {prior.visit}: {error.message}",
                hint="judge a run of this session",
            ) from error
        keys = {"session": plan.session, "id": prior.visit, "visit": prior.visit}
        result.append(_entry(keys, gauge.world_from_map * prior.map_from_body, true, prior.covariance))
    return result


def _judge_truths(run: Run, cameras: Cameras, gauge: Gauge) -> list[dict[str, Any]]:
    return [
        _entry(
            {"session": session, "id": t.view, "visit": t.visit, "view": t.view},
            gauge.world_from_map * t.map_from_cam,
            cameras[session, t.visit, t.view],
            t.covariance,
        )
        for session, t in run.truths
        if (session, t.visit, t.view) in cameras
    ]


def _judge_estimates(results: Sequence[ViewResult], cameras: Cameras, gauge: Gauge) -> dict[str, Any]:
    entries = [
        _entry(
            {}, gauge.world_from_map * r.estimate.map_from_cam, cameras[r.session, r.visit, r.view],
            r.estimate.covariance,
        )
        for r in results
        if r.estimate.map_from_cam is not None and r.estimate.covariance is not None
    ]  # fmt: skip
    failed = sum(r.estimate.map_from_cam is None for r in results)
    infinite = [float("inf")] * failed
    return {
        "n": len(results),
        "failed": failed,
        "median_position_m": _median([e["position_m"] for e in entries] + infinite),
        "median_rotation_deg": _median([e["rotation_deg"] for e in entries] + infinite),
        "nees_median": _median([e["nees"] for e in entries]),
        "nees_trimmed": trimmed_mean([e["nees"] for e in entries]),
    }


def _true_cameras(run: Run, path: Path) -> Cameras:
    """Return world_from_cam of every view of a run; raises JudgeError where the session's truth has no such stamp."""
    stamped = _stamped(path)
    for r in run.results:
        if r.t_ns not in stamped:
            raise JudgeError(
                f"{path}: has no pose at {r.t_ns} ns, the view {r.view} of {r.visit}; expected one for every image",
                hint="judge a run of this session",
            )
    return {(r.session, r.visit, r.view): stamped[r.t_ns] for r in run.results}


def _stamped(path: Path) -> dict[int, Pose]:
    """Read poses by their stamps in ns."""
    result = {}
    for name, world_from_child in store.read_tum(path):
        try:
            result[int(np.int64(int(name)))] = world_from_child
        except (ValueError, OverflowError) as error:
            raise JudgeError(
                f"{path}: the stamp {name!r} is no whole number; expected nanoseconds", hint="synthesize it again"
            ) from error
    return result


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def trimmed_mean(values: Sequence[float], *, share: float = 0.02) -> float | None:
    """Return the mean without the largest share of the values: one outlier rules an average normalised error."""
    if not values:
        return None
    ordered = np.sort(values)
    return float(np.mean(ordered[: max(len(ordered) - int(np.ceil(share * len(ordered))), 1)]))
