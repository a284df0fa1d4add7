"""TagSLAM's recorded robots: wrong stamps are noticed, right ones are not, and poses agree with its reference."""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from tagslam_data import TagSlamTest, load

from fieldkit.bags import inspect_recording
from fieldkit.errors import FieldkitError
from fieldkit.frames import log, pose_error
from fieldkit.odometry import offset_fault
from fieldkit.prior import estimate_prior, odometry_clock
from fieldkit.protocol import ArmNoise, OdometryNoise
from fieldkit.tags import body_sightings, locate_body
from fieldkit.types import Start, TagPose, Visit

SECOND = 1_000_000_000
# Cameras on a rigid rig: nothing moves between them and the body, and the images are not quite synchronous
RIG = ArmNoise(image_deg=0.1, image_m=0.001, camera_deg=0.2, camera_m=0.003, base_deg=0.0, base_m=0.0)
NOISE = OdometryNoise()


@pytest.fixture(scope="module")
def stairs(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> TagSlamTest:
    return load(shared_data / "tagslam" / "test_21", tmp_path_factory.mktemp("stairs"))


def seen_around(test: TagSlamTest, t_ns: int) -> tuple[TagPose, list[TagPose]] | None:
    """The tag that is seen most within half a second of a time, and all others."""
    near = [f for f in test.frames if abs(f.t_ns - t_ns) <= SECOND // 2]
    counts = Counter(t.id for f in near for t in f.tags or () if test.tags.find(t.id) is not None)
    if not counts:
        return None
    main = test.tags.find(counts.most_common(1)[0][0])
    assert main is not None
    return main, [t for t in test.tags.tags if t.id != main.id]


def test_odometry_whose_stamps_are_wrong_is_noticed_with_what_and_when(shared_data: Path, tmp_path: Path) -> None:
    """Test 22 "tests for odom time stamp bug": half a second off, thinned out unevenly, with gaps."""
    test = load(shared_data / "tagslam" / "test_22", tmp_path)
    assert {f.kind for f in test.faults} == {"gap", "rate"}
    fault = offset_fault(odometry_clock(test.recording(), test.tags))
    assert fault is not None
    said = re.match(r"stamps are (\d\.\d\d) s \(sigma (\d\.\d\d)\) too early against the images", fault.message)
    assert said is not None
    assert 0.47 < float(said[1]) < 0.53
    assert float(said[2]) < 0.03
    assert test.odometry.t_ns[0] < fault.t_begin_ns < fault.t_end_ns < test.odometry.t_ns[-1]
    warnings = inspect_recording(tmp_path / "test_22_tags.bag")["warnings"]
    assert any("a gap of 1.00 s from 1609357296235723734 to" in w for w in warnings)
    assert any("stamps are irregular" in w for w in warnings)


def test_sound_stamps_raise_no_alarm(stairs: TagSlamTest) -> None:
    assert stairs.faults == ()
    # Every sixth message is enough, and quicker
    offset = odometry_clock(dataclasses.replace(stairs.recording(), tag_frames=stairs.frames[::6]), stairs.tags)
    assert offset is not None
    assert abs(offset.offset_s) < 0.01
    assert offset_fault(offset) is None


def test_jumps_that_the_authors_describe_are_the_only_alarm(shared_data: Path, tmp_path: Path) -> None:
    """Test 11: "There are some jumps in the odom, order 0.25" m."""
    test = load(shared_data / "tagslam" / "test_11", tmp_path)
    assert {f.kind for f in test.faults} == {"jump"}
    assert 1 <= len(test.faults) <= 20
    assert 0.2 < max(f.excess[0] for f in test.faults) < 0.4
    offset = odometry_clock(dataclasses.replace(test.recording(), tag_frames=test.frames[::20]), test.tags)
    assert offset is not None
    assert abs(offset.offset_s) < 0.01
    assert offset_fault(offset) is None


def test_the_body_from_detections_agrees_with_the_reference(stairs: TagSlamTest) -> None:
    errors, deviations = [], []
    for t_ns in range(int(stairs.reference.t_ns[0]) + 2 * SECOND, int(stairs.reference.t_ns[-1]) - SECOND, 13 * SECOND):
        seen = seen_around(stairs, t_ns)
        if seen is None:
            continue
        frames = [f for f in stairs.frames if abs(f.t_ns - t_ns) <= SECOND // 2]
        found = body_sightings(frames, [seen[0], *seen[1]], odometry=stairs.odometry, noise=NOISE)
        fix = locate_body(found, seen[0], arm=RIG, others=seen[1])
        true = stairs.reference.at(fix.t_ns)
        errors.append(pose_error(fix.map_from_body, true))
        delta = log(fix.map_from_body.inv() * true)
        deviations.append(float(delta @ np.linalg.solve(fix.covariance, delta)) / 6)
    assert len(errors) >= 3
    position, rotation = np.median(errors, axis=0)
    assert position < 0.015
    assert np.degrees(rotation) < 0.8
    assert max(deviations) < 4


def test_the_prior_after_ten_seconds_of_odometry_agrees_with_the_reference(stairs: TagSlamTest) -> None:
    errors, travelled = [], []
    for t_ns in range(
        int(stairs.reference.t_ns[0]) + 2 * SECOND, int(stairs.reference.t_ns[-1]) - 11 * SECOND, 15 * SECOND
    ):
        seen = seen_around(stairs, t_ns)
        if seen is None:
            continue
        start = Start(seen[0].id, t_ns - SECOND // 2, t_ns + SECOND // 2)
        recording = dataclasses.replace(stairs.recording(), starts=(start,))
        visit = Visit("w", t_ns + 10 * SECOND, t_ns + 10 * SECOND, ())
        try:
            prior = estimate_prior(recording, visit, stairs.tags, noise=NOISE, arm=RIG)
        except FieldkitError as error:
            pytest.fail(str(error))
        true = stairs.reference.at(visit.t_begin_ns)
        delta = log(prior.map_from_body.inv() * true)
        assert delta @ np.linalg.solve(prior.covariance, delta) < 30
        errors.append(pose_error(prior.map_from_body, true))
        travelled.append(prior.travelled_m)
    assert len(errors) >= 2
    assert np.median(travelled) > 0.8
    position, rotation = np.median(errors, axis=0)
    assert position < 0.04
    assert np.degrees(rotation) < 2.0
