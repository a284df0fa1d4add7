"""Tags in the map, their photos, and what a verdict on them rests on."""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fieldkit.frames import Pose

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class TagBounds:
    """What a calibrated tag's pass, warn and fail are.

    Fail: of several photos no two agree; the edge that the map's scale shows contradicts the given one by
    ``size_sigmas`` and by more than ``fail_size_share``; or all photos of the tag are rejected at their other tags.
    Warn: a standard deviation per axis exceeds ``warn_sigma_m`` or ``warn_sigma_rad``, fewer than ``enough_photos``
    agree, more than ``rejected_share`` of the photos are rejected, its tilt is open, or its size is off by more than
    ``size_share``.
    """

    warn_sigma_m: float = 0.01
    warn_sigma_rad: float = math.radians(0.5)
    enough_photos: int = 3
    rejected_share: float = 1 / 3
    size_sigmas: float = 4.0
    size_share: float = 0.005
    fail_size_share: float = 0.03


TAG_BOUNDS = TagBounds()


@dataclasses.dataclass(frozen=True)
class TagPhoto:
    """What became of one photo of a tag: ``reason`` is empty when it was used; sigma is its deviation in sigmas.

    ``flipped``: by itself the photo prefers the tag's other planar solution, which the others exclude. ``position_m``
    is where the photo by itself has the tag in the map, ``offset`` how far (m, rad) that is from the result,
    ``without`` how far the result moves without the photo, ``rms_px`` what remains in its corners. None where the
    photo does not tell.
    """

    file: str
    tag_id: int
    used: bool
    reason: str = ""
    visit: str | None = None
    ambiguity: float = 0.0
    sigma: float = 0.0
    flipped: bool = False
    rms_px: float | None = None
    position_m: tuple[float, float, float] | None = None
    offset: tuple[float, float] | None = None
    without: tuple[float, float] | None = None


@dataclasses.dataclass(frozen=True)
class TagPose:
    """A tag in the map: map_from_tag, its 6x6 covariance, edge length of the black square, and how it was found.

    ``leave_one_out``: by how much (m, rad) the pose moves at most without one of its photos. ``size_from_map``: the
    edge (m) that the map's scale shows, and its standard deviation. None where nothing tells. ``reason`` says what
    the verdict rests on, where it is not "pass".
    """

    id: int
    family: str
    size_m: float
    map_from_tag: Pose
    covariance: Array
    n_photos: int
    rms_px: float
    visit: str | None = None
    verdict: Literal["pass", "warn", "fail"] = "pass"
    leave_one_out: tuple[float, float] | None = None
    size_from_map: tuple[float, float] | None = None
    reason: str = ""


@dataclasses.dataclass(frozen=True)
class TagMap:
    """All tags of a session in the map with digest ``map_digest``; a tag that is moved has one pose per visit."""

    tags: tuple[TagPose, ...]
    photos: tuple[TagPhoto, ...]
    map_digest: str
    digest: str = ""
    path: str = ""

    def find(self, tag_id: int, *, visit: str | None = None) -> TagPose | None:
        """Return the tag's pose for a visit, else its pose for every visit, else None."""
        for wanted in (visit, None):
            for tag in self.tags:
                if tag.id == tag_id and tag.visit == wanted:
                    return tag
        return None

    def photos_of(self, tag: TagPose) -> list[TagPhoto]:
        """Return the photos of a tag; one that has the same place at every visit has those of every visit."""
        return [p for p in self.photos if p.tag_id == tag.id and tag.visit in (None, p.visit)]
