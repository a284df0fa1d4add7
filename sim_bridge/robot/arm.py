"""The robot: a body that stands on the floor, and an arm with a camera, as a chain of transforms.

The arm has four joints, like the ones of Spot that matter here: ``sh0`` turns the arm about the vertical, ``sh1`` lifts
the upper arm, ``el0`` bends the elbow, ``wr0`` nods the hand. Angles in rad; lifting, bending up and nodding up are
positive. Looking around turns sh0 and wr0 alone, and so moves the camera's centre.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldkit.cameras import Camera
from fieldkit.frames import Pose
from sim_bridge.aim import UPRIGHT_FROM_CAM, turn

Array = NDArray[np.float64]

# The paper's hand camera; its centre is given in COLMAP's pixels (the first pixel's centre is 0.5, 0.5).
ARM_CAMERA = Camera("PINHOLE", 640, 480, (552.03, 552.03, 320.0, 240.0))
# Height of the body frame above the floor, and the radius of the floor that the standing robot needs.
BODY_HEIGHT_M = 0.5
FOOTPRINT_RADIUS_M = 0.45

# Where the arm is mounted on the body, and the lengths of its links, about those of Spot.
SHOULDER_M = (0.292, 0.0, 0.188)
UPPER_ARM_M = 0.3385
FOREARM_M = 0.4033
# The camera sits in front of the hand's joint, beside its middle, and tilted upwards.
CAMERA_IN_HAND_M = (0.15, 0.02, 0.045)
CAMERA_TILT_RAD = float(np.radians(9.1))

# The upper arm leans back and the forearm is level: the hand is raised, close to the body, and turns in little space.
RAISED_SH1 = float(np.radians(125.0))

ARM_BASE, CAMERA_FRAME = "arm_link_base", "arm_camera"
LINKS = ("body", ARM_BASE, "arm_link_sh0", "arm_link_sh1", "arm_link_el0", "arm_link_wr0", CAMERA_FRAME)


@dataclasses.dataclass(frozen=True)
class ArmJoints:
    """Angles of the arm's joints in rad."""

    sh0: float
    sh1: float
    el0: float
    wr0: float

    def as_array(self) -> Array:
        """Return the angles (4,) in the order sh0, sh1, el0, wr0."""
        return np.array([self.sh0, self.sh1, self.el0, self.wr0])

    @property
    def pitch_rad(self) -> float:
        """Pitch of the camera's axis above the horizon."""
        return self.sh1 + self.el0 + self.wr0 + CAMERA_TILT_RAD


def joints(angles: ArrayLike) -> ArmJoints:
    """Make arm joints from angles (4,) in rad in the order sh0, sh1, el0, wr0."""
    sh0, sh1, el0, wr0 = (float(v) for v in np.asarray(angles, dtype=np.float64))
    return ArmJoints(sh0, sh1, el0, wr0)


def looking(yaw_rad: float, pitch_rad: float, *, sh1: float = RAISED_SH1, el0: float = -RAISED_SH1) -> ArmJoints:
    """Return the joints with which the camera looks along a yaw and a pitch of the body frame.

    ``sh1`` and ``el0`` hold the hand.
    """
    return ArmJoints(float(yaw_rad), float(sh1), float(el0), float(pitch_rad - CAMERA_TILT_RAD - sh1 - el0))


# Folded on the back, the hand in front of the shoulder, looking forward and down.
STOWED = looking(0.0, np.radians(-15.0), sh1=np.radians(176.0), el0=np.radians(-174.0))


def moving_links(arm: ArmJoints) -> list[tuple[str, str, Pose]]:
    """Return (parent, child, parent_from_child) of the links that the joints move."""
    places = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (UPPER_ARM_M, 0.0, 0.0), (FOREARM_M, 0.0, 0.0))
    turns = (turn(arm.sh0), turn(0.0, arm.sh1), turn(0.0, arm.el0), turn(0.0, arm.wr0))
    poses = [Pose.from_components(np.array(at), rotation) for at, rotation in zip(places, turns, strict=True)]
    return list(zip(LINKS[1:5], LINKS[2:6], poses, strict=True))


def fixed_links() -> list[tuple[str, str, Pose]]:
    """Return (parent, child, parent_from_child) of the links that never move: the arm's mount and the camera's."""
    mount = Pose.from_components(np.array(SHOULDER_M), turn(0.0))
    camera = Pose.from_components(np.array(CAMERA_IN_HAND_M), turn(0.0, CAMERA_TILT_RAD) * UPRIGHT_FROM_CAM)
    return [("body", ARM_BASE, mount), (LINKS[5], CAMERA_FRAME, camera)]


def body_from_camera(arm: ArmJoints) -> Pose:
    """Return body_from_cam of the arm camera: the product of all links, written out, for speed."""
    lifts = np.cumsum([arm.sh1, arm.el0, arm.wr0])
    ahead, side, above = CAMERA_IN_HAND_M
    x = np.dot(np.cos(lifts), (UPPER_ARM_M, FOREARM_M, ahead)) - np.sin(lifts[2]) * above
    z = np.dot(np.sin(lifts), (UPPER_ARM_M, FOREARM_M, ahead)) + np.cos(lifts[2]) * above
    c, s = np.cos(arm.sh0), np.sin(arm.sh0)
    position = np.array(SHOULDER_M) + (c * x - s * side, s * x + c * side, z)
    return Pose.from_components(position, turn(arm.sh0, float(lifts[2]) + CAMERA_TILT_RAD) * UPRIGHT_FROM_CAM)


def standing(xy: ArrayLike, yaw_rad: float) -> Pose:
    """Return world_from_body of the robot standing upright on the floor z = 0 at (2,), turned by a yaw."""
    x, y = np.asarray(xy, dtype=np.float64)
    return Pose.from_components(np.array([x, y, BODY_HEIGHT_M]), turn(yaw_rad))
