"""Recordings: three formats say the same, and images stay on disk."""

from __future__ import annotations

import bz2
import contextlib
import dataclasses
import json
import pickle
import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import zstandard
from bag_samples import (
    CAMERA,
    FORMATS,
    HAND_FROM_CAM,
    Options,
    body_from_hand,
    edited,
    every_format,
    odom_from_body,
    picture,
    rewritten,
    stamp,
    write_sample,
)
from mcap.reader import make_reader

from fieldkit.bags import LAYOUTS, BagFormat, RecordingWriter, inspect_recording, open_recording
from fieldkit.errors import BagError
from fieldkit.frames import Pose, Trajectory, pose_error
from fieldkit.types import Image, Recording


def pose_bytes(value: Pose | None) -> bytes:
    return b"" if value is None else value.as_matrix().tobytes()


def trajectory_bytes(trajectory: Trajectory | None) -> tuple[Any, ...]:
    if trajectory is None:
        return ()
    poses = [pose_bytes(p) for p in trajectory.poses]
    return trajectory.t_ns.tobytes(), poses, trajectory.parent, trajectory.child, trajectory.max_gap_ns


def everything(recording: Recording) -> list[Any]:
    frames = [(f.t_ns, f.camera, pose_bytes(f.body_from_cam), f.read().tobytes()) for f in recording.frames]
    index = {id(f): i for i, f in enumerate(recording.frames)}
    visits = [
        (v.id, v.t_begin_ns, v.t_end_ns, v.next, v.truth_tag_id)
        + tuple((w.id, w.kind, w.repeat, index[id(w.frame)]) for w in v.views)
        for v in recording.visits
    ]
    odometry, reference = trajectory_bytes(recording.odometry), trajectory_bytes(recording.reference)
    return [recording.name, recording.layout, frames, visits, odometry, reference, recording.starts, recording.warnings]


# What is written comes back


def test_three_formats_give_the_same_recording_bit_for_bit(tmp_path: Path) -> None:
    first, *others = (everything(open_recording(write_sample(tmp_path / f, f))) for f in FORMATS)
    assert len(first[2]) == 41
    assert all(other == first for other in others)


@every_format
def test_content_is_what_was_written(tmp_path: Path, format: BagFormat) -> None:
    recording = open_recording(write_sample(tmp_path, format))
    assert [f.t_ns for f in recording.frames] == [stamp(i) for i in range(41)]
    assert recording.frames[0].camera == CAMERA
    for step, frame in enumerate(recording.frames):
        assert frame.body_from_cam is not None
        assert max(pose_error(frame.body_from_cam, body_from_hand(step) * HAND_FROM_CAM)) < 1e-12
        assert max(pose_error(recording.odometry.at(frame.t_ns), odom_from_body(step))) < 1e-12
    assert (recording.odometry.parent, recording.odometry.child) == ("odom", "body")
    assert recording.reference is not None
    assert (len(recording.reference), recording.reference.parent, recording.reference.child) == (11, "map", "body")
    start, (w01, w02) = recording.starts[0], recording.visits
    assert (start.tag_id, start.t_begin_ns, start.t_end_ns, start.visit) == (1, stamp(1), stamp(6), None)
    assert (w01.id, w01.next, w01.truth_tag_id, w02.next, w02.truth_tag_id) == ("w01", "w02", 2, None, 3)
    assert [(v.id, v.kind, v.frame.t_ns) for v in w01.views] == [
        ("0", "stowed", stamp(10)),
        ("1", "sweep", stamp(12)),
        ("2", "sweep", stamp(14)),
        ("3", "truth", stamp(16)),
    ]
    assert (recording.name, recording.layout, recording.warnings) == ("robot", "generic", ())


