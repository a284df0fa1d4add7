"""What a rig's known geometry says about the poses that SfM found for its cameras one by one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from fieldkit.frames import Pose, pose_error
from fieldkit.maps.source import SourceImage

# Cameras of one frame agree when the rig poses that they imply do: several times what SfM leaves open in a room.
_MAX_POSITION_M = 0.05
_MAX_ROTATION_RAD = np.radians(1.5)


def contradicting(images: Sequence[SourceImage], map_from_cam: Mapping[int, Pose]) -> list[int]:
    """Return the images (by index) whose mapped pose disagrees with most of the rig's other cameras of their frame.

    Repeated texture can place an image in the wrong spot with many inliers. Where only two cameras contradict each
    other, nobody knows which is right, and both are returned.
    """
    frames: dict[str, list[int]] = {}
    for i in map_from_cam:
        if images[i].rig_from_cam is not None:
            frames.setdefault(images[i].frame, []).append(i)
    result = []
    for members in frames.values():
        if len(members) > 1:
            rig = {i: map_from_cam[i] * _rig_from_cam(images[i]).inv() for i in members}
            agreeing = {i: sum(_agree(rig[i], rig[j]) for j in members if j != i) for i in members}
            most = max(agreeing.values())
            result += [i for i in members if agreeing[i] == 0 or 2 * agreeing[i] < most]
    return sorted(result)


def _rig_from_cam(image: SourceImage) -> Pose:
    assert image.rig_from_cam is not None
    return image.rig_from_cam


def _agree(first: Pose, second: Pose) -> bool:
    position, rotation = pose_error(first, second)
    return position < _MAX_POSITION_M and rotation < _MAX_ROTATION_RAD
