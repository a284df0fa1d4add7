"""What users of the localizer rely on: threads, rigs, priors, confidence, and folders with bad images in them."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from synthetic_map import CAMERA, looking, make_map
from test_localize import noisy, scene

from fieldkit import maps, store
from fieldkit.bags import open_recording
from fieldkit.cameras import Camera
from fieldkit.cli import main
from fieldkit.errors import FeatureError, LocalizeError
from fieldkit.features import read_grey
from fieldkit.features.matching import match_groups
from fieldkit.frames import Pose, compose_covariance, exp, log, pose_error
from fieldkit.localize import CameraPrior, Localizer, Query
from fieldkit.localize.chance import Agreement, confidence, log_false_alarms
from fieldkit.localize.files import localize_files, localize_rig_files
from fieldkit.localize.localizer import _on_the_plane
from fieldkit.localize.matching import _merged, features_of
from fieldkit.localize.narrowing import plausible_images
from fieldkit.localize.pose import _between, estimate_pose, refine_pose
from fieldkit.localize.retrieval import build_index
from fieldkit.protocol import LocalizerRules
from fieldkit.store.inputs import Rig, RigCamera, write_camera, write_rig, write_tum
from fieldkit.types import Frame

SAMPLE = Path(__file__).resolve().parents[1] / "data_samples" / "room"


@pytest.fixture(scope="module")
def localizer() -> Localizer:
    return Localizer(maps.load_map(SAMPLE / "lab.map"))


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    """Six views of one waypoint: the body stands, the arm turns."""
    return [v.frame for v in open_recording(SAMPLE / "session").visits[0].views[1:7]]


def same_bits(a: Pose | None, b: Pose | None) -> bool:
    if a is None or b is None:
        return a is b
    return bool((a.as_matrix() == b.as_matrix()).all())


def test_threads_change_no_bit_and_no_order(localizer: Localizer, frames: list[Frame]) -> None:
    queries = [Query(f.read(), f.camera) for f in frames]
    alone = [localizer.localize_query(q) for q in queries]
    several = list(localizer.localize_many(iter(queries), threads=3))
    split = [localizer.localize(q.image, q.camera) for q in queries]
    assert sum(e.status == "ok" for e in alone) >= 3
    for one, many, halves in zip(alone, several, split, strict=True):
        assert one.status == many.status == halves.status
        for other in (many, halves):
            assert same_bits(one.map_from_cam, other.map_from_cam)
            np.testing.assert_array_equal(one.covariance, other.covariance)


def rig_of(frames: Sequence[Frame]) -> tuple[dict[str, np.ndarray], list[RigCamera]]:
    """Return views of a standing body as images of a rig: the body."""
    members = [RigCamera(f"c{i}", f.camera, f.body_from_cam) for i, f in enumerate(frames)]
    return {m.name: f.read() for m, f in zip(members, frames, strict=True)}, members


def test_a_rig_with_one_image_is_that_camera_alone(localizer: Localizer, frames: list[Frame]) -> None:
    images, rig = rig_of(frames)
    localized = 0
    for frame, member in zip(frames, rig, strict=True):
        alone = localizer.localize(frame.read(), frame.camera)
        found = localizer.localize_rig({member.name: images[member.name]}, rig)
        assert found.status == alone.status
        assert found.n_inliers == {member.name: alone.n_inliers}
        if alone.map_from_cam is None or alone.covariance is None or found.map_from_rig is None:
            continue
        localized += 1
        assert max(pose_error(found.map_from_rig, alone.map_from_cam * member.rig_from_cam.inv())) < 1e-12
        carried = compose_covariance(alone.covariance, member.rig_from_cam.inv())
        np.testing.assert_allclose(found.covariance, carried, rtol=1e-6, atol=1e-14)
    assert localized >= 3


def test_the_cameras_of_a_rig_make_one_pose(localizer: Localizer, frames: list[Frame]) -> None:
    images, rig = rig_of(frames)
    together = localizer.localize_rig(images, rig)
    assert together.map_from_rig is not None
    assert together.covariance is not None
    assert set(together.n_matches) == set(images)
    best = np.inf
    for frame, member in zip(frames, rig, strict=True):
        alone = localizer.localize(frame.read(), frame.camera)
        if alone.map_from_cam is None or alone.covariance is None:
            continue
        body = alone.map_from_cam * member.rig_from_cam.inv()
        spread = compose_covariance(alone.covariance, member.rig_from_cam.inv())
        best = min(best, float(np.trace(spread[3:, 3:])))
        # The arm is not as exact as the camera: 2 mm and 0.2 deg
        arm = np.diag([0.0035**2] * 3 + [0.004**2] * 3)
        d = log(body.inv() * together.map_from_rig)
        assert d @ np.linalg.solve(spread + together.covariance + arm, d) < 40
    assert np.trace(together.covariance[3:, 3:]) < 1.2 * best


def test_a_rig_is_placed_by_few_matches_in_each_camera(rng: np.random.Generator) -> None:
    nees = []
    for _ in range(60):
        truth, front = scene(rng, 10)
        turned = exp([0.0, 2.5, 0.0, 0.1, 0.0, -0.2])
        # The same landmarks, carried to where the other camera sees them as this one did
        behind = truth * turned * truth.inv()
        back = dataclasses.replace(front, xyz=behind.apply(front.xyz))
        pair = [
            dataclasses.replace(noisy(points, rng), rig_from_cam=rig_from_cam)
            for points, rig_from_cam in ((front, Pose.identity()), (back, turned))
        ]
        solved = estimate_pose(pair, max_error_px=12.0, seed=0)
        assert solved is not None
        assert [len(i) for i in solved.inliers] == [10, 10]
        d = log(solved.map_from_rig.inv() * truth)
        nees.append(d @ np.linalg.solve(solved.covariance, d) / 6)
        assert pose_error(solved.map_from_rig, truth)[0] < 0.1
    assert 0.4 < np.mean(nees) < 1.5


def test_an_image_of_a_camera_that_the_rig_lacks_is_refused(localizer: Localizer, frames: list[Frame]) -> None:
    images, rig = rig_of(frames[:2])
    with pytest.raises(LocalizeError, match="an image of the camera 'c1'; the rig has c0"):
        localizer.localize_rig(images, rig[:1])


def prior_at(pose: Pose, sigma_m: float, sigma_deg: float) -> CameraPrior:
    return CameraPrior(pose, np.diag([np.radians(sigma_deg) ** 2] * 3 + [sigma_m**2] * 3))


def test_a_prior_keeps_the_images_that_may_show_the_same(rng: np.random.Generator) -> None:
    scene_map = make_map(rng, n_landmarks=600, n_images=24)
    here = looking(np.array([0.5, 0.0, 1.5]), 0.0)
    near = plausible_images(scene_map, prior_at(here, 0.05, 2.0), CAMERA)
    wide = plausible_images(scene_map, prior_at(here, 0.5, 20.0), CAMERA)
    lost = plausible_images(scene_map, prior_at(here, 50.0, 20.0), CAMERA)
    assert near.sum() < wide.sum() < lost.sum() == 24
    assert not (near & ~wide).any()
    facing = np.array([p.rotation.as_matrix()[0, 2] for p in scene_map.map_from_image])
    assert near[facing > 0.9].all()
    assert not near[facing < -0.9].any()


def test_a_right_prior_leaves_the_pose_and_a_wrong_one_gives_none(localizer: Localizer, frames: list[Frame]) -> None:
    frame = next(f for f in frames if localizer.localize(f.read(), f.camera).status == "ok")
    free = localizer.localize(frame.read(), frame.camera)
    assert free.map_from_cam is not None
    shifted = free.map_from_cam * exp([0.0, 0.05, 0.0, 0.2, 0.0, 0.1])
    found = localizer.localize(frame.read(), frame.camera, prior=prior_at(shifted, 0.3, 8.0))
    assert found.map_from_cam is not None
    assert pose_error(found.map_from_cam, free.map_from_cam)[0] < 0.02
    elsewhere = Pose.from_translation([500.0, 0.0, 0.0]) * free.map_from_cam
    assert localizer.localize(frame.read(), frame.camera, prior=prior_at(elsewhere, 0.3, 8.0)).status == "no_matches"


def agreement(rng: np.random.Generator, n: int, right: int, *, side_px: float = 1.0) -> Agreement:
    """Matches all over an image of 640x480, or in a part of it, of which some agree within two pixels."""
    pixels = rng.uniform([0, 0], [640, 480], (n, 2)) * side_px
    residual = np.where(np.arange(n) < right, rng.uniform(0, 2, n), rng.uniform(20, 200, n))
    return Agreement(pixels, residual, 640.0 * 480.0)


def test_matches_by_chance_are_expected_and_many_that_agree_are_not(rng: np.random.Generator) -> None:
    random = [
        log_false_alarms([Agreement(rng.uniform([0, 0], [640, 480], (80, 2)), rng.uniform(0, 300, 80), 307200.0)],
                         max_error_px=12.0)
        for _ in range(50)
    ]  # fmt: skip
    assert min(random) > -2.0
    values = [log_false_alarms([agreement(rng, 80, k)], max_error_px=12.0) for k in (6, 12, 24, 48)]
    assert values == sorted(values, reverse=True)
    assert values[-1] < -80.0


def test_confidence_falls_with_matches_that_are_crowded_or_in_a_row(rng: np.random.Generator) -> None:
    all_over = agreement(rng, 40, 16)
    row = dataclasses.replace(all_over, pixels=all_over.pixels * [1.0, 0.01])
    crowd = dataclasses.replace(all_over, pixels=all_over.pixels * 0.04)
    sure, in_a_row, crowded = (confidence([a], max_error_px=12.0) for a in (all_over, row, crowd))
    assert crowded < 0.5
    assert crowded < in_a_row < 0.95 < 0.999 < sure < 1.0
    assert confidence([agreement(rng, 40, 5)], max_error_px=12.0) < 0.5


def test_a_pose_below_the_confidence_asked_for_is_none_and_says_so(localizer: Localizer, frames: list[Frame]) -> None:
    frame = next(f for f in frames if localizer.localize(f.read(), f.camera).status == "ok")
    found = localizer.localize(frame.read(), frame.camera)
    strict = Localizer(localizer._map, LocalizerRules(min_confidence=np.nextafter(1.0, 0.0)))
    doubtful = dataclasses.replace(found, confidence=0.4)
    assert doubtful.confidence < LocalizerRules().min_confidence < found.confidence
    small = cv2.resize(frame.read(), None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    refused = strict.localize(np.ascontiguousarray(small), frame.camera.scaled(0.25))
    assert refused.map_from_cam is None
    assert refused.covariance is None
    if refused.status == "low_confidence":
        assert refused.n_inliers >= 12
        assert 0.0 < refused.confidence < 1.0


def test_poses_that_fit_alike_are_all_within_the_covariance() -> None:
    here, there = Pose.identity(), exp([0.0, 0.3, 0.0, 0.5, 0.0, 0.0])
    alike, worse = (_between(here, [here, there], costs) for costs in ([20.0, 20.0], [20.0, 60.0]))
    assert np.sqrt(alike[3, 3]) == pytest.approx(0.5 / np.sqrt(2))
    assert np.sqrt(alike[1, 1]) == pytest.approx(0.3 / np.sqrt(2))
    assert np.sqrt(worse[3, 3]) < 0.01
    assert not _between(here, [here, here, here], [20.0, 20.0, 21.0]).any()


def test_landmarks_that_are_hardly_known_along_their_rays_do_no_harm(rng: np.random.Generator) -> None:
    truth, points = scene(rng)
    rays = points.xyz - truth.translation
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    long = 1e8 * np.einsum("ni,nj->nij", rays, rays) + 1e-10 * np.eye(3)
    start = truth * exp([0.5, 0.4, 0.3, 3.0, 2.0, 3.0])
    found, covariance, _ = refine_pose([dataclasses.replace(points, xyz_covariance=long)], start, noise=1.0)
    assert np.isfinite(found.as_matrix()).all()
    assert np.isfinite(covariance).all()


def test_large_keypoints_count_less_than_small_ones(rng: np.random.Generator) -> None:
    sized, plain = [], []
    for _ in range(40):
        truth, points = scene(rng)
        sigma = np.where(np.arange(60) < 40, 3.0, 0.3)
        points = dataclasses.replace(points, pixels=points.pixels + sigma[:, None] * rng.normal(size=(60, 2)))
        for kept, given in ((sized, sigma), (plain, np.ones(60))):
            found = estimate_pose([dataclasses.replace(points, sigma_px=given)], max_error_px=12.0, seed=0)
            assert found is not None
            kept.append(pose_error(found.map_from_rig, truth)[0])
    assert np.mean(sized) < 0.7 * np.mean(plain)


def test_mutual_matches_are_nearest_both_ways(rng: np.random.Generator) -> None:
    stored = rng.normal(size=(30, 10)).astype(np.float32)
    owner = np.repeat(np.arange(15), 2).astype(np.int32)
    query = np.concatenate([stored[::2] + 0.01, stored[:4:2] + 0.2]).astype(np.float32)
    rows, found, squared = match_groups(query, stored, owner, mutual=True)
    np.testing.assert_array_equal(rows, np.arange(15))
    np.testing.assert_array_equal(found, np.arange(15))
    np.testing.assert_allclose(squared, 10 * 0.01**2, rtol=1e-2)
    assert not len(match_groups(query[15:], stored, owner, max_squared=0.1)[0])
    for threads in (1, 2):
        again = match_groups(np.tile(query, (40, 1)), stored, owner, threads=threads)
        np.testing.assert_array_equal(again[1], match_groups(np.tile(query, (40, 1)), stored, owner)[1])


def test_pairs_of_several_images_are_merged_into_one_match_per_landmark() -> None:
    pairs = np.array([[0, 7], [1, 8], [0, 7], [2, 7], [1, 9]], dtype=np.int32)
    keypoint, landmark = _merged(pairs, np.array([0.5, 0.6, 0.9, 0.8, 0.95], dtype=np.float32))
    np.testing.assert_array_equal(keypoint, [0, 1])
    np.testing.assert_array_equal(landmark, [7, 9])


def test_a_mapping_image_is_seen_as_its_landmarks(rng: np.random.Generator) -> None:
    scene_map = make_map(rng, n_landmarks=80, n_images=6)
    features, landmark = features_of(scene_map, build_index(scene_map, seed=0), 4)
    mine = scene_map.observation_image == 4
    order = np.argsort(landmark)
    np.testing.assert_array_equal(landmark[order], scene_map.observation_landmark[mine])
    np.testing.assert_array_equal(features.keypoints_px[order], scene_map.observation_px[mine])
    np.testing.assert_array_equal(features.descriptors[order], scene_map.descriptors[mine])


def command(*words: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main(["localize", *map(str, words)])
    assert isinstance(ended.value.code, int)
    return ended.value.code


@pytest.fixture
def folder(tmp_path: Path, frames: list[Frame]) -> Path:
    """Two images, one that is none, and one of another size."""
    images = tmp_path / "images"
    images.mkdir()
    for name, frame in zip(("a.png", "b.png"), frames, strict=False):
        cv2.imwrite(str(images / name), frame.read())
    (images / "broken.jpg").write_bytes(b"not an image")
    cv2.imwrite(str(images / "small.png"), np.zeros((30, 40), dtype=np.uint8))
    write_camera(tmp_path / "camera.toml", frames[0].camera)
    return images


def test_one_bad_image_does_not_lose_the_poses_of_others(
    localizer: Localizer, frames: list[Frame], folder: Path
) -> None:
    found = dict(localize_files(localizer, folder, frames[0].camera))
    assert (found["broken.jpg"].status, found["small.png"].status) == ("unreadable", "other_size")
    alone = localizer.localize(read_grey(folder / "a.png"), frames[0].camera)
    assert same_bits(found["a.png"].map_from_cam, alone.map_from_cam)
    with pytest.raises(FeatureError, match=r"broken\.jpg: cannot be read as an image"):
        localize_files(localizer, folder / "broken.jpg", frames[0].camera)
    with pytest.raises(LocalizeError, match=r"small\.png: is 40x30; the camera says"):
        localize_files(localizer, folder / "small.png", frames[0].camera)


def test_priors_of_other_images_are_refused(localizer: Localizer, frames: list[Frame], folder: Path) -> None:
    with pytest.raises(LocalizeError, match=r"none of its 4 images has a prior; the first prior is of x\.png"):
        localize_files(localizer, folder, frames[0].camera, priors={"x.png": prior_at(Pose.identity(), 1.0, 1.0)})


def rig_folder(path: Path, frames: list[Frame]) -> Rig:
    rig = Rig(tuple(rig_of(frames[:2])[1]))
    for i, frame in enumerate(frames[:2]):
        (path / "images" / f"c{i}").mkdir(parents=True)
        cv2.imwrite(str(path / "images" / f"c{i}" / "f1.png"), frame.read())
    (path / "images" / "c1" / "f2.png").write_bytes(b"not an image")
    return rig


def test_the_frames_of_a_rig_are_localized_with_the_images_that_can_be_read(
    localizer: Localizer, frames: list[Frame], tmp_path: Path
) -> None:
    rig = rig_folder(tmp_path, frames)
    found = dict(localize_rig_files(localizer, tmp_path, rig))
    assert set(found["f1"].n_matches) == {"c0", "c1"}
    assert found["f2"].map_from_rig is None
    assert not found["f2"].n_matches
    with pytest.raises(LocalizeError, match="c1: images of a camera that the rig does not have; its cameras are c0"):
        localize_rig_files(localizer, tmp_path, Rig(rig.cameras[:1]))


def test_the_command_localizes_a_folder_and_a_rig(
    frames: list[Frame], folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, given = tmp_path / "poses.txt", ["--map", str(SAMPLE / "lab.map"), "--json"]
    camera = ["--camera", str(tmp_path / "camera.toml")]
    assert command(folder, *camera, *given, "--out", out) == 0
    shown = {i["name"]: i for i in json.loads(capsys.readouterr().out)["images"]}
    assert shown["broken.jpg"]["status"] == "unreadable"
    poses = dict(store.read_tum(out))
    assert set(poses) == {n for n, i in shown.items() if i["status"] == "ok"}
    priors = tmp_path / "priors.txt"
    write_tum(priors, [("a.png", Pose.from_translation([500.0, 0.0, 0.0]))])
    narrowed = ["--prior-poses", str(priors), "--force"]
    assert command(folder, *camera, *given, *narrowed, "--out", out) == 0
    assert json.loads(capsys.readouterr().out)["images"][0]["status"] == "no_matches"
    write_rig(tmp_path / "rig.toml", rig_folder(tmp_path / "rig", frames))
    rig = ["--rig", str(tmp_path / "rig.toml"), "--out", str(tmp_path / "rig.txt")]
    assert command(tmp_path / "rig", *given, *rig) == 0
    first = json.loads(capsys.readouterr().out)["frames"][0]
    assert first["name"] == "f1"
    assert set(first["matches"]) == {"c0", "c1"}
    assert command(folder, *given, "--out", out, "--force") == 1
    assert "expected one of the two" in capsys.readouterr().err


def test_names_of_images_come_back_from_the_poses_as_priors(
    frames: list[Frame], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    images = tmp_path / "images"
    images.mkdir()
    for name in ("a b.png", "a_b.png", "#c.png", "50%.png"):
        cv2.imwrite(str(images / name), frames[0].read())
    write_camera(tmp_path / "camera.toml", frames[0].camera)
    given = [images, "--map", SAMPLE / "lab.map", "--camera", tmp_path / "camera.toml", "--out"]
    assert command(*given, tmp_path / "poses.txt") == 0
    assert len({n for n, _ in store.read_tum(tmp_path / "poses.txt")}) == 4
    assert command(*given, tmp_path / "again.txt", "--prior-poses", tmp_path / "poses.txt") == 0
    assert "have no prior" not in caplog.text
    assert len(store.read_tum(tmp_path / "again.txt")) == 4


@pytest.mark.parametrize(
    ("options", "wrong"),
    [
        (["--threads", "0"], "--threads 0: expected 1 or more"),
        (["--prior-poses", "empty.txt"], "no pose in it"),
        (["--prior-poses", "twice.txt"], "a.png has two poses"),
        (["--prior-poses", "once.txt", "--prior-sigma-m", "1e300"], "expected 0 to 1e+06, not 0"),
    ],
)
def test_options_that_mean_nothing_are_refused(
    options: list[str],
    wrong: str,
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty.txt").touch()
    write_tum(tmp_path / "twice.txt", [("a.png", Pose.identity())] * 2)
    write_tum(tmp_path / "once.txt", [("a.png", Pose.identity())])
    given = [folder, "--map", SAMPLE / "lab.map", "--camera", "camera.toml", "--out", "poses.txt"]
    assert command(*given, *options) == 1
    assert wrong in capsys.readouterr().err
    assert not (tmp_path / "poses.txt").exists()


def test_a_prior_of_unknown_covariance_is_refused(localizer: Localizer, frames: list[Frame]) -> None:
    prior = CameraPrior(Pose.identity(), np.full((6, 6), np.nan))
    with pytest.raises(LocalizeError, match="covariance is not finite"):
        localizer.localize(frames[0].read(), frames[0].camera, prior=prior)


def test_a_rig_of_another_size_and_two_images_of_one_frame_are_refused(
    localizer: Localizer, frames: list[Frame], tmp_path: Path
) -> None:
    rig = rig_folder(tmp_path, frames)
    half = dataclasses.replace(rig.cameras[1], camera=rig.cameras[1].camera.scaled(0.5))
    with pytest.raises(LocalizeError, match=r"f1\.png: is 640x480; the camera says 320x240"):
        localize_rig_files(localizer, tmp_path, Rig((rig.cameras[0], half)))
    (tmp_path / "images" / "c0" / "f1.jpg").write_bytes(b"")
    with pytest.raises(LocalizeError, match=r"f1\.png: a second image of this frame beside f1\.jpg"):
        localize_rig_files(localizer, tmp_path, rig)


def test_pixels_without_a_ray_before_the_camera_are_left_out() -> None:
    fisheye = Camera("OPENCV_FISHEYE", 640, 480, (180.0, 180.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0))
    barrel = Camera("OPENCV", 640, 480, (300.0, 300.0, 320.0, 240.0, -0.4, 0.0, 0.0, 0.0))
    pixels = np.array([[320.0, 240.0], [420.0, 200.0], [5.0, 240.0], [2.0, 2.0]], dtype=np.float32)
    assert _on_the_plane(fisheye, pixels).tolist() == [True, True, False, False]
    assert _on_the_plane(barrel, pixels).tolist() == [True, True, False, False]
    assert _on_the_plane(CAMERA, pixels).all()
