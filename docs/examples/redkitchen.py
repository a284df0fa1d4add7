"""Turn the 7-Scenes red kitchen (every 8th frame of one walk) into a map source and a recording.

The frames of even blocks of 100 make the map source, those of odd blocks the recording: one visit per block, whose
frames are the views among which a policy chooses. Odometry is the given poses with drift; the given poses are also
the reference topic, which yields the start pose and the truth. The body is a frame that is fixed to the camera.

    python docs/examples/redkitchen.py DATA --out build/redkitchen
"""

from __future__ import annotations

import itertools
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from fieldkit import store
from fieldkit.bags import RecordingWriter
from fieldkit.cameras import Camera
from fieldkit.errors import FieldkitError, StoreError
from fieldkit.frames import Pose, exp, pose_from_matrix

COLOUR = Camera("PINHOLE", 640, 480, (525.0, 525.0, 320.0, 240.0))
DEPTH = Camera("PINHOLE", 640, 480, (585.0, 585.0, 320.0, 240.0))
BLOCK = 100
FRAME_NS = 33_333_333
BODY_FROM_CAM = Pose.from_rotation(Rotation.from_matrix([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))


def read_poses(data: Path) -> dict[int, Pose]:
    """Read world_from_cam of every frame number, turned so that z is up.

    The camera is held without roll: its x axes lie in the horizontal plane, and up is the direction that is least
    present in them.
    """
    files = {int(re.findall(r"\d+", p.name)[0]): p for p in sorted((data / "poses").glob("frame-*.pose.txt"))}
    if not files:
        raise StoreError(f"{data}: has no poses/frame-*.pose.txt; expected the red kitchen's frames and poses")
    poses = {number: pose_from_matrix(np.loadtxt(path)) for number, path in files.items()}
    axes = np.array([p.rotation.as_matrix() for p in poses.values()])
    up = np.linalg.svd(axes[:, :, 0])[2][2]
    up = up if up @ axes[:, :, 1].mean(axis=0) < 0 else -up
    level, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])
    return {number: Pose.from_rotation(level) * p for number, p in poses.items()}


def drifting(poses: list[Pose], *, rng: np.random.Generator) -> list[Pose]:
    """Return the poses as odometry with 3 % error of distance and 2 deg of yaw per metre would report them."""
    scale, yaw_per_m = 1.0 + 0.03 * rng.choice([-1, 1]), np.radians(2.0) * rng.choice([-1, 1])
    result = [Pose.identity()]
    for before, after in itertools.pairwise(poses):
        step = before.inv() * after
        travelled = float(np.linalg.norm(step.translation))
        noisy = Pose.from_components(step.translation * scale, step.rotation)
        result.append(result[-1] * noisy * exp([0.0, 0.0, yaw_per_m * travelled, 0.0, 0.0, 0.0]))
    return result


def write_source(data: Path, out: Path, poses: dict[int, Pose]) -> None:
    """Write the image folder from which `fieldkit map build` makes the map, with the frames that have a pose here."""
    (out / "images").mkdir(parents=True)
    (out / "depth").mkdir()
    rows = []
    for number in poses:
        name = f"{number:06d}"
        shutil.copy(data / "frames" / f"frame-{name}.color.jpg", out / "images" / f"{name}.jpg")
        depth = cv2.imread(str(data / "frames" / f"frame-{name}.depth.png"), cv2.IMREAD_UNCHANGED)
        depth[depth == 65535] = 0
        cv2.imwrite(str(out / "depth" / f"{name}.png"), depth)
        rows.append((f"{name}.jpg", poses[number]))
    store.write_tum(out / "poses.txt", rows)
    store.write_camera(out / "camera.toml", COLOUR)
    store.write_camera(out / "depth_camera.toml", DEPTH)


def write_recording(data: Path, path: Path, poses: dict[int, Pose]) -> None:
    """Write the odd blocks as an MCAP recording; odometry and reference run through all of them."""
    numbers = sorted(poses)
    map_from_body = [poses[n] * BODY_FROM_CAM.inv() for n in numbers]
    odom_from_body = drifting(map_from_body, rng=np.random.default_rng(0))
    blocks = sorted({n // BLOCK for n in numbers if (n // BLOCK) % 2})
    with RecordingWriter(path, format="mcap") as writer:
        writer.tf_static([("body", "arm_camera", BODY_FROM_CAM)])
        writer.event(1, {"v": 1, "event": "start_begin", "t_ns": 1})
        writer.event(2, {"v": 1, "event": "start_end", "t_ns": 2})
        for number, reference, odometry in zip(numbers, map_from_body, odom_from_body, strict=True):
            t_ns, block = 1 + number * FRAME_NS, number // BLOCK
            writer.odometry(t_ns, odometry)
            writer.reference(t_ns, reference)
            if block not in blocks:
                continue
            members = [n for n in numbers if n // BLOCK == block]
            visit = f"block{block:02d}"
            if number == members[0]:
                following = [b for b in blocks if b > block]
                event = {"v": 1, "event": "visit_begin", "t_ns": t_ns, "visit": visit}
                writer.event(t_ns, event | ({"next": f"block{following[0]:02d}"} if following else {}))
            writer.camera_info(t_ns, COLOUR)
            writer.image(t_ns, (data / "frames" / f"frame-{number:06d}.color.jpg").read_bytes())
            view = {"visit": visit, "view": f"{number:06d}", "kind": "sweep"}
            writer.event(t_ns, {"v": 1, "event": "view", "t_ns": t_ns} | view)
            if number == members[-1]:
                writer.event(t_ns + 1, {"v": 1, "event": "visit_end", "t_ns": t_ns + 1, "visit": visit})


def main(data: tyro.conf.Positional[Path], *, out: Path, force: bool = False) -> None:
    """Write source/ and recording.mcap.

    Args:
        data: folder with frames/ and poses/
        out: folder to write
        force: replace an existing folder
    """
    poses = read_poses(data)
    with store.atomic_folder(out, force=force) as work:
        write_source(data, work / "source", {n: p for n, p in poses.items() if (n // BLOCK) % 2 == 0})
        write_recording(data, work / "recording.mcap", poses)


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except FieldkitError as error:
        raise SystemExit(f"redkitchen: {error}") from None
