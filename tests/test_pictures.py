"""Photos as people have them: HEIC, 16 bits, EXIF rotation, several cameras in one folder, tags cut off."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image as PillowImage
from scipy.spatial.transform import Rotation
from tag_scenes import SIZE_M, render_tag

from fieldkit.calibrate.locating import _without_tags
from fieldkit.calibrate.photos import Shot, find_tags, list_photos, read_photo
from fieldkit.calibrate.pictures import read_header
from fieldkit.cameras import Camera
from fieldkit.errors import StoreError, TagError
from fieldkit.features import to_grey
from fieldkit.frames import Pose
from fieldkit.store import PhotoEntry, write_camera, write_photos
from fieldkit.types import Image, TagPhoto

CAMERA = Camera("PINHOLE", 640, 480, (552.0, 552.0, 320.0, 240.0))
MAKE, MODEL, ORIENTATION = 0x010F, 0x0110, 0x0112
FOCAL, FOCAL_FILM, LENS, ZOOM = 0x920A, 0xA405, 0xA434, 0xA404


def facing(x: float = 0.0, distance_m: float = 0.6) -> Image:
    turned = Rotation.from_rotvec([0.15, 0.2, 0.0]) * Rotation.from_rotvec([np.pi, 0, 0])
    rng = np.random.default_rng(0)
    return render_tag(
        CAMERA, Pose.from_components([x, 0.02, distance_m], turned), samples=4, noise=2.0, blur_px=0.7, rng=rng
    )


@pytest.fixture(scope="module")
def picture() -> Image:
    return facing()


Tags = dict[int, object]


def save(path: Path, image: Image, tags: Tags | None = None, shot: Tags | None = None) -> None:
    path.parent.mkdir(exist_ok=True)
    exif = PillowImage.Exif()
    exif.update(tags or {})
    exif.get_ifd(0x8769).update(shot or {})
    PillowImage.fromarray(image).save(path, quality=95, exif=exif)


def folder_of(path: Path, *, camera: Camera = CAMERA) -> Path:
    path.mkdir(exist_ok=True)
    write_camera(path / "camera.toml", camera)
    return path


def find(folder: Path) -> tuple[list[Shot], list[TagPhoto]]:
    return find_tags(folder, list_photos(folder, None), {None: SIZE_M}, ("tag36h11",), None)


def test_exif_is_read_without_the_pixels(tmp_path: Path, picture: Image) -> None:
    tags = {MAKE: "Acme\0", MODEL: " A1  b", ORIENTATION: 6}
    save(tmp_path / "a.jpg", picture, tags, {FOCAL: 4.25, FOCAL_FILM: 26, LENS: "wide", ZOOM: 2.0})
    header = read_header(tmp_path / "a.jpg")
    assert header is not None
    assert (header.width, header.height, header.orientation, header.bits) == (640, 480, 6, 8)
    assert (header.camera, header.lens, header.focal_mm, header.focal_film_mm) == ("Acme A1 b", "wide", 4.25, 26.0)
    assert header.zoom == 2.0
    save(tmp_path / "plain.png", picture)
    plain = read_header(tmp_path / "plain.png")
    assert plain is not None
    assert (plain.orientation, plain.camera, plain.focal_mm) == (1, None, None)
    (tmp_path / "no.jpg").write_bytes(b"no image")
    assert read_header(tmp_path / "no.jpg") is None


def test_exif_with_nonsense_is_not_compared(tmp_path: Path, picture: Image) -> None:
    folder = folder_of(tmp_path)
    save(folder / "a.jpg", picture, {ORIENTATION: 77}, {FOCAL: 0.0, FOCAL_FILM: 0})
    save(folder / "b.jpg", picture, {MODEL: ""}, {FOCAL: 4.2})
    assert [p.file for p in list_photos(folder, None)] == ["a.jpg", "b.jpg"]


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_pixels_stay_as_the_sensor_has_them_whatever_exif_says(
    tmp_path: Path, picture: Image, orientation: int
) -> None:
    folder = folder_of(tmp_path)
    save(folder / "a.jpg", picture, {ORIENTATION: orientation})
    (photo,) = list_photos(folder, None)
    image = read_photo(photo)
    assert image is not None
    assert np.abs(image.astype(int) - picture).mean() < 3.0
    shots, _ = find(folder)
    assert [d.id for d in shots[0].usable] == [2]


def test_a_calibration_of_turned_photos_is_refused_and_says_so(tmp_path: Path, picture: Image) -> None:
    turned = Camera("PINHOLE", 480, 640, (552.0, 552.0, 240.0, 320.0))
    folder = folder_of(tmp_path / "exif", camera=turned)
    save(folder / "a.jpg", picture, {ORIENTATION: 6})
    shown = r"a\.jpg: 640x480 pixels are stored, which EXIF \(orientation 6\) shows turned to 480x640; expected"
    with pytest.raises(TagError, match=shown):
        list_photos(folder, None)
    folder = folder_of(tmp_path / "plain", camera=turned)
    save(folder / "a.jpg", picture)
    with pytest.raises(TagError, match=r"640x480 pixels; expected 480x640 as in .*camera\.toml; .*turned by a quarter"):
        list_photos(folder, None)


def test_a_calibration_at_another_resolution_is_refused_and_says_by_how_much(tmp_path: Path, picture: Image) -> None:
    folder = folder_of(tmp_path, camera=CAMERA.scaled(0.5))
    save(folder / "a.jpg", picture)
    with pytest.raises(TagError, match=r"640x480 pixels; expected 320x240 as in .*; .*the photo has 2 times its width"):
        list_photos(folder, None)
    (folder / "camera.toml").unlink()
    with pytest.raises(TagError, match=r"camera\.toml: no such camera file; expected the calibration"):
        list_photos(folder, None)
    write_photos(folder / "photos.toml", [PhotoEntry("a.jpg", "lost.toml")])
    with pytest.raises((TagError, StoreError), match=r"lost\.toml"):
        list_photos(folder, None)


@pytest.mark.parametrize(
    ("one", "two", "message"),
    [
        (({MODEL: "A1"}, {}), ({MODEL: "B2"}, {}), r"2 cameras: A1 \(a\.jpg and 1 more\), B2 \(c\.jpg\); expected"),
        (({}, {FOCAL: 24.0}), ({}, {FOCAL: 35.0}), r"2 focal lengths: 24 mm \(a\.jpg and 1 more\), 35 mm \(c\.jpg\)"),
        (({}, {LENS: "wide"}), ({}, {LENS: "tele"}), "2 lenses: wide"),
        (({}, {ZOOM: 1.0}), ({}, {ZOOM: 2.0}), "2 digital zooms: 1x"),
    ],
)
def test_photos_of_two_cameras_under_one_calibration_are_refused(
    tmp_path: Path, picture: Image, one: tuple[dict, dict], two: tuple[dict, dict], message: str
) -> None:
    folder = folder_of(tmp_path)
    for name, (tags, shot) in (("a", one), ("b", one), ("c", two)):
        save(folder / f"{name}.jpg", picture, tags, shot)
    with pytest.raises(TagError, match=rf"camera\.toml: its photos are of {message}.*photos\.toml"):
        list_photos(folder, None)
    # Each with its own calibration they may stand side by side
    write_camera(folder / "other.toml", CAMERA)
    entries = [PhotoEntry("a.jpg", "camera.toml"), PhotoEntry("c.jpg", "other.toml")]
    write_photos(folder / "photos.toml", entries)
    assert [p.file for p in list_photos(folder, None)] == ["a.jpg", "c.jpg"]


def test_photos_of_two_sizes_are_refused_as_a_mixture(tmp_path: Path, picture: Image) -> None:
    folder = folder_of(tmp_path)
    save(folder / "a.jpg", picture)
    save(folder / "b.jpg", picture[:240, :320])
    with pytest.raises(TagError, match=r"2 sizes: 640x480 \(a\.jpg\), 320x240 \(b\.jpg\)"):
        list_photos(folder, None)


def test_a_focal_length_that_contradicts_the_calibration_is_warned_of(
    tmp_path: Path, picture: Image, caplog: pytest.LogCaptureFixture
) -> None:
    folder = folder_of(tmp_path)
    # 552 px of a diagonal of 800 are 30 mm of film
    save(folder / "a.jpg", picture, {}, {FOCAL_FILM: 30})
    with caplog.at_level(logging.WARNING):
        list_photos(folder, None)
    assert caplog.text == ""
    save(folder / "a.jpg", picture, {}, {FOCAL_FILM: 77})
    with caplog.at_level(logging.WARNING):
        list_photos(folder, None)
    assert "EXIF says a focal length of about 1424 px" in caplog.text
    assert "552 px" in caplog.text


@pytest.mark.parametrize("name", ["IMG_1.HEIC", "IMG_1.jpg"])
def test_heic_photos_are_refused_with_the_way_to_convert_them(tmp_path: Path, name: str) -> None:
    folder = folder_of(tmp_path)
    (folder / name).write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic")
    with pytest.raises(TagError, match=rf"{name}: a HEIC photo cannot be read; expected JPEG or PNG; convert to JPEG"):
        list_photos(folder, None)


def test_heic_photos_beside_their_jpegs_are_nothing_and_beside_others_warned_of(
    tmp_path: Path, picture: Image, caplog: pytest.LogCaptureFixture
) -> None:
    folder = folder_of(tmp_path)
    save(folder / "IMG_1.jpg", picture)
    (folder / "IMG_1.HEIC").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0")
    with caplog.at_level(logging.WARNING):
        assert [p.file for p in list_photos(folder, None)] == ["IMG_1.jpg"]
    assert caplog.text == ""
    (folder / "IMG_2.dng").write_bytes(b"II*\0")
    with caplog.at_level(logging.WARNING):
        assert len(list_photos(folder, None)) == 1
    assert "1 files are left out, for example IMG_2.dng" in caplog.text


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_photos_are_read_in_colour_for_features_that_look_at_it(
    tmp_path: Path, picture: Image, kind: type[np.unsignedinteger]
) -> None:
    folder = folder_of(tmp_path)
    reddish = np.stack([picture // 4, picture // 2, picture], axis=2).astype(kind) * (257 if kind == np.uint16 else 1)
    cv2.imwrite(str(folder / "a.png"), reddish)
    (photo,) = list_photos(folder, None)
    rgb, grey = read_photo(photo, colour=True), read_photo(photo)
    assert rgb is not None
    assert grey is not None
    # The brightest of 16-bit pixels become white, here those of the red channel
    stored = rgb.astype(float) * (np.median(picture) / np.median(rgb[:, :, 0]))
    np.testing.assert_allclose(np.minimum(stored[:, :, 0], 200), np.minimum(picture, 200), atol=3)
    np.testing.assert_allclose(stored[:, :, 2], picture // 4, atol=3)
    assert np.corrcoef(to_grey(rgb).ravel(), grey.ravel())[0, 1] > 0.999
    covered = _without_tags(rgb, find(folder)[0][0].usable)
    assert covered.shape == rgb.shape
    assert (covered != rgb).any(axis=2).mean() > 0.02


@pytest.mark.parametrize("brightest", [65535, 4095], ids=["full range", "12 of 16 bits"])
def test_sixteen_bits_are_read_as_eight_and_warned_of(
    tmp_path: Path, picture: Image, brightest: int, caplog: pytest.LogCaptureFixture
) -> None:
    folder = folder_of(tmp_path)
    cv2.imwrite(str(folder / "a.png"), (picture.astype(np.float64) / 255 * brightest).astype(np.uint16))
    with caplog.at_level(logging.WARNING):
        shots, rejected = find(folder)
    assert "1 photos have 16 bits per pixel, for example a.png" in caplog.text
    assert rejected == []
    (deep,) = shots[0].usable
    shutil.rmtree(folder)
    folder_of(folder)
    cv2.imwrite(str(folder / "a.png"), picture)
    (plain,) = find(folder)[0][0].usable
    np.testing.assert_allclose(deep.corners_px, plain.corners_px, atol=0.02)


def test_a_tag_partly_outside_is_rejected_with_the_reason(tmp_path: Path, picture: Image) -> None:
    folder = folder_of(tmp_path)
    save(folder / "a.png", picture)
    distance = 552 * SIZE_M / 100
    save(folder / "b.png", facing((-320 + 48) / 552 * distance, distance))
    save(folder / "c.png", facing((-320 + 20) / 552 * distance, distance))
    shots, rejected = find(folder)
    assert [s.photo.file for s in shots] == ["a.png"]
    reasons = {p.file: p.reason for p in rejected}
    assert "partly outside of the photo" in reasons["b.png"]
    assert reasons["c.png"].startswith("no tag found")
