"""The metric, upright frame of a reconstruction: from SLAM's poses, tags of known size, depth, or poses as given."""

from __future__ import annotations

import collections
import dataclasses
import functools
from collections.abc import Mapping, Sequence

import numpy as np
import pycolmap

from fieldkit.errors import MapError
from fieldkit.frames import Pose
from fieldkit.maps.landmarks import Model, model_arrays
from fieldkit.maps.metric.align import Alignment, Similarity, Verdict, align_to_slam, doubted
from fieldkit.maps.metric.depth import MAX_CHANGE, DepthScale, depth_scale, rescaled, with_depth_scale
from fieldkit.maps.metric.given import known_alignment
from fieldkit.maps.metric.tagged import MIN_IMAGES, TagScale, find_tags, tag_scale
from fieldkit.maps.metric.upright import Upright, find_upright, up_rotation
from fieldkit.maps.options import MapOptions, Progress
from fieldkit.maps.sources.order import walk_order
from fieldkit.maps.sources.source import MIN_POSES, MapSource, poses_path, read_depth
from fieldkit.tags import TagDetection

Told = tuple[Alignment, list[str]]
# Cameras may lean by this on average, lines and floors by a tenth of it, before a map's up is called doubtful
_PASS_DEG, _WARN_DEG = 1.0, 3.0
# Relative standard deviation of the scale
_PASS_SCALE, _WARN_SCALE = 0.005, 0.02


def refuse_unscaled(walk: MapSource, options: MapOptions) -> None:
    """Raise MapError where nothing in a source could give the map its scale, before any work."""
    posed = walk.n_posed >= MIN_POSES and options.poses != "none"
    missing = f"{poses_path(walk.path)}: no such file"
    if options.poses == "known" and not posed:
        raise MapError(
            f"{missing}; expected the poses that are known",
            hint="write one TUM line per image: name tx ty tz qx qy qz qw",
        )
    if options.scale == "depth" and walk.depth_camera is None:
        raise MapError(f"{walk.path / 'depth'}: no depth image; expected some, for the scale", hint="add depth/")
    if options.scale == "slam" and not posed:
        raise MapError(
            f"{missing}; expected SLAM poses, which give the map its scale and gravity",
            hint="write one TUM line per image: name tx ty tz qx qy qz qw",
        )
    if not posed and walk.depth_camera is None and not options.tag_sizes_m:
        raise MapError(
            f"{walk.path}: neither poses nor depth images, and no tag's size given; expected one of them: "
            "images alone leave the scale of a map unknown",
            hint=f"add {poses_path(walk.path).name} or depth/, or hang up AprilTags and give --size-m METRES",
        )


def find_frame(
    walk: MapSource,
    model: pycolmap.Reconstruction | Model,
    sfm_poses: Mapping[int, Pose],
    options: MapOptions,
    *,
    tags: Mapping[int, Sequence[TagDetection]],
    seed: int,
    match_share: float = 1.0,
) -> Told:
    """Return map_from_sfm with its residuals and verdict, and what a user should know about it.

    With SLAM's poses the frame is theirs, and tags or depth may refine the scale; without, the first camera is the
    origin, looks along x, and up is told by the images. ``tags`` are those that `look_for_tags` found;
    ``match_share`` says how well poses that are known fit. Raises MapError when what is asked for cannot be found.
    """
    if options.poses == "known":
        return _by_known(walk, model, sfm_poses, match_share)
    posed = {i: p for i in sfm_poses if (p := walk.images[i].slam_from_cam) is not None}
    sightings = [(pose, walk.images[i].camera, d) for i, pose in sfm_poses.items() for d in tags.get(i, ())]
    scale = tag_scale(sightings, options.tag_sizes_m, seed=seed)
    if scale is None and options.scale == "tags":
        raise _no_tags(walk)
    told = ["tags give no scale: none is well seen in three placed images"] if tags and scale is None else []
    if walk.n_posed < MIN_POSES:
        return _by_images(walk, model, sfm_poses, scale, told)
    try:
        alignment = align_to_slam(
            [sfm_poses[i] for i in posed], list(posed.values()), seed=seed, walks=_walks(walk, list(posed))
        )
    except MapError as error:
        raise MapError(f"{walk.path}: {error.message}", hint=error.hint) from error
    told += _doubts(alignment)
    centres = np.stack([sfm_poses[i].translation for i in posed]), np.stack([p.translation for p in posed.values()])
    if scale is not None:
        by_tags = _scaled_by_tags(alignment, scale, centres, told)
        return _beside_depth(walk, model, sfm_poses, by_tags, "tags", limit=MAX_CHANGE)
    if options.scale == "slam" or (options.scale == "auto" and walk.depth_camera is None):
        return alignment, told
    found = _depth_ratio(walk, model, sfm_poses, alignment.map_from_sfm)
    if found is None and options.scale == "depth":
        raise _too_little_depth(walk)
    if found is None:
        return alignment, told
    scaled, doubts = with_depth_scale(
        alignment, found, sfm_centres=centres[0], slam_centres=centres[1], anyway=options.scale == "depth"
    )
    return scaled, told + doubts


