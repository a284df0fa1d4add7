"""XFeat (Potje et al., CVPR 2024) by kornia, with the published weights."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from fieldkit.features.networks import MIN_SIDE_PX, as_tensor, no_keypoints, one_at_a_time, strongest
from fieldkit.features.weights import WEIGHTS, fill_network, find_weights, read_weights
from fieldkit.types import Image

if TYPE_CHECKING:
    from kornia.feature import XFeat

Floats = NDArray[np.float32]
Detected = tuple[Floats, Floats, Floats, Floats]
WIDTH = 64
_SIDE_PX = 32
_WINDOW_PX = 5.0
# Where detections lie beside what they show: half of how far they move when an image is flipped or turned, the same
# over red kitchen frames, rendered images and photos.
_BIAS_PX = np.array([0.45, -1.5], dtype=np.float32)


def load_xfeat(folder: Path | None) -> Callable[[Image, int], Detected]:
    """Return the sparse detector; raises WeightsError without its weights."""
    path = find_weights(WEIGHTS["xfeat"], folder=folder)
    from kornia.feature import XFeat

    network = XFeat()
    fill_network(network.net, read_weights(path), path=path)
    network.eval()
    return one_at_a_time(lambda image, count: _detect(network, image, count))


def _detect(network: XFeat, image: Image, max_keypoints: int) -> Detected:
    """Return keypoints (COLMAP pixels), scores, window sizes and unit descriptors f32[n, 64], strongest first.

    The network takes sides that are multiples of 32. Others are continued at the right and bottom by their last pixels,
    where kornia would stretch the image. It puts the centre of the first pixel at (0, 0): half a pixel is added, and
    the network's own bias taken off.
    """
    height, width = image.shape[:2]
    if min(height, width) < MIN_SIDE_PX or int(image.max()) == int(image.min()):
        return no_keypoints(WIDTH)
    padded = cv2.copyMakeBorder(image, 0, -height % _SIDE_PX, 0, -width % _SIDE_PX, cv2.BORDER_REPLICATE)
    found = network.detectAndCompute(as_tensor(np.asarray(padded, dtype=np.uint8)), top_k=padded.size)[0]
    pixels, scores = found["keypoints"].numpy(), found["scores"].numpy()
    order = strongest(scores, pixels, len(scores))
    order = order[(pixels[order] < np.array([width, height])).all(axis=1)][:max_keypoints]
    keypoints = pixels[order] + (np.float32(0.5) - _BIAS_PX)
    scales = np.full(len(order), _WINDOW_PX, dtype=np.float32)
    return keypoints, scores[order], scales, found["descriptors"].numpy()[order]
