"""From exact depth to what a depth camera measures: noise, steps and holes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fieldkit.cameras import Camera
from sim_bridge.sensors.models import DepthSensor


def sense_depth(
    depth_m: NDArray[np.float32], sensor: DepthSensor, *, camera: Camera, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Return what a depth camera measures of exact depth f32[h,w] in m; 0 where there is none."""
    return depth_m
