"""Recordings: read and write ROS 1 bags, ROS 2 bags and MCAP files without ROS."""

from __future__ import annotations

from fieldkit.bags.layouts import LAYOUTS, Layout
from fieldkit.bags.writing import BagFormat, RecordingWriter

__all__ = ["LAYOUTS", "BagFormat", "Layout", "RecordingWriter"]
