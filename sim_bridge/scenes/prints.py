"""What pictures are drawn with: colours by hue, words that can be spoken, fitted text, plain and striped surfaces."""

from __future__ import annotations

import colorsys

import cv2
import numpy as np
from numpy.typing import ArrayLike

from sim_bridge.scenes.textures import Rgb, fractal, tinted, to_bytes

Ink = tuple[int, int, int]

_ONSETS = ("b", "br", "c", "d", "f", "fl", "g", "h", "k", "kr", "l", "m", "n", "p", "r", "s", "st", "t", "tr", "v", "z")
_VOWELS = ("a", "e", "i", "o", "u", "ai", "ou", "y")
_CODAS = ("", "", "l", "n", "r", "s", "x", "m", "t")
FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX, cv2.FONT_HERSHEY_TRIPLEX)


def hue(
    rng: np.random.Generator,
    *,
    strong: tuple[float, float] = (0.5, 0.95),
    bright: tuple[float, float] = (0.35, 0.95),
) -> Ink:
    """Draw a colour of any hue, of a saturation and a brightness between limits."""
    r, g, b = colorsys.hsv_to_rgb(float(rng.random()), float(rng.uniform(*strong)), float(rng.uniform(*bright)))
    return int(255 * r), int(255 * g), int(255 * b)


def word(rng: np.random.Generator, *, syllables: int = 2) -> str:
    """Draw a word that could be spoken, in capitals."""
    parts = [f"{rng.choice(_ONSETS)}{rng.choice(_VOWELS)}{rng.choice(_CODAS)}" for _ in range(syllables)]
    return "".join(parts).upper()


def sheet(size: tuple[int, int], rgb: ArrayLike) -> Rgb:
    """Return an image (height, width) of one colour."""
    image = np.empty((*size, 3), np.uint8)
    image[:] = np.clip(np.asarray(rgb), 0, 255).astype(np.uint8)
    return image


