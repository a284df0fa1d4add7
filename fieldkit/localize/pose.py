"""PnP with covariance: RANSAC by COLMAP, then a refinement that knows how uncertain every landmark is."""

from __future__ import annotations

import dataclasses

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fieldkit.frames import Pose
from fieldkit.localize.kernels import MIN_DEPTH_M, normal_equations

Array = NDArray[np.float64]

# Weights 1 / (1 + r^2) of whitened residuals r (Cauchy) overstate the covariance of Gaussian ones: for r of unit
# variance in two dimensions the asymptotic covariance is this factor times the inverse of the weighted information,
# E[g] E[g^2 r^2] / 2 / (E[g] + E[g' r] / 2)^2 with g the weight.
_CAUCHY_FACTOR = 0.6123
# Share of the landmarks' variance that all landmarks in view have in common, because the same mapping images placed
# them. Set on one synthesized room whose map has its scale from depth: there the trimmed normalised errors of photos
# and views are 0.8 and 0.6 per degree of freedom with it, 2.3 and 1.1 without. A wrong map scale is not in it.
_SHARED = 0.01
# Shares of the inlier bound at which RANSAC is started. Distant, nearly planar landmarks have two poses that agree
# with all of them within a wide bound; a tight one, and the sum of the residuals, tells them apart.
_STARTS = (1.0, 0.3, 0.12)


@dataclasses.dataclass(frozen=True)
class PosedPoints:
    """Matches of a query: undistorted pixels from the principal point (n, 2), landmarks (n, 3), their covariances
    (n, 3, 3), and the focal lengths in px."""

    pixels: Array
    xyz: Array
    xyz_covariance: Array
    focal_px: tuple[float, float]


@dataclasses.dataclass(frozen=True)
class Solved:
    """map_from_cam, its 6x6 covariance (right perturbation, rotation first), and bool[n] inliers."""

    map_from_cam: Pose
    covariance: Array
    inliers: NDArray[np.bool_]


def estimate_pose(points: PosedPoints, *, max_error_px: float, seed: int) -> Solved | None:
    """Estimate a camera pose from matches of which many may be wrong; None when no pose is found.

    The same points and seed give the same bits.
    """
    starts = [_ransac(points, max_error_px=max_error_px * share, seed=seed) for share in _STARTS]
    refined = [
        (*refine_pose(kept, start.map_from_cam), kept)
        for start in starts
        if start is not None
        for kept in [subset(points, start.inliers)]
    ]
    if not refined:
        return None
    map_from_cam, covariance, kept = min(refined, key=lambda r: _robust_cost(points, r[0]))
    residual, x_in_cam = _residuals(points, map_from_cam)
    inliers = (np.linalg.norm(residual, axis=1) <= max_error_px) & (x_in_cam[:, 2] > 0)
    return Solved(map_from_cam, covariance + shared_covariance(kept, map_from_cam), inliers)


def _robust_cost(points: PosedPoints, map_from_cam: Pose) -> float:
    """Return the Cauchy cost of all matches, right and wrong, at a pose."""
    return float(_sums(points, map_from_cam.rotation.as_matrix(), np.array(map_from_cam.translation))[2])


def _sums(points: PosedPoints, rotation: Array, position: Array) -> tuple[Array, Array, float]:
    """Return information (6, 6), gradient (6,) and Cauchy cost of all points at a pose map_from_cam."""
    arrays = (points.pixels, points.xyz, points.xyz_covariance, np.asarray(points.focal_px), rotation, position)
    information, gradient, cost = normal_equations(*(np.ascontiguousarray(a, dtype=np.float64) for a in arrays))
    return information, gradient, float(cost)


def _ransac(points: PosedPoints, *, max_error_px: float, seed: int) -> Solved | None:
    (fx, fy), extent = points.focal_px, 2.0 * float(np.abs(points.pixels).max()) + 1.0
    size = int(np.ceil(extent))
    camera = pycolmap.Camera(model="PINHOLE", width=size, height=size, params=[fx, fy, 0.0, 0.0])
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = max_error_px
    options.ransac.random_seed = seed
    options.ransac.num_threads = 1
    found = pycolmap.estimate_and_refine_absolute_pose(points.pixels, points.xyz, camera, options)
    if found is None:
        return None
    matrix = np.vstack([found["cam_from_world"].matrix(), [0.0, 0.0, 0.0, 1.0]])
    inliers = np.asarray(found["inlier_mask"], dtype=bool)
    if inliers.sum() < 4 or not np.isfinite(matrix).all():
        return None
    return Solved(Pose.from_matrix(matrix).inv(), np.zeros((6, 6)), inliers)


