"""Candidate views at the prior, and the direction in which the robot goes on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import ReplayError
from fieldkit.protocol import CandidateRules
from fieldkit.types import Candidates, Prior, Recording, Visit

Array = NDArray[np.float64]


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
