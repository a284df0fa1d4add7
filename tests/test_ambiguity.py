"""Which of a tag's two planar poses is right: never called certain when it is not, and decided by other directions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tag_scenes import SIZE_M, VGA, look_from, slanted

from fieldkit.frames import Array, Pose, pose_error
from fieldkit.tags import Sighting, TagDetection, TagFix, fuse_sightings, solve, tag_corners

EXACT = np.eye(6) * 1e-12
SIGMA_PX = 0.1


def sight(
    rng: np.random.Generator, direction: Array, distance_m: float, *, covariance: Array | None = None
) -> Sighting:
    """Draw what a known camera sees of a tag, which is the reference frame."""
    cam_from_tag = look_from(rng, direction, distance_m)
    noise = SIGMA_PX**2 * np.eye(8) if covariance is None else covariance
    corners = VGA.project(cam_from_tag.apply(tag_corners(SIZE_M)))[0]
    corners = corners + (np.linalg.cholesky(noise) @ rng.normal(size=8)).reshape(4, 2)
    sigma = math.sqrt(float(np.trace(noise)) / 8)
    return Sighting(TagDetection(2, "tag36h11", corners, sigma, noise), VGA, cam_from_tag.inv(), EXACT)


def is_flipped(fix: TagFix) -> bool:
    """Whether the other solution is nearer to the truth, which is the identity."""
    other = fix.alternative
    true = Pose.identity()
    return other is not None and pose_error(other, true)[1] < pose_error(fix.ref_from_tag, true)[1]


def around(middle: Array, span_deg: float, count: int) -> list[Array]:
    """Directions on an arc about a middle one."""
    axis = np.cross(middle, [0.3, 0.5, 0.2])
    turns = np.radians(np.linspace(-span_deg / 2, span_deg / 2, count))
    return [Rotation.from_rotvec(axis / np.linalg.norm(axis) * t).apply(middle) for t in turns]


@pytest.mark.parametrize(("slant_deg", "count"), [((0.0, 20.0), 200), ((55.0, 72.0), 200)])
def test_no_flipped_sighting_is_called_certain(
    rng: np.random.Generator, slant_deg: tuple[float, float], count: int
) -> None:
    fixes = [
        fuse_sightings([sight(rng, slanted(rng, slant_deg), float(rng.uniform(0.5, 4.0)))], SIZE_M)
        for _ in range(count)
    ]
    assert not any(f.is_certain and is_flipped(f) for f in fixes)
    open_ones = [f for f in fixes if not f.is_certain]
    if slant_deg[0] == 0.0:
        # The law is not empty: some are flipped, many are open, many are not
        assert sum(is_flipped(f) for f in fixes) >= 3
        assert 0.1 * count < len(open_ones) < 0.9 * count
    # What is open keeps both solutions, or its tilt is unknown because they have merged
    assert all(f.alternative is not None or f.ambiguity == 0.0 for f in open_ones)


def test_evidence_is_a_log_likelihood_ratio(rng: np.random.Generator) -> None:
    """Among sightings with evidence E, one in 1 + exp(E / 2) is flipped."""
    evidence, flipped = [], []
    for _ in range(300):
        direction = slanted(rng, (3.0, 12.0))
        fix = fuse_sightings([sight(rng, direction, float(rng.uniform(1.5, 3.0)))], SIZE_M)
        if fix.alternative is not None:
            evidence.append(fix.evidence)
            flipped.append(is_flipped(fix))
    expected = 1.0 / (1.0 + np.exp(np.array(evidence) / 2))
    assert sum(flipped) > 12
    # Residuals may scale the noise up, never down: evidence is rather less than it could be
    deviation = math.sqrt(float((expected * (1 - expected)).sum()))
    assert expected.sum() - 8 * deviation < sum(flipped) < expected.sum() + 3 * deviation


def test_other_directions_decide_and_repeated_ones_do_not(rng: np.random.Generator) -> None:
    for _ in range(15):
        # Too far and too frontal for any sighting to decide by itself
        middle, distance = slanted(rng, (4.0, 9.0)), float(rng.uniform(2.8, 3.5))
        assert not fuse_sightings([sight(rng, middle, distance)], SIZE_M).is_certain
        same = fuse_sightings([sight(rng, d, distance) for d in around(middle, 2.0, 12)], SIZE_M)
        assert math.degrees(same.span_rad) < 3.0
        assert not same.is_certain
        assert same.alternative is not None
        close = fuse_sightings([sight(rng, d, distance) for d in around(middle, 10.0, 3)], SIZE_M)
        assert not close.is_certain
        apart = fuse_sightings([sight(rng, d, distance) for d in around(middle, 30.0, 4)], SIZE_M)
        assert math.degrees(apart.span_rad) == pytest.approx(30.0, abs=2.0)
        assert apart.is_certain
        assert not is_flipped(apart)


def test_twelve_sightings_from_one_direction_count_as_one(rng: np.random.Generator) -> None:
    direction = np.array([0.12, 0.1, 1.0])
    seen = [sight(rng, direction, 2.5) for _ in range(12)]
    together = fuse_sightings(seen, SIZE_M)
    alone = [fuse_sightings([s], SIZE_M).evidence for s in seen]
    assert together.span_rad < math.radians(1.0)
    assert together.evidence < max(alone)


def test_the_mirrored_solution_is_found_where_every_sighting_prefers_the_right_one(rng: np.random.Generator) -> None:
    seen = [sight(rng, d, 2.0) for d in around(np.array([0.3, 0.1, 1.0]), 6.0, 8)]
    fix = fuse_sightings(seen, SIZE_M)
    assert fix.alternative is not None
    turned = pose_error(fix.alternative, fix.ref_from_tag)[1]
    slant = math.atan(math.hypot(0.3, 0.1))
    assert turned == pytest.approx(2 * slant, abs=math.radians(6))


def test_a_covariance_of_the_corners_weighs_them(rng: np.random.Generator) -> None:
    noise = np.diag([0.01] * 6 + [4.0, 4.0]) ** 2
    squared = []
    for _ in range(60):
        seen = sight(rng, slanted(rng, (30.0, 50.0)), 0.8, covariance=noise)
        solution = solve(seen.detection, VGA, SIZE_M)
        position, angle = pose_error(seen.ref_from_cam * solution.cam_from_tag, Pose.identity())
        # Three corners of 0.01 px fix the pose; the fourth is off by pixels
        squared.append((position, angle))
    assert np.median(np.array(squared)[:, 1]) < math.radians(0.5)
