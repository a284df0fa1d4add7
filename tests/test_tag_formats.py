"""Tag files of other tools: axes, sizes and noise survive the way in and out, and what cannot is named."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fieldkit.cli import main
from fieldkit.errors import FieldkitError, StoreError, TagError
from fieldkit.frames import Pose, exp, pose_error, yaw_pose
from fieldkit.store import read_tags, write_tags
from fieldkit.tags.formats import TAG_FORMATS, ImportOptions, export_tags, import_tags
from fieldkit.types import TagMap, TagPose

# A wall that the robot looks at along x: to its eyes right is -y, up is z, and out of the paper is -x
ON_WALL = Rotation.from_matrix([[0, 0, -1], [-1, 0, 0], [0, 1, 0]])


def spread(rotation_rad: float, position_m: float) -> np.ndarray:
    return np.diag([rotation_rad**2] * 3 + [position_m**2] * 3)


def some_tags(rng: np.random.Generator) -> TagMap:
    return TagMap(
        (
            TagPose(1, "tag36h11", 0.1365, exp(rng.normal(0, 1, 6)), spread(0.002, 0.004), 6, 0.2),
            TagPose(5, "tag36h11", 0.3, exp(rng.normal(0, 1, 6)), spread(0.003, 0.005), 8, 0.2),
        ),
        (),
        "0123456789abcdef",
        path="tags.toml",
    )


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def tagslam(path: Path, *, body: str = "", tag: str = "") -> Path:
    return write(
        path,
        f"""
