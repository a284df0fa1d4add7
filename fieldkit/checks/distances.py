"""A tape measure against the map: distances between tags, and the scale error that they would mean."""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from fieldkit.checks.parameters import require_positive
from fieldkit.errors import TagError
from fieldkit.frames import Array
from fieldkit.types import TagMap, TagPose

log = logging.getLogger(__name__)

Verdict = Literal["pass", "warn", "fail"]

TAPE_SIGMA_M = 0.002
# Deviations up to so many sigmas pass; beyond so many, and by at least this share of the distance, they fail
PASS_SIGMAS, FAIL_SIGMAS, FAIL_SHARE = 2.0, 4.0, 0.005
# A distance whose 2 sigma exceeds this share tells little about scale
WEAK_SHARE = 0.02


@dataclasses.dataclass(frozen=True)
class TagName:
    """A tag as a user names it: its id, and the visit of a tag that is moved between waypoints."""

    id: int
    visit: str | None = None

    def __str__(self) -> str:
        return str(self.id) if self.visit is None else f"{self.id}@{self.visit}"


@dataclasses.dataclass(frozen=True)
class Tape:
    """A distance in m that was measured with a tape between the centres of two tags."""

    a: TagName
    b: TagName
    measured_m: float


@dataclasses.dataclass(frozen=True)
class DistanceCheck:
    """A taped distance beside the map's: their difference (map minus tape) in m with its sigma, and the verdict.

    ``sigma_m`` has both tags' covariances and the tape's noise; ``reason`` says what the verdict rests on.
    """

    tape: Tape
    map_m: float
    difference_m: float
    sigma_m: float
    verdict: Verdict
    reason: str

    @property
    def share(self) -> float:
        """Difference as a share of the taped distance: the scale error of the map that it would mean."""
        return self.difference_m / self.tape.measured_m

    @property
    def sigma_share(self) -> float:
        """Sigma as a share of the taped distance."""
        return self.sigma_m / self.tape.measured_m


@dataclasses.dataclass(frozen=True)
class ScaleCheck:
    """The scale error of the map that all distances together mean, with its sigma, as shares.

    ``sigmas`` is how far, per distance beyond the first, they are from one common scale: above 2 or so not the scale
    but a tag or a measurement is wrong. 0 for one distance.
    """

    error: float
    sigma: float
    sigmas: float
    verdict: Verdict


def parse_tag(text: str) -> TagName:
    """Parse ``3`` or ``3@w02`` (the pose of a visit). Raises TagError."""
    head, at, visit = text.partition("@")
    if not head.strip().isdecimal() or (at and not visit):
        raise TagError(f"--distance: {text!r} is no tag; expected an id (3), or an id and a visit (3@w02)")
    return TagName(int(head), visit or None)


def check_distances(
    tags: TagMap, tapes: Sequence[Tape], *, tape_sigma_m: float = TAPE_SIGMA_M
) -> tuple[tuple[DistanceCheck, ...], ScaleCheck]:
    """Compare taped distances between tag centres with the map, each by itself and all as one scale.

    The tags' covariances are taken as independent of each other: what tags share (a warp of the map, the same photos)
    moves them together and is not in the sigma. Raises TagError for an unknown tag or an impossible distance.
    """
    if not tapes:
        raise TagError("no distance to check; expected at least one")
    require_positive("--tape-sigma-m", tape_sigma_m)
    ends = [(_find(tags, t.a), _find(tags, t.b)) for t in tapes]
    for tape, (a, b) in zip(tapes, ends, strict=True):
        _check_tape(tags, tape, a, b)
    distance, jacobian, positions = _geometry(ends)
    covariance = jacobian @ positions @ jacobian.T + np.eye(len(tapes)) * tape_sigma_m**2
    checks = tuple(
        _judge(tape, float(d), math.sqrt(v)) for tape, d, v in zip(tapes, distance, np.diag(covariance), strict=True)
    )
    return checks, _scale(np.array([t.measured_m for t in tapes]), distance, covariance)


def _find(tags: TagMap, name: TagName) -> TagPose:
    found = tags.find(name.id, visit=name.visit)
    if found is not None:
        return found
    where = tags.path or "the tag file"
    own = [t for t in tags.tags if t.id == name.id]
    if name.visit is None and len(own) == 1:
        return own[0]
    if own:
        listed = ", ".join(f"{name.id}@{t.visit}" for t in own)
        raise TagError(f"{where}: tag {name} has a pose per visit; expected one of {listed}", hint="name the visit")
    known = ", ".join(str(TagName(t.id, t.visit)) for t in tags.tags) or "no tag"
    raise TagError(f"{where}: has no tag {name}; expected one of {known}", hint="correct the id")


