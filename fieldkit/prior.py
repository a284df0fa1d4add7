"""Where the robot believes it is at a waypoint: the start tag it saw, then odometry."""

from __future__ import annotations

import math

import numpy as np

from fieldkit.errors import FrameError, PriorError, TagError
from fieldkit.frames import Array, Pose, Trajectory, compose_covariance
from fieldkit.protocol import OdometryNoise
from fieldkit.tags import body_in_map, body_sightings, fuse_body_sightings
from fieldkit.types import Prior, Recording, Start, TagMap, Visit

# Standard deviations of a reference topic's pose where it gives the start
REFERENCE_COVARIANCE: Array = np.diag([math.radians(0.2) ** 2] * 3 + [0.005**2] * 3)
# Odometry that moves less than this between two samples stands: its jitter is no path
STEP_M, STEP_RAD = 0.05, math.radians(5.0)


def estimate_prior(recording: Recording, visit: Visit, tags: TagMap, *, noise: OdometryNoise) -> Prior:
    """Estimate map_from_body at the beginning of a visit: all sightings of the start tag, fused, then odometry.

    The start is the last one that names this visit, else the last one before it that names none. A start without a
    tag takes its pose from the recording's reference topic. The covariance has the tag's, the sightings' and the
    odometry's noise; the hand-to-camera calibration and a warp of the map are not in it. Raises PriorError, also where
    the sightings contradict the kinematics.
    """
    what = f"{recording.path}: visit {visit.id}"
    start = _start(recording, visit, what)
    if start.tag_id is None:
        t_ns, map_from_start, covariance, count = _from_reference(recording, start, what)
    else:
        t_ns, map_from_start, covariance, count = _from_tag(recording, visit, start, tags, what)
    try:
        start_from_body, growth, travelled = travel(recording.odometry, t_ns, visit.t_begin_ns, noise=noise)
    except FrameError as error:
        raise PriorError(f"{what}: no odometry from its start: {error.message}", hint="check the odometry") from error
    return Prior(
        visit.id,
        map_from_start * start_from_body,
        compose_covariance(covariance, start_from_body, growth),
        visit.t_begin_ns,
        travelled,
        count,
    )


def travel(odometry: Trajectory, t_from_ns: int, t_to_ns: int, *, noise: OdometryNoise) -> tuple[Pose, Array, float]:
    """Return from_body_to_body between two times by odometry, its 6x6 covariance, and the length of the path in m.

    Drift is taken as constant along the path, so standard deviations grow in proportion to it: position by
    ``position_per_m``, yaw by ``yaw_deg_per_m`` and ``yaw_deg_per_turn_deg``; a yaw error moves everything after it.
    Raises FrameError when the samples do not reach or have a gap.
    """
    path = [odometry.at(t_from_ns), *_between(odometry, t_from_ns, t_to_ns), odometry.at(t_to_ns)]
    anchors = [path[0]]
    steps: list[tuple[float, float]] = []
    for index, pose in enumerate(path[1:], start=1):
        moved = anchors[-1].inv() * pose
        length, turn = float(np.linalg.norm(moved.translation)), float(moved.rotation.magnitude())
        if length > STEP_M or turn > STEP_RAD or index == len(path) - 1:
            anchors.append(pose)
            steps.append((length, turn))
    per_m, per_turn = np.zeros(6), np.zeros(6)
    for anchor, (length, turn) in zip(anchors[1:], steps, strict=True):
        end_from_anchor = path[-1].inv() * anchor
        axis = end_from_anchor.rotation.apply([0.0, 0.0, 1.0])
        effect = np.concatenate([axis, np.cross(end_from_anchor.translation, axis)])
        per_m += length * effect
        per_turn += turn * effect
    travelled = sum(length for length, _ in steps)
    covariance = math.radians(noise.yaw_deg_per_m) ** 2 * np.outer(per_m, per_m)
    covariance += noise.yaw_deg_per_turn_deg**2 * np.outer(per_turn, per_turn)
    covariance[3:, 3:] += (noise.position_per_m * travelled) ** 2 * np.eye(3)
    return path[0].inv() * path[-1], covariance, travelled


def _between(odometry: Trajectory, t_from_ns: int, t_to_ns: int) -> list[Pose]:
    first, last = sorted((t_from_ns, t_to_ns))
    times = odometry.t_ns
    inside = np.flatnonzero((times > first) & (times < last))
    gaps = np.diff([first, *times[inside].tolist(), last])
    if len(gaps) and int(gaps.max()) > odometry.max_gap_ns:
        raise FrameError(
            f"{odometry.parent}_from_{odometry.child} has a gap of {gaps.max() / 1e9:.2f} s between {first} and "
            f"{last} ns; at most {odometry.max_gap_ns / 1e9:.2f} s is bridged"
        )
    found = [odometry.poses[int(i)] for i in inside]
    return found if t_from_ns <= t_to_ns else found[::-1]


def _start(recording: Recording, visit: Visit, what: str) -> Start:
    before = sorted((s for s in recording.starts if s.t_begin_ns <= visit.t_begin_ns), key=lambda s: s.t_begin_ns)
    own = [s for s in before if s.visit == visit.id]
    shared = [s for s in before if s.visit is None]
    if not own and not shared:
        raise PriorError(
            f"{what}: no start before it; expected start_begin and start_end events or a [[start]] in session.toml",
            hint="say when the robot stood in front of its start tag",
        )
    return (own or shared)[-1]


def _from_reference(recording: Recording, start: Start, what: str) -> tuple[int, Pose, Array, int]:
    if recording.reference is None:
        raise PriorError(
            f"{what}: its start names no tag and the recording has no reference topic; expected one of them"
        )
    try:
        return start.t_begin_ns, recording.reference.at(start.t_begin_ns), REFERENCE_COVARIANCE, 0
    except FrameError as error:
        raise PriorError(f"{what}: no reference pose at its start: {error.message}") from error


def _from_tag(
    recording: Recording, visit: Visit, start: Start, tags: TagMap, what: str
) -> tuple[int, Pose, Array, int]:
    assert start.tag_id is not None
    tag = tags.find(start.tag_id, visit=visit.id)
    if tag is None:
        known = sorted({t.id for t in tags.tags})
        raise PriorError(
            f"{what}: start tag {start.tag_id} is not in {tags.path or 'the tag file'}; it has tags {known}",
            hint="photograph and calibrate this tag, or correct the start's tag_id",
        )
    frames = [f for f in recording.frames if start.t_begin_ns <= f.t_ns <= start.t_end_ns]
    try:
        found = body_sightings(frames, tag, odometry=recording.odometry)
        fix = fuse_body_sightings(found.sightings, tag) if found.sightings else None
    except TagError as error:
        raise PriorError(f"{what}: start tag {tag.id}: {error.message}", hint=error.hint) from error
    if fix is None:
        raise PriorError(
            f"{what}: start tag {tag.id} ({tag.family}) is never seen from {start.t_begin_ns} to {start.t_end_ns} ns: "
            f"{found.explanation}",
            hint="turn the arm camera to the tag at the start, or correct the interval, id or family",
        )
    map_from_body, covariance = body_in_map(fix, tag)
    return found.t_ns, map_from_body, covariance, sum(fix.used)
