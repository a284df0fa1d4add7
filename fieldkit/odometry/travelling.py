"""What odometry says between two times, and how uncertain that is."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fieldkit.errors import FrameError
from fieldkit.frames import Array, Pose, Trajectory, adjoint
from fieldkit.protocol import OdometryNoise
from fieldkit.types import OdometryFault

# Odometry that moves less than this between two samples stands: its jitter is no path
STEP_M, STEP_RAD = 0.05, math.radians(5.0)


def travel(
    odometry: Trajectory,
    t_from_ns: int,
    t_to_ns: int,
    *,
    noise: OdometryNoise,
    faults: Sequence[OdometryFault] = (),
) -> tuple[Pose, Array, float]:
    """Return from_body_to_body between two times by odometry, its 6x6 covariance, and the length of the path in m.

    Biases are constant along the path, so their standard deviations grow in proportion to it; random walks grow with
    its root. A yaw error moves everything after it. A jump among ``faults`` adds its own size as a standard deviation
    at its place, also where one of the times lies inside of it: interpolation has put part of it there. Raises
    FrameError when the samples do not reach or have a gap.
    """
    path = _path(odometry, t_from_ns, t_to_ns)
    anchors = [path[0]]
    steps: list[tuple[float, float]] = []
    for index, pose in enumerate(path[1:], start=1):
        moved = anchors[-1].inv() * pose
        length, turn = float(np.linalg.norm(moved.translation)), float(moved.rotation.magnitude())
        if length > STEP_M or turn > STEP_RAD or index == len(path) - 1:
            anchors.append(pose)
            steps.append((length, turn))
    covariance = _growth(path[-1].inv(), anchors, steps, noise)
    first, last = min(t_from_ns, t_to_ns), max(t_from_ns, t_to_ns)
    for jump in jumps_between(faults, first, last):
        position, angle = jump.excess
        beyond = jump.t_end_ns if t_from_ns <= t_to_ns else jump.t_begin_ns
        effect = adjoint(path[-1].inv() * odometry.at(min(max(beyond, first), last)))
        covariance += effect @ np.diag([angle**2] * 3 + [position**2] * 3) @ effect.T
    return path[0].inv() * path[-1], covariance, sum(length for length, _ in steps)


def jumps_between(faults: Sequence[OdometryFault], first_ns: int, last_ns: int) -> list[OdometryFault]:
    """Return the jumps among faults of which any part lies between two times."""
    jumps = [f for f in faults if f.kind == "jump"]
    return [f for f in jumps if max(first_ns, f.t_begin_ns) < min(last_ns, f.t_end_ns)]


def _growth(
    end_from_odom: Pose, anchors: Sequence[Pose], steps: Sequence[tuple[float, float]], noise: OdometryNoise
) -> Array:
    per_m, per_turn, walk = np.zeros(6), np.zeros(6), np.zeros((6, 6))
    for anchor, (length, turn) in zip(anchors[1:], steps, strict=True):
        end_from_anchor = end_from_odom * anchor
        axis = end_from_anchor.rotation.apply([0.0, 0.0, 1.0])
        effect = np.concatenate([axis, np.cross(end_from_anchor.translation, axis)])
        per_m += length * effect
        per_turn += turn * effect
        walk += length * np.outer(effect, effect)
    travelled = sum(length for length, _ in steps)
    covariance: Array = math.radians(noise.yaw_deg_per_m) ** 2 * np.outer(per_m, per_m)
    covariance += noise.yaw_deg_per_turn_deg**2 * np.outer(per_turn, per_turn)
    covariance += math.radians(noise.yaw_deg_per_root_m) ** 2 * walk
    position = (noise.position_per_m * travelled) ** 2 + noise.position_per_root_m**2 * travelled
    covariance[3:, 3:] += position * np.eye(3)
    return covariance


def _path(odometry: Trajectory, t_from_ns: int, t_to_ns: int) -> list[Pose]:
    """Return poses from one time to the other, both included, in the order of the way."""
    begin, end = odometry.at(t_from_ns), odometry.at(t_to_ns)
    first, last = sorted((t_from_ns, t_to_ns))
    inside = np.flatnonzero((odometry.t_ns > first) & (odometry.t_ns < last))
    times = [first, *odometry.t_ns[inside].tolist(), last]
    gaps = np.diff(times)
    if int(gaps.max()) > odometry.max_gap_ns:
        at = times[int(gaps.argmax())]
        raise FrameError(
            f"{odometry.parent}_from_{odometry.child} has a gap of {gaps.max() / 1e9:.2f} s at {at} ns, between "
            f"{first} and {last} ns; at most {odometry.max_gap_ns / 1e9:.2f} s is bridged"
        )
    between = [odometry.poses[int(i)] for i in inside]
    if t_from_ns <= t_to_ns:
        return [begin, *between, end]
    return [begin, *between[::-1], end]
