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
    Landmarks,
    Mask,
    State,
    adjust_cameras,
)
from fieldkit.calibrate.agreement import agree, settle, without
from fieldkit.calibrate.geometry import Bearings, Poses, bearings
from fieldkit.calibrate.locating import LocatedPhoto
from fieldkit.calibrate.starting import Group, Homeless, Sighted, group, sight
from fieldkit.frames import Array, Pose, compose_covariance, pose_error
from fieldkit.frames import log as pose_log

# A tag's size is wrong where the map's scale says so by that many sigmas, and by at least this share
SIZE_SIGMAS, SIZE_SHARE = 4.0, 0.005
# Squared deviation (6 degrees of freedom) up to which a rejected sighting's other solution is the tag: one in 10^5
FLIP_GATE = 33.4


@dataclasses.dataclass(frozen=True)
class SolvedSighting:
    """What became of one sighting: whether it entered, its deviation in sigmas per dimension, and its own pose.

    ``alone`` is map_from_tag as this photo has it by itself, ``offset`` its distance (m) and angle (rad) from the
    result. ``without`` is how far the result moves (m, rad) without this photo; None where nothing else holds the tag.
    ``is_contradicted`` says that the photo's other tags do not fit it either: its landmarks do.
    """

    sighted: Sighted
    used: bool
    sigmas: float
    offset: tuple[float, float]
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
class _Setting:
    """All photos: what their landmarks say, the groups (t), and their sightings (c) in order."""

    seen: Sequence[tuple[Array, Bearings]]
    xyz: Array
    covariance: Array
    fixed: FixedLandmarks
    groups: Sequence[Group]
    members: Sequence[Sighted]
    corners: Corners

    def start(self, sizes_m: Array) -> State:
        return State(self.fixed.centre, Poses.of([g.fix.ref_from_tag for g in self.groups]), sizes_m)


def solve_tags(
    photos: Sequence[LocatedPhoto], xyz: Array, covariance: Array, *, sizes_m: Mapping[int | None, float]
) -> Solved:
    """Solve for the poses of all tags in localized photos, in a map with landmarks (l, 3) and covariances (l, 3, 3).

    All that the landmarks' residuals exceed their noise by multiplies that noise at once, before any tag is looked at.
    Raises TagError where sightings of a tag determine no pose.
    """
    rows = [p.landmark for p in photos]
    landmarks = Landmarks.of([(r, p.bearings) for r, p in zip(rows, photos, strict=True)], xyz, covariance)
    found = adjust_cameras(landmarks, Poses.of([p.map_from_cam for p in photos]))
    excess = max(1.0, found.chi2 / max(landmarks.freedom, 1))
    fixed = FixedLandmarks(found.centre, found.normal / excess, found.chi2 / excess)
    poses = [fixed.centre.pose(i) for i in range(len(photos))]
    blocks = [fixed.camera_covariance(i) for i in range(len(photos))]
    groups, homeless = group(sight(photos, poses, blocks, sizes_m), sizes_m)
    members = [s for g in groups for s in g.members]
    seen = [(r, p.bearings.noisier(math.sqrt(excess))) for r, p in zip(rows, photos, strict=True)]
    setting = _Setting(seen, xyz, covariance * excess, fixed, groups, members, _corners(groups))
    tags, scale = _solve(setting, [p.shared for p in photos])
    return Solved(tuple(tags), tuple(homeless), scale * math.sqrt(excess))


def _corners(groups: Sequence[Group]) -> Corners:
    sightings = []
    for t, g in enumerate(groups):
        for s in g.members:
            d = s.sighting.detection
            sightings.append((s.photo, t, bearings(s.sighting.camera, d.corners_px, d.sigma_px)))
    return Corners.of(sightings)


