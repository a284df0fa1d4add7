"""Meshes to read: rooms, solids and tables, plain, painted and coloured, and their files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

LENGTH_M, WIDTH_M, HEIGHT_M = 6.0, 5.0, 2.8


def quad(corners: list[tuple[float, float, float]]) -> trimesh.Trimesh:
    """A rectangle with texture coordinates 0..1, its first corner at the texture's lower left."""
    mesh = trimesh.Trimesh(corners, [(0, 1, 2), (0, 2, 3)], process=False)
    mesh.visual = trimesh.visual.TextureVisuals(uv=np.array([(0, 0), (1, 0), (1, 1), (0, 1)], dtype=np.float64))
    return mesh


def shell(length: float = LENGTH_M, width: float = WIDTH_M) -> list[trimesh.Trimesh]:
    """Floor and four walls of a room without a ceiling, seen from inside."""
    ring = [(0.0, 0.0), (length, 0.0), (length, width), (0.0, width)]
    walls = [
        quad([(*a, 0.0), (*b, 0.0), (*b, HEIGHT_M), (*a, HEIGHT_M)])
        for a, b in zip(ring, ring[1:] + ring[:1], strict=True)
    ]
    return [quad([(x, y, 0.0) for x, y in ring]), *walls]


def table() -> trimesh.Trimesh:
    """A plate on 0.7 m at (4.5, 2.5)."""
    top = trimesh.creation.box((1.0, 1.0, 0.05), trimesh.transformations.translation_matrix((4.5, 2.5, 0.7)))
    top.visual.face_colors = (90, 60, 30, 255)
    return top


def checks(px: int = 64) -> Image.Image:
    """Red upper left, green upper right, blue lower left, white lower right."""
    image = np.zeros((px, px, 3), np.uint8)
    half = px // 2
    image[:half, :half] = (250, 0, 0)
    image[:half, half:] = (0, 250, 0)
    image[half:, :half] = (0, 0, 250)
    image[half:, half:] = (250, 250, 250)
    return Image.fromarray(image)


def block(low: tuple[float, float, float], high: tuple[float, float, float]) -> trimesh.Trimesh:
    """A closed box seen from outside."""
    return trimesh.creation.box(bounds=[low, high])


def hall(length: float, width: float, height: float) -> trimesh.Trimesh:
    """A closed box seen from inside."""
    room = block((0.0, 0.0, 0.0), (length, width, height))
    room.invert()
    return room


def painted(parts: list[trimesh.Trimesh], image: Image.Image | None = None) -> list[trimesh.Trimesh]:
    for part in parts:
        material = trimesh.visual.material.SimpleMaterial(
            image=image or checks(), name="paint", diffuse=(255, 255, 255)
        )
        part.visual = trimesh.visual.TextureVisuals(uv=part.visual.uv, material=material)
    return parts


def coloured(parts: list[trimesh.Trimesh], rgb: tuple[int, int, int]) -> list[trimesh.Trimesh]:
    for part in parts:
        part.visual = trimesh.visual.ColorVisuals(part, vertex_colors=np.tile((*rgb, 255), (len(part.vertices), 1)))
    return parts


def saved(path: Path, parts: list[trimesh.Trimesh]) -> Path:
    scene = trimesh.Scene(parts)
    if path.suffix == ".ply":
        trimesh.util.concatenate(parts).export(path)
    else:
        scene.export(path)
    return path
