"""Localize image files: of one camera, or of a rig."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TypeVar

from fieldkit.cameras import Camera
from fieldkit.errors import FeatureError, LocalizeError
from fieldkit.features import read_image
from fieldkit.localize.localizer import Localizer, Query, RigEstimate
from fieldkit.localize.narrowing import CameraPrior
from fieldkit.localize.parallel import default_threads, in_threads
from fieldkit.store.inputs import Rig
from fieldkit.types import Estimate, Image

SUFFIXES = (".jpg", ".jpeg", ".png", ".pgm", ".bmp", ".tif", ".tiff")
Progress = Callable[[str, int, int], None]
Found = TypeVar("Found")


def localize_files(
    localizer: Localizer,
    images: Path,
    camera: Camera,
    *,
    priors: Mapping[str, CameraPrior] | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
) -> list[tuple[str, Estimate]]:
    """Localize one image file, or all image files of a folder in the order of their names; return name and estimate.

    A file of a folder that is no image, or of another size than the camera's, is an estimate without a pose: its
    status says so. ``priors`` are looked up by the image's name. Raises LocalizeError when there is no image, when
    none has the camera's size, or when the priors name none of them, and FeatureError when a single file is no image.
    """
    images, priors = Path(images), priors or {}
    files = [images] if images.is_file() else _image_files(images)
    if not files:
        raise LocalizeError(
            f"{images}: no image found; expected an image or a folder with {', '.join(SUFFIXES)}", hint="check the path"
        )
    if priors and not any(f.name in priors for f in files):
        raise LocalizeError(
            f"{images}: none of its {len(files)} images has a prior; the first prior is of {next(iter(priors))}",
            hint="give the priors of these images, by their file names",
        )
    single = files[0] if images.is_file() else None
    sizes: dict[Path, tuple[int, ...]] = {}

    def one(file: Path) -> Estimate:
        image = read(localizer, file)
        if image is None:
            if single is not None:
                raise FeatureError(f"{file}: cannot be read as an image; expected JPEG or PNG", hint="check the file")
            return _without("unreadable")
        sizes[file] = image.shape[:2]
        if image.shape[:2] != (camera.height, camera.width):
            return _without("other_size")
        return localizer.localize_query(Query(image, camera, priors.get(file.name)))

    found = list(_counted(in_threads(one, files, threads=threads or default_threads()), len(files), progress))
    if sizes and (camera.height, camera.width) not in sizes.values():
        file = min(sizes)
        raise LocalizeError(
            f"{file}: is {sizes[file][1]}x{sizes[file][0]}; the camera says {camera.width}x{camera.height}",
            hint="give the camera with which the image was taken",
        )
    return [(f.name, e) for f, e in zip(files, found, strict=True)]


def localize_rig_files(
    localizer: Localizer,
    folder: Path,
    rig: Rig,
    *,
    threads: int | None = None,
    progress: Progress | None = None,
) -> list[tuple[str, RigEstimate]]:
    """Localize the frames of a rig, images ``<camera>/<frame>.*`` of a folder or of ``images`` in it.

    A frame is what the images' names say without their suffix; cameras that have no image of a frame, or an
    unreadable one or one of another size, are left out of it. Raises LocalizeError when there is no image, or a folder
    of images of a camera that the rig does not have.
    """
    root = folder / "images" if (folder / "images").is_dir() else folder
    known = {c.name: c for c in rig.cameras}
    folders = [p for p in sorted(root.iterdir()) if p.is_dir()] if root.is_dir() else []
    by_camera = {p.name: _image_files(p) for p in folders}
    strange = [name for name, files in by_camera.items() if files and name not in known]
    if strange:
        raise LocalizeError(
            f"{root / strange[0]}: images of a camera that the rig does not have; its cameras are {', '.join(known)}",
            hint="add the camera to rig.toml, or move its images away",
        )
    frames: dict[str, dict[str, Path]] = {}
    for name, files in by_camera.items():
        for file in files:
            frames.setdefault(file.stem, {})[name] = file
    if not frames:
        raise LocalizeError(
            f"{root}: no image found; expected folders {', '.join(known)} with the images of each frame",
            hint="check the path",
        )

    def one(files: Mapping[str, Path]) -> RigEstimate:
        images: dict[str, Image] = {}
        for name, file in files.items():
            image, camera = read(localizer, file), known[name].camera
            if image is not None and image.shape[:2] == (camera.height, camera.width):
                images[name] = image
        return localizer.localize_rig(images, rig.cameras)

    order = sorted(frames)
    found = _counted(
        in_threads(one, [frames[f] for f in order], threads=threads or default_threads()), len(order), progress
    )
    return list(zip(order, found, strict=True))


def read(localizer: Localizer, file: Path) -> Image | None:
    """Read an image as the map's feature looks at it, None where it is none."""
    try:
        return read_image(file, colour=localizer.colour)
    except FeatureError:
        return None


def _image_files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.glob("*") if p.suffix.lower() in SUFFIXES)


def _without(status: str) -> Estimate:
    return Estimate(None, None, 0, 0, status, 0.0, {})


def _counted(items: Iterator[Found], total: int, progress: Progress | None) -> Iterator[Found]:
    for number, item in enumerate(items, start=1):
        if progress is not None:
            progress("localize", number, total)
        yield item
