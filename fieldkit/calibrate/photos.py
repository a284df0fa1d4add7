"""The photos of a folder: which there are, with which camera, and which tags they show."""

from __future__ import annotations

import dataclasses
import logging
import math
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NoReturn

import cv2
import numpy as np

from fieldkit.calibrate import pictures
from fieldkit.cameras import Camera
from fieldkit.errors import TagError
from fieldkit.store import calibration_file, read_camera, read_photos
from fieldkit.tags import TagDetection, detect
from fieldkit.tags.detectors import find_detector
from fieldkit.tags.families import FAMILIES
from fieldkit.types import Image, TagPhoto

log = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]

# Smaller tags show little of their tilt, and are taken for others more easily
MIN_CELL_PX = 3.0
# Blur of this share of a cell mixes it with its neighbours
MAX_BLUR_CELLS = 0.3
# Share of pixels that lie on steep edges: of a tag, of a whole photo
TAG_EDGES, PHOTO_EDGES = 0.005, 0.0002
# Blur of a whole photo, in widths of it, that explains why nothing was found
MAX_BLUR_WIDTHS = 1 / 300


def parse_sizes(texts: Sequence[str]) -> dict[int | None, float]:
    """Parse sizes in m: ``0.1365`` for every tag (key None), ``3:0.30`` for tag 3. Raises TagError."""
    sizes: dict[int | None, float] = {}
    for text in texts:
        head, colon, tail = text.rpartition(":")
        try:
            tag_id, size_m = (int(head) if colon else None), float(tail)
        except ValueError:
            tag_id, size_m = None, math.nan
        if not math.isfinite(size_m) or size_m <= 0:
            raise TagError(
                f"--size-m {text}: not a tag size; expected metres (0.1365) or ID:METRES (3:0.30)",
                hint="measure the edge of the tag's black square",
            )
        if tag_id in sizes:
            raise TagError(f"--size-m {text}: given twice for {'every tag' if tag_id is None else f'tag {tag_id}'}")
        if not 0.01 <= size_m <= 3.0:
            raise TagError(f"--size-m {text}: {size_m:g} m is no tag's edge; expected metres, 0.01 to 3")
        sizes[tag_id] = size_m
    if not sizes:
        raise TagError("no tag size; expected --size-m METRES", hint="measure the edge of the tag's black square")
    return sizes


@dataclasses.dataclass(frozen=True)
class Photo:
    """A photo as listed: its name, its file, the camera that took it, and the visit that it names."""

    file: str
    path: Path
    camera: Camera
    camera_path: Path
    visit: str | None = None


@dataclasses.dataclass(frozen=True)
class Shot:
    """A photo, the tags in it that can be calibrated, and all that were found."""

    photo: Photo
    usable: tuple[TagDetection, ...]
    found: tuple[TagDetection, ...]


def list_photos(folder: Path, camera: Path | None) -> list[Photo]:
    """List the photos of a folder in order, with their cameras; raises TagError or StoreError."""
    if not folder.is_dir():
        raise TagError(f"{folder}: no such folder; expected a folder with photos of tags")
    if (folder / "photos.toml").is_file():
        entries = read_photos(folder / "photos.toml")
        _check_inside(folder, [e.file for e in entries] + ([] if camera else [e.camera for e in entries]))
        paths = {e.camera: camera or folder / e.camera for e in entries}
        cameras = {name: read_camera(path) for name, path in paths.items()}
        listed = [Photo(e.file, folder / e.file, cameras[e.camera], paths[e.camera], e.visit) for e in entries]
    else:
        files = _photo_files(folder)
        path = camera or calibration_file(folder, "camera")
        if files and not path.is_file():
            raise TagError(
                f"{path}: no such camera file; expected the calibration of the photos in {folder}",
                hint="give it with --camera, or list the photos and their cameras in photos.toml",
            )
        found = read_camera(path) if files else None
        listed = [] if found is None else [Photo(p.name, p, found, path) for p in files]
    if not listed:
        raise TagError(f"{folder}: holds no photo; expected .jpg or .png files, or photos.toml")
    for photo in listed:
        if not photo.path.is_file():
            raise TagError(f"{photo.path}: no such photo; expected it, since photos.toml lists it")
    _check_once(folder, listed)
    _check_pictures(folder, listed)
    return listed


