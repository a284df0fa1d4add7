"""Where a standing robot's body and cameras are in the map: all sightings of known tags as one least-squares problem.

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
from scipy.stats import chi2 as chi2_law

from fieldkit.cameras import Camera
from fieldkit.errors import TagError
from fieldkit.frames import Array, Pose, adjoint, exp, log
from fieldkit.protocol import ArmNoise
from fieldkit.tags.fusion import SCALES, Sighting, TagFix, fuse_sightings
from fieldkit.tags.pose import tag_corners
from fieldkit.tags.sightings import BodySighting, BodySightings, Place
from fieldkit.types import TagPose

# Another tag joins in unless it contradicts the named one beyond one in ten thousand (6 degrees of freedom)
AGREES = float(chi2_law.ppf(0.9999, 6))
# How far from upright a body may well stand, and the tag be calibrated: the odds between planar solutions
UPRIGHT_RAD = math.radians(2.0)
# Residuals widen the covariance where they exceed their noise beyond one in a hundred
WIDEN = 0.99
# Added to a tag's variances, in rad^2 and m^2, and as a share of them: a tag that is known exactly, or exactly along a
# direction in rounded numbers, has a covariance without inverse
EXACT, ROUNDED = 1e-12, 2e-6


@dataclasses.dataclass(frozen=True)
class BodyFix:
    """The body in the map at ``t_ns``, and what is needed to place the cameras of the same visit.

    ``covariance`` is that of map_from_body. ``joint`` is that of the unknowns: map_from_body as the cameras see it, the
    shared error of the camera, the steps. ``scale`` multiplies the arm's stated noise per image, ``used`` counts the
    sightings per tag id, ``left_out`` names tags that contradict the named one, ``rms_sigma`` is
    the root mean square of what remains, in standard deviations.
    """

    t_ns: int
    map_from_body: Pose
    covariance: Array
    shared: Array
    joint: Array
    steps: tuple[Pose, ...]
    step_errors: Array
    scale: float
    used: dict[int, int]
    left_out: tuple[str, ...]
    rms_sigma: float
    image_covariance: Array

    def map_from_cam(self, place: Place) -> tuple[Pose, Array]:
        """Return the true camera pose of a placed frame and its 6x6 covariance."""
        moved = exp(_by_steps(place, self.steps) @ self.step_errors.ravel())
        cam = self.map_from_body * place.ref_from_body * moved * place.body_from_cam * exp(self.shared)
        by_unknown = _by_unknowns(place, self.steps)
        covariance = by_unknown @ self.joint @ by_unknown.T + self.scale**2 * self.image_covariance
        return cam, (covariance + covariance.T) / 2


def image_covariance(arm: ArmNoise) -> Array:
    """Return the 6x6 covariance of body_from_cam that is anew in every image."""
    return _diagonal(arm.image_deg, arm.image_m)


def hand_covariance(arm: ArmNoise) -> Array:
    """Return the 6x6 covariance of body_from_cam as a whole at the camera: per image, shared, and the arm's base."""
    return image_covariance(arm) + _diagonal(arm.camera_deg, arm.camera_m) + _diagonal(arm.base_deg, arm.base_m)


def locate_body(found: BodySightings, tag: TagPose, *, arm: ArmNoise, others: Sequence[TagPose] = ()) -> BodyFix:
    """Locate the body from sightings of a tag, and of others that agree with it.

    Consensus and planar solutions come from `fuse_sightings` of each tag; where the sightings leave both solutions
    open, the one with the more upright body is taken: the map's z and the body's both point up on a standing robot. No
    prior takes part. Raises TagError when the tag is not seen, there is no solution, or four or more sightings need
    the largest noise of the arm that is allowed: a wrong tag size or wrong kinematics shifts all of them.
    """
    seen = found.of(tag)
    if not seen:
        raise TagError(f"tag {tag.id} ({tag.family}) is never seen: {found.explanation}")
    main, map_from_body, doubt = _alone(found, seen, tag, arm)
    left_out, joined, first = [], [main], None
    for other in others:
        more = found.of(other)
        if not more or other.id == tag.id:
            continue
        try:
            part, its_body, _ = _alone(found, more, other, arm)
        except TagError as error:
            left_out.append(f"tag {other.id}: {error.message}")
            continue
        first = first or _solve(found, [main], map_from_body, arm)
        apart = _apart(first, _solve(found, [part], its_body, arm))
        if apart > AGREES:
            left_out.append(f"tag {other.id} contradicts tag {tag.id} by {math.sqrt(apart):.0f} sigma")
        else:
            joined.append(part)
    if len(joined) > 1:
        # Tags that agree have decided between the planar solutions
        return _solve(found, joined, map_from_body, arm, left_out=tuple(left_out))
    alone = first or _solve(found, joined, map_from_body, arm)
    joint = alone.joint.copy()
    joint[:6, :6] += doubt
    return dataclasses.replace(alone, covariance=alone.covariance + doubt, joint=joint, left_out=tuple(left_out))


