"""The least-squares problem of an arm sweep: what the corners should be, and how they depend on every unknown."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fieldkit.checks.parameters import (
    Parameter,
    camera_parameters,
    changed,
    hand_parameters,
    latency_parameter,
    refinable,
)
from fieldkit.checks.sweeps import Sweep
from fieldkit.frames import Array, Pose
from fieldkit.protocol import ArmNoise
from fieldkit.tags import image_covariance, tag_corners

Mask = NDArray[np.bool_]

HAND, LATENCY, CAMERA = slice(0, 6), 6, slice(7, 15)
# What a joint's zero is known to (standard deviation), where tf has every joint
JOINT_SIGMA_RAD = math.radians(0.1)
# Blur, averaged in light and then encoded, moves edges into the dark: by so many seconds of an image's motion, and so
# many pixels in every image (standard deviations). A tag is measured to such a share of its size
SHRINK_S, EDGE_PX, SIZE_SHARE = 0.005, 0.25, 0.002
# The arm's path between two samples of tf is taken as straight; what that is off by looks like late stamps, by so many
# intervals between samples
CHORD_INTERVALS = 0.05
# A joint that turns (rad/s) or shifts (m/s) by less may only seem to: noise of its samples looks like it
STILL_PER_S = 0.05
# A joint that turns less than this about its axis does not show which axis that is
TURNED_RAD = math.radians(1.0)
# What the noise of arm and images may be, each by itself; see `Noise`
GRID = {
    "arm": (0.0, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0),
    "jitter_s": (0.0, 0.0005, 0.001, 0.002, 0.004, 0.008, 0.016),
    "blur_s": (0.0, 0.0005, 0.001, 0.002, 0.004, 0.008, 0.016),
    "corner_px": (0.0, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2),
}
ARM_PER_IMAGE = image_covariance(ArmNoise())
_TAG_STEP = 1e-5


@dataclasses.dataclass(frozen=True)
class Noise:
    """What residuals may be made of beside the corners' own noise; a still arm does not show
    jitter and blur.

    ``arm`` is the factor of the arm's stated standard deviations in one image (`ArmNoise`). ``jitter_s``: an image is
    taken at another time than stated, or between samples of an arm that does not move evenly. ``blur_s``: corners of a
    moving image err by so many seconds of its motion, each by itself. ``corner_px``: corners err by more than their
    detector states, each by itself: another lens than the model, paper that is not flat.
    """

    arm: float = 1.0
    jitter_s: float = GRID["jitter_s"][-1]
    blur_s: float = GRID["blur_s"][-1]
    corner_px: float = 0.0


@dataclasses.dataclass(frozen=True)
class State:
    """Poses of the tags (g) at the begin of their stands, and the numbers (p): parameters, then joints' zeros."""

    tags: Pose
    values: Array


@dataclasses.dataclass(frozen=True)
class Linear:
    """Residuals (n, 8) and the prediction's derivatives: by own tag and what is free (n, 8, 6 + free), by the camera's
    pose (n, 8, 6), and by time (n, 8)."""

    residual: Array
    jacobian: Array
    by_camera: Array
    by_time: Array


