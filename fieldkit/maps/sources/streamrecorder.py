"""Folders that StreamRecorder (Microsoft's HoloLens2ForCV) makes of a HoloLens 2, as a SOURCE of maps.

Per sensor there is a folder of ``<time>.pgm`` and, beside it, ``_rig2world.txt`` (time and rig2world per line),
``_extrinsics.txt`` (rig2cam) and ``_lut.bin`` (a unit ray per pixel). Matrices are 4x4, row by row; times are ticks of
100 ns; the world has y up. Cameras are stored lying on their side; depth is the distance along the ray in mm.
"""

from __future__ import annotations

import bisect
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import scipy.optimize
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fieldkit.cameras import Camera
from fieldkit.errors import MapError
from fieldkit.frames import Pose
from fieldkit.maps.sources.source import DepthFrame, MapSource, SourceImage, read_source
from fieldkit.store.files import read_text

Array = NDArray[np.float64]

# Quarter turns, counter-clockwise, from an upright picture to the stored one
QUARTER_TURNS = {"LF": 1, "LL": -1, "RF": -1, "RR": 1}
_DEPTH = "Depth Long Throw"
# What the factory measured differs between devices by a few pixels: those of one device serve where a table is missing
_PARAMS: dict[str, tuple[float, ...]] = {
    "LL": (368.615, 367.439, 238.426, 313.126, -0.01339, 0.01189, 0.00119, -0.00266),
    "LF": (368.429, 366.500, 240.710, 328.719, -0.01290, 0.01003, 0.00041, 0.00365),
    "RF": (365.609, 364.354, 238.045, 307.250, -0.01765, 0.01594, 0.00058, -0.00486),
    "RR": (367.538, 366.644, 242.538, 324.929, -0.01713, 0.01521, -0.00005, 0.00262),
}
_TICKS_PER_S = 10_000_000
# Every fifth of thirty images a second; what was recorded more slowly is taken whole
_EVERY_S = 1.0 / 6.5
# Images this close in time are of one moment: a walking head moves 2 mm
_SAME_S = 0.002
# The nearest images tell where a depth image was taken, with SLAM's motion between
_NEAR_S = 0.5
_MAX_FIT_PX = 0.5
_WORLD = Pose.from_components(np.zeros(3), Rotation.from_euler("x", 90, degrees=True))


@dataclasses.dataclass(frozen=True)
class _Sensor:
    """One sensor's upright camera: its files and world_from_rig by time, rig_from_cam, calibration and unit rays."""

    name: str
    turns: int
    files: Mapping[int, Path]
    slam_from_rig: Mapping[int, Pose]
    rig_from_cam: Pose
    camera: Camera
    ray_z: Array | None

    def slam_from_cam(self, time: int) -> Pose | None:
        pose = self.slam_from_rig.get(time)
        return None if pose is None else pose * self.rig_from_cam


def is_streamrecorder(path: Path) -> bool:
    """Tell whether a folder holds a sensor of StreamRecorder, unpacked or not."""
    path = Path(path)
    return path.is_dir() and any(
        (path / f"VLC{between}{name}{ending}").exists()
        for name in QUARTER_TURNS
        for between in ("_", " ")
        for ending in ("_rig2world.txt", ".tar")
    )


def open_source(path: Path) -> MapSource:
    """Read any SOURCE of a map: a StreamRecorder folder, or one that `read_source` knows."""
    return read_streamrecorder(path) if is_streamrecorder(path) else read_source(path)


def read_streamrecorder(path: Path, *, every_s: float = _EVERY_S) -> MapSource:
    """Read a StreamRecorder folder as a rig's walk with SLAM poses and depth.

    Images less than ``every_s`` after the last are left out. Pictures are turned upright when they are read; cameras
    are fitted to the stored tables of rays. Images of one moment are a rig's frame, others stand for themselves.
    Raises MapError when no camera is complete or a file is damaged.
    """
    path = Path(path)
    notes: list[str] = []
    sensors = [s for name in QUARTER_TURNS if (s := _sensor(path, f"VLC {name}", QUARTER_TURNS[name], notes))]
    if not sensors:
        packed = next(iter(sorted(path.glob("*.tar"))), None)
        hint = f"unpack it: tar -xf {packed.name!r} -C {packed.stem!r}" if packed else "check the path"
        found = f"{packed.name} is not unpacked" if packed else "no images"
        raise MapError(f"{path}: {found}; expected folders VLC_LF, VLC_RF, .. with <time>.pgm", hint=hint)
    moments = _moments(sensors, every_s)
    images, frames = _images(sensors, moments)
    depth_sensor = _sensor(path, _DEPTH, 0, notes)
    depth: tuple[DepthFrame, ...] = ()
    if depth_sensor is not None and depth_sensor.ray_z is not None:
        depth = _depth_frames(depth_sensor, images, frames, every_s)
    if (path / "Depth AHaT").exists() or (path / "Depth_AHaT").exists():
        notes.append("Depth AHaT is not read: its distances wrap around at a metre")
    camera = depth_sensor.camera if depth_sensor is not None and depth else None
    return MapSource(path, tuple(images), camera, depth, tuple(notes))