@dataclasses.dataclass(frozen=True)
class _Part:
    """The sightings of one tag that agree with each other."""

    tag: TagPose
    sightings: tuple[BodySighting, ...]


def _alone(
    found: BodySightings, seen: Sequence[BodySighting], tag: TagPose, arm: ArmNoise
) -> tuple[_Part, Pose, Array]:
    """Return the sightings of one tag that agree, the body that they show by themselves, and what a flip adds to it."""
    total, stands = image_covariance(arm), [s.place.stand for s in seen]
    home = max(sorted(set(stands), reverse=True), key=stands.count)
    sightings = [
        Sighting(s.detection, s.place.frame.camera, s.place.ref_from_cam, total + _step_noise(s.place, found, home))
        for s in seen
    ]
    fix = fuse_sightings(sightings, tag.size_m)
    if len(sightings) >= 4 and fix.scale >= max(SCALES):
        raise TagError(
            f"the {len(sightings)} sightings of tag {tag.id} disagree with kinematics by about {max(SCALES):g} times "
            "their stated noise or more; expected one place of the tag in all of them",
            hint="check size_m of the tag, camera_info and tf",
        )
    used = tuple(s for s, u in zip(seen, fix.used, strict=True) if u)
    map_from_body = body_in_map(fix, tag)
    return _Part(tag, used), map_from_body, _doubt(fix, tag, map_from_body)


def _doubt(fix: TagFix, tag: TagPose, chosen: Pose) -> Array:
    """Return what the other planar solution adds to the covariance of the body where it stays possible.

    Both solutions have the odds of their residuals and of how upright the body stands; the spread of the two around the
    chosen one is added.
    """
    if fix.is_certain or fix.alternative is None:
        return np.zeros((6, 6))
    bodies = [tag.map_from_tag * o.inv() for o in (fix.ref_from_tag, fix.alternative)]
    worse = [(tilt(b) / UPRIGHT_RAD) ** 2 + e for b, e in zip(bodies, (0.0, fix.evidence), strict=True)]
    first = min((0, 1), key=lambda i: tilt(bodies[i]))
    odds = math.exp(-min(max(worse[1 - first] - worse[first], -20.0), 40.0) / 2)
    delta = log(chosen.inv() * bodies[1 - first])
    return odds / (1 + odds) * np.outer(delta, delta)


def body_in_map(fix: TagFix, tag: TagPose) -> Pose:
    """Return map_from_body from the tag relative to the body and the tag in the map.

    Where the sightings leave both planar solutions open, the one with the more upright body is taken. No odometry and
    no prior takes part in the choice.
    """
    options = [fix.ref_from_tag]
    if not fix.is_certain and fix.alternative is not None:
        options.append(fix.alternative)
    return min((tag.map_from_tag * o.inv() for o in options), key=tilt)


def tilt(map_from_body: Pose) -> float:
    """Return the angle (rad) between the body's z and the map's."""
    return float(np.arccos(np.clip(map_from_body.rotation.as_matrix()[2, 2], -1.0, 1.0)))


