"""Kalibr's camera files in place of camera.toml and rig.toml."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fieldkit.errors import StoreError
from fieldkit.frames import Pose, pose_error
from fieldkit.maps.sources.source import read_source
from fieldkit.store import calibration_file, read_camera, read_rig, write_tum

CAM0 = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 1.8e-05]
  distortion_model: radtan
  intrinsics: [458.6, 457.2, 367.2, 248.3]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
"""
CAM1 = """cam1:
  T_cn_cnm1:
  - [0.0, 1.0, 0.0, -0.11]
  - [-1.0, 0.0, 0.0, 0.02]
  - [0.0, 0.0, 1.0, 0.03]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [-0.01, 0.02, -0.003, 0.001]
  distortion_model: equidistant
  intrinsics: [300.0, 301.0, 320.0, 240.0]
  resolution: [640, 480]
"""


def chain(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_radtan_and_equidistant_lenses_project_as_opencv_does(tmp_path: Path) -> None:
    rays = np.random.default_rng(0).uniform([-0.4, -0.3, 1], [0.4, 0.3, 1.5], (40, 3))
    first = read_camera(chain(tmp_path / "camera.yaml", CAM0))
    assert (first.model, first.width, first.height) == ("OPENCV", 752, 480)
    k = np.array([[458.6, 0, 367.2], [0, 457.2, 248.3], [0, 0, 1]])
    expected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), k, np.array([-0.28, 0.07, 0.0002, 1.8e-05]))
    # OpenCV and Kalibr put the centre of the first pixel at (0, 0)
    np.testing.assert_allclose(first.project(rays)[0], expected[:, 0] + 0.5, atol=1e-6)
    second = read_rig(chain(tmp_path / "camchain.yaml", CAM0 + CAM1)).cameras[1].camera
    k = np.array([[300.0, 0, 320.0], [0, 301.0, 240.0], [0, 0, 1]])
    fisheye, _ = cv2.fisheye.projectPoints(
        rays[:, None], np.zeros(3), np.zeros(3), k, np.array([-0.01, 0.02, -0.003, 0.001])
    )
    np.testing.assert_allclose(second.project(rays)[0], fisheye[:, 0] + 0.5, atol=1e-6)


def test_a_chain_of_transforms_becomes_a_rig(tmp_path: Path) -> None:
    third = CAM1.replace("cam1", "cam2")
    rig = read_rig(chain(tmp_path / "camchain.yaml", CAM0 + CAM1 + third))
    assert [c.name for c in rig.cameras] == ["cam0", "cam1", "cam2"]
    step = Pose.from_components([-0.11, 0.02, 0.03], Rotation.from_euler("z", -90, degrees=True))
    for camera, expected in zip(rig.cameras, (Pose.identity(), step.inv(), step.inv() * step.inv()), strict=True):
        assert max(pose_error(camera.rig_from_cam, expected)) < 1e-9


def test_a_part_of_a_chain_without_a_gap_is_a_rig_too(tmp_path: Path) -> None:
    rig = read_rig(chain(tmp_path / "camchain.yaml", CAM0.replace("cam0", "cam1") + CAM1.replace("cam1", "cam2")))
    assert [c.name for c in rig.cameras] == ["cam1", "cam2"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (CAM1 + CAM1.replace("cam1", "cam2"), "has cam1, cam2 but no cam0; expected a chain without a gap"),
        (CAM1, "has cam1 but no cam0"),
        (CAM0 + CAM1.replace("cam1", "cam_left"), "has cam_left, cam0; expected cam0, cam1, .., as T_cn_cnm1"),
    ],
)
def test_a_camera_that_places_another_has_to_be_there(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=message):
        read_rig(chain(tmp_path / "camchain.yaml", text))