def _find(path: Path, name: str, ending: str) -> Path | None:
    return next((p for n in (name.replace(" ", "_"), name) if (p := path / f"{n}{ending}").exists()), None)


def _sensor(path: Path, name: str, turns: int, notes: list[str]) -> _Sensor | None:
    folder, poses = _find(path, name, ""), _find(path, name, "_rig2world.txt")
    files = {int(f.stem): f for f in folder.glob("*.pgm") if f.stem.isdecimal()} if folder is not None else {}
    if not files:
        if poses is not None or _find(path, name, ".tar") is not None:
            notes.append(f"{name} has no unpacked images and is left out")
        return None
    if poses is None:
        raise MapError(
            f"{path}: {name} has images and no {name.replace(' ', '_')}_rig2world.txt; expected it with the poses",
            hint="copy it from the device, too",
        )
    extrinsics = _find(path, name, "_extrinsics.txt")
    if extrinsics is None:
        raise MapError(
            f"{path}: {name} has no {name.replace(' ', '_')}_extrinsics.txt; expected rig2cam", hint="copy it, too"
        )
    stored_from_rig = _matrix(extrinsics, read_text(extrinsics, what="16 numbers").replace(",", " ").split())
    stored_from_upright = Pose.from_components(np.zeros(3), Rotation.from_euler("z", -90 * turns, degrees=True))
    if stored_from_rig is None:
        raise MapError(f"{extrinsics}: is no rigid transform; expected rig2cam, 16 numbers", hint="copy it again")
    first = cv2.imread(str(files[min(files)]), cv2.IMREAD_UNCHANGED)
    if first is None or first.ndim != 2:
        raise MapError(f"{files[min(files)]}: cannot be read; expected a grey PGM image", hint="copy it again")
    rays = _rays(_find(path, name, "_lut.bin"), first.shape, turns)
    camera = _camera(path, name, first.shape, turns, rays, notes)
    return _Sensor(
        name.split()[-1].lower(),
        turns,
        files,
        _poses(poses),
        stored_from_rig.inv() * stored_from_upright,
        camera,
        None if rays is None else rays[..., 2],
    )


def _matrix(path: Path, words: Sequence[str]) -> Pose | None:
    """Return a 4x4 matrix as a pose; None for zeros, which the device writes where it has lost itself."""
    try:
        matrix = np.array([float(w) for w in words]).reshape(4, 4)
    except ValueError as error:
        raise MapError(f"{path}: {error}; expected the 16 numbers of a matrix", hint="copy it again") from error
    rotation = matrix[:3, :3]
    if not np.isfinite(matrix).all() or not np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-2):
        return None
    return Pose.from_components(matrix[:3, 3], Rotation.from_matrix(rotation))


def _poses(path: Path) -> dict[int, Pose]:
    """Return slam_from_rig, z up, by time."""
    result = {}
    for number, line in enumerate(read_text(path, what="lines of time and 16 numbers").splitlines(), start=1):
        words = line.replace(",", " ").split()
        if not words:
            continue
        if len(words) != 17 or not words[0].isdecimal():
            raise MapError(
                f"{path}: line {number}: {len(words)} fields; expected a time and 16 numbers", hint="copy it again"
            )
        world_from_rig = _matrix(path, words[1:])
        if world_from_rig is not None:
            result[int(words[0])] = _WORLD * world_from_rig
    return result


def _rays(path: Path | None, shape: tuple[int, ...], turns: int) -> Array | None:
    """Return the upright picture's unit rays f64[h, w, 3] in the upright camera's frame; z is 0 where there is none."""
    if path is None:
        return None
    values = np.fromfile(path, dtype="<f4")
    if values.size != 3 * shape[0] * shape[1]:
        raise MapError(
            f"{path}: {values.size} numbers; expected three for each of {shape[1]}x{shape[0]} pixels",
            hint="copy it again",
        )
    stored = values.reshape(-1, 3).astype(np.float64)
    turned = Rotation.from_euler("z", 90 * turns, degrees=True).apply(stored)
    return np.rot90(turned.reshape(*shape[:2], 3), -turns)