@every_format
def test_images_are_read_on_demand_in_grey_and_rgb(tmp_path: Path, format: BagFormat) -> None:
    recording = open_recording(write_sample(tmp_path, format))
    grey, colour = recording.frames[30].read(), recording.frames[31].read()
    assert grey.shape == (48, 64)
    assert colour.shape == (48, 64, 3)
    assert np.abs(grey.astype(int) - picture(30)).mean() < 5
    assert np.abs(colour.astype(int) - picture(31, colour=True)).mean() < 8
    # Neither the pixels nor the bytes of an image are kept: the frames alone weigh less than one image each
    assert len(pickle.dumps(recording.frames)) < 41 * 48 * 64 / 2
    again = pickle.loads(pickle.dumps(recording.frames[31]))
    np.testing.assert_array_equal(again.read(), colour)


@every_format
def test_images_with_equal_stamps_keep_the_order_of_the_bag(tmp_path: Path, format: BagFormat) -> None:
    path = tmp_path / ("equal" + {"mcap": ".mcap", "ros1": ".bag", "ros2": ""}[format])
    with RecordingWriter(path, format=format) as writer:
        for level in range(6):
            image = np.full((48, 64), 40 * level, dtype=np.uint8)
            writer.image(stamp(1), bytes(cv2.imencode(".png", image)[1]))
        writer.camera_info(stamp(1), CAMERA)
        writer.odometry(stamp(1), odom_from_body(0))
        writer.tf_static([("body", "arm_camera", HAND_FROM_CAM)])
        writer.event(stamp(1), {"event": "visit_begin", "visit": "w"})
        writer.event(stamp(1), {"event": "visit_end", "visit": "w"})
    frames = open_recording(path).frames
    assert [int(frame.read()[0, 0]) for frame in frames] == [0, 40, 80, 120, 160, 200]


def bayer(rgb: Image, pattern: str) -> Image:
    mosaic = np.zeros(rgb.shape[:2], dtype=np.uint8)
    for place, letter in enumerate(pattern):
        y, x = divmod(place, 2)
        mosaic[y::2, x::2] = rgb[y::2, x::2, "rgb".index(letter)]
    return mosaic


FLAT = np.broadcast_to(np.array([200, 120, 40], dtype=np.uint8), (48, 64, 3))
GREY = picture(3)
RGB = picture(5, colour=True)
ALPHA = np.full((48, 64, 1), 255, dtype=np.uint8)


@pytest.mark.parametrize(
    ("encoding", "written", "expected"),
    [
        ("mono8", GREY, GREY),
        ("8UC1", GREY, GREY),
        ("mono16", GREY.astype("<u2") * 256 + 7, GREY),
        ("rgb8", RGB, RGB),
        ("bgr8", RGB[:, :, ::-1], RGB),
        ("8UC3", RGB[:, :, ::-1], RGB),
        ("rgba8", np.concatenate([RGB, ALPHA], axis=2), RGB),
        ("bgra8", np.concatenate([RGB[:, :, ::-1], ALPHA], axis=2), RGB),
        *((f"bayer_{p}8", bayer(FLAT, p), FLAT) for p in ("rggb", "bggr", "gbrg", "grbg")),
    ],
)
def test_uncompressed_image_of_every_encoding(tmp_path: Path, encoding: str, written: Image, expected: Image) -> None:
    path = tmp_path / "raw.mcap"
    with RecordingWriter(path, format="mcap") as writer:
        writer.tf_static([("body", "arm_camera", HAND_FROM_CAM)])
        writer.odometry(stamp(10), odom_from_body(0))
        writer.camera_info(stamp(10), CAMERA)
        writer.image_raw(stamp(10), written, encoding=encoding)
        writer.event(stamp(10), {"event": "visit_begin", "visit": "w"})
        writer.event(stamp(10), {"event": "view", "visit": "w", "view": 1})
    recording = open_recording(path)
    np.testing.assert_array_equal(recording.visits[0].views[0].frame.read(), expected)


