"""Point cameras: upright camera poses from a direction or a target."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from fieldkit.frames import Pose

# Columns: the camera's right, down and forward axes in a frame with x forward, y left, z up.
UPRIGHT_FROM_CAM = Rotation.from_matrix([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def turn(yaw_rad: float, pitch_rad: float = 0.0, roll_rad: float = 0.0) -> Rotation:
    """Return the rotation of a frame with x forward, z up: yaw about z, then pitch upwards, then roll about x."""
    return Rotation.from_euler("ZYX", [yaw_rad, -pitch_rad, roll_rad])


def aim(position_m: ArrayLike, yaw_rad: float, *, pitch_rad: float = 0.0, roll_rad: float = 0.0) -> Pose:
    """Return world_from_cam of a camera at a position (3,) that looks along a yaw and a pitch (upwards)."""
    rotation = turn(yaw_rad, pitch_rad, roll_rad) * UPRIGHT_FROM_CAM
    return Pose.from_components(np.asarray(position_m, dtype=np.float64), rotation)


def look_at(position_m: ArrayLike, target_m: ArrayLike, *, roll_rad: float = 0.0) -> Pose:
    """Return world_from_cam of a camera at a position (3,) whose axis passes through a target (3,)."""
    dx, dy, dz = np.asarray(target_m, dtype=np.float64) - np.asarray(position_m, dtype=np.float64)
    pitch = float(np.arctan2(dz, np.hypot(dx, dy)))
    return aim(position_m, float(np.arctan2(dy, dx)), pitch_rad=pitch, roll_rad=roll_rad)


def facing(position_m: ArrayLike, yaw_rad: float, *, pitch_rad: float = 0.0, roll_rad: float = 0.0) -> Pose:
    """Return world_from_tag of an upright tag at a position (3,) whose normal (+z) points along a yaw and a pitch.

    In a frame with x forward, y left, z up, the tag's x (its right, seen from the front) is y and its y is z.
    """
    upright_from_tag = Rotation.from_matrix([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    rotation = turn(yaw_rad, pitch_rad) * upright_from_tag * Rotation.from_euler("z", roll_rad)
    return Pose.from_components(np.asarray(position_m, dtype=np.float64), rotation)
