"""The file formats of sensors, and their grey."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_bridge.sensors.models import ColourSensor

Image = NDArray[np.uint8]


def grey(rgb: Image) -> Image:
    """Return the luminance of an RGB image."""
    result: Image = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    return result


def jpeg(image: Image, *, quality: int) -> bytes:
    """Encode a grey or RGB image as JPEG; colour is kept at full resolution so that edges do not smear."""
    data = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    settings = [
        cv2.IMWRITE_JPEG_QUALITY,
        quality,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    ]
    return bytes(cv2.imencode(".jpg", data, settings)[1])


def encode(image: Image, sensor: ColourSensor) -> bytes:
    """Encode an image as the JPEG file of a sensor, of quality 100 where the sensor has no compression."""
    return jpeg(image, quality=100 if sensor.jpeg is None else sensor.jpeg.quality)


def depth_png(depth_m: NDArray[np.float32], *, far_m: float) -> bytes:
    """Encode depth as 16-bit PNG in mm; 0 where there is none or it lies beyond ``far_m``."""
    valid = (depth_m > 0) & (depth_m <= far_m)
    millimetres = np.where(valid, np.rint(depth_m * 1000.0), 0).astype(np.uint16)
    return bytes(cv2.imencode(".png", millimetres)[1])
