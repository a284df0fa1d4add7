"""Dataset folders: what was asked for, the map of every scene, and one shard per waypoint."""

from __future__ import annotations

import dataclasses
import io
import json
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from fieldkit.cameras import Camera
from fieldkit.errors import FieldkitError, StoreError
from fieldkit.frames import Pose, pose
from fieldkit.protocol import CandidateRules, LocalizerRules, Threshold
from fieldkit.store.files import atomic_write, read_toml, write_toml
from fieldkit.types import Array

DATASET_FILE, SCENE_FILE, MAPS_FOLDER = "dataset.toml", "scene.toml", "maps"
A = TypeVar("A", bound=np.generic)


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
    scenes: tuple[str, ...]
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
    waypoints: tuple[str, ...]


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
    """Read scene.toml of a scene of a dataset; raises StoreError when it is missing, damaged or newer."""
    return read_toml(Path(path) / scene / SCENE_FILE, SceneFile, what="scene.toml of a dataset's scene")


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
    """Read the gauge of a map of a dataset."""
    return read_toml(gauge_path(map_folder), GaugeFile, what="the gauge of a dataset's map")


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
    """Read a shard; raises StoreError when it is missing, damaged or newer."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            head = json.loads(bytes(archive["head"]))
            if head["version"] > 1:
                raise StoreError(f"{path}: version {head['version']}; this fieldkit reads 1", hint="update fieldkit")
            model, width, height, *params = head["camera"]
            return Shard(
                scene=head["scene"], waypoint=head["waypoint"], next=head["next"], key=head["key"],
                camera=Camera(model, width, height, tuple(params)), view_ids=tuple(head["views"]),
                kinds=tuple(head["kinds"]), status=tuple(head["status"]), **{n: archive[n] for n in _ARRAYS},
            )  # fmt: skip
    except FileNotFoundError as error:
        raise StoreError(f"{path}: no such file; expected a shard of a dataset", hint="finish the dataset") from error
    except FieldkitError:
        raise
    except Exception as error:  # numpy, zip and zlib raise many types for damaged files
        raise StoreError(f"{path}: not a readable shard: {error}", hint="remove it and finish the dataset") from error


def pose_row(a_from_b: Pose) -> Array:
    """Return a pose as f64[7]: x y z qx qy qz qw."""
    return np.concatenate([a_from_b.translation, a_from_b.rotation.as_quat()])


def row_pose(row: Array) -> Pose:
    """Return the pose of a row f64[7]."""
    return pose(row[:3], row[3:])
