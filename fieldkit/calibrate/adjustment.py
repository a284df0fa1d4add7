"""One least-squares problem: cameras, landmarks with the map's covariance as prior, and tags with their corners.

Landmarks are eliminated by a Schur complement with 3x3 blocks (Triggs et al. 2000, Bundle Adjustment, section 6), so
that the solver knows cameras, tags and, on request, the logarithm of the tags' sizes. Poses are map_from_camera and
map_from_tag; they move by right perturbations, rotation first.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import scipy.linalg
import scipy.sparse
from numpy.typing import NDArray

from fieldkit.calibrate.geometry import Bearings, Poses, corner_bearings, project, skews
from fieldkit.cameras import Camera
from fieldkit.frames import Array
from fieldkit.tags import TagDetection, tag_corners

Mask = NDArray[np.bool_]
Ints = NDArray[np.int64]

# What is believed of a freed tag's size, 1 sigma of its logarithm: keeps it finite where nothing shows it
FREE_SIZE_SIGMA = 0.5


@dataclasses.dataclass(frozen=True)
class Reduced:
    """Chi-square of the landmarks and its quadratic about the cameras (p): normal (6p, 6p), gradient (6p,)."""

    normal: Array
    gradient: Array
    chi2: float


class LandmarkTerm(Protocol):
    """What landmarks say about the cameras, once the landmarks are eliminated."""

    def reduced(self, cameras: Poses) -> Reduced:
        """Return chi-square and normal equations at these cameras; the gradient points downhill."""
        ...


@dataclasses.dataclass(frozen=True)
class Landmarks:
    """Observations (o) of landmarks (l) by photos: indices, bearings, and the landmarks as the map has them.

    ``rows`` int[l] are the landmarks' rows in the map.
    """

    rows: Ints
    photo: Ints
    landmark: Ints
    bearings: Bearings
    xyz: Array
    information: Array
    n_photos: int

    @staticmethod
    def of(seen: Sequence[tuple[Ints, Bearings]], xyz: Array, covariance: Array) -> Landmarks:
        """Stack photos, each with the landmarks (n,) that it sees, rows of ``xyz`` and ``covariance``, and bearings."""
        photo = np.repeat(np.arange(len(seen)), [len(rows) for rows, _ in seen])
        used, landmark = np.unique(np.concatenate([rows for rows, _ in seen]), return_inverse=True)
        stacked = Bearings(np.concatenate([b.xy for _, b in seen]), np.concatenate([b.whitening for _, b in seen]))
        return Landmarks(used, photo, landmark, stacked, xyz[used], np.linalg.inv(covariance[used]), len(seen))

    @property
    def freedom(self) -> int:
        """Residuals less parameters, landmarks with their priors included."""
        return 2 * len(self.photo) - 6 * self.n_photos

    def reduced(self, cameras: Poses) -> Reduced:
        """Return chi-square and normal equations at these cameras, the landmarks at their best."""
        xyz = self.xyz
        for _ in range(2):
            residual, by_camera, by_landmark = self._linearise(cameras, xyz)
            hessian, downhill = self._by_landmark(residual, by_landmark, xyz)
            xyz = xyz + np.linalg.solve(hessian, downhill[..., None])[..., 0]
        residual, by_camera, by_landmark = self._linearise(cameras, xyz)
        hessian, downhill = self._by_landmark(residual, by_landmark, xyz)
        offset = xyz - self.xyz
        chi2 = float((residual**2).sum() + np.einsum("li,lij,lj->", offset, self.information, offset))
        size = 6 * self.n_photos
        coupling, root = self._coupling(by_camera, by_landmark, hessian)
        normal = -(coupling @ coupling.T).toarray()
        gradient = -(coupling @ np.linalg.solve(root, downhill[..., None]).reshape(-1))
        own = np.zeros((self.n_photos, 6, 6))
        np.add.at(own, self.photo, by_camera.transpose(0, 2, 1) @ by_camera)
        direct = np.zeros((self.n_photos, 6))
        np.add.at(direct, self.photo, np.einsum("oai,oa->oi", by_camera, residual))
        for i in range(self.n_photos):
            normal[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] += own[i]
        return Reduced(normal.reshape(size, size), gradient + direct.reshape(-1), chi2)

    def response(self, centre: Poses, normal: Array) -> Array:
        """Return f64[6p, 3l]: how the cameras follow displacements of the landmarks in the map, to first order.

        ``centre`` and ``normal`` (6p, 6p) as `adjust_cameras` finds them.
        """
        residual, by_camera, by_landmark = self._linearise(centre, self.xyz)
        hessian, _ = self._by_landmark(residual, by_landmark, self.xyz)
        believed = np.linalg.solve(hessian, self.information)
        blocks = -by_camera.transpose(0, 2, 1) @ by_landmark @ believed[self.landmark]
        pulls = np.zeros((self.n_photos, len(self.xyz), 6, 3))
        np.add.at(pulls, (self.photo, self.landmark), blocks)
        return np.asarray(np.linalg.solve(normal, pulls.transpose(0, 2, 1, 3).reshape(6 * self.n_photos, -1)))

    def _linearise(self, cameras: Poses, xyz: Array) -> tuple[Array, Array, Array]:
        """Return whitened residuals (o, 2) and the derivative by camera (o, 2, 6) and by landmark (o, 2, 3)."""
        back = cameras.rotation.transpose(0, 2, 1)[self.photo]
        x_in_cam = np.einsum("oij,oj->oi", back, xyz[self.landmark] - cameras.position[self.photo])
        xy, slope = project(x_in_cam)
        slope = self.bearings.whitening @ slope
        residual = np.einsum("oij,oj->oi", self.bearings.whitening, self.bearings.xy - xy)
        return residual, np.concatenate([slope @ skews(x_in_cam), -slope], axis=2), slope @ back

    def _by_landmark(self, residual: Array, by_landmark: Array, xyz: Array) -> tuple[Array, Array]:
        hessian, downhill = self.information.copy(), np.einsum("lij,lj->li", self.information, self.xyz - xyz)
        np.add.at(hessian, self.landmark, by_landmark.transpose(0, 2, 1) @ by_landmark)
        np.add.at(downhill, self.landmark, np.einsum("oai,oa->oi", by_landmark, residual))
        return hessian, downhill

    def _coupling(self, by_camera: Array, by_landmark: Array, hessian: Array) -> tuple[scipy.sparse.csr_array, Array]:
        """Return W L^-T (6p, 3l) of the camera-landmark blocks W and the landmarks' Hessians L L^T, and L."""
        root = np.asarray(np.linalg.cholesky(hessian), dtype=np.float64)
        mixed = by_landmark.transpose(0, 2, 1) @ by_camera
        block = np.asarray(np.linalg.solve(root[self.landmark], mixed), dtype=np.float64).transpose(0, 2, 1)
        rows = np.broadcast_to(6 * self.photo[:, None, None] + np.arange(6)[:, None], block.shape)
        columns = np.broadcast_to(3 * self.landmark[:, None, None] + np.arange(3), block.shape)
        shape = (6 * self.n_photos, 3 * len(self.xyz))
        return scipy.sparse.csr_array((block.ravel(), (rows.ravel(), columns.ravel())), shape=shape), root


