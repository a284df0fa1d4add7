"""One waypoint of a dataset: its views taken, localized, labelled, and what each would see from the prior."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from fieldkit.dataset.source import SourceView, SourceWaypoint, ViewSource
from fieldkit.errors import SurfaceError
from fieldkit.frames import Pose, pose_error
from fieldkit.localize import Localizer, Query
from fieldkit.maps import Gauge
from fieldkit.scores import inside
from fieldkit.store.datasets import DatasetRules, Shard, pose_row
from fieldkit.surface import RayCaster
from fieldkit.types import Array, Candidates, Estimate, SceneMap
from fieldkit.views import visibility


@dataclasses.dataclass(frozen=True)
class _Seen:
    """What all views see, one after the other."""

    starts: NDArray[np.int64]
    landmark: NDArray[np.int32]
    uv_px: NDArray[np.float32]
    distance_m: NDArray[np.float32]
    angle_rad: NDArray[np.float32]
    occluded: NDArray[np.bool_]


class Studio:
    """A scene with its map, ready to turn waypoints into shards."""

    def __init__(self, source: ViewSource, scene_map: SceneMap, gauge: Gauge, rules: DatasetRules) -> None:
        if scene_map.surface is None:
            raise SurfaceError(f"{scene_map.path}: has no surface; expected one, to tell hidden landmarks")
        self._source, self._map, self._rules = source, scene_map, rules
        self._map_from_world = gauge.world_from_map.inv()
        self._localizer = Localizer(scene_map, rules.localizer, seed=rules.seed)
        self._rays = RayCaster(scene_map.surface)
        self._tolerance_m = rules.tolerance_voxels * scene_map.surface.voxel_m

    def shard(self, waypoint: SourceWaypoint, *, key: str) -> Shard:
        """Take, localize and label all views of a waypoint."""
        views = waypoint.views
        prior = self._map_from_world * waypoint.world_from_prior
        candidates = Candidates(
            visit=waypoint.id,
            view_ids=tuple(v.id for v in views),
            kinds=tuple(v.kind for v in views),
            map_from_cam=tuple(prior * v.body_from_cam for v in views),
            camera=waypoint.camera,
            allowed=np.array([v.kind in self._rules.candidates.kinds for v in views]),
        )
        seen = self._seen(candidates)
        truths = [self._map_from_world * v.world_from_cam for v in views]
        chosen = _repeated(len(views), self._rules, waypoint)
        estimates: list[Estimate] = []
        again: list[tuple[int, int, tuple[float, float]]] = []
        for i, view in enumerate(views):
            estimates.append(self._localize(waypoint, view, repeat=0))
            for number in range(1, self._rules.repeats + 1 if i in chosen else 1):
                estimate = self._localize(waypoint, view, repeat=number)
                again.append((i, number, pose_error(estimate.map_from_cam, truths[i])))
        errors = [pose_error(e.map_from_cam, truth) for e, truth in zip(estimates, truths, strict=True)]
        return Shard(
            scene=self._source.name,
            waypoint=waypoint.id,
            next=waypoint.next,
            key=key,
            camera=waypoint.camera,
            view_ids=candidates.view_ids,
            kinds=candidates.kinds,
            status=tuple(e.status for e in estimates),
            prior=pose_row(prior),
            prior_covariance=np.asarray(waypoint.prior_covariance, dtype=np.float64),
            body=pose_row(self._map_from_world * waypoint.world_from_body),
            candidate=np.stack([pose_row(p) for p in candidates.map_from_cam]),
            body_from_cam=np.stack([pose_row(v.body_from_cam) for v in views]),
            truth=np.stack([pose_row(t) for t in truths]),
            estimate=np.stack([_row(e.map_from_cam) for e in estimates]),
            covariance=np.stack([np.full((6, 6), np.nan) if e.covariance is None else e.covariance for e in estimates]),
            matches=np.array([e.n_matches for e in estimates], dtype=np.int32),
            inliers=np.array([e.n_inliers for e in estimates], dtype=np.int32),
            confidence=np.array([e.confidence for e in estimates]),
            error=np.array(errors),
            label=np.array([inside(e, self._rules.label) for e in errors]),
            **vars(seen),
            repeat_view=np.array([i for i, _, _ in again], dtype=np.int32),
            repeat_number=np.array([n for _, n, _ in again], dtype=np.int32),
            repeat_error=np.array([e for _, _, e in again], dtype=np.float64).reshape(-1, 2),
            repeat_label=np.array([inside(e, self._rules.label) for _, _, e in again], dtype=bool),
        )

    def _localize(self, waypoint: SourceWaypoint, view: SourceView, *, repeat: int) -> Estimate:
        return self._localizer.localize_query(Query(self._source.shoot(waypoint, view, repeat=repeat), waypoint.camera))

    def _seen(self, candidates: Candidates) -> _Seen:
        rules = self._rules.candidates
        every = visibility(self._map, candidates, rules=rules)
        free = visibility(self._map, candidates, rules=rules, rays=self._rays, tolerance_m=self._tolerance_m)
        x_in_cam = np.concatenate(every.x_in_cam)
        pixels, _ = candidates.camera.project(x_in_cam)
        distance = np.linalg.norm(x_in_cam, axis=1)
        angle = np.arccos(np.clip(x_in_cam[:, 2] / np.maximum(distance, 1e-9), -1.0, 1.0))
        pairs = zip(every.landmarks, free.landmarks, strict=True)
        return _Seen(
            starts=np.cumsum([0, *(len(i) for i in every.landmarks)], dtype=np.int64),
            landmark=np.concatenate(every.landmarks).astype(np.int32),
            uv_px=pixels.astype(np.float32),
            distance_m=distance.astype(np.float32),
            angle_rad=angle.astype(np.float32),
            occluded=np.concatenate([~np.isin(a, b, assume_unique=True) for a, b in pairs]),
        )


def _row(map_from_cam: Pose | None) -> Array:
    return np.full(7, np.nan) if map_from_cam is None else pose_row(map_from_cam)


def _repeated(count: int, rules: DatasetRules, waypoint: SourceWaypoint) -> set[int]:
    """Return the views that are localized again: the same for the same waypoint, whatever else is done."""
    if not rules.repeats:
        return set()
    rng = np.random.default_rng([rules.seed, *waypoint.id.encode()])
    share = rules.repeat_share * count
    number = int(share) + int(rng.random() < share % 1.0)
    return {int(i) for i in rng.permutation(count)[:number]}
