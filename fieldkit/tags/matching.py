"""Corners of a tag from its whole pattern, blurred as the image is: for tags whose cells run into each other."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from fieldkit.cameras import Camera
from fieldkit.tags.edges import CornerFit
from fieldkit.tags.families import Family, pattern
from fieldkit.tags.kernels import blurred_pattern
from fieldkit.tags.lens import bend, bend_slope, flatten
from fieldkit.types import Image

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# What lies farther outside of the square than this share of a cell is not compared: the margin may end there
OUTSIDE_CELLS = 0.5
# Pixels times nodes of the blur that are computed: of a large tag every second or third pixel is compared
MAX_SAMPLES = 200000
# Most nodes for the part of the blur that is not along the tag's axes, and how far they reach in its deviations
MAX_NODES, NODE_REACH = 31, 3.5
# Only pixels that are nearer to an edge of a cell than so many deviations of the blur tell where it is
NEAR_BLURS, NEAR_PX = 3.0, 2.0
# Deviation of a pixel's own width
PIXEL_PX = math.sqrt(1.0 / 12.0)
# Light that changes across the tag: constant and two slopes for black, the same for white, and what lies beyond it
N_LIGHT = 7
# Corners, blur and tone
N_SHAPE = 10
# Reflectance of black over that of white; tones between 1 (blur acts on grey values) and 0.45 (on light, as in a lens)
BLACK, MIN_TONE, MAX_TONE = 0.05, 0.2, 2.0
# Corners that move farther than the pixels near an edge start again from where they are, so many times
MAX_ROUNDS = 3
# Residuals beyond this share of the contrast weigh less and less: glare, dirt; but not what the blur's shape leaves
OUTLIER = 0.3
# Blur that the instrument adds to the picture's own, in pixels
WIDER_PX = 0.7
# A residual of more than this share of the contrast is no picture of this tag
MAX_MISFIT = 0.2


@dataclasses.dataclass(frozen=True)
class _Patch:
    """The pixels that are compared: grey values (n,), undistorted places (n, 2), and d(undistorted)/d(pixel) there."""

    values: Array
    flat: Array
    flat_by_pixel: Array
    rows: Ints
    columns: Ints
    is_outline: NDArray[np.bool_]


@dataclasses.dataclass(frozen=True)
class _Shape:
    """What is fitted beside the light: corners (4, 2) in undistorted pixels, log of the blur in pixels, tone."""

    corners: Array
    log_blur: float
    tone: float

    def moved(self, step: NDArray[np.floating[Any]]) -> _Shape:
        log_blur = self.log_blur + float(np.clip(step[8], -0.5, 0.5))
        tone = float(np.clip(self.tone + np.clip(step[9], -0.3, 0.3), MIN_TONE, MAX_TONE))
        return _Shape(self.corners + step[:8].reshape(4, 2), float(np.clip(log_blur, -2.0, 3.5)), tone)


@dataclasses.dataclass(frozen=True)
class _Picture:
    """Residuals (n,) of a shape under the best light, their slopes (n, 10) by shape and (n, 7) by light."""

    residual: Array
    slope: Array
    light: Array

    @property
    def design(self) -> Array:
        return np.hstack([self.slope, self.light])

    @property
    def scale(self) -> float:
        return max(1.4826 * float(np.median(np.abs(self.residual))), 0.3)


def fit_pattern(grey: Image, camera: Camera, family: Family, tag_id: int, start: CornerFit) -> CornerFit | None:
    """Fit corners, blur, tone and light of a tag's known pattern to the image by least squares, from a start.

    The tone is the exponent between light, which a lens blurs, and grey values: without it white would seem to grow.
    The covariance is that of the residuals: noise, and whatever the model of a Gaussian blur does not explain.
    Returns None where the pattern does not explain the image.
    """
    for _ in range(MAX_ROUNDS):
        fit = _fit_once(_patch(grey, camera, family, start), family, tag_id, start)
        if fit is None or float(np.abs(fit.flat - start.flat).max()) < NEAR_PX:
            return fit
        start = fit
    return None


def misplacement_px(grey: Image, camera: Camera, family: Family, tag_id: int, start: CornerFit) -> float:
    """Return by how many pixels, as a root mean square, the image says that corners are off, to first order."""
    patch = _patch(grey, camera, family, start)
    if len(patch.values) < 2 * (N_SHAPE + N_LIGHT):
        return 0.0
    shape, cells = _Shape(start.flat, math.log(_lens_blur(start.blur_px)), 1.0), pattern(family.name, tag_id)
    picture = _picture(patch, family, cells.astype(np.float64), shape, np.ones(len(patch.values)))
    step = np.linalg.lstsq(picture.design, picture.residual, rcond=None)[0][:8]
    return float(np.sqrt(np.mean(step**2)))


def _fit_once(patch: _Patch, family: Family, tag_id: int, start: CornerFit) -> CornerFit | None:
    if len(patch.values) < 2 * (N_SHAPE + N_LIGHT):
        return None
    cells = pattern(family.name, tag_id).astype(np.float64)
    shape, damping = _Shape(start.flat, math.log(_lens_blur(start.blur_px)), 1.0), 1e-4
    weights = np.ones(len(patch.values))
    picture = _picture(patch, family, cells, shape, weights)
    for _ in range(15):
        weights = _weights(patch, picture)
        design = picture.design
        normal, gradient = design.T @ (design * weights[:, None]), design.T @ (weights * picture.residual)
        step = np.linalg.lstsq(normal + damping * np.diag(np.diag(normal)), gradient, rcond=None)[0]
        if np.abs(step[:8]).max() > 10.0:
            return None
        moved = shape.moved(step)
        new = _picture(patch, family, cells, moved, weights)
        if float(weights @ new.residual**2) <= float(weights @ picture.residual**2):
            shape, picture, damping = moved, new, max(damping / 10, 1e-9)
            if float(np.abs(step[:8]).max()) < 1e-3:
                break
        elif damping > 1e3:
            break
        else:
            damping *= 10
    return _polished(patch, family, cells, shape, picture)


def _polished(patch: _Patch, family: Family, cells: Array, shape: _Shape, picture: _Picture) -> CornerFit | None:
    """Solve for corners whose residuals, summed across edges, vanish; return them with their covariance.

    Least squares trusts the few pixels on which a sharp edge falls, and errs as the picture of an edge there differs
    from the model's. Summed with the slopes of a more blurred picture (an instrument), what the model's blur does not
    explain cancels from one side of an edge to the other.
    """
    weights = _weights(patch, picture)
    wide = _Shape(shape.corners, math.log(math.hypot(math.exp(shape.log_blur), PIXEL_PX, WIDER_PX)), shape.tone)
    instrument = picture.design
    instrument[:, :8] = _picture(patch, family, cells, wide, weights).slope[:, :8]
    weighted = instrument * weights[:, None]
    for _ in range(4):
        step = np.linalg.lstsq(weighted.T @ picture.design, weighted.T @ picture.residual, rcond=None)[0]
        if np.abs(step[:8]).max() > 2.0:
            return None
        shape = shape.moved(step)
        picture = _picture(patch, family, cells, shape, weights)
        if float(np.abs(step[:8]).max()) < 1e-3:
            break
    return _judged(patch, shape, picture, weighted)


def _judged(patch: _Patch, shape: _Shape, picture: _Picture, weighted: Array) -> CornerFit | None:
    count, parameters = picture.design.shape
    freedom = count / (count - parameters)
    if math.sqrt(freedom * float(np.mean(picture.residual**2))) > MAX_MISFIT * _contrast(patch):
        return None
    # Residuals differ from pixel to pixel: at edges more than elsewhere (White 1980)
    inverse = np.linalg.pinv(weighted.T @ picture.design)[:8]
    scores = weighted * picture.residual[:, None]
    factor = freedom * _correlation(patch, picture.residual)
    bending = _bending_px(*(a[patch.is_outline, :8] for a in (picture.slope, weighted, scores)))
    covariance = inverse @ (scores.T @ scores) @ inverse.T * factor + bending**2 * np.eye(8)
    if not np.isfinite(covariance).all() or not (np.linalg.eigvalsh(covariance) > 0).all():
        return None
    return CornerFit(shape.corners, covariance, math.hypot(math.exp(shape.log_blur), PIXEL_PX))


def _weights(patch: _Patch, picture: _Picture) -> Array:
    tolerated = max(4.0 * picture.scale, OUTLIER * _contrast(patch))
    weights: Array = 1.0 / (1.0 + (picture.residual / tolerated) ** 8)
    return weights


def _lens_blur(blur_px: float) -> float:
    """Return what is left of a blur, as a deviation in pixels, without the pixel's own."""
    return math.sqrt(max(blur_px**2 - PIXEL_PX**2, 0.2**2))


