"""Meshes of one's own: where their floor is, and what a robot and a walk find on it."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
import trimesh
from mesh_files import LENGTH_M, WIDTH_M, block, coloured, hall, painted, saved, shell, table

from sim_bridge.errors import SynthesisError
from sim_bridge.importing import MeshOptions, import_scene
from sim_bridge.stage import staging, tours


@pytest.fixture
def room(tmp_path: Path) -> Path:
    return saved(tmp_path / "room.glb", [*painted(shell()), table()])


def test_free_floor_is_where_nothing_stands(room: Path) -> None:
    scene = import_scene(room)
    spots = [(1.5, 2.5), (4.5, 2.5), (0.2, 2.5), (3.5, 0.5), (8.0, 2.5), (3.7, 2.5)]
    assert scene.free_floor(spots, 0.36).tolist() == [True, False, False, True, False, False]
    assert scene.free_floor([(1.5, 2.5)], 1.3).all()
    assert not scene.free_floor([(1.5, 2.5)], 1.7).any()


def test_a_tour_of_a_mesh_stays_on_its_floor(room: Path) -> None:
    scene = import_scene(room)
    loop = tours.tour(scene)
    assert scene.free_floor(loop, 0.3).all()
    assert loop[:, 0].max() - loop[:, 0].min() > 2.0


def test_the_largest_floor_lies_at_zero(tmp_path: Path) -> None:
    lower = painted(shell())
    upper = painted(shell(3.0, 2.0))
    for part in lower:
        part.apply_translation((0.0, 0.0, -3.2))
    for part in upper:
        part.apply_translation((0.0, 0.0, 0.1))
    scene = import_scene(saved(tmp_path / "two.glb", lower + upper))
    assert scene.bounds[0, 2] == pytest.approx(0.0, abs=1e-6)
    assert scene.free_floor([(5.0, 4.0)], 0.36).all()


def test_the_start_tag_hangs_on_the_rough_wall_of_a_scan(tmp_path: Path, rng: np.random.Generator) -> None:
    scan = trimesh.util.concatenate(coloured(shell(), (120, 140, 90)))
    scan = scan.subdivide_to_size(0.15)
    scan.vertices += rng.normal(0.0, 0.0015, scan.vertices.shape)
    scan.visual = trimesh.visual.ColorVisuals(scan, vertex_colors=rng.integers(0, 255, (len(scan.vertices), 3)))
    scan.export(tmp_path / "scan.ply")
    scene = import_scene(tmp_path / "scan.ply")
    stage = staging.set_stage(scene, staging.StageOptions(waypoints=0, start_places=1), rng=rng)
    x, y, _ = stage.start_tag.world_from_tag.translation
    assert 0.005 < min(x, y, LENGTH_M - x, WIDTH_M - y) < 0.025
    normal = stage.start_tag.world_from_tag.rotation.apply([0.0, 0.0, 1.0])
    assert max(np.abs(normal)) > np.cos(np.radians(2.0))
    in_front = stage.start_tag.world_from_tag.apply([0.0, 0.0, 0.005])
    half = 0.06
    corners = [[u, v, 0.003] for u in (-half, half) for v in (-half, half)]
    rays = stage.start_tag.world_from_tag.apply(corners) - in_front
    assert (scene.intersect(in_front, rays) > np.linalg.norm(rays, axis=1)).all()


def test_a_mesh_far_from_zero_is_moved_there(tmp_path: Path) -> None:
    parts = painted(shell())
    for part in parts:
        part.apply_translation((250_000.0, -4_000_000.0, 312.0))
    scene = import_scene(saved(tmp_path / "grid.obj", parts))
    assert np.abs(scene.bounds).max() < 10.0
    assert scene.bounds[0, 2] == pytest.approx(0.0, abs=1e-3)
    assert 15.0 < 25.0 * scene.free_floor(np.random.default_rng(0).uniform(-2.5, 2.5, (500, 2)), 0.2).mean() <= 25.0


def test_a_floor_narrower_than_the_robot_is_refused(tmp_path: Path) -> None:
    path = saved(tmp_path / "gap.glb", painted(shell(6.0, 0.6)))
    with pytest.raises(
        SynthesisError, match=r"gap.glb: no free floor above the robot's width .*expected 1 m2 .*0.36 m"
    ):
        import_scene(path, MeshOptions(up="z"))


def poles() -> list[trimesh.Trimesh]:
    places = [(x, y) for x in np.arange(0.2, 4.0, 0.45) for y in np.arange(0.2, 3.0, 0.45)]
    return [block((x, y, 0.0), (x + 0.05, y + 0.05, 2.0)) for x, y in places]


@pytest.mark.parametrize(
    "parts",
    [
        [hall(4.0, 3.0, 2.6), *poles()],
        [hall(6.0, 5.0, 1.6)],
        [hall(6.0, 5.0, 2.6), block((0.0, 0.0, 0.0), (6.0, 2.2, 2.6)), block((0.0, 2.8, 0.0), (6.0, 5.0, 2.6))],
    ],
    ids=["poles", "low", "narrow"],
)
def test_neither_a_roof_nor_the_hollow_of_a_solid_is_floor(tmp_path: Path, parts: list[trimesh.Trimesh]) -> None:
    path = saved(tmp_path / "room.ply", parts)
    with pytest.raises(SynthesisError, match=r"room.ply: no free floor above the robot's width") as error:
        import_scene(path)
    assert "\n" not in str(error.value)


def test_the_ground_around_a_house_that_is_full_is_floor(tmp_path: Path) -> None:
    house = [hall(4.0, 3.0, 2.6), *poles()]
    ground = block((-4.0, -4.0, -0.2), (8.0, 7.0, 0.0))
    scene = import_scene(saved(tmp_path / "house.ply", [*house, ground]))
    assert scene.free_floor([(-2.0, 1.0)], 0.36).all()
    assert not scene.free_floor([(2.0, 1.5)], 0.2).any()


def test_a_room_whose_faces_all_look_out_is_a_room(tmp_path: Path) -> None:
    scene = import_scene(saved(tmp_path / "room.ply", [block((0.0, 0.0, 0.0), (6.0, 5.0, 2.6))]))
    assert scene.bounds[0, 2] == pytest.approx(0.0, abs=1e-6)
    assert scene.free_floor([(3.0, 2.5)], 1.5).all()


@pytest.mark.parametrize("thick_m", [0.06, 0.2, 0.28])
def test_the_floor_is_the_top_of_a_slab_not_its_underside(tmp_path: Path, thick_m: float) -> None:
    slab = block((0.0, 0.0, -thick_m), (LENGTH_M, WIDTH_M, 0.0))
    scene = import_scene(saved(tmp_path / "slab.ply", [slab, *shell()[1:]]))
    assert scene.bounds[0, 2] == pytest.approx(-thick_m, abs=1e-6)
    assert scene.free_floor([(3.0, 2.5)], 0.36).all()


def test_a_long_narrow_corridor_is_taken_with_z_up(tmp_path: Path) -> None:
    scene = import_scene(saved(tmp_path / "corridor.ply", [hall(20.0, 2.0, 2.6)]))
    assert np.allclose(scene.bounds[1], [20.0, 2.0, 2.6])


def test_a_mesh_without_walls_is_told_what_helps(tmp_path: Path, rng: np.random.Generator) -> None:
    scene = import_scene(saved(tmp_path / "lawn.ply", [block((0.0, 0.0, 0.0), (6.0, 6.0, 0.02))]))
    with pytest.raises(SynthesisError, match=r"no bare wall .*; use another seed, or in a mesh of your own"):
        staging.set_stage(scene, staging.StageOptions(waypoints=0, start_places=1), rng=rng)


def test_a_foreign_house_is_read_with_its_floor(shared_data: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        scene = import_scene(shared_data / "small_house" / "small_house.glb")
    assert "no texture for 3 of 108 parts" in caplog.text
    assert np.allclose(np.ptp(scene.bounds, axis=0), [19.0, 11.4, 3.0], atol=0.01)
    graph, _ = tours.walkable(scene)
    assert 70.0 < 0.01 * len(graph.centres) < 150.0
    assert 150.0 < tours.shown_area_m2(scene, graph) < 217.0
    free = graph.centres[:: len(graph.centres) // 200]
    below = scene.intersect(np.column_stack([free, np.full(len(free), 1.7)]), [0.0, 0.0, -1.0])
    assert np.abs(below - 1.7).max() < 0.06
