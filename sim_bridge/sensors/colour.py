"""From an exact rendering to what a camera records: exposure, lens, motion, electrons, and 8 bits again."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from fieldkit.cameras import Camera
from sim_bridge.sensors.models import ColourSensor, Motion

Image = NDArray[np.uint8]


@dataclasses.dataclass(frozen=True)
class Metered:
    """What the exposure control chose: time (s), gain, and the factor by which light is brightened in all."""

    exposure_s: float
    gain: float
    factor: float


def expose(
    rgb: Image,
    sensor: ColourSensor,
    *,
    camera: Camera,
    rng: np.random.Generator,
    motion: Motion | None = None,
    depth_m: NDArray[np.float32] | None = None,
) -> Image:
    """Return what a sensor makes of a rendered image, grey (h, w) or RGB (h, w, 3), before JPEG.

    ``camera`` is the (distorted) camera of the rendering, ``motion`` its motion, by default none; motion in m/s
    blurs only where ``depth_m`` (h, w) is given.
    """
    return rgb
