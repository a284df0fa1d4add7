"""Where the joint problem starts: which sightings are of one tag in one place, and a consensus on its pose.

Each photo's own pose of the tag, with both planar solutions, votes for a pose; see `fieldkit.tags.fuse_sightings`.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np

from fieldkit.calibrate.locating import LocatedPhoto
from fieldkit.calibrate.photos import size_of
from fieldkit.frames import Array, Pose, compose_covariance
from fieldkit.frames import log as pose_log
from fieldkit.tags import Sighting, TagFix, TagSolution, fuse_sightings, solve

# A photo's covariance says how well its matches fit, not how far their landmarks are off together: it may be scaled up
PHOTO_SCALES = (1.0, 1.5, 2.0, 3.0, 5.0, 8.0)
# Poses of one tag that differ by less than this, 1 sigma per axis, are not told apart; beyond this chi-square (6
# degrees of freedom, one in a thousand) they are two places
PLACE_SIGMA_M, PLACE_SIGMA_RAD = 0.003, math.radians(0.2)
PLACE_GATE = 22.5
# Noise of fewer photos than show their own scale; and so many photos make one that contradicts them an outlier
FEW_PHOTOS, FEW_SCALE, OUTVOTING_PHOTOS = 4, 2.0, 3
# Two photos show a tag's size where their rays to it, at equal length, differ by this share; so many sigmas apart the
# places at which two photos see the tag are two; and so many photos must agree on another size before it is tried
RAY_SHARE, SAME_SIGMA, SIZE_VOTES = 0.2, 4.0, 3


@dataclasses.dataclass(frozen=True)
class Sighted:
    """A tag in a localized photo: the photo's index, its visit, the sighting, and both planar solutions."""

    photo: int
    visit: str | None
    sighting: Sighting
    solution: TagSolution


@dataclasses.dataclass(frozen=True)
class Group:
    """The sightings that share one pose of a tag, and their consensus; ``visit`` None: one pose for every visit.

    ``size_m`` is what is given. ``start_size_m`` is another where the photos agree at no pose with the given one.
    """

    tag_id: int
    family: str
    visit: str | None
    size_m: float
    start_size_m: float
    members: tuple[Sighted, ...]
    fix: TagFix


@dataclasses.dataclass(frozen=True)
class Homeless:
    """A sighting of a tag that moved, in a photo that names no visit; and between what it moved."""

    sighted: Sighted
    moved: str


def sight(
    photos: Sequence[LocatedPhoto],
    poses: Sequence[Pose],
    covariances: Sequence[Array],
    sizes_m: Mapping[int | None, float],
) -> list[Sighted]:
    """Return every tag in every photo, seen from where the landmarks put the photo."""
    return [
        Sighted(i, p.visit, Sighting(d, p.camera, poses[i], covariances[i]), solve(d, p.camera, size_of(d.id, sizes_m)))
        for i, p in enumerate(photos)
        for d in p.detections
    ]


def group(sighted: Sequence[Sighted], sizes_m: Mapping[int | None, float]) -> tuple[list[Group], list[Homeless]]:
    """Return the sightings that share one pose, by tag id, family and visit, and those of moved tags without visit.

    A tag whose photos all name a visit has one pose per visit. One that is also in photos without a visit is fixed
    where the poses from these photos and from every visit's agree: one pose for every visit, from all its photos.
    """
    by_tag: dict[tuple[int, str], list[Sighted]] = {}
    for s in sighted:
        by_tag.setdefault((s.sighting.detection.id, s.sighting.detection.family), []).append(s)
    groups: list[Group] = []
    homeless: list[Homeless] = []
    for (tag_id, family), every in by_tag.items():
        by_visit: dict[str | None, list[Sighted]] = {}
        for s in every:
            by_visit.setdefault(s.visit, []).append(s)
        size_m = size_of(tag_id, sizes_m)
        found = {visit: _consensus(tag_id, family, visit, size_m, members) for visit, members in by_visit.items()}
        if None in found and len(found) > 1:
            moved = _contradiction({visit: g.fix for visit, g in found.items()})
            if moved is None:
                found = {None: _consensus(tag_id, family, None, size_m, every)}
            else:
                homeless += [Homeless(s, moved) for s in found.pop(None).members]
        groups += found.values()
    return sorted(groups, key=lambda g: (g.tag_id, g.family, str(g.visit))), homeless


