"""What a user brings: cameras, rigs, photo lists, session files, and poses as TUM text."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from fieldkit.cameras import Camera
from fieldkit.errors import FieldkitError, StoreError
from fieldkit.frames import Array, Pose, pose, position_quaternion
from fieldkit.store.files import atomic_write, read_text, read_toml, write_toml
from fieldkit.store.kalibr import SUFFIXES as KALIBR_SUFFIXES
from fieldkit.store.kalibr import read_kalibr
from fieldkit.types import ViewKind

Size = Annotated[int, msgspec.Meta(gt=0)]
# Stamps that are later than this are no latency but another clock, or a number in ms
MAX_LATENCY_S = 1.0


class _CameraFile(msgspec.Struct, forbid_unknown_fields=True):
    version: Literal[1]
    model: str
    width: Size
    height: Size
    params: list[float]
    rms_px: float | None = None


def read_camera(path: Path) -> Camera:
    """Read camera.toml: COLMAP model name, size in pixels, params in COLMAP's order; or Kalibr's file of one camera."""
    if Path(path).suffix in KALIBR_SUFFIXES:
        cameras = read_kalibr(path)
        if len(cameras) > 1:
            raise StoreError(
                f"{path}: has {len(cameras)} cameras; expected one", hint="keep the entry of this camera, as cam0"
            )
        return cameras[0].camera
    data = read_toml(path, _CameraFile, what="camera.toml with version, model, width, height, params")
    try:
        return Camera(data.model, data.width, data.height, tuple(data.params))
    except FieldkitError as error:
        raise StoreError(f"{path}: {error.message}", hint=error.hint) from error


def calibration_file(folder: Path, kind: Literal["camera", "rig"]) -> Path:
    """Return where a folder has its camera or rig: a .toml, or Kalibr's file of that name or called camchain.yaml.

    A camchain is of a rig where ``images/`` has a folder for its first camera. Without any the name of the .toml.
    """
    chain = folder / "camchain.yaml"
    is_rig = (folder / "images" / "cam0").is_dir()
    names = [folder / f"{kind}{ending}" for ending in (".toml", *KALIBR_SUFFIXES)]
    if is_rig == (kind == "rig"):
        names.append(chain)
    return next((name for name in names if name.is_file()), names[0])


def write_camera(path: Path, camera: Camera, *, rms_px: float | None = None) -> None:
    """Write camera.toml."""
    write_toml(path, _CameraFile(1, camera.model, camera.width, camera.height, list(camera.params), rms_px))


class _HandFile(msgspec.Struct, forbid_unknown_fields=True):
    version: Literal[1]
    parent: str
    child: str
    position_m: list[float]
    quaternion_xyzw: list[float]
    covariance: list[float] | None = None
    latency_s: float | None = None
    latency_sigma_s: float | None = None


@dataclasses.dataclass(frozen=True)
class Hand:
    """Where the camera sits in the hand: two frames of tf, hand_from_cam, and its 6x6 covariance where it is known.

    ``latency`` is by how much (s) the images' stamps are late against tf, and its sigma; None where it is not known.
    """

    parent: str
    child: str
    hand_from_cam: Pose
    covariance: Array | None = None
    latency: tuple[float, float] | None = None


def read_hand(path: Path) -> Hand:
    """Read hand.toml: parent and child, position_m, quaternion_xyzw of hand_from_cam, covariance?, latency_s?."""
    data = read_toml(path, _HandFile, what="hand.toml with parent, child, position_m and quaternion_xyzw")
    try:
        if data.covariance is not None and len(data.covariance) != 36:
            raise StoreError(f"covariance has {len(data.covariance)} numbers; expected 36, row-major")
        covariance = None if data.covariance is None else np.asarray(data.covariance).reshape(6, 6)
        hand_from_cam = pose(data.position_m, data.quaternion_xyzw)
        return Hand(data.parent, data.child, hand_from_cam, covariance, _latency(data))
    except FieldkitError as error:
        raise StoreError(f"{path}: {error.message}", hint=error.hint) from error


def _latency(data: _HandFile) -> tuple[float, float] | None:
    if data.latency_s is None and data.latency_sigma_s is None:
        return None
    late_s, sigma_s = data.latency_s, data.latency_sigma_s
    # Written so that nan fails it too
    if late_s is None or sigma_s is None or not (abs(late_s) < MAX_LATENCY_S and 0 <= sigma_s < MAX_LATENCY_S):
        raise StoreError(
            f"latency_s {late_s} and latency_sigma_s {sigma_s}; expected both, in s and below {MAX_LATENCY_S:g}",
            hint="correct the two lines, or remove both",
        )
    return late_s, sigma_s


def write_hand(path: Path, hand: Hand) -> None:
    """Write hand.toml."""
    xyz, quaternion = position_quaternion(hand.hand_from_cam)
    covariance = None if hand.covariance is None else [float(v) for v in np.asarray(hand.covariance).ravel()]
    late = hand.latency or (None, None)
    write_toml(path, _HandFile(1, hand.parent, hand.child, xyz, quaternion, covariance, *late))


@dataclasses.dataclass(frozen=True)
class RigCamera:
    """One camera of a rig: its name, calibration, and rig_from_cam."""

    name: str
    camera: Camera
    rig_from_cam: Pose


@dataclasses.dataclass(frozen=True)
class Rig:
    """Cameras that move together; ``depth`` is the depth camera, if there is one."""

    cameras: tuple[RigCamera, ...]
    depth: RigCamera | None = None


class _RigCameraFile(msgspec.Struct, forbid_unknown_fields=True):
    name: str
    model: str
    width: Size
    height: Size
    params: list[float]
    position_m: list[float]
    quaternion_xyzw: list[float]


class _RigFile(msgspec.Struct, forbid_unknown_fields=True):
    version: Literal[1]
    camera: list[_RigCameraFile]
    depth_camera: _RigCameraFile | None = None


def read_rig(path: Path) -> Rig:
    """Read rig.toml: [[camera]] and [depth_camera] with calibration and rig_from_cam; or Kalibr's camchain.yaml."""
    if Path(path).suffix in KALIBR_SUFFIXES:
        return Rig(tuple(RigCamera(c.name, c.camera, c.rig_from_cam) for c in read_kalibr(path)))
    data = read_toml(path, _RigFile, what="rig.toml with [[camera]] entries")
    if not data.camera:
        raise StoreError(f"{path}: no [[camera]]; expected at least one", hint="add the rig's cameras")
    try:
        cameras = tuple(_rig_camera(c) for c in data.camera)
        return Rig(cameras, None if data.depth_camera is None else _rig_camera(data.depth_camera))
    except FieldkitError as error:
        raise StoreError(f"{path}: {error.message}", hint=error.hint) from error


