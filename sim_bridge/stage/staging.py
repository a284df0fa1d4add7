"""Set the stage as a field crew would: the start tag on a wall, waypoints, and a tag on a tripod at each."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fieldkit.cameras import Camera
from fieldkit.frames import Pose
from fieldkit.tags import draw_tag
from sim_bridge import robot
from sim_bridge.aim import facing, look_at
from sim_bridge.errors import SynthesisError
from sim_bridge.mesh import Scene
from sim_bridge.rendering import render
from sim_bridge.sensors import effects
from sim_bridge.stage.paths import FloorGraph, floor_graph
from sim_bridge.stage.tours import largest_part

Array = NDArray[np.float64]

FAMILY = "tag36h11"
# White margin around the black square, in cells of the tag (the square has 8), and the board that carries the print.
MARGIN_CELLS = 1
BOARD_M, BOARD_THICKNESS_M, POLE_M = 0.19, 0.006, 0.025
# A wall of a scan is flat to so much either way.
ROUGH_M = 0.01
# Places on the floor from which walls are looked for.
WALL_SPOTS = 400
# A quick look that tells how much there is to see around a tag.
_GLANCE = Camera("PINHOLE", 320, 240, (230.0, 230.0, 160.0, 120.0))


@dataclasses.dataclass(frozen=True)
class StageOptions:
    """What is set up: number of waypoints, the tags' size, and the room that the robot needs.

    ``start_places`` and ``tripod_places`` are looked at before the one with the richest surroundings is taken.
    """

    waypoints: int = 4
    tag_size_m: float = 0.1365
    start_tag_id: int = 1
    first_tripod_id: int = 2
    start_places: int = 20
    tripod_places: int = 4
    drive_radius_m: float = 0.36
    stand_radius_m: float = 0.42
    waypoint_radius_m: float = 0.5
    start_slant_deg: tuple[float, float] = (12.0, 35.0)
    start_distance_m: tuple[float, float] = (0.75, 1.25)
    tripod_distance_m: tuple[float, float] = (1.1, 1.35)
    truth_sightings: int = 12
    truth_slant_deg: tuple[float, float] = (20.0, 45.0)
    truth_distance_m: tuple[float, float] = (0.5, 1.15)


@dataclasses.dataclass(frozen=True)
class PlacedTag:
    """A tag in the world; a tripod's names the visit it belongs to."""

    id: int
    size_m: float
    world_from_tag: Pose
    visit: str | None = None