@dataclasses.dataclass(frozen=True)
class FixedLandmarks:
    """Landmarks as one quadratic about the cameras that they want: exact to second order, and far cheaper."""

    centre: Poses
    normal: Array
    chi2: float

    def reduced(self, cameras: Poses) -> Reduced:
        """Return chi-square and normal equations at these cameras."""
        offset = self.centre.difference(cameras).ravel()
        pull = self.normal @ offset
        return Reduced(self.normal, -pull, self.chi2 + float(offset @ pull))

    @functools.cached_property
    def covariance(self) -> Array:
        """The cameras' covariance f64[6p, 6p]."""
        return _symmetric(np.asarray(np.linalg.inv(self.normal), dtype=np.float64))

    def camera_covariance(self, photo: int) -> Array:
        """Return the 6x6 covariance of one camera."""
        return self.covariance[6 * photo : 6 * photo + 6, 6 * photo : 6 * photo + 6]

    def warped(self, shared: Array) -> FixedLandmarks:
        """Return the same with the covariance ``shared`` f64[6p, 6p] of what the landmarks are wrong by together."""
        total = _symmetric(self.covariance + shared)
        return FixedLandmarks(self.centre, _symmetric(np.asarray(np.linalg.inv(total), dtype=np.float64)), self.chi2)

    def loosened(self, scale: float) -> FixedLandmarks:
        """Return the same with every camera ``scale`` times as uncertain, the excess independent between photos.

        Each photo is off by itself too: its camera's calibration, its keypoints' bias, and the warp of the landmarks
        in its view. Landmarks that photos share must not hide that.
        """
        if scale == 1.0:
            return self
        total = self.covariance.copy()
        for i in range(len(self.centre)):
            own = self.camera_covariance(i)
            per_axis = np.repeat([np.trace(own[:3, :3]) / 3, np.trace(own[3:, 3:]) / 3], 3)
            block = np.arange(6 * i, 6 * i + 6)
            total[block, block] += (scale**2 - 1.0) * per_axis
        return FixedLandmarks(self.centre, _symmetric(np.asarray(np.linalg.inv(total), dtype=np.float64)), self.chi2)


