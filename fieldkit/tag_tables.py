"""Calibrated tags as a table and as JSON."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console

from fieldkit.console import cells, make_table
from fieldkit.frames import Array
from fieldkit.types import TAG_BOUNDS, TagMap, TagPhoto, TagPose

if TYPE_CHECKING:
    from rich.table import Table

    from fieldkit.calibrate.second import SecondLook


def print_tags(tags: TagMap) -> None:
    """Print every tag with its diagnostics, and what the verdicts mean."""
    console = Console(width=max(140, Console().width))
    console.print(_table(tags))
    bounds = TAG_BOUNDS
    known = f"{1e3 * bounds.warn_sigma_m:g} mm and {math.degrees(bounds.warn_sigma_rad):g} deg"
    console.print(
        f"pass: at least {bounds.enough_photos} photos agree, at most a third is rejected, and a standard deviation "
        f"per axis is at most {known}; fail: no two photos agree, or the size is {100 * bounds.fail_size_share:g} % "
        "off; warn: everything between",
        markup=False,
    )


def _table(tags: TagMap) -> Table:
    table = make_table(
        "tag", "visit", "photos", "rms px", "sigma mm", "sigma deg", "spread mm", "without one", "size from map",
        "verdict", "why",
    )  # fmt: skip
    for t in tags.tags:
        own = tags.photos_of(t)
        position, rotation = sigmas(t.covariance)
        spread = [p.offset[0] for p in own if p.used and p.offset is not None]
        without = t.leave_one_out
        row: list[object] = [
            t.id,
            t.visit or "-",
            f"{t.n_photos} of {max(len(own), t.n_photos)}",
            f"{t.rms_px:.2f}",
            f"{1e3 * position:.2f}",
            f"{rotation:.3f}",
            f"{1e3 * float(np.median(spread)):.1f}" if spread else "-",
            "-" if without is None else f"{1e3 * without[0]:.1f} mm {math.degrees(without[1]):.2f} deg",
            "-" if t.size_from_map is None else f"{t.size_from_map[0]:.4f} +- {t.size_from_map[1]:.4f}",
            t.verdict,
            t.reason or "-",
        ]
        table.add_row(*cells(row))
    return table


def tags_json(tags: TagMap) -> dict[str, Any]:
    """Return tags and photos as plain values; None where nothing tells."""
    return {
        "version": 1,
        "map_digest": tags.map_digest,
        "tags": [_tag_json(t) for t in tags.tags],
        "photos": [_photo_json(p) for p in tags.photos],
    }


def _tag_json(t: TagPose) -> dict[str, Any]:
    without, size = t.leave_one_out, t.size_from_map
    return {
        "id": t.id,
        "family": t.family,
        "visit": t.visit,
        "position_m": t.map_from_tag.translation,
        "quaternion_xyzw": t.map_from_tag.rotation.as_quat(),
        "covariance": t.covariance.ravel(),
        "n_photos": t.n_photos,
        "rms_px": t.rms_px,
        "verdict": t.verdict,
        "reason": t.reason,
        "size_m": t.size_m,
        "leave_one_out_m": None if without is None else without[0],
        "leave_one_out_deg": None if without is None else math.degrees(without[1]),
        "size_from_map_m": None if size is None else size[0],
        "size_sigma_m": None if size is None else size[1],
    }


def _photo_json(p: TagPhoto) -> dict[str, Any]:
    return {
        "file": p.file,
        "tag_id": p.tag_id,
        "visit": p.visit,
        "used": p.used,
        "reason": p.reason,
        "ambiguity": p.ambiguity,
        "sigma": p.sigma,
        "flipped": p.flipped,
        "rms_px": p.rms_px,
        "position_m": p.position_m,
        "offset_m": None if p.offset is None else p.offset[0],
        "offset_deg": None if p.offset is None else math.degrees(p.offset[1]),
        "without_m": None if p.without is None else p.without[0],
        "without_deg": None if p.without is None else math.degrees(p.without[1]),
    }


def print_second(look: SecondLook) -> None:
    """Print how photos in a second map differ from those in the first."""
    title = f"photos in a map of {look.features[1]} against the map of {look.features[0]}"
    table = make_table("photo", "difference mm", "difference deg", "sigmas", "verdict", title=title)
    for p in look.photos:
        numbers = [f"{1e3 * p.position_m:.1f}", f"{math.degrees(p.rotation_rad):.3f}", f"{p.sigmas:.1f}"]
        table.add_row(*cells([p.file, *numbers, "agrees" if p.agrees else "contradicts"]))
    for file, where in look.lost:
        table.add_row(*cells([file, "-", "-", "-", f"not localized in {where}"]))
    console = Console(width=max(120, Console().width))
    console.print(table)
    console.print(
        f"between the maps: {1e3 * look.offset[0]:.1f} mm, {math.degrees(look.offset[1]):.3f} deg, scale "
        f"{100 * look.scale[0]:+.2f} % (sigma {100 * look.scale[1]:.2f} %); what remains is {look.spread:.1f} times "
        f"the stated sigma: {look.verdict}",
        markup=False,
    )


def second_json(look: SecondLook) -> dict[str, Any]:
    """Return a second look at photos as plain values."""
    photos = [
        {
            "file": p.file,
            "position_m": p.position_m,
            "rotation_deg": math.degrees(p.rotation_rad),
            "sigmas": p.sigmas,
            "agrees": p.agrees,
        }
        for p in look.photos
    ]
    return {
        "features": list(look.features),
        "verdict": look.verdict,
        "spread": look.spread,
        "offset_m": look.offset[0],
        "offset_deg": math.degrees(look.offset[1]),
        "scale_percent": 100 * look.scale[0],
        "scale_sigma_percent": 100 * look.scale[1],
        "photos": photos,
        "lost": [{"file": file, "map": where} for file, where in look.lost],
    }


def sigmas(covariance: Array) -> tuple[float, float]:
    """Return the standard deviations of position (m) and rotation (deg) of a 6x6 covariance."""
    return float(np.sqrt(np.trace(covariance[3:, 3:]))), float(np.degrees(np.sqrt(np.trace(covariance[:3, :3]))))
