"""What a map's scale and frame come from: tags, depth, poses that are known, or SLAM; and what a source lacks."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from synthetic_map import CAMERA, looking
from test_align import ROTATION, as_sfm, walk
from tiny_walk import TAG_M, view, write_walk

from fieldkit.errors import MapError, TagError
from fieldkit.frames import Pose, exp, pose_error
from fieldkit.maps import (
    FrameOptions,
    ImportOptions,
    MapOptions,
    build_map,
    fit_gauge,
    import_map,
    load_map,
    map_info,
)
from fieldkit.maps.metric.choosing import find_frame
from fieldkit.maps.metric.tagged import TagScale, tag_scale
from fieldkit.maps.metric.upright import level_cameras, up_rotation
from fieldkit.maps.sources.source import MapSource, SourceImage
from fieldkit.store import Rig, RigCamera, read_camera, write_rig, write_tum
from fieldkit.tags import TagDetection, tag_corners

QUICK = MapOptions(max_keypoints=700)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Mapping[str, Pose]]:
    """A SOURCE with everything: poses, depth, tags; copies leave things away."""
    folder = tmp_path_factory.mktemp("room") / "source"
    return folder, write_walk(folder, tags=True)


def errors(path: Path, true: Mapping[str, Pose]) -> tuple[float, float]:
    """Return scale error and the angle of the map's z axis to the true one (deg)."""
    scene_map = load_map(path)
    turns = [
        p.rotation * true[n].rotation.inv()
        for n, p in zip(scene_map.image_names, scene_map.map_from_image, strict=True)
    ]
    up = Rotation.concatenate(turns).mean().apply([0.0, 0.0, 1.0])
    return fit_gauge(scene_map, true).scale_error, float(np.degrees(np.arccos(min(up[2], 1.0))))


def without(source: Path, out: Path, *names: str) -> Path:
    """Copy a SOURCE without some of its entries."""
    shutil.copytree(source, out, ignore=shutil.ignore_patterns(*names))
    return out


def test_depth_alone_gives_scale_and_its_level_surfaces_gravity(
    room: tuple[Path, Mapping[str, Pose]], tmp_path: Path
) -> None:
    source, true = room
    report = build_map(without(source, tmp_path / "s", "poses.txt"), tmp_path / "m", options=QUICK)
    scale, tilt = errors(tmp_path / "m", true)
    assert abs(scale) < 0.005
    assert tilt < 0.3
    assert map_info(tmp_path / "m")["alignment"]["source"] == "depth"
    assert report.alignment.gravity_from in ("floor", "verticals")
    assert any("nothing measured gravity: up is known to" in w for w in report.warnings)


def test_tags_alone_give_scale_and_upright_lines_gravity(room: tuple[Path, Mapping[str, Pose]], tmp_path: Path) -> None:
    source, true = room
    options = dataclasses.replace(QUICK, tag_sizes_m={None: TAG_M})
    report = build_map(without(source, tmp_path / "s", "poses.txt", "depth*"), tmp_path / "m", options=options)
    scale, tilt = errors(tmp_path / "m", true)
    entry = map_info(tmp_path / "m")["alignment"]
    assert entry["source"] == "tags"
    assert abs(scale) < min(0.005, 4 * entry["scale_sigma"])
    assert tilt < 0.3
    assert report.alignment.gravity_from == "verticals"
    assert entry["n_used"] >= 6


def test_known_poses_stay_as_they_are(room: tuple[Path, Mapping[str, Pose]], tmp_path: Path) -> None:
    source, true = room
    report = build_map(source, tmp_path / "m", options=dataclasses.replace(QUICK, poses="known"))
    scene_map = load_map(tmp_path / "m")
    for name, pose in zip(scene_map.image_names, scene_map.map_from_image, strict=True):
        assert max(pose_error(pose, true[name])) < 1e-6
    assert report.alignment.verdict == "pass"
    assert report.alignment.reprojection_px is not None
    assert report.alignment.reprojection_px < 1.0
    assert len(scene_map.xyz) > 200
    walls = np.abs(scene_map.xyz[:, :2]) / (2.0, 1.6)
    assert np.median(np.abs(walls.max(axis=1) - 1.0)) < 0.01


def test_an_imported_model_is_triangulated_anew_by_another_feature(
    room: tuple[Path, Mapping[str, Pose]], tmp_path: Path
) -> None:
    source, true = room
    build_map(source, tmp_path / "m", options=dataclasses.replace(QUICK, poses="known"))
    options = ImportOptions("akaze", FrameOptions(scale=1.0), retriangulate=True)
    report = import_map(tmp_path / "m", tmp_path / "again", images=source / "images", options=options)
    scene_map = load_map(tmp_path / "again")
    assert scene_map.feature == "akaze"
    assert report.n_landmarks == len(scene_map.xyz) > 100
    for name, pose in zip(scene_map.image_names, scene_map.map_from_image, strict=True):
        assert max(pose_error(pose, true[name])) < 1e-6
    halved = [(n, Pose.from_components(0.5 * p.translation, p.rotation)) for n, p in true.items()]
    halved = [(n, p if i % 2 else true[n]) for i, (n, p) in enumerate(halved)]
    write_tum(tmp_path / "bent.txt", halved)
    bent = ImportOptions("akaze", FrameOptions(poses=tmp_path / "bent.txt"), retriangulate=True)
    import_map(tmp_path / "m", tmp_path / "bent", images=source / "images", options=bent)
    stated = map_info(tmp_path / "bent")["alignment"]
    assert (stated["source"], stated["verdict"] != "pass", stated["match_share"] > 0.8) == ("slam", True, True)