@dataclasses.dataclass(frozen=True)
class Corners:
    """Sightings (c) of tags (t): photo and tag of each, and where its corners are seen.

    ``xy`` f64[c, 4, 2] at depth 1, and ``whitening`` f64[c, 8, 8] that turns small differences of them into standard
    deviations of the corners' noise.
    """

    photo: Ints
    tag: Ints
    xy: Array
    whitening: Array

    @staticmethod
    def of(sightings: Sequence[tuple[int, int, Camera, TagDetection]]) -> Corners:
        """Stack sightings, each with its photo, its tag, the camera and the detection."""
        seen = [corner_bearings(camera, d.corners_px, d.noise_px) for _, _, camera, d in sightings]
        return Corners(
            np.array([p for p, _, _, _ in sightings], dtype=np.int64),
            np.array([t for _, t, _, _ in sightings], dtype=np.int64),
            np.stack([xy for xy, _ in seen]),
            np.stack([whitening for _, whitening in seen]),
        )

    def __len__(self) -> int:
        return len(self.photo)

    def residuals(self, state: State) -> Array:
        """Return the whitened residuals f64[c, 8]."""
        return self._predict(state)[0]

    def linearise(self, state: State) -> tuple[Array, Array]:
        """Return whitened residuals (c, 8) and the derivative (c, 8, 6p + 6t + t): cameras, tags, sizes."""
        residual, slope, x_in_cam, cam_from_map = self._predict(state)
        c, n_photos, n_tags = len(self), len(state.cameras), len(state.tags)
        points = self._points(state)
        cam_from_tag = (cam_from_map @ state.tags.rotation[self.tag])[:, None]
        by_camera = np.concatenate([slope @ skews(x_in_cam.reshape(-1, 3)).reshape(c, 4, 3, 3), -slope], axis=3)
        turn = -(cam_from_tag @ skews(points.reshape(-1, 3)).reshape(c, 4, 3, 3))
        by_tag = slope @ np.concatenate([turn, np.broadcast_to(cam_from_tag, turn.shape)], axis=3)
        by_size = slope @ (cam_from_tag @ points[..., None])
        own = self.whitening @ np.concatenate([by_camera, by_tag, by_size], axis=3).reshape(c, 8, 13)
        result = np.zeros((c, 8, 6 * n_photos + 7 * n_tags))
        for i, (photo, tag) in enumerate(zip(self.photo, self.tag, strict=True)):
            result[i, :, 6 * photo : 6 * photo + 6] = own[i, :, :6]
            first = 6 * (n_photos + tag)
            result[i, :, first : first + 6] = own[i, :, 6:12]
            result[i, :, 6 * (n_photos + n_tags) + tag] = own[i, :, 12]
        return residual, result

    def chosen(self, rows: Mask, photo: Ints) -> Corners:
        """Return some of the sightings (bool[c]), their photos renumbered to ``photo``."""
        return Corners(photo, self.tag[rows], self.xy[rows], self.whitening[rows])

    def _points(self, state: State) -> Array:
        return tag_corners(1.0) * state.sizes_m[self.tag][:, None, None]

    def _predict(self, state: State) -> tuple[Array, Array, Array, Array]:
        c = len(self)
        tag_rotation, tag_position = state.tags.rotation[self.tag], state.tags.position[self.tag]
        cam_from_map = state.cameras.rotation[self.photo].transpose(0, 2, 1)
        x_in_map = np.einsum("cij,ckj->cki", tag_rotation, self._points(state)) + tag_position[:, None]
        x_in_cam = np.einsum("cij,ckj->cki", cam_from_map, x_in_map - state.cameras.position[self.photo][:, None])
        xy, slope = project(x_in_cam.reshape(-1, 3))
        residual = np.einsum("cij,cj->ci", self.whitening, (self.xy - xy.reshape(c, 4, 2)).reshape(c, 8))
        return residual, slope.reshape(c, 4, 2, 3), x_in_cam, cam_from_map


