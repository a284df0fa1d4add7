"""tags.yaml of apriltag_ros (ROS 1): standalone tags with a size, and bundles of tags with poses."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec

from fieldkit.errors import FieldkitError, TagError, suggestion
from fieldkit.frames import pose, position_quaternion
from fieldkit.tags.formats.common import (
    Exported,
    Imported,
    ImportOptions,
    assumed_noise,
    finish,
    imported_tag,
    read_yaml,
    refuse_empty,
    standing,
)
from fieldkit.types import Excluded, TagMap, TagPose

WHAT = "tags.yaml of apriltag_ros with tag_bundles"
_Size = Annotated[float, msgspec.Meta(gt=0)]


class _Standalone(msgspec.Struct, frozen=True):
    id: int
    size: _Size


class _Member(msgspec.Struct, frozen=True):
    id: int
    size: _Size
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    qw: float = 1.0
    qx: float = 0.0
    qy: float = 0.0
    qz: float = 0.0


class _Bundle(msgspec.Struct, frozen=True):
    layout: list[_Member]
    name: str | None = None


class _TagsYaml(msgspec.Struct, frozen=True):
    standalone_tags: list[_Standalone] | None = None
    tag_bundles: list[_Bundle] | None = None


def read(path: Path, options: ImportOptions) -> Imported:
    """Read the tags of one bundle; the bundle's frame becomes the map. Tag axes are apriltag_ros's: as fieldkit's.

    Raises StoreError for a file that cannot be read, TagError where it is not clear which bundle is meant.
    """
    data = read_yaml(path, _TagsYaml, what=WHAT)
    bundles = {b.name or f"bundle_{i}": b for i, b in enumerate(data.tag_bundles or [])}
    alone = [t.id for t in data.standalone_tags or []]
    if not bundles:
        raise TagError(
            f"{path}: no tag_bundles, so no tag has a pose; expected {WHAT}",
            hint="standalone tags hold sizes only: calibrate them with `fieldkit tags calibrate`",
        )
    bundle = _choose(path, bundles, options)
    members = {m.id for m in bundle.layout}
    left_out = [Excluded(f"tag {i}", "a standalone tag has no pose") for i in dict.fromkeys(alone) if i not in members]
    return finish(
        path,
        [_tag(path, index, member, options) for index, member in enumerate(bundle.layout)],
        options,
        left_out=left_out,
        warnings=assumed_noise(options, what="bundles"),
    )


def _choose(path: Path, bundles: dict[str, _Bundle], options: ImportOptions) -> _Bundle:
    if options.frame is None and len(bundles) == 1:
        return next(iter(bundles.values()))
    if options.frame in bundles:
        return bundles[options.frame]
    wrong = f"no bundle {options.frame!r}" if options.frame else f"{len(bundles)} bundles, each in a frame of its own"
    hint = f"give --frame; {suggestion(options.frame or '', list(bundles))}"
    raise TagError(f"{path}: {wrong}; expected the name of one", hint=hint)


def _tag(path: Path, index: int, member: _Member, options: ImportOptions) -> TagPose:
    try:
        map_from_tag = pose((member.x, member.y, member.z), (member.qx, member.qy, member.qz, member.qw))
    except FieldkitError as error:
        raise TagError(f"{path}: layout[{index}] (id {member.id}): {error.message}", hint="correct the file") from error
    size_m = options.sizes_m.get(member.id, member.size)
    return imported_tag(member.id, map_from_tag, family=options.family, size_m=size_m, covariance=options.covariance())


def write(tags: TagMap) -> Exported:
    """Return tags.yaml with one bundle named map, and every tag standalone, so that each is reported by itself.

    A node searches one family: that of the first tag; tags of others are left out, as are tags that are moved.
    """
    left_out: list[Excluded] = []
    kept = standing(tags, left_out)
    family = kept[0].family if kept else ""
    left_out += [
        Excluded(f"tag {t.id}", f"its family {t.family} is not {family}, and a node searches one")
        for t in kept
        if t.family != family
    ]
    kept = [t for t in kept if t.family == family]
    refuse_empty(tags, kept, left_out, to="apriltag_ros")
    lines = [
        f"# Tags in the map {tags.map_digest[:12] or '(unknown)'}, written by fieldkit. Metres; map_from_tag:",
        f"# x to the right, y up, z out of the paper. Set tag_family: '{family}' in settings.yaml.",
        "standalone_tags:",
        *(f"  - {{id: {t.id}, size: {t.size_m!r}, name: tag_{t.id}}}" for t in kept),
        "tag_bundles:",
        "  - name: map",
        "    layout:",
        *(f"      - {_layout(t)}" for t in kept),
    ]
    return Exported("\n".join(lines) + "\n", tuple(left_out))


def _layout(tag: TagPose) -> str:
    (x, y, z), (qx, qy, qz, qw) = position_quaternion(tag.map_from_tag)
    numbers = {"x": x, "y": y, "z": z, "qw": qw, "qx": qx, "qy": qy, "qz": qz}
    text = ", ".join(f"{key}: {value:.9f}" for key, value in numbers.items())
    return f"{{id: {tag.id}, size: {tag.size_m!r}, {text}}}"
