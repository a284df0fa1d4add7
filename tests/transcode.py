"""Write a recording again in another format or layout, with parts left out."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader

from fieldkit.bags import LAYOUTS, BagFormat, Layout, RecordingWriter
from fieldkit.cameras import Camera, camera_from_info
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
    camera: Camera | None = None,
    hand_from_cam: Pose | None = None,
    late_ns: int = 0,
) -> Path:
    """Copy a generic recording up to the end of its n-th visit; ``without`` names parts to leave out.

    The copy states ``camera`` and ``hand_from_cam`` where they are given, and stamps images later by ``late_ns``.
    """
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
                writer.image(t_ns + late_ns, bytes(message.data))
            elif part == "camera_info":
                model = message.distortion_model
                told = camera_from_info(message.width, message.height, message.k, message.d, distortion_model=model)
                writer.camera_info(t_ns + late_ns, camera or told)
            elif part == "odometry":
                writer.odometry(t_ns, _pose(message.pose.pose.position, message.pose.pose.orientation))
            elif part == "tf":
                writer.tf(t_ns, _transforms(message, writer.layout))
            elif part == "tf_static":
                rows = _transforms(message, writer.layout)
                if hand_from_cam is not None:
                    own = writer.layout.camera_frame
                    rows = [(a, b, hand_from_cam if b == own else a_from_b) for a, b, a_from_b in rows]
                writer.tf_static(rows)
            else:
                event = json.loads(message.data)
                # A view is announced with the stamp of its image
                late = late_ns if event["event"] == "view" else 0
                writer.event(t_ns + late, event | {"t_ns": t_ns + late})
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
