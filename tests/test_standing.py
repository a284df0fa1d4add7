"""A standing robot among tags: all sightings count, the shared error of the hand camera, steps, true covariances."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from standing_scenes import CAMERA, SECOND, SIZE_M, Settings, Standing, stand

from fieldkit.errors import PriorError, TruthError
from fieldkit.frames import Array, Pose, Trajectory, adjoint, exp, log, pose_error, skew, yaw_pose
from fieldkit.odometry import find_faults
from fieldkit.prior import estimate_prior
from fieldkit.protocol import ArmNoise, OdometryNoise
from fieldkit.tags import body_sightings, locate_body, tag_corners
from fieldkit.truth import estimate_truths
from fieldkit.types import Prior, SeenTag, TagPose, Truth

NOISE, ARM = OdometryNoise(), ArmNoise()


def prior_of(scene: Standing, arm: ArmNoise = ARM) -> Prior:
    return estimate_prior(scene.recording, scene.visit, scene.tags, noise=NOISE, arm=arm)


def truths_of(scene: Standing, arm: ArmNoise = ARM) -> dict[str, Truth]:
    return estimate_truths(scene.recording, scene.visit, scene.tags, noise=NOISE, arm=arm)


def nees(estimate: Pose, true: Pose, covariance: Array) -> float:
    delta = log(estimate.inv() * true)
    return float(delta @ np.linalg.solve(covariance, delta)) / 6


@pytest.mark.parametrize(
    "settings",
    [
        Settings(walk_m=0.0),
        Settings(n_start=2, n_truth=1, walk_m=3.0),
        Settings(states_sigma=False, corner_px=0.3, step_m=0.1),
    ],
)
def test_stated_covariances_of_prior_and_truth_are_true(settings: Settings) -> None:
    priors, truths = [], []
    for seed in range(10):
        scene = stand(np.random.default_rng(seed), settings)
        prior, found = prior_of(scene), truths_of(scene)
        priors.append(nees(prior.map_from_body, scene.map_from_body, prior.covariance))
        view = sorted(found)[seed % len(found)]
        truths.append(nees(found[view].map_from_cam, scene.map_from_cam[view], found[view].covariance))
    # The worst is left out; 54 degrees of freedom have their 0.1 % points at 0.49 and 1.71
    assert 0.45 < np.mean(sorted(priors)[:-1]) < 1.71
    assert 0.45 < np.mean(sorted(truths)[:-1]) < 1.71


def test_more_start_tags_tell_more() -> None:
    alone, together = [], []
    for seed in range(3):
        scene = stand(np.random.default_rng(seed), Settings(n_start_tags=3, walk_m=0.0))
        only = dataclasses.replace(scene.tags, tags=tuple(t for t in scene.tags.tags if t.id in (1, 99)))
        one, three = prior_of(dataclasses.replace(scene, tags=only)), prior_of(scene)
        assert three.n_sightings > 2 * one.n_sightings
        alone.append(np.trace(one.covariance[3:, 3:]))
        together.append(np.trace(three.covariance[3:, 3:]))
    assert np.mean(together) < 0.9 * np.mean(alone)


def test_a_start_tag_that_was_moved_is_left_out_and_named() -> None:
    scene = stand(np.random.default_rng(0), Settings(n_start_tags=3, walk_m=0.0))
    moved = tuple(
        dataclasses.replace(t, map_from_tag=t.map_from_tag * exp([0, 0, 0, 0.3, 0, 0])) if t.id == 2 else t
        for t in scene.tags.tags
    )
    without = tuple(t for t in scene.tags.tags if t.id != 2)
    prior = prior_of(dataclasses.replace(scene, tags=dataclasses.replace(scene.tags, tags=moved)))
    other = prior_of(dataclasses.replace(scene, tags=dataclasses.replace(scene.tags, tags=without)))
    assert pose_error(prior.map_from_body, other.map_from_body) == pytest.approx((0, 0), abs=1e-9)
    (note,) = prior.notes
    assert note.startswith("at the start tag 2 contradicts tag 1 by ")


def test_a_tag_that_is_carried_from_visit_to_visit_is_no_start_tag() -> None:
    scene = stand(np.random.default_rng(0), Settings(n_start_tags=2, walk_m=0.0))
    carried = tuple(dataclasses.replace(t, visit="w07") if t.id == 2 else t for t in scene.tags.tags)
    alone = tuple(t for t in scene.tags.tags if t.id != 2)
    one, other = (
        prior_of(dataclasses.replace(scene, tags=dataclasses.replace(scene.tags, tags=tags)))
        for tags in (carried, alone)
    )
    assert one.n_sightings == other.n_sightings


def test_an_error_of_the_camera_in_the_hand_does_not_average_out() -> None:
    """Eight times the sightings leave the prior as uncertain as the hand camera; only the truth can learn it."""
    few, many = (
        prior_of(stand(np.random.default_rng(1), Settings(n_start=n, walk_m=0.0, tag_m=1e-4, tag_deg=0.005)))
        for n in (6, 48)
    )
    for prior in (few, many):
        sigma_deg = np.degrees(np.sqrt(np.linalg.eigvalsh(prior.covariance[:3, :3])[-1]))
        assert sigma_deg > ARM.camera_deg
    free = ArmNoise(camera_deg=0.0, camera_m=0.0, base_deg=0.0, base_m=0.0)
    naive = prior_of(stand(np.random.default_rng(1), Settings(n_start=48, walk_m=0.0, tag_m=1e-4, tag_deg=0.005)), free)
    assert np.trace(naive.covariance[:3, :3]) < np.trace(many.covariance[:3, :3]) / 2


def test_truth_does_not_move_when_absolute_odometry_and_the_start_are_perturbed() -> None:
    scene = stand(np.random.default_rng(2), Settings())
    plain = truths_of(scene)
    rng, odometry = np.random.default_rng(5), scene.recording.odometry
    walking = odometry.t_ns < scene.visit.t_begin_ns
    # Everything before the visit is nonsense; within it the deltas stay and the origin is another one
    elsewhere = exp(rng.normal(0, [1, 1, 1, 50, 50, 5]))
    poses = tuple(
        exp(rng.normal(0, 1, 6)) if before else elsewhere * p for before, p in zip(walking, odometry.poses, strict=True)
    )
    broken = dataclasses.replace(
        scene.recording,
        odometry=dataclasses.replace(odometry, poses=poses),
        starts=(),
        frames=scene.recording.frames[8:],
    )
    moved = truths_of(dataclasses.replace(scene, recording=broken))
    assert sorted(moved) == sorted(plain)
    for view, truth in plain.items():
        assert pose_error(moved[view].map_from_cam, truth.map_from_cam) == pytest.approx((0, 0), abs=1e-9)
        np.testing.assert_allclose(moved[view].covariance, truth.covariance, atol=1e-12)


def test_a_step_within_the_visit_makes_views_on_its_other_side_less_certain() -> None:
    settings = Settings(step_m=0.5, n_truth=9, n_blind=4)
    scene = stand(np.random.default_rng(3), settings)
    visit = scene.visit
    # The tag is seen before the step at 25 s only
    frames = tuple(
        dataclasses.replace(f, tags=()) if f.t_ns > 25 * SECOND else f for f in (v.frame for v in visit.views)
    )
    views = tuple(dataclasses.replace(v, frame=f) for v, f in zip(visit.views, frames, strict=True))
    blind = dataclasses.replace(visit, views=views)
    recording = dataclasses.replace(scene.recording, frames=frames, visits=(blind,))
    truths = estimate_truths(recording, blind, scene.tags, noise=OdometryNoise(position_per_m=0.1))
    before = [truths[v.id].sigma[0] for v in views if v.frame.t_ns < 25 * SECOND]
    after = [truths[v.id].sigma[0] for v in views if v.frame.t_ns > 25 * SECOND]
    assert min(after) > max(before)
    assert min(after) > 0.04


def jumping(scene: Standing, seconds: float, jump: Pose) -> Standing:
    """Let odometry jump at a time while the robot stands, and find it as a recording does."""
    odometry = scene.recording.odometry
    after = odometry.t_ns >= seconds * SECOND
    at = odometry.poses[int(after.argmax())]
    poses = [at * jump * at.inv() * p if a else p for a, p in zip(after, odometry.poses, strict=True)]
    recording = dataclasses.replace(
        scene.recording,
        odometry=dataclasses.replace(odometry, poses=tuple(poses)),
        odometry_faults=find_faults(odometry.t_ns, poses),
    )
    assert [f.kind for f in recording.odometry_faults] == ["jump"]
    return dataclasses.replace(scene, recording=recording)


@pytest.mark.parametrize("seconds", [22.95, 24.5])
def test_tags_seen_on_both_sides_of_a_jump_keep_the_truth_true(seconds: float) -> None:
    ratios = []
    for seed in range(4):
        jump = yaw_pose([0.3, (-1) ** seed * 0.15, 0.0], 0.09)
        whole = stand(np.random.default_rng(seed), Settings(walk_m=0.0))
        scene = jumping(whole, seconds, jump)
        truths, plain = truths_of(scene), truths_of(whole)
        for view in ("00", "03", "11"):
            ratios.append(nees(truths[view].map_from_cam, scene.map_from_cam[view], truths[view].covariance))
            assert truths[view].sigma[0] < 3 * plain[view].sigma[0]
    assert 0.3 < np.mean(ratios) < 1.71


def test_a_jump_that_puts_the_tag_beside_the_camera_leaves_the_truth_true() -> None:
    whole = stand(np.random.default_rng(5), Settings(walk_m=0.0))
    plain = truths_of(whole)
    for jump in (yaw_pose([0.8, 0.0, 0.0], 0.24), yaw_pose([1.5, 1.5, 0.0], 1.0)):
        scene = jumping(whole, 23.0, jump)
        truths = truths_of(scene)
        for view in ("01", "06"):
            assert nees(truths[view].map_from_cam, scene.map_from_cam[view], truths[view].covariance) < 2
            assert pose_error(truths[view].map_from_cam, plain[view].map_from_cam)[0] < 0.03


def test_views_that_only_a_jump_leads_to_are_as_uncertain_as_the_jump_is_large() -> None:
    scene = jumping(stand(np.random.default_rng(1), Settings(walk_m=0.0)), 27.05, yaw_pose([0.3, 0.15, 0.0], 0.09))
    truths = truths_of(scene)
    for view, true in scene.map_from_cam.items():
        truth, is_beyond = truths[view], int(view) > 15
        assert (truth.sigma[0] > 0.3) == is_beyond
        assert nees(truth.map_from_cam, true, truth.covariance) < 3


@pytest.mark.parametrize("seconds", [2.5, 3.1])
def test_a_jump_at_the_start_is_in_the_prior(seconds: float) -> None:
    ratios = []
    for seed in range(5):
        jump = yaw_pose([0.3, (-1) ** seed * 0.15, 0.0], 0.09)
        scene = jumping(stand(np.random.default_rng(seed), Settings(walk_m=3.0)), seconds, jump)
        prior = prior_of(scene)
        ratios.append(nees(prior.map_from_body, scene.map_from_body, prior.covariance))
    assert 0.3 < np.mean(ratios) < 1.9


def test_noise_of_recorded_corners_is_that_of_their_residuals() -> None:
    for corner_px in (0.2, 0.6):
        scene = stand(np.random.default_rng(6), Settings(states_sigma=False, corner_px=corner_px, n_start=60))
        tag = scene.tags.tags[0]
        frames = scene.recording.frames[:60]
        found = body_sightings(frames, [tag], odometry=scene.recording.odometry, noise=NOISE)
        assert len(found.sightings) > 50
        (sigma,) = {s.detection.sigma_px for s in found.sightings}
        assert sigma == pytest.approx(corner_px, rel=0.35)


def test_detections_of_a_topic_serve_where_the_interval_has_no_image() -> None:
    scene = stand(np.random.default_rng(7), Settings(walk_m=0.0))
    recording = dataclasses.replace(scene.recording, frames=(), tag_frames=scene.recording.frames)
    tagged = dataclasses.replace(scene, recording=recording)
    same = prior_of(scene)
    prior = prior_of(tagged)
    np.testing.assert_allclose(prior.map_from_body.as_matrix(), same.map_from_body.as_matrix())
    assert sorted(truths_of(tagged)) == sorted(truths_of(scene))


def test_a_detection_without_a_family_is_taken_by_its_id() -> None:
    scene = stand(np.random.default_rng(8), Settings(walk_m=0.0))

    def nameless(tags: tuple[SeenTag, ...] | None) -> tuple[SeenTag, ...]:
        return tuple(dataclasses.replace(t, family=None) for t in tags or ())

    frames = tuple(dataclasses.replace(f, tags=nameless(f.tags)) for f in scene.recording.frames)
    other = dataclasses.replace(scene, recording=dataclasses.replace(scene.recording, frames=frames))
    assert prior_of(other).n_sightings == prior_of(scene).n_sightings
    wrong = tuple(
        dataclasses.replace(f, tags=tuple(dataclasses.replace(t, family="tag25h9") for t in f.tags or ()))
        for f in frames
    )
    with pytest.raises(PriorError, match=r"start tag 1 .* is never seen"):
        prior_of(dataclasses.replace(scene, recording=dataclasses.replace(scene.recording, frames=wrong)))


def test_a_tag_twice_in_a_frame_is_left_out_of_it() -> None:
    scene = stand(np.random.default_rng(9), Settings(walk_m=0.0, n_start=5))
    frames = tuple(dataclasses.replace(f, tags=(*(f.tags or ()), *(f.tags or ()))) for f in scene.recording.frames)
    with pytest.raises(PriorError, match=r"is never seen .*: 5 images searched"):
        prior_of(dataclasses.replace(scene, recording=dataclasses.replace(scene.recording, frames=frames)))


def test_a_covariance_of_a_tag_that_is_not_positive_definite_is_named() -> None:
    scene = stand(np.random.default_rng(10), Settings(walk_m=0.0))
    broken = tuple(dataclasses.replace(t, covariance=np.diag([1e-6] * 5 + [-1e-6])) for t in scene.tags.tags)
    other = dataclasses.replace(scene, tags=dataclasses.replace(scene.tags, tags=broken))
    with pytest.raises(PriorError, match="start tag 1: the covariance of tag 1 is not positive definite"):
        prior_of(other)
    with pytest.raises(TruthError, match="tripod tag 99: the covariance of tag 99 is not positive definite"):
        truths_of(other)


def test_tags_that_are_known_exactly_give_prior_and_truth() -> None:
    scene = stand(np.random.default_rng(10), Settings(walk_m=0.0, n_start_tags=2, tag_m=1e-9, tag_deg=1e-7))
    exact = tuple(dataclasses.replace(t, covariance=np.zeros((6, 6))) for t in scene.tags.tags)
    zeros = dataclasses.replace(scene, tags=dataclasses.replace(scene.tags, tags=exact))
    one, other = prior_of(scene), prior_of(zeros)
    assert pose_error(other.map_from_body, one.map_from_body) == pytest.approx((0, 0), abs=1e-6)
    np.testing.assert_allclose(other.covariance, one.covariance, rtol=1e-3, atol=1e-9)
    for view, truth in truths_of(zeros).items():
        assert nees(truth.map_from_cam, scene.map_from_cam[view], truth.covariance) < 4


def test_tags_whose_rounded_covariance_is_singular_give_a_prior() -> None:
    scene = stand(np.random.default_rng(10), Settings(walk_m=0.0))
    along = 1e-4 * np.outer(np.ones(6), np.ones(6))
    rounded = along - 5e-7 * along[0, 0] * np.outer([1, -1, 0, 0, 0, 0], [1, -1, 0, 0, 0, 0])
    assert np.linalg.eigvalsh(rounded)[0] < -1e-11
    tags = tuple(dataclasses.replace(t, covariance=rounded) for t in scene.tags.tags)
    prior = prior_of(dataclasses.replace(scene, tags=dataclasses.replace(scene.tags, tags=tags)))
    assert np.linalg.eigvalsh(prior.covariance)[0] > 0


def test_corners_count_with_their_full_covariance() -> None:
    """A detection whose corners move together tells less of the tag's place than one whose corners move apart."""
    scene = stand(np.random.default_rng(13), Settings(walk_m=0.0))
    tag = dataclasses.replace(scene.tags.tags[0], covariance=np.zeros((6, 6)))
    found = body_sightings(scene.recording.frames[:1], [tag], odometry=scene.recording.odometry, noise=NOISE)
    together = 0.2**2 * (0.1 * np.eye(8) + 0.9 * np.kron(np.ones((4, 4)), np.eye(2)))
    exact = ArmNoise(image_deg=1e-6, image_m=1e-8, camera_deg=0, camera_m=0, base_deg=0, base_m=0)

    def sigma_of_bearing(covariance_px: Array | None) -> float:
        (s,) = found.sightings
        detection = dataclasses.replace(s.detection, covariance_px=covariance_px)
        fix = locate_body(
            dataclasses.replace(found, sightings=(dataclasses.replace(s, detection=detection),)), tag, arm=exact
        )
        cam_from_tag = (fix.map_from_body * s.place.ref_from_cam).inv() * tag.map_from_tag
        by_cam = adjoint(s.place.ref_from_cam.inv())
        in_cam = by_cam @ fix.belief.joint[:6, :6] @ by_cam.T
        lever = np.hstack([skew(cam_from_tag.translation), -np.eye(3)])
        across = (lever @ in_cam @ lever.T)[:2, :2]
        return float(np.sqrt(np.linalg.eigvalsh(across)[0]))

    assert sigma_of_bearing(None) == pytest.approx(sigma_of_bearing(0.2**2 * np.eye(8)), rel=1e-9)
    assert sigma_of_bearing(together) > 1.3 * sigma_of_bearing(None)


