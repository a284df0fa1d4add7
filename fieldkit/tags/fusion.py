"""One tag seen by several cameras whose poses are known with some noise: consensus, then one least-squares problem."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fieldkit.cameras import Camera
from fieldkit.errors import TagError
from fieldkit.frames import Pose, compose_covariance, exp
from fieldkit.tags.detect import TagDetection
from fieldkit.tags.lens import flat_covariance, flatten
from fieldkit.tags.pose import TagSolution, project_derivative, solve, tag_corners, tilt_is_known

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Squared deviation of one sighting (6 or 8 degrees of freedom) beyond which it is an outlier
GATE = 40.0
# Difference of two solutions' chi-square below which neither is certain: odds of e^10
CERTAIN = 20.0
# Sightings from directions that span less share what their corners are wrong by (lens, paper, light): they count as one
SPAN_RAD = math.radians(15.0)
# A candidate that is turned by less than this (rad) is no other solution
SAME_RAD = 0.03
# One sighting of a decided pose does not outweigh those that leave it open
MOST_EVIDENCE = 2 * CERTAIN
# What the stated noise of the cameras may be multiplied by
SCALES = (0.0, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)


@dataclasses.dataclass(frozen=True)
class Sighting:
    """A tag in one image, and where that camera was: ref_from_cam with its own 6x6 covariance (right perturbation)."""

    detection: TagDetection
    camera: Camera
    ref_from_cam: Pose
    covariance: Array


@dataclasses.dataclass(frozen=True)
class TagFix:
    """A tag's pose in the reference frame, fused from sightings, with its 6x6 covariance (right perturbation).

    ``rms_px`` is what remains in the corners once the cameras have moved within their noise.
    ``used``, ``sigmas`` and ``ambiguities`` have one entry per sighting: whether it entered, its deviation from the
    result in standard deviations per degree of freedom, and its own ambiguity. ``flipped`` marks sightings whose own
    better solution is not the one that all together chose. ``scale`` multiplies the stated standard deviations of the
    camera poses: their noise as the sightings show it. ``span_rad`` is the largest angle between the directions from
    which the tag is seen. ``alternative`` is the other solution, when there is one, ``ambiguity`` the ratio of the two
    residuals, and ``evidence`` the difference of their chi-squares: of all sightings together where they span 15 deg,
    else at most that of the average one by itself: from one direction they repeat an error of lens or paper.
    """

    ref_from_tag: Pose
    covariance: Array
    rms_px: float
    used: tuple[bool, ...]
    sigmas: tuple[float, ...]
    ambiguities: tuple[float, ...]
    flipped: tuple[bool, ...]
    scale: float
    alternative: Pose | None = None
    alternative_covariance: Array | None = None
    ambiguity: float = 0.0
    evidence: float = float("inf")
    span_rad: float = 0.0

    @property
    def is_certain(self) -> bool:
        """Whether the sightings decide between the two solutions, and these have not merged into one."""
        return self.evidence > CERTAIN and tilt_is_known(self.covariance * self.repeated)

    @property
    def repeated(self) -> int:
        """How many sightings count as one: all that entered, where their directions span less than 15 deg."""
        return 1 if self.span_rad >= SPAN_RAD else sum(self.used)


def fuse_sightings(
    sightings: Sequence[Sighting],
    size_m: float,
    *,
    scales: Sequence[float] = SCALES,
    solutions: Sequence[TagSolution] | None = None,
) -> TagFix:
    """Fuse sightings of one tag of edge ``size_m`` into ref_from_tag.

    Both planar solutions of every sighting vote for a consensus; then one generalised least-squares problem over all
    corners of the sightings that agree. Each sighting's 8 residuals have the corners' noise plus the noise of its
    camera pose, which is what solving for all camera poses as well, with their covariances as priors, gives after
    eliminating them. The camera noise may be multiplied by one of ``scales``, the most likely one (from 4 sightings
    on). The covariance is scaled by chi-square per degree of freedom where that exceeds 1. Errors that all sightings
    share (hand-to-camera calibration, tag size, a warp of the map) are not in it. ``solutions`` are those of the
    sightings by themselves, where they are known already.
    Raises TagError when there is no sighting, or no pose that explains them.
    """
    if not sightings:
        raise TagError("no sighting of the tag; expected at least one")
    try:
        own = [solve(s.detection, s.camera, size_m) for s in sightings] if solutions is None else solutions
        return _fuse(sightings, size_m, scales, own)
    except np.linalg.LinAlgError as error:
        raise TagError(
            f"the {len(sightings)} sightings of tag {sightings[0].detection.id} determine no pose ({error}); expected "
            f"the corners of a square of {size_m:g} m",
            hint="check size_m of the tag and the camera's calibration",
        ) from error


def _fuse(
    sightings: Sequence[Sighting], size_m: float, scales: Sequence[float], solutions: Sequence[TagSolution]
) -> TagFix:
    points = tag_corners(size_m)
    problem = _Problem.of(sightings, points)
    votes = _vote(sightings, solutions)
    scale = max(1.0, votes.scale) if max(scales) >= 1.0 else max(scales)
    best, used, scale = _settle(problem, votes.first, votes.agrees, scale, scales)
    chi2 = problem.chi2(best, scale)
    factor = max(1.0, float(chi2[used].sum()) / max(8 * int(used.sum()) - 6, 1))
    covariance = _covariance(problem.information(best, used, scale)) * factor
    fix = TagFix(
        best,
        covariance,
        problem.rms_px(best, used, scale),
        tuple(bool(u) for u in used),
        tuple(float(np.sqrt(c / 8)) for c in chi2),
        tuple(s.ambiguity for s in solutions),
        tuple(_is_flipped(s, o, best) for s, o in zip(sightings, solutions, strict=True)),
        scale,
        span_rad=_span(problem.directions(best)[used]),
    )
    fix = _with_alternative(fix, problem, votes.others, used, factor)
    return fix if fix.span_rad >= SPAN_RAD else _as_one(fix, sightings, solutions)


@dataclasses.dataclass(frozen=True)
class _Problem:
    """Corners of n sightings as arrays: undistorted pixels (n, 4, 2), focal, their covariance, cam_from_ref and its."""

    points: Array
    flat: Array
    focal: Array
    noise: Array
    rotation: Array
    translation: Array
    covariance: Array

    @staticmethod
    def of(sightings: Sequence[Sighting], points: Array) -> _Problem:
        cam_from_ref = [s.ref_from_cam.inv() for s in sightings]
        return _Problem(
            points,
            np.stack([flatten(s.camera, s.detection.corners_px) for s in sightings]),
            np.array([s.camera.focal_px for s in sightings]),
            np.stack([flat_covariance(s.camera, s.detection.corners_px, s.detection.noise_px) for s in sightings]),
            np.stack([p.rotation.as_matrix() for p in cam_from_ref]),
            np.stack([p.translation for p in cam_from_ref]),
            np.stack([s.covariance for s in sightings]),
        )

    def linearise(self, ref_from_tag: Pose) -> tuple[Array, Array, Array]:
        """Return residuals (n, 8) in pixels, their derivative by the tag (n, 8, 6) and by the cameras (n, 8, 6)."""
        n = len(self.flat)
        rotation = ref_from_tag.rotation.as_matrix()
        x_in_ref = self.points @ rotation.T + ref_from_tag.translation
        x_in_cam = np.einsum("nij,kj->nki", self.rotation, x_in_ref) + self.translation[:, None]
        by_tag, by_cam = np.zeros((n, 4, 3, 6)), np.zeros((n, 4, 3, 6))
        cam_from_tag = self.rotation @ rotation
        by_tag[..., :3] = -np.einsum("nij,kjl->nkil", cam_from_tag, _skews(self.points))
        by_tag[..., 3:] = cam_from_tag[:, None]
        by_cam[..., :3] = _skews(x_in_cam.reshape(-1, 3)).reshape(n, 4, 3, 3)
        by_cam[..., 3:] = -np.eye(3)
        in_front = np.maximum(x_in_cam[..., 2:], 1e-3)
        predicted = x_in_cam[..., :2] / in_front * self.focal[:, None]
        slope = np.stack(
            [
                project_derivative(np.column_stack([x[:, :2], z]), f)
                for x, z, f in zip(x_in_cam, in_front, self.focal, strict=True)
            ]
        )
        residual = (self.flat - predicted).reshape(n, 8)
        return residual, (slope @ by_tag).reshape(n, 8, 6), (slope @ by_cam).reshape(n, 8, 6)

    def directions(self, ref_from_tag: Pose) -> Array:
        """Return unit vectors (n, 3) in the tag frame from the tag to the cameras."""
        cameras = -np.einsum("nji,nj->ni", self.rotation, self.translation)
        rays = ref_from_tag.inv().apply(cameras)
        result: Array = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        return result

    def are_in_front(self, ref_from_tag: Pose, used: Mask) -> bool:
        """Tell whether every corner lies in front of every camera that is used."""
        x_in_ref = ref_from_tag.apply(self.points)
        depth = np.einsum("nj,kj->nk", self.rotation[used, 2], x_in_ref) + self.translation[used, 2, None]
        return bool((depth > 1e-3).all())

    def weights(self, by_cam: Array, scale: float) -> tuple[Array, Array]:
        """Return the inverse covariance (n, 8, 8) of each sighting's residuals and its log determinant (n,)."""
        total = self.noise + scale**2 * by_cam @ self.covariance @ by_cam.transpose(0, 2, 1)
        return np.asarray(np.linalg.inv(total)), np.asarray(np.linalg.slogdet(total)[1])

    def chi2(self, ref_from_tag: Pose, scale: float) -> Array:
        """Return the squared deviation (n,) of each sighting."""
        residual, _, by_cam = self.linearise(ref_from_tag)
        result: Array = np.einsum("ni,nij,nj->n", residual, self.weights(by_cam, scale)[0], residual)
        return result

    def cost(self, ref_from_tag: Pose, used: Mask, scale: float) -> float:
        """Return twice the negative log likelihood of the sightings that are used, up to a constant."""
        _, _, by_cam = self.linearise(ref_from_tag)
        return float((self.chi2(ref_from_tag, scale) + self.weights(by_cam, scale)[1])[used].sum())

    def information(self, ref_from_tag: Pose, used: Mask, scale: float) -> Array:
        """Return the 6x6 information of the sightings that are used."""
        _, by_tag, by_cam = self.linearise(ref_from_tag)
        weights = self.weights(by_cam, scale)[0]
        result: Array = np.einsum("nai,nab,nbj->ij", by_tag[used], weights[used], by_tag[used])
        return result

    def rms_px(self, ref_from_tag: Pose, used: Mask, scale: float) -> float:
        """Return the root mean square per coordinate of what remains in the corners, in pixels.

        The cameras have moved within their noise to fit: of a residual r with covariance S, N S^-1 r remains, with the
        corners' own covariance N.
        """
        residual, _, by_cam = self.linearise(ref_from_tag)
        remains = np.einsum("nab,nbc,nc->na", self.noise, self.weights(by_cam, scale)[0], residual)
        return float(np.sqrt(np.mean(remains[used] ** 2)))

    def minimise(self, start: Pose, used: Mask, scale: float) -> Pose:
        """Minimise the weighted residuals from a start by Levenberg-Marquardt; weights follow the pose."""
        pose, damping = start, 1e-6
        cost = self._cost(pose, used, scale)
        for _ in range(40):
            if not np.isfinite(cost):
                break
            residual, by_tag, by_cam = self.linearise(pose)
            weighted = np.einsum("nab,nbj->naj", self.weights(by_cam, scale)[0], by_tag)[used]
            normal = np.einsum("nai,naj->ij", by_tag[used], weighted)
            gradient = np.einsum("nai,na->i", weighted, residual[used])
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
            candidate = pose * exp(step)
            new = self._cost(candidate, used, scale)
            if new < cost:
                gain, pose, cost, damping = cost - new, candidate, new, max(damping / 10, 1e-12)
                if gain < 1e-10 * (1.0 + cost):
                    break
            elif damping > 1e6 or float(np.abs(step).max()) < 1e-11:
                break
            else:
                damping *= 10
        return pose

    def _cost(self, pose: Pose, used: Mask, scale: float) -> float:
        """Return the sum to be minimised; infinite where a step puts the tag into a camera's plane."""
        try:
            cost = float(self.chi2(pose, scale)[used].sum())
        except np.linalg.LinAlgError:
            return float("inf")
        return cost if np.isfinite(cost) else float("inf")


