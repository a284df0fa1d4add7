"""The tag families: how each is laid out in cells, and the pattern of every tag."""

from __future__ import annotations

import ctypes
import dataclasses
import functools
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pupil_apriltags import Detector
from pupil_apriltags.bindings import _ApriltagFamily

from fieldkit.errors import TagError, suggestion
from fieldkit.types import TagMap

Bits = NDArray[np.uint8]


@dataclasses.dataclass(frozen=True)
class Family:
    """A tag family, in cells: the edge of the square whose corners count, and that of the whole pattern.

    The square is black on white; where ``is_reversed``, it is white on black and data lies outside of it as well.
    ``opencv`` is OpenCV's dictionary, and ``in_pupil`` whether pupil-apriltags finds the family. ``wrong_bits`` is how
    many bits of a code may be read wrongly: as many as leave a random square a chance below one in 5000 to be a tag,
    and AprilTag's table of codes below 200 MB.
    """

    name: str
    cells: int
    total: int
    is_reversed: bool = False
    opencv: int | None = None
    in_pupil: bool = True
    wrong_bits: int = 2


FAMILIES: dict[str, Family] = {
    f.name: f
    for f in (
        Family("tag36h11", 8, 10, opencv=cv2.aruco.DICT_APRILTAG_36h11),
        Family("tag25h9", 7, 9, opencv=cv2.aruco.DICT_APRILTAG_25h9, wrong_bits=1),
        Family("tag16h5", 6, 8, opencv=cv2.aruco.DICT_APRILTAG_16h5, wrong_bits=0),
        Family("tagCircle21h7", 5, 9, is_reversed=True, wrong_bits=0),
        Family("tagCircle49h12", 5, 11, is_reversed=True, wrong_bits=1),
        Family("tagCustom48h12", 6, 10, is_reversed=True, wrong_bits=1),
        Family("tagStandard41h12", 5, 9, is_reversed=True),
        Family("tagStandard52h13", 6, 10, is_reversed=True, wrong_bits=1),
        Family("tag36h10", 8, 10, opencv=cv2.aruco.DICT_APRILTAG_36h10, in_pupil=False),
    )
}


class _Undying(Detector):  # type: ignore[misc]
    """A detector that is never freed: the wrapper's destructor reads the family after freeing it and can abort."""

    def __del__(self) -> None:
        return


class PupilDetector(_Undying):
    """pupil-apriltags for one family, as AprilTag means its settings.

    The wrapper's own constructor rounds the sharpening to a whole number (AprilTag's 0.25 would be none) and tabulates
    all codes with two wrong bits, which takes gigabytes in the large families.
    """

    def __init__(self, family: Family, **settings: object) -> None:
        super().__init__(families="tag16h5", **settings)
        known = family_struct(family.name)
        self.libc.apriltag_detector_clear_families(self.tag_detector_ptr)
        self.libc.apriltag_detector_add_family_bits(self.tag_detector_ptr, known, family.wrong_bits)
        self.tag_families = {family.name: known}
        self.tag_detector_ptr.contents.decode_sharpening = float(self.params["decode_sharpening"])


@functools.lru_cache(maxsize=1)
def _library() -> Any:
    return _Undying(families="tag16h5").libc


@functools.lru_cache(maxsize=16)
def family_struct(family: str) -> Any:
    """Return AprilTag's own description of a family, which lives as long as the program."""
    create = getattr(_library(), f"{family}_create")
    create.restype = ctypes.POINTER(_ApriltagFamily)
    return create()


def check_families(tags: TagMap) -> None:
    """Raise TagError where a tag is of a family that nothing finds."""
    for tag in tags.tags:
        if tag.family not in FAMILIES:
            raise TagError(
                f"{tags.path}: tag {tag.id}: unknown tag family {tag.family!r}; expected one of {', '.join(FAMILIES)}",
                hint=suggestion(tag.family, list(FAMILIES)),
            )


def find_family(name: str) -> Family:
    """Return a family by name. Raises TagError for one that is unknown."""
    if name not in FAMILIES:
        raise TagError(f"unknown tag family {name!r}", hint=suggestion(name, list(FAMILIES)))
    return FAMILIES[name]


def pattern(family: str, tag_id: int) -> Bits:
    """Return a tag's cells uint8[total, total], 0 black and 1 white, as the AprilTag project prints it upright.

    Raises TagError for an unknown family or an id that the family does not have.
    """
    layout = find_family(family)
    count = family_size(family)
    if not 0 <= tag_id < count:
        raise TagError(f"{family} has no tag {tag_id}; expected an id in 0..{count - 1}")
    if layout.opencv is None:
        return _pupil_pattern(family, tag_id)
    dictionary = cv2.aruco.getPredefinedDictionary(layout.opencv)
    # OpenCV draws the same tag turned by 180 deg
    square = cv2.aruco.generateImageMarker(dictionary, tag_id, layout.cells)[::-1, ::-1]
    return np.pad(square // 255, 1, constant_values=1).astype(np.uint8)


@functools.lru_cache(maxsize=16)
def family_size(family: str) -> int:
    """Return the number of a family's tags; ids run from 0."""
    code = FAMILIES[family].opencv
    if code is None:
        return int(family_struct(family).contents.ncodes)
    return len(cv2.aruco.getPredefinedDictionary(code).bytesList)


def _pupil_pattern(family: str, tag_id: int) -> Bits:
    """Lay out the code as AprilTag 3 does: one white ring, then the bits, whose places may be outside of it."""
    layout, known = FAMILIES[family], family_struct(family).contents
    cells = np.zeros((layout.total, layout.total), dtype=np.uint8)
    ring = layout.cells + (0 if layout.is_reversed else 2)
    first = (layout.total - ring) // 2
    last = first + ring - 1
    cells[[first, last], first : last + 1] = 1
    cells[first : last + 1, [first, last]] = 1
    border, code = (layout.total - layout.cells) // 2, int(known.codes[tag_id])
    for i in range(known.nbits):
        if code >> (known.nbits - i - 1) & 1:
            # Stored as signed numbers
            x, y = ctypes.c_int32(known.bit_x[i]).value, ctypes.c_int32(known.bit_y[i]).value
            cells[y + border, x + border] = 1
    return cells