def _contrast(patch: _Patch) -> float:
    return float(np.ptp(np.quantile(patch.values, [0.05, 0.95])))


def _correlation(patch: _Patch, residual: Array) -> float:
    """Return by how much the variance of means exceeds that of independent residuals, from neighbours' products."""
    rows, columns = patch.rows - patch.rows.min(), patch.columns - patch.columns.min()
    image = np.full((rows.max() + 1, columns.max() + 1), np.nan)
    image[rows, columns] = residual
    factor, square = 1.0, float(np.mean(residual**2))
    for one, two in ((image[1:], image[:-1]), (image[:, 1:], image[:, :-1])):
        product = one * two
        if np.isfinite(product).sum() > 20:
            factor *= max(1.0, 1.0 + 2.0 * float(np.nanmean(product)) / max(square, 1e-12))
    return factor


def _bending_px(slope: Array, weighted: Array, scores: Array) -> float:
    """Return by how many pixels, as a root mean square, the outline alone would move the corners, beyond its noise.

    The interior of a tag on bent paper, or of one that something covers at its rim, fits another square than its
    outline; which of the two is the tag's cannot be told. All (n, 8) are of the outline's pixels.
    """
    if len(scores) <= 8:
        return 0.0
    total = scores.sum(axis=0)
    step = np.linalg.pinv(weighted.T @ slope) @ total
    excess = float(total @ np.linalg.pinv(scores.T @ scores, hermitian=True) @ total) / 8
    return math.sqrt(max(1.0 - 1.0 / max(excess, 1e-9), 0.0) * float(np.mean(step**2)))