@dataclasses.dataclass(frozen=True)
class _Votes:
    """The candidate that most sightings agree with, who agrees, at what noise scale, and the candidates after it."""

    first: Pose
    agrees: Mask
    scale: float
    others: tuple[Pose, ...]


def _vote(sightings: Sequence[Sighting], solutions: Sequence[TagSolution]) -> _Votes:
    """Let every solution of every sighting be a candidate, and every sighting vote with its closer solution.

    The noise scale is the smallest of a few at which more than half of the sightings agree with the best candidate.
    """
    owners, poses, covariances, penalties = [], [], [], []
    for index, (sighting, solution) in enumerate(zip(sightings, solutions, strict=True)):
        better = solution.rms_px**2, solution.cam_from_tag, solution.covariance
        both = [better]
        if solution.alternative is not None and solution.alternative_covariance is not None:
            both.append((solution.alternative_rms_px**2, solution.alternative, solution.alternative_covariance))
        for square, cam_from_tag, covariance in both:
            owners.append(index)
            poses.append(sighting.ref_from_cam * cam_from_tag)
            covariances.append(compose_covariance(sighting.covariance, cam_from_tag, covariance))
            penalties.append(8 * (square - solution.rms_px**2) / sighting.detection.sigma_px**2)
    distance = np.stack([_distances(poses, covariances, j) for j in range(len(poses))], axis=1)
    penalty, owner, n = np.array(penalties), np.array(owners), len(sightings)
    for scale in (1.0, 2.0, 4.0, 8.0, 16.0):
        per_candidate = np.minimum(distance / scale**2 + penalty[:, None], GATE)
        votes = np.stack([per_candidate[owner == i].min(axis=0) for i in range(n)])
        order = np.argsort(votes.sum(axis=0) + np.minimum(penalty, GATE), kind="stable")
        agrees: Mask = votes[:, order[0]] < GATE
        if 2 * int(agrees.sum()) > n:
            break
    return _Votes(poses[order[0]], agrees, scale, tuple(poses[k] for k in order[1:]))