def test_the_topics_own_covariance_is_used_where_it_states_one() -> None:
    scene = stand(np.random.default_rng(11), Settings())
    body = scene.recording.odometry
    reference = Trajectory(body.t_ns, body.poses, "map", "body")
    stated = np.broadcast_to(np.diag([1e-4] * 3 + [4e-4] * 3), (len(body), 6, 6))
    plain = dataclasses.replace(scene.recording, reference=reference)
    stating = dataclasses.replace(plain, reference_covariance=stated)
    none = ArmNoise(image_deg=1e-6, image_m=1e-8, camera_deg=0, camera_m=0, base_deg=0, base_m=0)
    one, other = (estimate_truths(r, scene.visit, scene.tags, arm=none)["03"] for r in (plain, stating))
    assert one.sigma[1] == pytest.approx(math.radians(0.2) * math.sqrt(3), rel=1e-3)
    assert other.sigma[1] == pytest.approx(0.01 * math.sqrt(3), rel=1e-3)
    assert other.source == "topic"


def test_one_sighting_is_enough_and_its_body_stands_upright() -> None:
    scene = stand(np.random.default_rng(12), Settings(n_start=1, walk_m=0.0))
    tag = scene.tags.tags[0]
    found = body_sightings(scene.recording.frames[:1], [tag], odometry=scene.recording.odometry, noise=NOISE)
    fix = locate_body(found, tag, arm=ARM)
    assert fix.used == {1: 1}
    assert fix.map_from_body.rotation.as_matrix()[2, 2] > 0.99


