"""What map building can be told, and what it tells."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal

from fieldkit.errors import MapError
from fieldkit.features.matchers import MatcherName
from fieldkit.maps.io import positive
from fieldkit.maps.landmarks import LandmarkRules
from fieldkit.tags.families import find_family

Progress = Callable[[str, int, int], None]


@dataclasses.dataclass(frozen=True)
class SlamRules:
    """How far SLAM's relative poses are trusted: generously, they only have to tell one desk from the next.

    ``rotation_deg`` and ``position_m`` are the errors allowed between two images, the latter growing by
    ``drift_per_m`` of the way walked in between; points lie ``nearest_m`` to ``farthest_m`` away, and nothing looks
    the same from directions more than ``widest_deg`` apart: opposite shelves do. Poses that fit less than
    ``least_share`` of all matches are wrong themselves and rule out nothing.
    Where a map folds nevertheless, pairs of images lose all their matches when the relative pose that these alone give
    is turned by more than ``pair_rotation_deg`` against SLAM's, or, for images ``pair_baseline_m`` apart, points
    ``pair_direction_deg`` elsewhere.
    """

    rotation_deg: float = 3.0
    position_m: float = 0.1
    drift_per_m: float = 0.005
    nearest_m: float = 0.2
    farthest_m: float = 15.0
    widest_deg: float = 60.0
    least_share: float = 0.5
    pair_rotation_deg: float = 8.0
    pair_direction_deg: float = 25.0
    pair_baseline_m: float = 0.8


@dataclasses.dataclass(frozen=True)
class MapOptions:
    """Settings of map building; the defaults suit 50..500 images of rooms.

    ``poses`` says what the poses of the source are: "slam" gives scale, frame and gravity to what SfM finds by itself,
    "known" are taken as they are, "none" are not read. ``scale`` "auto" takes tags where ``tag_sizes_m`` gives the edge
    of any (by id, None for all others), else depth images where there are any, else SLAM; "slam", "tags" and "depth"
    take just those. ``slam`` says how far SLAM's poses are trusted to rule out matches; None takes all matches.
    ``n_similar`` is to how many similar images every image is matched, by default what the matcher is fast enough for.
    ``retrieval`` says by what a query finds its mapping images: their landmarks' own descriptors, or a network's.
    ``weights`` is a folder where networks' weights are looked for first, ``n_threads`` by default the number of
    processors, which does not change the map, and ``keep_record`` writes seconds and versions into the map folder:
    these three are no part of what the options are told by.
    Raises MapError when a length or a count is not positive, or options contradict each other, and TagError for an
    unknown family.
    """

    max_keypoints: int = 2048
    max_image_size: int | None = 1600
    matcher: MatcherName = "nearest"
    retrieval: Literal["own", "efficientnet", "dinov2"] = "own"
    ratio: float = 0.8
    n_similar: int | None = None
    n_neighbours: int = 3
    min_registered: float = 0.5
    landmarks: LandmarkRules = dataclasses.field(default_factory=LandmarkRules)
    scale: Literal["auto", "slam", "tags", "depth"] = "auto"
    poses: Literal["slam", "known", "none"] = "slam"
    tag_sizes_m: Mapping[int | None, float] = dataclasses.field(default_factory=dict)
    tag_families: tuple[str, ...] = ("tag36h11",)
    slam: SlamRules | None = dataclasses.field(default_factory=SlamRules)
    voxel_m: float = 0.04
    truncation_voxels: float = 3.5
    max_depth_m: float = 6.0
    weights: Path | None = dataclasses.field(default=None, repr=False, compare=False)
    n_threads: int | None = dataclasses.field(default=None, repr=False, compare=False)
    keep_record: bool = dataclasses.field(default=True, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name in ("voxel_m", "truncation_voxels", "max_depth_m", "ratio", "max_keypoints"):
            positive(name, getattr(self, name))
        if self.n_threads is not None:
            positive("n_threads", self.n_threads)
        for tag_id, size_m in self.tag_sizes_m.items():
            positive("size_m of tags" if tag_id is None else f"size_m of tag {tag_id}", size_m)
        for family in self.tag_families:
            find_family(family)
        if self.scale == "tags" and not self.tag_sizes_m:
            raise MapError("scale by tags without a tag's size; expected one", hint="give --size-m METRES or ID:METRES")
        if self.poses == "known" and self.scale != "auto":
            raise MapError(
                f"poses that are known have their scale; expected no scale by {self.scale}",
                hint="leave --scale away, or take the poses as --poses slam",
            )
        if self.poses == "none" and self.scale == "slam":
            raise MapError(
                "scale by SLAM, but its poses are not to be read", hint="choose --poses slam or another scale"
            )
