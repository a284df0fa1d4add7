"""A synthetic map: landmarks on the walls of a room, seen by cameras that walk a circle; exact, or with noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fieldkit.cameras import Camera
from fieldkit.features import Features
from fieldkit.frames import Pose
from fieldkit.maps.io import AlignmentEntry, MapFile, SurfaceEntry, content_digest, write_features, write_map_file
from fieldkit.maps.landmarks import Model, landmark_covariance, model_from_arrays
from fieldkit.surface import write_ply
from fieldkit.types import SceneMap, Surface

CAMERA = Camera("OPENCV", 480, 640, (367.0, 366.0, 240.0, 320.0, -0.013, 0.012, 0.001, -0.002))


def looking(eye: np.ndarray, yaw: float, pitch: float = 0.0) -> Pose:
    """Return map_from_cam of a camera at ``eye`` that looks along yaw and pitch (rad, up positive)."""
    forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    rotation = np.column_stack([right, np.cross(forward, right), forward])
    return Pose.from_components(eye, Rotation.from_matrix(rotation))


def room_points(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return points (n, 3) on the four walls of a room of 6 x 4 x 2.5 m."""
    wall, along, up = rng.integers(0, 4, n), rng.uniform(-1, 1, n), rng.uniform(0, 2.5, n)
    x = np.where(wall == 0, 3.0, np.where(wall == 1, -3.0, 3.0 * along))
    y = np.where(wall == 2, 2.0, np.where(wall == 3, -2.0, 2.0 * along))
    return np.column_stack([x, y, up])


def make_map(
    rng: np.random.Generator, *, n_landmarks: int = 400, n_images: int = 24, noise_px: float = 0.0
) -> SceneMap:
    """Make a map in memory; descriptors are random per landmark, with a little noise per observation."""
    xyz = room_points(rng, n_landmarks)
    angles = np.linspace(0, 2 * np.pi, n_images, endpoint=False)
    poses = tuple(looking(np.array([np.cos(a), 0.7 * np.sin(a), 1.6]), a + 0.3) for a in angles)
    landmark, image, pixels = [], [], []
    for i, pose in enumerate(poses):
        projected, seen = CAMERA.project(pose.inv().apply(xyz))
        rows = np.flatnonzero(seen)
        landmark.append(rows)
        image.append(np.full(len(rows), i))
        pixels.append(projected[rows] + noise_px * rng.normal(size=(len(rows), 2)))
    owner = np.concatenate(landmark).astype(np.int32)
    observer = np.concatenate(image).astype(np.int32)
    base = rng.integers(0, 90, size=(n_landmarks, 128))
    descriptors = np.clip(base[owner] + rng.integers(-3, 4, size=(len(owner), 128)), 1, 255).astype(np.uint8)
    cameras = (CAMERA,) * n_images
    return SceneMap(
        path="synthetic",
        digest="synthetic",
        feature="sift",
        xyz=xyz,
        xyz_covariance=landmark_covariance(xyz, owner, observer, poses, cameras),
        image_names=tuple(f"lf/{i:06d}.jpg" for i in range(n_images)),
        image_cameras=cameras,
        map_from_image=poses,
        observation_landmark=owner,
        observation_image=observer,
        observation_px=np.concatenate(pixels).astype(np.float32),
        descriptors=descriptors,
        descriptor_landmark=owner,
        descriptor_image=observer,
        surface=None,
    )


def as_model(scene_map: SceneMap) -> Model:
    """Return the map's geometry as a Model whose images have exactly the observed keypoints."""
    first = np.searchsorted(scene_map.observation_image, scene_map.observation_image)
    return Model(
        scene_map.image_names,
        scene_map.image_cameras,
        scene_map.map_from_image,
        scene_map.xyz,
        np.arange(1, len(scene_map.xyz) + 1),
        scene_map.observation_landmark,
        scene_map.observation_image,
        (np.arange(len(first)) - first).astype(np.int32),
        scene_map.observation_px,
    )


def write_map(path: Path, scene_map: SceneMap, *, surface: Surface | None = None) -> None:
    """Write a map folder of a synthetic map in which every observation has a descriptor."""
    (path / "sparse").mkdir(parents=True)
    pixels, features, sizes = [], {}, {}
    for i, name in enumerate(scene_map.image_names):
        rows = scene_map.observation_image == i
        ones = np.ones(int(rows.sum()), dtype=np.float32)
        pixels.append(scene_map.observation_px[rows])
        features[name] = Features(scene_map.observation_px[rows], ones, ones, scene_map.descriptors[rows])
        sizes[name] = (scene_map.image_cameras[i].width, scene_map.image_cameras[i].height)
    model_from_arrays(as_model(scene_map), pixels).write_binary(path / "sparse")
    write_features(path / "features.h5", features, sizes)
    if surface is not None:
        write_ply(path / "surface.ply", surface)
    count = len(scene_map.image_names)
    entry = MapFile(
        version=1,
        digest=content_digest(path),
        feature="sift",
        n_images=count,
        n_registered=count,
        n_landmarks=len(scene_map.xyz),
        alignment=AlignmentEntry("known", 1.0, count, count, 0.0, 0.0, 0.0, "pass"),
        surface=None if surface is None else SurfaceEntry(surface.voxel_m, 0.14, "surface.ply"),
    )
    write_map_file(path, entry)
