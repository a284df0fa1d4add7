"""Sightings of known tags by a standing robot as one least-squares problem.

Unknown are the body at the reference, the error of the camera in the hand, which all images share, the steps that the
body made between its stands, and the tags, each with its own covariance as prior. The noise of the arm that is anew in
every image is eliminated into the weights.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from fieldkit.cameras import Camera
from fieldkit.errors import TagError
from fieldkit.frames import Array, Pose, adjoint, exp, log
from fieldkit.protocol import ArmNoise
from fieldkit.tags.pose import tag_corners
from fieldkit.tags.sightings import BodySighting, BodySightings, Place
from fieldkit.types import TagPose

# Added to a tag's variances, in rad^2 and m^2, and as a share of them: a tag that is known exactly, or exactly along a
# direction in rounded numbers, has a covariance without inverse
EXACT, ROUNDED = 1e-12, 2e-6


@dataclasses.dataclass(frozen=True)
class Part:
    """The sightings of one tag that agree with each other."""

    tag: TagPose
    sightings: tuple[BodySighting, ...]


def by_unknowns(place: Place, steps: Sequence[Pose]) -> Array:
    """Return the derivative (6, 12 + 6 s) of a camera's pose by body, shared error and steps (right perturbations)."""
    result = np.zeros((6, 12 + 6 * len(steps)))
    cam_from_ref = place.ref_from_cam.inv()
    result[:, :6] = adjoint(cam_from_ref)
    result[:, 6:12] = np.eye(6)
    for index in range(place.stand, len(steps)):
        result[:, 12 + 6 * index : 18 + 6 * index] = adjoint(cam_from_ref * steps[index])
    return result


def by_steps(place: Place, steps: Sequence[Pose]) -> Array:
    """Return the derivative (6, 6 s) of ref_from_body of a frame by the errors of the steps after its stand."""
    result = np.zeros((6, 6 * len(steps)))
    body_from_ref = place.ref_from_body.inv()
    for index in range(place.stand, len(steps)):
        result[:, 6 * index : 6 * index + 6] = adjoint(body_from_ref * steps[index])
    return result


@dataclasses.dataclass
class State:
    """The unknowns while they are refined."""

    map_from_body: Pose
    shared: Array
    step_errors: Array
    map_from_tags: list[Pose]

    def moved(self, d: Array) -> State:
        s = 12 + self.step_errors.size
        tags = [t * exp(d[s + 6 * k : s + 6 * k + 6]) for k, t in enumerate(self.map_from_tags)]
        steps = self.step_errors + d[12:s].reshape(-1, 6)
        return State(self.map_from_body * exp(d[:6]), self.shared + d[6:12], steps, tags)


