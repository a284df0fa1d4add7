"""Record what the robot senses: images, depth, kinematics, odometry and events; write them as bags."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldkit.bags import LAYOUTS, RecordingWriter
from fieldkit.bags.writing import BagFormat
from fieldkit.cameras import Camera
from fieldkit.errors import suggestion
from fieldkit.frames import Pose
from sim_bridge import robot
from sim_bridge.errors import SynthesisError
from sim_bridge.recording.schedule import Schedule, Shot
from sim_bridge.rendering import render, render_depth
from sim_bridge.robot.odometry import OdometryOptions, drifting_odometry
from sim_bridge.sensors import STANDARD, Motion, Sensors, bent, effects, encode, expose, sense_depth
from sim_bridge.stage.staging import Stage

Array = NDArray[np.float64]

BEGIN_NS = 1_700_000_000_000_000_000
# Name of the recording in a session folder, by format.
RECORDINGS: dict[BagFormat, str] = {"mcap": "robot.mcap", "ros1": "robot.bag", "ros2": "robot"}
# How often the drivers publish the robot's state (joints, tf, odometry) as they come, in Hz.
STATE_HZ = {"generic": 20.0, "spot_ros1": 20.0, "spot_ros2": 50.0}
# Half the time over which a camera's speed is taken.
_INSTANT_S = 0.004


@dataclasses.dataclass(frozen=True)
class RecorderOptions:
    """Names, rates and errors: the robot's state comes ``state_hz`` times a second (None: as the layout's driver does).

    The errors of the arm and of odometry are the robot's own; those of its cameras are the session's sensors.
    """

    layout: str = "generic"
    state_hz: float | None = None
    jitter_s: float = 0.004
    kinematics: robot.KinematicOptions = dataclasses.field(default_factory=robot.KinematicOptions)
    odometry: OdometryOptions = dataclasses.field(default_factory=OdometryOptions)


@dataclasses.dataclass(frozen=True)
class SensedImage:
    """An image of the hand's colour camera (JPEG) and of its depth camera (PNG), and where the former truly was."""

    t_ns: int
    jpeg: bytes
    depth_png: bytes
    world_from_cam: Pose


@dataclasses.dataclass(frozen=True)
class SensedState:
    """What the robot says of itself at a time: odometry with its speed (6,) in the body, and the measured joints."""

    t_ns: int
    odom_from_body: Pose
    twist: Array
    arm: robot.ArmJoints


@dataclasses.dataclass(frozen=True)
class Sensed:
    """All that a session's sensors gave, in order of time, and the true poses of the body."""

    camera: Camera
    images: tuple[SensedImage, ...]
    states: tuple[SensedState, ...]
    events: tuple[tuple[int, dict[str, Any]], ...]
    world_from_body: tuple[tuple[int, Pose], ...]


def stamp(t_s: float) -> int:
    """Return the header stamp of a time since the session's begin."""
    return BEGIN_NS + round(t_s * 1e9)


def check_layout(name: str) -> None:
    """Raise SynthesisError for an unknown layout."""
    if name not in LAYOUTS:
        raise SynthesisError(f"unknown layout {name!r}", hint=suggestion(name, list(LAYOUTS)))


def own_format(layout: str) -> BagFormat:
    """Return the format in which a layout's driver is recorded; the others are what converters make of it."""
    return "ros1" if layout == "spot_ros1" else "mcap"


def sense(
    stage: Stage,
    schedule: Schedule,
    options: RecorderOptions,
    *,
    rng: np.random.Generator,
    sensors: Sensors = STANDARD,
) -> Sensed:
    """Play a schedule: render colour and depth, measure joints and odometry.

    The robot's state has a clock of its own, and images come in between: a reader has to interpolate. Images do not
    depend on the layout, whose driver decides how often the state is published.
    """
    for_arm, for_states, for_images = rng.spawn(3)
    kinematics = robot.assembled(options.kinematics, rng=for_arm)
    rate_hz = STATE_HZ[options.layout] if options.state_hz is None else options.state_hz
    states, true_body = _states(schedule, kinematics, options, rate_hz=rate_hz, rng=for_states)
    camera = bent(robot.ARM_CAMERA, sensors.hand)
    images, events = [], [(stamp(t), event) for t, event in schedule.events]
    for shot in sorted(schedule.shots, key=lambda shot: shot.t_s):
        images.append(_taken(stage, schedule, kinematics, shot, camera=camera, sensors=sensors, rng=for_images))
        if shot.view is not None:
            t_ns = stamp(shot.t_s)
            view = {"event": "view", "visit": shot.visit, "view": shot.view, "kind": shot.kind, "t_ns": t_ns}
            events.append((t_ns, view))
    ordered = tuple(sorted(events, key=lambda item: item[0]))
    return Sensed(camera, tuple(images), states, ordered, true_body)