def _consensus(tag_id: int, family: str, visit: str | None, size_m: float, members: Sequence[Sighted]) -> Group:
    """Fuse sightings at the given size, and at the size that most photos agree on where they contradict each other."""
    sightings = [s.sighting for s in members]
    solutions, start_size_m = [s.solution for s in members], size_m
    fix = fuse_sightings(sightings, size_m, scales=PHOTO_SCALES, solutions=solutions)
    if len(members) >= SIZE_VOTES and (not all(fix.used) or fix.scale > 1.0):
        ratio = likely_size_ratio(members)
        other = fuse_sightings(sightings, size_m * ratio, scales=PHOTO_SCALES) if ratio != 1.0 else fix
        more, less_noise = sum(other.used) - sum(fix.used), 2 * other.scale <= fix.scale
        if sum(other.used) >= SIZE_VOTES and (more > 0 or (more == 0 and less_noise)):
            fix, start_size_m = other, size_m * ratio
    return Group(tag_id, family, visit, size_m, start_size_m, tuple(members), fix)


def likely_size_ratio(members: Sequence[Sighted]) -> float:
    """Return by what the tag's size must be multiplied for most photos to see it in one place; 1 if none is better.

    A tag of another size is seen as much nearer or farther along each photo's ray. Any two photos whose rays differ
    say by how much; the ratio that most photos agree with wins.
    """
    cameras = np.stack([np.asarray(s.sighting.ref_from_cam.translation) for s in members])
    rays = np.stack([s.sighting.ref_from_cam.rotation.apply(s.solution.cam_from_tag.translation) for s in members])
    spread = np.array([_position_sigma(s) for s in members])

    def votes(ratio: float, about: Array) -> int:
        distance = np.linalg.norm(cameras + ratio * rays - about, axis=1)
        return int((distance < SAME_SIGMA * spread * max(ratio, 1.0)).sum())

    best, most = 1.0, max(votes(1.0, centre) for centre in cameras + rays)
    for a, b in itertools.combinations(range(len(members)), 2):
        between, apart = cameras[a] - cameras[b], rays[a] - rays[b]
        if np.linalg.norm(apart) < RAY_SHARE * np.linalg.norm(rays[a]):
            continue
        ratio = float(-(between @ apart) / (apart @ apart))
        if 0.2 < ratio < 5.0:
            count = votes(ratio, (cameras[[a, b]] + ratio * rays[[a, b]]).mean(axis=0))
            if count > most:
                best, most = ratio, count
    return best


def _position_sigma(s: Sighted) -> float:
    total = compose_covariance(s.sighting.covariance, s.solution.cam_from_tag, s.solution.covariance)
    return math.sqrt(float(np.trace(total[3:, 3:])))


def _contradiction(fixes: Mapping[str | None, TagFix]) -> str | None:
    """Name two groups of photos between which a tag moved, or None where all agree on one place.

    A visit's only photo does not contradict photos without a visit that outvote it: it is an outlier among them.
    """
    outvoting = sum(fixes[None].used) >= OUTVOTING_PHOTOS
    counted = {v: f for v, f in fixes.items() if v is None or not (outvoting and len(f.used) == 1)}
    for (one, a), (two, b) in itertools.combinations(counted.items(), 2):
        if _places_differ(a, b):
            named = [f"visit {v}" if v is not None else "photos without a visit" for v in (one, two)]
            return " than in ".join(named)
    return None


def _places_differ(one: TagFix, two: TagFix) -> bool:
    floor = np.diag([PLACE_SIGMA_RAD**2] * 3 + [PLACE_SIGMA_M**2] * 3)
    for (a, a_covariance), (b, b_covariance) in itertools.product(_places(one), _places(two)):
        delta = pose_log(a.inv() * b)
        if float(delta @ np.linalg.solve(a_covariance + b_covariance + floor, delta)) <= PLACE_GATE:
            return False
    return True


def _places(fix: TagFix) -> list[tuple[Pose, Array]]:
    """Return the pose with its covariance, and the other planar solution where the photos leave it open."""
    factor = FEW_SCALE**2 if sum(fix.used) < FEW_PHOTOS else 1.0
    places = [(fix.ref_from_tag, fix.covariance * factor)]
    if not fix.is_certain and fix.alternative is not None and fix.alternative_covariance is not None:
        places.append((fix.alternative, fix.alternative_covariance * factor))
    return places
