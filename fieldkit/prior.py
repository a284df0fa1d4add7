"""Where the robot believes it is at a waypoint: the start tags it saw, then odometry."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fieldkit.errors import FrameError, PriorError, TagError
from fieldkit.frames import Array, Pose, compose_covariance
from fieldkit.odometry import ClockOffset, PlacedTag, clock_offset, travel
from fieldkit.protocol import ArmNoise, OdometryNoise
from fieldkit.tags import body_sightings, frames_between, locate_body, placed_tags
from fieldkit.types import Frame, Prior, Recording, Start, TagMap, TagPose, Visit

# Standard deviations of a reference topic's pose where it gives the start and states none
REFERENCE_COVARIANCE: Array = np.diag([math.radians(0.2) ** 2] * 3 + [0.005**2] * 3)
# Images that are searched for tags in motion, at most
MAX_MOVING = 120
MOVING_M_S, MOVING_RAD_S = 0.05, math.radians(5.0)


def estimate_prior(
    recording: Recording, visit: Visit, tags: TagMap, *, noise: OdometryNoise, arm: ArmNoise | None = None
) -> Prior:
    """Estimate map_from_body at the beginning of a visit: all sightings of the start tags, fused, then odometry.

    The start is the last one that names this visit, else the last one before it that names none. Other tags of the
    file that stand in one place for all visits join in where they are seen from the start and agree with its tag; one
    that does not is left out and named in ``notes``. A start without a tag takes its pose from the recording's
    reference topic. Where the interval has no image, detections that were recorded as a topic are used. The covariance
    has the tags', the corners', the arm's and the odometry's noise, and the size of jumps in odometry; a warp of the
    map is not in it. Raises PriorError, also where the sightings contradict the kinematics.
    """
    what = f"{recording.path}: visit {visit.id}"
    start = _start(recording, visit, what)
    if start.tag_id is None:
        t_ns, map_from_start, covariance, count = _from_reference(recording, start, what)
        notes: tuple[str, ...] = ()
    else:
        fix = _from_tags(recording, visit, start, tags, what=what, noise=noise, arm=arm or ArmNoise())
        t_ns, map_from_start, covariance, count, notes = fix
    try:
        start_from_body, growth, travelled = travel(
            recording.odometry, t_ns, visit.t_begin_ns, noise=noise, faults=recording.odometry_faults
        )
    except FrameError as error:
        raise PriorError(f"{what}: no odometry from its start: {error.message}", hint="check the odometry") from error
    return Prior(
        visit.id,
        map_from_start * start_from_body,
        compose_covariance(covariance, start_from_body, growth),
        visit.t_begin_ns,
        travelled,
        count,
        notes,
    )


def odometry_clock(recording: Recording, tags: TagMap) -> ClockOffset | None:
    """Estimate the offset of odometry's stamps against the images' from standing tags that were seen in motion.

    Up to 120 images and 240 messages of recorded detections from moments in which odometry moves are searched for the
    tags that stand in one place for all visits. None where too few of them show one.
    """
    standing = _standing(tags)
    moving = [f for f in (*recording.frames, *recording.tag_frames) if _moves(recording, f.t_ns)]
    images, messages = [f for f in moving if f.tags is None], [f for f in moving if f.tags]
    chosen = [*_spread(images, MAX_MOVING), *_spread(messages, 2 * MAX_MOVING)]
    found: list[PlacedTag] = placed_tags(chosen, standing)
    return clock_offset(recording.odometry, found)


def _spread(frames: Sequence[Frame], count: int) -> list[Frame]:
    """Return up to so many frames, evenly spread."""
    return [frames[i] for i in np.linspace(0, len(frames) - 1, min(len(frames), count)).astype(int)]


def _moves(recording: Recording, t_ns: int) -> bool:
    half = 250_000_000
    try:
        moved = recording.odometry.at(t_ns - half).inv() * recording.odometry.at(t_ns + half)
    except FrameError:
        return False
    seconds = 2 * half / 1e9
    fast = float(np.linalg.norm(moved.translation)) > MOVING_M_S * seconds
    return fast or float(moved.rotation.magnitude()) > MOVING_RAD_S * seconds


def _standing(tags: TagMap) -> list[TagPose]:
    """Return the tags that stand in one place for all visits, but those that failed."""
    carried = {t.id for t in tags.tags if t.visit is not None}
    return [t for t in tags.tags if t.id not in carried and t.verdict != "fail"]


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
        map_from_body = recording.reference.at(start.t_begin_ns)
    except FrameError as error:
        raise PriorError(f"{what}: no reference pose at its start: {error.message}") from error
    stated = recording.reference_covariance_at(start.t_begin_ns)
    return start.t_begin_ns, map_from_body, REFERENCE_COVARIANCE if stated is None else stated, 0


def _from_tags(
    recording: Recording, visit: Visit, start: Start, tags: TagMap, *, what: str, noise: OdometryNoise, arm: ArmNoise
) -> tuple[int, Pose, Array, int, tuple[str, ...]]:
    assert start.tag_id is not None
    tag = tags.find(start.tag_id, visit=visit.id)
    if tag is None:
        known = sorted({t.id for t in tags.tags})
        raise PriorError(
            f"{what}: start tag {start.tag_id} is not in {tags.path or 'the tag file'}; it has tags {known}",
            hint="photograph and calibrate this tag, or correct the start's tag_id",
        )
    others = [t for t in _standing(tags) if t.id != tag.id]
    frames = frames_between(recording, start.t_begin_ns, start.t_end_ns)
    try:
        found = body_sightings(
            frames,
            [tag, *others],
            odometry=recording.odometry,
            noise=noise,
            faults=recording.odometry_faults,
        )
        fix = locate_body(found, tag, arm=arm, others=others) if found.of(tag) else None
    except TagError as error:
        raise PriorError(f"{what}: start tag {tag.id}: {error.message}", hint=error.hint) from error
    if fix is None:
        raise PriorError(
            f"{what}: start tag {tag.id} ({tag.family}) is never seen from {start.t_begin_ns} to {start.t_end_ns} ns: "
            f"{found.explanation}",
            hint="turn the arm camera to the tag at the start, or correct the interval, id or family",
        )
    notes = tuple(f"at the start {note}; it is left out" for note in fix.left_out)
    return fix.t_ns, fix.map_from_body, fix.covariance, sum(fix.used.values()), notes
