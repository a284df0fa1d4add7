"""Recordings: read and write ROS 1 bags, ROS 2 bags and MCAP files without ROS."""

from __future__ import annotations

from fieldkit.bags.arm import ArmRecording, Kinematics, open_arm
from fieldkit.bags.detections import RecordedTags, read_detections
from fieldkit.bags.inspecting import inspect_recording
from fieldkit.bags.layouts import LAYOUTS, Layout
from fieldkit.bags.reading import open_recording
from fieldkit.bags.tag_messages import RecordedTag
from fieldkit.bags.tf import TfBuffer
from fieldkit.bags.writing import BagFormat, RecordingWriter

__all__ = [
    "LAYOUTS",
    "ArmRecording",
    "BagFormat",
    "Kinematics",
    "Layout",
    "RecordedTag",
    "RecordedTags",
    "RecordingWriter",
    "TfBuffer",
    "inspect_recording",
    "open_arm",
    "open_recording",
    "read_detections",
]