STILL = ArmNoise(image_deg=1e-4, image_m=1e-6, camera_deg=0, camera_m=0, base_deg=0, base_m=0)


def seen_once(slant_rad: float, distance_m: float) -> tuple[Standing, TagPose, Pose, Array]:
    """Return a robot before a tag that is turned about its upright axis, cam_from_tag, and the corners, noise drawn."""
    scene = stand(np.random.default_rng(0), Settings(n_start=1, walk_m=0.0))
    cam_from_tag = Pose.from_components([0.02, -0.03, distance_m], Rotation.from_euler("yx", [slant_rad, math.pi]))
    corners, _ = CAMERA.project(cam_from_tag.apply(tag_corners(SIZE_M)))
    corners += 0.2 * np.random.default_rng(5).normal(size=(4, 2))
    body = yaw_pose([0.0, 0.0, 0.0], 0.3)
    axes = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    body_from_cam = Pose.from_components([0.4, 0.0, 0.6], axes)
    tag = dataclasses.replace(
        scene.tags.tags[0], map_from_tag=body * body_from_cam * cam_from_tag, covariance=1e-12 * np.eye(6)
    )
    frame = scene.recording.frames[0]
    seen = (SeenTag(tag.id, tag.family, corners, 0.2),)
    frame = dataclasses.replace(frame, body_from_cam=body_from_cam, tags=seen)
    recording = dataclasses.replace(scene.recording, frames=(frame,))
    return dataclasses.replace(scene, recording=recording), tag, cam_from_tag, CAMERA.unproject(corners)[:, :2]


