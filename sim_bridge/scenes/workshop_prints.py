"""What is painted, stencilled and hung in a workshop: uint8 RGB images of (height, width) pixels."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
from numpy.typing import ArrayLike

from sim_bridge.scenes import textures
from sim_bridge.scenes.prints import FONTS, burst, framed, hue, lettering, lines, sheet, word
from sim_bridge.scenes.textures import Rgb, fractal, tinted, to_bytes

Size = tuple[int, int]
Spot = tuple[int, int]

_STEEL = (172, 174, 178)


def _spanner(rng: np.random.Generator, image: Rgb, at: Spot, length: int) -> None:
    wide = max(length // 9, 3)
    cv2.line(image, at, (at[0], at[1] + length), _STEEL, wide, cv2.LINE_AA)
    for y in (at[1], at[1] + length):
        cv2.circle(image, (at[0], y), int(1.5 * wide), _STEEL, -1, cv2.LINE_AA)
        cv2.circle(image, (at[0], y), max(int(0.7 * wide), 1), (60, 62, 66), -1, cv2.LINE_AA)


def _hammer(rng: np.random.Generator, image: Rgb, at: Spot, length: int) -> None:
    wide = max(length // 10, 3)
    cv2.line(image, at, (at[0], at[1] + length), (168, 118, 66), wide, cv2.LINE_AA)
    half = int(length * 0.24)
    cv2.rectangle(image, (at[0] - half, at[1] - wide), (at[0] + half, at[1] + wide), (70, 72, 78), -1)
    cv2.rectangle(image, (at[0] - half, at[1] - wide), (at[0] - half // 2, at[1] + wide), _STEEL, -1)


def _driver(rng: np.random.Generator, image: Rgb, at: Spot, length: int) -> None:
    wide = max(length // 8, 4)
    cv2.line(image, at, (at[0], at[1] + length), _STEEL, max(wide // 3, 2), cv2.LINE_AA)
    cv2.line(image, at, (at[0], at[1] + int(0.4 * length)), hue(rng), wide, cv2.LINE_AA)


def _pliers(rng: np.random.Generator, image: Rgb, at: Spot, length: int) -> None:
    wide, ink = max(length // 10, 3), hue(rng)
    pivot = (at[0], at[1] + length // 3)
    for side in (-1, 1):
        cv2.line(image, pivot, (at[0] + side * length // 6, at[1] + length), ink, wide, cv2.LINE_AA)
        cv2.line(image, pivot, (at[0] - side * length // 18, at[1]), _STEEL, wide, cv2.LINE_AA)
    cv2.circle(image, pivot, wide, (80, 82, 86), -1, cv2.LINE_AA)


def _saw(rng: np.random.Generator, image: Rgb, at: Spot, length: int) -> None:
    x, y = at
    blade = [(x - length // 6, y), (x + length // 6, y), (x + length // 14, y + length), (x - length // 14, y + length)]
    cv2.fillPoly(image, [np.array(blade)], (186, 188, 192), cv2.LINE_AA)
    grip = hue(rng)
    cv2.rectangle(image, (x - length // 5, y - length // 5), (x + length // 5, y + length // 12), grip, -1)
    cv2.circle(image, (x, y - length // 16), max(length // 12, 2), (40, 40, 44), -1, cv2.LINE_AA)


def _square(rng: np.random.Generator, image: Rgb, at: Spot, length: int) -> None:
    wide, ink = max(length // 9, 3), ((206, 170, 60), (60, 62, 66), _STEEL)[int(rng.integers(3))]
    cv2.line(image, at, (at[0], at[1] + length), ink, wide, cv2.LINE_AA)
    cv2.line(image, at, (at[0] + length // 2, at[1]), ink, 2 * wide, cv2.LINE_AA)


def _reel(rng: np.random.Generator, image: Rgb, at: Spot, length: int) -> None:
    centre, radius = (at[0], at[1] + length // 3), length // 3
    cv2.circle(image, centre, radius, hue(rng), -1, cv2.LINE_AA)
    cv2.circle(image, centre, int(0.45 * radius), (36, 36, 40), -1, cv2.LINE_AA)


_TOOLS = (_spanner, _hammer, _driver, _pliers, _saw, _square, _reel)


def pegboard(rng: np.random.Generator, size: Size, *, base: ArrayLike, px_per_m: float) -> Rgb:
    """Draw a board of holes with tools in rows: spanners by size, hammers, pliers, saws, in any order."""
    height, width = size
    image = sheet(size, base)
    step = 0.05 * px_per_m
    dark = [int(v) for v in np.asarray(base) * 0.55]
    for x, y in itertools.product(np.arange(step / 2, width, step), np.arange(step / 2, height, step)):
        cv2.circle(image, (int(x), int(y)), max(int(0.004 * px_per_m), 1), dark, -1)
    y = 0.07 * px_per_m
    while y < height - 0.2 * px_per_m:
        row, x = float(rng.uniform(0.2, 0.34)) * px_per_m, 0.08 * px_per_m
        while x < width - 0.1 * px_per_m:
            tool = _TOOLS[int(rng.integers(len(_TOOLS)))]
            count = int(rng.integers(1, 6)) if tool in (_spanner, _driver) else 1
            for i in range(count):
                length = int(row * (0.85 - 0.09 * i))
                if x < width - 0.08 * px_per_m and rng.random() < 0.88:
                    tool(rng, image, (int(x), int(y + 0.05 * px_per_m)), length)
                x += row * (0.26 if count > 1 else 0.5)
            x += row * rng.uniform(0.05, 0.3)
        y += row + 0.05 * px_per_m
    return framed(image, ink=(84, 70, 56), px=3)


def drawing(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw a technical drawing: views of a part, circles, dimension lines, a title block; white or blue paper."""
    height, width = size
    blue = rng.random() < 0.4
    image = sheet(size, (32, 70, 140) if blue else (246, 246, 240))
    ink = (230, 236, 246) if blue else (28, 30, 40)
    thick = max(height // 110, 3)
    for i in range(4):
        x, y = (0.06 + 0.48 * (i % 2)) * width, (0.06 + 0.4 * (i // 2)) * height
        x, y = x + rng.uniform(0, 0.1) * width, y + rng.uniform(0, 0.06) * height
        w, h = rng.uniform(0.2, 0.32) * width, rng.uniform(0.16, 0.26) * height
        cv2.rectangle(image, (int(x), int(y)), (int(x + w), int(y + h)), ink, thick)
        for _ in range(int(rng.integers(1, 5))):
            spot = (int(x + w * rng.uniform(0.15, 0.85)), int(y + h * rng.uniform(0.2, 0.8)))
            cv2.circle(image, spot, int(min(w, h) * rng.uniform(0.06, 0.3)), ink, thick, cv2.LINE_AA)
        for k in np.arange(0, w, max(w / 9, 6)):
            if rng.random() < 0.5:
                cv2.line(image, (int(x + k), int(y)), (int(x + k + h / 6), int(y + h / 4)), ink, 1, cv2.LINE_AA)
        level = int(y + h + 0.035 * height)
        cv2.arrowedLine(image, (int(x), level), (int(x + w), level), ink, 2, cv2.LINE_AA, tipLength=0.05)
        text = f"{rng.integers(10, 990)}"
        cv2.putText(image, text, (int(x + w / 2), level - 4), FONTS[0], height / 900, ink, 2, cv2.LINE_AA)
    box = (int(0.58 * width), int(0.8 * height), int(0.97 * width), int(0.96 * height))
    cv2.rectangle(image, box[:2], box[2:], ink, thick)
    lettering(image, word(rng, syllables=3), (box[0] + 6, box[1], box[2] - 6, (box[1] + box[3]) // 2), ink=ink)
    lines(rng, image, (box[0] + 6, (box[1] + box[3]) // 2, box[2] - 6, box[3]), line_px=max(height // 45, 8), ink=ink)
    return framed(image, ink=ink, px=2)


def warning(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw a warning: a coloured head, a triangle or disc with a figure, a few words."""
    height, width = size
    image = sheet(size, ((252, 208, 30), (246, 246, 240), (250, 250, 244))[int(rng.integers(3))])
    head, ink = int(0.2 * height), ((180, 24, 28), (18, 18, 20), (16, 80, 170))[int(rng.integers(3))]
    image[:head] = ink
    lettering(image, word(rng), (6, 3, width - 6, head - 3), ink=(250, 250, 244))
    x, y, radius = width // 2, int(0.48 * height), int(0.25 * min(width, height))
    angles = -np.pi / 2 + np.arange(3) * 2 * np.pi / 3
    for grow, tone in ((1.0, (16, 16, 18)), (0.78, (252, 212, 40))):
        corners = np.array([x, y]) + grow * radius * np.column_stack([np.cos(angles), np.sin(angles)])
        cv2.fillPoly(image, [corners.astype(np.int32)], tone, cv2.LINE_AA)
    for _ in range(3):
        a = (x + int(rng.normal(0, 0.16 * radius)), y + int(rng.normal(0, 0.16 * radius)))
        b = (x + int(rng.normal(0, 0.22 * radius)), y + int(rng.normal(0, 0.22 * radius)))
        cv2.line(image, a, b, (14, 14, 16), max(radius // 8, 3), cv2.LINE_AA)
    lettering(image, word(rng, syllables=3), (8, int(0.72 * height), width - 8, int(0.84 * height)), ink=(16, 16, 18))
    lines(rng, image, (10, int(0.84 * height), width - 10, height - 4), line_px=max(height // 28, 8), ink=(24, 24, 26))
    return framed(image, ink=(20, 20, 22), px=3)


def advert(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw a maker's poster: rays, a machine of blocks and wheels, a large name."""
    height, width = size
    image = sheet(size, hue(rng, strong=(0.4, 0.9), bright=(0.5, 0.95)))
    centre, ray = (width // 2, int(0.45 * height)), hue(rng, strong=(0.2, 0.6), bright=(0.7, 1.0))
    start = rng.uniform(0, 1)
    for k in range(12):
        angle = start + k * np.pi / 6 + np.array([0.0, 0.2])
        tips = np.asarray(centre) + 2 * height * np.column_stack([np.cos(angle), np.sin(angle)])
        cv2.fillPoly(image, [np.vstack([centre, tips]).astype(np.int32)], ray, cv2.LINE_AA)
    for _ in range(int(rng.integers(5, 9))):
        x, y = rng.uniform(0.2, 0.8) * width, rng.uniform(0.28, 0.62) * height
        w, h = rng.uniform(0.06, 0.2) * width, rng.uniform(0.05, 0.14) * height
        cv2.rectangle(image, (int(x - w), int(y - h)), (int(x + w), int(y + h)), hue(rng), -1)
        cv2.circle(image, (int(x + w), int(y + h)), int(0.6 * h), (30, 30, 34), -1, cv2.LINE_AA)
        cv2.circle(image, (int(x + w), int(y + h)), int(0.25 * h), (220, 220, 224), -1, cv2.LINE_AA)
    if rng.random() < 0.6:
        burst(image, (int(0.8 * width), int(0.68 * height)), 0.13 * width, ink=hue(rng))
    image[int(0.8 * height) :] = hue(rng, bright=(0.15, 0.4))
    lettering(image, word(rng, syllables=3), (8, int(0.81 * height), width - 8, height - 6), ink=(250, 248, 236))
    image[: int(0.13 * height)] = (246, 244, 236)
    lettering(image, word(rng, syllables=3), (8, 4, width - 8, int(0.13 * height) - 4), ink=(24, 24, 28))
    return framed(image, ink=(30, 30, 34), px=2)


def schedule(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw a planning board: a grid of weeks with coloured cards, some of them written on."""
    height, width = size
    image = sheet(size, (236, 238, 238))
    rows, cols = 7, 10
    for row, col in itertools.product(range(rows), range(cols)):
        x0, x1 = width * col // cols + 2, width * (col + 1) // cols - 3
        y0, y1 = height * row // rows + 2, height * (row + 1) // rows - 3
        if row == 0 or col == 0:
            image[y0:y1, x0:x1] = (52, 74, 108)
            lettering(image, f"{rng.integers(1, 53)}", (x0, y0, x1, y1), ink=(240, 240, 236))
        elif rng.random() < 0.55:
            image[y0:y1, x0:x1] = hue(rng, strong=(0.3, 0.9), bright=(0.7, 0.98))
            lettering(image, word(rng), (x0 + 3, y0, x1 - 3, y1), ink=(24, 24, 28))
    return framed(image, ink=(120, 122, 126), px=3)


def bins(rng: np.random.Generator, size: Size, *, cols: int, rows: int, tone: ArrayLike) -> Rgb:
    """Draw a wall of open bins of one colour with labels, seen from the front; what lies in them differs."""
    height, width = size
    image = sheet(size, (40, 42, 46))
    for row, col in itertools.product(range(rows), range(cols)):
        x0, x1 = width * col // cols + 2, width * (col + 1) // cols - 2
        y0, y1 = height * row // rows + 2, height * (row + 1) // rows - 2
        high = y1 - y0
        for _ in range(5):
            spot = (int(rng.uniform(x0 + 4, x1 - 4)), y0 + int(high * rng.uniform(0.18, 0.4)))
            cv2.circle(image, spot, max(high // 9, 2), hue(rng, strong=(0.0, 0.5)), -1, cv2.LINE_AA)
        image[y0 + int(0.38 * high) : y1, x0:x1] = np.asarray(tone, np.uint8)
        if rng.random() < 0.7:
            label = (x0 + (x1 - x0) // 5, y0 + int(0.55 * high), x1 - (x1 - x0) // 5, y1 - int(0.14 * high))
            image[label[1] : label[3], label[0] : label[2]] = (244, 244, 238)
            lettering(image, f"M{rng.integers(2, 30)}", label, ink=(20, 20, 24))
    return image


def controls(rng: np.random.Generator, size: Size, *, base: ArrayLike) -> Rgb:
    """Draw a machine's front: a plate with its name, dials, levers, a table of speeds, a red knob."""
    height, width = size
    image = sheet(size, base)
    top = int(rng.uniform(0.04, 0.12) * height)
    plate = (int(0.08 * width), top, int(0.92 * width), top + int(0.16 * height))
    image[plate[1] : plate[3], plate[0] : plate[2]] = hue(rng, bright=(0.1, 0.4))
    lettering(image, word(rng, syllables=3), plate, ink=(240, 238, 226))
    for _ in range(int(rng.integers(3, 6))):
        spot = (int(rng.uniform(0.12, 0.88) * width), int(rng.uniform(0.32, 0.9) * height))
        radius = int(min(size) * rng.uniform(0.04, 0.1))
        cv2.circle(image, spot, radius, (232, 232, 226), -1, cv2.LINE_AA)
        cv2.circle(image, spot, radius, (30, 30, 34), max(radius // 6, 2), cv2.LINE_AA)
        end = (spot[0] + int(rng.uniform(-0.7, 0.7) * radius), spot[1] - int(0.6 * radius))
        cv2.line(image, spot, end, (180, 20, 24), max(radius // 6, 2), cv2.LINE_AA)
    x, y = int(rng.uniform(0.1, 0.55) * width), int(rng.uniform(0.35, 0.6) * height)
    w, h = int(0.34 * width), int(0.26 * height)
    image[y : y + h, x : x + w] = (214, 208, 180)
    for i in range(1, 5):
        cv2.line(image, (x, y + h * i // 5), (x + w, y + h * i // 5), (40, 40, 40), 1)
        cv2.line(image, (x + w * i // 5, y), (x + w * i // 5, y + h), (40, 40, 40), 1)
    cv2.circle(image, (int(0.85 * width), int(0.4 * height)), max(min(size) // 14, 3), (200, 20, 24), -1, cv2.LINE_AA)
    return image


def crate_side(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw the side of a wooden crate: boards, battens, nails, a stencilled word and number."""
    height, width = size
    base = np.array([184, 146, 98]) + rng.normal(0, 10, 3)
    image = tinted(base, 6 * fractal(rng, size, cell_px=max(size) / 3, octaves=5))
    boards = max(round(height / 40), 3)
    for i in range(1, boards):
        y = height * i // boards
        image[y - 1 : y + 2] = (70, 52, 34)
    edge = max(width // 12, 8)
    for x in (0, width - edge):
        image[:, x : x + edge] = to_bytes(
            np.asarray(base) + 14 + 3 * fractal(rng, (height, edge), cell_px=9)[..., None]
        )
        image[:, min(x + edge, width - 1)] = (80, 60, 40)
        for y in range(height // boards // 2, height, max(height // boards, 1)):
            cv2.circle(image, (x + edge // 2, y), 2, (50, 44, 40), -1)
    ink = hue(rng, bright=(0.08, 0.35))
    middle = (int(1.4 * edge), int(rng.uniform(0.1, 0.3) * height), int(width - 1.4 * edge), int(0.6 * height))
    lettering(image, word(rng), middle, ink=ink, font=FONTS[3])
    low = (int(1.4 * edge), int(0.64 * height), int(rng.uniform(0.5, 0.88) * width), int(0.9 * height))
    lettering(image, f"{rng.integers(100, 9999)} KG {rng.integers(1, 30)}", low, ink=ink)
    return image


def roller(size: Size, *, px_per_m: float) -> Rgb:
    """Draw the slats of a roller door, all alike."""
    phase = (np.arange(size[0]) / (0.1 * px_per_m)) % 1.0
    shade = 168 + 16 * np.sin(2 * np.pi * phase) - 40 * (phase < 0.1)
    return to_bytes(np.repeat(np.repeat(shade[:, None, None], size[1], axis=1), 3, axis=2) + np.array([0.0, 2.0, 4.0]))


def hazard_stripes(size: Size, *, pitch_px: float) -> Rgb:
    """Draw slanting stripes of yellow and black."""
    y, x = np.mgrid[: size[0], : size[1]]
    dark = ((x + y) / pitch_px) % 1.0 < 0.5
    return np.where(dark[..., None], np.array((32, 32, 34), np.uint8), np.array((228, 190, 36), np.uint8))


def concrete(rng: np.random.Generator, size: Size, *, base: ArrayLike, px_per_m: float) -> Rgb:
    """Draw a concrete floor: clouds, cracks, stains of oil, scuffs."""
    height, width = size
    image = tinted(base, 5.0 * fractal(rng, size, cell_px=1.2 * px_per_m, octaves=6))
    area = height * width / px_per_m**2
    ground = np.asarray(base, dtype=np.float64)
    for _ in range(int(3 * area)):
        spot = (int(rng.uniform(0, width)), int(rng.uniform(0, height)))
        axes = tuple(int(px_per_m * v) + 1 for v in rng.uniform(0.006, 0.05, 2))
        ink = [int(v) for v in np.clip(ground + rng.normal(-10, 20), 0, 255)]
        cv2.ellipse(image, spot, axes, float(rng.uniform(0, 180)), 0, 360, ink, -1, cv2.LINE_AA)
    for _ in range(int(0.3 * area)):
        start = rng.uniform((0, 0), (width, height))
        path = start + np.cumsum(rng.normal(0, 0.06 * px_per_m, (12, 2)) + rng.normal(0, 0.05 * px_per_m, 2), axis=0)
        ink = [int(v) for v in np.clip(ground - 34, 0, 255)]
        cv2.polylines(image, [path.astype(np.int32)], isClosed=False, color=ink, thickness=1, lineType=cv2.LINE_AA)
    return image


def picture(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw one of the prints that hang in workshops."""
    kinds = (drawing, warning, advert, drawing, advert, textures.page)
    return kinds[int(rng.integers(len(kinds)))](rng, size)
