"""Photos of tags and a map in, the tags' poses in the map out."""

from __future__ import annotations

import dataclasses
import itertools
import logging
import math
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from fieldkit.cameras import Camera
from fieldkit.errors import TagError
from fieldkit.frames import Array, Pose
from fieldkit.frames import log as pose_log
from fieldkit.localize import Localizer
from fieldkit.maps import load_map
from fieldkit.protocol import LocalizerRules
from fieldkit.store import read_camera, read_photos
from fieldkit.tags import Sighting, TagDetection, TagFix, detect, fuse_sightings
from fieldkit.types import Estimate, Image, SceneMap, TagMap, TagPhoto, TagPose

Progress = Callable[[str, int, int], None]
log = logging.getLogger(__name__)

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png")
# A photo's covariance says how well its matches fit, not how far their landmarks are off together: it may be scaled up
PHOTO_SCALES = (1.0, 1.5, 2.0, 3.0, 5.0, 8.0)
# Photos are localized at this multiple of the mapping images' focal length in pixels: the many keypoints of finer
# texture, which mapping could not see, find no match and crowd out those that do
FOCAL_RATIO = 1.5
# Poses of one tag that differ by less than this, 1 sigma per axis, are not told apart; beyond this chi-square (6
# degrees of freedom, one in a thousand) they are two places
PLACE_SIGMA_M, PLACE_SIGMA_RAD = 0.003, math.radians(0.2)
PLACE_GATE = 22.5
# Noise of fewer photos than show their own scale; and so many photos make one that contradicts them an outlier
FEW_PHOTOS, FEW_SCALE, OUTVOTING_PHOTOS = 4, 2.0, 3
# A tag known worse than this, 1 sigma per axis, deserves a warning
WARN_SIGMA_M, WARN_SIGMA_RAD = 0.01, math.radians(0.5)


def parse_sizes(texts: Sequence[str]) -> dict[int | None, float]:
    """Parse sizes in m: ``0.1365`` for every tag (key None), ``3:0.30`` for tag 3. Raises TagError."""
    sizes: dict[int | None, float] = {}
    for text in texts:
        head, colon, tail = text.rpartition(":")
        try:
            tag_id, size_m = (int(head) if colon else None), float(tail)
        except ValueError:
            tag_id, size_m = None, math.nan
        if not math.isfinite(size_m) or size_m <= 0:
            raise TagError(
                f"--size-m {text}: not a tag size; expected metres (0.1365) or ID:METRES (3:0.30)",
                hint="measure the edge of the tag's black square",
            )
        if tag_id in sizes:
            raise TagError(f"--size-m {text}: given twice for {'every tag' if tag_id is None else f'tag {tag_id}'}")
        if not 0.01 <= size_m <= 3.0:
            raise TagError(f"--size-m {text}: {size_m:g} m is no tag's edge; expected metres, 0.01 to 3")
        sizes[tag_id] = size_m
    if not sizes:
        raise TagError("no tag size; expected --size-m METRES", hint="measure the edge of the tag's black square")
    return sizes


def calibrate_tags(
    photos: Path,
    map_path: Path,
    *,
    camera: Path | None = None,
    sizes_m: Mapping[int | None, float],
    families: Sequence[str] = ("tag36h11",),
    rules: LocalizerRules | None = None,
    progress: Progress | None = None,
) -> TagMap:
    """Find map_from_tag of every tag in a folder of photos, in the map in a folder; see `calibrate_photos`.

    Raises also MapError, before any photo is read.
    """
    scene_map = load_map(Path(map_path))
    return calibrate_photos(
        photos, scene_map, camera=camera, sizes_m=sizes_m, families=families, rules=rules, progress=progress
    )


