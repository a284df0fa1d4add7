"""Which sightings agree: chi-square gates about a consensus, and how well photos are really localized.

Why gates and no robust loss: photos are wrong by decimetres or right within millimetres, so that from a start in which
most agree, the test of each sighting against what all others predict, with both covariances, separates them; what
passes is Gaussian, and the inverse normal matrix stays its covariance. Down-weighting would bias both.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import scipy.optimize
import scipy.stats

from fieldkit.calibrate.adjustment import (
    FREE_SIZE_SIGMA,
    Adjusted,
    Corners,
    FixedLandmarks,
    Mask,
    State,
    adjust,
)
from fieldkit.frames import Array

# Share of right sightings that are lost
LOST = 1e-4
# The stated noise of localization is believed as if so many residuals had shown it
BELIEVED = 12
# What the stated noise of localization may be multiplied by
MAX_SCALE = 8.0
# Steps of the logarithm of that scale that make no difference
SCALE_STEP = 0.02
# A direction of a residual that the other observations determine by less than this share is not tested
OPEN = 1e-6


@dataclasses.dataclass(frozen=True)
class Agreement:
    """The solved problem, and per sighting (c): its chi-square against what all others predict, and its dimension.

    ``scale`` multiplied the standard deviations of localization; ``inflation`` multiplies the covariance for
    differences that no scale explains.
    """

    adjusted: Adjusted
    chi2: Array
    dimension: Array
    scale: float
    inflation: float

    @property
    def sigmas(self) -> Array:
        """Deviation (c,) from the others in standard deviations per dimension; 0 where nothing tests a sighting."""
        return np.asarray(np.sqrt(self.chi2 / np.maximum(self.dimension, 1)))


def agree(
    landmarks: FixedLandmarks, corners: Corners, start: State, *, used: Mask, free_sizes: Mask | None = None
) -> Agreement:
    """Find the sightings that agree, starting with the consensus ``used`` bool[c], and solve for them.

    Sightings that the consensus left out enter where its prediction admits them. Then the worst leaves while it is
    beyond the gate: a sighting, or all sightings of a photo whose landmarks contradict two or more of them. Each test
    compares with what is predicted without the tested, and with the noise that the others show.
    """
    now = settle(landmarks, corners, start, used=used, free_sizes=free_sizes)
    for _ in range(3):
        seen = np.isin(corners.tag, corners.tag[now.adjusted.used])
        entering = ~now.adjusted.used & seen & (now.chi2 < _gate(8, freedom(now.adjusted, corners)))
        if not entering.any():
            break
        used = now.adjusted.used | entering
        now = settle(landmarks, corners, now.adjusted.state, used=used, free_sizes=free_sizes, scale=now.scale)
    for _ in range(len(corners)):
        worst = _worst(landmarks, now, corners)
        if worst is None:
            break
        used, state = now.adjusted.used & ~worst, now.adjusted.state
        rest = settle(landmarks, corners, state, used=used, free_sizes=free_sizes, scale=now.scale)
        if predicted_chi2(rest.adjusted, worst) < _gate(8 * int(worst.sum()), freedom(rest.adjusted, corners)):
            break
        now = rest
    return now


def settle(
    landmarks: FixedLandmarks,
    corners: Corners,
    start: State,
    *,
    used: Mask,
    free_sizes: Mask | None = None,
    scale: float = 1.0,
) -> Agreement:
    """Solve for given sightings with the noise of localization that they show."""
    adjusted = adjust(landmarks.loosened(scale), corners, start, used=used, free_sizes=free_sizes)
    for _ in range(3):
        found, inflation = noise_scale(landmarks, adjusted, corners)
        if abs(math.log(found / scale)) < SCALE_STEP:
            break
        scale, loose = found, landmarks.loosened(found)
        adjusted = adjust(loose, corners, adjusted.state, used=used, free_sizes=free_sizes)
    return Agreement(adjusted, *deviations(adjusted, corners), scale, inflation)


def freedom(adjusted: Adjusted, corners: Corners) -> int:
    """Return by how much sightings and landmarks together are over-determined: 6 per sighting beyond a tag's first."""
    used = adjusted.used
    n_sizes = int(adjusted.solved[-len(adjusted.state.tags) :].sum())
    return 6 * (int(used.sum()) - len(np.unique(corners.tag[used]))) - n_sizes


