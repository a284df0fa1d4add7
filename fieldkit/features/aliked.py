"""ALIKED (Zhao et al., IEEE TIM 2023) by kornia, with the published weights."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fieldkit.features.networks import MIN_SIDE_PX, as_tensor, no_keypoints, one_at_a_time, strongest
from fieldkit.features.weights import WEIGHTS, fill_network, find_weights, read_weights
from fieldkit.types import Image

if TYPE_CHECKING:
    import torch
    from kornia.feature import ALIKED

Floats = NDArray[np.float32]
Detected = tuple[Floats, Floats, Floats, Floats]
_SIDE_PX = 32
# As published.
_MIN_SCORE = 0.2
# The window in which a keypoint is the maximum of the scores.
_WINDOW_PX = 5.0


@dataclasses.dataclass(frozen=True)
class AlikedVariant:
    """A published network: the name of its weights, the width of its descriptors, and the bias of its keypoints (x, y).

    The bias is where detections lie beside what they show: half of how far they move when an image is flipped or
    turned. Where it depends on what is shown, nothing is taken off.
    """

    weights: str
    width: int
    bias_px: tuple[float, float] = (0.0, 0.0)


# Trained with turned images; measured over red kitchen frames, rendered images and photos.
N16ROT = AlikedVariant("aliked-n16rot", 128, (0.46, -0.04))
# What hloc uses; 1.9 and 1.5 px beside.
N16 = AlikedVariant("aliked-n16", 128)
# Half as slow; 1.9 px beside.
T16 = AlikedVariant("aliked-t16", 64)


def load_aliked(variant: AlikedVariant, folder: Path | None) -> Callable[[Image, int], Detected]:
    """Return the detector of a variant; raises WeightsError without its weights."""
    path = find_weights(WEIGHTS[variant.weights], folder=folder)
    from kornia.feature import ALIKED

    network = ALIKED(variant.weights, detection_threshold=0.0, max_num_keypoints=-1)
    fill_network(network, read_weights(path), path=path)
    return one_at_a_time(lambda image, count: _detect(network, variant, image, count))


def _detect(network: ALIKED, variant: AlikedVariant, image: Image, max_keypoints: int) -> Detected:
    """Return keypoints (COLMAP pixels), scores, window sizes and unit descriptors f32[n, width], strongest first.

    kornia's own limit would let equal scores decide by chance, and its threshold falls back to noise in an image
    without texture: all maxima are ranked here. It puts the centre of the first pixel at (0, 0): half a pixel is added,
    and the network's own bias taken off.
    """
    height, width = image.shape[:2]
    if min(height, width) < MIN_SIDE_PX:
        return no_keypoints(variant.width)
    features, score_map = _maps(network, as_tensor(image))
    found: Any = network.dkd(score_map)
    normalised, scores = found[0][0], found[1][0].numpy()
    pixels = (normalised.numpy() + np.float32(1.0)) * np.array([width - 1, height - 1], np.float32) / np.float32(2.0)
    order = strongest(scores, pixels, max_keypoints)
    order = order[scores[order] > _MIN_SCORE]
    if not len(order):
        return no_keypoints(variant.width)
    descriptors = network.desc_head(features, [normalised[order.tolist()]])[0][0].numpy()
    scales = np.full(len(order), _WINDOW_PX, dtype=np.float32)
    keypoints = pixels[order] + (np.float32(0.5) - np.array(variant.bias_px, dtype=np.float32))
    return keypoints, scores[order], scales, descriptors


def _maps(network: ALIKED, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return unit features f32[1, width, h, w] and scores f32[1, 1, h, w], as kornia's `extract_dense_map` does.

    With the channels of a pixel side by side in memory, upscaling and normalising take half the time. Sides that are
    no multiple of 32 are continued at the right and bottom by their last pixels.
    """
    import torch
    from torch.nn.functional import pad

    height, width = image.shape[-2:]
    padded = pad(image, (0, -width % _SIDE_PX, 0, -height % _SIDE_PX), mode="replicate")
    first = network.block1(padded)
    second = network.block2(network.pool2(first))
    third = network.block3(network.pool4(second))
    fourth = network.block4(network.pool4(third))

    # One after the other: a photo of 1600x1200 would need 2 GB for them and what they are joined to.
    quarter = network.conv1.out_channels
    joined = torch.empty((1, 4 * quarter, *padded.shape[-2:]), memory_format=torch.channels_last)
    for number, (layer, upsample, x) in enumerate(
        (
            (network.conv1, torch.nn.Identity(), first),
            (network.conv2, network.upsample2, second),
            (network.conv3, network.upsample8, third),
            (network.conv4, network.upsample32, fourth),
        )
    ):
        narrow = network.gate(layer(x)).contiguous(memory_format=torch.channels_last)
        joined[:, number * quarter : (number + 1) * quarter] = upsample(narrow)
    scores = torch.sigmoid(network.score_head(joined))
    joined /= torch.linalg.vector_norm(joined, dim=1, keepdim=True).clamp_min(1e-12)
    return joined[..., :height, :width], scores[..., :height, :width].contiguous()
