"""Small recordings for tests: one arm camera, two visits, and whatever a test leaves out of them."""

from __future__ import annotations

import dataclasses
import sqlite3
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer as McapFile

from fieldkit.bags import BagFormat, Layout, RecordingWriter
from fieldkit.cameras import Camera
from fieldkit.frames import Pose, pose, yaw_pose
from fieldkit.types import Image

FORMATS: tuple[BagFormat, ...] = get_args(BagFormat)
every_format = pytest.mark.parametrize("format", FORMATS)
SUFFIXES: dict[BagFormat, str] = {"mcap": ".mcap", "ros1": ".bag", "ros2": ""}
T0 = 1_700_000_000_123_456_789
STEP = 100_000_000
CAMERA = Camera("OPENCV", 64, 48, (50.0, 51.0, 32.0, 24.5, 0.1, -0.02, 0.001, 0.002))
HAND_FROM_CAM = pose([0.1, 0.0, 0.02], [-0.5, 0.5, -0.5, 0.5])
N_STEPS = 40


@dataclasses.dataclass(frozen=True)
class Options:
    """What a sample recording leaves out or does differently."""

    without: frozenset[str] = frozenset()
    layout: str | Layout = "generic"
    camera: Camera = CAMERA
    events: tuple[tuple[int, Mapping[str, Any]], ...] | None = None
    tf_steps: range = range(N_STEPS + 1)


def stamp(step: int) -> int:
    return T0 + step * STEP


def picture(step: int, *, colour: bool = False) -> Image:
    shape = (CAMERA.height, CAMERA.width, 3) if colour else (CAMERA.height, CAMERA.width)
    noise = np.random.default_rng(step).integers(0, 256, shape, dtype=np.uint8)
    return np.asarray(cv2.blur(noise, (5, 5)), dtype=np.uint8)


def jpeg(image: Image) -> bytes:
    bgr = image if image.ndim == 2 else image[:, :, ::-1]
    return bytes(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 95])[1])


def odom_from_body(step: int) -> Pose:
    return yaw_pose([0.05 * step, 0.01 * step**2, 0.0], 0.02 * step)


def body_from_hand(step: int) -> Pose:
    return yaw_pose([0.2, 0.0, 0.5], 0.1 * step)


def default_events() -> tuple[tuple[int, Mapping[str, Any]], ...]:
    events: list[tuple[int, Mapping[str, Any]]] = [
        (stamp(1), {"event": "start_begin", "tag_id": 1}),
        (stamp(6), {"event": "start_end", "tag_id": 1}),
    ]
    for visit, first, following, tag in (("w01", 10, "w02", 2), ("w02", 25, None, 3)):
        events.append((stamp(first), {"event": "visit_begin", "visit": visit, "next": following, "tag_id": tag}))
        for view in range(4):
            kind = ("stowed", "sweep", "sweep", "truth")[view]
            event = {"event": "view", "visit": visit, "view": str(view), "kind": kind}
            events.append((stamp(first + 2 * view), event))
        events.append((stamp(first + 9), {"event": "visit_end", "visit": visit}))
    return tuple(events)


def write_sample(folder: Path, format: BagFormat, options: Options = Options(), *, name: str = "robot") -> Path:
    """Write 41 steps of 0.1 s: odometry, tf and an image at each; return the recording's path."""
    path, left_out = folder / f"{name}{SUFFIXES[format]}", options.without
    events = default_events() if options.events is None else options.events
    with RecordingWriter(path, format=format, layout=options.layout) as writer:
        body, camera_frame = writer.layout.body_frame, writer.layout.camera_frame
        if "tf" not in left_out:
            writer.tf_static([("hand", camera_frame, HAND_FROM_CAM)])
        for step in range(N_STEPS + 1):
            t_ns = stamp(step)
            if "odometry" not in left_out:
                writer.odometry(t_ns, odom_from_body(step))
            if "tf" not in left_out and step in options.tf_steps:
                writer.tf(t_ns, [(body, "hand", body_from_hand(step))])
            if "camera_info" not in left_out:
                writer.camera_info(t_ns, options.camera)
            if "image" not in left_out:
                writer.image(t_ns, jpeg(picture(step, colour=step % 2 == 1)))
            if "reference" not in left_out and step % 4 == 0:
                writer.reference(t_ns, odom_from_body(step))
        if "events" not in left_out:
            for t_ns, event in events:
                writer.event(t_ns, event)
    return path


def edited(folder: Path, *changes: str) -> None:
    """Run SQL statements on the sqlite3 file of a ROS 2 recording."""
    with sqlite3.connect(folder / f"{folder.name}.db3") as database:
        for change in changes:
            database.execute(change)
    database.close()


def rewritten(source: Path, target: Path, change: Callable[[str, bytes], bytes]) -> None:
    """Copy an MCAP file message by message, passing every payload through ``change(topic, data)``."""
    with source.open("rb") as stream, target.open("wb") as out:
        writer = McapFile(out)
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        writer.start(profile="ros2")
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            if channel.topic not in channels:
                key = schemas.setdefault(schema.name, writer.register_schema(schema.name, schema.encoding, schema.data))
                channels[channel.topic] = writer.register_channel(channel.topic, "cdr", key)
            data = change(channel.topic, message.data)
            writer.add_message(channels[channel.topic], message.log_time, data, message.log_time)
        writer.finish()
