"""The metric frame of a map: similarity to SLAM positions, gravity, and what wrong positions cannot do."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic_map import looking

from fieldkit.errors import MapError
from fieldkit.frames import Pose, exp, pose_error
from fieldkit.maps.metric.align import align_to_slam, robust_similarity, umeyama
from fieldkit.maps.metric.motion import motion_scale

ROTATION = Rotation.from_rotvec([0.3, -1.1, 0.7])


def walk(rng: np.random.Generator, n: int = 60) -> list[Pose]:
    """Camera poses along a loop of several metres, looking about."""
    angles = np.linspace(0, 2 * np.pi, n, endpoint=False)
    return [
        looking(np.array([3 * np.cos(a), 2 * np.sin(a), 1.6 + 0.1 * np.sin(5 * a)]), 2 * a, rng.normal(0, 0.2))
        for a in angles
    ]


def as_sfm(poses: list[Pose], *, scale: float = 3.7) -> list[Pose]:
    """Express poses in another frame and scale, as SfM would find them."""
    return [
        Pose.from_components(ROTATION.apply(scale * p.translation) + [5.0, -2.0, 9.0], ROTATION * p.rotation)
        for p in poses
    ]


def test_umeyama_finds_the_similarity_exactly(rng: np.random.Generator) -> None:
    source = rng.normal(size=(20, 3))
    target = 0.3 * ROTATION.apply(source) + [1.0, 2.0, 3.0]
    found = umeyama(source, target)
    assert found.scale == pytest.approx(0.3, rel=1e-12)
    np.testing.assert_allclose(found.points(source), target, atol=1e-12)


def test_exact_slam_poses_give_back_every_camera(rng: np.random.Generator) -> None:
    poses = walk(rng)
    found = align_to_slam(as_sfm(poses), poses, seed=0)
    assert found.map_from_sfm.scale == pytest.approx(1 / 3.7, rel=1e-9)
    for sfm, slam in zip(as_sfm(poses), poses, strict=True):
        assert max(pose_error(found.map_from_sfm.pose(sfm), slam)) < 1e-9
    assert (found.n_used, found.n_total, found.verdict) == (60, 60, "pass")
    assert found.rms_m < 1e-9
    assert found.gravity_deg < 1e-6


def test_a_third_of_wrong_slam_positions_does_not_move_the_map(rng: np.random.Generator) -> None:
    poses = walk(rng)
    noisy = [p * exp(rng.normal(0, [0.002, 0.002, 0.002, 0.01, 0.01, 0.01])) for p in poses]
    wrong = list(noisy)
    for i in rng.choice(60, 18, replace=False):
        wrong[i] = Pose.from_translation(rng.normal(0, 1.0, 3)) * noisy[i]
    clean, robust = (align_to_slam(as_sfm(poses), slam, seed=0) for slam in (noisy, wrong))
    assert abs(robust.map_from_sfm.scale * 3.7 - 1) < 0.005
    assert clean.gravity_deg < 0.3
    assert robust.gravity_deg < 0.3
    assert robust.n_used == pytest.approx(42, abs=2)


def test_drift_widens_the_threshold_instead_of_losing_the_walk(rng: np.random.Generator) -> None:
    poses = walk(rng)
    drifting = [Pose.from_translation([0.15 * i / 60, 0.0, 0.0]) * p for i, p in enumerate(poses)]
    found = align_to_slam(as_sfm(poses), drifting, seed=0)
    assert found.n_used >= 50
    assert found.threshold_m > 0.05
    assert abs(found.map_from_sfm.scale * 3.7 - 1) < 0.02


def test_gravity_comes_from_the_orientations_when_heights_drift(rng: np.random.Generator) -> None:
    poses = walk(rng)
    tilted = [Pose.from_translation([0.0, 0.0, 0.05 * p.translation[0]]) * p for p in poses]
    found = align_to_slam(as_sfm(poses), tilted, seed=0)
    assert found.gravity_deg < 1e-6
    up = found.map_from_sfm.rotation.apply(ROTATION.apply([0.0, 0.0, 1.0]))
    assert np.degrees(np.arccos(up[2])) < 1e-5


def test_the_robust_fit_follows_from_the_seed(rng: np.random.Generator) -> None:
    source = rng.normal(size=(30, 3))
    target = source + rng.normal(0, 0.05, size=(30, 3))
    fits = [robust_similarity(source, target, rng=np.random.default_rng(3)) for _ in range(2)]
    assert fits[0][0].scale == fits[1][0].scale
    assert fits[0][1] == fits[1][1]


def test_alignment_needs_a_walk_and_poses() -> None:
    still = [Pose.identity()] * 5
    with pytest.raises(MapError, match="expected a walk"):
        align_to_slam(still, still, seed=0)
    with pytest.raises(MapError, match="2 mapped images have a SLAM pose; expected at least 3"):
        align_to_slam(still[:2], still[:2], seed=0)


def drifting(poses: list[Pose], rng: np.random.Generator, *, m: float = 0.003, yaw: float = 0.003) -> list[Pose]:
    """Track poses as SLAM does: every step is a little wrong, and so is all that follows."""
    found = [poses[0]]
    for before, after in itertools.pairwise(poses):
        turn = Rotation.from_rotvec([0.0, 0.0, rng.normal(0, yaw)])
        step = before.inv() * after
        noisy = Pose.from_components(step.translation + rng.normal(0, m, 3), step.rotation)
        moved = found[-1] * noisy
        found.append(Pose.from_components(moved.translation, turn * moved.rotation))
    return found


def test_the_steps_of_a_drifting_walk_tell_its_scale_better_than_its_positions() -> None:
    off: dict[str, list[float]] = {"positions": [], "steps": [], "sigmas": []}
    for seed in range(8):
        rng = np.random.default_rng(seed)
        poses = walk(rng, 80)
        slam = drifting(poses, rng)
        by_positions = align_to_slam(as_sfm(poses), slam, seed=0)
        by_steps = align_to_slam(as_sfm(poses), slam, seed=0, walks=[range(80)])
        assert by_steps.scale_sigma is not None
        off["positions"].append(by_positions.map_from_sfm.scale * 3.7 - 1)
        off["steps"].append(by_steps.map_from_sfm.scale * 3.7 - 1)
        off["sigmas"].append((by_steps.map_from_sfm.scale * 3.7 - 1) / by_steps.scale_sigma)
    rms = {name: float(np.sqrt(np.mean(np.square(values)))) for name, values in off.items()}
    assert rms["steps"] < 0.6 * rms["positions"]
    assert 0.5 < rms["sigmas"] < 1.6


def test_positions_tell_the_scale_where_steps_are_short_against_their_noise(rng: np.random.Generator) -> None:
    poses = walk(rng, 80)
    noisy = [Pose.from_translation(rng.normal(0, 0.08, 3)) * p for p in poses]
    plain = align_to_slam(as_sfm(poses), noisy, seed=0)
    assert align_to_slam(as_sfm(poses), noisy, seed=0, walks=[range(80)]).map_from_sfm.scale == pytest.approx(
        plain.map_from_sfm.scale, rel=1e-9
    )


def test_steps_into_wrong_positions_do_not_count_and_short_walks_have_none(rng: np.random.Generator) -> None:
    poses = walk(rng, 80)
    slam = drifting(poses, rng, m=0.002, yaw=0.001)
    jump = exp([0.0, 0.0, 0.4, 1.0, -2.0, 0.0])
    moved = [jump * p if 30 <= i < 54 else p for i, p in enumerate(slam)]
    clean, wrong = (align_to_slam(as_sfm(poses), s, seed=0, walks=[range(80)]) for s in (slam, moved))
    assert abs(wrong.map_from_sfm.scale / clean.map_from_sfm.scale - 1) < 0.002
    assert motion_scale(as_sfm(poses)[:6], slam[:6], [range(6)]) is None
    assert motion_scale([poses[0]] * 20, [poses[0]] * 20, [range(20)]) is None
