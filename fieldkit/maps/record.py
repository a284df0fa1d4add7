"""build.json: how a map was made. It lies beside what the digest covers, and a map without it is as good."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import msgspec

from fieldkit.store.files import atomic_write, plain_json, read_json

RECORD_FILE = "build.json"


class BuildRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Seconds per stage, over all processes that a build took, library versions, options, and warnings."""

    seconds: dict[str, float]
    versions: dict[str, str]
    options: str
    warnings: tuple[str, ...] = ()
    version: Literal[1] = 1


def write_record(
    folder: Path, seconds: Mapping[str, float], *, versions: Mapping[str, str], options: str, told: Sequence[str]
) -> None:
    """Write build.json into a map folder."""
    entry = BuildRecord({k: round(v, 3) for k, v in seconds.items()}, dict(versions), options, tuple(told))
    atomic_write(folder / RECORD_FILE, plain_json(entry))


def read_record(folder: Path) -> BuildRecord | None:
    """Read build.json of a map folder; None for a map without one. Raises StoreError when it is damaged."""
    path = folder / RECORD_FILE
    return read_json(path, BuildRecord, what="build.json of fieldkit") if path.is_file() else None
