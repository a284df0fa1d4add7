"""Metric scale from depth: a wrong SLAM scale is corrected, and a contradiction is said."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fieldkit.cameras import Camera
from fieldkit.frames import Pose
from fieldkit.maps.landmarks import Model
from fieldkit.maps.metric.align import Alignment, Similarity
from fieldkit.maps.metric.depth import DepthScale, depth_scale, with_depth_scale
from fieldkit.maps.sources.source import DepthFrame, MapSource, SourceImage

CAMERA = Camera("PINHOLE", 160, 120, (120.0, 120.0, 80.0, 60.0))


def walk_before_a_wall(rng: np.random.Generator, *, scale: float) -> tuple[MapSource, Model, dict[int, Pose]]:
    """Two cameras 2 m before a wall; the map of wall and cameras is ``scale`` times too large."""
    poses = [Pose.from_translation([x, 0.0, 0.0]) for x in (0.0, 0.4)]
    wall = np.column_stack([rng.uniform(-0.6, 1.0, 400), rng.uniform(-0.6, 0.6, 400), np.full(400, 2.0)])
    images = tuple(SourceImage(f"{i}.png", Path(f"{i}.png"), CAMERA, "", str(i), p) for i, p in enumerate(poses))
    depth = tuple(DepthFrame(Path(f"{i}.png"), ((i, Pose.identity()),)) for i in range(2))
    n = len(wall)
    model = Model(
        tuple(i.name for i in images),
        (CAMERA, CAMERA),
        tuple(poses),
        wall * scale,
        np.arange(n),
        np.tile(np.arange(n, dtype=np.int32), 2),
        np.repeat(np.arange(2, dtype=np.int32), n),
        np.zeros(2 * n, np.int32),
        np.zeros((2 * n, 2), np.float32),
    )
    mapped = {i: Pose.from_translation(scale * p.translation) for i, p in enumerate(poses)}
    return MapSource(Path("walk"), images, CAMERA, depth), model, mapped


def noisy_wall(rng: np.random.Generator) -> np.ndarray:
    return np.round(2000 + rng.normal(0, 4, (CAMERA.height, CAMERA.width))).astype(np.uint16)


def test_a_map_that_is_too_large_is_measured(rng: np.random.Generator) -> None:
    walk, model, mapped = walk_before_a_wall(rng, scale=1.004)
    found = depth_scale(walk, model, mapped, read=lambda frame: noisy_wall(rng))
    assert found is not None
    assert found.ratio == pytest.approx(1 / 1.004, abs=4 * found.sigma + 1e-6)
    assert found.sigma < 2e-4


def test_landmarks_at_depth_edges_are_left_out(rng: np.random.Generator) -> None:
    walk, model, mapped = walk_before_a_wall(rng, scale=1.0)
    steps = np.where(np.arange(CAMERA.width) % 2, 2000, 2500).astype(np.uint16)[None].repeat(CAMERA.height, axis=0)
    assert depth_scale(walk, model, mapped, read=lambda frame: steps) is None


def alignment() -> Alignment:
    similarity = Similarity(2.0, Rotation.identity(), np.array([1.0, 0.0, 0.0]))
    return Alignment(similarity, "slam", 3, 3, 0.0, 0.0, 0.0, 0.05, "pass")


CENTRES = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])


def test_the_map_is_scaled_about_its_cameras() -> None:
    slam = alignment().map_from_sfm.points(CENTRES)
    scaled, doubts = with_depth_scale(alignment(), DepthScale(0.99, 1e-4, 999), sfm_centres=CENTRES, slam_centres=slam)
    assert not doubts
    assert scaled.source == "depth"
    assert scaled.map_from_sfm.scale == pytest.approx(1.98)
    np.testing.assert_allclose(scaled.map_from_sfm.points(CENTRES).mean(axis=0), slam.mean(axis=0))
    assert scaled.rms_m == pytest.approx(0.0211, abs=1e-4)


@pytest.mark.parametrize(
    ("ratio", "verdict", "told"), [(0.9, "warn", r"\+11\.1 %"), (0.7, "fail", r"\+42\.9 %"), (1.4, "fail", r"-28\.6 %")]
)
def test_a_contradiction_keeps_the_slam_scale_is_said_and_does_not_pass(ratio: float, verdict: str, told: str) -> None:
    found = DepthScale(ratio, 1e-4, 999)
    kept, doubts = with_depth_scale(alignment(), found, sfm_centres=CENTRES, slam_centres=CENTRES)
    assert kept.source == "slam"
    assert kept.map_from_sfm.scale == alignment().map_from_sfm.scale
    assert kept.verdict == verdict
    assert re.search(f"SLAM poses are {told} off in scale", doubts[0])
