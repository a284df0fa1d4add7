"""COLMAP models on disk, read and written as arrays: a million points without an object for each."""

from __future__ import annotations

import dataclasses
import io
import itertools
import struct
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numba
import numpy as np
import pycolmap
from numpy.typing import NDArray

from fieldkit.cameras import Camera
from fieldkit.errors import FieldkitError, MapError
from fieldkit.frames import Pose
from fieldkit.maps.landmarks import Model
from fieldkit.maps.quiet import quiet_colmap
from fieldkit.observations import reprojection_errors

Array = NDArray[np.float64]

# The file formats are COLMAP's: https://colmap.github.io/format.html. A model's number -> name and parameters
_MODELS: dict[int, tuple[str, int]] = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
}
_NUMBERS = {name: number for number, (name, _) in _MODELS.items()}
_OBSERVATION = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_TRACK = np.dtype([("image", "<u4"), ("keypoint", "<u4")])
# Bytes of a point before its track: id, position, colour, error, length of the track
_POINT_HEAD = 51


def model_folder(path: Path) -> Path:
    """Return the folder with the model: ``path``, its ``sparse/0``, ``sparse``, ``sfm`` or ``0``.

    Raises MapError when none of them holds one, or half of one.
    """
    path = Path(path)
    if not path.is_dir():
        raise MapError(f"{path}: no such folder; expected a COLMAP model", hint="check the path")
    for folder in (path, path / "sparse" / "0", path / "sparse", path / "sfm", path / "0"):
        if any((folder / f"images{ending}").is_file() for ending in (".bin", ".txt")):
            ending = ".bin" if (folder / "images.bin").is_file() else ".txt"
            for name in ("cameras", "points3D"):
                if not (folder / f"{name}{ending}").is_file():
                    raise MapError(
                        f"{folder}: no {name}{ending}; expected cameras, images and points3D",
                        hint="copy the model again",
                    )
            return folder
    raise MapError(
        f"{path}: no COLMAP model in it; expected cameras, images and points3D as .bin or .txt",
        hint="give the folder that COLMAP or hloc wrote, as sparse/0",
    )


def read_model(folder: Path) -> Model:
    """Read the registered images, points and observations of a COLMAP model, binary or text, of any version.

    Raises MapError when it is missing, damaged, or has a camera model that is unknown here.
    """
    folder = Path(folder)
    if (folder / "images.bin").is_file():
        return _read_binary(folder)
    try:
        with quiet_colmap(), tempfile.TemporaryDirectory(prefix="fieldkit-model-") as work:
            pycolmap.Reconstruction(folder).write_binary(work)
            return _read_binary(Path(work))
    except (ValueError, RuntimeError, OSError, LookupError) as error:
        raise _damaged(folder) from error


def _read_binary(folder: Path) -> Model:
    try:
        cameras = _read_cameras(folder / "cameras.bin")
        point_ids, xyz = _read_points(folder / "points3D.bin")
        with (folder / "images.bin").open("rb") as file:
            heads = _image_heads(file)
            owner = tuple(cameras[head.camera_id] for head in heads)
            count, landmark, keypoint, pixels = _observations(file, heads, point_ids)
    except (ValueError, struct.error, OSError, KeyError, OverflowError, UnicodeDecodeError, MemoryError) as error:
        raise _damaged(folder) from error
    image = np.repeat(np.arange(len(heads), dtype=np.int32), count)
    return Model(
        tuple(head.name for head in heads),
        owner,
        tuple(head.map_from_cam for head in heads),
        xyz,
        point_ids,
        landmark,
        image,
        keypoint,
        pixels,
    )


def _damaged(folder: Path) -> MapError:
    return MapError(
        f"{folder}: no readable COLMAP model; expected cameras, images and points3D that belong together",
        hint="copy or build the model again",
    )


def _read_cameras(path: Path) -> dict[int, Camera]:
    result = {}
    with path.open("rb") as file:
        for _ in range(_unpack(file, "<Q")[0]):
            number, model, width, height = _unpack(file, "<IiQQ")
            if model not in _MODELS:
                raise MapError(f"{path}: camera {number} has model number {model}", hint="undistort the images first")
            name, n = _MODELS[model]
            result[number] = _camera(path, number, name, (width, height), _unpack(file, f"<{n}d"))
    return result


