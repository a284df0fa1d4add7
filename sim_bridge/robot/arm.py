"""The robot: a body that stands on the floor, and an arm with two cameras, as a chain of transforms.

The arm is Spot's: ``sh0`` turns it about the vertical, ``sh1`` lifts the upper arm, ``el0`` bends the elbow, ``el1``
rolls the forearm, ``wr0`` nods and ``wr1`` rolls the hand. Lengths, axes, signs and limits are those of the published
URDF (``spot_description``), so lifting, bending up and nodding up are negative angles. The hand carries a colour and a
depth camera. Looking around turns sh0 and wr0 alone, and so moves the cameras' centres.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from fieldkit.cameras import Camera
from fieldkit.frames import Pose
from sim_bridge.aim import UPRIGHT_FROM_CAM, turn

Array = NDArray[np.float64]

# The paper's hand camera; its centre is given in COLMAP's pixels (the first pixel's centre is 0.5, 0.5).
ARM_CAMERA = Camera("PINHOLE", 640, 480, (552.03, 552.03, 320.0, 240.0))
# The time-of-flight camera in the hand, as one Spot reports it.
DEPTH_CAMERA = Camera("PINHOLE", 224, 171, (210.78, 210.78, 112.87, 87.74))
# Height of the body frame above the floor, and the radius of the floor that the standing robot needs.
BODY_HEIGHT_M = 0.5
FOOTPRINT_RADIUS_M = 0.45

JOINTS = ("sh0", "sh1", "el0", "el1", "wr0", "wr1")
# Lowest and highest angle (rad) of every joint.
SH0_RANGE_RAD = (float(np.radians(-150.0)), float(np.pi))
LIMITS_RAD: Array = np.array(
    [SH0_RANGE_RAD, *np.radians([(-180.0, 30.0), (0.0, 180.0), (-160.0, 160.0), (-105.0, 105.0), (-165.0, 165.0)])]
)
# Where every joint sits in the link before it; the first in the body.
SHOULDER_M = (0.292, 0.0, 0.188)
UPPER_ARM_M = 0.3385
FOREARM_M = (0.4033, 0.0, 0.075)
_PLACES_M = (SHOULDER_M, (0.0, 0.0, 0.0), (UPPER_ARM_M, 0.0, 0.0), FOREARM_M, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
_AXES = "zyyxyx"

# The hand frame, in front of the wrist; the colour camera beside and above its middle, tilted upwards.
HAND_IN_WRIST_M = (0.19557, 0.0, 0.0)
CAMERA_IN_HAND_M = (-0.058, 0.020, 0.025)
CAMERA_TILT_RAD = float(np.radians(9.1))
WRIST_FROM_CAMERA = Pose.from_components(
    np.add(HAND_IN_WRIST_M, CAMERA_IN_HAND_M), turn(0.0, CAMERA_TILT_RAD) * UPRIGHT_FROM_CAM
)
# The depth camera lies on its side: its picture's x points down and its y to the left.
_SIDEWAYS_FROM_CAM = Rotation.from_matrix([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
WRIST_FROM_DEPTH = Pose.from_components(
    np.array([0.13495, 0.0, 0.00799]), turn(0.0, float(np.radians(9.0))) * _SIDEWAYS_FROM_CAM
)

# The upper arm leans back and the forearm is level: the hand is raised, close to the body, and turns in little space.
RAISED_SH1 = -float(np.radians(125.0))


@dataclasses.dataclass(frozen=True)
class ArmJoints:
    """Angles of the arm's joints in rad."""

    sh0: float
    sh1: float
    el0: float
    el1: float
    wr0: float
    wr1: float

    def as_array(self) -> Array:
        """Return the angles (6,) in the order of JOINTS."""
        return np.array([self.sh0, self.sh1, self.el0, self.el1, self.wr0, self.wr1])

    @property
    def pitch_rad(self) -> float:
        """Pitch of the colour camera's axis above the horizon."""
        axis = body_from_camera(self).rotation.apply([0.0, 0.0, 1.0])
        return float(np.arctan2(axis[2], np.hypot(axis[0], axis[1])))