def _taken(
    stage: Stage,
    schedule: Schedule,
    kinematics: robot.Kinematics,
    shot: Shot,
    *,
    camera: Camera,
    sensors: Sensors,
    rng: np.random.Generator,
) -> SensedImage:
    """Take a picture and a depth image of what is there, with the cameras moving as they do."""

    def world_from_camera(t_s: float) -> Pose:
        return schedule.world_from_body(t_s) * kinematics.body_from_camera(schedule.joints(t_s))

    world_from_cam = world_from_camera(shot.t_s)
    motion = moving(world_from_camera(shot.t_s - _INSTANT_S), world_from_camera(shot.t_s + _INSTANT_S))
    seen = render(stage.scene, camera, world_from_cam)
    image = expose(seen.rgb, sensors.hand, camera=camera, rng=rng, motion=motion, depth_m=seen.depth_m)
    world_from_depth = schedule.world_from_body(shot.t_s) * kinematics.body_from_depth(schedule.joints(shot.t_s))
    exact = render_depth(stage.scene, robot.DEPTH_CAMERA, world_from_depth)
    depth = sense_depth(exact, sensors.hand_depth, camera=robot.DEPTH_CAMERA, rng=rng)
    png = effects.depth_png(depth, far_m=np.iinfo(np.uint16).max / 1000.0)
    return SensedImage(stamp(shot.t_s), encode(image, sensors.hand), png, world_from_cam)


def moving(before: Pose, after: Pose) -> Motion:
    """Return the motion of a camera between two poses world_from_cam, two instants apart, in its own frame."""
    step = before.inv() * after
    seconds = 2.0 * _INSTANT_S
    return Motion(step.rotation.as_rotvec() / seconds, step.translation / seconds)


def _states(
    schedule: Schedule,
    kinematics: robot.Kinematics,
    options: RecorderOptions,
    *,
    rate_hz: float,
    rng: np.random.Generator,
) -> tuple[tuple[SensedState, ...], tuple[tuple[int, Pose], ...]]:
    """Return what the robot says of itself over time, and where its body truly is then."""
    times = _clock(schedule.end_s, rate_hz, options.jitter_s, rng=rng)
    true_body = [schedule.world_from_body(float(t)) for t in times]
    believed = drifting_odometry(true_body, options.odometry, rng=rng)
    speeds = _speeds(believed, times)
    states = tuple(
        SensedState(stamp(float(t)), pose, twist, kinematics.measured(schedule.joints(float(t)), rng=rng))
        for t, pose, twist in zip(times, believed, speeds, strict=True)
    )
    return states, tuple((state.t_ns, pose) for state, pose in zip(states, true_body, strict=True))


def _clock(end_s: float, rate_hz: float, jitter_s: float, *, rng: np.random.Generator) -> Array:
    """Return times of a sensor that samples at about a rate, with its own phase and jitter."""
    count = int(np.floor(end_s * rate_hz))
    phase = rng.uniform(0.1, 0.9) if count else 0.0
    return (np.arange(count) + phase) / rate_hz + rng.uniform(-jitter_s, jitter_s, count)


def _speeds(odom_from_body: list[Pose], times: Array) -> Array:
    """Return the speed (n, 6) of a body, linear (m/s) then angular (rad/s), in its own frame; 0 at the begin."""
    speeds = np.zeros((len(times), 6))
    for k in range(1, len(times)):
        step = odom_from_body[k - 1].inv() * odom_from_body[k]
        speeds[k] = np.concatenate([step.translation, step.rotation.as_rotvec()]) / (times[k] - times[k - 1])
    return speeds


def write_recording(path: Path, sensed: Sensed, *, format: BagFormat, layout: str = "generic") -> None:
    """Write what was sensed as a bag, messages in the order of their stamps, named as the layout says."""
    with RecordingWriter(path, format=format, layout=layout) as writer:
        queue: list[tuple[int, int, Callable[[], None]]] = []
        for state in sensed.states:
            queue.append((state.t_ns, 0, _call(_write_state, writer, state)))
        for image in sensed.images:
            queue.append((image.t_ns, 1, _call(_write_image, writer, image, sensed.camera)))
        for t_ns, event in sensed.events:
            queue.append((t_ns, 2, _call(writer.event, t_ns, event)))
        names = writer.layout
        wrist = names.arm_frames[-1]
        writer.tf_static(
            [(wrist, names.camera_frame, robot.WRIST_FROM_CAMERA), (wrist, names.depth_frame, robot.WRIST_FROM_DEPTH)]
        )
        for _, _, write in sorted(queue, key=lambda item: item[:2]):
            write()


def _write_state(writer: RecordingWriter, state: SensedState) -> None:
    names = writer.layout
    writer.odometry(state.t_ns, state.odom_from_body, state.twist)
    writer.joint_states(state.t_ns, dict(zip(names.arm_joints, state.arm.as_array().tolist(), strict=True)))
    body = (names.odom_frame, names.body_frame, state.odom_from_body)
    writer.tf(state.t_ns, [body, *robot.moving_links(state.arm, names.arm_frames, body=names.body_frame)])


def _write_image(writer: RecordingWriter, image: SensedImage, camera: Camera) -> None:
    writer.camera_info(image.t_ns, camera)
    writer.image(image.t_ns, image.jpeg)
    writer.depth_info(image.t_ns, robot.DEPTH_CAMERA)
    writer.depth(image.t_ns, image.depth_png)


def _call(function: Callable[..., None], *values: Any) -> Callable[[], None]:
    return lambda: function(*values)
