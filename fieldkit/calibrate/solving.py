"""From localized photos to tags: start, agreement, the joint problem, and what it says about every sighting."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np

from fieldkit.calibrate.adjustment import (
    Adjusted,
    Corners,
    FixedLandmarks,
    Ints,
    Landmarks,
    Mask,
    State,
    adjust_cameras,
)
from fieldkit.calibrate.agreement import BELIEVED, Agreement, agree, settle, without
from fieldkit.calibrate.geometry import Poses
from fieldkit.calibrate.locating import LocatedPhoto
from fieldkit.calibrate.starting import Group, Homeless, Sighted, group, sight
from fieldkit.errors import TagError
from fieldkit.frames import Array, Pose, compose_covariance, pose_error
from fieldkit.frames import log as pose_log
from fieldkit.maps import MapWarp
from fieldkit.types import TAG_BOUNDS

# A photo known no better than this is not localized
LOST_SIGMA_M = 10.0
# Squared deviation (6 degrees of freedom) up to which a rejected sighting's other solution is the tag: one in 10^5
FLIP_GATE = 33.4


@dataclasses.dataclass(frozen=True)
class SolvedSighting:
    """What became of one sighting: whether it entered, its deviation in sigmas per dimension, and its own pose.

    ``offset`` is the distance (m) and angle (rad) between the tag as this photo has it by itself and the result,
    ``residual_px`` (8,) what remains in its corners; nan where the photo takes no part. ``without`` is how far the
    result moves (m, rad) without this photo; None where nothing else holds the tag. ``is_contradicted`` says that the
    photo is rejected at every other tag that others see too: not its corners are wrong, but where it is.
    """

    sighted: Sighted
    used: bool
    sigmas: float
    offset: tuple[float, float]
    residual_px: Array
    flipped: bool
    without: tuple[float, float] | None = None
    is_contradicted: bool = False


@dataclasses.dataclass(frozen=True)
class SizeCheck:
    """The edge of a tag as the map's scale shows it, its standard deviation as a share of it, and the judgement.

    ``is_wrong``: the given size contradicts the map; the tag's pose is then that of a tag of the size shown.
    """

    measured_m: float
    sigma: float
    is_wrong: bool


@dataclasses.dataclass(frozen=True)
class SolvedTag:
    """A tag's pose in the map with its 6x6 covariance, root mean square of its corners, and every sighting of it."""

    group: Group
    map_from_tag: Pose
    covariance: Array
    rms_px: float
    sightings: tuple[SolvedSighting, ...]
    size: SizeCheck

    @property
    def n_used(self) -> int:
        """Number of sightings that entered."""
        return sum(s.used for s in self.sightings)


@dataclasses.dataclass(frozen=True)
class Solved:
    """All tags, the sightings of moved tags that belong to no visit, and the scale of localization's noise."""

    tags: tuple[SolvedTag, ...]
    homeless: tuple[Homeless, ...]
    scale: float


@dataclasses.dataclass(frozen=True)
class _Problem:
    """What the landmarks of all photos say, the groups (t), and their sightings (c) in order."""

    fixed: FixedLandmarks
    groups: Sequence[Group]
    members: Sequence[Sighted]
    corners: Corners

    def start(self, sizes_m: Array) -> State:
        return State(self.fixed.centre, Poses.of([g.fix.ref_from_tag for g in self.groups]), sizes_m)


def solve_tags(
    photos: Sequence[LocatedPhoto],
    xyz: Array,
    covariance: Array,
    *,
    sizes_m: Mapping[int | None, float],
    warp: MapWarp | None = None,
) -> Solved:
    """Solve for the poses of all tags in localized photos, in a map with landmarks (l, 3) and covariances (l, 3, 3).

    ``warp`` (`fieldkit.maps.map_warp`) is what the landmarks are wrong by together; without it they are independent.
    First with all photos, to find those that agree; then with these alone, since a rejected one must not pull on the
    landmarks either. Raises TagError where the photos determine no pose.
    """
    try:
        return _solve(photos, xyz, covariance, sizes_m, warp)
    except np.linalg.LinAlgError as error:
        raise TagError(
            f"the {len(photos)} localized photos determine no pose ({error}); expected landmarks all over each photo",
            hint="take photos that show the tag and much of its mapped surroundings",
        ) from error


