"""Whether odometry and camera share a clock: a tag that stands must stay where it is while the robot moves."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fieldkit.frames import Array, Pose, Trajectory, log
from fieldkit.types import OdometryFault

# Sightings of a tag are compared with the ones before it, up to this long
PAIR_NS = 3_000_000_000
SEARCH_S, STEP_S = 1.5, 0.02
BRIDGED_NS = 1_100_000_000
MIN_PAIRS, MAX_PAIRS = 20, 1500
# Squared deviation per pair beyond which it counts no more, and what odometry errs by (share of the way)
CAP, DRIFT = 30.0, 0.05
# A clock is wrong where the offset is this long, this many deviations from 0, and explains this much of the residuals
FAULT_S, FAULT_SIGMAS, FAULT_GAIN = 0.06, 5.0, 0.3


@dataclasses.dataclass(frozen=True)
class PlacedTag:
    """A standing tag relative to the body by one image: time, id, body_from_tag and its 6x6 covariance."""

    t_ns: int
    id: int
    body_from_tag: Pose
    covariance: Array


_Pair = tuple[PlacedTag, PlacedTag]


@dataclasses.dataclass(frozen=True)
class ClockOffset:
    """What must be added to image stamps to find the odometry of that moment, its standard deviation, in s.

    ``gain`` is the share of the squared deviations that the offset explains, ``n_pairs`` how many pairs of sightings of
    a tag tell; the sightings lie between ``t_begin_ns`` and ``t_end_ns``.
    """

    offset_s: float
    sigma_s: float
    gain: float
    n_pairs: int
    t_begin_ns: int
    t_end_ns: int

    @property
    def is_wrong(self) -> bool:
        """Whether the offset is long, significant, and explains much of what is left without it."""
        significant = abs(self.offset_s) > FAULT_SIGMAS * self.sigma_s
        return abs(self.offset_s) > FAULT_S and significant and self.gain > FAULT_GAIN


def clock_offset(odometry: Trajectory, tags: Sequence[PlacedTag]) -> ClockOffset | None:
    """Estimate the offset between the stamps of odometry and of images from standing tags that were seen in motion.

    Pairs of sightings of one tag within 3 s give the body's motion, which odometry must have made too: the offset up to
    1.5 s with the least squared deviation, by the sightings' covariances and 5 % of the way for odometry, outliers
    capped. None where fewer than 20 pairs tell, or the robot stood: then no offset shows.
    """
    pairs = _pairs(tags, odometry)
    if len(pairs) < MIN_PAIRS:
        return None
    samples = _Samples.of(odometry)
    seen = np.stack([log(a.body_from_tag * b.body_from_tag.inv()) for a, b in pairs])
    noise = np.stack([_noise(a, b) for a, b in pairs])
    offsets = np.arange(-SEARCH_S, SEARCH_S + STEP_S / 2, STEP_S)
    costs = np.array([_cost(float(o), pairs, samples, seen=seen, noise=noise) for o in offsets])
    best = int(np.argmin(costs))
    zero = float(np.interp(0.0, offsets, costs))
    around = slice(max(best - 2, 0), best + 3)
    curve = np.polyfit(offsets[around] - offsets[best], costs[around], 2)
    if not (0 < best < len(offsets) - 1) or curve[0] <= 0:
        return None
    offset = float(offsets[best] + np.clip(-curve[1] / (2 * curve[0]), -STEP_S, STEP_S))
    # Deviations per degree of freedom beyond 1 widen the parabola: whatever the stated noise misses
    spread = max(1.0, float(costs[best]) / (6 * len(pairs)))
    sigma = math.sqrt(spread / float(curve[0]))
    gain = max(0.0, 1.0 - float(costs[best]) / max(zero, 1e-12))
    times = [p.t_ns for pair in pairs for p in pair]
    return ClockOffset(offset, sigma, gain, len(pairs), min(times), max(times))


def offset_fault(offset: ClockOffset | None) -> OdometryFault | None:
    """Return the fault that a wrong clock is, or None."""
    if offset is None or not offset.is_wrong:
        return None
    word = "early" if offset.offset_s < 0 else "late"
    text = (
        f"stamps are {abs(offset.offset_s):.2f} s (sigma {offset.sigma_s:.2f}) too {word} against the images: "
        f"{offset.n_pairs} pairs of tag sightings in motion fit {100 * offset.gain:.0f} % better with that offset,"
    )
    return OdometryFault("offset", offset.t_begin_ns, offset.t_end_ns, text)


def _pairs(tags: Sequence[PlacedTag], odometry: Trajectory) -> list[_Pair]:
    """Pair every sighting with later ones of the same tag, where odometry reaches at any offset."""
    margin = round(SEARCH_S * 1e9)
    first, last = int(odometry.t_ns[0]) + margin, int(odometry.t_ns[-1]) - margin
    inside = sorted((t for t in tags if first <= t.t_ns <= last), key=lambda t: t.t_ns)
    found = []
    for i, one in enumerate(inside):
        for other in inside[i + 1 :]:
            if other.t_ns - one.t_ns > PAIR_NS:
                break
            if other.id == one.id and other.t_ns > one.t_ns:
                found.append((one, other))
    if len(found) > MAX_PAIRS:
        found = [found[i] for i in np.linspace(0, len(found) - 1, MAX_PAIRS).astype(int)]
    return found


def _noise(one: PlacedTag, other: PlacedTag) -> Array:
    """Return variances (6,) of the body's motion between two sightings, rounded up to one per rotation and position."""
    rotation = np.trace(one.covariance[:3, :3]) + np.trace(other.covariance[:3, :3])
    reach = float(np.linalg.norm(other.body_from_tag.translation))
    position = np.trace(one.covariance[3:, 3:]) + np.trace(other.covariance[3:, 3:]) + rotation * reach**2
    moved = one.body_from_tag * other.body_from_tag.inv()
    turn, way = moved.rotation.magnitude(), float(np.linalg.norm(moved.translation))
    rotation = rotation / 3 + (DRIFT * turn) ** 2 + math.radians(0.2) ** 2
    position = position / 3 + (DRIFT * way) ** 2 + 0.003**2
    return np.array([rotation] * 3 + [position] * 3)