def _step_noise(place: Place, found: BodySightings, home: int) -> Array:
    """Return the 6x6 covariance of a camera's place by the steps between it and the stand from which most is seen."""
    total = np.zeros((6, 6))
    cam_from_ref = place.ref_from_cam.inv()
    for ref_from_begin, covariance in found.steps[min(place.stand, home) : max(place.stand, home)]:
        effect = adjoint(cam_from_ref * ref_from_begin)
        total += effect @ covariance @ effect.T
    return total


def _apart(one: BodyFix, other: BodyFix) -> float:
    delta = log(one.map_from_body.inv() * other.map_from_body)
    return float(delta @ np.linalg.solve(one.covariance + other.covariance, delta))


def _by_unknowns(place: Place, steps: Sequence[Pose]) -> Array:
    """Return the derivative (6, 12 + 6 s) of a camera's pose by body, shared error and steps (right perturbations)."""
    result = np.zeros((6, 12 + 6 * len(steps)))
    cam_from_ref = place.ref_from_cam.inv()
    result[:, :6] = adjoint(cam_from_ref)
    result[:, 6:12] = np.eye(6)
    for index in range(place.stand, len(steps)):
        result[:, 12 + 6 * index : 18 + 6 * index] = adjoint(cam_from_ref * steps[index])
    return result


def _by_steps(place: Place, steps: Sequence[Pose]) -> Array:
    """Return the derivative (6, 6 s) of ref_from_body of a frame by the errors of the steps after its stand."""
    result = np.zeros((6, 6 * len(steps)))
    body_from_ref = place.ref_from_body.inv()
    for index in range(place.stand, len(steps)):
        result[:, 6 * index : 6 * index + 6] = adjoint(body_from_ref * steps[index])
    return result


@dataclasses.dataclass
class _State:
    """The unknowns while they are refined."""

    map_from_body: Pose
    shared: Array
    step_errors: Array
    map_from_tags: list[Pose]

    def moved(self, d: Array) -> _State:
        s = 12 + self.step_errors.size
        tags = [t * exp(d[s + 6 * k : s + 6 * k + 6]) for k, t in enumerate(self.map_from_tags)]
        steps = self.step_errors + d[12:s].reshape(-1, 6)
        return _State(self.map_from_body * exp(d[:6]), self.shared + d[6:12], steps, tags)


class _Problem:
    """Residuals of all corners, and priors of everything but the body; n sightings, u unknowns."""

    def __init__(self, found: BodySightings, parts: Sequence[_Part], arm: ArmNoise) -> None:
        self.parts, self.image = parts, image_covariance(arm)
        self.steps, self.step_means = tuple(pose for pose, _ in found.steps), np.ravel(found.step_means)
        rows = [(k, s) for k, part in enumerate(parts) for s in part.sightings]
        self.tag_of = np.array([k for k, _ in rows])
        self.tags_at = 12 + 6 * len(self.steps)
        self.n_unknown = self.tags_at + 6 * len(parts)
        self.ref_from_body = Pose.concatenate([s.place.ref_from_body for _, s in rows])
        self.body_from_cam = Pose.concatenate([s.place.body_from_cam for _, s in rows])
        self.by_place = np.stack([_by_unknowns(s.place, self.steps) for _, s in rows])
        self.by_steps = np.stack([_by_steps(s.place, self.steps) for _, s in rows])
        self.points = np.stack([tag_corners(parts[k].tag.size_m) for k, _ in rows])
        self.xy = np.stack([s.place.frame.camera.unproject(s.detection.corners_px)[:, :2] for _, s in rows])
        self.lens = np.stack([_lens(s.place.frame.camera, xy) for (_, s), xy in zip(rows, self.xy, strict=True)])
        self.variance = np.stack([s.detection.noise_px for _, s in rows])
        shared = _inverse(_diagonal(max(arm.camera_deg, 1e-5), max(arm.camera_m, 1e-7)))
        priors = [shared, *(_inverse(c) for _, c in found.steps), *(_tag_prior(p.tag) for p in parts)]
        self.prior = block_diag(np.zeros((6, 6)), *priors)

    def __len__(self) -> int:
        return len(self.tag_of)

    def start(self, map_from_body: Pose) -> _State:
        """Return the unknowns at their priors, the body as given."""
        tags = [p.tag.map_from_tag for p in self.parts]
        return _State(map_from_body, np.zeros(6), np.zeros((len(self.steps), 6)), tags)

    def residuals(self, state: _State) -> tuple[Array, Array, Array]:
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

    def normal(self, state: _State, scale: float) -> tuple[Array, Array, float, float]:
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
        normal = np.einsum("nai,naj->ij", jacobian, weighted[..., :-1]) + self.prior
        gradient = np.einsum("nai,na->i", jacobian, weighted[..., -1]) - self.prior @ at_prior
        total = float(np.einsum("na,na->", residual, weighted[..., -1]) + at_prior @ self.prior @ at_prior)
        return normal, gradient, total, float(np.linalg.slogdet(noise)[1].sum())

    def _deviation(self, state: _State) -> Array:
        tags = [log(p.tag.map_from_tag.inv() * pose) for p, pose in zip(self.parts, state.map_from_tags, strict=True)]
        return np.concatenate([np.zeros(6), state.shared, state.step_errors.ravel() - self.step_means, *tags])

    def minimise(self, state: _State, scale: float, *, iterations: int = 15) -> tuple[_State, Array, float, float]:
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
        return _inverse(tag.covariance * (1 + ROUNDED * np.eye(6)) + EXACT * np.eye(6))
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


