"""Measure what was estimated against the truth of a synthesized session; the only reader of its ``truth/`` folder.

A map made from drifting SLAM poses is not the world. One rigid transform, scale not refitted, is fitted between the
true and the mapped mapping cameras; its residual is the gauge, and everything else is measured after it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fieldkit import maps, store
from fieldkit.errors import JudgeError
from fieldkit.frames import Pose, Trajectory, log, pose_error
from fieldkit.surface import read_ply
from fieldkit.types import Run, SceneMap, Surface, TagMap

Array = NDArray[np.float64]
LANDMARK_SAMPLE = 5000


@dataclasses.dataclass(frozen=True)
class Gauge:
    """The rigid transform world_from_map, and what it leaves of the mapping cameras' positions (m)."""

    world_from_map: Pose
    rms_m: float
    max_m: float
    scale_error: float


def judge(session: Path, *, map_path: Path, tags_path: Path | None, run_path: Path | None = None) -> dict[str, Any]:
    """Compare map, tags and optionally a run with the truth; return the values of ``fieldkit judge --json``.

    Errors are in m and deg; ``nees`` is the normalised estimation error squared (6 degrees of freedom). Raises
    JudgeError when the session holds no truth or does not belong to the map.
    """
    truth = Path(session) / "truth"
    if not truth.is_dir():
        raise JudgeError(f"{session}: has no truth/ folder; expected a session from `sim-bridge synthesize`")
    scene_map = maps.load_map(map_path)
    gauge = fit_gauge(scene_map, dict(store.read_tum(truth / "mapping_poses.txt")))
    up = gauge.world_from_map.rotation.apply([0.0, 0.0, 1.0])
    result: dict[str, Any] = {
        "version": 1,
        "gauge": {"rms_m": gauge.rms_m, "max_m": gauge.max_m},
        "map": {
            "scale_error": gauge.scale_error,
            "gravity_deg": float(np.degrees(np.arccos(np.clip(up[2], -1.0, 1.0)))),
            "landmark_median_m": _landmark_median(scene_map, gauge, truth / "surface.ply"),
        },
        "tags": [] if tags_path is None else _judge_tags(store.read_tags(tags_path), truth, gauge),
        "priors": [],
        "truths": [],
        "estimates": {},
    }
    if run_path is not None:
        result.update(_judge_run(store.read_run(run_path), truth, gauge))
    return result


def fit_gauge(scene_map: SceneMap, true_cameras: Mapping[str, Pose]) -> Gauge:
    """Fit world_from_map to the positions of the mapping cameras (Kabsch, no scale); scale is only measured."""
    pairs = [
        (p.translation, true_cameras[name].translation)
        for name, p in zip(scene_map.image_names, scene_map.map_from_image, strict=True)
        if name in true_cameras
    ]
    if len(pairs) < 3:
        raise JudgeError(
            f"{scene_map.path}: shares {len(pairs)} images with the session's truth; expected its mapping images",
            hint="judge a map that was built from this session's mapping/ folder",
        )
    mapped, true = (np.array(side) for side in zip(*pairs, strict=True))
    centred, target = mapped - mapped.mean(axis=0), true - true.mean(axis=0)
    rotation, _ = Rotation.align_vectors(target, centred)
    world_from_map = Pose.from_components(true.mean(axis=0) - rotation.apply(mapped.mean(axis=0)), rotation)
    residual = np.linalg.norm(world_from_map.apply(mapped) - true, axis=1)
    scale = float(np.sum(target * rotation.apply(centred)) / np.sum(centred**2))
    return Gauge(world_from_map, float(np.sqrt(np.mean(residual**2))), float(residual.max()), 1.0 / scale - 1.0)


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


def _judge_run(run: Run, truth: Path, gauge: Gauge) -> dict[str, Any]:
    bodies = _trajectory(truth / "body_poses.txt")
    cameras = dict(store.read_tum(truth / "view_poses.txt"))
    times = {(r.session, r.visit, r.view): str(r.t_ns) for r in run.results}
    priors = [
        _entry(
            {"session": p.session, "visit": p.prior.visit},
            gauge.world_from_map * p.prior.map_from_body,
            bodies.at(p.prior.t_ns),
            p.prior.covariance,
        )
        for p in run.plans
    ]
    truths = [
        _entry(
            {"session": session, "visit": t.visit, "view": t.view},
            gauge.world_from_map * t.map_from_cam,
            cameras[times[session, t.visit, t.view]],
            t.covariance,
        )
        for session, t in run.truths
        if (session, t.visit, t.view) in times
    ]
    return {"priors": priors, "truths": truths, "estimates": _judge_estimates(run, cameras, gauge)}


def _judge_estimates(run: Run, cameras: Mapping[str, Pose], gauge: Gauge) -> dict[str, Any]:
    entries = [
        _entry({}, gauge.world_from_map * r.estimate.map_from_cam, cameras[str(r.t_ns)], r.estimate.covariance)
        for r in run.results
        if r.estimate.map_from_cam is not None and r.estimate.covariance is not None
    ]
    failed = sum(r.estimate.map_from_cam is None for r in run.results)
    infinite = [float("inf")] * failed
    return {
        "n": len(run.results),
        "failed": failed,
        "median_position_m": _median([e["position_m"] for e in entries] + infinite),
        "median_rotation_deg": _median([e["rotation_deg"] for e in entries] + infinite),
        "nees_trimmed": trimmed_mean([e["nees"] for e in entries]),
    }


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def trimmed_mean(values: Sequence[float], *, share: float = 0.02) -> float | None:
    """Return the mean without the largest share of the values: one outlier rules an average normalised error."""
    if not values:
        return None
    ordered = np.sort(values)
    return float(np.mean(ordered[: max(len(ordered) - int(np.ceil(share * len(ordered))), 1)]))


def _trajectory(path: Path) -> Trajectory:
    rows = store.read_tum(path)
    times = np.array([int(name) for name, _ in rows], dtype=np.int64)
    return Trajectory(times, tuple(p for _, p in rows), "world", "body", max_gap_ns=2_000_000_000)