@dataclasses.dataclass(frozen=True)
class Motion:
    """The chain's links at the stamps less ``late_s``, and how each moves there: tangents (n, 6) per second.

    Taken from samples a little further apart than those that give the link itself: otherwise the noise of a sample
    would be in both, and noise that looks like motion would pull the latency to where it averages out. An arm that
    moves less than STILL_PER_S counts as still.
    """

    late_s: float
    at_stamps: tuple[Pose, ...]
    per_second: tuple[Array, ...]

    @staticmethod
    def at(sweep: Sweep, late_s: float) -> Motion:
        reach_ns = max(round(1.2e9 * interval_s(sweep)), 1_000_000)
        stamps = [int(t) - round(late_s * 1e9) for t in sweep.t_ns]
        now, before, after = (sweep.kinematics.links([t + d for t in stamps])[0] for d in (0, -reach_ns, reach_ns))
        moved = [b.inv() * a for a, b in zip(after, before, strict=True)]
        per_second = [np.hstack([m.rotation.as_rotvec(), m.translation]) * (1e9 / (2 * reach_ns)) for m in moved]
        fastest = np.max([np.linalg.norm(p.reshape(-1, 2, 3), axis=2).max(axis=1) for p in per_second], axis=0)
        moves = (fastest > STILL_PER_S).astype(np.float64)[:, None]
        return Motion(late_s, tuple(now), tuple(p * moves for p in per_second))

    def links(self, late_s: float) -> list[Pose]:
        """Return every step's transforms at the stamps less so many seconds, by the motion there."""
        seconds = self.late_s - late_s
        if seconds == 0.0:
            return list(self.at_stamps)
        return [link * _exp(seconds * speed) for link, speed in zip(self.at_stamps, self.per_second, strict=True)]


