"""The views of datasets as what a network is trained on: what each sees, and whether it localizes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldkit import maps
from fieldkit.cameras import Camera
from fieldkit.errors import DatasetError, TrainingError, suggestion
from fieldkit.store.datasets import (
    DatasetRules,
    SceneFile,
    Shard,
    map_path,
    read_dataset,
    read_scene,
    read_scene_shard,
    scene_path,
    shard_path,
)
from fieldkit.types import LandmarkStatistics, SceneMap
from fieldkit.views import HeatMaps, SeenLandmarks, landmark_statistics, seen_in_shard

Progress = Callable[[str, int, int], None]


@dataclasses.dataclass(frozen=True)
class SceneFolder:
    """A finished scene of a dataset on disk."""

    folder: Path
    entry: SceneFile
    rules: DatasetRules

    @property
    def name(self) -> str:
        return self.entry.name


@dataclasses.dataclass(frozen=True, eq=False)
class Examples:
    """The candidate views (v) of one scene, in the order of its waypoints.

    ``label`` bool[v]: the view localized; ``waypoint`` int32[v] its number. ``rows``: views i sees, of the k landmarks
    in view, ``starts[i]:starts[i + 1]``; ``seen`` holds all k one after the other, ``occluded`` bool[k].
    ``appearance`` f16[n, width] of the map's landmarks, by the network that saw them.
    """

    scene: str
    map_digest: str
    camera: Camera
    statistics: LandmarkStatistics
    heat_maps: HeatMaps
    label: NDArray[np.bool_]
    waypoint: NDArray[np.int32]
    starts: NDArray[np.int64]
    seen: SeenLandmarks
    occluded: NDArray[np.bool_]
    appearance: Mapping[str, NDArray[np.float16]]

    def view(self, number: int, *, occlusion: bool) -> SeenLandmarks:
        """Return what a view sees; with ``occlusion`` without the landmarks behind the surface."""
        rows = np.arange(self.starts[number], self.starts[number + 1])
        if occlusion:
            rows = rows[~self.occluded[rows]]
        return dataclasses.replace(self.seen.rows(rows), visible=len(rows))


def find_scenes(datasets: Sequence[Path]) -> tuple[SceneFolder, ...]:
    """Return the scenes of dataset folders, in order, without reading their views.

    Raises DatasetError for a dataset that is not finished, holds a scene twice, or was localized otherwise than the
    first one: features and labels of two features or localizers do not mix.
    """
    found: list[SceneFolder] = []
    for path in (Path(d) for d in datasets):
        head = read_dataset(path)
        for name in head.scenes:
            found.append(SceneFolder(path, _finished(path, name), head.rules))
        _refuse_other(path, head.rules, found[0])
    names = [s.name for s in found]
    twice = next((n for n in names if names.count(n) > 1), None)
    if twice is not None:
        raise DatasetError(
            f"{', '.join(str(d) for d in datasets)}: hold the scene {twice!r} twice; expected it once",
            hint="leave one of the datasets away",
        )
    return tuple(found)


def _finished(path: Path, name: str) -> SceneFile:
    if not scene_path(path, name).is_file():
        raise DatasetError(f"{path}: has no views of the scene {name!r} yet", hint="finish the dataset first")
    entry = read_scene(path, name)
    missing = [w for w in entry.waypoints if not shard_path(path, name, w).is_file()]
    if missing:
        raise DatasetError(
            f"{path}: {len(missing)} of {len(entry.waypoints)} waypoints of {name!r} are missing, {missing[0]} first; "
            "expected all",
            hint="finish the dataset first",
        )
    return entry


def _refuse_other(path: Path, rules: DatasetRules, first: SceneFolder) -> None:
    for what in ("feature", "localizer", "candidates", "tolerance_voxels", "label"):
        own, other = getattr(rules, what), getattr(first.rules, what)
        if own != other:
            raise DatasetError(
                f"{path}: was made with {what} {own!r}, {first.folder} with {other!r}; expected the same",
                hint="train from datasets that were made with the same settings",
            )


def read_examples(scene: SceneFolder, *, progress: Progress | None = None) -> Examples:
    """Read the views of a scene of a dataset, and how mapping saw their landmarks.

    Raises StoreError or MapError where a file is damaged, and DatasetError where the map is another than the one in
    which the views were localized.
    """
    scene_map = maps.load_map(map_path(scene.folder, scene.entry))
    if scene_map.digest != scene.entry.map_digest:
        raise DatasetError(
            f"{scene_map.path}: has the digest {scene_map.digest[:12]}; expected {scene.entry.map_digest[:12]}, the "
            f"one that {scene.name} was localized in",
            hint="make the dataset again",
        )
    statistics = landmark_statistics(scene_map)
    labels: list[NDArray[np.bool_]] = []
    waypoints: list[NDArray[np.int32]] = []
    parts: list[_Part] = []
    camera: Camera | None = None
    for number, waypoint in enumerate(scene.entry.waypoints):
        shard = read_scene_shard(scene.folder, scene.entry, waypoint)
        if shard.landmark.max(initial=-1) >= len(scene_map.xyz):
            raise DatasetError(
                f"{shard_path(scene.folder, scene.name, waypoint)}: sees the landmark {shard.landmark.max()}; expected "
                f"less than {len(scene_map.xyz)}, as many as its map has",
                hint="remove it and finish the dataset",
            )
        views = _candidates(shard, scene)
        labels.append(shard.label[views])
        waypoints.append(np.full(len(views), number, dtype=np.int32))
        parts += [_seen(shard, int(i), scene_map, statistics) for i in views]
        camera = shard.camera if camera is None else _same(camera, shard, scene)
        if progress is not None:
            progress(f"read {scene.name}", number + 1, len(scene.entry.waypoints))
    if camera is None or not parts:
        raise DatasetError(
            f"{scene.folder}: the scene {scene.name!r} has no views; expected some", hint="make it again"
        )
    counts = [len(p.occluded) for p in parts]
    return Examples(
        scene=scene.name,
        map_digest=scene_map.digest,
        camera=camera,
        statistics=statistics,
        heat_maps=HeatMaps(scene_map),
        label=np.concatenate(labels),
        waypoint=np.concatenate(waypoints),
        starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        seen=_joined([p.seen for p in parts]),
        occluded=np.concatenate([p.occluded for p in parts]),
        appearance=scene_map.appearance,
    )


@dataclasses.dataclass(frozen=True, eq=False)
class _Part:
    seen: SeenLandmarks
    occluded: NDArray[np.bool_]


def _seen(shard: Shard, view: int, scene_map: SceneMap, statistics: LandmarkStatistics) -> _Part:
    seen = seen_in_shard(shard, view, xyz=scene_map.xyz, statistics=statistics, occlusion=False)
    return _Part(seen, shard.occluded[shard.starts[view] : shard.starts[view + 1]])


def _same(camera: Camera, shard: Shard, scene: SceneFolder) -> Camera:
    if shard.camera != camera:
        raise DatasetError(
            f"{scene.folder}: {scene.name}/{shard.waypoint} has another camera than the waypoints before; expected one",
            hint="make a dataset per camera",
        )
    return camera


def _joined(parts: Sequence[SeenLandmarks]) -> SeenLandmarks:
    return SeenLandmarks(
        landmark=np.concatenate([p.landmark for p in parts]),
        uv_px=np.concatenate([p.uv_px for p in parts]),
        distance_m=np.concatenate([p.distance_m for p in parts]),
        angle_rad=np.concatenate([p.angle_rad for p in parts]),
        off_mean_rad=np.concatenate([p.off_mean_rad for p in parts]),
        visible=sum(p.visible for p in parts),
    )


@dataclasses.dataclass(frozen=True)
class Split:
    """Scenes to train on, and the one on which every choice is made."""

    training: tuple[SceneFolder, ...]
    validation: SceneFolder


def split_scenes(scenes: Sequence[SceneFolder], *, validate: str | None = None, tests: Sequence[Path] = ()) -> Split:
    """Split scenes into those to train on and one to validate on: never by view, and never a view in both.

    Without a name the scene of median difficulty is the one to validate on: by the share of its views that localize,
    then by name. Raises TrainingError when there is no such scene or no other, when two scenes are the same place, or
    one is in a dataset that is kept for ``tests``.
    """
    names, where = [s.name for s in scenes], ", ".join(dict.fromkeys(str(s.folder) for s in scenes))
    if len(names) < 2:
        raise TrainingError(
            f"{where or 'no dataset'}: {len(names) or 'no'} scene to train and validate on; expected at least two",
            hint="give a dataset of more scenes, or more datasets",
        )
    if validate is not None and validate not in names:
        raise TrainingError(
            f"{where}: no scene {validate!r} to validate on; expected one of its scenes",
            hint=suggestion(validate, names),
        )
    for number, scene in enumerate(scenes):
        _refuse_same_place(scene, scenes[:number])
        _refuse_tested(scene, tests)
    by_difficulty = sorted((_localized(s), s.name) for s in scenes) if validate is None else []
    chosen = by_difficulty[len(by_difficulty) // 2][1] if validate is None else validate
    return Split(tuple(s for s in scenes if s.name != chosen), next(s for s in scenes if s.name == chosen))


def _localized(scene: SceneFolder) -> float:
    """Return the share of a scene's candidate views that localize."""
    shards = [read_scene_shard(scene.folder, scene.entry, w) for w in scene.entry.waypoints]
    return float(np.mean(np.concatenate([s.label[_candidates(s, scene)] for s in shards])))


def _candidates(shard: Shard, scene: SceneFolder) -> NDArray[np.int64]:
    """Return the indices of the views among which policies choose."""
    allowed = scene.rules.candidates.kinds
    return np.array([i for i, kind in enumerate(shard.kinds) if kind in allowed], dtype=np.int64)


def _refuse_same_place(scene: SceneFolder, others: Sequence[SceneFolder]) -> None:
    for other in others:
        if scene.entry.map_digest == other.entry.map_digest:
            raise TrainingError(
                f"scenes {other.name!r} of {other.folder} and {scene.name!r} of {scene.folder} have the same map; "
                "expected different places, or training and validation would share views",
                hint="leave one of them away",
            )


def _refuse_tested(scene: SceneFolder, tests: Sequence[Path]) -> None:
    for path in tests:
        names = read_dataset(path).scenes
        maps_there = {read_scene(path, n).map_digest for n in names if scene_path(path, n).is_file()}
        if scene.name in names or scene.entry.map_digest in maps_there:
            raise TrainingError(
                f"{scene.folder}: its scene {scene.name!r} is one of the test scenes in {path}; expected others",
                hint="train and validate on scenes that no test will see",
            )