def test_with_the_imu_known_the_rig_is_the_imu(tmp_path: Path) -> None:
    rows = "".join(f"  - {row}\n" for row in ([1.0, 0, 0, 0.1], [0, 1.0, 0, 0.2], [0, 0, 1.0, 0.3], [0, 0, 0, 1.0]))
    rig = read_rig(chain(tmp_path / "camchain-imucam.yaml", f"{CAM0}  T_cam_imu:\n{rows}"))
    np.testing.assert_allclose(rig.cameras[0].rig_from_cam.translation, [-0.1, -0.2, -0.3])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (CAM0.replace("pinhole", "omni"), "cam0: camera_model omni; expected pinhole"),
        (CAM0.replace("radtan", "fov"), "cam0: distortion_model fov"),
        (CAM0.replace("[458.6, 457.2, 367.2, 248.3]", "[1, 2]"), r"intrinsics is \[1, 2\]; expected 4 numbers"),
        (CAM0.replace("458.6", "-458.6"), "cam0: camera .* expected positive size and focal length"),
        (CAM0 + CAM1.replace("[0.0, 0.0, 1.0, 0.03]", "[0.0, 0.0, 2.0, 0.03]"), "cam1: T_cn_cnm1 is no rigid"),
        (CAM0 + CAM1.replace("[0.0, 0.0, 1.0, 0.03]", "[0.0, 0.0, -1.0, 0.03]"), "cam1: T_cn_cnm1 is no rigid"),
        (CAM0 + CAM1.replace("[0.0, 0.0, 0.0, 1.0]", "[0.0, 0.0, 0.0, 2.0]"), "cam1: T_cn_cnm1 is no rigid"),
        (CAM0 + CAM1.replace("T_cn_cnm1", "T_other"), "cam1: T_cn_cnm1 is no rigid transform"),
        (CAM0 + CAM1.replace("cam1", "cam2"), "has cam0, cam2 but no cam1; expected a chain without a gap"),
        ("a: [1", "not valid YAML"),
        ("[1, 2]", "no cam0 in it"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(StoreError, match=message):
        read_rig(chain(tmp_path / "camchain.yaml", text))


def test_a_chain_is_not_one_camera(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="has 2 cameras; expected one"):
        read_camera(chain(tmp_path / "camchain.yaml", CAM0 + CAM1))


def test_a_folder_may_bring_kalibr_s_file_and_stamps(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    chain(tmp_path / "camchain.yaml", CAM0)
    stamps = [1403636579763555584 + 50_000_000 * i for i in range(4)]
    for ns in stamps:
        cv2.imwrite(str(tmp_path / "images" / f"{ns}.png"), np.zeros((480, 752), np.uint8))
    write_tum(
        tmp_path / "poses.txt", [(f"{ns / 1e9:.6f}", Pose.from_translation([i, 0, 0])) for i, ns in enumerate(stamps)]
    )
    walk = read_source(tmp_path)
    assert walk.images[0].camera.model == "OPENCV"
    assert [i.slam_from_cam.translation[0] for i in walk.images if i.slam_from_cam is not None] == [0, 1, 2, 3]


def test_a_chain_with_a_folder_per_camera_is_a_rig_s(tmp_path: Path) -> None:
    for name, (w, h) in {"cam0": (752, 480), "cam1": (640, 480)}.items():
        (tmp_path / "images" / name).mkdir(parents=True)
        for i in range(3):
            cv2.imwrite(str(tmp_path / "images" / name / f"{i:03d}.png"), np.zeros((h, w), np.uint8))
    chain(tmp_path / "camchain.yaml", CAM0 + CAM1)
    write_tum(tmp_path / "slam_poses.txt", [(f"{i:03d}", Pose.identity()) for i in range(3)])
    walk = read_source(tmp_path)
    assert [i.name for i in walk.images][:4] == ["cam0/000.png", "cam0/001.png", "cam0/002.png", "cam1/000.png"]
    assert all(i.rig_from_cam is not None for i in walk.images)
    assert calibration_file(tmp_path, "camera") == tmp_path / "camera.toml"
