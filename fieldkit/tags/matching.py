"""Corners of a tag from its whole pattern, blurred as the image is: for tags whose cells run into each other."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from fieldkit.cameras import Camera
from fieldkit.tags.edges import CornerFit
from fieldkit.tags.families import Family, pattern
from fieldkit.tags.lens import bend, bend_slope, flatten
from fieldkit.types import Image

Array = NDArray[np.float64]

# What lies farther outside of the square than this share of a cell is not compared: the margin may end there
OUTSIDE_CELLS = 0.5
# Of a large tag so many pixels are compared
MAX_PIXELS = 6000
# Gauss-Hermite nodes for the part of the blur that is not along the tag's axes
NODES, NODE_WEIGHTS = np.polynomial.hermite_e.hermegauss(5)
# Light that changes across the tag: constant and two slopes for black, the same for white, and what lies beyond it
N_LIGHT = 7
# A residual of more than this share of the contrast is no picture of this tag
MAX_MISFIT = 0.2


@dataclasses.dataclass(frozen=True)
class _Patch:
    """The pixels that are compared: grey values (n,), undistorted places (n, 2), and d(undistorted)/d(pixel) there."""

    values: Array
    flat: Array
    flat_by_pixel: Array
    where: tuple[NDArray[np.intp], NDArray[np.intp]]


def fit_pattern(grey: Image, camera: Camera, family: Family, tag_id: int, start: CornerFit) -> CornerFit | None:
    """Fit corners, blur and light of a tag's known pattern to the image by least squares, from a start.

    The covariance is that of the residuals: noise, and whatever the model of a Gaussian blur does not explain.
    Returns None where the pattern does not explain the image.
    """
    patch = _patch(grey, camera, family, start)
    if len(patch.values) < 8 + 1 + N_LIGHT + 8:
        return None
    cells = pattern(family.name, tag_id).astype(np.float64)
    corners, log_blur, damping = start.flat.copy(), math.log(max(start.blur_px, 0.3)), 1e-4
    weights = np.ones(len(patch.values))
    residual, slope, light = _model(patch, family, cells, corners, log_blur, weights)
    scale = _scale(residual)
    for _ in range(12):
        weights = 1.0 / (1.0 + (residual / (4.0 * scale)) ** 4)
        # Light enters linearly: of the slope, what light cannot explain
        design = np.hstack([slope, light]) * np.sqrt(weights)[:, None]
        normal = design.T @ design
        gradient = design.T @ (residual * np.sqrt(weights))
        step = np.linalg.lstsq(normal + damping * np.diag(np.diag(normal)), gradient, rcond=None)[0]
        moved, blur = corners + step[:8].reshape(4, 2), log_blur + float(np.clip(step[8], -0.5, 0.5))
        if np.abs(step[:8]).max() > 10.0 or not -2.5 < blur < 3.5:
            return None
        new = _model(patch, family, cells, moved, blur, weights)
        if float(weights @ new[0] ** 2) <= float(weights @ residual**2):
            small = float(np.abs(step[:8]).max()) < 1e-3
            corners, log_blur, (residual, slope, light), damping = moved, blur, new, max(damping / 10, 1e-9)
            scale = _scale(residual)
            if small:
                break
        elif damping > 1e3:
            break
        else:
            damping *= 10
    return _judged(patch, corners, log_blur, residual, slope, light, weights)


def _judged(
    patch: _Patch, corners: Array, log_blur: float, residual: Array, slope: Array, light: Array, weights: Array
) -> CornerFit | None:
    contrast = float(np.ptp(np.quantile(patch.values, [0.05, 0.95])))
    design = np.hstack([slope, light])
    n, p = design.shape
    variance = float(weights @ residual**2) / max(float(weights.sum()) - p, 1.0)
    if math.sqrt(variance) > MAX_MISFIT * contrast:
        return None
    covariance = np.linalg.pinv(design.T @ (design * weights[:, None]))[:8, :8] * variance * _correlation(patch, residual)
    if not np.isfinite(covariance).all() or not (np.linalg.eigvalsh(covariance) > 0).all():
        return None
    return CornerFit(corners, covariance, math.exp(log_blur))


def _scale(residual: Array) -> float:
    return max(1.4826 * float(np.median(np.abs(residual))), 0.3)


def _correlation(patch: _Patch, residual: Array) -> float:
    """Return by how much the variance of means exceeds that of independent residuals, from their neighbours' product."""
    rows, columns = (w - w.min() for w in patch.where)
    image = np.full((rows.max() + 1, columns.max() + 1), np.nan)
    image[rows, columns] = residual
    factor, square = 1.0, float(np.mean(residual**2))
    for one, two in ((image[1:], image[:-1]), (image[:, 1:], image[:, :-1])):
        product = one * two
        if np.isfinite(product).sum() > 20:
            factor *= max(1.0, 1.0 + 2.0 * float(np.nanmean(product)) / max(square, 1e-12))
    return factor


