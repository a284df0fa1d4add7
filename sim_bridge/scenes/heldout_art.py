"""Art of the test scenes: paintings, drawings of pupils, patterns on pots, banners; uint8 RGB, (height, width)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_bridge.scenes.heldout_prints import SLANTED, Ink, emblem, filled, ink, letter, paragraph, word
from sim_bridge.scenes.textures import fractal, tinted, to_bytes

Rgb = NDArray[np.uint8]


def painting(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw a painting of a random sort."""
    makers = (strokes, fields, landscape, portrait, still_life)
    return makers[int(rng.integers(len(makers)))](rng, size)


def strokes(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw an abstract of broad brush strokes over a ground."""
    height, width = size
    image = tinted(ink(rng, saturation=0.3, value=0.75), 12 * fractal(rng, size, cell_px=width / 4, octaves=5))
    palette = [ink(rng, saturation=0.75, value=0.6, spread=0.3) for _ in range(5)]
    for _ in range(int(rng.integers(25, 80))):
        start = rng.uniform(-0.1, 1.1, 2) * (width, height)
        angle = rng.uniform(0, 2 * np.pi) + np.linspace(0, rng.uniform(-2, 2), 12)
        step = rng.uniform(0.01, 0.05) * min(size)
        path = start + np.cumsum(step * np.stack([np.cos(angle), np.sin(angle)], 1), axis=0)
        thick = max(int(rng.uniform(0.01, 0.07) * min(size)), 2)
        rgb = palette[int(rng.integers(5))]
        cv2.polylines(image, [path.astype(np.int32)], False, rgb, thick, cv2.LINE_AA)
    return image


def fields(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw an abstract of rectangles between dark bars."""
    height, width = size
    image = filled(size, (236, 230, 214))
    xs = np.sort(rng.uniform(0, 1, int(rng.integers(3, 7)))) * width
    ys = np.sort(rng.uniform(0, 1, int(rng.integers(3, 7)))) * height
    for x0, x1 in zip([0.0, *xs], [*xs, width], strict=True):
        for y0, y1 in zip([0.0, *ys], [*ys, height], strict=True):
            if rng.random() < 0.55:
                image[int(y0) : int(y1), int(x0) : int(x1)] = ink(rng, saturation=0.7, value=0.7, spread=0.3)
    bar = max(int(0.018 * min(size)), 2)
    for x in xs:
        cv2.line(image, (int(x), 0), (int(x), height), (24, 24, 28), bar)
    for y in ys:
        cv2.line(image, (0, int(y)), (width, int(y)), (24, 24, 28), bar)
    return to_bytes(image + 5.0 * fractal(rng, size, cell_px=8, octaves=3)[..., None])


def landscape(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw hills one behind the other under a sky, with trees and sometimes water."""
    height, width = size
    fade = np.linspace(0, 1, height, dtype=np.float32)[:, None, None]
    sky, glow = np.array(ink(rng, saturation=0.45, value=0.7)), np.array(ink(rng, saturation=0.35, value=0.9))
    clouds = 16 * fractal(rng, size, cell_px=width / 3, octaves=5)[..., None]
    image = to_bytes((1 - fade) * sky + fade * glow + clouds)
    ridges = int(rng.integers(3, 6))
    for k in range(ridges):
        line = fractal(rng, (2, width), cell_px=width / rng.uniform(1.5, 5), octaves=6)[0]
        top = (0.3 + 0.6 * k / ridges + 0.07 * line) * height
        ground = np.arange(height)[:, None] > top[None, :]
        tone = ink(rng, saturation=0.4 + 0.3 * k / ridges, value=0.7 - 0.4 * k / ridges, spread=0.1)
        image[ground] = tinted(tone, 12 * fractal(rng, size, cell_px=width / 12, octaves=4))[ground]
        for _ in range(int(rng.integers(0, 9))):
            x = int(rng.integers(width))
            reach = int(rng.uniform(0.02, 0.06) * height * (1 + k))
            foot = int(top[x])
            cv2.line(image, (x, foot), (x, foot - reach), (60, 44, 34), max(reach // 8, 1))
            leaf = ink(rng, saturation=0.5, value=0.35, spread=0.15)
            cv2.ellipse(image, (x, foot - reach), (reach // 2, int(0.7 * reach)), 0, 0, 360, leaf, -1, cv2.LINE_AA)
    return image


def portrait(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw head and shoulders before a dark ground."""
    height, width = size
    dark = ink(rng, saturation=0.4, value=0.28, spread=0.12)
    image = tinted(dark, 14 * fractal(rng, size, cell_px=width / 3, octaves=5))
    x, y, r = rng.uniform(0.42, 0.58) * width, rng.uniform(0.34, 0.42) * height, 0.16 * min(size)
    skin = tuple(int(v) for v in np.array([226, 178, 146]) * rng.uniform(0.5, 1.05))

    def blob(dx: float, dy: float, rx: float, ry: float, rgb: tuple[int, ...]) -> None:
        centre, axes = (int(x + dx * r), int(y + dy * r)), (max(int(rx * r), 1), max(int(ry * r), 1))
        cv2.ellipse(image, centre, axes, 0, 0, 360, rgb, -1, cv2.LINE_AA)

    hair, coat = ink(rng, saturation=0.5, value=0.3), ink(rng, saturation=0.6, value=0.45)
    blob(0, 3.6, rng.uniform(1.9, 2.6), 2.2, coat)
    blob(0, -0.25, 1.12, rng.uniform(1.2, 1.7), hair)
    blob(0, 1.2, 0.4, 0.8, skin)
    blob(0, 0, 0.86, 1.12, skin)
    blob(0, 1.75, 0.75, 0.3, ink(rng, saturation=0.15, value=0.9))
    for side in (-1, 1):
        blob(0.34 * side, -0.1, 0.15, 0.08, (240, 236, 228))
        blob(0.34 * side, -0.1, 0.07, 0.07, (40, 30, 26))
        blob(0.34 * side, -0.32, 0.2, 0.05, hair)
    blob(0, 0.22, 0.1, 0.28, tuple(int(0.85 * v) for v in skin))
    blob(0, 0.62, 0.26, 0.07, (150, 60, 56))
    for k in range(int(rng.integers(3, 7))):
        blob(rng.uniform(-0.1, 0.1), 2.2 + 0.35 * k, 0.09, 0.09, (214, 188, 110))
    return to_bytes(image + 5.0 * fractal(rng, size, cell_px=5, octaves=2)[..., None])


def still_life(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw fruit and jars on a cloth."""
    height, width = size
    image = tinted(ink(rng, saturation=0.4, value=0.4), 13 * fractal(rng, size, cell_px=width / 2, octaves=5))
    edge = int(rng.uniform(0.55, 0.68) * height)
    cloth = ink(rng, saturation=0.25, value=0.75)
    image[edge:] = tinted(cloth, 12 * fractal(rng, (height - edge, width), cell_px=width / 5, octaves=3))
    for x in np.sort(rng.uniform(0.1, 0.9, int(rng.integers(3, 7)))) * width:
        foot = edge + rng.uniform(0.0, 0.2) * height
        tone = np.array(ink(rng, saturation=0.7, value=0.55))
        rx, ry = rng.uniform(0.04, 0.1) * width, rng.uniform(0.06, 0.24) * height
        for k in range(5):
            shade = tuple(int(min(v * (0.6 + 0.17 * k), 255)) for v in tone)
            centre = int(x - 0.09 * k * rx), int(foot - ry - 0.08 * k * ry)
            cv2.ellipse(image, centre, (int(rx * (1 - 0.2 * k)), int(ry * (1 - 0.2 * k))), 0, 0, 360, shade, -1)
        if ry > 0.14 * height:
            low, high = (int(x - 0.4 * rx), int(foot - 2.3 * ry)), (int(x + 0.4 * rx), int(foot - 1.8 * ry))
            cv2.rectangle(image, low, high, tuple(int(0.7 * v) for v in tone), -1)
    return image


def pupil_drawing(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw what a pupil draws with wax crayons: sun, houses, trees, people, flowers."""
    height, width = size
    image = filled(size, (247, 246, 240))
    thick = max(min(size) // 50, 2)
    ground = int(rng.uniform(0.72, 0.85) * height)
    _scribble(rng, image, (0, ground, width, height), (70, 160, 70), thick)
    if rng.random() < 0.6:
        _scribble(rng, image, (0, 0, width, int(0.12 * height)), (90, 150, 230), thick)
    sun = int(rng.uniform(0.1, 0.9) * width), int(rng.uniform(0.16, 0.25) * height)
    cv2.circle(image, sun, int(0.08 * height), (250, 200, 30), -1, cv2.LINE_AA)
    for x in rng.uniform(0.08, 0.85, int(rng.integers(2, 5))) * width:
        w, h = rng.uniform(0.1, 0.25) * width, rng.uniform(0.18, 0.4) * height
        wax = ink(rng, saturation=0.8, value=0.75)
        left, right, top = int(x), int(x + w), int(ground - h)
        kind = int(rng.integers(3))
        if kind == 0:
            _scribble(rng, image, (left, top, right, ground), wax, thick)
            roof = np.array([[left - 4, top], [(left + right) // 2, int(top - 0.5 * h)], [right + 4, top]])
            cv2.fillPoly(image, [roof], ink(rng, saturation=0.8, value=0.6), cv2.LINE_AA)
            door = (int(x + 0.4 * w), int(ground - 0.45 * h)), (int(x + 0.6 * w), ground)
            cv2.rectangle(image, *door, ink(rng, value=0.5), -1)
        elif kind == 1:
            cv2.line(image, (left, ground), (left, top), (110, 74, 46), 3 * thick)
            cv2.circle(image, (left, top), int(0.35 * h), (60, 150, 60), -1, cv2.LINE_AA)
            for spot in rng.normal(0, 0.16 * h, (6, 2)):
                cv2.circle(image, (int(left + spot[0]), int(top + spot[1])), 2 * thick, wax, -1, cv2.LINE_AA)
        else:
            cv2.circle(image, (left, top), int(0.12 * h), (240, 190, 160), -1, cv2.LINE_AA)
            cv2.line(image, (left, int(top + 0.12 * h)), (left, int(ground - 0.25 * h)), wax, 4 * thick)
            for side in (-1, 1):
                reach = int(left + side * 0.16 * h)
                cv2.line(image, (left, int(top + 0.3 * h)), (reach, int(top + 0.5 * h)), wax, thick, cv2.LINE_AA)
                cv2.line(image, (left, int(ground - 0.3 * h)), (reach, ground), (40, 40, 90), thick, cv2.LINE_AA)
    return image


def _scribble(rng: np.random.Generator, image: Rgb, box: tuple[int, int, int, int], rgb: Ink, thick: int) -> None:
    x0, y0, x1, y1 = box
    count = max((x1 - x0) // (2 * thick), 2)
    x = np.linspace(x0, x1, count) + rng.normal(0, thick, count)
    y = np.where(np.arange(count) % 2, y0, y1) + rng.normal(0, thick, count)
    cv2.polylines(image, [np.stack([x, y], 1).astype(np.int32)], False, rgb, 2 * thick, cv2.LINE_AA)


def glaze(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw the bands of ornament around a pot."""
    height, width = size
    dark, light = ink(rng, saturation=0.6, value=0.3), ink(rng, saturation=0.5, value=0.8, spread=0.1)
    image = tinted(light, 8 * fractal(rng, size, cell_px=width / 6, octaves=4))
    y = 0.0
    while y < height:
        tall = rng.uniform(0.06, 0.2) * height
        kind, count = int(rng.integers(4)), int(rng.integers(8, 24))
        for k in range(count):
            x, pitch = (k + 0.5) * width / count, width / count
            middle = (x, y + tall / 2)
            if kind == 0:
                cv2.circle(image, (int(middle[0]), int(middle[1])), int(0.3 * min(pitch, tall)), dark, -1)
            elif kind == 1:
                points = np.array([[x - pitch / 2, y + tall], [x, y + 0.1 * tall], [x + pitch / 2, y + tall]])
                cv2.fillPoly(image, [points.astype(np.int32)], dark, cv2.LINE_AA)
            elif kind == 2:
                cv2.rectangle(image, (int(x), int(y + 2)), (int(x + 0.5 * pitch), int(y + 0.9 * tall)), dark, -1)
        if kind == 3:
            image[int(y) : int(y + 0.8 * tall)] = dark
        y += tall * 1.1
    return image


def banner(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw the banner of an exhibition: a large picture, a title, dates and text."""
    height, width = size
    image = filled(size, ink(rng, saturation=0.65, value=0.5))
    edge = int(rng.uniform(0.4, 0.6) * height)
    image[:edge] = painting(rng, (edge, width))
    pale: Ink = (246, 240, 226)
    letter(image, word(rng).upper(), (0.06 * width, edge + 0.12 * height), 0.07 * height, pale, bold=4)
    letter(image, word(rng), (0.06 * width, edge + 0.2 * height), 0.045 * height, pale, font=SLANTED, bold=2)
    emblem(rng, image, (0.8 * width, edge + 0.15 * height), 0.1 * width, ink(rng, value=0.85))
    box = (0.06 * width, edge + 0.24 * height, 0.9 * width, 0.96 * height)
    paragraph(rng, image, box, line_px=20, rgb=pale)
    return image


def framed(image: Rgb, *, rim_px: int, rgb: ArrayLike) -> Rgb:
    """Return a picture with a bevelled rim around it."""
    height, width = image.shape[:2]
    result = np.empty((height + 2 * rim_px, width + 2 * rim_px, 3), np.uint8)
    result[:] = np.asarray(rgb)
    cv2.rectangle(result, (0, 0), (result.shape[1] - 1, result.shape[0] - 1), (40, 32, 24), max(rim_px // 6, 1))
    inner = (rim_px - 2, rim_px - 2), (width + rim_px + 1, height + rim_px + 1)
    cv2.rectangle(result, *inner, (60, 48, 34), max(rim_px // 5, 2))
    result[rim_px:-rim_px, rim_px:-rim_px] = image
    return result