def _rig_camera(c: _RigCameraFile) -> RigCamera:
    return RigCamera(c.name, Camera(c.model, c.width, c.height, tuple(c.params)), pose(c.position_m, c.quaternion_xyzw))


def write_rig(path: Path, rig: Rig) -> None:
    """Write rig.toml."""

    def entry(c: RigCamera) -> _RigCameraFile:
        xyz, quaternion = position_quaternion(c.rig_from_cam)
        camera = c.camera
        return _RigCameraFile(c.name, camera.model, camera.width, camera.height, list(camera.params), xyz, quaternion)

    depth = None if rig.depth is None else entry(rig.depth)
    write_toml(path, _RigFile(1, [entry(c) for c in rig.cameras], depth))


class PhotoEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One photo of a tag: its file and camera file (relative to the folder), and the visit of a tripod tag."""

    file: str
    camera: str
    visit: str | None = None


class _PhotosFile(msgspec.Struct, forbid_unknown_fields=True):
    photo: list[PhotoEntry]
    version: Literal[1] = 1


def read_photos(path: Path) -> tuple[PhotoEntry, ...]:
    """Read photos.toml: [[photo]] file, camera, visit."""
    return tuple(read_toml(path, _PhotosFile, what="photos.toml with [[photo]] file and camera").photo)


def write_photos(path: Path, photos: Iterable[PhotoEntry]) -> None:
    """Write photos.toml."""
    write_toml(path, _PhotosFile(list(photos)))


class SessionStart(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[[start]]: standing at a start tag, or, without tag_id, where the reference topic gives the start pose."""

    t_begin_ns: int
    t_end_ns: int
    tag_id: int | None = None
    visit: str | None = None


class SessionVisit(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[[visit]]: standing at a waypoint."""

    id: str
    t_begin_ns: int
    t_end_ns: int
    next: str | None = None
    truth_tag_id: int | None = None
    start: str | None = None


class SessionView(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[[view]]: one image of a visit."""

    visit: str
    id: str
    t_ns: int
    kind: ViewKind
    repeat: int = 0


class SessionFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """session.toml: the recording's file beside it, and what belongs to which waypoint where no events say so."""

    session: str
    recording: str
    version: Literal[1] = 1
    map_digest: str | None = None
    layout: str | None = None
    start: tuple[SessionStart, ...] = ()
    visit: tuple[SessionVisit, ...] = ()
    view: tuple[SessionView, ...] = ()


def read_session(path: Path) -> SessionFile:
    """Read session.toml."""
    return read_toml(path, SessionFile, what="session.toml with session and recording")


def write_session(path: Path, session: SessionFile) -> None:
    """Write session.toml."""
    write_toml(path, session)


def read_tum(path: Path) -> list[tuple[str, Pose]]:
    """Read TUM text: lines ``name_or_stamp tx ty tz qx qy qz qw``; blank lines and # comments are skipped."""
    rows: list[tuple[str, Pose]] = []
    for number, line in enumerate(read_text(path, what="TUM poses").splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            if len(words) != 8:
                raise StoreError(f"{len(words)} fields")
            values = [float(w) for w in words[1:]]
            rows.append((words[0], pose(values[:3], values[3:])))
        except (ValueError, FieldkitError) as error:
            raise StoreError(
                f"{path}: line {number}: {error}; expected `name tx ty tz qx qy qz qw`",
                hint="correct the line",
            ) from error
    return rows


def write_tum(path: Path, rows: Iterable[tuple[str, Pose]]) -> None:
    """Write TUM text with 9 decimals; names must be free of spaces."""
    lines = []
    for name, a_from_b in rows:
        xyz, quaternion = position_quaternion(a_from_b)
        lines.append(" ".join([name, *(f"{v:.9f}" for v in (*xyz, *quaternion))]) + "\n")
    atomic_write(path, "".join(lines))