def _distances(poses: Sequence[Pose], covariances: Sequence[Array], j: int) -> Array:
    stack = Pose.concatenate(list(poses))
    delta = stack.inv() * poses[j]
    tangent = np.concatenate([delta.rotation.as_rotvec(), delta.translation], axis=1)
    total = np.stack(covariances) + covariances[j]
    result: Array = np.einsum("ni,ni->n", tangent, np.linalg.solve(total, tangent[..., None])[..., 0])
    return result


def _settle(
    problem: _Problem, start: Pose, agrees: Mask, scale: float, scales: Sequence[float]
) -> tuple[Pose, Mask, float]:
    """Alternate between the pose, the scale of the cameras' noise, and who is within the gate."""
    pose, used = start, agrees
    for _ in range(6):
        pose = problem.minimise(pose, used, scale)
        if int(used.sum()) >= 4:
            scale = min(scales, key=lambda s: (problem.cost(pose, used, s), s))
            pose = problem.minimise(pose, used, scale)
        chi2 = problem.chi2(pose, scale)
        now: Mask = chi2 < GATE * max(1.0, float(np.median(chi2[used])) / 8)
        if not now.any() or (now == used).all():
            break
        used = now
    return pose, used, scale


def _with_alternative(fix: TagFix, problem: _Problem, others: Sequence[Pose], used: Mask, factor: float) -> TagFix:
    """Look for the other solution, another minimum of the same problem: from the mirror image, then from candidates."""
    best = float(problem.chi2(fix.ref_from_tag, fix.scale)[used].sum())
    mirrored = _mirrored(fix.ref_from_tag, problem.directions(fix.ref_from_tag)[used].mean(axis=0))
    starts = [p for p in (mirrored, *others) if _turned(fix.ref_from_tag, p) > SAME_RAD]
    minima = [problem.minimise(start, used, fix.scale) for start in starts[:8]]
    minima = [p for p in minima if _turned(fix.ref_from_tag, p) > 0.02 and problem.are_in_front(p, used)]
    found = [(float(problem.chi2(p, fix.scale)[used].sum()), p) for p in minima]
    for cost, other in sorted(found, key=lambda f: f[0]):
        try:
            covariance = _covariance(problem.information(other, used, fix.scale)) * factor
        except np.linalg.LinAlgError:
            continue
        return dataclasses.replace(
            fix,
            alternative=other,
            alternative_covariance=covariance,
            ambiguity=float(np.sqrt(min(best, cost) / max(best, cost, 1e-12))),
            evidence=(cost - best) / factor,
        )
    return fix


