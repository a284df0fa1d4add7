"""COLMAP and hloc models become maps: every source of scale, descriptors and surface, and what is refused."""

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
import trimesh
from scipy.spatial.transform import Rotation
from synthetic_map import as_model, make_map, write_map

from fieldkit import cli
from fieldkit.cameras import Camera
from fieldkit.errors import FieldkitError, MapError
from fieldkit.features import extract
from fieldkit.frames import Pose, pose_error
from fieldkit.maps import (
    ForeignMesh,
    FrameOptions,
    ImportOptions,
    LandmarkRules,
    export_map,
    import_map,
    load_map,
    map_info,
)
from fieldkit.maps.colmap import model_folder, read_model, write_model
from fieldkit.maps.descriptors import read_landmark_descriptors
from fieldkit.maps.landmarks import Model, model_arrays
from fieldkit.maps.metric.align import Similarity
from fieldkit.maps.sources.stamps import match_names
from fieldkit.store import write_tum
from fieldkit.types import SceneMap

SCALE = 3.7
SFM_FROM_MAP = Similarity(1 / SCALE, Rotation.from_rotvec([0.4, -1.1, 0.3]), np.array([1.0, -2.0, 0.5]))
EVERY = LandmarkRules(min_images=2)


def pixels_of(model: Model) -> list[np.ndarray]:
    return [model.observation_px[model.observation_image == i] for i in range(len(model.image_names))]


@pytest.fixture(scope="module")
def scene_map() -> SceneMap:
    """Landmarks of a room that at least two images see."""
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


@pytest.fixture(scope="module")
def model(scene_map: SceneMap, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """hloc's files of the map in another scale and frame: sfm/, features.h5, and poses.txt in the map's."""
    folder = tmp_path_factory.mktemp("hloc")
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


def test_an_hloc_model_in_any_frame_becomes_the_metric_map_again(
    model: Path, scene_map: SceneMap, tmp_path: Path
) -> None:
    report = import_map(model, tmp_path / "lab.map", options=by_hloc(model))
    assert report.alignment.source == "slam"
    assert report.alignment.map_from_sfm.scale == pytest.approx(SCALE)
    assert any("no mesh" in w for w in report.warnings)
    assert_same(load_map(tmp_path / "lab.map"), scene_map)


@pytest.mark.parametrize("to", ["colmap", "hloc"])
def test_an_exported_map_comes_back_as_it_was(model: Path, scene_map: SceneMap, tmp_path: Path, to: str) -> None:
    lab = model.parent / "lab.map"
    export_map(lab, tmp_path / "out", to=to)  # type: ignore[arg-type]
    import_map(tmp_path / "out", tmp_path / "again.map", options=by_hloc(model, poses=None, scale=1.0))
    assert_same(load_map(tmp_path / "again.map"), scene_map)
    info = map_info(tmp_path / "again.map")["alignment"]
    assert (info["source"], info["scale"], info["verdict"]) == ("known", 1.0, "pass")


def test_colmap_reads_what_is_exported_and_written_as_arrays(model: Path, scene_map: SceneMap, tmp_path: Path) -> None:
    export_map(model.parent / "lab.map", tmp_path / "out", to="colmap")
    text = tmp_path / "text"
    text.mkdir()
    for file in ("cameras", "images", "points3D"):
        (tmp_path / "out" / f"{file}.txt").rename(text / f"{file}.txt")
    for folder in (tmp_path / "out", text, model.parent / "lab.map" / "sparse"):
        found = model_arrays(pycolmap.Reconstruction(folder))
        np.testing.assert_allclose(found.xyz, scene_map.xyz, atol=1e-9)
        np.testing.assert_array_equal(found.observation_landmark, scene_map.observation_landmark)
        ours = read_model(folder)
        np.testing.assert_allclose(ours.xyz, found.xyz, atol=1e-12)
        np.testing.assert_array_equal(ours.observation_keypoint, found.observation_keypoint)
        for a, b in zip(ours.map_from_image, found.map_from_image, strict=True):
            assert max(pose_error(a, b)) < 1e-12


def test_points_of_a_written_model_know_their_error_and_track(model: Path, scene_map: SceneMap) -> None:
    found = pycolmap.Reconstruction(model / "sfm")
    assert found.compute_mean_reprojection_error() < 1e-3
    assert found.compute_num_observations() == len(scene_map.observation_landmark)
    assert all(p.error < 1e-2 for p in found.points3D.values())


def test_a_model_is_found_below_the_folder_that_a_tool_wrote(model: Path, tmp_path: Path) -> None:
    assert model_folder(model) == model / "sfm"
    (tmp_path / "sparse").mkdir()
    (tmp_path / "sparse" / "0").symlink_to(model / "sfm")
    assert model_folder(tmp_path) == tmp_path / "sparse" / "0"


def test_tum_poses_of_the_mapping_images_are_exported(model: Path, scene_map: SceneMap, tmp_path: Path) -> None:
    export_map(model.parent / "lab.map", tmp_path / "out", to="tum")
    lines = (tmp_path / "out" / "poses.txt").read_text().splitlines()
    assert [line.split()[0] for line in lines] == list(scene_map.image_names)


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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (put("keypoints", lambda k: k + np.float32(0.5)), r"not the model's: in lf/000000\.jpg they lie 0\.707 px"),
        (put("descriptors", lambda d: np.repeat(d, 2, axis=0)), "width 256; sift has 128"),
        (put("descriptors", lambda d: d - np.float32(0.1)), "negative or not of length 1"),
        (put("descriptors", lambda d: d**6 / np.linalg.norm(d**6, axis=0)), "SIFT of another normalisation"),
        (put("descriptors", lambda d: d[:, :-1]), r"keypoints .* expected \(n, 2\)"),
    ],
)
def test_features_of_another_kind_are_refused(
    model: Path, tmp_path: Path, change: Callable[[h5py.Group], None], message: str
) -> None:
    with pytest.raises(MapError, match=message):
        import_map(model, tmp_path / "lab.map", options=by_hloc(model, features=rewritten(model, tmp_path, change)))
    assert not (tmp_path / "lab.map").exists()


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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"poses": None}, "its scale is unknown; expected what makes it metric"),
        ({"features": None}, "a model has no descriptors"),
        ({"feature": "aliked"}, "8-bit|width|keypoints|normal|feature"),
        ({"poses": Path("none.txt")}, r"none\.txt: no such file"),
        ({"poses": None, "scale": 100.0}, "none of .* points is seen by 2 images from .* check the scale"),
    ],
)
def test_what_a_model_does_not_say_is_asked_for(
    model: Path, tmp_path: Path, options: dict[str, object], message: str
) -> None:
    if options.get("feature") == "aliked":
        options["features"] = rewritten(model, tmp_path, put("descriptors", lambda d: (d * 512).astype(np.uint8)))
    with pytest.raises(FieldkitError, match=message):
        import_map(model, tmp_path / "lab.map", options=by_hloc(model, **options))
    assert not list(tmp_path.glob("*lab.map*"))


