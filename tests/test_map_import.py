"""COLMAP and hloc models become maps and go back: frames and scale, formats, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from hloc_model import SCALE, assert_same, by_hloc, observed_room, put, rewritten, write_hloc

from fieldkit import cli
from fieldkit.errors import FieldkitError, MapError
from fieldkit.frames import Pose, pose_error
from fieldkit.maps import (
    FrameOptions,
    ImportOptions,
    export_map,
    import_map,
    load_map,
    map_info,
)
from fieldkit.maps.colmap import model_folder, read_model
from fieldkit.maps.landmarks import model_arrays
from fieldkit.maps.sources.stamps import match_names
from fieldkit.store import write_tum
from fieldkit.types import SceneMap


@pytest.fixture(scope="module")
def scene_map() -> SceneMap:
    """Landmarks of a room that at least two images see."""
    return observed_room()


@pytest.fixture(scope="module")
def model(scene_map: SceneMap, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """hloc's files of the map in another scale and frame: sfm/, features.h5, and poses.txt in the map's."""
    return write_hloc(tmp_path_factory.mktemp("hloc"), scene_map)


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
        (lambda p: change_bytes(p / "images.bin", lambda b: b[:44] + b"\0" * 6 + b"\xf0\x7f" + b[52:]),
         "no readable COLMAP model"),
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


def test_poses_meet_images_by_name_or_stamp() -> None:
    poses = {w: Pose.from_translation([i, 0.0, 0.0]) for i, w in enumerate(["1403636579.763555584", "b", "1305.1753"])}
    found = match_names(poses.items(), ["cam0/1403636579763555584.png", "x/b.jpg", "1305.175304.png", "7.png"])
    assert {name: int(p.translation[0]) for name, p in found.items()} == {
        "cam0/1403636579763555584.png": 0,
        "x/b.jpg": 1,
        "1305.175304.png": 2,
    }


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
