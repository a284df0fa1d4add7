"""TagSLAM's recorded tests as recordings of this toolkit: detections, odometry, cameras and tags, and the reference."""

from __future__ import annotations

import bz2
import dataclasses
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from fieldkit.bags import read_detections
from fieldkit.bags.content import PoseSamples, read_odometry
from fieldkit.bags.files import BagFile
from fieldkit.cameras import Camera
from fieldkit.errors import BagError
from fieldkit.frames import Pose, Trajectory, pose
from fieldkit.odometry import find_faults
from fieldkit.types import Frame, Image, OdometryFault, Recording, SeenTag, TagMap, TagPose

ODOMETRY = {"test_11": "/fla/vio/odom", "test_21": "/vio_node/odom", "test_22": "/camera/odom/sample"}
# What is not known of a tag: TagSLAM hands out no covariance of its map. 1 cm and 0.5 deg per axis
TAG_COVARIANCE = np.diag([np.radians(0.5) ** 2] * 3 + [0.01**2] * 3)


@dataclasses.dataclass(frozen=True)
class TagSlamTest:
    """A test of TagSLAM: frames with detections and no image, odometry, tags, and map_from_body of the reference.

    The body is what odometry is of. ``received_ns`` and ``samples`` are odometry's messages in the order of arrival.
    """

    frames: tuple[Frame, ...]
    odometry: Trajectory
    samples: PoseSamples
    faults: tuple[OdometryFault, ...]
    tags: TagMap
    reference: Trajectory

    def recording(self, name: str = "tagslam") -> Recording:
        """Return a recording without starts and visits."""
        return Recording(
            name, name, "generic", (), self.odometry, (), (), tag_frames=self.frames, odometry_faults=self.faults
        )


def unpack(source: Path, target: Path) -> Path:
    """Unpack a .bz2 file."""
    if not target.exists():
        target.write_bytes(bz2.decompress(source.read_bytes()))
    return target


def load(folder: Path, scratch: Path) -> TagSlamTest:
    """Read one test; ``scratch`` takes the unpacked bags."""
    bag = BagFile(unpack(folder / "tag_detections.bag.bz2", scratch / f"{folder.name}_tags.bag"))
    solved = BagFile(unpack(folder / "reference.bag.bz2", scratch / f"{folder.name}_reference.bag"))
    described = YAML(typ="safe", pure=True)
    settings, cameras = (described.load((folder / name).read_text()) for name in ("tagslam.yaml", "cameras.yaml"))
    rig_from_odom, sizes, default = _described(settings)
    places = _solved(solved)
    samples = read_odometry(bag, ODOMETRY[folder.name])
    odometry = samples.trajectory(parent="odom", child="body")[0]
    odometry = dataclasses.replace(odometry, max_gap_ns=1_100_000_000)
    received = np.array(samples.received, dtype=np.int64)
    stamps = np.array([t for t, _ in samples.samples], dtype=np.int64)
    faults = find_faults(stamps, [p for _, p in samples.samples], received_ns=received)
    tags = tuple(
        TagPose(i, "tag36h11", sizes.get(i, default), places[f"tag_{i}"], TAG_COVARIANCE, 1, 0.0)
        for i in (int(name[4:]) for name in places if name.startswith("tag_"))
    )
    by_topic = {c["tagtopic"]: (_camera(c), rig_from_odom.inv() * places[name]) for name, c in cameras.items()}
    frames = _frames(bag.path, by_topic, ignored=_ignored(settings))
    truth = read_odometry(solved, "/tagslam/odom/body_rig").trajectory(parent="map", child="rig")[0]
    reference = dataclasses.replace(
        truth, poses=tuple(p * rig_from_odom for p in truth.poses), max_gap_ns=2_000_000_000
    )
    return TagSlamTest(frames, odometry, samples, faults, TagMap(tags, (), "tagslam"), reference)


def _frames(path: Path, by_topic: dict[str, tuple[Camera, Pose]], *, ignored: set[int]) -> tuple[Frame, ...]:
    found: dict[tuple[int, str], list[SeenTag]] = defaultdict(list)
    for tag in read_detections(path).tags:
        if tag.id not in ignored and tag.corners_px is not None and (tag.hamming or 0) <= 1:
            found[tag.t_ns, tag.topic].append(SeenTag(tag.id, tag.family, tag.corners_px))
    return tuple(Frame(t_ns, *by_topic[topic], _no_image, tuple(seen)) for (t_ns, topic), seen in sorted(found.items()))


def _described(settings: Any) -> tuple[Pose, dict[int, float], float]:
    rig_from_odom, sizes, default = Pose.identity(), {}, 0.0
    for entry in settings["bodies"]:
        (body,) = entry.values()
        if "T_body_odom" in body:
            rig_from_odom = _pose(body["T_body_odom"])
        default = float(body.get("default_tag_size", default))
        for tag in body.get("tags") or ():
            sizes[int(tag["id"])] = float(tag.get("size", default))
    return rig_from_odom, sizes, default


def _ignored(settings: Any) -> set[int]:
    """Return ids that TagSLAM ignores, or that stand for several tags at different times."""
    ids = {int(i) for entry in settings["bodies"] for body in entry.values() for i in body.get("ignore_tags") or ()}
    return ids | {int(entry["id"]) for entry in settings.get("tag_id_remap") or ()}


def _solved(bag: BagFile) -> dict[str, Pose]:
    """Return the places of tags and cameras, in their parents, of the reference's tf: they never change in it."""
    places = {}
    for stamped in next(bag.messages(["/tf"])).value.transforms:
        p, q = stamped.transform.translation, stamped.transform.rotation
        places[stamped.child_frame_id] = pose((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))
    return places


def _camera(values: Any) -> Camera:
    # OpenCV's principal point: the centre of the first pixel is (0, 0)
    fx, fy, cx, cy = values["intrinsics"]
    k, (width, height) = values["distortion_coeffs"], values["resolution"]
    if values["distortion_model"] == "equidistant":
        return Camera("OPENCV_FISHEYE", width, height, (fx, fy, cx + 0.5, cy + 0.5, *k))
    return Camera("FULL_OPENCV", width, height, (fx, fy, cx + 0.5, cy + 0.5, *k[:4], k[4], 0.0, 0.0, 0.0))


def _pose(values: Any) -> Pose:
    position, rotation = ([values[k][axis] for axis in "xyz"] for k in ("position", "rotation"))
    return Pose.from_components(position, Rotation.from_rotvec(rotation))


def _no_image() -> Image:
    raise BagError("no image, only tag detections; expected none to be read")
