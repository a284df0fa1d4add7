"""The order of a walk: frames by name, numbers in names by their value."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from fieldkit.maps.sources.source import SourceImage


def walk_order(images: Sequence[SourceImage], members: Iterable[int]) -> list[int]:
    """Return images of one sequence (by index) in the order in which they were taken, as their frames' names tell.

    Names of equal length are in order as text; where lengths differ, frame10 comes after frame9.
    """
    chosen = list(members)
    names = {i: images[i].frame for i in chosen}
    if len({len(name) for name in names.values()}) < 2:
        return sorted(chosen, key=lambda i: names[i])
    return sorted(chosen, key=lambda i: (_numbered(names[i]), names[i]))


def _numbered(name: str) -> tuple[str | int, ...]:
    """Return a name as text and numbers in turn, text first: comparable with that of any other name."""
    return tuple(int(part) if k % 2 else part for k, part in enumerate(re.split(r"([0-9]+)", name)))
