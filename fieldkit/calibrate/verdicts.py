"""What a reader is told: every photo's verdict with its reason, every tag's, and what is worth a warning."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from fieldkit.calibrate.locating import LocatedPhoto
from fieldkit.calibrate.solving import Solved, SolvedSighting, SolvedTag
from fieldkit.types import TagPhoto, TagPose

log = logging.getLogger(__name__)

# A tag known worse than this, 1 sigma per axis, deserves a warning
WARN_SIGMA_M, WARN_SIGMA_RAD = 0.01, math.radians(0.5)
# A size that is wrong by more than this share makes the tag useless; below, the map's scale may be what is wrong
FAIL_SIZE_SHARE = 0.03
# A size that photos show no better than this is not shown
SHOWN_SIZE_SHARE = 0.1
# Fewer photos cannot outvote a wrong one
ENOUGH_PHOTOS = 3


def tag_pose(tag: SolvedTag) -> TagPose:
    """Return a solved tag as it is stored."""
    group, size = tag.group, tag.size
    return TagPose(
        group.tag_id,
        group.family,
        group.size_m,
        tag.map_from_tag,
        tag.covariance,
        tag.n_used,
        tag.rms_px,
        visit=group.visit,
        verdict=judge(tag),
        leave_one_out=leave_one_out(tag.sightings),
        size_from_map=(size.measured_m, size.measured_m * size.sigma) if size.sigma < SHOWN_SIZE_SHARE else None,
    )


def judge(tag: SolvedTag) -> Literal["pass", "warn", "fail"]:
    """Judge a tag.

    Fail: no two photos agree, its size contradicts the map by more than 3 %, or every photo of it is rejected at its
    other tags. Warn: a reader should look at the
    photos, since few are used, many rejected, the tilt is open, or the pose is uncertain or depends on one photo.
    """
    used, count = tag.n_used, len(tag.sightings)
    off = abs(math.log(tag.size.measured_m / tag.group.size_m))
    doubted = all(s.is_contradicted for s in tag.sightings if s.used)
    if (used == 1 and count > 1) or (tag.size.is_wrong and off > FAIL_SIZE_SHARE) or doubted:
        return "fail"
    sigma = np.sqrt(np.diag(tag.covariance))
    doubtful = used < ENOUGH_PHOTOS or 3 * (count - used) > count or not tag.group.fix.is_certain or tag.size.is_wrong
    if doubtful or float(sigma[3:].max()) > WARN_SIGMA_M or float(sigma[:3].max()) > WARN_SIGMA_RAD:
        return "warn"
    return "pass"


def leave_one_out(sightings: Sequence[SolvedSighting]) -> tuple[float, float] | None:
    """Return by how much (m, rad) a tag moves at most when one photo is left out; None where one photo holds it."""
    moved = [s.without for s in sightings if s.without is not None]
    return (max(m for m, _ in moved), max(r for _, r in moved)) if moved else None


def photo_verdicts(solved: Solved, photos: Sequence[LocatedPhoto]) -> list[TagPhoto]:
    """Return the verdict on every sighting of every tag."""
    verdicts = []
    for tag in solved.tags:
        for s in tag.sightings:
            verdicts.append(
                TagPhoto(
                    photos[s.sighted.photo].file,
                    tag.group.tag_id,
                    used=s.used,
                    reason="" if s.used else explain(s),
                    visit=tag.group.visit,
                    ambiguity=s.sighted.solution.ambiguity,
                    sigma=s.sigmas,
                    flipped=s.flipped,
                )
            )
    for h in solved.homeless:
        reason = f"the tag has another place in {h.moved}; expected the visit of this photo in photos.toml"
        file = photos[h.sighted.photo].file
        verdicts.append(TagPhoto(file, h.sighted.sighting.detection.id, used=False, reason=reason))
    return verdicts


def explain(sighting: SolvedSighting) -> str:
    """Say why a sighting is rejected."""
    position, angle = sighting.offset
    where = f"{sighting.sigmas:.1f} sigma ({100 * position:.1f} cm, {math.degrees(angle):.1f} deg)"
    if sighting.flipped:
        return f"flipped: its corners show the tag tilted to the other side by {where}"
    if sighting.is_contradicted:
        return f"disagrees with the others by {where}, and so do its other tags: the photo is localized wrongly"
    return f"disagrees with the others by {where}"


def warn(tags: Sequence[SolvedTag], photos: Sequence[TagPhoto]) -> None:
    """Log what a reader should look at."""
    for tag in tags:
        group, size, verdict = tag.group, tag.size, judge(tag)
        where = "" if group.visit is None else f" of visit {group.visit}"
        if size.is_wrong:
            log.warning(
                "tag %d%s: the map's scale shows an edge of %.4g m (1 sigma %.2g m), but %.4g m is given; measure the "
                "black square, or check the map's scale",
                group.tag_id, where, size.measured_m, size.measured_m * size.sigma, group.size_m,
            )  # fmt: skip
        if verdict != "pass":
            log.warning("tag %d%s: %s (%d photos used)", group.tag_id, where, verdict, tag.n_used)
        if len(tag.sightings) == 1:
            log.warning("tag %d%s: one photo only: nothing tells whether it is right", group.tag_id, where)
    known = {t.group.tag_id for t in tags}
    for tag_id in sorted({p.tag_id for p in photos if p.tag_id >= 0} - known):
        reasons = sorted({p.reason for p in photos if p.tag_id == tag_id})
        log.warning("tag %d: no pose: %s", tag_id, "; ".join(reasons))
