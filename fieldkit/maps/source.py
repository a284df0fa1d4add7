"""What a map is built from: a rig folder or an image folder, checked before any work starts."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fieldkit.cameras import Camera
from fieldkit.errors import MapError, SurfaceError
from fieldkit.frames import Pose
from fieldkit.maps.headers import read_header
from fieldkit.store import read_camera, read_rig, read_tum

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".pgm", ".bmp")
# Images with a SLAM pose that fix scale and frame of a map.
MIN_POSES = 3


@dataclasses.dataclass(frozen=True)
class SourceImage:
    """One mapping image: name below images/, file, camera, sequence (one camera's walk), frame, and SLAM pose.

    ``rig_from_cam`` is known for a rig's images; those with the same ``frame`` were taken at the same time.
    """

    name: str
    file: Path
    camera: Camera
    sequence: str
    frame: str
    slam_from_cam: Pose | None
    rig_from_cam: Pose | None = None


@dataclasses.dataclass(frozen=True)
class DepthFrame:
    """A depth image and the mapping images from whose poses its own follows: (index, cam_from_depth) each."""

    file: Path
    anchors: tuple[tuple[int, Pose], ...]


@dataclasses.dataclass(frozen=True)
class MapSource:
    """All mapping images (sorted by sequence and frame), the depth images if there are any, and the files it is of."""

    path: Path
    images: tuple[SourceImage, ...]
    depth_camera: Camera | None
    depth: tuple[DepthFrame, ...]
    files: tuple[Path, ...] = ()

    @property
    def n_posed(self) -> int:
        """How many images have a pose."""
        return sum(image.slam_from_cam is not None for image in self.images)


def read_source(path: Path) -> MapSource:
    """Read a SOURCE folder: with rig.toml a rig's walk, else images/ and camera.toml; poses are optional.

    The header of every image is read. Raises MapError when it is neither, when images or cameras are missing, when the
    poses are of other images, and when an image cannot be read, has another size than its camera, or shares its name.
    """
    path = Path(path)
    if not path.is_dir():
        raise MapError(
            f"{path}: no such folder; expected a folder with images/ and camera.toml or rig.toml",
            hint="check the path",
        )
    if not (path / "images").is_dir():
        raise MapError(f"{path}: no folder images/; expected it with the mapping images", hint="put them there")
    source = _read_rig_folder(path) if (path / "rig.toml").is_file() else _read_image_folder(path)
    if not source.images:
        raise MapError(
            f"{path / 'images'}: no image found; expected files like {', '.join(IMAGE_SUFFIXES[:3])}",
            hint="put the mapping images there",
        )
    poses_file = poses_path(path)
    if poses_file.is_file() and source.n_posed < MIN_POSES:
        raise MapError(
            f"{poses_file}: names {source.n_posed} of the {len(source.images)} images; expected at least {MIN_POSES}, "
            "which give the map its scale and gravity",
            hint="give each pose the name of its image file, without the folder",
        )
    for image in source.images:
        _refuse_unreadable(image.file, image.camera, bits=None)
    for frame in source.depth:
        assert source.depth_camera is not None
        _refuse_unreadable(frame.file, source.depth_camera, bits=16)
    texts = [path / name for name in ("rig.toml", "camera.toml", "depth_camera.toml")] + [poses_file]
    files = [*(f for f in texts if f.is_file()), *(i.file for i in source.images), *(d.file for d in source.depth)]
    return dataclasses.replace(source, files=tuple(files))


def without_poses(source: MapSource) -> MapSource:
    """Return a source as if nothing had tracked its images."""
    images = tuple(dataclasses.replace(image, slam_from_cam=None) for image in source.images)
    return dataclasses.replace(source, images=images)


def read_depth(frame: DepthFrame, camera: Camera) -> NDArray[np.uint16]:
    """Read a depth image (mm along the optical axis); raises SurfaceError when it is none of the camera's size."""
    depth = cv2.imread(str(frame.file), cv2.IMREAD_UNCHANGED)
    if depth is None or depth.dtype != np.uint16 or depth.shape != (camera.height, camera.width):
        raise SurfaceError(
            f"{frame.file}: expected a 16-bit PNG of {camera.width}x{camera.height} in mm",
            hint="check the depth image and the depth camera's size",
        )
    return np.asarray(depth, dtype=np.uint16)


def _refuse_unreadable(file: Path, camera: Camera, *, bits: int | None) -> None:
    """Raise MapError when an image's header says that it cannot be used with its camera."""
    found = read_header(file)
    kind = "an image" if bits is None else f"a {bits}-bit depth image in mm"
    expected = f"{kind} of {camera.width}x{camera.height} pixels as its camera says"
    if isinstance(found, str):
        raise MapError(f"{file}: {found}; expected {expected}", hint="replace or remove the file")
    if (found.width, found.height) != (camera.width, camera.height):
        raise MapError(
            f"{file}: is {found.width}x{found.height}; expected {expected}",
            hint="give every camera images of one size: it was calibrated for that one",
        )
    if bits is not None and found.bits != bits:
        raise MapError(f"{file}: has {found.bits} bits; expected {expected}", hint="write depth as 16-bit PNG")


def poses_path(path: Path) -> Path:
    """Return where a SOURCE has its poses, if it has any."""
    return path / ("slam_poses.txt" if (path / "rig.toml").is_file() else "poses.txt")


def _image_files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file())


