"""Procedural pictures: uint8 RGB images from a random generator, sized in pixels (height, width)."""

from __future__ import annotations

import string
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

Rgb = NDArray[np.uint8]
Float = NDArray[np.float32]

_FONTS = (
    cv2.FONT_HERSHEY_SIMPLEX,
    cv2.FONT_HERSHEY_DUPLEX,
    cv2.FONT_HERSHEY_COMPLEX,
    cv2.FONT_HERSHEY_TRIPLEX,
)


def fractal(rng: np.random.Generator, size: tuple[int, int], *, cell_px: float, octaves: int = 4) -> Float:
    """Return smooth noise f32[h,w] of about unit variance: octaves of random grids, the coarsest with this cell."""
    height, width = size
    total = np.zeros((height, width), np.float32)
    weight, power = 1.0, 0.0
    for _ in range(octaves):
        rows, cols = int(np.ceil(height / cell_px)) + 1, int(np.ceil(width / cell_px)) + 1
        grid = rng.standard_normal((rows, cols)).astype(np.float32)
        total += weight * cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
        power += weight**2
        weight, cell_px = 0.6 * weight, max(cell_px / 2, 1.0)
    return total / np.float32(np.sqrt(power))


def colour(rng: np.random.Generator, *, low: int = 30, high: int = 230) -> tuple[int, int, int]:
    """Draw an RGB colour."""
    r, g, b = (int(v) for v in rng.integers(low, high, 3))
    return r, g, b


def to_bytes(image: NDArray[np.floating]) -> Rgb:
    """Cut grey levels to 0..255 and drop their fractions."""
    result: Rgb = np.clip(image, 0, 255).astype(np.uint8)
    return result


def tinted(base: ArrayLike, change: Float) -> Rgb:
    """Return an image of one colour (3,) whose brightness changes by f32[h,w] grey levels."""
    return to_bytes(np.asarray(base, dtype=np.float32) + change[..., None])


def plaster(rng: np.random.Generator, size: tuple[int, int], *, base: ArrayLike) -> Rgb:
    """Draw a painted wall: almost one colour."""
    broad = 2.5 * fractal(rng, size, cell_px=size[0] / 2, octaves=3)
    return tinted(base, broad + 0.8 * fractal(rng, size, cell_px=4, octaves=2))


