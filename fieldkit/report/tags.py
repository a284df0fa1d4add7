"""What the page shows of the tags: verdicts with their bounds, residuals, spread, and ellipses."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from markupsafe import Markup

from fieldkit.report.tag_figures import tag_svg
from fieldkit.types import TAG_BOUNDS, TagMap, TagPhoto, TagPose


@dataclasses.dataclass(frozen=True)
class PhotoRow:
    """One photo of a tag."""

    file: str
    used: bool
    offset: str
    without: str
    rms_px: str
    sigma: str
    ambiguity: str
    reason: str


@dataclasses.dataclass(frozen=True)
class TagRow:
    """One tag: numbers as text, its picture, and its photos."""

    name: str
    grade: str
    verdict: str
    reason: str
    photos: str
    rms_px: str
    position: str
    rotation: str
    spread: str
    without: str
    size: str
    figure: Markup
    rows: tuple[PhotoRow, ...]


@dataclasses.dataclass(frozen=True)
class TagSection:
    """Everything the page says about a run's tags."""

    bounds: tuple[tuple[str, str], ...]
    tags: tuple[TagRow, ...]
    others: tuple[PhotoRow, ...]


def tag_section(tags: TagMap, *, name: str) -> TagSection:
    """Return what the page shows of the tags of a run; ``name`` is put before the ids of its figures."""
    own = [tags.photos_of(tag) for tag in tags.tags]
    listed = {id(p) for photos in own for p in photos}
    rows = tuple(_tag(t, photos, f"{name}{i}") for i, (t, photos) in enumerate(zip(tags.tags, own, strict=True)))
    return TagSection(_bounds(), rows, tuple(_photo(p) for p in tags.photos if id(p) not in listed))


def _bounds() -> tuple[tuple[str, str], ...]:
    b = TAG_BOUNDS
    degrees = math.degrees(b.warn_sigma_rad)
    return (
        (
            "pass",
            f"at least {b.enough_photos} photos agree, at most {100 * b.rejected_share:.0f} % are rejected, the "
            f"largest standard deviation along an axis is at most {1e3 * b.warn_sigma_m:g} mm and {degrees:g}°, the "
            "tilt is certain, and the size agrees with the map",
        ),
        ("warn", "one of these does not hold: look at the photos, take more, or measure the tag"),
        (
            "fail",
            "of several photos no two agree; or the map contradicts the size by "
            f"{b.size_sigmas:g} sigma and {100 * b.fail_size_share:g} %; or every photo is rejected at its other tags",
        ),
    )


def _tag(tag: TagPose, photos: list[TagPhoto], name: str) -> TagRow:
    sigma = np.sqrt(np.maximum(np.diag(tag.covariance), 0.0))
    spread = [p.offset for p in photos if p.used and p.offset is not None]
    middle = np.median(spread, axis=0) if spread else None
    return TagRow(
        name=str(tag.id) if tag.visit is None else f"{tag.id} · {tag.visit}",
        grade={"pass": "good", "warn": "poor", "fail": "failed"}[tag.verdict],
        verdict=tag.verdict,
        reason=tag.reason,
        photos=f"{tag.n_photos} of {max(len(photos), tag.n_photos)}",
        rms_px=f"{tag.rms_px:.2f}",
        position=" / ".join(f"{1e3 * v:.1f}" for v in sigma[3:]),
        rotation=" / ".join(f"{math.degrees(v):.2f}" for v in sigma[:3]),
        spread="-" if middle is None else _both((float(middle[0]), float(middle[1]))),
        without=_both(tag.leave_one_out),
        size="-" if tag.size_from_map is None else _size(tag),
        figure=Markup(tag_svg(tag, photos, name=name)),
        rows=tuple(_photo(p) for p in photos),
    )


def _size(tag: TagPose) -> str:
    assert tag.size_from_map is not None
    edge, sigma = tag.size_from_map
    return f"{1e3 * edge:.1f} ± {1e3 * sigma:.1f} mm ({1e3 * tag.size_m:.1f} given)"


def _photo(p: TagPhoto) -> PhotoRow:
    return PhotoRow(
        p.file, p.used, _both(p.offset), _both(p.without), "-" if p.rms_px is None else f"{p.rms_px:.2f}",
        f"{p.sigma:.1f}" if p.offset is not None else "-", f"{p.ambiguity:.2f}" if p.offset is not None else "-",
        p.reason or ("prefers the other tilt by itself" if p.flipped else ""),
    )  # fmt: skip


def _both(value: tuple[float, float] | None) -> str:
    return "-" if value is None else f"{1e3 * value[0]:.1f} mm, {math.degrees(value[1]):.2f}°"