def _solve(
    found: BodySightings, parts: Sequence[_Part], map_from_body: Pose, arm: ArmNoise, *, left_out: tuple[str, ...] = ()
) -> BodyFix:
    problem = _Problem(found, parts, arm)
    n = len(problem)
    try:
        state, scale = problem.start(map_from_body), 1.0
        for _ in range(2 if n >= 4 else 1):
            state, normal, total, _ = problem.minimise(state, scale)
            if n >= 4:
                scale = min(SCALES, key=lambda s: (_unlikely(problem, state, s), s))
        state, normal, total, _ = problem.minimise(state, scale)
        covariance = _inverse(normal)
    except np.linalg.LinAlgError as error:
        ids = ", ".join(str(p.tag.id) for p in parts)
        raise TagError(
            f"the {n} sightings of tag {ids} determine no pose ({error}); expected the corners of "
            "squares of the given sizes",
            hint="check size_m of the tag and the camera's calibration",
        ) from error
    freedom = 8 * n - 6
    if total > chi2_law.ppf(WIDEN, freedom):
        covariance = covariance * (total / freedom)
    known = 12 + 6 * len(problem.steps)
    joint = covariance[:known, :known]
    base = _diagonal(arm.base_deg, arm.base_m)
    counts: dict[int, int] = {}
    for part in parts:
        counts[part.tag.id] = len(part.sightings)
    return BodyFix(
        found.t_ns,
        state.map_from_body,
        joint[:6, :6] + base,
        state.shared,
        joint,
        problem.steps,
        state.step_errors,
        scale,
        counts,
        left_out,
        math.sqrt(total / (8 * n)),
        problem.image,
    )


def _unlikely(problem: _Problem, state: _State, scale: float) -> float:
    """Return twice the negative restricted log likelihood of a scale of the arm's noise, up to a constant.

    The state is that of another scale: what a Newton step from it gains is taken off.
    """
    normal, gradient, total, logdet = problem.normal(state, scale)
    gain = float(gradient @ np.linalg.solve(normal, gradient))
    return total - gain + logdet + float(np.linalg.slogdet(normal)[1])


def _diagonal(degrees: float, metres: float) -> Array:
    return np.diag([math.radians(degrees) ** 2] * 3 + [metres**2] * 3)


def _inverse(matrix: Array) -> Array:
    """Return the symmetric inverse; raises LinAlgError where the matrix is not positive definite in numbers."""
    # Columns in rad and in m differ by orders of magnitude: scaled to a unit diagonal before inverting
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    inverse = np.linalg.inv(matrix / np.outer(scale, scale)) / np.outer(scale, scale)
    if not np.isfinite(inverse).all() or not (np.linalg.eigvalsh(inverse * np.outer(scale, scale)) > 0).all():
        raise np.linalg.LinAlgError("not positive definite")
    return np.asarray((inverse + inverse.T) / 2, dtype=np.float64)