bodies:
  - lab:
      type: simple
      is_static: true
      default_tag_size: 0.15
      pose:
        position: {{x: 1.0, y: 2.0, z: 0.0}}
        rotation: {{x: 0.0, y: 0.0, z: 1.5707963267948966}}
        position_noise: {{x: 1e-6, y: 1e-6, z: 1e-6}}
        rotation_noise: {{x: 1e-6, y: 1e-6, z: 1e-6}}
      tags:
        - id: 3
          pose:
            position: {{x: 3.0, y: 0.0, z: 1.5}}
            rotation: {{x: 0.0, y: -1.5707963267948966, z: 0.0}}
            position_noise: {{x: 0.01, y: 0.02, z: 0.03}}
            rotation_noise: {{x: 0.001, y: 0.002, z: 0.003}}
{tag}
{body}
""",
    )


def world_object(tag_id: int = 524, **fiducial: Any) -> dict[str, Any]:
    """One fiducial on the wall, in camel case as MessageToJson writes it: 2 m ahead of a body that stands at x = 1."""
    spot = Rotation.from_matrix(np.column_stack([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])).as_quat()
    rotation = dict(zip("xyzw", spot.tolist(), strict=True))
    edges = {
        "vision": {"parentFrameName": "body", "parentTformChild": {"position": {"x": -1}, "rotation": {"w": 1}}},
        "body": {"parentFrameName": "", "parentTformChild": {"rotation": {"w": 1}}},
        "fiducial_524": {
            "parentFrameName": "body",
            "parentTformChild": {"position": {"x": 2, "z": 0.4}, "rotation": rotation},
        },
    }
    said = {
        "frameNameFiducial": "fiducial_524",
        "fiducialPoseStatus": "STATUS_OK",
        "dimensions": {"x": 0.146, "y": 0.146},
    }
    return {
        "id": 7,
        "name": "world_obj_apriltag_524",
        "apriltagProperties": {"tagId": tag_id, **said, **fiducial},
        "transformsSnapshot": {"childToParentEdgeMap": edges},
    }


def test_a_spot_fiducial_on_the_wall_keeps_its_place_and_changes_its_axes(tmp_path: Path) -> None:
    path = write(tmp_path / "objects.json", json.dumps({"worldObjects": [world_object()]}))
    (tag,) = import_tags(path, "spot").tags.tags
    assert (tag.id, tag.family, tag.size_m, tag.verdict) == (524, "tag36h11", 0.146, "warn")
    np.testing.assert_allclose(tag.map_from_tag.translation, [3.0, 0.0, 0.4], atol=1e-12)
    np.testing.assert_allclose(tag.map_from_tag.rotation.as_matrix(), ON_WALL.as_matrix(), atol=1e-12)


def test_spot_s_other_frames_and_spellings(tmp_path: Path) -> None:
    snake = json.loads(
        json.dumps([world_object()])
        .replace("apriltagProperties", "apriltag_properties")
        .replace("tagId", "tag_id")
        .replace("parentFrameName", "parent_frame_name")
    )
    path = write(tmp_path / "objects.json", json.dumps(snake))
    (tag,) = import_tags(path, "spot", options=ImportOptions(frame="body")).tags.tags
    np.testing.assert_allclose(tag.map_from_tag.translation, [2.0, 0.0, 0.4], atol=1e-12)
    with pytest.raises(TagError, match=r"no frame 'odom' that leads to fiducial_524; .* known: vision, body"):
        import_tags(path, "spot", options=ImportOptions(frame="odom"))


def test_a_filtered_pose_goes_first_and_a_bad_one_is_left_out(tmp_path: Path) -> None:
    good, bad = world_object(), world_object(7, fiducialPoseStatus="STATUS_AMBIGUOUS")
    edges = good["transformsSnapshot"]["childToParentEdgeMap"]
    edges["filtered_fiducial_524"] = {
        "parentFrameName": "body",
        "parentTformChild": {"position": {"x": 2.5}, "rotation": {"w": 1}},
    }
    good["apriltagProperties"] |= {
        "frameNameFiducialFiltered": "filtered_fiducial_524",
        "fiducialFilteredPoseStatus": "STATUS_OK",
    }
    found = import_tags(write(tmp_path / "o.json", json.dumps([good, bad, {"id": 1, "name": "dock"}])), "spot")
    np.testing.assert_allclose(found.tags.tags[0].map_from_tag.translation, [3.5, 0.0, 0.0], atol=1e-12)
    assert [(e.what, e.reason) for e in found.left_out] == [
        ("tag 7", "Spot calls none of its poses good (fiducial_524 STATUS_AMBIGUOUS)")
    ]


def test_a_graph_s_anchored_fiducials_need_a_size(tmp_path: Path) -> None:
    graph = {
        "waypoints": [{"id": "a"}],
        "anchoring": {"objects": [{"id": "301", "seedTformObject": {"position": {"y": 1}, "rotation": {"w": 1}}}]},
    }
    path = write(tmp_path / "graph.json", json.dumps(graph))
    with pytest.raises(TagError, match=r"graph.json: tag 301 has no size; .* --size-m"):
        import_tags(path, "spot")
    (tag,) = import_tags(path, "spot", options=ImportOptions(sizes_m={None: 0.146})).tags.tags
    # Spot's x is up in the paper: with Spot's axes along the map's, the tag's y is the map's x, its x the map's -y
    np.testing.assert_allclose(tag.map_from_tag.rotation.as_matrix(), [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-12)


def test_a_tagslam_tag_is_placed_by_its_body_with_both_noises(tmp_path: Path) -> None:
    (tag,) = import_tags(tagslam(tmp_path / "tagslam.yaml"), "tagslam").tags.tags
    assert (tag.id, tag.family, tag.size_m) == (3, "tag36h11", 0.15)
    np.testing.assert_allclose(tag.map_from_tag.translation, [1.0, 5.0, 1.5], atol=1e-9)
    # Turned by -90 deg about y the tag's x points up and its z along -x, which the body turns to -y
    np.testing.assert_allclose(
        tag.map_from_tag.rotation.as_matrix(), np.column_stack([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]), atol=1e-9
    )
    sigmas = [0.001, 0.002, 0.003, 0.01, 0.02, 0.03]
    np.testing.assert_allclose(np.sqrt(np.diag(tag.covariance)), sigmas, rtol=1e-3)


def test_tagslam_tags_without_a_pose_and_on_moving_bodies_are_left_out(tmp_path: Path) -> None:
    rig = "  - rig: {type: simple, is_static: false, tags: [{id: 9, size: 0.1}]}"
    found = import_tags(tagslam(tmp_path / "t.yaml", tag="        - id: 4\n          size: 0.1", body=rig), "tagslam")
    assert [t.id for t in found.tags.tags] == [3]
    assert [(e.what, e.reason) for e in found.left_out] == [
        ("tag 4", "it has no pose"),
        ("body rig with 1 tags", "it moves (is_static: false)"),
    ]


def test_the_noise_that_tagslam_writes_for_every_tag_is_not_believed_silently(tmp_path: Path) -> None:
    path = tagslam(tmp_path / "poses.yaml")
    text = path.read_text().replace("{x: 0.01, y: 0.02, z: 0.03}", "{x: 0.001, y: 0.001, z: 0.001}")
    path.write_text(text.replace("{x: 0.001, y: 0.002, z: 0.003}", "{x: 0.001, y: 0.001, z: 0.001}"))
    assert "TagSLAM writes that however well it knows a tag" in import_tags(path, "tagslam").warnings[0]
    stated = ImportOptions(sigma_m=0.02, sigma_deg=2.0)
    found = import_tags(path, "tagslam", options=stated)
    assert found.warnings == ()
    np.testing.assert_allclose(found.tags.tags[0].covariance, spread(math.radians(2.0), 0.02))


@pytest.mark.parametrize(("test", "expected"), [("test_22", {3}), ("test_21", {2})])
def test_tagslam_s_own_files_are_read(shared_data: Path, test: str, expected: set[int]) -> None:
    found = import_tags(shared_data / "tagslam" / test / "tagslam.yaml", "tagslam")
    assert {t.id for t in found.tags.tags} == expected


def test_a_real_building_is_read_with_the_noise_that_overrides_its_tags(shared_data: Path) -> None:
    found = import_tags(shared_data / "tagslam" / "test_11" / "tagslam.yaml", "tagslam")
    assert len(found.tags.tags) == 80
    assert [(e.what, e.reason) for e in found.left_out] == [
        ("tag 420", "it is tag 20 after a move (tag_id_remap)"),
        ("tag 520", "it is tag 20 after a move (tag_id_remap)"),
    ]
    assert {t.size_m for t in found.tags.tags} == {0.15}
    sigmas = np.sqrt([np.diag(t.covariance) for t in found.tags.tags])
    np.testing.assert_allclose(sigmas[:, :3], 0.05, rtol=1e-3)
    np.testing.assert_allclose(sigmas[:, 3:], 0.1, rtol=1e-3)


def test_an_apriltag_ros_bundle_is_read_with_its_defaults(tmp_path: Path) -> None:
    path = write(
        tmp_path / "tags.yaml",
        """