@dataclasses.dataclass(frozen=True)
class Problem:
    """Everything that stays the same: sightings, stated camera, what is free, and the joints' axes."""

    sweep: Sweep
    observed: Array
    noise: Array
    points: Array
    parameters: tuple[Parameter, ...]
    free: NDArray[np.int64]
    joints: tuple[tuple[int, Array], ...]
    prior: Array
    steps: Array
    inwards: Array
    shrinking: Array
    motion: Motion

    @staticmethod
    def of(sweep: Sweep, fixed: frozenset[int], *, size_sigma: float = SIZE_SHARE) -> Problem:
        """State the problem without ``fixed`` parameters; ``size_sigma``: what the tags' sizes are known to."""
        camera = refinable(sweep.camera)
        parameters = (*hand_parameters(), latency_parameter(), *camera_parameters(camera))
        joints = _joint_axes(sweep)
        free = [i for i in range(len(parameters)) if i not in fixed]
        free += range(len(parameters), len(parameters) + len(joints) + 3)
        sizes = [s.size_m for s in sweep.stands]
        return Problem(
            dataclasses.replace(sweep, camera=camera),
            sweep.corners_px,
            sweep.noise_px,
            np.stack([tag_corners(sizes[g]) for g in sweep.stand]),
            parameters,
            np.array(free),
            joints,
            np.array([p.wide for p in parameters] + [JOINT_SIGMA_RAD] * len(joints) + [SHRINK_S, EDGE_PX, size_sigma]),
            np.array([p.step for p in parameters] + [1e-5] * len(joints) + [1e-4, 1e-2, 1e-5]),
            inwards(sweep.corners_px, None),
            np.zeros((len(sweep), 4, 2)),
            Motion.at(sweep, 0.0),
        )

    def around(self, state: State) -> Problem:
        """Return the problem with the arm's motion taken where the stamps now are, and the corners' with it."""
        near = dataclasses.replace(self, motion=Motion.at(self.sweep, float(state.values[LATENCY])))
        return dataclasses.replace(near, shrinking=inwards(near.observed, speed_px(near, state)))

    def cameras(self, values: Array) -> Pose:
        """Return ref_from_cam (n)."""
        result = self.sweep.ref_from_body
        for link, turn in self._chain(values):
            result = result * link
            if turn is not None:
                result = result * _exp(np.concatenate([turn, np.zeros(3)]))
        return result * _exp(values[HAND])

    def _chain(self, values: Array) -> list[tuple[Pose, Array | None]]:
        """Return every step's transforms (n), and the small rotation (3,) by which its joint's zero is off, if any."""
        zeros = values[len(self.parameters) : -3]
        turns: dict[int, Array] = {}
        for (i, axis), zero in zip(self.joints, zeros, strict=True):
            turns[i] = turns.get(i, np.zeros(3)) + zero * axis
        return [(link, turns.get(i)) for i, link in enumerate(self.motion.links(float(values[LATENCY])))]

    def _turned(self, values: Array) -> list[Array]:
        """Return by how much (n, 6) the cameras move, in their own frames, with every joint's zero.

        A turn about an axis a through the joint moves a camera at p by a x p. Turns (3,) differ from their derivative
        by half their product with the axis, and by less than their square.
        """
        joint_from_cam, after = _exp(values[HAND]), {}
        chain = self._chain(values)
        for i in range(len(chain) - 1, -1, -1):
            link, turn = chain[i]
            after[i] = joint_from_cam
            if turn is not None:
                joint_from_cam = _exp(np.concatenate([turn, np.zeros(3)])) * joint_from_cam
            joint_from_cam = link * joint_from_cam
        moved = []
        for i, axis in self.joints:
            turn = chain[i][1]
            along = axis if turn is None else axis - np.cross(turn, axis) / 2
            rotation, n = after[i].rotation.inv(), len(self.noise)
            shift = rotation.apply(np.cross(along, after[i].translation))
            moved.append(np.hstack([np.broadcast_to(part, (n, 3)) for part in (rotation.apply(along), shift)]))
        return moved

    def predict(self, cameras: Pose, tags: Pose, values: Array) -> Array:
        """Return the corners' pixels (n, 4, 2)."""
        cam_from_tag = cameras.inv() * tags[self.sweep.stand]
        turn, shift = cam_from_tag.rotation.as_matrix(), cam_from_tag.translation
        x_in_cam = np.einsum("nij,nkj->nki", turn, math.exp(values[-1]) * self.points) + shift[:, None]
        return self._image(x_in_cam, values)

    def _image(self, x_in_cam: Array, values: Array) -> Array:
        """Return the pixels (n, 4, 2) of the corners where they are in the cameras (n, 4, 3)."""
        xy = x_in_cam[..., :2] / np.maximum(x_in_cam[..., 2:], 1e-3)
        camera = changed(self.sweep.camera, values[CAMERA])
        pixels = camera.distort(xy.reshape(-1, 2)) * camera.focal_px + camera.centre_px
        return pixels.reshape(-1, 4, 2) + float(values[-3]) * self.shrinking + float(values[-2]) * self.inwards

    def residual(self, state: State) -> Array:
        """Return the residuals (n, 8)."""
        predicted = self.predict(self.cameras(state.values), state.tags, state.values)
        return (self.observed - predicted).reshape(-1, 8)

    def linearise(self, state: State) -> Linear:
        """Return residuals and their derivatives, numerically."""
        cameras, values = self.cameras(state.values), state.values
        by_tags, by_cameras = self._by_poses(cameras, state)
        n, columns = len(self.noise), list(np.moveaxis(by_tags, 2, 0))
        turned, first = self._turned(values), len(self.parameters)
        for k in self.free:
            if 0 <= k - first < len(turned):
                columns.append(np.einsum("nai,ni->na", by_cameras, turned[k - first]))
            else:
                columns.append(self.slope(state, cameras, int(k)))
        return Linear(
            (self.observed - self.predict(cameras, state.tags, values)).reshape(n, 8),
            np.stack([c.reshape(n, 8) for c in columns], axis=2),
            by_cameras,
            self.slope(state, cameras, LATENCY).reshape(n, 8),
        )

    def _by_poses(self, cameras: Pose, state: State) -> tuple[Array, Array]:
        """Return the derivatives (n, 8, 6) of the pixels by right perturbations of the tags and of the cameras."""
        n, values = len(self.noise), state.values
        cam_from_tag = cameras.inv() * state.tags[self.sweep.stand]
        turn, x_in_tag = cam_from_tag.rotation.as_matrix(), math.exp(values[-1]) * self.points
        x_in_cam = np.einsum("nij,nkj->nki", turn, x_in_tag) + cam_from_tag.translation[:, None]
        steps = _TAG_STEP * np.eye(3)
        slopes = [
            (self._image(x_in_cam + s, values) - self._image(x_in_cam - s, values)) / (2 * _TAG_STEP) for s in steps
        ]
        slope = np.stack(slopes, axis=-1)
        # A turn about an axis a moves x by a x x; a camera's turn moves what it sees the other way
        by_turn = np.stack([np.cross(axis, x_in_tag) for axis in np.eye(3)], axis=-1)
        by_other = -np.stack([np.cross(axis, x_in_cam) for axis in np.eye(3)], axis=-1)
        x_by_tag = turn[:, None] @ np.concatenate([by_turn, np.broadcast_to(np.eye(3), by_turn.shape)], axis=-1)
        x_by_cam = np.concatenate([by_other, np.broadcast_to(-np.eye(3), by_other.shape)], axis=-1)
        return (slope @ x_by_tag).reshape(n, 8, 6), (slope @ x_by_cam).reshape(n, 8, 6)

    def slope(self, state: State, cameras: Pose, k: int) -> Array:
        """Return the derivative (n, 4, 2) of the predicted pixels by a number, not by a joint's zero."""
        step = np.zeros(len(self.prior))
        step[k] = self.steps[k]
        ahead, behind = state.values + step, state.values - step
        at = [cameras, cameras]
        if k == LATENCY:
            at = [self.cameras(ahead), self.cameras(behind)]
        elif k < LATENCY:
            cam_from_hand = _exp(state.values[HAND]).inv()
            at = [cameras * (cam_from_hand * _exp(v[HAND])) for v in (ahead, behind)]
        high, low = (self.predict(c, state.tags, v) for c, v in zip(at, (ahead, behind), strict=True))
        return (high - low) / (2 * float(self.steps[k]))

    def weights(self, linear: Linear, noise: Noise) -> tuple[Array, Array]:
        """Return the inverse covariance (n, 8, 8) of the residuals and its log determinant (n,)."""
        speed = np.mean(linear.by_time**2, axis=1) * 2
        alone = noise.corner_px**2 + noise.blur_s**2 * speed
        total = self.noise + alone[:, None, None] * np.eye(8)
        total = total + noise.arm**2 * linear.by_camera @ ARM_PER_IMAGE @ linear.by_camera.transpose(0, 2, 1)
        total += noise.jitter_s**2 * linear.by_time[:, :, None] * linear.by_time[:, None, :]
        return np.asarray(np.linalg.inv(total)), -np.asarray(np.linalg.slogdet(total)[1])

    def normal(self, linear: Linear, weights: Array, used: Mask, state: State) -> tuple[Array, Array]:
        """Return normal matrix and gradient: tags (6 each), then what is free, with what is known beforehand."""
        n_tags, n_free = len(self.sweep.stands), len(self.free)
        jacobian, weighted = linear.jacobian[used], weights[used] @ linear.jacobian[used]
        blocks = jacobian.transpose(0, 2, 1) @ weighted
        pulls = np.einsum("nai,na->ni", weighted, linear.residual[used])
        tags, first = self.sweep.stand[used], 6 * n_tags
        own_blocks, mixed, own_pulls = np.zeros((n_tags, 6, 6)), np.zeros((n_tags, 6, n_free)), np.zeros((n_tags, 6))
        np.add.at(own_blocks, tags, blocks[:, :6, :6])
        np.add.at(mixed, tags, blocks[:, :6, 6:])
        np.add.at(own_pulls, tags, pulls[:, :6])
        matrix = np.zeros((first + n_free, first + n_free))
        for g, block in enumerate(own_blocks):
            matrix[6 * g : 6 * g + 6, 6 * g : 6 * g + 6] = block
        matrix[:first, first:] = mixed.reshape(first, n_free)
        matrix[first:, :first] = matrix[:first, first:].T
        matrix[first:, first:] = blocks[:, 6:, 6:].sum(axis=0)
        gradient = np.concatenate([own_pulls.ravel(), pulls[:, 6:].sum(axis=0)])
        own = np.arange(6 * n_tags, len(matrix))
        matrix[own, own] += 1 / self.prior[self.free] ** 2
        gradient[own] -= state.values[self.free] / self.prior[self.free] ** 2
        return matrix, gradient

    def moved(self, state: State, step: Array) -> State:
        n_tags = len(self.sweep.stands)
        turns = step[: 6 * n_tags].reshape(-1, 6)
        values = state.values.copy()
        values[self.free] += step[6 * n_tags :]
        return State(state.tags * _exp(turns), values)

    def cost(self, state: State, weights: Array, used: Mask) -> float:
        chi2 = chi_square(self.residual(state), weights)[used].sum()
        return float(chi2 + np.sum((state.values[self.free] / self.prior[self.free]) ** 2))


