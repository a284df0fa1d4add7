"""A foreign mesh with its transform becomes the surface of an imported map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from hloc_model import by_hloc, observed_room, write_hloc
from scipy.spatial.transform import Rotation

from fieldkit.errors import FieldkitError, MapError
from fieldkit.maps import (
    ForeignMesh,
    import_map,
    load_map,
)
from fieldkit.types import SceneMap


@pytest.fixture(scope="module")
def scene_map() -> SceneMap:
    """Landmarks of a room that at least two images see."""
    return observed_room()


@pytest.fixture(scope="module")
def model(scene_map: SceneMap, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """hloc's files of the map in another scale and frame: sfm/, features.h5, and poses.txt in the map's."""
    return write_hloc(tmp_path_factory.mktemp("hloc"), scene_map)


def room_mesh(scale: float = 1.0) -> trimesh.Trimesh:
    box = trimesh.creation.box((6.0, 4.0, 2.5), trimesh.transformations.translation_matrix((0, 0, 1.25)))
    box = box.subdivide().subdivide()
    return trimesh.Trimesh(box.vertices * scale, box.faces, process=False)


@pytest.mark.parametrize("ending", ["ply", "obj", "glb", "stl"])
def test_a_foreign_mesh_becomes_the_surface(model: Path, tmp_path: Path, ending: str) -> None:
    room_mesh().export(tmp_path / f"room.{ending}")
    mesh = ForeignMesh(tmp_path / f"room.{ending}", voxel_m=0.05)
    report = import_map(model, tmp_path / "lab.map", options=by_hloc(model, mesh=mesh))
    surface = load_map(tmp_path / "lab.map").surface
    assert surface is not None
    assert surface.voxel_m == pytest.approx(0.05)
    np.testing.assert_allclose(np.ptp(surface.vertices, axis=0), [6.0, 4.0, 2.5], atol=1e-5)
    assert any("landmarks lie 0.0 cm off it" in w for w in report.warnings)


def test_a_mesh_is_moved_by_its_transform_unit_and_axis(model: Path, tmp_path: Path) -> None:
    map_from_mesh = np.eye(4)
    map_from_mesh[:3, :3] = 0.5 * Rotation.from_euler("z", 30, degrees=True).as_matrix()
    map_from_mesh[:3, 3] = (1.0, 2.0, 3.0)
    back = np.linalg.inv(map_from_mesh)
    mesh = room_mesh()
    points = mesh.vertices @ back[:3, :3].T + back[:3, 3]
    y_up_mm = 1000 * points[:, [0, 2, 1]] * (1, 1, -1)
    trimesh.Trimesh(y_up_mm, mesh.faces, process=False).export(tmp_path / "room.ply")
    np.savetxt(tmp_path / "T.txt", map_from_mesh)
    foreign = ForeignMesh(tmp_path / "room.ply", tmp_path / "T.txt", unit="mm", up="y")
    import_map(model, tmp_path / "lab.map", options=by_hloc(model, mesh=foreign))
    surface = load_map(tmp_path / "lab.map").surface
    assert surface is not None
    np.testing.assert_allclose(surface.vertices, mesh.vertices, atol=1e-4)


def test_a_mesh_in_another_unit_is_refused_with_the_one_that_fits(model: Path, tmp_path: Path) -> None:
    room_mesh(1000.0).export(tmp_path / "room.ply")
    with pytest.raises(MapError, match=r"off its surface; .* it fits with --mesh-unit mm --mesh-up z"):
        import_map(model, tmp_path / "lab.map", options=by_hloc(model, mesh=ForeignMesh(tmp_path / "room.ply")))
    (tmp_path / "T.txt").write_text("50 0 0 0 0 0 1\n")
    there = ForeignMesh(tmp_path / "room.ply", tmp_path / "T.txt", unit="mm")
    with pytest.raises(MapError, match="give --mesh-transform with map_from_mesh"):
        import_map(model, tmp_path / "lab.map", options=by_hloc(model, mesh=there))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3", "3 numbers; expected the 16 numbers"),
        ("1 0 0 0  0 1 0 0  0 0 -1 0  0 0 0 1", "no rotation times a scale"),
        ("1 0 0 0  0 2 0 0  0 0 1 0  0 0 0 1", "no rotation times a scale"),
        ("1 0 0 0  0 1 0 0  0 0 1 0  1 2 3 1", "expected the 16 numbers"),
        ("a b c d e f g", "could not convert"),
    ],
)
def test_a_transform_that_is_none_is_named(model: Path, tmp_path: Path, text: str, message: str) -> None:
    room_mesh().export(tmp_path / "room.ply")
    (tmp_path / "T.txt").write_text(text)
    mesh = ForeignMesh(tmp_path / "room.ply", tmp_path / "T.txt")
    with pytest.raises(MapError, match=message):
        import_map(model, tmp_path / "lab.map", options=by_hloc(model, mesh=mesh))


@pytest.mark.parametrize("ending", ["ply", "obj"])
def test_a_cloud_of_points_is_no_surface(model: Path, tmp_path: Path, ending: str) -> None:
    trimesh.PointCloud(np.random.default_rng(0).random((50, 3))).export(tmp_path / f"cloud.{ending}")
    with pytest.raises(FieldkitError, match=r"has no triangles"):
        import_map(model, tmp_path / "lab.map", options=by_hloc(model, mesh=ForeignMesh(tmp_path / f"cloud.{ending}")))
    assert not (tmp_path / "lab.map").exists()
