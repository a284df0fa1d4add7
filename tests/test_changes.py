"""Changes of the world between mapping and visit: what may move does, nothing collides, and all ways stay open."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import label
from scipy.spatial.transform import Rotation

from fieldkit.errors import FieldkitError
from fieldkit.frames import Pose, yaw_pose
from sim_bridge.scenes import make_blueprint
from sim_bridge.scenes.blueprint import Blueprint, Builder
from sim_bridge.scenes.changes import (
    STANDARD_CHANGES,
    Changed,
    ChangeOptions,
    changed,
    find_changes,
    make_worlds,
    mapped_scene,
    visited_scene,
    write_changes,
)
from sim_bridge.scenes.placing import LOST_CELLS, overlaps

NOTHING = ChangeOptions(
    moved=0.0,
    removed=0.0,
    added=0.0,
    exchanged_pictures=0.0,
    removed_pictures=0.0,
    lamps_off=0.0,
    daylight=(1.0, 1.0),
    dimmed=(1.0, 1.0),
)


def only(**settings: float | tuple[float, float]) -> ChangeOptions:
    return ChangeOptions(**{**{n: getattr(NOTHING, n) for n in NOTHING.__struct_fields__}, **settings})


def box(
    build: Builder, name: str, at: tuple[float, float], size: tuple[float, float, float], *, z: float = 0.0
) -> None:
    """Add a movable box; on the floor it marks its footprint."""
    place = yaw_pose([*at, z], 0.0)
    with build.thing(name, place, kind="movable"):
        build.box(place, [0.0, 0.0, size[2] / 2], size, build.shared(name, lambda: np.full((1, 1, 3), 90, np.uint8)))
        if z == 0.0:
            build.block(place, size[:2])


def hall() -> Blueprint:
    """Make a hall of 6 x 5 m, halved by a wall with a passage of 1.1 m, with twelve crates, a table and a mug on it."""
    build = Builder()
    floor = build.plain((150, 140, 130))
    build.panel(Pose.from_components([3.0, 2.5, 0.0], Rotation.identity()), (6.0, 5.0), floor)
    for y0, y1 in ((0.0, 1.9), (3.0, 5.0)):
        middle = yaw_pose([3.0, (y0 + y1) / 2, 0.0], 0.0)
        build.box(middle, [0.0, 0.0, 1.25], [0.1, y1 - y0, 2.5], floor)
        build.block(middle, (0.1, y1 - y0))
    for x, y in itertools.product((0.4, 2.2, 3.8, 5.6), (0.4, 1.2, 4.5)):
        box(build, "crate", (x, y), (0.4, 0.4, 0.5))
    box(build, "table", (1.3, 3.2), (0.8, 0.6, 0.7))
    box(build, "mug", (1.4, 3.3), (0.08, 0.08, 0.1), z=0.7)
    rng = np.random.default_rng(0)
    for k in range(4):
        at = Pose.from_components([0.01, 1.0 + k, 1.6], Rotation.from_euler("xyz", [90, 0, 90], degrees=True))
        with build.thing("poster", at, kind="picture"):
            build.panel(at, (0.5, 0.7), build.texture(rng.integers(0, 255, (35, 25, 3)).astype(np.uint8)), solid=False)
    for x, group in ((1.5, "ceiling"), (4.5, "ceiling"), (3.0, "window")):
        build.lamp(Pose.from_components([x, 2.5, 2.45], Rotation.from_euler("x", np.pi)), (0.6, 0.3), group=group)
    return build.blueprint(floor_bounds=(0.0, 0.0, 6.0, 5.0))


HALL = hall()


def change(options: ChangeOptions, *, seed: int = 3) -> Changed:
    return changed(HALL, options, rng=np.random.default_rng(seed))


def pose_of(blueprint: Blueprint, name: str) -> Pose:
    return next(t.world_from_thing for t in blueprint.things if t.name == name)


def corners(blueprint: Blueprint, name: str) -> np.ndarray:
    index = next(i for i, t in enumerate(blueprint.things) if t.name == name)
    return np.array([q.corners for q in blueprint.quads if q.thing == index])


def test_the_same_seed_changes_the_same_things() -> None:
    once, again, other = (change(STANDARD_CHANGES, seed=s) for s in (5, 5, 6))
    assert once.changes == again.changes
    assert once.changes != other.changes
    for a, b in zip(once.blueprint.quads, again.blueprint.quads, strict=True):
        assert np.array_equal(a.corners, b.corners)


def test_no_shares_no_changes() -> None:
    found = change(NOTHING)
    assert found.changes == ()
    for name in ("quads", "blocks"):
        parts = [getattr(b, name) for b in (found.blueprint, HALL)]
        shapes = [sorted((q.corners if name == "quads" else q.corners_xy).tobytes() for q in p) for p in parts]
        assert shapes[0] == shapes[1]


def test_moved_things_keep_their_shape_and_stay_near() -> None:
    found = change(only(moved=1.0))
    assert len(found.changes) > 6
    for before, after in zip(HALL.things, found.blueprint.things, strict=True):
        moved = after.world_from_thing.translation - before.world_from_thing.translation
        assert moved[2] == 0.0
        assert np.hypot(*moved[:2]) <= STANDARD_CHANGES.farthest_m + STANDARD_CHANGES.strewn_m
    for name in ("table", "mug"):
        spans = [
            np.linalg.norm(c.reshape(-1, 3) - c.reshape(-1, 3).mean(axis=0), axis=1)
            for c in (corners(HALL, name), corners(found.blueprint, name))
        ]
        assert np.allclose(*spans)


def test_the_building_never_moves() -> None:
    found = change(only(moved=0.5, removed=0.3, added=0.2))
    shells = [[q.corners for q in b.quads if q.thing == 0] for b in (HALL, found.blueprint)]
    assert np.array_equal(shells[0], shells[1])


@pytest.mark.parametrize("seed", range(4))
def test_nothing_moves_into_anything(seed: int) -> None:
    found = change(only(moved=0.6, added=0.4), seed=seed)
    outlines = np.array([b.corners_xy for b in found.blueprint.blocks])
    owners = np.array([b.thing for b in found.blueprint.blocks])
    for outline, owner in zip(outlines, owners, strict=True):
        others = owners != owner
        assert owner == 0 or not overlaps(outline, outlines[others]).any()
    movable = outlines[owners > 0].reshape(-1, 2)
    assert (movable > 0.0).all()
    assert (movable < (6.0, 5.0)).all()


@pytest.mark.parametrize("seed", range(4))
def test_all_ways_stay_open(seed: int) -> None:
    worlds = make_worlds(HALL, only(moved=0.6, added=0.4), seed=seed)
    xs, ys = np.arange(0.05, 6.0, 0.1), np.arange(0.05, 5.0, 0.1)
    grid = np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1)
    free = {
        name: getattr(worlds, name).free_floor(grid.reshape(-1, 2), STANDARD_CHANGES.passage_m).reshape(grid.shape[:2])
        for name in ("mapped", "visited", "both")
    }
    assert not (free["both"] & ~(free["mapped"] & free["visited"])).any()
    connected = {}
    for name in ("mapped", "both"):
        numbers, _ = label(free[name])
        connected[name] = numbers == np.bincount(numbers.ravel())[1:].argmax() + 1
    cut_off = free["both"] & connected["mapped"] & ~connected["both"]
    assert cut_off.sum() <= LOST_CELLS
    assert connected["both"].sum() > 300


def test_what_lies_on_a_thing_goes_where_it_goes() -> None:
    for seed in range(40):
        found = change(only(moved=0.5), seed=seed)
        names = [c.name for c in found.changes]
        if "table" in names and "mug" not in names:
            break
    steps = [pose_of(found.blueprint, name) * pose_of(HALL, name).inv() for name in ("table", "mug")]
    assert np.linalg.norm(steps[0].translation) > 0.05
    assert np.allclose(steps[0].as_matrix(), steps[1].as_matrix())


def test_what_lies_on_a_thing_stays_on_it() -> None:
    moved = 0
    for seed in range(12):
        found = change(only(moved=1.0), seed=seed)
        on_table = pose_of(found.blueprint, "table").inv() * pose_of(found.blueprint, "mug")
        x, y, z = on_table.translation
        assert abs(x) < 0.4
        assert abs(y) < 0.3
        assert z == pytest.approx(0.7)
        moved += abs(x - 0.1) > 0.01
    assert moved > 3


def test_removed_things_leave_nothing_behind() -> None:
    found = change(only(removed=1.0))
    assert {c.what for c in found.changes} == {"removed"}
    assert {q.thing for q in found.blueprint.quads if found.blueprint.things[q.thing].kind == "movable"} == set()
    assert all(b.thing == 0 for b in found.blueprint.blocks)


def test_added_things_are_copies() -> None:
    found = change(only(added=1.0))
    count = len(found.blueprint.things) - len(HALL.things)
    assert count == len(found.changes) > 5
    kinds = {t.name for t in found.blueprint.things[len(HALL.things) :]}
    assert kinds <= {"crate", "table", "mug"}
    assert len(found.blueprint.quads) == len(HALL.quads) + 6 * count


def test_pictures_are_exchanged_in_place_or_taken_down() -> None:
    exchanged, removed = change(only(exchanged_pictures=1.0)), change(only(removed_pictures=1.0))
    fronts = [[q for q in b.quads if b.things[q.thing].kind == "picture"] for b in (HALL, exchanged.blueprint)]
    for before, after in zip(*fronts, strict=True):
        assert np.array_equal(before.corners, after.corners)
        assert not np.array_equal(HALL.textures[before.texture], exchanged.blueprint.textures[after.texture])
    assert [q for q in removed.blueprint.quads if HALL.things[q.thing].kind == "picture"] == []
    assert {c.what for c in removed.changes} == {"removed"}


def test_lamps_that_are_off_give_no_light_and_glow_less() -> None:
    options = only(lamps_off=1.0)
    found = change(options)
    assert [(lamp.group, lamp.power > 0) for lamp in found.blueprint.lamps] == [
        ("ceiling", False),
        ("ceiling", False),
        ("window", True),
    ]
    assert sorted(q.glow for q in found.blueprint.quads if q.glow is not None) == [0.5, 0.5, 1.0]
    mapped, visited = mapped_scene(HALL, seed=1), visited_scene(HALL, options, seed=1)
    assert visited.shade.mean() < 0.85 * mapped.shade.mean()


def test_light_from_the_walls_changes_with_the_lamps() -> None:
    dim = change(only(dimmed=(0.5, 0.5), daylight=(0.5, 0.5))).light
    usual = change(NOTHING).light
    for name in ("ambient", "direct"):
        share = [light.lamp_share if name == "direct" else 1.0 - light.lamp_share for light in (usual, dim)]
        scale = (dim.exposure / usual.exposure) ** 2.2 * share[1] / share[0]
        assert scale * (0.5 if name == "direct" else 1.0) == pytest.approx(0.5)


def test_without_changes_all_worlds_are_one() -> None:
    worlds = make_worlds(HALL, None, seed=1)
    assert worlds.mapped is worlds.visited is worlds.both
    assert worlds.changes == ()


def test_changes_are_stored(tmp_path: Path) -> None:
    worlds = make_worlds(HALL, STANDARD_CHANGES, seed=1)
    write_changes(tmp_path, STANDARD_CHANGES, worlds)
    assert find_changes(str(tmp_path / "changes.toml")) == STANDARD_CHANGES
    assert (tmp_path / "truth" / "changes.toml").read_text().count("[[change]]") == len(worlds.changes) > 0


def test_unknown_changes_are_refused(tmp_path: Path) -> None:
    assert find_changes("none") is None
    with pytest.raises(FieldkitError, match="unknown changes 'standart'; did you mean 'standard'"):
        find_changes("standart")
    (tmp_path / "own.toml").write_text("version = 1\nmoved = 1.5\n")
    with pytest.raises(FieldkitError, match=r"own\.toml: Expected `float` <= 1.0 - at `\$\.moved`"):
        find_changes(str(tmp_path / "own.toml"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("dimmed = [1.1, 0.75]", r"dimmed is \[1.1, 0.75\]; expected the smaller factor first"),
        ("dimmed = [0.5, inf]", r"at `\$\.dimmed"),
        ("farthest_m = inf", r"at `\$\.farthest_m`"),
        ("turned_deg = 400", r"at `\$\.turned_deg`"),
        ("moved = 0.7\nremoved = 0.6", "moved and removed add up to 1.3; expected at most 1"),
    ],
)
def test_changes_beyond_sense_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "own.toml"
    path.write_text(f"version = 1\n{text}\n")
    with pytest.raises(FieldkitError, match=message):
        find_changes(str(path))


def test_passages_wider_than_all_floor_are_refused() -> None:
    with pytest.raises(FieldkitError, match=r"no floor is free for a disc of 2 m"):
        changed(make_blueprint("room", 0), ChangeOptions(passage_m=2.0), rng=np.random.default_rng(0))
