"""What sightings say of a body whose tilt against a tag they hardly see: an integral instead of a linear model.

A tag that faces the camera looks the same when it is slanted a little to one side or to the other, so the likelihood of
its tilt is no Gaussian: two solutions, apart or merged. The two angles of the tilt are integrated over numerically;
everything else is a Gaussian for each of them (Laplace's method).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import logsumexp

from fieldkit.frames import Array, Pose, adjoint
from fieldkit.tags.joint import Problem, State, inverse

# How far from upright a body may well stand, and the tag be calibrated: the odds between planar solutions. One robot in
# so many stands on a slope, or its body's z is not up
UPRIGHT_RAD, ASLANT = math.radians(2.0), 1e-4
# Twice the log likelihood at two standard deviations of the tilt is 4; off by more than this, the linear model is left
LINEAR = 0.4
# Twice the log likelihood by which the mirrored tilt has to be worse not to count
UNLIKELY = 16.0
# Places of the integral per solution, and the degrees of freedom of Student's law that they are spread by
COUNT, FREEDOM = 64, 4.0
# Newton's steps at each of them, and what the next one may still gain in chi-square
STEPS, SMALL = 5, 0.02
# A tag is not seen from behind
BEHIND_RAD = 2.5
# Fewer places of weight than this are no integral
ENOUGH = 6
# A solution that is turned by less than this many standard deviations is no other one
SAME = 1.0


@dataclasses.dataclass(frozen=True)
class Belief:
    """States of body, hand camera (n, 6) and steps (n, s, 6) with weights (n,); the covariance about each of them.

    ``chosen`` (n,) are the weights of the solution that is taken, where two stay open, else the same.
    """

    weights: Array
    chosen: Array
    map_from_body: Pose
    shared: Array
    step_errors: Array
    joint: Array

    def moments(self, poses: Pose) -> tuple[Pose, Array]:
        """Return the mean of poses (n) of the states over the solution that is taken, and 6x6 second moments about it.

        The moments are over both solutions, without the covariance about each state.
        """
        mean = poses[int(np.argmax(self.chosen))]
        if len(poses) == 1:
            return mean, np.zeros((6, 6))
        for _ in range(4):
            shift = self.chosen @ _logs(mean.inv() * poses)
            mean = mean * Pose.from_components(shift[3:], Rotation.from_rotvec(shift[:3]))
        deltas = _logs(mean.inv() * poses)
        return mean, (deltas * self.weights[:, None]).T @ deltas


@dataclasses.dataclass(frozen=True)
class Other:
    """The other planar solution's body, and the evidence (difference of chi-squares) against it.

    Sightings from one direction repeat an error of lens or paper and are not as sure as they say all together: then the
    evidence ``is_bound``, else they speak for themselves.
    """

    map_from_body: Pose
    evidence: float
    is_bound: bool


def tilt(map_from_body: Pose) -> float:
    """Return the angle (rad) between the body's z and the map's."""
    return float(np.arccos(np.clip(map_from_body.rotation.as_matrix()[2, 2], -1.0, 1.0)))


def believe(
    problem: Problem, state: State, scale: float, *, normal: Array, factor: float, other: Other | None = None
) -> Belief:
    """Return what the sightings say about the state at their minimum: one Gaussian, or an integral over the tilt.

    ``normal`` is the normal matrix there; ``factor`` divides chi-squares. Without another solution the linear model is
    tested at two standard deviations of the tilt to either side and at the mirrored tilt. Upright bodies are preferred,
    but only between solutions: not within one.
    """
    here = _Place(np.zeros(2), 0.0, state, inverse(normal) * factor)
    linear = _belief([here], np.ones(1), np.zeros(1, dtype=np.intp), known=problem.tags_at)
    try:
        places = _Tilting(problem, state, scale, factor)
        spread = places.spread(state, normal)
        if other is None and places.is_linear(spread):
            return linear
        return _integrate(places, spread, other) or linear
    except np.linalg.LinAlgError:
        return linear


@dataclasses.dataclass(frozen=True)
class _Place:
    """A tilt, twice its negative log likelihood (rest integrated over), the state of all else and its covariance."""

    tilt: Array
    cost: float
    state: State
    covariance: Array


class _Tilting:
    """The likelihood of the tilt: a turn of the body about axes in the plane of a tag, as a rotation vector (2,)."""

    def __init__(self, problem: Problem, state: State, scale: float, factor: float) -> None:
        self.problem, self.scale, self.factor = problem, scale, factor
        self.origin = state
        self.map_from_tag = problem.parts[0].tag.map_from_tag

    def at(self, turn: Array, state: State | None = None) -> _Place:
        """Minimise over all else at a tilt, from a state at it; the cost is infinite where there is no minimum."""
        if state is None:
            turned = Pose.from_rotation(Rotation.from_rotvec([*turn, 0.0]))
            body = self.map_from_tag * turned * self.map_from_tag.inv() * self.origin.map_from_body
            state = dataclasses.replace(self.origin, map_from_body=body)
        try:
            return self._minimise(turn, state)
        except np.linalg.LinAlgError:
            return _Place(turn, math.inf, state, np.zeros((self.problem.n_unknown, self.problem.n_unknown)))

    def _minimise(self, turn: Array, state: State) -> _Place:
        for _ in range(STEPS):
            normal, gradient, total, logdet = self.problem.normal(state, self.scale)
            free = self._free(state)
            rest = free.T @ normal @ free
            step = np.linalg.solve(rest, free.T @ gradient)
            gain = float(step @ rest @ step)
            if gain < SMALL * self.factor:
                break
            state = state.moved(free @ step)
        covariance = free @ inverse(rest) @ free.T * self.factor
        # Directions of the paper's normal are alike: the measure on the sphere
        angle = float(np.linalg.norm(turn))
        sphere = math.log(np.sinc(angle / math.pi)) if angle < BEHIND_RAD else -math.inf
        cost = (total - gain) / self.factor + logdet + float(np.linalg.slogdet(rest)[1]) - 2 * sphere
        return _Place(turn, cost if np.isfinite(cost) and gain < 1.0 else math.inf, state, covariance)

    def spread(self, state: State, normal: Array) -> Array:
        """Return the 2x2 covariance of the tilt in the linear model."""
        by_body = adjoint(self.map_from_tag.inv() * state.map_from_body)[:2]
        covariance: Array = by_body @ inverse(normal)[:6, :6] @ by_body.T * self.factor
        return covariance

    def is_linear(self, spread: Array) -> bool:
        """Tell whether the likelihood is that of the linear model: at two standard deviations, and where mirrored."""
        values, axes = np.linalg.eigh(spread)
        here = self.at(np.zeros(2)).cost
        turns = [sign * 2 * math.sqrt(v) * axis for v, axis in zip(values, axes.T, strict=True) for sign in (-1, 1)]
        if any(abs(self.at(turn).cost - here - 4) > LINEAR for turn in turns):
            return False
        mirrored = self.mirrored()
        return _is_same(mirrored, spread) or self.at(mirrored).cost - here > UNLIKELY

    def turn_to(self, map_from_body: Pose) -> Array:
        """Return the tilt at which a body stands."""
        here, there = (self.map_from_tag.inv() * b for b in (self.origin.map_from_body, map_from_body))
        return _turn((here * there.inv()).rotation.as_matrix()[:, 2])

    def mirrored(self) -> Array:
        """Return the tilt that would look the same without perspective: mirrored at the mean direction of the views."""
        cams = self.origin.map_from_body * self.problem.ref_from_body * self.problem.body_from_cam
        views = (self.map_from_tag.inv() * cams).translation
        view = (views / np.linalg.norm(views, axis=1, keepdims=True)).mean(axis=0)
        view /= np.linalg.norm(view)
        return _turn(2 * view[2] * view - [0.0, 0.0, 1.0])

    def _free(self, state: State) -> Array:
        """Return the directions (u, u - 2) of the unknowns that leave the tilt as it is."""
        n = self.problem.n_unknown
        free = np.zeros((n, n - 2))
        free[:6, :4] = adjoint(state.map_from_body.inv() * self.map_from_tag)[:, 2:]
        free[6:, 4:] = np.eye(n - 6)
        return free


def _integrate(places: _Tilting, spread: Array, other: Other | None) -> Belief | None:
    """Return the weighted places of an importance sample of one or two solutions; None where too few of them count."""
    second, mirrored = None if other is None else _second(places, other), places.mirrored()
    modes = [(np.zeros(2), spread)]
    if second is not None:
        modes.append(second)
    elif not _is_same(mirrored, spread):
        # Merged to a shoulder of the first
        modes.append((mirrored, spread))
    turns = np.concatenate([centre + _students(cov) for centre, cov in modes])
    density = np.stack([_density(turns - centre, cov) for centre, cov in modes])
    found = [places.at(turn) for turn in turns]
    cost = np.array([p.cost for p in found])
    if not np.isfinite(cost.min()):
        return None
    logs = (cost.min() - cost) / 2 - np.log(density.sum(axis=0))
    weights = _normalised(logs)
    if 1.0 / float(weights @ weights) < ENOUGH:
        return None
    owner = density.argmax(axis=0) if other is not None and second is not None else np.zeros(len(found), dtype=np.intp)
    if other is not None and second is None and other.is_bound:
        # All together show no second solution, but single ones do
        found.append(places.at(places.turn_to(other.map_from_body), places.problem.start(other.map_from_body)))
        logs = np.append(logs, logsumexp(logs) - other.evidence / 2)
        owner = np.append(owner, 1)
    if other is not None and owner.any():
        tilts = np.array([tilt(p.state.map_from_body) for p in found])
        weights = _between(logs, owner, tilts, abs(other.evidence) if other.is_bound else math.inf)
    return _belief(found, weights, owner, known=places.problem.tags_at)


def _belief(found: Sequence[_Place], weights: Array, owner: NDArray[np.intp], *, known: int) -> Belief:
    kept = np.flatnonzero(weights > 1e-5)
    places, weights, owner = [found[int(i)] for i in kept], weights[kept] / weights[kept].sum(), owner[kept]
    chosen = np.where(owner == (weights[owner == 1].sum() > 0.5), weights, 0.0)
    return Belief(
        weights,
        chosen / chosen.sum(),
        Pose.concatenate([p.state.map_from_body for p in places]),
        np.stack([p.state.shared for p in places]),
        np.stack([p.state.step_errors for p in places]),
        np.einsum("n,nij->ij", weights, np.stack([p.covariance[:known, :known] for p in places])),
    )


def _second(places: _Tilting, other: Other) -> tuple[Array, Array] | None:
    """Return tilt and 2x2 covariance of the other solution; None where it has merged into the first."""
    start = places.problem.start(other.map_from_body)
    state, normal, _, _ = places.problem.minimise(start, places.scale)
    turn = places.turn_to(state.map_from_body)
    spread = places.spread(state, normal)
    return None if _is_same(turn, spread) else (turn, spread)


def _is_same(turn: Array, spread: Array) -> bool:
    return float(turn @ np.linalg.solve(spread, turn)) < SAME**2


def _turn(normal: Array) -> Array:
    """Return the turn (2,) of a body about a tag after which the tag's normal is seen where this one (3,) was."""
    x, y, z = normal
    across = math.hypot(x, y)
    return math.atan2(across, z) / max(across, 1e-12) * np.array([y, -x])


