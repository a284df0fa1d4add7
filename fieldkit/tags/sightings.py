"""What the robot's arm camera sees of one tag: sightings relative to the body at one time."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from fieldkit.errors import FrameError, TagError
from fieldkit.frames import Array, Pose, Trajectory, compose_covariance, inverse_covariance
from fieldkit.tags.detect import detect
from fieldkit.tags.fusion import SCALES, Sighting, TagFix, fuse_sightings
from fieldkit.types import Frame, TagPose

# Noise of body_from_cam from joint angles, independent between images: 0.2 deg and 2 mm per axis. The fusion scales it
# to what the sightings show
ARM_COVARIANCE: Array = np.diag([math.radians(0.2) ** 2] * 3 + [0.002**2] * 3)


@dataclasses.dataclass(frozen=True)
class BodySightings:
    """Sightings of a tag relative to the body at ``t_ns``; how many frames were searched, and what was left out."""

    t_ns: int
    sightings: tuple[Sighting, ...]
    n_frames: int
    no_kinematics: int
    no_odometry: int
    last_error: str

    @property
    def explanation(self) -> str:
        """Why there is no sighting: counts of the frames and what was wrong with them."""
        parts = [f"{self.n_frames} images searched"]
        if self.no_kinematics:
            parts.append(f"{self.no_kinematics} without a transform from body to camera")
        if self.no_odometry:
            parts.append(f"{self.no_odometry} without odometry ({self.last_error})")
        return ", ".join(parts)


def body_sightings(
    frames: Sequence[Frame], tag: TagPose, *, odometry: Trajectory, max_frames: int = 60
) -> BodySightings:
    """Find one tag in frames of a robot that stands or moves little, and place the cameras relative to its body.

    The reference is the body at the last frame with kinematics and odometry. Motion between a frame and the
    reference comes from odometry deltas, never from its absolute pose. Of more than ``max_frames`` so many are
    searched, evenly spread. An image that shows the same tag twice is left out.
    """
    placed: list[tuple[Frame, Pose, Pose]] = []
    no_kinematics, no_odometry, last_error = 0, 0, ""
    chosen = [frames[i] for i in np.linspace(0, len(frames) - 1, min(len(frames), max_frames)).astype(int)]
    for frame in chosen:
        if frame.body_from_cam is None:
            no_kinematics += 1
            continue
        try:
            placed.append((frame, odometry.at(frame.t_ns), frame.body_from_cam))
        except FrameError as error:
            no_odometry += 1
            last_error = error.message
    if not placed:
        return BodySightings(0, (), len(chosen), no_kinematics, no_odometry, last_error)
    reference = placed[-1][0].t_ns
    ref_from_odom = odometry.at(reference).inv()
    sightings = []
    for frame, odom_from_body, body_from_cam in placed:
        seen = [d for d in detect(frame.read(), frame.camera, families=(tag.family,)) if d.id == tag.id]
        if len(seen) == 1:
            ref_from_cam = ref_from_odom * odom_from_body * body_from_cam
            sightings.append(Sighting(seen[0], frame.camera, ref_from_cam, ARM_COVARIANCE))
    return BodySightings(reference, tuple(sightings), len(chosen), no_kinematics, no_odometry, last_error)


def fuse_body_sightings(sightings: Sequence[Sighting], tag: TagPose) -> TagFix:
    """Fuse what a robot's own camera saw of one tag into body_from_tag; see `fuse_sightings`.

    Raises TagError when there is no solution, or when four or more sightings need the largest noise of the arm that
    is allowed: a wrong tag size or wrong kinematics shifts all of them, and the covariance would not tell.
    """
    fix = fuse_sightings(sightings, tag.size_m)
    if len(sightings) >= 4 and fix.scale >= max(SCALES):
        raise TagError(
            f"the {len(sightings)} sightings of tag {tag.id} disagree with kinematics by about {max(SCALES):g} times "
            "their stated noise or more; expected one place of the tag in all of them",
            hint="check size_m of the tag, camera_info and tf",
        )
    return fix


def body_in_map(fix: TagFix, tag: TagPose) -> tuple[Pose, Array]:
    """Return map_from_body and its covariance from the tag relative to the body and the tag in the map.

    Where the sightings leave both planar solutions open, the one with the more upright body is taken: the map's z and
    the body's z both point up on a standing robot. No odometry and no prior takes part in the choice.
    """
    options = [(fix.ref_from_tag, fix.covariance)]
    if not fix.is_certain and fix.alternative is not None and fix.alternative_covariance is not None:
        options.append((fix.alternative, fix.alternative_covariance))
    ref_from_tag, covariance = min(options, key=lambda o: _tilt(tag.map_from_tag * o[0].inv()))
    map_from_body = tag.map_from_tag * ref_from_tag.inv()
    tag_from_ref = inverse_covariance(ref_from_tag, covariance)
    return map_from_body, compose_covariance(tag.covariance, ref_from_tag.inv(), tag_from_ref)


def _tilt(map_from_body: Pose) -> float:
    return float(np.arccos(np.clip(map_from_body.rotation.as_matrix()[2, 2], -1.0, 1.0)))
