"""What a robot believes of its arm: encoders that are a little noisy, joints and cameras mounted a little wrong."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fieldkit.frames import Pose
from sim_bridge.robot.arm import WRIST_FROM_CAMERA, WRIST_FROM_DEPTH, ArmJoints, body_from_wrist, joints

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class KinematicOptions:
    """Errors of an arm (standard deviations): ``encoder_deg`` anew in every sample, the others once per robot.

    ``joint_deg`` is the error of a joint's zero, ``mount_m`` and ``mount_deg`` that of a camera in the hand.
    """

    encoder_deg: float = 0.02
    joint_deg: float = 0.08
    mount_m: float = 0.0008
    mount_deg: float = 0.08


@dataclasses.dataclass(frozen=True, eq=False)
class Kinematics:
    """One robot's arm as it truly is: errors of the joints' zeros (6,), and where its cameras truly sit."""

    zero_rad: Array
    encoder_rad: float
    wrist_from_camera: Pose
    wrist_from_depth: Pose

    def body_from_camera(self, arm: ArmJoints) -> Pose:
        """Return the true body_from_cam of the colour camera for true joints."""
        return body_from_wrist(arm) * self.wrist_from_camera

    def body_from_depth(self, arm: ArmJoints) -> Pose:
        """Return the true body_from_cam of the depth camera for true joints."""
        return body_from_wrist(arm) * self.wrist_from_depth

    def measured(self, arm: ArmJoints, *, rng: np.random.Generator) -> ArmJoints:
        """Return what the encoders say of true joints."""
        return joints(arm.as_array() + self.zero_rad + self.encoder_rad * rng.standard_normal(len(self.zero_rad)))


def assembled(options: KinematicOptions, *, rng: np.random.Generator) -> Kinematics:
    """Return the arm of a robot that was assembled with the errors of ``options``."""

    def mounted(nominal: Pose) -> Pose:
        turned = Rotation.from_rotvec(np.radians(options.mount_deg) * rng.standard_normal(3))
        return nominal * Pose.from_components(options.mount_m * rng.standard_normal(3), turned)

    zero = np.radians(options.joint_deg) * rng.standard_normal(6)
    encoder = float(np.radians(options.encoder_deg))
    return Kinematics(zero, encoder, mounted(WRIST_FROM_CAMERA), mounted(WRIST_FROM_DEPTH))
