"""Tags found by others: their corners in our order and pixels, whatever message and bag they stand in."""

from __future__ import annotations

import bz2
import dataclasses
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import get_types_from_msg
from rosbags.typesys.store import Typestore
from scipy.spatial.transform import Rotation
from tag_scenes import SIZE_M, VGA, look_at_tag

from fieldkit.bags import RecordedTags, read_detections
from fieldkit.bags.files import BagFile, ros1_types, ros2_types
from fieldkit.cameras import Camera
from fieldkit.errors import BagError
from fieldkit.frames import Array, Pose, pose, pose_error, position_quaternion
from fieldkit.tags import TagDetection, solve, tag_corners

T0 = 1_700_000_000_000_000_000
TOPIC = "/camera/tags"
ROS1_DETECTION = {
    "apriltag_ros/msg/AprilTagDetection": "int32[] id\nfloat64[] size\ngeometry_msgs/PoseWithCovarianceStamped pose",
    "apriltag_ros/msg/AprilTagDetectionArray": "std_msgs/Header header\napriltag_ros/AprilTagDetection[] detections",
}
OLD_DETECTION = {
    "apriltags_ros/msg/AprilTagDetection": "int32 id\nfloat64 size\ngeometry_msgs/PoseStamped pose",
    "apriltags_ros/msg/AprilTagDetectionArray": "std_msgs/Header header\napriltags_ros/AprilTagDetection[] detections",
}
TAGSLAM = {
    "apriltag_msgs/msg/Apriltag": (
        "int32 id\nstring family\nint32 hamming\nint32 border\nint32 bits\ngeometry_msgs/Point center\n"
        "geometry_msgs/Point[4] corners"
    ),
    "apriltag_msgs/msg/ApriltagArrayStamped": "std_msgs/Header header\napriltag_msgs/Apriltag[] apriltags",
}


def with_types(store: Typestore, definitions: dict[str, str]) -> Typestore:
    for kind, text in definitions.items():
        store.register(get_types_from_msg(text, kind))
    return store


