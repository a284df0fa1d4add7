"""Poses that are taken as they are: points are triangulated, and the images tell how well the poses fit."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from fieldkit.errors import MapError
from fieldkit.frames import Pose
from fieldkit.maps.align import Alignment, Similarity, Verdict
from fieldkit.maps.landmarks import Model, model_arrays, reprojection_errors
from fieldkit.maps.sfm import mapping_options, quiet_colmap
from fieldkit.maps.source import SourceImage

# What the poses let a point be off by; beyond it two images see different points, or a pose is wrong
_BOUND_PX = 4.0
_GOOD_PX = 2.0
_UP_DEG = 5.0


def triangulate(database: Path, images: Sequence[SourceImage]) -> pycolmap.Reconstruction:
    """Triangulate the verified matches of a database from the images' given poses, which stay as they are.

    Images without a pose are left out; a rig's frame has the pose of its first image that has one. Points are adjusted,
    poses and intrinsics are not. Raises MapError when no point is seen.
    """
    with contextlib.closing(pycolmap.Database.open(database)) as content:
        start = _placed_model(content, images)
    with tempfile.TemporaryDirectory(prefix="fieldkit-sfm-") as folder, quiet_colmap():
        model = pycolmap.triangulate_points(start, database, folder, folder, True, mapping_options(0))
    if not model.num_points3D():
        raise MapError(
            f"no point of the {len(images)} images is seen where their poses say",
            hint="check that poses are camera in the map (not map in the camera), in m, and of these images",
        )
    return model


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


def known_alignment(model: pycolmap.Reconstruction, poses: Mapping[int, Pose], tilt: tuple[float, float]) -> Alignment:
    """Return the alignment of a map whose poses were given, judged by what its points' residuals in the images are.

    ``rms_m`` and ``p95_m`` are those residuals at the points' distances, ``n_used`` of ``n_total`` images see
    enough points. ``tilt`` is the angle between the z axis and what the images show as up, and its sigma (deg): frames
    that are not upright are told, not turned.
    """
    arrays = model_arrays(model)
    errors = reprojection_errors(arrays)
    metres = errors * _metres_per_px(arrays)
    counts = np.bincount(arrays.observation_image, minlength=len(arrays.image_names))
    n_used = int((counts >= _LEAST_POINTS).sum())
    rms_px = float(np.sqrt(np.mean(errors**2)))
    return Alignment(
        Similarity(1.0, Rotation.identity(), np.zeros(3)),
        "known",
        n_used,
        len(poses),
        float(np.sqrt(np.mean(metres**2))),
        float(np.percentile(metres, 95)),
        tilt[0],
        0.0,
        _verdict(n_used / max(len(poses), 1), rms_px, tilt),
        gravity_from="known",
        reprojection_px=rms_px,
    )


# Points that say whether an image's pose fits the others'
_LEAST_POINTS = 15


def _metres_per_px(model: Model) -> np.ndarray:
    centres = np.stack([p.translation for p in model.map_from_image])
    focal = np.array([np.mean(camera.focal_px) for camera in model.image_cameras])
    away = model.xyz[model.observation_landmark] - centres[model.observation_image]
    return np.asarray(np.linalg.norm(away, axis=1) / focal[model.observation_image])


def _verdict(share_used: float, rms_px: float, tilt: tuple[float, float]) -> Verdict:
    # An angle counts as far as it is known: the images of a blank corridor say little about up
    leaning = tilt[0] - 3.0 * tilt[1]
    if share_used < 0.5 or rms_px > _BOUND_PX or leaning > _UP_DEG:
        return "fail"
    return "pass" if share_used >= 0.9 and rms_px <= _GOOD_PX and leaning <= 1.0 else "warn"
