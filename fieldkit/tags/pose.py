"""The pose of one tag in one image: both solutions of the planar problem, refined, with covariance."""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldkit.cameras import Camera
from fieldkit.errors import TagError
from fieldkit.frames import Pose, exp, pose_from_matrix, skew
from fieldkit.tags.detect import TagDetection
from fieldkit.tags.lens import flat_covariance, flatten

Array = NDArray[np.float64]

MERGED_SIGMA_RAD = math.radians(3.0)


@dataclasses.dataclass(frozen=True)
class TagSolution:
    """A tag's pose in the camera with its 6x6 covariance, and the other solution of the planar problem.

    ``ambiguity`` is the residual of the better solution over that of the other one, 0..1: above 0.2 the choice is
    suspect, at 1 the image cannot tell them apart. Without another solution it is 0, or 1 where the tilt is so
    uncertain that both have merged. Residuals are root mean squares per coordinate, in pixels, weighted by the corners'
    covariance: the chi-square of a solution is 8 (rms_px / sigma_px)^2.
    """

    cam_from_tag: Pose
    covariance: Array
    rms_px: float
    alternative: Pose | None
    alternative_covariance: Array | None
    alternative_rms_px: float
    ambiguity: float


def tag_corners(size_m: float) -> Array:
    """Return the corners f64[4, 3] of a tag in its own frame: bottom-left, bottom-right, top-right, top-left.

    The tag frame has its origin at the centre, x to the right, y up, z out of the paper, as in apriltag_ros.
    """
    h = size_m / 2
    return np.array([[-h, -h, 0.0], [h, -h, 0.0], [h, h, 0.0], [-h, h, 0.0]])


def solve(detection: TagDetection, camera: Camera, size_m: float) -> TagSolution:
    """Solve cam_from_tag from the corners: IPPE (Collins and Bartoli 2014), both solutions refined by least squares.

    The residuals are differences of undistorted corners, weighted by their covariance ``detection.noise_px``. The
    covariance (right perturbation) is what this gives; errors of the calibration and of ``size_m`` are not in it.
    Raises TagError when no solution lies in front of the camera.
    """
    flat = flatten(camera, detection.corners_px)
    points = tag_corners(size_m)
    focal = np.asarray(camera.focal_px)
    noise = flat_covariance(camera, detection.corners_px, detection.noise_px)
    whitening = np.linalg.inv(np.linalg.cholesky(noise))
    found = []
    for start in _planar(flat / focal, points):
        cam_from_tag, residual, jacobian = _refine(start, flat, points, focal, whitening)
        if (cam_from_tag.apply(points)[:, 2] > 0).all():
            rms = detection.sigma_px * float(np.sqrt(np.mean(residual**2)))
            found.append((rms, cam_from_tag, jacobian))
    found.sort(key=lambda f: f[0])
    if not found:
        raise TagError(f"tag {detection.id}: its corners fit no pose in front of the camera; expected a convex square")
    rms, best, jacobian = found[0]
    others = [f for f in found[1:] if (best.inv() * f[1]).rotation.magnitude() > 1e-3]
    if not others:
        covariance = _covariance(jacobian)
        return TagSolution(best, covariance, rms, None, None, float("inf"), 0.0 if tilt_is_known(covariance) else 1.0)
    other_rms, other, other_jacobian = others[0]
    return TagSolution(
        best,
        _covariance(jacobian),
        rms,
        other,
        _covariance(other_jacobian),
        other_rms,
        rms / max(other_rms, 1e-12),
    )


def tilt_is_known(covariance: Array) -> bool:
    """Tell whether a pose's rotation is certain enough (3 deg, 1 sigma) for its two solutions not to have merged."""
    return float(np.linalg.eigvalsh(covariance[:3, :3])[-1]) < MERGED_SIGMA_RAD**2


def project_tag(cam_from_tag: Pose, points: Array, focal: ArrayLike) -> tuple[Array, Array]:
    """Return undistorted pixels (n, 2), about the principal point, and their derivative (n, 2, 6).

    The derivative is by a right perturbation of cam_from_tag: rotation, then translation.
    """
    f = np.asarray(focal)
    rotation = cam_from_tag.rotation.as_matrix()
    x_in_cam = points @ rotation.T + cam_from_tag.translation
    by_pose = np.zeros((len(points), 3, 6))
    by_pose[:, :, :3] = -rotation @ np.stack([skew(p) for p in points])
    by_pose[:, :, 3:] = rotation
    return x_in_cam[:, :2] / x_in_cam[:, 2:] * f, project_derivative(x_in_cam, f) @ by_pose


def project_derivative(x_in_cam: Array, focal: Array) -> Array:
    """Return the derivative (n, 2, 3) of undistorted pixels by points (n, 3) in the camera frame."""
    z = x_in_cam[:, 2]
    result = np.zeros((len(x_in_cam), 2, 3))
    result[:, 0, 0] = focal[0] / z
    result[:, 1, 1] = focal[1] / z
    result[:, :, 2] = -x_in_cam[:, :2] * focal / z[:, None] ** 2
    return result


def _planar(xy: Array, points: Array) -> list[Pose]:
    # solvePnPGeneric calls its order of solutions best first, but only by its own linear residual
    count, rotations, translations, _ = cv2.solvePnPGeneric(
        points[:, None], xy[:, None], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    poses = []
    for rotation, translation in zip(rotations[:count], translations[:count], strict=True):
        matrix = np.eye(4)
        matrix[:3, :3] = cv2.Rodrigues(rotation)[0]
        matrix[:3, 3] = translation.ravel()
        if np.isfinite(matrix).all():
            poses.append(pose_from_matrix(matrix))
    return poses


def _refine(start: Pose, flat: Array, points: Array, focal: Array, whitening: Array) -> tuple[Pose, Array, Array]:
    """Minimise the whitened residuals by Levenberg-Marquardt; return pose, residuals (8,) and Jacobian (8, 6)."""
    cam_from_tag, damping = start, 1e-6
    unit = np.repeat([1.0, float(np.linalg.norm(start.translation))], 3)
    predicted, derivative = project_tag(cam_from_tag, points, focal)
    residual, jacobian = whitening @ (flat - predicted).ravel(), whitening @ derivative.reshape(-1, 6)
    for _ in range(30):
        normal = jacobian.T @ jacobian
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), jacobian.T @ residual)
        candidate = cam_from_tag * exp(step)
        predicted, derivative = project_tag(candidate, points, focal)
        new = whitening @ (flat - predicted).ravel()
        if new @ new < residual @ residual:
            gain = residual @ residual - new @ new
            cam_from_tag, residual, jacobian = candidate, new, whitening @ derivative.reshape(-1, 6)
            damping = max(damping / 10, 1e-12)
            if gain < 1e-14:
                break
        elif damping > 1e6 or float(np.abs(step / unit).max()) < 1e-9:
            break
        else:
            damping *= 10
    return cam_from_tag, residual, jacobian


def _covariance(jacobian: Array) -> Array:
    covariance = np.asarray(np.linalg.inv(jacobian.T @ jacobian), dtype=np.float64)
    return (covariance + covariance.T) / 2
