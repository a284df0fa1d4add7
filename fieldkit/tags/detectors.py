"""The tag detectors, behind one interface: a grey image and a family in, ids and corners out."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import TagError, suggestion
from fieldkit.tags.families import FAMILIES, Family, PupilDetector, find_family
from fieldkit.types import Image

Array = NDArray[np.float64]

# Both search an image of at most this edge length first; corners are refined at full size all the same
SEARCH_EDGE_PX = 1600
# What pupil-apriltags' decision between black and white must be clear by
MIN_MARGIN = 20.0


@dataclasses.dataclass(frozen=True)
class FoundTag:
    """An id and its corners f64[4, 2] as a detector has them.

    Bottom-left, bottom-right, top-right, top-left of the upright tag; COLMAP pixels.
    """

    id: int
    corners_px: Array


@dataclasses.dataclass(frozen=True)
class TagDetector:
    """A detector: its name, the families that it finds, and how it finds one of them in uint8[h, w]."""

    name: str
    families: tuple[str, ...]
    find: Callable[[Image, Family], list[FoundTag]]


def _find_pupil(grey: Image, family: Family) -> list[FoundTag]:
    coarse = float(max(1, round(max(grey.shape) / SEARCH_EDGE_PX)))
    for decimate in dict.fromkeys((coarse, max(1.0, coarse / 2))):
        found = _pupil(family, decimate).detect(grey)
        # Its corners are in our order, and the centre of its first pixel is (0.5, 0.5)
        tags = [
            FoundTag(int(r.tag_id), np.array(r.corners, dtype=np.float64))
            for r in found
            if r.decision_margin >= MIN_MARGIN
        ]
        if tags:
            return tags
    return []


@functools.lru_cache(maxsize=64)
def _pupil(family: Family, decimate: float) -> PupilDetector:
    # One family each: given several, pupil-apriltags silently uses only the first. Its own refinement of the edges
    # moves those of small tags so far that they are not decoded; ours comes after
    return PupilDetector(family, nthreads=1, quad_decimate=decimate, refine_edges=0)


def _find_opencv(grey: Image, family: Family) -> list[FoundTag]:
    assert family.opencv is not None
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_CONTOUR
    # Its default loses whole tags up to 20 px away from the border
    settings.minDistanceToBorder = 0
    scale = min(1.0, SEARCH_EDGE_PX / max(grey.shape))
    small = grey if scale == 1.0 else cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(family.opencv), settings)
    corners, ids, _ = detector.detectMarkers(small)
    # OpenCV's tag is turned by 180 deg, its corners run clockwise, and its first pixel's centre is (0, 0)
    size = np.array([grey.shape[1] / small.shape[1], grey.shape[0] / small.shape[0]])
    return [
        FoundTag(int(tag_id), (quad[0][[1, 0, 3, 2]].astype(np.float64) + 0.5) * size)
        for quad, tag_id in zip(corners, [] if ids is None else ids.ravel(), strict=True)
    ]


# In the order of preference: a family is looked for by the first that finds it, where none is chosen
DETECTORS: dict[str, TagDetector] = {
    d.name: d
    for d in (
        TagDetector("pupil", tuple(f.name for f in FAMILIES.values() if f.in_pupil), _find_pupil),
        TagDetector("opencv", tuple(f.name for f in FAMILIES.values() if f.opencv is not None), _find_opencv),
    )
}


def find_detector(family: str, name: str | None = None) -> TagDetector:
    """Return the detector of that name, or the first that finds a family.

    Raises TagError for an unknown family or detector, or a detector that does not find the family.
    """
    find_family(family)
    if name is None:
        return next(d for d in DETECTORS.values() if family in d.families)
    if name not in DETECTORS:
        raise TagError(f"unknown tag detector {name!r}", hint=suggestion(name, list(DETECTORS)))
    if family not in DETECTORS[name].families:
        able = ", ".join(d.name for d in DETECTORS.values() if family in d.families)
        raise TagError(
            f"{name} finds no {family}; expected one of {', '.join(DETECTORS[name].families)}",
            hint=f"take {able}, or leave the choice to the family",
        )
    return DETECTORS[name]
