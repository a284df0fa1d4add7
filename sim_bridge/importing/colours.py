"""Turn the looks of a mesh's parts into the textures, texture coordinates and brightness of a scene."""

from __future__ import annotations

import dataclasses
import hashlib
import logging
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_bridge.importing.reading import Part
from sim_bridge.mesh import Rgb

Array = NDArray[np.float64]
Ints = NDArray[np.int32]

GREY = (150, 150, 150)
# Texels of all textures together; each takes about six bytes in memory.
MOST_TEXELS = 100_000_000
LARGEST_TEXTURE_PX = 4096
# A face shows at most about so many repeats of its texture; larger ones are cut.
MOST_REPEATS = 4
MOST_FACES = 4_000_000
# Texture coordinates that leave their image by less than this are clamped, not repeated.
SLACK = 0.02
# The texture of all hues, for colours of vertices.
HUES = 256

_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True, eq=False)
class Painted:
    """A mesh as `Scene` has it: vertices, faces, and per face corner uv and shade, and the texture of each face."""

    vertices: Array
    faces: Ints
    uv: NDArray[np.float32]
    shade: NDArray[np.float32]
    texture: Ints
    textures: tuple[Rgb, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class _Piece:
    vertices: Array
    faces: Ints
    uv: Array
    shade: Array
    texture: int


def paint(parts: Sequence[Part]) -> Painted:
    """Return parts as one mesh with textures within MOST_TEXELS; what has no image and no colour is GREY."""
    palette = _Palette()
    pieces = [piece for part in parts for piece in _painted(part, palette)]
    starts = np.cumsum([0] + [len(p.vertices) for p in pieces])
    counts = [len(p.faces) for p in pieces]
    return Painted(
        vertices=np.concatenate([p.vertices for p in pieces]),
        faces=np.concatenate([p.faces + np.int32(s) for p, s in zip(pieces, starts[:-1], strict=True)]),
        uv=np.concatenate([p.uv for p in pieces]).astype(np.float32),
        shade=np.concatenate([p.shade for p in pieces]).astype(np.float32),
        texture=np.repeat([p.texture for p in pieces], counts).astype(np.int32),
        textures=_within_budget(palette.textures),
    )


class _Palette:
    """Collects textures, every one once."""

    def __init__(self) -> None:
        self.textures: list[Rgb] = []
        self._known: dict[bytes, int] = {}

    def number(self, image: Rgb) -> int:
        """Return the number of an image."""
        key = hashlib.blake2b(image.tobytes()).digest() + repr(image.shape).encode()
        if key not in self._known:
            self._known[key] = len(self.textures)
            self.textures.append(image)
        return self._known[key]


def _painted(part: Part, palette: _Palette) -> list[_Piece]:
    ones = np.ones((len(part.faces), 3))
    if part.corner_rgb is not None:
        uv, shade = hue_and_brightness(part.corner_rgb)
        return [_Piece(part.vertices, part.faces, uv, shade, palette.number(all_hues()))]
    if part.image is None or part.uv is None:
        colour = np.full((1, 1, 3), part.rgb or GREY, np.uint8)
        return [_Piece(part.vertices, part.faces, np.full((len(part.faces), 3, 2), 0.5), ones, palette.number(colour))]
    uv = part.uv - np.floor(part.uv.min(axis=1, keepdims=True) + SLACK)
    repeated = uv.max(axis=(1, 2)) > 1.0 + SLACK
    pieces = []
    if not repeated.all():
        plain = ~repeated
        faces, vertices = part.faces[plain], part.vertices
        pieces.append(_Piece(vertices, faces, uv[plain], ones[plain], palette.number(part.image)))
    if repeated.any():
        vertices, faces, uv = _cut(part.vertices, part.faces[repeated], uv[repeated])
        uv = uv - np.floor(uv.min(axis=1, keepdims=True) + SLACK)
        across, down = (max(1, int(np.ceil(m - SLACK))) for m in uv.max(axis=(0, 1)))
        number = palette.number(_tiled(part.image, across, down))
        pieces.append(_Piece(vertices, faces, uv / (across, down), np.ones((len(faces), 3)), number))
    return pieces


def _cut(vertices: Array, faces: Ints, uv: Array) -> tuple[Array, Ints, Array]:
    """Halve faces until none shows more than MOST_REPEATS of its texture along an edge."""
    for _ in range(40):
        spans = np.abs(uv - np.roll(uv, -1, axis=1)).max(axis=2)
        large = np.flatnonzero(spans.max(axis=1) > MOST_REPEATS)
        if not len(large) or len(faces) + len(large) > MOST_FACES:
            break
        # Turned so that the longest edge comes first.
        turned = (spans[large].argmax(axis=1)[:, None] + np.arange(3)) % 3
        old, t = np.take_along_axis(faces[large], turned, axis=1), np.take_along_axis(uv[large], turned[..., None], 1)
        middle = (len(vertices) + np.arange(len(large))).astype(np.int32)
        t_middle = 0.5 * (t[:, 0] + t[:, 1])
        vertices = np.concatenate([vertices, 0.5 * (vertices[old[:, 0]] + vertices[old[:, 1]])])
        faces, uv = faces.copy(), uv.copy()
        faces[large] = np.stack([old[:, 0], middle, old[:, 2]], axis=1)
        uv[large] = np.stack([t[:, 0], t_middle, t[:, 2]], axis=1)
        faces = np.concatenate([faces, np.stack([middle, old[:, 1], old[:, 2]], axis=1)])
        uv = np.concatenate([uv, np.stack([t_middle, t[:, 1], t[:, 2]], axis=1)])
    return vertices, faces, uv


def _tiled(image: Rgb, across: int, down: int) -> Rgb:
    """Return an image repeated; one that grows too large is made smaller."""
    height, width = image.shape[:2]
    scale = min(1.0, LARGEST_TEXTURE_PX / max(width * across, height * down))
    return np.tile(_scaled(image, scale), (down, across, 1))


def _scaled(image: Rgb, scale: float) -> Rgb:
    if scale >= 1.0:
        return image
    height, width = image.shape[:2]
    size = (max(1, int(width * scale)), max(1, int(height * scale)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8).reshape(*size[::-1], 3)


def _within_budget(textures: list[Rgb]) -> tuple[Rgb, ...]:
    texels = sum(t.shape[0] * t.shape[1] for t in textures)
    if texels <= MOST_TEXELS:
        return tuple(textures)
    scale = float(np.sqrt(MOST_TEXELS / texels))
    _log.info("textures of %.0f million texels are made smaller, to %.2f of their sides", texels / 1e6, scale)
    return tuple(_scaled(t, scale) for t in textures)


def all_hues() -> Rgb:
    """Return the texture of all hues at full brightness: u is the share of red, v that of green, the rest is blue."""
    share = np.arange(HUES) / (HUES - 1)
    red, green = np.broadcast_arrays(share[None, :], share[:, None])
    rgb = np.stack([red, green, np.maximum(1.0 - red - green, 0.0)], axis=2)
    hues: Rgb = np.rint(255.0 * rgb / rgb.max(axis=2, keepdims=True)).astype(np.uint8)
    return hues


def hue_and_brightness(rgb: Rgb) -> tuple[Array, Array]:
    """Return uv f64[m,3,2] into `all_hues` and brightness f64[m,3] that together give colours uint8[m,3,3]."""
    values = rgb.astype(np.float64)
    total = values.sum(axis=2, keepdims=True)
    share = np.where(total > 0, values / np.maximum(total, 1.0), 1.0 / 3.0)[..., :2]
    return (0.5 + share * (HUES - 1)) / HUES, values.max(axis=2) / 255.0
