"""The furnished room: repeatable, walkable, cluttered at the robot's height, rich and poor walls."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fieldkit.cameras import Camera
from fieldkit.frames import Pose, yaw_pose
from sim_bridge.mesh import Scene
from sim_bridge.rendering import render
from sim_bridge.scenes import make_scene

SEEDS = (0, 1)


@pytest.fixture(scope="module")
def rooms() -> dict[int, Scene]:
    return {seed: make_scene("room", seed) for seed in SEEDS}


def along(scene: Scene, *, step_m: float = 0.05) -> np.ndarray:
    """Return points f64[n,2] along the closed walk."""
    ends = np.roll(scene.walk_xy, -1, axis=0)
    pieces = []
    for start, end in zip(scene.walk_xy, ends, strict=True):
        count = max(2, int(np.linalg.norm(end - start) / step_m))
        pieces.append(start + np.linspace(0, 1, count)[:, None] * (end - start))
    return np.concatenate(pieces)


def test_the_same_seed_gives_the_same_scene_and_another_seed_another(rooms: dict[int, Scene]) -> None:
    again = make_scene("room", 0)
    for name in ("vertices", "faces", "uv", "texture", "shade", "blocks", "walk_xy", "closed"):
        assert np.array_equal(getattr(again, name), getattr(rooms[0], name)), name
    assert all(np.array_equal(a, b) for a, b in zip(again.textures, rooms[0].textures, strict=True))
    assert not np.array_equal(rooms[0].blocks, rooms[1].blocks)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_strip_of_90_cm_along_the_walk_is_free(rooms: dict[int, Scene], seed: int) -> None:
    assert rooms[seed].free_floor(along(rooms[seed]), 0.45).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_nothing_stands_on_floor_that_counts_as_free(rooms: dict[int, Scene], seed: int) -> None:
    scene = rooms[seed]
    x0, y0, x1, y1 = scene.floor_bounds
    spots = np.random.default_rng(seed).uniform([x0, y0], [x1, y1], (4000, 2))
    free = scene.free_floor(spots, 0.05)

    def height(top_m: float) -> np.ndarray:
        start = np.column_stack([spots, np.full(len(spots), top_m)])
        return top_m - scene.intersect(start, [0.0, 0.0, -1.0])

    # Door handles and pictures hang above a robot's body.
    assert height(1.0)[free].max() < 0.02
    assert (height(2.4)[~free] > 0.1).mean() > 0.6


def test_the_room_lies_where_its_bounds_say(rooms: dict[int, Scene]) -> None:
    assert np.allclose(rooms[0].bounds, [[0, 0, 0], [9, 7, 3]], atol=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
def test_furniture_hides_much_at_robot_height_and_little_below_the_ceiling(rooms: dict[int, Scene], seed: int) -> None:
    rng = np.random.default_rng(seed)
    path = along(rooms[seed])
    pairs = path[rng.integers(0, len(path), (3000, 2))]
    delta = pairs[:, 1] - pairs[:, 0]
    far = np.linalg.norm(delta, axis=1) > 1.5

    def hidden(height_m: float) -> float:
        start = np.column_stack([pairs[far, 0], np.full(far.sum(), height_m)])
        way = np.column_stack([delta[far], np.zeros(far.sum())])
        return float((rooms[seed].intersect(start, way) < np.linalg.norm(way, axis=1)).mean())

    assert hidden(0.6) > 0.4
    assert hidden(2.5) == 0.0


def test_pictures_and_furniture_make_features_and_one_wall_has_few(rooms: dict[int, Scene]) -> None:
    camera = Camera("PINHOLE", 640, 480, (420.0, 420.0, 320.0, 240.0))
    sift = cv2.SIFT_create()
    counts = []
    for wall, (x, y) in enumerate([(4.5, 2.4), (6.6, 3.5), (4.5, 4.6), (2.4, 3.5)]):
        upright = Rotation.from_matrix([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
        facing = yaw_pose([x, y, 2.2], np.pi + wall * np.pi / 2)
        pose = facing * Pose.from_components(np.zeros(3), upright)
        image = cv2.cvtColor(render(rooms[0], camera, pose).rgb, cv2.COLOR_RGB2GRAY)
        counts.append(len(sift.detect(image[100:380], None)))
    counts.sort()
    assert counts[1] > 150
    assert counts[0] < counts[1] / 3


def test_a_box_stands_where_it_is_put(rooms: dict[int, Scene]) -> None:
    pose = Pose.from_components([4.5, 3.5, 2.6], Rotation.from_euler("z", 0.4))
    scene = rooms[0].with_box(pose, (0.4, 0.2, 0.1), rgb=(200, 30, 30))
    start = pose.apply(np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.2]]))
    inward = pose.rotation.apply(-np.eye(3))
    assert np.allclose(scene.intersect(start, inward), [0.8, 0.9, 0.15], atol=1e-9)
    assert len(scene.faces) == len(rooms[0].faces) + 12


def test_a_further_footprint_is_no_longer_free(rooms: dict[int, Scene]) -> None:
    spot = rooms[0].walk_xy[:1]
    blocked = rooms[0].with_block(spot + [[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])
    assert rooms[0].free_floor(spot, 0.2).all()
    assert not blocked.free_floor(spot, 0.2).any()
    assert not blocked.free_floor(spot + [0.25, 0.0], 0.2).any()


def test_a_ray_that_leaves_the_scene_has_infinite_length(rooms: dict[int, Scene]) -> None:
    assert np.isinf(rooms[0].intersect([20.0, 20.0, 1.0], [1.0, 0.0, 0.0])).all()