def _exp(d: Array) -> Pose:
    """Return Exp of (6,) or (n, 6), as `fieldkit.frames.exp` does for one."""
    return Pose.from_components(d[..., 3:], Rotation.from_rotvec(d[..., :3]))


def _joint_axes(sweep: Sweep) -> tuple[tuple[int, Array], ...]:
    """Return (step, axis) for every small rotation by which the joints' zeros may be off.

    A joint that turns does so about the axis that it shows; one that stands still may be off about any. None where tf
    has the wrist in the body only: an error there is the tag's or the camera's place.
    """
    moving = [i for i, (_, _, moves) in enumerate(sweep.kinematics.steps) if moves]
    if len(moving) < 2:
        return ()
    links, _ = sweep.kinematics.links([int(t) for t in sweep.t_ns])
    axes = []
    for i in moving:
        turns = (links[i][0].rotation.inv() * links[i].rotation).as_rotvec()
        _, _, directions = np.linalg.svd(turns, full_matrices=False)
        reach = float(np.abs(turns @ directions[0]).max())
        one = reach > TURNED_RAD and float(np.abs(turns @ directions[1]).max()) < 0.1 * reach
        axes += [(i, a) for a in (directions[:1] if one else np.eye(3))]
    return tuple(axes)


def interval_s(sweep: Sweep) -> float:
    """Return the time in s between two samples of the arm's transforms."""
    moving = [(target, source) for target, source, moves in sweep.kinematics.steps if moves]
    return max(sweep.kinematics.tf.interval_ns(*frames) for frames in moving) / 1e9