def _as_one(fix: TagFix, sightings: Sequence[Sighting], solutions: Sequence[TagSolution]) -> TagFix:
    """Return a fix whose evidence is at most that of its average sighting by itself, with its other solution."""
    own = [
        (-1.0 if flipped else 1.0) * _evidence(s, o)
        for s, o, flipped, used in zip(sightings, solutions, fix.flipped, fix.used, strict=True)
        if used
    ]
    fix = dataclasses.replace(fix, evidence=min(fix.evidence, float(np.mean(np.minimum(own, MOST_EVIDENCE)))))
    if fix.alternative is not None or fix.evidence > CERTAIN:
        return fix
    # Together they have no other minimum: that of the sighting that knows least
    open_ones = [
        (s, o) for s, o, u in zip(sightings, solutions, fix.used, strict=True) if u and o.alternative is not None
    ]
    if not open_ones:
        return fix
    sighting, solution = min(open_ones, key=lambda p: _evidence(*p))
    options = [
        (solution.cam_from_tag, solution.covariance),
        (solution.alternative, solution.alternative_covariance),
    ]
    placed = [(sighting.ref_from_cam * p, p, c) for p, c in options if p is not None and c is not None]
    other, cam_from_tag, covariance = max(placed, key=lambda p: _turned(fix.ref_from_tag, p[0]))
    return dataclasses.replace(
        fix,
        alternative=other,
        alternative_covariance=compose_covariance(sighting.covariance, cam_from_tag, covariance),
        ambiguity=solution.ambiguity,
    )


