"""Every mistake a user can make gives one line with what is wrong and what to do, status 1, and leaves nothing."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from test_main_line import SAMPLE
from transcode import transcode

from fieldkit.cli import main

RECORDING = SAMPLE / "session" / "robot.mcap"
MAP, TAGS = SAMPLE / "lab.map", SAMPLE / "tags.toml"


def fails(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """Run the command line, expect status 1 and exactly one line of error; return it."""
    with pytest.raises(SystemExit) as stop:
        main([str(w) for w in words])
    text = capsys.readouterr().err
    assert not text.startswith("\n")
    said = [line for line in text.splitlines() if line.strip()]
    lines = [line for line in said if line.startswith("fieldkit: ")]
    assert stop.value.code == 1
    assert lines == said[-1:], said
    return lines[0]


def replay(capsys: pytest.CaptureFixture[str], out: Path, **changes: object) -> str:
    """Replay the sample with some arguments changed; assert that nothing is left and return the error."""
    values = {"recording": RECORDING, "map": MAP, "tags": TAGS, "protocol": "paper_real"} | changes
    out = out / "out" / "run"
    line = fails(
        capsys, "replay", values.pop("recording"), "--out", out, *(w for k, v in values.items() for w in (f"--{k}", v))
    )
    assert not out.parent.exists() or not list(out.parent.iterdir())
    return line


def test_a_missing_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = replay(capsys, tmp_path, recording=tmp_path / "none.mcap")
    assert "none.mcap: no such" in line


def test_an_empty_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "robot.bag").touch()
    assert "robot.bag: " in replay(capsys, tmp_path, recording=tmp_path / "robot.bag")


@pytest.mark.parametrize("name", ["mcap", "ros1", "ros2"])
def test_a_cut_off_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    path = transcode(RECORDING, tmp_path, name)
    file = next(path.glob("*.db3")) if path.is_dir() else path
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    line = replay(capsys, tmp_path, recording=path)
    assert str(path) in line
    assert ";" in line


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ("image", "image"),
        ("camera_info", "/arm_camera/camera_info"),
        ("tf", "tf"),
        ("odometry", "/odometry"),
        ("events", "/fieldkit/events"),
    ],
)
def test_a_recording_without_a_part(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], part: str, message: str
) -> None:
    path = transcode(RECORDING, tmp_path, "mcap", without={part, "tf_static"} if part == "tf" else {part})
    line = replay(capsys, tmp_path, recording=path)
    assert "robot.mcap: " in line
    assert message in line
    assert "expected" in line


def test_a_tag_that_is_not_in_the_tag_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "tags.toml").write_text(TAGS.read_text().replace("id = 1\n", "id = 17\n"))
    line = replay(capsys, tmp_path, tags=tmp_path / "tags.toml")
    assert "tags.toml has no tag 1, the start tag" in line
    assert "among 17 (every visit), 2 (w01)" in line


def test_tags_of_another_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = TAGS.read_text()
    (tmp_path / "tags.toml").write_text(text.replace('map_digest = "', 'map_digest = "f00'))
    assert "calibrated in the map f00" in replay(capsys, tmp_path, tags=tmp_path / "tags.toml")


def test_no_tag_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = fails(capsys, "replay", RECORDING, "--map", MAP, "--out", tmp_path / "run")
    assert "no tag file was given" in line
    assert not list(tmp_path.iterdir())


@pytest.fixture
def map_without_surface(tmp_path: Path) -> tuple[Path, Path]:
    """A copy of the sample's map as it is built where there are no depth images, and tags that fit it."""
    from fieldkit.maps import content_digest

    lab, tags = tmp_path / "flat.map", tmp_path / "flat.toml"
    shutil.copytree(MAP, lab)
    (lab / "surface.ply").unlink()
    text = (lab / "map.toml").read_text()
    old = text.split('digest = "')[1].split('"')[0]
    (lab / "map.toml").write_text(text[: text.index("[surface]")].replace(old, content_digest(lab)))
    tags.write_text(TAGS.read_text().replace(old, content_digest(lab)))
    return lab, tags


def test_a_protocol_of_occlusion_alone_needs_a_surface(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], map_without_surface: tuple[Path, Path]
) -> None:
    lab, tags = map_without_surface
    text = (SAMPLE.parents[1] / "protocols" / "paper_real.toml").read_text()
    (tmp_path / "hidden.toml").write_text(text + "\n[occlusion]\nuse = [true]\n")
    line = replay(capsys, tmp_path, map=lab, tags=tags, protocol=tmp_path / "hidden.toml")
    assert "flat.map: has no surface; expected surface.ply" in line
    assert "occlusion.use = [false]" in line


