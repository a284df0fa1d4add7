"""Walls, floors and cloths of the test scenes: nearly blank or repeating images, uint8 RGB, sized (height, width)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_bridge.scenes.textures import fractal, tinted, to_bytes

Rgb = NDArray[np.uint8]


def coat(rng: np.random.Generator, size: tuple[int, int], *, base: ArrayLike) -> Rgb:
    """Draw a rolled coat of paint: one colour but for a grey level."""
    return tinted(base, 1.1 * fractal(rng, size, cell_px=max(size) / 3, octaves=2))


def two_tone(
    rng: np.random.Generator, size: tuple[int, int], *, upper: ArrayLike, lower: ArrayLike, share: float
) -> Rgb:
    """Draw a wall in two colours with a thin line between them; ``share`` of its height is the lower one."""
    image = coat(rng, size, base=upper)
    edge = round(size[0] * (1.0 - share))
    image[edge:] = coat(rng, (size[0] - edge, size[1]), base=lower)
    image[edge - 2 : edge + 2] = np.asarray(lower) * 0.75
    return image


def bands(
    rng: np.random.Generator,
    size: tuple[int, int],
    *,
    base: ArrayLike,
    period_px: float,
    depth: float,
    upright: bool,
) -> Rgb:
    """Draw soft stripes of one period, upright or level, that are all alike; ``depth`` is in grey levels."""
    length = size[1] if upright else size[0]
    wave = np.clip(2.2 * np.sin(2 * np.pi * np.arange(length) / period_px), -1, 1).astype(np.float32)
    change = np.broadcast_to(wave[None, :] if upright else wave[:, None], size)
    return tinted(base, depth * change + 0.8 * fractal(rng, size, cell_px=max(size) / 2, octaves=2))


def tiled(tile: Rgb, size: tuple[int, int]) -> Rgb:
    """Repeat an image until it fills a size."""
    rows, cols = -(-size[0] // tile.shape[0]), -(-size[1] // tile.shape[1])
    return np.ascontiguousarray(np.tile(tile, (rows, cols, 1))[: size[0], : size[1]])


def flecked(rng: np.random.Generator, size: tuple[int, int], *, base: ArrayLike, tile_px: int) -> Rgb:
    """Draw sheet flooring whose flecks repeat with a period, worn a little."""
    grain = cv2.GaussianBlur(rng.standard_normal((tile_px, tile_px)).astype(np.float32), (0, 0), 1.6)
    flecks = tinted(base, 5.0 * np.sign(grain) * (np.abs(grain) > 0.28))
    worn = 1.6 * fractal(rng, size, cell_px=3.0 * tile_px, octaves=3)
    return to_bytes(tiled(flecks, size) + worn[..., None])


def slabs(rng: np.random.Generator, size: tuple[int, int], *, base: ArrayLike, other: ArrayLike, cell_px: int) -> Rgb:
    """Draw a floor of square slabs in two tones like a chessboard, with joints."""
    tile = np.empty((2 * cell_px, 2 * cell_px, 3), np.uint8)
    tile[:] = np.asarray(base)
    tile[:cell_px, :cell_px] = tile[cell_px:, cell_px:] = np.asarray(other)
    joint = to_bytes(np.asarray(base, dtype=np.float32) * 0.72)
    tile[::cell_px] = tile[:, ::cell_px] = joint
    worn = 2.0 * fractal(rng, size, cell_px=6.0 * cell_px, octaves=3)
    return to_bytes(tiled(tile, size) + worn[..., None])


def basket(rng: np.random.Generator, size: tuple[int, int], *, base: ArrayLike, cell_px: int) -> Rgb:
    """Draw parquet in a basket weave: squares of four staves that lie across each other, repeated."""
    staves = np.repeat(rng.normal(0, 7, 4).astype(np.float32), -(-cell_px // 4))[:cell_px]
    square = np.broadcast_to(staves[:, None], (cell_px, cell_px)).copy()
    square[:: -(-cell_px // 4)] -= 26
    turned = square.T
    weave = np.concatenate([np.concatenate([square, turned], 1), np.concatenate([turned, square], 1)], 0)
    worn = 2.0 * fractal(rng, size, cell_px=8.0 * cell_px, octaves=4)
    return to_bytes(tiled(tinted(base, weave), size) + worn[..., None])


def veneer(rng: np.random.Generator, size: tuple[int, int], *, base: ArrayLike, upright: bool) -> Rgb:
    """Draw wood with a soft grain."""
    height, width = size if not upright else size[::-1]
    lines = fractal(rng, (height, max(width // 24, 2)), cell_px=max(height / 9, 2.0), octaves=3)
    grain = cv2.resize(lines, (width, height), interpolation=cv2.INTER_LINEAR)
    return tinted(base, 4.0 * (grain.T if upright else grain))


def grid_ceiling(size: tuple[int, int], *, base: ArrayLike, cell_px: int) -> Rgb:
    """Draw a ceiling of equal square plates."""
    tile = np.empty((cell_px, cell_px, 3), np.uint8)
    tile[:] = np.asarray(base)
    tile[0] = tile[:, 0] = to_bytes(np.asarray(base, dtype=np.float32) * 0.88)
    return tiled(tile, size)


def pleats(size: tuple[int, int], *, base: ArrayLike, count: int) -> Rgb:
    """Draw a hanging cloth in equal folds."""
    fold = np.sin(2 * np.pi * count * (np.arange(size[1]) + 0.5) / size[1])
    return tinted(base, np.broadcast_to(13 * fold.astype(np.float32), size))


def weave(rng: np.random.Generator, size: tuple[int, int], *, base: ArrayLike, strength: float = 6.0) -> Rgb:
    """Draw coarse cloth or felt."""
    return tinted(base, strength * fractal(rng, size, cell_px=4, octaves=2))
