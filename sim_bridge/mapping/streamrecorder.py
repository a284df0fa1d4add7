"""Export a mapping walk as the folders that StreamRecorder (Microsoft's HoloLens2ForCV) makes of a HoloLens 2.

Per sensor there is a folder of ``<time>.pgm`` and, beside it, ``_rig2world.txt`` (time and rig2world per line),
``_extrinsics.txt`` (rig2cam) and ``_lut.bin`` (a unit ray per pixel). Matrices are 4x4, row by row; times are ticks of
100 ns since 1601; the world has y up. The rig is the left front camera. Cameras are stored lying on their side, as
they are built in; depth is the distance along the ray in mm. Infrared brightness, the photo camera and the head's,
hands' and eyes' poses are not simulated, and left out.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fieldkit.frames import Pose
from fieldkit.store import Rig, RigCamera, atomic_folder, read_rig, read_tum
from sim_bridge.errors import SynthesisError

Array = NDArray[np.float64]
Image = NDArray[np.uint8] | NDArray[np.uint16]

DEPTH = "Depth Long Throw"
# Quarter turns, counter-clockwise, from an upright picture to the one that the device stores.
QUARTER_TURNS = {"ll": -1, "lf": 1, "rf": -1, "rr": 1}
# The walk has no clock of its own: it begins here and goes on at an easy pace, standing for a moment at each station.
BEGIN_TICKS = 116_444_736_000_000_000 + 17_000_000_000_000_000
PACE_M_S, PAUSE_S = 0.7, 0.2
# HoloLens' world has y up, SLAM's z.
_WORLD_FROM_SLAM = Pose.from_components(np.zeros(3), Rotation.from_euler("x", -90, degrees=True))


@dataclasses.dataclass(frozen=True)
class _Walk:
    """A session's mapping folder, its stations (frame, slam_from_rig) with their times, and rig_from_device."""

    mapping: Path
    stations: tuple[tuple[str, Pose], ...]
    ticks: list[int]
    rig_from_device: Pose


def export_streamrecorder(
    session: Path, out: Path, *, separator: Literal["_", " "] = "_", force: bool = False
) -> dict[str, int]:
    """Write a session's mapping walk as StreamRecorder's folders; return the number of images per sensor.

    ``separator`` stands between the words of names: "_" as in the paper's recordings, " " as the device writes them.
    Raises StoreError for a session without a complete mapping folder, SynthesisError for one without the four
    cameras or with a damaged image.
    """
    mapping = Path(session) / "mapping"
    rig = read_rig(mapping / "rig.toml")
    stations = read_tum(mapping / "slam_poses.txt")
    missing = sorted(set(QUARTER_TURNS) - {camera.name for camera in rig.cameras})
    if missing:
        raise SynthesisError(
            f"{mapping / 'rig.toml'}: no camera {', '.join(missing)}; expected ll, lf, rf and rr",
            hint="export a session that sim-bridge synthesized",
        )
    if not stations:
        raise SynthesisError(
            f"{mapping / 'slam_poses.txt'}: holds no pose; expected one per station of the walk",
            hint="synthesize the session again",
        )
    rig_from_device = _stored_frame(next(c for c in rig.cameras if c.name == "lf"), QUARTER_TURNS["lf"])
    walk = _Walk(mapping, tuple(stations), _ticks([pose for _, pose in stations]), rig_from_device)
    # Either spelling is an export.
    markers = [f"VLC{between}LF_rig2world.txt" for between in (separator, "_", " ")]
    marker = next((name for name in markers if (Path(out) / name).is_file()), markers[0])
    with atomic_folder(out, force=force, marker=marker) as folder:
        return {
            name: _write_sensor(folder / name.replace(" ", separator), camera, turns, walk=walk)
            for name, camera, turns in _sensors(rig)
        }


def _sensors(rig: Rig) -> list[tuple[str, RigCamera, int]]:
    named = {camera.name: camera for camera in rig.cameras}
    sensors = [(f"VLC {name.upper()}", named[name], turns) for name, turns in QUARTER_TURNS.items()]
    return sensors if rig.depth is None else [*sensors, (DEPTH, rig.depth, 0)]


