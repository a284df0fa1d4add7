"""tags.toml: the calibrated tags of a map."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from fieldkit.errors import FieldkitError, StoreError
from fieldkit.frames import Array, pose, position_quaternion
from fieldkit.store.files import digest, read_toml, write_toml
from fieldkit.types import TagMap, TagPhoto, TagPose

MAX_SIZE_M = 100.0


class _Tag(msgspec.Struct, forbid_unknown_fields=True):
    id: int
    family: str
    size_m: Annotated[float, msgspec.Meta(gt=0, le=MAX_SIZE_M)]
    position_m: list[float]
    quaternion_xyzw: list[float]
    covariance: list[float]
    n_photos: int
    rms_px: float
    verdict: Literal["pass", "warn", "fail"]
    visit: Annotated[str, msgspec.Meta(min_length=1)] | None = None
    leave_one_out_m: float | None = None
    leave_one_out_deg: float | None = None
    size_from_map_m: float | None = None
    size_sigma_m: float | None = None
    reason: str | None = None


class _Photo(msgspec.Struct, forbid_unknown_fields=True):
    file: str
    tag_id: int
    used: bool
    reason: str
    ambiguity: float
    sigma: float
    visit: str | None = None
    flipped: bool = False
    rms_px: float | None = None
    position_m: tuple[float, float, float] | None = None
    offset_m: float | None = None
    offset_deg: float | None = None
    without_m: float | None = None
    without_deg: float | None = None


class _TagsFile(msgspec.Struct, forbid_unknown_fields=True):
    version: Literal[1]
    map_digest: str
    tag: list[_Tag]
    photo: list[_Photo] = []


def read_tags(path: Path) -> TagMap:
    """Read tags.toml into a TagMap; raises StoreError with the place of what is wrong."""
    path = Path(path)
    data = read_toml(path, _TagsFile, what="tags.toml with map_digest and [[tag]]")
    tags = []
    for index, entry in enumerate(data.tag):
        try:
            tags.append(_tag(entry))
        except FieldkitError as error:
            raise StoreError(
                f"{path}: tag[{index}] (id {entry.id}): {error.message}", hint="correct the file"
            ) from error
    keys = [(t.id, t.visit) for t in tags]
    if len(set(keys)) != len(keys):
        raise StoreError(f"{path}: a tag is listed twice for the same visit", hint="keep one [[tag]] per id and visit")
    return TagMap(
        tuple(tags), tuple(_photo(p) for p in data.photo), data.map_digest, digest=digest(path), path=str(path)
    )


def _tag(entry: _Tag) -> TagPose:
    if len(entry.covariance) != 36:
        raise StoreError(f"covariance has {len(entry.covariance)} numbers; expected 36, row-major")
    covariance = np.asarray(entry.covariance).reshape(6, 6)
    _check_covariance(covariance)
    size = entry.size_from_map_m, entry.size_sigma_m
    map_from_tag = pose(entry.position_m, entry.quaternion_xyzw)
    return TagPose(
        entry.id, entry.family, entry.size_m, map_from_tag, covariance, entry.n_photos, entry.rms_px,
        visit=entry.visit, verdict=entry.verdict,
        leave_one_out=_in_rad(entry.leave_one_out_m, entry.leave_one_out_deg),
        size_from_map=None if size[0] is None or size[1] is None else (size[0], size[1]),
        reason=entry.reason or "",
    )  # fmt: skip


def _check_covariance(covariance: Array) -> None:
    """Raise StoreError unless a 6x6 covariance is finite, symmetric and has no negative direction.

    All zeros are a tag that is known exactly.
    """
    largest = float(np.abs(covariance).max()) if np.isfinite(covariance).all() else math.inf
    if not math.isfinite(largest):
        raise StoreError("covariance is not finite")
    if float(np.abs(covariance - covariance.T).max()) > 1e-6 * largest:
        raise StoreError("covariance is not symmetric; expected 36 numbers, row-major, rotation before translation")
    # Rotation (rad) and translation (m) differ by orders: each is measured by itself
    scale = np.sqrt(np.abs(np.diag(covariance)))
    unit = np.where(scale > 0, scale, 1.0)
    lowest = float(np.linalg.eigvalsh((covariance + covariance.T) / 2 / np.outer(unit, unit)).min())
    if lowest < -1e-6 or (np.diag(covariance) < 0).any():
        raise StoreError(
            f"covariance is not positive definite (it has a variance of {lowest:.2g} along a direction, diagonal 1)"
        )


def _in_rad(metres: float | None, degrees: float | None) -> tuple[float, float] | None:
    return None if metres is None or degrees is None else (metres, math.radians(degrees))


def _in_degrees(both: tuple[float, float] | None) -> tuple[float | None, float | None]:
    return (None, None) if both is None else (both[0], math.degrees(both[1]))


def _photo(p: _Photo) -> TagPhoto:
    return TagPhoto(
        p.file, p.tag_id, p.used, p.reason, p.visit, p.ambiguity, p.sigma, p.flipped, p.rms_px, p.position_m,
        _in_rad(p.offset_m, p.offset_deg), _in_rad(p.without_m, p.without_deg),
    )  # fmt: skip


def write_tags(path: Path, tags: TagMap) -> None:
    """Write tags.toml."""
    entries = []
    for t in tags.tags:
        xyz, quaternion = position_quaternion(t.map_from_tag)
        covariance = [float(v) for v in np.asarray(t.covariance).ravel()]
        spread, size = _in_degrees(t.leave_one_out), t.size_from_map or (None, None)
        entries.append(
            _Tag(
                t.id, t.family, t.size_m, xyz, quaternion, covariance, t.n_photos, t.rms_px, t.verdict, t.visit,
                leave_one_out_m=spread[0], leave_one_out_deg=spread[1],
                size_from_map_m=size[0], size_sigma_m=size[1], reason=t.reason or None,
            )
        )  # fmt: skip
    photos = [
        _Photo(
            p.file, p.tag_id, p.used, p.reason, p.ambiguity, p.sigma, p.visit, p.flipped, p.rms_px, p.position_m,
            *_in_degrees(p.offset), *_in_degrees(p.without),
        )
        for p in tags.photos
    ]  # fmt: skip
    write_toml(path, _TagsFile(1, tags.map_digest, entries, photos))
