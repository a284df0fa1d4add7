"""Scenes as view sources: places to look around, keys that follow what matters, images that depend on nothing else."""

from __future__ import annotations

import dataclasses
import pickle
from pathlib import Path

import msgspec
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from fieldkit.errors import FieldkitError
from fieldkit.frames import log, pose_error
from fieldkit.judge import nearest_distance
from fieldkit.maps import MapOptions, build_map, load_map
from fieldkit.maps.gauge import fit_gauge
from fieldkit.maps.sources.source import read_source
from fieldkit.types import Surface
from sim_bridge.cli import main
from sim_bridge.dataset import DatasetOptions, MeshSource, SceneOptions, SceneSource, make_scenes
from sim_bridge.errors import SynthesisError
from sim_bridge.importing import MeshOptions
from sim_bridge.mapping.mapper import WalkOptions
from sim_bridge.mesh import Scene
from sim_bridge.robot import ARM_CAMERA, STOWED
from sim_bridge.scenes import make_scene
from sim_bridge.sensors import IDEAL, STANDARD
from sim_bridge.stage.lookouts import Lookout, LookoutOptions, find_lookouts

OPTIONS = SceneOptions(lookouts=LookoutOptions(count=8, views=20))
CALM = dataclasses.replace(OPTIONS, changes=None)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene("room", 0)


@pytest.fixture(scope="module")
def lookouts(scene: Scene) -> tuple[Lookout, ...]:
    return find_lookouts(scene, OPTIONS.lookouts, rng=np.random.default_rng(0))


@pytest.fixture(scope="module")
def source() -> SceneSource:
    return SceneSource("room", OPTIONS)


def angles(lookout: Lookout) -> np.ndarray:
    """Return yaw about the body and pitch of the sweep's arms (n, 2) in deg."""
    arms = [arm for _, kind, arm in lookout.arms if kind == "sweep"]
    return np.degrees([(arm.sh0, arm.pitch_rad) for arm in arms])


def test_places_are_free_and_spread_over_the_floor(scene: Scene, lookouts: tuple[Lookout, ...]) -> None:
    radius = OPTIONS.lookouts.stand_radius_m
    places = np.array([one.world_from_body.translation[:2] for one in lookouts])
    assert scene.free_floor(places, radius).all()
    gaps = np.linalg.norm(places[:, None] - places[None], axis=2) + 99 * np.eye(len(places))
    x0, y0, x1, y1 = scene.floor_bounds
    grid = np.stack(np.meshgrid(np.arange(x0, x1, 0.2), np.arange(y0, y1, 0.2)), axis=-1).reshape(-1, 2)
    floor = grid[scene.free_floor(grid, radius)]
    farthest = np.linalg.norm(floor[:, None] - places[None], axis=2).min(axis=1).max()
    assert gaps.min() > 0.2
    assert farthest < 2.5 * np.sqrt(len(floor) * 0.04 / len(places))


def test_a_sweep_hits_every_stratum_of_yaw_and_of_pitch_once(lookouts: tuple[Lookout, ...]) -> None:
    low, high = OPTIONS.lookouts.pitch_deg
    for one in lookouts:
        yaw, pitch = angles(one).T
        count = OPTIONS.lookouts.views
        assert sorted(np.floor(yaw % 360.0 / 360.0 * count)) == list(range(count))
        assert sorted(np.floor((pitch - low) / (high - low) * count)) == list(range(count))


def test_the_round_trip_visits_all_and_forward_looks_towards_the_next(lookouts: tuple[Lookout, ...]) -> None:
    following = {one.id: one.next for one in lookouts}
    at, seen = lookouts[0].id, []
    while at not in seen:
        seen.append(at)
        at = following[at]
    assert sorted(seen) == sorted(following)
    place = {one.id: one.world_from_body.translation for one in lookouts}
    turned = []
    for one in lookouts:
        names = {name: (kind, arm) for name, kind, arm in one.arms}
        assert names["stowed"] == ("stowed", STOWED)
        assert names["forward"][1].pitch_rad == pytest.approx(0.0, abs=1e-9)
        way = one.world_from_body.inv().rotation.apply(place[one.next] - place[one.id])
        turned.append(abs(np.angle(np.exp(1j * (np.arctan2(way[1], way[0]) - names["forward"][1].sh0)))))
    assert np.median(turned) < np.radians(45.0)


