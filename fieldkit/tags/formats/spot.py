"""Spot's fiducials as JSON of the SDK's messages: world objects, or the anchoring of a GraphNav map."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
from scipy.spatial.transform import Rotation

from fieldkit.errors import FieldkitError, StoreError, TagError, suggestion
from fieldkit.frames import Pose, pose, position_quaternion
from fieldkit.store.files import convert, read_text
from fieldkit.tags.formats.common import (
    Exported,
    Imported,
    ImportOptions,
    assumed_noise,
    finish,
    imported_tag,
    refuse_empty,
    standing,
)
from fieldkit.types import Excluded, TagMap, TagPose

WHAT = "JSON of Spot's world objects or of a GraphNav map (google.protobuf.json_format.MessageToJson)"
FAMILY = "tag36h11"
# Spot's fiducials have x up, y to the left, z out of the paper; here x is to the right, y up, z out of the paper
SPOT_FROM_TAG = Pose.from_rotation(Rotation.from_matrix([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
_OK = ("STATUS_OK", 1)


# protobuf leaves out every field that is zero
class _Position(msgspec.Struct, frozen=True):
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


class _Quaternion(msgspec.Struct, frozen=True):
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 0.0


class _Pose(msgspec.Struct, frozen=True):
    position: _Position = _Position()
    rotation: _Quaternion = _Quaternion()

    def pose(self, what: str) -> Pose:
        p, q = self.position, self.rotation
        try:
            return pose((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))
        except FieldkitError as error:
            raise TagError(f"{what}: {error.message}") from error


class _Edge(msgspec.Struct, frozen=True):
    parent_frame_name: str = ""
    parent_tform_child: _Pose | None = None


class _Snapshot(msgspec.Struct, frozen=True):
    child_to_parent_edge_map: dict[str, _Edge] = {}


class _Fiducial(msgspec.Struct, frozen=True):
    tag_id: int
    dimensions: _Position = _Position()
    frame_name_fiducial: str = ""
    frame_name_fiducial_filtered: str = ""
    fiducial_pose_status: str | int = "STATUS_UNKNOWN"
    fiducial_filtered_pose_status: str | int = "STATUS_UNKNOWN"


class _WorldObject(msgspec.Struct, frozen=True):
    apriltag_properties: _Fiducial | None = None
    transforms_snapshot: _Snapshot = _Snapshot()


class _Anchored(msgspec.Struct, frozen=True):
    id: str
    seed_tform_object: _Pose


class _Anchoring(msgspec.Struct, frozen=True):
    objects: list[_Anchored] = []


class _File(msgspec.Struct, frozen=True):
    world_objects: list[_WorldObject] | None = None
    anchoring: _Anchoring | None = None


def read(path: Path, options: ImportOptions) -> Imported:
    """Read fiducials and turn their axes into those of fieldkit's tag frame.

    World objects are taken in the frame ``options.frame`` (vision when not given), filtered pose first, and only
    where Spot calls the pose good; anchored objects are in the map's seed frame and need a size. Raises StoreError
    for a file that cannot be read, TagError for a frame that is not there or fiducials without a size.
    """
    data = convert(_values(path), _File, path=path, what=WHAT)
    left_out: list[Excluded] = []
    tags: list[TagPose] = []
    if data.anchoring is not None:
        if options.frame not in (None, "seed"):
            raise TagError(f"{path}: no frame {options.frame!r} in a GraphNav map", hint="known: seed")
        for entry in data.anchoring.objects:
            if not entry.id.isdecimal():
                left_out.append(Excluded(f"object {entry.id!r}", "it is no fiducial: its id is no number"))
                continue
            seed_from_spot = entry.seed_tform_object.pose(f"{path}: object {entry.id}")
            tags.append(_tag(path, int(entry.id), seed_from_spot, None, options))
    elif data.world_objects is not None:
        for found in data.world_objects:
            if found.apriltag_properties is not None:
                tags += _from_world_object(path, found, options, left_out)
    else:
        raise StoreError(
            f"{path}: no world_objects and no anchoring; expected {WHAT}", hint="check the file and --from"
        )
    return finish(path, tags, options, left_out=left_out, warnings=assumed_noise(options, what="fiducials"))


def _values(path: Path) -> Any:
    text = read_text(path, what=WHAT)
    try:
        values = _snake(json.loads(text))
    except (ValueError, RecursionError) as error:
        raise StoreError(f"{path}: not valid JSON: {error}; expected {WHAT}", hint="check the file") from error
    if isinstance(values, list):
        return {"world_objects": values}
    return {"anchoring": values} if isinstance(values, dict) and "objects" in values else values


def _snake(values: Any, *, keep: bool = False) -> Any:
    """Return JSON with the field names of the .proto files; MessageToJson turns them into camel case."""
    if isinstance(values, list):
        return [_snake(v) for v in values]
    if not isinstance(values, Mapping):
        return values
    names = {k: k if keep else re.sub(r"(?<=[a-z0-9])([A-Z])", lambda m: "_" + m.group().lower(), k) for k in values}
    # The keys of this map are frames, not fields
    return {names[k]: _snake(v, keep=names[k] == "child_to_parent_edge_map" and not keep) for k, v in values.items()}


def _from_world_object(
    path: Path, found: _WorldObject, options: ImportOptions, left_out: list[Excluded]
) -> list[TagPose]:
    fiducial = found.apriltag_properties
    assert fiducial is not None
    named = [
        (fiducial.frame_name_fiducial_filtered, fiducial.fiducial_filtered_pose_status),
        (fiducial.frame_name_fiducial, fiducial.fiducial_pose_status),
    ]
    edges = found.transforms_snapshot.child_to_parent_edge_map
    good = [frame for frame, status in named if frame in edges and status in _OK]
    if not good:
        said = ", ".join(f"{frame} {status}" for frame, status in named if frame) or "no frame"
        left_out.append(Excluded(f"tag {fiducial.tag_id}", f"Spot calls none of its poses good ({said})"))
        return []
    root = options.frame or "vision"
    root_from_spot = _from_root(path, edges, root, good[0])
    return [_tag(path, fiducial.tag_id, root_from_spot, fiducial.dimensions.x or None, options)]


def _from_root(path: Path, edges: Mapping[str, _Edge], root: str, frame: str) -> Pose:
    """Return root_from_frame through the tree of a snapshot, in which either may be above the other."""
    tree_from_root, top = _to_top(path, edges, root)
    tree_from_frame, other = _to_top(path, edges, frame)
    if root not in edges or top != other:
        raise TagError(
            f"{path}: no frame {root!r} that leads to {frame}; expected one of the snapshot's frames",
            hint=f"give --frame; {suggestion(root, [f for f in edges if 'fiducial' not in f])}",
        )
    return tree_from_root.inv() * tree_from_frame


def _to_top(path: Path, edges: Mapping[str, _Edge], frame: str) -> tuple[Pose, str]:
    result, visited = Pose.identity(), [frame]
    while (edge := edges.get(visited[-1])) is not None and edge.parent_frame_name:
        if edge.parent_tform_child is not None:
            result = edge.parent_tform_child.pose(f"{path}: frame {visited[-1]}") * result
        if edge.parent_frame_name in visited:
            raise TagError(f"{path}: frame {visited[-1]} is its own ancestor; expected a tree", hint="check the file")
        visited.append(edge.parent_frame_name)
    return result, visited[-1]


def _tag(path: Path, tag_id: int, ref_from_spot: Pose, in_file: float | None, options: ImportOptions) -> TagPose:
    size_m = options.size_m(tag_id, in_file)
    if size_m is None:
        raise TagError(
            f"{path}: tag {tag_id} has no size; expected the edge length of its black square",
            hint="give --size-m (Spot's own fiducials: 0.146)",
        )
    return imported_tag(
        tag_id, ref_from_spot * SPOT_FROM_TAG, family=FAMILY, size_m=size_m, covariance=options.covariance()
    )


def write(tags: TagMap) -> Exported:
    """Return the anchoring of a GraphNav map as JSON: the map frame is its seed frame.

    It parses into bosdyn.api.graph_nav.Graph; its objects are what ProcessAnchoring takes as hints. Tags that are
    moved, and families other than tag36h11, are left out: Spot sees no others.
    """
    left_out: list[Excluded] = []
    kept = standing(tags, left_out)
    left_out += [
        Excluded(f"tag {t.id}", f"Spot does not see the family {t.family}") for t in kept if t.family != FAMILY
    ]
    kept = [t for t in kept if t.family == FAMILY]
    refuse_empty(tags, kept, left_out, to="Spot")
    objects = []
    for tag in kept:
        (x, y, z), (qx, qy, qz, qw) = position_quaternion(tag.map_from_tag * SPOT_FROM_TAG.inv())
        seed_from_spot = {"position": {"x": x, "y": y, "z": z}, "rotation": {"x": qx, "y": qy, "z": qz, "w": qw}}
        objects.append({"id": str(tag.id), "seedTformObject": seed_from_spot})
    return Exported(json.dumps({"anchoring": {"objects": objects}}, indent=1) + "\n", tuple(left_out))
