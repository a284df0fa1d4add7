"""Maps: sources, alignment, landmarks, folders on disk, and one build from real images."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
from collections.abc import Sequence
from pathlib import Path

import cv2
import h5py
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from synthetic_map import CAMERA, as_model, looking, make_map, write_map
from test_align import walk

from fieldkit.cameras import Camera
from fieldkit.errors import FieldkitError, MapError, StoreError
from fieldkit.features import Features, extract
from fieldkit.frames import Pose, exp, pose_error, pose_from_matrix
from fieldkit.localize import Localizer
from fieldkit.maps import MapOptions, build_map, compact_map, content_digest, load_map, map_info
from fieldkit.maps.landmarks import LandmarkRules, good_landmarks, landmark_covariance, model_arrays, model_from_arrays
from fieldkit.maps.options import SlamRules
from fieldkit.maps.sources.source import SourceImage, read_source
from fieldkit.maps.structure.pairs import choose_pairs
from fieldkit.maps.structure.plausible import plausible_matches
from fieldkit.maps.structure.rigs import write_cameras
from fieldkit.maps.structure.strays import strays
from fieldkit.store import Rig, RigCamera, write_camera, write_rig, write_tum
from fieldkit.types import Surface


def test_models_survive_colmap(rng: np.random.Generator) -> None:
    scene_map = make_map(rng, n_landmarks=60, n_images=5)
    pixels = [scene_map.observation_px[scene_map.observation_image == i] for i in range(5)]
    again = model_arrays(model_from_arrays(as_model(scene_map), pixels))
    assert again.image_names == scene_map.image_names
    assert again.image_cameras == scene_map.image_cameras
    np.testing.assert_allclose(again.xyz, scene_map.xyz)
    np.testing.assert_array_equal(again.observation_landmark, scene_map.observation_landmark)
    np.testing.assert_array_equal(again.observation_px, scene_map.observation_px)
    for found, expected in zip(again.map_from_image, scene_map.map_from_image, strict=True):
        assert max(pose_error(found, expected)) < 1e-12


def test_the_filter_asks_for_images_distance_and_reprojection(rng: np.random.Generator) -> None:
    model = as_model(make_map(rng, n_landmarks=300))
    n_images = np.bincount(model.observation_landmark, minlength=300)
    good = good_landmarks(model, LandmarkRules())
    np.testing.assert_array_equal(good, n_images >= 4)
    assert 0 < good.sum() < 300
    assert not good_landmarks(model, LandmarkRules(max_distance_m=0.5)).any()
    assert not good_landmarks(model, LandmarkRules(min_distance_m=7.0, max_distance_m=8.0)).any()
    moved = model.observation_px.copy()
    victim = int(np.flatnonzero(good)[0])
    moved[model.observation_landmark == victim] += np.float32(6.0)
    worse = good_landmarks(dataclasses.replace(model, observation_px=moved), LandmarkRules())
    np.testing.assert_array_equal(np.flatnonzero(good & ~worse), [victim])


def test_landmark_covariance_predicts_the_scatter_of_triangulated_points(rng: np.random.Generator) -> None:
    poses = [looking(np.array([0.0, y, 1.5]), 0.0) for y in (-0.6, -0.2, 0.2, 0.6)]
    point = np.array([[3.0, 0.3, 1.2]])
    zeros, images = np.zeros(4, dtype=np.int32), np.arange(4, dtype=np.int32)
    covariance = landmark_covariance(point, zeros, images, poses, [CAMERA] * 4)[0]
    exact = np.stack([CAMERA.project(p.inv().apply(point))[0][0] for p in poses])
    camera = pycolmap.Camera(model="OPENCV", width=480, height=640, params=CAMERA.params)
    cams = [pycolmap.Rigid3d(p.inv().as_matrix()[:3]) for p in poses]
    errors = []
    for _ in range(300):
        noisy = exact + rng.normal(size=(4, 2))
        found = pycolmap.estimate_triangulation(noisy, cams, [camera] * 4)
        errors.append(found["xyz"] - point[0])
    nees = np.einsum("ni,ij,nj->n", np.array(errors), np.linalg.inv(covariance), np.array(errors))
    assert 2.4 < np.mean(nees) < 3.6


def rig_images(rng: np.random.Generator) -> tuple[list[SourceImage], dict[int, Pose]]:
    rig_from_cam = {c: looking(np.array([0.0, 0.1 * i, 0.0]), 0.5 * i) for i, c in enumerate(("ll", "lf", "rf"))}
    images, poses = [], {}
    for frame, map_from_rig in enumerate(walk(rng, 4)):
        for name, pose in rig_from_cam.items():
            poses[len(images)] = map_from_rig * pose
            images.append(SourceImage(f"{name}/{frame}.jpg", Path(), CAMERA, name, str(frame), None, pose))
    return images, poses


def test_a_rig_is_one_body_and_a_lone_camera_its_own(tmp_path: Path, rng: np.random.Generator) -> None:
    images, _ = rig_images(rng)
    images.append(SourceImage("phone/0.jpg", Path(), CAMERA, "phone", "0", None))
    with contextlib.closing(pycolmap.Database.open(tmp_path / "database.db")) as database:
        assert write_cameras(database, images) == [1, 2, 3] * 4 + [4]
        rig, alone = database.read_all_rigs()
        frames = database.read_all_frames()
    assert [len(list(frame.data_ids)) for frame in frames] == [3, 3, 3, 3, 1]
    assert alone.num_sensors() == 1
    cameras = [image.rig_from_cam for image in images[:3]]
    for number, rig_from_cam in enumerate(cameras[1:], start=2):
        found = rig.sensor_from_rig(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number)).matrix()
        assert rig_from_cam is not None
        assert cameras[0] is not None
        assert np.allclose(found, (rig_from_cam.inv() * cameras[0]).as_matrix()[:3], atol=1e-12)


def test_what_sfm_misplaced_is_told_from_what_slam_misplaced(rng: np.random.Generator) -> None:
    images, poses = rig_images(rng)
    slam = {i: pose * exp([0.0, 0.0, 0.0, 0.02, 0.0, 0.0]) for i, pose in poses.items()}
    images = [dataclasses.replace(image, slam_from_cam=slam[i]) for i, image in enumerate(images)]
    assert strays(images, poses, threshold_m=0.05) == []
    leap = exp([0.0, 0.0, 0.0, 2.0, 0.0, 0.0])
    misplaced = poses | {i: poses[i] * leap for i in (3, 4, 5)}
    assert strays(images, misplaced, threshold_m=0.05) == [3, 4, 5]
    jumping = [dataclasses.replace(im, slam_from_cam=slam[i] * leap) if i == 4 else im for i, im in enumerate(images)]
    assert strays(jumping, poses, threshold_m=0.05) == []


def matched(places: Sequence[Pose], slam: Sequence[Pose], points: NDArray[np.float64], *, shift_m: float = 0.0) -> int:
    """Return how many matches SLAM's poses leave when the second camera sees the same thing shifted along x."""
    images = [SourceImage(f"{i}.jpg", Path(), CAMERA, "", str(i), pose) for i, pose in enumerate(slam)]
    seen = []
    for k, place in enumerate(places):
        pixels, _ = CAMERA.project(place.inv().apply(points + [shift_m * k, 0.0, 0.0]))
        unused = np.zeros(len(points), np.float32)
        seen.append(Features(pixels.astype(np.float32), unused, unused, np.zeros((len(points), 128), np.float32)))
    matches = [np.arange(len(points), dtype=np.uint32)[:, None].repeat(2, axis=1)]
    return len(plausible_matches(images, seen, [(0, 1)], matches, rules=SlamRules())[0])


