"""Recordings that lack something, are damaged or contradict themselves: named in one line."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from bag_samples import (
    CAMERA,
    HAND_FROM_CAM,
    Options,
    edited,
    every_format,
    jpeg,
    odom_from_body,
    picture,
    rewritten,
    stamp,
    write_sample,
)

from fieldkit.bags import BagFormat, RecordingWriter, inspect_recording, open_recording
from fieldkit.cameras import Camera
from fieldkit.errors import BagError, FieldkitError


@pytest.mark.parametrize(
    ("left_out", "message"),
    [
        ("image", r"no image in layout 'generic'; expected messages on /arm_camera/image/compressed or /arm_camera/"),
        ("camera_info", "no camera_info in layout 'generic'; expected messages on /arm_camera/camera_info"),
        ("tf", "no tf in layout 'generic'; expected messages on /tf or /tf_static"),
        ("odometry", "no odometry in layout 'generic'; expected messages on /odometry"),
    ],
)
@every_format
def test_missing_topic_is_named_beside_the_topics_there(
    tmp_path: Path, format: BagFormat, left_out: str, message: str
) -> None:
    path = write_sample(tmp_path, format, Options(without=frozenset({left_out})))
    with pytest.raises(
        BagError, match=f"^{re.escape(str(path))}: {message}.*; the bag has .*/fieldkit/events.*; record"
    ):
        open_recording(path)


@every_format
def test_recording_without_events_and_session_file_says_what_to_write(tmp_path: Path, format: BagFormat) -> None:
    path = write_sample(tmp_path, format, Options(without=frozenset({"events"})))
    with pytest.raises(
        BagError, match=r"no visit in it; expected visit_begin events on /fieldkit/events, or \[\[visit"
    ):
        open_recording(path)


def test_no_layout_fits(tmp_path: Path) -> None:
    path = write_sample(tmp_path, "mcap", Options(without=frozenset({"image", "camera_info"})))
    message = r"no layout fits; expected images on /arm_camera.*/<robot>/camera/hand/image; the bag has .*/odometry"
    with pytest.raises(BagError, match=message):
        open_recording(path)


def test_unknown_layout_is_answered_with_the_known_ones(tmp_path: Path) -> None:
    path = write_sample(tmp_path, "mcap")
    with pytest.raises(
        BagError, match=r"robot\.mcap: unknown layout 'spot_ros3'; did you mean 'spot_ros.'\? known: gen"
    ):
        open_recording(path, layout="spot_ros3")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("no.bag", "no such file or folder; expected a .bag, a .mcap, a ROS 2 folder"),
        ("empty.bag", r"the file is empty \(0 bytes\)"),
        ("empty.mcap", r"the file is empty \(0 bytes\)"),
        ("folder", "folder without metadata.yaml or session.toml"),
        ("notes.txt", "unknown kind of file '.txt'"),
        ("noise.bag", "damaged or cut off"),
        ("noise.mcap", "damaged or cut off"),
    ],
)
def test_file_that_is_no_recording(tmp_path: Path, name: str, message: str) -> None:
    for empty in ("empty.bag", "empty.mcap"):
        (tmp_path / empty).touch()
    for noise in ("notes.txt", "noise.bag", "noise.mcap"):
        (tmp_path / noise).write_bytes(b"no bag at all " * 100)
    (tmp_path / "folder").mkdir()
    path = tmp_path / name
    for read in (open_recording, inspect_recording):
        with pytest.raises(BagError, match=f"^{re.escape(str(path))}: {message}"):
            read(path)


@pytest.mark.parametrize("share", [0.02, 0.5, 0.9, 1.0])
@every_format
def test_cut_off_recording_is_recognised(tmp_path: Path, format: BagFormat, share: float) -> None:
    path = write_sample(tmp_path, format)
    file = path / "robot.db3" if path.is_dir() else path
    data = file.read_bytes()
    file.write_bytes(data[: min(int(share * len(data)), len(data) - 1)])
    kind = {"mcap": "MCAP file of ROS 2 messages", "ros1": "ROS 1 bag", "ros2": "ROS 2 bag"}[format]
    with pytest.raises(
        BagError, match=rf"^{re.escape(str(path))}: damaged or cut off \(.*\); expected a complete {kind}; "
    ):
        open_recording(path)


def test_ros_2_folder_with_damaged_metadata(tmp_path: Path) -> None:
    path = write_sample(tmp_path, "ros2")
    text = (path / "metadata.yaml").read_text()
    (path / "metadata.yaml").write_text(text[: len(text) // 2])
    with pytest.raises(BagError, match="robot: damaged or cut off"):
        open_recording(path)
    (path / "metadata.yaml").write_text(text)
    (path / "robot.db3").unlink()
    with pytest.raises(BagError, match=r"robot: damaged or cut off .*missing"):
        open_recording(path)


@every_format
def test_flipped_bytes_never_pass_silently_as_another_kind_of_error(
    tmp_path: Path, format: BagFormat, rng: np.random.Generator
) -> None:
    path = write_sample(tmp_path, format)
    file = path / "robot.db3" if path.is_dir() else path
    data = file.read_bytes()
    seen = 0
    for _ in range(25):
        damaged = bytearray(data)
        for place in rng.integers(len(data), size=200):
            damaged[place] ^= 0xFF
        file.write_bytes(damaged)
        try:
            for frame in open_recording(path).frames:
                frame.read()
        except FieldkitError:
            seen += 1
    assert seen > 20


def test_bag_without_any_message(tmp_path: Path) -> None:
    path = write_sample(tmp_path, "ros2")
    edited(path, "DELETE FROM messages")
    (path / "metadata.yaml").unlink()
    with pytest.raises(BagError, match=r"robot\.db3: no message in it"):
        open_recording(path / "robot.db3")


@every_format
def test_camera_info_of_another_size_is_refused(tmp_path: Path, format: BagFormat) -> None:
    other = Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
    path = write_sample(tmp_path, format, Options(camera=other))
    with pytest.raises(
        BagError, match=r"robot.*: image is 64x48 but its CameraInfo says 640x480; expected the same size"
    ):
        open_recording(path)


def test_image_that_changes_its_size_is_noticed_when_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "robot.mcap"
    with RecordingWriter(path, format="mcap") as writer:
        writer.tf_static([("body", "arm_camera", HAND_FROM_CAM)])
        for step in (0, 1):
            writer.odometry(stamp(step), odom_from_body(step))
            writer.camera_info(stamp(step), CAMERA)
            writer.image(stamp(step), jpeg(picture(step)[: 48 - 8 * step]))
        writer.event(stamp(0), {"event": "visit_begin", "visit": "w"})
    frames = open_recording(path).frames
    frames[0].read()
    with pytest.raises(BagError, match="image is 64x40 but its CameraInfo says 64x48"):
        frames[1].read()


def test_uncalibrated_camera_info_is_refused(tmp_path: Path) -> None:
    path = write_sample(tmp_path, "mcap")
    changed = tmp_path / "changed.mcap"
    zeros = np.array([50.0, 0.0, 31.5, 0.0, 51.0]).tobytes()
    rewritten(path, changed, lambda topic, data: data.replace(zeros, bytes(len(zeros))))
    with pytest.raises(BagError, match=r"changed\.mcap: /arm_camera/camera_info: CameraInfo has focal lengths 0, 0"):
        open_recording(changed)
    assert any("focal lengths 0, 0" in what for what in inspect_recording(changed)["missing"])


def test_tf_that_misses_some_images_warns_and_leaves_none(tmp_path: Path) -> None:
    recording = open_recording(write_sample(tmp_path, "mcap", Options(tf_steps=range(20))))
    reached = [frame.body_from_cam is not None for frame in recording.frames]
    assert reached == [step < 20 for step in range(41)]
    assert any("tf does not reach the camera in 21 of 41 images" in w for w in recording.warnings)


def test_tf_that_misses_every_view_is_an_error_that_names_the_frames(tmp_path: Path) -> None:
    path = write_sample(tmp_path, "mcap", Options(tf_steps=range(5)))
    message = r"robot\.mcap: tf reaches the camera at no view: tf 'body' from 'hand' at .* outside of its samples"
    with pytest.raises(BagError, match=message):
        open_recording(path)


def test_camera_that_stands_still_while_joints_move_is_a_warning(tmp_path: Path) -> None:
    path = tmp_path / "robot.mcap"
    with RecordingWriter(path, format="mcap") as writer:
        writer.tf_static([("body", "arm_camera", HAND_FROM_CAM)])
        writer.event(stamp(0), {"event": "visit_begin", "visit": "w"})
        for step in range(3):
            writer.joint_states(stamp(step), {"arm_joint1": 0.5 * step})
            writer.odometry(stamp(step), odom_from_body(step))
            writer.camera_info(stamp(step), CAMERA)
            writer.image(stamp(step), jpeg(picture(step)))
            writer.event(stamp(step), {"event": "view", "visit": "w", "view": step})
        writer.event(stamp(3), {"event": "visit_end", "visit": "w"})
    assert any("tf may be frozen" in warning for warning in open_recording(path).warnings)
