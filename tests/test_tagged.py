"""A recording whose images were not kept: detections of a topic stand in, and a reference states its covariance."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_samples import CAMERA, Options, odom_from_body, stamp, write_sample
from rosbags import rosbag1
from rosbags.typesys.store import Typestore
from test_detections import TAGSLAM, header, ros_pose, with_types

from fieldkit.bags import inspect_recording, open_recording
from fieldkit.bags.files import ros1_types
from fieldkit.errors import BagError

CORNERS = np.array([[20.0, 30.0], [30.0, 30.0], [30.0, 20.0], [20.0, 20.0]])
Extra = list[tuple[int, str, str, Any]]


def extended(tmp_path: Path, without: set[str], extra: Callable[[Typestore], Extra]) -> Path:
    """Copy a sample recording message by message, and add others."""
    source = write_sample(tmp_path, "ros1", Options(frozenset(without)), name="source")
    store, target = with_types(ros1_types(), TAGSLAM), tmp_path / "robot.bag"
    with rosbag1.Reader(source) as reader, rosbag1.Writer(target) as writer:
        connections = {c.id: writer.add_connection(c.topic, c.msgtype, typestore=store) for c in reader.connections}
        for connection, t_ns, raw in reader.messages():
            writer.write(connections[connection.id], t_ns, bytes(raw))
        added: dict[str, Any] = {}
        for t_ns, topic, kind, message in extra(store):
            if topic not in added:
                added[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(added[topic], t_ns, store.serialize_ros1(message, kind))
    return target


def detections(frame: str = "arm_camera", *, hamming: int = 0) -> Callable[[Typestore], Extra]:
    def make(store: Typestore) -> Extra:
        point = store.types["geometry_msgs/msg/Point"]
        kind = "apriltag_msgs/msg/ApriltagArrayStamped"
        rows: Extra = []
        for step in range(41):
            corners = [point(*c, 0.0) for c in CORNERS.tolist()]
            tag = store.types["apriltag_msgs/msg/Apriltag"](7, "mit", hamming, 1, 6, point(0.0, 0.0, 0.0), corners)
            found = [tag] if step % 2 else []
            rows.append((stamp(step), "/tags", kind, store.types[kind](header(store, stamp(step), frame), found)))
        return rows

    return make


def test_a_bag_without_images_opens_with_its_detections_as_frames(tmp_path: Path) -> None:
    recording = open_recording(extended(tmp_path, {"image"}, detections()))
    assert recording.frames == ()
    assert [len(f.tags or ()) for f in recording.tag_frames[:4]] == [0, 1, 0, 1]
    frame = recording.tag_frames[1]
    (tag,) = frame.tags or ()
    assert (frame.t_ns, frame.camera, tag.id, tag.family, tag.sigma_px) == (stamp(1), CAMERA, 7, None, None)
    np.testing.assert_allclose(tag.corners_px, CORNERS + 0.5)
    assert frame.body_from_cam is not None
    assert [v.frame.t_ns for v in recording.visits[0].views] == [stamp(10 + 2 * i) for i in range(4)]
    with pytest.raises(BagError, match=r"robot\.bag: no image at \d+ ns, only tag detections; expected an image"):
        frame.read()


def test_inspect_counts_detections_per_tag(tmp_path: Path) -> None:
    found = inspect_recording(extended(tmp_path, {"image"}, detections()))
    assert found["detections"] == {"topics": [{"name": "/tags", "count": 41}], "tags": {"7": 20}}
    (missing,) = found["missing"]
    assert missing.endswith("/arm_camera/image_raw; tag detections alone leave nothing to localize")


def test_a_bag_without_images_and_with_another_camera_s_detections_is_named(tmp_path: Path) -> None:
    path = extended(tmp_path, {"image"}, detections("head_camera"))
    message = (
        r"robot\.bag: no image and no tag detection of the arm camera \(41 detections on /tags are of frame "
        r"'head_camera', not of the arm camera; left out\); expected images of it; record"
    )
    with pytest.raises(BagError, match=message):
        open_recording(path)
    found = inspect_recording(path)
    assert [m for m in found["missing"] if m.startswith("images on ")]
    assert any("frame 'head_camera'" in w for w in found["warnings"])


def test_detections_of_another_camera_and_doubtful_ones_are_left_out(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    foreign = open_recording(extended(tmp_path / "a", set(), detections("head_camera")))
    assert foreign.tag_frames == ()
    assert any(
        "41 detections on /tags are of frame 'head_camera', not of the arm camera" in w for w in foreign.warnings
    )
    doubtful = open_recording(extended(tmp_path / "b", set(), detections(hamming=2)))
    assert all(f.tags == () for f in doubtful.tag_frames)


FIXED = np.diag([0.04, 0.01, 0.09, 1e-4, 2e-4, 3e-4])


def references(covariances: Callable[[int], Any]) -> Callable[[Typestore], Extra]:
    def make(store: Typestore) -> Extra:
        kind, inner = "geometry_msgs/msg/PoseWithCovarianceStamped", store.types["geometry_msgs/msg/PoseWithCovariance"]
        return [
            (
                stamp(i), "/fieldkit/reference", kind,
                store.types[kind](
                    header(store, stamp(i), "map"), inner(ros_pose(store, odom_from_body(i)), covariances(i).ravel())
                ),
            )
            for i in range(41)
        ]  # fmt: skip

    return make


@pytest.mark.parametrize("stated", [True, False])
def test_a_reference_s_covariance_is_turned_into_the_body_s_own_frame(tmp_path: Path, *, stated: bool) -> None:
    values = FIXED if stated else np.zeros((6, 6))
    recording = open_recording(extended(tmp_path, {"reference"}, references(lambda _: values)))
    assert recording.reference is not None
    assert recording.warnings == ()
    if not stated:
        assert recording.reference_covariance is None
        assert recording.reference_covariance_at(stamp(20)) is None
        return
    covariance = recording.reference_covariance_at(stamp(40))
    assert covariance is not None
    turn = odom_from_body(40).rotation.as_matrix()
    np.testing.assert_allclose(turn @ covariance[3:, 3:] @ turn.T, FIXED[:3, :3], atol=1e-9)
    np.testing.assert_allclose(turn @ covariance[:3, :3] @ turn.T, FIXED[3:, 3:], atol=1e-9)


@pytest.mark.parametrize(
    ("broken", "reason"),
    [
        (FIXED * np.where(np.arange(6) == 2, -1, 1), "not positive definite"),
        (FIXED + 0.5 * (np.eye(6, k=1) + np.eye(6, k=-1)), "not positive definite"),
        (np.diag([0.04, 0.01, 0.0, 0.0, 0.0, 3e-4]), "not positive definite"),
        (FIXED + 0.005 * np.eye(6, k=1), "not symmetric"),
        (FIXED * np.where(np.arange(6) == 2, np.nan, 1), "not finite"),
    ],
)
def test_covariances_of_the_reference_that_cannot_be_are_counted_and_named(
    tmp_path: Path, broken: Any, reason: str
) -> None:
    path = extended(tmp_path, {"reference"}, references(lambda _: broken))
    recording = open_recording(path)
    assert recording.reference_covariance is None
    line = f"/fieldkit/reference: of 41 covariances 41 {reason}; used for these samples: 5 mm and 0.2 deg per axis"
    assert line in recording.warnings
    assert line in inspect_recording(path)["warnings"]


def test_samples_of_the_reference_that_state_a_covariance_count_where_others_do_not(tmp_path: Path) -> None:
    def mixed(i: int) -> Any:
        return -FIXED if i == 5 else np.zeros((6, 6)) if i == 30 else FIXED * (1 + i)

    recording = open_recording(extended(tmp_path, {"reference"}, references(mixed)))
    assert recording.warnings == (
        "/fieldkit/reference: of 41 covariances 1 not positive definite, 1 not stated; used for these samples: that of "
        "the nearest sample that states one",
    )
    assert recording.reference_covariance is not None
    sizes = np.trace(recording.reference_covariance, axis1=1, axis2=2) / np.trace(FIXED)
    np.testing.assert_allclose([sizes[i] for i in (0, 4, 5, 6, 29, 30, 40)], [1, 5, 5, 7, 30, 30, 41], rtol=1e-9)
