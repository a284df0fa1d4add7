"""Dataset folders that are quick to write: synthetic maps, and views that localize where they see many landmarks."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import msgspec
import numpy as np
from synthetic_map import CAMERA, looking, make_map, write_map

from fieldkit.dataset import DatasetRules
from fieldkit.frames import Pose
from fieldkit.maps import load_map
from fieldkit.store import digest
from fieldkit.store.datasets import (
    DatasetFile,
    SceneFile,
    Shard,
    map_path,
    pose_row,
    read_shard,
    shard_path,
    write_dataset,
    write_scene,
    write_shard,
)
from fieldkit.types import Candidates, SceneMap
from fieldkit.views import visibility

RULES = DatasetRules()


def write_views(
    out: Path, scenes: tuple[str, ...] = ("a", "b", "c"), *, waypoints: int = 6, views: int = 12, seed: int = 0
) -> Path:
    """Write a finished dataset: every scene another map, every second landmark hidden, and return its folder."""
    for number, name in enumerate(scenes):
        rng = np.random.default_rng([seed, number])
        entry = SceneFile(
            1, name, digest(name), digest(name, "views"), f"{name}.map", "", tuple(f"w{i}" for i in range(waypoints))
        )
        write_map(map_path(out, entry), make_map(rng, n_landmarks=150, n_images=8))
        scene_map = load_map(map_path(out, entry))
        write_scene(out, msgspec.structs.replace(entry, map_digest=scene_map.digest))
        for waypoint in entry.waypoints:
            shard = _shard(rng, scene_map, name, waypoint, views=views)
            write_shard(shard_path(out, name, waypoint), dataclasses.replace(shard, key=entry.views_key))
    write_dataset(out, DatasetFile(1, scenes, RULES, {}, {}))
    return out


def _shard(rng: np.random.Generator, scene_map: SceneMap, scene: str, waypoint: str, *, views: int) -> Shard:
    place = np.array([*rng.uniform(-0.8, 0.8, 2), 1.2])
    poses = tuple(looking(place, yaw) for yaw in rng.uniform(-np.pi, np.pi, views))
    names = tuple(f"s{i}" for i in range(views))
    every = Candidates(waypoint, names, ("sweep",) * views, poses, CAMERA, np.ones(views, dtype=bool))
    seen = visibility(scene_map, every, rules=RULES.candidates)
    mapped = [np.isin(i, scene_map.observation_landmark) for i in seen.landmarks]
    counts = np.array([np.count_nonzero(m) for m in mapped])
    x_in_cam, landmark = (np.concatenate(p)[np.concatenate(mapped)] for p in (seen.x_in_cam, seen.landmarks))
    distance = np.linalg.norm(x_in_cam, axis=1)
    label = counts + rng.normal(0, 2, views) > np.median(counts)
    one = pose_row(Pose.identity())
    rows = np.stack([pose_row(p) for p in poses])
    return Shard(
        scene=scene, waypoint=waypoint, next=None, key="", camera=CAMERA, view_ids=names, kinds=every.kinds,
        status=("ok",) * views, prior=one, prior_covariance=np.eye(6), body=one, candidate=rows,
        body_from_cam=rows, truth=rows, estimate=rows, covariance=np.full((views, 6, 6), np.nan),
        matches=np.zeros(views, np.int32), inliers=np.zeros(views, np.int32), confidence=np.zeros(views),
        error=np.where(label[:, None], 0.01, 1.0) * np.ones((views, 2)), label=label,
        starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64), landmark=landmark.astype(np.int32),
        uv_px=CAMERA.project(x_in_cam)[0].astype(np.float32), distance_m=distance.astype(np.float32),
        angle_rad=np.arccos(x_in_cam[:, 2] / distance).astype(np.float32), occluded=landmark % 2 == 1,
        repeat_view=np.zeros(0, np.int32), repeat_number=np.zeros(0, np.int32), repeat_error=np.zeros((0, 2)),
        repeat_label=np.zeros(0, bool),
    )  # fmt: skip


def relabel(folder: Path, scene: str, *, label: bool) -> None:
    """Give all views of a scene one label."""
    for path in sorted((folder / scene).glob("*.npz")):
        shard = read_shard(path)
        write_shard(path, dataclasses.replace(shard, label=np.full(len(shard.label), label)))
