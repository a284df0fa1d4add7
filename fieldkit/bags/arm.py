"""Open a recording for what its arm does: images, and kinematics at any time; no visits are needed."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldkit.bags.content import Content, arm_chain, collect
from fieldkit.bags.correcting import correct
from fieldkit.bags.layouts import Layout
from fieldkit.bags.reading import choose_layout, general_warnings, make_frames, open_source, topic_list
from fieldkit.bags.tagged import tag_frames
from fieldkit.bags.tf import TfBuffer
from fieldkit.errors import BagError, FrameError
from fieldkit.frames import Pose, Trajectory
from fieldkit.store import Corrections
from fieldkit.types import Frame

Mask = NDArray[np.bool_]


@dataclasses.dataclass(frozen=True)
class Kinematics:
    """The chain of transforms from the body to the camera, which tf gives at any time between its samples.

    ``steps`` are (frame, next frame, whether it can move); ``mount`` the frame that carries the camera by a transform
    that never changes, with frame_from_cam, or None where tf moves the camera itself.
    """

    tf: TfBuffer
    body_frame: str
    camera_frame: str
    steps: tuple[tuple[str, str, bool], ...]
    mount: tuple[str, Pose] | None

    def links(self, t_ns: Sequence[int]) -> tuple[list[Pose], Mask]:
        """Return every step's transforms at times (n), each a stack of n, and bool[n]: tf reaches there."""
        reached = np.ones(len(t_ns), dtype=bool)
        stacks = []
        for target, source, _ in self.steps:
            found = self.tf.lookup_all(target, source, t_ns=t_ns)
            reached &= [not isinstance(f, FrameError) for f in found]
            stacks.append(Pose.concatenate([Pose.identity() if isinstance(f, FrameError) else f for f in found]))
        return stacks, reached


@dataclasses.dataclass(frozen=True)
class ArmRecording:
    """Frames of the arm camera in the order of stamps, kinematics, and odometry if any.

    ``frames`` are images, or the messages of a detector on the robot where there is no image.
    """

    path: str
    frames: tuple[Frame, ...]
    kinematics: Kinematics
    odometry: Trajectory | None
    warnings: tuple[str, ...]


def open_arm(
    path: Path | str, *, layout: str | Layout | None = None, corrections: Corrections | None = None
) -> ArmRecording:
    """Read the images and the kinematics of a recording, whatever waypoints it has; images stay in the bag.

    ``corrections`` take the place of the stated camera, of its place in the hand, and of its stamps. Raises BagError
    where the camera's calibration or the transforms from body to camera are missing, or corrections do not fit.
    """
    source = open_source(path)
    bag, chosen = source.bag, choose_layout(source, layout=layout)
    if chosen is None:
        raise BagError(
            f"{bag.path}: no layout fits; the bag has {topic_list(bag)}", hint="pass a Layout that names them"
        )
    content = collect(bag, chosen)
    warnings = correct(bag, content, corrections, layout=chosen)
    if content.camera_error is not None:
        raise content.camera_error
    if not content.has_camera:
        raise BagError(
            f"{bag.path}: no camera_info in layout {chosen.name!r}; expected messages on {chosen.camera_info}",
            hint="record the topic",
        )
    odometry = None
    if content.odometry.samples:
        odometry, repeated = content.odometry.trajectory(parent=chosen.odom_frame, child=chosen.body_frame)
    body = chosen.body_frame if odometry is None else odometry.child
    frames, _ = make_frames(bag, content, camera_frame=chosen.camera_frame, body_frame=body)
    kinematics = _kinematics(bag.path, content, body=body, camera=_camera_frame(content, chosen))
    warnings += general_warnings(bag, content, 0 if odometry is None else repeated)
    if not frames:
        frames, notes = tag_frames(bag, content, camera_frame=chosen.camera_frame, body_frame=body)
        warnings += notes
    return ArmRecording(str(path), frames, kinematics, odometry, tuple(warnings))


def _camera_frame(content: Content, layout: Layout) -> str:
    named = Counter(image.frame for image in content.images if image.frame)
    return named.most_common(1)[0][0] if named else layout.camera_frame


def _kinematics(path: Path, content: Content, *, body: str, camera: str) -> Kinematics:
    t_ns, steps = arm_chain(path, content, body=body, camera=camera)
    if not any(moves for _, _, moves in steps):
        raise BagError(
            f"{path}: no transform between {body!r} and {camera!r} moves; expected the arm's on tf",
            hint="record /tf together with the images",
        )
    last, _, moves = steps[-1]
    mount = None if moves else (last, content.tf.lookup(last, camera, t_ns=t_ns))
    return Kinematics(content.tf, body, camera, steps, mount)
