"""Tags that somebody else's detector found while a bag was recorded: read from topics, without images."""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldkit.bags.content import stamp_ns
from fieldkit.bags.files import BagFile
from fieldkit.bags.reading import open_source, topic_list
from fieldkit.bags.tf import clean_frame
from fieldkit.cameras import Camera
from fieldkit.errors import BagError, FieldkitError
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


@dataclasses.dataclass(frozen=True)
class RecordedTags:
    """All tags on the topics of a bag in the order of their stamps, and what was left out, counted by reason.

    ``n_messages`` per topic: a detector also speaks when it sees nothing.
    """

    tags: tuple[RecordedTag, ...]
    n_messages: dict[str, int]
    refused: dict[str, int]


def read_detections(path: Path | str, *, topics: Sequence[str] | None = None) -> RecordedTags:
    """Read tag detections from a recording of any format; from all topics with a known type when none is named.

    Known types: apriltag_msgs/ApriltagArrayStamped (TagSLAM), apriltag_msgs/AprilTagDetectionArray (apriltag_ros of
    ROS 2), and AprilTagDetectionArray of apriltag_ros, apriltags2_ros and apriltags_ros (ROS 1, poses only). Poses of
    bundles are left out and counted. Raises BagError when there is no such topic, or a named one is of another type.
    """
    bag = open_source(path).bag
    known = {name: _READERS[topic.type] for name, topic in bag.topics.items() if topic.type in _READERS}
    for topic in topics or ():
        if topic not in known:
            found = f"is of type {bag.topics[topic].type}" if topic in bag.topics else "is not in the bag"
            raise BagError(
                f"{bag.path}: {topic} {found}; expected a topic with one of {', '.join(_READERS)}",
                hint=f"the bag has {topic_list(bag)}",
            )
    wanted = tuple(topics) if topics else tuple(known)
    if not wanted:
        raise BagError(
            f"{bag.path}: no topic with tag detections; expected one of {', '.join(_READERS)}; the bag has "
            f"{topic_list(bag)}",
            hint="record the detector's topic, or record images",
        )
    unknown = {kind: n for kind, n in bag.unknown.items() if kind in _READERS}
    if unknown:
        raise BagError(
            f"{bag.path}: the bag does not describe its messages of type {', '.join(unknown)}; expected it to",
            hint="record it with ROS 2 Iron or later, or convert it to MCAP where the package is installed",
        )
    tags, counts, refused = _collect(bag, wanted, known)
    return RecordedTags(tuple(sorted(tags, key=lambda tag: tag.t_ns)), dict(counts), dict(refused))


_Reader = Callable[[str, Any, Counter[str]], Iterator[RecordedTag]]


def _collect(
    bag: BagFile, topics: Sequence[str], known: dict[str, _Reader]
) -> tuple[list[RecordedTag], Counter[str], Counter[str]]:
    found: list[RecordedTag] = []
    counts: Counter[str] = Counter(dict.fromkeys(topics, 0))
    refused: Counter[str] = Counter()
    for message in bag.messages(topics):
        counts[message.topic] += 1
        try:
            found += known[message.topic](message.topic, message.value, refused)
        except AttributeError as error:
            kind = message.value.__msgtype__
            raise BagError(
                f"{bag.path}: {message.topic}: {kind} has no field {error.name!r}; expected the published definition",
                hint="name the other topics, or leave this one out",
            ) from error
    return found, counts, refused


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


_READERS: dict[str, _Reader] = {
    "apriltag_msgs/msg/ApriltagArrayStamped": _from_tagslam,
    "apriltag_msgs/msg/AprilTagDetectionArray": _from_ros2,
    "apriltag_ros/msg/AprilTagDetectionArray": _from_ros1,
    "apriltags2_ros/msg/AprilTagDetectionArray": _from_ros1,
    "apriltags_ros/msg/AprilTagDetectionArray": _from_ros1,
}