def _between(logs: Array, owner: NDArray[np.intp], tilts: Array, evidence: float) -> Array:
    """Return weights with odds between two solutions of no more evidence than allowed, and of how upright they are.

    ``logs`` (n,) are logarithms of weights, ``owner`` (n,) the solution of each, ``tilts`` (n,) how far it is from
    upright in rad. How upright a solution is does not change the weights within it.
    """
    upright = logs + np.logaddexp(-((tilts / UPRIGHT_RAD) ** 2) / 2, math.log(ASLANT))
    mass = np.array([_log_sum(logs[owner == k]) for k in range(2)])
    stands = np.array([_log_sum(upright[owner == k]) for k in range(2)]) - mass
    if not np.isfinite(mass).all():
        return _normalised(logs)
    odds = float(np.clip(mass[1] - mass[0], -evidence / 2, evidence / 2) + stands[1] - stands[0])
    share = -np.logaddexp(0.0, [odds, -odds])
    return _normalised(logs + (share - mass)[owner])


def _log_sum(logs: Array) -> float:
    return float(logsumexp(logs)) if len(logs) else -math.inf


def _normalised(logs: Array) -> Array:
    weights = np.exp(logs - logs.max())
    result: Array = weights / weights.sum()
    return result


def _students(covariance: Array) -> Array:
    """Return points (COUNT, 2) evenly spread by Student's law: Roberts' sequence, which is the same every time."""
    golden = 1.32471795724474602596
    u, v = ((0.5 + np.arange(1, COUNT + 1)[:, None] / golden ** np.array([1, 2])) % 1.0).T
    radius = np.sqrt(FREEDOM * ((1 - u) ** (-2 / FREEDOM) - 1))
    circle = radius[:, None] * np.column_stack([np.cos(2 * np.pi * v), np.sin(2 * np.pi * v)])
    result: Array = circle @ np.linalg.cholesky(covariance).T
    return result


def _density(delta: Array, covariance: Array) -> Array:
    square = np.einsum("ni,ni->n", delta, np.linalg.solve(covariance, delta.T).T)
    result: Array = (1 + square / FREEDOM) ** (-(FREEDOM + 2) / 2) / math.sqrt(np.linalg.det(covariance))
    return result


def _logs(poses: Pose) -> Array:
    return np.concatenate([poses.rotation.as_rotvec(), poses.translation], axis=1)
