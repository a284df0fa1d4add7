"""PnP of one camera or a rig: RANSAC by COLMAP, then a refinement that knows how uncertain every landmark is."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fieldkit.frames import Pose, adjoint, log
from fieldkit.localize.kernels import MIN_DEPTH_M, cauchy_cost, linearise, refine

Array = NDArray[np.float64]

# How many matches the expected noise of the pixels is worth, against that which their residuals show
EXPECTED_MATCHES = 40.0
# Multiples of the expected noise within which a pose is first refined and told from others: these are not exact yet
_FIRST_NOISE = 2.5
# Poses whose cost is higher by this count e times less
_UNDECIDED = 5.0
# Residuals of this many standard deviations have half of the weight: 95 % as good as least squares on Gaussian ones
_SCALE = 3.0
_ITERATIONS = 20
# Share of the variance that matches in one cell have in common: they lie on the same edges, lit and blurred alike
_SHARED, _CELL_PX = 0.5, 16.0
# Information that every pose has: what matches leave open has a standard deviation of 100 rad and 100 m, not none
_UNKNOWN = 1e-4 * np.eye(6)
# Median of chi-square with 2 degrees of freedom
_MEDIAN_CHI2 = 2.0 * math.log(2.0)
# Shares of the inlier bound at which RANSAC is started. Distant, nearly planar landmarks have two poses that agree
# with all of them within a wide bound; a tight one, and the sum of the residuals, tells them apart.
_STARTS = (1.0, 0.3, 0.12)


@dataclasses.dataclass(frozen=True)
class PosedPoints:
    """Matches of a camera: undistorted pixels from the principal point (n, 2), their expected noise per axis in px (n),
    landmarks (n, 3), their covariances (n, 3, 3), and the focal lengths in px; ``rig_from_cam`` where the camera is
    one of a rig. ``stretch`` (n): by how much undistorting magnified the image there, None without distortion.
    """

    pixels: Array
    sigma_px: Array
    xyz: Array
    xyz_covariance: Array
    focal_px: tuple[float, float]
    rig_from_cam: Pose | None = None
    stretch: Array | None = None


@dataclasses.dataclass(frozen=True)
class Solved:
    """map_from_rig (of one camera: map_from_cam), its 6x6 covariance (right perturbation, rotation first), bool[n]
    inliers of each camera, the multiple of the expected noise that the residuals show, and how the pose follows the
    matched landmarks of all cameras, f64[6, 3n].

    The covariance has the pixels' noise and every landmark's own; not what landmarks are wrong by together.
    """

    map_from_rig: Pose
    covariance: Array
    inliers: tuple[NDArray[np.bool_], ...]
    noise: float
    response: Array


@dataclasses.dataclass(frozen=True)
class _Stacked:
    """The matches of all cameras as `kernels` take them."""

    pixels: Array
    sigma_px: Array
    xyz: Array
    covariance: Array
    focal_px: Array
    camera: NDArray[np.int64]
    rig_rotation: Array
    rig_position: Array

    @staticmethod
    def of(cameras: Sequence[PosedPoints]) -> _Stacked:
        """Stack cameras."""
        counts = [len(c.xyz) for c in cameras]
        focal_px = np.array([c.focal_px for c in cameras], dtype=np.float64).reshape(-1, 2)
        camera = np.repeat(np.arange(len(cameras)), counts)
        return _Stacked(
            np.concatenate([c.pixels for c in cameras]),
            np.concatenate([c.sigma_px for c in cameras]),
            np.concatenate([c.xyz for c in cameras]),
            np.concatenate([c.xyz_covariance for c in cameras]),
            focal_px[camera],
            camera,
            np.stack([_from_rig(c).rotation.as_matrix() for c in cameras]),
            np.stack([np.asarray(_from_rig(c).translation) for c in cameras]),
        )

    def arguments(self, noise: float) -> tuple[NDArray[Any], ...]:
        """Return what every kernel takes first; ``noise`` multiplies the expected one."""
        variance = (noise * self.sigma_px) ** 2
        return (
            self.pixels, variance, self.xyz, self.covariance, self.focal_px, self.camera, self.rig_rotation,
            self.rig_position,
        )  # fmt: skip

    def linear(self, map_from_rig: Pose, noise: float) -> tuple[Array, Array]:
        """Return whitened rows f64[n, 2, 7] (derivatives by the pose, residual), and f64[n, 2, 3] by landmarks."""
        rows, by_landmark = np.empty((len(self.xyz), 2, 7)), np.empty((len(self.xyz), 2, 3))
        rotation, position = map_from_rig.rotation.as_matrix(), np.array(map_from_rig.translation)
        linearise(*self.arguments(noise), rotation, position, rows, by_landmark)
        return rows, by_landmark

    def refined(self, map_from_rig: Pose, noise: float, scale: float) -> Pose:
        """Return the pose of least Cauchy cost near another."""
        rotation, position = map_from_rig.rotation.as_matrix(), np.array(map_from_rig.translation)
        rows, by_landmark = np.empty((len(self.xyz), 2, 7)), np.empty((len(self.xyz), 2, 3))
        refine(*self.arguments(noise), rotation, position, scale**2, _ITERATIONS, rows, by_landmark)
        return Pose.from_components(position, Rotation.from_matrix(rotation))


def estimate_pose(cameras: Sequence[PosedPoints], *, max_error_px: float, seed: int) -> Solved | None:
    """Estimate the pose of a camera, or of a rig, from matches of which many may be wrong; None when none is found.

    The same points and seed give the same bits. A rig of which one camera has matches is that camera alone.
    """
    with_matches = [c for c in cameras if len(c.xyz)]
    if len(with_matches) == 1 and with_matches[0].rig_from_cam is not None:
        alone = dataclasses.replace(with_matches[0], rig_from_cam=None)
        solved = estimate_pose([alone], max_error_px=max_error_px, seed=seed)
        return None if solved is None else _carried(solved, cameras, with_matches[0].rig_from_cam.inv())
    starts = [_ransac(cameras, max_error_px=max_error_px * share, seed=seed) for share in _STARTS]
    settled = (_settled(cameras, *start, max_error_px) for start in starts if start is not None)
    refined = [pose for pose in settled if pose is not None]
    if not refined:
        return None
    costs = [_cost(cameras, pose) for pose in refined]
    best = refined[int(np.argmin(costs))]
    inliers = _inliers(cameras, best, max_error_px)
    if sum(int(i.sum()) for i in inliers) < 4:
        return None
    kept = _subsets(cameras, inliers)
    noise = shown_noise(kept, best)
    map_from_rig, covariance, response = refine_pose(kept, best, noise=noise)
    every = np.zeros((6, sum(len(c.xyz) for c in cameras), 3))
    every[:, np.concatenate(inliers)] = response.reshape(6, -1, 3)
    inliers = _inliers(cameras, map_from_rig, max_error_px)
    covariance = covariance + _between(map_from_rig, refined, costs)
    return Solved(map_from_rig, covariance, inliers, noise, every.reshape(6, -1))


def refine_pose(
    cameras: Sequence[PosedPoints], map_from_rig: Pose, *, noise: float, scale: float = _SCALE
) -> tuple[Pose, Array, Array]:
    """Refine a pose on its inliers by reweighted Gauss-Newton; return it, its 6x6 covariance, and f64[6, 3n].

    Every residual is whitened by its own 2x2 covariance: ``noise`` times the expected one plus the landmark's
    uncertainty projected into the image; those of ``scale`` standard deviations have half of the weight. The
    covariance is that of an M-estimator (Huber and Ronchetti, Robust Statistics, 7.6) whose noise is the residuals',
    pooled with the expected; it takes the landmarks' errors as independent, and directions that the matches leave open
    as unknown (100 rad, 100 m). The last is how the pose follows the
    landmarks.
    """
    stacked = _Stacked.of(cameras)
    refined = stacked.refined(map_from_rig, noise, scale)
    rows, by_landmark = stacked.linear(refined, noise)
    squared, by_pose = _squared(rows), rows[:, :, :6]
    # For weights 1 / (1 + r^2 / c^2) in two dimensions the mean derivative of the weighted residual is that of their
    # squares, too.
    slope = (1.0 + squared / scale**2) ** -2
    variance = (0.5 * slope @ squared + EXPECTED_MATCHES) / (max(slope.sum() - 3.0, 0.0) + EXPECTED_MATCHES)
    weighted = slope[:, None, None] * by_pose
    alone = np.einsum("nai,naj->ij", weighted, by_pose)
    inverse = np.linalg.inv(alone + _UNKNOWN)
    response = -np.einsum("ij,njk->ink", inverse, np.einsum("naj,nak->njk", weighted, by_landmark))
    spread = inverse @ ((1.0 - _SHARED) * alone + _SHARED * _crowded(stacked, weighted) + _UNKNOWN) @ inverse
    return refined, 0.5 * variance * (spread + spread.T), response.reshape(6, -1)


def _crowded(stacked: _Stacked, weighted: Array) -> Array:
    """Return the information (6, 6) that matches would have whose errors are the same in every cell of the image."""
    cells = np.column_stack([stacked.camera, np.floor(stacked.pixels / _CELL_PX).astype(np.int64)])
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    sums = np.zeros((int(cell.max(initial=-1)) + 1, 2, 6))
    np.add.at(sums, cell.ravel(), weighted)
    return np.asarray(np.einsum("cai,caj->ij", sums, sums))


def shown_noise(cameras: Sequence[PosedPoints], map_from_rig: Pose) -> float:
    """Return the multiple of the pixels' expected noise that half of the residuals show, pooled with the expected one.

    The landmarks' own uncertainty is taken off.
    """
    stacked, shown = _Stacked.of(cameras), 1.0
    count = len(stacked.xyz)
    for _ in range(4):
        squared = _squared(stacked.linear(map_from_rig, math.sqrt(shown))[0])
        shown = max(shown * float(np.median(squared)) / _MEDIAN_CHI2, 0.01)
    shown *= count / max(count - 3.0, 1.0)
    return math.sqrt((count * shown + EXPECTED_MATCHES) / (count + EXPECTED_MATCHES))


def _settled(
    cameras: Sequence[PosedPoints], map_from_rig: Pose, inliers: Sequence[NDArray[np.bool_]], max_error_px: float
) -> Pose | None:
    """Return where a pose settles: starts that mean the same pose end at the same one."""
    for _ in range(2):
        map_from_rig = _Stacked.of(_subsets(cameras, inliers)).refined(map_from_rig, _FIRST_NOISE, 1.0)
        inliers = _inliers(cameras, map_from_rig, max_error_px)
        if sum(int(i.sum()) for i in inliers) < 4:
            return None
    return map_from_rig


def _cost(cameras: Sequence[PosedPoints], map_from_rig: Pose) -> float:
    """Return the Cauchy cost of all matches, right and wrong, at a pose."""
    return float(cauchy_cost(_Stacked.of(cameras).linear(map_from_rig, _FIRST_NOISE)[0], 1.0))


def _squared(rows: Array) -> Array:
    return np.asarray((rows[:, :, 6] ** 2).sum(axis=1))


def _between(map_from_rig: Pose, others: Sequence[Pose], costs: Sequence[float]) -> Array:
    """Return the 6x6 covariance of not knowing which of the poses that were found is the right one.

    Small planes and short rows of landmarks are seen nearly the same from several places, and what is wrong with a
    map or a camera, not noise, decides which of these fits best.
    """
    weights = np.exp(-(np.asarray(costs) - min(costs)) / _UNDECIDED)
    offsets = np.stack([log(map_from_rig.inv() * other) for other in others])
    return np.asarray(np.einsum("n,ni,nj->ij", weights / weights.sum(), offsets, offsets))


def _carried(solved: Solved, cameras: Sequence[PosedPoints], cam_from_rig: Pose) -> Solved:
    """Return what is known of one camera as what is known of its rig."""
    inliers = tuple(solved.inliers[0] if len(c.xyz) else np.zeros(0, dtype=bool) for c in cameras)
    transport = adjoint(cam_from_rig.inv())
    return Solved(
        solved.map_from_rig * cam_from_rig,
        transport @ solved.covariance @ transport.T,
        inliers,
        solved.noise,
        transport @ solved.response,
    )


def _ransac(
    cameras: Sequence[PosedPoints], *, max_error_px: float, seed: int
) -> tuple[Pose, tuple[NDArray[np.bool_], ...]] | None:
    """Return a pose map_from_rig and the inliers of each camera."""
    models = [_pinhole(c) for c in cameras]
    if cameras[0].rig_from_cam is None:
        options = pycolmap.AbsolutePoseEstimationOptions()
        options.ransac.max_error = max_error_px
        options.ransac.random_seed = seed
        options.ransac.num_threads = 1
        found = pycolmap.estimate_absolute_pose(cameras[0].pixels, cameras[0].xyz, models[0], options)
    else:
        ransac = pycolmap.RANSACOptions()
        ransac.max_error, ransac.random_seed, ransac.num_threads = max_error_px, seed, 1
        cams_from_rig = [pycolmap.Rigid3d(_from_rig(c).inv().as_matrix()[:3]) for c in cameras]
        found = pycolmap.estimate_generalized_absolute_pose(
            np.concatenate([c.pixels for c in cameras]),
            np.concatenate([c.xyz for c in cameras]),
            np.repeat(np.arange(len(cameras)), [len(c.xyz) for c in cameras]),
            cams_from_rig,
            models,
            ransac,
        )
    if found is None:
        return None
    matrix = np.vstack(
        [found["cam_from_world" if "cam_from_world" in found else "rig_from_world"].matrix(), [0, 0, 0, 1]]
    )
    inliers = np.asarray(found["inlier_mask"], dtype=bool)
    if inliers.sum() < 4 or not np.isfinite(matrix).all():
        return None
    parts = np.split(inliers, np.cumsum([len(c.xyz) for c in cameras])[:-1])
    return Pose.from_matrix(matrix).inv(), tuple(parts)


def _from_rig(camera: PosedPoints) -> Pose:
    return Pose.identity() if camera.rig_from_cam is None else camera.rig_from_cam


def _pinhole(camera: PosedPoints) -> pycolmap.Camera:
    size = math.ceil(2.0 * float(np.abs(camera.pixels).max(initial=0.0)) + 1.0)
    return pycolmap.Camera(model="PINHOLE", width=size, height=size, params=[*camera.focal_px, 0.0, 0.0])


def _inliers(cameras: Sequence[PosedPoints], map_from_rig: Pose, max_error_px: float) -> tuple[NDArray[np.bool_], ...]:
    return tuple(residuals_px(c, map_from_rig) <= max_error_px for c in cameras)


def residuals_px(camera: PosedPoints, map_from_rig: Pose) -> Array:
    """Return f64[n]: by how many pixels of the image matches miss their landmarks; inf behind the camera."""
    x_in_cam = (map_from_rig * _from_rig(camera)).inv().apply(camera.xyz)
    depth = np.maximum(x_in_cam[:, 2:], MIN_DEPTH_M)
    missed = np.linalg.norm(x_in_cam[:, :2] / depth * camera.focal_px - camera.pixels, axis=1)
    missed = missed if camera.stretch is None else missed / camera.stretch
    return np.where(x_in_cam[:, 2] > 0, missed, np.inf)


def _subsets(cameras: Sequence[PosedPoints], inliers: Sequence[NDArray[np.bool_]]) -> list[PosedPoints]:
    return [subset(c, rows) for c, rows in zip(cameras, inliers, strict=True)]


def subset(points: PosedPoints, rows: NDArray[np.bool_]) -> PosedPoints:
    """Return the matches in ``rows`` bool[n]."""
    return dataclasses.replace(
        points,
        pixels=points.pixels[rows],
        sigma_px=points.sigma_px[rows],
        xyz=points.xyz[rows],
        xyz_covariance=points.xyz_covariance[rows],
        stretch=None if points.stretch is None else points.stretch[rows],
    )