@dataclasses.dataclass(frozen=True)
class Waypoint:
    """Where the robot stands, the tripod tag beside it, and the arm's poses that look at that tag."""

    id: str
    world_from_body: Pose
    tag: PlacedTag
    truth_arms: tuple[robot.ArmJoints, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class Stage:
    """The scene with all tags, where the robot starts, and its waypoints in order."""

    scene: Scene
    start_tag: PlacedTag
    world_from_start: Pose
    waypoints: tuple[Waypoint, ...]

    @property
    def tags(self) -> tuple[PlacedTag, ...]:
        """All tags: the start tag, then those of the waypoints."""
        return (self.start_tag, *(w.tag for w in self.waypoints))


def set_stage(scene: Scene, options: StageOptions, *, rng: np.random.Generator) -> Stage:
    """Choose places for the start tag, the waypoints and their tripods; raises SynthesisError when there is no room."""
    start_tag, start = _place_start(scene, options, rng=rng)
    stage = Stage(with_tag(scene, start_tag), start_tag, start, ())
    for index in range(options.waypoints):
        waypoint = _place_waypoint(stage, options, index=index, rng=rng)
        stage = Stage(with_tag(stage.scene, waypoint.tag), start_tag, start, (*stage.waypoints, waypoint))
    return stage


def set_in(scene: Scene, stage: Stage) -> Stage:
    """Return the stage with its tags set up in another scene, in which there must be room for them."""
    for tag in stage.tags:
        scene = with_tag(scene, tag)
    return dataclasses.replace(stage, scene=scene)


def with_tag(scene: Scene, tag: PlacedTag) -> Scene:
    """Return the scene with a tag on its board, and with a tripod's pole and foot when it belongs to a visit."""
    print_m = tag.size_m * (8 + 2 * MARGIN_CELLS) / 8
    board = Pose.from_components([0.0, 0.0, -0.002 - BOARD_THICKNESS_M / 2], Rotation.identity())
    size = (BOARD_M, BOARD_M, BOARD_THICKNESS_M)
    result = scene.with_box(tag.world_from_tag * board, size, rgb=(228, 228, 224))
    image = draw_tag(FAMILY, tag.id, cell_px=16, border_cells=MARGIN_CELLS)
    # Paper is not quite white and ink not quite black.
    paper = np.rint(20.0 + image * (215.0 / 255.0)).astype(np.uint8)
    result = result.with_quad(tag.world_from_tag, print_m, print_m, paper)
    return result if tag.visit is None else _with_tripod(result, tag)


def _with_tripod(scene: Scene, tag: PlacedTag) -> Scene:
    top = tag.world_from_tag.apply([0.0, -0.03, -0.002 - BOARD_THICKNESS_M - POLE_M / 2])
    upright = Rotation.identity()
    pole = Pose.from_components([top[0], top[1], top[2] / 2], upright)
    foot = Pose.from_components([top[0], top[1], 0.01], upright)
    result = scene.with_box(pole, (POLE_M, POLE_M, top[2]), rgb=(45, 45, 48))
    result = result.with_box(foot, (0.24, 0.24, 0.02), rgb=(50, 50, 52))
    half = 0.12
    corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
    return result.with_block(np.array(corners) + top[:2])


def sees(scene: Scene, world_from_cam: Pose, camera: Camera, tag: PlacedTag, *, margin_px: float) -> bool:
    """Return whether a camera sees a tag whole, from the front, nothing in between, this far inside the image.

    The scene may hold the tag or not: rays end in front of it.
    """
    half = 0.5 * tag.size_m * (8 + 2 * MARGIN_CELLS) / 8
    corners = np.array([[x, y, 0.003] for x in (-half, 0.0, half) for y in (-half, 0.0, half)])
    in_world = tag.world_from_tag.apply(corners)
    pixels, inside = camera.project(world_from_cam.inv().apply(in_world))
    if not inside.all() or pixels.min() < margin_px:
        return False
    if (pixels > np.array([camera.width, camera.height]) - margin_px).any() or slant(world_from_cam, tag) > 1.3:
        return False
    rays = in_world - world_from_cam.translation
    return bool((scene.intersect(world_from_cam.translation, rays) > np.linalg.norm(rays, axis=1) - 1e-3).all())


def slant(world_from_cam: Pose, tag: PlacedTag) -> float:
    """Return the angle (rad) between a tag's normal and the direction from its centre to a camera."""
    x, y, z = tag.world_from_tag.inv().apply(world_from_cam.translation)
    return float(np.arctan2(np.hypot(x, y), z))


def clear_around(scene: Scene, position_m: Array, *, radius_m: float) -> bool:
    """Return whether nothing lies within a radius of a point (3,), by rays in 26 directions."""
    grid = np.stack(np.meshgrid(*[(-1.0, 0.0, 1.0)] * 3), axis=-1).reshape(-1, 3)
    rays = grid[np.abs(grid).sum(axis=1) > 0]
    return bool((scene.intersect(position_m, rays) > radius_m).all())


def richness(scene: Scene, world_from_cam: Pose) -> int:
    """Return how many corners a quick look from a pose shows: how much there is to localize with."""
    image = effects.grey(render(scene, _GLANCE, world_from_cam, samples=1).rgb)
    found = cv2.goodFeaturesToTrack(image, 500, 0.02, 4)
    return 0 if found is None else len(found)


def _place_start(scene: Scene, options: StageOptions, *, rng: np.random.Generator) -> tuple[PlacedTag, Pose]:
    """Hang the start tag where the wall is bare and flat and the view of it, wall and room, is the richest."""
    graph = largest_part(floor_graph(scene, options.drive_radius_m))
    best: tuple[int, PlacedTag, Pose] | None = None
    seen = 0
    for place in _bare_walls(scene, graph, rng=rng):
        tag = PlacedTag(options.start_tag_id, options.tag_size_m, place)
        body = _body_before(scene, graph, tag, options, rng=rng)
        if body is None or not _room_for_photos(scene, tag):
            continue
        value = _background(scene, tag)
        if best is None or value > best[0]:
            best = (value, tag, body)
        seen += 1
        if seen == options.start_places:
            break
    if best is None:
        raise SynthesisError(
            "the scene has no bare wall in front of which the robot can stand",
            hint="use another seed, or in a mesh of your own give it more bare wall",
        )
    return best[1], best[2]


def _bare_walls(scene: Scene, graph: FloorGraph, *, rng: np.random.Generator) -> list[Pose]:
    """Return world_from_tag of places at 0.5..0.8 m height where the wall is flat, free, and a tag fits; shuffled.

    Walls are what rays from the free floor meet within reach of the robot. A wall is taller than furniture. Where
    no wall is quite flat, as in a scan, one that is nearly flat will do.
    """
    spots = graph.centres[rng.permutation(len(graph.centres))[:WALL_SPOTS]]
    yaws = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
    eyes = np.column_stack([spots, rng.uniform(0.55, 0.8, len(spots))])
    origins = np.repeat(eyes, len(yaws), axis=0)
    rays = np.tile(np.column_stack([np.cos(yaws), np.sin(yaws), np.zeros_like(yaws)]), (len(spots), 1))
    distance, normal = scene.trace(origins, rays)
    in_reach = ((normal * rays).sum(axis=1) < -0.5) & (distance > 0.4) & (distance < 1.6)
    for leaning, rough_m in ((0.02, 0.0), (0.35, ROUGH_M)):
        near = np.flatnonzero(in_reach & (np.abs(normal[:, 2]) < leaning))
        found = origins[near] + distance[near, None] * rays[near]
        # One place per square of 15 cm is enough.
        _, first = np.unique(np.floor(found[:, :2] / 0.15), axis=0, return_index=True)
        places = []
        for k in rng.permutation(first):
            x, y, _ = normal[near[k]]
            place: Pose | None = facing(found[k] + 0.01 * normal[near[k]], float(np.arctan2(y, x)))
            if place is not None and rough_m:
                place = _before_plane(scene, place, rough_m)
            if place is not None and _is_wall(scene, place, rough_m=rough_m):
                places.append(place)
        if places:
            return places
    return []


def _around() -> Array:
    offsets = np.linspace(-0.13, 0.13, 7)
    return np.array([[x, y, 0.4] for x in offsets for y in offsets])


def _before_plane(scene: Scene, world_from_tag: Pose, rough_m: float) -> Pose | None:
    """Return the pose turned to face the plane that fits the surface behind it best, in front of all of that surface.

    None where the surface is not upright or not as flat as that.
    """
    around = _around()
    back = world_from_tag.rotation.apply([0.0, 0.0, -1.0])
    height = 0.4 - scene.intersect(world_from_tag.apply(around), back)
    if not np.isfinite(height).all():
        return None
    columns = np.column_stack([around[:, :2], np.ones(len(around))])
    plane = np.linalg.lstsq(columns, height, rcond=None)[0]
    off = height - columns @ plane
    if np.abs(off).max() > rough_m or abs(plane[1]) > 0.03:
        return None
    x, y, _ = world_from_tag.rotation.apply([-plane[0], 0.0, 1.0])
    return facing(world_from_tag.apply([0.0, 0.0, plane[2] + off.max() + 0.01]), float(np.arctan2(y, x)))


def _is_wall(scene: Scene, world_from_tag: Pose, *, rough_m: float) -> bool:
    """Return whether a tag's surroundings are flat, and the surface behind it goes on to above a head's height."""
    around = _around()
    floor = -float(world_from_tag.translation[2])
    above = np.array([[x, floor + z, 0.4] for x in (-0.1, 0.1) for z in (0.3, 1.1, 1.5, 1.8)])
    back = world_from_tag.rotation.apply([0.0, 0.0, -1.0])
    depth = scene.intersect(world_from_tag.apply(np.vstack([around, above])), back)
    # Rays that miss the wall have no depth; pictures and door frames stand out from it a little.
    flat = np.abs(depth[: len(around)] - (0.41 + rough_m)) < 1e-3 + rough_m
    return bool(flat.all() and (np.abs(depth[len(around) :] - 0.41) < 0.06).all())


def _body_before(
    scene: Scene, graph: FloorGraph, tag: PlacedTag, options: StageOptions, *, rng: np.random.Generator
) -> Pose | None:
    """Return a world_from_body, if one is found, from which the arm camera sees a wall tag near and at a slant."""
    for _ in range(60):
        angle = np.radians(rng.uniform(*options.start_slant_deg)) * rng.choice([-1.0, 1.0])
        distance = rng.uniform(*options.start_distance_m)
        hand = tag.world_from_tag.apply([distance * np.sin(angle), 0.0, distance * np.cos(angle)])
        toward = tag.world_from_tag.translation - hand
        yaw = float(np.arctan2(toward[1], toward[0]) + rng.uniform(-0.15, 0.15))
        arm = looking_at(robot.standing([0.0, 0.0], 0.0), np.array([2.0, 0.0, tag.world_from_tag.translation[2]]))
        reach = robot.body_from_camera(arm).translation[0]
        body = robot.standing(hand[:2] - reach * np.array([np.cos(yaw), np.sin(yaw)]), yaw)
        if not scene.free_floor(body.translation[:2], options.stand_radius_m)[0]:
            continue
        if np.linalg.norm(graph.centres - body.translation[:2], axis=1).min() > 0.15:
            continue
        view = body * robot.body_from_camera(looking_at(body, tag.world_from_tag.translation))
        low, high = np.radians(options.start_slant_deg[0]) * 0.7, np.radians(options.start_slant_deg[1]) * 1.2
        good = low < slant(view, tag) < high and sees(scene, view, robot.ARM_CAMERA, tag, margin_px=60.0)
        if good and clear_around(scene, view.translation, radius_m=0.15):
            return body
    return None


def looking_at(
    world_from_body: Pose, target_m: Array, *, sh1: float = robot.RAISED_SH1, el0: float = -robot.RAISED_SH1
) -> robot.ArmJoints:
    """Return the joints with which the arm camera of a body looks at a target (3,) in the world."""
    target = world_from_body.inv().apply(target_m)
    arm = robot.looking(float(np.arctan2(target[1], target[0] - robot.SHOULDER_M[0])), 0.0, sh1=sh1, el0=el0)
    for _ in range(4):
        at = robot.body_from_camera(arm)
        x, y, z = target - at.translation
        pitch = float(np.arctan2(z, np.hypot(x, y)))
        side = float(at.inv().apply(target)[0] / np.linalg.norm(target - at.translation))
        arm = robot.looking(arm.sh0 - 0.5 * np.arcsin(np.clip(side, -0.9, 0.9)), pitch, sh1=sh1, el0=el0)
    return arm


def _place_waypoint(stage: Stage, options: StageOptions, *, index: int, rng: np.random.Generator) -> Waypoint:
    """Choose the free place that is farthest from the start and the other waypoints, with room for a tripod."""
    bodies = [stage.world_from_start, *(w.world_from_body for w in stage.waypoints)]
    taken = np.array([pose.translation[:2] for pose in (*bodies, *(t.world_from_tag for t in stage.tags))])
    ways = largest_part(floor_graph(stage.scene, options.drive_radius_m))
    roomy = ways.centres[stage.scene.free_floor(ways.centres, options.waypoint_radius_m)]
    spots = roomy[rng.permutation(len(roomy))[:400]]
    far = np.linalg.norm(spots[:, None] - taken[None], axis=2).min(axis=1)
    for spot in spots[np.argsort(-far, kind="stable")][:80]:
        body = robot.standing(spot, float(rng.uniform(-np.pi, np.pi)))
        if _sweep_is_clear(stage.scene, body):
            waypoint = _with_tripod_near(stage, body, options, index=index, rng=rng)
            if waypoint is not None:
                return waypoint
    raise SynthesisError(
        f"the scene has no room for waypoint {index + 1} of {options.waypoints}", hint="ask for fewer waypoints"
    )


def _sweep_is_clear(scene: Scene, body: Pose) -> bool:
    arms = [robot.looking(float(yaw), 0.0) for yaw in np.linspace(*robot.SH0_RANGE_RAD, 12)]
    views = [body * robot.body_from_camera(arm) for arm in (robot.STOWED, *arms)]
    return all(clear_around(scene, view.translation, radius_m=0.12) for view in views)


def _with_tripod_near(
    stage: Stage, body: Pose, options: StageOptions, *, index: int, rng: np.random.Generator
) -> Waypoint | None:
    """Put a tripod near the robot where the arm sees its tag at a slant, a photographer fits, and no way is blocked.

    Of a few such places the one before the richest background is taken: a photo has to be localized by it.
    """
    scene = stage.scene
    bodies = [stage.world_from_start, *(w.world_from_body for w in stage.waypoints), body]
    points = [pose.translation[:2] for pose in bodies]
    keep_off = np.array([*points[:-1], *(t.world_from_tag.translation[:2] for t in stage.tags)])
    best: tuple[int, Waypoint] | None = None
    found = 0
    for _ in range(60):
        tag = _propose_tripod(body, options, index=index, rng=rng)
        at = tag.world_from_tag.translation[:2]
        if not scene.free_floor(at, 0.16)[0] or np.linalg.norm(at - body.translation[:2]) < 0.75:
            continue
        if np.linalg.norm(keep_off - at, axis=1).min() < 1.0 or not _room_for_photos(scene, tag):
            continue
        arms = _truth_arms(scene, body, tag, options, rng=rng)
        if len(arms) < options.truth_sightings:
            continue
        if not floor_graph(with_tag(scene, tag), options.drive_radius_m).connects(points):
            continue
        value = _background(scene, tag)
        if best is None or value > best[0]:
            best = (value, Waypoint(f"w{index + 1:02d}", body, tag, arms))
        found += 1
        if found == options.tripod_places:
            break
    return None if best is None else best[1]


def _propose_tripod(body: Pose, options: StageOptions, *, index: int, rng: np.random.Generator) -> PlacedTag:
    shoulder = body.apply(robot.SHOULDER_M)
    azimuth = rng.uniform(-np.pi, np.pi)
    distance = rng.uniform(*options.tripod_distance_m)
    at = shoulder + distance * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    at[2] = rng.uniform(0.75, 1.0)
    away = azimuth + np.pi + np.radians(rng.uniform(26.0, 34.0)) * rng.choice([-1.0, 1.0])
    tilt, roll = np.radians(rng.normal(0.0, 2.0, 2))
    pose = facing(at, away, pitch_rad=tilt, roll_rad=roll)
    return PlacedTag(options.first_tripod_id + index, options.tag_size_m, pose, visit=f"w{index + 1:02d}")


def _background(scene: Scene, tag: PlacedTag) -> int:
    """Return how much three photos of a tag, from the left, the middle and the right, would show."""
    eyes = tag.world_from_tag.apply([[x, 0.55, 1.3] for x in (-0.9, 0.0, 0.9)])
    return sum(richness(scene, look_at(eye, tag.world_from_tag.translation)) for eye in eyes)


def _truth_arms(
    scene: Scene, body: Pose, tag: PlacedTag, options: StageOptions, *, rng: np.random.Generator
) -> tuple[robot.ArmJoints, ...]:
    """Return arm poses, far from each other, that see a tag near and at a slant; fewer than asked where few do."""
    found, centres = [], []
    for trial in range(150):
        sh1 = robot.RAISED_SH1 + rng.uniform(-0.4, 0.7)
        direct = looking_at(body, tag.world_from_tag.translation, sh1=sh1, el0=-sh1 + rng.uniform(-0.4, 0.3))
        turned = [rng.uniform(-0.25, 0.25), 0.0, 0.0, 0.0, rng.uniform(-0.2, 0.2), 0.0]
        arm = robot.joints(direct.as_array() + turned)
        view = body * robot.body_from_camera(arm)
        distance = float(np.linalg.norm(view.translation - tag.world_from_tag.translation))
        low, high = np.radians(options.truth_slant_deg)
        near = options.truth_distance_m[0] <= distance <= options.truth_distance_m[1] and robot.within_limits(arm)
        good = near and low <= slant(view, tag) <= high and clear_around(scene, view.translation, radius_m=0.1)
        if good and sees(scene, view, robot.ARM_CAMERA, tag, margin_px=25.0):
            found.append(arm)
            centres.append(view.translation)
        if trial == 30 and not found:
            return ()
    chosen: list[int] = []
    while len(chosen) < min(options.truth_sightings, len(found)):
        gaps = [min((float(np.linalg.norm(c - centres[k])) for k in chosen), default=np.inf) for c in centres]
        chosen.append(int(np.argmax([-1.0 if k in chosen else gap for k, gap in enumerate(gaps)])))
    return tuple(found[k] for k in chosen)


def _room_for_photos(scene: Scene, tag: PlacedTag) -> bool:
    """Return whether enough places in front of a tag are free to stand there with a camera."""
    angles, distances = np.meshgrid(np.radians(np.arange(-50.0, 51.0, 10.0)), np.arange(0.9, 2.2, 0.15))
    offsets = np.stack([distances * np.sin(angles), np.zeros_like(angles), distances * np.cos(angles)], axis=-1)
    spots = tag.world_from_tag.apply(offsets.reshape(-1, 3))
    free = scene.free_floor(spots[:, :2], 0.2)
    rays = spots - tag.world_from_tag.translation
    begin = tag.world_from_tag.apply([0.0, 0.0, 0.01])
    return int((free & (scene.intersect(begin, rays) > np.linalg.norm(rays, axis=1))).sum()) >= 25