def test_slam_rules_out_the_next_desk_and_keeps_the_same_one_under_drift(rng: np.random.Generator) -> None:
    places = [looking(np.array([x, 0.0, 1.5]), np.pi / 2) for x in (0.0, 1.6)]
    drifted = [places[0], places[1] * exp([0.0, 0.02, 0.0, 0.08, 0.0, 0.0])]
    points = rng.uniform([0.3, 2.5, 1.0], [1.3, 4.0, 2.0], (200, 3))
    assert matched(places, places, points) == 200
    assert matched(places, drifted, points) == 200
    assert matched(places, places, points, shift_m=1.6) < 20
    assert matched(places, drifted, points, shift_m=1.6) < 20


def test_slam_rules_out_the_shelf_opposite_that_looks_the_same() -> None:
    facing = [looking(np.array([0.0, 0.0, 1.5]), np.pi / 2), looking(np.array([0.0, 4.0, 1.5]), -np.pi / 2)]
    between = np.array([[x, 2.0, z] for x in (-0.5, 0.0, 0.5) for z in (1.0, 1.5, 2.0)])
    assert matched(facing, facing, between) == 0


def test_pairs_do_not_depend_on_poses_and_hold_the_neighbours(rng: np.random.Generator) -> None:
    images, _ = rig_images(rng)
    features = [extract(rng.integers(0, 255, size=(64, 64)).astype(np.uint8), max_keypoints=20) for _ in images]
    posed = [dataclasses.replace(i, slam_from_cam=Pose.from_translation(rng.normal(size=3))) for i in images]
    pairs = choose_pairs(images, features, seed=0, n_similar=1, n_neighbours=2)
    assert pairs == choose_pairs(posed, features, seed=0, n_similar=1, n_neighbours=2)
    assert {(0, 3), (0, 6), (0, 1), (0, 4)} <= set(pairs)
    assert all(i < j for i, j in pairs)


