"""A rendered mapping walk that is quick to map: the tiny source's room, with AprilTags on two of its walls."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from tiny_source import CAMERA, TinySource, wall_pose

from fieldkit.frames import Pose
from fieldkit.store import write_camera, write_tum
from fieldkit.tags import draw_tag
from fieldkit.types import Image
from sim_bridge.aim import aim
from sim_bridge.rendering import render

# Edge of the black square and of the whole print, whose margin is one cell of eight
TAG_M = 0.48
PRINT_M = TAG_M * 10 / 8


def view(world_from_cam: Pose) -> Image:
    """Return the grey image of the room without tags from a place."""
    seen = render(TinySource()._scene, CAMERA, world_from_cam, samples=4)
    return np.asarray(cv2.cvtColor(seen.rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def write_walk(folder: Path, *, n: int = 16, tags: bool = False) -> Mapping[str, Pose]:
    """Write a SOURCE with images, depth and true poses; return the poses by name."""
    scene = TinySource()._scene
    for tag_id, (x, y, yaw_deg) in enumerate(((1.98, 0.2, 180.0), (-1.98, 0.0, 0.0)) if tags else (), start=1):
        drawn = draw_tag("tag36h11", tag_id, cell_px=12, border_cells=1)
        scene = scene.with_quad(wall_pose(x, y, yaw_deg), PRINT_M, PRINT_M, drawn)
    true = {}
    for part in ("images", "depth"):
        (folder / part).mkdir(parents=True)
    for k in range(n):
        angle = 2 * np.pi * k / n
        world_from_cam = aim([np.cos(angle), 0.7 * np.sin(angle), 1.2], angle + np.pi - 0.3)
        seen = render(scene, CAMERA, world_from_cam, samples=4)
        cv2.imwrite(str(folder / "images" / f"{k:02d}.png"), cv2.cvtColor(seen.rgb, cv2.COLOR_RGB2GRAY))
        cv2.imwrite(str(folder / "depth" / f"{k:02d}.png"), np.rint(1000 * seen.depth_m).astype(np.uint16))
        true[f"{k:02d}.png"] = world_from_cam
    write_camera(folder / "camera.toml", CAMERA)
    write_camera(folder / "depth_camera.toml", CAMERA)
    write_tum(folder / "poses.txt", true.items())
    return true
