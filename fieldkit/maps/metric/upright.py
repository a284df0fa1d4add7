"""Which way is up in a reconstruction that nobody tracked: level cameras, upright lines in images, floors in depth."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fieldkit.cameras import Camera
from fieldkit.frames import Pose
from fieldkit.maps.metric.depth import depth_views
from fieldkit.maps.sources.source import MapSource, read_depth, read_image

Array = NDArray[np.float64]

# How level cameras are held: their x axis within this of horizontal, and, far less surely, their z axis
_ROLL_RAD, _PITCH_RAD = np.radians(5.0), np.radians(35.0)
# Lines and surfaces within this of the cameras' guess are taken for upright ones or for floors
_NEAR_RAD = np.radians(15.0)
# Widths of the robust fit, from coarse to fine
_WIDTHS_RAD = tuple(np.radians((6.0, 3.0, 1.5, 1.0, 1.0, 1.0)))
_MOST_IMAGES = 120
# Of the smaller side of the image; shorter lines have no direction
_SHORTEST_LINE = 0.06
_LEAST_SUPPORT = 200
_BLOCKS = 10


@dataclasses.dataclass(frozen=True)
class Upright:
    """The unit direction (3,) against gravity in SfM's frame, its standard deviation, and what told it.

    ``cameras`` assumes that the cameras were held level on average, ``verticals`` that most nearly upright lines in
    the images are upright, ``floor`` that most nearly level surfaces in the depth images are level.
    """

    up_in_sfm: Array
    sigma_deg: float
    source: Literal["floor", "verticals", "cameras"]


@dataclasses.dataclass(frozen=True)
class _Normals:
    """Unit normals (n, 3) in SfM's frame: ``across`` of planes that hold an upright line, and ``block`` int[n]."""

    xyz: Array
    weight: Array
    block: NDArray[np.int64]
    level_too: bool


def find_upright(walk: MapSource, sfm_from_cam: Mapping[int, Pose]) -> Upright:
    """Find the direction against gravity from what the mapping images show, the surest of three ways.

    The standard deviation is a jackknife's over blocks of the walk: what all blocks have wrong in common, such as a
    sloping floor, it does not tell.
    """
    level = level_cameras(list(sfm_from_cam.values()))
    found = [level]
    for source, normals in (
        ("floor", _surface_normals(walk, sfm_from_cam)),
        ("verticals", _line_normals(walk, sfm_from_cam)),
    ):
        better = _refined(level.up_in_sfm, normals)
        if better is not None:
            found.append(Upright(*better, "floor" if source == "floor" else "verticals"))
    return min(found, key=lambda u: u.sigma_deg)


def level_cameras(sfm_from_cam: Sequence[Pose]) -> Upright:
    """Return the direction that is most level for the cameras' x axes, and, weakly, for their optical axes."""
    axes = np.stack([p.rotation.as_matrix() for p in sfm_from_cam])

    def solve(chosen: Array) -> Array:
        across, ahead = chosen[:, :, 0], chosen[:, :, 2]
        spread = across.T @ across / _ROLL_RAD**2 + ahead.T @ ahead / _PITCH_RAD**2
        up = np.linalg.eigh(spread)[1][:, 0]
        return np.asarray(up * np.sign(-(chosen[:, :, 1] @ up).sum() or 1.0))

    blocks = np.arange(len(axes)) * _BLOCKS // len(axes)
    up = solve(axes)
    left_out = [solve(axes[blocks != b]) for b in np.unique(blocks) if (blocks != b).any()]
    # Nobody holds a camera level to better than this, however alike the blocks are
    return Upright(up, max(_jackknife_deg(up, left_out), 1.0), "cameras")


def up_rotation(up_in_sfm: Array, forward_in_sfm: Array) -> Rotation:
    """Return map_from_sfm with z along ``up_in_sfm`` and x along the level part of ``forward_in_sfm``, both (3,)."""
    z = up_in_sfm / np.linalg.norm(up_in_sfm)
    x = forward_in_sfm - (forward_in_sfm @ z) * z
    if np.linalg.norm(x) < 1e-3:
        x = np.cross(z, [1.0, 0.0, 0.0] if abs(z[0]) < 0.9 else [0.0, 1.0, 0.0])
    x = x / np.linalg.norm(x)
    return Rotation.from_matrix(np.stack([x, np.cross(z, x), z]))


def _refined(start: Array, normals: _Normals) -> tuple[Array, float] | None:
    """Return the direction to which most normals are square (or, where they may be, parallel), and its sigma."""
    up = _robust(start, normals)
    if up is None:
        return None
    rest = [
        _robust(up, _Normals(normals.xyz[keep], normals.weight[keep], normals.block[keep], normals.level_too))
        for b in np.unique(normals.block)
        if (keep := normals.block != b).any()
    ]
    left_out = [r for r in rest if r is not None]
    if len(left_out) < 3:
        return None
    return up, max(_jackknife_deg(up, left_out), 0.02)


