"""The mapping walk: a head-mounted rig like HoloLens 2, its images, depth, and SLAM poses that drift."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from fieldkit.cameras import Camera
from fieldkit.frames import Pose
from fieldkit.store import Rig, RigCamera
from sim_bridge.aim import UPRIGHT_FROM_CAM, turn
from sim_bridge.mesh import Scene
from sim_bridge.rendering import render, render_depth
from sim_bridge.sensors import ColourSensor, DepthSensor, Motion, bent, effects, encode, expose, sense_depth
from sim_bridge.stage import tours

Array = NDArray[np.float64]

# The simulated intrinsics of the paper's HoloLens 2 cameras (portrait).
VLC = Camera("PINHOLE", 480, 640, (366.88, 365.71, 240.0, 320.0))
# Size and field of view (75 x 70 deg) of the long-throw depth camera.
DEPTH = Camera("PINHOLE", 320, 288, (208.5, 208.5, 160.0, 144.0))
BASELINE_M = 0.0995
OUTWARDS_DEG = 52.0
LOOP_STEP_M = 0.05
# A quarter turn counts as a metre and a half of walking.
METRES_PER_QUARTER_TURN = 1.5
# As does the step into another room.
METRES_PER_NEW_VIEW = 2.0
# Each station takes four images.
STATIONS_PER_M2 = 1.0
LEAST_STATIONS, MOST_STATIONS = 12, 150
# What 16 bits of millimetres can hold.
DEPTH_FAR_M = 65.0


@dataclasses.dataclass(frozen=True)
class WalkOptions:
    """How the walk is taken and how well the device tracks itself.

    ``stations`` None takes STATIONS_PER_M2 of the floor that can be seen, within limits. A tour passes a share
    ``covers`` of the free floor. ``laps`` above 1 repeats the beginning, so that the walk closes. The drift is a random
    walk per root of metre.
    """

    stations: int | None = None
    covers: float = 0.62
    laps: float = 1.04
    height_m: float = 1.65
    look_around_deg: float = 25.0
    speed_m_s: float = 0.6
    turning_deg_s: float = 12.0
    drift_m: float = 0.005
    drift_yaw_deg: float = 0.1
    tilt_deg: float = 0.1


@dataclasses.dataclass(frozen=True)
class Station:
    """One place of the walk: its frame name, the true pose of the rig, and the pose that its SLAM believes.

    ``angular_rad_s`` and ``linear_m_s`` (3,) are how the rig moves, in its own frame.
    """

    frame: str
    world_from_rig: Pose
    slam_from_rig: Pose
    angular_rad_s: Array
    linear_m_s: Array


def hololens_rig(sensor: ColourSensor | None = None) -> Rig:
    """Return the rig: LF and RF look forward, LL and RR are turned outwards; the rig frame has x forward, z up.

    The grey cameras have the lens of ``sensor``, by default none.
    """
    vlc = bent(VLC, sensor or ColourSensor())
    side = 0.5 * BASELINE_M
    places = {
        "ll": ((-0.005, side + 0.02, 0.0), OUTWARDS_DEG),
        "lf": ((0.0, side, 0.0), 0.0),
        "rf": ((0.0, -side, 0.0), 0.0),
        "rr": ((-0.005, -side - 0.02, 0.0), -OUTWARDS_DEG),
    }
    cameras = tuple(RigCamera(name, vlc, _mounted(at, yaw)) for name, (at, yaw) in places.items())
    return Rig(cameras, RigCamera("depth", DEPTH, _mounted((0.01, 0.0, 0.03), 0.0, pitch_deg=-8.0)))


def _mounted(position_m: tuple[float, float, float], yaw_deg: float, *, pitch_deg: float = 0.0) -> Pose:
    rotation = turn(np.radians(yaw_deg), np.radians(pitch_deg)) * UPRIGHT_FROM_CAM
    return Pose.from_components(np.asarray(position_m), rotation)


def walk(scene: Scene, options: WalkOptions, *, rng: np.random.Generator) -> tuple[Station, ...]:
    """Walk along the scene's loop and return the stations, evenly spaced, with natural bob and turning of the head.

    A scene without a loop of its own is toured by a short way there and back, as a person with little time would:
    some floor is never walked on. SLAM's frame starts below the first station, z up.
    """
    if len(scene.walk_xy):
        path, tangent = _smooth_loop(scene, scene.walk_xy, step_m=LOOP_STEP_M)
    else:
        loop = tours.tour(scene, covers=options.covers)
        path, tangent = _and_back(*_smooth_loop(scene, loop, step_m=LOOP_STEP_M))
    phase = rng.uniform(0.0, 2 * np.pi, 4)
    count = options.stations or _count(scene)
    at, metres = _places(_change(scene, path, options), tangent, count, laps=options.laps)
    around = np.radians(options.look_around_deg)
    yaw = tangent[at] + around * np.sin(2 * np.pi * metres / 5.3 + phase[0])
    yaw = yaw + np.radians(rng.normal(0.0, 1.5, count))
    pitch = np.radians(-8.0 + 9.0 * np.sin(2 * np.pi * metres / 2.7 + phase[1]) + rng.normal(0.0, 1.0, count))
    roll = np.radians(2.0 * np.sin(2 * np.pi * metres / 3.3 + phase[2]) + rng.normal(0.0, 0.7, count))
    bob = 0.025 * np.sin(2 * np.pi * metres / 0.71 + phase[3]) + rng.normal(0.0, 0.008, count)
    poses = tuple(
        Pose.from_components([*path[k], options.height_m + bob[i]], turn(yaw[i], pitch[i], roll[i]))
        for i, k in enumerate(at)
    )
    believed = drifting(poses, options, rng=rng)
    turning = np.radians(options.turning_deg_s) * rng.standard_normal((count, 3)) * (0.3, 0.7, 1.0)
    walking = [
        pose.rotation.inv().apply(turn(tangent[k]).apply([options.speed_m_s, 0.0, 0.0]))
        for pose, k in zip(poses, at, strict=True)
    ]
    return tuple(
        Station(f"{i:06d}", *parts) for i, parts in enumerate(zip(poses, believed, turning, walking, strict=True))
    )


def _change(scene: Scene, path: Array, options: WalkOptions) -> Array:
    """Return how much of all around comes into view or goes out of it at each step of a path, f64[n] in 0..1.

    In the middle of a room it is almost nothing; through a doorway it adds up to about one.
    """
    if not len(scene.faces):
        return np.zeros(len(path))
    angles = np.linspace(0.0, 2 * np.pi, 90, endpoint=False)
    rays = np.column_stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)])
    eyes = np.column_stack([path, np.full(len(path), options.height_m)])
    distance = scene.intersect(np.repeat(eyes, len(rays), axis=0), np.tile(rays, (len(path), 1)))
    seen = np.log(np.minimum(distance, 20.0)).reshape(len(path), -1)
    changed = (np.abs(seen - np.roll(seen, 1, axis=0)) > 0.25).mean(axis=1)
    return gaussian_filter1d(changed, 0.2 / LOOP_STEP_M, mode="wrap")


def _count(scene: Scene) -> int:
    """Return how many stations a floor of this size is worth."""
    graph, _ = tours.walkable(scene)
    return min(max(round(STATIONS_PER_M2 * tours.shown_area_m2(scene, graph)), LEAST_STATIONS), MOST_STATIONS)


def _places(change: Array, heading: Array, count: int, *, laps: float) -> tuple[NDArray[np.intp], Array]:
    """Return the index on the loop of every station and the metres walked there.

    A quarter turn takes as many stations as a metre and a half, and a doorway as many as some metres: views of
    neighbours overlap in bends and from room to room, too.
    """
    length = len(change)
    index = np.arange(int(np.ceil(laps * length)) + 1)
    lap, rest = np.divmod(index, length)
    total_turn = heading[-1] - heading[0] + _wrapped(heading[0] - heading[-1])
    turned = np.abs(np.diff(heading[rest] + lap * total_turn))
    per_rad = METRES_PER_QUARTER_TURN / (np.pi / 2)
    step = LOOP_STEP_M + turned * per_rad + change[rest[1:]] * METRES_PER_NEW_VIEW
    effort = np.concatenate([[0.0], np.cumsum(step)])
    wanted = np.linspace(0.0, effort[-1], count, endpoint=False)
    place = np.searchsorted(effort, wanted)
    return rest[place].astype(np.intp), place.astype(np.float64) * LOOP_STEP_M


def _and_back(path: Array, heading: Array) -> tuple[Array, Array]:
    """Return a closed path (n, 2) walked once each way, and the heading (2n,), with a turn on the spot in between."""
    both = np.concatenate([heading, heading[::-1] + np.pi])
    # The turns take about a metre, and the second undoes the first.
    return np.vstack([path, path[::-1]]), gaussian_filter1d(both, 0.5 / LOOP_STEP_M, mode="wrap")


def _smooth_loop(scene: Scene, loop: Array, *, step_m: float) -> tuple[Array, Array]:
    """Return a closed loop as points (n, 2), rounded as far as the free floor allows, and its heading (n,)."""
    corners = np.vstack([loop, loop[:1]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    count = max(round(along[-1] / step_m), 8)
    at = np.linspace(0.0, along[-1], count, endpoint=False)
    sharp = np.column_stack([np.interp(at, along, corners[:, k]) for k in range(2)])
    path = sharp
    for radius_m in (0.5, 0.35, 0.2, 0.1):
        smooth = gaussian_filter1d(sharp, radius_m / step_m, axis=0, mode="wrap")
        if scene.free_floor(smooth, 0.2).all():
            path = smooth
            break
    delta = np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0)
    heading = np.unwrap(np.arctan2(delta[:, 1], delta[:, 0]))
    turns = heading[-1] - heading[0] + _wrapped(heading[0] - heading[-1])
    ramp = np.linspace(0.0, turns, count, endpoint=False)
    return path, gaussian_filter1d(heading - ramp, 0.8 / step_m, mode="wrap") + ramp


def _wrapped(angle: float) -> float:
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def drifting(poses: tuple[Pose, ...], options: WalkOptions, *, rng: np.random.Generator) -> tuple[Pose, ...]:
    """Return slam_from_rig of true poses world_from_rig: increments with errors that grow with the metres walked.

    Position and yaw drift; gravity is observed, so roll and pitch only err by a small independent tilt.
    """
    first = poses[0]
    yaw0 = float(np.arctan2(*first.rotation.apply([1.0, 0.0, 0.0])[1::-1]))
    slam_from_world = Pose.from_components([*first.translation[:2], 0.0], turn(yaw0)).inv()
    error_yaw, error_xyz = 0.0, np.zeros(3)
    result = [slam_from_world * first]
    for before, after in itertools.pairwise(poses):
        root = np.sqrt(float(np.linalg.norm(after.translation - before.translation)))
        error_yaw += np.radians(options.drift_yaw_deg) * root * rng.standard_normal()
        step = slam_from_world.rotation.apply(after.translation - before.translation)
        moved = turn(error_yaw).apply(step) - step
        error_xyz = error_xyz + moved + options.drift_m * root * rng.standard_normal(3) * (1.0, 1.0, 0.5)
        true = slam_from_world * after
        tilt = Rotation.from_rotvec([*np.radians(options.tilt_deg) * rng.standard_normal(2), 0.0])
        result.append(Pose.from_components(true.translation + error_xyz, turn(error_yaw) * tilt * true.rotation))
    return tuple(result)


def images(
    scene: Scene, stations: tuple[Station, ...], sensor: ColourSensor, *, rng: np.random.Generator
) -> Iterator[tuple[str, Pose, bytes]]:
    """Render every image of the walk: yield its name (``lf/000012.jpg``), world_from_cam, and the JPEG file."""
    rig = hololens_rig(sensor)
    for station in stations:
        for mounted in rig.cameras:
            world_from_cam = station.world_from_rig * mounted.rig_from_cam
            rendered = render(scene, mounted.camera, world_from_cam)
            shot = expose(
                effects.grey(rendered.rgb),
                sensor,
                camera=mounted.camera,
                motion=_motion(station, mounted),
                depth_m=rendered.depth_m,
                rng=rng,
            )
            yield f"{mounted.name}/{station.frame}.jpg", world_from_cam, encode(shot, sensor)


def depths(
    scene: Scene, stations: tuple[Station, ...], sensor: DepthSensor, *, rng: np.random.Generator
) -> Iterator[tuple[str, bytes]]:
    """Render every depth image of the walk: yield its name (``000012.png``) and the PNG file."""
    mounted = hololens_rig().depth
    assert mounted is not None
    for station in stations:
        exact = render_depth(scene, mounted.camera, station.world_from_rig * mounted.rig_from_cam)
        measured = sense_depth(exact, sensor, camera=mounted.camera, rng=rng)
        yield f"{station.frame}.png", effects.depth_png(measured, far_m=DEPTH_FAR_M)


def _motion(station: Station, mounted: RigCamera) -> Motion:
    """Return how a camera of the rig moves: with the rig, and around its origin."""
    lever = mounted.rig_from_cam.translation
    linear = station.linear_m_s + np.cross(station.angular_rad_s, lever)
    cam_from_rig = mounted.rig_from_cam.rotation.inv()
    return Motion(cam_from_rig.apply(station.angular_rad_s), cam_from_rig.apply(linear))