def _photo_files(folder: Path) -> list[Path]:
    """Return the photos of a folder that names none; raises TagError where all are of a format that is not read."""
    every = sorted(p for p in folder.iterdir() if p.is_file())
    files = [p for p in every if p.suffix.lower() in pictures.PHOTO_SUFFIXES]
    converted = {p.stem for p in files}
    foreign = [p for p in every if p.suffix.lower() in pictures.FOREIGN_SUFFIXES and p.stem not in converted]
    if foreign and not files:
        pictures.refuse_foreign(foreign[0])
    if foreign:
        log.warning(
            "%s: %d files are left out, for example %s: only JPEG and PNG are read; %s",
            folder, len(foreign), foreign[0].name, pictures.CONVERT_HINT,
        )  # fmt: skip
    return files


def _check_pictures(folder: Path, listed: Sequence[Photo]) -> None:
    """Refuse formats that are not read, photos of several cameras under one calibration, and other sizes; warn."""
    by_camera: dict[Path, dict[str, pictures.PhotoHeader]] = {}
    for photo in listed:
        pictures.refuse_foreign(photo.path)
        header = pictures.read_header(photo.path)
        if header is not None:
            by_camera.setdefault(photo.camera_path, {})[photo.file] = header
    cameras = {p.camera_path: p.camera for p in listed}
    for camera_path, headers in by_camera.items():
        camera = cameras[camera_path]
        pictures.refuse_mixture(headers, camera_path)
        file, header = next(iter(headers.items()))
        pictures.refuse_other_size(folder / file, header, (camera.width, camera.height), camera_path)
        pictures.warn_focal(folder / file, header, float(np.mean(camera.focal_px)), camera_path)
        deep = [f for f, h in headers.items() if h.bits > 8]
        if deep:
            log.warning(
                "%s: %d photos have 16 bits per pixel, for example %s: read as 8 bits, the brightest as white",
                folder, len(deep), deep[0],
            )  # fmt: skip


def _check_inside(folder: Path, names: Sequence[str]) -> None:
    # By the text of the path: a link that somebody put into the folder is in the folder
    for name in names:
        normal = os.path.normpath(name)
        if os.path.isabs(normal) or normal.split(os.sep)[0] == os.pardir:
            raise TagError(
                f"{folder / 'photos.toml'}: {name!r} leads outside of the folder; expected a path in {folder}",
                hint="copy the file into the folder, or give the camera with --camera",
            )


def _check_once(folder: Path, listed: Sequence[Photo]) -> None:
    first: dict[Path, str] = {}
    for photo in listed:
        path = photo.path.resolve()
        if path in first:
            raise TagError(
                f"{folder}: photo {photo.file} is listed twice, first as {first[path]}; expected every photo once",
                hint="remove one of the two",
            )
        first[path] = photo.file


def read_photo(photo: Photo, *, colour: bool = False) -> Image | None:
    """Read a photo's stored pixels, grey or RGB, None where it is no image; raises TagError for another size."""
    image = pictures.read_pixels(photo.path, colour=colour)
    if image is not None:
        header = pictures.PhotoHeader(image.shape[1], image.shape[0])
        pictures.refuse_other_size(photo.path, header, (photo.camera.width, photo.camera.height), photo.camera_path)
    return image


def find_tags(
    folder: Path,
    listed: Sequence[Photo],
    sizes_m: Mapping[int | None, float],
    families: Sequence[str],
    progress: Progress | None,
    *,
    detector: str | None = None,
) -> tuple[list[Shot], list[TagPhoto]]:
    """Find the tags in photos; also return a verdict on each that cannot be used. Raises TagError when none can."""
    for family in families:
        find_detector(family, detector)
    shots: list[Shot] = []
    rejected: list[TagPhoto] = []
    for number, photo in enumerate(listed):
        if progress is not None:
            progress("find tags", number + 1, len(listed))
        image = read_photo(photo)
        found = [] if image is None else detect(image, photo.camera, families=families, detector=detector)
        if not found:
            if image is not None:
                reason = f"no tag found{describe_blur(image)}"
            elif pictures.is_cut_short(photo.path):
                reason = "the file is cut short; copy it again"
            else:
                reason = "cannot be read as an image"
            rejected.append(TagPhoto(photo.file, -1, used=False, reason=reason, visit=photo.visit))
        usable = []
        for d in found:
            assert image is not None
            reason = _why_not(d, found, image, sizes_m)
            if reason:
                rejected.append(TagPhoto(photo.file, d.id, used=False, reason=reason, visit=photo.visit))
            else:
                usable.append(d)
        if usable:
            shots.append(Shot(photo, tuple(usable), tuple(found)))
    _check_families(folder, shots)
    if not shots:
        _refuse_useless(folder, listed, families, sizes_m, rejected)
    return shots, rejected