def test_a_map_folder_comes_back_as_it_was(tmp_path: Path, rng: np.random.Generator) -> None:
    scene_map = make_map(rng)
    surface = Surface(np.eye(3), np.array([[0, 1, 2]], dtype=np.int32), 0.05)
    write_map(tmp_path / "room.map", scene_map, surface=surface)
    again = load_map(tmp_path / "room.map")
    seen = np.unique(scene_map.observation_landmark)
    np.testing.assert_allclose(again.xyz[seen], scene_map.xyz[seen])
    np.testing.assert_array_equal(again.descriptors, scene_map.descriptors)
    np.testing.assert_array_equal(again.descriptor_landmark, scene_map.descriptor_landmark)
    np.testing.assert_array_equal(again.observation_image, scene_map.observation_image)
    assert again.surface is not None
    assert again.surface.voxel_m == 0.05
    assert again.digest == content_digest(tmp_path / "room.map") == map_info(tmp_path / "room.map")["digest"]


def test_features_are_stored_as_hloc_stores_them(tmp_path: Path, rng: np.random.Generator) -> None:
    scene_map = make_map(rng, n_landmarks=50, n_images=4)
    write_map(tmp_path / "room.map", scene_map)
    rows = scene_map.observation_image == 2
    with h5py.File(tmp_path / "room.map" / "features.h5") as file:
        group = file["lf"]["000002.jpg"]
        np.testing.assert_allclose(group["keypoints"][:], scene_map.observation_px[rows] - 0.5, atol=1e-4)
        np.testing.assert_array_equal(group["descriptors"][:], scene_map.descriptors[rows].T)
        np.testing.assert_array_equal(group["image_size"][:], [480, 640])


def test_a_compact_map_has_one_descriptor_per_landmark_and_the_same_geometry(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    scene_map = make_map(rng)
    write_map(tmp_path / "room.map", scene_map)
    compact_map(tmp_path / "room.map", tmp_path / "small.map")
    full, small = load_map(tmp_path / "room.map"), load_map(tmp_path / "small.map")
    np.testing.assert_allclose(small.xyz, full.xyz)
    np.testing.assert_array_equal(small.observation_landmark, full.observation_landmark)
    np.testing.assert_allclose(small.observation_px, full.observation_px, atol=0.02)
    np.testing.assert_array_equal(np.sort(small.descriptor_landmark), np.unique(full.descriptor_landmark))
    assert small.digest != full.digest
    for row in range(0, len(small.descriptors), 17):
        original = (full.descriptor_landmark == small.descriptor_landmark[row]) & (
            full.descriptor_image == small.descriptor_image[row]
        )
        np.testing.assert_array_equal(full.descriptors[original][0], small.descriptors[row])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda p: (p / "map.toml").unlink(), "no map.toml"),
        (lambda p: (p / "features.h5").unlink(), "features.h5: no such file"),
        (lambda p: (p / "features.h5").write_bytes(b"cut off"), "another digest.* damaged or changed"),
        (lambda p: shutil.rmtree(p / "sparse"), "images.bin: no such file"),
        (lambda p: (p / "sparse" / "images.bin").write_bytes(b"\x05"), "another digest.* damaged or changed"),
        (lambda p: (p / "surface.ply").write_bytes(b"ply"), "another digest.* damaged or changed"),
        (lambda p: _replace(p / "map.toml", '"sift"', '"sfit"'), "sfit.*did you mean 'sift'"),
        (lambda p: _replace(p / "map.toml", "version = 1", "version = 2"), "version 2"),
        (lambda p: _replace(p / "map.toml", "n_images", "n_image"), "n_image"),
    ],
)
def test_a_damaged_map_is_named(tmp_path: Path, rng: np.random.Generator, damage: object, message: str) -> None:
    path = tmp_path / "room.map"
    write_map(path, make_map(rng, n_landmarks=50, n_images=4))
    damage(path)  # type: ignore[operator]
    with pytest.raises(FieldkitError, match=message):
        load_map(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("voxel_m = 0.05", "voxel_m = 0.1", r"map\.toml: surface\.voxel_m is 0\.1; expected 0\.05 as in surface\.ply"),
        ("voxel_m = 0.05", "voxel_m = nan", r"surface\.voxel_m is nan; expected a positive number"),
        ("voxel_m = 0.05", "voxel_m = 0.0", r"surface\.voxel_m is 0; expected a positive number"),
        ("truncation_m = 0.14", "truncation_m = inf", r"surface\.truncation_m is inf; expected a positive number"),
        ("\nscale = 1.0", "\nscale = -1.0", r"alignment\.scale is -1; expected a positive number"),
        ("rms_m = 0.0", "rms_m = nan", r"alignment\.rms_m is nan; expected a finite number"),
        ('"surface.ply"', '"../other.ply"', r"map\.toml: .*other\.ply"),
        ('[surface]\nvoxel_m = 0.05\ntruncation_m = 0.14\nfile = "surface.ply"\n', "", r"has no \[surface\]"),
    ],
)
def test_numbers_of_a_map_that_no_digest_covers_cannot_change_results(
    tmp_path: Path, rng: np.random.Generator, old: str, new: str, message: str
) -> None:
    path = tmp_path / "room.map"
    surface = Surface(np.eye(3), np.array([[0, 1, 2]], dtype=np.int32), 0.05)
    write_map(path, make_map(rng, n_landmarks=50, n_images=4), surface=surface)
    assert old in (path / "map.toml").read_text()
    _replace(path / "map.toml", old, new)
    with pytest.raises(FieldkitError, match=message):
        load_map(path)


