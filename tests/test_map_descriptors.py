"""Where an imported model's descriptors come from: hloc's features, COLMAP's database, the images."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable
from pathlib import Path

import cv2
import h5py
import numpy as np
import pycolmap
import pytest
from hloc_model import EVERY, assert_same, by_hloc, observed_room, put, rewritten, write_hloc

from fieldkit.cameras import Camera
from fieldkit.errors import MapError
from fieldkit.features import extract
from fieldkit.frames import Pose
from fieldkit.maps import (
    FrameOptions,
    ImportOptions,
    import_map,
    load_map,
)
from fieldkit.maps.colmap import read_model, write_model
from fieldkit.maps.descriptors import read_landmark_descriptors
from fieldkit.maps.landmarks import Model
from fieldkit.types import SceneMap


@pytest.fixture(scope="module")
def scene_map() -> SceneMap:
    """Landmarks of a room that at least two images see."""
    return observed_room()


@pytest.fixture(scope="module")
def model(scene_map: SceneMap, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """hloc's files of the map in another scale and frame: sfm/, features.h5, and poses.txt in the map's."""
    return write_hloc(tmp_path_factory.mktemp("hloc"), scene_map)


def test_hloc_finds_features_and_pairs_of_every_image(model: Path, scene_map: SceneMap) -> None:
    with h5py.File(model / "features.h5", "r") as file:
        group = file[scene_map.image_names[0]]
        mine = scene_map.observation_px[scene_map.observation_image == 0]
        np.testing.assert_allclose(group["keypoints"][:], mine - 0.5, atol=1e-4)
        assert group["descriptors"].shape == (128, len(mine))
        assert group["descriptors"].dtype == np.float32
        assert list(group["image_size"]) == [480, 640]
    pairs = [line.split() for line in (model / "pairs-db-covis20.txt").read_text().splitlines()]
    assert {a for a, _ in pairs} == set(scene_map.image_names)
    assert all(a != b for a, b in pairs)


def test_half_precision_keypoints_of_hloc_are_still_the_model_s(
    model: Path, scene_map: SceneMap, tmp_path: Path
) -> None:
    halved = rewritten(model, tmp_path, lambda g: halve(g))
    found = import_map(model, tmp_path / "lab.map", options=by_hloc(model, features=halved))
    assert found.n_landmarks == len(scene_map.xyz)
    again = load_map(tmp_path / "lab.map").descriptors.astype(int)
    assert np.abs(again - scene_map.descriptors).max() <= 1


def halve(group: h5py.Group) -> None:
    for name in ("keypoints", "descriptors"):
        values = group[name][()].astype(np.float16)
        del group[name]
        group[name] = values


def flatten(group: h5py.Group) -> None:
    parent, name = group.parent, group.name
    del parent[name]
    parent[name] = 3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (put("keypoints", lambda k: k + np.float32(0.5)), r"not the model's: in lf/000000\.jpg they lie 0\.707 px"),
        (put("descriptors", lambda d: np.repeat(d, 2, axis=0)), "width 256; sift has 128"),
        (put("descriptors", lambda d: d - np.float32(0.1)), "negative or not of length 1"),
        (put("descriptors", lambda d: d**6 / np.linalg.norm(d**6, axis=0)), "SIFT of another normalisation"),
        (put("descriptors", lambda d: d * np.nan), "not finite"),
        (flatten, "cannot be read"),
        (put("descriptors", lambda d: d[:, :-1]), r"keypoints .* expected \(n, 2\)"),
    ],
)
def test_features_of_another_kind_are_refused(
    model: Path, tmp_path: Path, change: Callable[[h5py.Group], None], message: str
) -> None:
    with pytest.raises(MapError, match=message):
        import_map(model, tmp_path / "lab.map", options=by_hloc(model, features=rewritten(model, tmp_path, change)))
    assert not (tmp_path / "lab.map").exists()


def test_sift_is_no_other_feature_of_its_width(model: Path, tmp_path: Path) -> None:
    with pytest.raises(MapError, match="without negative numbers, as of SIFT; aliked has some"):
        import_map(model, tmp_path / "lab.map", options=by_hloc(model, feature="aliked"))
    assert not (tmp_path / "lab.map").exists()


def test_observations_without_a_descriptor_do_not_hide_what_the_others_are(model: Path, tmp_path: Path) -> None:
    def clear(descriptors: np.ndarray) -> np.ndarray:
        return descriptors * (np.arange(descriptors.shape[1]) % 3 == 0)

    features = rewritten(model, tmp_path, put("descriptors", clear))
    import_map(model, tmp_path / "lab.map", options=by_hloc(model, features=features))
    found = load_map(tmp_path / "lab.map")
    assert 0 < found.descriptors.any(axis=1).sum() < 0.5 * len(found.observation_landmark)


def test_features_of_other_images_are_refused(model: Path, tmp_path: Path) -> None:
    with h5py.File(tmp_path / "features.h5", "w") as file:
        file.create_group("query/1.jpg")
    with pytest.raises(MapError, match=r"features\.h5: no features of lf/000000\.jpg"):
        import_map(model, tmp_path / "lab.map", options=by_hloc(model, features=tmp_path / "features.h5"))
    (tmp_path / "features.h5").write_bytes(b"no hdf5")
    with pytest.raises(MapError, match=r"features\.h5: cannot be read"):
        import_map(model, tmp_path / "lab.map", options=by_hloc(model, features=tmp_path / "features.h5"))


def write_database(path: Path, scene_map: SceneMap, *, shift: float = 0.0) -> None:
    with contextlib.closing(pycolmap.Database.open(path)) as database:
        for i, name in enumerate(scene_map.image_names, start=1):
            rows = scene_map.observation_image == i - 1
            if i == 1:
                database.write_camera(pycolmap.Camera(camera_id=1, model="PINHOLE", width=480, height=640,
                                                      params=[367, 366, 240, 320]), use_camera_id=True)  # fmt: skip
            database.write_image(pycolmap.Image(name=name, camera_id=1, image_id=i), use_image_id=True)
            database.write_keypoints(i, scene_map.observation_px[rows] + np.float32(shift))
            descriptors = pycolmap.FeatureDescriptors(
                type=pycolmap.FeatureExtractorType.SIFT, data=scene_map.descriptors[rows]
            )
            database.write_descriptors(i, descriptors)


def test_descriptors_come_from_a_colmap_database(model: Path, scene_map: SceneMap, tmp_path: Path) -> None:
    write_database(tmp_path / "database.db", scene_map)
    before = (tmp_path / "database.db").read_bytes()
    options = by_hloc(model, features=None, database=tmp_path / "database.db")
    import_map(model, tmp_path / "lab.map", options=options)
    assert_same(load_map(tmp_path / "lab.map"), scene_map)
    assert (tmp_path / "database.db").read_bytes() == before


def test_the_database_of_another_model_is_refused(model: Path, scene_map: SceneMap, tmp_path: Path) -> None:
    write_database(tmp_path / "moved.db", scene_map, shift=3.0)
    renamed = dataclasses.replace(scene_map, image_names=tuple(f"x{n}" for n in scene_map.image_names))
    write_database(tmp_path / "renamed.db", renamed)
    (tmp_path / "broken.db").write_bytes(b"no database at all" * 100)
    for name, message in {
        "moved": r"keypoints are not the model's: .* 4\.24 px",
        "renamed": r"lf/000000\.jpg: no image of that name",
        "broken": "cannot be read",
        "none": "no such file",
    }.items():
        options = by_hloc(model, features=None, database=tmp_path / f"{name}.db")
        with pytest.raises(MapError, match=message):
            import_map(model, tmp_path / "lab.map", options=options)


def test_descriptors_are_extracted_where_the_model_s_keypoints_are(tmp_path: Path) -> None:
    images, small = tmp_path / "images", Camera("PINHOLE", 160, 120, (150.0, 150.0, 80.0, 60.0))
    images.mkdir()
    grey = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 256, (120, 160), dtype=np.uint8), (0, 0), 1.5)
    grey = cv2.normalize(grey, None, 0, 255, cv2.NORM_MINMAX)
    for i in range(4):
        cv2.imwrite(str(images / f"{i}.png"), grey)
    found = extract(grey)
    px = np.concatenate([found.keypoints_px[:60], [[3.0, 3.0]]]).astype(np.float32)
    n = len(px)
    xyz = small.unproject(px) * 2.0
    model = Model(
        tuple(f"{i}.png" for i in range(4)), (small,) * 4, (Pose.identity(),) * 4, xyz, np.arange(1, n + 1),
        np.tile(np.arange(n, dtype=np.int32), 4), np.repeat(np.arange(4, dtype=np.int32), n),
        np.tile(np.arange(n, dtype=np.int32), 4), np.tile(px, (4, 1)),
    )  # fmt: skip
    write_model(tmp_path / "model", model, [px] * 4)
    options = ImportOptions(frame=FrameOptions(scale=1.0, up="-y"), landmarks=EVERY)
    report = import_map(tmp_path / "model", tmp_path / "lab.map", images=images, options=options)
    scene_map = load_map(tmp_path / "lab.map")
    assert report.n_landmarks == n
    assert len(np.unique(scene_map.descriptor_landmark)) >= n - 1
    row = int(np.flatnonzero((scene_map.descriptor_landmark == 7) & (scene_map.descriptor_image == 2))[0])
    same = np.linalg.norm(found.keypoints_px - px[7], axis=1) < 1.0
    assert (found.descriptors[same] == scene_map.descriptors[row]).all(axis=1).any()


def test_of_too_many_descriptors_landmarks_keep_the_most_different_views(model: Path, scene_map: SceneMap) -> None:
    lab = model.parent / "lab.map"
    arrays = read_model(lab / "sparse")
    room = 2 * len(scene_map.xyz) * 128
    values, rows = read_landmark_descriptors(lab / "features.h5", arrays, width=128, max_bytes=room)
    owned = np.bincount(arrays.observation_landmark[rows], minlength=len(scene_map.xyz))
    np.testing.assert_array_equal(owned, np.minimum(np.bincount(arrays.observation_landmark), 2))
    np.testing.assert_array_equal(values, scene_map.descriptors[rows])
    k = int(np.argmax(np.bincount(arrays.observation_landmark)))
    centres = np.stack([p.translation for p in scene_map.map_from_image])
    mine = np.flatnonzero(arrays.observation_landmark == k)
    views = centres[arrays.observation_image[mine]] - scene_map.xyz[k]
    views = np.column_stack([views / np.linalg.norm(views, axis=1)[:, None], np.log(np.linalg.norm(views, axis=1))])
    away = np.linalg.norm(views[:, None] - views[None], axis=2)
    kept = np.flatnonzero(np.isin(mine, rows))
    assert away[kept[0], kept[1]] in [pytest.approx(away[k].max(), rel=1e-5) for k in kept]
    one, few = read_landmark_descriptors(lab / "features.h5", arrays, width=128, max_bytes=1)
    assert len(one) == len(few) == len(scene_map.xyz)