def test_poses_of_other_images_are_named(model: Path, tmp_path: Path) -> None:
    write_tum(tmp_path / "poses.txt", [(f"other{i}", Pose.identity()) for i in range(5)])
    with pytest.raises(MapError, match=r"poses\.txt: names 0 of the model's 16 images; expected at least 3"):
        import_map(model, tmp_path / "lab.map", options=by_hloc(model, poses=tmp_path / "poses.txt"))


def test_a_scale_and_a_scale_s_source_are_not_both_taken() -> None:
    with pytest.raises(MapError, match="--poses and --scale are both given"):
        ImportOptions(frame=FrameOptions(poses=Path("poses.txt"), scale=1.0))
    with pytest.raises(MapError, match="scale is 0; expected a positive number"):
        ImportOptions(frame=FrameOptions(scale=0.0))


def test_an_axis_that_is_not_up_is_noticed(model: Path, tmp_path: Path) -> None:
    export_map(model.parent / "lab.map", tmp_path / "out", to="colmap")
    options = by_hloc(model, poses=None, scale=1.0, up="y")
    report = import_map(tmp_path / "out", tmp_path / "again.map", options=options)
    assert report.alignment.verdict == "warn"
    assert any("check --up" in w for w in report.warnings)


def test_missing_images_are_counted_and_named(model: Path, tmp_path: Path) -> None:
    (tmp_path / "lf").mkdir()
    (tmp_path / "lf" / "000000.jpg").touch()
    with pytest.raises(MapError, match=r"15 of the model's 16 images are missing: lf/000001\.jpg"):
        import_map(model, tmp_path / "lab.map", images=tmp_path, options=by_hloc(model))


