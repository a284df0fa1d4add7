"""Corners of a tag from lines fitted to the edges of its square, with the covariance that the fit shows."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldkit.cameras import Camera
from fieldkit.tags.lens import bend, flatten
from fieldkit.types import Image

Array = NDArray[np.float64]

# Neighbouring samples of an edge share pixels: about one independent one per so many pixels, as measured on renders
SAMPLE_PX = 1.5
MIN_SAMPLES = 6
# Parts of an edge whose means tell whether its residuals are correlated: a bent edge, a lens calibrated badly
N_PARTS = 6


@dataclasses.dataclass(frozen=True)
class CornerFit:
    """Corners f64[4, 2] in undistorted pixels about the principal point, their 8x8 covariance, and the blur in pixels.

    ``blur_px`` is the standard deviation of the edges' profile, the pixel's own width included.
    """

    flat: Array
    covariance: Array
    blur_px: float


@dataclasses.dataclass(frozen=True)
class _Line:
    """A line by its normal, a point on it, and the variances of its offset there and of its angle (rad)."""

    normal: Array
    centre: Array
    variance: Array
    chi2_of_parts: float

    @property
    def along(self) -> Array:
        return np.array([-self.normal[1], self.normal[0]])


def fit_square(grey: Image, camera: Camera, corners: Array, cells: int, *, is_reversed: bool) -> CornerFit | None:
    """Fit a line to each edge of a square and intersect them, starting from corners (4, 2) in the image.

    ``cells`` is the square's edge in cells, ``is_reversed`` a white square on black. Lines are straight in
    undistorted pixels; the image is not resampled. Returns None where an edge cannot be read.
    """
    fit = None
    for _ in range(3):
        fit = _fit_once(grey, camera, corners, cells, is_reversed)
        if fit is None:
            return None
        corners = bend(camera, fit.flat)
    return fit


def _fit_once(grey: Image, camera: Camera, corners: Array, cells: int, is_reversed: bool) -> CornerFit | None:
    lines, blurs = [], []
    for i in range(4):
        points, blur = edge_points(grey, corners, i, cells, is_reversed=is_reversed)
        if len(points) < MIN_SAMPLES:
            return None
        lines.append(_fit_line(flatten(camera, points), float(np.linalg.norm(corners[(i + 1) % 4] - corners[i]))))
        blurs.append(blur)
    # How much more the means of parts vary than independent samples would
    excess = max(1.0, sum(line.chi2_of_parts for line in lines) / (4 * (N_PARTS - 2)))
    flat, slope = np.empty((4, 2)), np.zeros((8, 8))
    for j in range(4):
        before, after = lines[j - 1], lines[j]
        normals = np.array([before.normal, after.normal])
        if abs(np.linalg.det(normals)) < 1e-3:
            return None
        inverse = np.linalg.inv(normals)
        flat[j] = inverse @ [before.normal @ before.centre, after.normal @ after.centre]
        for column, (k, line) in enumerate((((j - 1) % 4, before), (j, after))):
            far = float((flat[j] - line.centre) @ line.along)
            slope[2 * j : 2 * j + 2, 2 * k : 2 * k + 2] += np.outer(inverse[:, column], [1.0, far])
    covariance = (slope * np.concatenate([line.variance for line in lines])) @ slope.T * excess
    return CornerFit(flat, covariance, float(np.median(blurs)))


def edge_points(grey: Image, corners: Array, i: int, cells: int, *, is_reversed: bool = False) -> tuple[Array, float]:
    """Return points (n, 2) in COLMAP pixels on the edge from corner i to the next, one per pixel, and their blur.

    Grey values are read along the tag's own direction across the edge, at most half a cell to either side: there is
    nothing but the black rim and the white margin. Each point is the centroid of their gradient: exact for any
    symmetric blur and for pixels that are boxes.
    """
    quad = np.roll(corners, -i, axis=0).astype(np.float32)
    square = np.array([[0, 0], [cells, 0], [cells, cells], [0, cells]], dtype=np.float32)
    image_from_tag = cv2.getPerspectiveTransform(square, quad)
    length = float(np.linalg.norm(quad[1] - quad[0]))
    across_px = float(np.linalg.norm(np.diff(_apply(image_from_tag, [[cells / 2, -0.5], [cells / 2, 0.5]]), axis=0)))
    margin = max(0.5, 1.5 * cells / max(length, 1e-9))
    half = min(0.5, 5.0 / max(across_px, 1e-9))
    n_along, n_across = int(length * (1 - 2 * margin / cells)), 2 * int(np.ceil(half * across_px / 0.25)) + 1
    if n_along < MIN_SAMPLES or half * across_px < 0.8:
        return np.empty((0, 2)), 0.0
    u, v = np.meshgrid(np.linspace(margin, cells - margin, min(n_along, 300)), np.linspace(half, -half, n_across))
    places = _apply(image_from_tag, np.column_stack([u.ravel(), v.ravel()])).reshape(*u.shape, 2)
    grid = (places - 0.5).astype(np.float32)
    values = cv2.remap(grey, grid[..., 0], grid[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    rise = np.diff(values.astype(np.float64), axis=0) * (-1.0 if is_reversed else 1.0)
    contrast = rise.sum(axis=0)
    inside = ((places > 0.5) & (places < (grey.shape[1] - 0.5, grey.shape[0] - 0.5))).all(axis=(0, 2))
    good = inside & (contrast > max(12.0, 0.5 * float(np.median(contrast))))
    middle = (places[1:] + places[:-1]) / 2
    points: Array = (rise[..., None] * middle).sum(axis=0)[good] / contrast[good, None]
    return points, _blur(rise[:, good], middle[:, good], points, quad[1] - quad[0])


def _blur(rise: Array, middle: Array, points: Array, along: Array) -> float:
    """Return the standard deviation of the edge's profile at right angles to it, in pixels."""
    if len(points) == 0:
        return 0.0
    normal = np.array([-along[1], along[0]]) / max(float(np.hypot(*along)), 1e-9)
    variance = (rise * ((middle - points) @ normal) ** 2).sum(axis=0) / rise.sum(axis=0)
    return float(np.sqrt(max(float(np.median(variance)), 0.0)))