def calibrate_photos(
    photos: Path,
    scene_map: SceneMap,
    *,
    camera: Path | None = None,
    sizes_m: Mapping[int | None, float],
    families: Sequence[str] = ("tag36h11",),
    rules: LocalizerRules | None = None,
    progress: Progress | None = None,
) -> TagMap:
    """Find map_from_tag of every tag in a folder of photos, with covariance and a verdict on every photo.

    Every photo is localized in the map; photos and tags are then one least-squares problem per tag. The covariance
    has the noise of corners and of localization, scaled to what the photos show; a warp or wrong scale of the map,
    which all photos share, and an error of the tag's size are not in it.

    The folder holds photos.toml, or photos of one camera (``camera``, else camera.toml in the folder). ``sizes_m`` as
    `parse_sizes` returns it. A tag whose photos all name a visit gets one pose per visit. One that is also in photos
    without a visit is fixed where the poses from these photos and from every visit's agree: one pose for every visit,
    from all its photos. Where they do not, the tag moved: it keeps one pose per visit, and its photos without a visit
    are rejected. Raises TagError, StoreError or LocalizeError.
    """
    listed = _list_photos(Path(photos), camera)
    shots, rejected = _find_tags(Path(photos), listed, sizes_m, families, progress)
    located, failed = _localize(shots, scene_map, rules, progress)
    rejected += failed
    verdicts: list[TagPhoto] = []
    tags: list[TagPose] = []
    groups, homeless = _groups(located, sizes_m)
    rejected += homeless
    for (tag_id, family, visit), group in sorted(groups.items(), key=lambda g: (g[0][0], str(g[0][1:]))):
        size_m, fix = _size(tag_id, sizes_m), _fuse(group, sizes_m)
        tags.append(_tag_pose(fix, tag_id, family, size_m, visit))
        verdicts += [_photo_verdict(s, fix, index, visit) for index, s in enumerate(group)]
    if not tags:
        reasons = sorted({f"{p.file}: {p.reason}" for p in rejected})
        raise TagError(
            f"{photos}: no photo of a tag could be localized in {scene_map.path} ({reasons[0]}); expected at least one",
            hint="take photos that show the tag and much of its mapped surroundings",
        )
    _warn(tags, verdicts + rejected)
    order = {p.file: i for i, p in enumerate(listed)}
    everything = sorted(verdicts + rejected, key=lambda p: (order[p.file], p.tag_id))
    return TagMap(tuple(tags), tuple(everything), scene_map.digest)


@dataclasses.dataclass(frozen=True)
class _Photo:
    file: str
    path: Path
    camera: Camera
    camera_path: Path
    visit: str | None = None


@dataclasses.dataclass(frozen=True)
class _Shot:
    """A photo, the tags in it that can be calibrated, and all that were found."""

    photo: _Photo
    usable: tuple[TagDetection, ...]
    found: tuple[TagDetection, ...]


@dataclasses.dataclass(frozen=True)
class _Located:
    photo: _Photo
    sighting: Sighting


def _list_photos(folder: Path, camera: Path | None) -> list[_Photo]:
    if not folder.is_dir():
        raise TagError(f"{folder}: no such folder; expected a folder with photos of tags")
    if (folder / "photos.toml").is_file():
        entries = read_photos(folder / "photos.toml")
        _check_inside(folder, [e.file for e in entries] + ([] if camera else [e.camera for e in entries]))
        paths = {e.camera: camera or folder / e.camera for e in entries}
        cameras = {name: read_camera(path) for name, path in paths.items()}
        listed = [_Photo(e.file, folder / e.file, cameras[e.camera], paths[e.camera], e.visit) for e in entries]
    else:
        files = sorted(p for p in folder.iterdir() if p.suffix.lower() in PHOTO_SUFFIXES)
        path = camera or folder / "camera.toml"
        if files and not path.is_file():
            raise TagError(
                f"{path}: no such camera file; expected the calibration of the photos in {folder}",
                hint="give it with --camera, or list the photos and their cameras in photos.toml",
            )
        found = read_camera(path) if files else None
        listed = [] if found is None else [_Photo(p.name, p, found, path) for p in files]
    if not listed:
        raise TagError(f"{folder}: holds no photo; expected .jpg or .png files, or photos.toml")
    for photo in listed:
        if not photo.path.is_file():
            raise TagError(f"{photo.path}: no such photo; expected it, since photos.toml lists it")
    _check_once(folder, listed)
    return listed


def _check_inside(folder: Path, names: Sequence[str]) -> None:
    # By the text of the path: a link that somebody put into the folder is in the folder
    for name in names:
        normal = os.path.normpath(name)
        if os.path.isabs(normal) or normal.split(os.sep)[0] == os.pardir:
            raise TagError(
                f"{folder / 'photos.toml'}: {name!r} leads outside of the folder; expected a path in {folder}",
                hint="copy the file into the folder, or give the camera with --camera",
            )


def _check_once(folder: Path, listed: Sequence[_Photo]) -> None:
    first: dict[Path, str] = {}
    for photo in listed:
        path = photo.path.resolve()
        if path in first:
            raise TagError(
                f"{folder}: photo {photo.file} is listed twice, first as {first[path]}; expected every photo once",
                hint="remove one of the two",
            )
        first[path] = photo.file