def change_bytes(path: Path, change: Callable[[bytes], bytes]) -> None:
    path.write_bytes(change(path.read_bytes()))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda p: (p / "points3D.bin").unlink(), r"no points3D\.bin"),
        (lambda p: change_bytes(p / "points3D.bin", lambda b: b[:-9]), "no readable COLMAP model"),
        (lambda p: change_bytes(p / "images.bin", lambda b: b[: len(b) // 2]), "no readable COLMAP model"),
        (lambda p: change_bytes(p / "points3D.bin", lambda b: b"\0" * 8), "no readable COLMAP model"),
        (lambda p: change_bytes(p / "images.bin", lambda b: b"\0" * 8), "0 registered images"),
        (lambda p: change_bytes(p / "images.bin", lambda b: b.replace(b"000001.jpg", b"000000.jpg")),
         r"two images are called lf/000000\.jpg"),
        (lambda p: change_bytes(p / "cameras.bin", lambda b: b[:12] + b"\7" + b[13:]), "camera 1: unknown camera"),
        (lambda p: [f.unlink() for f in p.iterdir()], "no COLMAP model in it"),
    ],
)  # fmt: skip
def test_a_damaged_model_is_named(model: Path, tmp_path: Path, damage: Callable[[Path], object], message: str) -> None:
    (tmp_path / "sfm").mkdir()
    for file in (model / "sfm").iterdir():
        (tmp_path / "sfm" / file.name).write_bytes(file.read_bytes())
    damage(tmp_path / "sfm")
    with pytest.raises(MapError, match=message):
        import_map(tmp_path / "sfm", tmp_path / "lab.map", options=by_hloc(model))
    assert not list(tmp_path.glob("*lab.map*"))


def test_a_model_without_points_is_named(tmp_path: Path) -> None:
    made = pycolmap.Reconstruction()
    made.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=1, model="PINHOLE", width=4, height=4, params=[1] * 4))
    image = pycolmap.Image(name="a.jpg", camera_id=1, image_id=1, points2D=pycolmap.Point2DList())
    made.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    made.write_text(tmp_path)
    with pytest.raises(MapError, match="1 registered images, 0 points; expected both"):
        import_map(tmp_path, tmp_path / "lab.map", options=ImportOptions(frame=FrameOptions(scale=1.0)))


def test_simple_fisheyes_become_fisheyes(tmp_path: Path) -> None:
    given = pycolmap.Camera(
        camera_id=1, model="RADIAL_FISHEYE", width=640, height=480, params=[300, 320, 240, 0.1, 0.02]
    )
    made = pycolmap.Reconstruction()
    made.add_camera_with_trivial_rig(given)
    made.add_image_with_trivial_frame(
        pycolmap.Image(name="a.jpg", camera_id=1, image_id=1, points2D=pycolmap.Point2DList()), pycolmap.Rigid3d()
    )
    made.write_binary(tmp_path)
    found = read_model(tmp_path).image_cameras[0]
    rays = np.random.default_rng(0).uniform([-1, -1, 1], [1, 1, 2], (50, 3))
    np.testing.assert_allclose(found.project(rays)[0], given.img_from_cam(rays), atol=1e-9)


def room_mesh(scale: float = 1.0) -> trimesh.Trimesh:
    box = trimesh.creation.box((6.0, 4.0, 2.5), trimesh.transformations.translation_matrix((0, 0, 1.25)))
    box = box.subdivide().subdivide()
    return trimesh.Trimesh(box.vertices * scale, box.faces, process=False)


@pytest.mark.parametrize("ending", ["ply", "obj", "glb", "stl"])
def test_a_foreign_mesh_becomes_the_surface(model: Path, tmp_path: Path, ending: str) -> None:
    room_mesh().export(tmp_path / f"room.{ending}")
    mesh = ForeignMesh(tmp_path / f"room.{ending}", voxel_m=0.05)
    report = import_map(model, tmp_path / "lab.map", options=by_hloc(model, mesh=mesh))
    surface = load_map(tmp_path / "lab.map").surface
    assert surface is not None
    assert surface.voxel_m == pytest.approx(0.05)
    np.testing.assert_allclose(np.ptp(surface.vertices, axis=0), [6.0, 4.0, 2.5], atol=1e-5)
    assert any("landmarks lie 0.0 cm off it" in w for w in report.warnings)


def test_a_mesh_is_moved_by_its_transform_unit_and_axis(model: Path, tmp_path: Path) -> None:
    map_from_mesh = np.eye(4)
    map_from_mesh[:3, :3] = 0.5 * Rotation.from_euler("z", 30, degrees=True).as_matrix()
    map_from_mesh[:3, 3] = (1.0, 2.0, 3.0)
    back = np.linalg.inv(map_from_mesh)
    mesh = room_mesh()
    points = mesh.vertices @ back[:3, :3].T + back[:3, 3]
    y_up_mm = 1000 * points[:, [0, 2, 1]] * (1, 1, -1)
    trimesh.Trimesh(y_up_mm, mesh.faces, process=False).export(tmp_path / "room.ply")
    np.savetxt(tmp_path / "T.txt", map_from_mesh)
    foreign = ForeignMesh(tmp_path / "room.ply", tmp_path / "T.txt", unit="mm", up="y")
    import_map(model, tmp_path / "lab.map", options=by_hloc(model, mesh=foreign))
    surface = load_map(tmp_path / "lab.map").surface
    assert surface is not None
    np.testing.assert_allclose(surface.vertices, mesh.vertices, atol=1e-4)