def _patch(grey: Image, camera: Camera, family: Family, start: CornerFit) -> _Patch:
    corners = bend(camera, start.flat)
    low = np.clip(np.floor(corners.min(axis=0)) - 2, 0, grey.shape[::-1]).astype(int)
    high = np.clip(np.ceil(corners.max(axis=0)) + 2, 0, grey.shape[::-1]).astype(int)
    rows, columns = (w.ravel() for w in np.mgrid[low[1] : high[1], low[0] : high[0]])
    centre = start.flat.mean(axis=0)[None]
    flat_by_pixel = np.linalg.inv(bend_slope(camera, centre)[0])
    # Which of many pixels are near an edge need not be known exactly: without the lens's curvature
    flat = centre + (np.column_stack([columns + 0.5, rows + 0.5]) - bend(camera, centre)) @ flat_by_pixel.T
    near = _near(family, start, flat, flat_by_pixel)
    rows, columns = rows[near], columns[near]
    nodes = len(_Axes.of(_derivative(_tag_from_flat(start.flat, family.cells), centre) @ flat_by_pixel, 1.0).nodes)
    every = max(1, math.ceil(len(rows) * nodes / MAX_SAMPLES))
    # A lattice that is not aligned with the rows of pixels
    kept = (rows * max(round(0.382 * every), 1) + columns) % every == 0
    rows, columns = rows[kept], columns[kept]
    flat = flatten(camera, np.column_stack([columns + 0.5, rows + 0.5]))
    off = np.abs(_apply(_tag_from_flat(start.flat, family.cells), flat) - family.cells / 2).max(axis=1)
    is_outline = off > (family.cells - 1) / 2
    return _Patch(grey[rows, columns].astype(np.float64), flat, flat_by_pixel, rows, columns, is_outline)


def _near(family: Family, start: CornerFit, flat: Array, flat_by_pixel: Array) -> NDArray[np.bool_]:
    """Return bool[n]: which places lie on the square, or not far outside, and near the edge of a cell."""
    tag_from_flat = _tag_from_flat(start.flat, family.cells)
    places = _apply(tag_from_flat, flat)
    slope = _derivative(tag_from_flat, flat) @ flat_by_pixel
    off = np.abs(places - np.round(places)) / np.maximum(np.linalg.norm(slope, axis=2), 1e-12)
    within = ((places > -OUTSIDE_CELLS) & (places < family.cells + OUTSIDE_CELLS)).all(axis=1)
    near: NDArray[np.bool_] = within & (off.min(axis=1) < NEAR_BLURS * start.blur_px + NEAR_PX)
    return near


