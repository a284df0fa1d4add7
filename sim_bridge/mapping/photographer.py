"""Photos of the tags and their surroundings, taken by a person with a good camera, as the field guide asks."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from fieldkit.cameras import Camera
from fieldkit.frames import Pose
from sim_bridge.aim import look_at
from sim_bridge.errors import SynthesisError
from sim_bridge.mesh import Scene
from sim_bridge.rendering import render
from sim_bridge.sensors import ColourSensor, Motion, bent, encode, expose
from sim_bridge.sensors.models import DSLR
from sim_bridge.stage.staging import PlacedTag, Stage, clear_around, richness, sees, slant

Array = NDArray[np.float64]

# 12 megapixels, 69 deg wide; the distortion is that of the sensor's lens.
PHOTO_CAMERA = Camera("PINHOLE", 4000, 3000, (2905.4, 2903.1, 2012.3, 1489.6))
CAMERA_FILE = "camera.toml"
# Viewpoints that are proposed in each sector before a tag.
TRIES = 16


@dataclasses.dataclass(frozen=True)
class PhotoOptions:
    """How many photos are taken, and from where."""

    start_photos: int = 8
    tripod_photos: int = 6
    distance_m: tuple[float, float] = (0.8, 2.2)
    height_m: tuple[float, float] = (1.1, 1.7)
    slant_deg: float = 50.0
    shake_deg_s: float = 1.0
    scale: float = 1.0


@dataclasses.dataclass(frozen=True)
class Photo:
    """A photo to take: its file name, the tag it is of, and the camera's pose."""

    file: str
    tag: PlacedTag
    world_from_cam: Pose


def camera(options: PhotoOptions, sensor: ColourSensor = DSLR) -> Camera:
    """Return the calibrated camera of the photos."""
    return bent(PHOTO_CAMERA if options.scale == 1.0 else PHOTO_CAMERA.scaled(options.scale), sensor)


def plan_photos(
    stage: Stage, options: PhotoOptions, *, rng: np.random.Generator, sensor: ColourSensor = DSLR
) -> tuple[Photo, ...]:
    """Choose the viewpoints of all photos; raises SynthesisError where too few places see a tag."""
    photos, taken = [], camera(options, sensor)
    for tag in stage.tags:
        name = f"start{tag.id}" if tag.visit is None else tag.visit
        count = options.start_photos if tag.visit is None else options.tripod_photos
        poses = _viewpoints(stage.scene, tag, count, options, taken=taken, rng=rng)
        photos += [Photo(f"{name}_{k + 1:02d}.jpg", tag, pose) for k, pose in enumerate(poses)]
    return tuple(photos)


def photos(
    scene: Scene,
    planned: tuple[Photo, ...],
    options: PhotoOptions,
    *,
    rng: np.random.Generator,
    sensor: ColourSensor = DSLR,
) -> Iterator[tuple[Photo, bytes]]:
    """Render the photos: yield each with its JPEG file. Hands shake a little."""
    taken = camera(options, sensor)
    for photo in planned:
        shake = np.radians(options.shake_deg_s) * rng.standard_normal(3)
        image = render(scene, taken, photo.world_from_cam).rgb
        shot = expose(image, sensor, camera=taken, motion=Motion(shake, np.zeros(3)), rng=rng)
        yield photo, encode(shot, sensor)


def _viewpoints(
    scene: Scene, tag: PlacedTag, count: int, options: PhotoOptions, *, taken: Camera, rng: np.random.Generator
) -> list[Pose]:
    """Choose viewpoints from left to right of a tag; in each sector the one that shows most of the surroundings."""
    edges = np.linspace(-options.slant_deg, options.slant_deg, count + 1)
    sectors: list[list[tuple[int, Pose]]] = []
    for sector in itertools.pairwise(edges):
        found = [_try(scene, tag, sector, options, taken=taken, rng=rng) for _ in range(TRIES)]
        shown = [(richness(scene, pose), pose) for pose in found if pose is not None]
        sectors.append(sorted(shown, key=lambda item: -item[0]))
    # A sector that furniture blocks, or that shows a bare wall, leaves its photo to the others.
    enough = 0.4 * max((sector[0][0] for sector in sectors if sector), default=0)
    ranked = [sector[rank] for rank in range(TRIES) for sector in sectors if rank < len(sector)]
    ranked.sort(key=lambda item: item[0] < enough)
    chosen = [pose for _, pose in ranked[:count]]
    if len(chosen) < count:
        raise SynthesisError(
            f"only {len(chosen)} places from which tag {tag.id} can be photographed; expected {count}",
            hint="use another seed, or in a mesh of your own fewer waypoints or more bare wall",
        )
    return chosen


def _try(
    scene: Scene,
    tag: PlacedTag,
    sector_deg: tuple[float, float],
    options: PhotoOptions,
    *,
    taken: Camera,
    rng: np.random.Generator,
) -> Pose | None:
    """Propose a viewpoint in a sector, the tag somewhere in the picture; None when it does not work."""
    angle, distance = np.radians(rng.uniform(*sector_deg)), rng.uniform(*options.distance_m)
    height, roll = rng.uniform(*options.height_m), np.radians(rng.normal(0.0, 3.0))
    aside, up = rng.uniform(-0.35, 0.35) * distance, rng.uniform(-0.05, 0.3) * distance
    rise = height - tag.world_from_tag.translation[2]
    flat = np.sqrt(max(distance**2 - rise**2, 0.0))
    if flat < 0.4:
        return None
    normal = tag.world_from_tag.rotation.apply([0.0, 0.0, 1.0])
    yaw = np.arctan2(normal[1], normal[0]) + angle
    at = tag.world_from_tag.translation + [flat * np.cos(yaw), flat * np.sin(yaw), rise]
    if not scene.free_floor(at[:2], 0.2)[0]:
        return None
    across = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    pose = look_at(at, tag.world_from_tag.translation + aside * across + [0.0, 0.0, up], roll_rad=float(roll))
    margin = 0.06 * taken.height
    if slant(pose, tag) > np.radians(options.slant_deg + 8.0) or not sees(scene, pose, taken, tag, margin_px=margin):
        return None
    return pose if clear_around(scene, pose.translation, radius_m=0.2) else None