def _solve(setting: _Setting, shared: Sequence[Array]) -> tuple[list[SolvedTag], float]:
    groups, corners = setting.groups, setting.corners
    consensus: Mask = np.array([u for g in groups for u in g.fix.used], dtype=bool)
    sizes = _measure_sizes(setting, consensus)
    agreed = agree(setting.fixed, corners, setting.start(sizes.solved_m), used=consensus, free_sizes=sizes.is_wrong)
    # Once more with the photos that agree alone: rejected ones must not pull on the landmarks either
    kept = np.unique(corners.photo[agreed.adjusted.used])
    rows = np.isin(corners.photo, kept)
    state = agreed.adjusted.state
    final = settle(
        adjust_cameras(
            Landmarks.of([setting.seen[i] for i in kept], setting.xyz, setting.covariance), state.cameras[kept]
        ),
        Corners(np.searchsorted(kept, corners.photo[rows]), corners.tag[rows], corners.bearings[rows]),
        State(state.cameras[kept], state.tags, state.sizes_m),
        used=agreed.adjusted.used[rows],
        scale=agreed.scale,
        free_sizes=sizes.is_wrong,
    )
    sigmas = agreed.sigmas
    sigmas[rows] = final.sigmas
    used = agreed.adjusted.used
    moved = np.full((len(corners), 2), np.nan)
    moved[rows] = _moved_without(final.adjusted, np.searchsorted(kept, corners.photo[rows]), corners.tag[rows])
    residual = np.zeros((len(corners), 8))
    residual[rows] = final.adjusted.residual
    tags = []
    for t in range(len(groups)):
        members = np.flatnonzero(corners.tag == t)
        noise = np.array([[setting.members[c].sighting.detection.sigma_px] for c in members if used[c]])
        map_from_tag = final.adjusted.state.tags.pose(t)
        covariance = final.adjusted.tag_covariance(t) * final.inflation
        common = [shared[setting.members[c].photo] for c in members if used[c]]
        cams = [setting.members[c].sighting.ref_from_cam for c in members if used[c]]
        sightings = tuple(
            _sighting(
                setting.members[c], map_from_tag, covariance, bool(used[c]), float(sigmas[c]), moved[c],
                _is_contradicted(corners, used, c),
            )
            for c in members
        )  # fmt: skip
        tags.append(
            SolvedTag(
                groups[t],
                map_from_tag,
                covariance + _common(common, cams, map_from_tag),
                float(np.sqrt(np.mean((residual[members[used[members]]] * noise) ** 2))),
                sightings,
                sizes.of(t),
            )
        )
    return tags, final.scale


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


def _measure_sizes(setting: _Setting, consensus: Mask) -> _Sizes:
    """Solve with every tag's size free: what the map's scale says about it."""
    n = len(setting.groups)
    given = np.array([g.size_m for g in setting.groups])
    start = setting.start(np.array([g.start_size_m for g in setting.groups]))
    free = agree(setting.fixed, setting.corners, start, used=consensus, free_sizes=np.ones(n, dtype=bool))
    sigma = np.sqrt(np.diag(free.adjusted.covariance)[-n:] * free.inflation)
    measured = free.adjusted.state.sizes_m
    deviation = np.abs(np.log(measured / given))
    return _Sizes(measured, sigma, (deviation > SIZE_SIGMAS * sigma) & (deviation > SIZE_SHARE), given)


def _moved_without(adjusted: Adjusted, photo: Array, tag: Array) -> Array:
    """Return how far (m, rad) each sighting's tag moves when the sighting's photo is left out; nan where it must not."""
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


def _is_contradicted(corners: Corners, used: Mask, c: int) -> bool:
    """Tell whether a photo is rejected at every tag, two or more, that others see."""
    seen_by = np.bincount(corners.tag)
    rows = (corners.photo == corners.photo[c]) & (seen_by[corners.tag] > 1)
    return int(rows.sum()) > 1 and not bool(used[rows].any())


def _common(shared: Sequence[Array], cams: Sequence[Pose], map_from_tag: Pose) -> Array:
    """Return the mean covariance that photos carry to a tag from what they are wrong by together: once, not divided."""
    carried = [compose_covariance(s, cam.inv() * map_from_tag) for s, cam in zip(shared, cams, strict=True)]
    return np.asarray(np.mean(carried, axis=0))


def _sighting(
    sighted: Sighted,
    map_from_tag: Pose,
    covariance: Array,
    used: bool,
    sigmas: float,
    moved: Array,
    is_contradicted: bool,
) -> SolvedSighting:
    cam, solution = sighted.sighting.ref_from_cam, sighted.solution
    own, flipped = cam * solution.cam_from_tag, False
    if solution.alternative is not None and solution.alternative_covariance is not None:
        other = cam * solution.alternative
        flipped = pose_error(other, map_from_tag)[1] < pose_error(own, map_from_tag)[1]
        if not used:
            # A photo that is localized wrongly may come closer with its other solution, but not agree
            total = compose_covariance(
                sighted.sighting.covariance, solution.alternative, solution.alternative_covariance
            )
            delta = pose_log(other.inv() * map_from_tag)
            flipped &= bool(delta @ np.linalg.solve(total + covariance, delta) < FLIP_GATE)
    without_it = None if np.isnan(moved[0]) else (float(moved[0]), float(moved[1]))
    return SolvedSighting(
        sighted, used, sigmas, pose_error(own, map_from_tag), flipped, without_it, is_contradicted and not used
    )
