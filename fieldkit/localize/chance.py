"""How sure a pose is: could matches that mean nothing agree with one as well as these do?"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

Array = NDArray[np.float64]

# Matches that a pose is made of agree with it in any case
_SAMPLE = 3
# Matches nearer than this to each other show the same thing, and count as one
_CELL_PX = 8.0
# Residuals below this are taken for this: keypoints are no more exact
_LEAST_PX = 1.0
# Decades of chance that matches lose when they are crowded e times closer: a poster or a socket that hangs elsewhere,
# too, agrees in all its keypoints. Set, as the two below, on rendered queries of five scenes in each other's maps
_CROWDED = 6.0
# Half of the queries with this many decades of evidence are right, one in e fewer with this many less
_MIDDLE, _WIDTH = -3.0, 3.0
# Matches that miss by less say where in the image the pose is seen to be right
_NEAR_PX = 4.0


@dataclasses.dataclass(frozen=True)
class Agreement:
    """Matches of one camera with a pose: where they are seen f64[n, 2] and by how much they miss f64[n], both in px
    of the image of ``area_px`` in which keypoints were found.
    """

    pixels: Array
    residual_px: Array
    area_px: float


def log_false_alarms(cameras: Sequence[Agreement], *, max_error_px: float) -> float:
    """Return log10 of the expected number of poses on which random matches would agree as these do.

    The matches are as many, every one of them is anywhere in the image, and the best number of them is looked for:
    Moisan and Stival 2004, IJCV 57(3), as Moulon et al. 2012 (AC-RANSAC) use it, for three matches to make a pose.
    """
    shares = []
    for camera in cameras:
        order = np.argsort(camera.residual_px, kind="stable")
        cells = np.floor(camera.pixels[order] / _CELL_PX).astype(np.int64)
        _, first = np.unique(cells, axis=0, return_index=True)
        residual = np.maximum(camera.residual_px[order][first], _LEAST_PX)
        shares.append(np.where(residual <= max_error_px, math.pi * residual**2 / camera.area_px, np.inf))
    share = np.sort(np.concatenate(shares))
    n = len(share)
    k = np.arange(_SAMPLE + 1, int((share < 1.0).sum()) + 1)
    if not len(k):
        return math.inf
    choices = _log_choose(n, k) + _log_choose(k, np.full(len(k), _SAMPLE))
    log_alarms = math.log(n - _SAMPLE) + choices + (k - _SAMPLE) * np.log(share[k - 1])
    return float(log_alarms.min()) / math.log(10.0)


def confidence(cameras: Sequence[Agreement], *, max_error_px: float) -> float:
    """Return 0..1, the probability that a pose is right, from how little chance explains its matches.

    Crowded matches, or those in a row, say less than as many all over the image. Repeated places, and things that
    were moved, are not chance: no single image tells them.
    """
    spread = max(_narrow_spread(c) for c in cameras)
    evidence = -log_false_alarms(cameras, max_error_px=max_error_px) + _CROWDED * math.log(spread)
    return float(1.0 / (1.0 + math.exp(min(max(-(evidence - _MIDDLE) / _WIDTH, -700.0), 700.0))))


def _narrow_spread(camera: Agreement) -> float:
    """Return the smaller standard deviation of matches over the image, in sides of a square as large as the image."""
    near = camera.pixels[camera.residual_px <= _NEAR_PX]
    if len(near) <= _SAMPLE:
        return 1e-3
    narrow = float(np.linalg.eigvalsh(np.cov(near.T))[0])
    return max(math.sqrt(max(narrow, 1.0) / camera.area_px), 1e-3)


def _log_choose(n: int | NDArray[np.int64], k: NDArray[np.int64]) -> Array:
    return np.asarray(gammaln(np.asarray(n) + 1.0) - gammaln(k + 1.0) - gammaln(np.asarray(n) - k + 1.0))
