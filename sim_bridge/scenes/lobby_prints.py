"""Surfaces and prints of the lobby: uint8 RGB images of (height, width) pixels."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike

from sim_bridge.scenes import textures
from sim_bridge.scenes.office_prints import flecked, mosaic
from sim_bridge.scenes.textures import Rgb, colour, fractal, tinted, write_lines

Size = tuple[int, int]


def slats(rng: np.random.Generator, size: Size, *, base: ArrayLike, px_per_m: float, pitch_m: float = 0.12) -> Rgb:
    """Draw upright wooden slats, all alike, with dark gaps."""
    phase = (np.arange(size[1]) / (pitch_m * px_per_m)) % 1.0
    gap = -42.0 * np.exp(-(((phase - 0.5) / 0.09) ** 2))
    return tinted(base, (0.8 * fractal(rng, size, cell_px=size[0] / 2, octaves=2) + gap[None]).astype(np.float32))


def cladding(
    rng: np.random.Generator, size: Size, *, base: ArrayLike, px_per_m: float, panel_m: tuple[float, float]
) -> Rgb:
    """Draw a wall clad with equal panels of (width, height) in m, divided by thin joints."""
    image = 1.0 * fractal(rng, size, cell_px=size[0] / 2, octaves=2)
    for x in np.arange(0, size[1], panel_m[0] * px_per_m).astype(int):
        image[:, x : x + 2] = -26
    for y in np.arange(0, size[0], panel_m[1] * px_per_m).astype(int):
        image[size[0] - 1 - y - 1 : size[0] - 1 - y + 1] = -26
    return tinted(base, image)


def terrazzo(rng: np.random.Generator, size: Size, *, base: ArrayLike, px_per_m: float) -> Rgb:
    """Draw slabs of polished terrazzo of 0.6 m with chips of stone and thin joints."""
    height, width = size
    ground = tinted(base, 2.0 * fractal(rng, size, cell_px=0.8 * px_per_m, octaves=4))
    image = flecked(rng, ground, count=int(45 * height * width / px_per_m**2), px_per_m=px_per_m, contrast=16.0)
    for at in np.arange(0, max(size), 0.6 * px_per_m).astype(int):
        image[at : at + 1] = image[at : at + 1] // 8 * 7
        image[:, at : at + 1] = image[:, at : at + 1] // 8 * 7
    return image


def mat(size: Size) -> Rgb:
    """Draw a ribbed doormat."""
    ribs = np.where((np.arange(size[0]) // 3) % 2, 46, 58).astype(np.uint8)
    return np.repeat(np.repeat(ribs[:, None, None], size[1], axis=1), 3, axis=2)


def lift_door(size: Size) -> Rgb:
    """Draw two leaves of brushed steel."""
    height, width = size
    shine = 150 + 14 * np.sin(np.linspace(0, 2 * np.pi, width, endpoint=False))
    image = np.repeat(np.repeat(shine[None, :, None], height, axis=0), 3, axis=2)
    image[:, width // 2 - 1 : width // 2 + 1] = 52
    return image.astype(np.uint8)


def lift_panel(size: Size) -> Rgb:
    """Draw two buttons and a display on steel."""
    height, width = size
    image = np.full((height, width, 3), 126, np.uint8)
    for y in (0.5, 0.78):
        cv2.circle(image, (width // 2, int(y * height)), max(width // 5, 2), (228, 226, 210), -1, cv2.LINE_AA)
    image[int(0.08 * height) : int(0.28 * height), width // 5 : -width // 5] = (26, 30, 34)
    return image


def directory(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw a board that lists floors and firms."""
    height, width = size
    image = np.empty((height, width, 3), np.uint8)
    image[:] = colour(rng, low=30, high=90)
    rows = 9
    for i in range(rows):
        y0, y1 = height * i // rows + 3, height * (i + 1) // rows - 3
        number = image[y0:y1, 4 : width // 6]
        number[:] = colour(rng, low=90, high=230)
        scale = (y1 - y0) / 40
        cv2.putText(image, str(rows - i), (width // 18, y1 - (y1 - y0) // 4), 2, scale, (250, 250, 250), 2, cv2.LINE_AA)
        strip = np.full((y1 - y0, width - width // 6 - 12, 3), 232, np.uint8)
        write_lines(rng, strip, (4, 0, strip.shape[1] - 4, strip.shape[0]), line_px=max((y1 - y0) * 2 // 5, 9))
        image[y0:y1, width // 6 + 6 : width - 6] = strip
    return image


def logo(rng: np.random.Generator, size: Size, *, base: ArrayLike) -> Rgb:
    """Draw a firm's mark and its name on a plain ground."""
    height, width = size
    image = np.empty((height, width, 3), np.uint8)
    image[:] = np.asarray(base, np.uint8)
    middle, radius = (height // 2, height // 2), int(0.42 * height)
    for i in range(3):
        turn = int(rng.integers(0, 360))
        cv2.ellipse(image, middle, (radius - i * radius // 4,) * 2, turn, 0, 250, colour(rng), radius // 6, cv2.LINE_AA)
    letters = rng.choice(list("ABDEGKLMNORSTU"), 6)
    text = f"{''.join(letters[:3])}-{''.join(letters[3:])}"
    spot = (int(1.15 * height), int(0.66 * height))
    cv2.putText(
        image, text, spot, cv2.FONT_HERSHEY_TRIPLEX, height / 62, (70, 74, 80), max(2, height // 30), cv2.LINE_AA
    )
    return image


def painting(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw a large picture of bent bands of colour, with few fine marks."""
    height, width = size
    field = fractal(rng, size, cell_px=max(size) / 2.5, octaves=2) + np.linspace(-1.2, 1.2, width)[None]
    bands = np.clip(((field + 2.5) * 2.4).astype(int), 0, 13)
    palette = np.array([colour(rng, low=50, high=235) for _ in range(14)], np.uint8)
    image = np.ascontiguousarray(palette[bands])
    for _ in range(14):
        spot = (int(rng.uniform(0, width)), int(rng.uniform(0, height)))
        cv2.circle(image, spot, int(rng.uniform(0.01, 0.05) * height), colour(rng), -1, cv2.LINE_AA)
    return image


def banner(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw a long banner: a mark at its top, a picture, a few large words."""
    height, width = size
    image = np.empty((height, width, 3), np.uint8)
    image[:] = colour(rng, low=90, high=240)
    top = int(height * rng.uniform(0.25, 0.35))
    disc = (width // 2, top // 2)
    for i in range(4):
        cv2.circle(image, disc, int(0.42 * top * (1 - i / 4)), colour(rng), -1, cv2.LINE_AA)
    kind = textures.photo if rng.random() < 0.4 else mosaic
    picture = kind(rng, (int(0.4 * height), width))
    image[top : top + len(picture)] = picture
    box = (width // 14, top + len(picture), width - width // 14, height - 4)
    write_lines(rng, image, box, line_px=max(height // 22, 9))
    return image


def leaflets(rng: np.random.Generator, size: Size, *, cols: int) -> Rgb:
    """Draw a row of leaflets in a rack."""
    height, width = size
    image = np.full((height, width, 3), 60, np.uint8)
    for i in range(cols):
        x0, x1 = width * i // cols + 2, width * (i + 1) // cols - 2
        top = int(height * rng.uniform(0.02, 0.15))
        kind = textures.photo if rng.random() < 0.5 else textures.shapes
        sheet = kind(rng, (height - top, x1 - x0))
        band = max((height - top) // 4, 10)
        sheet[:band] = colour(rng, low=120, high=240)
        write_lines(rng, sheet, (2, 0, x1 - x0 - 2, band), line_px=max(band // 2, 9))
        image[top:, x0:x1] = sheet
    return image


def street(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw what one sees through a glazed front by day: pale, with few soft edges."""
    height, width = size
    fade = np.linspace(250, 226, height, dtype=np.float32)[:, None] + 1.5 * fractal(rng, size, cell_px=width / 2)
    x = 0
    while x < width:
        step, top = int(width * rng.uniform(0.2, 0.4)), int(height * rng.uniform(0.3, 0.55))
        fade[top:, x : x + step] = rng.uniform(205, 225)
        x += step
    fade[int(0.86 * height) :] = 198
    return tinted((0.0, 1.0, 3.0), fade.astype(np.float32))
