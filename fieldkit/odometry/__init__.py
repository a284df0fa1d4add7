"""Odometry: how far it can be trusted along a path, what is wrong with it, and whether its clock is the camera's."""

from fieldkit.odometry.clock import ClockOffset, PlacedTag, clock_offset, offset_fault
from fieldkit.odometry.faults import find_faults, summarize_faults
from fieldkit.odometry.travelling import jumps_between, travel

__all__ = [
    "ClockOffset",
    "PlacedTag",
    "clock_offset",
    "find_faults",
    "jumps_between",
    "offset_fault",
    "summarize_faults",
    "travel",
]
