"""What a foreign mesh looks like: its textures, plain colours and vertex colours, as textures of a scene."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.mesh import Array, Rgb

if TYPE_CHECKING:
    from PIL.Image import Image
    from trimesh import Trimesh

GREY = (128, 128, 128)
# Sides of the texture in which vertex colours are looked up.
CHROMA_PX = 256
# A texture that repeats is copied side by side up to this size; beyond, triangles are cut at its borders.
TILED_PX = 2048
# A triangle over more repetitions than this is not cut.
MOST_TILES = 400
OPAQUE = 64


@dataclasses.dataclass(frozen=True, eq=False)
class Skin:
    """The look of one part of a mesh: texture coordinates f64[m,3,2] (v downwards), shades f64[m,3], an image.

    ``key`` tells images apart. ``missing`` says that the part has no colour of its own; ``kept`` bool[m] leaves out
    faces that are transparent.
    """

    uv: Array
    shade: Array
    image: Rgb
    key: object
    missing: bool
    kept: NDArray[np.bool_]


def skin_of(part: Trimesh, *, missing: bool = False) -> Skin:
    """Return the look of a part: its texture, else its vertex or face colours, else its plain colour, else grey."""
    count = len(part.faces)
    visual: Any = part.visual
    if visual.kind in ("vertex", "face"):
        per_vertex = visual.kind == "vertex"
        rgba = visual.vertex_colors[part.faces] if per_vertex else np.repeat(visual.face_colors[:, None], 3, axis=1)
        return _coloured(np.asarray(rgba)[..., :3])
    if visual.kind != "texture":
        return _plain(count, GREY, missing=True)
    material = visual.material
    image, factor, see_through = _material(material)
    uv = visual.uv
    if image is not None and uv is not None and len(uv) == len(part.vertices):
        return _textured(np.asarray(uv, dtype=np.float64)[part.faces], image, factor, see_through=see_through)
    white = factor is None or min(factor[:3]) >= 1.0
    if missing or image is not None or (white and uv is not None) or factor is None:
        return _plain(count, GREY, missing=True)
    skin = _plain(count, tuple(round(255 * c) for c in factor[:3]), missing=False)
    return dataclasses.replace(skin, kept=np.full(count, not see_through or factor[3] * 255 >= OPAQUE))


def chroma_texture() -> Rgb:
    """Draw all colours without their brightness: red's share of the sum to the right, green's downwards.

    With the brightest channel as shade, three corners' colours vary between them as in any renderer of vertex
    colours, and need no texels of their own.
    """
    share = (np.arange(CHROMA_PX) + 0.5) / CHROMA_PX
    red, green = np.broadcast_to(share[None, :], (CHROMA_PX, CHROMA_PX)), share[:, None]
    # Beyond the line without blue the nearest colour goes on, for filters that reach over it.
    over = np.maximum(red + green - 1.0, 0.0) / 2
    shares = np.stack([red - over, green - over, np.maximum(1.0 - red - green, 0.0)], axis=-1).clip(0.0, 1.0)
    return np.rint(255 * shares / shares.max(axis=-1, keepdims=True)).astype(np.uint8)


def _coloured(rgb: NDArray[np.uint8]) -> Skin:
    colour = rgb.astype(np.float64)
    total = colour.sum(axis=2, keepdims=True)
    # Black has no hue: that of its neighbours would do, grey does as well.
    uv = np.where(total > 0, colour[..., :2] / np.maximum(total, 1.0), 1.0 / 3.0)
    kept = np.ones(len(colour), np.bool_)
    return Skin(uv, colour.max(axis=2) / 255.0, chroma_texture(), "chroma", missing=False, kept=kept)


def _plain(count: int, rgb: tuple[int, ...], *, missing: bool) -> Skin:
    image = np.array(rgb, np.uint8).reshape(1, 1, 3)
    return Skin(np.zeros((count, 3, 2)), np.ones((count, 3)), image, rgb, missing, np.ones(count, np.bool_))


def _material(material: Any) -> tuple[Image | None, tuple[float, ...] | None, bool]:
    """Return a material's image, its colour (four numbers 0..1, gamma encoded), and whether it may be see-through."""
    if hasattr(material, "baseColorTexture"):
        factor = material.baseColorFactor
        see_through = material.alphaMode in ("BLEND", "MASK")
        if factor is None:
            return material.baseColorTexture, (1.0, 1.0, 1.0, 1.0), see_through
        linear = np.asarray(factor, dtype=np.float64).ravel()
        linear = np.clip(linear / (255.0 if np.asarray(factor).dtype.kind in "ui" else 1.0), 0.0, 1.0)
        alpha = float(linear[3]) if len(linear) > 3 else 1.0
        return material.baseColorTexture, (*(float(c) ** (1 / 2.2) for c in linear[:3]), alpha), see_through
    image = getattr(material, "image", None)
    diffuse = getattr(material, "diffuse", None)
    if image is not None or diffuse is None:
        return image, (1.0, 1.0, 1.0, 1.0) if image is not None else None, image is not None and image.mode == "RGBA"
    return None, tuple(float(c) / 255.0 for c in np.asarray(diffuse).ravel()[:4]), False


