"""Render a picture of every scene for the documentation: `python docs/examples/scene_pictures.py --out docs/scenes`."""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from fieldkit.cameras import Camera
from sim_bridge.aim import aim
from sim_bridge.rendering import render
from sim_bridge.scenes import SCENES, make_scene
from sim_bridge.stage.paths import floor_graph

CAMERA = Camera("PINHOLE", 960, 640, (620.0, 620.0, 480.0, 320.0))
EYE_M = 1.55
TRIALS = 150


def picture(name: str, seed: int) -> np.ndarray:
    """Return the view, of many from free floor, that shows the most: far, and full of corners, all over the image."""
    scene, rng = make_scene(name, seed), np.random.default_rng(seed)
    spots = floor_graph(scene, 0.36).centres
    best, most = None, -1.0
    small = Camera("PINHOLE", 240, 160, tuple(p / 4 for p in CAMERA.params))
    for _ in range(TRIALS):
        x, y = spots[rng.integers(len(spots))]
        pose = aim([x, y, EYE_M], float(rng.uniform(-np.pi, np.pi)), pitch_rad=-0.12)
        look = render(scene, small, pose, samples=1)
        found = cv2.goodFeaturesToTrack(cv2.cvtColor(look.rgb, cv2.COLOR_RGB2GRAY), 400, 0.01, 3)
        cells = 0 if found is None else len(np.unique((found[:, 0] // 30).astype(int), axis=0))
        value = cells + 4.0 * float(np.percentile(look.depth_m, 60)) + 4.0 * float(np.percentile(look.depth_m, 15))
        if value > most:
            best, most = pose, value
    return render(scene, CAMERA, best).rgb


def main() -> None:
    """Write one JPEG per scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scenes", nargs="*", default=[name for name in SCENES if name != "room"])
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    for name in given.scenes:
        image = cv2.cvtColor(picture(name, given.seed), cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(given.out / f"{name}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 80])


if __name__ == "__main__":
    main()