def _apply(homography: Array, points: ArrayLike) -> Array:
    result: Array = cv2.perspectiveTransform(np.asarray(points, dtype=np.float64)[None], homography)[0]
    return result


def _fit_line(points: Array, length_px: float) -> _Line:
    """Fit a line robustly to points (n, 2) on an edge of so many pixels; its variances are those of the residuals."""
    weights = np.ones(len(points))
    normal, centre, residual, scale = np.zeros(2), np.zeros(2), np.zeros(len(points)), 0.0
    for _ in range(5):
        centre = np.average(points, axis=0, weights=weights)
        centred = points - centre
        normal = np.linalg.eigh((centred * weights[:, None]).T @ centred)[1][:, 0]
        residual = centred @ normal
        scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-4)
        weights = 1.0 / (1.0 + (residual / (2.5 * scale)) ** 4)
    place = centred @ np.array([-normal[1], normal[0]])
    n = len(points)
    variance = scale**2 * n / (n - 2)
    independent = max(float(weights.sum()) / n * min(n * SAMPLE_PX, length_px) / SAMPLE_PX, 3.0)
    parts = np.array_split(np.arange(n)[np.argsort(place)], N_PARTS)
    means = np.array([np.average(residual[p], weights=weights[p]) for p in parts])
    chi2 = float((means**2).sum()) / (variance * N_PARTS / independent)
    spread = float(np.average(place**2, weights=weights))
    return _Line(normal, centre, variance / independent * np.array([1.0, 1.0 / spread]), chi2)
