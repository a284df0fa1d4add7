"""TagSLAM's tagslam.yaml, and the poses.yaml that it writes: bodies, and tags on them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from fieldkit.errors import TagError, suggestion
from fieldkit.frames import Array, Pose, compose_covariance
from fieldkit.store.files import convert
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

WHAT = "tagslam.yaml or poses.yaml of TagSLAM with bodies"
# What TagSLAM writes as the noise of every tag, in m and rad, however well it knows the tag
_WRITTEN_NOISE = 0.001
_FAMILIES = {6: "tag36h11", 5: "tag25h9", 4: "tag16h5"}


# A bound that no building reaches also refuses what is not a number
_Number = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]


class _Vector(msgspec.Struct, frozen=True):
    x: _Number
    y: _Number
    z: _Number

    @property
    def array(self) -> Array:
        return np.array([self.x, self.y, self.z])


class _Pose(msgspec.Struct, frozen=True):
    position: _Vector
    rotation: _Vector
    position_noise: _Vector | None = None
    rotation_noise: _Vector | None = None

    @property
    def pose(self) -> Pose:
        return Pose.from_components(self.position.array, Rotation.from_rotvec(self.rotation.array))

    def covariance(self, *, rotation: float = -1.0, position: float = -1.0) -> Array | None:
        """Return the covariance of a right perturbation, rotation first: GTSAM's order, too.

        Standard deviations that are given (rad, m) replace the pose's own.
        """
        if self.position_noise is None or self.rotation_noise is None:
            return None
        of_rotation = self.rotation_noise.array if rotation < 0 else np.full(3, rotation)
        of_position = self.position_noise.array if position < 0 else np.full(3, position)
        return np.diag(np.concatenate([of_rotation, of_position]) ** 2)


class _Tag(msgspec.Struct, frozen=True):
    id: int
    size: Annotated[float, msgspec.Meta(gt=0)] | None = None
    bits: int = 6
    pose: _Pose | None = None


class _Body(msgspec.Struct, frozen=True):
    is_static: bool
    type: str = "simple"
    default_tag_size: float | None = None
    ignore_tags: list[int] | None = None
    override_tag_position_noise: float = -1.0
    override_tag_rotation_noise: float = -1.0
    pose: _Pose | None = None
    tags: list[_Tag] | None = None


class _Remap(msgspec.Struct, frozen=True):
    remap_id: int


class _Remapped(msgspec.Struct, frozen=True):
    id: int
    remaps: list[_Remap]


class _File(msgspec.Struct, frozen=True):
    bodies: list[dict[str, Any]]
    tag_id_remap: list[_Remapped] | None = None


class _Bodies(msgspec.Struct, frozen=True):
    bodies: list[dict[str, _Body]]


def read(path: Path, options: ImportOptions) -> Imported:
    """Read the tags of static bodies that have poses: map_from_tag is the body's pose times the tag's.

    TagSLAM's tag axes (x right, y up, z out of the paper) are fieldkit's; its rotations are axis times angle, its
    noises standard deviations along the axes of the tag. Raises StoreError and TagError.
    """
    listed = read_yaml(path, _File, what=WHAT)
    # A body is a mapping of one name; TagSLAM skips what else stands between them
    named = [{n: b for n, b in entry.items() if isinstance(b, dict)} for entry in listed.bodies]
    checked = convert({"bodies": named}, _Bodies, path=path, what=WHAT)
    bodies = {n: b for entry in checked.bodies for n, b in entry.items()}
    if options.frame is not None and options.frame not in bodies:
        raise TagError(f"{path}: no body {options.frame!r}", hint=suggestion(options.frame, list(bodies)))
    left_out: list[Excluded] = []
    kept: list[tuple[_Tag, TagPose]] = []
    moved = {r.remap_id: m.id for m in listed.tag_id_remap or [] for r in m.remaps}
    for name, body in bodies.items():
        place = _place(name, body, left_out) if options.frame in (None, name) else None
        if place is None:
            continue
        for tag in body.tags or []:
            found = (
                f"it is tag {moved[tag.id]} after a move (tag_id_remap)"
                if tag.id in moved
                else _tag(tag, body, place, options)
            )
            if isinstance(found, str):
                left_out.append(Excluded(f"tag {tag.id}", found))
            else:
                kept.append((tag, found))
    warnings = _warnings(kept, options)
    return finish(path, [t for _, t in kept], options, left_out=left_out, warnings=warnings)


def _place(name: str, body: _Body, left_out: list[Excluded]) -> _Pose | None:
    """Return where a body stands; its tags are left out where it moves, has no pose, or is a board."""
    reason = ""
    if not body.is_static:
        reason = "it moves (is_static: false)"
    elif body.type != "simple":
        reason = f"it is a {body.type}: its tags have no poses of their own"
    elif body.pose is None:
        reason = "it has no pose"
    if reason and body.tags:
        left_out.append(Excluded(f"body {name} with {len(body.tags)} tags", reason))
    return None if reason else body.pose


def _tag(tag: _Tag, body: _Body, place: _Pose, options: ImportOptions) -> TagPose | str:
    """Return a tag in the map, or why it has to be left out."""
    if tag.id in (body.ignore_tags or ()):
        return "it is in the body's ignore_tags"
    if tag.pose is None:
        return "it has no pose"
    if tag.bits not in _FAMILIES:
        return f"a tag of {tag.bits} bits is of no family that is known here"
    size_m = options.size_m(tag.id, tag.size or body.default_tag_size or None)
    if size_m is None:
        return "it has no size"
    covariance = tag.pose.covariance(
        rotation=body.override_tag_rotation_noise, position=body.override_tag_position_noise
    )
    if covariance is None or options.sigma_m is not None or options.sigma_deg is not None:
        covariance = options.covariance()
    elif (of_body := place.covariance()) is not None:
        covariance = compose_covariance(of_body, tag.pose.pose, covariance)
    family = options.family if tag.bits == 6 else _FAMILIES[tag.bits]
    return imported_tag(tag.id, place.pose * tag.pose.pose, family=family, size_m=size_m, covariance=covariance)


def _warnings(kept: list[tuple[_Tag, TagPose]], options: ImportOptions) -> list[str]:
    if options.sigma_m is not None or options.sigma_deg is not None:
        return assumed_noise(options, what="options")
    own = [tag.pose.covariance() for tag, _ in kept if tag.pose is not None]
    silent = sum(covariance is None for covariance in own)
    if silent:
        return assumed_noise(options, what=f"{silent} tags")
    if own and all(np.allclose(np.diag(c), _WRITTEN_NOISE**2, rtol=1e-3) for c in own if c is not None):
        return [
            f"every tag has a noise of {_WRITTEN_NOISE} m and rad: TagSLAM writes that however well it knows a tag; "
            "give --sigma-m and --sigma-deg"
        ]
    return []


def write(tags: TagMap) -> Exported:
    """Return the bodies of tagslam.yaml: one static body named map that holds the tags.

    Of a covariance only the standard deviations along the tag's axes are kept. Tags that are moved and families
    other than tag36h11, tag25h9 and tag16h5 are left out.
    """
    left_out: list[Excluded] = []
    bits = {family: n for n, family in _FAMILIES.items()}
    kept = standing(tags, left_out)
    left_out += [
        Excluded(f"tag {t.id}", f"TagSLAM does not know the family {t.family}") for t in kept if t.family not in bits
    ]
    kept = [t for t in kept if t.family in bits]
    refuse_empty(tags, kept, left_out, to="TagSLAM")
    zero, tiny = [0.0] * 3, [1e-6] * 3
    lines = [
        f"# Tags in the map {tags.map_digest[:12] or '(unknown)'}, written by fieldkit: for tagslam.yaml; add",
        "# the body that carries the cameras. Metres; rotations are axis times angle; noises standard deviations.",
        "body_defaults:",
        "  position_noise: 0.05",
        "  rotation_noise: 0.01",
        "default_body: map",
        "bodies:",
        "  - map:",
        "      type: simple",
        "      is_static: true",
        f"      default_tag_size: {kept[0].size_m!r}",
        *_pose_lines(zero, zero, tiny, tiny, indent=6),
        "      tags:",
    ]
    for tag in kept:
        sigmas = [math.sqrt(max(float(v), 1e-18)) for v in np.diag(tag.covariance)]
        lines += [f"        - id: {tag.id}", f"          bits: {bits[tag.family]}", f"          size: {tag.size_m!r}"]
        position = [float(v) for v in tag.map_from_tag.translation]
        rotation = [float(v) for v in tag.map_from_tag.rotation.as_rotvec()]
        lines += _pose_lines(position, rotation, sigmas[3:], sigmas[:3], indent=10)
    return Exported("\n".join(lines) + "\n", tuple(left_out))


def _pose_lines(
    position: list[float],
    rotation: list[float],
    position_noise: list[float],
    rotation_noise: list[float],
    *,
    indent: int,
) -> list[str]:
    parts = {
        "position": position, "rotation": rotation, "position_noise": position_noise, "rotation_noise": rotation_noise,
    }  # fmt: skip
    space = " " * indent
    lines = [f"{space}pose:"]
    for key, (x, y, z) in parts.items():
        lines.append(f"{space}  {key}: {{x: {x:.9f}, y: {y:.9f}, z: {z:.9f}}}")
    return lines