def _solve(
    photos: Sequence[LocatedPhoto],
    xyz: Array,
    covariance: Array,
    sizes_m: Mapping[int | None, float],
    warp: MapWarp | None,
) -> Solved:
    fixed, _ = place_photos(photos, xyz, covariance, warp)
    poses = [fixed.centre.pose(i) for i in range(len(photos))]
    blocks = [fixed.camera_covariance(i) for i in range(len(photos))]
    groups, homeless = group(sight(photos, poses, blocks, sizes_m), sizes_m)
    members = [s for g in groups for s in g.members]
    problem = _Problem(fixed, groups, members, _corners(groups))
    consensus: Mask = np.array([u for g in groups for u in g.fix.used], dtype=bool)
    sizes = _measure_sizes(problem, consensus)
    start = problem.start(sizes.solved_m)
    agreed = agree(fixed, problem.corners, start, used=consensus, free_sizes=sizes.is_wrong)
    kept = np.unique(problem.corners.photo[agreed.adjusted.used])
    alone, excess = place_photos([photos[i] for i in kept], xyz, covariance, warp)
    final, corners, rows = _settle(problem, agreed, kept, alone, sizes.is_wrong)
    sightings = _sightings(problem, agreed, final, corners, rows)
    tags = [_tag(t, problem, final, sightings, sizes.of(t)) for t in range(len(groups))]
    return Solved(tuple(tags), tuple(homeless), final.scale * math.sqrt(excess))


def place_photos(
    photos: Sequence[LocatedPhoto], xyz: Array, covariance: Array, warp: MapWarp | None = None
) -> tuple[FixedLandmarks, float]:
    """Return what the landmarks say about the photos, and the factor of their variance that residuals show.

    With ``warp`` the photos' covariance has what errors of the mapping images do to all landmarks together.
    """
    landmarks = Landmarks.of([(p.landmark, p.bearings) for p in photos], xyz, covariance)
    found = adjust_cameras(landmarks, Poses.of([p.map_from_cam for p in photos]))
    excess = (BELIEVED + found.chi2) / (BELIEVED + max(landmarks.freedom, 0))
    fixed = FixedLandmarks(found.centre, found.normal / excess, found.chi2 / excess)
    for i, photo in enumerate(photos):
        variance = float(np.trace(fixed.camera_covariance(i)[3:, 3:]))
        if not 0.0 < variance < LOST_SIGMA_M**2:
            raise np.linalg.LinAlgError(f"the landmarks in {photo.file} leave it open")
    if warp is not None:
        shared = warp.covariance(landmarks.rows, landmarks.response(found.centre, found.normal))
        fixed = fixed.warped(shared)
    return fixed, excess


def _corners(groups: Sequence[Group]) -> Corners:
    return Corners.of(
        [(s.photo, t, s.sighting.camera, s.sighting.detection) for t, g in enumerate(groups) for s in g.members]
    )


def _settle(
    problem: _Problem, agreed: Agreement, kept: Ints, alone: FixedLandmarks, free_sizes: Mask
) -> tuple[Agreement, Corners, Mask]:
    """Solve with the photos that agree alone; also return their sightings, and which (c) of all these are."""
    every, state = problem.corners, agreed.adjusted.state
    rows: Mask = np.isin(every.photo, kept)
    corners = every.chosen(rows, np.searchsorted(kept, every.photo[rows]))
    final = settle(
        alone,
        corners,
        State(alone.centre, state.tags, state.sizes_m),
        used=agreed.adjusted.used[rows],
        scale=agreed.scale,
        free_sizes=free_sizes,
    )
    return final, corners, rows


@dataclasses.dataclass(frozen=True)
class _Sizes:
    measured_m: Array
    sigma: Array
    is_wrong: Mask
    given_m: Array

    @property
    def solved_m(self) -> Array:
        return np.where(self.is_wrong, self.measured_m, self.given_m)

    def of(self, tag: int) -> SizeCheck:
        return SizeCheck(float(self.measured_m[tag]), float(self.sigma[tag]), bool(self.is_wrong[tag]))


def _measure_sizes(problem: _Problem, consensus: Mask) -> _Sizes:
    """Solve with every tag's size free: what the map's scale says about it."""
    n = len(problem.groups)
    given = np.array([g.size_m for g in problem.groups])
    start = problem.start(np.array([g.start_size_m for g in problem.groups]))
    free = agree(problem.fixed, problem.corners, start, used=consensus, free_sizes=np.ones(n, dtype=bool))
    sigma = np.sqrt(np.diag(free.adjusted.covariance)[-n:] * free.inflation)
    measured = free.adjusted.state.sizes_m
    deviation = np.abs(np.log(measured / given))
    return _Sizes(
        measured, sigma, (deviation > TAG_BOUNDS.size_sigmas * sigma) & (deviation > TAG_BOUNDS.size_share), given
    )


