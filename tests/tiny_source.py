"""A view source that is quick to map and to look at: a small room with patterned walls, without light or sensors."""

from __future__ import annotations

import dataclasses
import functools
import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from fieldkit.cameras import Camera
from fieldkit.dataset import DatasetRules, SourceView, SourceWaypoint, make_dataset
from fieldkit.errors import DatasetError
from fieldkit.frames import Pose, exp, yaw_pose
from fieldkit.store import digest, write_camera, write_tum
from fieldkit.types import Image
from sim_bridge.aim import aim, facing
from sim_bridge.mesh import Scene
from sim_bridge.rendering import render
from sim_bridge.scenes.blueprint import Builder
from sim_bridge.scenes.light import unlit

CAMERA = Camera("PINHOLE", 320, 240, (240.0, 240.0, 160.0, 120.0))
SIDES = (((2.0, 0.0), 180.0), ((-2.0, 0.0), 0.0), ((0.0, 1.6), 270.0), ((0.0, -1.6), 90.0))


@dataclasses.dataclass(frozen=True)
class TinySource:
    """A room of 4 x 3.2 m, mapped from a circle; ``fault`` fails in one of the ways in which sources fail."""

    name: str = "tiny"
    seed: int = 0
    count: int = 3
    views: int = 4
    noise: float = 2.0
    pause_s: float = 0.0
    fault: str = ""

    @property
    def mapping_key(self) -> str:
        return digest(repr((self.name, self.seed)))

    @property
    def views_key(self) -> str:
        return digest(repr((self.mapping_key, self.count, self.views, self.noise)))

    @functools.cached_property
    def _scene(self) -> Scene:
        rng = np.random.default_rng(self.seed)
        build = Builder()
        for (x, y), yaw_deg in SIDES:
            coarse = rng.integers(20, 235, (26, 42, 3), dtype=np.uint8)
            texture = build.texture(cv2.resize(coarse, None, fx=8, fy=8, interpolation=cv2.INTER_NEAREST))
            build.panel(wall_pose(x, y, yaw_deg), (4.0, 2.5), texture)
        floor = build.texture(np.full((1, 1, 3), 90, np.uint8))
        build.panel(Pose.from_components(np.zeros(3), Rotation.identity()), (4.0, 3.2), floor)
        return unlit(build.blueprint(floor_bounds=(-2.0, -1.6, 2.0, 1.6)))

    def write_mapping(self, folder: Path) -> Mapping[str, Pose]:
        true = {}
        for part in ("images", "depth"):
            (folder / part).mkdir()
        for k in range(16):
            angle = 2 * np.pi * k / 16
            world_from_cam = aim([np.cos(angle), 0.7 * np.sin(angle), 1.2], angle + np.pi - 0.3)
            seen = render(self._scene, CAMERA, world_from_cam, samples=1)
            cv2.imwrite(str(folder / "images" / f"{k:02d}.png"), cv2.cvtColor(seen.rgb, cv2.COLOR_RGB2GRAY))
            cv2.imwrite(str(folder / "depth" / f"{k:02d}.png"), np.rint(1000 * seen.depth_m).astype(np.uint16))
            true[f"{k:02d}.png"] = world_from_cam
        write_camera(folder / "camera.toml", CAMERA)
        write_camera(folder / "depth_camera.toml", CAMERA)
        write_tum(folder / "poses.txt", true.items())
        if self.fault == "no room":
            raise OSError(28, "No space left on device", str(folder / "images" / "23.png"))
        return true

    def waypoints(self) -> Sequence[SourceWaypoint]:
        if self.count > 20:
            raise DatasetError(f"20 places; expected at least {self.count}", hint="ask for fewer waypoints")
        rng = np.random.default_rng([self.seed, 1])
        sigmas = np.array([0.003, 0.003, 0.02, 0.05, 0.05, 0.01])
        result = []
        for k in range(self.count):
            body = yaw_pose([rng.uniform(-0.6, 0.6), rng.uniform(-0.4, 0.4), 0.5], rng.uniform(-3.0, 3.0))
            yaws = 2 * np.pi * (np.arange(self.views) + rng.random(self.views)) / self.views
            arms = [("stowed", 0.0), *((f"s{i}", yaw) for i, yaw in enumerate(yaws))]
            views = []
            for name, yaw in arms:
                hand = aim([0.2 * np.cos(yaw), 0.2 * np.sin(yaw), 0.5], float(yaw), pitch_rad=0.1)
                views.append(SourceView(name, "stowed" if name == "stowed" else "sweep", hand, body * hand))
            prior = body * exp(sigmas * rng.standard_normal(6)).inv()
            if self.fault == "twins":
                views.append(views[-1])
            following = f"w{(k + 1) % self.count}"
            result.append(
                SourceWaypoint(f"w{k}", body, prior, np.diag(sigmas**2), CAMERA, tuple(views), next=following)
            )
        return result

    def shoot(self, waypoint: SourceWaypoint, view: SourceView, *, repeat: int = 0) -> Image:
        time.sleep(self.pause_s)
        if self.fault == "death" and waypoint.id == "w1":
            os._exit(9)
        if self.fault == "defect" and waypoint.id == "w1":
            raise ZeroDivisionError("a defect of the source")
        rng = np.random.default_rng([repeat, *f"{waypoint.id}/{view.id}".encode()])
        image = cv2.cvtColor(render(self._scene, CAMERA, view.world_from_cam, samples=1).rgb, cv2.COLOR_RGB2GRAY)
        noisy = image + self.noise * rng.standard_normal(image.shape)
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


SOURCE = TinySource()
RULES = DatasetRules(repeats=2, repeat_share=0.4)


def make(out: Path, *sources: TinySource, workers: int = 1, force: bool = False, rules: DatasetRules = RULES) -> None:
    """Make a dataset of these sources, or of the one that has all the defaults."""
    make_dataset(sources or [SOURCE], out, described={"seed": 0}, rules=rules, workers=workers, force=force)


def content(folder: Path) -> dict[str, bytes]:
    """Return all files below a folder."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def wall_pose(x: float, y: float, yaw_deg: float) -> Pose:
    """Return world_from_quad of a wall of 2.5 m height at (x, y) that faces along a yaw."""
    return facing([x, y, 1.25], np.radians(yaw_deg))
