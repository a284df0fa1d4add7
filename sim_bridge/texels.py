"""Mip chains: every texture halved down to one texel, packed for the renderer."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Rgb = NDArray[np.uint8]
Words = NDArray[np.uint32]
Longs = NDArray[np.int64]

# Enough for textures of 2 ** 15 texels along a side.
LEVELS = 16


@dataclasses.dataclass(frozen=True, eq=False)
class Mips:
    """Mip chains: ``texels`` uint32 (red, green << 21, blue << 10), ``levels`` int64[t,16,3].

    A level is its first texel, width and height; after a texture's last level of one texel that level repeats.
    Textures from number ``base`` on lie in ``added`` instead of ``texels``, so that scenes can share the large array.
    Both arrays end in unused texels, since a filter of 2x2 texels may read one row and column too far.
    """

    texels: Words
    added: Words
    levels: Longs
    base: int

    def extended(self, textures: Sequence[Rgb]) -> Mips:
        """Return the mip chains with further textures: ``texels`` is shared, only ``added`` is copied."""
        texels, levels = _chains(textures)
        kept = self.added[: len(self.added) - _margin(self.levels[self.base :])]
        levels[:, :, 0] += len(kept)
        return Mips(self.texels, np.concatenate([kept, texels]), np.concatenate([self.levels, levels]), self.base)


def mips(textures: Sequence[Rgb]) -> Mips:
    """Halve every texture (h, w, 3) down to one texel by exact area averages, in gamma space.

    Averages of linear light would move black-white edges by a quarter of a pixel and so bias the size of tags.
    """
    texels, levels = _chains(textures)
    return Mips(texels, np.zeros(0, np.uint32), levels, len(textures))


def _margin(levels: Longs) -> int:
    return int(levels[:, 0, 1].max()) + 2 if len(levels) else 0


def _chains(textures: Sequence[Rgb]) -> tuple[Words, Longs]:
    levels = np.zeros((len(textures), LEVELS, 3), np.int64)
    start = 0
    for t, image in enumerate(textures):
        height, width = image.shape[:2]
        for k in range(LEVELS):
            levels[t, k] = start, width, height
            if width > 1 or height > 1:
                start += width * height
                width, height = max(1, width // 2), max(1, height // 2)
        start += 1
    texels = np.zeros(start + _margin(levels), np.uint32)
    for t, image in enumerate(textures):
        _fill(texels, levels[t], image)
    return texels, levels


def _fill(texels: Words, levels: Longs, image: Rgb) -> None:
    level = image.astype(np.float32)
    for k, (start, width, height) in enumerate(levels):
        if k > 0:
            level = cv2.resize(level, (int(width), int(height)), interpolation=cv2.INTER_AREA)
        whole = (image if k == 0 else np.rint(level)).astype(np.uint32)
        into = texels[start : start + width * height].reshape(height, width)
        into[:] = whole[..., 0]
        into |= whole[..., 2] << np.uint32(10)
        into |= whole[..., 1] << np.uint32(21)
        if width == 1 and height == 1:
            break
