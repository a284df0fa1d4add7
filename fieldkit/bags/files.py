"""Open a bag of any format, whatever wrote it, and hand out decoded messages."""

from __future__ import annotations

import dataclasses
import weakref
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, TypeVar

import zstandard
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from fieldkit.errors import BagError

T = TypeVar("T")
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_IDL_SEPARATOR = "=" * 80 + "\nIDL: "
_APRILTAG_MSGS = {
    "apriltag_msgs/msg/Point": "float64 x\nfloat64 y",
    "apriltag_msgs/msg/AprilTagDetection": (
        "string family\nint32 id\nint32 hamming\nfloat32 goodness\nfloat32 decision_margin\n"
        "apriltag_msgs/Point centre\napriltag_msgs/Point[4] corners\nfloat64[9] homography"
    ),
    "apriltag_msgs/msg/AprilTagDetectionArray": "std_msgs/Header header\napriltag_msgs/AprilTagDetection[] detections",
}
EXPECTED = "expected a .bag, a .mcap, a ROS 2 folder with metadata.yaml, or a folder with session.toml"


def ros1_types() -> Typestore:
    """Return the standard messages of ROS 1, with tf2_msgs, which the library's own collection lacks."""
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    return store


def ros2_types() -> Typestore:
    """Return the standard messages of ROS 2, with apriltag_msgs: before Iron no bag described its own messages."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for kind, definition in _APRILTAG_MSGS.items():
        store.register(get_types_from_msg(definition, kind))
    return store


@dataclasses.dataclass(frozen=True)
class Topic:
    """One topic of a bag: message type as ``package/msg/Name``, and how many messages there are."""

    type: str
    count: int


@dataclasses.dataclass(frozen=True)
class Place:
    """Where a message is found again: its connection, its time in the bag, and its rank among equal times."""

    connection: int
    log_ns: int
    rank: int


@dataclasses.dataclass(frozen=True)
class Message:
    """A decoded message with its topic and place."""

    topic: str
    place: Place
    value: Any


class BagFile:
    """An open bag: what it holds, one pass over decoded messages, and single messages on demand.

    ``unknown`` counts the messages of each type that cannot be decoded; they are left out of every pass.
    A copy in another process opens the file again. Raises BagError for a file that is missing or damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        _check_path(path)
        self.format = {".bag": "ros1", ".mcap": "mcap"}.get("" if path.is_dir() else path.suffix, "ros2")
        self._reader = self._guard(self._open_reader)
        self._finalizer = weakref.finalize(self, self._reader.close)
        self._connections: list[Connection] = list(self._reader.connections)
        self._stores: dict[int, Typestore] = {}
        self.unknown: Counter[str] = Counter()
        self._find_types()
        self.topics = {
            name: Topic(info.msgtype or "several types", info.msgcount) for name, info in self._reader.topics.items()
        }
        self.n_messages = sum(t.count for t in self.topics.values())
        # The library's end is one past the last message, and without messages it is before the start
        self.duration_ns = self._reader.end_time - 1 - self._reader.start_time if self.n_messages else 0

    def __reduce__(self) -> tuple[type[BagFile], tuple[Path]]:
        return BagFile, (self.path,)

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Yield the decodable messages of some topics in the order of their times in the bag."""
        wanted = [c for c in self._connections if c.topic in topics and id(c) in self._stores]
        ranks: dict[int, tuple[int, int]] = {}
        numbers = {id(c): number for number, c in enumerate(self._connections)}
        if not wanted:
            return
        stream = self._reader.messages(connections=wanted)
        while (item := self._guard(lambda: next(stream, None))) is not None:
            connection, log_ns, raw = item
            number = numbers[id(connection)]
            before_ns, rank = ranks.get(number, (-1, 0))
            rank = rank + 1 if before_ns == log_ns else 0
            ranks[number] = (log_ns, rank)
            yield Message(connection.topic, Place(number, log_ns, rank), self._decode(connection, raw))

    def message(self, place: Place) -> Any:
        """Return the decoded message at a place."""
        connection = self._connections[place.connection]
        stream = self._reader.messages(connections=[connection], start=place.log_ns, stop=place.log_ns + 1)
        for rank, (_, _, raw) in enumerate(self._guard(lambda: list(stream))):
            if rank == place.rank:
                return self._decode(connection, raw)
        raise BagError(f"{self.path}: the message at {place.log_ns} ns of {connection.topic} is gone")

    def _open_reader(self) -> Any:
        for database in [self.path] if self.path.suffix == ".db3" else sorted(self.path.glob("*.db3")):
            _check_sqlite(database)
        reader = rosbag1.Reader(self.path) if self.format == "ros1" else rosbag2.Reader(self.path)
        reader.open()
        return reader

    def _guard(self, call: Callable[[], T]) -> T:
        # A damaged file makes the decoders fail with whatever they meet, a MemoryError for an absurd length among them
        try:
            return call()
        except PermissionError as error:
            raise BagError(
                f"{self.path}: cannot be read; expected permission", hint="check the file's owner"
            ) from error
        except Exception as error:
            reason = str(error) or type(error).__name__
            raise BagError(
                f"{self.path}: damaged or cut off ({reason}); expected a complete {_NAMES[self.format]}",
                hint=_REPAIRS[self.format],
            ) from error

    def _decode(self, connection: Connection, raw: Any) -> Any:
        store = self._stores[id(connection)]
        if self.format == "ros1":
            return self._guard(lambda: store.deserialize_ros1(raw, connection.msgtype))
        # A single file of a bag recorded with message compression does not say so; CDR never starts like this
        data = zstandard.decompress(raw) if bytes(raw[:4]) == _ZSTD_MAGIC else raw
        return self._guard(lambda: store.deserialize_cdr(data, connection.msgtype))

    def _find_types(self) -> None:
        own = get_typestore(Stores.EMPTY)
        standard: Typestore | None = None
        known: dict[str, Typestore | None] = {}
        for connection in self._connections:
            kind = connection.msgtype
            if kind not in known:
                known[kind] = own if _register(own, connection) else None
                if known[kind] is None and not connection.msgdef.data.strip():
                    standard = standard or (ros1_types() if self.format == "ros1" else ros2_types())
                    known[kind] = standard if kind in standard.fielddefs else None
            store = known[kind]
            if store is not None:
                self._stores[id(connection)] = store
            else:
                self.unknown[kind] += connection.msgcount


_NAMES = {"ros1": "ROS 1 bag", "ros2": "ROS 2 bag", "mcap": "MCAP file of ROS 2 messages"}
_REPAIRS = {
    "ros1": "copy it again, or run `rosbag reindex` on a copy",
    "ros2": "copy it again, or run `ros2 bag reindex` on a copy",
    "mcap": "copy it again, or run `mcap recover`",
}


def _check_path(path: Path) -> None:
    if not path.exists():
        raise BagError(f"{path}: no such file or folder; {EXPECTED}", hint="check the path")
    if path.is_dir():
        if not (path / "metadata.yaml").is_file():
            raise BagError(
                f"{path}: folder without metadata.yaml or session.toml; {EXPECTED}",
                hint="name the bag inside it, or run `ros2 bag reindex`",
            )
        return
    if path.suffix not in (".bag", ".mcap", ".db3"):
        raise BagError(f"{path}: unknown kind of file {path.suffix!r}; {EXPECTED}", hint="name a recording")
    if path.stat().st_size == 0:
        raise BagError(f"{path}: the file is empty (0 bytes); expected a recording", hint="copy or record it again")


def _check_sqlite(path: Path) -> None:
    """Raise ValueError where a file is shorter than its header says; SQLite would fill up the last page with zeros."""
    with path.open("rb") as stream:
        header = stream.read(100)
    page = int.from_bytes(header[16:18], "big")
    expected = int.from_bytes(header[28:32], "big") * (65536 if page == 1 else page)
    if len(header) < 100 or path.stat().st_size < expected:
        raise ValueError(f"{path.name} has {path.stat().st_size} of {expected} bytes")


def _register(store: Typestore, connection: Connection) -> bool:
    """Add a connection's own definition to a store; False where it has none that can be used."""
    text = connection.msgdef.data
    if connection.msgdef.format == MessageDefinitionFormat.NONE or not text.strip():
        return False
    try:
        if connection.msgdef.format == MessageDefinitionFormat.MSG:
            store.register(get_types_from_msg(text, connection.msgtype))
        elif text.startswith(_IDL_SEPARATOR):
            for part in text.split(_IDL_SEPARATOR)[1:]:
                store.register(get_types_from_idl(part.split("\n", 1)[1]))
        else:
            store.register(get_types_from_idl(text))
    except Exception:  # a definition that the parser cannot read makes its messages unknown, not the bag unreadable
        return False
    return connection.msgtype in store.fielddefs