@dataclasses.dataclass(frozen=True)
class State:
    """All that is solved for but the landmarks: cameras (p), tags (t), and the tags' sizes (t,) in m."""

    cameras: Poses
    tags: Poses
    sizes_m: Array

    def moved(self, step: Array) -> State:
        """Return the state after a step (6p + 6t + t,)."""
        n, m = 6 * len(self.cameras), 6 * (len(self.cameras) + len(self.tags))
        cameras, tags = self.cameras.moved(step[:n].reshape(-1, 6)), self.tags.moved(step[n:m].reshape(-1, 6))
        return State(cameras, tags, self.sizes_m * np.exp(step[m:]))


@dataclasses.dataclass(frozen=True)
class Adjusted:
    """A solved problem: the state, residuals (c, 8) and derivative (c, 8, n) of every sighting, used or not, and the
    covariance f64[n, n] of cameras, tags and the logarithms of sizes.

    The rows of what is not solved for, sizes that are given and tags that nobody sees, are zero. ``chi2`` is the sum
    of landmarks and used sightings.
    """

    state: State
    residual: Array
    derivative: Array
    covariance: Array
    solved: Mask
    used: Mask
    chi2: float

    def tag_covariance(self, tag: int) -> Array:
        """Return the 6x6 covariance of one tag."""
        first = 6 * (len(self.state.cameras) + tag)
        return self.covariance[first : first + 6, first : first + 6]


def adjust_cameras(landmarks: Landmarks, start: Poses, *, iterations: int = 15) -> FixedLandmarks:
    """Find the cameras that the landmarks alone want, and return what the landmarks say as one quadratic."""
    cameras, damping = start, 1e-6
    here = landmarks.reduced(cameras)
    for _ in range(iterations):
        step = _solve(here.normal + damping * np.diag(np.diag(here.normal)), here.gradient)
        candidate = cameras.moved(step.reshape(-1, 6))
        there = landmarks.reduced(candidate)
        if np.isfinite(there.chi2) and there.chi2 <= here.chi2:
            gain, cameras, here, damping = here.chi2 - there.chi2, candidate, there, max(damping / 10, 1e-12)
            if gain < 1e-9 * (1.0 + here.chi2) or float(np.abs(step).max()) < 1e-10:
                break
        elif damping > 1e6 or float(np.abs(step).max()) < 1e-10:
            break
        else:
            damping *= 10
    return FixedLandmarks(cameras, here.normal, here.chi2)


