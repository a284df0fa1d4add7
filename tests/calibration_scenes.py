"""Simulated photos of tags: cameras, landmarks with the map's errors, and the residuals that they leave."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from scipy.spatial.transform import Rotation

from fieldkit.calibrate.adjustment import Corners, Landmarks, State
from fieldkit.calibrate.geometry import Poses, bearings
from fieldkit.calibrate.locating import LocatedPhoto
from fieldkit.cameras import Camera
from fieldkit.frames import Array, Pose, exp
from fieldkit.tags import TagDetection, tag_corners

PHOTO = Camera("OPENCV", 1600, 1200, (1300.0, 1295.0, 805.0, 598.0, -0.05, 0.02, 0.001, -0.001))
SIZE_M = 0.1365
CORNER_PX = 0.4
# The tag hangs on a wall in the map's x-z plane and faces -y
MAP_FROM_TAG = Pose.from_components([2.0, 1.0, 1.2], Rotation.from_euler("x", 90, degrees=True))


@dataclasses.dataclass(frozen=True)
class Scene:
    """True poses, what the map says about its landmarks, and the photos as localization would hand them over."""

    map_from_tags: tuple[Pose, ...]
    map_from_cams: tuple[Pose, ...]
    xyz_true: Array
    xyz: Array
    covariance: Array
    photos: tuple[LocatedPhoto, ...]

    def joint(self) -> tuple[Landmarks, Corners, State]:
        """Return the joint problem of all photos and tags, and the true state."""
        landmarks = Landmarks.of([(p.landmark, p.bearings) for p in self.photos], self.xyz, self.covariance)
        sightings = [(i, d.id, p.camera, d) for i, p in enumerate(self.photos) for d in p.detections]
        sizes = np.full(len(self.map_from_tags), SIZE_M)
        state = State(Poses.of(self.map_from_cams), Poses.of(self.map_from_tags), sizes)
        return landmarks, Corners.of(sightings), state


def aim(rng: np.random.Generator, *, spread_deg: float = 45.0) -> Pose:
    """Draw map_from_cam of a photo of the first tag from 1.2 to 2.2 m, the tag somewhere about its middle."""
    yaw, pitch = np.radians(rng.uniform(-spread_deg, spread_deg)), np.radians(rng.uniform(-20, 20))
    direction = Rotation.from_euler("yx", [yaw, pitch]).apply([0.0, 0.0, 1.0])
    centre = direction * rng.uniform(1.2, 2.2)
    forward = np.array([*rng.uniform(-0.3, 0.3, 2), 0.0]) - centre
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    tag_from_cam = Pose.from_components(
        centre, Rotation.from_matrix(np.column_stack([right, np.cross(forward, right), forward]))
    )
    return MAP_FROM_TAG * tag_from_cam * exp([0, 0, rng.uniform(-0.3, 0.3), 0, 0, 0])


def photograph(
    rng: np.random.Generator,
    *,
    n_photos: int = 8,
    n_landmarks: int = 90,
    map_sigma_m: float = 0.005,
    shared: bool = True,
    tags: tuple[Pose, ...] = (MAP_FROM_TAG,),
    warp_m: float = 0.0,
    corner_px: float = CORNER_PX,
) -> Scene:
    """Photograph tags: every photo sees ``n_landmarks``, from a cloud of three times as many where they are shared.

    ``warp_m`` displaces all landmarks of a photo together, which the map's covariance does not tell. Corners have
    noise of ``corner_px`` (root mean square), correlated.
    """
    cams = tuple(aim(rng) for _ in range(n_photos))
    count = 3 * n_landmarks if shared else n_landmarks * n_photos
    cloud = MAP_FROM_TAG.apply(
        np.column_stack([rng.uniform(-1.6, 1.6, count), rng.uniform(-1.1, 1.1, count), rng.uniform(-0.1, 0.5, count)])
    )
    covariance = np.tile(np.eye(3) * map_sigma_m**2, (count, 1, 1))
    xyz = cloud + rng.normal(0, map_sigma_m, cloud.shape)
    photos = []
    for i, map_from_cam in enumerate(cams):
        rows = np.arange(count) if shared else np.arange(i * n_landmarks, (i + 1) * n_landmarks)
        seen = cloud + rng.normal(0, warp_m, 3) if warp_m else cloud
        photos.append(
            _photo(
                rng,
                f"{i}.jpg",
                map_from_cam,
                seen,
                rows,
                n_landmarks,
                tuple(map_from_cam.inv() * t for t in tags),
                corner_px,
            )
        )
    return Scene(tags, cams, cloud, xyz, covariance, tuple(photos))


def _photo(
    rng: np.random.Generator,
    file: str,
    map_from_cam: Pose,
    cloud: Array,
    rows: Array,
    n_landmarks: int,
    cam_from_tags: tuple[Pose, ...],
    corner_px: float,
) -> LocatedPhoto:
    pixels, visible = PHOTO.project(map_from_cam.inv().apply(cloud[rows]))
    chosen = rng.permutation(np.flatnonzero(visible))[:n_landmarks]
    noisy = pixels[chosen] + rng.normal(0, 1.0, (len(chosen), 2))
    detections = []
    for tag_id, cam_from_tag in enumerate(cam_from_tags):
        corners = PHOTO.project(cam_from_tag.apply(tag_corners(SIZE_M)))[0]
        noise = corner_noise(rng, corner_px)
        detections.append(TagDetection(tag_id, "tag36h11", drawn(rng, corners, noise), corner_px, noise))
    start = map_from_cam * exp(rng.normal(0, [0.002] * 3 + [0.005] * 3))
    return LocatedPhoto(file, None, PHOTO, start, rows[chosen], bearings(PHOTO, noisy, 1.0), tuple(detections))


def corner_noise(rng: np.random.Generator, corner_px: float) -> Array:
    """Draw a covariance f64[8, 8] of corners: of ``corner_px`` (root mean square), unequal and correlated."""
    root = np.eye(8) + rng.normal(0, 0.2, (8, 8))
    covariance = root @ root.T
    return np.asarray(covariance * (8 * corner_px**2 / np.trace(covariance)))


def drawn(rng: np.random.Generator, corners: Array, noise: Array) -> Array:
    """Return corners (4, 2) with noise of covariance (8, 8)."""
    return corners + rng.multivariate_normal(np.zeros(8), noise, method="cholesky").reshape(4, 2)


def localize_wrongly(rng: np.random.Generator, scene: Scene, index: int, *, distance_m: float) -> LocatedPhoto:
    """Return a photo with its landmarks where a camera that stands elsewhere would see them; its tags as they are."""
    photo, true = scene.photos[index], scene.map_from_cams[index]
    while True:
        direction = rng.normal(size=3)
        wrong = true * exp([*rng.normal(0, math.radians(5), 3), *(direction / np.linalg.norm(direction) * distance_m)])
        pixels, visible = PHOTO.project(wrong.inv().apply(scene.xyz_true))
        rows = rng.permutation(np.flatnonzero(visible))[: len(photo.landmark)]
        if len(rows) >= 30:
            noisy = pixels[rows] + rng.normal(0, 1.0, (len(rows), 2))
            return dataclasses.replace(photo, map_from_cam=wrong, landmark=rows, bearings=bearings(PHOTO, noisy, 1.0))


def flip(rng: np.random.Generator, scene: Scene, index: int) -> LocatedPhoto:
    """Return a photo whose corners show the tag tilted to the other side, as the other planar solution has it."""
    photo = scene.photos[index]
    cam_from_tag = scene.map_from_cams[index].inv() * scene.map_from_tags[0]
    ray = cam_from_tag.translation / np.linalg.norm(cam_from_tag.translation)
    normal = cam_from_tag.rotation.apply([0.0, 0.0, 1.0])
    mirrored = 2 * (normal @ ray) * ray - normal
    axis = np.cross(normal, mirrored)
    angle = math.atan2(float(np.linalg.norm(axis)), float(normal @ mirrored))
    turn = Rotation.from_rotvec(axis / max(float(np.linalg.norm(axis)), 1e-12) * angle)
    other = Pose.from_components(cam_from_tag.translation, turn * cam_from_tag.rotation)
    corners = drawn(rng, PHOTO.project(other.apply(tag_corners(SIZE_M)))[0], photo.detections[0].noise_px)
    flipped = dataclasses.replace(photo.detections[0], corners_px=corners)
    return dataclasses.replace(photo, detections=(flipped, *photo.detections[1:]))


def tilt_deg(scene: Scene, index: int) -> float:
    """Return the angle between the tag's normal and the ray from it to a photo's camera: 0 is frontal."""
    cam_in_tag = (scene.map_from_tags[0].inv() * scene.map_from_cams[index]).translation
    return math.degrees(math.acos(float(cam_in_tag[2] / np.linalg.norm(cam_in_tag))))
