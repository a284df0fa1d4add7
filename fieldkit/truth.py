"""The true camera pose of every view of a visit: the tripod tag and kinematics, or a pose topic."""

from __future__ import annotations

import math

import numpy as np

from fieldkit.errors import FrameError, TagError, TruthError
from fieldkit.frames import Array, compose_covariance
from fieldkit.protocol import ArmNoise, OdometryNoise
from fieldkit.tags import body_sightings, frames_between, hand_covariance, locate_body
from fieldkit.types import Frame, Recording, TagMap, TagPose, Truth, Visit

# Standard deviations of a pose topic that states none: 5 mm and 0.2 deg per axis
TOPIC_COVARIANCE: Array = np.diag([math.radians(0.2) ** 2] * 3 + [0.005**2] * 3)
MAX_IMAGES = 240


def estimate_truths(
    recording: Recording,
    visit: Visit,
    tags: TagMap,
    *,
    noise: OdometryNoise | None = None,
    arm: ArmNoise | None = None,
    topic_covariance: Array = TOPIC_COVARIANCE,
) -> dict[str, Truth]:
    """Estimate the true map_from_cam of the views of a visit, by view id; a view without kinematics is left out.

    With a reference topic it gives the body, with the covariance that it states, else ``topic_covariance``. Otherwise
    the images of the views, and images of the visit's interval up to MAX_IMAGES in all (recorded detections where there
    is no image), are searched for its tripod tag and fused into the body and the error of the camera in the hand, which
    all images share; motion of the body within the visit is taken from odometry deltas. Neither the prior nor the
    absolute odometry takes part. The covariance of a view has the tag's, the corners', the arm's and the deltas' noise
    and what is not known of the camera in the hand; a warp of the map is not in it. Raises TruthError, also where the
    images contradict the kinematics.
    """
    what = f"{recording.path}: visit {visit.id}"
    arm = arm or ArmNoise()
    if recording.reference is not None:
        return _from_topic(recording, visit, topic_covariance, hand=_hand(visit, arm), what=what)
    return _from_tag(recording, visit, _tag(visit, tags, what), what=what, noise=noise or OdometryNoise(), arm=arm)


def _hand(visit: Visit, arm: ArmNoise) -> Array:
    """Return the 6x6 covariance of body_from_cam: none where the camera is fixed, not held by an arm."""
    poses = [v.frame.body_from_cam.as_matrix() for v in visit.views if v.frame.body_from_cam is not None]
    if len(poses) > 1 and all(np.allclose(p, poses[0], atol=1e-9) for p in poses):
        return np.zeros((6, 6))
    return hand_covariance(arm)


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


def _from_tag(
    recording: Recording, visit: Visit, tag: TagPose, *, what: str, noise: OdometryNoise, arm: ArmNoise
) -> dict[str, Truth]:
    try:
        found = body_sightings(
            _frames(recording, visit),
            [tag],
            odometry=recording.odometry,
            noise=noise,
            faults=recording.odometry_faults,
            max_frames=MAX_IMAGES,
        )
        fix = locate_body(found, tag, arm=arm) if found.sightings else None
    except TagError as error:
        raise TruthError(f"{what}: tripod tag {tag.id}: {error.message}", hint=error.hint) from error
    if fix is None:
        raise TruthError(
            f"{what}: tripod tag {tag.id} ({tag.family}) is never seen: {found.explanation}",
            hint="turn the arm camera to the tag at every waypoint, or correct its id or family",
        )
    truths = {}
    places = {place.frame.t_ns: place for place in found.places}
    for view in sorted(visit.views, key=lambda v: v.frame.t_ns):
        place = places.get(view.frame.t_ns)
        if place is not None:
            map_from_cam, covariance = fix.map_from_cam(place)
            truths[view.id] = Truth(visit.id, view.id, map_from_cam, place.body_from_cam, covariance, "tag")
    return truths


def _frames(recording: Recording, visit: Visit) -> list[Frame]:
    """Return the frames to search: those of the views, and from the visit's interval up to MAX_IMAGES in all."""
    # Views first: the arm may turn to the tag for no more than one announced image
    chosen = {v.frame.t_ns: v.frame for v in visit.views}
    inside = frames_between(recording, visit.t_begin_ns, visit.t_end_ns)
    between = [f for f in inside if f.t_ns not in chosen]
    room = min(max(MAX_IMAGES - len(chosen), 0), len(between))
    chosen |= {between[i].t_ns: between[i] for i in np.linspace(0, len(between) - 1, room).astype(int)}
    return [chosen[t_ns] for t_ns in sorted(chosen)]


def _from_topic(
    recording: Recording, visit: Visit, default_covariance: Array, *, hand: Array, what: str
) -> dict[str, Truth]:
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
        stated = recording.reference_covariance_at(view.frame.t_ns)
        covariance = compose_covariance(default_covariance if stated is None else stated, body_from_cam, hand)
        truths[view.id] = Truth(visit.id, view.id, map_from_body * body_from_cam, body_from_cam, covariance, "topic")
    if not truths:
        raise TruthError(f"{what}: no view has a pose of the reference topic: {reason}", hint="check its stamps")
    return truths
