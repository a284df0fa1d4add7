"""What an arm camera saw of tags while the robot stood: sightings with the kinematics at any time around them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from fieldkit.bags import ArmRecording, Kinematics
from fieldkit.cameras import Camera
from fieldkit.errors import FrameError, TagError
from fieldkit.frames import Array, Pose, Trajectory, pose_error
from fieldkit.tags import TagDetection, tags_in, with_noise
from fieldkit.types import Frame

Progress = Callable[[str, int, int], None]

# Late stamps are looked for up to here: kinematics must reach as far to either side of an image
REACH_NS = 300_000_000
# A body that moves less than this within that time stands
STILL_M, STILL_RAD = 0.01, math.radians(0.5)
# One stand ends where the body has moved so far from its beginning
STAND_M, STAND_RAD = 0.1, math.radians(5.0)
# Sightings of a tag in one stand: fewer say little beyond where the tag is
MIN_SIGHTINGS = 3
MAX_IMAGES = 300


@dataclasses.dataclass(frozen=True)
class Stand:
    """One tag during one stand of the robot: its pose in the body is an unknown of its own."""

    tag_id: int
    size_m: float
    t_begin_ns: int


@dataclasses.dataclass(frozen=True)
class Sweep:
    """Sightings (n) of tags in stands (g), all by one camera.

    ``t_ns`` stamps, ``stand`` int[n], ``corners_px`` f64[n, 4, 2] and their covariance ``noise_px`` f64[n, 8, 8];
    ``ref_from_body`` is how the body swayed since the stand's begin, by odometry. ``left_out`` says what was not
    used, with counts.
    """

    path: str
    camera: Camera
    kinematics: Kinematics
    stands: tuple[Stand, ...]
    detections: tuple[TagDetection, ...]
    t_ns: NDArray[np.int64]
    stand: NDArray[np.int64]
    ref_from_body: Pose
    n_images: int
    left_out: Mapping[str, int]

    def __len__(self) -> int:
        return len(self.detections)

    @property
    def corners_px(self) -> Array:
        """Corners f64[n, 4, 2] in pixels."""
        return np.stack([d.corners_px for d in self.detections])

    @property
    def noise_px(self) -> Array:
        """Covariance f64[n, 8, 8] of the corners in pixels."""
        return np.stack([d.noise_px for d in self.detections])


def find_sweep(
    recording: ArmRecording,
    sizes_m: Mapping[int | None, float],
    *,
    families: Sequence[str] = ("tag36h11",),
    progress: Progress | None = None,
) -> Sweep:
    """Find tags of known sizes (key None: all others) in the images of a recording while the body stands.

    Where there is no image, detections that were recorded stand in. Without odometry the body is taken to stand.
    Raises TagError when no tag is seen MIN_SIGHTINGS times in one stand.
    """
    frames, left_out = _standing(recording)
    chosen = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, min(len(frames), MAX_IMAGES)).astype(int))]
    wanted = [(tag_id, f) for tag_id in sorted(sizes_m, key=lambda k: (k is None, k)) for f in families]
    found: list[tuple[Frame, TagDetection]] = []
    other, before = 0, set[tuple[int, int, str]]()
    for number, frame in enumerate(chosen):
        if progress is not None:
            progress("find tags", number + 1, len(chosen))
        if frame.camera != chosen[0].camera:
            other += 1
            continue
        # Two detectors may have searched one image
        seen = [d for d in tags_in(frame, wanted) if (frame.t_ns, d.id, d.family) not in before]
        before |= {(frame.t_ns, d.id, d.family) for d in seen}
        found += [(frame, d) for d in seen]
    if other:
        left_out["with another calibration than the first"] = other
    known = with_noise([(d, f.camera, sizes_m[d.id if d.id in sizes_m else None]) for f, d in found])
    found = [(frame, d) for (frame, _), d in zip(found, known, strict=True)]
    return _group(recording, found, sizes_m, len(chosen), left_out)


def _standing(recording: ArmRecording) -> tuple[list[Frame], dict[str, int]]:
    """Return the frames whose kinematics reach far enough and at which the body stands, and what was left out."""
    frames = [f for f in recording.frames if f.tags is None or f.tags]
    stamps = [f.t_ns for f in frames]
    if not stamps:
        raise TagError(
            f"{recording.path}: no image and no detected tag in it; expected images of tags", hint="record the camera"
        )
    reached = np.ones(len(stamps), dtype=bool)
    for shift in (-REACH_NS, 0, REACH_NS):
        reached &= recording.kinematics.links([t + shift for t in stamps])[1]
    kept, moving = [], 0
    for frame, there in zip(frames, reached, strict=True):
        if there and recording.odometry is not None and not _stands(recording.odometry, frame.t_ns):
            moving += 1
        elif there:
            kept.append(frame)
    out = {"without kinematics around them": int((~reached).sum()), "while the body moved": moving}
    return kept, {why: n for why, n in out.items() if n}


def _stands(odometry: Trajectory, t_ns: int) -> bool:
    try:
        before, after = odometry.at(t_ns - REACH_NS), odometry.at(t_ns + REACH_NS)
    except FrameError:
        return False
    distance, angle = pose_error(after, before)
    return distance < STILL_M and angle < STILL_RAD


def _group(
    recording: ArmRecording,
    found: Sequence[tuple[Frame, TagDetection]],
    sizes_m: Mapping[int | None, float],
    n_images: int,
    left_out: dict[str, int],
) -> Sweep:
    """Give every sighting its stand; drop stands with too few sightings."""
    begins = _stand_begins(recording.odometry)
    members: dict[tuple[int, int, str], list[tuple[Frame, TagDetection]]] = {}
    for frame, detection in found:
        number = int(np.searchsorted(begins, frame.t_ns, side="right"))
        members.setdefault((number, detection.id, detection.family), []).append((frame, detection))
    kept = {key: rows for key, rows in members.items() if len(rows) >= MIN_SIGHTINGS}
    few = len(found) - sum(len(rows) for rows in kept.values())
    if few:
        left_out[f"of a tag that one stand shows less than {MIN_SIGHTINGS} times"] = few
    if not kept:
        raise TagError(_nothing(recording, found, sizes_m, n_images, left_out), hint="sweep the arm before one tag")
    rows = [(k, *row) for k, own in enumerate(kept.values()) for row in own]
    stands = tuple(
        Stand(tag_id, sizes_m[tag_id] if tag_id in sizes_m else sizes_m[None], own[0][0].t_ns)
        for (_, tag_id, _), own in kept.items()
    )
    swayed = [_swayed(recording.odometry, stands[k].t_begin_ns, f.t_ns) for k, f, _ in rows]
    return Sweep(
        recording.path,
        rows[0][1].camera,
        recording.kinematics,
        stands,
        tuple(d for _, _, d in rows),
        np.array([f.t_ns for _, f, _ in rows], dtype=np.int64),
        np.array([k for k, _, _ in rows], dtype=np.int64),
        Pose.concatenate(swayed),
        n_images,
        left_out,
    )


def _stand_begins(odometry: Trajectory | None) -> NDArray[np.int64]:
    """Return the times at which the body has left the place where it was: between them it stands, or passes by."""
    if odometry is None:
        return np.zeros(0, dtype=np.int64)
    begins, origin = [], odometry.poses[0]
    for t_ns, odom_from_body in zip(odometry.t_ns, odometry.poses, strict=True):
        distance, angle = pose_error(odom_from_body, origin)
        if distance > STAND_M or angle > STAND_RAD:
            begins.append(int(t_ns))
            origin = odom_from_body
    return np.array(begins, dtype=np.int64)


def _swayed(odometry: Trajectory | None, t_begin_ns: int, t_ns: int) -> Pose:
    return Pose.identity() if odometry is None else odometry.at(t_begin_ns).inv() * odometry.at(t_ns)


def _nothing(
    recording: ArmRecording,
    found: Sequence[tuple[Frame, TagDetection]],
    sizes_m: Mapping[int | None, float],
    n_images: int,
    left_out: Mapping[str, int],
) -> str:
    sizes = ", ".join("every tag" if k is None else f"tag {k}" for k in sizes_m) or "no tag"
    out = "".join(f", {n} images {why}" for why, n in left_out.items())
    return (
        f"{recording.path}: {len(found)} sightings of tags in {n_images} images{out}; expected one tag at least "
        f"{MIN_SIGHTINGS} times while the robot stands (sizes are known of {sizes})"
    )
