"""Compiled loops over the pixels of a sensor. Noise comes from counters: any number of threads gives the same bits."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from sim_bridge.rendering.kernels import kernel, parallel_kernel

F32 = NDArray[np.float32]

# Fields over the image are given at every 16th pixel centre and interpolated in between.
STEP = 16
# The quantiles of noise are a table of 12 bits; grey levels are looked up by the root of the light, which is nearly
# the gamma curve already, so that 12 bits are enough there, too.
BITS = 12


@kernel
def bits_of(seed: Any, counter: Any) -> Any:
    """Return 64 random bits of a counter: splitmix64 (Steele, Lea, Flood 2014)."""
    z = np.uint64(seed) + np.uint64(counter + 1) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@kernel
def _at(nodes: Any, x: Any, y: Any) -> Any:
    """Interpolate a field at a pixel."""
    column, row = x // STEP, y // STEP
    across = np.float32(x % STEP) / np.float32(STEP)
    down = np.float32(y % STEP) / np.float32(STEP)
    upper = nodes[row, column] + across * (nodes[row, column + 1] - nodes[row, column])
    lower = nodes[row + 1, column] + across * (nodes[row + 1, column + 1] - nodes[row + 1, column])
    return upper + down * (lower - upper)


@parallel_kernel
def to_light(image: Any, decode: Any, boost: Any) -> Any:
    """Return linear light f32[h,w,c] of grey levels; ``boost`` brightens by the darkest channel of a pixel."""
    height, width, channels = image.shape
    light = np.empty(image.shape, np.float32)
    for y in numba.prange(height):
        for x in range(width):
            least = image[y, x, 0]
            for c in range(1, channels):
                least = min(least, image[y, x, c])
            for c in range(channels):
                light[y, x, c] = decode[image[y, x, c]] * boost[least]
    return light


@kernel
def _taps(length: Any) -> Any:
    """Return m and a: weights 1 at steps -m..m and a at both ends beyond have the variance of a box of this length.

    The variance of the box is length^2 / 12, and that of steps -m..m alone m (m + 1) / 3.
    """
    variance = length * length / np.float32(12.0)
    m = int(np.floor((np.sqrt(np.float32(1.0) + length * length) - np.float32(1.0)) * np.float32(0.5)))
    whole = np.float32(m * (m + 1) * (2 * m + 1)) / np.float32(3.0)
    end = (np.float32(2 * m + 1) * variance - whole) / (np.float32(2.0) * (np.float32((m + 1) * (m + 1)) - variance))
    return m, max(end, np.float32(0.0))


@parallel_kernel
def smear(light: Any, turning: Any, moving: Any, depth_m: Any) -> Any:
    """Average light along each pixel's path: ``turning`` f32[r,q,2] in px, plus ``moving`` (px m) over depth.

    Steps along the longer axis of the path are whole pixels; across it light is interpolated.
    """
    height, width, channels = light.shape
    out = np.empty(light.shape, np.float32)
    turning_u, turning_v = turning[..., 0], turning[..., 1]
    moving_u, moving_v = moving[..., 0], moving[..., 1]
    for y in numba.prange(height):
        for x in range(width):
            du, dv = _at(turning_u, x, y), _at(turning_v, x, y)
            if depth_m[y, x] > 0.0:
                du += _at(moving_u, x, y) / depth_m[y, x]
                dv += _at(moving_v, x, y) / depth_m[y, x]
            flat = abs(du) >= abs(dv)
            length = abs(du) if flat else abs(dv)
            slope = np.float32(0.0) if length == 0.0 else (dv / du if flat else du / dv)
            m, end = _taps(length)
            scale = np.float32(1.0) / (np.float32(2 * m + 1) + np.float32(2.0) * end)
            # Sums in registers, for one channel or three, are faster than sums in the image.
            red = light[y, x, 0] * scale
            green = light[y, x, 1 % channels] * scale
            blue = light[y, x, 2 % channels] * scale
            for k in range(1, m + 2):
                weight = (end if k == m + 1 else np.float32(1.0)) * scale
                aside = np.float32(k) * slope
                below = int(np.floor(aside))
                far = weight * (aside - np.float32(below))
                near = weight - far
                # The taps at k and -k mirror each other; beyond the border the image repeats its last pixel.
                for sign in (1, -1):
                    x0, y0 = (x + sign * k, y + sign * below) if flat else (x + sign * below, y + sign * k)
                    x1, y1 = (x0, y0 + sign) if flat else (x0 + sign, y0)
                    x0, x1 = min(max(x0, 0), width - 1), min(max(x1, 0), width - 1)
                    y0, y1 = min(max(y0, 0), height - 1), min(max(y1, 0), height - 1)
                    red += near * light[y0, x0, 0] + far * light[y1, x1, 0]
                    if channels == 3:
                        green += near * light[y0, x0, 1] + far * light[y1, x1, 1]
                        blue += near * light[y0, x0, 2] + far * light[y1, x1, 2]
            out[y, x, 0] = red
            if channels == 3:
                out[y, x, 1], out[y, x, 2] = green, blue
    return out


@parallel_kernel
def develop(
    light: Any, falloff: Any, electrons: Any, read_e: Any, levels: Any, seed: Any, table: Any, grey: Any
) -> Any:
    """Return grey levels u8[h,w,c] of light.

    ``electrons`` of light 1 are collected, less ``falloff``; ``levels`` of an electron is its share of white. Each
    pixel has shot noise (variance: its electrons) and read noise (``read_e``), normal with quantiles ``table``; a
    negative ``read_e`` is no noise at all. ``grey`` are the grey levels of the root of a share of white.
    """
    height, width, channels = light.shape
    out = np.empty(light.shape, np.uint8)
    floor = read_e * read_e
    mask = np.uint64((1 << BITS) - 1)
    top = np.float32((1 << BITS) - 1)
    for y in numba.prange(height):
        for x in range(width):
            share = _at(falloff, x, y) * electrons
            bits = bits_of(seed, y * width + x)
            for c in range(channels):
                signal = light[y, x, c] * share
                if read_e >= 0.0:
                    signal += np.sqrt(signal + floor) * table[np.int64(bits & mask)]
                    bits >>= np.uint64(BITS)
                value = min(max(signal * levels, np.float32(0.0)), np.float32(1.0))
                out[y, x, c] = grey[int(np.sqrt(value) * top + np.float32(0.5))]
    return out


@kernel
def _bend(before: Any, here: Any, after: Any) -> Any:
    """Return how far a depth lies off the middle of its neighbours; nothing where one is missing."""
    return abs(before - 2.0 * here + after) if before > 0.0 and after > 0.0 else np.float32(0.0)


@kernel
def _slope(before: Any, here: Any, after: Any) -> Any:
    """Return the change of depth per pixel towards the neighbour that is nearer in depth, on the same surface."""
    if before > 0.0 and (after <= 0.0 or abs(here - before) < abs(after - here)):
        return here - before
    return after - here if after > 0.0 else np.float32(0.0)


@parallel_kernel
def holes(
    depth_m: Any,
    focal_px: Any,
    centre_px: Any,
    near_far_m: Any,
    edge: Any,
    edge_share: Any,
    sine: Any,
    speckle: Any,
    seed: Any,
) -> Any:
    """Return bool[h,w]: where depth is lost. ``sine`` is that of the lowest angle above a surface."""
    height, width = depth_m.shape
    lost = np.zeros(depth_m.shape, np.bool_)
    for y in numba.prange(height):
        for x in range(width):
            z = depth_m[y, x]
            if z < near_far_m[0] or z > near_far_m[1]:
                lost[y, x] = True
                continue
            left, right = depth_m[y, max(x - 1, 0)], depth_m[y, min(x + 1, width - 1)]
            up, down = depth_m[max(y - 1, 0), x], depth_m[min(y + 1, height - 1), x]
            bits = bits_of(seed, y * width + x)
            chance = np.float32(bits >> np.uint64(40)) / np.float32(1 << 24)
            other = np.float32(bits & np.uint64(0xFFFFFF)) / np.float32(1 << 24)
            step = max(_bend(left, z, right), _bend(up, z, down))
            if chance < speckle or (step > edge * z and other < edge_share):
                lost[y, x] = True
                continue
            # The points of neighbouring pixels span the surface; the ray rises above it by an angle of this sine.
            rx, ry = (x + 0.5 - centre_px[0]) / focal_px[0], (y + 0.5 - centre_px[1]) / focal_px[1]
            zx, zy = _slope(left, z, right), _slope(up, z, down)
            across = (z / focal_px[0] + zx * rx, zx * ry, zx)
            along = (zy * rx, z / focal_px[1] + zy * ry, zy)
            nx = across[1] * along[2] - across[2] * along[1]
            ny = across[2] * along[0] - across[0] * along[2]
            nz = across[0] * along[1] - across[1] * along[0]
            towards = abs(nx * rx + ny * ry + nz)
            lost[y, x] = towards < sine * np.sqrt((nx * nx + ny * ny + nz * nz) * (rx * rx + ry * ry + 1.0))
    return lost


@parallel_kernel
def noisy_depth(depth_m: Any, floor_m: Any, per_m2: Any, step_m: Any, seed: Any, table: Any) -> Any:
    """Return depth f32[h,w] with noise of ``floor_m`` + ``per_m2`` z^2, in whole steps; nothing stays 0."""
    height, width = depth_m.shape
    out = np.zeros(depth_m.shape, np.float32)
    for y in numba.prange(height):
        for x in range(width):
            z = depth_m[y, x]
            if z > 0.0:
                draw = table[np.int64(bits_of(seed, y * width + x) & np.uint64((1 << BITS) - 1))]
                noisy = z + (floor_m + per_m2 * z * z) * draw
                out[y, x] = max(np.rint(noisy / step_m), np.float32(1.0)) * step_m
    return out
