"""The same photos localized in a second map: what one map, its feature and its landmarks, may hide."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fieldkit.calibrate.locating import LocatedPhoto, locate
from fieldkit.calibrate.photos import Progress, find_tags, list_photos
from fieldkit.calibrate.solving import place_photos
from fieldkit.errors import TagError
from fieldkit.frames import Array, Pose, exp
from fieldkit.frames import log as pose_log
from fieldkit.maps import map_warp
from fieldkit.types import SceneMap

# Squared deviation of a photo (6 degrees of freedom) beyond which its two poses contradict each other: one in 10^4
GATE = 27.9
# Median of chi-square with 6 degrees of freedom
MEDIAN_CHI2 = 5.35
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


@dataclasses.dataclass(frozen=True)
class PlacedPhotos:
    """Photos (p) in one map: map_from_cam of each, and the covariance f64[6p, 6p] of all of them."""

    poses: tuple[Pose, ...]
    covariance: Array


def refuse_same_map(first: SceneMap, second: SceneMap) -> None:
    """Raise TagError where a second map is the first."""
    if first.digest == second.digest:
        raise TagError(
            f"{second.path}: is the map that is checked; expected another", hint="build one with another --feature"
        )


def check_in_second_map(
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
    """Localize the photos of tags in two maps and compare their poses with their covariances.

    The second map may be built with another feature, from other images, or on another day; its frame may differ. What
    both maps share (their images, SLAM's poses) can be wrong in both: this finds what a feature or its matches get
    wrong, not that. Raises TagError where fewer than MIN_PHOTOS are localized in both, or the maps are one.
    """
    refuse_same_map(first, second)
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


def _placed(located: Sequence[LocatedPhoto], files: Sequence[str], scene_map: SceneMap) -> PlacedPhotos:
    chosen = [p for p in located if p.file in files]
    fixed, _ = place_photos(
        chosen, scene_map.xyz, np.asarray(scene_map.xyz_covariance, dtype=np.float64), map_warp(scene_map)
    )
    return PlacedPhotos(tuple(fixed.centre.pose(i) for i in range(len(chosen))), fixed.covariance)


def compare(
    files: Sequence[str],
    first: PlacedPhotos,
    second: PlacedPhotos,
    *,
    lost: Sequence[tuple[str, str]] = (),
    features: tuple[str, str] = ("", ""),
) -> SecondLook:
    """Compare poses of the same photos in two maps, by one similarity between the maps that fits those that agree.

    What the photos of a map are wrong by together is in its covariance, and so in the fit. A photo is judged by what
    the others predict for it.
    """
    fit, log_scale = _mean_start(first.poses, second.poses), 0.0
    # Both are of the camera in its own frame, which is nearly the same
    total = first.covariance + second.covariance
    deltas = _deltas(fit, log_scale, first, second)
    agrees = _passed(np.array([d @ np.linalg.solve(_block(total, [i]), d) for i, d in enumerate(deltas)]))
    for _ in range(20):
        slopes = _slopes(fit, log_scale, first, second)
        rows = np.flatnonzero(agrees)
        weighted = np.linalg.solve(_block(total, rows), slopes[rows].reshape(-1, 7))
        spread = np.linalg.inv(slopes[rows].reshape(-1, 7).T @ weighted)
        step = -spread @ weighted.T @ deltas[rows].ravel()
        fit, log_scale = fit * exp(step[:6]), log_scale + float(step[6])
        deltas = _deltas(fit, log_scale, first, second)
        chi2 = np.array([_contradiction(i, agrees, deltas, slopes, total) for i in range(len(files))])
        before, agrees = agrees, _passed(chi2)
        if float(np.abs(step).max()) < 1e-9 and (before == agrees).all():
            break
    remains = deltas[rows].ravel()
    root = math.sqrt(float(remains @ np.linalg.solve(_block(total, rows), remains)) / max(len(remains) - 7, 1))
    photos = tuple(
        PhotoDifference(f, float(np.linalg.norm(d[3:])), float(np.linalg.norm(d[:3])), math.sqrt(x / 6), bool(x < GATE))
        for f, d, x in zip(files, deltas, chi2, strict=True)
    )
    scale = math.expm1(-log_scale), math.sqrt(float(spread[6, 6])) * max(1.0, root)
    offset = float(np.linalg.norm(fit.translation)), float(fit.rotation.magnitude())
    return SecondLook(features, photos, tuple(lost), offset, scale, root, _judge(photos, root, scale))


def _passed(chi2: Array) -> NDArray[np.bool_]:
    passed: NDArray[np.bool_] = chi2 <= max(GATE, GATE * float(np.median(chi2)) / MEDIAN_CHI2)
    return passed


def _contradiction(photo: int, agrees: NDArray[np.bool_], deltas: Array, slopes: Array, total: Array) -> float:
    """Return the chi-square (6) of a photo against what the others that agree predict, fit included.

    This is universal kriging (Cressie 1993, section 3.4): errors that photos share are predicted, too.
    """
    others = np.flatnonzero(agrees & (np.arange(len(agrees)) != photo))
    known, own = _block(total, others), _block(total, [photo])
    mixed = _block(total, [photo], others)
    gain = np.linalg.solve(known, mixed.T).T
    trend = slopes[others].reshape(-1, 7)
    spread = np.linalg.pinv(trend.T @ np.linalg.solve(known, trend), hermitian=True)
    shift = spread @ trend.T @ np.linalg.solve(known, deltas[others].ravel())
    open_slope = slopes[photo] - gain @ trend
    residual = deltas[photo] - slopes[photo] @ shift - gain @ (deltas[others].ravel() - trend @ shift)
    covariance = own - gain @ mixed.T + open_slope @ spread @ open_slope.T
    return float(residual @ np.linalg.solve(covariance, residual))


def _block(total: Array, rows: Sequence[int] | NDArray[Any], columns: NDArray[Any] | None = None) -> Array:
    """Return the 6x6 blocks of photos of a covariance (6p, 6p)."""
    first = (6 * np.asarray(rows)[:, None] + np.arange(6)).ravel()
    second = first if columns is None else (6 * columns[:, None] + np.arange(6)).ravel()
    return np.asarray(total[np.ix_(first, second)])


def _deltas(fit: Pose, log_scale: float, first: PlacedPhotos, second: PlacedPhotos) -> Array:
    return np.array([_delta(fit, log_scale, a, b) for a, b in zip(first.poses, second.poses, strict=True)])


def _slopes(fit: Pose, log_scale: float, first: PlacedPhotos, second: PlacedPhotos) -> Array:
    return np.array([_slope(fit, log_scale, a, b) for a, b in zip(first.poses, second.poses, strict=True)])


def _judge(
    rows: Sequence[PhotoDifference], spread: float, scale: tuple[float, float]
) -> Literal["pass", "warn", "fail"]:
    wrong = sum(not r.agrees for r in rows)
    if spread > FAIL_SPREAD or 2 * wrong > len(rows):
        return "fail"
    off = abs(scale[0]) > 3 * scale[1]
    return "warn" if wrong or off or spread > PASS_SPREAD else "pass"


def _mean_start(first: Sequence[Pose], second: Sequence[Pose]) -> Pose:
    """Return first_from_second of the photo whose own fit is closest to all others'."""
    own = [a * b.inv() for a, b in zip(first, second, strict=True)]
    centre = np.mean([b.translation for b in second], axis=0)

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
