"""What is around and above the floor of a mesh: walls, a ceiling, or the inside of something solid."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from sim_bridge.mesh import Scene

__all__ = ["Shelter", "faces_agree", "look_around"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Floor lies indoors where this share of level rays ends at something: a roof or a lawn does not.
ENCLOSED_SHARE = 0.66
# A room whose faces agree shows no backs; something solid does, but where its faces coincide with a room's.
HOLLOW_SHARE = 0.2
# Judged on squares of so many cells, from the height of a robot's arm.
SQUARE_CELLS = 5
EYE_M = 1.1
RAYS = 16
# Faces agree about their front where so few of their edges say otherwise, and so many have a face on both sides.
WRONG_EDGES, CLOSED_EDGES = 0.01, 0.5
SAME_M = 1e-4


@dataclasses.dataclass(frozen=True, eq=False)
class Shelter:
    """What is around the cells of a plan: whether they lie ``indoors`` or in a ``hollow``, and the room above them.

    A hollow is the inside of something solid: it shows the backs of its faces. ``room_m`` is the height to what is
    above a cell, or to the mesh's top; 0 where there is no floor.
    """

    indoors: Mask
    hollow: Mask
    room_m: Array


def look_around(
    scene: Scene, ground: Mask, *, free: Mask, level_m: float, origin_xy: tuple[float, float], cell_m: float
) -> Shelter:
    """Return what level rays and one upwards show from the cells of ``ground``, some of which are ``free``.

    Masks are bool[nx,ny] over cells from ``origin_xy``. Whether free floor is hollow is judged by all of it in one
    piece, so that a few wrong faces do not matter.
    """
    step, shape = SQUARE_CELLS, ground.shape
    where = np.argwhere(_squares(ground))
    middle = np.asarray(origin_xy) + (where + 0.5) * step * cell_m
    feet = np.column_stack([middle, np.full(len(middle), level_m + 0.1)])
    top = float(scene.bounds[1, 2]) - level_m
    room = np.minimum(0.1 + scene.intersect(feet, np.tile([0.0, 0.0, 1.0], (len(feet), 1))), max(top, 0.1))
    # Below a low ceiling, or a table, the eye is half as high.
    height = np.where(_squares(free)[tuple(where.T)], EYE_M, np.minimum(EYE_M, 0.5 * room))
    angles = np.linspace(0.0, 2 * np.pi, RAYS, endpoint=False) + 0.1
    rays = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(RAYS)])
    eyes = np.column_stack([middle, level_m + height])
    distance, behind = scene.intersect_sides(np.repeat(eyes, RAYS, axis=0), np.tile(rays, (len(eyes), 1)))
    met = np.isfinite(distance).reshape(-1, RAYS)
    seen, backs = met.sum(axis=1), (met & behind.reshape(-1, RAYS)).sum(axis=1)

    def cells(values: Array) -> Array:
        spread = np.zeros(tuple(-(-n // step) for n in shape))
        spread[tuple(where.T)] = values
        return np.repeat(np.repeat(spread, step, axis=0), step, axis=1)[: shape[0], : shape[1]]

    enclosed = ground & (cells(seen) >= ENCLOSED_SHARE * RAYS) & (cells(seen) > 0)
    from_behind = cells(backs) > HOLLOW_SHARE * cells(seen)
    part, count = label(enclosed & free)
    # Each eye speaks for the piece in which it is.
    inside = part[tuple(np.minimum(where * step + step // 2, np.array(shape) - 1).T)]
    votes = [np.bincount(inside, weights=n, minlength=count + 1) for n in (backs, seen)]
    hollow = np.where(part > 0, (votes[0] > HOLLOW_SHARE * votes[1])[part], from_behind)
    return Shelter(enclosed & ~hollow, enclosed & hollow, np.where(ground, cells(room), 0.0))


def _squares(mask: Mask) -> Mask:
    step = SQUARE_CELLS
    padded = np.pad(mask, [(0, -n % step) for n in mask.shape])
    return np.asarray(padded.reshape(padded.shape[0] // step, step, -1, step).any(axis=(1, 3)))


def faces_agree(scene: Scene) -> bool:
    """Return whether the fronts of neighbouring faces are on the same side: edges are run through both ways."""
    low = scene.vertices.min(axis=0)
    # Vertices at one place are one, whatever their texture coordinates: found by a hash of where they are.
    place = np.rint((scene.vertices - low) / SAME_M).astype(np.uint64)
    primes = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
    _, same = np.unique((place * primes).sum(axis=1, dtype=np.uint64), return_inverse=True)
    faces = same.reshape(-1)[scene.faces].astype(np.int64)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = edges[edges[:, 0] != edges[:, 1]]
    key = edges.min(axis=1) * len(scene.vertices) + edges.max(axis=1)
    _, number, count = np.unique(key, return_inverse=True, return_counts=True)
    ways = np.abs(np.bincount(number.reshape(-1), weights=np.where(edges[:, 0] < edges[:, 1], 1.0, -1.0)))
    wrong, closed = (count > 1) & (ways == count), ways == 0
    return bool(wrong.mean() <= WRONG_EDGES and closed.mean() >= CLOSED_EDGES)