def _robust(start: Array, normals: _Normals) -> Array | None:
    up = start
    for width in _WIDTHS_RAD:
        along = normals.xyz @ up
        square = np.abs(along) < np.sin(_NEAR_RAD)
        level = (np.abs(along) > np.cos(_NEAR_RAD)) & normals.level_too
        if square.sum() + level.sum() < _LEAST_SUPPORT:
            return None
        off = np.where(level, np.sqrt(np.maximum(1.0 - along**2, 0.0)), np.abs(along))
        weight = np.where(square | level, normals.weight / (1.0 + (off / width) ** 2) ** 2, 0.0)
        signed = np.where(level, -weight, weight)
        spread = (normals.xyz * signed[:, None]).T @ normals.xyz
        found = np.linalg.eigh(spread)[1][:, 0]
        up = found * np.sign(found @ up)
    return np.asarray(up)


def _jackknife_deg(up: Array, left_out: Sequence[Array]) -> float:
    n = len(left_out)
    if n < 3:
        return 90.0
    off = np.stack([u - up for u in left_out])
    return float(np.degrees(np.sqrt((n - 1) / n * (off**2).sum())))


def _line_normals(walk: MapSource, sfm_from_cam: Mapping[int, Pose]) -> _Normals:
    """Return the normals of the planes through camera centres and straight lines in the images."""
    chosen = sorted(sfm_from_cam)[:: max(1, -(-len(sfm_from_cam) // _MOST_IMAGES))]
    normals, weights, blocks = [], [], []
    for k, i in enumerate(chosen):
        camera = walk.images[i].camera
        ends = _lines(read_image(walk.images[i]), camera)
        if not len(ends):
            continue
        a, b = (_unit(camera.unproject(ends[:, side])) for side in (0, 1))
        across = np.cross(a, b)
        length = np.linalg.norm(across, axis=1)
        normals.append(sfm_from_cam[i].rotation.apply(across / np.maximum(length, 1e-12)[:, None]))
        weights.append(length**2)
        blocks.append(np.full(len(length), k * _BLOCKS // len(chosen)))
    return _gathered(normals, weights, blocks, level_too=False)


def _lines(grey: NDArray[np.uint8], camera: Camera) -> Array:
    """Return the ends (n, 2, 2) of straight lines in COLMAP pixels."""
    found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(grey)[0]
    if found is None:
        return np.zeros((0, 2, 2))
    ends = np.asarray(found, dtype=np.float64).reshape(-1, 2, 2) + 0.5
    long = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > _SHORTEST_LINE * min(camera.width, camera.height)
    return np.asarray(ends[long])


def _surface_normals(walk: MapSource, sfm_from_cam: Mapping[int, Pose]) -> _Normals:
    """Return the normals of smooth surfaces in the depth images."""
    if walk.depth_camera is None:
        return _gathered([], [], [], level_too=True)
    views = depth_views(walk, sfm_from_cam)
    views = views[:: max(1, -(-len(views) // _MOST_IMAGES))]
    normals, weights, blocks = [], [], []
    for k, (frame, sfm_from_depth) in enumerate(views):
        found = _depth_normals(read_depth(frame, walk.depth_camera), walk.depth_camera)
        normals.append(sfm_from_depth.rotation.apply(found))
        weights.append(np.ones(len(found)))
        blocks.append(np.full(len(found), k * _BLOCKS // len(views)))
    return _gathered(normals, weights, blocks, level_too=True)


def _depth_normals(depth_mm: NDArray[np.uint16], camera: Camera) -> Array:
    """Return unit normals (n, 3) in the depth camera, on a grid, where five points lie on one plane."""
    reach, step = max(2, camera.width // 32), max(2, camera.width // 64)
    v, u = (g.ravel() for g in np.mgrid[reach : camera.height - reach : step, reach : camera.width - reach : step])
    around = [(u, v), (u - reach, v), (u + reach, v), (u, v - reach), (u, v + reach)]
    z = np.stack([depth_mm[b, a] for a, b in around]).astype(np.float64) / 1000.0
    rays = [camera.unproject(np.column_stack([a + 0.5, b + 0.5])) for a, b in around]
    centre, left, right, above, below = (r * d[:, None] for r, d in zip(rays, z, strict=True))
    normal = _unit(np.cross(right - left, below - above))
    off = np.abs(
        np.einsum("kni,ni->kn", np.stack([left - centre, right - centre, above - centre, below - centre]), normal)
    )
    flat = (z > 0.3).all(axis=0) & (z < 5.0).all(axis=0) & (off.max(axis=0) < 0.01 * z[0])
    return np.asarray(normal[flat])


def _gathered(
    normals: Sequence[Array], weights: Sequence[Array], blocks: Sequence[NDArray[np.int64]], *, level_too: bool
) -> _Normals:
    if not normals:
        return _Normals(np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64), level_too)
    return _Normals(np.concatenate(normals), np.concatenate(weights), np.concatenate(blocks), level_too)


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))
