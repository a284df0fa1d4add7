"""Candidate views at the prior, and which landmarks each of them would see: map and geometry only, never an image."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import ReplayError
from fieldkit.frames import Pose
from fieldkit.protocol import CandidateRules
from fieldkit.surface import RayCaster
from fieldkit.types import Candidates, LandmarkStatistics, PlanView, Prior, Recording, SceneMap, Visit

Array = NDArray[np.float64]
PLAN_LANDMARKS = 6000
_SAME_PLACE_M = 1e-6
# Cells per side of the map of where mapping images saw a landmark, as in the paper
HEAT_CELLS = 8


@dataclasses.dataclass(frozen=True)
class Visibility:
    """What each of v candidates sees: landmark indices int32[k], and their positions in its camera f64[k, 3] in m."""

    landmarks: tuple[NDArray[np.int32], ...]
    x_in_cam: tuple[Array, ...]


def landmark_statistics(scene_map: SceneMap) -> LandmarkStatistics:
    """Collect from where mapping saw each landmark.

    Angles to the principal axis are in the camera frame (the paper's features). ``mean_direction`` and ``spread_rad``
    are directions at the landmark (Davison and Murray, 2002, section 4.2), which the policy "angle" uses.
    """
    n = len(scene_map.xyz)
    landmark, image = scene_map.observation_landmark, scene_map.observation_image
    centres = np.array([p.translation for p in scene_map.map_from_image]).reshape(-1, 3)
    axes = np.array([p.rotation.as_matrix()[:, 2] for p in scene_map.map_from_image]).reshape(-1, 3)
    ray = scene_map.xyz[landmark] - centres[image]
    distance = np.linalg.norm(ray, axis=1)
    ray = ray / np.maximum(distance, 1e-9)[:, None]
    angle = np.arccos(np.clip(np.sum(ray * axes[image], axis=1), -1.0, 1.0))
    mean = np.zeros((n, 3))
    np.add.at(mean, landmark, -ray)
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-9)[:, None]
    deviation = np.arccos(np.clip(np.sum(-ray * mean[landmark], axis=1), -1.0, 1.0))
    return LandmarkStatistics(
        min_distance_m=_extreme(np.minimum, landmark, distance, n),
        max_distance_m=_extreme(np.maximum, landmark, distance, n),
        min_angle_rad=_extreme(np.minimum, landmark, angle, n),
        max_angle_rad=_extreme(np.maximum, landmark, angle, n),
        mean_direction=mean,
        spread_rad=_extreme(np.maximum, landmark, deviation, n),
        n_observations=np.bincount(landmark, minlength=n).astype(np.int32),
    )


def landmark_heat_maps(
    scene_map: SceneMap, landmarks: NDArray[np.integer], *, cells: int = HEAT_CELLS
) -> NDArray[np.float32]:
    """Return f32[k, cells, cells] for some landmarks (k): where in their images the mapping cameras saw each.

    Rows go down the image and columns to the right; every map sums to 1. Of all landmarks of a large map they are many
    gigabytes: ask for those that are needed.
    """
    wanted = np.asarray(landmarks, dtype=np.int64)
    row = np.full(len(scene_map.xyz), -1, dtype=np.int64)
    unique, first = np.unique(wanted, return_inverse=True)
    row[unique] = np.arange(len(unique))
    owner = row[scene_map.observation_landmark]
    seen = np.flatnonzero(owner >= 0)
    sizes = np.array([(c.width, c.height) for c in scene_map.image_cameras], dtype=np.float64).reshape(-1, 2)
    place = scene_map.observation_px[seen] / sizes[scene_map.observation_image[seen]]
    column, line = np.clip((place * cells).astype(np.int64), 0, cells - 1).T
    index = (owner[seen] * cells + line) * cells + column
    counts = np.bincount(index, minlength=len(unique) * cells**2).reshape(len(unique), cells, cells)
    shares = counts / np.maximum(counts.sum(axis=(1, 2), keepdims=True), 1)
    return np.asarray(shares.astype(np.float32)[first.ravel()])


def _extreme(ufunc: np.ufunc, landmark: NDArray[np.int32], values: Array, n: int) -> Array:
    result = np.full(n, np.inf if ufunc is np.minimum else -np.inf)
    ufunc.at(result, landmark, values)
    return result


def recorded_candidates(
    recording: Recording,
    visit: Visit,
    prior: Prior,
    *,
    rules: CandidateRules,
    forward_in_map: Array | None = None,
) -> Candidates:
    """Place the recorded views of a visit at the prior: map_from_cam = prior * body motion since then * kinematics.

    Views of kind "truth" and views that tf does not reach are left out. Views whose kind is not in ``rules.kinds``
    stay in the list, for the policies that name them (stowed, forward), but are not allowed to the others.
    Raises ReplayError when no view is left, or when the views were taken with cameras that differ.
    """
    views = [v for v in visit.views if v.kind != "truth" and v.frame.body_from_cam is not None]
    if not any(v.kind in rules.kinds for v in views):
        raise ReplayError(
            f"{recording.path}: visit {visit.id} has no view of kind {' or '.join(rules.kinds)} that tf reaches",
            hint="record a sweep at the waypoint, or change candidates.kinds in the protocol",
        )
    cameras = {v.frame.camera for v in views}
    if len(cameras) > 1:
        raise ReplayError(
            f"{recording.path}: the views of visit {visit.id} have {len(cameras)} different cameras; expected one",
            hint="keep one resolution and calibration per recording",
        )
    odom_from_prior = recording.odometry.at(prior.t_ns)
    poses = []
    for view in views:
        moved = odom_from_prior.inv() * recording.odometry.at(view.frame.t_ns)
        assert view.frame.body_from_cam is not None
        poses.append(prior.map_from_body * moved * view.frame.body_from_cam)
    return Candidates(
        visit=visit.id,
        view_ids=tuple(v.id for v in views),
        kinds=tuple(v.kind for v in views),
        map_from_cam=tuple(poses),
        camera=cameras.pop(),
        allowed=np.array([v.kind in rules.kinds for v in views]),
        forward_in_map=forward_in_map,
    )


def forward_directions(visits: Sequence[Visit], priors: Sequence[Prior], *, rules: CandidateRules) -> list[Array]:
    """Return for each visit the unit direction (3,) in the map in which the robot goes on.

    It points from the visit's prior to the next waypoint's, with the protocol's pitch. The last waypoint keeps the
    direction in which the path arrived ("previous") or takes the body's x axis ("body").
    """
    position = {p.visit: p.map_from_body.translation for p in priors}
    before = {v.next: v.id for v in visits if v.next is not None}
    result = []
    for visit, prior in zip(visits, priors, strict=True):
        here, step = position[visit.id], np.zeros(3)
        if visit.next in position:
            step = position[visit.next] - here
        elif rules.last_forward == "previous" and before.get(visit.id) in position:
            step = here - position[before[visit.id]]
        step[2] = 0.0
        if np.linalg.norm(step) < 1e-3:
            step = prior.map_from_body.rotation.as_matrix()[:, 0] * (1.0, 1.0, 0.0)
        level = step / np.linalg.norm(step)
        pitch = np.radians(rules.forward_pitch_deg)
        result.append(np.cos(pitch) * level + np.sin(pitch) * np.array([0.0, 0.0, 1.0]))
    return result


def visibility(
    scene_map: SceneMap,
    candidates: Candidates,
    *,
    rules: CandidateRules,
    rays: RayCaster | None = None,
    tolerance_m: float = 0.0,
) -> Visibility:
    """Tell which landmarks each candidate sees: inside the image and the distance limits, and not behind the surface.

    ``rays`` switches the occlusion filter on: a landmark is hidden when the surface is hit more than ``tolerance_m``
    before it. One ray is cast per landmark and distinct camera centre. At a centre inside a closed surface every
    landmark is hidden, all utilities tie, and the choice is the same as random's.
    """
    inside = [_in_view(scene_map.xyz, pose, candidates, rules) for pose in candidates.map_from_cam]
    if rays is not None:
        inside = _drop_hidden(scene_map.xyz, inside, candidates.map_from_cam, rays, tolerance_m)
    x_in_cam = [pose.inv().apply(scene_map.xyz[i]) for pose, i in zip(candidates.map_from_cam, inside, strict=True)]
    return Visibility(tuple(inside), tuple(x_in_cam))


def _in_view(xyz: Array, map_from_cam: Pose, candidates: Candidates, rules: CandidateRules) -> NDArray[np.int32]:
    x_in_cam = map_from_cam.inv().apply(xyz)
    distance = np.linalg.norm(x_in_cam, axis=1)
    near = np.flatnonzero((distance >= rules.min_distance_m) & (distance <= rules.max_distance_m))
    _, in_image = candidates.camera.project(x_in_cam[near])
    return near[in_image].astype(np.int32)


def _drop_hidden(
    xyz: Array,
    inside: Sequence[NDArray[np.int32]],
    poses: Sequence[Pose],
    rays: RayCaster,
    tolerance_m: float,
) -> list[NDArray[np.int32]]:
    groups: dict[tuple[int, ...], list[int]] = {}
    for index, pose in enumerate(poses):
        # Centres that differ by rounding only, far below a voxel, are one
        place = np.rint(pose.translation / _SAME_PLACE_M).astype(np.int64)
        groups.setdefault(tuple(place.tolist()), []).append(index)
    result = list(inside)
    for members in groups.values():
        targets = np.unique(np.concatenate([inside[m] for m in members]))
        if not len(targets):
            continue
        seen = rays.visible(poses[members[0]].translation, xyz[targets], tolerance_m=tolerance_m)
        visible = np.zeros(len(xyz), dtype=bool)
        visible[targets[seen]] = True
        for m in members:
            result[m] = inside[m][visible[inside[m]]]
    return result


def plan_view(scene_map: SceneMap, *, seed: int) -> PlanView:
    """Thin a map to what is drawn from above: up to 6000 landmarks, chosen by the seed, and all mapping cameras."""
    rng = np.random.default_rng(seed)
    keep = np.sort(rng.permutation(len(scene_map.xyz))[:PLAN_LANDMARKS])
    cameras = np.array([p.translation for p in scene_map.map_from_image], dtype=np.float32).reshape(-1, 3)
    return PlanView(scene_map.xyz[keep].astype(np.float32), cameras)