def header(store: Typestore, t_ns: int, frame: str = "cam") -> Any:
    stamp = store.types["builtin_interfaces/msg/Time"](t_ns // 10**9, t_ns % 10**9)
    kind = store.types["std_msgs/msg/Header"]
    names = {f.name for f in dataclasses.fields(kind)}
    return kind(**{"seq": 0} if "seq" in names else {}, stamp=stamp, frame_id=frame)


def ros_pose(store: Typestore, value: Pose) -> Any:
    position, quaternion = position_quaternion(value)
    point, turn = store.types["geometry_msgs/msg/Point"], store.types["geometry_msgs/msg/Quaternion"]
    return store.types["geometry_msgs/msg/Pose"](point(*position), turn(*quaternion))


def ros1_bag(path: Path, store: Typestore, kind: str, messages: list[Any], *, topic: str = TOPIC) -> Path:
    with rosbag1.Writer(path) as bag:
        connection = bag.add_connection(topic, kind, typestore=store)
        for i, message in enumerate(messages):
            bag.write(connection, T0 + i, store.serialize_ros1(message, kind))
    return path


def ros2_bag(path: Path, store: Typestore, messages: list[Any], *, plugin: StoragePlugin) -> Path:
    kind = "apriltag_msgs/msg/AprilTagDetectionArray"
    with rosbag2.Writer(path, version=8, storage_plugin=plugin) as bag:
        connection = bag.add_connection(TOPIC, kind, typestore=store)
        for i, message in enumerate(messages):
            bag.write(connection, T0 + i, store.serialize_cdr(message, kind))
    return path


def ros2_message(store: Typestore, t_ns: int, corners: Array, *, tag_id: int = 3) -> Any:
    point = store.types["apriltag_msgs/msg/Point"]
    tag = store.types["apriltag_msgs/msg/AprilTagDetection"](
        "tag36h11", tag_id, 1, 0.0, 61.5, point(0.0, 0.0), [point(*c) for c in corners.tolist()], np.zeros(9)
    )
    return store.types["apriltag_msgs/msg/AprilTagDetectionArray"](header(store, t_ns), [tag])


def tagslam_message(store: Typestore, corners: Array, *, family: str = "mit") -> Any:
    point = store.types["geometry_msgs/msg/Point"]
    tag = store.types["apriltag_msgs/msg/Apriltag"](
        3, family, 2, 1, 6, point(0.0, 0.0, 0.0), [point(*c, 0.0) for c in corners.tolist()]
    )
    return store.types["apriltag_msgs/msg/ApriltagArrayStamped"](header(store, T0), [tag])


@pytest.mark.parametrize(
    ("plugin", "described"), [(StoragePlugin.MCAP, True), (StoragePlugin.SQLITE3, True), (StoragePlugin.SQLITE3, False)]
)
def test_ros2_detections_are_read_also_where_the_bag_does_not_describe_them(
    tmp_path: Path, rng: np.random.Generator, plugin: StoragePlugin, described: bool
) -> None:
    corners = VGA.project(look_at_tag(rng).apply(tag_corners(SIZE_M)))[0]
    store = ros2_types()
    messages = [ros2_message(store, T0 + step, corners) for step in (2, 1)]
    path = ros2_bag(tmp_path / "bag", store, messages, plugin=plugin)
    if not described:
        with sqlite3.connect(next(path.glob("*.db3"))) as database:
            database.execute("DELETE FROM message_definitions")
        database.close()
    found = read_detections(path)
    assert [t.t_ns for t in found.tags] == [T0 + 1, T0 + 2]
    tag = found.tags[0]
    assert (tag.id, tag.family, tag.frame, tag.hamming, tag.margin) == (3, "tag36h11", "cam", 1, 61.5)
    np.testing.assert_allclose(tag.corners_px, corners)
    assert found.n_messages == {TOPIC: 2}


def test_tagslam_s_pixels_are_those_of_the_detector_that_its_family_may_name(tmp_path: Path) -> None:
    corners = np.array([[10.0, 40.0], [42.0, 41.0], [41.0, 9.0], [9.0, 8.0]])
    store = with_types(ros1_types(), TAGSLAM)
    messages = [tagslam_message(store, corners, family=name) for name in ("mit", "36h11", "tf25h9", "umich", "")]
    found = read_detections(ros1_bag(tmp_path / "t.bag", store, "apriltag_msgs/msg/ApriltagArrayStamped", messages))
    assert [t.family for t in found.tags] == [None, "tag36h11", "tag25h9", None, None]
    for tag, shift in zip(found.tags, (0.5, 0.5, 0.5, 0.0, 0.0), strict=True):
        np.testing.assert_allclose(tag.corners_px, corners + shift)
    assert found.tags[0].hamming == 2


def test_corners_that_are_mirrored_or_not_finite_are_counted_and_left_out(tmp_path: Path) -> None:
    corners = np.array([[10.0, 40.0], [42.0, 41.0], [41.0, 9.0], [9.0, 8.0]])
    store = with_types(ros1_types(), TAGSLAM)
    messages = [tagslam_message(store, c) for c in (corners, corners[::-1], corners * np.nan)]
    found = read_detections(ros1_bag(tmp_path / "t.bag", store, "apriltag_msgs/msg/ApriltagArrayStamped", messages))
    assert len(found.tags) == 1
    assert found.refused == {"corners that are no square seen from its front": 2}


def test_poses_of_ros1_become_the_corners_that_they_were_solved_from(tmp_path: Path, rng: np.random.Generator) -> None:
    cam_from_tag = look_at_tag(rng)
    store = with_types(ros1_types(), ROS1_DETECTION)
    kinds = store.types
    inner = kinds["geometry_msgs/msg/PoseWithCovariance"](ros_pose(store, cam_from_tag), np.zeros(36))
    stamped = kinds["geometry_msgs/msg/PoseWithCovarianceStamped"](header(store, T0 + 5, "hand"), inner)
    one = kinds["apriltag_ros/msg/AprilTagDetection"](np.array([3], np.int32), np.array([SIZE_M]), stamped)
    bundle = kinds["apriltag_ros/msg/AprilTagDetection"](np.array([3, 4], np.int32), np.array([0.1, 0.1]), stamped)
    message = kinds["apriltag_ros/msg/AprilTagDetectionArray"](header(store, T0), [one, bundle])
    found = read_detections(ros1_bag(tmp_path / "t.bag", store, message.__msgtype__, [message]))
    (tag,) = found.tags
    assert (tag.t_ns, tag.frame, tag.id, tag.size_m, tag.corners_px) == (T0 + 5, "hand", 3, SIZE_M, None)
    assert found.refused == {"poses of bundles": 1}
    corners = tag.corners(VGA)
    assert corners is not None
    solved = solve(TagDetection(3, "tag36h11", corners, 0.3), VGA, SIZE_M).cam_from_tag
    assert pose_error(solved, cam_from_tag) == pytest.approx((0, 0), abs=1e-6)


def test_the_first_apriltags_ros_is_read_too(tmp_path: Path) -> None:
    store = with_types(ros1_types(), OLD_DETECTION)
    kinds = store.types
    at, behind = (
        kinds["apriltags_ros/msg/AprilTagDetection"](
            7,
            0.2,
            kinds["geometry_msgs/msg/PoseStamped"](
                header(store, 0, ""), ros_pose(store, pose([0, 0, z], [1, 0, 0, 0]))
            ),
        )
        for z in (2.0, -2.0)
    )
    message = kinds["apriltags_ros/msg/AprilTagDetectionArray"](header(store, T0), [at, behind])
    found = read_detections(ros1_bag(tmp_path / "t.bag", store, message.__msgtype__, [message]))
    (tag,) = found.tags
    assert (tag.id, tag.size_m, tag.t_ns, tag.frame) == (7, 0.2, T0, "cam")
    assert found.refused == {"poses behind the camera or without a size": 1}


def test_a_bag_without_detections_names_what_it_has(tmp_path: Path) -> None:
    store = ros1_types()
    text = store.types["std_msgs/msg/String"]("hello")
    path = ros1_bag(tmp_path / "t.bag", store, "std_msgs/msg/String", [text], topic="/talk")
    with pytest.raises(BagError, match=r"t.bag: no topic with tag detections; .*; the bag has /talk; record"):
        read_detections(path)
    with pytest.raises(BagError, match=r"/talk is of type std_msgs/msg/String; expected a topic with one of"):
        read_detections(path, topics=["/talk"])
    with pytest.raises(BagError, match=r"/tags is not in the bag"):
        read_detections(path, topics=["/tags"])
    with pytest.raises(BagError, match=r"none.bag: no such file"):
        read_detections(tmp_path / "none.bag")


def test_a_message_of_the_same_name_but_other_fields_is_named(tmp_path: Path) -> None:
    kind = "apriltag_ros/msg/AprilTagDetectionArray"
    store = with_types(ros1_types(), {kind: "std_msgs/Header header\nint32 number"})
    message = store.types[kind](header(store, T0), 3)
    with pytest.raises(BagError, match=rf"{TOPIC}: {kind} has no field 'detections'; expected"):
        read_detections(ros1_bag(tmp_path / "t.bag", store, kind, [message]))


# TagSLAM's own recordings: its fixed tags as map_from_tag, its cameras with OpenCV's principal point
STAIRS_TAG = (2, 0.16, ([0.93840377, -0.51000614, 0.13412727], [1.06798425, -1.0944786, -1.25097143]))
YARD_TAG = (3, 0.42, ([0.0, 0.0, 1.5], [0.0, -1.5708, 0.0]))
CASES = {
    "test_21": (
        "/t265/fisheye1/tags",
        Camera("OPENCV_FISHEYE", 848, 800, (286.712, 286.784, 421.414, 397.392,
               -0.006671324837952852, 0.03932977095246315, -0.03556782007217407, 0.005536118987947702)),
        STAIRS_TAG,
    ),
    "test_22": (
        "/detector/tags/left",
        Camera("OPENCV_FISHEYE", 800, 848, (283.943, 284.986, 421.579, 401.027, 0.00132, 0.03049, -0.02875, 0.0034)),
        YARD_TAG,
    ),
}  # fmt: skip


def unpack(source: Path, target: Path) -> Path:
    target.write_bytes(bz2.decompress(source.read_bytes()))
    return target


def reference(path: Path) -> dict[int, Pose]:
    """Return TagSLAM's own world_from_rig by stamp."""
    result = {}
    for message in BagFile(path).messages(["/tagslam/odom/body_rig"]):
        stamp, value = message.value.header.stamp, message.value.pose.pose
        p, q = value.position, value.orientation
        result[stamp.sec * 10**9 + stamp.nanosec] = pose((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))
    return result


@pytest.mark.parametrize("name", CASES)
def test_real_detections_put_the_camera_where_tagslam_puts_it(shared_data: Path, tmp_path: Path, name: str) -> None:
    topic, camera, (tag_id, size_m, (position, rotation)) = CASES[name]
    folder = shared_data / "tagslam" / name
    found = read_detections(unpack(folder / "tag_detections.bag.bz2", tmp_path / "tags.bag"))
    assert found.refused == {}
    truth = reference(unpack(folder / "reference.bag.bz2", tmp_path / "reference.bag"))
    map_from_tag = Pose.from_components(position, Rotation.from_rotvec(rotation))
    seen = [t for t in found.tags if t.id == tag_id and t.topic == topic and t.t_ns in truth]
    assert len(seen) > 30
    for turns in range(4):
        errors, residuals = _errors(seen[:40], turns, camera, size_m, map_from_tag, truth)
        # One corner further along, the camera would stand a quarter of a turn off
        assert np.degrees(np.median(errors[:, 1])) == pytest.approx((0.0, 90.0, 180.0, 90.0)[turns], abs=1.0)
        if turns == 0:
            assert np.median(errors[:, 0]) < 0.05
            assert np.median(residuals) < 0.2


def _errors(
    seen: list[Any], turns: int, camera: Camera, size_m: float, map_from_tag: Pose, truth: dict[int, Pose]
) -> tuple[Array, list[float]]:
    errors, residuals = [], []
    for tag in seen:
        corners = np.roll(tag.corners_px, turns, axis=0)
        solution = solve(TagDetection(tag.id, "tag36h11", corners, 0.3), camera, size_m)
        errors.append(pose_error(map_from_tag * solution.cam_from_tag.inv(), truth[tag.t_ns]))
        residuals.append(solution.rms_px)
    return np.array(errors), residuals


@pytest.mark.parametrize(
    ("name", "n_tags", "hamming"),
    [("test_4", 22379, 1), ("test_22", 105, 0)],
)
def test_real_detections_are_whole_and_their_hamming_says_what_was_corrected(
    shared_data: Path, tmp_path: Path, name: str, n_tags: int, hamming: int
) -> None:
    found: RecordedTags = read_detections(
        unpack(shared_data / "tagslam" / name / "tag_detections.bag.bz2", tmp_path / "tags.bag")
    )
    assert len(found.tags) == n_tags
    assert {t.hamming for t in found.tags} == set(range(hamming + 1))
    assert all(t.family is None and t.margin is None and t.size_m is None for t in found.tags)
    stamps = [t.t_ns for t in found.tags]
    assert stamps == sorted(stamps)


def test_corners_of_real_tags_that_hang_upright_start_at_the_bottom_left(shared_data: Path, tmp_path: Path) -> None:
    found = read_detections(
        unpack(shared_data / "tagslam" / "test_4" / "tag_detections.bag.bz2", tmp_path / "tags.bag")
    )
    corners = np.array([t.corners_px for t in found.tags])
    along, up = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]
    # Eight upright cameras look at walls of tags and at a wand that is turned by hand
    assert np.mean((along[:, 0] > np.abs(along[:, 1])) & (-up[:, 1] > np.abs(up[:, 0]))) > 0.9
