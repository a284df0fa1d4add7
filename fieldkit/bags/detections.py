"""Tags that somebody else's detector found while a bag was recorded: read from topics, without images."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from fieldkit.bags.files import BagFile
from fieldkit.bags.reading import open_source, topic_list
from fieldkit.bags.tag_messages import READERS, Reader, RecordedTag
from fieldkit.errors import BagError


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
    known = {name: READERS[topic.type] for name, topic in bag.topics.items() if topic.type in READERS}
    for topic in topics or ():
        if topic not in known:
            found = f"is of type {bag.topics[topic].type}" if topic in bag.topics else "is not in the bag"
            raise BagError(
                f"{bag.path}: {topic} {found}; expected a topic with one of {', '.join(READERS)}",
                hint=f"the bag has {topic_list(bag)}",
            )
    wanted = tuple(topics) if topics else tuple(known)
    if not wanted:
        raise BagError(
            f"{bag.path}: no topic with tag detections; expected one of {', '.join(READERS)}; the bag has "
            f"{topic_list(bag)}",
            hint="record the detector's topic, or record images",
        )
    unknown = {kind: n for kind, n in bag.unknown.items() if kind in READERS}
    if unknown:
        raise BagError(
            f"{bag.path}: the bag does not describe its messages of type {', '.join(unknown)}; expected it to",
            hint="record it with ROS 2 Iron or later, or convert it to MCAP where the package is installed",
        )
    tags, counts, refused = _collect(bag, wanted, known)
    return RecordedTags(tuple(sorted(tags, key=lambda tag: tag.t_ns)), dict(counts), dict(refused))


def _collect(
    bag: BagFile, topics: Sequence[str], known: dict[str, Reader]
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
