"""Mapping cameras for COLMAP: those whose places on a device are known are one rig and move together."""

from __future__ import annotations

from collections.abc import Sequence

import pycolmap

from fieldkit.cameras import Camera
from fieldkit.frames import Pose
from fieldkit.maps.landmarks import colmap_camera
from fieldkit.maps.sources.source import SourceImage

RIG_ID = 1


def write_cameras(database: pycolmap.Database, images: Sequence[SourceImage]) -> list[int]:
    """Write cameras, rigs, images (id = index + 1) and frames; return the camera id of every image.

    Images with a known ``rig_from_cam`` belong to one rig, and those with the same ``frame`` to one of its frames.
    Every other camera is a rig of its own, and each of its images a frame. One sequence has one camera.
    """
    ids: dict[tuple[str, Camera], int] = {}
    first: dict[int, SourceImage] = {}
    for image in images:
        number = ids.setdefault((image.sequence, image.camera), len(ids) + 1)
        first.setdefault(number, image)
    camera_ids = [ids[image.sequence, image.camera] for image in images]
    cameras = {number: colmap_camera(image.camera, number) for number, image in first.items()}
    for camera in cameras.values():
        database.write_camera(camera, use_camera_id=True)
    rig_of = _write_rigs(database, cameras, first)
    rows = [pycolmap.Image(name=image.name, camera_id=camera_ids[i], image_id=i + 1) for i, image in enumerate(images)]
    frames: dict[tuple[int, str], list[int]] = {}
    for i, image in enumerate(images):
        database.write_image(rows[i], use_image_id=True)
        name = image.frame if image.rig_from_cam is not None else f"image {i}"
        frames.setdefault((rig_of[camera_ids[i]], name), []).append(i)
    for number, ((rig_id, _), members) in enumerate(frames.items(), start=1):
        frame = pycolmap.Frame(frame_id=number, rig_id=rig_id)
        for i in members:
            frame.add_data_id(rows[i].data_id)
        database.write_frame(frame, use_frame_id=True)
    return camera_ids


def _write_rigs(
    database: pycolmap.Database, cameras: dict[int, pycolmap.Camera], first: dict[int, SourceImage]
) -> dict[int, int]:
    """Write the rigs and return the rig of every camera; the first camera of a rig is its reference."""
    mounted = {number: image.rig_from_cam for number, image in first.items() if image.rig_from_cam is not None}
    rig_of = dict.fromkeys(mounted, RIG_ID)
    if mounted:
        reference, *others = mounted
        rig = pycolmap.Rig(rig_id=RIG_ID)
        rig.add_ref_sensor(cameras[reference].sensor_id)
        for number in others:
            cam_from_reference = mounted[number].inv() * mounted[reference]
            rig.add_sensor(cameras[number].sensor_id, _rigid(cam_from_reference))
        database.write_rig(rig, use_rig_id=True)
    for number in cameras:
        if number not in mounted:
            rig_of[number] = RIG_ID + number
            rig = pycolmap.Rig(rig_id=rig_of[number])
            rig.add_ref_sensor(cameras[number].sensor_id)
            database.write_rig(rig, use_rig_id=True)
    return rig_of


def _rigid(pose: Pose) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation.as_quat()), pose.translation)