def refine_pose(points: PosedPoints, map_from_cam: Pose, *, iterations: int = 20) -> tuple[Pose, Array]:
    """Refine a pose on its inliers by reweighted Gauss-Newton and return it with its 6x6 covariance.

    Every residual is whitened by its own 2x2 covariance: 1 px of noise plus the landmark's uncertainty projected
    into the image; large residuals count less (Cauchy). The covariance takes the landmarks' errors as independent.
    """
    rotation, position = map_from_cam.rotation.as_matrix(), np.array(map_from_cam.translation)
    for _ in range(iterations):
        information, gradient, _ = _sums(points, rotation, position)
        step = np.linalg.lstsq(information, -gradient, rcond=None)[0]
        position = position + rotation @ step[3:]
        rotation = rotation @ Rotation.from_rotvec(step[:3]).as_matrix()
        if float(np.abs(step).max()) < 1e-9:
            break
    information, _, _ = _sums(points, rotation, position)
    covariance = _CAUCHY_FACTOR * np.linalg.pinv(information, hermitian=True)
    refined = Pose.from_components(position, Rotation.from_matrix(rotation))
    return refined, 0.5 * (covariance + covariance.T)


def shared_covariance(points: PosedPoints, map_from_cam: Pose) -> Array:
    """Return the 6x6 covariance of what no number of matches averages out: the error that nearby landmarks share.

    The landmarks in view are taken to be displaced together by a share of their mean variance, and turned about the
    camera by that displacement at their median distance.
    """
    displacement = _SHARED * log_mean(points.xyz_covariance)
    rotation = map_from_cam.rotation.as_matrix()
    distance = float(np.median(np.linalg.norm(points.xyz - map_from_cam.translation, axis=1)))
    result = np.zeros((6, 6))
    result[:3, :3] = np.eye(3) * np.trace(displacement) / 3.0 / max(distance, MIN_DEPTH_M) ** 2
    result[3:, 3:] = rotation.T @ displacement @ rotation
    return 0.5 * (result + result.T)


def log_mean(covariances: Array) -> Array:
    """Return the log-Euclidean mean (3, 3) of covariances (n, 3, 3): no single landmark rules it."""
    values, vectors = np.linalg.eigh(covariances)
    logs = np.einsum("nij,nj,nkj->nik", vectors, np.log(np.maximum(values, 1e-12)), vectors)
    mean_values, mean_vectors = np.linalg.eigh(logs.mean(axis=0))
    return np.asarray((mean_vectors * np.exp(mean_values)) @ mean_vectors.T)


def _residuals(points: PosedPoints, map_from_cam: Pose) -> tuple[Array, Array]:
    x_in_cam = map_from_cam.inv().apply(points.xyz)
    depth = np.maximum(x_in_cam[:, 2:], MIN_DEPTH_M)
    return x_in_cam[:, :2] / depth * points.focal_px - points.pixels, x_in_cam


def subset(points: PosedPoints, rows: NDArray[np.bool_]) -> PosedPoints:
    """Return the matches in ``rows`` bool[n]."""
    return PosedPoints(points.pixels[rows], points.xyz[rows], points.xyz_covariance[rows], points.focal_px)


def confidence(inliers_px: NDArray[np.float32], size: tuple[int, int]) -> float:
    """Return 0..1 from how many cells of a 16 x 16 grid over the image hold an inlier: half at 15 cells.

    Wrong poses have few inliers, or many on one repeated object; right ones have them all over the image.
    """
    cells = np.floor(inliers_px / (np.asarray(size) / 16.0)).astype(int)
    occupied = len(np.unique(cells, axis=0))
    return float(1.0 / (1.0 + np.exp(-(occupied - 15.0) / 3.0)))