def lettering(
    image: Rgb, text: str, box: tuple[int, int, int, int], *, ink: Ink, font: int = FONTS[1], weight: float = 1.0
) -> None:
    """Write text as large as fits into a box (x0, y0, x1, y1), in its middle; stroke width follows the size."""
    x0, y0, x1, y1 = box
    (wide, high), _ = cv2.getTextSize(text, font, 1.0, 2)
    scale = min((x1 - x0) / max(wide, 1), 0.8 * (y1 - y0) / max(high, 1))
    thick = max(1, round(2.2 * scale * weight))
    (wide, high), _ = cv2.getTextSize(text, font, scale, thick)
    spot = ((x0 + x1 - wide) // 2, (y0 + y1 + high) // 2)
    cv2.putText(image, text, spot, font, scale, ink, thick, cv2.LINE_AA)


def lines(rng: np.random.Generator, image: Rgb, box: tuple[int, int, int, int], *, line_px: int, ink: Ink) -> None:
    """Fill a box with lines of small words, ragged on the right."""
    x0, y0, x1, y1 = box
    scale = line_px / 34
    thick = max(1, line_px // 14)
    for y in range(y0 + line_px, y1, int(1.5 * line_px)):
        x, stop = x0, x0 + (x1 - x0) * rng.uniform(0.55, 1.0)
        while x < stop:
            text = word(rng, syllables=int(rng.integers(1, 4))).lower()
            (wide, _), _ = cv2.getTextSize(text, FONTS[0], scale, thick)
            if x + wide > x1:
                break
            cv2.putText(image, text, (x, y), FONTS[0], scale, ink, thick, cv2.LINE_AA)
            x += wide + line_px // 2


def burst(image: Rgb, centre: tuple[int, int], radius: float, *, ink: Ink, points: int = 14) -> None:
    """Draw a star of many points."""
    angle = np.arange(2 * points) * np.pi / points
    reach = radius * np.where(np.arange(2 * points) % 2, 0.78, 1.0)
    outline = np.asarray(centre) + reach[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    cv2.fillPoly(image, [outline.astype(np.int32)], ink, cv2.LINE_AA)


def blob(rng: np.random.Generator, image: Rgb, centre: tuple[float, float], radius: float, *, ink: Ink) -> None:
    """Draw a rounded irregular form."""
    angle = np.arange(24) * np.pi / 12
    reach = np.ones(24)
    for k in (2, 3, 5):
        reach += rng.normal(0, 0.35 / k) * np.cos(k * angle + rng.uniform(0, 6.3))
    outline = np.asarray(centre) + radius * reach[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    cv2.fillPoly(image, [outline.astype(np.int32)], ink, cv2.LINE_AA)


def framed(image: Rgb, *, ink: Ink, px: int) -> Rgb:
    """Draw a border of some pixels around an image, in place, and return it."""
    height, width = image.shape[:2]
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), ink, 2 * px)
    return image


def blank(rng: np.random.Generator, size_m: tuple[float, float], *, base: ArrayLike, px_per_m: int = 100) -> Rgb:
    """Draw a painted wall of (width, height) in m: one colour that drifts by a grey level or two over metres."""
    size = (max(int(size_m[1] * px_per_m), 1), max(int(size_m[0] * px_per_m), 1))
    return tinted(base, 1.0 * fractal(rng, size, cell_px=1.6 * px_per_m, octaves=2))


def banded(image: Rgb, size_m: tuple[float, float], bands: list[tuple[float, float, Ink]]) -> Rgb:
    """Paint horizontal bands (from, to) in m above the floor onto a wall, in place."""
    height = image.shape[0]
    per_m = height / size_m[1]
    for low, high, ink in bands:
        image[max(int(height - high * per_m), 0) : int(height - low * per_m)] = ink
    return image


def upright_stripes(image: Rgb, *, period_px: float, change: float) -> Rgb:
    """Return an image with soft upright stripes: brightness swings by ``change`` grey levels."""
    x = np.arange(image.shape[1], dtype=np.float32)
    wave = change * np.clip(3 * np.sin(2 * np.pi * x / period_px), -1, 1)
    return to_bytes(image + wave[None, :, None])


def tiled(
    rng: np.random.Generator,
    size_m: tuple[float, float],
    *,
    tile_m: float,
    base: ArrayLike,
    joint: ArrayLike,
    spread: float = 2.0,
    px_per_m: int = 150,
) -> Rgb:
    """Draw a floor (width, depth) of square tiles that differ by a few grey levels, with joints and faint wear."""
    size = (int(size_m[1] * px_per_m), int(size_m[0] * px_per_m))
    step = tile_m * px_per_m
    rows, cols = (np.arange(n) / step for n in size)
    tones = rng.normal(0, spread, (int(rows[-1]) + 1, int(cols[-1]) + 1)).astype(np.float32)
    change = tones[rows.astype(int)[:, None], cols.astype(int)[None]]
    change = change + 2.0 * fractal(rng, size, cell_px=0.8 * px_per_m, octaves=4)
    image = tinted(base, change)
    for y in np.arange(step, size[0], step).astype(int):
        image[y : y + 1] = joint
    for x in np.arange(step, size[1], step).astype(int):
        image[:, x : x + 1] = joint
    return image


def ceiling_grid(size_m: tuple[float, float], *, base: ArrayLike, step_m: float, px_per_m: int = 60) -> Rgb:
    """Draw a ceiling (width, depth) of one colour with a faint repeated grid."""
    image = sheet((int(size_m[1] * px_per_m), int(size_m[0] * px_per_m)), base)
    dark = np.clip(np.asarray(base) - 16, 0, 255).astype(np.uint8)
    for y in np.arange(0, image.shape[0], step_m * px_per_m).astype(int):
        image[y : y + 1] = dark
    for x in np.arange(0, image.shape[1], step_m * px_per_m).astype(int):
        image[:, x : x + 1] = dark
    return image


def columns(parts: list[Rgb], *, gap_px: int = 1, ink: Ink = (20, 20, 22)) -> Rgb:
    """Set images of one height beside each other with dark gaps."""
    height = parts[0].shape[0]
    gap = sheet((height, gap_px), ink)
    pieces: list[Rgb] = []
    for part in parts:
        pieces += [part, gap]
    return np.ascontiguousarray(np.concatenate(pieces[:-1], axis=1))
