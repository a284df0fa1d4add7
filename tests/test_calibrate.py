"""Tag calibration: real photos of a textured wall with tags, localized in a real map of it."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fieldkit.calibrate import calibrate_photos, parse_sizes
from fieldkit.cameras import Camera
from fieldkit.cli import tags_calibrate
from fieldkit.errors import MapError, TagError
from fieldkit.features import extract
from fieldkit.frames import Pose, pose_error
from fieldkit.store import PhotoEntry, read_tags, write_camera, write_photos, write_tags
from fieldkit.tags import draw_tag
from fieldkit.types import Image, SceneMap, TagMap

# The wall lies in the map's x-z plane and is seen from y < 0; its texture has 2 mm per pixel
TEXEL_M = 0.002
MAP_FROM_WALL = Pose.from_components([2.0, 1.0, 1.2], Rotation.from_euler("x", 90, degrees=True))
MAPPING = Camera("PINHOLE", 960, 720, (600.0, 600.0, 480.0, 360.0))
PHOTO = Camera("PINHOLE", 1280, 960, (1000.0, 1000.0, 640.0, 480.0))
SIZE_M = 0.16


def wall(rng: np.random.Generator, *, tags: dict[int, tuple[float, float]]) -> Image:
    """Draw a wall of 2.8 x 2.2 m with spots of many sizes and tags at (x, y) of the wall's frame."""
    texture = np.full((1100, 1400), 128, np.uint8)
    for radius in (40, 20, 12, 8):
        for _ in range(12000 // radius):
            centre = rng.integers(0, (1400, 1100)).tolist()
            axes = (int(rng.integers(2, radius + 2)), int(rng.integers(2, radius + 2)))
            cv2.ellipse(texture, centre, axes, float(rng.uniform(0, 180)), 0, 360, int(rng.integers(30, 230)), -1)
    texture = cv2.GaussianBlur(texture, (0, 0), 1.2)
    for tag_id, (x, y) in tags.items():
        tag = draw_tag("tag36h11", tag_id, cell_px=10)
        row, column = 550 - round(y / TEXEL_M) - len(tag) // 2, 700 + round(x / TEXEL_M) - len(tag) // 2
        texture[row : row + len(tag), column : column + len(tag)] = tag
    return texture


def photograph(texture: Image, camera: Camera, map_from_cam: Pose, rng: np.random.Generator) -> Image:
    """Render the wall at three times the resolution, then average: antialiased, with exact geometry."""
    cam_from_wall = map_from_cam.inv() * MAP_FROM_WALL
    rotation = cam_from_wall.rotation.as_matrix()
    fine = camera.scaled(3.0)
    pixel_from_wall = fine.matrix() @ np.column_stack([rotation[:, :2], cam_from_wall.translation])
    wall_from_texel = np.array([[TEXEL_M, 0, -700 * TEXEL_M], [0, -TEXEL_M, 550 * TEXEL_M], [0, 0, 1]])
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    homography = np.linalg.inv(half) @ pixel_from_wall @ wall_from_texel @ half
    image = cv2.warpPerspective(texture, homography, (fine.width, fine.height), borderValue=90)
    small = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return np.clip(small + rng.normal(0, 1.5, small.shape), 0, 255).astype(np.uint8)


def looking_at_wall(x: float, y: float, distance: float, yaw_deg: float = 0.0, pitch_deg: float = 0.0) -> Pose:
    """Return map_from_cam of a camera whose axis meets the wall at (x, y), turned about that point."""
    turn = Rotation.from_euler("yx", [yaw_deg, pitch_deg], degrees=True)
    facing = Pose.from_components([x, y, 0], turn) * Pose.from_components([0, 0, distance], Rotation.identity())
    return MAP_FROM_WALL * facing * Pose.from_rotation(Rotation.from_euler("x", 180, degrees=True))


def build(texture: Image, rng: np.random.Generator, *, feature: str = "sift") -> SceneMap:
    """Make a map from one image of the wall: its keypoints, back-projected onto the wall, are the landmarks.

    Three more images, which are not drawn, see the landmarks where they are.
    """
    map_from_cam = looking_at_wall(0.0, 0.0, 1.7)
    features = extract(photograph(texture, MAPPING, map_from_cam, rng), feature=feature, max_keypoints=2000)
    rays = map_from_cam.rotation.apply(MAPPING.unproject(features.keypoints_px))
    normal = MAP_FROM_WALL.rotation.apply([0.0, 0.0, 1.0])
    depth = (MAP_FROM_WALL.translation - map_from_cam.translation) @ normal / (rays @ normal)
    xyz = map_from_cam.translation + rays * depth[:, None]
    n = len(xyz)
    poses = (map_from_cam, *(looking_at_wall(*a) for a in ((0, 0, 1.6, 25), (0, 0, 1.8, -25), (0, 0, 1.7, 0, 20))))
    seen = [np.arange(n, dtype=np.int32)]
    pixels = [features.keypoints_px]
    for pose in poses[1:]:
        projected, visible = MAPPING.project(pose.inv().apply(xyz))
        seen.append(np.flatnonzero(visible).astype(np.int32))
        pixels.append(projected[visible] + rng.normal(0, 0.3, (int(visible.sum()), 2)))
    image = np.repeat(np.arange(len(poses), dtype=np.int32), [len(s) for s in seen])
    return SceneMap(
        "wall.map", "digest", feature, xyz, np.tile(np.eye(3) * 1e-6, (n, 1, 1)),
        tuple(f"{i}.jpg" for i in range(len(poses))), (MAPPING,) * len(poses), poses, np.concatenate(seen), image,
        np.concatenate(pixels).astype(np.float32), features.descriptors, seen[0], np.zeros(n, np.int32),
    )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Wall:
    texture: Image
    scene_map: SceneMap
    folder: Path


PLACES = {1: (0.1, 0.2), 2: (-0.35, -0.1)}
AIMS = [
    (0.1, 0.1, 1.2, 25, 0),
    (-0.1, 0.1, 1.3, -25, 5),
    (0, 0, 1.4, 10, 20),
    (0.1, 0, 1.3, -10, -20),
    (-0.1, 0, 1.5, 30, 10),
]


@pytest.fixture(scope="module")
def wall_photos(tmp_path_factory: pytest.TempPathFactory) -> Wall:
    """Five photos with tags 1 and 2, one in which tag 1 hangs elsewhere, one of the tag on a bare wall, one without."""
    rng = np.random.default_rng(0)
    texture = wall(rng, tags=PLACES)
    moved = wall(np.random.default_rng(0), tags={1: (0.25, 0.2)})
    bare = cv2.copyMakeBorder(draw_tag("tag36h11", 1, cell_px=10), 500, 500, 650, 650, cv2.BORDER_CONSTANT, value=150)
    folder = tmp_path_factory.mktemp("photos")
    for i, aim in enumerate(AIMS):
        cv2.imwrite(str(folder / f"a{i}.png"), photograph(texture, PHOTO, looking_at_wall(*aim), rng))
    cv2.imwrite(str(folder / "moved.png"), photograph(moved, PHOTO, looking_at_wall(0.1, 0, 1.3, 5, 10), rng))
    cv2.imwrite(str(folder / "bare.png"), photograph(bare, PHOTO, looking_at_wall(0, 0, 1.2, 20), rng))
    cv2.imwrite(str(folder / "empty.png"), np.full((960, 1280), 120, np.uint8))
    write_camera(folder / "camera.toml", PHOTO)
    return Wall(texture, build(texture, rng), folder)


@pytest.fixture(scope="module")
def calibrated(wall_photos: Wall) -> TagMap:
    return calibrate_photos(wall_photos.folder, wall_photos.scene_map, sizes_m={None: SIZE_M})


def true_pose(tag_id: int) -> Pose:
    # Tags are drawn centred on whole pixels
    x, y = PLACES[tag_id]
    return MAP_FROM_WALL * Pose.from_translation([round(x / TEXEL_M) * TEXEL_M, round(y / TEXEL_M) * TEXEL_M, 0.0])


def test_tags_are_found_where_they_hang(calibrated: TagMap) -> None:
    assert [(t.id, t.visit, t.n_photos, t.verdict) for t in calibrated.tags] == [
        (1, None, 5, "pass"),
        (2, None, 5, "pass"),
    ]
    for tag in calibrated.tags:
        position, angle = pose_error(tag.map_from_tag, true_pose(tag.id))
        assert position < 0.003
        assert angle < math.radians(0.3)
        assert tag.rms_px < 0.3
        assert np.linalg.eigvalsh(tag.covariance).min() > 0
        assert position < 5 * math.sqrt(np.trace(tag.covariance[3:, 3:])) + 0.001
    assert calibrated.map_digest == "digest"


def test_every_photo_has_a_verdict_with_its_reason(calibrated: TagMap) -> None:
    reasons = {(p.file, p.tag_id): p.reason for p in calibrated.photos if not p.used}
    assert sorted(reasons) == [("bare.png", 1), ("empty.png", -1), ("moved.png", 1)]
    assert reasons["empty.png", -1] == "no tag found"
    assert reasons["bare.png", 1].startswith("not localized (")
    assert reasons["moved.png", 1].startswith("disagrees with the others by ")
    used = [(p.file, p.tag_id) for p in calibrated.photos if p.used]
    assert used == [(f"a{i}.png", tag) for i in range(5) for tag in (1, 2)]


def test_calibration_survives_a_round_trip_through_its_file(calibrated: TagMap, tmp_path: Path) -> None:
    write_tags(tmp_path / "tags.toml", calibrated)
    again = read_tags(tmp_path / "tags.toml")
    for photo, stored in zip(calibrated.photos, again.photos, strict=True):
        exact = {"offset": None, "without": None}
        assert dataclasses.replace(stored, **exact) == dataclasses.replace(photo, **exact)
        assert (stored.offset or 0.0) == pytest.approx(photo.offset or 0.0)
        assert (stored.without or 0.0) == pytest.approx(photo.without or 0.0)
    assert [t.reason for t in again.tags] == [t.reason for t in calibrated.tags]
    for one, two in zip(again.tags, calibrated.tags, strict=True):
        assert pose_error(one.map_from_tag, two.map_from_tag) == pytest.approx((0, 0), abs=1e-9)


def listed(wall_photos: Wall, folder: Path, entries: list[tuple[str, str | None]]) -> Path:
    folder.mkdir()
    for name in [*{e[0] for e in entries}, "camera.toml"]:
        if (wall_photos.folder / name).exists():
            (folder / name).symlink_to(wall_photos.folder / name)
    write_photos(folder / "photos.toml", [PhotoEntry(f, "camera.toml", v) for f, v in entries])
    return folder


def test_a_tag_whose_photos_name_visits_has_a_pose_per_visit(wall_photos: Wall, tmp_path: Path) -> None:
    folder = listed(wall_photos, tmp_path / "p", [("a0.png", "w01"), ("a1.png", "w01"), ("moved.png", "w02")])
    tags = calibrate_photos(folder, wall_photos.scene_map, sizes_m={1: SIZE_M})
    assert [(t.id, t.visit, t.n_photos, t.verdict) for t in tags.tags] == [(1, "w01", 2, "warn"), (1, "w02", 1, "warn")]
    first, second = (tags.find(1, visit=v) for v in ("w01", "w02"))
    assert first is not None
    assert second is not None
    assert pose_error(first.map_from_tag, second.map_from_tag)[0] == pytest.approx(0.15, abs=0.01)
    assert {p.reason for p in tags.photos if p.tag_id == 2} == {"no size given for this tag"}


def test_a_tag_that_is_also_in_photos_without_a_visit_is_fixed(wall_photos: Wall, tmp_path: Path) -> None:
    folder = listed(wall_photos, tmp_path / "p", [("a0.png", None), ("a1.png", "w01"), ("a2.png", "w02")])
    tags = calibrate_photos(folder, wall_photos.scene_map, sizes_m={None: SIZE_M})
    assert [(t.id, t.visit, t.n_photos) for t in tags.tags] == [(1, None, 3), (2, None, 3)]


def test_a_tag_that_moves_between_visits_keeps_its_places_though_a_photo_without_visit_shows_it(
    wall_photos: Wall, tmp_path: Path
) -> None:
    entries = [("a0.png", None), ("a1.png", "w01"), ("a2.png", "w01"), ("moved.png", "w02")]
    folder = listed(wall_photos, tmp_path / "p", entries)
    tags = calibrate_photos(folder, wall_photos.scene_map, sizes_m={1: SIZE_M})
    assert [(t.id, t.visit, t.n_photos) for t in tags.tags] == [(1, "w01", 2), (1, "w02", 1)]
    second = tags.find(1, visit="w02")
    assert second is not None
    assert pose_error(second.map_from_tag, true_pose(1))[0] == pytest.approx(0.15, abs=0.01)
    (rejected,) = (p for p in tags.photos if p.tag_id == 1 and not p.used)
    assert (rejected.file, rejected.visit) == ("a0.png", None)
    assert rejected.reason.startswith("the tag has another place in photos without a visit than in visit w02; expected")
    assert tags.find(1, visit="w03") is None


def test_a_visit_that_contradicts_the_photos_without_a_visit_keeps_its_own_place(
    wall_photos: Wall, tmp_path: Path
) -> None:
    folder = listed(wall_photos, tmp_path / "p", [("moved.png", None), ("a0.png", "w01"), ("a1.png", "w01")])
    tags = calibrate_photos(folder, wall_photos.scene_map, sizes_m={1: SIZE_M})
    assert [(t.visit, t.n_photos) for t in tags.tags] == [("w01", 2)]
    assert pose_error(tags.tags[0].map_from_tag, true_pose(1))[0] < 0.01
    folder = listed(wall_photos, tmp_path / "q", [("a2.png", None), ("a0.png", "w01"), ("a1.png", "w01")])
    tags = calibrate_photos(folder, wall_photos.scene_map, sizes_m={1: SIZE_M})
    assert [(t.visit, t.n_photos) for t in tags.tags] == [(None, 3)]


def test_one_photo_of_a_visit_does_not_outvote_the_photos_of_a_fixed_tag(wall_photos: Wall, tmp_path: Path) -> None:
    entries = [*((f"a{i}.png", None) for i in range(3)), ("moved.png", "w02"), ("a3.png", "w01")]
    tags = calibrate_photos(listed(wall_photos, tmp_path / "p", entries), wall_photos.scene_map, sizes_m={1: SIZE_M})
    assert [(t.id, t.visit, t.n_photos) for t in tags.tags] == [(1, None, 4)]
    assert [p.file for p in tags.photos if p.tag_id == 1 and not p.used] == ["moved.png"]


@pytest.mark.parametrize("again", ["a0.png", "./a0.png", "link.png"])
def test_a_photo_that_is_listed_twice_is_refused(wall_photos: Wall, tmp_path: Path, again: str) -> None:
    folder = listed(wall_photos, tmp_path / "p", [("a0.png", None)])
    (folder / "link.png").symlink_to(folder / "a0.png")
    write_photos(folder / "photos.toml", [PhotoEntry(f, "camera.toml", None) for f in ("a0.png", again)])
    message = rf"p: photo {again} is listed twice, first as a0\.png; expected every photo once; remove one"
    with pytest.raises(TagError, match=message):
        calibrate_photos(folder, wall_photos.scene_map, sizes_m={1: SIZE_M})


@pytest.mark.parametrize("upwards", ["../", "x/../../", "/"])
@pytest.mark.parametrize("what", ["photo", "camera"])
def test_a_path_that_leads_outside_of_the_folder_is_refused(
    wall_photos: Wall, tmp_path: Path, upwards: str, what: str
) -> None:
    folder = listed(wall_photos, tmp_path / "p", [("a0.png", None)])
    (tmp_path / "a1.png").symlink_to(wall_photos.folder / "a1.png")
    (tmp_path / "camera.toml").symlink_to(wall_photos.folder / "camera.toml")
    (folder / "x").mkdir()
    way = f"{tmp_path}/" if upwards == "/" else upwards
    entry = PhotoEntry(way + "a1.png", "camera.toml") if what == "photo" else PhotoEntry("a0.png", way + "camera.toml")
    write_photos(folder / "photos.toml", [entry])
    with pytest.raises(TagError, match=r"photos\.toml: '.*' leads outside of the folder; expected a path in .*p; "):
        calibrate_photos(folder, wall_photos.scene_map, sizes_m={1: SIZE_M})


def test_two_photos_that_disagree_fail_the_tag(wall_photos: Wall, tmp_path: Path) -> None:
    folder = listed(wall_photos, tmp_path / "p", [("a0.png", None), ("moved.png", None)])
    (tag,) = calibrate_photos(folder, wall_photos.scene_map, sizes_m={1: SIZE_M}).tags
    assert (tag.n_photos, tag.verdict) == (1, "fail")
    assert tag.reason.startswith("no two of its 2 photos agree")
    # 15 cm apart, and nothing tells which one is right
    assert np.trace(tag.covariance[3:, 3:]) > 0.14**2


def test_photos_that_are_refused_count_as_rejected(wall_photos: Wall, tmp_path: Path) -> None:
    names = ["a0.png", "a1.png", "a2.png", "soft0.png", "soft1.png"]
    folder = listed(wall_photos, tmp_path / "p", [(name, None) for name in names])
    soft = cv2.GaussianBlur(cv2.imread(str(wall_photos.folder / "a4.png")), (0, 0), 4.0)
    for name in names[3:]:
        cv2.imwrite(str(folder / name), soft)
    (tag,) = calibrate_photos(folder, wall_photos.scene_map, sizes_m={1: SIZE_M}).tags
    assert (tag.n_photos, tag.verdict, tag.reason) == (3, "warn", "2 of 5 photos are rejected")


def test_one_id_in_two_families_is_refused(wall_photos: Wall, tmp_path: Path) -> None:
    folder = listed(wall_photos, tmp_path / "p", [("a0.png", None), ("other.png", None)])
    other = cv2.copyMakeBorder(draw_tag("tag25h9", 1, cell_px=20), 300, 300, 400, 400, cv2.BORDER_CONSTANT, value=150)
    cv2.imwrite(str(folder / "other.png"), cv2.resize(other, (PHOTO.width, PHOTO.height)))
    message = r"p: tag 1 is of tag36h11 in a0\.png and of tag25h9 in other\.png; expected one family per id; choose one"
    with pytest.raises(TagError, match=message):
        calibrate_photos(folder, wall_photos.scene_map, sizes_m={None: SIZE_M}, families=("tag36h11", "tag25h9"))


def test_what_is_wrong_with_the_photos_is_named(wall_photos: Wall, tmp_path: Path) -> None:
    sizes, scene_map = {None: SIZE_M}, wall_photos.scene_map
    with pytest.raises(TagError, match="no such folder"):
        calibrate_photos(tmp_path / "absent", scene_map, sizes_m=sizes)
    with pytest.raises(TagError, match="holds no photo"):
        calibrate_photos(tmp_path, scene_map, sizes_m=sizes)
    empty = listed(wall_photos, tmp_path / "empty", [("empty.png", None)])
    with pytest.raises(
        TagError, match=r"none of the 1 photos shows a tag of tag36h11 \(for example empty\.png: no tag"
    ):
        calibrate_photos(empty, scene_map, sizes_m=sizes)
    lost = listed(wall_photos, tmp_path / "lost", [("bare.png", None)])
    with pytest.raises(TagError, match=r"no photo of a tag could be localized in wall\.map \(bare\.png: not localized"):
        calibrate_photos(lost, scene_map, sizes_m=sizes)
    with pytest.raises(TagError, match="no tag can be used; tags"):
        calibrate_photos(wall_photos.folder, scene_map, sizes_m={9: SIZE_M})
    write_camera(tmp_path / "other.toml", PHOTO.scaled(0.5))
    with pytest.raises(TagError, match=r"a0\.png: 1280x960 pixels; expected 640x480 as in .*other\.toml"):
        calibrate_photos(wall_photos.folder, scene_map, camera=tmp_path / "other.toml", sizes_m=sizes)
    (lost / "bare.png").unlink()
    with pytest.raises(TagError, match=r"bare\.png: no such photo"):
        calibrate_photos(lost, scene_map, sizes_m=sizes)
    (empty / "camera.toml").unlink()
    (empty / "photos.toml").unlink()
    with pytest.raises(TagError, match=r"camera\.toml: no such camera file"):
        calibrate_photos(empty, scene_map, sizes_m=sizes)


def test_a_photo_that_cannot_be_read_is_rejected_and_the_others_count(wall_photos: Wall, tmp_path: Path) -> None:
    folder = listed(wall_photos, tmp_path / "p", [("a0.png", None), ("a1.png", None)])
    (folder / "a1.png").unlink()
    (folder / "a1.png").write_bytes(b"not an image")
    tags = calibrate_photos(folder, wall_photos.scene_map, sizes_m={1: SIZE_M})
    assert [(p.file, p.reason) for p in tags.photos if p.tag_id != 2] == [
        ("a0.png", ""),
        ("a1.png", "cannot be read as an image"),
    ]


def test_a_photo_that_was_copied_in_part_is_rejected(wall_photos: Wall, tmp_path: Path) -> None:
    folder = listed(wall_photos, tmp_path / "p", [("a0.png", None), ("part.jpg", None)])
    whole = cv2.imencode(".jpg", cv2.imread(str(wall_photos.folder / "a1.png")))[1].tobytes()
    (folder / "part.jpg").write_bytes(whole[: len(whole) * 9 // 10])
    tags = calibrate_photos(folder, wall_photos.scene_map, sizes_m={1: SIZE_M})
    assert [p.reason for p in tags.photos if p.file == "part.jpg"] == ["the file is cut short; copy it again"]


def test_the_second_map_is_read_before_photos_and_its_contradiction_is_the_exit_status(
    wall_photos: Wall, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    maps = {"lab.map": wall_photos.scene_map, "bad.map": bent(wall_photos.scene_map)}
    monkeypatch.setattr("fieldkit.maps.load_map", lambda path: maps[path.name])
    out, size_m = tmp_path / "tags.toml", (str(SIZE_M),)
    with pytest.raises(TagError, match="is the map that is checked"):
        tags_calibrate(wall_photos.folder, map=Path("lab.map"), check_map=Path("lab.map"), out=out, size_m=size_m)
    assert not out.exists()
    assert (
        tags_calibrate(wall_photos.folder, map=Path("lab.map"), check_map=Path("bad.map"), out=out, size_m=size_m) == 3
    )
    assert "fail" in capsys.readouterr().out


def bent(scene_map: SceneMap) -> SceneMap:
    """Return the map with its wall bent by decimetres."""
    xyz = scene_map.xyz.copy()
    xyz[:, 1] += 0.3 * np.sin(4 * xyz[:, 0])
    return dataclasses.replace(scene_map, xyz=xyz, digest="bent", path="bad.map")


def test_a_missing_map_is_named_before_photos_are_read(wall_photos: Wall, tmp_path: Path) -> None:
    out = tmp_path / "tags.toml"
    with pytest.raises(MapError, match=r"absent\.map"):
        tags_calibrate(wall_photos.folder, map=tmp_path / "absent.map", out=out, size_m=(str(SIZE_M),))
    assert not out.exists()


def test_sizes_are_parsed() -> None:
    assert parse_sizes(["0.1365", "3:0.30"]) == {None: 0.1365, 3: 0.3}


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["big"], "--size-m big: not a tag size; expected metres"),
        (["x:0.1"], "--size-m x:0.1: not a tag size"),
        (["-0.1"], "not a tag size"),
        (["nan"], "not a tag size"),
        (["136.5"], "136.5 m is no tag's edge"),
        (["0.1", "0.2"], "given twice for every tag"),
        (["3:0.1", "3:0.2"], "given twice for tag 3"),
        ([], "no tag size"),
    ],
)
def test_bad_sizes_are_named(texts: list[str], message: str) -> None:
    with pytest.raises(TagError, match=message):
        parse_sizes(texts)
