"""Tag files of other tools: read into a TagMap and written from one."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

from fieldkit.errors import TagError, suggestion
from fieldkit.store.files import atomic_write, digest
from fieldkit.tags.families import FAMILIES
from fieldkit.tags.formats import apriltag_ros, spot, tagslam
from fieldkit.tags.formats.common import Exported, Imported, ImportOptions
from fieldkit.types import TagMap

__all__ = ["TAG_FORMATS", "Exported", "ImportOptions", "Imported", "export_tags", "import_tags"]


@dataclasses.dataclass(frozen=True)
class TagFormat:
    """How a foreign tag file is read and written."""

    read: Callable[[Path, ImportOptions], Imported]
    write: Callable[[TagMap], Exported]


TAG_FORMATS = {
    "apriltag_ros": TagFormat(apriltag_ros.read, apriltag_ros.write),
    "tagslam": TagFormat(tagslam.read, tagslam.write),
    "spot": TagFormat(spot.read, spot.write),
}


def import_tags(path: Path, format: str, *, options: ImportOptions | None = None) -> Imported:
    """Read a foreign tag file; poses become map_from_tag in the frame of that file, tag axes those of fieldkit.

    Raises TagError for an unknown format or family or tags that cannot be used, StoreError for an unreadable file.
    """
    chosen = options or ImportOptions()
    if chosen.family not in FAMILIES:
        raise TagError(f"unknown tag family {chosen.family!r}", hint=suggestion(chosen.family, list(FAMILIES)))
    found = _format(format).read(Path(path), chosen)
    return dataclasses.replace(found, tags=dataclasses.replace(found.tags, digest=digest(Path(path))))


def export_tags(tags: TagMap, format: str, *, out: Path) -> Exported:
    """Write tags to a foreign tag file; raises TagError for an unknown format, or where it can hold none of them."""
    written = _format(format).write(tags)
    atomic_write(out, written.text)
    return written


def _format(name: str) -> TagFormat:
    if name not in TAG_FORMATS:
        raise TagError(f"unknown tag file format {name!r}", hint=suggestion(name, list(TAG_FORMATS)))
    return TAG_FORMATS[name]
