"""Find AprilTags in an image: pupil-apriltags or OpenCV, then sub-pixel edges; one corner order, COLMAP pixels."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pupil_apriltags import Detector

from fieldkit.cameras import Camera
from fieldkit.errors import TagError, suggestion
from fieldkit.tags.drawing import DRAWN_FAMILIES, family_cells
from fieldkit.types import Image

Array = NDArray[np.float64]

PUPIL_FAMILIES = (
    "tag36h11", "tag25h9", "tag16h5", "tagCircle21h7", "tagCircle49h12", "tagCustom48h12", "tagStandard41h12",
    "tagStandard52h13",
)  # fmt: skip
OPENCV_FAMILIES = ("tag36h10",)
FAMILIES = (*PUPIL_FAMILIES, *OPENCV_FAMILIES)

# Corner noise of the plain detectors, and what no fit of the edges gets below (residual lens error, uneven print)
COARSE_SIGMA_PX = 0.3
FLOOR_SIGMA_PX = 0.05
# Blur reaches from cell to cell in small tags: measured on renders, inverse to the height of a cell in pixels
SMALL_SIGMA_PX = 0.25
# Both detectors search an image of at most this edge length first; the edges are always refined at full size
SEARCH_EDGE_PX = 1600
MIN_MARGIN = 20.0


@dataclasses.dataclass(frozen=True)
class TagDetection:
    """A tag in an image: id, family, corners f64[4, 2] in COLMAP pixels, and their noise per axis in pixels.

    Corners in the order bottom-left, bottom-right, top-right, top-left of the upright tag, distortion included.
    """

    id: int
    family: str
    corners_px: Array
    sigma_px: float

    @property
    def edge_px(self) -> float:
        """Length of the shortest edge in pixels."""
        return float(np.linalg.norm(self.corners_px - np.roll(self.corners_px, -1, axis=0), axis=1).min())


class _KeptDetector(Detector):  # type: ignore[misc]
    """A detector that is never freed: the library's destructor reads the family after freeing it and can abort."""

    def __del__(self) -> None:
        return


def detect(image: Image, camera: Camera, *, families: Sequence[str] = ("tag36h11",)) -> list[TagDetection]:
    """Find tags in an image uint8[h, w] (grey) or uint8[h, w, 3] (RGB), sorted by id and position.

    Corners come from lines fitted to the tag's edges where the lines are straight: in undistorted coordinates. The
    photo itself is not resampled. Raises TagError for an unknown family or an image of another size than the camera.
    """
    for family in families:
        if family not in FAMILIES:
            raise TagError(f"unknown tag family {family!r}", hint=suggestion(family, FAMILIES))
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise TagError(
            f"image of {width}x{height} pixels with a camera of {camera.width}x{camera.height}; expected the same size",
            hint="give the camera that took the image",
        )
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else np.ascontiguousarray(image)
    coarse = [found for family in dict.fromkeys(families) for found in _find(grey, family)]
    refined = [_refine(grey, camera, found) for found in coarse]
    return sorted(refined, key=lambda d: (d.id, d.family, tuple(d.corners_px.mean(axis=0))))


def _find(grey: Image, family: str) -> list[TagDetection]:
    longest = max(grey.shape)
    if family in OPENCV_FAMILIES:
        return _find_opencv(grey, family)
    coarse = float(max(1, round(longest / SEARCH_EDGE_PX)))
    found = _find_pupil(grey, family, coarse)
    return found if found or coarse == 1.0 else _find_pupil(grey, family, max(1.0, coarse / 2))


def _find_pupil(grey: Image, family: str, decimate: float) -> list[TagDetection]:
    # Its corners: bottom-left, bottom-right, top-right, top-left of the upright tag, first pixel's centre at 0.5, 0.5
    return [
        TagDetection(int(r.tag_id), family, np.array(r.corners, dtype=np.float64), COARSE_SIGMA_PX)
        for r in _pupil(family, decimate).detect(grey)
        if r.hamming <= 1 and r.decision_margin >= MIN_MARGIN
    ]


@functools.lru_cache(maxsize=64)
def _pupil(family: str, decimate: float) -> Detector:
    # One family each: given several, pupil-apriltags silently uses only the first
    return _KeptDetector(families=family, nthreads=1, quad_decimate=decimate)


def _find_opencv(grey: Image, family: str) -> list[TagDetection]:
    dictionary = cv2.aruco.getPredefinedDictionary(DRAWN_FAMILIES[family][0])
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(grey)
    # OpenCV's tag is turned by 180 deg, its corners run clockwise, and its first pixel's centre is (0, 0)
    return [
        TagDetection(int(tag_id), family, quad[0][[1, 0, 3, 2]].astype(np.float64) + 0.5, COARSE_SIGMA_PX)
        for quad, tag_id in zip(corners, [] if ids is None else ids.ravel(), strict=True)
    ]


