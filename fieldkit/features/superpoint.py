"""SuperPoint (DeTone et al., CVPRW 2018): the network by the published names and shapes of its layers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fieldkit.features.networks import MIN_SIDE_PX, as_tensor, no_keypoints, one_at_a_time, strongest
from fieldkit.features.weights import WEIGHTS, fill_network, find_weights, read_weights
from fieldkit.types import Image

if TYPE_CHECKING:
    import torch

Floats = NDArray[np.float32]
Detected = tuple[Floats, Floats, Floats, Floats]
WIDTH = 256
# As published: side of a cell, score that a keypoint needs, and how near it may be to another and to the border.
_CELL_PX = 8
_MIN_SCORE = 0.005
_RADIUS_PX = 4
# (name, channels in, channels out, side of the kernel)
_LAYERS = (
    ("conv1a", 1, 64, 3),
    ("conv1b", 64, 64, 3),
    ("conv2a", 64, 64, 3),
    ("conv2b", 64, 64, 3),
    ("conv3a", 64, 128, 3),
    ("conv3b", 128, 128, 3),
    ("conv4a", 128, 128, 3),
    ("conv4b", 128, 128, 3),
    ("convPa", 128, 256, 3),
    ("convPb", 256, 65, 1),
    ("convDa", 128, 256, 3),
    ("convDb", 256, WIDTH, 1),
)


def superpoint_network() -> torch.nn.ModuleDict:
    """Return the layers of the network, by their published names, with random weights."""
    import torch

    return torch.nn.ModuleDict({n: torch.nn.Conv2d(i, o, k, padding=k // 2) for n, i, o, k in _LAYERS})


def load_superpoint(folder: Path | None) -> Callable[[Image, int], Detected]:
    """Return the detector; raises WeightsError without its weights."""
    path = find_weights(WEIGHTS["superpoint"], folder=folder)
    network = superpoint_network()
    fill_network(network, read_weights(path), path=path)
    return one_at_a_time(lambda image, count: _detect(network, image, count))


def maps(network: torch.nn.ModuleDict, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return scores f32[b, h, w] and descriptors f32[b, 256, h/8, w/8] of images f32[b, 1, h, w] with sides 8 k."""
    import torch.nn.functional as nn

    x = images
    for block in "1234":
        x = nn.relu(network[f"conv{block}b"](nn.relu(network[f"conv{block}a"](x))))
        x = x if block == "4" else nn.max_pool2d(x, 2)
    logits = network["convPb"](nn.relu(network["convPa"](x)))
    # Component 8 row + column of a cell is its pixel (row, column); the last one says that there is no keypoint.
    scores = nn.pixel_shuffle(nn.softmax(logits, dim=1)[:, :-1], _CELL_PX)[:, 0]
    descriptors = network["convDb"](nn.relu(network["convDa"](x)))
    return scores, nn.normalize(descriptors, dim=1)


def local_maxima(scores: torch.Tensor) -> torch.Tensor:
    """Return bool[b, h, w]: maxima of their window, and in two more rounds of what lies outside the windows found."""
    import torch
    import torch.nn.functional as nn

    def highest(values: torch.Tensor) -> torch.Tensor:
        return nn.max_pool2d(values[:, None], 2 * _RADIUS_PX + 1, stride=1, padding=_RADIUS_PX)[:, 0]

    found = scores == highest(scores)
    for _ in range(2):
        covered = highest(found.float()) > 0
        rest = torch.where(covered, torch.zeros_like(scores), scores)
        found = found | ((rest == highest(rest)) & ~covered)
    return found


def _detect(network: torch.nn.ModuleDict, image: Image, max_keypoints: int) -> Detected:
    """Return keypoints (COLMAP pixels), scores, cell sizes and unit descriptors f32[n, 256], strongest first.

    Sides that are no multiple of a cell are continued at the right and bottom by their last pixels. Pixel (0, 0) has
    its centre at (0.5, 0.5), and cell (0, 0) its own at (4, 4), where descriptors are read bilinearly.
    """
    import torch
    import torch.nn.functional as nn

    height, width = image.shape
    if min(height, width) < MIN_SIDE_PX:
        return no_keypoints(WIDTH)
    more = (0, -width % _CELL_PX, 0, -height % _CELL_PX)
    scores, descriptors = maps(network, nn.pad(as_tensor(image), more, mode="replicate"))
    table = scores[0].numpy()
    inside = np.zeros(table.shape, dtype=bool)
    inside[_RADIUS_PX : height - _RADIUS_PX, _RADIUS_PX : width - _RADIUS_PX] = True
    rows, columns = np.nonzero(local_maxima(scores)[0].numpy() & inside & (table > _MIN_SCORE))
    if not len(rows):
        return no_keypoints(WIDTH)
    pixels, values = np.column_stack([columns, rows]).astype(np.float32), table[rows, columns]
    order = strongest(values, pixels, max_keypoints)
    keypoints = pixels[order] + np.float32(0.5)
    padded = np.array([table.shape[1], table.shape[0]], dtype=np.float32)
    grid = torch.from_numpy(np.float32(2.0) * keypoints / padded - np.float32(1.0))[None, None]
    read = nn.normalize(nn.grid_sample(descriptors, grid, align_corners=False)[0, :, 0], dim=0)
    scales = np.full(len(order), float(_CELL_PX), dtype=np.float32)
    return keypoints, values[order], scales, np.ascontiguousarray(read.numpy().T)
