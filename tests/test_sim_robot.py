"""The simulated robot: kinematics, odometry, paths, and the mapping walk's drift."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from fieldkit.frames import Pose, pose_error
from sim_bridge import robot
from sim_bridge.aim import aim, facing, look_at
from sim_bridge.errors import SynthesisError
from sim_bridge.mapping import mapper
from sim_bridge.mesh import Scene
from sim_bridge.recording.schedule import ScheduleOptions, sweep_arms
from sim_bridge.robot.odometry import OdometryOptions, drifting_odometry
from sim_bridge.stage.paths import TrackBuilder, floor_graph, headings, plan_path, spaced


def floor(blocks: list[tuple[float, float, float, float]]) -> Scene:
    """A floor of 6 x 4 m with rectangular footprints (x0, y0, x1, y1) and nothing to see."""
    corners = [[x0, y0, x1, y0, x1, y1, x0, y1] for x0, y0, x1, y1 in blocks]
    return Scene(
        vertices=np.zeros((0, 3)),
        faces=np.zeros((0, 3), np.int32),
        uv=np.zeros((0, 3, 2), np.float32),
        texture=np.zeros(0, np.int32),
        textures=(),
        closed=np.zeros(0, np.bool_),
        shade=np.zeros((0, 3), np.float32),
        blocks=np.array(corners, dtype=np.float64).reshape(-1, 8),
        walk_xy=np.array([(1, 1), (5, 1), (5, 3), (1, 3)], dtype=np.float64),
        floor_bounds=(0.0, 0.0, 6.0, 4.0),
    )


def chain(arm: robot.ArmJoints) -> Pose:
    """body_from_cam as a reader of tf finds it: from the camera's frame up to the body."""
    links = {child: (parent, pose) for parent, child, pose in [*robot.moving_links(arm), *robot.fixed_links()]}
    frame, result = robot.CAMERA_FRAME, Pose.identity()
    while frame != "body":
        frame, parent_from_child = links[frame]
        result = parent_from_child * result
    return result


def random_arms(rng: np.random.Generator) -> list[robot.ArmJoints]:
    return [robot.joints(rng.uniform(-3.0, 3.0, 4)) for _ in range(20)]


def test_the_links_of_tf_multiply_to_the_camera(rng: np.random.Generator) -> None:
    for arm in random_arms(rng):
        distance, angle = pose_error(robot.body_from_camera(arm), chain(arm))
        assert distance < 1e-12
        assert angle < 1e-7


def test_the_camera_looks_along_the_yaw_and_pitch_that_it_was_sent_to() -> None:
    for yaw_deg, pitch_deg in ((0, 0), (-130, 25), (75, -10)):
        view = robot.body_from_camera(robot.looking(np.radians(yaw_deg), np.radians(pitch_deg)))
        expected = aim([0, 0, 0], np.radians(yaw_deg), pitch_rad=np.radians(pitch_deg))
        assert (view.rotation.inv() * expected.rotation).magnitude() < 1e-7


def test_looking_around_moves_the_camera_centre() -> None:
    centres = np.array([robot.body_from_camera(arm).translation for arm in sweep_arms(ScheduleOptions())])
    assert np.ptp(centres[:, 0]) > 0.5
    assert np.ptp(centres[:, 2]) > 0.05


def test_the_stowed_camera_is_low_in_front_and_looks_down_ahead() -> None:
    view = robot.body_from_camera(robot.STOWED)
    raised = robot.body_from_camera(robot.looking(0.0, 0.0))
    axis = view.rotation.apply([0.0, 0.0, 1.0])
    assert view.translation[2] < raised.translation[2] - 0.2
    assert view.translation[0] > 0.4
    assert axis[0] > 0.9
    assert -0.4 < axis[2] < -0.1


def test_the_sweep_has_twelve_or_more_directions_all_around() -> None:
    arms = sweep_arms(ScheduleOptions())
    yaws = np.sort([arm.sh0 for arm in arms])
    assert len(arms) >= 12
    assert np.degrees(np.diff(yaws)).max() < 46.0
    assert all(-10.0 <= np.degrees(arm.pitch_rad) <= 30.0 for arm in arms)


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
