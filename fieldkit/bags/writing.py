"""Write recordings that other tools read too: MCAP, ROS 1 bag and ROS 2 sqlite3, standard messages only."""

from __future__ import annotations

import dataclasses
import json
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Protocol, Self, get_args

import numpy as np
from mcap.writer import Writer as McapFile
from numpy.typing import ArrayLike
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Connection, Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2.metadata import dump_qos_v8
from rosbags.typesys.store import Typestore

from fieldkit.bags.files import ros1_types, ros2_types
from fieldkit.bags.layouts import Layout, find_layout, fit_layout
from fieldkit.cameras import Camera, camera_info_fields
from fieldkit.errors import BagError, suggestion
from fieldkit.frames import Pose, position_quaternion
from fieldkit.types import Image

BagFormat = Literal["mcap", "ros1", "ros2"]

_NO_TIME = QosTime(0, 0)
# The profile that tf2 offers for static transforms: a player must hand them to late subscribers
_LATCHED = Qos(
    QosHistory.KEEP_LAST,
    1,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    _NO_TIME,
    _NO_TIME,
    QosLiveliness.AUTOMATIC,
    _NO_TIME,
    False,
)


class _Container(Protocol):
    """A bag file that is being written: topics are added on first use, messages are serialized inside."""

    store: Typestore

    def write(self, topic: str, message: Any, t_ns: int) -> None: ...

    def close(self) -> None: ...

    def abort(self) -> None: ...


class _Ros1Bag:
    def __init__(self, path: Path, latched: frozenset[str]) -> None:
        self.store = ros1_types()
        self._latched = latched
        self._topics: dict[str, Connection] = {}
        self._writer = rosbag1.Writer(path)
        self._writer.open()

    def write(self, topic: str, message: Any, t_ns: int) -> None:
        kind = message.__msgtype__
        if topic not in self._topics:
            latching = 1 if topic in self._latched else None
            self._topics[topic] = self._writer.add_connection(topic, kind, typestore=self.store, latching=latching)
        self._writer.write(self._topics[topic], t_ns, self.store.serialize_ros1(message, kind))

    def close(self) -> None:
        self._writer.close()

    def abort(self) -> None:
        if self._writer.bio is not None:
            self._writer.bio.close()


class _Ros2Bag:
    def __init__(self, path: Path, latched: frozenset[str]) -> None:
        self.store = ros2_types()
        self._latched = latched
        self._topics: dict[str, Connection] = {}
        # Version 8 is what ROS 2 Iron writes; it and every later release read it
        self._writer = rosbag2.Writer(path, version=8)
        self._writer.open()

    def write(self, topic: str, message: Any, t_ns: int) -> None:
        kind = message.__msgtype__
        if topic not in self._topics:
            qos = (_LATCHED,) if topic in self._latched else ()
            connection = self._writer.add_connection(topic, kind, typestore=self.store, offered_qos_profiles=qos)
            self._topics[topic] = connection
        self._writer.write(self._topics[topic], t_ns, self.store.serialize_cdr(message, kind))

    def close(self) -> None:
        self._writer.close()

    def abort(self) -> None:
        self._writer.abort()


class _McapBag:
    def __init__(self, path: Path, latched: frozenset[str]) -> None:
        self.store = ros2_types()
        self._latched = latched
        self._topics: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._counts: dict[str, int] = {}
        self._stream = path.open("xb")
        self._writer = McapFile(self._stream)
        self._writer.start(profile="ros2", library="fieldkit")
        # By this record rosbag2 knows that the profiles of the topics are in the notation before version 9
        self._writer.add_metadata("rosbag2", {"serialized_metadata": ""})

    def write(self, topic: str, message: Any, t_ns: int) -> None:
        kind = message.__msgtype__
        if topic not in self._topics:
            if kind not in self._schemas:
                definition, _ = self.store.generate_msgdef(kind, ros_version=2)
                self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", definition.encode())
            metadata = {"offered_qos_profiles": dump_qos_v8([_LATCHED] if topic in self._latched else [])}
            self._topics[topic] = self._writer.register_channel(topic, "cdr", self._schemas[kind], metadata)
        data = bytes(self.store.serialize_cdr(message, kind))
        count = self._counts[topic] = self._counts.get(topic, 0) + 1
        self._writer.add_message(self._topics[topic], t_ns, data, t_ns, count)

    def close(self) -> None:
        self._writer.finish()
        self._stream.close()

    def abort(self) -> None:
        self._stream.close()


_CONTAINERS: dict[BagFormat, Callable[[Path, frozenset[str]], _Container]] = {
    "mcap": _McapBag,
    "ros1": _Ros1Bag,
    "ros2": _Ros2Bag,
}


@dataclasses.dataclass(frozen=True)
class _Open:
    container: _Container
    folder: Path
    path: Path