def test_the_frames_of_a_rig_stay_where_their_known_poses_are(
    room: tuple[Path, Mapping[str, Pose]], tmp_path: Path
) -> None:
    source, true = room
    ahead, beside = Pose.identity(), exp([0.0, 0.3, 0.0, 0.1, 0.0, 0.0])
    camera = read_camera(source / "camera.toml")
    write_rig(tmp_path / "rig.toml", Rig((RigCamera("a", camera, ahead), RigCamera("b", camera, beside))))
    frames = sorted(true)[::2]
    for name, at in (("a", ahead), ("b", beside)):
        (tmp_path / "images" / name).mkdir(parents=True)
        for frame in frames:
            image = view(true[frame] * at)
            assert cv2.imwrite(str(tmp_path / "images" / name / frame), image)
    write_tum(tmp_path / "slam_poses.txt", [(Path(frame).stem, true[frame]) for frame in frames])
    options = dataclasses.replace(QUICK, poses="known")
    report = build_map(tmp_path, tmp_path / "rig.map", options=options)
    scene_map = load_map(tmp_path / "rig.map")
    for name, pose in zip(scene_map.image_names, scene_map.map_from_image, strict=True):
        expected = true[Path(name).name] * (beside if name.startswith("b/") else ahead)
        assert max(pose_error(pose, expected)) < 1e-6
    assert len(scene_map.image_names) == 16
    assert report.alignment.match_share is not None
    assert report.alignment.match_share > 0.85


@pytest.mark.parametrize(("sigma_rad", "sigma_m"), [(0.01, 0.01), (0.05, 0.3)])
def test_known_poses_that_are_wrong_do_not_pass(
    room: tuple[Path, Mapping[str, Pose]], tmp_path: Path, sigma_rad: float, sigma_m: float, rng: np.random.Generator
) -> None:
    source, true = room
    wrong = without(source, tmp_path / "s", "poses.txt")
    sigmas = [sigma_rad] * 3 + [sigma_m] * 3
    write_tum(wrong / "poses.txt", [(name, pose * exp(rng.normal(0, sigmas))) for name, pose in true.items()])
    options = dataclasses.replace(QUICK, poses="known")
    if sigma_m > 0.1:
        with pytest.raises(MapError, match=r"the known poses fit \d+ % of the matches .* expected most"):
            build_map(wrong, tmp_path / "m", options=options)
        return
    report = build_map(wrong, tmp_path / "m", options=options)
    assert report.alignment.verdict != "pass"
    assert any("known poses, verdict" in w for w in report.warnings)


@pytest.mark.parametrize(
    ("missing", "options", "message"),
    [
        (
            ("poses.txt", "depth*"),
            {},
            "neither poses nor depth images, and no tag's size.*scale of a map unknown",
        ),
        (("poses.txt",), {"scale": "slam"}, "poses.txt: no such file; expected SLAM poses"),
        (("poses.txt",), {"poses": "known"}, "poses.txt: no such file; expected the poses that are known"),
        (("depth*",), {"scale": "depth"}, "no depth image; expected some, for the scale"),
        ((), {"scale": "tags", "tag_sizes_m": {77: 0.2}}, "no tag of known size is seen in 3 images"),
    ],
)
def test_a_source_without_what_gives_its_scale_is_told_so_and_leaves_nothing(
    room: tuple[Path, Mapping[str, Pose]],
    tmp_path: Path,
    missing: tuple[str, ...],
    options: dict[str, object],
    message: str,
) -> None:
    source = without(room[0], tmp_path / "s", *missing)
    with pytest.raises(MapError, match=message):
        build_map(source, tmp_path / "m", options=MapOptions(**options))  # type: ignore[arg-type]
    assert [p.name for p in tmp_path.iterdir()] == ["s"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scale": "tags"}, "scale by tags without a tag's size"),
        ({"poses": "known", "scale": "depth"}, "poses that are known have their scale"),
        ({"poses": "none", "scale": "slam"}, "its poses are not to be read"),
        ({"tag_sizes_m": {3: -0.1}}, "size_m of tag 3 is -0.1"),
        ({"tag_families": ("tag36h12",)}, "tag36h12"),
    ],
)
def test_options_that_contradict_each_other_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises((MapError, TagError), match=message):
        MapOptions(**options)  # type: ignore[arg-type]


