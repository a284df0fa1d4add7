"""From an exact rendering to what a camera records: exposure, lens, motion, electrons, and 8 bits again.

The light of a rendering is its grey level to the power 2.2, as in the baked light of scenes; 1 is white paper under
ordinary light.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from fieldkit.cameras import Camera
from sim_bridge.sensors import pixels
from sim_bridge.sensors.models import ColourSensor, Exposure, Motion, Noise

Array = NDArray[np.float64]
F32 = NDArray[np.float32]
Image = NDArray[np.uint8]

GAMMA = 2.2
# From this grey level on, a rendering's white may be a lamp or a window.
KNEE = 240
# Pixels between those that the exposure control looks at.
METER_STEP = 4
# Paths shorter than this change nothing that 8 bits could show.
LEAST_BLUR_PX = 0.15


@dataclasses.dataclass(frozen=True)
class Metered:
    """What the exposure control chose: time (s), gain, and the factor by which both brighten the light."""

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
    depth_m: F32 | None = None,
) -> Image:
    """Return what a sensor makes of a rendered image, grey (h, w) or RGB (h, w, 3), before JPEG.

    ``camera`` is the (distorted) camera of the rendering, ``motion`` its motion, by default none; motion in m/s
    blurs only where ``depth_m`` (h, w) is given. Draws the same numbers whatever is switched on.
    """
    error, seed = float(rng.standard_normal()), rng.integers(0, 2**63)
    blurs = sensor.blur is not None and motion is not None
    if sensor.exposure is None and sensor.vignetting is None and sensor.noise is None and not blurs:
        return rgb
    image = rgb.reshape(*rgb.shape[:2], -1)
    highlights = 1.0 if sensor.exposure is None else sensor.exposure.highlights
    light = pixels.to_light(image, _decoded(), _boost(highlights))
    falloff = _falloff(camera, 0.0 if sensor.vignetting is None else sensor.vignetting.strength)
    metered = Metered(0.0, 1.0, 1.0)
    if sensor.exposure is not None:
        metered = meter(light, falloff, sensor.exposure, error=error)
    elif sensor.blur is not None:
        metered = Metered(sensor.blur.exposure_s, 1.0, 1.0)
    if sensor.blur is not None and motion is not None:
        light = _blurred(light, camera, motion, metered.exposure_s, depth_m=depth_m)
    noise = sensor.noise or Noise()
    result: Image = pixels.develop(
        light,
        falloff,
        np.float32(noise.full_well_e * metered.factor / metered.gain),
        np.float32(-1.0 if sensor.noise is None else noise.read_e),
        np.float32(metered.gain / noise.full_well_e),
        np.uint64(seed),
        quantiles(),
        _grey_levels(),
    )
    return result.reshape(rgb.shape)


def meter(light: F32, falloff: F32, exposure: Exposure, *, error: float) -> Metered:
    """Choose time and gain so that the mean grey level, clipped at white, is the target; ``error`` is a normal draw.

    ``light`` f32[h,w,c] in front of the lens, ``falloff`` at every 16th pixel.
    """
    seen = light[METER_STEP // 2 :: METER_STEP, METER_STEP // 2 :: METER_STEP].mean(axis=2)
    rows, columns = (np.arange(n) * METER_STEP // pixels.STEP for n in seen.shape)
    encoded = (seen * falloff[np.ix_(rows, columns)]) ** (1.0 / GAMMA)
    low, high = 1e-3, 1e3
    for _ in range(24):
        middle = np.sqrt(low * high)
        enough = float(np.minimum(encoded * middle, 1.0).mean()) > exposure.target
        low, high = (low, middle) if enough else (middle, high)
    stops = GAMMA * np.log2(high) + exposure.error_ev * error
    if exposure.step_ev > 0.0:
        stops = np.rint(stops / exposure.step_ev) * exposure.step_ev
    wanted_s = float(2.0**stops) * exposure.white_s
    time_s = min(max(wanted_s, exposure.shortest_s), exposure.longest_s)
    gain = min(max(wanted_s / time_s, 1.0), exposure.most_gain)
    return Metered(time_s, gain, time_s * gain / exposure.white_s)


def _blurred(light: F32, camera: Camera, motion: Motion, exposure_s: float, *, depth_m: F32 | None) -> F32:
    turning, moving = _paths(camera, motion)
    turning, moving = (turning * exposure_s).astype(np.float32), (moving * exposure_s).astype(np.float32)
    depth = np.zeros(light.shape[:2], np.float32) if depth_m is None else depth_m
    nearest = float(np.min(depth, where=depth > 0, initial=np.inf))
    if np.abs(turning).max() + np.abs(moving).max() / nearest < LEAST_BLUR_PX:
        return light
    result: F32 = pixels.smear(light, turning, moving, depth)
    return result


def _paths(camera: Camera, motion: Motion) -> tuple[Array, Array]:
    """Return pixel velocities at every 16th pixel: of turning (px/s), and of moving for points at 1 m (px m/s).

    The image velocity of a point that stands still before a camera that turns by w and moves by v: for a direction
    (x, y, 1) at depth z it is that of the vector -w x (x, y, 1) - v / z.
    """
    nodes = _node_pixels(camera)
    rays = camera.unproject(nodes.reshape(-1, 2))
    # Pixels per normalised coordinate, by differences: the lens may distort.
    step = 1e-5
    here = camera.distort(rays[:, :2])
    slopes = [(camera.distort(rays[:, :2] + shift) - here) / step for shift in ((step, 0.0), (0.0, step))]
    result = []
    angular = np.broadcast_to(np.asarray(motion.angular_rad_s, dtype=np.float64), rays.shape)
    linear = np.broadcast_to(np.asarray(motion.linear_m_s, dtype=np.float64), rays.shape)
    for velocity in (-np.cross(angular, rays), -linear):
        plane = velocity[:, :2] - rays[:, :2] * velocity[:, 2:]
        moved = slopes[0] * plane[:, :1] + slopes[1] * plane[:, 1:]
        result.append((moved * camera.focal_px).reshape(nodes.shape))
    return result[0], result[1]


def _node_pixels(camera: Camera) -> Array:
    columns = np.arange((camera.width - 1) // pixels.STEP + 2) * pixels.STEP + 0.5
    rows = np.arange((camera.height - 1) // pixels.STEP + 2) * pixels.STEP + 0.5
    return np.stack(np.meshgrid(columns, rows), axis=-1)


@functools.lru_cache(maxsize=16)
def _falloff(camera: Camera, strength: float) -> F32:
    """Return the share of light at every 16th pixel: a part ``strength`` follows cos^4 of the angle to the axis."""
    nodes = _node_pixels(camera)
    if strength == 0.0:
        return np.ones(nodes.shape[:2], np.float32)
    rays = camera.unproject(nodes.reshape(-1, 2))
    cosine = 1.0 / np.linalg.norm(rays, axis=1)
    share = 1.0 - strength * (1.0 - cosine**4)
    return np.asarray(share.reshape(nodes.shape[:2]), dtype=np.float32)


@functools.lru_cache(maxsize=1)
def _decoded() -> F32:
    return np.asarray((np.arange(256) / 255.0) ** GAMMA, dtype=np.float32)


@functools.lru_cache(maxsize=8)
def _boost(highlights: float) -> F32:
    above = np.clip((np.arange(256) - KNEE) / (255.0 - KNEE), 0.0, 1.0)
    return np.asarray(1.0 + (highlights - 1.0) * above**2, dtype=np.float32)


@functools.lru_cache(maxsize=1)
def _grey_levels() -> Image:
    root = np.arange(1 << pixels.BITS) / ((1 << pixels.BITS) - 1)
    return np.rint(255.0 * root ** (2.0 / GAMMA)).astype(np.uint8)


@functools.lru_cache(maxsize=1)
def quantiles() -> F32:
    """Return the quantiles of the normal distribution at the middles of 4096 equal shares, scaled to variance 1."""
    values = ndtri((np.arange(1 << pixels.BITS) + 0.5) / (1 << pixels.BITS))
    return np.asarray(values / values.std(), dtype=np.float32)
