"""Images that SfM put in the wrong place: repeated rooms and furniture match well where they should not."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from fieldkit.frames import Pose
from fieldkit.maps.sources.order import walk_order
from fieldkit.maps.sources.source import SourceImage

Array = NDArray[np.float64]

# Drift is smooth and wide residuals widen the bound; what lies this far beyond it is no drift.
_BEYOND = 3.0
_MIN_M = 0.3
# Images that are a piece of a walk, and by how much the step into a misplaced one is the longer
_PIECE, _LEAP = 3, 1.5


def strays(images: Sequence[SourceImage], map_from_cam: Mapping[int, Pose], *, threshold_m: float) -> list[int]:
    """Return the images (by index) whose mapped position contradicts SLAM's, and whose walk leaps in the map.

    Whether SfM or SLAM is wrong there is told by the way from the last to the next image of its sequence that does
    not contradict: the longer detour is the wrong one. Where a whole piece of the walk lies elsewhere, as the end of a
    corridor may on a place nearer by, the detour is the longer in the right one: there the steps tell into the piece
    and out of it, a leap in the wrong one. With one image of a rig's frame all of the frame are returned.
    """
    wrong, _ = _judged(images, map_from_cam, threshold_m)
    frames = {images[i].frame for i in wrong if images[i].rig_from_cam is not None}
    together = {i for i in map_from_cam if images[i].rig_from_cam is not None and images[i].frame in frames}
    return sorted(wrong | together)


def folded(images: Sequence[SourceImage], map_from_cam: Mapping[int, Pose], *, threshold_m: float) -> set[int]:
    """Return the images (by index) that contradict SLAM, but for those where SLAM is what leaps."""
    _, slams = _judged(images, map_from_cam, threshold_m)
    return contradicting(images, map_from_cam, threshold_m=threshold_m) - slams


def _judged(
    images: Sequence[SourceImage], map_from_cam: Mapping[int, Pose], threshold_m: float
) -> tuple[set[int], set[int]]:
    """Return the contradicting images that the map has in the wrong place, and those that SLAM has."""
    posed = [i for i in map_from_cam if images[i].slam_from_cam is not None]
    mapped = {i: np.asarray(map_from_cam[i].translation) for i in posed}
    slam = {i: _position(images[i]) for i in posed}
    far = contradicting(images, map_from_cam, threshold_m=threshold_m)
    sequences: dict[str, list[int]] = {}
    for i in posed:
        sequences.setdefault(images[i].sequence, []).append(i)
    wrong, slams = set[int](), set[int]()
    for members in sequences.values():
        order = walk_order(images, members)
        for piece, steps in _pieces(order, far):
            ends = [j for step in steps for j in step if j not in far]
            leaps = _leaps(mapped, piece, steps), _leaps(slam, piece, steps)
            if ends and len(piece) >= _PIECE and max(leaps) > _LEAP * min(leaps) + threshold_m:
                (wrong if leaps[0] > leaps[1] else slams).update(piece)
            else:
                wrong |= {i for i in piece if _goes_farther(mapped, slam, i, ends)}
                slams |= {i for i in piece if _goes_farther(slam, mapped, i, ends)}
    return wrong, slams


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


def _pieces(order: Sequence[int], far: set[int]) -> list[tuple[list[int], list[tuple[int, int]]]]:
    """Return every run of contradicting images, with its steps from the image before and to the one after."""
    pieces = []
    for is_far, group in itertools.groupby(range(len(order)), key=lambda k: order[k] in far):
        run = list(group)
        if is_far:
            steps = [(order[k], order[k + 1]) for k in (run[0] - 1, run[-1]) if 0 <= k < len(order) - 1]
            pieces.append(([order[k] for k in run], steps))
    return pieces


def _leaps(position: Mapping[int, Array], piece: Sequence[int], steps: Sequence[tuple[int, int]]) -> float:
    """Return the longest step into or out of a piece, and between its images."""
    inside = list(itertools.pairwise(piece))
    return max((float(np.linalg.norm(position[i] - position[j])) for i, j in (*steps, *inside)), default=0.0)


def _position(image: SourceImage) -> Array:
    assert image.slam_from_cam is not None
    return np.asarray(image.slam_from_cam.translation)


def _goes_farther(here: Mapping[int, Array], there: Mapping[int, Array], i: int, ends: Sequence[int]) -> bool:
    """Tell whether the way from the ends of its piece to an image is longer here than there."""
    way = [sum(float(np.linalg.norm(position[i] - position[j])) for j in ends) for position in (here, there)]
    return way[0] > way[1]