def normals_by_grid(cam_from_tag: Pose, xy: Array) -> tuple[Array, Array]:
    """Return mean and covariance of the tag's normal in the camera, from the likelihood on a fine grid of tilts."""
    side = np.radians(np.linspace(-45, 45, 121))
    tilts = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    turned = cam_from_tag.rotation * Rotation.from_rotvec(np.column_stack([tilts, np.zeros(len(tilts))]))
    rest = np.tile([0.0, *cam_from_tag.translation], (len(tilts), 1))

    def residuals(q: Array) -> Array:
        about_z = Rotation.from_rotvec(q[:, :1] * [0.0, 0.0, 1.0])
        x = np.einsum("nij,kj->nki", (turned * about_z).as_matrix(), tag_corners(SIZE_M)) + q[:, None, 1:]
        return ((xy - x[..., :2] / x[..., 2:]) * CAMERA.focal_px / 0.2).reshape(len(q), 8)

    for _ in range(6):
        here = residuals(rest)
        slope = np.stack([(residuals(rest + d) - here) / 1e-6 for d in 1e-6 * np.eye(4)], axis=-1)
        normal = slope.transpose(0, 2, 1) @ slope
        rest = rest - np.linalg.solve(normal, np.einsum("nai,na->ni", slope, here)[..., None])[..., 0]
    angle = np.linalg.norm(tilts, axis=1)
    cost = (residuals(rest) ** 2).sum(axis=1) + np.linalg.slogdet(normal)[1] - 2 * np.log(np.sinc(angle / np.pi))
    weights = np.exp(-(cost - cost.min()) / 2)
    weights /= weights.sum()
    normals = turned.as_matrix()[..., 2]
    mean = weights @ normals
    return mean, ((normals - mean) * weights[:, None]).T @ (normals - mean)


