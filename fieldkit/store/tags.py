"""tags.toml: the calibrated tags of a map."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from fieldkit.errors import FieldkitError, StoreError
from fieldkit.frames import pose, position_quaternion
from fieldkit.store.files import digest, read_toml, write_toml
from fieldkit.types import TagMap, TagPhoto, TagPose


class _Tag(msgspec.Struct, forbid_unknown_fields=True):
    id: int
    family: str
    size_m: Annotated[float, msgspec.Meta(gt=0)]
    position_m: list[float]
    quaternion_xyzw: list[float]
    covariance: list[float]
    n_photos: int
    rms_px: float
    verdict: Literal["pass", "warn", "fail"]
    visit: str | None = None
    leave_one_out_m: float | None = None
    leave_one_out_deg: float | None = None
    size_from_map_m: float | None = None
    size_sigma_m: float | None = None


class _Photo(msgspec.Struct, forbid_unknown_fields=True):
    file: str
    tag_id: int
    used: bool
    reason: str
    ambiguity: float
    sigma: float
    visit: str | None = None
    flipped: bool = False


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
    photos = tuple(
        TagPhoto(p.file, p.tag_id, p.used, p.reason, p.visit, p.ambiguity, p.sigma, p.flipped) for p in data.photo
    )
    return TagMap(tuple(tags), photos, data.map_digest, digest=digest(path), path=str(path))


def _tag(entry: _Tag) -> TagPose:
    if len(entry.covariance) != 36:
        raise StoreError(f"covariance has {len(entry.covariance)} numbers; expected 36, row-major")
    covariance = np.asarray(entry.covariance).reshape(6, 6)
    if not np.isfinite(covariance).all() or np.linalg.eigvalsh((covariance + covariance.T) / 2).min() < -1e-12:
        raise StoreError("covariance is not positive semi-definite")
    spread, size = (entry.leave_one_out_m, entry.leave_one_out_deg), (entry.size_from_map_m, entry.size_sigma_m)
    map_from_tag = pose(entry.position_m, entry.quaternion_xyzw)
    return TagPose(
        entry.id, entry.family, entry.size_m, map_from_tag, covariance, entry.n_photos, entry.rms_px,
        visit=entry.visit, verdict=entry.verdict,
        leave_one_out=None if spread[0] is None or spread[1] is None else (spread[0], math.radians(spread[1])),
        size_from_map=None if size[0] is None or size[1] is None else (size[0], size[1]),
    )  # fmt: skip


def write_tags(path: Path, tags: TagMap) -> None:
    """Write tags.toml."""
    entries = []
    for t in tags.tags:
        xyz, quaternion = position_quaternion(t.map_from_tag)
        covariance = [float(v) for v in np.asarray(t.covariance).ravel()]
        entries.append(
            _Tag(
                t.id,
                t.family,
                t.size_m,
                xyz,
                quaternion,
                covariance,
                t.n_photos,
                t.rms_px,
                t.verdict,
                t.visit,
                *((None, None) if t.leave_one_out is None else (t.leave_one_out[0], math.degrees(t.leave_one_out[1]))),
                *(t.size_from_map or (None, None)),
            )
        )
    photos = [_Photo(p.file, p.tag_id, p.used, p.reason, p.ambiguity, p.sigma, p.visit, p.flipped) for p in tags.photos]
    write_toml(path, _TagsFile(1, tags.map_digest, entries, photos))
