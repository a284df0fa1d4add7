"""What a tag's corners err by, and whether their stated noise is true, through rendered images: `make bench`.

Tags of 0.1365 m in a VGA camera (f 552), traced with 8x8 rays per pixel; 20 images per row. The normalised error
squared is per degree of freedom, with the noise that the image shows and with what is added for what no image shows.
The table is that of docs/detection.md. Nothing here passes or fails.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tag_scenes import SIZE_M, VGA, look_from, render_tag, slanted

from fieldkit.frames import Pose
from fieldkit.tags import DETECTORS, FAMILIES, detect, tag_corners
from fieldkit.tags.detect import UNSEEN_SIGMA_PX
from fieldkit.types import Image

COUNT = 20


@dataclasses.dataclass(frozen=True)
class Case:
    """How a tag is seen: distance, slant in degrees, grey noise, blur in pixels, and what a camera does to it."""

    distance_m: float
    slant_deg: tuple[float, float] = (0.0, 20.0)
    noise: float = 2.0
    blur_px: float = 0.7
    in_light: bool = True
    sharpened: bool = False
    jpeg: int | None = None

    def __str__(self) -> str:
        blur = f"{'light' if self.in_light else 'grey'} blurred {self.blur_px:g} px"
        words = [f"{self.distance_m:g} m", f"{self.slant_deg[0]:.0f}..{self.slant_deg[1]:.0f} deg"]
        words += [blur, f"noise {self.noise:g}"]
        return ", ".join(words + ["sharpened"] * self.sharpened + [f"JPEG {self.jpeg}"] * (self.jpeg is not None))

    def image(self, rng: np.random.Generator, cam_from_tag: Pose) -> Image:
        image = render_tag(
            VGA, cam_from_tag, samples=8, blur_px=self.blur_px, in_light=self.in_light,
            noise=0.0 if self.sharpened else self.noise, rng=rng,
        )  # fmt: skip
        if self.sharpened:
            fine = image.astype(np.float64)
            fine += 0.8 * (fine - cv2.GaussianBlur(fine, (0, 0), 1.0)) + rng.normal(0, self.noise, fine.shape)
            image = np.clip(np.round(fine), 0, 255).astype(np.uint8)
        if self.jpeg is not None:
            coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self.jpeg])[1]
            image = np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
        return image


CASES = (
    Case(0.5), Case(1.0), Case(2.0), Case(4.0),
    Case(0.5, (55.0, 72.0)), Case(1.0, (55.0, 72.0)), Case(2.0, (55.0, 72.0)),
    Case(1.0, noise=8.0), Case(3.0, noise=8.0), Case(1.0, blur_px=1.5), Case(2.0, blur_px=1.5),
    Case(1.0, in_light=False), Case(1.0, blur_px=0.0, in_light=False, noise=0.0), Case(2.0, blur_px=0.0, noise=2.0),
    Case(1.0, sharpened=True), Case(2.0, sharpened=True), Case(1.0, jpeg=60), Case(2.0, jpeg=60),
)  # fmt: skip


def line(case: Case) -> str:
    rng = np.random.default_rng(3)
    errors, coarse, sigmas, seen, stated, found = [], [], [], [], [], 0
    for _ in range(COUNT):
        cam_from_tag = look_from(rng, slanted(rng, case.slant_deg), case.distance_m)
        image = case.image(rng, cam_from_tag)
        exact = VGA.project(cam_from_tag.apply(tag_corners(SIZE_M)))[0]
        tags = [d for d in detect(image, VGA) if d.id == 2]
        raw = [t for t in DETECTORS["pupil"].find(image, FAMILIES["tag36h11"]) if t.id == 2]
        if not tags:
            continue
        found += 1
        error = (tags[0].corners_px - exact).ravel()
        errors.append(error)
        coarse.append((raw[0].corners_px - exact).ravel())
        sigmas.append(tags[0].sigma_px)
        image_alone = tags[0].noise_px - UNSEEN_SIGMA_PX**2 * np.eye(8)
        seen.append(error @ np.linalg.solve(image_alone, error) / 8)
        stated.append(error @ np.linalg.solve(tags[0].noise_px, error) / 8)
    cells = [
        str(case),
        f"{found}/{COUNT}",
        f"{np.sqrt(np.mean(np.square(coarse))):.3f}",
        f"{np.sqrt(np.mean(np.square(errors))):.3f}",
        f"{np.median(sigmas):.3f}",
        f"{np.median(seen):.2f}",
        f"{np.mean(seen):.2f}",
        f"{np.mean(stated):.2f}",
    ]
    return f"| {' | '.join(cells)} |"


@pytest.mark.benchmark(group="tags")
def test_corner_noise(benchmark: Any, capsys: pytest.CaptureFixture[str]) -> None:
    head = (
        "| tag | found | pupil's, px rms | fitted, px rms | stated sigma | NEES of the image's noise: median | mean |"
    )
    lines = benchmark.pedantic(lambda: [line(case) for case in CASES], rounds=1, iterations=1)
    with capsys.disabled():
        print("\n".join(["", f"{head} mean with {UNSEEN_SIGMA_PX} px added |", "|---" * 8 + "|", *lines]))  # noqa: T201