@pytest.mark.parametrize("value", [0.0, -0.1, float("nan"), float("inf")])
def test_a_voxel_without_size_fails_before_any_work(tmp_path: Path, rng: np.random.Generator, value: float) -> None:
    with pytest.raises(MapError, match=r"voxel_m is .*; expected a positive number; choose another voxel_m"):
        MapOptions(voxel_m=value)
    write_map(tmp_path / "room.map", make_map(rng, n_landmarks=50, n_images=4))
    with pytest.raises(MapError, match=r"voxel_m is .*; expected a positive number"):
        compact_map(tmp_path / "room.map", tmp_path / "small.map", voxel_m=value)
    assert [p.name for p in tmp_path.iterdir()] == ["room.map"]


def test_a_missing_map_is_named(tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"none\.map: no such folder"):
        load_map(tmp_path / "none.map")


def _replace(path: Path, old: str, new: str) -> None:
    path.write_text(path.read_text().replace(old, new))


def image_folder(path: Path, n: int = 4) -> Path:
    """Write a SOURCE of blank images with poses."""
    (path / "images").mkdir(parents=True)
    for i in range(n):
        cv2.imwrite(str(path / "images" / f"{i:03d}.png"), np.full((48, 64), 128, dtype=np.uint8))
    write_camera(path / "camera.toml", Camera("PINHOLE", 64, 48, (60.0, 60.0, 32.0, 24.0)))
    write_tum(path / "poses.txt", [(f"{i:03d}", Pose.from_translation([0.2 * i, 0.0, 0.0])) for i in range(n)])
    return path


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda p: shutil.rmtree(p), "source: no such folder"),
        (lambda p: shutil.rmtree(p / "images"), "no folder images/"),
        (lambda p: [f.unlink() for f in (p / "images").iterdir()], "no image found"),
        (lambda p: (p / "camera.toml").unlink(), "camera.toml: no such file"),
        (lambda p: (p / "poses.txt").unlink(), "neither poses nor depth images, and no tag's size given"),
        (lambda p: (p / "poses.txt").write_text("000 1 2\n"), "line 1"),
        (lambda p: write_tum(p / "poses.txt", [(n, Pose.identity()) for n in "abcd"]),
         r"poses\.txt: names 0 of the 4 images; expected at least 3"),
        (lambda p: [(p / "images" / f"00{i}.png").unlink() for i in (0, 1)], "names 2 of the 2 images"),
        (lambda p: (p / "images" / "001.png").write_bytes(b"broken"), "001.png: cannot be read"),
        (lambda p: cv2.imwrite(str(p / "images" / "002.png"), np.zeros((30, 40), np.uint8)), "002.png: is 40x30"),
        (lambda p: shutil.copy(p / "images" / "001.png", p / "images" / "001.jpg"), "have one name"),
        (lambda p: (p / "depth").mkdir() or cv2.imwrite(str(p / "depth" / "001.png"), np.zeros((4, 4), np.uint16)),
         "depth/ without depth_camera.toml"),
        (lambda p: None, "no pair of the 4 images shows the same place"),
    ],
)  # fmt: skip
def test_a_source_that_cannot_be_mapped_is_named_and_leaves_nothing(
    tmp_path: Path, damage: object, message: str
) -> None:
    source = image_folder(tmp_path / "source")
    damage(source)  # type: ignore[operator]
    with pytest.raises(FieldkitError, match=message):
        build_map(source, tmp_path / "out.map")
    assert not list(tmp_path.glob("*out.map*"))


