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


def match_names(rows: Iterable[tuple[str, Pose]], names: Sequence[str]) -> dict[str, Pose]:
    """Return the pose of every image that has one, by the image's name.

    The first field of a row is the image's name, with or without folder and ending, or, where images are named by
    their stamps (in s, or in ns, us or ms since 1970), a stamp in s within 0.1 ms of the image's.
    """
    listed = dict(rows)
    stamps = {ns: name for name in listed if (ns := stamp_ns(name)) is not None}
    ordered = sorted(stamps)
    result = {}
    for name in names:
        path = PurePosixPath(name)
        word = next((w for w in (name, path.name, str(path.with_suffix("")), path.stem) if w in listed), None)
        if word is None and ordered and (ns := stamp_ns(path.stem)) is not None:
            word = _nearest(stamps, ordered, ns)
        if word is not None:
            result[name] = listed[word]
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


def _nearest(stamps: dict[int, str], ordered: list[int], ns: int) -> str | None:
    at = bisect.bisect_left(ordered, ns)
    near = min(ordered[max(at - 1, 0) : at + 1], key=lambda t: abs(t - ns))
    return stamps[near] if abs(near - ns) <= _NEAR_NS else None
