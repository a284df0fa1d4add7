"""Messages of tag detectors, type by type, as one noun."""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldkit.bags.content import stamp_ns
from fieldkit.bags.tf import clean_frame
from fieldkit.cameras import Camera
from fieldkit.errors import FieldkitError
from fieldkit.frames import Pose, pose

Array = NDArray[np.float64]

# The MIT detector, as OpenCV, puts the centre of the first pixel at (0, 0); COLMAP, AprilTag 2 and 3 at (0.5, 0.5)
_OPENCV_PX = 0.5
# What the node for AprilTag 2 writes as the family
_UMICH = ("umich", "")
_FAMILY = re.compile(r"(?:tag|tf)?(36h1[01]|25h9|16h5|circle21h7|circle49h12|custom48h12|standard41h12|standard52h13)")


@dataclasses.dataclass(frozen=True)
class RecordedTag:
    """A tag in one image, as a topic tells it: header stamp, camera frame, and what the message knows.

    ``corners_px`` f64[4, 2] in COLMAP pixels of the image that was searched, in the order bottom-left, bottom-right,
    top-right, top-left of the upright tag; None where the message has a pose only: then ``cam_from_tag`` and
    ``size_m`` are there (tag frame: x right, y up, z out of the paper). ``family`` is None where the message names
    only its detector. ``hamming`` counts corrected bits, ``margin`` is AprilTag's decision margin.
    """

    t_ns: int
    frame: str
    topic: str
    id: int
    family: str | None
    corners_px: Array | None
    size_m: float | None = None
    cam_from_tag: Pose | None = None
    hamming: int | None = None
    margin: float | None = None

    def corners(self, camera: Camera) -> Array | None:
        """Return the corners f64[4, 2] in pixels of a camera, from the pose where the message has no corners.

        The pose's own residual is gone then, and so is the other solution of the planar problem. None where the
        camera cannot see all of the tag.
        """
        if self.corners_px is not None:
            return self.corners_px
        if self.cam_from_tag is None or self.size_m is None:
            return None
        h = self.size_m / 2
        square = np.array([[-h, -h, 0.0], [h, -h, 0.0], [h, h, 0.0], [-h, h, 0.0]])
        pixels = camera.project(self.cam_from_tag.apply(square))[0]
        return pixels if np.isfinite(pixels).all() else None


Reader = Callable[[str, Any, Counter[str]], Iterator[RecordedTag]]


def _from_tagslam(topic: str, message: Any, refused: Counter[str]) -> Iterator[RecordedTag]:
    """Read apriltag_msgs/ApriltagArrayStamped, which TagSLAM reads: pixels by detector, corners from bottom-left."""
    for tag in message.apriltags:
        shift = 0.0 if tag.family.strip().lower() in _UMICH else _OPENCV_PX
        corners = np.array([[p.x, p.y] for p in tag.corners], dtype=np.float64) + shift
        if not _is_quad(corners, refused):
            continue
        yield RecordedTag(
            stamp_ns(message.header), clean_frame(message.header.frame_id), topic, int(tag.id), _family(tag.family),
            corners, hamming=int(tag.hamming),
        )  # fmt: skip


def _from_ros2(topic: str, message: Any, refused: Counter[str]) -> Iterator[RecordedTag]:
    """Read apriltag_msgs/AprilTagDetectionArray: AprilTag 3's own corners, first pixel's centre at (0.5, 0.5)."""
    for tag in message.detections:
        corners = np.array([[p.x, p.y] for p in tag.corners], dtype=np.float64)
        if not _is_quad(corners, refused):
            continue
        yield RecordedTag(
            stamp_ns(message.header), clean_frame(message.header.frame_id), topic, int(tag.id), _family(tag.family),
            corners, hamming=int(tag.hamming), margin=float(tag.decision_margin),
        )  # fmt: skip


def _from_ros1(topic: str, message: Any, refused: Counter[str]) -> Iterator[RecordedTag]:
    """Read AprilTagDetectionArray of ROS 1: poses, x right, y up, z out of the paper; a bundle has several ids."""
    for tag in message.detections:
        ids, sizes = np.atleast_1d(tag.id), np.atleast_1d(tag.size)
        if len(ids) != 1 or len(sizes) != 1:
            refused["poses of bundles"] += 1
            continue
        # The pose's own header is empty in some versions, the array's in others
        header = tag.pose.header if stamp_ns(tag.pose.header) else message.header
        value = tag.pose.pose.pose if hasattr(tag.pose.pose, "pose") else tag.pose.pose
        p, q = value.position, value.orientation
        try:
            cam_from_tag = pose((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))
        except FieldkitError:
            refused["poses with impossible numbers"] += 1
            continue
        if cam_from_tag.translation[2] <= 0 or not sizes[0] > 0:
            refused["poses behind the camera or without a size"] += 1
            continue
        frame = clean_frame(header.frame_id or message.header.frame_id)
        yield RecordedTag(
            stamp_ns(header), frame, topic, int(ids[0]), None, None, size_m=float(sizes[0]), cam_from_tag=cam_from_tag
        )


def _is_quad(corners: Array, refused: Counter[str]) -> bool:
    """Tell whether four corners run counter-clockwise around a tag seen from its front, and count those that do not."""
    ahead = np.roll(corners, -1, axis=0) - corners
    behind = np.roll(ahead, 1, axis=0)
    # Image y points down: counter-clockwise to the eye turns negative
    turns = behind[:, 0] * ahead[:, 1] - behind[:, 1] * ahead[:, 0]
    if bool(np.isfinite(corners).all() and (turns < 0).all()):
        return True
    refused["corners that are no square seen from its front"] += 1
    return False


def _family(name: str) -> str | None:
    match = _FAMILY.fullmatch(name.strip().lower())
    if match is None:
        return None
    return "tag" + re.sub("^[a-z]", lambda m: m.group().upper(), match.group(1))


READERS: dict[str, Reader] = {
    "apriltag_msgs/msg/ApriltagArrayStamped": _from_tagslam,
    "apriltag_msgs/msg/AprilTagDetectionArray": _from_ros2,
    "apriltag_ros/msg/AprilTagDetectionArray": _from_ros1,
    "apriltags2_ros/msg/AprilTagDetectionArray": _from_ros1,
    "apriltags_ros/msg/AprilTagDetectionArray": _from_ros1,
}
