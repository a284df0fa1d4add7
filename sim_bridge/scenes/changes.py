"""What changes in a scene between the mapping walk and the robot's visit: furniture, pictures, and light."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from fieldkit.errors import suggestion
from fieldkit.frames import Pose, yaw_pose
from fieldkit.store import read_toml, write_toml
from sim_bridge.errors import SynthesisError
from sim_bridge.mesh import Rgb, Scene
from sim_bridge.scenes.blueprint import FULL_UV, Blueprint, Lamp, Quad, Thing
from sim_bridge.scenes.light import Light, lit, unlit
from sim_bridge.scenes.placing import Floor, Item, Items

Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Metres = Annotated[float, Meta(ge=0.0, le=100.0)]
Factor = Annotated[float, Meta(ge=0.0, le=100.0)]

# Tries to find a new place for a thing before it stays where it is.
TRIES = 24
# A lamp that is off still shows some of the light around it.
OFF_GLOW = 0.5


class ChangeOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How much changes, as in a session's ``changes.toml``; shares are of all movable things, pictures or lamps.

    A thing moves by up to ``farthest_m`` and turns by about ``turned_deg``; what lies on something by up to
    ``strewn_m``. Passages for a disc of ``passage_m`` (radius) stay open. Daylight (group "window") is scaled by a
    factor within ``daylight``, every other group of lamps within ``dimmed``.
    """

    version: Literal[1] = 1
    moved: Share = 0.25
    removed: Share = 0.06
    added: Share = 0.06
    exchanged_pictures: Share = 0.08
    removed_pictures: Share = 0.05
    lamps_off: Share = 0.15
    farthest_m: Metres = 0.9
    turned_deg: Annotated[float, Meta(ge=0.0, le=180.0)] = 50.0
    strewn_m: Metres = 0.3
    passage_m: Annotated[float, Meta(ge=0.0, le=2.0)] = 0.4
    daylight: tuple[Factor, Factor] = (0.3, 1.5)
    dimmed: tuple[Factor, Factor] = (0.75, 1.1)

    def __post_init__(self) -> None:
        for name in ("daylight", "dimmed"):
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(f"{name} is [{low:g}, {high:g}]; expected the smaller factor first")
        if self.moved + self.removed > 1.0:
            raise ValueError(f"moved and removed add up to {self.moved + self.removed:g}; expected at most 1")


STANDARD_CHANGES = ChangeOptions()
CHANGES: dict[str, ChangeOptions | None] = {"standard": STANDARD_CHANGES, "none": None}