def _refine(grey: Image, camera: Camera, found: TagDetection) -> TagDetection:
    """Fit a line to each edge of the black square and intersect them; keep the coarse corners where that fails."""
    cells = family_cells(found.family)
    if cells is None:
        return found
    corners, sigma = found.corners_px, COARSE_SIGMA_PX
    for _ in range(3):
        fitted = _fit_corners(grey, camera, corners, cells)
        if fitted is None:
            return found
        corners, sigma = fitted
    moved = float(np.linalg.norm(corners - found.corners_px, axis=1).max())
    if moved > max(2.0, 0.5 * found.edge_px / cells):
        return found
    return dataclasses.replace(found, corners_px=corners, sigma_px=sigma)


def _fit_corners(grey: Image, camera: Camera, corners: Array, cells: int) -> tuple[Array, float] | None:
    focal = np.asarray(camera.focal_px)
    lines, variances = [], []
    for i in range(4):
        points = _edge_points(grey, corners, i, cells)
        if len(points) < 6:
            return None
        # Undistorted coordinates in units of pixels
        line, residual = _fit_line(camera.unproject(points)[:, :2] * focal)
        lines.append(line)
        # Neighbouring samples share pixels: about one independent sample per 1.5 px; at its end a line is known
        # with four times the variance of its middle
        length = float(np.linalg.norm(corners[(i + 1) % 4] - corners[i]))
        variances.append(4.0 * residual**2 / max(length / 1.5, 4.0))
    meeting = np.array([np.cross(lines[i - 1], lines[i]) for i in range(4)])
    if (np.abs(meeting[:, 2]) < 1e-9).any():
        return None
    xy = meeting[:, :2] / meeting[:, 2:] / focal
    floor = FLOOR_SIGMA_PX**2 + (SMALL_SIGMA_PX / _cell_px(corners, cells)) ** 2
    return camera.distort(xy) * focal + camera.centre_px, float(np.sqrt(np.mean(variances) + floor))


def _cell_px(corners: Array, cells: int) -> float:
    """Return the height of a cell across the longest edge: what foreshortening leaves of it."""
    (ax, ay), (bx, by) = corners[2] - corners[0], corners[3] - corners[1]
    longest = float(np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1).max())
    return max(float(abs(ax * by - ay * bx)) / 2 / longest / cells, 0.1)


def _edge_points(grey: Image, corners: Array, i: int, cells: int) -> Array:
    """Return points (n, 2) in COLMAP pixels on the edge from corner i to the next, about one per pixel of its length.

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
    if n_along < 6 or half * across_px < 0.8:
        return np.empty((0, 2))
    u, v = np.meshgrid(np.linspace(margin, cells - margin, min(n_along, 300)), np.linspace(half, -half, n_across))
    places = _apply(image_from_tag, np.column_stack([u.ravel(), v.ravel()])).reshape(*u.shape, 2)
    grid = (places - 0.5).astype(np.float32)
    values = cv2.remap(grey, grid[..., 0], grid[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    rise = np.diff(values.astype(np.float64), axis=0)
    contrast = rise.sum(axis=0)
    inside = ((places > 0.5) & (places < (grey.shape[1] - 0.5, grey.shape[0] - 0.5))).all(axis=(0, 2))
    good = inside & (contrast > max(12.0, 0.5 * float(np.median(contrast))))
    middle = (places[1:] + places[:-1]) / 2
    points: Array = (rise[..., None] * middle).sum(axis=0)[good] / contrast[good, None]
    return points


def _apply(homography: Array, points: ArrayLike) -> Array:
    result: Array = cv2.perspectiveTransform(np.asarray(points, dtype=np.float64)[None], homography)[0]
    return result


def _fit_line(points: Array) -> tuple[Array, float]:
    """Return the line (a, b, c) with a x + b y + c = 0 and a^2 + b^2 = 1, and the robust residual in pixels."""
    weights = np.ones(len(points))
    line, scale = np.zeros(3), 0.0
    for _ in range(5):
        centre = np.average(points, axis=0, weights=weights)
        centred = points - centre
        normal = np.linalg.eigh((centred * weights[:, None]).T @ centred)[1][:, 0]
        line = np.array([*normal, -normal @ centre])
        residual = np.abs(points @ normal + line[2])
        scale = max(1.4826 * float(np.median(residual)), 1e-4)
        weights = 1.0 / (1.0 + (residual / (2.5 * scale)) ** 4)
    return line, scale