def _refuse_useless(
    folder: Path,
    listed: Sequence[Photo],
    families: Sequence[str],
    sizes_m: Mapping[int | None, float],
    rejected: Sequence[TagPhoto],
) -> NoReturn:
    """Raise TagError: no photo has a tag that can be used."""
    seen = {p.tag_id for p in rejected if p.tag_id >= 0}
    if not seen:
        raise TagError(
            f"{folder}: none of the {len(listed)} photos shows a tag of {', '.join(families)} (for example "
            f"{listed[0].file}: {rejected[0].reason}); expected the tags to be calibrated",
            hint="check the family, and that the tag is whole, sharp and at least 30 pixels wide",
        )
    if all(tag_id in sizes_m or None in sizes_m for tag_id in seen):
        example = next(p for p in rejected if p.tag_id >= 0)
        raise TagError(
            f"{folder}: no tag can be used (for example tag {example.tag_id} in {example.file}: {example.reason})",
            hint="take sharp photos in which the tag is at least 30 pixels wide, and hangs once",
        )
    raise TagError(
        f"{folder}: no tag can be used; tags {sorted(seen)} are seen, sizes are given for {_keys(sizes_m)}",
        hint="give the size of one of these tags with --size-m",
    )


def _check_families(folder: Path, shots: Sequence[Shot]) -> None:
    """Raise TagError where one id is seen in two families: tags.toml, starts and visits name a tag by its id alone."""
    first: dict[int, tuple[str, str]] = {}
    for shot in shots:
        for d in shot.found:
            family, file = first.setdefault(d.id, (d.family, shot.photo.file))
            if family != d.family:
                raise TagError(
                    f"{folder}: tag {d.id} is of {family} in {file} and of {d.family} in {shot.photo.file}; expected "
                    "one family per id",
                    hint="choose one with --family, or print other ids",
                )


def _why_not(
    detection: TagDetection, found: Sequence[TagDetection], image: Image, sizes_m: Mapping[int | None, float]
) -> str:
    """Return why a tag in a photo cannot be used, or nothing."""
    if None not in sizes_m and detection.id not in sizes_m:
        return "no size given for this tag"
    if [d.id for d in found].count(detection.id) > 1:
        return "the same id is seen twice in the photo"
    if (detection.corners_px < 0).any() or (detection.corners_px > image.shape[::-1]).any():
        return "the tag is partly outside of the photo"
    if detection.covariance_px is None:
        return "its pattern cannot be fitted: the tag is partly outside of the photo, covered or bent"
    cell_px = detection.edge_px / FAMILIES[detection.family].cells
    if cell_px < MIN_CELL_PX:
        edge = math.ceil(detection.edge_px * MIN_CELL_PX / cell_px)
        return f"the tag is too small: {detection.edge_px:.0f} px; expected an edge of at least {edge} px"
    blur = tag_blur_px(image, detection)
    if blur > MAX_BLUR_CELLS * cell_px:
        return f"the tag is blurred by {blur:.1f} px; expected less than {MAX_BLUR_CELLS * cell_px:.1f} px"
    return ""


def tag_blur_px(image: Image, detection: TagDetection) -> float:
    """Return the blur at a tag, as the standard deviation in pixels of a Gaussian; 0.8 px where it is sharp."""
    low = np.maximum(np.floor(detection.corners_px.min(axis=0)).astype(int) - 2, 0)
    high = np.ceil(detection.corners_px.max(axis=0)).astype(int) + 2
    return _blur_px(image[low[1] : high[1], low[0] : high[0]], TAG_EDGES)


def describe_blur(image: Image) -> str:
    """Return words about a photo that is blurred all over, or nothing."""
    blur = _blur_px(image, PHOTO_EDGES)
    blurred = MAX_BLUR_WIDTHS * image.shape[1] < blur < math.inf
    return f"; the photo is blurred by about {blur:.0f} px" if blurred else ""


def _blur_px(image: Image, edges: float) -> float:
    """Estimate blur from the steepest edges: a step of height h, blurred by s, has the slope h / (s sqrt(2 pi))."""
    grey = image.astype(np.float32)
    slope = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=1 / 8))
    low, high = np.quantile(grey, (4 * edges, 1 - 4 * edges))
    steepest = float(np.quantile(slope, 1 - edges))
    return float(high - low) / (steepest * math.sqrt(2 * math.pi)) if steepest > 0 else math.inf


def _keys(sizes_m: Mapping[int | None, float]) -> list[int | str]:
    return [k if k is not None else "every tag" for k in sizes_m]


def size_of(tag_id: int, sizes_m: Mapping[int | None, float]) -> float:
    """Return the size in m that is given for a tag."""
    return sizes_m[tag_id] if tag_id in sizes_m else sizes_m[None]
