"""Pixels of ROS image messages."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from fieldkit.types import Image

# Encoding -> channels in the message, conversion to RGB (None: already grey or RGB)
_ENCODINGS: dict[str, tuple[int, int | None]] = {
    "mono8": (1, None),
    "8UC1": (1, None),
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "8UC4": (4, cv2.COLOR_BGRA2RGB),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
}


def decode_image(message: Any) -> Image:
    """Return the pixels of a sensor_msgs Image or CompressedImage: uint8[h, w] grey or uint8[h, w, 3] RGB.

    16-bit grey is reduced to its upper 8 bits. Raises ValueError that says what is wrong.
    """
    return _decode_raw(message) if hasattr(message, "encoding") else _decode_compressed(message)


def _decode_compressed(message: Any) -> Image:
    data = np.asarray(message.data, dtype=np.uint8)
    pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if pixels is None:
        raise ValueError(f"compressed image of {data.size} bytes, format {message.format!r}, cannot be decoded")
    if pixels.dtype != np.uint8:
        raise ValueError(f"compressed image has {pixels.dtype} pixels; expected 8 bits")
    if pixels.ndim == 2:
        return np.asarray(pixels, dtype=np.uint8)
    code = cv2.COLOR_BGRA2RGB if pixels.shape[2] == 4 else cv2.COLOR_BGR2RGB
    return np.asarray(cv2.cvtColor(pixels, code), dtype=np.uint8)


def _decode_raw(message: Any) -> Image:
    height, width, step, encoding = message.height, message.width, message.step, message.encoding
    data = np.asarray(message.data, dtype=np.uint8)
    if height <= 0 or width <= 0 or data.size < height * step:
        raise ValueError(f"image {width}x{height} with {data.size} bytes; expected {height * step}")
    lines = data[: height * step].reshape(height, step)
    if encoding in ("mono16", "16UC1"):
        upper = 0 if message.is_bigendian else 1
        return np.ascontiguousarray(lines[:, : 2 * width].reshape(height, width, 2)[:, :, upper])
    if encoding not in _ENCODINGS:
        raise ValueError(f"image encoding {encoding!r}; known: {', '.join([*_ENCODINGS, 'mono16'])}")
    channels, conversion = _ENCODINGS[encoding]
    if step < width * channels:
        raise ValueError(f"image {width} px wide in {encoding} with lines of {step} bytes")
    pixels = np.ascontiguousarray(lines[:, : width * channels].reshape(height, width, channels))
    if conversion is not None:
        return np.asarray(cv2.cvtColor(pixels, conversion), dtype=np.uint8)
    return pixels[:, :, 0].copy() if channels == 1 else pixels
