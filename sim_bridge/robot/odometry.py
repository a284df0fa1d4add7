"""Wheel or leg odometry: the true motion of the body with errors that grow with distance and turning."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from fieldkit.frames import Pose
from sim_bridge.aim import turn

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class OdometryOptions:
    """How odometry errs (standard deviations): per-robot biases drawn once, and random walks.

    ``scale`` is the relative error of distances, ``turn_scale`` that of angles, ``yaw_bias_deg`` the yaw gained per
    metre; ``yaw_walk_deg`` and ``walk_m`` are random walks per root of metre.
    """

    scale: float = 0.015
    turn_scale: float = 0.01
    yaw_bias_deg: float = 0.3
    yaw_walk_deg: float = 0.6
    walk_m: float = 0.008
    origin_xy_m: tuple[float, float] = (1.3, -0.7)
    origin_yaw_deg: float = 35.0


def drifting_odometry(world_from_body: list[Pose], options: OdometryOptions, *, rng: np.random.Generator) -> list[Pose]:
    """Return odom_from_body for true poses of a body that moves upright on a floor.

    The odometry frame stands where ``options`` says, not at the robot: nothing may rely on a start at zero. Errors
    come with motion only; a standing body has constant odometry.
    """
    bias = rng.standard_normal(3) * (options.scale, options.turn_scale, np.radians(options.yaw_bias_deg))
    xy = np.array(options.origin_xy_m)
    yaw = np.radians(options.origin_yaw_deg)
    headings = np.array([_yaw(pose) for pose in world_from_body])
    result = [_flat(xy, yaw, world_from_body[0])]
    for k in range(1, len(world_from_body)):
        delta = world_from_body[k].translation[:2] - world_from_body[k - 1].translation[:2]
        moved = float(np.hypot(*delta))
        turned = float((headings[k] - headings[k - 1] + np.pi) % (2 * np.pi) - np.pi)
        noise = rng.standard_normal(3)
        if moved > 1e-9 or abs(turned) > 1e-9:
            step = _rotated(delta, yaw - headings[k - 1]) * (1.0 + bias[0])
            xy = xy + step + options.walk_m * np.sqrt(moved) * noise[:2]
            walk = np.radians(options.yaw_walk_deg) * np.sqrt(moved) * noise[2]
            yaw += turned * (1.0 + bias[1]) + bias[2] * moved + walk
        result.append(_flat(xy, yaw, world_from_body[k]))
    return result


def _yaw(pose: Pose) -> float:
    forward = pose.rotation.apply([1.0, 0.0, 0.0])
    return float(np.arctan2(forward[1], forward[0]))


def _rotated(xy: Array, yaw: float) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([c * xy[0] - s * xy[1], s * xy[0] + c * xy[1]])


def _flat(xy: Array, yaw: float, body: Pose) -> Pose:
    return Pose.from_components(np.array([xy[0], xy[1], body.translation[2]]), turn(yaw))
