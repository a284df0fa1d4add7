"""What a reader is told: every photo's verdict with its reason, every tag's, and what is worth a warning."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from fieldkit.calibrate.locating import LocatedPhoto
from fieldkit.calibrate.solving import Solved, SolvedSighting, SolvedTag
from fieldkit.types import TAG_BOUNDS, TagPhoto, TagPose

log = logging.getLogger(__name__)

# A size that photos show no better than this is not shown
SHOWN_SIZE_SHARE = 0.1


def tag_pose(tag: SolvedTag, *, refused: int = 0) -> TagPose:
    """Return a solved tag as it is stored; ``refused`` photos of it did not come as far as being solved for."""
    group, size = tag.group, tag.size
    verdict, reason = explained(tag, refused=refused)
    return TagPose(
        group.tag_id,
        group.family,
        group.size_m,
        tag.map_from_tag,
        tag.covariance,
        tag.n_used,
        tag.rms_px,
        visit=group.visit,
        verdict=verdict,
        leave_one_out=leave_one_out(tag.sightings),
        size_from_map=(size.measured_m, size.measured_m * size.sigma) if size.sigma < SHOWN_SIZE_SHARE else None,
        reason=reason,
    )


Verdict = Literal["pass", "warn", "fail"]


def judge(tag: SolvedTag) -> Verdict:
    """Judge a tag; see `TagBounds`."""
    return explained(tag)[0]


def explained(tag: SolvedTag, *, refused: int = 0) -> tuple[Verdict, str]:
    """Judge a tag, and say what a verdict other than pass rests on; see `tag_pose`."""
    bounds, used, count = TAG_BOUNDS, tag.n_used, len(tag.sightings)
    off = abs(math.log(tag.size.measured_m / tag.group.size_m))
    fails: list[str] = []
    warns: list[str] = []
    if used == 1 and count > 1:
        fails.append(f"no two of its {count} photos agree")
    if all(s.is_contradicted for s in tag.sightings if s.used):
        fails.append("its photos are rejected at every other tag that they show")
    if tag.size.is_wrong:
        words = f"the map's scale shows an edge of {tag.size.measured_m:.4g} m, {100 * off:.2g} % off"
        (fails if off > bounds.fail_size_share else warns).append(words)
    if count == 1:
        warns.append("one photo only: nothing tells whether it is right")
    elif 1 < used < bounds.enough_photos:
        warns.append(f"{used} photos only: they cannot outvote a wrong one")
    if count + refused - used > bounds.rejected_share * (count + refused):
        warns.append(f"{count + refused - used} of {count + refused} photos are rejected")
    if not tag.group.fix.is_certain:
        warns.append("its tilt is open: the photos do not decide between two")
    sigma = np.sqrt(np.diag(tag.covariance))
    if float(sigma[3:].max()) > bounds.warn_sigma_m:
        warns.append(f"its position is known to {1e3 * float(sigma[3:].max()):.0f} mm only")
    if float(sigma[:3].max()) > bounds.warn_sigma_rad:
        warns.append(f"its rotation is known to {math.degrees(float(sigma[:3].max())):.1f} deg only")
    return "fail" if fails else "warn" if warns else "pass", "; ".join(fails + warns)


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
                    visit=s.sighted.visit,
                    ambiguity=s.sighted.solution.ambiguity,
                    sigma=s.sigmas,
                    flipped=s.flipped,
                    rms_px=None if np.isnan(s.residual_px).any() else float(np.sqrt(np.mean(s.residual_px**2))),
                    position_m=_position(s),
                    offset=s.offset,
                    without=s.without,
                )
            )
    for h in solved.homeless:
        reason = f"the tag has another place in {h.moved}; expected the visit of this photo in photos.toml"
        file = photos[h.sighted.photo].file
        verdicts.append(TagPhoto(file, h.sighted.sighting.detection.id, used=False, reason=reason))
    return verdicts


def _position(sighting: SolvedSighting) -> tuple[float, float, float]:
    """Return where a photo by itself has the tag in the map."""
    sighted = sighting.sighted
    x, y, z = (sighted.sighting.ref_from_cam * sighted.solution.cam_from_tag).translation
    return float(x), float(y), float(z)


def explain(sighting: SolvedSighting) -> str:
    """Say why a sighting is rejected."""
    position, angle = sighting.offset
    where = f"{sighting.sigmas:.1f} sigma ({100 * position:.1f} cm, {math.degrees(angle):.1f} deg)"
    if sighting.flipped:
        return f"flipped: its corners show the tag tilted to the other side by {where}"
    if sighting.is_contradicted:
        return f"disagrees with the others by {where}, and so do its other tags: the photo is localized wrongly"
    return f"disagrees with the others by {where}"


def warn(tags: Sequence[SolvedTag], photos: Sequence[TagPhoto], refused: Sequence[int]) -> None:
    """Log what a reader should look at; ``refused`` photos of each tag did not come as far as being solved for."""
    for tag, n_refused in zip(tags, refused, strict=True):
        group, size, (verdict, reason) = tag.group, tag.size, explained(tag, refused=n_refused)
        where = "" if group.visit is None else f" of visit {group.visit}"
        if size.is_wrong:
            log.warning(
                "tag %d%s: the map's scale shows an edge of %.4g m (1 sigma %.2g m), but %.4g m is given; measure the "
                "black square, or check the map's scale",
                group.tag_id, where, size.measured_m, size.measured_m * size.sigma, group.size_m,
            )  # fmt: skip
        if verdict != "pass":
            log.warning("tag %d%s: %s: %s", group.tag_id, where, verdict, reason)
    known = {t.group.tag_id for t in tags}
    for tag_id in sorted({p.tag_id for p in photos if p.tag_id >= 0} - known):
        reasons = sorted({p.reason for p in photos if p.tag_id == tag_id})
        log.warning("tag %d: no pose: %s", tag_id, "; ".join(reasons))