def _camera(path: Path, number: int, name: str, size: tuple[int, int], params: tuple[float, ...]) -> Camera:
    """Return a camera; those that OPENCV_FISHEYE can express become it."""
    if name in ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"):
        f, cx, cy, *k = params
        name, params = "OPENCV_FISHEYE", (f, f, cx, cy, *(k + [0.0] * 4)[:4])
    try:
        return Camera(name, *size, params)
    except FieldkitError as error:
        hint = error.hint or "undistort the images with `colmap image_undistorter` and import that model"
        raise MapError(f"{path}: camera {number}: {error.message}", hint=hint) from error


@dataclasses.dataclass(frozen=True)
class _Head:
    """An image without its keypoints, of which there are ``n`` at ``offset`` in the file."""

    name: str
    camera_id: int
    map_from_cam: Pose
    offset: int
    n: int


def _image_heads(file: io.BufferedReader) -> list[_Head]:
    """Return the images sorted by name."""
    heads = []
    for _ in range(_unpack(file, "<Q")[0]):
        numbers = _unpack(file, "<I7dI")
        name = _read_name(file)
        (n,) = _unpack(file, "<Q")
        pose = _pose(np.array(numbers[1:5]), np.array(numbers[5:8]))
        heads.append(_Head(name, numbers[8], pose, file.tell(), n))
        file.seek(_OBSERVATION.itemsize * n, io.SEEK_CUR)
    return sorted(heads, key=lambda head: head.name)


def _observations(
    file: io.BufferedReader, heads: Sequence[_Head], point_ids: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]:
    """Return how many points each image observes, and of every observation landmark, keypoint and pixel (o, 2).

    Room is made for all keypoints at once: what is not written to is never given memory, and nothing is copied.
    """
    room = min(sum(head.n for head in heads), file.seek(0, io.SEEK_END) // _OBSERVATION.itemsize)
    landmark, keypoint = np.empty(room, dtype=np.int32), np.empty(room, dtype=np.int32)
    pixels, count, end = np.empty((room, 2), dtype=np.float32), np.zeros(len(heads), dtype=np.int64), 0
    for i, head in enumerate(heads):
        file.seek(head.offset)
        rows = np.frombuffer(file.read(_OBSERVATION.itemsize * head.n), dtype=_OBSERVATION)
        if len(rows) != head.n:
            raise ValueError("cut off")
        seen = np.flatnonzero(rows["point"] != -1)
        found = np.searchsorted(point_ids, rows["point"][seen])
        if len(seen) and (
            not len(point_ids) or (point_ids[np.minimum(found, len(point_ids) - 1)] != rows["point"][seen]).any()
        ):
            raise ValueError("a keypoint observes a point that is not there")
        if not np.isfinite(rows["xy"][seen]).all():
            raise ValueError("a keypoint is not finite")
        part = slice(end, end + len(seen))
        landmark[part], keypoint[part], pixels[part] = found, seen, rows["xy"][seen]
        count[i], end = len(seen), part.stop
    return count, landmark[:end], keypoint[:end], pixels[:end]


def _unpack(file: io.BufferedReader, layout: str) -> tuple[int, ...]:
    return struct.unpack(layout, file.read(struct.calcsize(layout)))


def _read_name(file: io.BufferedReader) -> str:
    letters = bytearray()
    while (letter := file.read(1)) != b"\0":
        if not letter:
            raise ValueError("cut off")
        letters += letter
    return letters.decode("utf-8")


def _pose(wxyz: Array, translation: Array) -> Pose:
    """Return map_from_cam of cam_from_map as COLMAP stores it, through the matrix that COLMAP itself makes of it."""
    length = float(np.linalg.norm(wxyz))
    if not (np.isfinite(length) and length > 0 and np.isfinite(translation).all()):
        raise ValueError("a pose is not finite")
    w, x, y, z = (wxyz / length).tolist()
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - (2 * y * y + 2 * z * z), 2 * y * x - 2 * z * w, 2 * z * x + 2 * y * w],
        [2 * y * x + 2 * z * w, 1 - (2 * x * x + 2 * z * z), 2 * z * y - 2 * x * w],
        [2 * z * x - 2 * y * w, 2 * z * y + 2 * x * w, 1 - (2 * x * x + 2 * y * y)],
    ]
    matrix[:3, 3] = translation
    return Pose.from_matrix(matrix).inv()