class Problem:
    """Residuals of all corners, and priors of everything but the body; n sightings, u unknowns."""

    def __init__(self, found: BodySightings, parts: Sequence[Part], arm: ArmNoise) -> None:
        self.parts, self.image = parts, image_covariance(arm)
        self.steps, self.step_means = tuple(pose for pose, _ in found.steps), np.ravel(found.step_means)
        rows = [(k, s) for k, part in enumerate(parts) for s in part.sightings]
        self.tag_of = np.array([k for k, _ in rows])
        self.tags_at = 12 + 6 * len(self.steps)
        self.n_unknown = self.tags_at + 6 * len(parts)
        self.ref_from_body = Pose.concatenate([s.place.ref_from_body for _, s in rows])
        self.body_from_cam = Pose.concatenate([s.place.body_from_cam for _, s in rows])
        self.by_place = np.stack([by_unknowns(s.place, self.steps) for _, s in rows])
        self.by_steps = np.stack([by_steps(s.place, self.steps) for _, s in rows])
        self.points = np.stack([tag_corners(parts[k].tag.size_m) for k, _ in rows])
        self.xy = np.stack([s.place.frame.camera.unproject(s.detection.corners_px)[:, :2] for _, s in rows])
        self.lens = np.stack([_lens(s.place.frame.camera, xy) for (_, s), xy in zip(rows, self.xy, strict=True)])
        self.variance = np.stack([s.detection.noise_px for _, s in rows])
        shared = inverse(diagonal(max(arm.camera_deg, 1e-5), max(arm.camera_m, 1e-7)))
        priors = [shared, *(inverse(c) for _, c in found.steps), *(_tag_prior(p.tag) for p in parts)]
        self.prior = block_diag(np.zeros((6, 6)), *priors)

    def __len__(self) -> int:
        return len(self.tag_of)

    def start(self, map_from_body: Pose) -> State:
        """Return the unknowns at their priors, the body as given."""
        tags = [p.tag.map_from_tag for p in self.parts]
        return State(map_from_body, np.zeros(6), np.zeros((len(self.steps), 6)), tags)

    def residuals(self, state: State) -> tuple[Array, Array, Array]:
        """Return residuals (n, 8) in pixels, their derivative by the tag (n, 8, 6) and by the camera (n, 8, 6)."""
        n, moved = len(self), self.by_steps @ state.step_errors.ravel()
        swayed = Pose.from_components(moved[:, 3:], Rotation.from_rotvec(moved[:, :3]))
        cam = state.map_from_body * self.ref_from_body * swayed * self.body_from_cam * exp(state.shared)
        tags = Pose.concatenate(state.map_from_tags)
        cam_from_tag = cam.inv() * tags[self.tag_of]
        rotation = cam_from_tag.rotation.as_matrix()
        x_in_cam = np.einsum("nij,nkj->nki", rotation, self.points) + cam_from_tag.translation[:, None]
        z = np.maximum(x_in_cam[..., 2:], 1e-3)
        slope = np.zeros((n, 4, 2, 3))
        slope[..., 0, 0] = slope[..., 1, 1] = 1.0 / z[..., 0]
        slope[..., :, 2] = -x_in_cam[..., :2] / z**2
        slope = self.lens @ slope
        by_tag = np.concatenate(
            [-rotation[:, None] @ _skews(self.points), np.broadcast_to(rotation[:, None], (n, 4, 3, 3))], axis=-1
        )
        by_cam = np.concatenate([_skews(x_in_cam), np.broadcast_to(-np.eye(3), (n, 4, 3, 3))], axis=-1)
        residual = (self.lens @ (self.xy - x_in_cam[..., :2] / z)[..., None]).reshape(n, 8)
        return residual, (slope @ by_tag).reshape(n, 8, 6), (slope @ by_cam).reshape(n, 8, 6)

    def normal(self, state: State, scale: float) -> tuple[Array, Array, float, float]:
        """Return normal matrix, gradient, chi-square, and the log determinant of the residuals' covariances."""
        residual, by_tag, by_cam = self.residuals(state)
        noise = self.variance + scale**2 * by_cam @ self.image @ by_cam.transpose(0, 2, 1)
        jacobian = np.zeros((len(self), 8, self.n_unknown))
        jacobian[:, :, : self.tags_at] = by_cam @ self.by_place
        for k in range(len(self.parts)):
            at = self.tags_at + 6 * k
            jacobian[self.tag_of == k, :, at : at + 6] = by_tag[self.tag_of == k]
        weighted = np.linalg.solve(noise, np.concatenate([jacobian, residual[..., None]], axis=2))
        at_prior = self._deviation(state)
        stacked = jacobian.reshape(-1, self.n_unknown).T @ weighted.reshape(-1, self.n_unknown + 1)
        normal = stacked[:, :-1] + self.prior
        gradient = stacked[:, -1] - self.prior @ at_prior
        total = float(np.einsum("na,na->", residual, weighted[..., -1]) + at_prior @ self.prior @ at_prior)
        return normal, gradient, total, float(np.linalg.slogdet(noise)[1].sum())

    def _deviation(self, state: State) -> Array:
        tags = [log(p.tag.map_from_tag.inv() * pose) for p, pose in zip(self.parts, state.map_from_tags, strict=True)]
        return np.concatenate([np.zeros(6), state.shared, state.step_errors.ravel() - self.step_means, *tags])

    def minimise(self, state: State, scale: float, *, iterations: int = 15) -> tuple[State, Array, float, float]:
        """Return the state that minimises the weighted residuals, and normal matrix, chi-square and log determinant."""
        normal, gradient, cost, logdet = self.normal(state, scale)
        damping = 1e-9
        for _ in range(iterations):
            step = np.asarray(np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient), dtype=np.float64)
            trial = state.moved(step)
            new = self.normal(trial, scale)
            # The weights follow the pose, so a step may cost a trace more and still be the last one
            if np.isfinite(new[2]) and new[2] <= cost + 1e-6 * (1.0 + cost):
                gain, state, (normal, gradient, cost, logdet) = abs(cost - new[2]), trial, new
                damping = max(damping / 10, 1e-12)
                if gain < 1e-7 * (1.0 + cost):
                    break
            elif damping > 1e6:
                break
            else:
                damping = max(damping * 30, 1e-6)
        return state, normal, cost, logdet


def _tag_prior(tag: TagPose) -> Array:
    try:
        return inverse(tag.covariance * (1 + ROUNDED * np.eye(6)) + EXACT * np.eye(6))
    except np.linalg.LinAlgError as error:
        raise TagError(
            f"the covariance of tag {tag.id} is not positive definite; expected 36 numbers as calibration writes them",
            hint="calibrate the tag again",
        ) from error


def _lens(camera: Camera, xy: Array) -> Array:
    """Return the derivative (4, 2, 2) of pixels by undistorted coordinates (4, 2)."""
    step = 1e-6
    here = camera.distort(xy)
    columns = [(camera.distort(xy + d) - here) / step for d in ((step, 0.0), (0.0, step))]
    result: Array = np.stack(columns, axis=2) * np.asarray(camera.focal_px)[:, None]
    return result


def _skews(v: Array) -> Array:
    """Return the matrices (..., 3, 3) of the cross products with v (..., 3)."""
    result = np.zeros((*v.shape, 3))
    result[..., 0, 1], result[..., 0, 2], result[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return result - np.swapaxes(result, -1, -2)


def image_covariance(arm: ArmNoise) -> Array:
    """Return the 6x6 covariance of body_from_cam that is anew in every image."""
    return diagonal(arm.image_deg, arm.image_m)


def diagonal(degrees: float, metres: float) -> Array:
    return np.diag([math.radians(degrees) ** 2] * 3 + [metres**2] * 3)


def inverse(matrix: Array) -> Array:
    """Return the symmetric inverse; raises LinAlgError where the matrix is not positive definite in numbers."""
    # Columns in rad and in m differ by orders of magnitude: scaled to a unit diagonal before inverting
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    inverse = np.linalg.inv(matrix / np.outer(scale, scale)) / np.outer(scale, scale)
    if not np.isfinite(inverse).all() or not (np.linalg.eigvalsh(inverse * np.outer(scale, scale)) > 0).all():
        raise np.linalg.LinAlgError("not positive definite")
    return np.asarray((inverse + inverse.T) / 2, dtype=np.float64)
