"""Memory and time of a large map: load it, index it, localize an image in it, each step's peak in a process of its own.

Run it by itself, the folder is kept when it is given: ``python tests/bench/test_map_memory.py [--landmarks 1000000]``.
"""

from __future__ import annotations

import argparse
import itertools
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import h5py
import numpy as np

from fieldkit.cameras import Camera
from fieldkit.features import extract
from fieldkit.frames import Pose
from fieldkit.maps.colmap import write_model
from fieldkit.maps.io import AlignmentEntry, MapFile, content_digest, write_map_file
from fieldkit.maps.landmarks import Model

CAMERA = Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
PER_IMAGE = 200
SEEN_BY = np.arange(4, 8)
QUERY_SEED = 7

LOAD = """
import json, sys, time
def peak():
    # Not ru_maxrss, which a child inherits from the process that started it
    lines = open("/proc/self/status").read().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024
import cv2, numpy, pycolmap, pathlib
from fieldkit.maps import load_map
from fieldkit.localize import Localizer
from fieldkit.cameras import Camera
from tests_query import query
found = {"imports_mb": peak()}
t = time.perf_counter(); scene = load_map(pathlib.Path(sys.argv[1])); found["load_s"] = time.perf_counter() - t
found["load_mb"], found["landmarks"], found["descriptors"] = peak(), len(scene.xyz), len(scene.descriptors)
t = time.perf_counter(); localizer = Localizer(scene); found["index_s"] = time.perf_counter() - t
found["index_mb"] = peak()
camera = Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
localizer.localize(query(), camera)
t = time.perf_counter(); e = localizer.localize(query(), camera); found["localize_s"] = time.perf_counter() - t
found |= {"status": e.status, "inliers": e.n_inliers, "peak_mb": peak(), "seconds": dict(e.seconds)}
print(json.dumps(found))
"""


def query() -> np.ndarray:
    """Return a textured image uint8[480, 640]: smoothed noise of several sizes."""
    import cv2

    rng, image = np.random.default_rng(QUERY_SEED), np.zeros((480, 640))
    for cells in (8, 16, 32, 64, 128):
        image += cv2.resize(rng.standard_normal((cells * 3 // 4, cells)), (640, 480), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 40 * image, 0, 255).astype(np.uint8)


def make_map(folder: Path, *, n_landmarks: int, seed: int = 0) -> None:
    """Write a map of a long walk: 200 new landmarks per image, each seen by 4..7 images, and the query's in one."""
    rng, n_images = np.random.default_rng(seed), n_landmarks // PER_IMAGE
    poses = tuple(Pose.from_translation([0.05 * (i % 100), 5.0 * (i // 100), 1.5]) for i in range(n_images))
    found = extract(query(), feature="sift")
    begin = n_images // 2 * PER_IMAGE
    n_known = min(len(found), PER_IMAGE)
    pixels = rng.uniform((40, 40), (600, 440), (n_landmarks, 2))
    pixels[begin : begin + n_known] = found.keypoints_px[:n_known]
    rays = CAMERA.unproject(pixels) * rng.uniform(2.0, 6.0, n_landmarks)[:, None]
    owner = np.arange(n_landmarks) // PER_IMAGE
    centres = np.stack([p.translation for p in poses])
    xyz = rays + centres[owner]
    count = rng.choice(SEEN_BY, n_landmarks)
    landmark = np.repeat(np.arange(n_landmarks), count)
    step = np.arange(len(landmark)) - np.repeat(np.cumsum(count) - count, count)
    image = owner[landmark] + step
    kept = image < n_images
    landmark, image = landmark[kept], image[kept]
    order = np.lexsort((landmark, image))
    landmark, image = landmark[order].astype(np.int32), image[order].astype(np.int32)
    x_in_cam = xyz[landmark] - centres[image]
    seen_px = (x_in_cam[:, :2] / x_in_cam[:, 2:] * 500.0 + (320.0, 240.0)).astype(np.float32)
    bounds = np.searchsorted(image, np.arange(n_images + 1))
    keypoint = np.concatenate([np.arange(b - a, dtype=np.int32) for a, b in itertools.pairwise(bounds)])
    names = tuple(f"{i:06d}.jpg" for i in range(n_images))
    model = Model(
        names, (CAMERA,) * n_images, poses, xyz, np.arange(1, n_landmarks + 1), landmark, image, keypoint, seen_px
    )
    parts = [slice(int(a), int(b)) for a, b in itertools.pairwise(bounds)]
    write_model(folder / "sparse", model, [seen_px[p] for p in parts])
    with h5py.File(folder / "features.h5", "w", libver="v110") as file:
        for name, part in zip(names, parts, strict=True):
            rows = landmark[part]
            values = np.stack([_descriptor(k) for k in rows // 40]) + rng.integers(0, 30, (len(rows), 128))
            mine = (rows >= begin) & (rows < begin + n_known)
            values[mine] = found.descriptors[rows[mine] - begin]
            group = file.create_group(name)
            group["keypoints"], group["scores"] = seen_px[part] - 0.5, np.ones(len(rows), np.float32)
            group["descriptors"] = np.ascontiguousarray(np.clip(values, 0, 255).astype(np.uint8).T)
            group["image_size"] = np.array([640, 480])
    alignment = AlignmentEntry("known", 1.0, 0, 0, 0.0, 0.0, 0.0, "pass")
    counts = (n_images, n_images, n_landmarks)
    write_map_file(folder, MapFile(1, content_digest(folder), "sift", *counts, alignment))


def _descriptor(number: int) -> np.ndarray:
    return np.random.default_rng(int(number)).integers(0, 90, 128)


def measure(folder: Path) -> dict[str, object]:
    """Load and localize in a process of its own; return its peak memory and seconds."""
    here = Path(__file__).resolve()
    with tempfile.TemporaryDirectory() as work:
        (Path(work) / "tests_query.py").write_text(
            f"import sys; sys.path.insert(0, {str(here.parent)!r})\nfrom test_map_memory import query\n"
        )
        script = f"import sys; sys.path[:0] = [{work!r}, {str(here.parents[2])!r}]\n{LOAD}"
        done = subprocess.run([sys.executable, "-c", script, str(folder)], capture_output=True, text=True, check=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def test_a_map_of_a_hundred_thousand_landmarks_localizes_its_query(tmp_path: Path) -> None:
    make_map(tmp_path, n_landmarks=100_000)
    found = measure(tmp_path)
    assert found["status"] == "ok", found


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--landmarks", type=int, default=1_000_000)
    parser.add_argument("--folder", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        target = given.folder or Path(temporary)
        if not (target / "map.toml").is_file():
            target.mkdir(parents=True, exist_ok=True)
            make_map(target, n_landmarks=given.landmarks)
        sys.stdout.write(json.dumps(measure(target), indent=1) + "\n")