def test_a_mesh_in_another_unit_is_refused_with_the_one_that_fits(model: Path, tmp_path: Path) -> None:
    room_mesh(1000.0).export(tmp_path / "room.ply")
    with pytest.raises(MapError, match=r"off its surface; .* it fits with --mesh-unit mm --mesh-up z"):
        import_map(model, tmp_path / "lab.map", options=by_hloc(model, mesh=ForeignMesh(tmp_path / "room.ply")))
    (tmp_path / "T.txt").write_text("50 0 0 0 0 0 1\n")
    there = ForeignMesh(tmp_path / "room.ply", tmp_path / "T.txt", unit="mm")
    with pytest.raises(MapError, match="give --mesh-transform with map_from_mesh"):
        import_map(model, tmp_path / "lab.map", options=by_hloc(model, mesh=there))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3", "3 numbers; expected the 16 numbers"),
        ("1 0 0 0  0 1 0 0  0 0 -1 0  0 0 0 1", "no rotation times a scale"),
        ("1 0 0 0  0 2 0 0  0 0 1 0  0 0 0 1", "no rotation times a scale"),
        ("1 0 0 0  0 1 0 0  0 0 1 0  1 2 3 1", "expected the 16 numbers"),
        ("a b c d e f g", "could not convert"),
    ],
)
def test_a_transform_that_is_none_is_named(model: Path, tmp_path: Path, text: str, message: str) -> None:
    room_mesh().export(tmp_path / "room.ply")
    (tmp_path / "T.txt").write_text(text)
    mesh = ForeignMesh(tmp_path / "room.ply", tmp_path / "T.txt")
    with pytest.raises(MapError, match=message):
        import_map(model, tmp_path / "lab.map", options=by_hloc(model, mesh=mesh))


@pytest.mark.parametrize("ending", ["ply", "obj"])
def test_a_cloud_of_points_is_no_surface(model: Path, tmp_path: Path, ending: str) -> None:
    trimesh.PointCloud(np.random.default_rng(0).random((50, 3))).export(tmp_path / f"cloud.{ending}")
    with pytest.raises(FieldkitError, match=r"has no triangles"):
        import_map(model, tmp_path / "lab.map", options=by_hloc(model, mesh=ForeignMesh(tmp_path / f"cloud.{ending}")))
    assert not (tmp_path / "lab.map").exists()


def test_poses_meet_images_by_name_or_stamp() -> None:
    poses = {w: Pose.from_translation([i, 0.0, 0.0]) for i, w in enumerate(["1403636579.763555584", "b", "1305.1753"])}
    found = match_names(poses.items(), ["cam0/1403636579763555584.png", "x/b.jpg", "1305.175304.png", "7.png"])
    assert {name: int(p.translation[0]) for name, p in found.items()} == {
        "cam0/1403636579763555584.png": 0,
        "x/b.jpg": 1,
        "1305.175304.png": 2,
    }


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


@pytest.mark.parametrize(
    ("text", "message"), [("version = 0", "version 0"), ("version = 2", "version 2"), ("", "version")]
)
def test_another_version_of_a_map_is_named(model: Path, tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "old.map").mkdir()
    content = (model.parent / "lab.map" / "map.toml").read_text().replace("version = 1", text)
    (tmp_path / "old.map" / "map.toml").write_text(content)
    with pytest.raises(FieldkitError, match=rf"map\.toml: .*{message}"):
        load_map(tmp_path / "old.map")


def test_the_command_line_imports_and_exports(model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["map", "import", str(model), "--features", str(model / "features.h5"), "--out", str(tmp_path / "lab.map")]
    with pytest.raises(SystemExit) as failed:
        cli.main(words)
    assert failed.value.code == 1
    assert capsys.readouterr().err.count("\n") == 1
    with pytest.raises(SystemExit) as done:
        cli.main([*words, "--poses", str(model / "poses.txt"), "--min-images", "2"])
    assert done.value.code == 0
    with pytest.raises(SystemExit) as done:
        cli.main(["map", "export", str(tmp_path / "lab.map"), "--to", "tum", "--out", str(tmp_path / "tum")])
    assert done.value.code == 0
    assert (tmp_path / "tum" / "poses.txt").is_file()