def test_too_many_places_are_refused(scene: Scene) -> None:
    options = dataclasses.replace(OPTIONS.lookouts, count=9000)
    with pytest.raises(SynthesisError, match=r"can stand; expected at least 9000; ask for fewer waypoints"):
        find_lookouts(scene, options, rng=np.random.default_rng(0))


def test_a_region_without_room_for_the_arm_gives_its_place_to_another_one() -> None:
    source = SceneSource("laboratory", dataclasses.replace(OPTIONS, lookouts=LookoutOptions(count=100, views=2)))
    at = np.array([w.world_from_body.translation for w in source.waypoints()])
    assert len(at) == 100
    assert cKDTree(at).query(at, k=2)[0][:, 1].min() > 0.05


def test_priors_err_as_their_covariance_says_and_kinematics_are_not_quite_the_truth() -> None:
    many = SceneSource("room", dataclasses.replace(CALM, lookouts=LookoutOptions(count=40, views=1)))
    squares = []
    for waypoint in many.waypoints():
        error = log(waypoint.world_from_prior.inv() * waypoint.world_from_body)
        squares.append(float(error @ np.linalg.solve(waypoint.prior_covariance, error)))
        for view in waypoint.views:
            position, rotation = pose_error(waypoint.world_from_body * view.body_from_cam, view.world_from_cam)
            assert 1e-6 < position < 0.02
            assert 1e-6 < rotation < np.radians(1.0)
    assert 4.0 < np.mean(squares) < 8.5


def test_the_robot_s_options_change_the_views_key_only(source: SceneSource) -> None:
    other_hand = msgspec.structs.replace(STANDARD, hand=IDEAL.hand)
    for options in (dataclasses.replace(OPTIONS, sensors=other_hand), CALM):
        other = SceneSource("room", options)
        assert other.mapping_key == source.mapping_key
        assert other.views_key != source.views_key


def test_the_walk_and_the_mapping_s_sensors_change_the_mapping_key(source: SceneSource) -> None:
    other_rig = msgspec.structs.replace(STANDARD, mapping=IDEAL.mapping)
    for changes in ({"walk": WalkOptions(height_m=1.7)}, {"sensors": other_rig}):
        other = SceneSource("room", dataclasses.replace(OPTIONS, **changes))
        assert other.mapping_key != source.mapping_key


def test_an_image_depends_on_view_and_repeat_not_on_what_was_shot_before(source: SceneSource) -> None:
    waypoints = source.waypoints()
    fresh = pickle.loads(pickle.dumps(source))
    assert "_scene" not in vars(fresh)
    first, last = waypoints[0], waypoints[-1]
    image = source.shoot(last, last.views[3])
    assert image.shape == (ARM_CAMERA.height, ARM_CAMERA.width, 3)
    source.shoot(first, first.views[0])
    assert np.array_equal(source.shoot(last, last.views[3]), image)
    assert np.array_equal(fresh.shoot(last, last.views[3]), image)
    assert not np.array_equal(source.shoot(last, last.views[3], repeat=1), image)
    assert (fresh.mapping_key, fresh.views_key) == (source.mapping_key, source.views_key)


def test_the_mapping_is_a_source_of_map_build(tmp_path: Path) -> None:
    short = SceneSource("room", dataclasses.replace(OPTIONS, walk=WalkOptions(stations=2)))
    true = short.write_mapping(tmp_path)
    walk = read_source(tmp_path)
    assert sorted(true) == sorted(image.name for image in walk.images)
    assert len(walk.depth) == 2


