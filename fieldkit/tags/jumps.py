"""How far odometry jumped while a tag was in sight: the tag stands, so what moved is odometry."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np

from fieldkit.errors import TagError
from fieldkit.frames import Array, Pose, adjoint, exp, log
from fieldkit.tags.fusion import Sighting, TagFix, fuse_sightings

# Noise of the arm while a jump is looked for, which is only where the joint problem starts
ARM_COVARIANCE: Array = np.diag([math.radians(0.5) ** 2] * 3 + [0.005**2] * 3)


def jump_between(
    before: Sequence[Sighting], after: Sequence[Sighting], *, size_m: float, ref_from_begin: Pose, covariance: Array
) -> Array:
    """Return the error (6,) of a step of odometry by the sightings of a tag before and after it, zeros where unknown.

    ``ref_from_begin`` is the body after the step and ``covariance`` 6x6 that of the step: the error is its right
    perturbation, and the mean of what odometry and the sightings say. Where planar solutions stay open, the likeliest
    pair counts.
    """
    try:
        fixes = [fuse_sightings(sightings, size_m) for sightings in (before, after)]
        found = [
            _step_error(one, two, ref_from_begin, covariance)
            for one, two in itertools.product(*(_options(fix) for fix in fixes))
        ]
        return min(found, key=lambda f: f[1])[0]
    except (TagError, np.linalg.LinAlgError):
        return np.zeros(6)


def move(ref_from_begin: Pose, error: Array) -> Pose:
    """Return what moves everything before a step in the reference where the step has an error (6,)."""
    return ref_from_begin * exp(error) * ref_from_begin.inv()


@dataclasses.dataclass(frozen=True)
class _Option:
    """A place of the tag that sightings leave open, its covariance, and chi-square beyond that of the best one."""

    ref_from_tag: Pose
    covariance: Array
    worse: float = 0.0


def _step_error(before: _Option, after: _Option, ref_from_begin: Pose, covariance: Array) -> tuple[Array, float]:
    """Return the error (6,) and twice the negative log likelihood, up to a constant."""
    error = log(ref_from_begin.inv() * after.ref_from_tag * before.ref_from_tag.inv() * ref_from_begin)
    by_tag = adjoint(ref_from_begin.inv() * after.ref_from_tag)
    total = covariance + by_tag @ (before.covariance + after.covariance) @ by_tag.T
    weighted = np.linalg.solve(total, error)
    unlikely = float(error @ weighted + np.linalg.slogdet(total)[1]) + before.worse + after.worse
    return covariance @ weighted, unlikely


def _options(fix: TagFix) -> list[_Option]:
    options = [_Option(fix.ref_from_tag, fix.covariance)]
    if not fix.is_certain and fix.alternative is not None and fix.alternative_covariance is not None:
        options.append(_Option(fix.alternative, fix.alternative_covariance, fix.evidence))
    return options
