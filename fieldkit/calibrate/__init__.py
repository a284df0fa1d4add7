"""Photos of tags and a map in, the tags' poses in the map out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from fieldkit.calibrate.locating import locate
from fieldkit.calibrate.photos import Progress, find_tags, list_photos, parse_sizes
from fieldkit.calibrate.second import check_in_second_map, refuse_same_map
from fieldkit.calibrate.solving import solve_tags
from fieldkit.calibrate.starting import Group
from fieldkit.calibrate.verdicts import photo_verdicts, tag_pose, warn
from fieldkit.errors import TagError
from fieldkit.maps import map_warp
from fieldkit.protocol import LocalizerRules
from fieldkit.types import SceneMap, TagMap, TagPhoto

__all__ = ["calibrate_photos", "check_in_second_map", "parse_sizes", "refuse_same_map"]


def calibrate_photos(
    photos: Path,
    scene_map: SceneMap,
    *,
    camera: Path | None = None,
    sizes_m: Mapping[int | None, float],
    families: Sequence[str] = ("tag36h11",),
    detector: str | None = None,
    rules: LocalizerRules | None = None,
    progress: Progress | None = None,
) -> TagMap:
    """Find map_from_tag of every tag in a folder of photos, with covariance and a verdict on every photo.

    Every photo is localized in the map; then photos, landmarks and tags are one least-squares problem. The covariance
    has the noise of corners, of keypoints and of the landmarks, and how far the map may be bent (`map_warp`); it is
    scaled up to what the photos show. A wrong scale of the map and an error of the tag's size that the map does not
    contradict are not in it.

    The folder holds photos.toml, or photos of one camera (``camera``, else camera.toml in the folder). ``sizes_m`` as
    `parse_sizes` returns it. A tag whose photos all name a visit gets one pose per visit. One that is also in photos
    without a visit is fixed where the poses from these photos and from every visit's agree: one pose for every visit,
    from all its photos. Where they do not, the tag moved: it keeps one pose per visit, and its photos without a visit
    are rejected. Raises TagError, StoreError or LocalizeError.
    """
    listed = list_photos(Path(photos), camera)
    shots, rejected = find_tags(Path(photos), listed, sizes_m, families, progress, detector=detector)
    located, failed = locate(shots, scene_map, rules, progress)
    rejected += failed
    if not located:
        reasons = sorted({f"{p.file}: {p.reason}" for p in rejected})
        raise TagError(
            f"{photos}: no photo of a tag could be localized in {scene_map.path} ({reasons[0]}); expected at least one",
            hint="take photos that show the tag and much of its mapped surroundings",
        )
    warp = map_warp(scene_map)
    covariance = np.asarray(scene_map.xyz_covariance, dtype=np.float64)
    solved = solve_tags(located, scene_map.xyz, covariance, sizes_m=sizes_m, warp=warp)
    everything = photo_verdicts(solved, located) + rejected
    refused = [sum(_is_of(p, t.group) for p in rejected) for t in solved.tags]
    warn(solved.tags, everything, refused)
    order = {p.file: i for i, p in enumerate(listed)}
    everything.sort(key=lambda p: (order[p.file], p.tag_id))
    tags = tuple(tag_pose(t, refused=n) for t, n in zip(solved.tags, refused, strict=True))
    return TagMap(tags, tuple(everything), scene_map.digest)


def _is_of(photo: TagPhoto, group: Group) -> bool:
    return photo.tag_id == group.tag_id and group.visit in (None, photo.visit)
