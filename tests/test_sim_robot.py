"""The simulated robot: kinematics, odometry, paths, and the mapping walk's drift."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from empty_floor import empty_floor
from scipy.spatial.transform import RigidTransform, Rotation

from fieldkit.frames import Pose, pose_error
from sim_bridge import robot
from sim_bridge.aim import aim, facing, look_at
from sim_bridge.errors import SynthesisError
from sim_bridge.mapping import mapper
from sim_bridge.mesh import Scene
from sim_bridge.recording.schedule import ScheduleOptions, lagging, sweep_arms
from sim_bridge.robot.odometry import OdometryOptions, drifting_odometry
from sim_bridge.stage.paths import TrackBuilder, floor_graph, headings, plan_path, spaced


def floor(blocks: list[tuple[float, float, float, float]]) -> Scene:
    """A floor of 6 x 4 m with rectangular footprints (x0, y0, x1, y1) and nothing to see."""
    return empty_floor((6.0, 4.0), blocks, walk_xy=[(1, 1), (5, 1), (5, 3), (1, 3)])


def chain(arm: robot.ArmJoints, names: tuple[str, ...]) -> Pose:
    """body_from_wrist as a reader of tf finds it: from the last link up to the body."""
    links = {child: (parent, pose) for parent, child, pose in robot.moving_links(arm, names, body="body")}
    frame, result = names[-1], Pose.identity()
    while frame != "body":
        frame, parent_from_child = links[frame]
        result = parent_from_child * result
    return result


def random_arms(rng: np.random.Generator) -> list[robot.ArmJoints]:
    return [robot.joints(rng.uniform(-3.0, 3.0, 6)) for _ in range(20)]


@pytest.mark.parametrize("names", [robot.JOINTS, ("wrist",)])
def test_the_links_of_tf_multiply_to_the_wrist(names: tuple[str, ...], rng: np.random.Generator) -> None:
    for arm in random_arms(rng):
        distance, angle = pose_error(robot.body_from_wrist(arm), chain(arm, names))
        assert distance < 1e-12
        assert angle < 1e-7


def test_the_stretched_arm_is_as_long_as_spot_s() -> None:
    wrist = robot.body_from_wrist(robot.joints(np.zeros(6)))
    assert wrist.translation == pytest.approx([0.292 + 0.3385 + 0.4033, 0.0, 0.188 + 0.075])
    assert wrist.rotation.magnitude() == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(("joint", "up"), [("sh1", 1.0), ("el0", 1.0), ("wr0", 1.0), ("sh0", 0.0), ("wr1", 0.0)])
def test_lifting_bending_up_and_nodding_up_are_negative_as_on_spot(joint: str, up: float) -> None:
    bent = dataclasses.replace(robot.joints(np.zeros(6)), **{joint: -0.1})
    axis = robot.body_from_wrist(bent).rotation.apply([1.0, 0.0, 0.0])
    assert axis[2] == pytest.approx(up * np.sin(0.1), abs=1e-12)


def test_the_colour_camera_sits_in_the_hand_as_spot_s_does() -> None:
    hand_from_wrist = Pose.from_components(-np.array(robot.HAND_IN_WRIST_M), Rotation.identity())
    found = hand_from_wrist * robot.WRIST_FROM_CAMERA
    published = Rotation.from_quat([-0.459, 0.459, -0.538, 0.538])
    assert found.translation == pytest.approx([-0.058, 0.020, 0.025])
    assert np.degrees((found.rotation.inv() * published).magnitude()) < 0.1


def test_the_depth_camera_looks_where_the_colour_camera_looks_its_picture_on_its_side() -> None:
    colour, depth = robot.WRIST_FROM_CAMERA, robot.WRIST_FROM_DEPTH
    x, _, z = (colour.rotation.inv() * depth.rotation).as_matrix().T
    assert z == pytest.approx([0.0, 0.0, 1.0], abs=0.01)
    assert x == pytest.approx([0.0, 1.0, 0.0], abs=0.01)
    assert np.linalg.norm(colour.translation - depth.translation) < 0.03


def test_the_camera_looks_along_the_yaw_and_pitch_that_it_was_sent_to() -> None:
    for yaw_deg, pitch_deg in ((0, 0), (-130, 25), (75, -10), (-170, 40)):
        view = robot.body_from_camera(robot.looking(np.radians(yaw_deg), np.radians(pitch_deg)))
        expected = aim([0, 0, 0], np.radians(yaw_deg), pitch_rad=np.radians(pitch_deg))
        assert (view.rotation.inv() * expected.rotation).magnitude() < 1e-7


def test_looking_around_turns_sh0_and_wr0_alone_and_moves_the_camera_s_centre() -> None:
    arms = sweep_arms(ScheduleOptions())
    moved = np.ptp([arm.as_array() for arm in arms], axis=0) > 0
    centres = np.array([robot.body_from_camera(arm).translation for arm in arms])
    assert [name for name, moves in zip(robot.JOINTS, moved, strict=True) if moves] == ["sh0", "wr0"]
    assert np.ptp(centres[:, 0]) > 0.5
    assert np.ptp(centres[:, 2]) > 0.05


def test_the_stowed_camera_is_low_in_front_and_looks_ahead() -> None:
    view = robot.body_from_camera(robot.STOWED)
    raised = robot.body_from_camera(robot.looking(0.0, 0.0))
    right, _, axis = view.rotation.apply(np.eye(3))
    assert view.translation[2] < raised.translation[2] - 0.2
    assert view.translation[0] > 0.4
    assert axis == pytest.approx([np.cos(robot.CAMERA_TILT_RAD), 0.0, np.sin(robot.CAMERA_TILT_RAD)], abs=1e-9)
    assert right == pytest.approx([0.0, -1.0, 0.0], abs=1e-9)


@pytest.mark.parametrize("yaws", [3, 6, 8, 12, 50])
def test_the_sweep_covers_all_that_sh0_reaches_with_staggered_rows(yaws: int) -> None:
    arms = sweep_arms(dataclasses.replace(ScheduleOptions(), sweep_yaws=yaws))
    turns = np.sort([arm.sh0 for arm in arms])
    low, high = robot.SH0_RANGE_RAD
    assert all(robot.within_limits(arm) for arm in arms)
    assert len(set(turns)) == 2 * yaws
    assert turns[0] - low + high - turns[-1] < np.radians(31.0)
    assert np.diff(turns).max() < np.pi / yaws + 1e-9
    assert all(-10.0 <= np.degrees(arm.pitch_rad) <= 30.0 for arm in arms)


def test_what_the_arm_cannot_reach_is_outside_of_its_limits() -> None:
    reached = [robot.within_limits(robot.looking(np.radians(yaw), 0.0)) for yaw in range(-180, 180, 10)]
    assert reached.count(False) == 2
    assert not robot.within_limits(robot.looking(np.radians(-165.0), 0.0))
    assert not robot.within_limits(robot.looking(0.0, np.radians(-110.0)))
    assert robot.within_limits(robot.STOWED)


EXACT = robot.KinematicOptions(encoder_deg=0.0, joint_deg=0.0, mount_m=0.0, mount_deg=0.0)


def believed_and_true(
    kinematics: robot.Kinematics, arm: robot.ArmJoints, rng: np.random.Generator
) -> tuple[Pose, Pose]:
    return robot.body_from_camera(kinematics.measured(arm, rng=rng)), kinematics.body_from_camera(arm)


def test_an_arm_without_errors_is_where_it_believes_to_be(rng: np.random.Generator) -> None:
    kinematics = robot.assembled(EXACT, rng=rng)
    for arm in random_arms(rng):
        assert pose_error(*believed_and_true(kinematics, arm, rng)) == pytest.approx((0.0, 0.0), abs=1e-7)


def test_kinematic_errors_are_millimetres_and_stay_the_same_for_a_robot() -> None:
    arms, errors, repeated = sweep_arms(ScheduleOptions()), [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        kinematics = robot.assembled(robot.KinematicOptions(), rng=rng)
        first, second = (
            [np.subtract(*(p.translation for p in believed_and_true(kinematics, arm, rng))) for arm in arms]
            for _ in range(2)
        )
        errors += [np.linalg.norm(e) for e in first]
        repeated += [np.linalg.norm(a - b) for a, b in zip(first, second, strict=True)]
    assert 0.001 < np.median(errors) < 0.004
    assert np.median(repeated) < 0.3 * np.median(errors)


def test_a_lagging_arm_arrives_late_but_where_it_was_sent() -> None:
    build = TrackBuilder([0.0])
    build.move([1.0], seconds=0.5)
    build.hold(1.0)
    sent, followed = build.build(), lagging(build.build(), 0.06, end_s=1.5)
    middle = float((sent.at([0.25]) - followed.at([0.25]))[0, 0])
    assert 0.05 < middle < 0.15
    left = sent.at([0.5, 0.6, 0.9, 1.5])[:, 0] - followed.at([0.5, 0.6, 0.9, 1.5])[:, 0]
    assert (np.diff(left) < 0).all()
    assert 1e-6 < left[2] < 1e-3
    assert left[3] < 1e-6


def test_look_at_puts_the_target_on_the_optical_axis(rng: np.random.Generator) -> None:
    for at, target in rng.uniform(-3, 3, (10, 2, 3)):
        x, y, z = look_at(at, target, roll_rad=0.3).inv().apply(target)
        assert (x, y) == pytest.approx((0.0, 0.0), abs=1e-9)
        assert z == pytest.approx(float(np.linalg.norm(target - at)))


def test_a_facing_tag_stands_upright_with_its_normal_along_the_yaw() -> None:
    tag = facing([1.0, 2.0, 0.7], np.radians(90.0))
    assert tag.rotation.apply([0, 0, 1]) == pytest.approx([0, 1, 0], abs=1e-12)
    assert tag.rotation.apply([0, 1, 0]) == pytest.approx([0, 0, 1], abs=1e-12)


def body_walk(step_m: float = 0.02, metres: float = 8.0) -> list[Pose]:
    along = np.arange(0.0, metres, step_m)
    yaws = 0.8 * np.sin(along)
    xy = np.cumsum(step_m * np.column_stack([np.cos(yaws), np.sin(yaws)]), axis=0)
    return [robot.standing(point, yaw) for point, yaw in zip(xy, yaws, strict=True)]


def test_odometry_without_errors_is_the_true_motion_in_another_frame(rng: np.random.Generator) -> None:
    walk = body_walk()
    exact = OdometryOptions(scale=0, turn_scale=0, yaw_bias_deg=0, yaw_walk_deg=0, walk_m=0)
    believed = drifting_odometry(walk, exact, rng=rng)
    assert pose_error(believed[0].inv() * believed[-1], walk[0].inv() * walk[-1]) == pytest.approx((0, 0), abs=1e-6)
    assert pose_error(believed[0], walk[0])[0] > 1.0


def test_odometry_drifts_in_distance_and_yaw_as_much_as_it_says() -> None:
    walk = body_walk()
    errors = []
    for seed in range(40):
        believed = drifting_odometry(walk, OdometryOptions(), rng=np.random.default_rng(seed))
        errors.append(pose_error(believed[0].inv() * believed[-1], walk[0].inv() * walk[-1]))
    distance, angle = np.sqrt(np.mean(np.square(errors), axis=0))
    assert 0.05 < distance < 0.6
    assert 1.0 < np.degrees(angle) < 6.0


def test_a_standing_robot_has_constant_odometry(rng: np.random.Generator) -> None:
    believed = drifting_odometry([robot.standing([1.0, 2.0], 0.5)] * 30, OdometryOptions(), rng=rng)
    assert max(pose_error(believed[0], pose)[0] for pose in believed) == 0.0


def test_odometry_is_the_same_for_the_same_seed() -> None:
    runs = [drifting_odometry(body_walk(), OdometryOptions(), rng=np.random.default_rng(3)) for _ in range(2)]
    assert np.array_equal(runs[0][-1].as_matrix(), runs[1][-1].as_matrix())


def test_a_path_keeps_off_furniture_and_ends_where_it_should() -> None:
    scene = floor([(2.5, 0.0, 3.5, 2.6)])
    path = plan_path(scene, floor_graph(scene, 0.3), ([1.0, 1.0], [5.0, 1.0]), radius_m=0.3)
    assert scene.free_floor(path, 0.3).all()
    assert path[0] == pytest.approx([1.0, 1.0])
    assert path[-1] == pytest.approx([5.0, 1.0])
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 0.05


def test_a_path_turns_smoothly() -> None:
    scene = floor([(2.5, 0.0, 3.5, 2.6)])
    path = plan_path(scene, floor_graph(scene, 0.3), ([1.0, 1.0], [5.0, 1.0]), radius_m=0.3)
    assert np.degrees(np.abs(np.diff(headings(path)))).max() < 10.0


def test_a_wall_across_the_floor_leaves_no_path() -> None:
    scene = floor([(2.5, 0.0, 3.5, 4.0)])
    graph = floor_graph(scene, 0.3)
    assert not graph.connects([[1.0, 1.0], [5.0, 1.0]])
    with pytest.raises(SynthesisError, match="no free path from"):
        plan_path(scene, graph, ([1.0, 1.0], [5.0, 1.0]), radius_m=0.3)


def test_a_full_floor_is_refused() -> None:
    with pytest.raises(SynthesisError, match="no free floor"):
        floor_graph(floor([(0.0, 0.0, 6.0, 4.0)]), 0.3)


def test_spaced_points_keep_both_ends() -> None:
    points = spaced(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.55]]), 0.1)
    assert points[[0, -1]].tolist() == [[0.0, 0.0], [1.0, 0.55]]
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).max() < 0.11


def test_a_track_starts_and_stops_smoothly_and_passes_what_it_was_sent_to() -> None:
    build = TrackBuilder([0.0])
    build.hold(1.0)
    build.move([2.0], seconds=1.0)
    build.hold(1.0)
    track = build.build()
    assert track.at([0.5, 1.5, 2.5, 9.0])[:, 0] == pytest.approx([0.0, 1.0, 2.0, 2.0])
    assert track.at([1.02])[0, 0] < 0.01


@functools.cache
def stations(seed: int, laps: float = 1.04) -> tuple[mapper.Station, ...]:
    options = dataclasses.replace(mapper.WalkOptions(), laps=laps)
    return mapper.walk(floor([]), options, rng=np.random.default_rng(seed))


def test_the_walk_is_at_head_height_and_comes_back_to_its_start() -> None:
    heights = [s.world_from_rig.translation[2] for s in stations(0)]
    first, last = stations(0)[0].world_from_rig, stations(0)[-1].world_from_rig
    assert 1.5 < min(heights) < max(heights) < 1.8
    assert np.linalg.norm(first.translation - last.translation) < 1.0


def test_neighbouring_stations_turn_little_enough_to_overlap() -> None:
    for before, after in zip(stations(0), stations(0)[1:], strict=False):
        assert np.degrees(pose_error(before.world_from_rig, after.world_from_rig)[1]) < 45.0


def test_slam_drifts_by_centimetres_and_keeps_scale_and_gravity() -> None:
    for seed in range(5):
        true = np.array([s.world_from_rig.translation for s in stations(seed)])
        slam = np.array([s.slam_from_rig.translation for s in stations(seed)])
        a, b = true - true.mean(axis=0), slam - slam.mean(axis=0)
        rotation, _ = Rotation.align_vectors(a, b)
        residual = np.linalg.norm(a - rotation.apply(b), axis=1)
        assert 0.003 < residual.max() < 0.15
        assert abs(np.linalg.norm(b) / np.linalg.norm(a) - 1.0) < 0.01
        assert np.degrees(np.arccos(rotation.as_matrix()[2, 2])) < 1.0


def test_the_rig_has_four_cameras_two_of_them_forward_side_by_side() -> None:
    rig = mapper.hololens_rig()
    poses: dict[str, RigidTransform] = {c.name: c.rig_from_cam for c in rig.cameras}
    axes = {name: pose.rotation.apply([0.0, 0.0, 1.0]) for name, pose in poses.items()}
    assert sorted(poses) == ["lf", "ll", "rf", "rr"]
    assert np.linalg.norm(poses["lf"].translation - poses["rf"].translation) == pytest.approx(0.0995)
    assert axes["lf"] == pytest.approx([1, 0, 0])
    assert axes["ll"][1] > 0.5
    assert axes["rr"][1] < -0.5