class Change(msgspec.Struct, frozen=True, kw_only=True):
    """One thing that changed: its name, what happened, where (x, y, z in m) it is or was, and how far it moved."""

    what: Literal["moved", "removed", "added", "exchanged", "switched off"]
    name: str
    at_m: tuple[float, float, float]
    moved_m: float | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class Changed:
    """A changed world: blueprint, light, and the list of changes."""

    blueprint: Blueprint
    light: Light
    changes: tuple[Change, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class Worlds:
    """A scene as it is mapped and photographed, as the robot visits it, and what is in the way in either.

    ``both`` has the furniture of both and no light of its own: a place that is free there is free in each, and what
    is seen there is seen in each. Without changes the three are one.
    """

    mapped: Scene
    visited: Scene
    both: Scene
    changes: tuple[Change, ...] = ()


def find_changes(name: str) -> ChangeOptions | None:
    """Return options by name or from a TOML file, None for no changes; raises SynthesisError or StoreError."""
    if name.endswith(".toml"):
        return read_toml(Path(name), ChangeOptions, what="options as in a session's changes.toml")
    if name not in CHANGES:
        raise SynthesisError(f"unknown changes {name!r}", hint=f"{suggestion(name, list(CHANGES))}, or a TOML file")
    return CHANGES[name]


def write_changes(folder: Path, options: ChangeOptions | None, worlds: Worlds) -> None:
    """Write a session's ``changes.toml`` (the options, none where nothing changes), and what changed as truth."""
    if options is not None:
        write_toml(folder / "changes.toml", options)
    write_toml(folder / "truth" / "changes.toml", {"version": 1, "change": list(worlds.changes)})


def make_worlds(blueprint: Blueprint, options: ChangeOptions | None, *, seed: int) -> Worlds:
    """Make and light the worlds of a session; the same blueprint, options and seed give the same worlds."""
    mapped = mapped_scene(blueprint, seed=seed)
    if options is None:
        return Worlds(mapped, mapped, mapped)
    new = _changed_by_seed(blueprint, options, seed)
    visited = lit(new.blueprint, new.light, rng=np.random.default_rng([seed, 90719]))
    return Worlds(mapped, visited, unlit(_united(blueprint, new.blueprint)), new.changes)


def mapped_scene(blueprint: Blueprint, *, seed: int) -> Scene:
    """Light a scene as it is mapped: `Worlds.mapped` alone."""
    return lit(blueprint, rng=np.random.default_rng([seed, 90709]))


def visited_scene(blueprint: Blueprint, options: ChangeOptions | None, *, seed: int) -> Scene:
    """Light a scene as the robot visits it: `Worlds.visited` alone."""
    if options is None:
        return mapped_scene(blueprint, seed=seed)
    new = _changed_by_seed(blueprint, options, seed)
    return lit(new.blueprint, new.light, rng=np.random.default_rng([seed, 90719]))


def _changed_by_seed(blueprint: Blueprint, options: ChangeOptions, seed: int) -> Changed:
    return changed(blueprint, options, rng=np.random.default_rng([seed, 90717]))


def changed(blueprint: Blueprint, options: ChangeOptions, *, rng: np.random.Generator) -> Changed:
    """Change a world: move, remove and add movable things, exchange pictures, and change the light.

    Nothing moves into walls or other things, and no passage closes, not even one that is only free in the original.
    What lies on a thing goes where it goes.
    """
    items = Items.of(blueprint)
    floor = Floor.of(blueprint, options.passage_m)
    changes = _change_things(items, floor, options, rng=rng)
    quads, blocks, things = items.built()
    lamps, quads, light, switched = _change_light(blueprint.lamps, quads, options, rng=rng)
    textures = list(blueprint.textures)
    quads, hung = _change_pictures(things, quads, textures, options, rng=rng)
    new = dataclasses.replace(
        blueprint, quads=tuple(quads), blocks=tuple(blocks), things=tuple(things), textures=tuple(textures), lamps=lamps
    )
    return Changed(new, light, (*changes, *hung, *switched))


def _united(before: Blueprint, after: Blueprint) -> Blueprint:
    """Return the original with all that stands elsewhere, or is new, in the changed world."""
    known = {id(q) for q in before.quads}
    stands = {id(b) for b in before.blocks}
    return dataclasses.replace(
        before,
        quads=(*before.quads, *(q for q in after.quads if id(q) not in known and q.thing)),
        blocks=(*before.blocks, *(b for b in after.blocks if id(b) not in stands)),
        textures=after.textures,
        things=after.things,
    )


def _change_things(items: Items, floor: Floor, options: ChangeOptions, *, rng: np.random.Generator) -> list[Change]:
    """Remove, move and add movable things; each is drawn by its own chance, in the order of the blueprint."""
    changes: list[Change] = []
    for index in items.indices("movable"):
        fate = float(rng.random())
        if index not in items:
            continue
        item = items[index]
        at = _place(item.thing.world_from_thing)
        if fate < options.removed:
            items.remove(index)
            changes.append(Change(what="removed", name=item.thing.name, at_m=at))
        elif fate < options.removed + options.moved:
            moved_m = _move(items, floor, index, options, rng=rng)
            if moved_m is not None:
                here = _place(items[index].thing.world_from_thing)
                changes.append(Change(what="moved", name=item.thing.name, at_m=here, moved_m=round(moved_m, 4)))
        elif fate < options.removed + options.moved + options.added:
            copy = _add(items, floor, index, options, rng=rng)
            if copy is not None:
                changes.append(Change(what="added", name=item.thing.name, at_m=_place(copy.thing.world_from_thing)))
    return changes


def _move(items: Items, floor: Floor, index: int, options: ChangeOptions, *, rng: np.random.Generator) -> float | None:
    """Move a thing to a free place nearby and return how far; None where there is none."""
    item = items[index]
    reach = options.farthest_m if item.stands else options.strewn_m
    for _ in range(TRIES):
        step = reach * np.sqrt(rng.uniform(0.02, 1.0)) * _direction(rng)
        turn = np.radians(options.turned_deg) * float(rng.standard_normal())
        there = item.carried(_turned_about(item, step, turn))
        if items.fits(there, but=index) and floor.take(there):
            items.put(index, there)
            return float(np.hypot(*step))
    return None


def _add(items: Items, floor: Floor, index: int, options: ChangeOptions, *, rng: np.random.Generator) -> Item | None:
    """Put a copy of a thing on free floor anywhere, or beside the original on what that lies on."""
    item = items[index]
    for _ in range(TRIES):
        if item.stands:
            target = floor.cells[int(rng.integers(len(floor.cells)))]
            step = np.asarray(target) - item.thing.world_from_thing.translation[:2]
        else:
            step = options.strewn_m * rng.uniform(0.3, 2.0) * _direction(rng)
        there = item.carried(_turned_about(item, step, float(rng.uniform(-np.pi, np.pi))))
        if items.fits(there) and floor.take(there):
            items.add(there)
            return there
    return None


def _direction(rng: np.random.Generator) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    angle = rng.uniform(0.0, 2 * np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


def _turned_about(item: Item, step_xy: np.ndarray[tuple[int], np.dtype[np.float64]], yaw: float) -> Pose:
    """Return new_from_old that turns a thing about its own upright axis and moves it in plan."""
    x, y, _ = item.thing.world_from_thing.translation
    return yaw_pose([x + step_xy[0], y + step_xy[1], 0.0], yaw) * yaw_pose([-x, -y, 0.0], 0.0)


def _place(pose: Pose) -> tuple[float, float, float]:
    x, y, z = (round(float(v), 4) for v in pose.translation)
    return x, y, z


def _change_pictures(
    things: list[Thing], quads: list[Quad], textures: list[Rgb], options: ChangeOptions, *, rng: np.random.Generator
) -> tuple[list[Quad], list[Change]]:
    """Exchange or take down pictures; a screen, whose body stays, goes dark instead."""
    changes: list[Change] = []
    fronts = _fronts(things, quads, textures)
    dark = len(textures)
    textures.append(np.full((1, 1, 3), (24, 25, 28), np.uint8))
    gone: set[int] = set()
    swapped: dict[int, int] = {}
    for thing, front in fronts.items():
        fate, other = float(rng.random()), list(fronts.values())[int(rng.integers(len(fronts)))]
        name, at = things[thing].name, _place(things[thing].world_from_thing)
        if fate < options.removed_pictures:
            screen = any(q.solid for q in quads if q.thing == thing)
            if screen:
                swapped[front] = dark
            else:
                gone.add(thing)
            changes.append(Change(what="switched off" if screen else "removed", name=name, at_m=at))
        elif fate < options.removed_pictures + options.exchanged_pictures:
            textures.append(_another(textures[quads[other].texture]))
            swapped[front] = len(textures) - 1
            changes.append(Change(what="exchanged", name=name, at_m=at))
    result = []
    for number, quad in enumerate(quads):
        if quad.thing not in gone:
            texture = swapped.get(number)
            result.append(quad if texture is None else dataclasses.replace(quad, texture=texture, uv=FULL_UV))
    return result, changes


def _fronts(things: list[Thing], quads: list[Quad], textures: list[Rgb]) -> dict[int, int]:
    """Return for each picture the number of its front: the largest of its rectangles that is not of one colour."""
    fronts: dict[int, tuple[float, int]] = {}
    for number, quad in enumerate(quads):
        if things[quad.thing].kind == "picture" and textures[quad.texture].size > 3 * 16:
            a, b, _, d = quad.corners
            area = float(np.linalg.norm(b - a) * np.linalg.norm(d - a))
            if area > fronts.get(quad.thing, (0.0, 0))[0]:
                fronts[quad.thing] = (area, number)
    return {thing: number for thing, (_, number) in fronts.items()}


def _another(picture: Rgb) -> Rgb:
    """Return a picture of the same style that matches the given one nowhere: mirrored, in other colours."""
    return np.ascontiguousarray(picture[:, ::-1, [1, 2, 0]])


def _change_light(
    lamps: tuple[Lamp, ...], quads: list[Quad], options: ChangeOptions, *, rng: np.random.Generator
) -> tuple[tuple[Lamp, ...], list[Quad], Light, list[Change]]:
    """Switch lamps off, their glowing panels with them, and scale the groups; windows only change with the day."""
    groups = {}
    for group in dict.fromkeys(lamp.group for lamp in lamps):
        low, high = options.daylight if group == "window" else options.dimmed
        groups[group] = float(rng.uniform(low, high))
    glowing = [(n, q) for n, q in enumerate(quads) if q.glow is not None]
    result, changes, new = [], [], list(quads)
    for lamp in lamps:
        off = lamp.group != "window" and float(rng.random()) < options.lamps_off
        share = OFF_GLOW if off else min(groups[lamp.group], 1.0) ** (1 / 2.2)
        middle = lamp.points.mean(axis=0)
        for number, quad in glowing:
            if np.linalg.norm(quad.corners.mean(axis=0) - middle) < 0.1:
                new[number] = dataclasses.replace(quad, glow=(quad.glow or 0.0) * share)
        result.append(dataclasses.replace(lamp, power=0.0) if off else lamp)
        if off:
            x, y, z = (round(float(v), 4) for v in middle)
            changes.append(Change(what="switched off", name=f"{lamp.group} lamp", at_m=(x, y, z)))
    before = sum(lamp.power for lamp in lamps)
    after = sum(lamp.power * groups[lamp.group] for lamp in result)
    return tuple(result), new, _dimmed(after / before if before > 0.0 else 1.0, groups), changes


def _dimmed(ratio: float, groups: dict[str, float]) -> Light:
    """Return the light of scaled groups when all lamps together give this share of their light.

    What comes off walls and ceiling, the light's share that is not the lamps', changes with them.
    """
    usual = Light()
    total = usual.lamp_share + (1.0 - usual.lamp_share) * ratio
    exposure = usual.exposure * total ** (1 / 2.2)
    return dataclasses.replace(usual, lamp_share=usual.lamp_share / total, exposure=exposure, groups=groups)