def joints(angles: ArrayLike) -> ArmJoints:
    """Make arm joints from angles (6,) in rad in the order of JOINTS."""
    return ArmJoints(*(float(v) for v in np.asarray(angles, dtype=np.float64)))


def within_limits(arm: ArmJoints) -> bool:
    """Return whether the real arm can take these angles: sh0 misses 30 deg at the right of straight back."""
    angles = arm.as_array()
    return bool(((angles >= LIMITS_RAD[:, 0] - 1e-6) & (angles <= LIMITS_RAD[:, 1] + 1e-6)).all())


def looking(yaw_rad: float, pitch_rad: float, *, sh1: float = RAISED_SH1, el0: float = -RAISED_SH1) -> ArmJoints:
    """Return the joints with which the colour camera looks along a yaw and a pitch (upwards) of the body frame.

    ``sh1`` and ``el0`` hold the hand; el1 and wr1 are 0. Any yaw is answered, sh0 is the equal angle nearest to its
    range: whoever minds the limits asks `within_limits`.
    """
    low, high = SH0_RANGE_RAD
    begin = 0.5 * (low + high) - np.pi
    sh0 = begin + (float(yaw_rad) - begin) % (2.0 * np.pi)
    return ArmJoints(sh0, float(sh1), float(el0), 0.0, float(CAMERA_TILT_RAD - pitch_rad - sh1 - el0), 0.0)


# Folded on the back, the hand above the shoulder, on its side and turned back: the camera looks ahead.
STOWED = ArmJoints(0.0, -3.1, 3.1, 1.5708, 0.0, -1.5708)


def links(arm: ArmJoints) -> list[Pose]:
    """Return parent_from_child of the six links sh0 .. wr1; the first one's parent is the body."""
    turns = [Rotation.from_euler(axis, angle) for axis, angle in zip(_AXES, arm.as_array(), strict=True)]
    return [Pose.from_components(np.array(at), r) for at, r in zip(_PLACES_M, turns, strict=True)]


def moving_links(arm: ArmJoints, names: Sequence[str], *, body: str) -> list[tuple[str, str, Pose]]:
    """Return (parent, child, parent_from_child) of the links that the joints move.

    ``names`` are the frames of the six links, or the wrist's alone, which then hangs on the body.
    """
    if len(names) == 1:
        return [(body, names[0], body_from_wrist(arm))]
    return list(zip((body, *names[:-1]), names, links(arm), strict=True))


def body_from_wrist(arm: ArmJoints) -> Pose:
    """Return the pose of the last link, wr1, in the body: the product of all links, written out, for speed."""
    upper = Rotation.from_euler("ZY", [arm.sh0, arm.sh1])
    fore = Rotation.from_euler("ZYX", [arm.sh0, arm.sh1 + arm.el0, arm.el1])
    hand = fore * Rotation.from_euler("YX", [arm.wr0, arm.wr1])
    # The forearm's place does not depend on el1, which turns after it.
    bend = Rotation.from_euler("ZY", [arm.sh0, arm.sh1 + arm.el0])
    at = np.array(SHOULDER_M) + upper.apply([UPPER_ARM_M, 0.0, 0.0]) + bend.apply(FOREARM_M)
    return Pose.from_components(at, hand)


def body_from_camera(arm: ArmJoints) -> Pose:
    """Return body_from_cam of the hand's colour camera."""
    return body_from_wrist(arm) * WRIST_FROM_CAMERA


def body_from_depth(arm: ArmJoints) -> Pose:
    """Return body_from_cam of the hand's depth camera."""
    return body_from_wrist(arm) * WRIST_FROM_DEPTH


def standing(xy: ArrayLike, yaw_rad: float) -> Pose:
    """Return world_from_body of the robot standing upright on the floor z = 0 at (2,), turned by a yaw."""
    x, y = np.asarray(xy, dtype=np.float64)
    return Pose.from_components(np.array([x, y, BODY_HEIGHT_M]), turn(yaw_rad))