standalone_tags: [{id: 9, size: 0.05, name: far}, {id: 1, size: 0.1}]
tag_bundles:
  [{name: 'wall', layout: [{id: 1, size: 0.1}, {id: 2, size: 0.2, x: 1, y: 2.5, qw: 0, qz: 1}]}]
""",
    )
    found = import_tags(path, "apriltag_ros", options=ImportOptions(family="tag25h9", sizes_m={2: 0.25}))
    first, second = found.tags.tags
    assert pose_error(first.map_from_tag, Pose.identity()) == (0.0, 0.0)
    assert (second.family, second.size_m) == ("tag25h9", 0.25)
    assert pose_error(second.map_from_tag, yaw_pose([1.0, 2.5, 0.0], math.pi)) == pytest.approx((0, 0), abs=1e-12)
    assert [(e.what, e.reason) for e in found.left_out] == [("tag 9", "a standalone tag has no pose")]
    assert "0.01 m and 1 deg per axis are taken" in found.warnings[0]
    np.testing.assert_allclose(first.covariance, spread(math.radians(1.0), 0.01))


@pytest.mark.parametrize("format", TAG_FORMATS)
def test_tags_survive_the_way_out_and_in(tmp_path: Path, rng: np.random.Generator, format: str) -> None:
    tags = some_tags(rng)
    assert export_tags(tags, format, out=tmp_path / "out").left_out == ()
    options = ImportOptions(sizes_m={1: 0.1365, 5: 0.3} if format == "spot" else {}, map_digest=tags.map_digest)
    found = import_tags(tmp_path / "out", format, options=options).tags
    assert found.map_digest == tags.map_digest
    for before, after in zip(tags.tags, found.tags, strict=True):
        assert (after.id, after.family, after.size_m) == (before.id, before.family, before.size_m)
        assert pose_error(after.map_from_tag, before.map_from_tag) == pytest.approx((0, 0), abs=1e-7)
        if format == "tagslam":
            np.testing.assert_allclose(after.covariance, before.covariance, rtol=1e-3, atol=1e-10)
    write_tags(tmp_path / "tags.toml", found)
    assert len(read_tags(tmp_path / "tags.toml").tags) == 2


@pytest.mark.parametrize("format", TAG_FORMATS)
def test_tags_that_a_format_cannot_hold_are_named(tmp_path: Path, rng: np.random.Generator, format: str) -> None:
    first = some_tags(rng).tags[0]
    moved = TagPose(2, "tag36h11", 0.1, first.map_from_tag, first.covariance, 1, 0.1, visit="w01")
    other = TagPose(8, "tag36h10", 0.1, first.map_from_tag, first.covariance, 1, 0.1)
    left_out = export_tags(TagMap((first, moved, other), (), "map"), format, out=tmp_path / "out").left_out
    assert [e.what for e in left_out] == ["tag 2", "tag 8"]
    assert "visit w01" in left_out[0].reason
    assert "tag36h10" in left_out[1].reason
    with pytest.raises(TagError, match=r"no tag that .* can hold"):
        export_tags(TagMap((moved,), (), "map"), format, out=tmp_path / "none")
    assert not (tmp_path / "none").exists()


LAB = """
bodies:
- lab:
    is_static: true
    pose: &pose {position: {x: 1, y: 0, z: 0}, rotation: {x: 0, y: 0, z: 0}}
    tags:
    - id: 1
      size: 0.1
      pose:
        <<: *pose
        position: {%s, y: 0, z: 0}
        position_noise: &noise {x: %g, y: 0.1, z: 0.1}
        rotation_noise: *noise
