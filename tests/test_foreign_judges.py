"""Recordings are opened and decoded by readers that nobody here wrote: ROS 1's own rosbag, and Foxglove's for MCAP."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from bag_samples import CAMERA, HAND_FROM_CAM, STEP, T0, body_from_hand, jpeg, odom_from_body, picture
from scipy.spatial.transform import Rotation
from transcode import transcode

from fieldkit.bags import BagFormat, RecordingWriter, open_recording
from fieldkit.bags.layouts import LAYOUTS, Layout
from fieldkit.frames import Pose, position_quaternion

JUDGES = Path(__file__).parent / "judges"
# The system's Python: Debian's packages are not seen from a virtual environment.
DEBIAN_PYTHON = "/usr/bin/python3"
STEPS = 6
Line = dict[str, Any]
Judge = Callable[[Path], list[Line]]


def _missing(reason: str) -> None:
    if os.environ.get("CI") == "true":
        pytest.fail(f"{reason}; CI installs it")
    pytest.skip(reason)


def _lines(command: list[str]) -> list[Line]:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def _rosbag(path: Path) -> list[Line]:
    return _lines([DEBIAN_PYTHON, str(JUDGES / "read_rosbag.py"), str(path)])


def _foxglove(path: Path) -> list[Line]:
    return _lines(["node", str(JUDGES / "read_mcap.mjs"), str(path)])


@pytest.fixture(scope="module", params=["ros1", "mcap"])
def judged(request: pytest.FixtureRequest) -> Iterator[tuple[BagFormat, Judge]]:
    """A format and the foreign reader that judges it."""
    if request.param == "ros1":
        packages = "import rosbag, roslib.message, sensor_msgs.msg, nav_msgs.msg, tf2_msgs.msg, std_msgs.msg"
        found = Path(DEBIAN_PYTHON).exists()
        if not found or subprocess.run([DEBIAN_PYTHON, "-c", packages], capture_output=True, check=False).returncode:
            _missing("Debian's python3-rosbag and message packages are not installed (`make judges` says which)")
        yield "ros1", _rosbag
    else:
        if shutil.which("node") is None or not (JUDGES / "node_modules" / "@mcap" / "core").is_dir():
            _missing("Foxglove's readers are not installed (`make judges` installs them)")
        yield "mcap", _foxglove


def _write(path: Path, format: BagFormat, layout: str) -> Layout:
    with RecordingWriter(path, format=format, layout=layout) as writer:
        writer.tf_static([("hand", writer.layout.camera_frame, HAND_FROM_CAM)])
        for step in range(STEPS):
            t_ns = T0 + step * STEP
            writer.odometry(t_ns, odom_from_body(step), twist=np.arange(6.0) + step)
            writer.tf(t_ns, [(writer.layout.body_frame, "hand", body_from_hand(step))])
            writer.joint_states(t_ns, {"sh0": 0.1 * step, "wr0": -0.2 * step})
            writer.camera_info(t_ns, CAMERA)
            writer.image(t_ns, jpeg(picture(step, colour=True)))
            writer.image_raw(t_ns, picture(step))
            writer.depth_info(t_ns, CAMERA)
            writer.depth(t_ns, depth_png(step))
            writer.event(t_ns, {"event": "view", "visit": "w01", "view": str(step), "kind": "sweep"})
            writer.reference(t_ns, odom_from_body(step))
        return writer.layout


def depth_png(step: int) -> bytes:
    """Return a depth image of 16 bits in mm."""
    return bytes(cv2.imencode(".png", np.full((CAMERA.height, CAMERA.width), 900 + step, np.uint16))[1])


def _on(lines: list[Line], topic: str) -> list[Line]:
    return [line for line in lines if line["topic"] == topic]


def _digest(data: bytes) -> dict[str, Any]:
    return {"length": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def _stamp(t_ns: int) -> dict[str, int]:
    return {"sec": t_ns // 10**9, "nanosec": t_ns % 10**9}


def _header(content: Line, t_ns: int, frame: str) -> None:
    assert content["header"]["stamp"] == _stamp(t_ns)
    assert content["header"]["frame_id"] == frame


def _xyz(values: Line) -> list[float]:
    return [values[key] for key in "xyz"]


def _check_pose(position: Line, orientation: Line, expected: Pose) -> None:
    xyz, quaternion = position_quaternion(expected)
    assert _xyz(position) == list(xyz)
    assert [*_xyz(orientation), orientation["w"]] == list(quaternion)


@pytest.fixture(scope="module", params=sorted(LAYOUTS))
def read(
    request: pytest.FixtureRequest, judged: tuple[BagFormat, Judge], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Layout, list[Line]]:
    """What a foreign reader says of a recording in one layout."""
    format, judge = judged
    path = tmp_path_factory.mktemp("judged") / f"robot.{'bag' if format == 'ros1' else 'mcap'}"
    layout = _write(path, format, request.param)
    return layout, judge(path)


def test_every_message_is_there_at_its_time(read: tuple[Layout, list[Line]]) -> None:
    layout, lines = read
    topics = (
        layout.odometry, layout.tf, layout.joint_states, layout.camera_info, layout.compressed, layout.image,
        layout.events, layout.reference, layout.depth_compressed, layout.depth_info,
    )  # fmt: skip
    for topic in topics:
        assert [int(line["t_ns"]) for line in _on(lines, topic)] == [T0 + k * STEP for k in range(STEPS)]
    assert len(lines) == len(topics) * STEPS + 1


def test_images_are_the_bytes_that_were_written(read: tuple[Layout, list[Line]]) -> None:
    layout, lines = read
    for step, (line, raw) in enumerate(zip(_on(lines, layout.compressed), _on(lines, layout.image), strict=True)):
        _header(line["content"], T0 + step * STEP, layout.camera_frame)
        assert line["content"]["data"] == _digest(jpeg(picture(step, colour=True)))
        assert line["content"]["format"] == "jpeg"
        plain = raw["content"]
        assert (plain["height"], plain["width"], plain["step"]) == (CAMERA.height, CAMERA.width, CAMERA.width)
        assert plain["encoding"] == "mono8"
        assert plain["data"] == _digest(picture(step).tobytes())


def test_depth_images_are_the_bytes_that_were_written(read: tuple[Layout, list[Line]]) -> None:
    layout, lines = read
    for step, line in enumerate(_on(lines, layout.depth_compressed)):
        _header(line["content"], T0 + step * STEP, layout.depth_frame)
        assert line["content"]["data"] == _digest(depth_png(step))
        assert line["content"]["format"] == "16UC1; png compressed"


def test_camera_info_is_the_camera_in_ros_pixels(read: tuple[Layout, list[Line]]) -> None:
    layout, lines = read
    fx, fy, cx, cy, k1, k2, p1, p2 = CAMERA.params
    for step, line in enumerate(_on(lines, layout.camera_info)):
        info = {key.lower(): value for key, value in line["content"].items()}
        _header(info, T0 + step * STEP, layout.camera_frame)
        assert (info["height"], info["width"]) == (CAMERA.height, CAMERA.width)
        assert info["k"] == [fx, 0.0, cx - 0.5, 0.0, fy, cy - 0.5, 0.0, 0.0, 1.0]
        assert (info["distortion_model"], info["d"][:4]) == ("plumb_bob", [k1, k2, p1, p2])


def test_transforms_are_exact(read: tuple[Layout, list[Line]]) -> None:
    layout, lines = read
    for step, line in enumerate(_on(lines, layout.tf)):
        (transform,) = line["content"]["transforms"]
        _header(transform, T0 + step * STEP, layout.body_frame)
        assert transform["child_frame_id"] == "hand"
        inside = transform["transform"]
        _check_pose(inside["translation"], inside["rotation"], body_from_hand(step))
    (static,) = _on(lines, layout.tf_static)
    (transform,) = static["content"]["transforms"]
    assert transform["child_frame_id"] == layout.camera_frame
    _check_pose(transform["transform"]["translation"], transform["transform"]["rotation"], HAND_FROM_CAM)


def test_odometry_and_joints_are_exact(read: tuple[Layout, list[Line]]) -> None:
    layout, lines = read
    for step, line in enumerate(_on(lines, layout.odometry)):
        content = line["content"]
        _header(content, T0 + step * STEP, layout.odom_frame)
        assert content["child_frame_id"] == layout.body_frame
        inside = content["pose"]["pose"]
        _check_pose(inside["position"], inside["orientation"], odom_from_body(step))
        twist = content["twist"]["twist"]
        assert [*_xyz(twist["linear"]), *_xyz(twist["angular"])] == [float(i + step) for i in range(6)]
    for step, line in enumerate(_on(lines, layout.joint_states)):
        assert line["content"]["name"] == ["sh0", "wr0"]
        assert line["content"]["position"] == [0.1 * step, -0.2 * step]


def test_a_recording_of_the_simulator_is_read_alike_by_strangers(
    judged: tuple[BagFormat, Judge], tmp_path: Path
) -> None:
    format, judge = judged
    sample = Path(__file__).resolve().parents[1] / "data_samples" / "room" / "session" / "robot.mcap"
    path = transcode(sample, tmp_path, format)
    ours, lines = open_recording(path), judge(path)
    images = _on(lines, LAYOUTS["generic"].compressed)
    assert [int(line["t_ns"]) for line in images] == [frame.t_ns for frame in ours.frames]
    odometry = _on(lines, LAYOUTS["generic"].odometry)
    assert [int(line["t_ns"]) for line in odometry] == list(ours.odometry.t_ns)
    for line, pose in zip(odometry, ours.odometry.poses, strict=True):
        inside = line["content"]["pose"]["pose"]
        assert np.allclose(_xyz(inside["position"]), pose.translation, atol=1e-12)
        turn = Rotation.from_quat([*_xyz(inside["orientation"]), inside["orientation"]["w"]])
        assert (turn.inv() * Rotation.from_matrix(pose.rotation.as_matrix())).magnitude() < 1e-7
