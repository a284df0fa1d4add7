"""The renderer against exact geometry: corners, edges, depth, coverage, filtering."""

from __future__ import annotations

import dataclasses

import cv2
import numba
import numpy as np
import pytest
from empty_floor import empty_floor
from numpy.typing import NDArray
from pupil_apriltags import Detector
from scipy.spatial.transform import Rotation

from fieldkit.cameras import Camera
from fieldkit.errors import CameraError
from fieldkit.frames import Pose
from sim_bridge.mesh import Scene
from sim_bridge.rendering import RENDERERS, render, render_depth
from sim_bridge.scenes import make_scene

Array = NDArray[np.float64]

PINHOLE = Camera("PINHOLE", 640, 480, (552.0, 552.0, 320.0, 240.0))
DISTORTED = Camera("OPENCV", 1600, 1200, (1200.0, 1202.0, 804.0, 596.0, 0.08, -0.12, 0.001, -0.0005))
TAG_M = 0.1365
CORNERS = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]) * TAG_M / 2
BACKGROUND = (255, 0, 255)


def empty_scene() -> Scene:
    return dataclasses.replace(empty_floor((1.0, 1.0), []), background=BACKGROUND)


@pytest.fixture(scope="module")
def room() -> Scene:
    return make_scene("room", 0)


@pytest.fixture(scope="module")
def tag() -> Scene:
    """A tag36h11 of TAG_M with a white border of one cell, at the origin, before a grey board."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    image = np.pad(cv2.aruco.generateImageMarker(dictionary, 3, 8), 1, constant_values=255).astype(np.uint8)
    board = Pose.from_components([0.0, 0.0, -0.01], Rotation.identity())
    print_m = TAG_M * 10 / 8
    grey = np.full((2, 2), 110, np.uint8)
    return empty_scene().with_quad(board, 0.6, 0.6, grey).with_quad(Pose.identity(), print_m, print_m, image)


def look(position: Array, target: Array) -> Pose:
    """Return world_from_cam at a position, looking at a target, upright for z up."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    matrix = np.column_stack([right, np.cross(forward, right), forward])
    return Pose.from_components(position, Rotation.from_matrix(matrix))