def test_unknown_encoding_is_named_with_the_known_ones(tmp_path: Path) -> None:
    path = tmp_path / "raw.mcap"
    with RecordingWriter(path, format="mcap") as writer:
        writer.tf_static([("body", "arm_camera", HAND_FROM_CAM)])
        writer.odometry(stamp(10), odom_from_body(0))
        writer.camera_info(stamp(10), CAMERA)
        writer.image_raw(stamp(10), GREY, encoding="32FC1")
        writer.event(stamp(10), {"event": "visit_begin", "visit": "w"})
    frame = open_recording(path).frames[0]
    with pytest.raises(BagError, match=r"raw\.mcap: image at .* ns: image encoding '32FC1'; known: mono8, "):
        frame.read()


def test_camera_info_in_the_bag_is_half_a_pixel_lower(tmp_path: Path) -> None:
    with write_sample(tmp_path, "mcap").open("rb") as stream:
        schema, _, message = next(make_reader(stream).iter_messages("/arm_camera/camera_info"))
        data = message.data
    assert schema is not None
    assert schema.name == "sensor_msgs/msg/CameraInfo"
    assert np.array([50.0, 0.0, 31.5, 0.0, 51.0, 24.0]).tobytes() in data
    assert np.array([32.0]).tobytes() not in data


@pytest.mark.parametrize("layout", list(LAYOUTS))
@every_format
def test_layout_is_found_by_its_topics(tmp_path: Path, format: BagFormat, layout: str) -> None:
    recording = open_recording(write_sample(tmp_path, format, Options(layout=layout)))
    assert recording.layout == layout
    assert all(frame.body_from_cam is not None for frame in recording.frames)


def test_robot_name_is_read_from_the_topics(tmp_path: Path) -> None:
    layout = LAYOUTS["spot_ros2"].named("rex")
    recording = open_recording(write_sample(tmp_path, "mcap", Options(layout=layout)))
    assert (recording.layout, recording.odometry.child) == ("spot_ros2", "rex/body")


# Writing is all or nothing


@every_format
def test_nothing_remains_of_a_recording_that_failed(tmp_path: Path, format: BagFormat) -> None:
    path = tmp_path / "robot.bag"
    with contextlib.suppress(ZeroDivisionError), RecordingWriter(path, format=format) as writer:
        writer.odometry(stamp(0), odom_from_body(0))
        assert list(tmp_path.iterdir()) != []
        raise ZeroDivisionError
    with pytest.raises(BagError, match=r"robot\.bag: nothing was written"), RecordingWriter(path, format=format):
        pass
    assert list(tmp_path.iterdir()) == []


@every_format
def test_existing_recording_is_not_overwritten(tmp_path: Path, format: BagFormat) -> None:
    path = write_sample(tmp_path, format)
    with pytest.raises(BagError, match=r"robot.*: exists already"):
        write_sample(tmp_path, format)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    open_recording(path)


def test_unknown_format_and_closed_writer_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BagError, match=r"unknown format 'ros3'; did you mean 'ros.'\?"):
        RecordingWriter(tmp_path / "x", format="ros3")  # type: ignore[arg-type]
    with pytest.raises(BagError, match="not open; expected to be used inside a with block"):
        RecordingWriter(tmp_path / "x", format="ros1").event(0, {"event": "view"})


# What others write


def test_payloads_compressed_one_by_one_are_read_without_metadata(tmp_path: Path) -> None:
    path, packed = write_sample(tmp_path, "mcap"), tmp_path / "packed" / "robot.mcap"
    packed.parent.mkdir()
    rewritten(path, packed, lambda topic, data: zstandard.compress(data))
    assert everything(open_recording(packed)) == everything(open_recording(path))


