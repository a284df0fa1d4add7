"""What odometry says between two times, and how uncertain that is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import FrameError
from fieldkit.frames import Array, Pose, Trajectory, adjoint
from fieldkit.protocol import OdometryNoise
from fieldkit.types import OdometryFault

# Odometry that moves less than this between two samples stands: its jitter is no path
STEP_M, STEP_RAD = 0.05, math.radians(5.0)
# A longer path is reckoned in so many steps
MAX_STEPS = 300


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
    its root. A yaw error turns everything after it, however large: the covariance has the second moments about what
    odometry says, also of what is not linear in the angle. A jump among ``faults`` adds its own size as a standard
    deviation at its place, also where one of the times lies inside of it: interpolation has put part of it there.
    Raises FrameError when the samples do not reach or have a gap.
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
    covariance = _growth(anchors, steps, noise)
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


def _growth(anchors: Sequence[Pose], steps: Sequence[tuple[float, float]], noise: OdometryNoise) -> Array:
    """Return the 6x6 second moments of the error at the last anchor about what odometry says (right perturbation).

    The yaw error is a Gaussian process along the path, about the path's mean z axis, and turns every step after it. The
    moments of a Gaussian's cosine and sine are known in closed form (E exp(i x) = exp(-var x / 2)), so this holds for
    large angles too: a yaw of 20 deg also shortens the way.
    """
    poses = Pose.concatenate(list(anchors))
    placed = poses[0].inv() * poses
    up, axes = _upright(placed.rotation.as_matrix()[..., 2].mean(axis=0))
    moved = np.diff(placed.translation @ axes.T @ np.array([1.0, 1.0j]))
    lengths, turns = np.array(steps).T
    moved, lengths, turns = (_merged(v) for v in (moved, lengths, turns))
    way, turned = (np.append(np.cumsum(v) - v / 2, v.sum()) for v in (lengths, turns))
    yaw: Array = math.radians(noise.yaw_deg_per_m) ** 2 * np.outer(way, way)
    yaw += noise.yaw_deg_per_turn_deg**2 * np.outer(turned, turned)
    yaw += math.radians(noise.yaw_deg_per_root_m) ** 2 * np.minimum.outer(way, way)
    basis = np.zeros((6, 3))
    basis[:3, 0], basis[3:, 1:] = up, axes.T
    basis = np.kron(np.eye(2), placed[-1].rotation.as_matrix().T) @ basis
    covariance: Array = basis @ _turning(moved, yaw) @ basis.T
    travelled = float(lengths.sum())
    position = (noise.position_per_m * travelled) ** 2 + noise.position_per_root_m**2 * travelled
    covariance[3:, 3:] += position * np.eye(3)
    return covariance


def _turning(moved: NDArray[np.complex128], yaw: Array) -> Array:
    """Return the 3x3 second moments of yaw and position at the end of a path whose steps are turned by a yaw error.

    ``moved`` (n,) are the steps in their plane, ``yaw`` (n + 1, n + 1) is the covariance of the yaw error at each of
    them and at the end. The position's error is the sum of (exp(i yaw) - 1) * step.
    """
    var = np.diag(yaw)[:-1]
    mean, both = np.exp(-var / 2), (var[:, None] + var) / 2
    known = 1.0 - mean[:, None] - mean
    size = (moved @ (np.exp(yaw[:-1, :-1] - both) + known) @ moved.conj()).real
    square = moved @ (np.exp(-yaw[:-1, :-1] - both) + known) @ moved
    with_yaw = 1j * np.sum(yaw[:-1, -1] * mean * moved)
    result = np.diag([yaw[-1, -1], (size + square.real) / 2, (size - square.real) / 2])
    result[1, 2] = result[2, 1] = square.imag / 2
    result[0, 1:] = result[1:, 0] = with_yaw.real, with_yaw.imag
    return result


def _upright(z: Array) -> tuple[Array, Array]:
    """Return the unit vector along z (3,), and two (2, 3) that complete it to a right-handed frame."""
    length = float(np.linalg.norm(z))
    # A body that tumbles has no upright: that of the start serves
    up = z / length if length > 0.1 else np.array([0.0, 0.0, 1.0])
    first = np.cross(up, np.eye(3)[int(np.abs(up).argmin())])
    first /= np.linalg.norm(first)
    return up, np.stack([first, np.cross(up, first)])


def _merged(values: NDArray[Any]) -> NDArray[Any]:
    """Return the sums of up to MAX_STEPS runs of values (n,)."""
    begins = np.unique(np.linspace(0, len(values), MAX_STEPS, endpoint=False).astype(int))
    merged: NDArray[Any] = np.add.reduceat(values, begins)
    return merged


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
