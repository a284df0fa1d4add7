"""Poses, their errors and their covariances. ``a_from_b`` maps coordinates in b to coordinates in a."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from fieldkit.errors import FrameError

Pose = RigidTransform
Array = NDArray[np.float64]


def pose(position_m: ArrayLike, quaternion_xyzw: ArrayLike) -> Pose:
    """Make a pose from a position (3,) in m and a quaternion (4,) in the order x y z w."""
    xyz = np.asarray(position_m, dtype=np.float64)
    quaternion = np.asarray(quaternion_xyzw, dtype=np.float64)
    if xyz.shape != (3,) or quaternion.shape != (4,):
        raise FrameError(f"pose has {xyz.shape} position and {quaternion.shape} quaternion; expected (3,) and (4,)")
    norm = float(np.linalg.norm(quaternion))
    if not np.isfinite(xyz).all() or not np.isfinite(norm) or abs(norm - 1.0) > 0.05:
        raise FrameError(f"pose is not finite or its quaternion has length {norm:.3g}; expected a unit quaternion")
    return Pose.from_components(xyz, Rotation.from_quat(quaternion))


def pose_from_matrix(matrix: ArrayLike) -> Pose:
    """Make a pose from a 4x4 matrix whose rotation is projected to the nearest orthonormal one (SVD)."""
    values = np.asarray(matrix, dtype=np.float64)
    if values.shape != (4, 4) or not np.isfinite(values).all():
        raise FrameError(f"pose matrix of shape {values.shape}; expected 4x4 finite numbers")
    u, _, vt = np.linalg.svd(values[:3, :3])
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return Pose.from_components(values[:3, 3], Rotation.from_matrix(rotation))


def position_quaternion(a_from_b: Pose) -> tuple[list[float], list[float]]:
    """Return position (m) and quaternion (x y z w, w >= 0) of one pose as plain lists."""
    xyz = [float(v) for v in a_from_b.translation]
    return xyz, [float(v) for v in a_from_b.rotation.as_quat(canonical=True)]


def yaw_pose(position_m: ArrayLike, yaw_rad: float) -> Pose:
    """Make a pose that stands upright (z up) at a position (3,) in m, turned by yaw about z."""
    return Pose.from_components(np.asarray(position_m, dtype=np.float64), Rotation.from_euler("z", yaw_rad))


def pose_error(estimate: Pose | None, truth: Pose) -> tuple[float, float]:
    """Return distance (m) and angle (rad) between two poses; a missing estimate is infinitely wrong."""
    if estimate is None:
        return float("inf"), float("inf")
    delta = truth.inv() * estimate
    return float(np.linalg.norm(delta.translation)), float(delta.rotation.magnitude())


def exp(d: ArrayLike) -> Pose:
    """Return Exp(d) of a tangent vector (6,): rotation (rad), then translation (m).

    Rotation and translation are perturbed separately (SO(3) x R^3): the translation part is the shift itself,
    in the right-hand frame.
    """
    values = np.asarray(d, dtype=np.float64)
    return Pose.from_components(values[3:], Rotation.from_rotvec(values[:3]))


def log(transform: Pose) -> Array:
    """Return the tangent vector (6,) of a pose: rotation (rad), then translation (m); the inverse of `exp`."""
    return np.concatenate([transform.rotation.as_rotvec(), transform.translation])


def skew(v: ArrayLike) -> Array:
    """Return the 3x3 matrix of the cross product with v (3,)."""
    x, y, z = np.asarray(v, dtype=np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def adjoint(a_from_b: Pose) -> Array:
    """Return the 6x6 matrix A with a_from_b * Exp(d) = Exp(A d) * a_from_b to first order (rotation first)."""
    rotation = a_from_b.rotation.as_matrix()
    result = np.zeros((6, 6))
    result[:3, :3] = rotation
    result[3:, 3:] = rotation
    result[3:, :3] = skew(a_from_b.translation) @ rotation
    return result


def compose_covariance(covariance_ab: Array, b_from_c: Pose, covariance_bc: Array | None = None) -> Array:
    """Return the 6x6 covariance of a_from_b * b_from_c from those of the independent factors (right perturbations).

    The first factor's perturbation is carried through b_from_c by the adjoint of its inverse; see Barfoot,
    "State Estimation for Robotics", section 7.3.
    """
    transport = adjoint(b_from_c.inv())
    result = transport @ covariance_ab @ transport.T
    return result if covariance_bc is None else result + covariance_bc


def inverse_covariance(a_from_b: Pose, covariance_ab: Array) -> Array:
    """Return the 6x6 covariance of b_from_a (right perturbation) from that of a_from_b."""
    transport = adjoint(a_from_b)
    return transport @ covariance_ab @ transport.T


def mean_pose(poses: Sequence[Pose], *, covariances: Sequence[Array] | None = None) -> tuple[Pose, Array]:
    """Fuse poses of the same transform by Gauss-Newton with their 6x6 covariances; return mean and covariance.

    Without covariances every pose weighs the same, and the covariance is the sample's, divided by the count.
    Raises FrameError when there is no pose.
    """
    if not poses:
        raise FrameError("no pose to average; expected at least one")
    count = len(poses)
    if covariances is None:
        mean = Pose.concatenate(list(poses)).mean() if count > 1 else poses[0]
        deltas = np.stack([log(mean.inv() * p) for p in poses])
        return mean, deltas.T @ deltas / max(count * (count - 1), 1)
    information = [np.linalg.inv(c) for c in covariances]
    mean = poses[0]
    for _ in range(10):
        total = np.sum(information, axis=0)
        step = np.linalg.solve(total, sum(w @ log(mean.inv() * p) for w, p in zip(information, poses, strict=True)))
        mean = mean * exp(step)
        if float(np.abs(step).max()) < 1e-12:
            break
    return mean, np.linalg.inv(np.sum(information, axis=0))


def interpolate(first: Pose, second: Pose, fraction: float) -> Pose:
    """Return the pose between two poses: linear in translation, geodesic in rotation."""
    xyz = (1.0 - fraction) * first.translation + fraction * second.translation
    delta = (first.rotation.inv() * second.rotation).as_rotvec()
    return Pose.from_components(xyz, first.rotation * Rotation.from_rotvec(fraction * delta))


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """A timed pose ``parent_from_child`` that interpolates between samples and refuses gaps.

    ``t_ns`` int64[n] strictly increasing, ``poses`` n poses, ``max_gap_ns`` the longest interval that is bridged.
    """

    t_ns: NDArray[np.int64]
    poses: tuple[Pose, ...]
    parent: str
    child: str
    max_gap_ns: int = 500_000_000

    def __len__(self) -> int:
        return len(self.poses)

    def at(self, t_ns: int) -> Pose:
        """Return the pose at a time; raises FrameError before, after, or inside a gap of the samples."""
        what = f"{self.parent}_from_{self.child} at {t_ns} ns"
        if not self.poses:
            raise FrameError(f"{what}: the trajectory has no samples")
        right = int(np.searchsorted(self.t_ns, t_ns))
        if right < len(self.poses) and int(self.t_ns[right]) == t_ns:
            return self.poses[right]
        if right == 0 or right == len(self.poses):
            raise FrameError(f"{what}: outside of the samples {int(self.t_ns[0])} .. {int(self.t_ns[-1])} ns")
        t0, t1 = int(self.t_ns[right - 1]), int(self.t_ns[right])
        if t1 - t0 > self.max_gap_ns:
            raise FrameError(f"{what}: inside a gap of {(t1 - t0) / 1e9:.2f} s; at most {self.max_gap_ns / 1e9:.2f} s")
        return interpolate(self.poses[right - 1], self.poses[right], (t_ns - t0) / (t1 - t0))
