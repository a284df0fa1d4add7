"""Images as features take them: read from files as stored, grey or RGB."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from fieldkit.errors import FeatureError
from fieldkit.types import Image


def to_grey(image: Image) -> Image:
    """Return uint8[h, w] of a grey or RGB image; raises FeatureError for any other array."""
    _refuse_other(image)
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return np.ascontiguousarray(grey, dtype=np.uint8)


def to_colour(image: Image) -> Image:
    """Return uint8[h, w, 3] of a grey or RGB image, grey repeated; raises FeatureError for any other array."""
    _refuse_other(image)
    colour = image if image.ndim == 3 else np.repeat(image[:, :, None], 3, axis=2)
    return np.ascontiguousarray(colour, dtype=np.uint8)


def _refuse_other(image: Image) -> None:
    if (
        image.dtype != np.uint8
        or image.ndim not in (2, 3)
        or image.size == 0
        or (image.ndim == 3 and image.shape[2] != 3)
    ):
        raise FeatureError(
            f"image is {image.dtype}{list(image.shape)}; expected uint8[h, w] grey or uint8[h, w, 3] RGB"
        )


def read_grey(path: Path) -> Image:
    """Read an image file as uint8[h, w], as stored: a camera's calibration knows nothing of EXIF turns.

    Colours become grey as `to_grey` makes them, so that a file and the same image in a recording are equal. Raises
    FeatureError when the file is missing or no readable image.
    """
    return to_grey(read_image(path, colour=True))


def read_image(path: Path, *, colour: bool) -> Image:
    """Read an image file as `read_grey` does, or with ``colour`` as RGB uint8[h, w, 3], grey files repeated."""
    return np.ascontiguousarray(_read(path)[:, :, ::-1]) if colour else read_grey(path)


def _read(path: Path) -> Image:
    if not Path(path).is_file():
        raise FeatureError(f"{path}: no such file; expected an image", hint="check the path")
    image = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise FeatureError(f"{path}: cannot be read as an image; expected JPEG or PNG", hint="check or remove the file")
    return np.asarray(image, dtype=np.uint8)
