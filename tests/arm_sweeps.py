"""Recordings of an arm that sweeps its camera over a tag, by sim_bridge; calibrations that are stated wrongly."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import numpy as np

from fieldkit.bags import RecordingWriter
from fieldkit.cameras import Camera
from fieldkit.frames import Array, Pose, exp, log
from sim_bridge import robot
from sim_bridge.recording import recorder
from sim_bridge.recording.recorder import Sensed
from sim_bridge.recording.schedule import Schedule, Shot, lagging
from sim_bridge.scenes import make_scene
from sim_bridge.sensors import STANDARD, Sensors
from sim_bridge.stage import staging
from sim_bridge.stage.paths import Track, TrackBuilder

SIZE_M = 0.1365
STAGE = staging.StageOptions(waypoints=0, start_places=1)


@dataclasses.dataclass(frozen=True)
class Swept:
    """What was sensed of the tag, and where the camera truly sits in the wrist."""

    sensed: Sensed
    wrist_from_camera: Pose


@dataclasses.dataclass(frozen=True)
class Stated:
    """What a recording says wrongly: the truth is hand_from_cam * Exp(hand), stamps are late, focal too long."""

    hand: tuple[float, ...] = (0.0,) * 6
    late_ns: int = 0
    focal: float = 0.0


@functools.cache
def before_tag() -> staging.Stage:
    """A robot that stands before the start tag of a room."""
    return staging.set_stage(make_scene("room", 0), STAGE, rng=np.random.default_rng(0))


def sweep(
    seed: int,
    *,
    poses: int = 20,
    moving: bool = True,
    turning: tuple[str, ...] = robot.JOINTS,
    kinematics: robot.KinematicOptions = robot.KinematicOptions(),
    sensors: Sensors = STANDARD,
) -> Swept:
    """Stand before a tag and let the arm go through random poses that see it, with images there and on the way."""
    rng = np.random.default_rng(seed)
    stage = before_tag()
    arms = _arms(stage, poses, turning, rng)
    track, shots = TrackBuilder(arms[0].as_array()), []
    track.hold(1.0)
    for before, arm in zip(arms, arms[1:], strict=False):
        seconds = max(0.4, 1.5 * float(np.abs(arm.as_array() - before.as_array()).max()) / 0.7)
        if moving:
            shots.append(Shot(track.t_s + seconds * float(rng.uniform(0.3, 0.7))))
        track.move(arm.as_array(), seconds=seconds)
        track.hold(0.4)
        shots.append(Shot(track.t_s))
        track.hold(0.05)
    track.hold(1.0)
    body = stage.world_from_start
    x, y, _ = body.translation
    forward = body.rotation.apply([1.0, 0.0, 0.0])
    still = Track(np.array([0.0]), np.array([[x, y, np.arctan2(forward[1], forward[0])]]))
    schedule = Schedule(
        still, lagging(track.build(), 0.06, end_s=track.t_s), tuple(shots), (), track.t_s, np.zeros((2, 3, 6))
    )
    options = recorder.RecorderOptions(kinematics=kinematics)
    sensed = recorder.sense(stage, schedule, options, rng=np.random.default_rng([seed, 8]), sensors=sensors)
    assembled = robot.assembled(kinematics, rng=np.random.default_rng([seed, 8]).spawn(3)[0])
    return Swept(sensed, assembled.wrist_from_camera)


def _arms(
    stage: staging.Stage, count: int, turning: tuple[str, ...], rng: np.random.Generator
) -> list[robot.ArmJoints]:
    body, tag = stage.world_from_start, stage.start_tag
    free = np.array([name in turning for name in robot.JOINTS])
    found: list[robot.ArmJoints] = []
    while len(found) < count:
        sh1, el0 = robot.RAISED_SH1, -robot.RAISED_SH1
        if free[1]:
            sh1, el0 = sh1 + rng.uniform(-0.4, 0.5), el0 + rng.uniform(-0.4, 0.4)
        direct = staging.looking_at(body, tag.world_from_tag.translation, sh1=sh1, el0=el0)
        turned = free * rng.uniform(-1, 1, 6) * (0.3, 0.0, 0.0, 0.5, 0.25, 0.7)
        arm = robot.joints(direct.as_array() + turned)
        view = body * robot.body_from_camera(arm)
        if robot.within_limits(arm) and staging.sees(stage.scene, view, robot.ARM_CAMERA, tag, margin_px=15.0):
            found.append(arm)
    return found


def write(path: Path, swept: Swept, stated: Stated = Stated(), *, layout: str = "generic") -> Path:
    """Write an MCAP recording with the errors of ``stated`` in its tf, stamps and CameraInfo."""
    sensed = swept.sensed
    fx, fy, *rest = sensed.camera.params
    said = Camera(
        sensed.camera.model,
        sensed.camera.width,
        sensed.camera.height,
        (fx * (1 + stated.focal), fy * (1 + stated.focal), *rest),
    )
    with RecordingWriter(path, format="mcap", layout=layout) as writer:
        names = writer.layout
        writer.tf_static([(names.arm_frames[-1], names.camera_frame, said_mount(stated))])
        for state in sensed.states:
            recorder._write_state(writer, state)
        for image in sensed.images:
            writer.camera_info(image.t_ns + stated.late_ns, said)
            writer.image(image.t_ns + stated.late_ns, image.jpeg)
    return path


def said_mount(stated: Stated) -> Pose:
    """Return wrist_from_cam as the recording has it."""
    return robot.WRIST_FROM_CAMERA * exp(stated.hand).inv()


def true_correction(swept: Swept, stated: Stated) -> Array:
    """Return d with true wrist_from_cam = stated wrist_from_cam * Exp(d)."""
    return log(said_mount(stated).inv() * swept.wrist_from_camera)
