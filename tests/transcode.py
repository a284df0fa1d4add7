"""Write a recording again in another format or layout, with parts left out."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader

from fieldkit.bags import LAYOUTS, BagFormat, Layout, RecordingWriter
from fieldkit.cameras import camera_from_info
from fieldkit.frames import Pose, pose

NAMES: dict[BagFormat, str] = {"mcap": "robot.mcap", "ros1": "robot.bag", "ros2": "robot"}
PARTS = {
    "/arm_camera/image/compressed": "image",
    "/arm_camera/camera_info": "camera_info",
    "/odometry": "odometry",
    "/tf": "tf",
    "/tf_static": "tf_static",
    "/fieldkit/events": "events",
}


def transcode(
    source: Path,
    folder: Path,
    format: BagFormat,
    *,
    without: Collection[str] = (),
    n_visits: int = 1,
    layout: str = "generic",
) -> Path:
    """Copy a generic recording up to the end of its n-th visit; ``without`` names parts to leave out."""
    folder.mkdir(parents=True, exist_ok=True)
    path, ended = folder / NAMES[format], 0
    with RecordingWriter(path, format=format, layout=layout) as writer:
        for part, t_ns, message in _messages(source):
            if part in without:
                ended += part == "events" and json.loads(message.data)["event"] == "visit_end"
                if ended == n_visits:
                    break
                continue
            if part == "image":
                writer.image(t_ns, bytes(message.data))
            elif part == "camera_info":
                model = message.distortion_model
                camera = camera_from_info(message.width, message.height, message.k, message.d, distortion_model=model)
                writer.camera_info(t_ns, camera)
            elif part == "odometry":
                writer.odometry(t_ns, _pose(message.pose.pose.position, message.pose.pose.orientation))
            elif part == "tf":
                writer.tf(t_ns, _transforms(message, writer.layout))
            elif part == "tf_static":
                writer.tf_static(_transforms(message, writer.layout))
            else:
                event = json.loads(message.data)
                writer.event(t_ns, event)
                ended += event["event"] == "visit_end"
                if ended == n_visits:
                    break
    return path


def _messages(source: Path) -> Iterator[tuple[str, int, Any]]:
    with AnyReader([source]) as reader:
        for connection, t_ns, raw in reader.messages():
            if connection.topic in PARTS:
                yield PARTS[connection.topic], t_ns, reader.deserialize(raw, connection.msgtype)


def _pose(xyz: Any, q: Any) -> Pose:
    return pose(np.array([xyz.x, xyz.y, xyz.z]), np.array([q.x, q.y, q.z, q.w]))


def _transforms(message: Any, names: Layout) -> list[tuple[str, str, Pose]]:
    old = LAYOUTS["generic"]
    renamed = {
        old.odom_frame: names.odom_frame,
        old.body_frame: names.body_frame,
        old.camera_frame: names.camera_frame,
        old.depth_frame: names.depth_frame,
    }
    return [
        (
            renamed.get(t.header.frame_id, t.header.frame_id),
            renamed.get(t.child_frame_id, t.child_frame_id),
            _pose(t.transform.translation, t.transform.rotation),
        )
        for t in message.transforms
    ]
