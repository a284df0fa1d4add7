"""What hangs, stands and glows in a laboratory: uint8 RGB images of (height, width) pixels."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
from numpy.typing import ArrayLike

from sim_bridge.scenes import textures
from sim_bridge.scenes.prints import FONTS, Ink, blob, framed, hue, lettering, lines, sheet, word
from sim_bridge.scenes.textures import Rgb, fractal, tinted, write_lines

Size = tuple[int, int]

_SYMBOLS = (
    "H He Li Be B C N O F Ne Na Mg Al Si P S Cl Ar K Ca Sc Ti V Cr Mn Fe Co Ni Cu Zn Ga Ge As Se Br Kr Rb Sr Y Zr Nb "
    "Mo Tc Ru Rh Pd Ag Cd In Sn Sb Te I Xe Cs Ba La Hf Ta W Re Os Ir Pt Au Hg Tl Pb Bi Po At Rn"
)
_INKS: tuple[Ink, ...] = ((28, 40, 150), (176, 32, 36), (22, 112, 48), (26, 26, 30))


def periodic_table(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw the periodic table of the elements: a coloured cell for each, symbols, a heading."""
    height, width = size
    image = sheet(size, (244, 243, 238))
    tones = [hue(rng, strong=(0.25, 0.6), bright=(0.7, 0.95)) for _ in range(8)]
    step_x, step_y = 0.96 * width / 18, 0.8 * height / 6
    lettering(image, "PERIODIC TABLE", (int(0.2 * width), 4, int(0.68 * width), int(0.15 * height)), ink=(24, 24, 40))
    spots = [(0, 0), (17, 0), *((c, 1) for c in (0, 1, *range(12, 18))), *((c, 2) for c in (0, 1, *range(12, 18)))]
    spots += [(c, r) for r in (3, 4, 5) for c in range(18)]
    for i, (symbol, (col, row)) in enumerate(zip(_SYMBOLS.split(), spots, strict=True)):
        x0, y0 = int(0.02 * width + col * step_x), int(0.16 * height + row * step_y)
        x1, y1 = int(x0 + step_x) - 2, int(y0 + step_y) - 2
        image[y0:y1, x0:x1] = tones[(col * 7 // 17 + (row > 3)) % 8]
        cv2.rectangle(image, (x0, y0), (x1, y1), (60, 60, 60), 1)
        lettering(image, symbol, (x0 + 3, y0 + (y1 - y0) // 4, x1 - 2, y1 - 1), ink=(20, 20, 20))
        cv2.putText(image, str(i + 1), (x0 + 2, y0 + 9), FONTS[0], 0.28, (40, 40, 40), 1, cv2.LINE_AA)
    return framed(image, ink=(40, 42, 60), px=2)


def _ring(
    image: Rgb, centre: tuple[float, float], radius: float, *, ink: Ink, thick: int, turn: float
) -> list[tuple[int, int]]:
    angle = turn + np.arange(6) * np.pi / 3
    points = np.asarray(centre) + radius * np.column_stack([np.cos(angle), np.sin(angle)])
    cv2.polylines(image, [points.astype(np.int32)], isClosed=True, color=ink, thickness=thick, lineType=cv2.LINE_AA)
    return [(int(x), int(y)) for x, y in points]


def molecules(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw a poster with structural formulae: rings, bonds, atoms as coloured discs, a heading and text."""
    height, width = size
    image = sheet(size, hue(rng, strong=(0.03, 0.5), bright=(0.75, 0.98)))
    band, scale = int(0.16 * height), min(size)
    image[:band] = hue(rng, bright=(0.25, 0.6))
    lettering(image, word(rng, syllables=3), (8, 4, width - 8, band - 4), ink=(246, 246, 240))
    for _ in range(int(rng.integers(5, 9))):
        centre = (rng.uniform(0.15, 0.85) * width, rng.uniform(0.28, 0.72) * height)
        ink, radius = hue(rng, bright=(0.15, 0.5)), scale * rng.uniform(0.06, 0.13)
        corners = _ring(image, centre, radius, ink=ink, thick=max(scale // 70, 2), turn=float(rng.uniform(0, 1)))
        for x, y in corners:
            if rng.random() < 0.5:
                dx, dy = np.array([x, y]) - centre
                end = (int(x + 0.8 * dx), int(y + 0.8 * dy))
                cv2.line(image, (x, y), end, ink, max(scale // 80, 2), cv2.LINE_AA)
                cv2.circle(image, end, int(scale * rng.uniform(0.02, 0.045)), hue(rng), -1, cv2.LINE_AA)
    lines(rng, image, (10, int(0.8 * height), width - 10, height - 6), line_px=max(height // 26, 9), ink=(30, 30, 34))
    return framed(image, ink=(50, 50, 54), px=2)


def hazards(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw a sheet of hazard signs: red diamonds with black figures, each with its text."""
    height, width = size
    image = sheet(size, (246, 244, 236))
    band = int(0.13 * height)
    image[:band] = (250, 206, 20)
    lettering(image, f"CAUTION {word(rng)}", (6, 2, width - 6, band - 2), ink=(16, 16, 16))
    cols = 3 if width > 0.8 * height else 2
    rows = max(round(cols * (height - band) / width), 1)
    for row, col in itertools.product(range(rows), range(cols)):
        wide, high = width / cols, (height - band) / rows
        x, y = (col + 0.5) * wide, band + (row + 0.4) * high
        radius = 0.36 * min(wide, high)
        for grow, ink in ((1.0, (204, 24, 28)), (0.76, (250, 250, 246))):
            corners = np.array([(x, y - grow * radius), (x + grow * radius, y), (x, y + grow * radius)])
            corners = np.vstack([corners, (x - grow * radius, y)])
            cv2.fillPoly(image, [corners.astype(np.int32)], ink, cv2.LINE_AA)
        for _ in range(3):
            spot = np.array([x, y]) + rng.normal(0, 0.14 * radius, 2)
            blob(rng, image, (float(spot[0]), float(spot[1])), radius * float(rng.uniform(0.1, 0.26)), ink=(12, 12, 12))
        box = (int(x - 0.42 * wide), int(y + 1.05 * radius), int(x + 0.42 * wide), int(band + (row + 1) * high - 2))
        lettering(image, word(rng), box, ink=(20, 20, 20))
    return framed(image, ink=(30, 30, 30), px=2)


def rules(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw rules of conduct: a row per rule, a blue, red or green sign and two lines of text."""
    height, width = size
    image = sheet(size, (248, 248, 246))
    rows, head = max(round(3.4 * height / width), 3), int(0.12 * height)
    ink = ((16, 74, 160), (14, 120, 70), (190, 26, 30))[int(rng.integers(3))]
    image[:head] = ink
    lettering(image, f"{word(rng)} {word(rng)}", (6, 2, width - 6, head - 2), ink=(250, 250, 250))
    step = (height - head) / rows
    for row in range(rows):
        y = int(head + (row + 0.5) * step)
        radius = int(0.38 * step)
        sign = _INKS[int(rng.integers(3))]
        centre = (int(0.06 * width) + radius, y)
        cv2.circle(image, centre, radius, sign, -1, cv2.LINE_AA)
        for _ in range(2):
            spot = (centre[0] + float(rng.normal(0, 0.2 * radius)), y + float(rng.normal(0, 0.2 * radius)))
            blob(rng, image, spot, radius * float(rng.uniform(0.25, 0.45)), ink=(248, 248, 248))
        box = (centre[0] + 2 * radius, y - radius, int(0.96 * width), y + radius)
        lines(rng, image, box, line_px=max(int(0.5 * radius), 8), ink=(24, 24, 28))
    return framed(image, ink=(80, 80, 84), px=2)


def spectra(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw a poster of results: rows of curves with peaks on a grid, bars of colour, headings."""
    height, width = size
    image = sheet(size, hue(rng, strong=(0.0, 0.25), bright=(0.85, 0.98)))
    band = int(0.14 * height)
    image[:band] = hue(rng, bright=(0.3, 0.7))
    write_lines(rng, image, (8, 0, width - 8, band), line_px=max(band // 2, 9))
    rows = int(rng.integers(2, 5))
    for row in range(rows):
        y0 = int(band + (height - band) * row / rows) + 6
        y1 = int(band + (height - band) * (row + 1) / rows) - 6
        x0, x1 = int(0.08 * width), int(rng.uniform(0.55, 0.94) * width)
        image[y0:y1, x0:x1] = (252, 252, 250)
        cv2.rectangle(image, (x0, y0), (x1, y1), (40, 40, 44), 2)
        xs = np.arange(x0, x1)
        for _ in range(2):
            level = np.full(len(xs), 0.08)
            for _ in range(int(rng.integers(3, 9))):
                spot, wide = rng.uniform(x0, x1), width * rng.uniform(0.008, 0.04)
                level += rng.uniform(0.1, 0.8) * np.exp(-0.5 * ((xs - spot) / wide) ** 2)
            ys = y1 - (y1 - y0) * np.clip(level, 0, 0.95)
            curve = np.column_stack([xs, ys]).astype(np.int32)
            cv2.polylines(image, [curve], isClosed=False, color=hue(rng), thickness=3, lineType=cv2.LINE_AA)
        if x1 < 0.8 * width:
            lines(rng, image, (x1 + 8, y0, width - 8, y1), line_px=max((y1 - y0) // 7, 8), ink=(40, 40, 44))
    return framed(image, ink=(60, 60, 64), px=2)


def formulae(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw a whiteboard with rings, curves, equations and a table in one or two inks."""
    height, width = size
    image = sheet(size, (240, 241, 239))
    for _ in range(int(rng.integers(4, 7))):
        centre = (rng.uniform(0.08, 0.6) * width, rng.uniform(0.15, 0.8) * height)
        ink, radius = _INKS[int(rng.integers(4))], 0.09 * height * rng.uniform(0.7, 1.3)
        for x, y in _ring(image, centre, radius, ink=ink, thick=4, turn=0.52)[:: int(rng.integers(1, 4))]:
            end = (int(2 * x - centre[0]), int(2 * y - centre[1]))
            cv2.line(image, (x, y), end, ink, 3, cv2.LINE_AA)
            letter = str(rng.choice(["OH", "CH3", "N", "Cl", "O", "NH2"]))
            cv2.putText(image, letter, end, FONTS[0], height / 480, ink, 2, cv2.LINE_AA)
    for i in range(int(rng.integers(3, 6))):
        ink, y = _INKS[int(rng.integers(4))], int((0.14 + 0.16 * i) * height)
        text = f"{word(rng, syllables=1)} = {rng.integers(2, 99)} {word(rng, syllables=1)}"
        box = (int(rng.uniform(0.5, 0.66) * width), y, int(rng.uniform(0.8, 0.98) * width), y + int(0.12 * height))
        lettering(image, text, box, ink=ink, font=FONTS[0])
    xs = np.linspace(0.1, 0.5, 40) * width
    ys = (0.86 - 0.1 * np.sin(np.linspace(0, rng.uniform(4, 12), 40) + rng.uniform(0, 6))) * height
    curve = np.column_stack([xs, ys]).astype(np.int32)
    cv2.polylines(image, [curve], isClosed=False, color=_INKS[1], thickness=4, lineType=cv2.LINE_AA)
    return framed(image, ink=(150, 152, 156), px=max(height // 90, 3))


def _bottle(rng: np.random.Generator, image: Rgb, foot: tuple[int, int], size: tuple[int, int]) -> None:
    """Draw a bottle standing on a point: body, neck, cap, label."""
    (x, y), (wide, high) = foot, size
    body = ((118, 70, 34), (216, 220, 222), (238, 238, 234), (72, 96, 130), (150, 168, 160))[int(rng.integers(5))]
    shoulder, half = y - int(0.66 * high), wide // 2
    cv2.rectangle(image, (x - half, shoulder), (x + half, y), body, -1)
    cv2.ellipse(image, (x, shoulder), (half, max(int(0.14 * high), 1)), 0, 180, 360, body, -1, cv2.LINE_AA)
    neck = max(wide // 5, 2)
    cv2.rectangle(image, (x - neck, y - int(0.88 * high)), (x + neck, shoulder), body, -1)
    cv2.rectangle(image, (x - neck - 2, y - high), (x + neck + 2, y - int(0.84 * high)), hue(rng), -1)
    top, bottom = y - int(rng.uniform(0.5, 0.62) * high), y - int(rng.uniform(0.08, 0.2) * high)
    cv2.rectangle(image, (x - half + 1, top), (x + half - 1, bottom), (244, 242, 234), -1)
    cv2.rectangle(image, (x - half + 1, top), (x + half - 1, top + max((bottom - top) // 4, 2)), hue(rng), -1)
    for line in range(top + (bottom - top) // 3, bottom - 2, 5):
        cv2.line(image, (x - half + 4, line), (x + half - 5, line), (70, 70, 74), 1)


def bottles(
    rng: np.random.Generator, size: Size, *, rows: int, full: float = 0.8, back: ArrayLike = (206, 206, 202)
) -> Rgb:
    """Draw shelves of bottles, jars and boxes as seen from the front; ``full`` is the share that is occupied."""
    height, width = size
    image = sheet(size, back)
    step = height // rows
    for row in range(rows):
        y, x = (row + 1) * step - max(step // 14, 3), 6
        while x < width - 10:
            wide = int(step * rng.uniform(0.22, 0.48))
            high = int(step * rng.uniform(0.5, 0.86))
            if rng.random() < full and x + wide < width - 4:
                if rng.random() < 0.75:
                    _bottle(rng, image, (x + wide // 2, y), (wide, high))
                else:
                    box = hue(rng, strong=(0.1, 0.8))
                    image[y - high : y, x : x + wide] = box
                    image[y - high // 2 : y - high // 5, x + 3 : x + wide - 3] = (240, 240, 236)
            x += wide + int(step * rng.uniform(0.02, 0.1))
        image[y : (row + 1) * step] = (150, 152, 154)
    return image


def glass_front(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw a cupboard with glass doors: dim shelves of bottles and glass behind panes in pale frames."""
    height, width = size
    inside = bottles(rng, size, rows=5, full=float(rng.uniform(0.5, 0.9)), back=(120, 124, 128))
    image = np.ascontiguousarray((0.8 * inside + 26).astype(np.uint8))
    rim = max(width // 22, 5)
    for x0, x1 in ((0, width // 2), (width // 2, width)):
        cv2.rectangle(image, (x0, 0), (x1 - 1, height - 1), (216, 218, 216), 2 * rim)
    for x in (width // 2 - 2 * rim, width // 2 + rim):
        cv2.rectangle(image, (x, height // 2 - 3 * rim), (x + rim // 2, height // 2 + 3 * rim), (90, 92, 96), -1)
    return image


def hood_inside(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw what stands in a fume hood behind its pane: grey tiles, stands, flasks, tubes."""
    height, width = size
    image = sheet(size, (164, 168, 168))
    image[:, :: max(width // 8, 8)] = 140
    image[:: max(width // 8, 8)] = 140
    for _ in range(int(rng.integers(2, 4))):
        x = int(rng.uniform(0.1, 0.9) * width)
        cv2.line(image, (x, height), (x, int(rng.uniform(0.15, 0.4) * height)), (70, 72, 76), 5)
        spot = (x + int(rng.uniform(-0.1, 0.1) * width), int(rng.uniform(0.5, 0.8) * height))
        cv2.line(image, (x, spot[1] - 30), (spot[0], spot[1] - 30), (60, 60, 64), 4)
        cv2.circle(image, spot, int(rng.uniform(0.06, 0.1) * height), hue(rng, bright=(0.5, 0.9)), -1, cv2.LINE_AA)
    for _ in range(int(rng.integers(2, 6))):
        foot = (int(rng.uniform(0.06, 0.94) * width), height - 4)
        _bottle(rng, image, foot, (int(0.1 * width), int(rng.uniform(0.2, 0.34) * height)))
    return image


def panel_front(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw the front of an instrument: a screen, knobs, buttons, slots, a stripe with a name."""
    height, width = size
    image = sheet(size, np.array((214, 216, 214)) - rng.integers(0, 60))
    stripe = hue(rng, strong=(0.5, 0.9))
    y = int(rng.uniform(0.05, 0.2) * height)
    image[y : y + height // 7] = stripe
    lettering(image, word(rng, syllables=3), (6, y, int(0.7 * width), y + height // 7), ink=(250, 250, 250))
    x0 = int(rng.uniform(0.05, 0.45) * width)
    x1, y0, y1 = x0 + int(0.42 * width), int(0.4 * height), int(0.75 * height)
    image[y0:y1, x0:x1] = (22, 34, 40)
    write_lines(rng, image, (x0 + 4, y0, x1 - 4, y1 - 2), line_px=max((y1 - y0) // 4, 8))
    for _ in range(int(rng.integers(5, 12))):
        x, y = int(rng.uniform(0.06, 0.94) * width), int(rng.uniform(0.36, 0.94) * height)
        if x0 - 8 < x < x1 + 8 and y < y1 + 8:
            continue
        cv2.circle(image, (x, y), max(int(height * rng.uniform(0.02, 0.05)), 3), hue(rng), -1, cv2.LINE_AA)
    for y in range(int(0.84 * height), int(0.95 * height), 6):
        image[y : y + 2, int(0.1 * width) : int(0.5 * width)] = 70
    return framed(image, ink=(96, 98, 100), px=2)


def readout(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw the screen of an instrument's computer: curves on dark, a table, buttons."""
    height, width = size
    image = sheet(size, (24, 30, 40))
    image[: height // 10] = hue(rng, bright=(0.4, 0.8))
    xs = np.linspace(0.05, 0.65, 120) * width
    for row in range(3):
        level = np.abs(fractal(rng, (1, 120), cell_px=float(rng.uniform(6, 30)), octaves=3)[0])
        ys = (0.36 + 0.27 * row) * height - 0.11 * height * level
        curve = np.column_stack([xs, ys]).astype(np.int32)
        ink = hue(rng, bright=(0.7, 1.0))
        cv2.polylines(image, [curve], isClosed=False, color=ink, thickness=2, lineType=cv2.LINE_AA)
    right = (int(0.68 * width), int(0.14 * height), int(0.97 * width), int(0.94 * height))
    image[right[1] : right[3], right[0] : right[2]] = (236, 238, 240)
    lines(rng, image, (right[0] + 4, right[1], right[2] - 4, right[3]), line_px=max(height // 16, 8), ink=(20, 20, 24))
    return framed(image, ink=(14, 14, 16), px=max(width // 60, 3))


def escape_plan(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw a plan of the way out: rooms as black lines, green arrows, a key."""
    height, width = size
    image = sheet(size, (250, 250, 248))
    image[: height // 8] = (20, 130, 70)
    lettering(image, "EXIT PLAN", (6, 2, width - 6, height // 8 - 2), ink=(250, 250, 250))
    for _ in range(9):
        x0, y0 = int(rng.uniform(0.04, 0.7) * width), int(rng.uniform(0.17, 0.6) * height)
        x1, y1 = x0 + int(rng.uniform(0.12, 0.28) * width), y0 + int(rng.uniform(0.1, 0.22) * height)
        if rng.random() < 0.4:
            image[y0:y1, x0:x1] = hue(rng, strong=(0.15, 0.35), bright=(0.85, 0.98))
        cv2.rectangle(image, (x0, y0), (x1, y1), (20, 20, 20), 3)
    for _ in range(4):
        a = (int(rng.uniform(0.1, 0.9) * width), int(rng.uniform(0.2, 0.8) * height))
        b = (a[0] + int(rng.uniform(-0.25, 0.25) * width), a[1])
        cv2.arrowedLine(image, a, b, (16, 140, 70), 5, cv2.LINE_AA)
    lines(rng, image, (10, int(0.84 * height), width - 10, height - 4), line_px=max(height // 30, 8), ink=(30, 30, 30))
    return framed(image, ink=(20, 110, 60), px=3)


def vinyl(rng: np.random.Generator, size: Size, *, base: ArrayLike, px_per_m: float) -> Rgb:
    """Draw a floor of welded vinyl sheets: faint clouds, small marks, seams every 2 m."""
    height, width = size
    image = tinted(base, 3.0 * fractal(rng, size, cell_px=0.6 * px_per_m, octaves=5))
    ground = image.reshape(-1, 3).mean(axis=0)
    for _ in range(int(4 * height * width / px_per_m**2)):
        spot = (int(rng.uniform(0, width)), int(rng.uniform(0, height)))
        ink = [int(v) for v in np.clip(ground + rng.normal(0, 20), 0, 255)]
        axes = (int(px_per_m * rng.uniform(0.005, 0.03)) + 1, int(px_per_m * rng.uniform(0.004, 0.015)) + 1)
        cv2.ellipse(image, spot, axes, float(rng.uniform(0, 180)), 0, 360, ink, -1, cv2.LINE_AA)
    for x in np.arange(2.0 * px_per_m, width, 2.0 * px_per_m).astype(int):
        image[:, x : x + 2] = np.clip(ground - 26, 0, 255)
    return image


def picture(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw one of the prints that hang in laboratories."""
    kinds = (molecules, spectra, hazards, rules, textures.chart, molecules, spectra)
    return kinds[int(rng.integers(len(kinds)))](rng, size)