def _evidence(sighting: Sighting, solution: TagSolution) -> float:
    """Return the difference of chi-square of a sighting's own two solutions: none where they merged into one."""
    if solution.alternative is None:
        return math.inf if tilt_is_known(solution.covariance) else 0.0
    better, other = (8 * (r / sighting.detection.sigma_px) ** 2 for r in (solution.rms_px, solution.alternative_rms_px))
    # Two degrees of freedom remain to show that the corners are noisier than they say
    return (other - better) / max(1.0, better / 2)


def _turned(one: Pose, two: Pose) -> float:
    return float((one.inv() * two).rotation.magnitude())


def _mirrored(ref_from_tag: Pose, tag_to_camera: Array) -> Pose:
    """Return the pose whose picture from a direction (3,) in the tag frame, without perspective, is the same.

    Mirrored at the plane that faces the camera, and at its own: the sign of its slant cannot be told.
    """
    d = tag_to_camera / np.linalg.norm(tag_to_camera)
    turn = (np.eye(3) - 2 * np.outer(d, d)) @ np.diag([1.0, 1.0, -1.0])
    return Pose.from_components(ref_from_tag.translation, ref_from_tag.rotation * Rotation.from_matrix(turn))


def _span(directions: Array) -> float:
    """Return the largest angle in rad between unit vectors (n, 3)."""
    return float(np.arccos(np.clip((directions @ directions.T).min(), -1.0, 1.0)))


def _covariance(information: Array) -> Array:
    """Return the inverse; raises LinAlgError where rounding leaves it not positive definite."""
    inverse = np.asarray(np.linalg.inv(information), dtype=np.float64)
    covariance = (inverse + inverse.T) / 2
    if not np.isfinite(covariance).all() or not (np.linalg.eigvalsh(covariance) > 0).all():
        raise np.linalg.LinAlgError("covariance not positive definite")
    return covariance


def _is_flipped(sighting: Sighting, solution: TagSolution, ref_from_tag: Pose) -> bool:
    if solution.alternative is None:
        return False
    cam_from_tag = sighting.ref_from_cam.inv() * ref_from_tag
    own, other = solution.cam_from_tag, solution.alternative
    return bool((cam_from_tag.inv() * other).rotation.magnitude() < (cam_from_tag.inv() * own).rotation.magnitude())


def _skews(v: Array) -> Array:
    result = np.zeros((len(v), 3, 3))
    result[:, 0, 1], result[:, 0, 2], result[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return result - result.transpose(0, 2, 1)
