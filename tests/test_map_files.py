"""Files of a SOURCE that cannot be mapped are named before any work, and maps of other versions when they are read."""

from __future__ import annotations

import io
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np
import pytest
from synthetic_map import make_map, write_map
from test_maps import image_folder

from fieldkit import map_commands
from fieldkit.cameras import Camera
from fieldkit.errors import FieldkitError, MapError
from fieldkit.frames import Pose
from fieldkit.maps import build_map, load_map
from fieldkit.maps.sources.headers import ImageHeader, read_header
from fieldkit.maps.sources.source import read_source
from fieldkit.store import Rig, RigCamera, write_camera, write_rig, write_tum

SIZE = Camera("PINHOLE", 64, 48, (60.0, 60.0, 32.0, 24.0))


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".bmp", ".pgm"])
@pytest.mark.parametrize("channels", [1, 3])
def test_the_header_of_every_kind_of_image_tells_its_size(tmp_path: Path, suffix: str, channels: int) -> None:
    file = tmp_path / f"image{'.ppm' if suffix == '.pgm' and channels == 3 else suffix}"
    assert cv2.imwrite(str(file), np.full((48, 64, channels), 77, np.uint8))
    assert read_header(file) == ImageHeader(64, 48, 8)
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) * 2 // 3])
    assert read_header(file) == "is cut off"


def test_headers_of_other_writers_are_read(tmp_path: Path) -> None:
    stream = io.BytesIO()
    figure = plt.figure(figsize=(0.64, 0.48), dpi=100)
    figure.savefig(stream, format="jpg")
    plt.close(figure)
    (tmp_path / "a.jpg").write_bytes(stream.getvalue() + b"a maker's trailer")
    assert read_header(tmp_path / "a.jpg") == ImageHeader(64, 48, 8)
    cv2.imwrite(str(tmp_path / "d.png"), np.zeros((48, 64), np.uint16))
    assert read_header(tmp_path / "d.png") == ImageHeader(64, 48, 16)
    (tmp_path / "c.pgm").write_bytes(b"P5\n# by a camera\n64 48\n255\n" + bytes(64 * 48))
    assert read_header(tmp_path / "c.pgm") == ImageHeader(64, 48, 8)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "is empty"),
        (b"broken", "cannot be read as an image"),
        (b"\xff\xd8\xff\xe0\x00\x10JFIF", "cannot be read as an image"),
        (b"\x89PNG\r\n\x1a\n" + bytes(4), "cannot be read as an image"),
        (b"P5\n64 x 255\n", "cannot be read as an image"),
    ],
)
def test_files_that_are_no_images_say_what_is_wrong(tmp_path: Path, content: bytes, told: str) -> None:
    (tmp_path / "image.jpg").write_bytes(content)
    assert read_header(tmp_path / "image.jpg") == told
    assert read_header(tmp_path / "none.jpg") == "cannot be read: No such file or directory"


def test_a_jpeg_that_no_decoder_takes_is_named_by_its_file(tmp_path: Path) -> None:
    path = tmp_path / "image.jpg"
    cv2.imwrite(str(path), np.full((48, 64), 128, dtype=np.uint8))
    content = path.read_bytes()
    path.write_bytes(content.replace(b"\xff\xdb\x00\x43\x00", b"\xff\xdb\x00\x43\x0f", 1))
    assert read_header(path) == "is damaged, its content cannot be decoded"


def struck(path: Path, at: float) -> None:
    """Change one byte of a file."""
    content = bytearray(path.read_bytes())
    content[int(at * len(content))] ^= 0x55
    path.write_bytes(content)


