"""What every foreign tag file has in common: options of an import, its result, and strict reading of YAML."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import msgspec
import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from fieldkit.errors import StoreError, TagError
from fieldkit.frames import Array, Pose
from fieldkit.store.files import convert, read_text
from fieldkit.tags.families import FAMILIES, family_size
from fieldkit.types import Excluded, TagMap, TagPose

T = TypeVar("T", bound=msgspec.Struct)

# Taken where a file says nothing of its poses' uncertainty: a careful survey with a tape measure
DEFAULT_SIGMA_M = 0.01
DEFAULT_SIGMA_DEG = 1.0
# Beyond this a place is a typing error
FAR_M = 1e6


@dataclasses.dataclass(frozen=True)
class ImportOptions:
    """What a foreign tag file may leave open.

    ``frame`` names the bundle (apriltag_ros), body (tagslam) or frame (spot) whose tags are taken. ``sizes_m`` are
    edge lengths of the black square by tag id, None for every other tag. Standard deviations per axis, in m and deg,
    replace those of the file; None takes the file's, or 0.01 m and 1 deg where it has none.
    """

    family: str = "tag36h11"
    frame: str | None = None
    sizes_m: Mapping[int | None, float] = dataclasses.field(default_factory=dict)
    sigma_m: float | None = None
    sigma_deg: float | None = None
    map_digest: str = ""

    def __post_init__(self) -> None:
        values = {"sigma_m": self.sigma_m, "sigma_deg": self.sigma_deg}
        values |= {f"size of tag {k}" if k is not None else "size_m": v for k, v in self.sizes_m.items()}
        for name, value in values.items():
            if value is not None and not (math.isfinite(value) and value > 0):
                raise TagError(f"{name} is {value}; expected a positive number", hint="correct the option")

    def covariance(self) -> Array:
        """Return the 6x6 covariance (right perturbation) of the given or assumed standard deviations."""
        rotation = math.radians(DEFAULT_SIGMA_DEG if self.sigma_deg is None else self.sigma_deg)
        position = DEFAULT_SIGMA_M if self.sigma_m is None else self.sigma_m
        return np.diag([rotation**2] * 3 + [position**2] * 3)

    def size_m(self, tag_id: int, in_file: float | None) -> float | None:
        """Return the size of a tag: the one given for it, else the file's, else the one given for all."""
        return self.sizes_m.get(tag_id, in_file if in_file is not None else self.sizes_m.get(None))


@dataclasses.dataclass(frozen=True)
class Imported:
    """Tags of a foreign file, in its own frame; what was left out and why; and what a reader should know."""

    tags: TagMap
    left_out: tuple[Excluded, ...]
    warnings: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Exported:
    """The text of a foreign tag file, and the tags that it cannot hold."""

    text: str
    left_out: tuple[Excluded, ...]


def read_yaml(path: Path, struct: type[T], *, what: str) -> T:
    """Read a YAML file into a struct that ignores other keys; raises StoreError with the place of what is wrong."""
    text = read_text(path, what=what)
    try:
        values = YAML(typ="safe", pure=True).load(text)
    except YAMLError as error:
        mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
        place = f" in line {mark.line + 1}" if mark is not None else ""
        problem = getattr(error, "problem", None) or type(error).__name__
        raise StoreError(
            f"{path}: not valid YAML{place}: {problem}; expected {what}", hint="correct the file"
        ) from error
    except (ValueError, RecursionError) as error:
        raise StoreError(f"{path}: not valid YAML: {error}; expected {what}", hint="correct the file") from error
    return convert(values, struct, path=path, what=what)


def imported_tag(tag_id: int, map_from_tag: Pose, *, family: str, size_m: float, covariance: Array) -> TagPose:
    """Return a tag that was not calibrated here: no photos, and a verdict that says to have a look."""
    return TagPose(tag_id, family, size_m, map_from_tag, covariance, 0, 0.0, verdict="warn")


def finish(
    path: Path,
    tags: Sequence[TagPose],
    options: ImportOptions,
    *,
    left_out: Sequence[Excluded],
    warnings: Sequence[str],
) -> Imported:
    """Return the tags sorted by id; raises TagError where there is none, or one is listed twice."""
    if not tags:
        reasons = "; ".join(dict.fromkeys(e.reason for e in left_out)) or "it lists none"
        raise TagError(
            f"{path}: no tag with a pose ({reasons}); expected one or more", hint="check the file and --from"
        )
    ids = [t.id for t in tags]
    twice = next((i for i in ids if ids.count(i) > 1), None)
    if twice is not None:
        raise TagError(f"{path}: tag {twice} is listed twice; expected one pose per tag", hint="keep one of them")
    for tag in tags:
        _check(path, tag)
    ordered = tuple(sorted(tags, key=lambda t: t.id))
    return Imported(TagMap(ordered, (), options.map_digest, path=str(path)), tuple(left_out), tuple(warnings))


def _check(path: Path, tag: TagPose) -> None:
    if not 0.005 <= tag.size_m <= 5.0:
        raise TagError(
            f"{path}: tag {tag.id} has an edge of {tag.size_m:g} m; expected metres, 0.005 to 5",
            hint="correct the file",
        )
    if tag.family in FAMILIES and not 0 <= tag.id < family_size(tag.family):
        raise TagError(
            f"{path}: tag {tag.id}: {tag.family} has the ids 0 to {family_size(tag.family) - 1}",
            hint="correct the file, or give its family with --family",
        )
    if float(np.abs(tag.map_from_tag.translation).max()) > FAR_M:
        raise TagError(f"{path}: tag {tag.id} is farther than {FAR_M:g} m; expected metres", hint="correct the file")
    if float(np.linalg.eigvalsh(tag.covariance)[0]) <= 0:
        raise TagError(
            f"{path}: tag {tag.id} has no noise along some axis; expected standard deviations above zero",
            hint="correct the file, or give --sigma-m and --sigma-deg",
        )


def assumed_noise(options: ImportOptions, *, what: str) -> list[str]:
    """Return the warning that a file is silent about its noise, where the options are, too."""
    if options.sigma_m is not None and options.sigma_deg is not None:
        return []
    return [
        f"{what} say nothing of their uncertainty: {options.sigma_m or DEFAULT_SIGMA_M:g} m and "
        f"{options.sigma_deg or DEFAULT_SIGMA_DEG:g} deg per axis are taken; give --sigma-m and --sigma-deg"
    ]


def standing(tags: TagMap, left_out: list[Excluded]) -> list[TagPose]:
    """Return the tags that stay where they are; those with a visit are added to ``left_out``."""
    left_out += [
        Excluded(f"tag {t.id}", f"it is moved (visit {t.visit}), and the format holds one pose per tag")
        for t in tags.tags
        if t.visit is not None
    ]
    return [t for t in tags.tags if t.visit is None]


def refuse_empty(tags: TagMap, kept: Sequence[TagPose], left_out: Sequence[Excluded], *, to: str) -> None:
    """Raise TagError where nothing is left to be exported."""
    if not kept:
        reasons = "; ".join(dict.fromkeys(e.reason for e in left_out)) or "it lists none"
        raise TagError(
            f"{tags.path or 'tags'}: no tag that {to} can hold ({reasons}); expected one or more",
            hint="choose another --to",
        )
