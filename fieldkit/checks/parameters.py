"""The quantities that an arm sweep checks: their stated values, units, and how large an error in each matters."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from fieldkit.cameras import Camera
from fieldkit.errors import TagError
from fieldkit.frames import Array

_DISTORTION = {True: ("k1", "k2", "k3", "k4"), False: ("k1", "k2", "p1", "p2")}


@dataclasses.dataclass(frozen=True)
class Parameter:
    """One number that is estimated beside its stated value.

    ``wide`` is the standard deviation of what is taken as known of it beforehand: wide enough not to pull.
    ``tolerance`` is the error that begins to matter; a value known worse than that counts as not observed. ``step``
    is for numeric derivatives. ``factor`` turns the internal number (rad, m, s, log) into ``unit`` for display.
    """

    name: str
    group: str
    unit: str
    factor: float
    wide: float
    tolerance: float
    step: float


def require_positive(option: str, value: float) -> None:
    """Raise TagError unless the value of an option is finite and above 0."""
    if not (math.isfinite(value) and value > 0):
        raise TagError(f"{option} {value:g}; expected a finite number above 0")


def hand_parameters() -> tuple[Parameter, ...]:
    """Return the six numbers of hand_from_cam's correction, about and along the camera's axes: rotation first."""
    degrees = math.degrees(1.0)
    turns = tuple(
        Parameter(f"rotation {axis}", "hand", "deg", degrees, math.radians(10), math.radians(0.5), 1e-5)
        for axis in "xyz"
    )
    shifts = tuple(Parameter(f"position {axis}", "hand", "mm", 1e3, 0.1, 0.01, 1e-5) for axis in "xyz")
    return turns + shifts


def latency_parameter() -> Parameter:
    """Return by how much stamps are late."""
    return Parameter("stamps late by", "stamps", "ms", 1e3, 0.1, 0.02, 2e-3)


def camera_parameters(camera: Camera) -> tuple[Parameter, ...]:
    """Return the numbers of a refinable camera: focal length, aspect, centre, distortion.

    An error of a distortion coefficient matters where it moves the image's corner by two pixels.
    """
    focal = math.sqrt(camera.focal_px[0] * camera.focal_px[1])
    radius = math.hypot(camera.width, camera.height) / 2 / focal
    # By how much a coefficient of 1 moves the corner of the image, in px
    powers = (3, 5, 7, 9) if camera.is_fisheye else (3, 5, 2, 2)
    moved = [focal * radius**p * (3.0 if p == 2 else 1.0) for p in powers]
    centre = tuple(Parameter(f"centre {axis}", "camera", "px", 1.0, 0.05 * camera.width, 5.0, 1e-2) for axis in "xy")
    distortion = tuple(
        Parameter(name, "camera", "", 1.0, 60.0 / m, 2.0 / m, 1e-2 / m)
        for name, m in zip(_DISTORTION[camera.is_fisheye], moved, strict=True)
    )
    return (
        Parameter("focal length", "camera", "%", 100.0, 0.1, 0.01, 1e-5),
        Parameter("fy over fx", "camera", "%", 100.0, 0.02, 0.005, 1e-5),
        *centre,
        *distortion,
    )


def refinable(camera: Camera) -> Camera:
    """Return the same camera as a model with both focal lengths and at least four distortion coefficients."""
    if camera.model in ("OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"):
        return camera
    params = (*camera.focal_px, *camera.centre_px, *camera.opencv_distortion[:4])
    return Camera("OPENCV", camera.width, camera.height, tuple(float(p) for p in params))


def changed(camera: Camera, delta: Array) -> Camera:
    """Return a refinable camera with the numbers of `camera_parameters` (8,) added to its own."""
    params = np.array(camera.params)
    params[:2] *= np.exp(delta[0] + np.array([-0.5, 0.5]) * delta[1])
    params[2:8] += delta[2:8]
    return Camera(camera.model, camera.width, camera.height, tuple(float(p) for p in params))