def _write_sensor(path: Path, camera: RigCamera, turns: int, *, walk: _Walk) -> int:
    """Write the folder of one sensor and the files beside it; return the number of images."""
    path.mkdir()
    rays, lines = stored_rays(camera, turns), []
    for (frame, slam_from_rig), tick in zip(walk.stations, walk.ticks, strict=True):
        if turns:
            upright = _read(walk.mapping / "images" / camera.name / f"{frame}.jpg", cv2.IMREAD_GRAYSCALE, camera)
            image = np.rot90(upright, turns)
        else:
            along_axis = _read(walk.mapping / "depth" / f"{frame}.png", cv2.IMREAD_UNCHANGED, camera)
            # Depth is stored along the ray, not along the axis; what 16 bits cannot hold is no depth.
            along_ray = np.rint(along_axis / rays[..., 2])
            image = np.where(along_ray <= np.iinfo(np.uint16).max, along_ray, 0).astype(np.uint16)
        (path / f"{tick}.pgm").write_bytes(pgm(image))
        lines.append(f"{tick},{_numbers(_WORLD_FROM_SLAM * slam_from_rig * walk.rig_from_device)}\n")
    device_from_cam = walk.rig_from_device.inv() * _stored_frame(camera, turns)
    path.with_name(f"{path.name}_rig2world.txt").write_text("".join(lines))
    path.with_name(f"{path.name}_extrinsics.txt").write_text(_numbers(device_from_cam.inv()) + "\n")
    path.with_name(f"{path.name}_lut.bin").write_bytes(rays.astype("<f4").tobytes())
    return len(lines)


def _stored_frame(camera: RigCamera, turns: int) -> Pose:
    """Return rig_from_cam of the camera whose picture is the stored one: turned about the axis."""
    # An image turned counter-clockwise is one of a camera that is turned clockwise about its axis, which points away.
    upright_from_stored = Rotation.from_euler("z", 90 * turns, degrees=True)
    return camera.rig_from_cam * Pose.from_components(np.zeros(3), upright_from_stored)


def stored_rays(camera: RigCamera, turns: int) -> Array:
    """Return the unit rays f64[h,w,3] of a stored picture's pixels, in the frame of the stored camera."""
    rows, columns = np.indices((camera.camera.height, camera.camera.width)) + 0.5
    upright = camera.camera.unproject(np.column_stack([columns.ravel(), rows.ravel()]))
    turned = Rotation.from_euler("z", -90 * turns, degrees=True).apply(upright)
    unit = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    return np.rot90(unit.reshape(*rows.shape, 3), turns)


def pgm(image: Image) -> bytes:
    """Encode a grey image of 8 or 16 bits as binary PGM; 16 bits are big-endian."""
    height, width = image.shape
    deep = image.dtype == np.uint16
    head = f"P5\n{width} {height}\n{65535 if deep else 255}\n".encode()
    return head + np.ascontiguousarray(image, dtype=">u2" if deep else np.uint8).tobytes()


def _ticks(slam_from_rig: Sequence[Pose]) -> list[int]:
    places = np.array([pose.translation for pose in slam_from_rig])
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1) / PACE_M_S + PAUSE_S
    return [BEGIN_TICKS + round(t * 1e7) for t in np.concatenate([[0.0], np.cumsum(steps)])]


def _numbers(a_from_b: Pose) -> str:
    return ",".join(f"{value:.9g}" for value in a_from_b.as_matrix().ravel())


def _read(path: Path, flags: int, camera: RigCamera) -> Image:
    """Read an image of a rig's camera; raises SynthesisError when it is missing, cut short, or of another size."""
    data = path.read_bytes() if path.is_file() else b""
    whole = data.endswith(b"\xff\xd9") if path.suffix == ".jpg" else True
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data and whole else None
    size = (camera.camera.height, camera.camera.width)
    if image is None or image.shape != size:
        found = "missing or damaged" if image is None else f"{' x '.join(map(str, image.shape[::-1]))} pixels"
        raise SynthesisError(
            f"{path}: {found}; expected an image of the mapping walk, {size[1]} x {size[0]} pixels",
            hint="synthesize the session again",
        )
    return np.asarray(image)
