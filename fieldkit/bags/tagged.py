"""Frames without an image: what a detector on the robot saw of tags, at the stamps of its messages."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from fieldkit.bags.content import Content, stamp_ns
from fieldkit.bags.files import BagFile
from fieldkit.bags.tag_messages import READERS, RecordedTag
from fieldkit.bags.tf import clean_frame
from fieldkit.cameras import Camera
from fieldkit.errors import BagError, FrameError
from fieldkit.types import Frame, Image, SeenTag

# Detections that needed more corrected bits are too often no tags
MAX_HAMMING = 1
# Corner noise of a message that has a pose only: its own residuals are gone, so they cannot tell
POSE_SIGMA_PX = 0.3


def detection_topics(bag: BagFile) -> list[str]:
    """Return the topics of a bag whose messages are tag detections of a known type."""
    return sorted(name for name, topic in bag.topics.items() if topic.type in READERS and topic.count)


def tag_frames(
    bag: BagFile, content: Content, *, camera_frame: str, body_frame: str
) -> tuple[tuple[Frame, ...], list[str]]:
    """Return a frame per message of tag detections by the arm camera, in the order of stamps, and notes.

    Messages of another camera's frame are left out and counted, for their calibration is not known, and so are tags
    with more than one corrected bit. Where a message has poses alone, their pixels are those of the camera that the
    recording states: it served the detector. ``read()`` of such a frame raises BagError.
    """
    topics = detection_topics(bag)
    if not topics or not content.has_camera:
        return (), []
    own = {camera_frame, *(image.frame for image in content.images if image.frame)}
    found: list[tuple[int, str, list[RecordedTag]]] = []
    foreign: Counter[str] = Counter()
    refused: Counter[str] = Counter()
    for message in bag.messages(topics):
        tags = list(READERS[bag.topics[message.topic].type](message.topic, message.value, refused))
        frame = tags[0].frame if tags else clean_frame(message.value.header.frame_id)
        if (frame or camera_frame) not in own:
            foreign[f"{message.topic} are of frame {frame!r}"] += 1
            continue
        found.append((tags[0].t_ns if tags else stamp_ns(message.value.header), frame or camera_frame, tags))
    notes = [f"{n} detections on {what}, not of the arm camera; left out" for what, n in sorted(foreign.items())]
    notes += [f"tag detections: {n} {what} were skipped" for what, n in sorted(refused.items())]
    found.sort(key=lambda item: item[0])
    frames = []
    for stamp, name, tags in found:
        camera, t_ns = content.camera_at(stamp), stamp - content.late_ns
        reached = content.tf.lookup_all(body_frame, name, t_ns=[t_ns])[0]
        body_from_cam = None if isinstance(reached, FrameError) else reached
        read = functools.partial(_no_image, bag.path, stamp)
        seen = _seen(tags, content.stated_at(stamp) if content.cameras else camera)
        frames.append(Frame(t_ns, camera, body_from_cam, read, seen, content.late_ns))
    return tuple(frames), notes


def _seen(tags: Sequence[RecordedTag], camera: Camera) -> tuple[SeenTag, ...]:
    result = []
    for tag in tags:
        corners = tag.corners(camera)
        if corners is not None and (tag.hamming or 0) <= MAX_HAMMING:
            result.append(SeenTag(tag.id, tag.family, corners, None if tag.corners_px is not None else POSE_SIGMA_PX))
    return tuple(result)


def _no_image(path: Path, t_ns: int) -> Image:
    raise BagError(
        f"{path}: no image at {t_ns} ns, only tag detections; expected an image to localize",
        hint="record the arm camera's images",
    )
