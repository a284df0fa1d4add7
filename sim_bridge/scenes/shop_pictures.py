"""Pictures of the shop: packages, price rails, promotional signs, boards, doors of fridges."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from sim_bridge.scenes import prints
from sim_bridge.scenes.prints import Ink
from sim_bridge.scenes.textures import Rgb, fractal, tinted, to_bytes

PX_PER_M = 400


@dataclasses.dataclass(frozen=True, eq=False)
class Product:
    """A package: its name, size (width, height) in m, front picture and the colour of its sides."""

    name: str
    size_m: tuple[float, float]
    front: Rgb
    side: Ink


def product(rng: np.random.Generator, size_m: tuple[float, float]) -> Product:
    """Draw a package of a size: a brand on a band, a form or a stripe, small print."""
    width, height = (int(s * PX_PER_M) for s in size_m)
    base, second, third = prints.hue(rng), prints.hue(rng, bright=(0.6, 1.0)), prints.hue(rng, strong=(0.0, 0.4))
    image = prints.sheet((height, width), base)
    style = int(rng.integers(4))
    if style == 0:
        cv2.rectangle(image, (0, int(0.55 * height)), (width, height), second, -1)
    elif style == 1:
        prints.blob(rng, image, (width / 2, 0.65 * height), 0.28 * min(width, height), ink=second)
    elif style == 2:
        for x in range(0, width, max(width // 5, 4)):
            cv2.line(image, (x, 0), (x + width // 3, height), second, max(width // 14, 1))
    else:
        cv2.circle(image, (width // 2, int(0.62 * height)), int(0.3 * min(width, height)), second, -1, cv2.LINE_AA)
        prints.blob(rng, image, (width / 2, 0.62 * height), 0.16 * min(width, height), ink=base)
    top, name = int(rng.uniform(0.08, 0.25) * height), prints.word(rng)
    bottom = top + max(int(0.2 * height), 9)
    cv2.rectangle(image, (0, top), (width, bottom), third, -1)
    dark = (15, 15, 40) if sum(third) > 330 else (245, 245, 235)
    prints.lettering(image, name, (2, top, width - 2, bottom), ink=dark, weight=1.4)
    low = int(0.86 * height)
    cv2.rectangle(image, (int(0.15 * width), low), (int(0.7 * width), low + max(height // 30, 2)), third, -1)
    edge = (int(0.6 * base[0]), int(0.6 * base[1]), int(0.6 * base[2]))
    return Product(name, size_m, prints.framed(image, ink=edge, px=1), base)


def facing(article: Product, count: int) -> Rgb:
    """Draw one article set beside itself ``count`` times."""
    return prints.columns([article.front] * count)


def price_rail(width_m: float) -> Rgb:
    """Draw the rail in front of a board: pale tags whose print is too small to see, so that rails tell nothing."""
    image = prints.sheet((20, int(width_m * 500)), (208, 210, 210))
    for x in np.arange(0.1, width_m - 0.06, 0.2) * 500:
        cv2.rectangle(image, (int(x), 3), (int(x) + 30, 16), (226, 226, 216), -1)
    return image


def promotion(rng: np.random.Generator, size_m: tuple[float, float], *, px_per_m: int = 340) -> Rgb:
    """Draw a promotional sign: a huge price in a star, a name, forms in the background."""
    width, height = (int(s * px_per_m) for s in size_m)
    base = prints.hue(rng)
    image = prints.sheet((height, width), base)
    image = to_bytes(image + 14 * fractal(rng, (height, width), cell_px=min(width, height) / 4, octaves=3)[..., None])
    for _ in range(int(rng.integers(4, 9))):
        spot = (float(rng.uniform(0, width)), float(rng.uniform(0, height)))
        prints.blob(rng, image, spot, min(width, height) * float(rng.uniform(0.05, 0.18)), ink=prints.hue(rng))
    ink: Ink = (250, 250, 240) if sum(base) < 420 else (20, 20, 30)
    band = int(height * rng.uniform(0.2, 0.3))
    top = 0 if rng.random() < 0.6 else height - band
    cv2.rectangle(image, (0, top), (width, top + band), tuple(int(0.45 * c) for c in base), -1)
    prints.lettering(image, prints.word(rng), (width // 20, top, width - width // 20, top + band), ink=(250, 250, 240))
    middle = (int(width * rng.uniform(0.3, 0.7)), int(height * (0.64 if top == 0 else 0.36)))
    radius = 0.36 * min(width, height)
    prints.burst(image, middle, radius, ink=prints.hue(rng, strong=(0.8, 1.0), bright=(0.85, 1.0)))
    price = f"-{rng.integers(10, 60)}%" if rng.random() < 0.4 else f"{rng.integers(1, 19)}.{rng.integers(10, 99)}"
    reach = int(0.72 * radius)
    box = (middle[0] - reach, middle[1] - reach, middle[0] + reach, middle[1] + reach)
    prints.lettering(image, price, box, ink=(20, 20, 24), font=prints.FONTS[3], weight=1.3)
    low = int(0.92 * height) if top == 0 else int(0.72 * height)
    prints.lines(rng, image, (width // 20, low - height // 9, width // 2, low), line_px=max(height // 22, 7), ink=ink)
    return prints.framed(image, ink=ink, px=max(min(width, height) // 60, 2))


def category(rng: np.random.Generator, size_m: tuple[float, float], number: int) -> Rgb:
    """Draw the sign that hangs over an aisle: a number and two words."""
    width, height = (int(s * 340) for s in size_m)
    image = prints.sheet((height, width), (30, 92, 60))
    cv2.rectangle(image, (6, 6), (int(0.28 * width), height - 6), (245, 245, 235), -1)
    prints.lettering(image, str(number), (6, 6, int(0.28 * width), height - 6), ink=(30, 92, 60), weight=2.0)
    for i in range(2):
        box = (int(0.33 * width), int(height * (0.08 + 0.44 * i)), int(0.97 * width), int(height * (0.48 + 0.44 * i)))
        prints.lettering(image, prints.word(rng, syllables=3), box, ink=(245, 245, 235))
    return image


def notices(rng: np.random.Generator, size_m: tuple[float, float]) -> Rgb:
    """Draw a cork board with notes of all sizes pinned on it."""
    width, height = (int(s * 380) for s in size_m)
    image = tinted((170, 128, 86), 9 * fractal(rng, (height, width), cell_px=5, octaves=2))
    for _ in range(16):
        w, h = int(rng.uniform(0.1, 0.26) * width), int(rng.uniform(0.16, 0.4) * height)
        x, y = int(rng.uniform(8, width - w - 8)), int(rng.uniform(8, height - h - 8))
        note = prints.sheet((h, w), prints.hue(rng, strong=(0.05, 0.5), bright=(0.8, 1.0)))
        ink = prints.hue(rng, bright=(0.1, 0.4))
        if rng.random() < 0.5:
            prints.blob(rng, note, (w / 2, 0.6 * h), 0.25 * min(w, h), ink=prints.hue(rng))
        prints.lettering(note, prints.word(rng), (2, 2, w - 2, h // 3), ink=ink)
        prints.lines(rng, note, (4, h // 3, w - 4, h - 4), line_px=9, ink=ink)
        image[y : y + h, x : x + w] = note
        cv2.circle(image, (x + w // 2, y + 4), 4, prints.hue(rng), -1, cv2.LINE_AA)
    return prints.framed(image, ink=(90, 66, 44), px=6)


def fridge_door(rng: np.random.Generator, size_m: tuple[float, float], articles: list[Product]) -> Rgb:
    """Draw a glass door with rows of articles behind it, in the cold light of the fridge."""
    width, height = (int(s * 260) for s in size_m)
    image = prints.sheet((height, width), (42, 50, 56))
    rows = 5
    step = (height - 30) // rows
    for i in range(rows):
        bottom = 15 + (i + 1) * step
        x = 16
        while x < width - 20:
            front = articles[int(rng.integers(len(articles)))]
            scale = min(0.85 * step / front.front.shape[0], 0.65)
            small = cv2.resize(front.front, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            for _ in range(int(rng.integers(2, 5))):
                h, w = small.shape[:2]
                if x + w > width - 16:
                    x = width
                    break
                image[bottom - h : bottom, x : x + w] = small
                x += w + 2
        cv2.rectangle(image, (12, bottom), (width - 12, bottom + 4), (205, 212, 216), -1)
    cool = image.astype(np.float32) * 0.8 + np.array([26, 32, 36], np.float32)
    shine = np.clip(1 - np.abs(np.linspace(-1.4, 2.2, width)), 0, 1).astype(np.float32)
    image = to_bytes(cool + 14 * shine[None, :, None])
    prints.framed(image, ink=(70, 74, 78), px=9)
    cv2.rectangle(image, (width - 26, height // 3), (width - 18, 2 * height // 3), (190, 194, 198), -1)
    return image


def cold_panel(size_m: tuple[float, float]) -> Rgb:
    """Draw the insulated wall of a cold store: white panels with soft upright joints."""
    image = prints.sheet((int(size_m[1] * 100), int(size_m[0] * 100)), (214, 217, 218))
    for x in range(0, image.shape[1], 115):
        image[:, x : x + 2] = (188, 192, 194)
        image[:, x + 2 : x + 4] = (226, 228, 229)
    return image


def crate_of_fruit(rng: np.random.Generator, size_m: tuple[float, float]) -> Rgb:
    """Draw a crate of fruit seen from above."""
    width, height = (int(s * PX_PER_M) for s in size_m)
    image = prints.sheet((height, width), (70, 52, 34))
    base = np.array(prints.hue(rng, strong=(0.6, 0.95), bright=(0.5, 0.9)), np.float64)
    radius = int(rng.uniform(9, 16))
    for y in range(radius, height, int(1.6 * radius)):
        for x in range(radius, width, int(1.7 * radius)):
            spot = (x + int(rng.integers(-3, 4)), y + int(rng.integers(-3, 4)))
            tone = base * rng.uniform(0.8, 1.1)
            ink = (int(min(tone[0], 255)), int(min(tone[1], 255)), int(min(tone[2], 255)))
            cv2.circle(image, spot, radius, tuple(int(0.6 * c) for c in ink), -1, cv2.LINE_AA)
            cv2.circle(image, (spot[0] - 2, spot[1] - 2), radius - 2, ink, -1, cv2.LINE_AA)
    return prints.framed(image, ink=(126, 96, 62), px=5)


def belt(length_m: float) -> Rgb:
    """Draw the belt of a checkout."""
    return prints.sheet((8, int(length_m * 20)), (44, 46, 50))


def screen(rng: np.random.Generator, size_m: tuple[float, float]) -> Rgb:
    """Draw the screen of a till."""
    width, height = (int(s * 500) for s in size_m)
    image = prints.sheet((height, width), (26, 40, 62))
    for j in range(3):
        for i in range(4):
            box = (8 + i * width // 5, 8 + j * height // 4, i * width // 5 + width // 5, j * height // 4 + height // 4)
            cv2.rectangle(image, box[:2], box[2:], prints.hue(rng), -1)
    prints.lines(rng, image, (8, 3 * height // 4, width - 8, height - 4), line_px=10, ink=(230, 230, 230))
    return prints.framed(image, ink=(16, 16, 18), px=4)