def tag_views(rng: np.random.Generator, camera: Camera, count: int, *, near_m: float, far_m: float) -> list[Pose]:
    """Draw poses from which the whole tag is in the image, up to 60 degrees aslant, rolled and off the centre."""
    views: list[Pose] = []
    while len(views) < count:
        slant, azimuth = np.deg2rad(rng.uniform(0, 60)), rng.uniform(0, 2 * np.pi)
        across = np.sin(slant) * np.array([np.cos(azimuth), np.sin(azimuth)])
        position = rng.uniform(near_m, far_m) * np.array([*across, np.cos(slant)])
        forward = -position / np.linalg.norm(position)
        right = np.cross([0.0, -1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        facing = Rotation.from_matrix(np.column_stack([right, np.cross(forward, right), forward]))
        turn = Rotation.from_euler("zyx", rng.uniform([-0.6, -0.25, -0.18], [0.6, 0.25, 0.18]))
        pose = Pose.from_components(position, facing * turn)
        if camera.project(pose.inv().apply(1.3 * CORNERS))[1].all():
            views.append(pose)
    return views


def edge_shift(image: NDArray[np.uint8], camera: Camera, world_from_cam: Pose) -> Array:
    """Measure how far the tag's four outer edges lie from their exact projection: dx, dy, outward in px.

    Along the normal of each edge, the area under the step from black to white says where the step is. The exact
    edges are curves when the lens distorts.
    """
    cam_from_world = world_from_cam.inv()
    centre = camera.project(cam_from_world.apply(np.zeros((1, 3))))[0][0]
    normals, shifts = [], []
    for start, end in zip(CORNERS, np.roll(CORNERS, -1, axis=0), strict=True):
        points = start + np.linspace(0.15, 0.85, 60)[:, None] * (end - start)
        at = camera.project(cam_from_world.apply(points))[0]
        along = camera.project(cam_from_world.apply(points + 1e-5 * (end - start)))[0] - at
        normal = np.column_stack([along[:, 1], -along[:, 0]]) / np.linalg.norm(along, axis=1, keepdims=True)
        normal *= np.sign(normal[0] @ (at[0] - centre))
        reach = min(5.0, 0.45 / 8 / 0.7 * float(np.linalg.norm(at[-1] - at[0])))
        offsets = np.arange(-reach, reach + 1e-9, 0.1)
        spots = (at[:, None] + offsets[:, None] * normal[:, None] - 0.5).astype(np.float32)
        grey = image[..., 0].astype(np.float32)
        profile = cv2.remap(grey, spots[..., 0], spots[..., 1], cv2.INTER_LINEAR).astype(np.float64)
        low, high = profile[:, :3].mean(axis=1), profile[:, -3:].mean(axis=1)
        step = (profile - low[:, None]) / (high - low)[:, None]
        normals.append(normal)
        shifts.append(reach - np.trapezoid(step, offsets, axis=1))
    system = np.column_stack([np.concatenate(normals), np.ones(240)])
    return np.linalg.lstsq(system, np.concatenate(shifts))[0]


def test_detected_tag_corners_have_no_bias(tag: Scene, rng: np.random.Generator) -> None:
    detector = Detector(families="tag36h11", quad_decimate=1.0)
    errors = []
    for pose in tag_views(rng, PINHOLE, 60, near_m=0.3, far_m=0.9):
        exact = PINHOLE.project(pose.inv().apply(CORNERS))[0]
        found = detector.detect(np.ascontiguousarray(render(tag, PINHOLE, pose).rgb[..., 0]))
        assert len(found) == 1
        nearest = np.linalg.norm(found[0].corners[None] - exact[:, None], axis=2).argmin(axis=1)
        errors.append(found[0].corners[nearest] - exact)
    assert np.abs(np.concatenate(errors).mean(axis=0)).max() < 0.02
    assert np.concatenate(errors).std() < 0.12


def test_edges_of_a_tag_lie_on_their_exact_curves_behind_a_distorting_lens(
    tag: Scene, rng: np.random.Generator
) -> None:
    views = tag_views(rng, DISTORTED, 8, near_m=0.3, far_m=0.6)
    shifts = np.array([edge_shift(render(tag, DISTORTED, p).rgb, DISTORTED, p) for p in views])
    assert np.abs(shifts.mean(axis=0)).max() < 0.02
    assert np.abs(shifts).max() < 0.05


def rays(camera: Camera, world_from_cam: Pose, pixels: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return directions (n, 3) in the world with unit depth through the centres of pixels (n, 2), and their lengths."""
    directions = camera.unproject(pixels + 0.5)
    return world_from_cam.rotation.apply(directions), np.linalg.norm(directions, axis=1)


@pytest.mark.parametrize("camera", [PINHOLE, DISTORTED], ids=["pinhole", "distorted"])
def test_depth_is_that_of_the_ray_through_the_pixel_centre(
    room: Scene, rng: np.random.Generator, camera: Camera
) -> None:
    pose = look(np.array([4.5, 5.8, 0.7]), np.array([0.0, 5.8, 1.2]))
    image = render(room, camera, pose)
    pixels = np.column_stack([rng.integers(0, camera.width, 40_000), rng.integers(0, camera.height, 40_000)])
    directions, lengths = rays(camera, pose, pixels)
    exact = room.intersect(pose.translation, directions) / lengths
    error = np.abs(image.depth_m[pixels[:, 1], pixels[:, 0]] - exact)
    # Where an outline passes within a rounding of the pixel centre (or, behind a lens, between pixel centres of the
    # image that is bent), either surface is right.
    assert (error > 1e-4).mean() < (1e-4 if camera.is_pinhole else 5e-3)
    assert error[error < 1e-4].max() < 2e-6


def test_any_number_of_threads_gives_the_same_bits(room: Scene) -> None:
    pose = look(np.array([0.9, 0.9, 1.6]), np.array([5.0, 4.0, 0.9]))
    many = render(room, DISTORTED, pose)
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        one = render(room, DISTORTED, pose)
    finally:
        numba.set_num_threads(before)
    assert np.array_equal(one.rgb, many.rgb)
    assert np.array_equal(one.depth_m, many.depth_m)


@pytest.mark.parametrize("samples", [1, 4])
def test_a_closed_room_shows_no_gap_between_triangles(room: Scene, rng: np.random.Generator, samples: int) -> None:
    marked = dataclasses.replace(
        room,
        textures=tuple(np.zeros((1, 1, 3), np.uint8) for _ in room.textures),
        background=BACKGROUND,
    )
    for height in rng.uniform(0.4, 1.8, 6):
        level = look(np.array([4.5, 5.8, height]), np.array([*rng.uniform([0, 0], [9, 7]), height]))
        image = render(marked, PINHOLE, level, samples=samples)
        assert image.rgb.max() == 0
        assert image.depth_m.min() > 0


def test_pixels_that_meet_nothing_have_the_background_and_no_depth(tag: Scene) -> None:
    away = Pose.from_components([0.0, 0.0, 1.0], Rotation.identity())
    image = render(tag, PINHOLE, away)
    assert (image.rgb == BACKGROUND).all()
    assert (image.depth_m == 0).all()


def test_a_texture_stands_upright_with_its_first_row_at_plus_y() -> None:
    picture = np.array([[[250, 0, 0], [0, 250, 0]], [[0, 0, 250], [250, 250, 250]]], np.uint8)
    scene = empty_scene().with_quad(Pose.identity(), 1.0, 1.0, picture)
    facing = Pose.from_components([0.0, 0.0, 1.5], Rotation.from_euler("x", np.pi))
    image = render(scene, PINHOLE, facing).rgb
    quadrants = [image[150, 230], image[150, 410], image[330, 230], image[330, 410]]
    assert np.array_equal(quadrants, picture.reshape(4, 3))


def test_borders_of_a_texture_do_not_bleed_to_the_opposite_side() -> None:
    picture = np.zeros((64, 64), np.uint8)
    picture[:, 32:] = 255
    scene = empty_scene().with_quad(Pose.identity(), 1.0, 1.0, picture)
    facing = Pose.from_components([0.0, 0.0, 20.0], Rotation.from_euler("x", np.pi))
    image = render(dataclasses.replace(scene, background=(0, 0, 0)), PINHOLE, facing).rgb[..., 0]
    columns = image[240, 300:340]
    assert columns[:18].max() == 0
    assert columns[22:32].min() > 200


def test_a_texture_far_away_keeps_its_mean_brightness() -> None:
    squares = (np.indices((64, 64)).sum(axis=0) % 2 * 255).astype(np.uint8)
    scene = empty_scene().with_quad(Pose.identity(), 4.0, 4.0, squares)
    slanted = look(np.array([-1.0, -6.0, 3.0]), np.zeros(3))
    image = render(scene, PINHOLE, slanted)
    inside = cv2.erode((image.depth_m > 0).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert abs(float(image.rgb[..., 0][inside].mean()) - 127.5) < 1.0


def test_outlines_are_covered_in_quarters_without_bias() -> None:
    white = np.full((1, 1), 255, np.uint8)
    scene = dataclasses.replace(empty_scene().with_quad(Pose.identity(), 0.5, 0.5, white), background=(0, 0, 0))
    turned = Pose.from_components([0.0, 0.0, 1.0], Rotation.from_euler("xz", [np.pi, 0.3]))
    grey = render(scene, PINHOLE, turned).rgb[..., 0].astype(np.int64)
    assert set(np.unique(grey)) == {0, 64, 128, 191, 255}
    assert abs(grey.sum() / 255 - (0.5 * 552) ** 2) < 30


def test_a_camera_inside_a_triangle_s_reach_needs_no_clipping() -> None:
    floor = empty_scene().with_quad(Pose.identity(), 200.0, 200.0, np.full((1, 1), 200, np.uint8))
    above = look(np.array([0.0, 0.0, 0.5]), np.array([1.0, 0.0, 0.5]))
    image = render(floor, PINHOLE, above)
    assert (image.rgb[300:] == 200).all()
    assert np.allclose(image.depth_m[479], 0.5 * 552 / 239.5, rtol=1e-6)


def test_a_field_of_view_wider_than_a_plane_holds_is_refused(tag: Scene) -> None:
    wide = Camera("OPENCV_FISHEYE", 640, 480, (200.0, 200.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(CameraError, match="field of view too wide"):
        render(tag, wide, Pose.identity())


def test_depth_alone_is_the_depth_of_the_image(room: Scene) -> None:
    pose = look(np.array([0.9, 0.9, 1.6]), np.array([5.0, 4.0, 0.9]))
    for camera in (PINHOLE, DISTORTED):
        assert np.array_equal(render_depth(room, camera, pose), render(room, camera, pose).depth_m)


def subdivided(scene: Scene) -> Scene:
    """Cut every face into four of the same surface."""
    halves = 0.5 * np.array([[[2, 0, 0], [1, 1, 0], [1, 0, 1]], [[1, 1, 0], [0, 2, 0], [0, 1, 1]]])
    inner = 0.5 * np.array([[[1, 0, 1], [0, 1, 1], [0, 0, 2]], [[1, 1, 0], [0, 1, 1], [1, 0, 1]]])
    weights = np.concatenate([halves, inner])
    corners = np.einsum("kcj,mjx->mkcx", weights, scene.vertices[scene.faces])
    return dataclasses.replace(
        scene,
        vertices=corners.reshape(-1, 3),
        faces=np.arange(12 * len(scene.faces), dtype=np.int32).reshape(-1, 3),
        uv=np.einsum("kcj,mjx->mkcx", weights, scene.uv).reshape(-1, 3, 2).astype(np.float32),
        shade=np.einsum("kcj,mj->mkc", weights, scene.shade).reshape(-1, 3).astype(np.float32),
        texture=np.repeat(scene.texture, 4),
        closed=np.repeat(scene.closed, 4),
    )


def test_a_finer_mesh_of_the_same_surface_gives_the_same_image(room: Scene, rng: np.random.Generator) -> None:
    fine = subdivided(subdivided(room))
    for height in rng.uniform(0.4, 1.8, 3):
        level = look(np.array([4.5, 5.8, height]), np.array([*rng.uniform([0, 0], [9, 7]), height]))
        coarse_image, fine_image = render(room, PINHOLE, level), render(fine, PINHOLE, level)
        difference = np.abs(coarse_image.rgb.astype(np.int64) - fine_image.rgb)
        assert (difference > 2).mean() < 2e-3
        assert difference.mean() < 0.05
        assert (np.abs(coarse_image.depth_m - fine_image.depth_m) > 1e-5).mean() < 1e-4


def test_a_derived_scene_shares_what_it_was_made_from_and_looks_as_if_made_at_once(room: Scene) -> None:
    tag = np.kron(np.indices((8, 8)).sum(axis=0) % 2 * 255, np.ones((8, 8))).astype(np.uint8)
    at = Pose.from_components([4.0, 3.5, 1.0], Rotation.from_euler("x", 90, degrees=True))
    board = at * Pose.from_components([0.0, 0.0, -0.02], Rotation.identity())
    derived = room.with_box(board, (0.5, 0.5, 0.02), rgb=(200, 30, 30)).with_quad(at, 0.4, 0.4, tag)
    derived = derived.with_block(np.zeros((4, 2)))
    whole = dataclasses.replace(derived)
    assert derived.mips.texels is room.mips.texels
    assert len(derived.mips.added) < len(whole.mips.texels) / 5
    pose = look(np.array([4.2, 1.5, 1.3]), np.array([4.0, 3.5, 1.0]))
    first, second = render(derived, PINHOLE, pose), render(whole, PINHOLE, pose)
    assert not np.array_equal(first.rgb, render(room, PINHOLE, pose).rgb)
    assert np.array_equal(first.depth_m, second.depth_m)
    assert (first.rgb == second.rgb).all(axis=2).mean() > 0.9999
    rays = np.random.default_rng(0).standard_normal((1000, 3))
    assert np.array_equal(derived.intersect(pose.translation, rays), whole.intersect(pose.translation, rays))


def test_every_renderer_of_the_table_draws_the_room(room: Scene) -> None:
    pose = look(np.array([0.9, 0.9, 1.6]), np.array([5.0, 4.0, 0.9]))
    for draw in RENDERERS.values():
        image = draw(room, PINHOLE, pose)
        assert image.rgb.shape == (480, 640, 3)
        assert image.depth_m.dtype == np.float32
        assert image.rgb.std() > 20
