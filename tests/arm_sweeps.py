"""Recordings of an arm that sweeps its camera over a tag, by sim_bridge; calibrations that are stated wrongly."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from empty_floor import empty_floor

from fieldkit.bags import RecordingWriter
from fieldkit.cameras import Camera
from fieldkit.frames import Array, Pose, exp, log
from fieldkit.tags import TagDetection, detect
from sim_bridge import robot
from sim_bridge.aim import facing
from sim_bridge.recording import recorder
from sim_bridge.recording.recorder import Sensed
from sim_bridge.recording.schedule import Schedule, Shot, lagging
from sim_bridge.sensors import STANDARD, Sensors
from sim_bridge.stage import staging
from sim_bridge.stage.paths import Track, TrackBuilder

SIZE_M = 0.1365
KINEMATICS = robot.KinematicOptions()


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


@dataclasses.dataclass(frozen=True)
class Told:
    """What stands in a recording in place of images: detections on topics, of a camera's frame (None: the arm's)."""

    topics: tuple[str, ...] = ("/detections",)
    frame: str | None = None
    hamming: int = 0


AS_IT_IS = Stated()


@functools.cache
def before_tag() -> staging.Stage:
    """A robot that stands before a tag on a bare wall: nothing else matters here, and it is drawn quickly."""
    tag = staging.PlacedTag(1, SIZE_M, facing((3.47, 2.9, 0.59), np.pi + 0.21))
    wall = tag.world_from_tag * Pose.from_translation([0.0, 0.0, -0.06])
    scene = empty_floor((6.0, 6.0), ()).with_box(wall, (4.0, 3.0, 0.1), rgb=(150, 145, 140))
    return staging.Stage(staging.with_tag(scene, tag), tag, robot.standing((2.0, 3.0), 0.0), ())


def sweep(
    seed: int,
    *,
    poses: int = 20,
    moving: bool = True,
    turning: tuple[str, ...] = robot.JOINTS,
    kinematics: robot.KinematicOptions = KINEMATICS,
    sensors: Sensors = STANDARD,
) -> Swept:
    """Stand before a tag and let the arm go through random poses that see it, with images there and on the way."""
    rng = np.random.default_rng(seed)
    stage = before_tag()
    arms = _arms(stage, poses, turning, rng)
    track, shots = TrackBuilder(arms[0].as_array()), []
    track.hold(1.0)
    for before, arm in itertools.pairwise(arms):
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


def write(
    path: Path, swept: Swept, stated: Stated = AS_IT_IS, *, layout: str = "generic", told: Told | None = None
) -> Path:
    """Write an MCAP recording with the errors of ``stated`` in its tf, stamps and CameraInfo.

    With ``told`` it holds apriltag_ros' detections in place of images.
    """
    sensed = swept.sensed
    fx, fy, *rest = sensed.camera.params
    params = (fx * (1 + stated.focal), fy * (1 + stated.focal), *rest)
    said = Camera(sensed.camera.model, sensed.camera.width, sensed.camera.height, params)
    with RecordingWriter(path, format="mcap", layout=layout) as writer:
        names = writer.layout
        writer.tf_static([(names.arm_frames[-1], names.camera_frame, said_mount(stated))])
        for state in sensed.states:
            body = (names.odom_frame, names.body_frame, state.odom_from_body)
            links = robot.moving_links(state.arm, names.arm_frames, body=names.body_frame)
            writer.odometry(state.t_ns, state.odom_from_body, state.twist)
            writer.tf(state.t_ns, [body, *links])
        for image in sensed.images:
            t_ns = image.t_ns + stated.late_ns
            writer.camera_info(t_ns, said)
            if told is None:
                writer.image(t_ns, image.jpeg)
            else:
                _write_detections(writer, t_ns, _detected(image.jpeg, sensed.camera), told)
    return path


def _write_detections(writer: RecordingWriter, t_ns: int, seen: Sequence[TagDetection], told: Told) -> None:
    assert writer._open is not None
    store = writer._open.container.store
    point = store.types["apriltag_msgs/msg/Point"]
    kind = store.types["apriltag_msgs/msg/AprilTagDetection"]
    found = [
        kind(
            d.family, d.id, told.hamming, 0.0, 60.0, point(0.0, 0.0),
            [point(*c) for c in d.corners_px.tolist()], np.zeros(9),
        )
        for d in seen
    ]  # fmt: skip
    header = writer._header(t_ns, told.frame or writer.layout.camera_frame)
    message = store.types["apriltag_msgs/msg/AprilTagDetectionArray"](header, found)
    for topic in told.topics:
        writer._write(topic, message, t_ns)


@functools.cache
def _detected(jpeg: bytes, camera: Camera) -> tuple[TagDetection, ...]:
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    return tuple(detect(np.asarray(image, dtype=np.uint8), camera))


def said_mount(stated: Stated) -> Pose:
    """Return wrist_from_cam as the recording has it."""
    return robot.WRIST_FROM_CAMERA * exp(stated.hand).inv()


def true_correction(swept: Swept, stated: Stated) -> Array:
    """Return d with true wrist_from_cam = stated wrist_from_cam * Exp(d)."""
    return log(said_mount(stated).inv() * swept.wrist_from_camera)
