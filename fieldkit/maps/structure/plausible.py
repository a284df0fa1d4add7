"""Matches that SLAM's poses rule out: identical furniture matches as well as one piece seen twice."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fieldkit.features import Features
from fieldkit.frames import Pose
from fieldkit.maps.options import SlamRules
from fieldkit.maps.sources.order import walk_order
from fieldkit.maps.sources.source import SourceImage
from fieldkit.maps.structure.pairs import Pair

Array = NDArray[np.float64]


def plausible_matches(
    images: Sequence[SourceImage],
    features: Sequence[Features],
    pairs: Sequence[Pair],
    matches: Sequence[NDArray[np.uint32]],
    *,
    rules: SlamRules,
) -> list[NDArray[np.uint32]]:
    """Return the matches uint32[k, 2] of every pair that SLAM's poses allow; images without a pose keep all of theirs.

    A match stays when its two rays, placed by SLAM, could meet at a depth within the rules' limits.
    """
    rays = [image.camera.unproject(f.keypoints_px) for image, f in zip(images, features, strict=True)]
    walked = _walked(images)
    result = []
    for (a, b), found in zip(pairs, matches, strict=True):
        first, second = images[a].slam_from_cam, images[b].slam_from_cam
        if first is None or second is None or not len(found):
            result.append(found)
            continue
        x = _unit(first.rotation.apply(rays[a][found[:, 0]]))
        y = _unit(second.rotation.apply(rays[b][found[:, 1]]))
        error_m = rules.position_m + rules.drift_per_m * abs(walked[a] - walked[b])
        result.append(found[_meet(x, y, second.translation - first.translation, error_m, rules)])
    return result


def plausible_pairs(
    images: Sequence[SourceImage], pairs: Sequence[Pair], relative: Sequence[Pose | None], *, rules: SlamRules
) -> NDArray[np.bool_]:
    """Tell of every pair (a, b) whether its own relative pose, b_from_a up to scale, agrees with SLAM's, as bool[n].

    Pairs without a relative pose, or of images without a SLAM pose, agree.
    """
    result = np.ones(len(pairs), dtype=bool)
    for k, ((a, b), found) in enumerate(zip(pairs, relative, strict=True)):
        first, second = images[a].slam_from_cam, images[b].slam_from_cam
        if found is None or first is None or second is None:
            continue
        b_from_a = second.inv() * first
        turned = (found.rotation * b_from_a.rotation.inv()).magnitude()
        result[k] = turned <= np.radians(rules.pair_rotation_deg)
        baseline_m = float(np.linalg.norm(b_from_a.translation))
        if baseline_m > rules.pair_baseline_m:
            # Images from one spot have a length of 0, and so no direction: SLAM has one.
            along = float(found.translation @ b_from_a.translation)
            least = baseline_m * float(np.linalg.norm(found.translation)) * np.cos(np.radians(rules.pair_direction_deg))
            result[k] &= along > 0 and along >= least
    return result


def _meet(x: Array, y: Array, step: Array, error_m: float, rules: SlamRules) -> NDArray[np.bool_]:
    """Return bool[k]: whether unit rays x (k, 3) from the origin and y (k, 3) from ``step`` (3,) can meet.

    Rays too far apart do not. The point on x at each of a few depths is looked at from ``step``: the smallest angle
    to y must lie within the rotation's error plus the angle under which the position's error is seen from there.
    """
    depths = np.geomspace(rules.nearest_m, rules.farthest_m, 24)
    allowed = np.zeros(len(x), dtype=bool)
    narrow = (x * y).sum(axis=1) >= np.cos(np.radians(rules.widest_deg))
    for depth in depths:
        towards = depth * x - step
        distance = np.linalg.norm(towards, axis=1)
        cosine = np.clip((towards * y).sum(axis=1) / np.maximum(distance, 1e-9), -1.0, 1.0)
        # Between two depths of the ladder lies at most a tenth of the distance, seen under this much at worst.
        between = 0.1 * depth * np.linalg.norm(step) / np.maximum(distance, rules.nearest_m) ** 2
        slack = np.radians(rules.rotation_deg) + error_m / np.maximum(distance, rules.nearest_m) + between
        near = distance >= rules.nearest_m
        allowed |= near & (np.arccos(cosine) <= np.minimum(slack, np.pi / 4))
    return np.asarray(allowed & narrow)


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _walked(images: Sequence[SourceImage]) -> Array:
    """Return the way f64[n] in m that its sequence had walked at each image, by SLAM's positions."""
    result = np.zeros(len(images))
    sequences: dict[str, list[int]] = {}
    for i, image in enumerate(images):
        sequences.setdefault(image.sequence, []).append(i)
    for members in sequences.values():
        last, total = None, 0.0
        for i in walk_order(images, members):
            pose = images[i].slam_from_cam
            if pose is not None:
                total += 0.0 if last is None else float(np.linalg.norm(pose.translation - last))
                last = pose.translation
            result[i] = total
    return result
