"""Images that SfM put in the wrong place: repeated rooms and furniture match well where they should not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from fieldkit.frames import Pose
from fieldkit.maps.order import walk_order
from fieldkit.maps.source import SourceImage

Array = NDArray[np.float64]

# Drift is smooth and wide residuals widen the bound; what lies this far beyond it is no drift.
_BEYOND = 3.0
_MIN_M = 0.3


def strays(images: Sequence[SourceImage], map_from_cam: Mapping[int, Pose], *, threshold_m: float) -> list[int]:
    """Return the images (by index) whose mapped position contradicts SLAM's, and whose walk leaps in the map.

    Whether SfM or SLAM is wrong there is told by the way from the last to the next image of its sequence that does
    not contradict: the longer detour is the wrong one. With one image of a rig's frame all of the frame are returned.
    """
    posed = [i for i in map_from_cam if images[i].slam_from_cam is not None]
    mapped = {i: np.asarray(map_from_cam[i].translation) for i in posed}
    slam = {i: _position(images[i]) for i in posed}
    far = contradicting(images, map_from_cam, threshold_m=threshold_m)
    sequences: dict[str, list[int]] = {}
    for i in posed:
        sequences.setdefault(images[i].sequence, []).append(i)
    wrong = set()
    for members in sequences.values():
        order = walk_order(images, members)
        for k, i in enumerate(order):
            if i in far:
                ends = [j for j in (_nearest(order[:k][::-1], far), _nearest(order[k + 1 :], far)) if j is not None]
                if ends and _detour(mapped, i, ends) > _detour(slam, i, ends):
                    wrong.add(i)
    frames = {images[i].frame for i in wrong if images[i].rig_from_cam is not None}
    together = {i for i in map_from_cam if images[i].rig_from_cam is not None and images[i].frame in frames}
    return sorted(wrong | together)


def contradicting(images: Sequence[SourceImage], map_from_cam: Mapping[int, Pose], *, threshold_m: float) -> set[int]:
    """Return the images (by index) whose mapped position contradicts SLAM's.

    Their residual exceeds three times ``threshold_m``, the bound of the alignment, and 0.3 m.
    """
    bound, far = max(_BEYOND * threshold_m, _MIN_M), set()
    for i, mapped in map_from_cam.items():
        if images[i].slam_from_cam is not None:
            residual_m = float(np.linalg.norm(mapped.translation - _position(images[i])))
            far |= {i} if residual_m > bound else set()
    return far


def _position(image: SourceImage) -> Array:
    assert image.slam_from_cam is not None
    return np.asarray(image.slam_from_cam.translation)


def _nearest(order: Sequence[int], far: set[int]) -> int | None:
    return next((j for j in order if j not in far), None)


def _detour(position: Mapping[int, Array], i: int, ends: Sequence[int]) -> float:
    return float(sum(np.linalg.norm(position[i] - position[j]) for j in ends))
