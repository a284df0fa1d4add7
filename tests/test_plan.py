"""The parts of a building: walls stand where the plan says, openings are open, textures run on across them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from fieldkit.cameras import Camera
from sim_bridge.aim import aim
from sim_bridge.mesh import Scene
from sim_bridge.rendering import render
from sim_bridge.scenes.blueprint import Builder
from sim_bridge.scenes.light import lit
from sim_bridge.scenes.plan import Opening, outside, slab, wall, wall_frame, window

DOOR = Opening(at_m=1.5, width_m=1.0)
PANE = Opening(at_m=3.5, width_m=1.2, top_m=2.0, bottom_m=0.9)
START, END, HEIGHT = (1.0, 2.0), (1.0, 7.0), 3.0


def gradient() -> np.ndarray:
    """Return a texture whose red grows from left to right and whose green grows from top to bottom."""
    u, v = np.meshgrid(np.linspace(0, 250, 512), np.linspace(0, 250, 256))
    return np.stack([u, v, np.zeros_like(u)], axis=-1).round().astype(np.uint8)


def walled(*, openings: tuple[Opening, ...] = (DOOR, PANE)) -> Scene:
    """Return one wall from START to END without light."""
    build = Builder()
    face = build.texture(gradient())
    wall(build, START, END, height_m=HEIGHT, openings=openings, left=face, right=face)
    plan = build.blueprint(floor_bounds=(-5.0, -5.0, 8.0, 12.0))
    dull = lit(plan, rng=np.random.default_rng(0))
    return dataclasses.replace(dull, shade=np.ones_like(dull.shade))


def test_openings_let_through_and_the_rest_of_a_wall_does_not() -> None:
    scene = walled()
    rng = np.random.default_rng(1)
    along, up = rng.uniform(0, 5, 500), rng.uniform(0.01, 2.99, 500)
    start = np.column_stack([np.full(500, -1.0), 2.0 + along, up])
    distance = scene.intersect(start, [1.0, 0.0, 0.0])
    in_door = (abs(along - 1.5) < 0.5) & (up < 2.1)
    in_pane = (abs(along - 3.5) < 0.6) & (up > 0.9) & (up < 2.0)
    assert np.array_equal(np.isinf(distance), in_door | in_pane)
    assert np.allclose(distance[~np.isinf(distance)], 1.94)


def test_only_passages_are_free_floor() -> None:
    scene = walled()
    spots = np.column_stack([np.full(50, 1.0), np.linspace(2.05, 6.95, 50)])
    free = scene.free_floor(spots, 0.01)
    assert np.array_equal(free, abs(spots[:, 1] - 3.5) <= 0.49)


@pytest.mark.parametrize(("side", "x", "yaw"), [("left", -0.5, 0.0), ("right", 2.5, np.pi)])
def test_a_texture_spans_the_face_as_seen_from_its_own_side(side: str, x: float, yaw: float) -> None:
    scene = walled()
    camera = Camera("PINHOLE", 90, 90, (150.0, 150.0, 45.0, 45.0))
    for along, up in ((0.5, 0.7), (1.5, 2.6), (3.5, 0.4), (4.6, 2.5)):
        image = render(scene, camera, aim([x, 2.0 + along, up], yaw), samples=1)
        red, green, _ = image.rgb[40:50, 40:50].reshape(-1, 3).mean(axis=0)
        # Looking along +x from the left, y grows to the left.
        u = 1 - along / 5 if side == "left" else along / 5
        assert red == pytest.approx(250 * u, abs=6)
        assert green == pytest.approx(250 * (1 - up / HEIGHT), abs=6)


def test_from_outside_no_back_of_a_face_is_seen() -> None:
    scene = walled()
    rng = np.random.default_rng(2)
    turns = rng.uniform(0, 2 * np.pi, 4000)
    starts = np.column_stack([1 + 4 * np.cos(turns), 4.5 + 4 * np.sin(turns), rng.uniform(0.1, 2.9, 4000)])
    targets = rng.uniform([0.95, 2.0, 0.0], [1.05, 7.0, 3.0], (4000, 3))
    ways = targets - starts
    hit = scene._rays.intersects_first(starts, ways)
    a, b, c = (scene.vertices[scene.faces[hit[hit >= 0], i]] for i in range(3))
    # Corners run clockwise seen from outside, so that this normal points into the body.
    inwards = np.cross(b - a, c - a)
    assert (hit >= 0).mean() > 0.7
    assert ((ways[hit >= 0] * inwards).sum(axis=1) > -1e-9).all()


def test_openings_that_do_not_fit_are_refused() -> None:
    for openings in ((DOOR, Opening(2.2, 1.0)), (Opening(0.1, 1.0),), (Opening(4.8, 1.0),)):
        with pytest.raises(ValueError, match="openings"):
            walled(openings=openings)


def test_a_wall_frame_stands_on_its_face_and_looks_into_the_room() -> None:
    left = wall_frame(START, END, 2.0)
    right = wall_frame(START, END, 2.0, side="right")
    assert np.allclose(left.translation, [0.94, 4.0, 0.0])
    assert np.allclose(right.translation, [1.06, 4.0, 0.0])
    assert np.allclose(left.rotation.as_matrix()[:, :2].T, [[0, 1, 0], [-1, 0, 0]])
    assert np.allclose(right.rotation.as_matrix()[:, :2].T, [[0, -1, 0], [1, 0, 0]])


def test_a_window_shines_into_the_room_and_belongs_to_the_windows() -> None:
    build = Builder()
    window(build, START, END, PANE, power=2.5, side="right", frame=build.plain((90, 90, 90)))
    (lamp,) = build.lamps
    assert lamp.group == "window"
    assert lamp.power == 2.5
    assert np.allclose(lamp.normal, [1.0, 0.0, 0.0])
    assert np.allclose(lamp.points.mean(axis=0), [1.0 - 0.01, 5.5, 1.45], atol=0.03)


@pytest.mark.parametrize("up", [True, False])
def test_a_slab_repeats_its_texture_and_cuts_it_at_the_border(up: bool) -> None:
    build = Builder()
    face = build.texture(gradient())
    slab(build, (0.0, 0.0, 2.5, 1.5), z_m=1.0, texture=face, up=up, tile_m=(1.0, 1.0))
    assert len(build.quads) == 6
    area = sum(np.prod(np.ptp(q.corners[:, :2], axis=0)) for q in build.quads)
    assert area == pytest.approx(2.5 * 1.5)
    assert all(q.normal[2] == pytest.approx(1.0 if up else -1.0) for q in build.quads)
    for quad in build.quads:
        width, height = np.ptp(quad.corners[:, :2], axis=0)
        left, top, right, bottom = quad.uv
        assert (right - left, bottom - top) == pytest.approx((width, height))


def test_what_lies_outside_all_rooms_is_not_free() -> None:
    build = Builder()
    slab(build, (0.0, 0.0, 10.0, 6.0), z_m=0.0, texture=build.plain((90, 90, 90)), up=True, cell_m=5.0)
    rooms = [(0.0, 0.0, 4.0, 6.0), (4.0, 2.0, 9.0, 3.5)]
    outside(build, (0.0, 0.0, 10.0, 6.0), rooms)
    scene = lit(build.blueprint(floor_bounds=(0.0, 0.0, 10.0, 6.0)), rng=np.random.default_rng(0))
    spots = np.random.default_rng(3).uniform([0, 0], [10, 6], (3000, 2))
    inside = np.zeros(3000, bool)
    for x0, y0, x1, y1 in rooms:
        inside |= ((spots > [x0, y0]) & (spots < [x1, y1])).all(axis=1)
    assert np.array_equal(scene.free_floor(spots, 1e-9), inside)