@dataclasses.dataclass(frozen=True)
class _Samples:
    """Odometry as arrays: times, rotations and positions, and the longest gap that is bridged."""

    t_ns: NDArray[np.int64]
    rotation: Rotation
    position: Array
    max_gap_ns: int

    @staticmethod
    def of(odometry: Trajectory) -> _Samples:
        stack = Pose.concatenate(list(odometry.poses))
        return _Samples(odometry.t_ns, stack.rotation, stack.translation, max(odometry.max_gap_ns, BRIDGED_NS))

    def at(self, t_ns: NDArray[np.int64]) -> tuple[Pose, NDArray[np.bool_]]:
        """Return the poses at times within the samples, interpolated, and which of them lie in no gap."""
        right = np.clip(np.searchsorted(self.t_ns, t_ns), 1, len(self.t_ns) - 1)
        before, after = self.t_ns[right - 1], self.t_ns[right]
        share = ((t_ns - before) / (after - before))[:, None]
        turned = (self.rotation[right - 1].inv() * self.rotation[right]).as_rotvec()
        rotation = self.rotation[right - 1] * Rotation.from_rotvec(share * turned)
        position = (1 - share) * self.position[right - 1] + share * self.position[right]
        return Pose.from_components(position, rotation), (after - before) <= self.max_gap_ns


def _cost(offset_s: float, pairs: Sequence[_Pair], odometry: _Samples, *, seen: Array, noise: Array) -> float:
    shift = round(offset_s * 1e9)
    first, second = (np.array([pair[k].t_ns + shift for pair in pairs], dtype=np.int64) for k in (0, 1))
    (begin, reached), (end, also) = odometry.at(first), odometry.at(second)
    moved = begin.inv() * end
    made = np.concatenate([moved.rotation.as_rotvec(), moved.translation], axis=1)
    deviation = np.minimum(((made - seen) ** 2 / noise).sum(axis=1), CAP)[reached & also]
    # Pairs in a gap of odometry are taken as the mean of the others, so that offsets stay comparable
    return float(deviation.mean() * len(pairs)) if len(deviation) else math.inf