def noise_scale(landmarks: FixedLandmarks, adjusted: Adjusted, corners: Corners) -> tuple[float, float]:
    """Return what the standard deviations of localization must be multiplied by, 1..8, and what remains, at least 1.

    What shifts a whole photo (see `FixedLandmarks.loosened`) no residual inside of it shows. The photos' differences
    at the tags do: the scale is the most likely one by restricted maximum likelihood (Patterson and Thompson 1971),
    only upwards. Where the differences exceed even so their degrees of freedom, the rest multiplies the covariance.
    """
    dof = freedom(adjusted, corners)
    if dof <= 0:
        return 1.0, 1.0
    between = _Between.of(landmarks, adjusted, corners)
    if between.cost(1.0) <= between.cost(math.exp(SCALE_STEP)):
        scale = 1.0
    else:
        found = scipy.optimize.minimize_scalar(
            lambda x: between.cost(math.exp(x)), bounds=(0.0, math.log(MAX_SCALE)), options={"xatol": SCALE_STEP}
        )
        scale = math.exp(float(found.x))
    return scale, max(1.0, (BELIEVED + between.chi2(scale)) / (BELIEVED + dof))


@dataclasses.dataclass(frozen=True)
class _Between:
    """What landmarks and corners say about the same cameras and tags, as two quadratics about the solution.

    ``wanted`` is where the landmarks alone want the cameras. Of the corners' residuals only the part counts that a
    camera can explain: the rest is inside of one sighting.
    """

    landmarks: FixedLandmarks
    wanted: Array
    corners: Array
    gradient: Array
    square: float

    @staticmethod
    def of(landmarks: FixedLandmarks, adjusted: Adjusted, corners: Corners) -> _Between:
        """Linearise a solution."""
        solved, rows = adjusted.solved, np.flatnonzero(adjusted.used)
        own = np.stack([adjusted.derivative[c][:, 6 * corners.photo[c] : 6 * corners.photo[c] + 6] for c in rows])
        explained = np.einsum("cai,ca->ci", np.linalg.qr(own)[0], adjusted.residual[rows])
        stacked = adjusted.derivative[rows].reshape(-1, len(solved))
        normal, n_tags = stacked.T @ stacked, len(adjusted.state.tags)
        normal[-n_tags:, -n_tags:] += np.eye(n_tags) / FREE_SIZE_SIGMA**2
        return _Between(
            landmarks,
            adjusted.state.cameras.difference(landmarks.centre).ravel(),
            normal[np.ix_(solved, solved)],
            (stacked.T @ adjusted.residual[rows].ravel())[solved],
            float((explained**2).sum()),
        )

    def chi2(self, scale: float) -> float:
        """Return the smallest sum of both quadratics when localization is ``scale`` times as uncertain."""
        return self._sums(scale)[0]

    def cost(self, scale: float) -> float:
        """Return twice the negative restricted log likelihood, up to a constant."""
        chi2, joint, loose = self._sums(scale)
        return chi2 + float(np.linalg.slogdet(joint)[1] - np.linalg.slogdet(loose)[1])

    def _sums(self, scale: float) -> tuple[float, Array, Array]:
        loose, n = self.landmarks.loosened(scale).normal, len(self.wanted)
        normal, right, pull = self.corners.copy(), self.gradient.copy(), loose @ self.wanted
        normal[:n, :n] += loose
        right[:n] += pull
        return float(self.wanted @ pull + self.square - right @ np.linalg.solve(normal, right)), normal, loose


