"""Draw AprilTags the way the AprilTag project prints them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import TagError
from fieldkit.tags.families import FAMILIES, find_family, pattern

# Families of a closed black square, as sheets print them -> its edge length in cells
DRAWN_FAMILIES: dict[str, int] = {f.name: f.cells for f in FAMILIES.values() if not f.is_reversed}


def draw_tag(family: str, tag_id: int, *, cell_px: int = 8, border_cells: int = 1) -> NDArray[np.uint8]:
    """Draw a tag upright as the AprilTag project prints it: x of the tag frame to the right, y up.

    Returns uint8[n, n] with n = cell_px * (cells of the square + 2 * border_cells); the edge of the square, black on
    white or in newer families white on black, is the tag's ``size_m``. Families with data outside of the square need
    two or three cells of border to be whole. OpenCV draws the same tag turned by 180 deg.
    Raises TagError for an unknown family or an id that the family does not have.
    """
    layout = find_family(family)
    if cell_px < 1 or border_cells < 0:
        raise TagError(f"cannot draw a tag with cell_px={cell_px}, border_cells={border_cells}; expected >= 1 and >= 0")
    cells, around = pattern(family, tag_id), border_cells - (layout.total - layout.cells) // 2
    if around < 0:
        cells = cells[-around:around, -around:around]
    square = np.kron(cells * 255, np.ones((cell_px, cell_px))).astype(np.uint8)
    return np.pad(square, max(around, 0) * cell_px, constant_values=255)