@dataclasses.dataclass(frozen=True)
class _Axes:
    """What blurs n places, seen in cells: the lens's Gaussian of the image, and the pixel that averages its square.

    With A (n, 2, 2) = d(place)/d(pixel), the Gaussian has the covariance S = blur^2 A A' in the tag's axes. With its
    correlation r, (1 - |r|) diag S acts along the axes, where a blurred pattern is a product of error functions; the
    rest of S has rank one: ``aslant`` (n, 2), over which ``nodes`` sum. Along each axis the pixel is a box (``widths``)
    and a narrower box, which counts as a Gaussian. ``axial`` (n, 2) are the deviations of all Gaussians along the
    axes, ``lens`` (n, 2) the lens's share of their squares, ``deviation`` (n, 2) that of everything.
    """

    deviation: Array
    axial: Array
    lens: Array
    widths: Array
    aslant: Array
    nodes: Array

    @staticmethod
    def of(by_pixel: Array, blur_px: float) -> _Axes:
        spread = by_pixel @ by_pixel.transpose(0, 2, 1) * blur_px**2
        variance = np.stack([spread[:, 0, 0], spread[:, 1, 1]], axis=1)
        r = np.clip(spread[:, 0, 1] / np.sqrt(variance.prod(axis=1)), -0.999, 0.999)
        sides = np.abs(by_pixel)
        wide, narrow = sides.max(axis=2), sides.min(axis=2) ** 2 / 12
        axial = variance * (1.0 - np.abs(r))[:, None] + narrow
        aslant = np.sqrt(variance * np.abs(r)[:, None]) * np.column_stack([np.ones(len(r)), np.sign(r)])
        lens = 1.0 - narrow / axial
        deviation = np.sqrt(variance + narrow + wide**2 / 12)
        return _Axes(deviation, np.sqrt(axial), lens, wide, aslant, _nodes(float(np.abs(r).max())))


def _nodes(correlation: float) -> Array:
    """Return the nodes of a sum over a Gaussian, as close as what it is convolved with is narrow."""
    if correlation < 0.02:
        return np.zeros(1)
    spacing = math.sqrt((1.0 - correlation) / correlation)
    half = min(max(math.ceil(NODE_REACH / spacing), 2), MAX_NODES // 2)
    return np.linspace(-NODE_REACH, NODE_REACH, 2 * half + 1)


def _picture(patch: _Patch, family: Family, cells: Array, shape: _Shape, weights: Array) -> _Picture:
    tag_from_flat = _tag_from_flat(shape.corners, family.cells)
    places = _apply(tag_from_flat, patch.flat)
    axes = _Axes.of(_derivative(tag_from_flat, patch.flat) @ patch.flat_by_pixel, math.exp(shape.log_blur))
    margin = (family.total - family.cells) / 2
    node_weights = np.exp(-0.5 * axes.nodes**2)
    ink, by_place, by_blur = blurred_pattern(
        cells,
        places + margin,
        axes.axial,
        axes.lens,
        axes.widths,
        axes.aslant,
        axes.nodes,
        node_weights / node_weights.sum(),
    )
    ink, by_ink, by_tone = _toned(ink, shape.tone)
    place = (places - family.cells / 2) / family.cells
    ramps = np.column_stack([np.ones(len(place)), place])
    beyond = 1.0 - _within(family, places, axes)
    if beyond.max() < 1e-3:
        beyond[:] = 0.0
    light = np.hstack([ramps, ramps * ink[:, None], beyond[:, None]])
    root = np.sqrt(weights)
    amount = np.linalg.lstsq(light * root[:, None], patch.values * root, rcond=None)[0]
    white = ramps @ amount[3:6]
    slope = np.empty((len(place), N_SHAPE))
    for k in range(8):
        # A corner that moves carries the pattern along: places move against it
        bumped = shape.corners.copy()
        bumped[k // 2, k % 2] += 1e-3
        moved = (_apply(_tag_from_flat(bumped, family.cells), patch.flat) - places) / 1e-3
        slope[:, k] = white * by_ink * np.einsum("ni,ni->n", by_place, moved)
    slope[:, 8] = white * by_ink * by_blur
    slope[:, 9] = white * by_tone
    return _Picture(patch.values - light @ amount, slope, light)


def _toned(ink: Array, tone: float) -> tuple[Array, Array, Array]:
    """Return grey values (n,) of 0..1 for reflected light of 0..1, and their derivatives by light and by tone."""

    def curve(exponent: float) -> Array:
        span = (1.0 + BLACK) ** exponent - BLACK**exponent
        values: Array = ((ink + BLACK) ** exponent - BLACK**exponent) / span
        return values

    by_ink = tone * (ink + BLACK) ** (tone - 1.0) / ((1.0 + BLACK) ** tone - BLACK**tone)
    return curve(tone), by_ink, (curve(tone + 1e-4) - curve(tone - 1e-4)) / 2e-4


def _within(family: Family, places: Array, axes: _Axes) -> Array:
    """Return how much (n,) of the blurred neighbourhood of places lies within the printed pattern."""
    margin = (family.total - family.cells) / 2
    above, below = ((b - places) / axes.deviation for b in (family.cells + margin, -margin))
    result: Array = (ndtr(above) - ndtr(below)).prod(axis=1)
    return result


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
