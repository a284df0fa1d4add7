"""What a map is built from: a rig folder or an image folder, checked before any work starts."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fieldkit import features
from fieldkit.cameras import Camera
from fieldkit.errors import MapError, SurfaceError
from fieldkit.frames import Pose
from fieldkit.maps.sources.stamps import NamedPoses
from fieldkit.store import calibration_file, read_camera, read_rig, read_tum
from fieldkit.types import Image

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".pgm", ".bmp")
# Images with a SLAM pose that fix scale and frame of a map.
MIN_POSES = 3


@dataclasses.dataclass(frozen=True)
class SourceImage:
    """One mapping image: name below images/, file, camera, sequence (one camera's walk), frame, and SLAM pose.

    ``rig_from_cam`` is known for a rig's images; those with the same ``frame`` were taken at the same time. ``turns``
    are the quarter turns, counter-clockwise, by which the file's picture is turned away from the camera's.
    """

    name: str
    file: Path
    camera: Camera
    sequence: str
    frame: str
    slam_from_cam: Pose | None
    rig_from_cam: Pose | None = None
    turns: int = 0


@dataclasses.dataclass(frozen=True)
class DepthFrame:
    """A depth image and the mapping images from whose poses its own follows: (index, cam_from_depth) each.

    Where the file holds distances along the pixels' rays, ``ray_z`` f64[h, w] are the z of these unit rays.
    """

    file: Path
    anchors: tuple[tuple[int, Pose], ...]
    ray_z: NDArray[np.float64] | None = None


@dataclasses.dataclass(frozen=True)
class MapSource:
    """All mapping images (sorted by sequence and frame), the depth images if any, and what a user should know."""

    path: Path
    images: tuple[SourceImage, ...]
    depth_camera: Camera | None
    depth: tuple[DepthFrame, ...]
    notes: tuple[str, ...] = ()

    @property
    def n_posed(self) -> int:
        """How many images have a pose."""
        return sum(image.slam_from_cam is not None for image in self.images)


def without_poses(source: MapSource) -> MapSource:
    """Return a source as if nothing had tracked its images."""
    images = tuple(dataclasses.replace(image, slam_from_cam=None) for image in source.images)
    return dataclasses.replace(source, images=images)


def read_image(image: SourceImage, *, colour: bool = False) -> Image:
    """Read a mapping image as its camera sees it, uint8[h, w] or uint8[h, w, 3] RGB; raises FeatureError if not one."""
    return np.ascontiguousarray(np.rot90(features.read_image(image.file, colour=colour), -image.turns))


def along_axis(depth_mm: NDArray[np.uint16], frame: DepthFrame) -> NDArray[np.uint16]:
    """Return depth along the optical axis (mm) of what a depth image's file holds."""
    return depth_mm if frame.ray_z is None else np.rint(depth_mm * frame.ray_z).astype(np.uint16)


def read_depth(frame: DepthFrame, camera: Camera) -> NDArray[np.uint16]:
    """Read a depth image, mm along the optical axis; raises SurfaceError when it is none of the camera's size."""
    depth = cv2.imread(str(frame.file), cv2.IMREAD_UNCHANGED)
    if depth is None or depth.dtype != np.uint16 or depth.shape != (camera.height, camera.width):
        raise SurfaceError(
            f"{frame.file}: expected a 16-bit PNG of {camera.width}x{camera.height} in mm",
            hint="check the depth image and the depth camera's size",
        )
    return along_axis(np.asarray(depth, dtype=np.uint16), frame)


def read_source(path: Path) -> MapSource:
    """Read a SOURCE folder: with rig.toml a rig's walk, else images/ and camera.toml; poses are optional.

    Raises MapError when it is neither, when images or cameras are missing, when the poses are of other images, and
    when two images share a name.
    """
    path = Path(path)
    if not path.is_dir():
        raise MapError(
            f"{path}: no such folder; expected a folder with images/ and camera.toml or rig.toml",
            hint="check the path",
        )
    if not (path / "images").is_dir():
        raise MapError(f"{path}: no folder images/; expected it with the mapping images", hint="put them there")
    source = _read_rig_folder(path) if calibration_file(path, "rig").is_file() else _read_image_folder(path)
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
    return source


def poses_path(path: Path) -> Path:
    """Return where a SOURCE has its poses, if it has any."""
    return path / ("slam_poses.txt" if calibration_file(path, "rig").is_file() else "poses.txt")


def _image_files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file())


def _read_rig_folder(path: Path) -> MapSource:
    rig = read_rig(calibration_file(path, "rig"))
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
    camera = read_camera(calibration_file(path, "camera"))
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


def _poses(path: Path) -> NamedPoses:
    if not path.is_file():
        return NamedPoses([])
    rows = read_tum(path)
    poses = dict(rows)
    if len(poses) < len(rows):
        names = [name for name, _ in rows]
        twice = next(name for name in names if names.count(name) > 1)
        raise MapError(f"{path}: {twice} has two poses; expected one per name", hint="take one of them out")
    return NamedPoses(rows)