def test_a_map_whose_surface_was_lost(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(MAP, tmp_path / "lab.map")
    (tmp_path / "lab.map" / "surface.ply").unlink()
    assert "surface.ply" in replay(capsys, tmp_path, map=tmp_path / "lab.map")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('"max"', '"mx"'), "unknown policy 'mx'; did you mean 'max'"),
        (('feature = "sift"', 'feature = "shift"'), "'shift'"),
        (('feature = "sift"', 'features = "sift"'), "unknown key 'features' at $; did you mean 'feature'"),
        (("position_m = 0.25", "position_m = 0.0"), "at `$.thresholds[0].position_m`"),
        (("rotation_deg = 2.0", "rotation = 2.0"), "unknown key 'rotation' at $.thresholds"),
    ],
)
def test_a_wrong_protocol(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: tuple[str, str], message: str
) -> None:
    from fieldkit import protocol

    shipped = Path(protocol.__file__).parent.parent / "protocols" / "paper_real.toml"
    (tmp_path / "mine.toml").write_text(shipped.read_text().replace(*change))
    line = replay(capsys, tmp_path, protocol=tmp_path / "mine.toml")
    assert message in line


def test_an_unknown_protocol(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "unknown protocol 'paper'" in replay(capsys, tmp_path, protocol="paper")


def test_an_unknown_feature(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = fails(capsys, "map", "build", tmp_path, "--out", tmp_path / "lab.map", "--feature", "sfit")
    assert "'sfit'" in line
    assert "sift" in line


def test_an_unknown_preset(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from test_store import make_run

    from fieldkit import store

    store.write_run(tmp_path / "run", make_run())
    assert "unknown preset 'lamer'; did you mean 'lamar'" in fails(
        capsys, "score", tmp_path / "run", "--preset", "lamer"
    )


def test_a_missing_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "none.map" in replay(capsys, tmp_path, map=tmp_path / "none.map")


def test_a_map_folder_that_is_no_source(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = fails(capsys, "map", "build", tmp_path, "--out", tmp_path / "lab.map")
    assert str(tmp_path) in line
    assert "expected" in line
    assert not list(tmp_path.iterdir())


def write_photos(folder: Path) -> None:
    """Write two photos in which there is no tag."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    for name in ("a.jpg", "b.jpg"):
        cv2.imwrite(str(folder / name), cv2.blur(rng.integers(0, 255, (480, 640), dtype=np.uint8), (9, 9)))
    (folder / "camera.toml").write_text(
        'version = 1\nmodel = "PINHOLE"\nwidth = 640\nheight = 480\nparams = [552.0, 552.0, 320.0, 240.0]\n'
    )


def calibrate(capsys: pytest.CaptureFixture[str], tmp_path: Path, *words: object) -> str:
    line = fails(capsys, "tags", "calibrate", *words, "--map", MAP, "--out", tmp_path / "out.toml")
    assert not (tmp_path / "out.toml").exists()
    return line


def test_photos_without_a_tag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_photos(tmp_path / "photos")
    words = (tmp_path / "photos", "--camera", tmp_path / "photos" / "camera.toml", "--size-m", "0.1365")
    line = calibrate(capsys, tmp_path, *words)
    assert "photos" in line
    assert "tag" in line


def test_photos_of_another_size_than_the_camera(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_photos(tmp_path / "photos")
    camera = tmp_path / "camera.toml"
    camera.write_text((tmp_path / "photos" / "camera.toml").read_text().replace("width = 640", "width = 641"))
    line = calibrate(capsys, tmp_path, tmp_path / "photos", "--camera", camera, "--size-m", "0.1365")
    assert "640x480" in line


@pytest.mark.parametrize("size", ["0", "-0.1", "big", "3:", "x:0.1"])
def test_a_wrong_tag_size(tmp_path: Path, capsys: pytest.CaptureFixture[str], size: str) -> None:
    write_photos(tmp_path / "photos")
    line = calibrate(capsys, tmp_path, tmp_path / "photos", "--size-m", size)
    assert "size" in line


def test_a_photo_folder_that_is_missing_or_empty(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "none" in calibrate(capsys, tmp_path, tmp_path / "none", "--size-m", "0.1365")
    (tmp_path / "empty").mkdir()
    assert "empty" in calibrate(capsys, tmp_path, tmp_path / "empty", "--size-m", "0.1365")


def test_an_image_of_another_size_is_not_localized(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_photos(tmp_path / "photos")
    camera = tmp_path / "camera.toml"
    camera.write_text((tmp_path / "photos" / "camera.toml").read_text().replace("width = 640", "width = 641"))
    line = fails(
        capsys, "localize", tmp_path / "photos", "--map", MAP, "--camera", camera, "--out", tmp_path / "poses.txt"
    )
    assert "a.jpg: is 640x480; the camera says 641x480" in line
    assert not (tmp_path / "poses.txt").exists()


def test_a_report_of_no_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "not a run folder" in fails(capsys, "report", tmp_path, "--out", tmp_path / "report.html")
    assert not list(tmp_path.iterdir())


def test_a_judge_without_truth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "has no truth/ folder" in fails(capsys, "judge", tmp_path, "--map", MAP)


def test_an_existing_result_is_not_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").write_text("{}")
    line = fails(capsys, "replay", RECORDING, "--map", MAP, "--tags", TAGS, "--out", tmp_path / "run")
    assert "exists already; give --force" in line


def test_a_wrong_flag_is_a_usage_error(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["score", "run", "--pre-set", "lamar"])
    assert stop.value.code == 2
    assert "--preset" in capsys.readouterr().err
