"""Hand-eye calibration from tags that stand still: hand-to-camera transform, latency, camera, all at once."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from fieldkit.checks.parameters import Parameter
from fieldkit.checks.sweep_problem import (
    CHORD_INTERVALS,
    GRID,
    LATENCY,
    SIZE_SHARE,
    Linear,
    Mask,
    Noise,
    Problem,
    State,
    chi_square,
    interval_s,
)
from fieldkit.checks.sweeps import Sweep
from fieldkit.errors import TagError
from fieldkit.frames import Array, Pose
from fieldkit.tags import Sighting, fuse_sightings

# A latency that changes by less has been found
SETTLED_S = 1e-4
# Median of chi-square with 8 degrees of freedom
MEDIAN_CHI2 = 7.34
# To begin with: how far stated kinematics and calibration may be off
START_COVARIANCE: Array = np.diag([math.radians(3.0) ** 2] * 3 + [0.03**2] * 3)
# What is known beforehand of the logarithm of the tags' size where their stated one does not count; and from how many
# sigmas apart the stated one does not
SIZE_UNKNOWN, SIZE_AGREES = 1.0, 3.0
# Squared deviation of one sighting (8 degrees of freedom) beyond which it is an outlier
GATE = 40.0


@dataclasses.dataclass(frozen=True)
class SweepFit:
    """The solution: deviations from the stated values in the order of ``parameters``, and their covariance.

    ``values`` f64[p] and ``covariance`` f64[p, p] in rad, m, s, log and pixels. ``noise`` is what the residuals show.
    ``size`` is by how much larger the tags are than stated, as a share, by the sweep alone, and its sigma.
    ``rms_px`` is the root mean square of the corners' residuals before anything is corrected and after, kinematics as
    they are. ``excess`` is that of what remains over its noise, arm and motion included: about 1 where the noise that
    was found explains it.
    """

    parameters: tuple[Parameter, ...]
    values: Array
    covariance: Array
    noise: Noise
    used: Mask
    size: tuple[float, float]
    rms_px: tuple[float, float]
    excess: float

    def sigma(self, index: int) -> float:
        """Return the standard deviation of a parameter."""
        return math.sqrt(float(self.covariance[index, index]))


def fit_sweep(sweep: Sweep, *, fixed: frozenset[int] = frozenset()) -> SweepFit:
    """Fit tags, hand_from_cam, latency and camera to all sightings by least squares.

    Unknowns: a pose of every tag in every stand; the correction of the camera in the hand (hand_from_cam * Exp(d));
    by how much stamps are late, with kinematics interpolated there; focal length, aspect, centre and distortion;
    where tf has every joint, small errors of the joints' zeros; by how much blur makes tags smaller; and their size.
    Residuals are corners, with their noise and that of arm and motion, which restricted maximum likelihood finds.
    ``fixed`` parameters keep their stated value. What is known beforehand is wide: a parameter that the sweep does
    not show comes back with a sigma as wide. So is the tags' size at first; where the sweep agrees with the stated one,
    that counts as measured, and the rest is fitted again.
    Raises TagError where the corners determine nothing.
    """
    try:
        problem = Problem.of(sweep, fixed, size_sigma=SIZE_UNKNOWN)
        start = _start(problem, sweep)
        stated = problem.residual(start)
        free = _fit(problem, start, Noise(), np.ones(len(sweep), dtype=bool))
        found = _described(free, stated)
        size, sigma = found.size
        if abs(size) > SIZE_AGREES * math.hypot(sigma, SIZE_SHARE):
            return found
        problem = Problem.of(sweep, fixed, size_sigma=SIZE_SHARE)
        held = _fit(problem, free.state, free.noise, free.used)
        return dataclasses.replace(_described(held, stated), size=found.size)
    except np.linalg.LinAlgError as error:
        raise TagError(
            f"{sweep.path}: the {len(sweep)} sightings of tags determine no solution ({error}); expected tags of the "
            "stated sizes that stand still",
            hint="check sizes, camera_info and tf",
        ) from error


@dataclasses.dataclass(frozen=True)
class _Solved:
    """Where the search ended: the problem about there, the state, the noise, and the sightings that are used."""

    problem: Problem
    state: State
    noise: Noise
    used: Mask


def _fit(problem: Problem, state: State, noise: Noise, used: Mask) -> _Solved:
    """Alternate between the state, the noise, and who is within the gate."""
    for _ in range(12):
        late_s = float(state.values[LATENCY])
        problem = problem.around(state)
        state = _minimise(problem, state, used, noise)
        settled = abs(float(state.values[LATENCY]) - late_s) < SETTLED_S
        linear = problem.linearise(state)
        shown = _noise(problem, state, linear, used, noise)
        chi2 = chi_square(linear.residual, problem.weights(linear, shown)[0])
        # Nobody leaves before the noise is known
        now = chi2 < GATE * max(1.0, float(np.median(chi2[used])) / MEDIAN_CHI2) if shown == noise else used
        if settled and shown == noise and (now == used).all():
            break
        noise, used = shown, now
    return _Solved(problem, _minimise(problem, state, used, noise), noise, used)


def _described(solved: _Solved, stated: Array) -> SweepFit:
    """Return the solution with its covariance, widened where residuals exceed their noise; ``stated`` are those (n, 8)
    before anything was corrected."""
    problem, state, used = solved.problem, solved.state, solved.used
    sweep = problem.sweep
    linear = problem.linearise(state)
    weights, _ = problem.weights(linear, solved.noise)
    matrix, _ = problem.normal(linear, weights, used, state)
    freedom = max(8 * int(used.sum()) - 6 * len(sweep.stands) - len(problem.free), 1)
    factor = float(chi_square(linear.residual, weights)[used].sum()) / freedom
    count, first = len(problem.parameters), 6 * len(sweep.stands)
    inverse: Array = np.asarray(np.linalg.inv(matrix), dtype=np.float64) * max(1.0, factor)
    own = problem.free < count
    inside = first + np.flatnonzero(own)
    covariance = np.zeros((count, count))
    covariance[np.ix_(problem.free[own], problem.free[own])] = inverse[np.ix_(inside, inside)]
    covariance[LATENCY, LATENCY] += (CHORD_INTERVALS * interval_s(sweep)) ** 2
    larger = math.exp(float(state.values[-1]))
    size = larger - 1.0, larger * math.sqrt(float(inverse[-1, -1]))
    old, new = (float(np.sqrt(np.mean(r[used] ** 2))) for r in (stated, linear.residual))
    return SweepFit(
        problem.parameters, state.values[:count], covariance, solved.noise, used, size, (old, new), math.sqrt(factor)
    )


def _start(problem: Problem, sweep: Sweep) -> State:
    """Place every tag where its sightings agree most, as far as the stated calibration lets them."""
    values = np.zeros(len(problem.prior))
    cameras = problem.cameras(values)
    tags = []
    for g, stand in enumerate(sweep.stands):
        rows = np.flatnonzero(sweep.stand == g)
        seen = [Sighting(sweep.detections[i], sweep.camera, cameras[int(i)], START_COVARIANCE) for i in rows]
        tags.append(fuse_sightings(seen, stand.size_m, scales=(1.0,)).ref_from_tag)
    return State(Pose.concatenate(tags), values)


def _minimise(problem: Problem, state: State, used: Mask, noise: Noise) -> State:
    """Minimise by Levenberg-Marquardt; the weights follow the state."""
    damping = 1e-4
    for _ in range(40):
        linear = problem.linearise(state)
        weights, _ = problem.weights(linear, noise)
        matrix, gradient = problem.normal(linear, weights, used, state)
        cost = problem.cost(state, weights, used)
        while True:
            step = np.asarray(np.linalg.solve(matrix + damping * np.diag(np.diag(matrix)), gradient), dtype=np.float64)
            candidate = problem.moved(state, step)
            gain = cost - problem.cost(candidate, weights, used)
            if gain >= 0 or damping > 1e6:
                break
            damping *= 10
        if gain < 0:
            return state
        state, damping = candidate, max(damping / 10, 1e-12)
        if gain < 1e-6 * (1.0 + cost):
            break
    return state


def _noise(problem: Problem, state: State, linear: Linear, used: Mask, noise: Noise) -> Noise:
    """Return the most likely noise, one of its parts after the other."""
    for _ in range(3):
        before = noise
        for name, values in GRID.items():
            options = [dataclasses.replace(noise, **{name: v}) for v in values]
            noise = min(options, key=lambda n: _likelihood(problem, state, linear, used, n))
        if noise == before:
            break
    return noise


def _likelihood(problem: Problem, state: State, linear: Linear, used: Mask, noise: Noise) -> float:
    """Return twice the negative restricted log likelihood of a noise, up to a constant."""
    weights, log_information = problem.weights(linear, noise)
    matrix, gradient = problem.normal(linear, weights, used, state)
    chi2 = float(chi_square(linear.residual, weights)[used].sum())
    prior = float(np.sum((state.values[problem.free] / problem.prior[problem.free]) ** 2))
    # At the minimum that belongs to this noise, to first order
    reduced = chi2 + prior - float(gradient @ np.linalg.solve(matrix, gradient))
    return reduced - float(log_information[used].sum()) + float(np.linalg.slogdet(matrix)[1])
