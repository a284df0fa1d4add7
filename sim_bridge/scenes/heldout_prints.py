"""Paper of the test scenes: lettering, notices, boards, signs, covers, book spines; uint8 RGB, (height, width)."""

from __future__ import annotations

import colorsys
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_bridge.scenes.heldout_surfaces import weave
from sim_bridge.scenes.textures import fractal, tinted, to_bytes

Rgb = NDArray[np.uint8]
Ink = tuple[int, int, int]
Picture = Callable[[np.random.Generator, tuple[int, int]], Rgb]

_SYLLABLES = (
    "ka",
    "re",
    "mo",
    "lin",
    "tor",
    "us",
    "pe",
    "ga",
    "dun",
    "ish",
    "vo",
    "al",
    "ne",
    "qui",
    "stra",
    "fel",
)
PLAIN, SMALL, SCRIPT = (
    cv2.FONT_HERSHEY_PLAIN,
    cv2.FONT_HERSHEY_COMPLEX_SMALL,
    cv2.FONT_HERSHEY_SCRIPT_SIMPLEX,
)
SLANTED = SMALL | cv2.FONT_ITALIC


def ink(rng: np.random.Generator, *, saturation: float = 0.7, value: float = 0.6, spread: float = 0.2) -> Ink:
    """Draw a colour of about this saturation and value, of any hue."""
    s, v = np.clip(np.array([saturation, value]) + rng.uniform(-spread, spread, 2), 0.0, 1.0)
    r, g, b = colorsys.hsv_to_rgb(float(rng.random()), float(s), float(v))
    return int(255 * r), int(255 * g), int(255 * b)


def filled(size: tuple[int, int], rgb: ArrayLike) -> Rgb:
    """Return an image of one colour."""
    image = np.empty((*size, 3), np.uint8)
    image[:] = np.asarray(rgb)
    return image


def word(rng: np.random.Generator) -> str:
    """Make up a word."""
    return "".join(rng.choice(_SYLLABLES, int(rng.integers(1, 4))))


def letter(
    image: Rgb,
    text: str,
    corner: tuple[float, float],
    height_px: float,
    rgb: Ink,
    *,
    font: int = SMALL,
    bold: int = 1,
) -> None:
    """Write text whose lower left corner is (x, y), with capitals of a height in pixels."""
    scale = cv2.getFontScaleFromHeight(font & 15, max(int(height_px), 2), bold)
    cv2.putText(image, text, (int(corner[0]), int(corner[1])), font, scale, rgb, bold, cv2.LINE_AA)