def test_a_rig_folder_is_read_with_its_frames_depth_and_poses(tmp_path: Path) -> None:
    cameras = tuple(
        RigCamera(n, CAMERA, looking(np.array([0.0, 0.1, 0.0]), yaw)) for n, yaw in (("lf", 0.1), ("rf", -0.1))
    )
    depth = RigCamera("depth", Camera("PINHOLE", 64, 48, (60.0, 60.0, 32.0, 24.0)), looking(np.zeros(3), 0.0))
    for name in ("images/lf", "images/rf", "depth"):
        (tmp_path / name).mkdir(parents=True)
    write_rig(tmp_path / "rig.toml", Rig(cameras, depth))
    poses = [Pose.from_translation([0.2 * i, 0.0, 1.6]) for i in range(3)]
    write_tum(tmp_path / "slam_poses.txt", [(f"{i:06d}", p) for i, p in enumerate(poses)])
    for i in range(3):
        for camera in ("lf", "rf"):
            cv2.imwrite(str(tmp_path / "images" / camera / f"{i:06d}.jpg"), np.zeros((640, 480), dtype=np.uint8))
    cv2.imwrite(str(tmp_path / "depth" / "000001.png"), np.zeros((48, 64), dtype=np.uint16))
    source = read_source(tmp_path)
    assert [i.name for i in source.images][:4] == ["lf/000000.jpg", "lf/000001.jpg", "lf/000002.jpg", "rf/000000.jpg"]
    slam = source.images[1].slam_from_cam
    assert slam is not None
    assert max(pose_error(slam, poses[1] * cameras[0].rig_from_cam)) < 1e-6
    assert [d.file.name for d in source.depth] == ["000001.png"]
    for index, cam_from_depth in source.depth[0].anchors:
        camera = cameras[0] if source.images[index].sequence == "lf" else cameras[1]
        assert max(pose_error(camera.rig_from_cam * cam_from_depth, depth.rig_from_cam)) < 1e-6


def test_an_existing_map_is_not_replaced_unasked(tmp_path: Path) -> None:
    source = image_folder(tmp_path / "source")
    (tmp_path / "old.map").mkdir()
    (tmp_path / "old.map" / "map.toml").write_text("old")
    with pytest.raises(StoreError, match="exists already"):
        build_map(source, tmp_path / "old.map")
    with pytest.raises(MapError):
        build_map(source, tmp_path / "old.map", force=True)
    assert (tmp_path / "old.map" / "map.toml").read_text() == "old"


def test_a_rig_walk_with_the_poses_of_another_is_named(tmp_path: Path) -> None:
    write_rig(tmp_path / "rig.toml", Rig((RigCamera("lf", CAMERA, Pose.identity()),)))
    (tmp_path / "images" / "lf").mkdir(parents=True)
    for i in range(5):
        cv2.imwrite(str(tmp_path / "images" / "lf" / f"{i:06d}.png"), np.zeros((640, 480), dtype=np.uint8))
    write_tum(tmp_path / "slam_poses.txt", [(f"{i:06d}", Pose.identity()) for i in range(3, 9)])
    with pytest.raises(MapError, match=r"slam_poses\.txt: names 2 of the 5 images; expected at least 3"):
        read_source(tmp_path)


