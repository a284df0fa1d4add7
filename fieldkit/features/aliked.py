"""ALIKED (Zhao et al., IEEE TIM 2023) by kornia, with the published weights."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fieldkit.features.networks import MIN_SIDE_PX, as_tensor, no_keypoints, one_at_a_time, strongest
from fieldkit.features.weights import WEIGHTS, fill_network, find_weights, read_weights
from fieldkit.types import Image

if TYPE_CHECKING:
    from kornia.feature import ALIKED

Floats = NDArray[np.float32]
Detected = tuple[Floats, Floats, Floats, Floats]
WIDTH = 128
# As published.
_MIN_SCORE = 0.2
# Where detections lie beside what they show: half of how far they move when an image is flipped or turned, over red
# kitchen frames, rendered images and photos. The variant trained with rotations has the least: "n16" 1.9 and 1.5 px.
_BIAS_PX = np.array([0.37, -0.09], dtype=np.float32)
# The window in which a keypoint is the maximum of the scores.
_WINDOW_PX = 5.0


def load_aliked(folder: Path | None) -> Callable[[Image, int], Detected]:
    """Return the detector with 16 deformable samples and 128 components; raises WeightsError without its weights."""
    path = find_weights(WEIGHTS["aliked-n16rot"], folder=folder)
    from kornia.feature import ALIKED

    network = ALIKED("aliked-n16rot", detection_threshold=0.0, max_num_keypoints=-1)
    fill_network(network, read_weights(path), path=path)
    return one_at_a_time(lambda image, count: _detect(network, image, count))


def _detect(network: ALIKED, image: Image, max_keypoints: int) -> Detected:
    """Return keypoints (COLMAP pixels), scores, window sizes and unit descriptors f32[n, 128], strongest first.

    kornia's own limit would let equal scores decide by chance, and its threshold falls back to noise in an image
    without texture: all maxima are ranked here. It puts the centre of the first pixel at (0, 0): half a pixel is added,
    and the network's own bias taken off.
    """
    height, width = image.shape[:2]
    if min(height, width) < MIN_SIDE_PX:
        return no_keypoints(WIDTH)
    features, score_map = network.extract_dense_map(as_tensor(image))
    found: Any = network.dkd(score_map)
    normalised, scores = found[0][0], found[1][0].numpy()
    pixels = (normalised.numpy() + np.float32(1.0)) * np.array([width - 1, height - 1], np.float32) / np.float32(2.0)
    order = strongest(scores, pixels, max_keypoints)
    order = order[scores[order] > _MIN_SCORE]
    if not len(order):
        return no_keypoints(WIDTH)
    descriptors = network.desc_head(features, [normalised[order.tolist()]])[0][0].numpy()
    scales = np.full(len(order), _WINDOW_PX, dtype=np.float32)
    return pixels[order] + (np.float32(0.5) - _BIAS_PX), scores[order], scales, descriptors
