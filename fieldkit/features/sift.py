"""SIFT by OpenCV, in 8 bits: RootSIFT descriptors, or Lowe's own normalisation."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from fieldkit.types import Image

Detected = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]

# Weak contrast is kept and the strongest keypoints are chosen afterwards, so that dim images still get their number.
_CONTRAST = 0.02
# RootSIFT has unit length; 512 keeps its largest components inside 8 bits (the convention of VLFeat and COLMAP).
_SCALE = 512.0


def detect_sift(grey: Image, max_keypoints: int) -> Detected:
    """Return keypoints (COLMAP pixels), scores, scales (px) and RootSIFT uint8[n, 128], strongest first."""
    keypoints, scores, scales, histograms = _detect(grey, max_keypoints)
    return keypoints, scores, scales, root_sift(histograms)


def detect_sift_l2(grey: Image, max_keypoints: int) -> Detected:
    """Return what `detect_sift` does, with histograms of length 512, clipped at 0.2 of it (Lowe, IJCV 2004)."""
    keypoints, scores, scales, histograms = _detect(grey, max_keypoints)
    return keypoints, scores, scales, np.asarray(np.clip(np.rint(histograms), 0, 255), dtype=np.uint8)


def _detect(
    grey: Image, max_keypoints: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Find keypoints and Lowe's histograms f32[n, 128], whole numbers of 0..255.

    OpenCV puts the centre of the first pixel at (0, 0): half a pixel is added. Its precise upscaling is switched on,
    because the default moves every keypoint by a quarter of a pixel. Equal scores are ordered by position, so that
    the same image always gives the same list.
    """
    detector = cv2.SIFT.create(nfeatures=max_keypoints, contrastThreshold=_CONTRAST, enable_precise_upscale=True)
    found, descriptors = detector.detectAndCompute(grey, None)
    if not found or descriptors is None:
        empty = np.zeros(0, dtype=np.float32)
        return np.zeros((0, 2), dtype=np.float32), empty, empty, np.zeros((0, 128), dtype=np.float32)
    table = np.array([(-k.response, k.pt[0], k.pt[1], k.size, k.angle) for k in found])
    order = np.lexsort(table.T[::-1])[:max_keypoints]
    table = table[order].astype(np.float32)
    histograms = np.asarray(descriptors, dtype=np.float32)[order]
    return table[:, 1:3] + np.float32(0.5), -table[:, 0], table[:, 3], histograms


def root_sift(descriptors: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Turn SIFT histograms (n, 128) into 8-bit RootSIFT (Arandjelovic and Zisserman, CVPR 2012)."""
    total = np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-12)
    return np.asarray(np.clip(np.rint(_SCALE * np.sqrt(descriptors / total)), 0, 255), dtype=np.uint8)
