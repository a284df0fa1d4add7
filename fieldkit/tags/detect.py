"""Find AprilTags in an image: a detector for the ids, then corners and their noise from the image itself."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from fieldkit.cameras import Camera
from fieldkit.errors import TagError
from fieldkit.tags.detectors import FoundTag, find_detector
from fieldkit.tags.edges import CornerFit, fit_square
from fieldkit.tags.families import Family, find_family
from fieldkit.tags.lens import bend, bent_covariance, flatten
from fieldkit.tags.matching import fit_pattern, misplacement_px
from fieldkit.types import Image

Array = NDArray[np.float64]

# What no residual shows: a blur that is no Gaussian, as measured on renders without a lens (docs/detection.md)
UNSEEN_SIGMA_PX = 0.02
# What lines miss where the pattern cannot be fitted: a lens blurs light, so that white grows into black
LINES_SIGMA_PX = 0.4
# The least for corners as a detector leaves them, where neither pattern nor edges could be fitted
COARSE_SIGMA_PX = 0.6
# Blur from which a pattern's fit starts where no edge shows it
SHARP_BLUR_PX = 0.7
# How far a fit may move a detector's corners, in pixels and in cells of the longest edge
MAX_MOVE_PX, MAX_MOVE_CELLS = 2.0, 1.0


@dataclasses.dataclass(frozen=True)
class TagDetection:
    """A tag in an image: id, family, corners f64[4, 2] in COLMAP pixels, and their noise per axis in pixels.

    Corners in the order bottom-left, bottom-right, top-right, top-left of the upright tag, distortion included.
    ``covariance_px`` is the 8x8 covariance of the corners' pixels where it is known, ``sigma_px`` its root mean square.
    """

    id: int
    family: str
    corners_px: Array
    sigma_px: float
    covariance_px: Array | None = None

    @property
    def edge_px(self) -> float:
        """Length of the shortest edge in pixels."""
        return float(np.linalg.norm(self.corners_px - np.roll(self.corners_px, -1, axis=0), axis=1).min())

    @property
    def noise_px(self) -> Array:
        """Covariance f64[8, 8] of the corners: as estimated, else ``sigma_px`` in every coordinate."""
        return self.sigma_px**2 * np.eye(8) if self.covariance_px is None else self.covariance_px


def detect(
    image: Image, camera: Camera, *, families: Sequence[str] = ("tag36h11",), detector: str | None = None
) -> list[TagDetection]:
    """Find tags in an image uint8[h, w] (grey) or uint8[h, w, 3] (RGB), sorted by id and position.

    Corners come from the tag's whole pattern, fitted in undistorted coordinates; the photo itself is not resampled.
    Their covariance is what the fit's residuals show. ``detector`` is one of `DETECTORS`; without it each family has
    its own. Raises TagError for an unknown family or detector, one that does not find the family, or an image of
    another size than the camera.
    """
    chosen = [(find_family(family), find_detector(family, detector)) for family in dict.fromkeys(families)]
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise TagError(
            f"image of {width}x{height} pixels with a camera of {camera.width}x{camera.height}; expected the same size",
            hint="give the camera that took the image",
        )
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else np.ascontiguousarray(image)
    found = [_refine(grey, camera, family, tag) for family, finder in chosen for tag in finder.find(grey, family)]
    return sorted(found, key=lambda d: (d.id, d.family, tuple(d.corners_px.mean(axis=0))))


def _refine(grey: Image, camera: Camera, family: Family, found: FoundTag) -> TagDetection:
    """Fit the tag's pattern, from lines along its edges; else keep the lines' corners, else the detector's."""
    coarse = TagDetection(found.id, family.name, found.corners_px, COARSE_SIGMA_PX)
    edges = np.linalg.norm(found.corners_px - np.roll(found.corners_px, -1, axis=0), axis=1)
    cell_px = float(edges.max()) / family.cells
    limit = max(MAX_MOVE_PX, MAX_MOVE_CELLS * cell_px)
    fit = fit_square(grey, camera, found.corners_px, family.cells, is_reversed=family.is_reversed)
    if fit is not None and _moved(camera, fit, found) > limit:
        fit = None
    start = fit or CornerFit(flatten(camera, found.corners_px), np.eye(8), SHARP_BLUR_PX)
    whole = fit_pattern(grey, camera, family, found.id, start)
    unseen = LINES_SIGMA_PX
    if whole is not None and _moved(camera, whole, found) <= limit:
        fit, unseen = whole, UNSEEN_SIGMA_PX
    if fit is None:
        off = misplacement_px(grey, camera, family, found.id, start)
        # At the image's border the quad may end where the image does, though the tag goes on
        edge = np.minimum(found.corners_px, np.array(grey.shape[::-1]) - found.corners_px).min()
        cut = cell_px if edge < cell_px else 0.0
        return dataclasses.replace(coarse, sigma_px=max(COARSE_SIGMA_PX, off, cut))
    covariance = bent_covariance(camera, fit.flat, fit.covariance) + unseen**2 * np.eye(8)
    sigma = float(np.sqrt(np.trace(covariance) / 8))
    return dataclasses.replace(coarse, corners_px=bend(camera, fit.flat), sigma_px=sigma, covariance_px=covariance)


def _moved(camera: Camera, fit: CornerFit, found: FoundTag) -> float:
    return float(np.linalg.norm(bend(camera, fit.flat) - found.corners_px, axis=1).max())
