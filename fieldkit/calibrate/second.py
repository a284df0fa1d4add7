"""The same photos localized in a second map: what one map, its feature and its landmarks, may hide."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from fieldkit.calibrate.locating import LocatedPhoto, locate
from fieldkit.calibrate.photos import Progress, find_tags, list_photos
from fieldkit.calibrate.solving import place_photos
from fieldkit.errors import TagError
from fieldkit.frames import Array, Pose, exp
from fieldkit.frames import log as pose_log
from fieldkit.maps import load_map, map_warp
from fieldkit.types import SceneMap

# Squared deviation of a photo (6 degrees of freedom) beyond which its two poses contradict each other: one in 10^4
GATE = 27.9
# Root mean normalised error of the photos up to which two maps agree, and from which they do not
PASS_SPREAD, FAIL_SPREAD = 1.5, 3.0
MIN_PHOTOS = 4


@dataclasses.dataclass(frozen=True)
class PhotoDifference:
    """One photo in both maps: distance (m) and angle (rad) between its poses, and how far that is in sigmas."""

    file: str
    position_m: float
    rotation_rad: float
    sigmas: float
    agrees: bool


@dataclasses.dataclass(frozen=True)
class SecondLook:
    """Photos in a second map, after one rigid fit with scale between the maps.

    ``offset`` is that fit (m, rad), ``scale`` the second map's lengths over the first's less 1, with its sigma.
    ``spread`` is the root mean normalised error of what remains: 1 where the stated covariances are true.
    ``lost`` photos were localized in one of the maps only, named with the map that lacks them.
    """

    features: tuple[str, str]
    photos: tuple[PhotoDifference, ...]
    lost: tuple[tuple[str, str], ...]
    offset: tuple[float, float]
    scale: tuple[float, float]
    spread: float
    verdict: Literal["pass", "warn", "fail"]


def check_in_second_map(
    photos: Path,
    map_path: Path,
    second_path: Path,
    *,
    camera: Path | None = None,
    sizes_m: Mapping[int | None, float],
    families: Sequence[str] = ("tag36h11",),
    detector: str | None = None,
    progress: Progress | None = None,
) -> SecondLook:
    """Localize the photos of tags in two maps and compare their poses with their covariances.

    The second map may be built with another feature, from other images, or on another day; its frame may differ. What
    both maps share (their images, SLAM's poses) can be wrong in both: this finds what a feature or its matches get
    wrong, not that. Raises TagError where fewer than MIN_PHOTOS are localized in both; MapError, StoreError.
    """
    first, second = load_map(Path(map_path)), load_map(Path(second_path))
    return look_again(
        photos, first, second, camera=camera, sizes_m=sizes_m, families=families, detector=detector, progress=progress
    )


def look_again(
    photos: Path,
    first: SceneMap,
    second: SceneMap,
    *,
    camera: Path | None = None,
    sizes_m: Mapping[int | None, float],
    families: Sequence[str] = ("tag36h11",),
    detector: str | None = None,
    progress: Progress | None = None,
) -> SecondLook:
    """Localize photos in two maps and compare their poses; see `check_in_second_map`."""
    if first.digest == second.digest:
        raise TagError(
            f"{second.path}: is the map that is checked; expected another", hint="build one with another --feature"
        )
    shots, _ = find_tags(
        Path(photos), list_photos(Path(photos), camera), sizes_m, families, progress, detector=detector
    )
    both = [locate(shots, scene_map, None, progress)[0] for scene_map in (first, second)]
    names = [{p.file for p in located} for located in both]
    shared = [p.file for p in both[0] if p.file in names[1]]
    lost = [
        (shot.photo.file, scene_map.path)
        for shot in shots
        for scene_map, own in zip((first, second), names, strict=True)
        if shot.photo.file not in own
    ]
    if len(shared) < MIN_PHOTOS:
        raise TagError(
            f"{photos}: {len(shared)} photos are localized in both {first.path} and {second.path}; expected at least "
            f"{MIN_PHOTOS}",
            hint="check that both maps show the place",
        )
    placed = [_placed(located, shared, scene_map) for located, scene_map in zip(both, (first, second), strict=True)]
    return compare(shared, *placed, lost=lost, features=(first.feature, second.feature))


def _placed(located: Sequence[LocatedPhoto], files: Sequence[str], scene_map: SceneMap) -> list[tuple[Pose, Array]]:
    """Return map_from_cam and its covariance of every photo, from its landmarks."""
    chosen = [p for p in located if p.file in files]
    fixed, _ = place_photos(chosen, scene_map.xyz, scene_map.xyz_covariance, map_warp(scene_map))
    return [(fixed.centre.pose(i), fixed.camera_covariance(i)) for i in range(len(chosen))]


def compare(
    files: Sequence[str],
    first: Sequence[tuple[Pose, Array]],
    second: Sequence[tuple[Pose, Array]],
    *,
    lost: Sequence[tuple[str, str]] = (),
    features: tuple[str, str] = ("", ""),
) -> SecondLook:
    """Compare poses of the same photos with their 6x6 covariances in two maps."""
    fit, log_scale = _mean_start(first, second), 0.0
    agrees = np.ones(len(files), dtype=bool)
    for _ in range(20):
        deltas = [_delta(fit, log_scale, a, b) for (a, _), (b, _) in zip(first, second, strict=True)]
        # Both are of the camera in its own frame, which is nearly the same
        totals = [ca + cb for (_, ca), (_, cb) in zip(first, second, strict=True)]
        slopes = [_slope(fit, log_scale, a, b) for (a, _), (b, _) in zip(first, second, strict=True)]
        chi2 = np.array([d @ np.linalg.solve(c, d) for d, c in zip(deltas, totals, strict=True)])
        agrees = chi2 < max(GATE, GATE * float(np.median(chi2)) / 5.35)
        normal, gradient = np.zeros((7, 7)), np.zeros(7)
        for ok, d, c, j in zip(agrees, deltas, totals, slopes, strict=True):
            if ok:
                weighted = np.linalg.solve(c, j)
                normal += j.T @ weighted
                gradient -= weighted.T @ d
        step = np.linalg.solve(normal, gradient)
        fit, log_scale = fit * exp(step[:6]), log_scale + float(step[6])
        if float(np.abs(step).max()) < 1e-9:
            break
    sigma = math.sqrt(float(np.linalg.inv(normal)[6, 6]))
    freedom = max(6 * int(agrees.sum()) - 7, 1)
    spread = math.sqrt(float(chi2[agrees].sum()) / freedom)
    rows = tuple(
        PhotoDifference(f, float(np.linalg.norm(d[3:])), float(np.linalg.norm(d[:3])), math.sqrt(x / 6), bool(x < GATE))
        for f, d, x in zip(files, deltas, chi2, strict=True)
    )
    scale = math.expm1(-log_scale), sigma * max(1.0, spread)
    offset = float(np.linalg.norm(fit.translation)), float(fit.rotation.magnitude())
    return SecondLook(features, rows, tuple(lost), offset, scale, spread, _judge(rows, spread, scale))


def _judge(
    rows: Sequence[PhotoDifference], spread: float, scale: tuple[float, float]
) -> Literal["pass", "warn", "fail"]:
    wrong = sum(not r.agrees for r in rows)
    if spread > FAIL_SPREAD or 2 * wrong > len(rows):
        return "fail"
    off = abs(scale[0]) > 3 * scale[1]
    return "warn" if wrong or off or spread > PASS_SPREAD else "pass"


def _mean_start(first: Sequence[tuple[Pose, Array]], second: Sequence[tuple[Pose, Array]]) -> Pose:
    """Return first_from_second of the photo whose own fit is closest to all others'."""
    own = [a * b.inv() for (a, _), (b, _) in zip(first, second, strict=True)]
    centre = np.mean([b.translation for b, _ in second], axis=0)

    def away(fit: Pose) -> float:
        there = fit.apply(centre)
        return float(np.median([np.linalg.norm(there - o.apply(centre)) for o in own]))

    return min(own, key=away)


def _delta(fit: Pose, log_scale: float, a: Pose, b: Pose) -> Array:
    """Return the tangent (6,) from a photo's pose in the first map to that in the second, brought into the first."""
    scaled = Pose.from_components(math.exp(log_scale) * b.translation, b.rotation)
    return pose_log(a.inv() * fit * scaled)


def _slope(fit: Pose, log_scale: float, a: Pose, b: Pose) -> Array:
    """Return the derivative (6, 7) of `_delta` by fit (right perturbation) and log scale."""
    columns = []
    for k in range(7):
        step = np.zeros(7)
        step[k] = 1e-6
        ahead = _delta(fit * exp(step[:6]), log_scale + step[6], a, b)
        columns.append((ahead - _delta(fit * exp(-step[:6]), log_scale - step[6], a, b)) / 2e-6)
    return np.stack(columns, axis=1)
