"""What a dataset holds: views and labels per scene, and how often a label changes with new noise."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from fieldkit.store.datasets import read_dataset, read_scene, read_scene_shard, scene_path, shard_path


@dataclasses.dataclass(frozen=True)
class SceneCount:
    """One scene: waypoints there and planned, sweep views, the share of them that localize, and repeats.

    ``flipped`` is the share of the repeated localizations whose label is another than the view's first one;
    ``unsteady`` the share of the repeated views that have such a repeat. nan where nothing was repeated.
    """

    scene: str
    waypoints: int
    planned: int
    views: int
    localized: float
    repeats: int
    flipped: float
    unsteady: float


def count_scenes(path: Path) -> tuple[SceneCount, ...]:
    """Count what a dataset folder holds, finished or not, a row per scene; raises StoreError where it is damaged."""
    path = Path(path)
    return tuple(_count(path, s) for s in read_dataset(path).scenes if scene_path(path, s).is_file())


def _count(path: Path, scene: str) -> SceneCount:
    entry = read_scene(path, scene)
    there = [w for w in entry.waypoints if shard_path(path, scene, w).is_file()]
    labels: list[bool] = []
    changed: list[bool] = []
    unsteady: list[bool] = []
    for waypoint in there:
        shard = read_scene_shard(path, entry, waypoint)
        labels += [bool(y) for y, kind in zip(shard.label, shard.kinds, strict=True) if kind == "sweep"]
        other = shard.repeat_label != shard.label[shard.repeat_view]
        changed += other.tolist()
        unsteady += [bool(other[shard.repeat_view == v].any()) for v in np.unique(shard.repeat_view)]
    counts = len(there), len(entry.waypoints), len(labels)
    return SceneCount(scene, *counts, _share(labels), len(changed), _share(changed), _share(unsteady))


def _share(values: list[bool]) -> float:
    return float(np.mean(values)) if values else float("nan")
