"""Charts of the test scenes: maps, timetables, teaching charts, blackboards, monitors; uint8 RGB, (height, width)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_bridge.scenes.heldout_prints import PLAIN, SCRIPT, SLANTED, Ink, filled, ink, letter, paragraph, word
from sim_bridge.scenes.textures import fractal, tinted

Rgb = NDArray[np.uint8]


def land_map(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw a wall map: sea, countries with borders, a net of degrees, names and a key."""
    height, width = size
    ground = fractal(rng, size, cell_px=width / 3, octaves=6)
    sites = rng.uniform(0, 1, (14, 2)) * (height, width)
    bend = 0.06 * width * fractal(rng, size, cell_px=width / 10, octaves=3)
    rows, cols = np.mgrid[0:height, 0:width].astype(np.float32)
    apart = np.stack([np.hypot(rows - s[0] + bend, cols - s[1] + bend) for s in sites])
    country = apart.argmin(axis=0)
    colours = np.array([ink(rng, saturation=0.35, value=0.82, spread=0.12) for _ in sites])
    image: Rgb = colours[country].astype(np.uint8)
    borders = cv2.morphologyEx(country.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    image[borders] = (120, 60, 60)
    sea = ground < np.quantile(ground, rng.uniform(0.3, 0.6))
    image[sea] = tinted((148, 186, 208), 9 * np.clip(ground, -2, 2))[sea]
    coast = cv2.morphologyEx(sea.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    image[coast] = (50, 80, 110)
    for k in range(1, 8):
        cv2.line(image, (k * width // 8, 0), (k * width // 8, height), (110, 130, 140), 1)
        cv2.line(image, (0, k * height // 8), (width, k * height // 8), (110, 130, 140), 1)
    for y, x in sites:
        letter(image, word(rng).upper(), (x - 20, y), 11, (40, 30, 30), font=SLANTED)
        cv2.circle(image, (int(x), int(y + 9)), 4, (170, 20, 20), -1, cv2.LINE_AA)
    image[-height // 6 :, : width // 4] = (240, 236, 222)
    box = (6, height - height // 6 + 3, width // 4 - 4, height - 4)
    paragraph(rng, image, box, line_px=13, rgb=(60, 60, 60))
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (60, 50, 40), 8)
    return image


def timetable(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw a table of coloured boxes with a word in each."""
    height, width = size
    image = filled(size, (246, 246, 242))
    rows, cols = int(rng.integers(5, 10)), int(rng.integers(5, 9))
    palette = [ink(rng, saturation=0.45, value=0.85) for _ in range(6)]
    letter(
        image,
        f"{word(rng)} {rng.integers(1, 40)}",
        (0.04 * width, 0.09 * height),
        0.06 * height,
        (40, 40, 90),
        bold=2,
    )
    top = 0.13 * height
    for i in range(rows):
        for j in range(cols):
            if rng.random() < 0.72:
                y0, y1 = top + (height - top) * np.array([i + 0.08, i + 0.92]) / rows
                x0, x1 = width * np.array([j + 0.05, j + 0.95]) / cols
                corner = (int(x0), int(y0)), (int(x1), int(y1))
                cv2.rectangle(image, *corner, palette[int(rng.integers(6))], -1)
                letter(image, word(rng)[:5], (x0 + 3, 0.4 * y0 + 0.6 * y1), 0.3 * (y1 - y0), (50, 50, 50))
    return image


def anatomy(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw a teaching chart of a body or an organ with pointed labels."""
    height, width = size
    image = filled(size, (242, 237, 222))
    skin = ink(rng, saturation=0.35, value=0.8, spread=0.1)
    middle = width * rng.uniform(0.4, 0.6)
    if rng.random() < 0.5:
        cv2.circle(image, (int(middle), int(0.16 * height)), int(0.06 * height), skin, -1, cv2.LINE_AA)
        cv2.ellipse(
            image,
            (int(middle), int(0.42 * height)),
            (int(0.13 * width), int(0.2 * height)),
            0,
            0,
            360,
            skin,
            -1,
        )
        for side in (-1, 1):
            knee, hand = middle + side * 0.08 * width, middle + side * rng.uniform(0.18, 0.3) * width
            ends = (int(knee), int(0.55 * height)), (int(knee), int(0.93 * height))
            cv2.line(image, *ends, skin, int(0.07 * width))
            ends = (int(middle + side * 0.1 * width), int(0.27 * height)), (int(hand), int(0.55 * height))
            cv2.line(image, *ends, skin, int(0.05 * width))
    else:
        cv2.ellipse(
            image,
            (int(middle), int(0.5 * height)),
            (int(0.3 * width), int(0.34 * height)),
            0,
            0,
            360,
            skin,
            -1,
        )
    for _ in range(int(rng.integers(7, 13))):
        x, y = middle + rng.normal(0, 0.08) * width, rng.uniform(0.2, 0.75) * height
        axes = int(rng.uniform(0.02, 0.08) * width), int(rng.uniform(0.02, 0.07) * height)
        angle = float(rng.uniform(0, 180))
        cv2.ellipse(image, (int(x), int(y)), axes, angle, 0, 360, ink(rng, value=0.6), -1, cv2.LINE_AA)
        end = width * (0.06 if x < middle else 0.8)
        cv2.line(image, (int(x), int(y)), (int(end + 0.1 * width * (x < middle)), int(y)), (60, 60, 60), 1)
        letter(image, word(rng), (end, y - 3), 11, (30, 30, 30))
    letter(image, word(rng).upper(), (0.06 * width, 0.08 * height), 0.05 * height, (130, 30, 30), bold=2)
    return image


def eye_chart(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw rows of letters that get smaller."""
    height, width = size
    image = filled(size, (250, 250, 248))
    y, tall = 0.06 * height, 0.13 * height
    while tall > 6:
        count = max(int(0.5 * width / tall), 1)
        for k, sign in enumerate(rng.choice(list("CDEFLNOPTZ"), count)):
            x = width * (k + 0.5) / count - 0.4 * tall
            letter(
                image,
                str(sign),
                (x, y + tall),
                tall,
                (15, 15, 15),
                font=PLAIN,
                bold=max(int(0.14 * tall), 1),
            )
        y, tall = y + 1.5 * tall, 0.78 * tall
    return image


def chalked(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw a blackboard with wiped smears, lines of handwriting, a curve and a figure."""
    height, width = size
    image = tinted((40, 62, 54), 5 * fractal(rng, size, cell_px=width / 6, octaves=4))
    chalk: tuple[Ink, ...] = ((226, 230, 224), (226, 230, 224), (230, 206, 120), (210, 150, 150))
    y = 0.16 * height
    for _ in range(int(rng.integers(4, 8))):
        text = " ".join(word(rng) for _ in range(int(rng.integers(1, 4))))
        if rng.random() < 0.5:
            text = f"{rng.integers(2, 99)} x {rng.integers(2, 99)} = {rng.integers(100, 999)}"
        where = (float(rng.uniform(0.02, 0.12)) * width, y)
        letter(image, text, where, 0.065 * height, chalk[int(rng.integers(4))], font=SCRIPT, bold=2)
        y += 0.13 * height
    left, low = rng.uniform(0.58, 0.66) * width, rng.uniform(0.45, 0.9) * height
    x = np.linspace(0, 0.3 * width, 60)
    curve = low - 0.15 * height * (1 + np.sin(x / width * rng.uniform(12, 40) + rng.uniform(0, 6)))
    points = np.stack([left + x, curve], 1).astype(np.int32)
    cv2.polylines(image, [points], False, chalk[2], 3, cv2.LINE_AA)
    axes = np.array([[left, low - 0.38 * height], [left, low], [left + 0.32 * width, low]]).astype(np.int32)
    cv2.polylines(image, [axes], False, chalk[0], 2, cv2.LINE_AA)
    corners = np.array([rng.uniform(0.55, 0.95, 5) * width, rng.uniform(0.08, 0.45, 5) * height]).T
    cv2.polylines(image, [corners.astype(np.int32)], True, chalk[3], 2, cv2.LINE_AA)
    return image


def readout(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw a monitor's picture: dark, with traces and figures, or a form."""
    height, width = size
    if rng.random() < 0.5:
        image = filled(size, (12, 18, 26))
        x = np.arange(width)
        for k in range(4):
            beat = np.abs(np.sin(x / width * rng.uniform(8, 30))) ** rng.uniform(2, 12)
            y = (0.22 * (k + 1) - 0.14 * beat) * height
            points = np.stack([0.72 * x, y], 1).astype(np.int32)
            rgb = ink(rng, saturation=0.8, value=0.9, spread=0.1)
            cv2.polylines(image, [points], False, rgb, 2, cv2.LINE_AA)
            number = str(rng.integers(20, 190))
            letter(image, number, (0.77 * width, 0.22 * (k + 1) * height), 0.12 * height, rgb, bold=2)
        return image
    image = filled(size, (228, 232, 238))
    image[: height // 9] = ink(rng, saturation=0.6, value=0.5)
    image[height // 9 :, : int(rng.uniform(0.15, 0.3) * width)] = (196, 204, 214)
    paragraph(rng, image, (0.34 * width, 0.16 * height, 0.96 * width, 0.9 * height), line_px=16, rgb=(50, 60, 80))
    paragraph(rng, image, (6, 0.16 * height, 0.15 * width, 0.7 * height), line_px=22, rgb=(30, 60, 120))
    return image


def clock(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw the face of a clock on a dark square."""
    image = filled(size, (60, 60, 64))
    middle, radius = np.array(size[::-1]) / 2, 0.46 * min(size)
    cv2.circle(image, (int(middle[0]), int(middle[1])), int(radius), (246, 246, 240), -1, cv2.LINE_AA)
    for k in range(12):
        tip = np.array([np.sin(k * np.pi / 6), np.cos(k * np.pi / 6)])
        a, b = (middle + radius * r * tip for r in (0.8, 0.93))
        cv2.line(image, (int(a[0]), int(a[1])), (int(b[0]), int(b[1])), (20, 20, 20), max(int(0.05 * radius), 1))
    for reach, wide in ((0.5, 0.08), (0.75, 0.05)):
        angle = rng.uniform(0, 2 * np.pi)
        tip = middle + reach * radius * np.array([np.sin(angle), -np.cos(angle)])
        ends = (int(middle[0]), int(middle[1])), (int(tip[0]), int(tip[1]))
        cv2.line(image, *ends, (20, 20, 20), max(int(wide * radius), 1), cv2.LINE_AA)
    return image
