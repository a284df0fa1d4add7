"""Surfaces: depth images of known shapes, PLY round trips, and rays."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from fieldkit.cameras import Camera
from fieldkit.errors import SurfaceError
from fieldkit.frames import Pose, pose
from fieldkit.surface import RayCaster, coarsen, fuse_depth, read_ply, write_ply
from fieldkit.types import Surface

PINHOLE = Camera("PINHOLE", 160, 120, (120.0, 120.0, 80.0, 60.0))
DISTORTED = Camera("OPENCV", 160, 120, (120.0, 121.0, 79.0, 61.0, -0.1, 0.02, 0.001, -0.001))
RADIUS, DISTANCE = 0.5, 2.0


def sphere_depth(camera: Camera) -> np.ndarray:
    """Render z-depth in mm of a sphere of radius 0.5 m, 2 m in front, on nothing."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = camera.unproject(np.column_stack([u.ravel(), v.ravel()]))
    a, b, c = (rays**2).sum(axis=1), -2 * DISTANCE * rays[:, 2], DISTANCE**2 - RADIUS**2
    inside = b**2 - 4 * a * c
    z = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / (2 * a), 0.0)
    return np.rint(1000 * z).astype(np.uint16).reshape(camera.height, camera.width)


def around(n: int) -> list[Pose]:
    """Poses of cameras on a circle around the origin, all looking at it (map_from_cam)."""
    poses = []
    for angle in np.linspace(0, 2 * np.pi, n, endpoint=False):
        eye = DISTANCE * np.array([np.cos(angle), np.sin(angle), 0.0])
        forward, down = -eye / DISTANCE, np.array([0.0, 0.0, -1.0])
        rotation = np.column_stack([np.cross(down, forward), down, forward])
        poses.append(Pose.from_matrix(np.vstack([np.column_stack([rotation, eye]), [0, 0, 0, 1]])))
    return poses


@pytest.mark.parametrize("camera", [PINHOLE, DISTORTED])
def test_depth_images_of_a_sphere_become_that_sphere(camera: Camera) -> None:
    depth = sphere_depth(camera)
    surface = fuse_depth([(p, lambda: depth) for p in around(8)], camera, voxel_m=0.04)
    radius = np.linalg.norm(surface.vertices, axis=1)
    middle = np.abs(surface.vertices[:, 2]) < 0.3
    assert middle.sum() > 500
    assert abs(float(np.median(radius[middle])) - RADIUS) < 0.004
    assert float(np.percentile(np.abs(radius[middle] - RADIUS), 95)) < 0.03
    assert surface.voxel_m == 0.04


def test_turning_all_cameras_turns_the_surface(rng: np.random.Generator) -> None:
    depth = sphere_depth(PINHOLE)
    turn = pose([3.0, -1.0, 0.5], [0.1, -0.2, 0.3, 0.927])
    surface = fuse_depth([(turn * p, lambda: depth) for p in around(8)], PINHOLE)
    radius = np.linalg.norm(turn.inv().apply(surface.vertices), axis=1)
    assert abs(float(np.median(radius)) - RADIUS) < 0.01


def test_depth_without_values_is_an_error() -> None:
    empty = np.zeros((120, 160), dtype=np.uint16)
    with pytest.raises(SurfaceError, match="no depth image has a valid depth"):
        fuse_depth([(Pose.identity(), lambda: empty)], PINHOLE)


def test_a_volume_that_would_not_fit_is_refused_before_it_is_made() -> None:
    depth = sphere_depth(PINHOLE)
    far = pose([1e4, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
    with pytest.raises(SurfaceError, match="too many voxels"):
        fuse_depth([(Pose.identity(), lambda: depth), (far, lambda: depth)], PINHOLE)


def wall(x_m: float) -> Surface:
    corners = np.array([[x_m, -2, -2], [x_m, 2, -2], [x_m, 2, 2], [x_m, -2, 2]], dtype=np.float64)
    return Surface(corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32), 0.04)


def test_ply_files_come_back_as_they_were(tmp_path: Path) -> None:
    surface = dataclasses.replace(wall(1.25), voxel_m=0.03)
    write_ply(tmp_path / "wall.ply", surface)
    again = read_ply(tmp_path / "wall.ply")
    np.testing.assert_array_equal(again.vertices, surface.vertices)
    np.testing.assert_array_equal(again.faces, surface.faces)
    assert again.voxel_m == 0.03


def test_ply_files_of_others_are_read(tmp_path: Path) -> None:
    import trimesh

    surface = wall(1.25)
    for encoding in ("ascii", "binary"):
        trimesh.Trimesh(surface.vertices, surface.faces, process=False).export(tmp_path / "wall.ply", encoding=encoding)
        again = read_ply(tmp_path / "wall.ply")
        np.testing.assert_allclose(again.vertices, surface.vertices)
        np.testing.assert_array_equal(again.faces, surface.faces)


def test_a_file_that_is_no_mesh_is_named(tmp_path: Path) -> None:
    (tmp_path / "broken.ply").write_bytes(b"ply\nformat nonsense\n")
    for name in ("broken.ply", "missing.ply"):
        with pytest.raises(SurfaceError, match=name):
            read_ply(tmp_path / name)


def test_a_wall_hides_what_lies_behind_it_and_nothing_else() -> None:
    caster = RayCaster(wall(1.0))
    targets = np.array([[0.9, 0, 0], [1.05, 0, 0], [1.5, 0, 0], [1.5, 5, 0], [-1, 0, 0]])
    seen = caster.visible([0.0, 0.0, 0.0], targets, tolerance_m=0.08)
    np.testing.assert_array_equal(seen, [True, True, False, True, True])
    strict = caster.visible(np.zeros((5, 3)), targets, tolerance_m=0.0)
    np.testing.assert_array_equal(strict, [True, False, False, True, True])


def test_rays_measure_the_distance_to_the_first_triangle() -> None:
    caster = RayCaster(wall(1.0))
    directions = np.array([[1.0, 0, 0], [-1.0, 0, 0], [np.sqrt(0.5), np.sqrt(0.5), 0]])
    distance = caster.hit_distance(np.zeros((3, 3)), directions)
    np.testing.assert_allclose(distance, [1.0, np.inf, np.sqrt(2)], rtol=1e-6)


def test_coarsening_keeps_the_shape_with_fewer_triangles() -> None:
    depth = sphere_depth(PINHOLE)
    fine = fuse_depth([(p, lambda: depth) for p in around(8)], PINHOLE)
    coarse = coarsen(fine, voxel_m=0.12)
    assert len(coarse.faces) < 0.3 * len(fine.faces)
    assert coarse.voxel_m == 0.12
    assert abs(float(np.median(np.linalg.norm(coarse.vertices, axis=1))) - RADIUS) < 0.02
    hidden = RayCaster(coarse).visible([2.0, 0, 0], np.array([[0.0, 0, 0], [-2.0, 0, 0]]), tolerance_m=0.1)
    assert not hidden.any()
