"""Mapping walks through free floor, and walls for the start tag, in scenes of several rooms."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from empty_floor import empty_floor
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fieldkit.frames import Pose
from sim_bridge.errors import SynthesisError
from sim_bridge.mapping import mapper
from sim_bridge.mesh import Clearance, Scene
from sim_bridge.scenes import make_blueprint
from sim_bridge.scenes.light import unlit
from sim_bridge.stage import staging, tours
from sim_bridge.stage.paths import floor_graph

SCENES = ("clinic", "office")


@functools.cache
def scene(name: str) -> Scene:
    return unlit(make_blueprint(name, 0))


@functools.cache
def tour(name: str) -> np.ndarray:
    return tours.tour(scene(name))


def length(loop: np.ndarray) -> float:
    return float(np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1).sum())


def shelves() -> Scene:
    """Four aisles between three shelves, open at both ends."""
    return empty_floor((8.0, 9.0), [(x, 1.5, x + 0.9, 7.5) for x in (1.3, 3.55, 5.8)])


@pytest.mark.parametrize("name", SCENES)
def test_a_tour_is_closed_and_stays_on_free_floor(name: str) -> None:
    loop = tour(name)
    assert np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1).max() < 0.12
    assert scene(name).free_floor(loop, 0.3).all()


@pytest.mark.parametrize("name", SCENES)
def test_a_tour_passes_near_all_free_floor(name: str) -> None:
    graph, _ = tours.walkable(scene(name))
    off, _ = cKDTree(tour(name)).query(graph.centres)
    assert off.max() < 2.5
    assert np.quantile(off, 0.95) < 1.6


@pytest.mark.parametrize("name", SCENES)
def test_a_shorter_tour_leaves_out_dead_ends_and_covers_what_it_promises(name: str) -> None:
    graph, _ = tours.walkable(scene(name))
    short = tours.tour(scene(name), covers=0.65)
    off, _ = cKDTree(short).query(graph.centres)
    assert (off < 1.5).mean() > 0.6
    assert off.max() > 2.0
    assert length(short) < 0.75 * length(tour(name))


@pytest.mark.parametrize("name", SCENES)
def test_a_walk_has_four_images_per_square_metre_of_the_floor_that_is_seen(name: str) -> None:
    graph, _ = tours.walkable(scene(name))
    area = tours.shown_area_m2(scene(name), graph)
    stations = mapper.walk(scene(name), mapper.WalkOptions(), rng=np.random.default_rng(0))
    assert 3.5 < 4 * len(stations) / area < 4.5
    assert 4 * len(stations) <= 600


def test_a_tour_of_all_the_floor_leads_into_every_aisle_once() -> None:
    loop = tours.tour(shelves())
    for middle in (0.65, 2.875, 5.125, 7.35):
        in_aisle = (np.abs(loop[:, 0] - middle) < 0.3) & (loop[:, 1] > 2.0) & (loop[:, 1] < 7.0)
        assert np.ptp(loop[in_aisle, 1]) > 4.5


def test_stations_of_a_walk_look_both_ways_and_turn_around_in_steps() -> None:
    stations = mapper.walk(shelves(), mapper.WalkOptions(stations=70), rng=np.random.default_rng(0))
    at = np.array([s.world_from_rig.translation[:2] for s in stations])
    ahead = np.array([s.world_from_rig.rotation.apply([1.0, 0.0, 0.0])[:2] for s in stations])
    near = np.linalg.norm(at[:, None] - at[None], axis=2) < 0.8
    against = ahead @ ahead.T < -0.7
    assert (near & against).any(axis=1).mean() > 0.6
    # Neighbours overlap: the cameras together see 170 degrees.
    turned = np.degrees(np.arccos(np.clip((ahead[1:] * ahead[:-1]).sum(axis=1), -1.0, 1.0)))
    assert turned.max() < 70.0
    moved = np.linalg.norm(np.diff(at, axis=0), axis=1)
    assert moved.max() < 2.0


def test_a_tour_goes_through_doors_into_every_room_of_the_connected_floor() -> None:
    # Two rooms with a door in between, and a third without one.
    plan = empty_floor((9.0, 4.0), [(3.9, 0.0, 4.0, 1.5), (3.9, 2.5, 4.0, 4.0), (7.0, 0.0, 7.1, 4.0)])
    loop = tours.tour(plan)
    assert loop[:, 0].min() < 2.0
    assert 5.0 < loop[:, 0].max() < 7.0


def test_walkers_make_themselves_narrow_where_they_must() -> None:
    graph, radius_m = tours.walkable(empty_floor((6.0, 0.8), []))
    assert radius_m == 0.28
    assert len(graph.centres) > 20
    with pytest.raises(SynthesisError, match="no free floor"):
        tours.walkable(empty_floor((6.0, 0.35), []))


def test_clearance_narrows_the_floor_like_blocks_do() -> None:
    distance = np.minimum(*np.meshgrid(np.arange(40) * 0.05, np.arange(40) * 0.05, indexing="ij")).astype(np.float32)
    plan = empty_floor((2.0, 2.0), [(1.5, 1.5, 1.6, 1.6)])
    limited = Scene(**{**plan.__dict__, "clearance": Clearance(distance, (0.0, 0.0), 0.05)})
    spots = [(1.0, 1.0), (0.35, 1.0), (1.0, 0.35), (1.45, 1.45)]
    assert plan.free_floor(spots, 0.34).tolist() == [True, True, True, False]
    assert limited.free_floor(spots, 0.34).tolist() == [True, False, False, False]


def test_free_floor_looks_at_every_block_that_matters(rng: np.random.Generator) -> None:
    corners = rng.uniform(0, 20, (300, 2))
    plan = empty_floor((20.0, 20.0), [(x, y, x + 0.5, y + 0.3) for x, y in corners])
    spots = rng.uniform(0.4, 19.6, (2000, 2))
    gaps = np.maximum(np.maximum(corners - spots[:, None], spots[:, None] - corners - [0.5, 0.3]), 0.0)
    expected = np.linalg.norm(gaps, axis=2).min(axis=1) >= 0.4
    assert np.array_equal(plan.free_floor(spots, 0.4), expected)


def test_rays_tell_the_normal_of_what_they_meet_also_of_what_was_added() -> None:
    boxed = scene("clinic").with_box(
        Pose.from_components([50.0, 0.0, 1.0], Rotation.identity()), (1, 1, 1), rgb=(9, 9, 9)
    )
    distance, normal = boxed.trace(
        [[52.0, 0.0, 1.0], [50.0, 0.0, 3.0], [60.0, 0.0, 1.0]], [[-1, 0, 0], [0, 0, -1], [0, 0, 1]]
    )
    assert distance == pytest.approx([1.5, 1.5, np.inf])
    assert np.allclose(normal, [[1, 0, 0], [0, 0, 1], [0, 0, 0]])


@pytest.mark.parametrize("name", SCENES)
def test_start_tags_find_bare_walls_all_over_also_inner_ones(name: str, rng: np.random.Generator) -> None:
    inside = scene(name)
    graph = tours.largest_part(floor_graph(inside, 0.36))
    places = staging._bare_walls(inside, graph, rng=rng)
    at = np.array([p.translation for p in places])
    x0, y0, x1, y1 = inside.floor_bounds
    inner = (at[:, 0] > x0 + 0.5) & (at[:, 0] < x1 - 0.5) & (at[:, 1] > y0 + 0.5) & (at[:, 1] < y1 - 0.5)
    assert len(places) >= 10
    assert inner.any()
    for place in places:
        front = inside.intersect(place.apply([0.1, 0.1, 0.4]), place.rotation.apply([0.0, 0.0, -1.0]))
        assert front == pytest.approx([0.41], abs=2e-3)