def _patch(grey: Image, camera: Camera, family: Family, start: CornerFit) -> _Patch:
    corners = bend(camera, start.flat)
    height, width = grey.shape
    low = np.clip(np.floor(corners.min(axis=0)) - 2, 0, (width, height)).astype(int)
    high = np.clip(np.ceil(corners.max(axis=0)) + 2, 0, (width, height)).astype(int)
    area = float(np.prod(np.maximum(high - low, 1)))
    stride = max(1, round(math.sqrt(area / MAX_PIXELS)))
    rows, columns = np.meshgrid(
        np.arange(low[1], high[1], stride), np.arange(low[0], high[0], stride), indexing="ij"
    )
    rows, columns = rows.ravel(), columns.ravel()
    flat = flatten(camera, np.column_stack([columns + 0.5, rows + 0.5]))
    places = _apply(_tag_from_flat(start.flat, family.cells), flat)
    near = ((places > -OUTSIDE_CELLS) & (places < family.cells + OUTSIDE_CELLS)).all(axis=1)
    slope = np.linalg.inv(bend_slope(camera, start.flat.mean(axis=0)[None])[0])
    where = rows[near] // stride, columns[near] // stride
    return _Patch(grey[rows[near], columns[near]].astype(np.float64), flat[near], slope, where)


