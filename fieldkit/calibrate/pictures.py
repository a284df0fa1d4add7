"""What photo files hold besides the picture: format, depth, rotation, and the camera that took them."""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from PIL import ExifTags, UnidentifiedImageError
from PIL import Image as PillowImage

from fieldkit.errors import TagError
from fieldkit.types import Image

log = logging.getLogger(__name__)

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png")
# Formats of phones and cameras that are not read, and how to make JPEGs of them
FOREIGN_SUFFIXES = {
    **dict.fromkeys((".heic", ".heif", ".hif", ".avif"), "HEIC"),
    **dict.fromkeys((".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"), "raw"),
    **dict.fromkeys((".tif", ".tiff", ".webp", ".bmp"), "other"),
}
HEIC_BRANDS = (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1", b"avif")
CONVERT_HINT = (
    "convert to JPEG at full size without turning the pixels, for example `magick mogrify -format jpg *.HEIC`; on an "
    "iPhone choose Settings > Camera > Formats > Most Compatible"
)
# EXIF orientations that show the photo turned by a quarter
QUARTER_TURNS = (5, 6, 7, 8)
# Focal lengths that differ by more than this share are two; EXIF's and a calibration's, in whole millimetres of film
SAME_FOCAL, SAME_CALIBRATION = 0.02, 0.25
FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
# The brightest of 16-bit pixels: this quantile becomes white
WHITE_QUANTILE = 0.999


@dataclasses.dataclass(frozen=True)
class PhotoHeader:
    """Stored size in pixels, EXIF's orientation (1 upright), camera, lens, focal lengths in mm; None unknown."""

    width: int
    height: int
    orientation: int = 1
    camera: str | None = None
    lens: str | None = None
    focal_mm: float | None = None
    focal_film_mm: float | None = None
    zoom: float | None = None
    bits: int = 8


def foreign_format(path: Path) -> str | None:
    """Name a photo's format where it is one that is not read, by its first bytes or its suffix."""
    try:
        with path.open("rb") as file:
            head = file.read(12)
    except OSError:
        return None
    if head[4:8] == b"ftyp" and head[8:12] in HEIC_BRANDS:
        return "HEIC"
    return FOREIGN_SUFFIXES.get(path.suffix.lower())


def refuse_foreign(path: Path) -> None:
    """Raise TagError where a photo's format is one that is not read."""
    kind = foreign_format(path)
    if kind is not None:
        name = {"HEIC": "a HEIC photo", "raw": "a raw photo"}.get(kind, f"a {path.suffix.lstrip('.')} file")
        raise TagError(f"{path}: {name} cannot be read; expected JPEG or PNG", hint=CONVERT_HINT)


def read_header(path: Path) -> PhotoHeader | None:
    """Read size and EXIF of a photo without its pixels; None where it is no image."""
    try:
        with PillowImage.open(path) as image:
            exif = image.getexif()
            size = image.size
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError):
        return None
    shot = exif.get_ifd(ExifTags.IFD.Exif)
    orientation = exif.get(ExifTags.Base.Orientation, 1)
    words = [_text(exif.get(ExifTags.Base.Make)), _text(exif.get(ExifTags.Base.Model))]
    return PhotoHeader(
        *size,
        orientation=orientation if orientation in range(1, 9) else 1,
        camera=" ".join(w for w in words if w) or None,
        lens=_text(shot.get(ExifTags.Base.LensModel)),
        focal_mm=_positive(shot.get(ExifTags.Base.FocalLength)),
        focal_film_mm=_positive(shot.get(ExifTags.Base.FocalLengthIn35mmFilm)),
        zoom=_positive(shot.get(ExifTags.Base.DigitalZoomRatio)),
        bits=_png_bits(path),
    )


def _png_bits(path: Path) -> int:
    with path.open("rb") as file:
        head = file.read(25)
    return head[24] if len(head) == 25 and head.startswith(b"\x89PNG") else 8


def _text(value: object) -> str | None:
    return (" ".join(value.replace("\0", " ").split()) or None) if isinstance(value, str) else None


def _positive(value: object) -> float | None:
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None


MUST_AGREE: dict[str, Callable[[PhotoHeader], str | None]] = {
    "sizes": lambda h: f"{h.width}x{h.height}",
    "cameras": lambda h: h.camera,
    "lenses": lambda h: h.lens,
    "focal lengths": lambda h: None if h.focal_mm is None else f"{h.focal_mm:g} mm",
    "digital zooms": lambda h: None if h.zoom is None else f"{h.zoom:g}x",
}