def test_bag_without_definitions_falls_back_to_the_standard_ones(tmp_path: Path) -> None:
    path, stripped = write_sample(tmp_path, "ros2"), tmp_path / "stripped" / "robot"
    shutil.copytree(path, stripped)
    edited(
        stripped,
        "DELETE FROM message_definitions",
        "INSERT INTO topics VALUES(99, '/odd', 'odd_msgs/msg/Thing', 'cdr', '', '')",
        "INSERT INTO messages (topic_id, timestamp, data) VALUES(99, 1700000001000000000, x'00010000')",
        "INSERT INTO messages (topic_id, timestamp, data) VALUES(99, 1700000002000000000, x'00010000')",
    )
    recording = open_recording(stripped / "robot.db3")
    assert recording.warnings == ("2 messages of unknown type odd_msgs/msg/Thing were skipped",)
    assert everything(recording)[:-1] == everything(open_recording(path))[:-1]


@every_format
def test_inspect_counts_everything(tmp_path: Path, format: BagFormat) -> None:
    found = inspect_recording(write_sample(tmp_path, format, Options(tf_steps=range(30))))
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert (found["format"], found["layout"], found["duration_s"], found["missing"]) == (format, "generic", 4.0, [])
    assert {"name": "/odometry", "type": "nav_msgs/msg/Odometry", "count": 41} in found["topics"]
    assert (found["images"]["with_tf"], found["images"]["without_tf"]) == (30, 11)
    assert found["visits"][1]["views"] == {"stowed": 1, "sweep": 2, "truth": 1}
    assert (found["visits"][1]["views_with_tf"], found["starts"][0]["tag_id"]) == (3, 1)


@pytest.mark.parametrize("left_out", ["image", "camera_info", "tf", "odometry", "events", "reference"])
def test_inspect_goes_on_where_something_is_missing(tmp_path: Path, left_out: str) -> None:
    found = inspect_recording(write_sample(tmp_path, "ros1", Options(without=frozenset({left_out}))))
    assert any(left_out.rstrip("s") in what for what in found["missing"]) == (left_out != "reference")


# Bags that others recorded


def test_foreign_bags_are_inspected_and_refused_in_one_line(tmp_path: Path, shared_data: Path) -> None:
    bags = [bag for bag in sorted((shared_data / "bags").glob("*.bag")) if bag.stat().st_size]
    for packed in sorted((shared_data / "tagslam").glob("test_2*/*.bag.bz2")):
        bags.append(tmp_path / f"{packed.parent.name}_{packed.stem}")
        bags[-1].write_bytes(bz2.decompress(packed.read_bytes()))
    assert len(bags) >= 9
    for bag in bags:
        found = inspect_recording(bag)
        assert json.loads(json.dumps(found, allow_nan=False)) == found
        assert found["missing"]
        assert found["duration_s"] >= 0
        with pytest.raises(BagError, match=f"^{re.escape(str(bag))}: .*; ") as caught:
            open_recording(bag)
        assert "\n" not in str(caught.value)
    with pytest.raises(BagError, match=r"empty-file\.bag: the file is empty"):
        open_recording(shared_data / "bags" / "empty-file.bag")


def test_foreign_compression_gives_the_same_messages(shared_data: Path) -> None:
    plain, *packed = (inspect_recording(shared_data / "bags" / f"example{kind}.bag") for kind in ("", "-lz4", "-bz2"))
    assert plain["n_messages"] == 8647
    for other in packed:
        assert {k: v for k, v in other.items() if k not in ("path", "name")} == {
            k: v for k, v in plain.items() if k not in ("path", "name")
        }


def test_real_image_and_camera_info_are_read_with_a_layout_of_ones_own(shared_data: Path) -> None:
    layout = LAYOUTS["generic"]
    own = dataclasses.replace(
        layout, name="raspicam", compressed="/raspicam_node/image/compressed", camera_info="/raspicam_node/camera_info"
    )
    found = inspect_recording(shared_data / "bags" / "aruco_images.bag", layout=own)
    assert found["images"]["count"] == 1
    assert list(found["images"]["cameras"].values()) == [1]
