"""One pass over a bag: everything small is kept, of images only where they are."""

from __future__ import annotations

import bisect
import dataclasses
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from fieldkit.bags.files import BagFile, Place
from fieldkit.bags.layouts import Layout
from fieldkit.bags.tf import TfBuffer, clean_frame
from fieldkit.cameras import Camera, camera_from_info
from fieldkit.errors import BagError, FieldkitError, FrameError
from fieldkit.frames import Array, Pose, Trajectory, pose

# Message types that may stand on the topics of a layout
_IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_REFERENCE_TYPES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "nav_msgs/msg/Odometry",
)
# Share of the largest number by which a covariance may be asymmetric: rounded to single precision
ASYMMETRY = 1e-5
_TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")


@dataclasses.dataclass(frozen=True)
class ImagePlace:
    """An image that was seen in passing: header stamp, frame, size where the message tells it, and its place."""

    t_ns: int
    frame: str
    size: tuple[int, int] | None
    place: Place


@dataclasses.dataclass
class PoseSamples:
    """Stamped poses in the order of arrival, with the frames that their messages name.

    ``received`` are the times of arrival, ``covariances`` (6x6, right perturbation) what the messages state, or None
    where they state none or, as ``refused`` says, one that cannot be.
    """

    samples: list[tuple[int, Pose]] = dataclasses.field(default_factory=list)
    parent: str = ""
    child: str = ""
    received: list[int] = dataclasses.field(default_factory=list)
    covariances: list[Array | None] = dataclasses.field(default_factory=list)
    refused: Counter[str] = dataclasses.field(default_factory=Counter)

    def trajectory(self, *, parent: str, child: str) -> tuple[Trajectory, int]:
        """Return the trajectory, and how many samples it left out because their stamp repeats an earlier one."""
        kept = self._kept()
        stamps = np.array([self.samples[i][0] for i in kept], dtype=np.int64)
        poses = tuple(self.samples[i][1] for i in kept)
        return Trajectory(stamps, poses, self.parent or parent, self.child or child), len(self.samples) - len(kept)

    def covariance(self) -> Array | None:
        """Return the covariances f64[n, 6, 6] of the trajectory's samples; None where no sample states a usable one.

        A sample without one has that of the nearest in time that states one.
        """
        kept = self._kept()
        stated = [(self.samples[i][0], c) for i in kept if (c := self.covariances[i]) is not None]
        if not stated:
            return None
        stamps = np.array([t for t, _ in stated], dtype=np.int64)
        nearest = [int(np.argmin(np.abs(stamps - self.samples[i][0]))) for i in kept]
        return np.stack([stated[k][1] for k in nearest])

    def _kept(self) -> list[int]:
        order = sorted(range(len(self.samples)), key=lambda i: self.samples[i][0])
        return [i for k, i in enumerate(order) if k == 0 or self.samples[i][0] != self.samples[order[k - 1]][0]]


@dataclasses.dataclass
class Content:
    """What one pass over a bag found on the topics of a layout.

    ``corrected`` takes the place of the stated ``cameras``; the images' stamps are known to be late by ``late_ns``.
    """

    image_topic: str
    images: list[ImagePlace] = dataclasses.field(default_factory=list)
    cameras: list[tuple[int, Camera]] = dataclasses.field(default_factory=list)
    odometry: PoseSamples = dataclasses.field(default_factory=PoseSamples)
    reference: PoseSamples = dataclasses.field(default_factory=PoseSamples)
    tf: TfBuffer = dataclasses.field(default_factory=TfBuffer)
    events: list[tuple[int, str]] = dataclasses.field(default_factory=list)
    joints: list[tuple[int, dict[str, float]]] = dataclasses.field(default_factory=list)
    refused: Counter[str] = dataclasses.field(default_factory=Counter)
    last_ns: int = 0
    camera_error: BagError | None = None
    corrected: Camera | None = None
    late_ns: int = 0

    @property
    def has_camera(self) -> bool:
        """Whether anything says how the camera is calibrated."""
        return bool(self.cameras) or self.corrected is not None

    def camera_at(self, stamp_ns: int) -> Camera:
        """Return the calibration of the image with a stamp: the corrected one, else the one that is stated."""
        return self.stated_at(stamp_ns) if self.corrected is None else self.corrected

    def stated_at(self, t_ns: int) -> Camera:
        """Return the stated calibration whose stamp is nearest; the later one when two are equally near."""
        right = bisect.bisect_left(self.cameras, t_ns, key=lambda item: item[0])
        near = self.cameras[max(right - 1, 0) : right + 1]
        return min(reversed(near), key=lambda item: abs(item[0] - t_ns))[1]