def paragraph(
    rng: np.random.Generator, image: Rgb, box: tuple[float, float, float, float], *, line_px: float, rgb: Ink
) -> None:
    """Fill a box (x0, y0, x1, y1) with lines of made-up words."""
    x0, y0, x1, y1 = box
    wide, y = max(int((x1 - x0) / (0.95 * line_px)), 1), y0 + line_px
    while y < y1:
        text = " ".join(word(rng) for _ in range(wide // 4 + 2))
        letter(image, text[: max(wide - int(rng.integers(0, 1 + wide // 3)), 1)], (x0, y), 0.5 * line_px, rgb)
        y += line_px


def emblem(rng: np.random.Generator, image: Rgb, centre: tuple[float, float], radius: float, rgb: Ink) -> None:
    """Draw a sign of a random sort: ring, star, arrow, cross, waves or drop."""
    middle = np.array(centre)
    kind = int(rng.integers(6))
    thick = max(int(0.28 * radius), 1)
    if kind == 0:
        cv2.circle(image, (int(middle[0]), int(middle[1])), int(0.8 * radius), rgb, thick, cv2.LINE_AA)
        cv2.line(image, *_ends(middle, 0.6 * radius, float(rng.uniform(0, np.pi))), rgb, thick, cv2.LINE_AA)
    elif kind == 1:
        arms = int(rng.integers(3, 8))
        angle = np.pi * np.arange(2 * arms) / arms + rng.uniform(0, np.pi)
        reach = np.where(np.arange(2 * arms) % 2, rng.uniform(0.35, 0.6), 1.0) * radius
        _polygon(image, middle + np.stack([np.cos(angle), np.sin(angle)], 1) * reach[:, None], rgb)
    elif kind == 2:
        arrow = np.array([[-1, -0.3], [0.1, -0.3], [0.1, -0.8], [1, 0], [0.1, 0.8], [0.1, 0.3], [-1, 0.3]]) * radius
        quarter = int(rng.integers(4))
        turn = np.linalg.matrix_power(np.array([[0, -1], [1, 0]]), quarter)
        _polygon(image, middle + arrow @ turn.T, rgb)
    elif kind == 3:
        first = float(rng.choice([0.0, np.pi / 4]))
        for tilt in (first, first + np.pi / 2):
            cv2.line(image, *_ends(middle, 0.8 * radius, tilt), rgb, 2 * thick, cv2.LINE_AA)
    elif kind == 4:
        x = np.linspace(-radius, radius, 40)
        for k in range(int(rng.integers(2, 5))):
            y = 0.25 * radius * np.sin(x / radius * rng.uniform(4, 9)) + (0.5 * k - 0.6) * radius
            cv2.polylines(image, [(middle + np.stack([x, y], 1)).astype(np.int32)], False, rgb, thick, cv2.LINE_AA)
    else:
        cv2.circle(image, (int(middle[0]), int(middle[1] + 0.3 * radius)), int(0.6 * radius), rgb, -1, cv2.LINE_AA)
        _polygon(image, middle + np.array([[-0.5, 0.1], [0, -1], [0.5, 0.1]]) * radius, rgb)


def _ends(middle: NDArray[np.float64], reach: float, angle: float) -> tuple[tuple[int, int], tuple[int, int]]:
    step = reach * np.array([np.cos(angle), np.sin(angle)])
    (x0, y0), (x1, y1) = middle - step, middle + step
    return (int(x0), int(y0)), (int(x1), int(y1))


def _polygon(image: Rgb, points: NDArray[np.float64], rgb: Ink) -> None:
    cv2.fillPoly(image, [np.rint(points).astype(np.int32)], rgb, cv2.LINE_AA)


def notice(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw a printed sheet: heading, emblem or picture, and text, in one of four layouts."""
    strong = ink(rng, saturation=0.75, value=0.55)
    image = filled(size, ink(rng, saturation=0.12, value=0.93, spread=0.07))
    layouts = (_headed, _edged, _illustrated, _numbered)
    layouts[int(rng.integers(len(layouts)))](rng, image, strong)
    return image


def _headed(rng: np.random.Generator, image: Rgb, strong: Ink) -> None:
    height, width = image.shape[:2]
    image[: int(rng.uniform(0.18, 0.3) * height)] = strong
    letter(image, word(rng).upper(), (0.07 * width, 0.16 * height), 0.09 * height, (245, 245, 240), bold=2)
    emblem(rng, image, (0.5 * width, 0.52 * height), 0.17 * min(height, width), strong)
    paragraph(rng, image, (0.08 * width, 0.72 * height, 0.92 * width, 0.94 * height), line_px=14, rgb=(50, 50, 55))


def _edged(rng: np.random.Generator, image: Rgb, strong: Ink) -> None:
    height, width = image.shape[:2]
    edge = int(rng.uniform(0.2, 0.34) * width)
    image[:, :edge] = strong
    for k in range(int(rng.integers(2, 5))):
        emblem(rng, image, (edge / 2, (0.14 + 0.24 * k) * height), 0.36 * edge, ink(rng, saturation=0.2, value=0.9))
    letter(image, word(rng), (edge + 0.05 * width, 0.17 * height), 0.1 * height, strong, font=SLANTED, bold=2)
    box = (edge + 0.06 * width, 0.26 * height, 0.95 * width, 0.92 * height)
    paragraph(rng, image, box, line_px=17, rgb=(60, 60, 60))


def _illustrated(rng: np.random.Generator, image: Rgb, strong: Ink) -> None:
    height, width = image.shape[:2]
    photo = tinted(ink(rng, value=0.5), 34 * fractal(rng, (height // 2, width), cell_px=width / 3, octaves=5))
    image[: height // 2] = photo
    for _ in range(int(rng.integers(2, 6))):
        where = (float(rng.uniform(0.1, 0.9)) * width, float(rng.uniform(0.1, 0.4)) * height)
        emblem(rng, image, where, float(rng.uniform(0.06, 0.16)) * width, ink(rng))
    letter(image, f"{word(rng)} {word(rng)}", (0.06 * width, 0.64 * height), 0.07 * height, strong, bold=2)
    paragraph(rng, image, (0.06 * width, 0.7 * height, 0.94 * width, 0.95 * height), line_px=15, rgb=(40, 40, 60))


def _numbered(rng: np.random.Generator, image: Rgb, strong: Ink) -> None:
    height, width = image.shape[:2]
    image[:] = strong
    letter(image, str(rng.integers(10, 99)), (0.1 * width, 0.5 * height), 0.34 * height, (250, 240, 210), bold=9)
    for k in range(3):
        letter(image, word(rng), (0.1 * width, (0.66 + 0.12 * k) * height), 0.06 * height, (240, 240, 240), bold=2)
    cv2.rectangle(image, (4, 4), (width - 5, height - 5), (235, 230, 215), 3)


def pinboard(rng: np.random.Generator, size: tuple[int, int], *, base: ArrayLike, sheets: int) -> Rgb:
    """Draw a felt board with pinned sheets, some askew, some over one another."""
    height, width = size
    image = weave(rng, size, base=base, strength=4.0)
    for _ in range(sheets):
        h = int(min(rng.uniform(60, 170), 0.7 * height))
        w = int(min(h * rng.uniform(0.6, 1.4), 0.6 * width))
        x, y = rng.uniform(0.02, 0.98) * (width - w), rng.uniform(0.04, 0.96) * (height - h)
        angle = float(rng.normal(0, 3))
        move = cv2.getRotationMatrix2D((w / 2, h / 2), angle, 1.0)
        move[:, 2] += (x, y)
        sheet = notice(rng, (h, w))
        mask = cv2.warpAffine(np.full((h, w), 255, np.uint8), move, (width, height))
        pasted = cv2.warpAffine(sheet, move, (width, height))
        image[mask > 128] = pasted[mask > 128]
        cv2.circle(image, (int(x + w / 2), int(y + 8)), 4, ink(rng, value=0.7), -1, cv2.LINE_AA)
    return image


def number_sign(rng: np.random.Generator, size: tuple[int, int], *, text: str, base: Ink) -> Rgb:
    """Draw a small sign with a number or letters and a line of text."""
    height, width = size
    image = filled(size, base)
    letter(image, text, (0.1 * width, 0.62 * height), 0.45 * height, (250, 250, 250), bold=max(height // 22, 2))
    letter(image, f"{word(rng)} {word(rng)}", (0.1 * width, 0.86 * height), 0.12 * height, (235, 235, 235))
    return image


def cover(rng: np.random.Generator, size: tuple[int, int]) -> Rgb:
    """Draw the cover of a book or magazine."""
    height, width = size
    image = tinted(ink(rng, value=0.65), 18 * fractal(rng, size, cell_px=width / 2, octaves=4))
    for _ in range(int(rng.integers(1, 6))):
        where = float(rng.uniform(0.2, 0.8)) * width, float(rng.uniform(0.35, 0.85)) * height
        emblem(rng, image, where, float(rng.uniform(0.1, 0.32)) * width, ink(rng, value=0.75))
    letter(image, word(rng).upper(), (0.08 * width, 0.18 * height), 0.11 * height, (250, 248, 240), bold=3)
    letter(image, word(rng), (0.08 * width, 0.27 * height), 0.05 * height, (245, 245, 220), font=SLANTED)
    return image


def spines(rng: np.random.Generator, size: tuple[int, int], *, series: bool, full: float = 1.0) -> Rgb:
    """Draw a shelf's books side by side: a series of equal volumes, or all sorts; ``full`` is the share filled."""
    height, width = size
    image = filled(size, (34, 30, 28))
    cloth, gilt = ink(rng, saturation=0.55, value=0.4), (214, 190, 120)
    x, tall, thick = 1, int(rng.uniform(0.72, 0.9) * height), int(rng.uniform(10, 15))
    volume = int(rng.integers(1, 60))
    while x < full * width - 6:
        if not series:
            cloth = ink(rng, saturation=0.5, value=0.55, spread=0.35)
            gilt = ink(rng, saturation=0.3, value=0.85 if sum(cloth) < 330 else 0.2)
            tall, thick = int(rng.uniform(0.55, 0.97) * height), int(rng.uniform(6, 19))
        end, top = min(x + thick, width), height - tall
        image[top:, x : end - 1] = cloth
        for level in (0.12, 0.2, 0.82) if series else np.sort(rng.uniform(0.05, 0.95, int(rng.integers(0, 4)))):
            image[top + int(level * tall) : top + int(level * tall) + 3, x : end - 1] = gilt
        if thick > 11 and series:
            letter(image, str(volume), (x + 1, top + 0.62 * tall), 7, gilt, font=PLAIN)
        elif thick > 9:
            _upright_title(rng, image, (x, top + int(0.25 * tall)), (int(0.5 * tall), thick - 4), gilt)
        x, volume = end, volume + 1
        if not series and rng.random() < 0.06:
            x += int(rng.uniform(8, 40))
    return image


def _upright_title(
    rng: np.random.Generator, image: Rgb, corner: tuple[int, int], size: tuple[int, int], rgb: Ink
) -> None:
    x, y = corner
    patch = image[y : y + size[0], x + 1 : x + 1 + size[1]]
    turned = np.ascontiguousarray(np.rot90(patch))
    letter(turned, word(rng) + word(rng), (2, 0.8 * turned.shape[0]), 0.6 * turned.shape[0], rgb, font=PLAIN)
    patch[:] = np.rot90(turned, -1)


def speckled(rng: np.random.Generator, size: tuple[int, int], *, base: ArrayLike) -> Rgb:
    """Draw stone: fine speckles and a few veins."""
    image = 14 * fractal(rng, size, cell_px=6, octaves=2) + 8 * fractal(rng, size, cell_px=max(size) / 3, octaves=4)
    return to_bytes(np.asarray(base, dtype=np.float32) + image[..., None])
