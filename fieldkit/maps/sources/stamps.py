"""Poses belong to images by name, or by stamp where images are named by it."""

from __future__ import annotations

import bisect
from collections.abc import Iterable, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import PurePosixPath

from fieldkit.frames import Pose

# Names that are stamps count ns, us or ms since 1970 where they have no point: a day of this century has so many digits
_UNITS = {19: 9, 16: 6, 13: 3, 10: 0}
# Some tools write stamps with four digits after the point
_NEAR_NS = 100_000


class NamedPoses:
    """Poses by the first field of their TUM lines: an image's name, or a stamp in s within 0.1 ms of the image's.

    Images are stamped by names that are stamps themselves: in s, or in ns, us or ms since 1970.
    """

    def __init__(self, rows: Iterable[tuple[str, Pose]]) -> None:
        self._listed = dict(rows)
        self._stamps = {ns: name for name in self._listed if (ns := stamp_ns(name)) is not None}
        self._ordered = sorted(self._stamps)

    def get(self, name: str, default: Pose | None = None) -> Pose | None:
        """Return the pose of this name, else that of the stamp that it is, else ``default``."""
        if name in self._listed:
            return self._listed[name]
        ns = stamp_ns(name) if self._ordered else None
        if ns is None:
            return default
        at = bisect.bisect_left(self._ordered, ns)
        near = min(self._ordered[max(at - 1, 0) : at + 1], key=lambda t: abs(t - ns))
        return self._listed[self._stamps[near]] if abs(near - ns) <= _NEAR_NS else default


def match_names(rows: Iterable[tuple[str, Pose]], names: Sequence[str]) -> dict[str, Pose]:
    """Return the pose of every image that has one, by the image's name with or without its folder and ending."""
    poses, result = NamedPoses(rows), {}
    for name in names:
        path = PurePosixPath(name)
        words = (name, path.name, str(path.with_suffix("")), path.stem)
        found = next((p for w in words if (p := poses.get(w)) is not None), None)
        if found is not None:
            result[name] = found
    return result


def stamp_ns(word: str) -> int | None:
    """Return the time in ns that a word states: seconds with a point, or ns, us, ms or s since 1970 by its length."""
    try:
        value = Decimal(word)
    except InvalidOperation:
        return None
    if not value.is_finite() or value < 0:
        return None
    digits = 0 if "." in word or "e" in word.lower() else _UNITS.get(len(word), 0)
    return int(value.scaleb(9 - digits).to_integral_value())