def adjust(
    landmarks: LandmarkTerm,
    corners: Corners,
    start: State,
    *,
    used: Mask,
    free_sizes: Mask | None = None,
    iterations: int = 30,
) -> Adjusted:
    """Solve for cameras and tags, and the sizes of tags in ``free_sizes`` bool[t], by Levenberg-Marquardt.

    ``used`` bool[c]: the sightings that enter. The covariance is the inverse of the reduced normal matrix. Raises
    LinAlgError where the landmarks leave a camera undetermined.
    """
    problem = _Problem(landmarks, corners, used, _solved(corners, start, used, free_sizes), start.sizes_m)
    state, damping = start, 1e-6
    chi2, normal, downhill = problem.equations(state)
    for _ in range(iterations):
        step = np.zeros(len(problem.solved))
        step[problem.solved] = _solve(normal + damping * np.diag(np.diag(normal)), downhill)
        there = problem.equations(state.moved(step))
        if np.isfinite(there[0]) and there[0] <= chi2:
            gain, state, damping = chi2 - there[0], state.moved(step), max(damping / 10, 1e-12)
            chi2, normal, downhill = there
            if gain < 1e-11 * (1.0 + chi2) or float(np.abs(step).max()) < 1e-11:
                break
        elif damping > 1e6 or float(np.abs(step).max()) < 1e-11:
            break
        else:
            damping *= 10
    inverse = _solve(normal, np.eye(len(normal)))
    covariance = np.zeros((len(problem.solved),) * 2)
    covariance[np.ix_(problem.solved, problem.solved)] = _symmetric(inverse)
    residual, derivative = corners.linearise(state)
    return Adjusted(state, residual, derivative, covariance, problem.solved, used, chi2)


@dataclasses.dataclass(frozen=True)
class _Problem:
    landmarks: LandmarkTerm
    corners: Corners
    used: Mask
    solved: Mask
    sizes_m: Array

    def equations(self, state: State) -> tuple[float, Array, Array]:
        """Return chi-square, the normal matrix and the downhill gradient of what is solved for."""
        said = self.landmarks.reduced(state.cameras)
        residual, derivative = self.corners.linearise(state)
        residual, derivative = residual[self.used], derivative[self.used]
        stacked = derivative.reshape(-1, derivative.shape[2])
        normal, downhill = stacked.T @ stacked, stacked.T @ residual.ravel()
        n = len(said.gradient)
        normal[:n, :n] += said.normal
        downhill[:n] += said.gradient
        grown = np.log(state.sizes_m / self.sizes_m) / FREE_SIZE_SIGMA
        first = len(downhill) - len(grown)
        normal[first:, first:] += np.eye(len(grown)) / FREE_SIZE_SIGMA**2
        downhill[first:] -= grown / FREE_SIZE_SIGMA
        chi2 = said.chi2 + float((residual**2).sum() + grown @ grown)
        return chi2, normal[np.ix_(self.solved, self.solved)], downhill[self.solved]


def _solved(corners: Corners, start: State, used: Mask, free_sizes: Mask | None) -> Mask:
    """Return bool[6p + 6t + t]: every camera, the tags that are seen, and the sizes that are free."""
    seen = np.zeros(len(start.tags), dtype=bool)
    seen[corners.tag[used]] = True
    free = seen & (False if free_sizes is None else free_sizes)
    return np.concatenate([np.ones(6 * len(start.cameras), dtype=bool), np.repeat(seen, 6), free])


def _symmetric(matrix: Array) -> Array:
    return (matrix + matrix.T) / 2


def _solve(normal: Array, right: Array) -> Array:
    """Solve with a positive definite matrix whose rows differ in unit; raises LinAlgError where it is singular."""
    unit = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    factor = scipy.linalg.cho_factor(normal * unit[:, None] * unit, check_finite=False)
    scaled = right * (unit if right.ndim == 1 else unit[:, None])
    solution = scipy.linalg.cho_solve(factor, scaled, check_finite=False)
    return np.asarray(solution * (unit if right.ndim == 1 else unit[:, None]))