@pytest.fixture(scope="module")
def kitchen(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A SOURCE of 16 frames of the real kitchen at half resolution, with depth."""
    folder, frames = tmp_path_factory.mktemp("kitchen"), shared_data / "redkitchen"
    for name in ("images", "depth"):
        (folder / name).mkdir()
    rows = []
    for number in range(0, 256, 16):
        stem = f"frame-{number:06d}"
        image = cv2.imread(str(frames / "frames" / f"{stem}.color.jpg"))
        cv2.imwrite(str(folder / "images" / f"{stem}.png"), cv2.resize(image, (320, 240), interpolation=cv2.INTER_AREA))
        depth = cv2.imread(str(frames / "frames" / f"{stem}.depth.png"), cv2.IMREAD_UNCHANGED)
        depth[depth == 65535] = 0
        cv2.imwrite(str(folder / "depth" / f"{stem}.png"), depth[::4, ::4].copy())
        rows.append((stem, pose_from_matrix(np.loadtxt(frames / "poses" / f"{stem}.pose.txt"))))
    write_camera(folder / "camera.toml", Camera("PINHOLE", 320, 240, (262.5, 262.5, 160.0, 120.0)))
    write_camera(folder / "depth_camera.toml", Camera("PINHOLE", 160, 120, (146.25, 146.25, 80.0, 60.0)))
    write_tum(folder / "poses.txt", rows)
    return folder


@pytest.fixture(scope="module")
def kitchen_map(kitchen: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("maps") / "kitchen.map"
    build_map(kitchen, out, options=MapOptions(max_keypoints=1000))
    return out


def test_real_images_become_a_metric_map(kitchen: Path, kitchen_map: Path) -> None:
    info, scene_map = map_info(kitchen_map), load_map(kitchen_map)
    assert info["n_registered"] >= 14
    assert info["n_landmarks"] == len(scene_map.xyz) > 200
    assert info["alignment"]["rms_m"] < 0.08
    truth = {i.name: i.slam_from_cam for i in read_source(kitchen).images}
    errors = [
        pose_error(found, truth[name])[0]
        for name, found in zip(scene_map.image_names, scene_map.map_from_image, strict=True)
        if truth[name] is not None
    ]
    assert np.median(errors) < 0.08
    assert scene_map.surface is not None
    assert len(scene_map.surface.faces) > 2000


def test_building_again_gives_the_same_map_bit_for_bit(kitchen: Path, kitchen_map: Path, tmp_path: Path) -> None:
    steps: list[str] = []
    report = build_map(
        kitchen,
        tmp_path / "again.map",
        options=MapOptions(max_keypoints=1000),
        progress=lambda step, done, total: steps.append(step),
    )
    assert report.digest == load_map(kitchen_map).digest
    assert list(dict.fromkeys(steps)) == ["extract", "match", "verify", "reconstruct", "surface"]


def test_a_map_without_depth_has_no_surface_and_says_so(kitchen: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare"
    shutil.copytree(kitchen, bare, ignore=shutil.ignore_patterns("depth*"))
    report = build_map(bare, tmp_path / "bare.map", options=MapOptions(max_keypoints=600))
    assert not report.has_surface
    assert any("no depth images" in w for w in report.warnings)
    assert load_map(tmp_path / "bare.map").surface is None
    assert not (tmp_path / "bare.map" / "surface.ply").exists()


def test_a_real_image_is_localized_and_repeats_bit_for_bit(kitchen: Path, kitchen_map: Path, shared_data: Path) -> None:
    camera = Camera("PINHOLE", 320, 240, (262.5, 262.5, 160.0, 120.0))
    images = [
        cv2.resize(cv2.imread(str(shared_data / "redkitchen" / "frames" / f"frame-{n:06d}.color.jpg"), 0), (320, 240))
        for n in (24, 40, 232)
    ]
    images = [np.asarray(image, dtype=np.uint8) for image in images]
    localizer = Localizer(load_map(kitchen_map))
    first = [localizer.localize(image, camera) for image in images]
    again = [Localizer(load_map(kitchen_map)).localize(image, camera) for image in reversed(images)][::-1]
    for number, a, b in zip((24, 40, 232), first, again, strict=True):
        truth = pose_from_matrix(np.loadtxt(shared_data / "redkitchen" / "poses" / f"frame-{number:06d}.pose.txt"))
        assert a.status == "ok"
        assert a.map_from_cam is not None
        assert b.map_from_cam is not None
        assert pose_error(a.map_from_cam, truth)[0] < 0.12
        np.testing.assert_array_equal(a.map_from_cam.as_matrix(), b.map_from_cam.as_matrix())
        np.testing.assert_array_equal(a.covariance, b.covariance)
        assert set(a.seconds) == {"extract", "retrieve", "match", "pnp"}
    blank = localizer.localize(np.full((240, 320), 90, dtype=np.uint8), camera)
    assert blank.map_from_cam is None
    assert blank.covariance is None
    assert blank.status == "no_features"