def _read_photo(photo: _Photo) -> Image | None:
    # The sensor's pixels, as calibrated: a rotation noted in EXIF would swap the camera's axes
    image = cv2.imread(str(photo.path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        return None
    height, width = image.shape[:2]
    if (width, height) != (photo.camera.width, photo.camera.height):
        raise TagError(
            f"{photo.path}: {width}x{height} pixels; expected {photo.camera.width}x{photo.camera.height} as in "
            f"{photo.camera_path}",
            hint="give the calibration of this camera at this resolution, not rotated or resized",
        )
    return np.asarray(image, dtype=np.uint8)


def _find_tags(
    folder: Path,
    listed: Sequence[_Photo],
    sizes_m: Mapping[int | None, float],
    families: Sequence[str],
    progress: Progress | None,
) -> tuple[list[_Shot], list[TagPhoto]]:
    shots: list[_Shot] = []
    rejected: list[TagPhoto] = []
    seen: set[int] = set()
    for number, photo in enumerate(listed):
        if progress is not None:
            progress("find tags", number + 1, len(listed))
        image = _read_photo(photo)
        found = [] if image is None else detect(image, photo.camera, families=families)
        if not found:
            reason = "cannot be read as an image" if image is None else "no tag found"
            rejected.append(TagPhoto(photo.file, -1, used=False, reason=reason, visit=photo.visit))
        ids = [d.id for d in found]
        usable = []
        for d in found:
            seen.add(d.id)
            if None not in sizes_m and d.id not in sizes_m:
                reason = "no size given for this tag"
            elif ids.count(d.id) > 1:
                reason = "the same id is seen twice in the photo"
            else:
                usable.append(d)
                continue
            rejected.append(TagPhoto(photo.file, d.id, used=False, reason=reason, visit=photo.visit))
        if usable:
            shots.append(_Shot(photo, tuple(usable), tuple(found)))
    if not seen:
        raise TagError(
            f"{folder}: none of the {len(listed)} photos shows a tag of {', '.join(families)} (for example "
            f"{listed[0].file}: {rejected[0].reason}); expected the tags to be calibrated",
            hint="check the family, and that the tag is whole, sharp and at least 30 pixels wide",
        )
    if not shots:
        raise TagError(
            f"{folder}: no tag can be used; tags {sorted(seen)} are seen, sizes are given for {_keys(sizes_m)}"
        )
    return shots, rejected


def _keys(sizes_m: Mapping[int | None, float]) -> list[int | str]:
    return [k if k is not None else "every tag" for k in sizes_m]


def _localize(
    shots: Sequence[_Shot], scene_map: SceneMap, rules: LocalizerRules | None, progress: Progress | None
) -> tuple[list[_Located], list[TagPhoto]]:
    localizer = Localizer(scene_map, rules or LocalizerRules())
    finest_px = FOCAL_RATIO * float(np.median([c.focal_px[0] for c in scene_map.image_cameras]))
    located: list[_Located] = []
    failed: list[TagPhoto] = []
    for number, shot in enumerate(shots):
        if progress is not None:
            progress("localize photos", number + 1, len(shots))
        image = _read_photo(shot.photo)
        assert image is not None
        covered = _without_tags(image, shot.found)
        estimate: Estimate = localizer.localize(*_reduced(covered, shot.photo.camera, finest_px))
        for d in shot.usable:
            if estimate.map_from_cam is None or estimate.covariance is None:
                reason = f"not localized ({estimate.status}, {estimate.n_inliers} inliers)"
                failed.append(TagPhoto(shot.photo.file, d.id, used=False, reason=reason, visit=shot.photo.visit))
            else:
                sighting = Sighting(d, shot.photo.camera, estimate.map_from_cam, estimate.covariance)
                located.append(_Located(shot.photo, sighting))
    return located, failed


def _without_tags(image: Image, detections: Sequence[TagDetection]) -> Image:
    """Return the photo with its tags painted over, margin included.

    A tag that hung elsewhere while mapping would otherwise pull the photo there.
    """
    covered = image.copy()
    for d in detections:
        centre = d.corners_px.mean(axis=0)
        quad = np.round(centre + 1.3 * (d.corners_px - centre)).astype(np.int32)
        cv2.fillConvexPoly(covered, quad, float(np.median(image)))
    return covered


def _reduced(image: Image, camera: Camera, focal_px: float) -> tuple[Image, Camera]:
    """Return image and camera, made smaller where the focal length is longer than ``focal_px``."""
    factor = focal_px / camera.focal_px[0]
    if factor >= 1.0:
        return image, camera
    small = camera.scaled(factor)
    resized = cv2.resize(image, (small.width, small.height), interpolation=cv2.INTER_AREA)
    return np.asarray(resized, dtype=np.uint8), small


def _size(tag_id: int, sizes_m: Mapping[int | None, float]) -> float:
    return sizes_m[tag_id] if tag_id in sizes_m else sizes_m[None]


def _fuse(group: Sequence[_Located], sizes_m: Mapping[int | None, float]) -> TagFix:
    sightings = [s.sighting for s in group]
    return fuse_sightings(sightings, _size(sightings[0].detection.id, sizes_m), scales=PHOTO_SCALES)


def _groups(
    located: Sequence[_Located], sizes_m: Mapping[int | None, float]
) -> tuple[dict[tuple[int, str, str | None], list[_Located]], list[TagPhoto]]:
    """Return the photos that share one pose, by tag id, family and visit (None: every visit), and those rejected."""
    by_tag: dict[tuple[int, str], list[_Located]] = {}
    for s in located:
        by_tag.setdefault((s.sighting.detection.id, s.sighting.detection.family), []).append(s)
    groups: dict[tuple[int, str, str | None], list[_Located]] = {}
    rejected: list[TagPhoto] = []
    for (tag_id, family), every in by_tag.items():
        by_visit: dict[str | None, list[_Located]] = {}
        for s in every:
            by_visit.setdefault(s.photo.visit, []).append(s)
        if None in by_visit and len(by_visit) > 1:
            moved = _contradiction({visit: _fuse(group, sizes_m) for visit, group in by_visit.items()})
            if moved is None:
                by_visit = {None: every}
            else:
                reason = f"the tag has another place in {moved}; expected the visit of this photo in photos.toml"
                rejected += [TagPhoto(s.photo.file, tag_id, used=False, reason=reason) for s in by_visit.pop(None)]
        groups |= {(tag_id, family, visit): group for visit, group in by_visit.items()}
    return groups, rejected


def _contradiction(fixes: Mapping[str | None, TagFix]) -> str | None:
    """Name two groups of photos between which a tag moved, or None where all agree on one place.

    A visit's only photo does not contradict photos without a visit that outvote it: it is an outlier among them.
    """
    outvoting = sum(fixes[None].used) >= OUTVOTING_PHOTOS
    counted = {v: f for v, f in fixes.items() if v is None or not (outvoting and len(f.used) == 1)}
    for (one, a), (two, b) in itertools.combinations(counted.items(), 2):
        if _places_differ(a, b):
            named = [f"visit {v}" if v is not None else "photos without a visit" for v in (one, two)]
            return " than in ".join(named)
    return None


def _places_differ(one: TagFix, two: TagFix) -> bool:
    floor = np.diag([PLACE_SIGMA_RAD**2] * 3 + [PLACE_SIGMA_M**2] * 3)
    for (a, a_covariance), (b, b_covariance) in itertools.product(_places(one), _places(two)):
        delta = pose_log(a.inv() * b)
        if float(delta @ np.linalg.solve(a_covariance + b_covariance + floor, delta)) <= PLACE_GATE:
            return False
    return True


def _places(fix: TagFix) -> list[tuple[Pose, Array]]:
    """Return the pose with its covariance, and the other planar solution where the photos leave it open."""
    factor = FEW_SCALE**2 if sum(fix.used) < FEW_PHOTOS else 1.0
    places = [(fix.ref_from_tag, fix.covariance * factor)]
    if not fix.is_certain and fix.alternative is not None and fix.alternative_covariance is not None:
        places.append((fix.alternative, fix.alternative_covariance * factor))
    return places


def _tag_pose(fix: TagFix, tag_id: int, family: str, size_m: float, visit: str | None) -> TagPose:
    return TagPose(
        tag_id,
        family,
        size_m,
        fix.ref_from_tag,
        fix.covariance,
        sum(fix.used),
        fix.rms_px,
        visit=visit,
        verdict=_verdict(fix),
    )


def _verdict(fix: TagFix) -> Literal["pass", "warn", "fail"]:
    """Judge a tag: fail where no two photos agree; warn where a reader should look at the photos."""
    used, count = sum(fix.used), len(fix.used)
    if used == 1 and count > 1:
        return "fail"
    sigma = np.sqrt(np.diag(fix.covariance))
    doubtful = used < 3 or 3 * (count - used) > count or not fix.is_certain
    if doubtful or float(sigma[3:].max()) > WARN_SIGMA_M or float(sigma[:3].max()) > WARN_SIGMA_RAD:
        return "warn"
    return "pass"


def _photo_verdict(located: _Located, fix: TagFix, index: int, visit: str | None) -> TagPhoto:
    sigma = fix.sigmas[index]
    return TagPhoto(
        located.photo.file,
        located.sighting.detection.id,
        used=fix.used[index],
        reason="" if fix.used[index] else f"disagrees with the others by {sigma:.1f} sigma",
        visit=visit,
        ambiguity=fix.ambiguities[index],
        sigma=sigma,
    )


def _warn(tags: Sequence[TagPose], photos: Sequence[TagPhoto]) -> None:
    for tag in tags:
        where = "" if tag.visit is None else f" of visit {tag.visit}"
        if tag.verdict != "pass":
            log.warning("tag %d%s: %s (%d photos used)", tag.id, where, tag.verdict, tag.n_photos)
    known = {t.id for t in tags}
    for tag_id in sorted({p.tag_id for p in photos if p.tag_id >= 0} - known):
        reasons = sorted({p.reason for p in photos if p.tag_id == tag_id})
        log.warning("tag %d: no pose: %s", tag_id, "; ".join(reasons))
