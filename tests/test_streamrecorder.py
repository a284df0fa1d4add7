"""The mapping walk as StreamRecorder's folders, read back as that project's converter reads them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from fieldkit.cameras import Camera
from fieldkit.errors import StoreError
from fieldkit.frames import Pose, pose, pose_error
from fieldkit.store import Rig, RigCamera, read_rig, read_tum, write_rig, write_tum
from sim_bridge import cli
from sim_bridge.errors import SynthesisError
from sim_bridge.mapping.mapper import hololens_rig
from sim_bridge.mapping.streamrecorder import export_streamrecorder

UPRIGHT = {"LF": cv2.ROTATE_90_CLOCKWISE, "RR": cv2.ROTATE_90_CLOCKWISE}
UPRIGHT |= {"LL": cv2.ROTATE_90_COUNTERCLOCKWISE, "RF": cv2.ROTATE_90_COUNTERCLOCKWISE}
# z up as in fieldkit, y up as on the device.
Y_UP_FROM_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def small(camera: RigCamera) -> RigCamera:
    """The same camera with a tenth of the pixels."""
    c = camera.camera
    params = tuple(p * 0.1 for p in c.params[:4]) + c.params[4:]
    return RigCamera(camera.name, Camera(c.model, c.width // 10, c.height // 10, params), camera.rig_from_cam)


@pytest.fixture
def session(tmp_path: Path, rng: np.random.Generator) -> Path:
    """Three stations with noise for images and depth."""
    mapping = tmp_path / "session" / "mapping"
    full = hololens_rig()
    assert full.depth is not None
    rig = Rig(tuple(small(c) for c in full.cameras), small(full.depth))
    write_rig(mapping / "rig.toml", rig)
    quaternions = rng.standard_normal((3, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    write_tum(
        mapping / "slam_poses.txt", [(f"{k:06d}", pose(rng.uniform(-3, 3, 3), q)) for k, q in enumerate(quaternions)]
    )
    for k in range(3):
        for camera in rig.cameras:
            picture(mapping / "images" / camera.name / f"{k:06d}.jpg", rng.integers(0, 256, (64, 48), dtype=np.uint8))
        depth = rng.integers(0, 6000, (28, 32), dtype=np.uint16)
        picture(mapping / "depth" / f"{k:06d}.png", np.where(depth < 500, 0, depth).astype(np.uint16))
    return tmp_path / "session"


def picture(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return np.asarray(image)


def rig2world(path: Path) -> dict[int, np.ndarray]:
    lines = [line.split(",") for line in path.read_text().splitlines()]
    return {int(words[0]): np.array([float(w) for w in words[1:]]).reshape(4, 4) for words in lines}


def cam2world(out: Path, sensor: str) -> list[np.ndarray]:
    extrinsics = np.loadtxt(out / f"{sensor}_extrinsics.txt", delimiter=",").reshape(4, 4)
    return [matrix @ np.linalg.inv(extrinsics) for matrix in rig2world(out / f"{sensor}_rig2world.txt").values()]


def lut(out: Path, sensor: str) -> np.ndarray:
    return np.fromfile(out / f"{sensor}_lut.bin", dtype="f").reshape(-1, 3)


def slam_from_cam(session: Path, name: str) -> tuple[Camera, list[Pose]]:
    rig = read_rig(session / "mapping" / "rig.toml")
    mounted = next(c for c in (*rig.cameras, rig.depth) if c is not None and c.name == name)
    stations = read_tum(session / "mapping" / "slam_poses.txt")
    return mounted.camera, [slam_from_rig * mounted.rig_from_cam for _, slam_from_rig in stations]


def test_pictures_turned_upright_are_those_of_the_session(session: Path, tmp_path: Path) -> None:
    counts = export_streamrecorder(session, tmp_path / "out")
    assert counts == {"VLC LL": 3, "VLC LF": 3, "VLC RF": 3, "VLC RR": 3, "Depth Long Throw": 3}
    for name, turn in UPRIGHT.items():
        stored = sorted((tmp_path / "out" / f"VLC_{name}").glob("*.pgm"))
        assert [int(path.stem) for path in stored] == list(rig2world(tmp_path / "out" / f"VLC_{name}_rig2world.txt"))
        for k, path in enumerate(stored):
            expected = cv2.imread(
                str(session / "mapping" / "images" / name.lower() / f"{k:06d}.jpg"), cv2.IMREAD_GRAYSCALE
            )
            assert read(path).shape == (48, 64)
            assert np.array_equal(cv2.rotate(read(path), turn), expected)


@pytest.mark.parametrize("name", ["LL", "LF", "RF", "RR"])
def test_a_stored_pixel_s_ray_meets_what_the_session_s_camera_sees_there(
    session: Path, tmp_path: Path, name: str
) -> None:
    out = tmp_path / "out"
    export_streamrecorder(session, out)
    rays = lut(out, f"VLC_{name}").reshape(48, 64, 3)
    camera, poses = slam_from_cam(session, name.lower())
    for matrix, believed in zip(cam2world(out, f"VLC_{name}"), poses, strict=True):
        for row, column in ((0, 0), (5, 60), (40, 13)):
            point_m = (matrix @ [*(2.0 * rays[row, column]), 1.0])[:3]
            pixel, inside = camera.project(believed.inv().apply(Y_UP_FROM_Z_UP.T @ point_m)[None])
            u, v = (48 - row - 0.5, column + 0.5) if name in ("LF", "RR") else (row + 0.5, 64 - column - 0.5)
            assert inside.all()
            assert pixel[0] == pytest.approx([u, v], abs=1e-3)


def test_depth_times_ray_is_the_point_that_was_measured(session: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    export_streamrecorder(session, out)
    camera, poses = slam_from_cam(session, "depth")
    files = sorted((out / "Depth_Long_Throw").glob("*.pgm"))
    rays = lut(out, "Depth_Long_Throw")
    for k, (path, matrix) in enumerate(zip(files, cam2world(out, "Depth_Long_Throw"), strict=True)):
        measured = read(session / "mapping" / "depth" / f"{k:06d}.png").ravel()
        points_m = read(path).reshape(-1, 1) * rays / 1000.0
        in_world = points_m @ matrix[:3, :3].T + matrix[:3, 3]
        in_cam = poses[k].inv().apply(in_world @ Y_UP_FROM_Z_UP)
        seen = measured > 0
        assert np.array_equal(seen, np.linalg.norm(points_m, axis=1) > 0)
        assert np.abs(in_cam[seen, 2] - measured[seen] / 1000.0).max() < 0.001
        rows, columns = np.indices((28, 32)) + 0.5
        pixels, _ = camera.project(in_cam[seen])
        assert np.abs(pixels - np.column_stack([columns.ravel(), rows.ravel()])[seen]).max() < 1e-3


def test_the_rig_is_the_left_front_camera(session: Path, tmp_path: Path) -> None:
    export_streamrecorder(session, tmp_path / "out")
    extrinsics = np.loadtxt(tmp_path / "out" / "VLC_LF_extrinsics.txt", delimiter=",").reshape(4, 4)
    assert extrinsics == pytest.approx(np.eye(4), abs=1e-9)


def test_up_is_y(session: Path, tmp_path: Path) -> None:
    export_streamrecorder(session, tmp_path / "out")
    _, believed = slam_from_cam(session, "lf")
    found = cam2world(tmp_path / "out", "VLC_LF")
    heights = [matrix[1, 3] for matrix in found]
    assert heights == pytest.approx([p.translation[2] for p in believed], abs=1e-6)
    moved = pose_error(Pose.from_matrix(found[0]), Pose.from_matrix(found[1]))
    assert moved == pytest.approx(pose_error(believed[0], believed[1]), abs=1e-6)


def test_names_may_be_the_device_s_own(session: Path, tmp_path: Path) -> None:
    words = [str(session), "--to", "streamrecorder", "--names", "spaces", "--out", str(tmp_path / "out")]
    cli.main(["export", *words])
    folders = sorted(p.name for p in (tmp_path / "out").iterdir() if p.is_dir())
    assert folders == ["Depth Long Throw", "VLC LF", "VLC LL", "VLC RF", "VLC RR"]


def test_a_folder_without_a_walk_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"rig\.toml"):
        export_streamrecorder(tmp_path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_missing_image_leaves_nothing(session: Path, tmp_path: Path) -> None:
    (session / "mapping" / "images" / "rf" / "000001.jpg").unlink()
    with pytest.raises(SynthesisError, match=r"000001\.jpg: missing or damaged; expected an image"):
        export_streamrecorder(session, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("name", "keep", "message"),
    [
        ("images/rf/000001.jpg", 0.6, r"000001\.jpg: missing or damaged; expected an image"),
        ("slam_poses.txt", 0.0, r"slam_poses\.txt: holds no pose; expected one per station"),
    ],
)
def test_a_file_cut_short_leaves_nothing(session: Path, tmp_path: Path, name: str, keep: float, message: str) -> None:
    path = session / "mapping" / name
    path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])
    with pytest.raises(SynthesisError, match=message):
        export_streamrecorder(session, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_image_of_another_size_is_refused(session: Path, tmp_path: Path) -> None:
    cv2.imwrite(str(session / "mapping" / "depth" / "000001.png"), np.zeros((3, 5), np.uint16))
    with pytest.raises(SynthesisError, match=r"000001\.png: 5 x 3 pixels; expected an image of the mapping walk"):
        export_streamrecorder(session, tmp_path / "out")


def test_another_rig_is_refused(session: Path, tmp_path: Path) -> None:
    rig = read_rig(session / "mapping" / "rig.toml")
    write_rig(session / "mapping" / "rig.toml", Rig(rig.cameras[:2], rig.depth))
    with pytest.raises(SynthesisError, match="no camera rf, rr; expected ll, lf, rf and rr"):
        export_streamrecorder(session, tmp_path / "out")


def test_an_existing_export_is_kept(session: Path, tmp_path: Path) -> None:
    export_streamrecorder(session, tmp_path / "out")
    with pytest.raises(StoreError, match="exists already"):
        export_streamrecorder(session, tmp_path / "out")
    export_streamrecorder(session, tmp_path / "out", force=True)
    export_streamrecorder(session, tmp_path / "out", separator=" ", force=True)
