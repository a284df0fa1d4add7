"""Cameras with COLMAP's models and pixel convention: the centre of the first pixel is (0.5, 0.5)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldkit.errors import CameraError, suggestion

Array = NDArray[np.float64]

# Model name -> number of parameters
MODELS: dict[str, int] = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
}


@dataclasses.dataclass(frozen=True)
class Camera:
    """A camera: COLMAP model name, image size in pixels, and parameters in COLMAP's order."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise CameraError(f"unknown camera model {self.model!r}", hint=suggestion(self.model, list(MODELS)))
        if len(self.params) != MODELS[self.model]:
            raise CameraError(
                f"camera model {self.model} has {len(self.params)} params; expected {MODELS[self.model]} as in COLMAP"
            )
        if self.width <= 0 or self.height <= 0 or not np.isfinite(self.params).all() or min(self.focal_px) <= 0:
            raise CameraError(
                f"camera {self.width}x{self.height} {self.params}; expected positive size and focal length"
            )

    @property
    def focal_px(self) -> tuple[float, float]:
        """Focal lengths fx, fy in pixels."""
        single = self.model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
        return (self.params[0], self.params[0]) if single else (self.params[0], self.params[1])

    @property
    def centre_px(self) -> tuple[float, float]:
        """Principal point cx, cy in pixels, with (0.5, 0.5) at the centre of the first pixel."""
        single = self.model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
        return (self.params[1], self.params[2]) if single else (self.params[2], self.params[3])

    @property
    def opencv_distortion(self) -> tuple[float, ...]:
        """Distortion coefficients in OpenCV's order: (k1 k2 p1 p2 k3 k4 k5 k6), or (k1 k2 k3 k4) of a fisheye."""
        p = self.params
        match self.model:
            case "SIMPLE_RADIAL":
                return (p[3], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            case "RADIAL":
                return (p[3], p[4], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            case "OPENCV":
                return (*p[4:8], 0.0, 0.0, 0.0, 0.0)
            case "OPENCV_FISHEYE":
                return p[4:8]
            case "FULL_OPENCV":
                return p[4:12]
            case _:
                return (0.0,) * 8

    @property
    def is_fisheye(self) -> bool:
        """Whether the distortion is OpenCV's equidistant fisheye."""
        return self.model == "OPENCV_FISHEYE"

    @property
    def is_pinhole(self) -> bool:
        """Whether the camera has no distortion."""
        return not self.is_fisheye and not any(self.opencv_distortion)

    def matrix(self, *, opencv: bool = False) -> Array:
        """Return the 3x3 calibration matrix; with ``opencv`` the centre of the first pixel is (0, 0)."""
        (fx, fy), (cx, cy) = self.focal_px, self.centre_px
        shift = 0.5 if opencv else 0.0
        return np.array([[fx, 0.0, cx - shift], [0.0, fy, cy - shift], [0.0, 0.0, 1.0]])

    def distort(self, xy: ArrayLike) -> Array:
        """Map undistorted normalised coordinates (n, 2) to distorted ones (n, 2)."""
        values = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
        return (
            _distort_fisheye(values, self.params[4:8]) if self.is_fisheye else _distort(values, self.opencv_distortion)
        )

    def project(self, x_in_cam: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Project points (n, 3) in m to pixels (n, 2); also return bool[n]: in front of the camera and in the image.

        Pixels of points that are not in front are nan. Far outside the field of view a polynomial distortion may
        fold points back into the image; such points (beyond the model's monotonic radius) count as not visible.
        """
        points = np.asarray(x_in_cam, dtype=np.float64).reshape(-1, 3)
        front = points[:, 2] > 1e-9
        xy = np.full((len(points), 2), np.nan)
        xy[front] = points[front, :2] / points[front, 2:]
        pixels = np.full((len(points), 2), np.nan)
        pixels[front] = self.distort(xy[front]) * self.focal_px + self.centre_px
        with np.errstate(invalid="ignore"):
            inside = front & (pixels >= 0).all(axis=1) & (pixels < (self.width, self.height)).all(axis=1)
            if not self.is_fisheye and not self.is_pinhole:
                inside &= np.hypot(xy[:, 0], xy[:, 1]) <= self._monotonic_radius()
        return pixels, inside

    def unproject(self, pixels: ArrayLike) -> Array:
        """Return directions (n, 3) in the camera frame with z = 1 of pixels (n, 2); undistortion by Newton steps."""
        values = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        target = (values - self.centre_px) / np.asarray(self.focal_px)
        xy = target if self.is_pinhole else self._undistort(target)
        return np.column_stack([xy, np.ones(len(xy))])

    def _undistort(self, target: Array) -> Array:
        if self.is_fisheye:
            return _undistort_fisheye(target, self.params[4:8])
        xy, step = target.copy(), 1e-6
        for _ in range(20):
            here = self.distort(xy)
            dx = (self.distort(xy + (step, 0.0)) - here) / step
            dy = (self.distort(xy + (0.0, step)) - here) / step
            residual = target - here
            determinant = dx[:, 0] * dy[:, 1] - dy[:, 0] * dx[:, 1]
            delta = np.column_stack(
                [
                    (dy[:, 1] * residual[:, 0] - dy[:, 0] * residual[:, 1]) / determinant,
                    (dx[:, 0] * residual[:, 1] - dx[:, 1] * residual[:, 0]) / determinant,
                ]
            )
            xy = xy + delta
            if float(np.abs(delta).max(initial=0.0)) < 1e-14:
                break
        return xy

    def _monotonic_radius(self) -> float:
        """Return the normalised radius beyond which the radial distortion folds points back towards the centre."""
        k1, k2, _, _, k3, k4, k5, k6 = self.opencv_distortion
        r = np.linspace(0.0, 10.0, 4001)
        folded = np.flatnonzero(
            np.diff(_distort(np.column_stack([r, 0 * r]), (k1, k2, 0, 0, k3, k4, k5, k6))[:, 0]) <= 0
        )
        return float(r[folded[0]]) if len(folded) else float("inf")

    def scaled(self, factor: float) -> Camera:
        """Return the camera of the image resized by a factor (size rounded, centre scaled: no half-pixel shift)."""
        width, height = max(round(self.width * factor), 1), max(round(self.height * factor), 1)
        sx, sy = width / self.width, height / self.height
        p = list(self.params)
        if self.model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
            p[0], p[1], p[2] = p[0] * (sx + sy) / 2, p[1] * sx, p[2] * sy
        else:
            p[0], p[1], p[2], p[3] = p[0] * sx, p[1] * sy, p[2] * sx, p[3] * sy
        return Camera(self.model, width, height, tuple(p))


def _distort(xy: Array, coefficients: Sequence[float]) -> Array:
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return np.column_stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ]
    )


def _fisheye_theta(theta: Array, k: Sequence[float]) -> Array:
    t2 = theta * theta
    return theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))


def _distort_fisheye(xy: Array, k: Sequence[float]) -> Array:
    r = np.linalg.norm(xy, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.where(r > 1e-9, _fisheye_theta(np.arctan(r), k) / r, 1.0)
    return xy * scale[:, None]


def _undistort_fisheye(target: Array, k: Sequence[float]) -> Array:
    r = np.linalg.norm(target, axis=1)
    theta = np.minimum(r, 1.5)
    for _ in range(30):
        t2 = theta * theta
        slope = 1 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3])))
        theta = theta - (_fisheye_theta(theta, k) - r) / slope
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.where(r > 1e-9, np.tan(theta) / r, 1.0)
    return target * scale[:, None]


def camera_from_info(
    width: int, height: int, k: ArrayLike, d: Sequence[float], *, distortion_model: str = "plumb_bob"
) -> Camera:
    """Make a Camera from the fields of a ROS CameraInfo (K row-major, D), whose first pixel centre is (0, 0).

    Knows plumb_bob, rational_polynomial and equidistant. Raises CameraError for another model or an uncalibrated K.
    """
    matrix = np.asarray(k, dtype=np.float64).reshape(3, 3)
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5
    if fx <= 0 or fy <= 0:
        raise CameraError(f"CameraInfo has focal lengths {fx:g}, {fy:g}; expected a calibrated camera (K set)")
    values = [float(v) for v in d]
    head = (float(fx), float(fy), float(cx), float(cy))
    if not any(values):
        return Camera("PINHOLE", width, height, head)
    if distortion_model in ("equidistant", "fisheye"):
        return Camera("OPENCV_FISHEYE", width, height, (*head, *(values + [0.0] * 4)[:4]))
    if distortion_model not in ("plumb_bob", "rational_polynomial", "radtan", ""):
        known = ["plumb_bob", "rational_polynomial", "equidistant"]
        raise CameraError(
            f"CameraInfo has distortion_model {distortion_model!r}", hint=suggestion(distortion_model, known)
        )
    full = (values + [0.0] * 8)[:8]
    if any(full[4:]):
        return Camera("FULL_OPENCV", width, height, (*head, *full))
    return Camera("OPENCV", width, height, (*head, *full[:4]))


def camera_info_fields(camera: Camera) -> tuple[list[float], list[float], str]:
    """Return K (9 numbers, row-major), D and the distortion model of a ROS CameraInfo (first pixel centre at 0, 0)."""
    k = [float(v) for v in camera.matrix(opencv=True).ravel()]
    distortion = [float(v) for v in camera.opencv_distortion]
    if camera.is_fisheye:
        return k, distortion, "equidistant"
    if any(distortion[5:]):
        return k, distortion, "rational_polynomial"
    return k, distortion[:5], "plumb_bob"