def stamp_ns(header: Any) -> int:
    """Return a message header's stamp in ns."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def image_topic(bag: BagFile, layout: Layout) -> str:
    """Return the topic with most images; the uncompressed one when both have as many."""
    counts = {t: bag.topics[t].count if t in bag.topics else 0 for t in (layout.image, layout.compressed)}
    return max(counts, key=lambda t: counts[t])


def collect(bag: BagFile, layout: Layout) -> Content:
    """Read everything on a layout's topics once. Raises BagError for a damaged bag.

    A CameraInfo that cannot be used is kept as ``camera_error``: whoever needs cameras raises it.
    """
    content = Content(image_topic(bag, layout))
    cache: dict[tuple[Any, ...], Camera] = {}
    topics = {content.image_topic, layout.camera_info, layout.odometry, layout.tf, layout.tf_static}
    topics |= {layout.events, layout.reference, layout.joint_states}
    for message in bag.messages(topics):
        value, kind = message.value, message.value.__msgtype__
        content.last_ns = max(content.last_ns, message.place.log_ns)
        if message.topic == content.image_topic and kind in (
            "sensor_msgs/msg/Image",
            "sensor_msgs/msg/CompressedImage",
        ):
            size = (int(value.width), int(value.height)) if hasattr(value, "width") else None
            content.images.append(
                ImagePlace(stamp_ns(value.header), clean_frame(value.header.frame_id), size, message.place)
            )
        elif message.topic == layout.camera_info and kind == "sensor_msgs/msg/CameraInfo":
            try:
                content.cameras.append((stamp_ns(value.header), _camera(bag, layout.camera_info, value, cache)))
            except BagError as error:
                content.camera_error = content.camera_error or error
        elif message.topic == layout.odometry and kind == "nav_msgs/msg/Odometry":
            add_pose(content.refused, content.odometry, value, value.pose.pose, received_ns=message.place.log_ns)
        elif message.topic == layout.reference and kind in _REFERENCE_TYPES:
            inner = value.pose if kind == _REFERENCE_TYPES[0] else value.pose.pose
            add_pose(content.refused, content.reference, value, inner, received_ns=message.place.log_ns)
        elif message.topic in (layout.tf, layout.tf_static) and kind in _TF_TYPES:
            _add_transforms(content, value.transforms, static=message.topic == layout.tf_static)
        elif message.topic == layout.events and kind == "std_msgs/msg/String":
            content.events.append((message.place.log_ns, value.data))
        elif message.topic == layout.joint_states and kind == "sensor_msgs/msg/JointState":
            angles = dict(zip(value.name, (float(v) for v in value.position), strict=False))
            content.joints.append((stamp_ns(value.header), angles))
        else:
            content.refused[f"messages of type {kind} on {message.topic}"] += 1
    content.images.sort(key=lambda image: image.t_ns)
    content.cameras.sort(key=lambda item: item[0])
    return content


def _camera(bag: BagFile, topic: str, info: Any, cache: dict[tuple[Any, ...], Camera]) -> Camera:
    # ROS 1 spells the matrices in capitals
    k, d = (getattr(info, name, None) for name in ("k", "d"))
    k, d = (info.K if k is None else k), (info.D if d is None else d)
    key = (info.width, info.height, tuple(k), tuple(d), info.distortion_model)
    if key not in cache:
        try:
            cache[key] = camera_from_info(
                int(info.width), int(info.height), k, list(d), distortion_model=info.distortion_model
            )
        except FieldkitError as error:
            hint = (
                error.hint
                or "calibrate the camera and give its camera.toml (--camera), or correct the driver's CameraInfo"
            )
            raise BagError(f"{bag.path}: {topic}: {error.message}", hint=hint) from error
    return cache[key]


def read_odometry(bag: BagFile, topic: str) -> PoseSamples:
    """Read the poses of a nav_msgs/Odometry topic that no layout names."""
    samples, refused = PoseSamples(), Counter[str]()
    for message in bag.messages([topic]):
        add_pose(refused, samples, message.value, message.value.pose.pose, received_ns=message.place.log_ns)
    return samples


def add_pose(refused: Counter[str], samples: PoseSamples, message: Any, value: Any, *, received_ns: int) -> None:
    """Add a stamped pose with the covariance that its message states; count it where its numbers are impossible."""
    p, q = value.position, value.orientation
    try:
        sample = pose((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))
    except FieldkitError:
        refused["poses with impossible numbers"] += 1
        return
    samples.samples.append((stamp_ns(message.header), sample))
    samples.received.append(received_ns)
    try:
        samples.covariances.append(_stated_covariance(message, sample))
    except BagError as error:
        samples.covariances.append(None)
        samples.refused[error.message] += 1
    samples.parent = samples.parent or clean_frame(message.header.frame_id)
    samples.child = samples.child or clean_frame(getattr(message, "child_frame_id", ""))


def _stated_covariance(message: Any, parent_from_child: Pose) -> Array | None:
    """Return the 6x6 covariance (right perturbation, rotation first) that a message states; None where it is unknown.

    ROS gives position, then rotation about the parent's fixed axes. Zeros, and -1 in the first place, say unknown.
    Raises BagError for numbers that are no covariance of a pose.
    """
    values = getattr(message.pose, "covariance", None)
    if values is None:
        return None
    matrix = np.asarray(values, dtype=np.float64).reshape(6, 6)
    if matrix[0, 0] == -1 or not matrix.any():
        return None
    fixed = np.block([[matrix[3:, 3:], matrix[3:, :3]], [matrix[:3, 3:], matrix[:3, :3]]])
    if not np.isfinite(fixed).all():
        raise BagError("not finite")
    if float(np.abs(fixed - fixed.T).max()) > ASYMMETRY * float(np.abs(fixed).max()):
        raise BagError("not symmetric")
    if not (np.linalg.eigvalsh((fixed + fixed.T) / 2) > 0).all():
        raise BagError("not positive definite")
    turn = np.kron(np.eye(2), parent_from_child.rotation.as_matrix().T)
    result: Array = turn @ (fixed + fixed.T) / 2 @ turn.T
    return result


def _add_transforms(content: Content, transforms: Iterable[Any], *, static: bool) -> None:
    for stamped in transforms:
        p, q = stamped.transform.translation, stamped.transform.rotation
        parent, child = stamped.header.frame_id, stamped.child_frame_id
        xyz, quaternion = (p.x, p.y, p.z), (q.x, q.y, q.z, q.w)
        try:
            if static:
                content.tf.add_static(parent, child, xyz, quaternion)
            else:
                t_ns = stamp_ns(stamped.header)
                content.tf.add(parent, child, t_ns, position_m=xyz, quaternion_xyzw=quaternion)
        except FieldkitError:
            content.refused["transforms with impossible numbers"] += 1


def arm_chain(path: Path, content: Content, *, body: str, camera: str) -> tuple[int, tuple[tuple[str, str, bool], ...]]:
    """Return a time in ns within the images, and the steps of tf from body to camera then; see `TfBuffer.chain`.

    Raises BagError where they are not connected.
    """
    t_ns = content.images[len(content.images) // 2].t_ns if content.images else content.last_ns
    try:
        return t_ns, content.tf.chain(body, camera, t_ns=t_ns)
    except FrameError as error:
        raise BagError(
            f"{path}: {error.message}; expected the arm's transforms from {body!r} to {camera!r} on tf",
            hint="record /tf and /tf_static together with the images",
        ) from error
