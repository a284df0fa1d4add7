"""Record what the robot senses: arm images, kinematics, odometry and events; write them as bags."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldkit.bags import RecordingWriter
from fieldkit.bags.writing import BagFormat
from fieldkit.frames import Pose
from sim_bridge import robot
from sim_bridge.recording.schedule import Schedule
from sim_bridge.rendering import render
from sim_bridge.robot.odometry import OdometryOptions, drifting_odometry
from sim_bridge.sensors import effects
from sim_bridge.stage.staging import Stage

Array = NDArray[np.float64]

BEGIN_NS = 1_700_000_000_000_000_000
# Name of the recording in a session folder, by format.
RECORDINGS: dict[BagFormat, str] = {"mcap": "robot.mcap", "ros1": "robot.bag", "ros2": "robot"}


@dataclasses.dataclass(frozen=True)
class RecorderOptions:
    """Rates, sensor noise and image quality."""

    rate_hz: float = 20.0
    jitter_s: float = 0.004
    encoder_deg: float = 0.02
    noise_sigma: float = 2.0
    jpeg_quality: int = 90
    odometry: OdometryOptions = dataclasses.field(default_factory=OdometryOptions)


@dataclasses.dataclass(frozen=True)
class SensedImage:
    """An image of the arm camera: stamp, JPEG file, and where the camera truly was."""

    t_ns: int
    jpeg: bytes
    world_from_cam: Pose


@dataclasses.dataclass(frozen=True)
class Sensed:
    """All that a session's sensors gave, in order of time, and the true poses of the body."""

    images: tuple[SensedImage, ...]
    odometry: tuple[tuple[int, Pose], ...]
    links: tuple[tuple[int, list[tuple[str, str, Pose]]], ...]
    events: tuple[tuple[int, dict[str, Any]], ...]
    world_from_body: tuple[tuple[int, Pose], ...]


def stamp(t_s: float) -> int:
    """Return the header stamp of a time since the session's begin."""
    return BEGIN_NS + round(t_s * 1e9)


def sense(stage: Stage, schedule: Schedule, options: RecorderOptions, *, rng: np.random.Generator) -> Sensed:
    """Play a schedule: render the images, measure joints and odometry.

    Joints and odometry have clocks of their own, and images come in between: a reader has to interpolate.
    """
    odometry_s = _clock(schedule.end_s, options, rng=rng)
    true_body = [schedule.world_from_body(float(t)) for t in odometry_s]
    believed = drifting_odometry(true_body, options.odometry, rng=rng)
    stamps = [stamp(float(t)) for t in odometry_s]
    links = []
    for t in _clock(schedule.end_s, options, rng=rng):
        noise = np.radians(options.encoder_deg) * rng.standard_normal(4)
        measured = robot.joints(schedule.joints(float(t)).as_array() + noise)
        links.append((stamp(float(t)), robot.moving_links(measured)))
    images, events = [], [(stamp(t), event) for t, event in schedule.events]
    for shot in sorted(schedule.shots, key=lambda shot: shot.t_s):
        world_from_cam = schedule.world_from_body(shot.t_s) * robot.body_from_camera(schedule.joints(shot.t_s))
        rendered = render(stage.scene, robot.ARM_CAMERA, world_from_cam).rgb
        noisy = effects.add_noise(rendered, sigma=options.noise_sigma, rng=rng)
        t_ns = stamp(shot.t_s)
        images.append(SensedImage(t_ns, effects.jpeg(noisy, quality=options.jpeg_quality), world_from_cam))
        if shot.view is not None:
            view = {"event": "view", "visit": shot.visit, "view": shot.view, "kind": shot.kind, "t_ns": t_ns}
            events.append((t_ns, view))
    return Sensed(
        tuple(images),
        tuple(zip(stamps, believed, strict=True)),
        tuple(links),
        tuple(sorted(events, key=lambda item: item[0])),
        tuple(zip(stamps, true_body, strict=True)),
    )


def _clock(end_s: float, options: RecorderOptions, *, rng: np.random.Generator) -> Array:
    """Return times of a sensor that samples at about the rate, with its own phase and jitter."""
    count = int(np.floor(end_s * options.rate_hz))
    phase = rng.uniform(0.1, 0.9) if count else 0.0
    return (np.arange(count) + phase) / options.rate_hz + rng.uniform(-options.jitter_s, options.jitter_s, count)


def write_recording(path: Path, sensed: Sensed, *, format: BagFormat, layout: str = "generic") -> None:
    """Write what was sensed as a bag, messages in the order of their stamps."""
    with RecordingWriter(path, format=format, layout=layout) as writer:
        queue: list[tuple[int, int, Callable[[], None]]] = []
        for t_ns, pose in sensed.odometry:
            queue.append((t_ns, 0, _call(writer.odometry, t_ns, pose)))
        for t_ns, links in sensed.links:
            queue.append((t_ns, 1, _call(writer.tf, t_ns, links)))
        for image in sensed.images:
            queue.append((image.t_ns, 2, _call(writer.camera_info, image.t_ns, robot.ARM_CAMERA)))
            queue.append((image.t_ns, 3, _call(writer.image, image.t_ns, image.jpeg)))
        for t_ns, event in sensed.events:
            queue.append((t_ns, 4, _call(writer.event, t_ns, event)))
        writer.tf_static(robot.fixed_links())
        for _, _, write in sorted(queue, key=lambda item: item[:2]):
            write()


def _call(function: Callable[..., None], *values: Any) -> Callable[[], None]:
    return lambda: function(*values)