def test_a_map_of_rendered_images_lies_on_the_true_surface(tmp_path: Path) -> None:
    some = SceneSource("room", dataclasses.replace(CALM, walk=WalkOptions(stations=16, laps=0.35)))
    true = some.write_mapping(tmp_path / "mapping")
    build_map(tmp_path / "mapping", tmp_path / "room.map", options=MapOptions(max_keypoints=800))
    room_map = load_map(tmp_path / "room.map")
    gauge = fit_gauge(room_map, true)
    assert gauge.rms_m < 0.01
    scene = some._mapped()
    landmarks = gauge.world_from_map.apply(room_map.xyz)
    distance = nearest_distance(Surface(scene.vertices, scene.faces, 0.0), landmarks, rng=np.random.default_rng(0))
    assert len(distance) > 1000
    assert np.median(distance) < 0.01


def test_a_mesh_is_a_source_whose_keys_follow_its_content(tmp_path: Path) -> None:
    keys = []
    for shade in (90, 140, 90):
        hall = trimesh.creation.box((6.0, 5.0, 2.8))
        hall.visual.face_colors = (shade, 120, 160, 255)
        hall.export(tmp_path / "hall.ply")
        source = MeshSource("hall", CALM, str(tmp_path / "hall.ply"), MeshOptions())
        keys.append((source.mapping_key, source.views_key))
    assert keys[0] == keys[2]
    assert not set(keys[0]) & set(keys[1])
    fresh = pickle.loads(pickle.dumps(source))
    assert "_scene" not in vars(fresh)
    waypoints = fresh.waypoints()
    assert len(waypoints) == OPTIONS.lookouts.count
    shot = fresh.shoot(waypoints[0], waypoints[0].views[0])
    assert np.array_equal(source.shoot(waypoints[0], waypoints[0].views[0]), shot)
    # Walls in the mesh's own colour, whatever the exposure makes of it.
    assert shot[..., 2].mean() > shot[..., 0].mean() + 15


@pytest.mark.parametrize(
    ("scenes", "options", "message"),
    [
        (["rom"], DatasetOptions(), r"unknown scene 'rom'; did you mean 'room'\?"),
        (["room"], DatasetOptions(waypoints=0), r"--waypoints 0: expected 1\.\.9999"),
        (["room"], DatasetOptions(sensors="idle"), r"unknown sensors 'idle'; did you mean 'ideal'\?"),
        (["room"], DatasetOptions(changes="some"), r"unknown changes 'some'"),
        (["room"], DatasetOptions(repeat_share=0.0), r"--repeat-share 0: expected more than 0"),
        (["room"], DatasetOptions(feature="alikd"), r"unknown feature 'alikd'; did you mean 'aliked'\?"),
        (["room", "room"], DatasetOptions(), r"scenes are room, room; expected each once"),
        (["gone.glb"], DatasetOptions(), r"gone.glb: no such file; expected a mesh"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    scenes: list[str], options: DatasetOptions, message: str, tmp_path: Path
) -> None:
    with pytest.raises(FieldkitError, match=message):
        make_scenes(scenes, tmp_path / "set", options=options)
    assert not list(tmp_path.iterdir())


def test_a_scene_without_room_or_a_mesh_that_cannot_be_read_leaves_nothing(tmp_path: Path) -> None:
    hall = trimesh.creation.box((6.0, 5.0, 2.8))
    hall.vertices[0] = np.nan
    hall.export(tmp_path / "nan.ply")
    out = tmp_path / "set"
    with pytest.raises(FieldkitError, match=r"nan: .*nan\.ply"):
        make_scenes(["room", str(tmp_path / "nan.ply")], out, options=DatasetOptions(waypoints=2, views=2))
    with pytest.raises(FieldkitError, match=r"room: .*ask for fewer waypoints"):
        make_scenes(["room"], out, options=DatasetOptions(waypoints=9000))
    assert not out.exists()


def test_the_command_says_a_mistake_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["dataset", "--scenes", "rom", "--out", str(tmp_path / "set")])
    assert stop.value.code == 1
    assert capsys.readouterr().err.count("\n") == 1
