"""Side rooms of halls: a door, a screen wall behind it that hides the rest, plain walls, hardly any furniture.

Stores, washrooms and cloakrooms are like that. Nothing of the hall is seen from within, and who maps a building in
little time does not go in.
"""

from __future__ import annotations

import dataclasses

from sim_bridge.scenes.blueprint import Builder
from sim_bridge.scenes.halls import EAST, NORTH, SOUTH, WEST, lamps
from sim_bridge.scenes.plan import THICKNESS_M, Rect, slab, wall

TILE_M = (2.4, 2.4)
_HALF = THICKNESS_M / 2
_LAMP_M = (0.6, 0.6)


@dataclasses.dataclass(frozen=True)
class Finish:
    """Texture numbers of a side room's walls, floor and ceiling (both in tiles of TILE_M), and skirting."""

    walls: int
    floor: int
    ceiling: int
    trim: int


@dataclasses.dataclass(frozen=True)
class SideRoom:
    """The floor's rectangle (x0, y0, x1, y1), the side on which the hall lies, and the screen wall's line in plan.

    ``rect`` ends at the outer face of the hall's wall, in which the hall itself leaves an opening for the door. The
    hall's own floor ends ``threshold_m`` before it.
    """

    rect: Rect
    hall: int
    screen: tuple[tuple[float, float], tuple[float, float]]
    height_m: float
    threshold_m: float = THICKNESS_M

    @property
    def floor(self) -> Rect:
        """The rectangle with the threshold in the opening."""
        x0, y0, x1, y1 = self.rect
        reach = dict.fromkeys(range(4), 0.0) | {self.hall: self.threshold_m}
        return x0 - reach[WEST], y0 - reach[SOUTH], x1 + reach[EAST], y1 + reach[NORTH]


def side_room(build: Builder, room: SideRoom, finish: Finish, *, lamp_power: float) -> None:
    """Add the room's three outer walls, its screen, floor, ceiling, and two lamps along its middle."""
    x0, y0, x1, y1 = room.rect
    lines = {
        SOUTH: ((x0, y0 - _HALF), (x1, y0 - _HALF)),
        EAST: ((x1 + _HALF, y0), (x1 + _HALF, y1)),
        NORTH: ((x1, y1 + _HALF), (x0, y1 + _HALF)),
        WEST: ((x0 - _HALF, y1), (x0 - _HALF, y0)),
    }
    for side, line in lines.items():
        if side != room.hall:
            wall(build, *line, height_m=room.height_m, left=finish.walls, right=None, trim=finish.trim)
    wall(build, *room.screen, height_m=room.height_m, left=finish.walls, right=finish.walls, trim=finish.trim)
    slab(build, room.floor, z_m=0.0, texture=finish.floor, up=True, cell_m=0.14, tile_m=TILE_M)
    slab(build, room.rect, z_m=room.height_m, texture=finish.ceiling, up=False, cell_m=0.6, tile_m=TILE_M)
    if room.hall in (EAST, WEST):
        spots = [(x0 + share * (x1 - x0), (y0 + y1) / 2) for share in (0.25, 0.75)]
    else:
        spots = [((x0 + x1) / 2, y0 + share * (y1 - y0)) for share in (0.25, 0.75)]
    lamps(build, spots, z_m=room.height_m - 0.01, size_m=_LAMP_M, power=lamp_power)


def union(first: Rect, second: Rect) -> Rect:
    """Return the smallest rectangle around two."""
    lows, highs = zip(first[:2], second[:2], strict=True), zip(first[2:], second[2:], strict=True)
    (x0, y0), (x1, y1) = (min(pair) for pair in lows), (max(pair) for pair in highs)
    return x0, y0, x1, y1
