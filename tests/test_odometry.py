"""Odometry: what is wrong with it is found and named, what is right raises nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fieldkit.frames import Pose, Trajectory, exp, yaw_pose
from fieldkit.odometry import PlacedTag, clock_offset, find_faults, offset_fault, summarize_faults, travel
from fieldkit.protocol import OdometryNoise
from fieldkit.types import OdometryFault

MS = 1_000_000
N = 400


def times(n: int = N, *, step_ms: int = 50) -> np.ndarray:
    return np.arange(n, dtype=np.int64) * step_ms * MS + 1_700_000_000_000_000_000


def wander(t_ns: np.ndarray) -> list[Pose]:
    """A robot that drives, turns, stands: smooth, with the jitter of real odometry."""
    rng = np.random.default_rng(0)
    poses, x, y, yaw = [], 0.0, 0.0, 0.0
    for before, t in zip((t_ns[0], *t_ns[:-1]), t_ns, strict=True):
        s, dt = (t - t_ns[0]) / 1e9, (t - before) / 1e9
        speed, rate = max(0.0, 0.8 * math.sin(0.7 * s)), 0.9 * math.sin(1.3 * s)
        x, y, yaw = x + speed * dt * math.cos(yaw), y + speed * dt * math.sin(yaw), yaw + rate * dt
        poses.append(yaw_pose([x, y, 0.0], yaw) * exp(rng.normal(0, [1e-4] * 3 + [5e-4] * 3)))
    return poses


def kinds(faults: tuple[OdometryFault, ...]) -> list[str]:
    return [f.kind for f in faults]


def test_sound_odometry_has_no_fault() -> None:
    t = times()
    assert find_faults(t, wander(t), received_ns=t + 30 * MS, image_latency_ns=80 * MS) == ()
    jitter = t + np.random.default_rng(1).integers(-12 * MS, 12 * MS, N)
    assert find_faults(jitter, wander(jitter), received_ns=jitter + 30 * MS) == ()


def test_too_few_samples_are_no_fault() -> None:
    assert find_faults(times(1), wander(times(1))) == ()
    assert find_faults(times(0), []) == ()


def test_every_gap_is_a_fault_with_its_begin_and_end() -> None:
    t = times()
    kept = np.concatenate([t[:100], t[130:300], t[320:]])
    poses = [p for p, k in zip(wander(t), np.isin(t, kept), strict=True) if k]
    faults = find_faults(kept, poses)
    assert kinds(faults) == ["gap", "gap"]
    assert (faults[0].t_begin_ns, faults[0].t_end_ns) == (t[99], t[130])
    (line,) = summarize_faults(faults)
    assert line == f"odometry: a gap of 1.55 s from {t[99]} to {t[130]} ns; 1 more, the first at {t[99]} ns"


@pytest.mark.parametrize(("jump", "words"), [([0, 0, 0, 0.3, 0, 0], "0.300 m"), ([0, 0, 0.3, 0, 0, 0], "17.2 deg")])
def test_a_jump_is_found_where_it_is_and_how_large(jump: list[float], words: str) -> None:
    t = times()
    poses = [p * exp(jump) if i >= 200 else p for i, p in enumerate(wander(t))]
    (fault,) = find_faults(t, poses)
    assert (fault.kind, fault.t_begin_ns, fault.t_end_ns) == ("jump", t[199], t[200])
    size = fault.excess[0] if jump[3] else fault.excess[1]
    assert size == pytest.approx(max(jump), rel=0.1)
    assert f"beyond the speed around it from {t[199]}" in summarize_faults([fault])[0]


def test_stamps_out_of_order_and_repeated_are_named() -> None:
    t = times()
    poses, swapped = wander(t), t.copy()
    swapped[[50, 51]] = swapped[[51, 50]]
    assert kinds(find_faults(swapped, poses))[0] == "order"
    repeated = t.copy()
    repeated[70] = repeated[69]
    (fault, *_) = find_faults(repeated, poses)
    assert (fault.kind, fault.t_begin_ns) == ("repeat", t[69])
    # A message that was sent twice is no second pose
    assert find_faults(np.concatenate([t, t[-1:]]), [*poses, poses[-1]]) == ()


@pytest.mark.parametrize(
    ("lag_ms", "image_ms", "words"),
    [
        (-300, 50, "stamps lie 0.300 s after the arrival of their messages"),
        (30, 600, "stamps run ahead of those of the images by 0.570 s"),
        (900, 60, "stamps lag behind those of the images by 0.840 s"),
    ],
)
def test_stamps_of_another_clock_are_named(lag_ms: int, image_ms: int, words: str) -> None:
    t = times()
    faults = find_faults(t, wander(t), received_ns=t + lag_ms * MS, image_latency_ns=image_ms * MS)
    assert set(kinds(faults)) == {"latency"}
    assert any(words in f.message for f in faults)


def test_a_clock_that_drifts_is_named() -> None:
    t = times()
    (fault,) = find_faults(t, wander(t), received_ns=t + 20 * MS + ((t - t[0]) * 0.02).astype(np.int64))
    assert "stamps run away from their arrival: 0.040 s late at first, 0.400 s at last" in fault.message


def test_irregular_stamps_are_named() -> None:
    rng = np.random.default_rng(3)
    t = times()[0] + np.cumsum(rng.choice([5, 50, 50, 50, 130], N)).astype(np.int64) * MS
    assert "rate" in kinds(find_faults(t, wander(t)))


def test_a_jump_on_the_way_widens_the_covariance_by_its_size() -> None:
    t = times()
    poses = [p * exp([0, 0, 0, 0.3, 0, 0]) if i >= 200 else p for i, p in enumerate(wander(t))]
    odometry = Trajectory(t, tuple(poses), "odom", "body")
    faults = find_faults(t, poses)
    noise = OdometryNoise()
    _, plain, _ = travel(odometry, int(t[150]), int(t[250]), noise=noise)
    _, wide, _ = travel(odometry, int(t[150]), int(t[250]), noise=noise, faults=faults)
    added = np.linalg.eigvalsh((wide - plain)[3:, 3:])
    assert np.sqrt(added) == pytest.approx([0.3] * 3, rel=0.1)
    _, elsewhere, _ = travel(odometry, int(t[250]), int(t[350]), noise=noise, faults=faults)
    np.testing.assert_array_equal(elsewhere, travel(odometry, int(t[250]), int(t[350]), noise=noise)[1])


def test_a_jump_counts_once_on_every_way_that_touches_it_in_either_direction() -> None:
    t, moved = times(), exp([0, 0, 0, 0.3, 0, 0])
    poses = [p * moved if i >= 200 else p for i, p in enumerate(wander(t))]
    odometry, faults, inside = Trajectory(t, tuple(poses), "odom", "body"), find_faults(t, poses), int(t[199]) + 7 * MS

    def added(begin: int, end: int) -> float:
        plain, wide = (travel(odometry, begin, end, noise=OdometryNoise(), faults=f)[1] for f in ((), faults))
        return float(np.trace((wide - plain)[3:, 3:]))

    whole = added(int(t[190]), int(t[210]))
    assert math.sqrt(whole) == pytest.approx(0.3 * math.sqrt(3), rel=0.1)
    for begin, end in ((int(t[190]), inside), (inside, int(t[210])), (int(t[210]), inside), (int(t[210]), int(t[190]))):
        assert added(begin, end) == pytest.approx(whole, rel=0.1)
    for begin, end in ((int(t[190]), int(t[199])), (int(t[200]), int(t[210])), (inside, inside)):
        assert added(begin, end) == 0.0


def seen_in_motion(offset_ms: int, *, still: bool = False, noise: float = 0.004) -> tuple[Trajectory, list[PlacedTag]]:
    """Odometry and sightings of two standing tags whose images are stamped late by an offset."""
    rng, t = np.random.default_rng(4), times()
    poses = wander(t)
    if still:
        poses = [poses[0]] * len(poses)
    odometry = Trajectory(t, tuple(poses), "odom", "body")
    tags = []
    for t_ns in t[40:-40:4]:
        odom_from_body = odometry.at(int(t_ns) - offset_ms * MS)
        for tag_id, place in ((1, [3.0, 1.0, 0.5]), (2, [2.0, -2.0, 0.7])):
            body_from_tag = odom_from_body.inv() * Pose.from_translation(place) * exp(rng.normal(0, noise, 6))
            tags.append(PlacedTag(int(t_ns), tag_id, body_from_tag, np.eye(6) * noise**2))
    return odometry, tags


@pytest.mark.parametrize("offset_ms", [-480, 150, 480])
def test_an_offset_between_the_clocks_is_found_from_tags_in_motion(offset_ms: int) -> None:
    odometry, tags = seen_in_motion(offset_ms)
    found = clock_offset(odometry, tags)
    assert found is not None
    assert found.offset_s == pytest.approx(-offset_ms / 1e3, abs=0.01)
    assert found.is_wrong
    fault = offset_fault(found)
    assert fault is not None
    assert f"{abs(offset_ms) / 1e3:.2f} s" in fault.message
    assert ("too early" if offset_ms > 0 else "too late") in fault.message


def test_clocks_that_agree_are_no_fault_and_a_robot_that_stands_tells_nothing() -> None:
    found = clock_offset(*seen_in_motion(0))
    assert found is not None
    assert abs(found.offset_s) < 0.01
    assert offset_fault(found) is None
    assert offset_fault(clock_offset(*seen_in_motion(480, still=True))) is None
    odometry, tags = seen_in_motion(0)
    assert clock_offset(odometry, tags[:4]) is None
