"""A map small enough to ship as a sample: one 8-bit descriptor per landmark, a coarser surface."""

from __future__ import annotations

from pathlib import Path


def compact_map(path: Path, out: Path) -> None:
    raise NotImplementedError