class RecordingWriter:
    """Write a recording inside a ``with`` block; the same calls give the same content in every format.

    ``path`` is a file (mcap, ros1) or a folder (ros2) that must not exist. It appears when the block ends without
    an exception; otherwise nothing is left. Every message's time in the bag is its header stamp, int64 ns.
    Raises BagError when the path exists, the format or layout is unknown, or nothing was written.
    """

    def __init__(self, path: Path | str, *, format: BagFormat, layout: str | Layout = "generic") -> None:
        if format not in _CONTAINERS:
            raise BagError(f"{path}: unknown format {format!r}", hint=suggestion(format, list(get_args(BagFormat))))
        self.path = Path(path)
        self.format = format
        self.layout = fit_layout(find_layout(layout) if isinstance(layout, str) else layout, ())
        self._open: _Open | None = None
        self._static: list[tuple[str, str, Pose]] = []
        self._last_ns: int | None = None

    def __enter__(self) -> Self:
        if self.path.exists():
            raise BagError(f"{self.path}: exists already; expected a new path", hint="remove it or write elsewhere")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        # Written under its own name inside a hidden folder, because a ROS 2 bag repeats its name inside
        folder = Path(tempfile.mkdtemp(prefix=f".{self.path.name}.", dir=self.path.parent))
        inside = folder / self.path.name
        self._open = _Open(_CONTAINERS[self.format](inside, frozenset({self.layout.tf_static})), folder, inside)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        opened, self._open = self._written(), None
        try:
            if kind is not None:
                opened.container.abort()
                return
            if self._last_ns is None:
                opened.container.abort()
                raise BagError(f"{self.path}: nothing was written; expected at least one message")
            opened.container.close()
            opened.path.rename(self.path)
        finally:
            shutil.rmtree(opened.folder, ignore_errors=True)

    def image(self, t_ns: int, jpeg: bytes) -> None:
        """Write a compressed image (JPEG or PNG bytes) of the arm camera as sensor_msgs/CompressedImage."""
        kind = "png" if jpeg[:4] == b"\x89PNG" else "jpeg"
        message = self._make(
            "sensor_msgs/msg/CompressedImage",
            header=self._header(t_ns, self.layout.camera_frame),
            format=kind,
            data=np.frombuffer(jpeg, dtype=np.uint8),
        )
        self._write(self.layout.compressed, message, t_ns)

    def image_raw(self, t_ns: int, image: Image, *, encoding: str | None = None) -> None:
        """Write an uncompressed image of the arm camera, uint8[h, w] or [h, w, c], as sensor_msgs/Image.

        Without ``encoding`` it is mono8 or rgb8; with it, the array is written as it is under that name.
        """
        pixels = np.ascontiguousarray(image)
        height, width = pixels.shape[:2]
        message = self._make(
            "sensor_msgs/msg/Image",
            header=self._header(t_ns, self.layout.camera_frame),
            height=height,
            width=width,
            encoding=encoding or ("mono8" if pixels.ndim == 2 else "rgb8"),
            is_bigendian=0,
            step=pixels.nbytes // height,
            data=pixels.view(np.uint8).ravel(),
        )
        self._write(self.layout.image, message, t_ns)

    def camera_info(self, t_ns: int, camera: Camera) -> None:
        """Write the arm camera's calibration; pixels go half a pixel down to ROS' convention."""
        self._calibration(self.layout.camera_info, self.layout.camera_frame, t_ns, camera)

    def depth(self, t_ns: int, png: bytes) -> None:
        """Write a depth image (16-bit PNG, mm, 0 where there is none) as sensor_msgs/CompressedImage.

        It is what image_transport's plugin ``compressed`` makes of a 16UC1 image.
        """
        message = self._make(
            "sensor_msgs/msg/CompressedImage",
            header=self._header(t_ns, self.layout.depth_frame),
            format="16UC1; png compressed",
            data=np.frombuffer(png, dtype=np.uint8),
        )
        self._write(self.layout.depth_compressed, message, t_ns)

    def depth_info(self, t_ns: int, camera: Camera) -> None:
        """Write the depth camera's calibration, like `camera_info`."""
        self._calibration(self.layout.depth_info, self.layout.depth_frame, t_ns, camera)

    def odometry(self, t_ns: int, odom_from_body: Pose, twist: ArrayLike | None = None) -> None:
        """Write the robot's odometry; ``twist`` (6,) is linear (m/s), then angular (rad/s) velocity in the body."""
        speed = np.zeros(6) if twist is None else np.asarray(twist, dtype=np.float64)
        velocity = self._make(
            "geometry_msgs/msg/Twist", linear=self._vector(speed[:3]), angular=self._vector(speed[3:])
        )
        unknown = np.zeros(36)
        message = self._make(
            "nav_msgs/msg/Odometry",
            header=self._header(t_ns, self.layout.odom_frame),
            child_frame_id=self.layout.body_frame,
            pose=self._make(
                "geometry_msgs/msg/PoseWithCovariance", pose=self._pose(odom_from_body), covariance=unknown
            ),
            twist=self._make("geometry_msgs/msg/TwistWithCovariance", twist=velocity, covariance=unknown),
        )
        self._write(self.layout.odometry, message, t_ns)

    def tf(self, t_ns: int, transforms: Sequence[tuple[str, str, Pose]]) -> None:
        """Write moving transforms (parent, child, parent_from_child) at one stamp."""
        self._write(self.layout.tf, self._transforms(t_ns, transforms), t_ns)

    def tf_static(self, transforms: Sequence[tuple[str, str, Pose]]) -> None:
        """Write transforms (parent, child, parent_from_child) that never change.

        They get the time of the last message before them, or that of the first one after them.
        """
        if self._last_ns is None:
            self._static += list(transforms)
            return
        self._write(self.layout.tf_static, self._transforms(self._last_ns, transforms), self._last_ns)

    def event(self, t_ns: int, event: Mapping[str, Any]) -> None:
        """Write an event, e.g. {"event": "visit_begin", "visit": "w01"}; ``v`` and ``t_ns`` are filled in.

        A view's own ``t_ns`` (the stamp of its image) stays as it is given.
        """
        text = json.dumps({"v": 1, "t_ns": t_ns, **event}, allow_nan=False)
        self._write(self.layout.events, self._make("std_msgs/msg/String", data=text), t_ns)

    def reference(self, t_ns: int, map_from_body: Pose) -> None:
        """Write the body's pose in the map from another source, for use as truth."""
        message = self._make(
            "geometry_msgs/msg/PoseStamped", header=self._header(t_ns, "map"), pose=self._pose(map_from_body)
        )
        self._write(self.layout.reference, message, t_ns)

    def joint_states(self, t_ns: int, positions_rad: Mapping[str, float]) -> None:
        """Write joint angles in rad by joint name."""
        message = self._make(
            "sensor_msgs/msg/JointState",
            header=self._header(t_ns, ""),
            name=list(positions_rad),
            position=np.array(list(positions_rad.values()), dtype=np.float64),
            velocity=np.zeros(0),
            effort=np.zeros(0),
        )
        self._write(self.layout.joint_states, message, t_ns)

    def _calibration(self, topic: str, frame: str, t_ns: int, camera: Camera) -> None:
        k, d, model = camera_info_fields(camera)
        p = [k[0], k[1], k[2], 0.0, k[3], k[4], k[5], 0.0, k[6], k[7], k[8], 0.0]
        matrices: dict[str, Any] = {"d": d, "k": k, "r": np.eye(3).ravel(), "p": p}
        if self.format == "ros1":
            matrices = {key.upper(): value for key, value in matrices.items()}
        region = self._make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        message = self._make(
            "sensor_msgs/msg/CameraInfo",
            header=self._header(t_ns, frame),
            height=camera.height,
            width=camera.width,
            distortion_model=model,
            **{key: np.asarray(value, dtype=np.float64) for key, value in matrices.items()},
            binning_x=0,
            binning_y=0,
            roi=region,
        )
        self._write(topic, message, t_ns)

    def _written(self) -> _Open:
        if self._open is None:
            raise BagError(f"{self.path}: the writer is not open; expected to be used inside a with block")
        return self._open

    def _write(self, topic: str, message: Any, t_ns: int) -> None:
        opened, self._last_ns = self._written(), int(t_ns)
        if self._static:
            static, self._static = self._static, []
            opened.container.write(self.layout.tf_static, self._transforms(t_ns, static), int(t_ns))
        opened.container.write(topic, message, int(t_ns))

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._written().container.store.types[kind](**fields)

    def _header(self, t_ns: int, frame: str) -> Any:
        seconds, nanoseconds = divmod(int(t_ns), 1_000_000_000)
        stamp = self._make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        extra = {"seq": 0} if self.format == "ros1" else {}
        return self._make("std_msgs/msg/Header", **extra, stamp=stamp, frame_id=frame)

    def _vector(self, xyz: ArrayLike, *, kind: str = "Vector3") -> Any:
        x, y, z = (float(v) for v in np.asarray(xyz))
        return self._make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)

    def _quaternion(self, xyzw: Sequence[float]) -> Any:
        x, y, z, w = xyzw
        return self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _pose(self, a_from_b: Pose) -> Any:
        xyz, quaternion = position_quaternion(a_from_b)
        return self._make(
            "geometry_msgs/msg/Pose",
            position=self._vector(xyz, kind="Point"),
            orientation=self._quaternion(quaternion),
        )

    def _transforms(self, t_ns: int, transforms: Sequence[tuple[str, str, Pose]]) -> Any:
        stamped = []
        for parent, child, parent_from_child in transforms:
            xyz, quaternion = position_quaternion(parent_from_child)
            transform = self._make(
                "geometry_msgs/msg/Transform", translation=self._vector(xyz), rotation=self._quaternion(quaternion)
            )
            header = self._header(t_ns, parent)
            stamped.append(
                self._make(
                    "geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=transform
                )
            )
        return self._make("tf2_msgs/msg/TFMessage", transforms=stamped)
