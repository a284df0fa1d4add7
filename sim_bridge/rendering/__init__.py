"""Render a scene with a camera: antialiased colour and exact depth."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numba
import numpy as np
from numpy.typing import NDArray

from fieldkit.cameras import Camera
from fieldkit.errors import CameraError
from fieldkit.frames import Pose
from sim_bridge.mesh import Scene
from sim_bridge.rendering import cull, lens, raster
from sim_bridge.rendering.cull import Mesh, View
from sim_bridge.rendering.shade import Picture, Textures
from sim_bridge.texels import LEVELS, Mips

Array = NDArray[np.float64]

# A camera with distortion is rendered as a pinhole of this many times its focal length, then bent.
OVERSAMPLING = 1.1
# Half a field of view beyond this cannot be drawn on the plane of one pinhole image.
WIDEST_TAN = 4.0
# The bending is computed exactly at every 16th pixel and interpolated by cubics in between.
_STEP = 16
_MARGIN_PX = 6


@dataclasses.dataclass(frozen=True, eq=False)
class Image:
    """A rendered image: ``rgb`` uint8[h,w,3]; ``depth_m`` float32[h,w] along the camera's axis, 0 where nothing is.

    Depth is that of the ray through the centre (u + 0.5, v + 0.5) of each pixel.
    """

    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]


@dataclasses.dataclass(frozen=True, eq=False)
class _Drawn:
    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    seen: NDArray[np.int32]
    planes: Array


def render_numba(scene: Scene, camera: Camera, world_from_cam: Pose, *, samples: int = 4) -> Image:
    """Render with the rasteriser of `raster`, bent by `lens` when the camera's lens distorts."""
    cam_from_world = world_from_cam.inv().as_matrix()[:3]
    if camera.is_pinhole:
        drawn = _draw(scene, camera.matrix() @ cam_from_world, (camera.width, camera.height), samples=samples)
        return Image(drawn.rgb, drawn.depth_m)
    nodes = _directions(camera)
    low, high = nodes.min(axis=(0, 1)), nodes.max(axis=(0, 1))
    focal = OVERSAMPLING * np.asarray(camera.focal_px)
    centre = _MARGIN_PX - focal * low
    width, height = (int(v) for v in np.ceil(focal * (high - low) + 2 * _MARGIN_PX))
    matrix = np.array([[focal[0], 0.0, centre[0]], [0.0, focal[1], centre[1]], [0.0, 0.0, 1.0]])
    drawn = _draw(scene, matrix @ cam_from_world, (width, height), samples=samples)
    positions = nodes * focal + centre
    rgb, depth = lens.bend(drawn.rgb, drawn.seen, drawn.planes, positions, _STEP, camera.width, camera.height)
    return Image(rgb, depth)


def check_camera(camera: Camera) -> None:
    """Raise CameraError for a camera that `render` refuses: its lens looks too far aside, or folds the picture."""
    if not camera.is_pinhole:
        _directions(camera)


def _directions(camera: Camera) -> Array:
    """Return normalised coordinates f64[r,c,2] at every 16th pixel centre, from one step before to two after.

    Raises CameraError where they reach beyond WIDEST_TAN.
    """
    cols = np.arange(-1, (camera.width - 1) // _STEP + 3) * _STEP + 0.5
    rows = np.arange(-1, (camera.height - 1) // _STEP + 3) * _STEP + 0.5
    grid = np.stack(np.meshgrid(cols, rows), axis=-1)
    nodes = camera.unproject(grid.reshape(-1, 2))[:, :2].reshape(grid.shape)
    # Written so that what is no number is refused, too.
    if not float(np.abs(nodes).max()) <= WIDEST_TAN:
        raise CameraError(
            f"camera {camera.model} {camera.width}x{camera.height}: field of view too wide to render; "
            f"expected at most {np.degrees(np.arctan(WIDEST_TAN)):.0f} deg off the axis",
            hint="use a longer focal length or a weaker distortion",
        )
    return nodes


def _draw(scene: Scene, matrix: Array, size: tuple[int, int], *, samples: int) -> _Drawn:
    width, height = size
    view = View(np.ascontiguousarray(matrix), width, height)
    index, bounds, near = cull.visible(scene.clusters.boxes, view)
    nearest = np.argsort(-near, kind="stable")
    across, down = -(-width // cull.TILE_W), -(-height // cull.TILE_H)
    bins = raster.Bins(index[nearest], near[nearest], *cull.bin_tiles(bounds[nearest], across, down))
    picture = Picture(
        np.zeros((height, width, 3), np.uint8) if samples == 0 else np.empty((height, width, 3), np.uint8),
        np.empty((height, width), np.float32),
        np.empty((height, width), np.int32),
    )
    background = np.asarray(scene.background, dtype=np.float64)
    mips = scene.mips if samples > 0 else _NO_MIPS
    textures = Textures(mips.texels, mips.added, mips.levels, mips.base, background)
    mesh = Mesh(
        scene.vertices,
        scene.faces,
        scene.closed,
        scene.uv,
        scene.shade,
        scene.texture,
        scene.clusters.order,
        scene.clusters.starts,
    )
    planes = raster.draw(mesh, view, bins, textures, samples, numba.get_num_threads(), picture)
    return _Drawn(picture.rgb, picture.depth, picture.seen, planes)


# Depth needs no textures: a scene of which only depth is wanted never makes its mip maps.
_NO_MIPS = Mips(np.zeros(0, np.uint32), np.zeros(0, np.uint32), np.zeros((0, LEVELS, 3), np.int64), 0)

# Name -> renderer; a further renderer is one file and one line here.
RENDERERS: dict[str, Callable[..., Image]] = {"numba": render_numba}


def render(scene: Scene, camera: Camera, world_from_cam: Pose, *, samples: int = 4, renderer: str = "numba") -> Image:
    """Render what a camera sees from a pose.

    ``samples`` per pixel is 4 (rotated grid) or 1 (centre). Colour is gamma encoded, as the textures are; depth is
    exact at the pixel centres. The same input gives the same bits on any number of threads. Raises CameraError for
    a field of view wider than one plane can hold.
    """
    return RENDERERS[renderer](scene, camera, world_from_cam, samples=samples)


def render_depth(scene: Scene, camera: Camera, world_from_cam: Pose, *, renderer: str = "numba") -> NDArray[np.float32]:
    """Return the depth f32[h,w] that `render` gives, in a fraction of the time."""
    return RENDERERS[renderer](scene, camera, world_from_cam, samples=0).depth_m