def _camera(path: Path, name: str, shape: tuple[int, ...], turns: int, rays: Array | None, notes: list[str]) -> Camera:
    height, width = shape[::-1] if turns else shape[:2]
    if rays is not None:
        camera, rms_px = fit_camera(rays)
        if rms_px > _MAX_FIT_PX:
            notes.append(f"{name}: its rays fit OPENCV's lens model only to {rms_px:.2f} px")
        return camera
    letters = name.split()[-1]
    if letters not in _PARAMS or (width, height) != (480, 640):
        raise MapError(
            f"{path}: {name} has no {name.replace(' ', '_')}_lut.bin; expected its rays", hint="copy it, too"
        )
    notes.append(f"{name} has no _lut.bin: the calibration of another HoloLens 2 is used")
    return Camera("OPENCV", width, height, _PARAMS[letters])


def fit_camera(rays: Array) -> tuple[Camera, float]:
    """Fit COLMAP's OPENCV model to the rays f64[h, w, 3] of an image's pixels; return it and the rms residual in px."""
    height, width = rays.shape[:2]
    step = max(1, min(height, width) // 60)
    rows, columns = (a.ravel() for a in np.indices((height, width))[:, ::step, ::step])
    directions = rays[rows, columns]
    ahead = directions[:, 2] > 0.05
    xy = directions[ahead, :2] / directions[ahead, 2:]
    pixels = np.column_stack([columns, rows])[ahead] + 0.5

    def residuals(p: Array) -> Array:
        model = Camera("OPENCV", width, height, tuple(float(v) for v in p))
        return np.asarray((model.distort(xy) * model.focal_px + model.centre_px - pixels).ravel())

    ones = np.ones(len(xy))
    fx, cx = np.linalg.lstsq(np.column_stack([xy[:, 0], ones]), pixels[:, 0], rcond=None)[0]
    fy, cy = np.linalg.lstsq(np.column_stack([xy[:, 1], ones]), pixels[:, 1], rcond=None)[0]
    found = scipy.optimize.least_squares(
        residuals, np.array([fx, fy, cx, cy, 0.0, 0.0, 0.0, 0.0]), loss="soft_l1", x_scale="jac"
    )
    rms_px = float(np.sqrt(np.mean(residuals(found.x) ** 2) * 2))
    return Camera("OPENCV", width, height, tuple(float(v) for v in found.x)), rms_px


def _moments(sensors: Sequence[_Sensor], every_s: float) -> list[int]:
    """Return the times of the first sensor's images, thinned."""
    times: list[int] = []
    for time in sorted(sensors[0].files):
        if not times or time - times[-1] >= every_s * _TICKS_PER_S:
            times.append(time)
    return times


def _images(sensors: Sequence[_Sensor], moments: Sequence[int]) -> tuple[list[SourceImage], dict[int, list[int]]]:
    """Return the images of all sensors at the moments, and the images (by index) of each moment."""
    images: list[SourceImage] = []
    frames: dict[int, list[int]] = {time: [] for time in moments}
    for sensor in sensors:
        taken = sorted(sensor.files)
        for moment in moments:
            time = _nearest(taken, moment)
            together = abs(time - moment) <= _SAME_S * _TICKS_PER_S
            if not together and abs(time - moment) > 0.05 * _TICKS_PER_S:
                continue
            frames[moment].append(len(images))
            name = f"{sensor.name}/{time}.pgm"
            images.append(
                SourceImage(
                    name,
                    sensor.files[time],
                    sensor.camera,
                    sensor.name,
                    str(moment),
                    sensor.slam_from_cam(time),
                    sensor.rig_from_cam if together else None,
                    sensor.turns,
                )
            )
    return images, frames


def _depth_frames(
    sensor: _Sensor, images: Sequence[SourceImage], frames: Mapping[int, Sequence[int]], every_s: float
) -> tuple[DepthFrame, ...]:
    result: list[DepthFrame] = []
    times, last = sorted(frames), None
    for time in sorted(sensor.files):
        slam_from_depth = sensor.slam_from_cam(time)
        moment = _nearest(times, time)
        if slam_from_depth is None or abs(moment - time) > _NEAR_S * _TICKS_PER_S:
            continue
        if last is not None and time - last < every_s * _TICKS_PER_S:
            continue
        anchors = tuple(
            (i, p.inv() * slam_from_depth) for i in frames[moment] if (p := images[i].slam_from_cam) is not None
        )
        if anchors:
            last = time
            result.append(DepthFrame(sensor.files[time], anchors, sensor.ray_z))
    return tuple(result)


def _nearest(times: Sequence[int], time: int) -> int:
    at = bisect.bisect_left(times, time)
    return min(times[max(at - 1, 0) : at + 1], key=lambda t: abs(t - time))
