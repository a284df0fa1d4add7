"""Topic and frame names of the robots whose recordings are read: one entry per robot in a visible dict."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Collection
from typing import Any

from fieldkit.errors import BagError, suggestion

# Stands for the robot's own name, which some drivers put in front of every topic and frame
ROBOT = "{robot}"
# The names of Spot's description and of its ROS 2 driver
_JOINTS = tuple(f"arm_{joint}" for joint in ("sh0", "sh1", "el0", "el1", "wr0", "wr1"))
_LINKS = tuple(joint.replace("arm_", "arm_link_") for joint in _JOINTS)


@dataclasses.dataclass(frozen=True)
class Layout:
    """Where a recording keeps what: topics, frames and joints; ``{robot}`` in them stands for the robot's name.

    ``arm_frames`` are the links of the arm that tf moves, from the body outwards, the last one with the cameras; a
    driver that gives the wrist in the body names it alone. ``arm_joints`` are their names in joint states.
    """

    name: str
    image: str
    compressed: str
    camera_info: str
    odometry: str
    tf: str = "/tf"
    tf_static: str = "/tf_static"
    events: str = "/fieldkit/events"
    reference: str = "/fieldkit/reference"
    joint_states: str = "/joint_states"
    depth: str = "/arm_camera/depth/image_raw"
    depth_compressed: str = "/arm_camera/depth/image/compressed"
    depth_info: str = "/arm_camera/depth/camera_info"
    odom_frame: str = "odom"
    body_frame: str = "body"
    camera_frame: str = "arm_camera"
    depth_frame: str = "arm_depth"
    arm_frames: tuple[str, ...] = _LINKS
    arm_joints: tuple[str, ...] = _JOINTS

    def named(self, robot: str) -> Layout:
        """Return the layout with the robot's name filled in."""

        def filled(value: str | tuple[str, ...]) -> str | tuple[str, ...]:
            parts = [part.replace(ROBOT, robot) for part in ((value,) if isinstance(value, str) else value)]
            return parts[0] if isinstance(value, str) else tuple(parts)

        values: dict[str, Any] = {f.name: filled(getattr(self, f.name)) for f in dataclasses.fields(self)}
        return Layout(**values)


LAYOUTS: dict[str, Layout] = {
    "generic": Layout(
        name="generic",
        image="/arm_camera/image_raw",
        compressed="/arm_camera/image/compressed",
        camera_info="/arm_camera/camera_info",
        odometry="/odometry",
    ),
    "spot_ros1": Layout(
        name="spot_ros1",
        image="/spot/camera/hand_color/image",
        compressed="/spot/camera/hand_color/image/compressed",
        camera_info="/spot/camera/hand_color/camera_info",
        odometry="/spot/odometry",
        depth="/spot/depth/hand/image",
        depth_compressed="/spot/depth/hand/image/compressed",
        depth_info="/spot/depth/hand/camera_info",
        odom_frame="vision",
        camera_frame="hand_color_image_sensor",
        depth_frame="hand_depth_sensor",
        arm_frames=("link_wr1",),
        arm_joints=tuple(f"arm_joint{number}" for number in range(1, 7)),
    ),
    "spot_ros2": Layout(
        name="spot_ros2",
        image="/{robot}/camera/hand/image",
        compressed="/{robot}/camera/hand/compressed",
        camera_info="/{robot}/camera/hand/camera_info",
        odometry="/{robot}/odometry",
        joint_states="/{robot}/joint_states",
        depth="/{robot}/depth/hand/image",
        depth_compressed="/{robot}/depth/hand/image/compressed",
        depth_info="/{robot}/depth/hand/camera_info",
        odom_frame="{robot}/odom",
        body_frame="{robot}/body",
        camera_frame="{robot}/hand_color_image_sensor",
        depth_frame="{robot}/hand_depth_sensor",
        arm_frames=tuple(f"{ROBOT}/{link}" for link in _LINKS),
        arm_joints=tuple(f"{ROBOT}/{joint}" for joint in _JOINTS),
    ),
}


def find_layout(name: str) -> Layout:
    """Return the layout of a name; raises BagError with a suggestion for an unknown one."""
    if name not in LAYOUTS:
        raise BagError(f"unknown layout {name!r}", hint=suggestion(name, list(LAYOUTS)))
    return LAYOUTS[name]


def fit_layout(layout: Layout, topics: Collection[str]) -> Layout:
    """Fill the robot's name into a layout from the topics of a recording; ``spot`` where none of them tells it."""
    for pattern in (layout.image, layout.compressed, layout.camera_info, layout.odometry):
        if ROBOT in pattern:
            expression = re.compile(re.escape(pattern).replace(re.escape(ROBOT), "([^/]+)"))
            for topic in sorted(topics):
                if match := expression.fullmatch(topic):
                    return layout.named(match.group(1))
    return layout.named("spot")


def detect_layout(topics: Collection[str]) -> Layout | None:
    """Return the layout that finds most of its topics in a recording, or None when none finds images or CameraInfo."""
    best, best_count = None, 0
    for layout in LAYOUTS.values():
        fitted = fit_layout(layout, topics)
        camera = {fitted.image, fitted.compressed, fitted.camera_info} & set(topics)
        count = len(camera) + (fitted.odometry in topics)
        if camera and count > best_count:
            best, best_count = fitted, count
    return best