def _check_tape(tags: TagMap, tape: Tape, a: TagPose, b: TagPose) -> None:
    if a is b:
        raise TagError(f"--distance {tape.a} {tape.b}: is the same tag twice; expected two tags")
    if not (math.isfinite(tape.measured_m) and 0.05 <= tape.measured_m <= 1000):
        raise TagError(
            f"--distance {tape.a} {tape.b} {tape.measured_m:g}: no distance between two tags; expected metres, 0.05 to "
            "1000"
        )
    for name, tag in ((tape.a, a), (tape.b, b)):
        if tag.verdict == "fail":
            log.warning("%s: tag %s has the verdict 'fail': its distances say little", tags.path or "tags", name)
        if not np.diag(tag.covariance).any():
            log.warning("%s: tag %s has no covariance: it counts as known exactly", tags.path or "tags", name)


def _geometry(ends: Sequence[tuple[TagPose, TagPose]]) -> tuple[Array, Array, Array]:
    """Return distances (n,), their derivative (n, 3k) by the positions of k tags, and these' covariance (3k, 3k)."""
    tags: list[TagPose] = []
    for tag in (t for pair in ends for t in pair):
        if not any(tag is known for known in tags):
            tags.append(tag)
    positions = np.zeros((3 * len(tags), 3 * len(tags)))
    for i, tag in enumerate(tags):
        turn = tag.map_from_tag.rotation.as_matrix()
        positions[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = turn @ tag.covariance[3:, 3:] @ turn.T
    distance, jacobian = np.zeros(len(ends)), np.zeros((len(ends), 3 * len(tags)))
    for row, (a, b) in enumerate(ends):
        along = b.map_from_tag.translation - a.map_from_tag.translation
        distance[row] = np.linalg.norm(along)
        for tag, sign in ((a, -1.0), (b, 1.0)):
            i = next(i for i, known in enumerate(tags) if known is tag)
            jacobian[row, 3 * i : 3 * i + 3] = sign * along / max(distance[row], 1e-12)
    return distance, jacobian, positions


def _judge(tape: Tape, map_m: float, sigma_m: float) -> DistanceCheck:
    difference = map_m - tape.measured_m
    deviation, share = abs(difference) / sigma_m, abs(difference) / tape.measured_m
    seen = 2 * sigma_m / tape.measured_m
    verdict: Verdict = "pass"
    reason = f"agrees; a scale error below {100 * seen:.2g} % would not show"
    if deviation > FAIL_SIGMAS and share > FAIL_SHARE:
        verdict = "fail"
        reason = f"off by {deviation:.1f} sigma and {100 * share:.2f} %: scale, a tag or the tape is wrong"
    elif deviation > PASS_SIGMAS:
        verdict, reason = "warn", f"off by {deviation:.1f} sigma: measure again"
    elif seen > WEAK_SHARE:
        verdict, reason = "warn", f"too coarse: 2 sigma are {100 * seen:.2g} %; take tags that are further apart"
    return DistanceCheck(tape, map_m, difference, sigma_m, verdict, reason)


def _scale(measured_m: Array, map_m: Array, covariance: Array) -> ScaleCheck:
    """Fit map = (1 + error) * tape by generalised least squares."""
    weighted = np.linalg.solve(covariance, measured_m)
    information = float(measured_m @ weighted)
    error = float(weighted @ map_m) / information - 1.0
    rest = map_m - (1.0 + error) * measured_m
    chi2, sigma = float(rest @ np.linalg.solve(covariance, rest)), 1.0 / math.sqrt(information)
    spread = math.sqrt(chi2 / (len(map_m) - 1)) if len(map_m) > 1 else 0.0
    deviation = abs(error) / sigma
    verdict: Verdict = "pass"
    if spread > FAIL_SIGMAS or (deviation > FAIL_SIGMAS and abs(error) > FAIL_SHARE):
        verdict = "fail"
    elif spread > PASS_SIGMAS or deviation > PASS_SIGMAS or 2 * sigma > WEAK_SHARE:
        verdict = "warn"
    return ScaleCheck(error, sigma, spread, verdict)
