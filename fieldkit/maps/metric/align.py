"""Metric scale and frame: a robust similarity of the reconstructed cameras to the SLAM cameras, then gravity."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fieldkit.errors import MapError
from fieldkit.frames import Pose
from fieldkit.maps.metric.motion import Walks, motion_scale, position_sigma
from fieldkit.maps.sources.source import MIN_POSES

Array = NDArray[np.float64]
Verdict = Literal["pass", "warn", "fail"]
AlignmentSource = Literal["slam", "tags", "depth", "known"]
GravityFrom = Literal["slam", "floor", "verticals", "cameras", "known"]

# Below this no camera is called an outlier, however well the others fit: SLAM and SfM both are that uncertain.
_MIN_THRESHOLD_M = 0.05
# Threshold in median residuals: a steady drift is kept whole, positions that are plainly wrong are left out.
_WIDTH = 4.0
# Steps that tell the scale less surely than this are short against their noise, which then also biases them
_SURE = 0.005
# Drift that bends the whole walk leaves small residuals: in rendered walks positions were off by up to three times what
# their residuals tell (tests/bench/test_map_accuracy.py)
_UNSEEN = 3.0
_WRONG_RATIO = 1.2
# Tilt between SLAM's up and the map's that is levelled; more means that one of the two is wrong.
_MAX_LEVELLED_DEG = 5.0


@dataclasses.dataclass(frozen=True)
class Similarity:
    """a_from_b with scale: x_in_a = scale * rotation * x_in_b + translation."""

    scale: float
    rotation: Rotation
    translation: Array

    def points(self, x_in_b: Array) -> Array:
        """Map points (n, 3)."""
        return np.asarray(self.scale * self.rotation.apply(x_in_b) + self.translation)

    def pose(self, b_from_c: Pose) -> Pose:
        """Map a pose: its origin moves with the points, its axes turn."""
        return Pose.from_components(
            self.points(b_from_c.translation[None])[0],
            Rotation.from_matrix((self.rotation * b_from_c.rotation).as_matrix()),
        )


@dataclasses.dataclass(frozen=True)
class Alignment:
    """How the map got its scale and frame, and how well SLAM agrees with it.

    Residuals are distances between aligned and SLAM camera centres: ``rms_m`` of those used, ``p95_m`` of all.
    ``gravity_deg`` is the median angle between the up directions of aligned and SLAM cameras, after levelling.
    ``threshold_m`` is the residual above which a SLAM position was left out; it is chosen from the drift.
    Without SLAM positions what is counted, and the residuals, are those of ``source``: tags' corners or depths at
    landmarks, in m; ``gravity_deg`` is the standard deviation of the direction that ``gravity_from`` tells of.
    ``scale_sigma`` is the relative standard deviation of the scale. Of poses that were given, ``reprojection_px`` is
    the root mean square residual in the images, and ``match_share`` how much of the matches they fit.
    """

    map_from_sfm: Similarity
    source: AlignmentSource
    n_used: int
    n_total: int
    rms_m: float
    p95_m: float
    gravity_deg: float
    threshold_m: float
    verdict: Verdict
    gravity_from: GravityFrom = "slam"
    scale_sigma: float | None = None
    reprojection_px: float | None = None
    match_share: float | None = None


def doubted(alignment: Alignment, ratio: float) -> Alignment:
    """Return an alignment that does not pass: two sources of its scale contradict each other by a factor ``ratio``.

    By more than a fifth it fails: no drift or calibration is off by that, but a unit or the size of a tag.
    """
    if max(ratio, 1.0 / ratio) > _WRONG_RATIO:
        return dataclasses.replace(alignment, verdict="fail")
    return dataclasses.replace(alignment, verdict="warn") if alignment.verdict == "pass" else alignment


def umeyama(source: Array, target: Array) -> Similarity:
    """Fit target = scale * rotation * source + translation to points (n, 3) by least squares (Umeyama, PAMI 1991)."""
    mean_s, mean_t = source.mean(axis=0), target.mean(axis=0)
    s, t = source - mean_s, target - mean_t
    u, d, vt = np.linalg.svd(t.T @ s / len(s))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    matrix = u @ np.diag(sign) @ vt
    variance = float((s**2).sum() / len(s))
    scale = float((d * sign).sum() / variance) if variance > 0 else 0.0
    rotation = Rotation.from_matrix(matrix)
    return Similarity(scale, rotation, mean_t - scale * rotation.apply(mean_s))


def robust_similarity(source: Array, target: Array, *, rng: np.random.Generator) -> tuple[Similarity, float]:
    """Fit a similarity of which less than half of the points (n, 3) may be wrong; return it and its threshold (m).

    Starts from the least median of residuals over random triples and then fits to all points within four times the
    median residual, but at least 0.05 m: a drifting trajectory widens its own threshold, where a fixed one would
    throw most of it away.
    """
    best, lowest = umeyama(source, target), np.inf
    for _ in range(500):
        pick = rng.choice(len(source), 3, replace=False)
        trial = umeyama(source[pick], target[pick])
        if not 1e-6 < trial.scale < 1e6:
            continue
        median = float(np.median(np.linalg.norm(trial.points(source) - target, axis=1)))
        if median < lowest:
            best, lowest = trial, median
    threshold = max(2.0 * _WIDTH * lowest, _MIN_THRESHOLD_M)
    kept = np.zeros(len(source), dtype=bool)
    for _ in range(30):
        now = np.linalg.norm(best.points(source) - target, axis=1) <= threshold
        if (now == kept).all() or now.sum() < MIN_POSES:
            break
        kept = now
        best = umeyama(source[kept], target[kept])
        residual = np.linalg.norm(best.points(source) - target, axis=1)
        threshold = max(_WIDTH * float(np.median(residual)), _MIN_THRESHOLD_M)
    return best, threshold


def align_to_slam(
    sfm_from_cam: Sequence[Pose], slam_from_cam: Sequence[Pose], *, seed: int, walks: Walks = ()
) -> Alignment:
    """Find the map frame: SLAM's scale, position, heading and gravity for the cameras that SfM placed.

    The similarity is fitted to the camera centres; then the map is levelled, so that the median up direction of
    its cameras agrees with SLAM's, which knows gravity better than its drifting heights do. Where ``walks``, rows of
    images in the order in which they were taken, tell the scale more surely by their steps, it is taken from them.
    Raises MapError when fewer than three cameras have SLAM poses or they stand on one spot.
    """
    if len(sfm_from_cam) < MIN_POSES:
        raise MapError(
            f"{len(sfm_from_cam)} mapped images have a SLAM pose; expected at least {MIN_POSES}",
            hint="check that the names of the poses are those of the images",
        )
    source = np.stack([p.translation for p in sfm_from_cam])
    target = np.stack([p.translation for p in slam_from_cam])
    spread = float(np.linalg.norm(target - target.mean(axis=0), axis=1).max())
    if spread < 2 * _MIN_THRESHOLD_M:
        raise MapError(
            f"the SLAM positions lie within {spread:.3f} m of each other; expected a walk",
            hint="metric scale needs a walk of a metre or more; check the unit of the poses (m)",
        )
    similarity, threshold = robust_similarity(source, target, rng=np.random.default_rng(seed))
    used = np.linalg.norm(similarity.points(source) - target, axis=1) <= threshold
    if not used.any() or similarity.scale <= 0:
        raise MapError("the SLAM positions do not fit the reconstruction", hint="check the poses")
    similarity = _levelled(similarity, source, target, used, _ups(similarity, sfm_from_cam, slam_from_cam))
    similarity, sigma = _by_motion(similarity, sfm_from_cam, slam_from_cam, used, walks)
    residual = np.linalg.norm(similarity.points(source) - target, axis=1)
    used = residual <= threshold
    tilt = np.degrees(np.arccos(np.clip(_ups(similarity, sfm_from_cam, slam_from_cam)[:, 2], -1.0, 1.0)))
    rms = float(np.sqrt((residual[used] ** 2).mean())) if used.any() else float(np.sqrt((residual**2).mean()))
    gravity = float(np.median(tilt))
    share = float(used.mean())
    return Alignment(
        similarity,
        "slam",
        int(used.sum()),
        len(used),
        rms,
        float(np.percentile(residual, 95)),
        gravity,
        threshold,
        _verdict(share, rms / spread, gravity),
        scale_sigma=sigma,
    )


def _by_motion(
    similarity: Similarity,
    sfm_from_cam: Sequence[Pose],
    slam_from_cam: Sequence[Pose],
    used: NDArray[np.bool_],
    walks: Walks,
) -> tuple[Similarity, float | None]:
    """Return the similarity with the scale of the walks' steps where that is surer than that of the positions."""
    kept = [[i for i in walk if used[i]] for walk in walks]
    found = motion_scale(sfm_from_cam, slam_from_cam, kept)
    if found is None:
        return similarity, None
    source = np.stack([p.translation for p in sfm_from_cam])
    target = np.stack([p.translation for p in slam_from_cam])
    placed = similarity.points(source)
    by_position = _UNSEEN * position_sigma(placed, target - placed, kept)
    scale, sigma = found
    if by_position < sigma or sigma > _SURE:
        return similarity, by_position
    middle = similarity.rotation.apply(source[used]).mean(axis=0)
    return Similarity(scale, similarity.rotation, target[used].mean(axis=0) - scale * middle), sigma


