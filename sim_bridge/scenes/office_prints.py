"""What is printed, pinned and written in an office: uint8 RGB images of (height, width) pixels."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from sim_bridge.scenes import textures
from sim_bridge.scenes.textures import Rgb, colour, fractal, tinted, to_bytes, write_lines

Size = tuple[int, int]


def paint(rng: np.random.Generator, size: Size, *, base: ArrayLike) -> Rgb:
    """Draw a painted wall that is nearly blank: one or two grey levels."""
    return tinted(base, 1.2 * fractal(rng, size, cell_px=size[0] / 2, octaves=2))


def stripes(rng: np.random.Generator, size: Size, *, base: ArrayLike, px_per_m: float, pitch_m: float) -> Rgb:
    """Draw a wall with upright stripes that repeat: half of each pitch is a little darker."""
    width = size[1]
    phase = (np.arange(width) / (pitch_m * px_per_m)) % 1.0
    soft = 9.0 * np.tanh(8.0 * np.sin(2 * np.pi * phase))
    return tinted(base, (fractal(rng, size, cell_px=size[0] / 2, octaves=2) + soft[None]).astype(np.float32))


def carpet(rng: np.random.Generator, size: Size, *, base: ArrayLike, px_per_m: float) -> Rgb:
    """Draw carpet tiles of 0.5 m, turned in turn, worn and flecked."""
    height, width = size
    rows, cols = (np.arange(n) // (0.5 * px_per_m) % 2 for n in size)
    image = 2.0 * fractal(rng, size, cell_px=3, octaves=1) + 4.0 * fractal(rng, size, cell_px=0.6 * px_per_m, octaves=5)
    image += 2.5 * np.where(rows[:, None] == cols[None], 1.0, -1.0).astype(np.float32)
    return flecked(rng, tinted(base, image), count=int(20 * height * width / px_per_m**2), px_per_m=px_per_m)


def flecked(rng: np.random.Generator, image: Rgb, *, count: int, px_per_m: float, contrast: float = 22.0) -> Rgb:
    """Strew flecks of 2 to 7 cm over an image, a little lighter or darker than the ground."""
    height, width = image.shape[:2]
    ground = image.reshape(-1, 3).mean(axis=0)
    for x, y in rng.uniform((0, 0), (width, height), (count, 2)):
        axes = np.maximum(rng.uniform(0.008, 0.035, 2) * px_per_m, 1.0)
        tone = np.clip(ground + rng.normal(0.0, contrast) + rng.normal(0.0, 5.0, 3), 0, 255)
        ink = [int(v) for v in tone]
        cv2.ellipse(image, ((x, y), (2 * axes[0], 2 * axes[1]), rng.uniform(0, 180)), ink, -1, cv2.LINE_AA)
    return image


def ceiling_tiles(rng: np.random.Generator, size: Size, *, px_per_m: float) -> Rgb:
    """Draw mineral panels of 0.6 m in a white grid."""
    height, width = size
    image = 232 + fractal(rng, size, cell_px=2, octaves=1)
    for x in np.arange(0, width, 0.6 * px_per_m).astype(int):
        image[:, x : x + 2] = 220
    for y in np.arange(0, height, 0.6 * px_per_m).astype(int):
        image[y : y + 2] = 220
    return tinted((1.0, 0.0, -4.0), image)


def wall_tiles(rng: np.random.Generator, size: Size, *, base: ArrayLike, tile_px: int) -> Rgb:
    """Draw glazed tiles with pale joints."""
    image = 0.8 * fractal(rng, size, cell_px=tile_px, octaves=2)
    image[::tile_px], image[:, ::tile_px] = -18, -18
    return tinted(base, image)


def laminate(rng: np.random.Generator, size: Size, *, base: ArrayLike) -> Rgb:
    """Draw a table top or a cupboard's side with a faint grain."""
    height, width = size
    grain = fractal(rng, (height, max(width // 10, 2)), cell_px=max(height / 10, 2), octaves=3)
    return tinted(base, 2.0 * cv2.resize(grain, (width, height), interpolation=cv2.INTER_CUBIC))


def fabric(rng: np.random.Generator, size: Size, *, base: ArrayLike) -> Rgb:
    """Draw the cloth of a screen or a chair: fine, faint and without marks."""
    return tinted(base, 1.5 * fractal(rng, size, cell_px=2, octaves=1))


def fronts(
    size: Size, *, base: ArrayLike, cols: int, rows: int, px_per_m: float, handle: ArrayLike = (150, 150, 152)
) -> Rgb:
    """Draw the front of a cupboard: plain doors or drawers with joints and handles."""
    height, width = size
    image = np.empty((height, width, 3), np.uint8)
    image[:] = np.asarray(base, np.uint8)
    joint, line = np.asarray(base, np.int64) // 2, max(1, round(0.006 * px_per_m))
    ink = [int(v) for v in np.asarray(handle)]
    for col in range(cols):
        for row in range(rows):
            x0, x1 = width * col // cols, width * (col + 1) // cols
            y0, y1 = height * row // rows, height * (row + 1) // rows
            cv2.rectangle(image, (x0, y0), (x1 - 1, y1 - 1), [int(v) for v in joint], line)
            if rows > 1:
                w, y = round(0.07 * px_per_m), y0 + round(0.05 * px_per_m)
                cv2.rectangle(image, ((x0 + x1) // 2 - w, y), ((x0 + x1) // 2 + w, y + 2 * line), ink, -1)
            else:
                x = x1 - round(0.05 * px_per_m) if col % 2 == 0 else x0 + round(0.05 * px_per_m)
                h = round(0.08 * px_per_m)
                cv2.rectangle(image, (x - line, (y0 + y1) // 2 - h), (x + line, (y0 + y1) // 2 + h), ink, -1)
    return image


def binders(rng: np.random.Generator, size: Size, *, count: int) -> Rgb:
    """Draw a row of folders of one sort: white labels and finger holes on few colours."""
    height, width = size
    image = np.full((height, width, 3), 30, np.uint8)
    cloths = [np.array(colour(rng, low=40, high=130)) for _ in range(2)]
    for i in range(count):
        x0, x1 = width * i // count + 1, width * (i + 1) // count - 1
        top = round(0.08 * height)
        image[top:, x0:x1] = cloths[int(rng.random() < 0.3)]
        w = x1 - x0
        image[int(0.2 * height) : int(0.6 * height), x0 + w // 5 : x1 - w // 5] = 225
        for y in np.linspace(0.26, 0.52, 4):
            image[int(y * height) : int(y * height) + 2, x0 + w // 3 : x1 - w // 3] = 120
        cv2.circle(image, ((x0 + x1) // 2, int(0.8 * height)), max(w // 4, 2), (18, 18, 18), -1, cv2.LINE_AA)
    return image


def keyboard(size: Size) -> Rgb:
    """Draw a keyboard seen from above."""
    height, width = size
    image = np.full((height, width, 3), 42, np.uint8)
    for row in range(5):
        for col in range(15):
            x0, y0 = width * col // 15 + 2, height * row // 5 + 2
            image[y0 : height * (row + 1) // 5 - 1, x0 : width * (col + 1) // 15 - 1] = 78
    return image


def login(size: Size) -> Rgb:
    """Draw a screen that waits for its user: the same on all computers."""
    height, width = size
    image = np.full((height, width, 3), (32, 52, 84), np.uint8)
    cv2.circle(image, (width // 2, int(0.38 * height)), height // 9, (150, 165, 190), -1, cv2.LINE_AA)
    y = int(0.62 * height)
    cv2.rectangle(image, (int(0.36 * width), y), (int(0.64 * width), y + height // 14), (210, 216, 226), -1)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (14, 14, 14), max(width // 40, 3))
    return image


def cork(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw a notice board: sheets, photographs and coloured notes, pinned askew."""
    height, width = size
    image = tinted((172, 130, 84), 7 * fractal(rng, size, cell_px=4, octaves=2))
    count = int(rng.integers(9, 14))
    for i in range(count):
        h = int(height * rng.uniform(0.18, 0.42))
        w = max(int(h * rng.uniform(0.65, 1.4)), 16)
        kind = rng.random()
        if kind < 0.45:
            sheet = textures.page(rng, (max(h, 40), max(w, 40)))
        elif kind < 0.75:
            sheet = textures.photo(rng, (h, w))
        else:
            sheet = note(rng, (h, w))
        x = (i + rng.uniform(0.0, 0.8)) / count * width - 0.3 * w
        y = rng.uniform(0.02, 0.95) * height - 0.5 * h
        _paste(image, sheet, (x, y), angle_deg=float(rng.normal(0, 5)))
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (96, 78, 60), max(height // 45, 3))
    return image


def mosaic(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw a picture of plain cells of many colours with dark joints, a twelfth of the picture wide or less."""
    height, width = size
    count = int(rng.integers(60, 110))
    seeds = rng.uniform((0, 0), (width, height), (count, 2))
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    distance, cell = (np.asarray(part) for part in cKDTree(seeds).query(np.stack([x, y], axis=-1), k=2))
    palette = np.array([colour(rng, low=20, high=245) for _ in range(count)], np.uint8)
    image = palette[cell[..., 0]]
    image[distance[..., 1] - distance[..., 0] < max(size) / 110] = 25
    return np.ascontiguousarray(image)


def emblem(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw large crisp discs, polygons and bars over each other."""
    height, width = size
    image = np.empty((height, width, 3), np.uint8)
    image[:] = colour(rng, low=110, high=250)
    scale = min(size)
    for _ in range(int(rng.integers(22, 36))):
        middle = np.array([rng.uniform(0, width), rng.uniform(0, height)])
        radius = scale * float(rng.uniform(0.03, 0.16))
        kind = rng.integers(3)
        if kind == 0:
            cv2.circle(image, middle.astype(int).tolist(), int(radius), colour(rng, low=0, high=255), -1, cv2.LINE_AA)
            cv2.circle(image, middle.astype(int).tolist(), int(radius / 2), colour(rng), -1, cv2.LINE_AA)
        elif kind == 1:
            turns = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 6))))
            points = middle + 1.3 * radius * np.column_stack([np.cos(turns), np.sin(turns)])
            cv2.fillPoly(image, [points.astype(np.int32)], colour(rng, low=0, high=255), cv2.LINE_AA)
        else:
            end = middle + 2.0 * radius * rng.normal(size=2)
            thick = max(2, int(radius / 3))
            cv2.line(image, middle.astype(int).tolist(), end.astype(int).tolist(), colour(rng), thick, cv2.LINE_AA)
    return image


def placard(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw a few lines of large letters on bands of colour."""
    height, width = size
    image = np.empty((height, width, 3), np.uint8)
    edges = np.sort(np.concatenate([[0.0, 1.0], rng.uniform(0.12, 0.88, int(rng.integers(3, 6)))]))
    for top, bottom in itertools.pairwise((edges * height).astype(int)):
        image[top:bottom] = colour(rng, low=120, high=250)
        line = int(np.clip((bottom - top) * 0.7, 12, height / 7))
        if bottom - top > 14:
            box = (width // 30, top, width - width // 30, bottom)
            _large_letters(rng, image, box, line_px=line)
    return image


def _large_letters(rng: np.random.Generator, image: Rgb, box: tuple[int, int, int, int], *, line_px: int) -> None:
    x0, y0, x1, y1 = box
    thick, scale, ink = max(2, line_px // 7), line_px / 32, colour(rng, low=0, high=110)
    for y in range(y0 + line_px, y1 + 1, int(1.3 * line_px)):
        x = x0
        while x < x1 - line_px:
            letter = str(rng.choice(list("ABCDEFGHJKLMNPQRSTUVWXYZ23456789")))
            cv2.putText(image, letter, (x, y - line_px // 6), cv2.FONT_HERSHEY_DUPLEX, scale, ink, thick, cv2.LINE_AA)
            x += int(line_px * rng.choice([0.8, 0.8, 0.8, 1.5]))


# Kinds of prints on walls: all with structure of 2 to 15 cm on a print of ordinary size.
PRINTS: dict[str, Callable[[np.random.Generator, Size], Rgb]] = {
    "page": textures.page,
    "photo": textures.photo,
    "chart": textures.chart,
    "mosaic": mosaic,
    "emblem": emblem,
    "placard": placard,
}


def printed(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw a print of a random kind."""
    return PRINTS[str(rng.choice(list(PRINTS)))](rng, size)


def note(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw a coloured note with large writing."""
    image = np.empty((*size, 3), np.uint8)
    image[:] = colour(rng, low=150, high=250)
    write_lines(rng, image, (3, 0, size[1] - 3, size[0] - 2), line_px=max(size[0] // 4, 9))
    return image


def _paste(image: Rgb, sheet: Rgb, corner: tuple[float, float], *, angle_deg: float) -> None:
    """Paste a sheet turned about its middle; what reaches beyond the image is cut."""
    h, w = sheet.shape[:2]
    turn = cv2.getRotationMatrix2D((w / 2, h / 2), angle_deg, 1.0)
    turn[:, 2] += corner
    size = (image.shape[1], image.shape[0])
    mask = cv2.warpAffine(np.full((h, w), 255, np.uint8), turn, size, flags=cv2.INTER_NEAREST) > 0
    image[mask] = cv2.warpAffine(sheet, turn, size, flags=cv2.INTER_LINEAR)[mask]


def whiteboard(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw a whiteboard with boxes, arrows and writing in a part of it."""
    height, width = size
    image = np.full((height, width, 3), 240, np.uint8)
    inks = ((30, 40, 150), (170, 30, 30), (20, 110, 40), (25, 25, 30))
    left = int(width * rng.uniform(0.03, 0.25))
    points = []
    for _ in range(int(rng.integers(5, 9))):
        x, y = int(rng.uniform(left, left + 0.5 * width)), int(rng.uniform(0.06, 0.75) * height)
        w, h = int(rng.uniform(0.1, 0.2) * width), int(rng.uniform(0.1, 0.22) * height)
        cv2.rectangle(image, (x, y), (x + w, y + h), inks[int(rng.integers(4))], max(2, height // 160))
        write_lines(rng, image, (x + 4, y, x + w - 4, y + h - 2), line_px=max(h // 3, 9))
        points.append((x + w // 2, y + h))
    for a, b in itertools.pairwise(points):
        cv2.arrowedLine(image, a, b, inks[int(rng.integers(4))], max(2, height // 200), cv2.LINE_AA)
    write_lines(rng, image, (left, int(0.8 * height), int(0.9 * width), height - 6), line_px=max(height // 14, 9))
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (150, 152, 156), max(height // 60, 3))
    return image


def sign(rng: np.random.Generator, size: Size, *, text: str, base: ArrayLike) -> Rgb:
    """Draw a sign with large letters and a stripe of colour."""
    height, width = size
    image = np.empty((height, width, 3), np.uint8)
    image[:] = np.asarray(base, np.uint8)
    image[int(0.78 * height) :] = colour(rng)
    scale = 0.6 * height / 30
    (wide, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_DUPLEX, scale, 2)
    scale *= min(1.0, 0.9 * width / max(wide, 1))
    spot = (int(0.05 * width), int(0.62 * height))
    cv2.putText(image, text, spot, cv2.FONT_HERSHEY_DUPLEX, scale, (245, 245, 240), max(1, height // 26), cv2.LINE_AA)
    return image


def grille(size: Size) -> Rgb:
    """Draw the slots of an air vent."""
    image = np.full((*size, 3), 214, np.uint8)
    step = max(size[0] // 10, 3)
    for y in range(step, size[0] - step, step):
        image[y : y + step // 2, size[1] // 10 : -size[1] // 10] = 70
    return image


def calendar(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw a wall calendar: a picture above a table of days, some of them marked."""
    height, width = size
    image = np.full((height, width, 3), 246, np.uint8)
    image[: height // 2] = textures.photo(rng, (height // 2, width))
    for row in range(5):
        for col in range(7):
            x0, x1 = width * col // 7 + 2, width * (col + 1) // 7 - 2
            y0 = height // 2 + (height // 2) * row // 5 + 2
            y1 = height // 2 + (height // 2) * (row + 1) // 5 - 2
            cv2.rectangle(image, (x0, y0), (x1, y1), (170, 170, 170), 1)
            if rng.random() < 0.3:
                image[y0 + 2 : y1 - 1, x0 + 2 : x1 - 1] = colour(rng, low=90, high=240)
    return image


def window_view(rng: np.random.Generator, size: Size) -> Rgb:
    """Draw an overcast sky above pale roofs, almost burnt out."""
    height, width = size
    fade = np.linspace(252, 236, height, dtype=np.float32)[:, None] + fractal(rng, size, cell_px=width / 2, octaves=2)
    image = to_bytes(np.repeat(fade[..., None], 3, axis=2))
    x = 0
    while x < width:
        step, top = int(width * rng.uniform(0.15, 0.4)), int(height * rng.uniform(0.68, 0.85))
        image[top:, x : x + step] = int(rng.integers(206, 226))
        x += step
    return image
