"""Appearance: what a network sees at pixels of an image, and in the image as a whole."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import FeatureError, suggestion
from fieldkit.features import dinov2, efficientnet
from fieldkit.features.images import to_colour
from fieldkit.features.networks import as_tensor, one_at_a_time
from fieldkit.types import Image

if TYPE_CHECKING:
    import torch

Floats = NDArray[np.float32]
# Exponent of the generalised mean (Radenovic et al., TPAMI 2019): between the mean (1) and the maximum.
_GEM_POWER = 3.0


@dataclasses.dataclass(frozen=True)
class AppearanceKind:
    """A network of appearance.

    ``load(folder)`` returns ``maps(image)``, which gives dense features f32[1, dense_width, h/stride, w/stride] of an
    image f32[1, 3, h, w] whose sides are multiples of ``side_px``, and its global feature f32[1, whole_width].
    ``weights`` names the network's.
    """

    load: Callable[[Path | None], Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]]]
    dense_width: int
    whole_width: int
    stride_px: int
    side_px: int
    weights: str


def _open_efficientnet(folder: Path | None) -> Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]]:
    network = efficientnet.load_efficientnet(folder)

    def maps(image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        dense, last = efficientnet.feature_maps(network, image)
        return dense, last.clamp(min=1e-6).pow(_GEM_POWER).mean(dim=(2, 3)).pow(1.0 / _GEM_POWER)

    return maps


def _open_dinov2(folder: Path | None) -> Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]]:
    network = dinov2.load_dinov2(folder)
    return lambda image: dinov2.patch_features(network, image)


APPEARANCES: dict[str, AppearanceKind] = {
    "efficientnet": AppearanceKind(
        _open_efficientnet,
        efficientnet.DENSE_WIDTH,
        efficientnet.WHOLE_WIDTH,
        efficientnet.DENSE_STRIDE_PX,
        2 * efficientnet.DENSE_STRIDE_PX,
        "efficientnet-lite0",
    ),
    "dinov2": AppearanceKind(
        _open_dinov2, dinov2.WIDTH, dinov2.WIDTH, dinov2.PATCH_PX, dinov2.PATCH_PX, "dinov2-vits14"
    ),
}


@dataclasses.dataclass(frozen=True)
class Appearance:
    """An opened network of appearance, loaded once. May be used from several threads."""

    name: str
    kind: AppearanceKind
    maps: Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]] = dataclasses.field(repr=False)
    max_side_px: int

    def dense(self, image: Image, keypoints_px: NDArray[np.floating]) -> Floats:
        """Return unit vectors f32[n, dense_width] at COLMAP pixels [n, 2] of an image uint8[h, w] or RGB [h, w, 3].

        Features are read bilinearly between the centres of the network's cells; outside the image the nearest counts.
        """
        import torch
        from torch.nn.functional import grid_sample, normalize

        if not len(keypoints_px):
            return np.zeros((0, self.kind.dense_width), dtype=np.float32)
        found, _ = self.maps(self._ready(image))
        size = np.array([image.shape[1], image.shape[0]], dtype=np.float64)
        grid = torch.from_numpy((2.0 * np.asarray(keypoints_px) / size - 1.0).astype(np.float32))[None, None]
        read = grid_sample(found, grid, align_corners=False, padding_mode="border")[0, :, 0].T
        return np.ascontiguousarray(normalize(read, dim=1).numpy())

    def whole(self, image: Image) -> Floats:
        """Return the unit vector f32[whole_width] of an image uint8[h, w] or RGB [h, w, 3]."""
        _, found = self.maps(self._ready(image))
        vector = found[0].numpy()
        return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12), dtype=np.float32)

    def _ready(self, image: Image) -> torch.Tensor:
        """Return the image with its longer side at most ``max_side_px``, and both multiples of the network's cells."""
        colour = to_colour(image)
        height, width = colour.shape[:2]
        factor = min(1.0, self.max_side_px / max(height, width))
        side = self.kind.side_px
        columns, rows = (max(round(s * factor / side), 1) * side for s in (width, height))
        if (columns, rows) != (width, height):
            smaller = columns * rows < width * height
            colour = np.asarray(
                cv2.resize(colour, (columns, rows), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR),
                dtype=np.uint8,
            )
        return as_tensor(colour)


def open_appearance(name: str, *, weights: Path | None = None, max_side_px: int = 640) -> Appearance:
    """Open a network of appearance for many images; ``weights`` is a folder where weight files are looked for first.

    Raises FeatureError for an unknown name, and WeightsError when the weights are not found or not its own.
    """
    if name not in APPEARANCES:
        raise FeatureError(f"unknown appearance {name!r}", hint=suggestion(name, list(APPEARANCES)))
    kind = APPEARANCES[name]
    return Appearance(name, kind, one_at_a_time(kind.load(weights)), max_side_px)