def _walks(walk: MapSource, posed: Sequence[int]) -> list[list[int]]:
    """Return, for each sequence, the rows of ``posed`` of its images in the order in which they were taken."""
    row = {i: k for k, i in enumerate(posed)}
    sequences: dict[str, list[int]] = {}
    for i in posed:
        sequences.setdefault(walk.images[i].sequence, []).append(i)
    return [[row[i] for i in walk_order(walk.images, members)] for members in sequences.values()]


def _doubts(alignment: Alignment) -> list[str]:
    if alignment.verdict == "pass":
        return []
    return [
        f"alignment verdict {alignment.verdict}: {alignment.n_used} of {alignment.n_total} SLAM poses within "
        f"{alignment.threshold_m:.3f} m, rms {alignment.rms_m:.3f} m, gravity {alignment.gravity_deg:.2f} deg"
    ]


def look_for_tags(walk: MapSource, options: MapOptions, *, progress: Progress) -> dict[int, list[TagDetection]]:
    """Return the tags of known size in the images (by index) that show any, where the scale may be theirs.

    Raises MapError before any SfM where the scale has to be theirs, and too few images show any.
    """
    if not options.tag_sizes_m or options.scale not in ("auto", "tags"):
        return {}
    told = functools.partial(progress, "tags")
    found = find_tags(
        walk, options.tag_sizes_m, options.tag_families, progress=lambda done: told(done, len(walk.images))
    )
    counts = collections.Counter(d.id for seen in found.values() for d in seen)
    alone = walk.n_posed < MIN_POSES and walk.depth_camera is None
    if (options.scale == "tags" or alone) and max(counts.values(), default=0) < MIN_IMAGES:
        raise _no_tags(walk)
    return found


def _no_tags(walk: MapSource) -> MapError:
    return MapError(
        f"{walk.path}: no tag of known size is seen in {MIN_IMAGES} images from different places; expected one, which "
        "gives the scale",
        hint="check --size-m and --family, and map the tags from nearer and from several sides",
    )


def _scaled_by_tags(
    alignment: Alignment, tags: TagScale, centres: tuple[np.ndarray, np.ndarray], told: list[str]
) -> Told:
    """Take the scale of tags and the frame of SLAM; residuals are those to SLAM's positions."""
    ratio = tags.scale / alignment.map_from_sfm.scale
    scaled = rescaled(alignment, ratio, sfm_centres=centres[0], slam_centres=centres[1])
    told = [*told, *_tag_doubts(tags)]
    if abs(ratio - 1.0) > max(0.02, 4.0 * tags.sigma):
        told.append(
            f"tags say that the SLAM poses are {100 * (1.0 / ratio - 1):+.1f} % off in scale: check the tags' size; "
            "the tags are believed"
        )
        scaled = doubted(scaled, ratio)
    verdict = worst(scaled.verdict, _scale_verdict(tags.sigma, tags.apart))
    return dataclasses.replace(scaled, source="tags", scale_sigma=tags.sigma, verdict=verdict), told


def _tag_doubts(tags: TagScale) -> list[str]:
    if _scale_verdict(tags.sigma, tags.apart) == "pass":
        return []
    return [
        f"the scale by tags {', '.join(map(str, tags.ids))} is known to {100 * tags.sigma:.2f} % "
        f"(tags differ by up to {100 * tags.apart:.2f} %): check their sizes, and map them from nearer"
    ]