def _textured(uv: Array, image: Image, factor: tuple[float, ...] | None, *, see_through: bool) -> Skin:
    """Return a part's look with an image; faces on which all of it is transparent are left out."""
    rgba = np.asarray(image.convert("RGBA"))
    rgb, alpha = rgba[..., :3], rgba[..., 3]
    uv = np.nan_to_num(uv, posinf=0.0, neginf=0.0)
    uv = np.stack([uv[..., 0], 1.0 - uv[..., 1]], axis=-1)
    kept = np.ones(len(uv), np.bool_)
    if see_through:
        mixes = np.array([(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (0, 1, 1), (1, 0, 1), (1, 1, 1)])
        spots = np.einsum("sc,fcx->fsx", mixes / mixes.sum(axis=1, keepdims=True), uv) % 1.0
        height, width = alpha.shape
        rows, columns = (spots[..., 1] * height).astype(int), (spots[..., 0] * width).astype(int)
        strength = 1.0 if factor is None else factor[3]
        kept = (alpha[rows.clip(0, height - 1), columns.clip(0, width - 1)] * strength).max(axis=1) >= OPAQUE
        if (alpha < 255).any() and (alpha > 0).any():
            # What is left of a transparent background takes the colour of what is in front of it.
            mean = np.average(rgb.reshape(-1, 3), axis=0, weights=alpha.ravel())
            share = alpha[..., None] / 255.0
            rgb = np.rint(share * rgb + (1.0 - share) * mean).astype(np.uint8)
    tint = (1.0, 1.0, 1.0) if factor is None else factor[:3]
    if min(tint) < 1.0:
        rgb = np.rint(rgb * np.asarray(tint)).astype(np.uint8)
    key = (rgb.shape, tint, see_through, hash(rgba.tobytes()))
    return Skin(uv, np.ones(uv.shape[:2]), np.ascontiguousarray(rgb), key, missing=False, kept=kept)


def wrapped(uv: Array) -> tuple[Array, NDArray[np.int64]]:
    """Shift each face's texture coordinates f64[m,3,2] by whole repetitions to start in 0..1.

    Returns them and how many repetitions int64[m,2] each face spans.
    """
    shifted = uv - np.floor(uv.min(axis=1, keepdims=True) + 1e-4)
    return shifted, np.maximum(np.ceil(shifted.max(axis=1) - 1e-3), 1).astype(np.int64)


def copies(image: Rgb, tiles: NDArray[np.int64]) -> tuple[int, int]:
    """Return how often an image is to be repeated to the right and downwards for faces that span ``tiles``."""
    height, width = image.shape[:2]
    most = tiles.max(axis=0, initial=1)
    across, down = (min(int(n), max(1, TILED_PX // size)) for n, size in zip(most, (width, height), strict=True))
    return across, down


def cut(corners: Array, values: Array) -> tuple[Array, Array, NDArray[np.intp]]:
    """Cut triangles at whole texture coordinates, then shift each piece's into 0..1.

    ``corners`` f64[m,3,3] in space, ``values`` f64[m,3,k] per corner, whose first two are u and v. Returns the pieces'
    corners and values, and which triangle each was. One that spans very many repetitions is not cut.
    """
    done: list[tuple[Array, Array, NDArray[np.intp]]] = []
    source = np.arange(len(corners))
    span = wrapped(values[..., :2])[1].prod(axis=1)
    whole = (span == 1) | (span > MOST_TILES)
    done.append((corners[whole], values[whole], source[whole]))
    todo = np.concatenate([corners, values], axis=2)[~whole], source[~whole]
    for axis in (3, 4):
        pieces, owner = todo
        finished = []
        while len(pieces):
            at = pieces[..., axis]
            # A corner that lies on a line but for rounding does not cross it.
            line = np.floor(at.min(axis=1) + 1e-6) + 1.0
            crossing = at.max(axis=1) > line + 1e-6
            finished.append((pieces[~crossing], owner[~crossing]))
            pieces, owner = _halved(pieces[crossing], owner[crossing], line[crossing], axis)
        todo = np.concatenate([p for p, _ in finished]), np.concatenate([o for _, o in finished])
    done.append((todo[0][..., :3], todo[0][..., 3:], todo[1]))
    pieces_xyz, pieces_values, owners = (np.concatenate([d[i] for d in done]) for i in range(3))
    pieces_values = pieces_values.copy()
    pieces_values[..., :2] = wrapped(pieces_values[..., :2])[0]
    return pieces_xyz, pieces_values, owners


def _halved(pieces: Array, owner: NDArray[np.intp], line: Array, axis: int) -> tuple[Array, NDArray[np.intp]]:
    """Cut triangles that cross a line, each of their own, into three."""
    # The corner that is alone on its side comes first.
    below = pieces[..., axis] <= line[:, None]
    alone = np.where(below.sum(axis=1) == 1, np.argmax(below, axis=1), np.argmin(below, axis=1))
    order = (alone[:, None] + np.arange(3)) % 3
    a, b, c = (pieces[np.arange(len(pieces)), order[:, i]] for i in range(3))

    def crossing(end: Array) -> Array:
        share = ((line - a[:, axis]) / (end[:, axis] - a[:, axis]))[:, None]
        point: Array = a + share * (end - a)
        point[:, axis] = line
        return point

    ab, ac = crossing(b), crossing(c)
    three = [np.stack(t, axis=1) for t in ((a, ab, ac), (ab, b, c), (ab, c, ac))]
    return np.concatenate(three), np.tile(owner, 3)