def with_depth(path: Path, depth: np.ndarray) -> None:
    (path / "depth").mkdir()
    write_camera(path / "depth_camera.toml", SIZE)
    cv2.imwrite(str(path / "depth" / "001.png"), depth)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda p: cv2.imwrite(str(p / "images" / "002.png"), np.zeros((30, 40), np.uint8)),
         r"002\.png: is 40x30; expected an image of 64x48 pixels as its camera says; give every camera images of one"),
        (lambda p: (p / "images" / "003.png").write_bytes(b"broken"), r"003\.png: cannot be read as an image"),
        (lambda p: (p / "images" / "003.png").write_bytes((p / "images" / "002.png").read_bytes()[:60]),
         r"003\.png: is cut off; expected"),
        (lambda p: struck(p / "images" / "002.png", 0.6), r"002\.png: is damaged, its content cannot be decoded; exp"),
        (lambda p: (with_depth(p, np.full((48, 64), 900, np.uint16)), struck(p / "depth" / "001.png", 0.6)),
         r"depth/001\.png: is damaged, its content cannot be decoded; expected a 16-bit depth image"),
        (lambda p: shutil.copy(p / "images" / "001.png", p / "images" / "001.bmp"),
         r"001\.bmp and 001\.png have one name"),
        (lambda p: with_depth(p, np.zeros((24, 32), np.uint16)), r"001\.png: is 32x24; expected a 16-bit depth image"),
        (lambda p: with_depth(p, np.zeros((48, 64), np.uint8)), r"001\.png: has 8 bits; expected a 16-bit depth image"),
        (lambda p: (p / "poses.txt").write_text("000 nan 0 0 0 0 0 1\n"), r"poses\.txt: line 1: pose is not finite"),
        (lambda p: (p / "poses.txt").write_text("000 0 0 0 0 0 0 1\n" * 2), r"000 has two poses; expected one"),
    ],
)  # fmt: skip
def test_what_cannot_be_mapped_is_named_before_any_work(
    tmp_path: Path, damage: Callable[[Path], object], message: str
) -> None:
    source = image_folder(tmp_path / "source")
    damage(source)
    steps: list[str] = []
    with pytest.raises(FieldkitError, match=message):
        build_map(source, tmp_path / "lab.map", progress=lambda step, done, total: steps.append(step))
    assert not steps
    assert [p.name for p in tmp_path.iterdir()] == ["source"]


def test_one_name_with_two_endings_in_a_folder_of_a_rig_is_refused(tmp_path: Path) -> None:
    write_rig(tmp_path / "rig.toml", Rig(tuple(RigCamera(n, SIZE, Pose.identity()) for n in ("lf", "rf"))))
    for name in ("lf/000.png", "rf/000.png", "rf/001.png", "rf/001.jpg"):
        (tmp_path / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(tmp_path / "images" / name), np.zeros((48, 64), np.uint8))
    with pytest.raises(MapError, match=r"images/rf: 001\.jpg and 001\.png have one name"):
        read_source(tmp_path)
    (tmp_path / "images" / "rf" / "001.jpg").unlink()
    assert [i.name for i in read_source(tmp_path).images] == ["lf/000.png", "rf/000.png", "rf/001.png"]


def test_grey_and_coloured_images_may_be_mixed_and_poses_come_in_any_order(tmp_path: Path) -> None:
    source = image_folder(tmp_path / "source", n=5)
    cv2.imwrite(str(source / "images" / "002.png"), np.full((48, 64, 3), 99, np.uint8))
    rows = [(f"{i:03d}.png", Pose.from_translation([0.2 * i, 0.0, 0.0])) for i in (3, 0, 4, 1)]
    write_tum(source / "poses.txt", rows)
    assert read_source(source).n_posed == 4
    with pytest.raises(MapError, match="no pair of the 5 images shows the same place"):
        build_map(source, tmp_path / "lab.map")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "version = 1\n",
            "",
            r"map\.toml: has no version; this fieldkit reads version 1.*build or import the map",
        ),
        ("version = 1", "version = 0", r"map\.toml: version 0; this fieldkit reads version 1.*build or import the map"),
        ("version = 1", "version = 3", r"map\.toml: version 3; this fieldkit reads version 1; update fieldkit"),
        ("version = 1", 'version = "one"', r"map\.toml: version 'one'; this fieldkit reads version 1"),
    ],
)
def test_maps_of_other_versions_say_so_in_one_line(
    tmp_path: Path, rng: np.random.Generator, old: str, new: str, message: str
) -> None:
    write_map(tmp_path / "lab.map", make_map(rng, n_landmarks=50, n_images=4))
    file = tmp_path / "lab.map" / "map.toml"
    file.write_text(file.read_text().replace(old, new, 1))
    with pytest.raises(FieldkitError, match=message):
        load_map(tmp_path / "lab.map")


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_landmarks_that_are_not_finite_are_named_when_the_map_is_loaded(
    tmp_path: Path, rng: np.random.Generator, value: float
) -> None:
    scene_map = make_map(rng, n_landmarks=50, n_images=4)
    scene_map.xyz[scene_map.observation_landmark[0], 2] = value
    write_map(tmp_path / "room.map", scene_map)
    with pytest.raises(MapError, match=r"points3D\.bin: 1 of \d+ points are not finite; expected finite positions"):
        load_map(tmp_path / "room.map")


def test_what_a_map_holds_is_told_with_a_warning_where_its_files_are_others(
    tmp_path: Path, rng: np.random.Generator, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "room.map"
    write_map(path, make_map(rng, n_landmarks=50, n_images=4))
    map_commands.map_info(path)
    assert not caplog.messages
    with (path / "features.h5").open("ab") as file:
        file.write(b"more")
    map_commands.map_info(path)
    assert len(caplog.messages) == 1
    assert re.search(r"room\.map: its files have another digest than map\.toml names", caplog.messages[0])
