"""From exact depth to what a depth camera measures: noise, steps and holes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fieldkit.cameras import Camera
from sim_bridge.sensors import pixels
from sim_bridge.sensors.colour import quantiles
from sim_bridge.sensors.models import DepthSensor

F32 = NDArray[np.float32]


def sense_depth(depth_m: F32, sensor: DepthSensor, *, camera: Camera, rng: np.random.Generator) -> F32:
    """Return what a depth camera measures of exact depth f32[h,w] in m; 0 where there is none.

    ``camera`` is that of the rendering. Draws the same numbers whatever is switched on.
    """
    seeds = rng.integers(0, 2**63, 2).astype(np.uint64)
    result = depth_m
    if sensor.depth_noise is not None:
        noise = sensor.depth_noise
        floor, growth, step = (np.float32(v) for v in (noise.floor_m, noise.per_m2, noise.step_m))
        result = pixels.noisy_depth(depth_m, floor, growth, step, seeds[0], quantiles())
    if sensor.depth_holes is not None:
        holes = sensor.depth_holes
        lost = pixels.holes(
            depth_m,
            np.array(camera.focal_px, np.float32),
            np.array(camera.centre_px, np.float32),
            np.array([holes.near_m, holes.far_m], np.float32),
            np.float32(holes.edge),
            np.float32(holes.edge_share),
            np.float32(np.sin(np.radians(holes.grazing_deg))),
            np.float32(holes.speckle_share),
            seeds[1],
        )
        result = np.where(lost, np.float32(0.0), result)
    return result
