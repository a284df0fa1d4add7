"""Structure from motion: what it tells while it works."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
from synthetic_map import CAMERA, looking, room_points

from fieldkit.features import Features
from fieldkit.frames import Pose
from fieldkit.maps.sources.source import SourceImage
from fieldkit.maps.structure.sfm import reconstruct, write_verified


def test_the_progress_of_sfm_counts_the_frames_of_a_rig(tmp_path: Path, rng: np.random.Generator) -> None:
    rig_from_cam = {name: looking(np.array([0.0, y, 0.0]), 0.3 * y) for name, y in (("a", -0.2), ("b", 0.2))}
    images, features, seen_by = [], [], []
    xyz = room_points(rng, 400)
    for frame in range(5):
        map_from_rig = Pose.from_translation([-0.3 * frame, 0.2 * frame, 1.3])
        for name, pose in rig_from_cam.items():
            pixels, seen = CAMERA.project((map_from_rig * pose).inv().apply(xyz))
            images.append(SourceImage(f"{name}/{frame}.jpg", Path(), CAMERA, name, str(frame), None, pose))
            ones = np.ones(seen.sum(), dtype=np.float32)
            descriptors = np.zeros((len(ones), 128), dtype=np.uint8)
            features.append(Features(pixels[seen].astype(np.float32), ones, ones, descriptors))
            seen_by.append(np.flatnonzero(seen))
    pairs = list(itertools.combinations(range(len(images)), 2))
    both = [np.intersect1d(seen_by[a], seen_by[b], return_indices=True)[1:] for a, b in pairs]
    matches = [np.column_stack(rows).astype(np.uint32) for rows in both]
    write_verified(tmp_path / "database.db", images, features, pairs, matches, seed=0, n_threads=1)
    told: list[tuple[int, int]] = []
    models = reconstruct(
        tmp_path / "database.db", images, seed=0, progress=lambda step, done, total: told.append((done, total))
    )
    assert models[0].num_reg_images() == 10
    assert told == [(0, 5), (3, 5), (4, 5), (5, 5)]
