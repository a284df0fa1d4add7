"""Robots that stand before tags and walk to a waypoint, with every noise drawn as the toolkit states it; no images."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
from scipy.spatial.transform import Rotation

from fieldkit.cameras import Camera
from fieldkit.errors import BagError
from fieldkit.frames import Array, Pose, Trajectory, exp, yaw_pose
from fieldkit.protocol import ArmNoise, OdometryNoise
from fieldkit.tags import tag_corners
from fieldkit.types import Frame, Image, Recording, SeenTag, Start, TagMap, TagPose, View, Visit

CAMERA = Camera("OPENCV", 640, 480, (552.0, 552.0, 320.0, 240.0, -0.1, 0.03, 0.0005, -0.0005))
SIZE_M, SECOND = 0.1365, 1_000_000_000
# cam z forward, x right, y down of a body x forward, z up
_AXES = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
# tag x right, y up, z out of the paper, facing a robot that looks along x
_FACING = Rotation.from_matrix([[0, 0, -1], [-1, 0, 0], [0, 1, 0]])


@dataclasses.dataclass(frozen=True)
class Settings:
    """What is simulated: noises as stated, and by how much the true ones differ."""

    odometry: OdometryNoise = dataclasses.field(default_factory=OdometryNoise)
    arm: ArmNoise = dataclasses.field(default_factory=ArmNoise)
    corner_px: float = 0.2
    states_sigma: bool = True
    tag_m: float = 0.002
    tag_deg: float = 0.1
    n_start_tags: int = 1
    n_start: int = 8
    n_truth: int = 12
    n_blind: int = 8
    image_factor: float = 1.0
    step_m: float = 0.0
    walk_m: float = 6.0


@dataclasses.dataclass(frozen=True)
class Standing:
    """A recording without images, its tags as calibrated, and where body and cameras truly were."""

    recording: Recording
    tags: TagMap
    map_from_body: Pose
    map_from_cam: dict[str, Pose]

    @property
    def visit(self) -> Visit:
        return self.recording.visits[0]


def stand(rng: np.random.Generator, settings: Settings) -> Standing:
    """Draw a session: stand at the start tags, walk to a waypoint, look at its tripod tag and around."""
    s = settings
    start = yaw_pose([0.0, 0.0, 0.0], rng.uniform(-math.pi, math.pi))
    true, times = _walk(rng, start, s)
    odometry = Trajectory(times, tuple(_believed(rng, true, s.odometry)), "odom", "body")
    body = Trajectory(times, tuple(true), "map", "body")
    shared = exp(_draw(rng, s.arm.camera_deg, s.arm.camera_m)), exp(_draw(rng, s.arm.base_deg, s.arm.base_m))
    truths: dict[int, Pose] = {}
    placed = [(f"s{k}", start * _before(rng, k), 1 + k) for k in range(s.n_start_tags)]
    tripod = body.at(25 * SECOND) * _before(rng, 0), 99

    def frame(t_ns: int, tags: list[tuple[Pose, int]], aim: Pose | None) -> Frame:
        map_from_body = body.at(t_ns)
        measured = _arm(rng, map_from_body.inv() * tags[0][0]) if aim is None else aim
        noise = exp(s.image_factor * _draw(rng, s.arm.image_deg, s.arm.image_m))
        map_from_cam = map_from_body * shared[1] * measured * shared[0] * noise
        truths[t_ns] = map_from_cam
        seen = [_seen(rng, map_from_cam.inv() * pose, tag_id, s) for pose, tag_id in tags]
        return Frame(t_ns, CAMERA, measured, _no_image, tuple(t for t in seen if t is not None))

    start_tags = [(pose, tag_id) for _, pose, tag_id in placed]
    at_start = [frame(round((2 + 0.2 * i) * SECOND), start_tags, None) for i in range(s.n_start)]
    at_visit = []
    for i in range(s.n_truth + s.n_blind):
        blind = i >= s.n_truth
        yaw = rng.uniform(0.8, 2 * math.pi - 0.8)
        aim = (
            Pose.from_rotation(Rotation.from_euler("z", yaw)) * Pose.from_components([0.4, 0, 0.6], _AXES)
            if blind
            else None
        )
        at_visit.append(frame(round((21 + 0.4 * i) * SECOND), [tripod], aim))
    views = tuple(View(f"{i:02d}", "sweep", f) for i, f in enumerate(at_visit))
    visit = Visit("w01", 20 * SECOND, 40 * SECOND, views, truth_tag_id=99)
    recording = Recording(
        "s", "s.mcap", "generic", (*at_start, *at_visit), odometry, (Start(1, 0, 10 * SECOND),), (visit,)
    )  # fmt: skip
    covariance = _diagonal(s.tag_deg, s.tag_m)
    tags = tuple(
        TagPose(tag_id, "tag36h11", SIZE_M, pose * exp(_draw(rng, s.tag_deg, s.tag_m)), covariance, 8, 0.2, visit=name)
        for pose, tag_id, name in [*((p, i, None) for _, p, i in placed), (*tripod, "w01")]
    )
    cams = {v.id: truths[v.frame.t_ns] for v in views}
    return Standing(recording, TagMap(tags, (), "map", path="tags.toml"), body.at(visit.t_begin_ns), cams)


def _walk(rng: np.random.Generator, start: Pose, s: Settings) -> tuple[list[Pose], Array]:
    """Return true poses of the body and their times: still until 10 s, walking until 20 s, then one step if any."""
    times = np.arange(0, 42 * SECOND, SECOND // 10, dtype=np.int64)
    poses, bend = [start], rng.uniform(-0.5, 0.5)
    for t_ns in times[1:]:
        step = None
        if s.walk_m and 10 * SECOND < t_ns <= 19 * SECOND:
            step = yaw_pose([s.walk_m / 90, 0, 0], bend * s.walk_m / 90)
        if s.step_m and abs(int(t_ns) - 25 * SECOND) < SECOND // 20:
            angle = rng.uniform(-math.pi, math.pi)
            step = yaw_pose([s.step_m * math.cos(angle), s.step_m * math.sin(angle), 0], rng.normal(0, s.step_m))
        poses.append(poses[-1] if step is None else poses[-1] * step)
    return poses, times


def _believed(rng: np.random.Generator, true: list[Pose], noise: OdometryNoise) -> list[Pose]:
    """Return odometry of true poses: constant biases and random walks, as `OdometryNoise` says."""
    yaw_m, yaw_turn = math.radians(noise.yaw_deg_per_m) * rng.normal(), noise.yaw_deg_per_turn_deg * rng.normal()
    drift = noise.position_per_m * rng.normal(size=3)
    poses = [Pose.from_components(rng.uniform(-20, 20, 3), Rotation.from_euler("z", rng.uniform(-3, 3)))]
    for before, after in itertools.pairwise(true):
        if after is before:
            poses.append(poses[-1])
            continue
        moved = before.inv() * after
        length, turn = float(np.linalg.norm(moved.translation)), float(moved.rotation.magnitude())
        yaw = (
            yaw_m * length + yaw_turn * turn + math.radians(noise.yaw_deg_per_root_m) * math.sqrt(length) * rng.normal()
        )
        shift = drift * length + noise.position_per_root_m * math.sqrt(length) * rng.normal(size=3)
        shifted = poses[-1] * moved * exp([0, 0, yaw, 0, 0, 0])
        poses.append(Pose.from_components(shifted.translation + shift, shifted.rotation))
    return poses


def _before(rng: np.random.Generator, k: int) -> Pose:
    """Return body_from_tag of a tag before the robot, each further to the side."""
    slant = Rotation.from_euler("zyx", rng.uniform([-0.6, -0.2, -0.1], [0.6, 0.2, 0.1]))
    return Pose.from_components([rng.uniform(1.4, 2.0), 0.25 * k, rng.uniform(0.3, 0.8)], _FACING * slant)


def _arm(rng: np.random.Generator, body_from_tag: Pose) -> Pose:
    """Return body_from_cam of an arm that looks at a tag from somewhere, not quite into its middle."""
    at = np.array([0.5, 0.0, 0.6]) + rng.uniform(-0.25, 0.25, 3)
    forward = body_from_tag.translation - at
    yaw, pitch = math.atan2(forward[1], forward[0]), math.atan2(forward[2], math.hypot(forward[0], forward[1]))
    off = rng.uniform(-0.12, 0.12, 2)
    turned = Rotation.from_euler("ZYX", [yaw + off[0], -pitch + off[1], rng.uniform(-0.2, 0.2)])
    return Pose.from_components(at, turned * _AXES)


def _seen(rng: np.random.Generator, cam_from_tag: Pose, tag_id: int, s: Settings) -> SeenTag | None:
    pixels, inside = CAMERA.project(cam_from_tag.apply(tag_corners(SIZE_M)))
    if not inside.all():
        return None
    noisy = pixels + s.corner_px * rng.normal(size=(4, 2))
    return SeenTag(tag_id, "tag36h11", noisy, s.corner_px if s.states_sigma else None)


def _draw(rng: np.random.Generator, degrees: float, metres: float) -> Array:
    return rng.normal(size=6) * ([math.radians(degrees)] * 3 + [metres] * 3)


def _diagonal(degrees: float, metres: float) -> Array:
    return np.diag([math.radians(degrees) ** 2] * 3 + [metres**2] * 3)


def _no_image() -> Image:
    raise BagError("no image, only tag detections; expected none to be read")
