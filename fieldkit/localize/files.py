"""Localize image files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from fieldkit.cameras import Camera
from fieldkit.errors import LocalizeError
from fieldkit.features import read_image
from fieldkit.localize import Localizer
from fieldkit.types import Estimate

SUFFIXES = (".jpg", ".jpeg", ".png", ".pgm", ".bmp", ".tif", ".tiff")


def localize_files(
    localizer: Localizer,
    images: Path,
    camera: Camera,
    *,
    progress: Callable[[str, int, int], None] | None = None,
) -> list[tuple[str, Estimate]]:
    """Localize one image file, or all image files of a folder in the order of their names; return name and estimate.

    Raises LocalizeError when there is no image, or one of another size than the camera's.
    """
    images = Path(images)
    files = [images] if images.is_file() else sorted(p for p in images.glob("*") if p.suffix.lower() in SUFFIXES)
    if not files:
        raise LocalizeError(
            f"{images}: no image found; expected an image or a folder with {', '.join(SUFFIXES)}", hint="check the path"
        )
    result = []
    for number, file in enumerate(files, start=1):
        pixels = read_image(file, colour=localizer.takes_colour)
        if pixels.shape[:2] != (camera.height, camera.width):
            raise LocalizeError(
                f"{file}: is {pixels.shape[1]}x{pixels.shape[0]}; the camera says {camera.width}x{camera.height}",
                hint="give the camera with which the image was taken",
            )
        result.append((file.name, localizer.localize(pixels, camera)))
        if progress is not None:
            progress("localize", number, len(files))
    return result
