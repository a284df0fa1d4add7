"""Poses that are taken as they are: points are triangulated, and the images tell how well the poses fit."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from fieldkit.errors import MapError
from fieldkit.frames import Pose, skew
from fieldkit.maps.quiet import quiet_colmap
from fieldkit.maps.sources.source import SourceImage
from fieldkit.maps.structure.sfm import mapping_options

Array = NDArray[np.float64]

# Matches fit poses that let them lie this close to each other's rays; keypoints take a quarter of it
_FIT_PX = 2.0
# Share of the matches that poses have to fit to be used at all
_LEAST_SHARE = 0.2


def triangulate(database: Path, images: Sequence[SourceImage]) -> pycolmap.Reconstruction:
    """Triangulate the verified matches of a database from the images' given poses, which stay as they are.

    Images without a pose are left out; a rig's frame has the pose of its first image that has one. Points are adjusted,
    poses and intrinsics are not. Raises MapError when the poses fit hardly any match.
    """
    share = match_share(database, images)
    if share < _LEAST_SHARE:
        raise MapError(
            f"the known poses fit {100 * share:.0f} % of the matches between the {len(images)} images; expected most",
            hint="check that poses are camera in the map (not map in the camera), in m, and of these images",
        )
    with contextlib.closing(pycolmap.Database.open(database)) as content:
        start = _placed_model(content, images)
    with tempfile.TemporaryDirectory(prefix="fieldkit-sfm-") as folder, quiet_colmap():
        return pycolmap.triangulate_points(start, database, folder, folder, True, mapping_options(0))


def match_share(database: Path, images: Sequence[SourceImage]) -> float:
    """Return the share of the verified matches whose rays, by the images' poses, pass each other within two pixels.

    The distance is Sampson's (Hartley and Zisserman, Multiple View Geometry, 11.4.3), in undistorted pixels.
    """
    fitting = total = 0
    rays: dict[int, Array] = {}
    with contextlib.closing(pycolmap.Database.open(database)) as content:
        for pair_id, geometry in zip(*content.read_two_view_geometries(), strict=True):
            a, b = (i - 1 for i in pycolmap.pair_id_to_image_pair(pair_id))
            first, second = images[a].slam_from_cam, images[b].slam_from_cam
            if first is None or second is None or not len(geometry.inlier_matches):
                continue
            for i in (a, b):
                if i not in rays:
                    rays[i] = images[i].camera.unproject(content.read_keypoints(i + 1)[:, :2].astype(np.float64))
            x, y = rays[a][geometry.inlier_matches[:, 0]], rays[b][geometry.inlier_matches[:, 1]]
            off = _sampson(x, y, second.inv() * first) * np.mean(
                [*images[a].camera.focal_px, *images[b].camera.focal_px]
            )
            fitting, total = fitting + int((off <= _FIT_PX).sum()), total + len(off)
    return fitting / max(total, 1)


def _sampson(x: Array, y: Array, b_from_a: Pose) -> Array:
    """Return the distance of rays x (n, 3) and y (n, 3), depth 1, in two images to rays that meet, at depth 1."""
    baseline = b_from_a.translation / max(float(np.linalg.norm(b_from_a.translation)), 1e-12)
    essential = skew(baseline) @ b_from_a.rotation.as_matrix()
    lines_b, lines_a = x @ essential.T, y @ essential
    width = (lines_b[:, :2] ** 2).sum(axis=1) + (lines_a[:, :2] ** 2).sum(axis=1)
    return np.asarray(np.abs((lines_b * y).sum(axis=1)) / np.sqrt(np.maximum(width, 1e-24)))


def _placed_model(content: pycolmap.Database, images: Sequence[SourceImage]) -> pycolmap.Reconstruction:
    model = pycolmap.Reconstruction()
    for camera in content.read_all_cameras():
        model.add_camera(camera)
    for rig in content.read_all_rigs():
        model.add_rig(rig)
    frames = content.read_all_frames()
    for frame in frames:
        fresh = pycolmap.Frame(frame_id=frame.frame_id, rig_id=frame.rig_id)
        for data_id in frame.data_ids:
            fresh.add_data_id(data_id)
        model.add_frame(fresh)
    for image in content.read_all_images():
        model.add_image(
            pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id, frame_id=image.frame_id)
        )
    for frame in frames:
        for data_id in frame.data_ids:
            pose = images[data_id.id - 1].slam_from_cam
            if pose is not None:
                cam_from_map = pycolmap.Rigid3d(pose.inv().as_matrix()[:3])
                model.frame(frame.frame_id).set_cam_from_world(model.image(data_id.id).camera_id, cam_from_map)
                model.register_frame(frame.frame_id)
                break
    return model
