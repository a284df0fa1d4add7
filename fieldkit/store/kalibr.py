"""Kalibr's camera files (camchain.yaml): pinhole cameras with radtan or equidistant distortion, one or a rig."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from fieldkit.cameras import Camera
from fieldkit.errors import FieldkitError, StoreError
from fieldkit.frames import Pose
from fieldkit.store.files import read_text

SUFFIXES = (".yaml", ".yml")
_WHAT = "a camera file of Kalibr (cam0: camera_model, intrinsics, distortion_model, distortion_coeffs, resolution)"


@dataclasses.dataclass(frozen=True)
class KalibrCamera:
    """One camera of a camchain: its name there (cam0, ..), calibration, and rig_from_cam."""

    name: str
    camera: Camera
    rig_from_cam: Pose


def read_kalibr(path: Path) -> tuple[KalibrCamera, ...]:
    """Read all cameras of a camchain.yaml; the rig is the IMU where the file says where that is, else cam0.

    Kalibr puts the centre of the first pixel at (0, 0), COLMAP at (0.5, 0.5): the principal point is converted.
    Raises StoreError for another camera or distortion model than pinhole with radtan, equidistant or none, and where a
    camera that places another one is missing.
    """
    try:
        values = YAML(typ="safe").load(read_text(path, what=_WHAT))
    except YAMLError as error:
        line = str(error).splitlines()[0]
        raise StoreError(f"{path}: not valid YAML: {line}; expected {_WHAT}", hint="correct the file") from error
    names = [n for n in values if isinstance(n, str) and n.startswith("cam")] if isinstance(values, dict) else []
    if not names or not all(isinstance(values[n], dict) for n in names):
        raise StoreError(f"{path}: no cam0 in it; expected {_WHAT}", hint="give Kalibr's camchain.yaml")
    names.sort(key=lambda n: (int(n[3:]) if n[3:].isdigit() else -1, n))
    with_imu = all("T_cam_imu" in values[n] for n in names)
    if not with_imu:
        _refuse_gaps(path, {n: values[n] for n in names})
    result: list[KalibrCamera] = []
    for name in names:
        entry, place = values[name], f"{path}: {name}"
        if with_imu:
            rig_from_cam = _transform(entry, "T_cam_imu", place).inv()
        elif not result:
            rig_from_cam = Pose.identity()
        else:
            rig_from_cam = result[-1].rig_from_cam * _transform(entry, "T_cn_cnm1", place).inv()
        result.append(KalibrCamera(name, _camera(entry, place), rig_from_cam))
    return tuple(result)


def _refuse_gaps(path: Path, cameras: dict[str, Any]) -> None:
    """Raise StoreError where a camera is placed by one that is not there: T_cn_cnm1 is of the camera before."""
    names = list(cameras)
    numbers = [int(n[3:]) if n[3:].isdigit() else None for n in names]
    if len(names) > 1 and None in numbers:
        raise StoreError(
            f"{path}: has {', '.join(names)}; expected cam0, cam1, .., as T_cn_cnm1 is of the camera before",
            hint="name the cameras by their order in the chain, or give every camera its T_cam_imu",
        )
    first = numbers[0] or 0
    gaps = [first + k for k, number in enumerate(numbers) if number is not None and number != first + k]
    if not gaps and first > 0 and "T_cn_cnm1" in cameras[names[0]]:
        gaps = [first - 1]
    if gaps:
        raise StoreError(
            f"{path}: has {', '.join(names)} but no cam{gaps[0]}; expected a chain without a gap, as T_cn_cnm1 is of "
            "the camera before",
            hint=f"add cam{gaps[0]}, or give every camera its T_cam_imu",
        )


def _camera(entry: dict[str, Any], place: str) -> Camera:
    model, lens = str(entry.get("camera_model")), str(entry.get("distortion_model", "none")).lower()
    if model != "pinhole" or lens not in _LENSES:
        said = f"camera_model {model}" if model != "pinhole" else f"distortion_model {lens}"
        raise StoreError(
            f"{place}: {said}; expected pinhole with {', '.join(_LENSES)}",
            hint="calibrate it as pinhole-radtan, or pinhole-equi for a wide lens",
        )
    fx, fy, cx, cy = _numbers(entry, "intrinsics", 4, place)
    width, height = (int(v) for v in _numbers(entry, "resolution", 2, place))
    name = _LENSES[lens]
    distortion = [] if name == "PINHOLE" else _numbers(entry, "distortion_coeffs", 4, place)
    try:
        return Camera(name, width, height, (fx, fy, cx + 0.5, cy + 0.5, *distortion))
    except FieldkitError as error:
        raise StoreError(f"{place}: {error.message}", hint=error.hint) from error


_LENSES = {"radtan": "OPENCV", "equidistant": "OPENCV_FISHEYE", "equi": "OPENCV_FISHEYE", "none": "PINHOLE"}


def _numbers(entry: dict[str, Any], key: str, count: int, place: str) -> list[float]:
    values = entry.get(key)
    try:
        numbers = [float(v) for v in values] if isinstance(values, list) else []
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise StoreError(f"{place}: {key} is {values}; expected {count} numbers", hint="correct the file")
    return numbers


def _transform(entry: dict[str, Any], key: str, place: str) -> Pose:
    try:
        matrix = np.array(entry.get(key), dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    matrix = matrix if matrix.shape == (4, 4) and np.isfinite(matrix).all() else np.zeros((4, 4))
    rotation = matrix[:3, :3]
    rigid = np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-3) and np.linalg.det(rotation) > 0
    if not rigid or not np.array_equal(matrix[3], [0, 0, 0, 1]):
        raise StoreError(
            f"{place}: {key} is no rigid transform; expected 4 rows of 4 numbers", hint="calibrate the cameras together"
        )
    return Pose.from_matrix(matrix)
