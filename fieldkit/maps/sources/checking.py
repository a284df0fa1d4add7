"""What is asked of a source's files before hours of work, and the digest by which a build knows its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fieldkit.cameras import Camera
from fieldkit.errors import MapError
from fieldkit.frames import Pose
from fieldkit.maps.sources.headers import read_header
from fieldkit.maps.sources.source import MapSource


def check_images(walk: MapSource) -> None:
    """Read the headers of all images; raise MapError for the first that cannot be used with its camera."""
    for image in walk.images:
        _refuse_unusable(image.file, image.camera, turned=bool(image.turns % 2))
    for frame in walk.depth:
        assert walk.depth_camera is not None
        _refuse_unusable(frame.file, walk.depth_camera, turned=False, bits=16)


def content(walk: MapSource) -> list[str | bytes | Path]:
    """Return all that a source says, in parts for `fieldkit.store.digest`; where it lies is not among it."""
    parts: list[str | bytes | Path] = []
    for image in walk.images:
        said = (image.name, image.camera, image.sequence, image.frame, image.turns)
        parts += [repr(said), _matrix(image.slam_from_cam), _matrix(image.rig_from_cam), image.file]
    parts.append(repr(walk.depth_camera))
    for frame in walk.depth:
        for index, cam_from_depth in frame.anchors:
            parts += [str(index), _matrix(cam_from_depth)]
        parts += [b"" if frame.ray_z is None else np.ascontiguousarray(frame.ray_z).tobytes(), frame.file]
    return parts


def _matrix(pose: Pose | None) -> bytes:
    return b"" if pose is None else pose.as_matrix().tobytes()


def _refuse_unusable(file: Path, camera: Camera, *, turned: bool, bits: int | None = None) -> None:
    found = read_header(file)
    kind = "an image" if bits is None else f"a {bits}-bit depth image in mm"
    width, height = (camera.height, camera.width) if turned else (camera.width, camera.height)
    expected = f"{kind} of {width}x{height} pixels as its camera says"
    if isinstance(found, str):
        raise MapError(f"{file}: {found}; expected {expected}", hint="replace or remove the file")
    if (found.width, found.height) != (width, height):
        raise MapError(
            f"{file}: is {found.width}x{found.height}; expected {expected}",
            hint="give every camera images of one size, the one that it was calibrated for",
        )
    if bits is not None and found.bits != bits:
        raise MapError(f"{file}: has {found.bits} bits; expected {expected}", hint="write depth as 16-bit PNG")