def speed_px(problem: Problem, state: State) -> Array:
    """Return the motion (n, 4, 2) of the corners in px/s."""
    return problem.slope(state, problem.cameras(state.values), LATENCY)


def inwards(corners: Array, speed: Array | None) -> Array:
    """Return how corners (n, 4, 2) of a black square move where all its edges move into it.

    Every edge moves by one pixel; or, with the motion of its corner (n, 4, 2), by what that has along its normal.
    """
    along = np.roll(corners, -1, axis=1) - corners
    normal = np.stack([along[..., 1], -along[..., 0]], axis=-1) / np.linalg.norm(along, axis=-1, keepdims=True)
    outwards = np.sum(normal * (corners - corners.mean(axis=1, keepdims=True)), axis=-1, keepdims=True)
    normal = normal * np.sign(outwards)
    both = np.stack([normal, np.roll(normal, 1, axis=1)], axis=-2)
    by = np.ones((len(corners), 4, 2, 1)) if speed is None else np.abs(both @ speed[..., None])
    return np.asarray(np.linalg.solve(both, -by)[..., 0], dtype=np.float64)


def chi_square(residual: Array, weights: Array) -> Array:
    """Return the squared deviation (n,) of residuals (n, 8) with inverse covariances (n, 8, 8)."""
    result: Array = np.einsum("na,nab,nb->n", residual, weights, residual)
    return result