def wood(rng: np.random.Generator, size: tuple[int, int], *, base: ArrayLike) -> Rgb:
    """Draw wood with its grain along the rows."""
    height, width = size
    stretched = fractal(rng, (height, max(width // 16, 2)), cell_px=max(height / 12, 2), octaves=4)
    grain = cv2.resize(stretched, (width, height), interpolation=cv2.INTER_CUBIC)
    return tinted(base, 10 * grain + 3 * fractal(rng, size, cell_px=3, octaves=1))


def planks(rng: np.random.Generator, size: tuple[int, int], *, px_per_m: float) -> Rgb:
    """Draw a plank floor with unequal boards, stains and scratches; nothing repeats."""
    height, width = size
    image = np.empty((height, width, 3), np.uint8)
    depth, top = max(int(0.14 * px_per_m), 4), 0
    while top < height:
        left = -int(rng.uniform(0, 1.2) * px_per_m)
        bottom = min(top + depth, height)
        while left < width:
            right = left + int(rng.uniform(0.9, 1.6) * px_per_m)
            x0, x1 = max(left, 0), min(right, width)
            if x1 > x0:
                tone = np.array([158, 120, 82]) + rng.normal(0, 14) + rng.normal(0, 4, 3)
                board = wood(rng, (bottom - top, x1 - x0), base=tone)
                board[0], board[:, 0] = board[0] // 2, board[:, 0] // 2
                image[top:bottom, x0:x1] = board
            left = right
        top = bottom
    dirt = 7 * fractal(rng, size, cell_px=1.5 * px_per_m, octaves=6)
    return _scratched(
        rng, to_bytes(image + dirt[..., None]), count=int(6 * height * width / px_per_m**2), length_px=0.2 * px_per_m
    )


def _scratched(rng: np.random.Generator, image: Rgb, *, count: int, length_px: float) -> Rgb:
    height, width = image.shape[:2]
    for _ in range(count):
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        angle, length = rng.uniform(0, 2 * np.pi), length_px * rng.uniform(0.1, 1.0)
        end = (int(x + length * np.cos(angle)), int(y + length * np.sin(angle)))
        tone = rng.integers(60, 110) if rng.random() < 0.6 else rng.integers(180, 215)
        cv2.line(image, (int(x), int(y)), end, (int(tone), int(tone * 0.9), int(tone * 0.8)), 1, cv2.LINE_AA)
    return image


def carpet(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw a rug: concentric borders around a pattern of rotated squares."""
    height, width = size
    image = np.empty((height, width, 3), np.uint8)
    image[:] = colour(rng, low=60, high=150)
    for i, inset in enumerate(np.linspace(0, min(size) * 0.16, 5).astype(int)):
        cv2.rectangle(image, (inset, inset), (width - inset, height - inset), colour(rng), -1 if i < 4 else 3)
    step = min(size) / 8
    for y in np.arange(1.5 * step, height - step, step):
        for x in np.arange(1.5 * step, width - step, step):
            radius = step * rng.uniform(0.2, 0.48)
            turns = np.deg2rad(rng.choice([0, 45]) + np.arange(0, 360, 90))
            points = np.column_stack([x + radius * np.cos(turns), y + radius * np.sin(turns)])
            cv2.fillPoly(image, [points.astype(np.int32)], colour(rng))
    return to_bytes(image + 7 * fractal(rng, size, cell_px=2, octaves=1)[..., None])


def _word(rng: np.random.Generator, *, shortest: int = 2, longest: int = 9) -> str:
    letters = rng.choice(list(string.ascii_letters + string.digits), int(rng.integers(shortest, longest + 1)))
    return "".join(letters)


def write_lines(rng: np.random.Generator, image: Rgb, box: tuple[int, int, int, int], *, line_px: int) -> None:
    """Write lines of random words into a box (x0, y0, x1, y1) of an image."""
    x0, y0, x1, y1 = box
    font, ink = int(rng.choice(_FONTS)), colour(rng, low=0, high=90)
    scale = line_px / 40
    for y in range(y0 + line_px, y1, int(1.35 * line_px)):
        x = x0
        stop = x0 + (x1 - x0) * rng.uniform(0.6, 1.0)
        while x < stop:
            text = _word(rng)
            (width, _), _ = cv2.getTextSize(text, font, scale, 1)
            if x + width > x1:
                break
            cv2.putText(image, text, (x, y), font, scale, ink, max(1, line_px // 18), cv2.LINE_AA)
            x += width + line_px // 2


def page(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw a printed notice: a heading, columns of words, a picture."""
    height, width = size
    image = np.empty((height, width, 3), np.uint8)
    image[:] = colour(rng, low=205, high=250)
    band = int(height * rng.uniform(0.1, 0.2))
    cv2.rectangle(image, (0, 0), (width, band), colour(rng, low=60, high=200), -1)
    write_lines(rng, image, (width // 20, 0, width - width // 20, band), line_px=max(band // 2, 10))
    middle = int(width * rng.uniform(0.4, 0.6))
    line = max(height // 45, 8)
    write_lines(rng, image, (width // 20, band + line, middle, height - line), line_px=line)
    top = int(height * rng.uniform(0.4, 0.6))
    if middle + line < width - line:
        image[band + line : top, middle + line : width - line] = photo(
            rng, (top - band - line, width - middle - 2 * line)
        )
    write_lines(rng, image, (middle + line, top + line, width - line, height - line), line_px=line)
    return image


def photo(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw something like a photograph: sky, hills, buildings with windows, grain."""
    height, width = size
    fade = np.linspace(1.0, 0.4, height, dtype=np.float32)[:, None, None]
    sky = fade * np.array(colour(rng, low=120, high=250), np.float32)
    image = to_bytes(sky + 16 * fractal(rng, size, cell_px=max(size) / 4, octaves=6)[..., None])
    for depth in range(3):
        line = height * (0.45 + 0.14 * depth) + height * 0.08 * fractal(rng, (1, width), cell_px=width / 4)[0]
        below = np.arange(height)[:, None] > line[None]
        grain = 14 * fractal(rng, size, cell_px=max(size) / 20, octaves=5)
        image[below] = tinted(colour(rng, low=30, high=190), grain)[below]
        for _ in range(int(rng.integers(2, 6))):
            _house(rng, image, bottom=float(line.mean()) + 0.05 * height)
    return image


def _house(rng: np.random.Generator, image: Rgb, *, bottom: float) -> None:
    height, width = image.shape[:2]
    w, h = width * rng.uniform(0.05, 0.16), height * rng.uniform(0.08, 0.32)
    x = rng.uniform(0, width - w)
    cv2.rectangle(image, (int(x), int(bottom - h)), (int(x + w), int(bottom)), colour(rng), -1)
    pane, cols, rows = colour(rng), int(rng.integers(2, 5)), int(rng.integers(2, 7))
    for i in range(cols):
        for j in range(rows):
            x0, y0 = x + w * (i + 0.25) / cols, bottom - h + h * (j + 0.25) / rows
            if rng.random() < 0.85:
                corner = (int(x0 + 0.5 * w / cols), int(y0 + 0.5 * h / rows))
                cv2.rectangle(image, (int(x0), int(y0)), corner, pane, -1)


def shapes(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw an abstract picture of overlapping polygons, discs and strokes."""
    height, width = size
    image = np.empty((height, width, 3), np.uint8)
    image[:] = colour(rng, low=120, high=250)
    scale = min(size)
    for _ in range(int(rng.integers(30, 60))):
        centre = np.array([rng.uniform(0, width), rng.uniform(0, height)])
        radius = scale * rng.uniform(0.02, 0.2)
        kind = rng.integers(3)
        if kind == 0:
            cv2.circle(image, centre.astype(int).tolist(), int(radius), colour(rng), -1, cv2.LINE_AA)
        elif kind == 1:
            points = centre + radius * rng.normal(size=(int(rng.integers(3, 6)), 2))
            cv2.fillPoly(image, [points.astype(np.int32)], colour(rng), cv2.LINE_AA)
        else:
            end = centre + 3 * radius * rng.normal(size=2)
            thick = max(1, int(radius / 8))
            cv2.line(image, centre.astype(int).tolist(), end.astype(int).tolist(), colour(rng), thick, cv2.LINE_AA)
    return to_bytes(0.8 * image + 5 * fractal(rng, size, cell_px=3, octaves=2)[..., None])


def chart(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw a scientific poster: a title, curves, bars and a table."""
    height, width = size
    image = np.full((height, width, 3), 244, np.uint8)
    line = max(height // 40, 8)
    write_lines(rng, image, (line, 0, width - line, 3 * line), line_px=2 * line)
    rows, cols = 3, 2
    for row in range(rows):
        for col in range(cols):
            x0, x1 = int(width * col / cols) + line, int(width * (col + 1) / cols) - line
            y0 = int(4 * line + (height - 5 * line) * row / rows)
            y1 = int(4 * line + (height - 5 * line) * (row + 1) / rows) - line
            kind = rng.integers(3)
            if kind == 0:
                write_lines(rng, image, (x0, y0, x1, y1), line_px=line)
                continue
            cv2.rectangle(image, (x0, y0), (x1, y1), (40, 40, 40), 2)
            xs = np.linspace(x0, x1, 14)
            for _ in range(3):
                ys = y0 + (y1 - y0) * rng.uniform(0.1, 0.95, len(xs))
                ink = colour(rng)
                if kind == 1:
                    cv2.polylines(image, [np.column_stack([xs, ys]).astype(np.int32)], isClosed=False, color=ink)
                for x, y in zip(xs, ys, strict=True):
                    if kind == 1:
                        cv2.circle(image, (int(x), int(y)), 4, ink, -1, cv2.LINE_AA)
                    else:
                        cv2.rectangle(image, (int(x), int(y)), (int(x) + line // 2, y1), ink, -1)
    return image


# Kinds of pictures that hang on walls.
PICTURES: dict[str, Callable[[np.random.Generator, tuple[int, int]], Rgb]] = {
    "page": page,
    "photo": photo,
    "shapes": shapes,
    "chart": chart,
}


def spine(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw the back of a book or a folder, standing."""
    height, width = size
    image = tinted(colour(rng), 5 * fractal(rng, size, cell_px=8, octaves=2))
    label = colour(rng, low=150, high=250)
    top = int(height * rng.uniform(0.1, 0.5))
    bottom = top + int(height * rng.uniform(0.15, 0.4))
    cv2.rectangle(image, (2, top), (width - 3, bottom), label, -1)
    for y in rng.uniform(0.02, 0.98, 3):
        cv2.line(image, (0, int(y * height)), (width, int(y * height)), label, 2)
    turned = np.ascontiguousarray(np.rot90(image, -1))
    write_lines(rng, turned, (height - bottom + 4, 2, height - top - 2, width), line_px=max(int(width * 0.5), 7))
    return np.ascontiguousarray(np.rot90(turned))


def cardboard(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw the side of a carton: tape, a label, stamps."""
    height, width = size
    base = np.array([176, 138, 96]) + rng.normal(0, 12)
    image = tinted(base, 5 * fractal(rng, size, cell_px=max(size) / 3, octaves=6))
    middle = height // 2
    tape = tinted(base + 25, 3 * fractal(rng, (height // 10, width), cell_px=6, octaves=2))
    image[middle : middle + len(tape)] = tape
    w, h = int(width * rng.uniform(0.3, 0.45)), int(height * rng.uniform(0.25, 0.4))
    x, y = int(rng.uniform(0.03, 0.5) * width), int(rng.uniform(0.03, 0.55) * height)
    label = np.full((h, w, 3), 235, np.uint8)
    write_lines(rng, label, (4, 0, w - 4, h - 2), line_px=max(h // 6, 8))
    image[y : y + h, x : x + w] = label
    ink = colour(rng, low=20, high=110)
    spot = (int(0.6 * width), int(rng.uniform(0.2, 0.9) * height))
    cv2.putText(image, _word(rng), spot, _FONTS[3], height / 220, ink, 2, cv2.LINE_AA)
    return image


def doors(rng: np.random.Generator, size: tuple[int, int], *, base: ArrayLike) -> Rgb:
    """Draw the front of a cupboard: two to three doors or drawers with handles and a sticker."""
    height, width = size
    image = wood(rng, size, base=base)
    cols, rows = (2, 1) if height > width else (2, 3)
    for i in range(cols):
        for j in range(rows):
            x0, x1 = width * i // cols + 4, width * (i + 1) // cols - 4
            y0, y1 = height * j // rows + 4, height * (j + 1) // rows - 4
            cv2.rectangle(image, (x0, y0), (x1, y1), (40, 34, 30), 3)
            handle = (x1 - 22, (y0 + y1) // 2) if i == 0 else (x0 + 14, (y0 + y1) // 2)
            cv2.rectangle(image, handle, (handle[0] + 8, handle[1] + max(height // 12, 8)), (215, 215, 220), -1)
            if rng.random() < 0.6:
                note = shapes(rng, (max(height // 8, 16), max(width // 8, 16)))
                y, x = (
                    int(rng.uniform(y0, y1 - note.shape[0])),
                    int(rng.uniform(x0, max(x1 - note.shape[1], x0 + 1))),
                )
                target = image[y : y + note.shape[0], x : x + note.shape[1]]
                target[:] = note[: target.shape[0], : target.shape[1]]
    return image


def screen(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw a monitor that shows windows of text and a picture, with a dark rim."""
    height, width = size
    image = tinted((40, 70, 110), 12 * fractal(rng, size, cell_px=max(size) / 3, octaves=3))
    for _ in range(3):
        w, h = int(width * rng.uniform(0.3, 0.6)), int(height * rng.uniform(0.3, 0.6))
        x, y = int(rng.uniform(0, width - w)), int(rng.uniform(0, height - h))
        window = photo(rng, (h, w)) if rng.random() < 0.3 else np.full((h, w, 3), 240, np.uint8)
        write_lines(rng, window, (4, 0, w - 4, h - 2), line_px=max(h // 16, 8))
        cv2.rectangle(window, (0, 0), (w, h // 12), colour(rng), -1)
        image[y : y + h, x : x + w] = window
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (18, 18, 18), max(width // 30, 4))
    return image


def ceiling(rng: np.random.Generator, size: tuple[int, int], *, px_per_m: float) -> Rgb:
    """Draw ceiling panels of 0.6 m with small holes."""
    height, width = size
    image = tinted((214, 214, 210), 3 * fractal(rng, size, cell_px=px_per_m, octaves=4))
    specks = rng.random(size) < 0.02
    image[specks] = image[specks] // 5 * 4
    step = 0.6 * px_per_m
    for x in np.arange(0, width, step).astype(int):
        image[:, x : x + 2] = 150
    for y in np.arange(0, height, step).astype(int):
        image[y : y + 2] = 150
    return image
