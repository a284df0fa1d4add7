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
    Linear,
    Mask,
    Motion,
    Noise,
    Problem,
    State,
    chi_square,
    interval_s,
    inwards,
    speed_px,
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
# Squared deviation of one sighting (8 degrees of freedom) beyond which it is an outlier
GATE = 40.0


@dataclasses.dataclass(frozen=True)
class SweepFit:
    """The solution: deviations from the stated values in the order of ``parameters``, and their covariance.

    ``values`` f64[p] and ``covariance`` f64[p, p] in rad, m, s, log and pixels. ``noise`` is what the residuals show.
    ``size`` is by how much larger the tags are than stated, as a share, by the sweep alone, and its sigma.
    ``rms_px`` is the root mean square of the corners' residuals before anything is corrected and after, kinematics as
    they are.
    """

    parameters: tuple[Parameter, ...]
    values: Array
    covariance: Array
    noise: Noise
    used: Mask
    size: tuple[float, float]
    rms_px: tuple[float, float]

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
    not show comes back with a sigma as wide.
    Raises TagError where the corners determine nothing.
    """
    problem = Problem.of(sweep, fixed)
    try:
        return _fit(problem, sweep)
    except np.linalg.LinAlgError as error:
        raise TagError(
            f"{sweep.path}: the {len(sweep)} sightings of tags determine no solution ({error}); expected tags of the "
            "stated sizes that stand still",
            hint="check sizes, camera_info and tf",
        ) from error


def _fit(problem: Problem, sweep: Sweep) -> SweepFit:
    state = _start(problem, sweep)
    before = problem.residual(state)
    noise, used = Noise(), np.ones(len(sweep), dtype=bool)
    for _ in range(12):
        late_s = float(state.values[LATENCY])
        problem = dataclasses.replace(problem, motion=Motion.at(sweep, late_s))
        problem = dataclasses.replace(problem, shrinking=inwards(problem.observed, speed_px(problem, state)))
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
    state = _minimise(problem, state, used, noise)
    linear = problem.linearise(state)
    weights, _ = problem.weights(linear, noise)
    matrix, _ = problem.normal(linear, weights, used, state)
    freedom = max(8 * int(used.sum()) - 6 * len(sweep.stands) - len(problem.free), 1)
    factor = max(1.0, float(chi_square(linear.residual, weights)[used].sum()) / freedom)
    count, first = len(problem.parameters), 6 * len(sweep.stands)
    inverse: Array = np.asarray(np.linalg.inv(matrix), dtype=np.float64) * factor
    own = problem.free < count
    inside = first + np.flatnonzero(own)
    covariance = np.zeros((count, count))
    covariance[np.ix_(problem.free[own], problem.free[own])] = inverse[np.ix_(inside, inside)]
    covariance[LATENCY, LATENCY] += (CHORD_INTERVALS * interval_s(sweep)) ** 2
    size = _without_prior(float(state.values[-1]), float(inverse[-1, -1]), float(problem.prior[-1]) ** 2)
    old, new = (float(np.sqrt(np.mean(r[used] ** 2))) for r in (before, linear.residual))
    return SweepFit(problem.parameters, state.values[:count], covariance, noise, used, size, (old, new))


def _without_prior(value: float, variance: float, prior: float) -> tuple[float, float]:
    """Return value and sigma of a number without what was known beforehand, as precision and mean add up."""
    share = max(1.0 - variance / prior, 1e-6)
    return value / share, math.sqrt(variance / share)


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
