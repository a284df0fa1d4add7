"""A map and the files that hloc would have of it, in another scale and frame."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
from scipy.spatial.transform import Rotation
from synthetic_map import as_model, make_map, write_map

from fieldkit.frames import pose_error
from fieldkit.maps import (
    FrameOptions,
    ImportOptions,
    LandmarkRules,
    export_map,
)
from fieldkit.maps.colmap import write_model
from fieldkit.maps.landmarks import Model
from fieldkit.maps.metric.align import Similarity
from fieldkit.store import write_tum
from fieldkit.types import SceneMap

SCALE = 3.7
SFM_FROM_MAP = Similarity(1 / SCALE, Rotation.from_rotvec([0.4, -1.1, 0.3]), np.array([1.0, -2.0, 0.5]))
EVERY = LandmarkRules(min_images=2)


def observed_room() -> SceneMap:
    """Return a map of landmarks of a room that at least two images see."""
    made = make_map(np.random.default_rng(0), n_landmarks=300, n_images=16)
    kept = np.bincount(made.observation_landmark, minlength=300) >= 2
    number, rows = np.cumsum(kept) - 1, kept[made.observation_landmark]
    owner = number[made.observation_landmark[rows]].astype(np.int32)
    values = made.descriptors[rows].astype(float)
    values *= 512 / np.linalg.norm(values, axis=1, keepdims=True)
    return dataclasses.replace(
        made,
        xyz=made.xyz[kept],
        xyz_covariance=made.xyz_covariance[kept],
        observation_landmark=owner,
        observation_image=made.observation_image[rows],
        observation_px=made.observation_px[rows],
        descriptors=np.rint(values).astype(np.uint8),
        descriptor_landmark=owner,
        descriptor_image=made.observation_image[rows],
    )


def pixels_of(model: Model) -> list[np.ndarray]:
    return [model.observation_px[model.observation_image == i] for i in range(len(model.image_names))]


def write_hloc(folder: Path, scene_map: SceneMap) -> Path:
    """Write a map, and hloc's files of it in another scale and frame: sfm/, features.h5, poses.txt in the map's."""
    write_map(folder / "lab.map", scene_map)
    export_map(folder / "lab.map", folder / "hloc", to="hloc")
    arrays = as_model(scene_map)
    moved = dataclasses.replace(
        arrays,
        xyz=SFM_FROM_MAP.points(arrays.xyz),
        map_from_image=tuple(SFM_FROM_MAP.pose(p) for p in arrays.map_from_image),
    )
    write_model(folder / "hloc" / "sfm", moved, pixels_of(arrays))
    write_tum(folder / "hloc" / "poses.txt", zip(scene_map.image_names, scene_map.map_from_image, strict=True))
    return folder / "hloc"


def by_hloc(model: Path, **options: object) -> ImportOptions:
    frame = {"poses": model / "poses.txt"} | {k: options.pop(k) for k in ("poses", "scale", "up") if k in options}
    chosen = {"features": model / "features.h5", "landmarks": EVERY, **options}
    return ImportOptions(frame=FrameOptions(**frame), **chosen)  # type: ignore[arg-type]


def assert_same(found: SceneMap, expected: SceneMap) -> None:
    """Landmarks, poses, observations and descriptors are the same, up to rounding."""
    assert found.image_names == expected.image_names
    assert found.image_cameras == expected.image_cameras
    np.testing.assert_allclose(found.xyz, expected.xyz, atol=1e-6)
    np.testing.assert_array_equal(found.observation_landmark, expected.observation_landmark)
    np.testing.assert_allclose(found.observation_px, expected.observation_px, atol=1e-4)
    np.testing.assert_array_equal(found.descriptors, expected.descriptors)
    for a, b in zip(found.map_from_image, expected.map_from_image, strict=True):
        assert max(pose_error(a, b)) < 1e-6


def rewritten(model: Path, folder: Path, change: Callable[[h5py.Group], None]) -> Path:
    """Return a copy of the features file with a change in every image's group."""
    path = folder / "features.h5"
    path.write_bytes((model / "features.h5").read_bytes())
    with h5py.File(path, "a") as file:
        for name in list(file["lf"]):
            change(file["lf"][name])
    return path


def put(name: str, values: Callable[[np.ndarray], np.ndarray]) -> Callable[[h5py.Group], None]:
    def change(group: h5py.Group) -> None:
        old = group[name][()]
        del group[name]
        group[name] = values(old)

    return change
