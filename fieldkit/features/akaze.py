"""AKAZE keypoints with KAZE descriptors: a detector and a descriptor that share nothing with SIFT's."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from fieldkit.types import Image

# Weak responses are kept and the strongest keypoints are chosen afterwards
_THRESHOLD = 0.0002
WIDTH = 64


def detect_akaze(
    grey: Image, max_keypoints: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return keypoints (COLMAP pixels), scores, scales (px) and unit descriptors f32[n, 64], strongest first.

    Keypoints are extrema in a nonlinear scale space (Alcantarilla et al., BMVC 2013), descriptors M-SURF gradients.
    OpenCV puts the centre of the first pixel at (0, 0): half a pixel is added. Equal scores are ordered by position.
    """
    detector = cv2.xfeatures2d.AKAZE.create(
        descriptor_type=cv2.xfeatures2d.AKAZE_DESCRIPTOR_KAZE, threshold=_THRESHOLD, max_points=max_keypoints
    )
    found, descriptors = detector.detectAndCompute(grey, None)
    if not found or descriptors is None:
        empty = np.zeros(0, dtype=np.float32)
        return np.zeros((0, 2), dtype=np.float32), empty, empty, np.zeros((0, WIDTH), dtype=np.float32)
    table = np.array([(-k.response, k.pt[0], k.pt[1], k.size, k.angle) for k in found])
    order = np.lexsort(table.T[::-1])[:max_keypoints]
    table = table[order].astype(np.float32)
    values = np.asarray(descriptors, dtype=np.float32)[order]
    values = values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), np.float32(1e-12))
    return table[:, 1:3] + np.float32(0.5), -table[:, 0], table[:, 3], values