@pytest.mark.parametrize(("slant_deg", "distance_m"), [(2.0, 1.7), (8.0, 1.7), (16.0, 1.7), (20.0, 3.5)])
def test_a_tilt_that_is_hardly_seen_has_the_moments_of_its_likelihood(slant_deg: float, distance_m: float) -> None:
    """Solutions that merged, a shoulder, two that the perspective decides, two that stay open: as on a fine grid."""
    scene, tag, cam_from_tag, xy = seen_once(math.radians(slant_deg), distance_m)
    found = body_sightings(scene.recording.frames, [tag], odometry=scene.recording.odometry, noise=NOISE)
    fix = locate_body(found, tag, arm=STILL)
    assert len(fix.belief.weights) > 10
    cam, covariance = fix.map_from_cam(found.places[0])
    mean, expected = normals_by_grid(cam_from_tag, xy)
    normal = (cam.inv() * tag.map_from_tag).rotation.as_matrix()[:, 2]
    is_open = bool((fix.belief.chosen == 0).any())
    assert is_open == (distance_m > 3)
    if not is_open:
        assert np.linalg.norm(normal - mean / np.linalg.norm(mean)) < 0.05 * math.sqrt(np.trace(expected))
    by_turn = np.array([[0, -normal[2], normal[1]], [normal[2], 0, -normal[0]], [-normal[1], normal[0], 0]])
    stated = by_turn @ covariance[:3, :3] @ by_turn.T
    about = expected + np.outer(mean - normal, mean - normal)
    sigmas = [np.sqrt(np.linalg.eigvalsh(c)[1:]) for c in (stated, about)]
    # A flip by 40 deg is no small angle
    np.testing.assert_allclose(*sigmas, rtol=0.1 if is_open else 0.03)


def test_sightings_that_know_the_tilt_keep_the_linear_model() -> None:
    scene = stand(np.random.default_rng(13), Settings(walk_m=0.0))
    tag = scene.tags.tags[0]
    found = body_sightings(scene.recording.frames[:8], [tag], odometry=scene.recording.odometry, noise=NOISE)
    assert len(found.sightings) == 8
    assert len(locate_body(found, tag, arm=ARM).belief.weights) == 1
