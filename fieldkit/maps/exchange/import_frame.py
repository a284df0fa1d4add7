"""The metric, upright frame of a model that another tool made: from poses, tags, depth, or as the user states it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from fieldkit.errors import MapError
from fieldkit.frames import Pose
from fieldkit.maps.landmarks import Model
from fieldkit.maps.metric.align import Alignment, Similarity
from fieldkit.maps.metric.choosing import find_frame, look_for_tags
from fieldkit.maps.options import MapOptions, Progress
from fieldkit.maps.sources.source import MIN_POSES, DepthFrame, MapSource, SourceImage
from fieldkit.maps.sources.stamps import match_names
from fieldkit.store import read_camera, read_tum

Up = Literal["x", "y", "z", "-x", "-y", "-z"]
_UP: dict[str, tuple[float, float, float]] = {
    "x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1)
}  # fmt: skip
# Cameras are held upright on the whole: a median tilt beyond this means that another axis is up
_MAX_TILT_DEG = 45.0


@dataclasses.dataclass(frozen=True)
class FrameOptions:
    """What gives a model its scale and frame.

    ``poses`` (TUM, z up, in m) are of its images; ``tag_sizes_m`` are edges of AprilTags in them (by id, None for all
    others); ``depth`` is a folder of their depth images (16-bit mm, <stem>.png) by ``depth_camera``, at the same place.
    Or the user knows: ``scale`` are metres per unit, and ``up`` is the axis that points up.
    """

    poses: Path | None = None
    scale: float | None = None
    up: Up = "z"
    tag_sizes_m: Mapping[int | None, float] = dataclasses.field(default_factory=dict)
    tag_families: tuple[str, ...] = ("tag36h11",)
    depth: Path | None = None
    depth_camera: Path | None = None


def metric_alignment(
    folder: Path, model: Model, images: Path | None, options: FrameOptions, *, seed: int, progress: Progress
) -> tuple[Alignment, list[str]]:
    """Return map_from_sfm with its residuals and verdict, and what a user should know about it.

    Raises MapError when nothing is given that could tell the scale, or what is given does not fit the model.
    """
    if options.scale is not None:
        return _stated(model, options.scale, options.up)
    if options.poses is None and not options.tag_sizes_m and options.depth is None:
        raise MapError(
            f"{folder}: its scale is unknown; expected what makes it metric and z up",
            hint="give --poses poses.txt (TUM, of its images), or --scale 1 --up z when it is in metres with z up, "
            "or --size-m of AprilTags in its images, or --depth",
        )
    if images is None and (options.tag_sizes_m or options.poses is None):
        raise MapError(
            f"{folder}: tags and up are found in the images; expected them", hint="give --images, or --poses"
        )
    walk = _walk(folder, model, images, options)
    placed = dict(enumerate(model.map_from_image))
    building = MapOptions(
        poses="none" if options.poses is None else "slam",
        tag_sizes_m=options.tag_sizes_m,
        tag_families=options.tag_families,
    )
    tags = look_for_tags(walk, building, progress=progress)
    return find_frame(walk, model, placed, building, tags=tags, seed=seed)


def _stated(model: Model, scale: float, up: Up) -> tuple[Alignment, list[str]]:
    turn, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], [_UP[up]])
    similarity = Similarity(scale, turn, np.zeros(3))
    ups = np.stack([(turn * p.rotation).apply([0.0, -1.0, 0.0]) for p in model.map_from_image])
    tilt_deg = float(np.degrees(np.arccos(np.clip(np.median(ups[:, 2]), -1.0, 1.0))))
    verdict: Literal["pass", "warn"] = "pass" if tilt_deg < _MAX_TILT_DEG else "warn"
    doubts = [] if verdict == "pass" else [f"the cameras' up is {tilt_deg:.0f} deg off the map's: check --up"]
    return Alignment(similarity, "known", 0, 0, 0.0, 0.0, 0.0, 0.0, verdict, gravity_from="known"), doubts


def _walk(folder: Path, model: Model, images: Path | None, options: FrameOptions) -> MapSource:
    """Return the model's images as if a map were to be built from them."""
    poses: dict[str, Pose] = {}
    if options.poses is not None:
        poses = match_names(read_tum(options.poses), model.image_names)
        if len(poses) < MIN_POSES:
            raise MapError(
                f"{options.poses}: names {len(poses)} of the model's {len(model.image_names)} images; expected at "
                f"least {MIN_POSES}",
                hint="give each pose the name of its image, or the stamp by which the image is named",
            )
    found = _images(model, images, poses)
    if options.depth is None:
        return MapSource(folder, tuple(found), None, ())
    if options.depth_camera is None:
        raise MapError(f"{options.depth}: no depth camera; expected its calibration", hint="give --depth-camera")
    frames = []
    for i, image in enumerate(found):
        path = PurePosixPath(image.name)
        files = (options.depth / path.with_suffix(".png"), options.depth / f"{path.stem}.png")
        frames += [DepthFrame(f, ((i, Pose.identity()),)) for f in files if f.is_file()][:1]
    if not frames:
        raise MapError(
            f"{options.depth}: no depth image of the model's images; expected <name>.png", hint="check --depth"
        )
    return MapSource(folder, tuple(found), read_camera(options.depth_camera), tuple(frames))


def posed_walk(folder: Path, model: Model, images: Path) -> MapSource:
    """Return the model's images with its own poses, as if a map were to be built from them."""
    poses = dict(zip(model.image_names, model.map_from_image, strict=True))
    return MapSource(folder, tuple(_images(model, images, poses)), None, ())


def _images(model: Model, images: Path | None, poses: Mapping[str, Pose]) -> list[SourceImage]:
    found = []
    for name, camera in zip(model.image_names, model.image_cameras, strict=True):
        path = PurePosixPath(name)
        file = Path(name) if images is None else images / name
        found.append(SourceImage(name, file, camera, path.parent.as_posix(), path.stem, poses.get(name)))
    return found
