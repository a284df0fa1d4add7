"""The ground truth: tripod tag and kinematics, or a topic; never the prior, never absolute odometry."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tag_scenes import AT_VISIT, FORWARD, SECOND, VGA, Robot, stand_and_look

from fieldkit.errors import TruthError
from fieldkit.frames import Pose, Trajectory, exp, log, pose_error, yaw_pose
from fieldkit.tags import TagFix, body_in_map
from fieldkit.truth import MAX_IMAGES, estimate_truths
from fieldkit.types import Frame, Recording, Truth, Visit


def truths_of(robot: Robot) -> dict[str, Truth]:
    return estimate_truths(robot.recording, robot.visit, robot.tags)


def with_views(robot: Robot, views: tuple) -> tuple[Recording, Visit]:
    visit = dataclasses.replace(robot.visit, views=views)
    return dataclasses.replace(robot.recording, visits=(visit,)), visit


def test_truth_is_known_for_every_view_also_where_the_tag_is_not_seen(rng: np.random.Generator) -> None:
    robot = stand_and_look(rng=rng)
    truths = truths_of(robot)
    assert sorted(truths) == ["00", "01", "02", "03", "04", "05"]
    for view in robot.visit.views:
        truth = truths[view.id]
        position, angle = pose_error(truth.map_from_cam, AT_VISIT * view.frame.body_from_cam)
        assert position < 0.005
        assert angle < math.radians(0.3)
        assert (truth.source, truth.visit, truth.body_from_cam) == ("tag", "w01", view.frame.body_from_cam)
        assert position < 4 * truth.sigma[0]


def test_drift_and_origin_of_the_odometry_leave_the_truth_alone_while_the_robot_stands() -> None:
    elsewhere = Pose.from_components([70.0, -40.0, 3.0], Rotation.from_euler("zyx", [2.0, 0.3, -0.2]))
    plain = truths_of(stand_and_look(rng=np.random.default_rng(3)))
    perturbed = truths_of(stand_and_look(rng=np.random.default_rng(3), drift=0.3, odom_from_map=elsewhere))
    assert sorted(plain) == sorted(perturbed)
    for view, truth in plain.items():
        assert pose_error(perturbed[view].map_from_cam, truth.map_from_cam) == pytest.approx((0, 0), abs=1e-7)


def test_truth_needs_no_start_and_no_start_tag(rng: np.random.Generator) -> None:
    robot = stand_and_look(rng=rng)
    recording = dataclasses.replace(robot.recording, starts=())
    tags = dataclasses.replace(robot.tags, tags=robot.tags.tags[1:])
    bare = estimate_truths(recording, robot.visit, tags)
    for view, truth in truths_of(robot).items():
        np.testing.assert_array_equal(bare[view].map_from_cam.as_matrix(), truth.map_from_cam.as_matrix())


def test_truth_follows_a_step_of_the_body_within_the_visit(rng: np.random.Generator) -> None:
    robot = stand_and_look(rng=rng)
    odometry = robot.recording.odometry
    step = exp([0, 0, 0.05, 0.04, 0.0, 0.0])
    poses = tuple(
        p * step if t >= 20 * SECOND - SECOND // 2 else p for t, p in zip(odometry.t_ns, odometry.poses, strict=True)
    )
    moved = dataclasses.replace(robot.recording, odometry=dataclasses.replace(odometry, poses=poses))
    seen = with_views(dataclasses.replace(robot, recording=moved), robot.visit.views[3:4] + robot.visit.views[5:])
    truths = estimate_truths(*seen, robot.tags)
    last = robot.visit.views[5]
    assert pose_error(truths["05"].map_from_cam, AT_VISIT * step * last.frame.body_from_cam)[0] < 0.01


def test_turning_the_map_turns_the_truth(rng: np.random.Generator) -> None:
    robot, turn = stand_and_look(rng=rng), yaw_pose([4.0, -7.0, 1.0], 2.5)
    tags = tuple(dataclasses.replace(t, map_from_tag=turn * t.map_from_tag) for t in robot.tags.tags)
    turned = truths_of(dataclasses.replace(robot, tags=dataclasses.replace(robot.tags, tags=tags)))
    for view, truth in truths_of(robot).items():
        assert pose_error(turned[view].map_from_cam, turn * truth.map_from_cam) == pytest.approx((0, 0), abs=1e-9)
        np.testing.assert_allclose(turned[view].covariance, truth.covariance, atol=1e-12)


def test_an_error_of_the_tag_in_the_map_is_within_the_stated_covariance() -> None:
    squared = []
    for seed in range(8):
        robot = stand_and_look(rng=np.random.default_rng(seed), tag_noise=0.005)
        recording, visit = with_views(robot, robot.visit.views[:3])
        for view, truth in estimate_truths(recording, visit, robot.tags).items():
            frame = next(v.frame for v in visit.views if v.id == view)
            error = log((AT_VISIT * frame.body_from_cam).inv() * truth.map_from_cam)
            squared.append(float(error @ np.linalg.solve(truth.covariance, error)) / 6)
    assert 0.3 < np.mean(squared) < 2.0


def test_images_between_the_views_show_the_tag_too_and_only_those_of_the_visit(rng: np.random.Generator) -> None:
    robot = stand_and_look(rng=rng)
    recording, visit = with_views(robot, robot.visit.views[5:])
    (truth,) = estimate_truths(recording, visit, robot.tags).values()
    assert pose_error(truth.map_from_cam, AT_VISIT * visit.views[0].frame.body_from_cam)[0] < 0.01
    late = dataclasses.replace(visit, t_begin_ns=20 * SECOND)
    with pytest.raises(TruthError, match="is never seen: 1 images searched"):
        estimate_truths(recording, late, robot.tags)


def test_of_a_long_visit_every_view_and_a_bounded_number_of_other_images_is_searched(rng: np.random.Generator) -> None:
    robot = stand_and_look(rng=rng)
    blind, seen = robot.visit.views[5].frame, robot.visit.views[2]
    reads: list[int] = []

    def counted(t_ns: int, frame: Frame) -> Frame:
        return dataclasses.replace(frame, t_ns=t_ns, read=lambda: (reads.append(t_ns), blank)[1])

    blank = np.full((VGA.height, VGA.width), 128, np.uint8)
    many = tuple(counted(15 * SECOND + 10_000_000 * i, blind) for i in range(1000))
    recording, visit = with_views(robot, (seen,))
    truths = estimate_truths(dataclasses.replace(recording, frames=many), visit, robot.tags)
    assert sorted(truths) == ["02"]
    # The view itself is one of them, and its own frame counts rather than another one with its stamp
    assert len(reads) == len(set(reads)) == MAX_IMAGES - 1
    assert min(reads) < 15.1 * SECOND < 24.9 * SECOND < max(reads)


def test_a_wrong_tag_size_is_no_truth(rng: np.random.Generator) -> None:
    robot = stand_and_look(rng=rng)
    tags = tuple(dataclasses.replace(t, size_m=0.2) for t in robot.tags.tags)
    message = (
        r"s\.mcap: visit w01: .*the 5 sightings of tag 2 disagree with kinematics by about 5 times their stated noise "
        r"or more; .*; check size_m of the tag, camera_info and tf"
    )
    with pytest.raises(TruthError, match=message):
        estimate_truths(robot.recording, robot.visit, dataclasses.replace(robot.tags, tags=tags))


@pytest.mark.parametrize(
    ("size_m", "message"),
    [(1e-6, "5 sightings of tag 2 (determine no pose|disagree with kinematics)"), (1e-160, "its corners fit no pose")],
)
def test_sightings_without_a_solution_are_named(rng: np.random.Generator, size_m: float, message: str) -> None:
    robot = stand_and_look(rng=rng)
    tags = tuple(dataclasses.replace(t, size_m=size_m) for t in robot.tags.tags)
    with pytest.raises(TruthError, match=rf"s\.mcap: visit w01: tripod tag 2: .*{message}"):
        estimate_truths(robot.recording, robot.visit, dataclasses.replace(robot.tags, tags=tags))


def test_one_image_with_wrong_kinematics_does_not_move_the_truth(rng: np.random.Generator) -> None:
    robot = stand_and_look(rng=rng)
    first, *rest = robot.visit.views
    frame = dataclasses.replace(first.frame, body_from_cam=first.frame.body_from_cam * exp([0.2, 0, 0, 0.3, 0, 0]))
    recording, visit = with_views(robot, (dataclasses.replace(first, frame=frame), *rest))
    truths = estimate_truths(recording, visit, robot.tags)
    assert pose_error(truths["01"].map_from_cam, AT_VISIT * rest[0].frame.body_from_cam)[0] < 0.006


def test_between_two_open_solutions_the_upright_body_is_taken(rng: np.random.Generator) -> None:
    tag = stand_and_look(rng=rng).tags.tags[0]
    standing = (tag.map_from_tag.inv() * yaw_pose([0.0, 0.2, 0.0], 0.3)).inv()
    leaning = standing * exp([0.5, 0.2, 0, 0, 0, 0])
    fix = TagFix(
        leaning, np.eye(6) * 1e-4, 0.2, (True,), (1.0,), (0.9,), (False,), 1.0, standing, np.eye(6) * 1e-4, 0.9, 2.0
    )
    assert body_in_map(fix, tag).rotation.as_matrix()[2, 2] == pytest.approx(1.0)
    certain = dataclasses.replace(fix, evidence=1000.0)
    assert body_in_map(certain, tag).rotation.as_matrix()[2, 2] < 0.95


def test_a_reference_topic_is_the_truth_and_says_so(rng: np.random.Generator) -> None:
    robot = stand_and_look(rng=rng)
    reference = Trajectory(np.array([0, 18 * SECOND]), (AT_VISIT, AT_VISIT), "map", "body", max_gap_ns=60 * SECOND)
    recording = dataclasses.replace(robot.recording, reference=reference)
    truths = estimate_truths(recording, robot.visit, dataclasses.replace(robot.tags, tags=()))
    # The topic ends at 18 s: later views have no truth rather than a guessed one
    assert sorted(truths) == ["00", "01", "02", "03"]
    assert {t.source for t in truths.values()} == {"topic"}
    expected = AT_VISIT * robot.visit.views[2].frame.body_from_cam
    assert pose_error(truths["02"].map_from_cam, expected) == pytest.approx((0, 0), abs=1e-9)
    # The topic's 0.2 deg per axis, and what is not known of the arm: per image, of its camera, of its base
    per_axis = math.sqrt(0.2**2 + 0.2**2 + 0.15**2 + 0.1**2)
    assert truths["02"].sigma[1] == pytest.approx(math.radians(per_axis) * math.sqrt(3))
    fixed = tuple(
        dataclasses.replace(v, frame=dataclasses.replace(v.frame, body_from_cam=FORWARD)) for v in robot.visit.views
    )
    mounted = estimate_truths(recording, dataclasses.replace(robot.visit, views=fixed), robot.tags)
    assert mounted["02"].sigma[1] == pytest.approx(math.radians(0.2) * math.sqrt(3))


def test_what_is_missing_is_named(rng: np.random.Generator) -> None:
    robot = stand_and_look(rng=rng)
    only_start = dataclasses.replace(robot.tags, tags=robot.tags.tags[:1])
    with pytest.raises(TruthError, match=r"visit w01: tripod tag 2 is not in tags\.toml .*; it has 1 \(every visit\)"):
        estimate_truths(robot.recording, robot.visit, only_start)
    unnamed = dataclasses.replace(robot.visit, truth_tag_id=None)
    with pytest.raises(TruthError, match="names no tripod tag"):
        estimate_truths(robot.recording, unnamed, robot.tags)
    recording, blind = with_views(robot, robot.visit.views[5:])
    unseen = dataclasses.replace(recording, frames=(blind.views[0].frame,))
    with pytest.raises(TruthError, match=r"tripod tag 2 \(tag36h11\) is never seen: 1 images searched"):
        estimate_truths(unseen, blind, robot.tags)
    ended = Trajectory(np.array([0, 1]), (AT_VISIT, AT_VISIT), "map", "body")
    with pytest.raises(TruthError, match="no view has a pose of the reference topic"):
        estimate_truths(dataclasses.replace(robot.recording, reference=ended), robot.visit, robot.tags)