def _sightings(
    problem: _Problem, agreed: Agreement, final: Agreement, corners: Corners, rows: Mask
) -> list[SolvedSighting]:
    """Return what became of every sighting (c)."""
    used, every = agreed.adjusted.used, problem.corners
    sigmas = agreed.sigmas
    sigmas[rows] = final.sigmas
    moved = np.full((len(every), 2), np.nan)
    moved[rows] = _moved_without(final.adjusted, corners)
    residual = np.full((len(every), 8), np.nan)
    residual[rows] = final.adjusted.residual
    seen_by = np.bincount(every.tag)
    result = []
    for c, sighted in enumerate(problem.members):
        others = (every.photo == every.photo[c]) & (seen_by[every.tag] > 1)
        tag = int(every.tag[c])
        map_from_tag, covariance = final.adjusted.state.tags.pose(tag), final.adjusted.tag_covariance(tag)
        result.append(
            SolvedSighting(
                sighted,
                bool(used[c]),
                float(sigmas[c]),
                pose_error(sighted.sighting.ref_from_cam * sighted.solution.cam_from_tag, map_from_tag),
                np.linalg.cholesky(sighted.sighting.detection.noise_px) @ residual[c],
                _is_flipped(sighted, map_from_tag, None if used[c] else covariance),
                None if np.isnan(moved[c, 0]) else (float(moved[c, 0]), float(moved[c, 1])),
                int(others.sum()) > int(not used[c]) and not bool(used[others].any()),
            )
        )
    return result


def _tag(
    tag: int,
    problem: _Problem,
    final: Agreement,
    sightings: Sequence[SolvedSighting],
    size: SizeCheck,
) -> SolvedTag:
    own = [s for s, t in zip(sightings, problem.corners.tag, strict=True) if t == tag]
    map_from_tag, covariance = final.adjusted.state.tags.pose(tag), final.adjusted.tag_covariance(tag) * final.inflation
    if sum(s.used for s in own) == 1 < len(own):
        # No two photos agree, and nothing tells which one is right
        apart = np.median([s.offset for s in own if not s.used], axis=0)
        covariance = covariance + np.diag(np.repeat(apart[::-1] ** 2 / 3, 3))
    return SolvedTag(
        problem.groups[tag],
        map_from_tag,
        covariance,
        float(np.sqrt(np.mean([s.residual_px**2 for s in own if s.used]))),
        tuple(own),
        size,
    )


def _moved_without(adjusted: Adjusted, corners: Corners) -> Array:
    """Return how far (m, rad) a sighting's tag moves without its photo, (c, 2); nan where nothing else holds it."""
    photo, tag = corners.photo, corners.tag
    result = np.full((len(photo), 2), np.nan)
    n_used = np.bincount(tag[adjusted.used], minlength=len(adjusted.state.tags))
    for i in np.unique(photo[adjusted.used]):
        rows = adjusted.used & (photo == i) & (n_used[tag] > 1)
        if not rows.any():
            continue
        step = without(adjusted, rows)
        for c in np.flatnonzero(rows):
            first = 6 * (len(adjusted.state.cameras) + tag[c])
            turn, shift = step[first : first + 3], step[first + 3 : first + 6]
            result[c] = np.linalg.norm(shift), np.linalg.norm(turn)
    return result


def _is_flipped(sighted: Sighted, map_from_tag: Pose, covariance: Array | None) -> bool:
    """Tell whether a photo by itself prefers the other planar solution of a tag.

    Of a rejected photo (with the tag's covariance) the other solution must be the tag: one that is localized wrongly
    may come closer with its other solution, but does not agree.
    """
    cam, solution = sighted.sighting.ref_from_cam, sighted.solution
    if solution.alternative is None or solution.alternative_covariance is None:
        return False
    own, other = cam * solution.cam_from_tag, cam * solution.alternative
    if pose_error(other, map_from_tag)[1] >= pose_error(own, map_from_tag)[1]:
        return False
    if covariance is None:
        return True
    total = compose_covariance(sighted.sighting.covariance, solution.alternative, solution.alternative_covariance)
    delta = pose_log(other.inv() * map_from_tag)
    return bool(delta @ np.linalg.solve(total + covariance, delta) < FLIP_GATE)