def sightings(
    rng: np.random.Generator, *, size_m: float = 0.3, scale: float = 3.7, noise_px: float = 0.2, tag_id: int = 1
) -> list[tuple[Pose, object, TagDetection]]:
    """Return a tag as cameras that walk past it see it; their poses are in a frame of another scale."""
    map_from_tag = looking(np.array([3.0, 0.0, 1.5]), 0.0) * Pose.from_rotation(Rotation.from_euler("x", np.pi))
    corners = map_from_tag.apply(tag_corners(size_m))
    places = [looking(np.array([0.8, y, 1.5 + 0.1 * y]), -0.35 * y) for y in np.linspace(-1.2, 1.2, 9)]
    result: list[tuple[Pose, object, TagDetection]] = []
    for sfm, place in zip(as_sfm(places, scale=scale), places, strict=True):
        pixels, inside = CAMERA.project(place.inv().apply(corners))
        assert inside.all()
        seen = pixels + rng.normal(0, noise_px, (4, 2))
        result.append((sfm, CAMERA, TagDetection(tag_id, "tag36h11", seen, noise_px)))
    return result


def scale_of(seen: list[tuple[Pose, object, TagDetection]], sizes: Mapping[int | None, float]) -> TagScale:
    found = tag_scale(seen, sizes, seed=0)  # type: ignore[arg-type]
    assert found is not None
    return found


def test_the_size_of_a_tag_is_the_scale_of_the_map(rng: np.random.Generator) -> None:
    found = scale_of(sightings(rng), {None: 0.3})
    assert abs(found.scale * 3.7 - 1) < 4 * found.sigma < 0.02
    assert (found.n_used, found.n_total, found.ids) == (9, 9, (1,))
    assert found.rms_m < 0.003


@pytest.mark.parametrize(("size_m", "verdict"), [(0.3, "pass"), (0.33, "warn"), (0.45, "fail")])
def test_slam_poses_that_contradict_the_size_of_a_tag_do_not_pass(
    rng: np.random.Generator, size_m: float, verdict: str
) -> None:
    seen = sightings(rng, noise_px=0.05)
    places = [looking(np.array([0.8, y, 1.5 + 0.1 * y]), -0.35 * y) for y in np.linspace(-1.2, 1.2, 9)]
    places += [looking(np.array([x, 0.0, 1.5]), 0.0) for x in (-1.0, 0.0, 1.5)]
    images = tuple(SourceImage(f"{i}.png", Path(), CAMERA, "", str(i), place) for i, place in enumerate(places))
    options = MapOptions(tag_sizes_m={None: size_m})
    found, told = find_frame(
        MapSource(Path("walk"), images, None, ()),
        pycolmap.Reconstruction(),
        dict(enumerate(as_sfm(places, scale=3.7))),
        options,
        tags={i: [d] for i, (_, _, d) in enumerate(seen)},
        seed=0,
    )
    assert (found.source, found.verdict) == ("tags", verdict)
    assert any("SLAM poses are" in t for t in told) == (verdict != "pass")


def test_a_second_tag_of_the_same_number_elsewhere_does_not_count(rng: np.random.Generator) -> None:
    seen = sightings(rng)
    moved = [
        (pose, camera, dataclasses.replace(d, corners_px=d.corners_px + [40.0, -25.0]))
        if i in (2, 5)
        else (pose, camera, d)
        for i, (pose, camera, d) in enumerate(seen)
    ]
    found = scale_of(moved, {1: 0.3})
    assert (found.n_used, found.n_total) == (7, 9)
    assert abs(found.scale * 3.7 - 1) < 4 * found.sigma


def test_tags_that_contradict_each_other_widen_the_sigma(rng: np.random.Generator) -> None:
    both = sightings(rng) + sightings(rng, tag_id=2)
    assert scale_of(both, {None: 0.3}).apart < 0.02
    wrong = scale_of(both, {1: 0.3, 2: 0.36})
    assert wrong.apart > 0.08
    assert wrong.sigma > 0.05


def test_tags_seen_from_one_place_or_twice_give_no_scale(rng: np.random.Generator) -> None:
    seen = sightings(rng)
    assert tag_scale(seen[:2], {None: 0.3}, seed=0) is None  # type: ignore[arg-type]
    assert tag_scale([seen[4]] * 6, {None: 0.3}, seed=0) is None  # type: ignore[arg-type]
    assert tag_scale([], {None: 0.3}, seed=0) is None


def test_cameras_that_are_held_level_tell_up(rng: np.random.Generator) -> None:
    level = level_cameras(as_sfm(walk(rng)))
    up = ROTATION.apply([0.0, 0.0, 1.0])
    assert np.degrees(np.arccos(level.up_in_sfm @ up)) < 1.0
    assert level.sigma_deg >= 1.0
    turned = up_rotation(up, ROTATION.apply([0.6, 0.0, 0.8]))
    np.testing.assert_allclose(turned.apply(up), [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(turned.apply(ROTATION.apply([1.0, 0.0, 0.0])), [1.0, 0.0, 0.0], atol=1e-12)
