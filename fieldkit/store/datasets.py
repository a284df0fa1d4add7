"""Dataset folders: what was asked for, the map of every scene, and one shard per waypoint."""

from __future__ import annotations

import dataclasses
import io
import json
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from fieldkit.cameras import Camera
from fieldkit.errors import FieldkitError, StoreError
from fieldkit.frames import Pose, pose
from fieldkit.protocol import CandidateRules, LocalizerRules, Threshold
from fieldkit.store.files import atomic_write, convert, read_toml, write_toml
from fieldkit.types import Array, ViewKind

DATASET_FILE, SCENE_FILE, MAPS_FOLDER = "dataset.toml", "scene.toml", "maps"
Names = Annotated[tuple[str, ...], msgspec.Meta(min_length=1)]


class DatasetRules(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How views become features and labels. The defaults are those of the protocol paper_sim.

    A view's label is true when the camera's error is strictly inside ``label``. ``repeats`` further localizations
    with new noise are made of a share of the views.
    """

    feature: str = "sift"
    seed: Annotated[int, msgspec.Meta(ge=0, lt=2**31)] = 0
    localizer: LocalizerRules = LocalizerRules()
    candidates: CandidateRules = CandidateRules()
    tolerance_voxels: Annotated[float, msgspec.Meta(gt=0)] = 2.0
    label: Threshold = Threshold(0.1, 1.0)
    repeats: Annotated[int, msgspec.Meta(ge=0)] = 0
    repeat_share: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.1


class DatasetFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """dataset.toml: scenes in order, rules, and the options of the source as plain values."""

    version: Literal[1]
    scenes: Names
    rules: DatasetRules
    source: dict[str, Any]
    versions: dict[str, str]


class SceneFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """scene.toml: keys of what the map and the views were made from, the map, and the waypoints in order."""

    version: Literal[1]
    name: str
    mapping_key: str
    views_key: str
    map: str
    map_digest: str
    waypoints: Names


class GaugeFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """<map>.gauge.toml: world_from_map, what it leaves of the mapping cameras' positions, and the map's scale error."""

    version: Literal[1]
    position_m: tuple[float, ...]
    quaternion_xyzw: tuple[float, ...]
    rms_m: float
    max_m: float
    scale_error: float


@dataclasses.dataclass(frozen=True, eq=False)
class Shard:
    """One waypoint of a dataset: v views, their estimates, labels, and the k landmarks that they would see.

    Poses are rows x y z qx qy qz qw in the map. ``prior`` f64[7] and its 6x6 ``prior_covariance``; ``body`` f64[7] the
    true body. ``candidate`` f64[v, 7]: camera at the prior; ``truth`` f64[v, 7]: true camera; ``body_from_cam``
    f64[v, 7]; ``estimate`` f64[v, 7] and ``covariance`` f64[v, 6, 6], nan where localization failed. ``error``
    f64[v, 2]: m and rad of the camera, inf where it failed; ``label`` bool[v].

    Landmarks in view at ``candidate``: rows ``starts[i]:starts[i + 1]`` belong to view i; ``landmark`` int32[k] index
    in the map, ``uv_px`` f32[k, 2], ``distance_m`` f32[k], ``angle_rad`` f32[k] from the principal axis, ``occluded``
    bool[k]: hidden by the map's surface.

    Repeats r with new noise: ``repeat_view`` int32[r], ``repeat_number`` int32[r] from 1, ``repeat_error`` f64[r, 2],
    ``repeat_label`` bool[r].
    """

    scene: str
    waypoint: str
    next: str | None
    key: str
    camera: Camera
    view_ids: tuple[str, ...]
    kinds: tuple[str, ...]
    status: tuple[str, ...]
    prior: Array
    prior_covariance: Array
    body: Array
    candidate: Array
    body_from_cam: Array
    truth: Array
    estimate: Array
    covariance: Array
    matches: NDArray[np.int32]
    inliers: NDArray[np.int32]
    confidence: Array
    error: Array
    label: NDArray[np.bool_]
    starts: NDArray[np.int64]
    landmark: NDArray[np.int32]
    uv_px: NDArray[np.float32]
    distance_m: NDArray[np.float32]
    angle_rad: NDArray[np.float32]
    occluded: NDArray[np.bool_]
    repeat_view: NDArray[np.int32]
    repeat_number: NDArray[np.int32]
    repeat_error: Array
    repeat_label: NDArray[np.bool_]


_TEXTS = ("scene", "waypoint", "next", "key", "camera", "view_ids", "kinds", "status")
_ARRAYS = tuple(f.name for f in dataclasses.fields(Shard) if f.name not in _TEXTS)
_AGAIN = "remove it and finish the dataset"
# Types and axes of a shard's arrays: v views, k landmarks in view, r repeats.
_LAYOUT: dict[str, tuple[str, tuple[str | int, ...]]] = {
    "prior": ("f8", (7,)),
    "prior_covariance": ("f8", (6, 6)),
    "body": ("f8", (7,)),
    "candidate": ("f8", ("v", 7)),
    "body_from_cam": ("f8", ("v", 7)),
    "truth": ("f8", ("v", 7)),
    "estimate": ("f8", ("v", 7)),
    "covariance": ("f8", ("v", 6, 6)),
    "matches": ("i4", ("v",)),
    "inliers": ("i4", ("v",)),
    "confidence": ("f8", ("v",)),
    "error": ("f8", ("v", 2)),
    "label": ("?", ("v",)),
    "starts": ("i8", ("v + 1",)),
    "landmark": ("i4", ("k",)),
    "uv_px": ("f4", ("k", 2)),
    "distance_m": ("f4", ("k",)),
    "angle_rad": ("f4", ("k",)),
    "occluded": ("?", ("k",)),
    "repeat_view": ("i4", ("r",)),
    "repeat_number": ("i4", ("r",)),
    "repeat_error": ("f8", ("r", 2)),
    "repeat_label": ("?", ("r",)),
}


class _Head(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The texts of a shard as stored; ``camera`` is model, width, height and params."""

    version: Literal[1]
    scene: str
    waypoint: str
    next: str | None
    key: str
    camera: list[Any]
    views: tuple[str, ...]
    kinds: tuple[ViewKind, ...]
    status: tuple[str, ...]


def is_dataset(path: Path) -> bool:
    """Tell whether a folder is a dataset."""
    return (Path(path) / DATASET_FILE).is_file()


def read_dataset(path: Path) -> DatasetFile:
    """Read dataset.toml of a dataset folder; raises StoreError when it is missing, damaged or newer."""
    return read_toml(Path(path) / DATASET_FILE, DatasetFile, what="dataset.toml of a dataset folder")


def write_dataset(path: Path, head: DatasetFile) -> None:
    """Write dataset.toml."""
    write_toml(Path(path) / DATASET_FILE, head)


def scene_path(path: Path, scene: str) -> Path:
    """Return where scene.toml of a scene lies."""
    return Path(path) / scene / SCENE_FILE


def read_scene(path: Path, scene: str) -> SceneFile:
    """Read scene.toml of a scene of a dataset; raises StoreError when it is missing, damaged, newer or of another."""
    entry = read_toml(scene_path(path, scene), SceneFile, what="scene.toml of a dataset's scene")
    strange = [n for n in (entry.map, *entry.waypoints) if not is_plain(n)]
    if entry.name != scene or strange or len(set(entry.waypoints)) < len(entry.waypoints):
        what = f"names the scene {entry.name!r}" if entry.name != scene else "names a waypoint twice"
        raise StoreError(
            f"{scene_path(path, scene)}: {f'names {strange[0]!r}' if strange else what}; expected the scene {scene!r}, "
            "and each waypoint once by the name of its file",
            hint="remove its folder and make the dataset again",
        )
    return entry


def is_plain(name: str) -> bool:
    """Tell whether a name can be that of a file in a folder."""
    return name not in ("", ".", "..") and not set("/\\\0") & set(name)


def write_scene(path: Path, entry: SceneFile) -> None:
    """Write scene.toml."""
    write_toml(Path(path) / entry.name / SCENE_FILE, entry)


def map_path(path: Path, entry: SceneFile) -> Path:
    """Return the map folder of a scene of a dataset."""
    return Path(path) / MAPS_FOLDER / entry.map


def gauge_path(map_folder: Path) -> Path:
    """Return the gauge file that lies beside a map of a dataset."""
    return map_folder.with_suffix(".gauge.toml")


def read_gauge(map_folder: Path) -> GaugeFile:
    """Read the gauge of a map of a dataset; raises StoreError when it is missing, damaged or newer, or no pose."""
    path = gauge_path(map_folder)
    entry = read_toml(path, GaugeFile, what="the gauge of a dataset's map")
    try:
        pose(entry.position_m, entry.quaternion_xyzw)
    except FieldkitError as error:
        raise StoreError(f"{path}: {error.message}", hint="correct the file") from error
    if not (np.isfinite([entry.rms_m, entry.max_m, entry.scale_error]).all() and min(entry.rms_m, entry.max_m) >= 0.0):
        raise StoreError(
            f"{path}: rms_m {entry.rms_m:g}, max_m {entry.max_m:g}, scale_error {entry.scale_error:g}; expected finite "
            "numbers, none negative",
            hint="correct the file",
        )
    return entry


def write_gauge(map_folder: Path, entry: GaugeFile) -> None:
    """Write the gauge of a map of a dataset."""
    write_toml(gauge_path(map_folder), entry)


def shard_path(path: Path, scene: str, waypoint: str) -> Path:
    """Return where the shard of a waypoint lies."""
    return Path(path) / scene / f"{waypoint}.npz"


def write_shard(path: Path, shard: Shard) -> None:
    """Write a shard: the same content gives the same bytes; raises StoreError when it cannot be written."""
    camera = shard.camera
    head = {
        "version": 1, "scene": shard.scene, "waypoint": shard.waypoint, "next": shard.next, "key": shard.key,
        "camera": [camera.model, camera.width, camera.height, *camera.params], "views": list(shard.view_ids),
        "kinds": list(shard.kinds), "status": list(shard.status),
    }  # fmt: skip
    arrays = {"head": np.frombuffer(json.dumps(head).encode(), np.uint8)}
    stream = io.BytesIO()
    np.savez_compressed(stream, allow_pickle=False, **arrays, **{name: getattr(shard, name) for name in _ARRAYS})
    atomic_write(path, stream.getvalue())


def read_shard(path: Path) -> Shard:
    """Read a shard; raises StoreError when it is missing, damaged, newer, or not what `Shard` describes."""
    path = Path(path)
    try:
        with np.load(path, allow_pickle=False) as archive:
            head = convert(json.loads(bytes(archive["head"])), _Head, path=path, what="the head of a shard")
            arrays = {name: archive[name] for name in _ARRAYS}
        model, width, height, *params = head.camera
        camera = Camera(model, width, height, tuple(params))
    except FileNotFoundError as error:
        raise StoreError(f"{path}: no such file; expected a shard of a dataset", hint="finish the dataset") from error
    except StoreError:
        raise
    except FieldkitError as error:
        raise StoreError(f"{path}: {error.message}", hint=_AGAIN) from error
    except Exception as error:  # numpy, zip and zlib raise many types for damaged files
        raise StoreError(f"{path}: not a readable shard: {error}", hint=_AGAIN) from error
    fault = _head_fault(head) or _layout_fault(head, arrays) or _pose_fault(head, arrays) or _content_fault(arrays)
    if fault is not None:
        raise StoreError(f"{path}: {fault}", hint=_AGAIN)
    return Shard(
        scene=head.scene, waypoint=head.waypoint, next=head.next, key=head.key, camera=camera, view_ids=head.views,
        kinds=head.kinds, status=head.status, **arrays,
    )  # fmt: skip


def read_scene_shard(path: Path, entry: SceneFile, waypoint: str) -> Shard:
    """Read the shard of a waypoint of a dataset's scene.

    Raises StoreError as `read_shard` does, and when it is of another scene or waypoint, or was made otherwise.
    """
    file = shard_path(path, entry.name, waypoint)
    shard = read_shard(file)
    if (shard.scene, shard.waypoint) != (entry.name, waypoint):
        raise StoreError(
            f"{file}: is of {shard.scene}/{shard.waypoint}; expected {entry.name}/{waypoint}, as the file is named",
            hint=_AGAIN,
        )
    if shard.key != entry.views_key:
        raise StoreError(f"{file}: was made with other settings than {entry.name}; expected the same", hint=_AGAIN)
    return shard


def _head_fault(head: _Head) -> str | None:
    """Return what is wrong with a head in itself, or None."""
    views = len(head.views)
    if not views:
        return "holds no views; expected some"
    if len(set(head.views)) < views:
        twice = next(v for v in head.views if head.views.count(v) > 1)
        return f"view {twice!r} is there twice; expected it once"
    if not views == len(head.kinds) == len(head.status):
        return f"{views} views, {len(head.kinds)} kinds and {len(head.status)} status; expected as many of each"
    return None


def _layout_fault(head: _Head, arrays: dict[str, NDArray[Any]]) -> str | None:
    """Return which array has another shape or type than documented, or None."""
    views = len(head.views)
    sizes = {"v": views, "v + 1": views + 1, "k": arrays["landmark"].size, "r": arrays["repeat_view"].size}
    for name, (kind, axes) in _LAYOUT.items():
        shape = tuple(sizes[n] if isinstance(n, str) else n for n in axes)
        found = arrays[name]
        if found.shape != shape or found.dtype != np.dtype(kind):
            return f"{name} is {found.dtype} of shape {found.shape}; expected {np.dtype(kind)} of shape {shape}"
    return None


def _pose_fault(head: _Head, arrays: dict[str, NDArray[Any]]) -> str | None:
    """Return which pose is none, or contradicts its status, or None."""
    known = np.array([s == "ok" for s in head.status])
    for name in ("prior", "body", "candidate", "body_from_cam", "truth"):
        if not _are_poses(arrays[name]):
            return f"{name} is not finite or has no unit quaternion; expected poses x y z qx qy qz qw"
    estimate, covariance, error = (arrays[n] for n in ("estimate", "covariance", "error"))
    if not _are_poses(estimate[known]) or not np.isnan(estimate[~known]).all():
        return "estimate and status contradict each other; expected a pose where it is ok, else nan"
    whole, none = (f(covariance).all(axis=(1, 2)) for f in (np.isfinite, np.isnan))
    if not (none | (whole & known)).all():
        return "covariance is not finite; expected finite numbers where status is ok, else nan"
    if not (np.isfinite(error).all(axis=1) == known).all() or not (error >= 0.0).all():
        return "error and status contradict each other; expected finite numbers where it is ok, else inf"
    if arrays["label"][~known].any():
        return "label and status contradict each other; expected false where localization failed"
    return None


def _content_fault(arrays: dict[str, NDArray[Any]]) -> str | None:
    """Return which array holds what it cannot hold, or None."""
    for name in ("prior_covariance", "confidence", "uv_px", "distance_m", "angle_rad"):
        if not np.isfinite(arrays[name]).all():
            return f"{name} is not finite; expected finite numbers"
    starts, views = arrays["starts"], len(arrays["label"])
    if starts[0] != 0 or starts[-1] != len(arrays["landmark"]) or (np.diff(starts) < 0).any():
        return "starts do not divide the landmarks; expected them to rise from 0 to their number"
    if (arrays["landmark"] < 0).any():
        return "landmark is negative; expected indices in the map"
    again = arrays["repeat_view"]
    if (again < 0).any() or (again >= views).any() or (arrays["repeat_number"] < 1).any():
        return f"repeat_view or repeat_number is out of range; expected 0..{views - 1}, and numbers from 1"
    if not (arrays["repeat_error"] >= 0.0).all():
        return "repeat_error is nan or negative; expected errors, inf where localization failed"
    return None


def _are_poses(rows: NDArray[Any]) -> bool:
    length = np.linalg.norm(rows[..., 3:], axis=-1)
    return bool(np.isfinite(rows).all() and (np.abs(length - 1.0) <= 0.05).all())


def pose_row(a_from_b: Pose) -> Array:
    """Return a pose as f64[7]: x y z qx qy qz qw."""
    return np.concatenate([a_from_b.translation, a_from_b.rotation.as_quat()])


def row_pose(row: Array) -> Pose:
    """Return the pose of a row f64[7]."""
    return pose(row[:3], row[3:])