def _ups(similarity: Similarity, sfm_from_cam: Sequence[Pose], slam_from_cam: Sequence[Pose]) -> Array:
    """Return (n, 3): where SLAM's up direction, seen by each camera, points in the map."""
    map_from_slam = [
        similarity.rotation * a.rotation * b.rotation.inv() for a, b in zip(sfm_from_cam, slam_from_cam, strict=True)
    ]
    return np.stack([r.apply([0.0, 0.0, 1.0]) for r in map_from_slam])


def _levelled(similarity: Similarity, source: Array, target: Array, used: NDArray[np.bool_], ups: Array) -> Similarity:
    up = np.median(ups[used], axis=0)
    up /= max(float(np.linalg.norm(up)), 1e-12)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    angle = float(np.arctan2(np.linalg.norm(axis), up[2]))
    if np.degrees(angle) > _MAX_LEVELLED_DEG:
        return similarity
    tilt = Rotation.from_rotvec(axis / max(float(np.linalg.norm(axis)), 1e-12) * angle)
    rotation = tilt * similarity.rotation
    turned = rotation.apply(source[used])
    s, t = turned - turned.mean(axis=0), target[used] - target[used].mean(axis=0)
    scale = float((s * t).sum() / (s * s).sum())
    return Similarity(scale, rotation, target[used].mean(axis=0) - scale * turned.mean(axis=0))


def _verdict(share_used: float, rms_of_extent: float, gravity_deg: float) -> Verdict:
    """Judge an alignment: residuals relative to the extent of the walk bound the error of the scale."""
    if share_used < 0.5 or rms_of_extent > 0.2 or gravity_deg > _MAX_LEVELLED_DEG:
        return "fail"
    return "pass" if share_used >= 0.7 and rms_of_extent <= 0.05 and gravity_deg <= 1.0 else "warn"
