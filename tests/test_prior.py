"""The prior: start tag, then odometry."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from tag_scenes import SECOND, Robot, stand_and_look

from fieldkit.errors import PriorError
from fieldkit.frames import Pose, Trajectory, exp, log, pose_error, yaw_pose
from fieldkit.odometry import travel
from fieldkit.prior import estimate_prior
from fieldkit.protocol import OdometryNoise
from fieldkit.types import Prior, Start, TagMap

NOISE = OdometryNoise(position_per_root_m=0.0, yaw_deg_per_root_m=0.0)


def prior_of(robot: Robot) -> Prior:
    return estimate_prior(robot.recording, robot.visit, robot.tags, noise=NOISE)


def test_prior_is_the_start_tag_and_odometry_to_the_beginning_of_the_visit(rng: np.random.Generator) -> None:
    robot = stand_and_look(rng=rng)
    prior = prior_of(robot)
    position, angle = pose_error(prior.map_from_body, robot.map_from_body_at_visit)
    assert position < 0.01
    assert angle < math.radians(0.4)
    assert (prior.visit, prior.t_ns, prior.n_sightings) == ("w01", 14 * SECOND, 6)
    assert prior.travelled_m == pytest.approx(math.hypot(3, 2), rel=0.1)


def test_drift_of_the_odometry_is_the_error_of_the_prior_and_within_its_covariance(rng: np.random.Generator) -> None:
    robot = stand_and_look(rng=rng, drift=0.02)
    prior = prior_of(robot)
    error = log(robot.map_from_body_at_visit.inv() * prior.map_from_body)
    assert 0.05 < np.linalg.norm(error[3:]) < 0.3
    assert error[2] == pytest.approx(0.02 * prior.travelled_m, rel=0.2)
    noise = OdometryNoise(yaw_deg_per_m=math.degrees(0.02))
    wide = estimate_prior(robot.recording, robot.visit, robot.tags, noise=noise)
    assert error @ np.linalg.solve(wide.covariance, error) < 16


def test_where_odometry_has_its_origin_does_not_matter() -> None:
    one, two = (
        prior_of(stand_and_look(rng=np.random.default_rng(0), odom_from_map=p))
        for p in (None, Pose.from_components([100.0, 50.0, 2.0], yaw_pose([0, 0, 0], -2.0).rotation))
    )
    assert pose_error(one.map_from_body, two.map_from_body) == pytest.approx((0, 0), abs=1e-9)


def test_turning_the_map_turns_the_prior(rng: np.random.Generator) -> None:
    robot, turn = stand_and_look(rng=rng), yaw_pose([4.0, -7.0, 1.0], 2.5)
    tags = tuple(dataclasses.replace(t, map_from_tag=turn * t.map_from_tag) for t in robot.tags.tags)
    turned = prior_of(dataclasses.replace(robot, tags=dataclasses.replace(robot.tags, tags=tags)))
    same = prior_of(robot)
    assert pose_error(turned.map_from_body, turn * same.map_from_body) == pytest.approx((0, 0), abs=1e-9)
    np.testing.assert_allclose(turned.covariance, same.covariance, atol=1e-12)


def test_the_start_that_names_the_visit_is_used_else_the_last_one_that_names_none(rng: np.random.Generator) -> None:
    robot = stand_and_look(rng=rng)
    (good,) = robot.recording.starts
    other, later = Start(1, 5 * SECOND, 6 * SECOND, visit="w09"), Start(1, 20 * SECOND, 21 * SECOND)
    own = dataclasses.replace(good, visit="w01")
    unnamed = Start(7, 8 * SECOND, 9 * SECOND)
    for starts in ((good, other, later), (own, unnamed)):
        recording = dataclasses.replace(robot.recording, starts=starts)
        assert estimate_prior(recording, robot.visit, robot.tags, noise=NOISE).n_sightings == 6


def test_a_start_without_a_tag_takes_the_reference_topic(rng: np.random.Generator) -> None:
    robot = stand_and_look(rng=rng)
    pose = robot.map_from_body_at_start
    reference = Trajectory(np.array([0, 40 * SECOND]), (pose, pose), "map", "body", max_gap_ns=60 * SECOND)
    starts = (Start(None, 2 * SECOND, 3 * SECOND),)
    recording = dataclasses.replace(robot.recording, starts=starts, reference=reference)
    prior = estimate_prior(recording, robot.visit, TagMap((), (), "map"), noise=NOISE)
    assert pose_error(prior.map_from_body, robot.map_from_body_at_visit) == pytest.approx((0, 0), abs=1e-6)
    bare = dataclasses.replace(recording, reference=None)
    with pytest.raises(PriorError, match="names no tag and the recording has no reference topic"):
        estimate_prior(bare, robot.visit, TagMap((), (), "map"), noise=NOISE)


def straight(length_m: float, *, jitter_m: float = 0.0) -> Trajectory:
    rng = np.random.default_rng(0)
    times = np.arange(101, dtype=np.int64) * SECOND // 10
    x = np.linspace(0, length_m, 101)
    poses = tuple(yaw_pose([v, *rng.normal(0, 1, 2) * jitter_m], 0.0) for v in x)
    return Trajectory(times, poses, "odom", "body")


def test_uncertainty_grows_in_proportion_to_the_path() -> None:
    _, short, one = travel(straight(1.0), 0, 10 * SECOND, noise=NOISE)
    _, long, four = travel(straight(4.0), 0, 10 * SECOND, noise=NOISE)
    assert (one, four) == pytest.approx((1.0, 4.0))
    assert long[2, 2] == pytest.approx(16 * short[2, 2])
    # A yaw of 2 deg takes less than a thousandth off the way
    assert long[3, 3] == pytest.approx(16 * short[3, 3], rel=1e-3)
    # A yaw error at every metre of 4 m moves the end sideways by half of 4 m times its sum
    yaw, sideways = math.sqrt(long[2, 2]), math.sqrt(long[4, 4] - long[3, 3])
    assert yaw == pytest.approx(math.radians(0.5) * 4)
    assert sideways == pytest.approx(yaw * 2, rel=0.05)


def test_covariance_of_travel_is_that_of_simulated_drift() -> None:
    rng, ends = np.random.default_rng(1), []
    steps = [yaw_pose([0.1, 0.0, 0.0], 0.02)] * 60
    clean = [Pose.identity()]
    for step in steps:
        clean.append(clean[-1] * step)
    odometry = Trajectory(np.arange(61) * SECOND // 10, tuple(clean), "odom", "body")
    delta, covariance, _ = travel(
        odometry, 0, 6 * SECOND, noise=OdometryNoise(position_per_m=1e-9, position_per_root_m=0, yaw_deg_per_root_m=0)
    )
    for _ in range(120):
        per_m = rng.normal(0, math.radians(0.5))
        pose = Pose.identity()
        for step in steps:
            pose = pose * step * exp([0, 0, per_m * 0.1, 0, 0, 0])
        ends.append(log(delta.inv() * pose))
    simulated = np.cov(np.array(ends).T)
    for i in (2, 3, 4):
        assert math.sqrt(simulated[i, i]) == pytest.approx(math.sqrt(covariance[i, i]), rel=0.25)


@pytest.mark.parametrize("turn", [0.0, 0.8])
def test_covariance_of_a_long_way_holds_beyond_the_linear_model(turn: float) -> None:
    """A yaw bias of 20 deg at the end of 40 m: the second moments are those of drawn ways, along it as well."""
    turned, slanted = np.linspace(0, turn, 401), exp([0.05, -0.1, 0, 3.0, -2.0, 1.0])
    moved = 0.1 * np.stack([np.cos(turned), np.sin(turned)], axis=1)
    poses = [yaw_pose([*xy, 0.0], yaw) for xy, yaw in zip(np.cumsum(moved, axis=0), turned, strict=True)]
    odometry = Trajectory(np.arange(401) * SECOND // 10, tuple(slanted * p for p in poses), "odom", "body")
    noise = OdometryNoise(position_per_m=1e-9, position_per_root_m=0, yaw_deg_per_root_m=1.0)
    _, covariance, _ = travel(odometry, 0, 40 * SECOND, noise=noise)
    rng = np.random.default_rng(0)
    yaw = np.radians(rng.normal(0, 0.5 * 0.1, (4000, 1)) + rng.normal(0, math.sqrt(0.1), (4000, 400))).cumsum(axis=1)
    yaw += noise.yaw_deg_per_turn_deg * rng.normal(size=(4000, 1)) * (turned[1:] - turned[0])
    steps = moved[1:] @ np.array([1.0, 1.0j])
    error = ((np.exp(1j * yaw) - 1) * steps).sum(axis=1) * np.exp(-1j * turn)
    drawn = np.stack([yaw[:, -1], error.real, error.imag])
    moments, here = drawn @ drawn.T / 4000, covariance[np.ix_([2, 3, 4], [2, 3, 4])]
    scale = np.sqrt(np.outer(np.diag(moments), np.diag(moments)))
    np.testing.assert_allclose(here / scale, moments / scale, atol=0.05)
    # What the linear model leaves out: the way along x, here by more than half a metre
    assert math.sqrt(here[1, 1]) > 0.5
    assert (np.linalg.eigvalsh(covariance) > -1e-12).all()


def test_jitter_while_standing_is_no_path() -> None:
    assert travel(straight(0.0, jitter_m=0.002), 0, 10 * SECOND, noise=NOISE)[2] < 0.02


def test_what_is_missing_is_named(rng: np.random.Generator) -> None:
    robot = stand_and_look(rng=rng)
    recording, visit = robot.recording, robot.visit
    only_tripod = dataclasses.replace(robot.tags, tags=robot.tags.tags[1:])
    with pytest.raises(PriorError, match=r"s\.mcap: visit w01: start tag 1 is not in tags\.toml; it has tags \[2\]"):
        estimate_prior(recording, visit, only_tripod, noise=NOISE)
    unseen = dataclasses.replace(recording, starts=(Start(2, 2 * SECOND, 4 * SECOND),))
    with pytest.raises(PriorError, match=r"start tag 2 \(tag36h11\) is never seen .*: 6 images searched"):
        estimate_prior(unseen, visit, robot.tags, noise=NOISE)
    with pytest.raises(PriorError, match="no start before it"):
        estimate_prior(dataclasses.replace(recording, starts=()), visit, robot.tags, noise=NOISE)
    resized = tuple(dataclasses.replace(f, camera=f.camera.scaled(0.5)) for f in recording.frames)
    with pytest.raises(PriorError, match="start tag 1: image of 640x480 pixels with a camera of 320x240"):
        estimate_prior(dataclasses.replace(recording, frames=resized), visit, robot.tags, noise=NOISE)
    no_arm = tuple(dataclasses.replace(f, body_from_cam=None) for f in recording.frames)
    with pytest.raises(PriorError, match="6 without a transform from body to camera"):
        estimate_prior(dataclasses.replace(recording, frames=no_arm), visit, robot.tags, noise=NOISE)


def test_a_start_whose_kinematics_are_broken_is_no_prior(rng: np.random.Generator) -> None:
    robot = stand_and_look(rng=rng)
    frames = tuple(
        dataclasses.replace(f, body_from_cam=f.body_from_cam * exp(rng.normal(0, [0.05] * 3 + [0.08] * 3)))
        for f in robot.recording.frames
    )
    message = (
        r"s\.mcap: visit w01: .*the 6 sightings of tag 1 disagree with kinematics by about 5 times their stated noise "
        r"or more; .*; check size_m of the tag, camera_info and tf"
    )
    with pytest.raises(PriorError, match=message):
        estimate_prior(dataclasses.replace(robot.recording, frames=frames), robot.visit, robot.tags, noise=NOISE)


def test_sightings_without_a_solution_are_named(rng: np.random.Generator) -> None:
    robot = stand_and_look(rng=rng)
    tags = tuple(dataclasses.replace(t, size_m=1e-160) for t in robot.tags.tags)
    with pytest.raises(PriorError, match=r"s\.mcap: visit w01: start tag 1: .*its corners fit no pose"):
        estimate_prior(robot.recording, robot.visit, dataclasses.replace(robot.tags, tags=tags), noise=NOISE)


def test_a_gap_in_the_odometry_is_named(rng: np.random.Generator) -> None:
    robot = stand_and_look(rng=rng)
    whole = robot.recording.odometry
    kept = [i for i, t in enumerate(whole.t_ns) if not 6 * SECOND < t < 9 * SECOND]
    torn = dataclasses.replace(whole, t_ns=whole.t_ns[kept], poses=tuple(whole.poses[i] for i in kept))
    with pytest.raises(PriorError, match=r"odom_from_body has a gap of 3\.00 s"):
        estimate_prior(dataclasses.replace(robot.recording, odometry=torn), robot.visit, robot.tags, noise=NOISE)