"""
BUNDLE = "tag_bundles: [{name: a, layout: [{id: 1, size: 0.1%s}]}%s]\n"


@pytest.mark.parametrize(
    ("format", "text", "message"),
    [
        ("apriltag_ros", "tag_bundles: [{name", r"not valid YAML in line 1: .*; expected tags.yaml of apriltag_ros"),
        ("apriltag_ros", "tag_bundles: 3", r"Expected `array \| null`, got `int` - at `\$.tag_bundles`"),
        ("apriltag_ros", "just words", "Expected `object`, got `str`"),
        ("apriltag_ros", "standalone_tags: [{id: 1, size: 0.1}]", "no tag_bundles, so no tag has a pose"),
        ("apriltag_ros", BUNDLE % (", qw: 0", ""), r"layout\[0\] \(id 1\): .* expected a unit quaternion"),
        ("apriltag_ros", BUNDLE % (", x: .nan", ""), r"layout\[0\] \(id 1\): pose is not finite"),
        ("apriltag_ros", BUNDLE % ("}, {id: 1, size: 0.2", ""), "tag 1 is listed twice"),
        ("apriltag_ros", BUNDLE % ("", ", {name: b, layout: []}"), "2 bundles, each in a frame .* known: a, b"),
        ("apriltag_ros", "tag_bundles: [{layout: [{id: 1, size: 0}]}]", r"Expected `float` > 0.0 - at .*size`"),
        (
            "apriltag_ros",
            "tag_bundles: [{layout: [{id: 1, size: 150}]}]",
            "tag 1 has an edge of 150 m; expected metres",
        ),
        ("tagslam", LAB % ("x: .nan", 0.1), r"Expected `float` >= -1000000.0 - at .*position.x`"),
        ("tagslam", LAB % ("x: 1", 0.0), "tag 1 has no noise along some axis; expected"),
        ("tagslam", "bodies: {lab: {}}", "Expected `array`"),
        ("tagslam", "bodies: [{lab: {type: simple}}]", "missing required field `is_static` - at"),
        ("tagslam", "bodies: [{rig: {is_static: false, tags: [{id: 1}]}}]", r"no tag with a pose \(it moves"),
        ("tagslam", "other: 1", "missing required field `bodies`"),
        ("spot", "{", "not valid JSON"),
        ("spot", "[" * 100_000, "not valid JSON"),
        ("apriltag_ros", "tag_bundles: " + "[" * 2000, "not valid YAML"),
        ("spot", "{}", "no world_objects and no anchoring; expected JSON of Spot"),
        ("spot", '{"waypoints": [], "anchoring": {}}', r"no tag with a pose \(it lists none\)"),
        ("spot", '[{"apriltagProperties": {"tagId": "x"}}]', r"Expected `int`, got `str` - at .*tag_id`"),
        ("spot", '{"objects": [{"id": "1", "seedTformObject": {}}]}', "object 1: .* expected a unit quaternion"),
    ],
)
def test_a_file_that_cannot_be_used_is_named_in_one_line(tmp_path: Path, format: str, text: str, message: str) -> None:
    path = write(tmp_path / "tags.in", text)
    with pytest.raises(FieldkitError, match=message) as error:
        import_tags(path, format)
    assert str(error.value).startswith(f"{path}: ")
    assert error.value.hint or "expected" in error.value.message


def test_a_missing_or_binary_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "graph").write_bytes(b"\x0a\xff\xfe\x00")
    for format in TAG_FORMATS:
        with pytest.raises(StoreError, match=r"none: no such file; expected"):
            import_tags(tmp_path / "none", format)
        with pytest.raises(StoreError, match=r"graph: cannot be read as text; expected"):
            import_tags(tmp_path / "graph", format)


def test_options_without_sense_are_refused(tmp_path: Path) -> None:
    path = tagslam(tmp_path / "t.yaml")
    with pytest.raises(TagError, match="sigma_m is -1"):
        ImportOptions(sigma_m=-1.0)
    with pytest.raises(TagError, match="unknown tag family 'tag36h12'; did you mean 'tag36h11'"):
        import_tags(path, "tagslam", options=ImportOptions(family="tag36h12"))
    with pytest.raises(TagError, match="no body 'lap'; did you mean 'lab'"):
        import_tags(path, "tagslam", options=ImportOptions(frame="lap"))
    with pytest.raises(TagError, match="unknown tag file format 'spott'; did you mean 'spot'"):
        import_tags(path, "spott")


def test_the_commands_convert_between_tools(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = tagslam(tmp_path / "tagslam.yaml")
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["tags", "import", str(source), "--from", "tagslam", "--out", str(tmp_path / "tags.toml"), "--json"])
    said = json.loads(capsys.readouterr().out)
    assert [t["id"] for t in said["tags"]] == [3]
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["tags", "export", str(tmp_path / "tags.toml"), "--to", "spot", "--out", str(tmp_path / "spot.json")])
    (tag,) = import_tags(tmp_path / "spot.json", "spot", options=ImportOptions(sizes_m={None: 0.15})).tags.tags
    assert pose_error(tag.map_from_tag, read_tags(tmp_path / "tags.toml").tags[0].map_from_tag) == pytest.approx(
        (0, 0), abs=1e-9
    )


def test_a_refused_import_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = write(tmp_path / "tags.yaml", "bodies: []")
    with pytest.raises(SystemExit, match=r"^1$"):
        main(["tags", "import", str(source), "--from", "tagslam", "--out", str(tmp_path / "tags.toml")])
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["tags.yaml"]
