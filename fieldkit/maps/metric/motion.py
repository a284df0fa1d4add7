"""The scale of a walk by its steps: SLAM's drift bends a long way, but hardly shortens the pieces of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fieldkit.frames import Pose

Array = NDArray[np.float64]
Walks = Sequence[Sequence[int]]

# Steps of so many images are tried; of longer ones a walk has too few
_LAGS = (1, 2, 4, 8, 16, 32)
_LEAST_STEPS = 8
# In median residuals: farther off are jumps, and images that one of the two has elsewhere
_WIDTH = 4.0


def motion_scale(
    sfm_from_cam: Sequence[Pose], slam_from_cam: Sequence[Pose], walks: Walks
) -> tuple[float, float] | None:
    """Return metres per unit of SfM by the steps between images, and its relative standard deviation.

    ``walks`` are the rows of each camera's images, in the order in which they were taken. A step is compared as its
    first camera sees it, so that a wrong heading does not matter, and weighs by its length, as errors of a random walk
    grow. Of the numbers of images per step the one is taken whose residuals make the scale the surest: few where
    drift is what is wrong, many where each position is by itself. Noise that is not small against the steps makes
    them look too long: how much is in the standard deviation. Returns None for walks that are too short.
    """
    found = [result for lag in _LAGS if (result := _by_steps(sfm_from_cam, slam_from_cam, walks, lag)) is not None]
    return min(found, key=lambda result: result[1]) if found else None


def _by_steps(
    sfm_from_cam: Sequence[Pose], slam_from_cam: Sequence[Pose], walks: Walks, lag: int
) -> tuple[float, float] | None:
    steps = [(w[k], w[k + lag]) for w in walks for k in range(len(w) - lag)]
    # Cameras of one rig share their errors: the longest walk says how many steps there are that overlap nowhere
    independent = max((len(w) for w in walks), default=0) / lag
    if independent < _LEAST_STEPS:
        return None
    slam, sfm = (
        np.stack([(poses[i].inv() * poses[j]).translation for i, j in steps]) for poses in (slam_from_cam, sfm_from_cam)
    )
    length = np.linalg.norm(sfm, axis=1)
    moved = length > 0.02 * np.median(length)
    if moved.sum() < _LEAST_STEPS:
        return None
    slam, sfm, length = slam[moved], sfm[moved], length[moved]
    along = (slam * sfm).sum(axis=1)
    scale, used = float(np.median(along / length**2)), np.ones(len(length), dtype=bool)
    for _ in range(20):
        if not scale > 0:
            return None
        off = np.linalg.norm(slam - scale * sfm, axis=1) / np.sqrt(length)
        used = off <= _WIDTH * np.median(off) + 1e-12
        before, scale = scale, float((along[used] / length[used]).sum() / length[used].sum())
        if abs(scale - before) < 1e-9 * before:
            break
    wrong = (along - scale * length**2)[used] / length[used] ** 1.5
    walked = independent * float(length[used].sum()) / len(length)
    # With the roles of the two exchanged noise counts on the other side
    other = float(np.linalg.norm(slam[used], axis=1).sum() / (along[used] / np.linalg.norm(slam[used], axis=1)).sum())
    bias = abs(other / scale - 1.0) / 2
    return scale, float(np.hypot(np.sqrt(np.mean(wrong**2) / walked) / scale, bias))


def position_sigma(source: Array, residual: Array, walks: Walks) -> float:
    """Return the relative standard deviation of the scale that a similarity of positions has.

    ``source`` (n, 3) are the positions and ``residual`` (n, 3) what the fit left, both in m. Residuals of neighbours
    along a walk are alike under drift: they count as many as there are correlation lengths in it.
    """
    rows = np.concatenate([np.asarray(w, dtype=int) for w in walks])
    away = source - source[rows].mean(axis=0)
    total = float((away[rows] ** 2).sum())
    pull = (residual * away).sum(axis=1)
    longest = np.asarray(max(walks, key=len), dtype=int)
    series = residual[longest]
    power, reach = float((series**2).sum()), 1.0
    if power > 0:
        for lag in range(1, len(series)):
            alike = float((series[lag:] * series[:-lag]).sum()) / power
            if alike <= 0:
                break
            reach += 2 * alike
    shared = len(rows) / len(longest) * reach
    return float(np.sqrt((pull[rows] ** 2).sum() * shared) / total)
