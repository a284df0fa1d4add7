"""StreamRecorder folders of a HoloLens 2 as SOURCE: what was exported from a mapping folder is read as that folder."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from test_streamrecorder import session

from fieldkit.cameras import Camera
from fieldkit.errors import MapError
from fieldkit.frames import pose_error
from fieldkit.maps.sources.source import SourceImage, read_depth, read_image, read_source
from fieldkit.maps.sources.streamrecorder import fit_camera, is_streamrecorder, open_source, read_streamrecorder
from sim_bridge.mapping.streamrecorder import export_streamrecorder

__all__ = ["session"]


@pytest.fixture
def recorded(session: Path, tmp_path: Path) -> Path:
    export_streamrecorder(session, tmp_path / "recorded")
    return tmp_path / "recorded"


def by_camera(images: tuple[SourceImage, ...]) -> dict[str, list[SourceImage]]:
    found: dict[str, list[SourceImage]] = {}
    for image in images:
        found.setdefault(image.sequence, []).append(image)
    return found


def test_images_poses_and_rig_are_those_of_the_mapping_folder(session: Path, recorded: Path) -> None:
    original, found = read_source(session / "mapping"), open_source(recorded)
    before, after = by_camera(original.images), by_camera(found.images)
    assert {name: len(images) for name, images in after.items()} == {"lf": 3, "ll": 3, "rf": 3, "rr": 3}
    for name, images in after.items():
        for a, b in zip(images, before[name], strict=True):
            np.testing.assert_array_equal(read_image(a), read_image(b))
            assert a.slam_from_cam is not None
            assert b.slam_from_cam is not None
            assert max(pose_error(a.slam_from_cam, b.slam_from_cam)) < 1e-6
            assert a.rig_from_cam is not None
            rays = b.camera.unproject(np.array([[3.0, 4.0], [40.0, 60.0]]))
            np.testing.assert_allclose(a.camera.project(rays)[0], b.camera.project(rays)[0], atol=1e-3)
        steps = [
            (a.slam_from_cam * a.rig_from_cam.inv()).as_matrix()  # type: ignore[operator, union-attr]
            for a in images
        ]
        rig = [
            (a.slam_from_cam * a.rig_from_cam.inv()).as_matrix()  # type: ignore[operator, union-attr]
            for a in after["lf"]
        ]
        np.testing.assert_allclose(steps, rig, atol=1e-6)
    assert not found.notes


def test_depth_along_the_ray_becomes_depth_along_the_axis(session: Path, recorded: Path) -> None:
    original, found = read_source(session / "mapping"), open_source(recorded)
    assert found.depth_camera is not None
    assert original.depth_camera is not None
    assert len(found.depth) == len(original.depth) == 3
    for a, b in zip(found.depth, original.depth, strict=True):
        after, before = read_depth(a, found.depth_camera), read_depth(b, original.depth_camera)
        assert np.abs(after.astype(int) - before).max() <= 1
        poses = [
            [walk.images[i].slam_from_cam * cam_from_depth for i, cam_from_depth in frame.anchors]  # type: ignore[operator]
            for walk, frame in ((found, a), (original, b))
        ]
        assert all(max(pose_error(p, poses[1][0])) < 1e-6 for p in poses[0])


def test_the_device_s_own_names_are_known(session: Path, tmp_path: Path) -> None:
    export_streamrecorder(session, tmp_path / "spaces", separator=" ")
    assert is_streamrecorder(tmp_path / "spaces")
    assert len(read_streamrecorder(tmp_path / "spaces").images) == 12
    assert not is_streamrecorder(session / "mapping")


def test_images_that_follow_too_closely_are_thinned(recorded: Path) -> None:
    assert len(read_streamrecorder(recorded, every_s=1e6).images) == 4


def test_images_of_another_moment_are_not_the_rig_s(recorded: Path) -> None:
    late = 100_000
    for file in sorted((recorded / "VLC_RF").glob("*.pgm")):
        file.rename(file.with_name(f"{int(file.stem) + late}.pgm"))
    poses = recorded / "VLC_RF_rig2world.txt"
    lines = [line.split(",", 1) for line in poses.read_text().splitlines()]
    poses.write_text("".join(f"{int(t) + late},{rest}\n" for t, rest in lines))
    found = by_camera(read_streamrecorder(recorded).images)
    assert all(image.rig_from_cam is None for image in found["rf"])
    assert all(image.slam_from_cam is not None for image in found["rf"])
    assert all(image.rig_from_cam is not None for image in found["ll"])


def test_where_the_device_was_lost_an_image_has_no_pose(recorded: Path) -> None:
    poses = recorded / "VLC_LF_rig2world.txt"
    lines = poses.read_text().splitlines()
    lines[1] = lines[1].split(",")[0] + ",0" * 16
    poses.write_text("\n".join(lines))
    found = by_camera(read_streamrecorder(recorded).images)["lf"]
    assert [image.slam_from_cam is None for image in found] == [False, True, False]


def test_a_lens_is_fitted_to_its_rays() -> None:
    camera = Camera("OPENCV", 480, 640, (368.4, 366.5, 240.7, 328.7, -0.0129, 0.01, 0.0004, 0.0036))
    rows, columns = np.indices((640, 480)) + 0.5
    rays = camera.unproject(np.column_stack([columns.ravel(), rows.ravel()])).reshape(640, 480, 3)
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    rays[:3] = 0.0
    found, rms_px = fit_camera(rays)
    assert rms_px < 1e-3
    np.testing.assert_allclose(found.params, camera.params, atol=1e-3)


def without_lut(folder: Path) -> None:
    (folder / "VLC_LF_lut.bin").unlink()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda p: (p / "VLC_LF_rig2world.txt").unlink(), r"VLC LF has images and no VLC_LF_rig2world\.txt"),
        (lambda p: (p / "VLC_LF_extrinsics.txt").unlink(), r"VLC LF has no VLC_LF_extrinsics\.txt"),
        (lambda p: (p / "VLC_LF_extrinsics.txt").write_text("0," * 16), r"VLC_LF_extrinsics\.txt: "),
        (lambda p: (p / "VLC_LF_rig2world.txt").write_text("12,1,2\n"), "line 1: 3 fields; expected a time"),
        (lambda p: (p / "VLC_LF_lut.bin").write_bytes(b"\0" * 12), r"VLC_LF_lut\.bin: 3 numbers; expected three"),
        (without_lut, r"VLC LF has no VLC_LF_lut\.bin; expected its rays"),
        (lambda p: [f.write_bytes(b"P5") for f in (p / "VLC_LF").iterdir()], r"\.pgm: cannot be read"),
    ],
)
def test_an_incomplete_recording_is_named(recorded: Path, damage: Callable[[Path], object], message: str) -> None:
    damage(recorded)
    with pytest.raises(MapError, match=message):
        read_streamrecorder(recorded)


def test_packed_images_are_told_to_be_unpacked(recorded: Path) -> None:
    for folder in [p for p in recorded.iterdir() if p.is_dir()]:
        shutil.rmtree(folder)
        (recorded / f"{folder.name}.tar").touch()
    with pytest.raises(MapError, match=r"Depth_Long_Throw\.tar is not unpacked; .* tar -xf"):
        read_streamrecorder(recorded)


def test_one_packed_camera_is_left_out_with_a_note(recorded: Path) -> None:
    shutil.rmtree(recorded / "VLC_RR")
    walk = read_streamrecorder(recorded)
    assert set(by_camera(walk.images)) == {"lf", "ll", "rf"}
    assert walk.notes == ("VLC RR has no unpacked images and is left out",)


def test_another_device_s_lens_stands_in_for_a_missing_table(recorded: Path) -> None:
    without_lut(recorded)
    for file in (recorded / "VLC_LF").iterdir():
        cv2.imwrite(str(file), np.zeros((480, 640), np.uint8))
    walk = read_streamrecorder(recorded)
    assert walk.notes == ("VLC LF has no _lut.bin: the calibration of another HoloLens 2 is used",)
    assert by_camera(walk.images)["lf"][0].camera.params[0] == pytest.approx(368.429)
