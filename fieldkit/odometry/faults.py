"""What is wrong with odometry: gaps, jumps, and stamps that cannot be right; found from the messages alone."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fieldkit.frames import Array, Pose
from fieldkit.types import OdometryFault

Stamps = NDArray[np.int64]

MAX_GAP_NS = 500_000_000
# A step is a jump where it differs from what its neighbours' speed says by this many robust deviations, and by more
# than these: nothing that a robot drives on accelerates so much between two samples
JUMP_SIGMAS, JUMP_M, JUMP_RAD = 8.0, 0.05, math.radians(5.0)
ACCELERATION, ANGULAR_ACCELERATION = 10.0, math.radians(1500.0)
NEIGHBOURS = 4
# Share of the intervals that may be twice or half the median
IRREGULAR_SHARE = 0.1
# Latency: a stamp ahead of its arrival, a clock that runs away, and odometry against images
AHEAD_NS, DRIFT_NS, APART_NS = 20_000_000, 100_000_000, 250_000_000


def find_faults(
    t_ns: Stamps,
    poses: Sequence[Pose],
    *,
    received_ns: Stamps | None = None,
    image_latency_ns: float | None = None,
    max_gap_ns: int = MAX_GAP_NS,
) -> tuple[OdometryFault, ...]:
    """Find what is wrong with odometry samples in the order of their arrival; one fault per gap and per jump.

    ``t_ns`` int64[n] are the header stamps, ``received_ns`` int64[n] the times of arrival; ``image_latency_ns`` is the
    median arrival minus stamp of the images. Kinds: order (a stamp before the one that came before it), repeat (two
    poses with one stamp), gap, rate (intervals far from regular), jump (a step that its neighbours do not explain),
    latency (stamps after their arrival, a clock that drifts against it, or one far from the images').
    """
    if len(t_ns) < 2:
        return ()
    faults = _order(t_ns, poses)
    if received_ns is not None:
        faults += _latency(t_ns, received_ns, image_latency_ns)
    order = np.argsort(t_ns, kind="stable")
    order = order[np.concatenate([[True], np.diff(t_ns[order]) > 0])]
    times, kept = t_ns[order], [poses[int(i)] for i in order]
    if len(times) >= 2:
        faults += _gaps(times, max_gap_ns) + _rate(times) + _jumps(times, kept, max_gap_ns)
    return tuple(faults)


def summarize_faults(faults: Sequence[OdometryFault]) -> list[str]:
    """Return one line per kind of fault: its count, its worst or first case, and when."""
    lines = []
    for kind in dict.fromkeys(f.kind for f in faults):
        same = [f for f in faults if f.kind == kind]
        worst = max(same, key=_severity)
        when = f"from {worst.t_begin_ns} to {worst.t_end_ns} ns"
        more = f"; {len(same) - 1} more, the first at {same[0].t_begin_ns} ns" if len(same) > 1 else ""
        lines.append(f"odometry: {worst.message} {when}{more}")
    return lines


def _severity(fault: OdometryFault) -> float:
    if fault.kind == "jump":
        return max(fault.excess[0] / JUMP_M, fault.excess[1] / JUMP_RAD)
    return float(fault.t_end_ns - fault.t_begin_ns)


def _order(t_ns: Stamps, poses: Sequence[Pose]) -> list[OdometryFault]:
    faults = []
    back = np.flatnonzero(np.diff(t_ns) < 0)
    if len(back):
        far = float(-np.diff(t_ns)[back].min()) / 1e9
        text = (
            f"{len(back)} of {len(t_ns)} messages have a stamp before that of the message before, by up to {far:.3f} s,"
        )
        first, last = t_ns[back + 1], t_ns[back]
        faults.append(OdometryFault("order", int(first.min()), int(last.max()), text))
    order = np.argsort(t_ns, kind="stable")
    same = np.flatnonzero(np.diff(t_ns[order]) == 0)
    apart = [i for i in same if not _equal(poses[int(order[i])], poses[int(order[i + 1])])]
    if apart:
        times = t_ns[order[apart]]
        text = f"{len(apart)} of {len(t_ns)} messages repeat a stamp with another pose,"
        faults.append(OdometryFault("repeat", int(times[0]), int(times[-1]), text))
    return faults


def _equal(one: Pose, other: Pose) -> bool:
    return bool(np.allclose(one.as_matrix(), other.as_matrix(), atol=1e-9))


def _latency(t_ns: Stamps, received_ns: Stamps, image_latency_ns: float | None) -> list[OdometryFault]:
    latency = (received_ns - t_ns).astype(np.float64)
    median = float(np.median(latency))
    first, last = int(t_ns.min()), int(t_ns.max())
    found = []
    if median < -AHEAD_NS:
        found.append(f"stamps lie {-median / 1e9:.3f} s after the arrival of their messages (median),")
    tenth = max(len(latency) // 10, 1)
    begin, end = float(np.median(latency[:tenth])), float(np.median(latency[-tenth:]))
    if len(latency) >= 20 and abs(end - begin) > DRIFT_NS:
        found.append(
            f"stamps run away from their arrival: {begin / 1e9:.3f} s late at first, {end / 1e9:.3f} s at last,"
        )
    if image_latency_ns is not None and abs(median - image_latency_ns) > APART_NS:
        word = "lag behind" if median > image_latency_ns else "run ahead of"
        apart = abs(median - image_latency_ns) / 1e9
        found.append(f"stamps {word} those of the images by {apart:.3f} s, both against their arrival (median),")
    return [OdometryFault("latency", first, last, text) for text in found]


def _gaps(times: Stamps, max_gap_ns: int) -> list[OdometryFault]:
    step = np.diff(times)
    return [
        OdometryFault("gap", int(times[i]), int(times[i + 1]), f"a gap of {step[i] / 1e9:.2f} s")
        for i in np.flatnonzero(step > max_gap_ns)
    ]


def _rate(times: Stamps) -> list[OdometryFault]:
    step = np.diff(times) / 1e9
    median = float(np.median(step))
    odd = (step > 2 * median) | (step < median / 2)
    if len(step) < 20 or odd.mean() <= IRREGULAR_SHARE:
        return []
    text = (
        f"stamps are irregular: {100 * odd.mean():.0f} % of the intervals are under half or over twice their median of "
        f"{1e3 * median:.0f} ms, from {1e3 * step.min():.0f} to {1e3 * step.max():.0f} ms,"
    )
    return [OdometryFault("rate", int(times[0]), int(times[-1]), text)]


def _jumps(times: Stamps, poses: Sequence[Pose], max_gap_ns: int) -> list[OdometryFault]:
    if len(times) < 2 * NEIGHBOURS + 2:
        return []
    stack = Pose.concatenate(list(poses))
    moved = stack[:-1].inv() * stack[1:]
    seconds = np.diff(times) / 1e9
    steps = np.concatenate([moved.translation, moved.rotation.as_rotvec()], axis=1)
    # Twice in a row, or one after a gap: a sample's neighbours must not be jumps themselves, so their median counts
    expected = _neighbours(steps / seconds[:, None]) * seconds[:, None]
    excess = np.stack([np.linalg.norm((steps - expected)[:, i : i + 3], axis=1) for i in (0, 3)], axis=1)
    # What is left grows with the interval: the robot has time to do something else than its neighbours say
    sigma = 1.4826 * np.median(excess / seconds[:, None], axis=0) * seconds[:, None]
    room = np.array([[JUMP_M, JUMP_RAD]]) + np.array([[ACCELERATION, ANGULAR_ACCELERATION]]) * seconds[:, None] ** 2 / 2
    over = (excess > np.maximum(JUMP_SIGMAS * sigma, room)).any(axis=1) & (np.diff(times) <= max_gap_ns)
    faults = []
    for i in np.flatnonzero(over):
        position, angle = float(excess[i, 0]), float(excess[i, 1])
        text = (
            f"a jump: {np.linalg.norm(steps[i, :3]):.3f} m and {math.degrees(np.linalg.norm(steps[i, 3:])):.1f} deg in "
            f"{1e3 * seconds[i]:.0f} ms, {position:.3f} m and {math.degrees(angle):.1f} deg beyond the speed around it"
        )
        faults.append(OdometryFault("jump", int(times[i]), int(times[i + 1]), text, (position, angle)))
    return faults


def _neighbours(speed: Array) -> Array:
    """Return the median (n, 6) of the speeds (n, 6) of up to NEIGHBOURS samples on either side, without the own one."""
    n = len(speed)
    offsets = np.array([k for k in range(-NEIGHBOURS, NEIGHBOURS + 1) if k])
    index = np.arange(n)[:, None] + offsets
    inside = (index >= 0) & (index < n)
    values = np.where(inside[..., None], speed[np.clip(index, 0, n - 1)], np.nan)
    return np.asarray(np.nanmedian(values, axis=1))