def _read_points(path: Path) -> tuple[NDArray[np.int64], Array]:
    """Return ids, sorted, and positions (n, 3)."""
    content = np.fromfile(path, dtype=np.uint8)
    count = int(content[:8].view("<u8")[0])
    if count * _POINT_HEAD > len(content):
        raise ValueError("cut off")
    heads = np.zeros((count, 32), dtype=np.uint8)
    if _gather_points(content, heads) != len(content):
        raise ValueError("cut off")
    del content
    ids = np.ascontiguousarray(heads[:, :8]).view("<i8").ravel()
    order = np.argsort(ids, kind="stable")
    xyz = np.ascontiguousarray(heads[:, 8:]).view("<f8")
    wrong = int((~np.isfinite(xyz).all(axis=1)).sum())
    if wrong:
        raise MapError(
            f"{path}: {wrong} of {count} points are not finite; expected finite positions",
            hint="copy or build the model again",
        )
    return ids[order].astype(np.int64), xyz[order].astype(np.float64)


@numba.njit(cache=True)
def _gather_points(content, heads):  # type: ignore[no-untyped-def]
    """Copy id and position of every point into ``heads``; return where the last one ends, -1 when it is cut off."""
    at = np.int64(8)
    for k in range(len(heads)):
        if at + 51 > len(content):
            return np.int64(-1)
        for i in range(32):
            heads[k, i] = content[at + i]
        length = np.int64(0)
        for i in range(7, -1, -1):
            length = length * 256 + np.int64(content[at + 43 + i])
        if length < 0 or length > len(content):
            return np.int64(-1)
        at += 51 + 8 * length
    return at


def write_model(folder: Path, model: Model, pixels: Sequence[NDArray[np.float32]]) -> None:
    """Write a binary COLMAP model; ``pixels`` f32[m, 2] are all keypoints of each image, in COLMAP pixels.

    Every image is a frame of its own: without rigs, which all versions of COLMAP read. Points keep their ids.
    """
    folder.mkdir(parents=True, exist_ok=True)
    ids: dict[Camera, int] = {}
    for camera in model.image_cameras:
        ids.setdefault(camera, len(ids) + 1)
    with (folder / "cameras.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(ids)))
        for camera, number in ids.items():
            file.write(struct.pack("<IiQQ", number, _NUMBERS[camera.model], camera.width, camera.height))
            file.write(np.asarray(camera.params, dtype="<f8").tobytes())
    bounds = np.searchsorted(model.observation_image, np.arange(len(model.image_names) + 1))
    with (folder / "images.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(model.image_names)))
        for i, name in enumerate(model.image_names):
            cam_from_map = model.map_from_image[i].inv()
            x, y, z, w = cam_from_map.rotation.as_quat(canonical=True)
            file.write(struct.pack("<I7dI", i + 1, w, x, y, z, *cam_from_map.translation, ids[model.image_cameras[i]]))
            file.write(name.encode("utf-8") + b"\0" + struct.pack("<Q", len(pixels[i])))
            rows = np.zeros(len(pixels[i]), dtype=_OBSERVATION)
            rows["xy"], rows["point"] = pixels[i], -1
            seen = slice(bounds[i], bounds[i + 1])
            rows["point"][model.observation_keypoint[seen]] = model.point_ids[model.observation_landmark[seen]]
            file.write(rows.tobytes())
    _write_points(folder / "points3D.bin", model)


def _write_points(path: Path, model: Model) -> None:
    count = np.bincount(model.observation_landmark, minlength=len(model.xyz))
    errors = reprojection_errors(model)
    mean = np.bincount(model.observation_landmark, weights=errors, minlength=len(model.xyz)) / np.maximum(count, 1)
    order = np.argsort(model.observation_landmark, kind="stable")
    tracks = np.zeros(len(order), dtype=_TRACK)
    tracks["image"], tracks["keypoint"] = model.observation_image[order] + 1, model.observation_keypoint[order]
    bounds = np.concatenate([[0], np.cumsum(count)])
    with path.open("wb") as file:
        file.write(struct.pack("<Q", len(model.xyz)))
        for k, (begin, end) in enumerate(itertools.pairwise(bounds.tolist())):
            file.write(struct.pack("<q3d3Bd", model.point_ids[k], *model.xyz[k], 0, 0, 0, mean[k]))
            file.write(struct.pack("<Q", end - begin) + tracks[begin:end].tobytes())