def refuse_mixture(headers: Mapping[str, PhotoHeader], camera_path: Path) -> None:
    """Raise TagError where photos that share a camera file differ in size, camera, lens or focal length.

    What a photo's EXIF does not say is not compared.
    """
    for what, of in MUST_AGREE.items():
        groups: dict[str, list[str]] = {}
        for file, header in headers.items():
            value = of(header)
            if value is not None:
                groups.setdefault(value, []).append(file)
        if len(groups) > 1 and not (what == "focal lengths" and _nearly_same(headers.values())):
            named = ", ".join(f"{value} ({_some(files)})" for value, files in groups.items())
            raise TagError(
                f"{camera_path}: its photos are of {len(groups)} {what}: {named}; expected those of one camera, lens "
                "and zoom",
                hint="calibrate each camera and name its file for each photo in photos.toml, or leave photos out",
            )


def _nearly_same(headers: Iterable[PhotoHeader]) -> bool:
    focal = [h.focal_mm for h in headers if h.focal_mm is not None]
    return max(focal) <= (1 + SAME_FOCAL) * min(focal)


def _some(files: Sequence[str]) -> str:
    return files[0] if len(files) == 1 else f"{files[0]} and {len(files) - 1} more"


def refuse_other_size(path: Path, header: PhotoHeader, size: tuple[int, int], camera_path: Path) -> None:
    """Raise TagError where the stored pixels are not of the camera's size, with the likely reason.

    EXIF's orientation is ignored: a calibration is that of the sensor's pixels.
    """
    if (header.width, header.height) == size:
        return
    stored, expected = f"{header.width}x{header.height}", f"{size[0]}x{size[1]}"
    text = f"{path}: {stored} pixels; expected {expected} as in {camera_path}"
    hint = "give the calibration of this camera at this resolution"
    if (header.height, header.width) == size and header.orientation in QUARTER_TURNS:
        text = (
            f"{path}: {stored} pixels are stored, which EXIF (orientation {header.orientation}) shows turned to "
            f"{expected}; expected pixels as calibrated in {camera_path}"
        )
        hint = "calibrate with the pixels as stored, or turn the pixels themselves and drop EXIF's orientation"
    elif (header.height, header.width) == size:
        hint = "the photo or the calibration was turned by a quarter: use the pixels as the sensor has them"
    elif header.width * size[1] == header.height * size[0]:
        hint = f"{hint}: the photo has {header.width / size[0]:.4g} times its width"
    raise TagError(text, hint=hint)


def warn_focal(path: Path, header: PhotoHeader, focal_px: float, camera_path: Path) -> None:
    """Warn where EXIF's focal length contradicts the calibration's: that of another camera or zoom."""
    if header.focal_film_mm is None:
        return
    shown_px = header.focal_film_mm / FILM_DIAGONAL_MM * math.hypot(header.width, header.height)
    if abs(math.log(shown_px / focal_px)) > SAME_CALIBRATION:
        log.warning(
            "%s: EXIF says a focal length of about %.0f px, %s has %.0f px; is this the calibration of this camera?",
            path, shown_px, camera_path, focal_px,
        )  # fmt: skip


def is_cut_short(path: Path) -> bool:
    """Tell whether a file begins as a JPEG but has no end of image (ITU T.81, B.2.1) in its last megabyte."""
    try:
        with path.open("rb") as file:
            if file.read(3) != b"\xff\xd8\xff":
                return False
            file.seek(max(0, path.stat().st_size - 2**20))
            return b"\xff\xd9" not in file.read()
    except OSError:
        return False


def read_pixels(path: Path, *, colour: bool = False) -> Image | None:
    """Read the stored pixels of a photo as grey uint8[h, w] or RGB uint8[h, w, 3], None where it is no image.

    EXIF's rotation is not applied. Of 16-bit pixels, linear or not, black stays and the brightest become white. A JPEG
    that is cut short counts as no image: decoders fill the rest with grey.
    """
    if is_cut_short(path):
        return None
    kind = cv2.IMREAD_COLOR if colour else cv2.IMREAD_GRAYSCALE
    image = cv2.imread(str(path), kind | cv2.IMREAD_IGNORE_ORIENTATION | cv2.IMREAD_ANYDEPTH)
    if image is None:
        return None
    if colour:
        image = np.ascontiguousarray(image[:, :, ::-1])
    if image.dtype == np.uint8:
        return np.asarray(image)
    white = max(float(np.quantile(image, WHITE_QUANTILE)), 1.0)
    scaled: Image = np.clip(np.round(image.astype(np.float32) * (255.0 / white)), 0, 255).astype(np.uint8)
    return scaled
