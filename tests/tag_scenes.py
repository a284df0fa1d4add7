"""Renders of tags with exact geometry, and a robot that stands in front of them."""

from __future__ import annotations

import dataclasses
import itertools
import math

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from fieldkit.cameras import Camera
from fieldkit.frames import Array, Pose, Trajectory, exp, yaw_pose
from fieldkit.tags import FAMILIES, draw_tag, tag_corners
from fieldkit.types import Frame, Image, Recording, Start, TagMap, TagPose, View, Visit

VGA = Camera("PINHOLE", 640, 480, (552.0, 552.0, 320.0, 240.0))
SIZE_M = 0.1365
# body x forward, y left, z up; cam z forward, x right, y down
FORWARD = Pose.from_components([0.3, 0.0, 0.5], Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]))


def render_tag(
    camera: Camera, cam_from_tag: Pose, *, tag_id: int = 2, size_m: float = SIZE_M, family: str = "tag36h11",
    samples: int = 6, noise: float = 0.0, blur_px: float = 0.0, rng: np.random.Generator | None = None,
    in_light: bool = False,
) -> Image:  # fmt: skip
    """Render a tag by tracing samples^2 rays per pixel through the camera model, distortion included.

    Pixels average and blur grey values; ``in_light``, as in a camera, the light that sRGB's grey values stand for.
    """
    layout = FAMILIES[family]
    border = max(1, (layout.total - layout.cells) // 2)
    texture = draw_tag(family, tag_id, cell_px=64, border_cells=border)
    half = size_m / 2 * len(texture) / (64 * layout.cells)
    shades = np.array([20.0, 170.0, 230.0])
    if in_light:
        shades = to_light(shades)
    image = np.full((camera.height, camera.width), shades[1])
    edge = cam_from_tag.apply(tag_corners(2 * half))
    pixels, _ = camera.project(edge)
    if np.isfinite(pixels).all():
        low = np.clip(np.floor(pixels.min(axis=0)) - 3, 0, (camera.width, camera.height)).astype(int)
        high = np.clip(np.ceil(pixels.max(axis=0)) + 3, 0, (camera.width, camera.height)).astype(int)
        if (high > low).all():
            image[low[1] : high[1], low[0] : high[0]] = _trace(
                camera, cam_from_tag, texture, half, low, high, samples, shades
            )
    if blur_px:
        image = cv2.GaussianBlur(image, (0, 0), blur_px)
    if in_light:
        image = to_grey(image)
    if rng is not None:
        image = image + rng.normal(0.0, noise, image.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def _trace(camera: Camera, cam_from_tag: Pose, texture: Image, half: float, low, high, samples: int, shades) -> Array:
    columns, rows = ((np.arange((high[i] - low[i]) * samples) + 0.5) / samples + low[i] for i in (0, 1))
    x, y = np.meshgrid(columns, rows)
    rotation, origin = cam_from_tag.rotation.as_matrix(), cam_from_tag.inv().translation
    rays = camera.unproject(np.column_stack([x.ravel(), y.ravel()])) @ rotation
    on_tag = origin + rays * (-origin[2] / rays[:, 2])[:, None]
    u, v = ((1 + s * on_tag[:, i] / half) / 2 * len(texture) for i, s in ((0, 1), (1, -1)))
    inside = (u >= 0) & (u < len(texture)) & (v >= 0) & (v < len(texture)) & (rays[:, 2] * -origin[2] > 0)
    values = np.full(len(u), shades[1])
    values[inside] = np.where(texture[v[inside].astype(int), u[inside].astype(int)] > 0, shades[2], shades[0])
    return values.reshape(len(rows) // samples, samples, len(columns) // samples, samples).mean(axis=(1, 3))


def look_at_tag(rng: np.random.Generator, *, camera: Camera = VGA, distance_m=(0.5, 1.2), slant_deg=(0, 60)) -> Pose:
    """Draw cam_from_tag of a tag that faces the camera at a slant, whole in the image."""
    axis, slant = rng.uniform(0, 2 * np.pi), math.radians(rng.uniform(*slant_deg))
    tilt = Rotation.from_rotvec([slant * np.cos(axis), slant * np.sin(axis), 0.0])
    facing = tilt * Rotation.from_rotvec([0, 0, rng.uniform(-0.5, 0.5)]) * Rotation.from_rotvec([np.pi, 0, 0])
    distance = rng.uniform(*distance_m)
    reach = np.array([camera.width, camera.height]) / 2 / camera.focal_px[0] - 0.6 * SIZE_M / distance - 0.03
    return Pose.from_components([*(rng.uniform(-1, 1, 2) * reach * distance), distance], facing)


@dataclasses.dataclass(frozen=True)
class Robot:
    """A robot that sees tags: its true poses, and the recording that it made."""

    recording: Recording
    tags: TagMap
    map_from_body_at_visit: Pose
    map_from_body_at_start: Pose

    @property
    def visit(self) -> Visit:
        return self.recording.visits[0]


MAP_FROM_START_TAG = Pose.from_components([1.6, 0.1, 0.6], Rotation.from_matrix([[0, 0, -1], [-1, 0, 0], [0, 1, 0]]))
START = yaw_pose([0.0, 0.0, 0.0], 0.1)
AT_VISIT = yaw_pose([3.0, 2.0, 0.0], 1.2)
BODY_FROM_TRIPOD_TAG = Pose.from_components(
    [1.35, 0.05, 0.55],
    Rotation.from_matrix([[0, 0, -1], [-1, 0, 0], [0, 1, 0]]) * Rotation.from_rotvec([0.1, 0.6, 0.05]),
)
SECOND = 1_000_000_000


def stand_and_look(
    *, rng: np.random.Generator, drift: float = 0.0, odom_from_map: Pose | None = None, tag_noise: float = 0.0
) -> Robot:
    """Make a session: stand at start tag 1 (2..4 s), walk (4..14 s), stand at a waypoint with tripod tag 2 (14..30 s).

    ``drift``: odometry's relative length error and yaw error in rad per m. The tag file has the tags' true poses, or
    poses perturbed by ``tag_noise`` (rad and m).
    """
    map_from_tripod = AT_VISIT * BODY_FROM_TRIPOD_TAG
    odometry = _odometry(drift, yaw_pose([5.0, -3.0, 0.0], 0.7) if odom_from_map is None else odom_from_map)

    def frame(t_ns: int, map_from_body: Pose, map_from_tag: Pose, tag_id: int, body_from_cam: Pose) -> Frame:
        cam_from_tag = (map_from_body * body_from_cam).inv() * map_from_tag
        seed = int(rng.integers(1 << 30))
        return Frame(
            t_ns,
            VGA,
            body_from_cam,
            lambda: render_tag(VGA, cam_from_tag, tag_id=tag_id, samples=4, noise=2.0, rng=np.random.default_rng(seed)),
        )

    def arm(yaw: float, pitch: float) -> Pose:
        return Pose.from_rotation(Rotation.from_euler("zy", [yaw, -pitch])) * FORWARD

    at_start = [
        frame(2 * SECOND + i * SECOND // 4, START, MAP_FROM_START_TAG, 1, arm(0.05 * i - 0.15, 0.0)) for i in range(6)
    ]
    aims = [(-0.3, 0.1), (0.2, -0.05), (0.0, 0.1), (0.1, 0.15), (-0.15, 0.0), (2.5, 0.0)]
    at_visit = [frame(15 * SECOND + i * SECOND, AT_VISIT, map_from_tripod, 2, arm(*aim)) for i, aim in enumerate(aims)]
    kinds = ("truth", "truth", "truth", "truth", "sweep", "sweep")
    views = tuple(View(f"{i:02d}", kind, f) for i, (kind, f) in enumerate(zip(kinds, at_visit, strict=True)))
    visit = Visit("w01", 14 * SECOND, 30 * SECOND, views, truth_tag_id=2)
    start = Start(1, 2 * SECOND, 4 * SECOND)
    recording = Recording("s", "s.mcap", "generic", (*at_start, *at_visit), odometry, (start,), (visit,))
    sigma = max(tag_noise, 1e-4)
    tags = tuple(
        TagPose(i, "tag36h11", SIZE_M, p * exp(rng.normal(0, 1, 6) * tag_noise), np.eye(6) * sigma**2, 6, 0.1, visit=v)
        for i, p, v in ((1, MAP_FROM_START_TAG, None), (2, map_from_tripod, "w01"))
    )
    return Robot(recording, TagMap(tags, (), "map", path="tags.toml"), AT_VISIT, START)


def _odometry(drift: float, odom_from_map: Pose) -> Trajectory:
    times = np.arange(0, 32 * SECOND, SECOND // 10, dtype=np.int64)
    along = np.clip((times / SECOND - 4) / 10, 0, 1)
    step = START.inv() * AT_VISIT
    twist = np.concatenate([step.rotation.as_rotvec(), step.translation])
    true = [START * exp(twist * s) for s in along]
    poses = [odom_from_map * true[0]]
    for before, after in itertools.pairwise(true):
        moved = before.inv() * after
        length = float(np.linalg.norm(moved.translation))
        stretched = Pose.from_components(moved.translation * (1 + drift), moved.rotation)
        poses.append(poses[-1] * stretched * exp([0, 0, drift * length, 0, 0, 0]))
    return Trajectory(times, tuple(poses), "odom", "body")


def look_from(rng: np.random.Generator, direction: Array, distance_m: float, *, camera: Camera = VGA) -> Pose:
    """Return cam_from_tag of a camera in a direction (3,) of the tag frame, at any roll, the tag whole in the image."""
    centre = np.asarray(direction) / np.linalg.norm(direction) * distance_m
    forward = -centre / distance_m
    side = np.cross(forward, rng.normal(size=3))
    side /= np.linalg.norm(side)
    axes = np.column_stack([side, np.cross(forward, side), forward])
    reach = np.array([camera.width, camera.height]) / 2 / camera.focal_px[0] - 0.7 * SIZE_M / distance_m - 0.05
    aside = Rotation.from_rotvec([*(rng.uniform(-0.7, 0.7, 2) * np.maximum(reach, 0.0)), 0.0])
    return Pose.from_components(centre, Rotation.from_matrix(axes) * aside).inv()


def slanted(rng: np.random.Generator, slant_deg: tuple[float, float]) -> Array:
    """Return a direction (3,) in the tag frame at an angle to the tag's normal."""
    slant, around = math.radians(rng.uniform(*slant_deg)), rng.uniform(0, 2 * np.pi)
    return np.array([np.sin(slant) * np.cos(around), np.sin(slant) * np.sin(around), np.cos(slant)])


def to_light(grey: Array) -> Array:
    """Return the light (0..1) of sRGB's grey values."""
    v = np.asarray(grey, dtype=np.float64) / 255
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


def to_grey(light: Array) -> Array:
    """Return sRGB's grey values of light (0..1)."""
    bright = 1.055 * np.clip(light, 0.0031308, None) ** (1 / 2.4) - 0.055
    return 255 * np.where(light <= 0.0031308, 12.92 * light, bright)