def _read_rig_folder(path: Path) -> MapSource:
    rig = read_rig(path / "rig.toml")
    poses = _poses(poses_path(path))
    images: list[SourceImage] = []
    frames: dict[str, list[tuple[int, Pose]]] = {}
    for camera in rig.cameras:
        folder = path / "images" / camera.name
        if not folder.is_dir():
            raise MapError(f"{folder}: no such folder; rig.toml has a camera {camera.name!r}", hint="add its images")
        files = _image_files(folder)
        _refuse_duplicates(folder, files)
        for file in files:
            slam_from_rig = poses.get(file.stem)
            slam_from_cam = None if slam_from_rig is None else slam_from_rig * camera.rig_from_cam
            if rig.depth is not None:
                cam_from_depth = camera.rig_from_cam.inv() * rig.depth.rig_from_cam
                frames.setdefault(file.stem, []).append((len(images), cam_from_depth))
            name = f"{camera.name}/{file.name}"
            images.append(
                SourceImage(name, file, camera.camera, camera.name, file.stem, slam_from_cam, camera.rig_from_cam)
            )
    depth = tuple(
        DepthFrame(path / "depth" / f"{frame}.png", tuple(anchors))
        for frame, anchors in sorted(frames.items())
        if (path / "depth" / f"{frame}.png").is_file()
    )
    return MapSource(path, tuple(images), rig.depth.camera if rig.depth and depth else None, depth)


def _read_image_folder(path: Path) -> MapSource:
    camera = read_camera(path / "camera.toml")
    poses = _poses(poses_path(path))
    images = []
    files = _image_files(path / "images")
    _refuse_duplicates(path / "images", files)
    for file in files:
        pose = poses.get(file.name, poses.get(file.stem))
        images.append(SourceImage(file.name, file, camera, "", file.stem, pose))
    depth = tuple(
        DepthFrame(path / "depth" / f"{image.frame}.png", ((i, Pose.identity()),))
        for i, image in enumerate(images)
        if (path / "depth" / f"{image.frame}.png").is_file()
    )
    if depth and not (path / "depth_camera.toml").is_file():
        raise MapError(
            f"{path}: depth/ without depth_camera.toml",
            hint="add depth_camera.toml (camera.toml of the depth camera), or take depth/ away",
        )
    return MapSource(path, tuple(images), read_camera(path / "depth_camera.toml") if depth else None, depth)


def _refuse_duplicates(folder: Path, files: Sequence[Path]) -> None:
    """Raise MapError where two files differ in their ending alone: poses and depth could mean either."""
    seen: dict[str, str] = {}
    for file in files:
        if file.stem in seen:
            raise MapError(
                f"{folder}: {seen[file.stem]} and {file.name} have one name; expected one file each",
                hint="rename or remove one of them",
            )
        seen[file.stem] = file.name


def _poses(path: Path) -> dict[str, Pose]:
    if not path.is_file():
        return {}
    rows = read_tum(path)
    poses = dict(rows)
    if len(poses) < len(rows):
        names = [name for name, _ in rows]
        twice = next(name for name in names if names.count(name) > 1)
        raise MapError(f"{path}: {twice} has two poses; expected one per name", hint="take one of them out")
    return poses