def _model(
    patch: _Patch, family: Family, cells: Array, corners: Array, log_blur: float, weights: Array
) -> tuple[Array, Array, Array]:
    """Return residuals (n,), the slope (n, 9) of the picture by corners and blur, and that (n, 7) by light."""
    tag_from_flat = _tag_from_flat(corners, family.cells)
    places = _apply(tag_from_flat, patch.flat)
    by_flat = _derivative(tag_from_flat, patch.flat)
    blur = math.exp(log_blur)
    ink, by_place = _blurred(family, cells, places, by_flat @ patch.flat_by_pixel, blur)
    rest, _ = _blurred(family, np.ones((1, 1)), places, by_flat @ patch.flat_by_pixel, blur)
    wider, _ = _blurred(family, cells, places, by_flat @ patch.flat_by_pixel, blur * 1.01)
    place = (places - family.cells / 2) / family.cells
    ramps = np.column_stack([np.ones(len(place)), place])
    light = np.hstack([ramps, ramps * ink[:, None], 1.0 - rest[:, None]])
    root = np.sqrt(weights)
    amount = np.linalg.lstsq(light * root[:, None], patch.values * root, rcond=None)[0]
    residual = patch.values - light @ amount
    white = ramps @ amount[3:6]
    slope = np.empty((len(residual), 9))
    for k in range(8):
        # A corner that moves carries the pattern along: places move against it
        bumped = corners.copy()
        bumped[k // 2, k % 2] += 1e-3
        moved = (_apply(_tag_from_flat(bumped, family.cells), patch.flat) - places) / 1e-3
        slope[:, k] = white * np.einsum("ni,ni->n", by_place, moved)
    slope[:, 8] = white * (wider - ink) / 0.01
    return residual, slope, light


def _blurred(family: Family, cells: Array, places: Array, by_pixel: Array, blur_px: float) -> tuple[Array, Array]:
    """Return the pattern at places (n, 2) in cells, blurred by a Gaussian of the image, and its derivative (n, 2).

    In the tag's axes the Gaussian has the covariance S = blur^2 A A', A (n, 2, 2) = d(place)/d(pixel). Along the axes
    the blurred pattern is a product of error functions; the correlated rest of S has rank one and is summed over nodes.
    """
    spread = by_pixel @ by_pixel.transpose(0, 2, 1) * blur_px**2
    deviation = np.sqrt(np.stack([spread[:, 0, 0], spread[:, 1, 1]], axis=1))
    rho = np.clip(spread[:, 0, 1] / (deviation[:, 0] * deviation[:, 1]), -0.999, 0.999)
    axial = deviation * np.sqrt(1.0 - np.abs(rho))[:, None]
    aslant = deviation * np.sqrt(np.abs(rho))[:, None] * np.column_stack([np.ones(len(rho)), np.sign(rho)])
    nodes, weights = (NODES, NODE_WEIGHTS) if np.abs(rho).max() > 0.02 else (np.zeros(1), np.ones(1))
    value, slope = np.zeros(len(places)), np.zeros((len(places), 2))
    margin = (len(cells) - family.cells) / 2 if len(cells) > 1 else (family.total - family.cells) / 2
    bounds = np.arange(1, len(cells)) - margin if len(cells) > 1 else np.array([-margin, family.cells + margin])
    for node, weight in zip(nodes, weights / weights.sum(), strict=True):
        shifted = places + node * aslant
        (gu, du), (gv, dv) = (_shares(bounds, shifted[:, i], axial[:, i]) for i in (0, 1))
        if len(cells) == 1:
            value += weight * gu[:, 1] * gv[:, 1]
            continue
        rows = gv @ cells
        value += weight * np.einsum("nj,nj->n", rows, gu)
        slope[:, 0] += weight * np.einsum("nj,nj->n", rows, du)
        slope[:, 1] += weight * np.einsum("nj,nj->n", dv @ cells, gu)
    return value, slope


def _shares(bounds: Array, at: Array, deviation: Array) -> tuple[Array, Array]:
    """Return the share of a Gaussian at ``at`` in each of the intervals between bounds, and its derivative by ``at``."""
    z = (bounds - at[:, None]) / deviation[:, None]
    below = np.hstack([np.zeros((len(at), 1)), ndtr(z), np.ones((len(at), 1))])
    density = np.exp(-0.5 * z**2) / (math.sqrt(2 * math.pi) * deviation[:, None])
    density = np.hstack([np.zeros((len(at), 1)), density, np.zeros((len(at), 1))])
    return np.diff(below, axis=1), -np.diff(density, axis=1)


def _tag_from_flat(corners: Array, cells: int) -> Array:
    """Return the homography from undistorted pixels to cells: columns to the right, rows down from the top left."""
    square = np.array([[0, cells], [cells, cells], [cells, 0], [0, 0]], dtype=np.float64)
    rows = []
    for (x, y), (u, v) in zip(corners, square, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
    solved = np.linalg.solve(np.array(rows), square.ravel())
    return np.append(solved, 1.0).reshape(3, 3)


def _apply(homography: Array, points: Array) -> Array:
    mapped = points @ homography[:, :2].T + homography[:, 2]
    result: Array = mapped[:, :2] / mapped[:, 2:]
    return result


def _derivative(homography: Array, points: Array) -> Array:
    mapped = points @ homography[:, :2].T + homography[:, 2]
    w = mapped[:, 2, None, None]
    result: Array = (homography[:2, :2] - (mapped[:, :2] / mapped[:, 2:])[:, :, None] * homography[2, :2]) / w
    return result
