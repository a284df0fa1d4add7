"""Draw AprilTags the way the AprilTag project prints them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import TagError, suggestion

# Family -> OpenCV's dictionary and the edge length of the black square in cells
DRAWN_FAMILIES: dict[str, tuple[int, int]] = {
    "tag36h11": (cv2.aruco.DICT_APRILTAG_36h11, 8),
    "tag36h10": (cv2.aruco.DICT_APRILTAG_36h10, 8),
    "tag25h9": (cv2.aruco.DICT_APRILTAG_25h9, 7),
    "tag16h5": (cv2.aruco.DICT_APRILTAG_16h5, 6),
}


def draw_tag(family: str, tag_id: int, *, cell_px: int = 8, border_cells: int = 1) -> NDArray[np.uint8]:
    """Draw a tag upright as the AprilTag project prints it: x of the tag frame to the right, y up.

    Returns uint8[n, n] with n = cell_px * (cells of the black square + 2 * border_cells); the edge of the black
    square is the tag's ``size_m``, the border outside of it is white. OpenCV draws the same tag turned by 180 deg.
    Raises TagError for a family that cannot be drawn or an id that the family does not have.
    """
    if family not in DRAWN_FAMILIES:
        raise TagError(f"cannot draw tag family {family!r}", hint=suggestion(family, list(DRAWN_FAMILIES)))
    if cell_px < 1 or border_cells < 0:
        raise TagError(f"cannot draw a tag with cell_px={cell_px}, border_cells={border_cells}; expected >= 1 and >= 0")
    name, cells = DRAWN_FAMILIES[family]
    dictionary = cv2.aruco.getPredefinedDictionary(name)
    count = len(dictionary.bytesList)
    if not 0 <= tag_id < count:
        raise TagError(f"{family} has no tag {tag_id}; expected an id in 0..{count - 1}")
    square = cv2.aruco.generateImageMarker(dictionary, tag_id, cells * cell_px)[::-1, ::-1]
    return np.pad(square, border_cells * cell_px, constant_values=255).astype(np.uint8)


def family_cells(family: str) -> int | None:
    """Return the edge length of the black square in cells, or None for a family without a closed black square."""
    return DRAWN_FAMILIES[family][1] if family in DRAWN_FAMILIES else None