def deviations(adjusted: Adjusted, corners: Corners) -> tuple[Array, Array]:
    """Return chi-square (c,) of each sighting against what all others predict, and its dimension (c,).

    Of a used one this is the deletion residual v' (I - H)^-1 v (Cook and Weisberg 1982, section 2.2), H its block of
    the hat matrix; directions that nothing else determines are left out. Of one that is not used, or whose tag has no
    pose, it is the prediction's chi-square, or nothing.
    """
    chi2, dimension = np.zeros(len(corners)), np.zeros(len(corners))
    seen = np.isin(corners.tag, corners.tag[adjusted.used])
    for c in range(len(corners)):
        if adjusted.used[c]:
            hat = adjusted.derivative[c] @ adjusted.covariance @ adjusted.derivative[c].T
            chi2[c], dimension[c] = _quadratic(np.eye(8) - hat, adjusted.residual[c])
        elif seen[c]:
            chi2[c], dimension[c] = predicted_chi2(adjusted, np.arange(len(corners)) == c), 8
    return chi2, dimension


def predicted_chi2(adjusted: Adjusted, rows: Mask) -> float:
    """Return the chi-square of sightings that are not used against what is predicted, both covariances summed."""
    derivative = adjusted.derivative[rows].reshape(-1, len(adjusted.solved))
    residual = adjusted.residual[rows].ravel()
    total = np.eye(len(residual)) + derivative @ adjusted.covariance @ derivative.T
    return float(residual @ np.linalg.solve(total, residual))


def without(adjusted: Adjusted, rows: Mask) -> Array:
    """Return the step (6p + 6t + t,) that the solution takes when used sightings are left out, to first order."""
    derivative = adjusted.derivative[rows].reshape(-1, len(adjusted.solved))
    spread = adjusted.covariance @ derivative.T
    rest = np.eye(len(derivative)) - derivative @ spread
    return np.asarray(-spread @ np.linalg.pinv(rest, rcond=OPEN, hermitian=True) @ adjusted.residual[rows].ravel())


def _gate(dimension: int, dof: int) -> float:
    """Return the bound on a chi-square: that of an F-test, since the noise it is measured by is itself estimated."""
    return dimension * float(scipy.stats.f.isf(LOST, dimension, BELIEVED + max(dof, 0)))


def _worst(landmarks: FixedLandmarks, now: Agreement, corners: Corners) -> Mask | None:
    """Return which used sightings, of one tag or of one photo, contradict the rest most; None where none is tested."""
    adjusted = now.adjusted
    n_of_tag = np.bincount(corners.tag[adjusted.used], minlength=len(adjusted.state.tags))
    tested: Mask = adjusted.used & (n_of_tag[corners.tag] > 1)
    choices = [(float(now.chi2[c] - now.dimension[c]), np.arange(len(corners)) == c) for c in np.flatnonzero(tested)]
    loose = landmarks.loosened(now.scale)
    for photo in np.unique(corners.photo[tested]):
        rows = tested & (corners.photo == photo)
        if int(rows.sum()) > 1:
            choices.append((_landmark_excess(loose, adjusted, int(photo)), rows))
    excess, rows = max(choices, key=lambda choice: choice[0], default=(0.0, tested))
    return rows if excess > 0 else None


def _landmark_excess(loose: FixedLandmarks, adjusted: Adjusted, photo: int) -> float:
    """Return by how much the chi-square of a photo's landmarks against what the tags say exceeds its dimension.

    The difference of own and joint estimate has the difference of their covariances.
    """
    block = slice(6 * photo, 6 * photo + 6)
    difference = adjusted.state.cameras.difference(loose.centre)[photo]
    root = np.linalg.cholesky(loose.camera_covariance(photo))
    relative = np.linalg.solve(root, np.linalg.solve(root, adjusted.covariance[block, block]).T)
    square, count = _quadratic(np.eye(6) - relative, np.linalg.solve(root, difference))
    return square - count


def _quadratic(matrix: Array, vector: Array) -> tuple[float, int]:
    """Return v' M^-1 v over the eigenvectors whose eigenvalue is not nearly zero, and their number."""
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    kept = values > OPEN
    return float((((vectors.T @ vector)[kept]) ** 2 / values[kept]).sum()), int(kept.sum())
