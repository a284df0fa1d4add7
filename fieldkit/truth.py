"""The true camera pose of every view of a visit: the tripod tag and kinematics, or a pose topic."""

from __future__ import annotations

import math

import numpy as np

from fieldkit.errors import FrameError, TagError, TruthError
from fieldkit.frames import Array, compose_covariance
from fieldkit.tags import ARM_COVARIANCE, body_in_map, body_sightings, fuse_body_sightings
from fieldkit.types import Frame, Recording, TagMap, TagPose, Truth, Visit

# Standard deviations of a pose topic that states none: 5 mm and 0.2 deg per axis
TOPIC_COVARIANCE: Array = np.diag([math.radians(0.2) ** 2] * 3 + [0.005**2] * 3)
MAX_IMAGES = 240


def estimate_truths(
    recording: Recording, visit: Visit, tags: TagMap, *, topic_covariance: Array = TOPIC_COVARIANCE
) -> dict[str, Truth]:
    """Estimate the true map_from_cam of the views of a visit, by view id; a view without kinematics is left out.

    With a reference topic it gives the body. Otherwise the images of the views, and images of the visit's interval up
    to MAX_IMAGES in all, are searched for its tripod tag and fused into map_from_body; motion of the body within the
    visit is taken from odometry deltas. Neither the prior nor the absolute odometry takes part. The covariance has
    the tag's, the corners' and the arm's noise; errors that all images share (hand-to-camera calibration) and a warp
    of the map are not in it. Raises TruthError, also where the images contradict the kinematics.
    """
    what = f"{recording.path}: visit {visit.id}"
    if recording.reference is not None:
        return _from_topic(recording, visit, topic_covariance, what)
    return _from_tag(recording, visit, _tag(visit, tags, what), what)


def _tag(visit: Visit, tags: TagMap, what: str) -> TagPose:
    if visit.truth_tag_id is None:
        raise TruthError(
            f"{what}: names no tripod tag and the recording has no reference topic; expected tag_id in visit_begin",
            hint="add truth_tag_id in session.toml",
        )
    tag = tags.find(visit.truth_tag_id, visit=visit.id)
    if tag is None:
        known = sorted({(t.id, t.visit or "every visit") for t in tags.tags})
        listed = ", ".join(f"{tag_id} ({where})" for tag_id, where in known) or "no tags"
        raise TruthError(
            f"{what}: tripod tag {visit.truth_tag_id} is not in {tags.path or 'the tag file'} for this visit; "
            f"it has {listed}",
            hint="photograph and calibrate this tag, or correct the visit's tag_id",
        )
    return tag


def _from_tag(recording: Recording, visit: Visit, tag: TagPose, what: str) -> dict[str, Truth]:
    views = sorted(visit.views, key=lambda v: v.frame.t_ns)
    try:
        found = body_sightings(_frames(recording, visit), tag, odometry=recording.odometry, max_frames=MAX_IMAGES)
        fix = fuse_body_sightings(found.sightings, tag) if found.sightings else None
    except TagError as error:
        raise TruthError(f"{what}: tripod tag {tag.id}: {error.message}", hint=error.hint) from error
    if fix is None:
        raise TruthError(
            f"{what}: tripod tag {tag.id} ({tag.family}) is never seen: {found.explanation}",
            hint="turn the arm camera to the tag at every waypoint, or correct its id or family",
        )
    map_from_ref, covariance = body_in_map(fix, tag)
    ref_from_odom = recording.odometry.at(found.t_ns).inv()
    truths = {}
    for view in views:
        try:
            ref_from_body = ref_from_odom * recording.odometry.at(view.frame.t_ns)
        except FrameError:
            continue
        if view.frame.body_from_cam is not None:
            ref_from_cam = ref_from_body * view.frame.body_from_cam
            arm = ARM_COVARIANCE * fix.scale**2
            truths[view.id] = Truth(
                visit.id,
                view.id,
                map_from_ref * ref_from_cam,
                view.frame.body_from_cam,
                compose_covariance(covariance, ref_from_cam, arm),
                "tag",
            )
    return truths


def _frames(recording: Recording, visit: Visit) -> list[Frame]:
    """Return the frames to search: those of the views, and from the visit's interval up to MAX_IMAGES in all."""
    # Views first: the arm may turn to the tag for no more than one announced image
    chosen = {v.frame.t_ns: v.frame for v in visit.views}
    between = [f for f in recording.frames if visit.t_begin_ns <= f.t_ns <= visit.t_end_ns and f.t_ns not in chosen]
    room = min(max(MAX_IMAGES - len(chosen), 0), len(between))
    chosen |= {between[i].t_ns: between[i] for i in np.linspace(0, len(between) - 1, room).astype(int)}
    return [chosen[t_ns] for t_ns in sorted(chosen)]


def _from_topic(recording: Recording, visit: Visit, body_covariance: Array, what: str) -> dict[str, Truth]:
    assert recording.reference is not None
    truths, reason = {}, "no view"
    for view in visit.views:
        body_from_cam = view.frame.body_from_cam
        if body_from_cam is None:
            reason = f"view {view.id} has no transform from body to camera"
            continue
        try:
            map_from_body = recording.reference.at(view.frame.t_ns)
        except FrameError as error:
            reason = error.message
            continue
        covariance = compose_covariance(body_covariance, body_from_cam)
        truths[view.id] = Truth(visit.id, view.id, map_from_body * body_from_cam, body_from_cam, covariance, "topic")
    if not truths:
        raise TruthError(f"{what}: no view has a pose of the reference topic: {reason}", hint="check its stamps")
    return truths