def _by_images(
    walk: MapSource,
    model: pycolmap.Reconstruction | Model,
    sfm_poses: Mapping[int, Pose],
    tags: TagScale | None,
    told: list[str],
) -> Told:
    """Place the map without any pose: scale by tags or else by depth, up by what the images show."""
    up = find_upright(walk, sfm_poses)
    first = sfm_poses[min(sfm_poses)]
    rotation = up_rotation(up.up_in_sfm, first.rotation.as_matrix()[:, 2])
    told = [*told, _gravity_told(up)]
    unit = Similarity(1.0, rotation, -rotation.apply(first.translation))
    if tags is not None:
        scaled = dataclasses.replace(unit, scale=tags.scale, translation=tags.scale * unit.translation)
        numbers = tags.n_used, tags.n_total, tags.rms_m, tags.p95_m
        verdict = worst(_scale_verdict(tags.sigma, tags.apart), _gravity_verdict(up))
        alignment = Alignment(scaled, "tags", *numbers, up.sigma_deg, 0.0, verdict, up.source, tags.sigma)
        by_tags = alignment, told + _tag_doubts(tags)
        return _beside_depth(walk, model, sfm_poses, by_tags, "tags", limit=MAX_CHANGE)
    found = None
    # A depth camera beside the images sees landmarks under angles that depend on the scale
    for _ in range(4):
        ratio = _depth_ratio(walk, model, sfm_poses, unit)
        if ratio is None:
            break
        found, change = ratio, ratio.ratio
        unit = dataclasses.replace(unit, scale=unit.scale * change, translation=change * unit.translation)
        if abs(change - 1.0) < 1e-4:
            break
    if found is None:
        raise _too_little_depth(walk) if walk.depth_camera else _no_tags(walk)
    verdict = worst(_scale_verdict(found.sigma, 0.0), _gravity_verdict(up))
    numbers = found.n_used, found.n, found.rms_m, found.p95_m
    return Alignment(unit, "depth", *numbers, up.sigma_deg, 0.0, verdict, up.source, found.sigma), told


def _too_little_depth(walk: MapSource) -> MapError:
    return MapError(
        f"{walk.path / 'depth'}: the depth images show too few landmarks; expected more, for the scale",
        hint=f"add {poses_path(walk.path).name}, or hang up AprilTags and give --size-m METRES",
    )


def _gravity_told(up: Upright) -> str:
    assumed = {
        "floor": "level surfaces in the depth images are level",
        "verticals": "nearly upright lines in the images are upright",
        "cameras": "the cameras were held level on average",
    }[up.source]
    return f"nothing measured gravity: up is known to {up.sigma_deg:.2f} deg if {assumed}"


def _by_known(walk: MapSource, model: pycolmap.Reconstruction | Model, poses: Mapping[int, Pose], share: float) -> Told:
    assert not isinstance(model, Model)
    up = find_upright(walk, poses)
    tilt = float(np.degrees(np.arccos(np.clip(up.up_in_sfm[2], -1.0, 1.0))))
    alignment = known_alignment(model, poses, share=share, tilt=(tilt, up.sigma_deg))
    told = []
    if alignment.verdict != "pass":
        told.append(
            f"known poses, verdict {alignment.verdict}: {alignment.n_used} of {alignment.n_total} images see points, "
            f"{100 * share:.0f} % of the matches fit, up is {tilt:.1f} +- {up.sigma_deg:.1f} deg off z in the images"
        )
    return _beside_depth(walk, model, poses, (alignment, told), "known poses", limit=0.02)


def _beside_depth(
    walk: MapSource,
    model: pycolmap.Reconstruction | Model,
    poses: Mapping[int, Pose],
    found: Told,
    what: str,
    *,
    limit: float,
) -> Told:
    """Doubt a scale that depth images, where there are any, contradict by more than ``limit``; it is kept."""
    alignment, told = found
    depth = _depth_ratio(walk, model, poses, alignment.map_from_sfm)
    if depth is None or abs(depth.ratio - 1.0) <= max(limit, 4.0 * depth.sigma):
        return found
    off = f"depth images say that the {what} are {100 * (1.0 / depth.ratio - 1):+.1f} % off in scale"
    return doubted(alignment, depth.ratio), [*told, off]


def _depth_ratio(
    walk: MapSource, model: pycolmap.Reconstruction | Model, sfm_poses: Mapping[int, Pose], map_from_sfm: Similarity
) -> DepthScale | None:
    if walk.depth_camera is None:
        return None
    camera, arrays = walk.depth_camera, model if isinstance(model, Model) else model_arrays(model)
    scaled = dataclasses.replace(arrays, xyz=map_from_sfm.points(arrays.xyz))
    mapped = {i: map_from_sfm.pose(p) for i, p in sfm_poses.items()}
    return depth_scale(walk, scaled, mapped, read=lambda frame: read_depth(frame, camera))


def _scale_verdict(sigma: float, apart: float) -> Verdict:
    worst = max(sigma, apart / 3.0)
    return "pass" if worst <= _PASS_SCALE else "warn" if worst <= _WARN_SCALE else "fail"


def _gravity_verdict(up: Upright) -> Verdict:
    return "pass" if up.sigma_deg < _PASS_DEG else "warn" if up.sigma_deg < _WARN_DEG else "fail"


def worst(*verdicts: Verdict) -> Verdict:
    """Return the worst of verdicts."""
    order: Sequence[Verdict] = ("pass", "warn", "fail")
    return max(verdicts, key=order.index)
