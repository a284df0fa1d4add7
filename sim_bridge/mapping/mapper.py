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
from sim_bridge.rendering import render
from sim_bridge.sensors import effects

Array = NDArray[np.float64]

# The simulated intrinsics of the paper's HoloLens 2 cameras (portrait).
VLC = Camera("PINHOLE", 480, 640, (366.88, 365.71, 240.0, 320.0))
# Size and field of view (75 x 70 deg) of the long-throw depth camera.
DEPTH = Camera("PINHOLE", 320, 288, (208.5, 208.5, 160.0, 144.0))
BASELINE_M = 0.0995
OUTWARDS_DEG = 52.0
LOOP_STEP_M = 0.05


@dataclasses.dataclass(frozen=True)
class WalkOptions:
    """How the walk is taken and how well the device tracks itself.

    ``laps`` above 1 repeats the beginning, so that the walk closes. The drift is a random walk per root of metre.
    """

    stations: int = 54
    laps: float = 1.04
    height_m: float = 1.65
    look_around_deg: float = 15.0
    noise_sigma: float = 1.5
    jpeg_quality: int = 95
    drift_m: float = 0.005
    drift_yaw_deg: float = 0.1
    tilt_deg: float = 0.1
    depth_far_m: float = 6.0
    depth_noise: float = 0.002


@dataclasses.dataclass(frozen=True)
class Station:
    """One place of the walk: its frame name, the true pose of the rig, and the pose that its SLAM believes."""

    frame: str
    world_from_rig: Pose
    slam_from_rig: Pose


def hololens_rig() -> Rig:
    """Return the rig: LF and RF look forward, LL and RR are turned outwards; the rig frame has x forward, z up."""
    side = 0.5 * BASELINE_M
    places = {
        "ll": ((-0.005, side + 0.02, 0.0), OUTWARDS_DEG),
        "lf": ((0.0, side, 0.0), 0.0),
        "rf": ((0.0, -side, 0.0), 0.0),
        "rr": ((-0.005, -side - 0.02, 0.0), -OUTWARDS_DEG),
    }
    cameras = tuple(RigCamera(name, VLC, _mounted(at, yaw)) for name, (at, yaw) in places.items())
    return Rig(cameras, RigCamera("depth", DEPTH, _mounted((0.01, 0.0, 0.03), 0.0, pitch_deg=-8.0)))


def _mounted(position_m: tuple[float, float, float], yaw_deg: float, *, pitch_deg: float = 0.0) -> Pose:
    rotation = turn(np.radians(yaw_deg), np.radians(pitch_deg)) * UPRIGHT_FROM_CAM
    return Pose.from_components(np.asarray(position_m), rotation)


def walk(scene: Scene, options: WalkOptions, *, rng: np.random.Generator) -> tuple[Station, ...]:
    """Walk along the scene's loop and return the stations, evenly spaced, with natural bob and turning of the head.

    SLAM's frame starts below the first station, z up.
    """
    path, tangent = _smooth_loop(scene, step_m=LOOP_STEP_M)
    count, phase = options.stations, rng.uniform(0.0, 2 * np.pi, 4)
    at, metres = _places(len(path), tangent, options)
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
    return tuple(Station(f"{i:06d}", true, slam) for i, (true, slam) in enumerate(zip(poses, believed, strict=True)))


def _places(length: int, heading: Array, options: WalkOptions) -> tuple[NDArray[np.intp], Array]:
    """Return the index on the loop of every station and the metres walked there.

    A quarter turn takes as many stations as a metre and a half: views of neighbours overlap in bends, too.
    """
    index = np.arange(int(np.ceil(options.laps * length)) + 1)
    laps, rest = np.divmod(index, length)
    total_turn = heading[-1] - heading[0] + _wrapped(heading[0] - heading[-1])
    turned = np.abs(np.diff(heading[rest] + laps * total_turn))
    effort = np.concatenate([[0.0], np.cumsum(LOOP_STEP_M + turned * (1.5 / (np.pi / 2)))])
    wanted = np.linspace(0.0, effort[-1], options.stations, endpoint=False)
    place = np.searchsorted(effort, wanted)
    return rest[place].astype(np.intp), place.astype(np.float64) * LOOP_STEP_M


def _smooth_loop(scene: Scene, *, step_m: float) -> tuple[Array, Array]:
    """Return the scene's loop as points (n, 2), rounded as far as the free floor allows, and its heading (n,)."""
    corners = np.vstack([scene.walk_xy, scene.walk_xy[:1]])
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
    scene: Scene, stations: tuple[Station, ...], options: WalkOptions, *, rng: np.random.Generator
) -> Iterator[tuple[str, Pose, bytes]]:
    """Render every image of the walk: yield its name (``lf/000012.jpg``), world_from_cam, and the JPEG file."""
    rig = hololens_rig()
    for station in stations:
        for mounted in rig.cameras:
            world_from_cam = station.world_from_rig * mounted.rig_from_cam
            shot = effects.grey(render(scene, mounted.camera, world_from_cam).rgb)
            noisy = effects.add_noise(shot, sigma=options.noise_sigma, rng=rng)
            data = effects.jpeg(noisy, quality=options.jpeg_quality)
            yield f"{mounted.name}/{station.frame}.jpg", world_from_cam, data


def depths(
    scene: Scene, stations: tuple[Station, ...], options: WalkOptions, *, rng: np.random.Generator
) -> Iterator[tuple[str, bytes]]:
    """Render every depth image of the walk: yield its name (``000012.png``) and the PNG file."""
    rig = hololens_rig()
    assert rig.depth is not None
    for station in stations:
        world_from_cam = station.world_from_rig * rig.depth.rig_from_cam
        exact = render(scene, rig.depth.camera, world_from_cam).depth_m
        noise = rng.standard_normal(exact.shape, dtype=np.float32) * np.float32(options.depth_noise)
        yield f"{station.frame}.png", effects.depth_png(exact * (1.0 + noise), far_m=options.depth_far_m)
