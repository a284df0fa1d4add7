"""Which photos of a tag are believed, what a reader is told about the others, and about the tag."""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from calibration_scenes import MAP_FROM_TAG, PHOTO, SIZE_M, Scene, flip, localize_wrongly, photograph, tilt_deg
from scipy.spatial.transform import Rotation
from tag_scenes import VGA, render_tag

from fieldkit.calibrate.adjustment import adjust, adjust_cameras
from fieldkit.calibrate.agreement import without
from fieldkit.calibrate.locating import LocatedPhoto, right_matches
from fieldkit.calibrate.photos import Photo, find_tags
from fieldkit.calibrate.solving import Solved, solve_tags
from fieldkit.calibrate.verdicts import judge, photo_verdicts, tag_pose, warn
from fieldkit.errors import TagError
from fieldkit.frames import Pose, exp, pose_error
from fieldkit.localize import Inliers
from fieldkit.types import TagPhoto

TWO_TAGS = (MAP_FROM_TAG, MAP_FROM_TAG * exp([0.1, 0.0, 0.2, 0.3, 0.1, 0.02]))


def scene(seed: int = 0, *, n_photos: int = 6, tags: tuple[Pose, ...] = (MAP_FROM_TAG,), **noise: float) -> Scene:
    return photograph(np.random.default_rng(seed), n_photos=n_photos, n_landmarks=60, tags=tags, **noise)  # type: ignore[arg-type]


def solve(of: Scene, photos: Sequence[LocatedPhoto] | None = None, *, size_m: float = SIZE_M) -> Solved:
    return solve_tags(of.photos if photos is None else photos, of.xyz, of.covariance, sizes_m={None: size_m})


def rejected(solved: Solved, photos: Sequence[LocatedPhoto]) -> dict[tuple[str, int], str]:
    return {(p.file, p.tag_id): p.reason for p in photo_verdicts(solved, photos) if not p.used}


def with_photo(of: Scene, index: int, photo: LocatedPhoto) -> list[LocatedPhoto]:
    return [photo if i == index else p for i, p in enumerate(of.photos)]


def test_good_photos_are_all_used_and_pass() -> None:
    of = scene()
    solved = solve(of)
    assert rejected(solved, of.photos) == {}
    assert judge(solved.tags[0]) == "pass"
    assert solved.scale < 2.0


def test_a_photo_that_is_localized_wrongly_is_named_with_its_distance() -> None:
    of = scene(1)
    photos = with_photo(of, 2, localize_wrongly(np.random.default_rng(1), of, 2, distance_m=0.8))
    solved = solve(of, photos)
    ((key, reason),) = rejected(solved, photos).items()
    assert key == ("2.jpg", 0)
    assert reason.startswith("disagrees with the others by ")
    assert solved.tags[0].sightings[2].offset[0] == pytest.approx(0.8, abs=0.35)
    assert solved.tags[0].sightings[2].sigmas > 10


def test_a_wrong_photo_changes_nothing_but_its_own_verdict() -> None:
    of = scene(2)
    photos = with_photo(of, 4, localize_wrongly(np.random.default_rng(2), of, 4, distance_m=0.3))
    good = [p for i, p in enumerate(of.photos) if i != 4]
    one, two = solve(of, photos).tags[0], solve(of, good).tags[0]
    assert pose_error(one.map_from_tag, two.map_from_tag) == pytest.approx((0, 0), abs=1e-6)
    np.testing.assert_allclose(one.covariance, two.covariance, atol=1e-3 * np.abs(two.covariance).max())


def test_a_photo_localized_wrongly_is_told_from_a_wrong_tag_where_it_sees_two() -> None:
    of = scene(3, tags=TWO_TAGS)
    photos = with_photo(of, 1, localize_wrongly(np.random.default_rng(3), of, 1, distance_m=0.5))
    reasons = rejected(solve(of, photos), photos)
    assert sorted(reasons) == [("1.jpg", 0), ("1.jpg", 1)]
    assert all(r.endswith("the photo is localized wrongly") for r in reasons.values())


def test_a_tag_that_only_a_wrong_photo_sees_fails() -> None:
    of = scene(3, tags=TWO_TAGS)
    wrong = localize_wrongly(np.random.default_rng(3), of, 1, distance_m=0.5)
    photos = [wrong if i == 1 else dataclasses.replace(p, detections=p.detections[:1]) for i, p in enumerate(of.photos)]
    solved = solve(of, photos)
    assert [judge(t) for t in solved.tags] == ["pass", "fail"]
    assert list(rejected(solved, photos)) == [("1.jpg", 0)]


def test_landmarks_that_fix_no_camera_are_an_error() -> None:
    of = scene(3)
    few = [dataclasses.replace(p, landmark=p.landmark[:1], bearings=p.bearings[:1]) for p in of.photos]
    with pytest.raises(TagError, match=r"6 localized photos determine no pose .the landmarks in 0\.jpg leave it open"):
        solve(of, few)


def test_one_bad_set_of_corners_leaves_the_photos_other_tag_in() -> None:
    of = scene(4, tags=TWO_TAGS)
    first, second = of.photos[3].detections
    shifted = dataclasses.replace(first, corners_px=first.corners_px + 25.0)
    photos = with_photo(of, 3, dataclasses.replace(of.photos[3], detections=(shifted, second)))
    assert list(rejected(solve(of, photos), photos)) == [("3.jpg", 0)]


def test_a_flipped_photo_is_named() -> None:
    of = scene(5)
    index = max(range(6), key=lambda i: tilt_deg(of, i))
    photos = with_photo(of, index, flip(np.random.default_rng(5), of, index))
    solved = solve(of, photos)
    verdict = next(p for p in photo_verdicts(solved, photos) if p.file == f"{index}.jpg")
    assert verdict.flipped
    assert not verdict.used
    assert verdict.reason.startswith("flipped: its corners show the tag tilted to the other side by ")
    assert not any(p.flipped for p in photo_verdicts(solve(of), of.photos))


def test_leaving_one_out_predicts_the_solution_without_it() -> None:
    landmarks, corners, state = scene(6).joint()
    fixed = adjust_cameras(landmarks, state.cameras)
    every = np.ones(len(corners), dtype=bool)
    found = adjust(fixed, corners, state, used=every)
    for i in (0, 3):
        rest = adjust(fixed, corners, state, used=every & (corners.photo != i))
        moved = found.state.tags.difference(rest.state.tags)[0]
        predicted = without(found, corners.photo == i)[-7:-1]
        np.testing.assert_allclose(predicted, moved, atol=0.02 * np.abs(moved).max())


def test_the_spread_of_a_tag_is_the_largest_move_without_one_photo() -> None:
    tag = solve(scene(6)).tags[0]
    moved = [s.without for s in tag.sightings if s.without is not None]
    assert len(moved) == 6
    assert tag_pose(tag).leave_one_out == (max(m for m, _ in moved), max(r for _, r in moved))
    # Standard deviations bound it: one of six photos does not move a mean by more than the mean is uncertain
    assert max(m for m, _ in moved) < 3 * math.sqrt(np.trace(tag.covariance[3:, 3:]))


@pytest.mark.parametrize("factor", [0.9, 1.03, 1.1, 1.5])
def test_a_wrong_size_is_noticed_and_the_tag_is_found_all_the_same(
    factor: float, caplog: pytest.LogCaptureFixture
) -> None:
    of = scene(7, n_photos=8)
    tag = solve(of, size_m=SIZE_M * factor).tags[0]
    assert tag.size.is_wrong
    assert tag.size.measured_m == pytest.approx(SIZE_M, rel=4 * tag.size.sigma)
    assert tag.size.sigma < 0.01
    assert judge(tag) == ("warn" if factor == 1.03 and tag.size.measured_m > SIZE_M else "fail")
    assert pose_error(tag.map_from_tag, MAP_FROM_TAG)[0] < 0.01
    assert tag.n_used == 8
    with caplog.at_level(logging.WARNING):
        warn([tag], [], [0])
    assert f"but {SIZE_M * factor:.4g} m is given; measure the black square, or check the map's scale" in caplog.text


def test_a_right_size_is_confirmed() -> None:
    tag = solve(scene(8)).tags[0]
    assert not tag.size.is_wrong
    assert abs(math.log(tag.size.measured_m / SIZE_M)) < 4 * tag.size.sigma
    assert tag_pose(tag).size_from_map == pytest.approx((SIZE_M, 0.0), abs=0.002)


def test_one_photo_is_allowed_and_says_what_that_means(caplog: pytest.LogCaptureFixture) -> None:
    of = scene(9)
    solved = solve(of, of.photos[:1])
    stored = tag_pose(solved.tags[0])
    assert (stored.n_photos, stored.verdict) == (1, "warn")
    assert stored.leave_one_out is None
    assert stored.size_from_map is None
    with caplog.at_level(logging.WARNING):
        warn(solved.tags, [], [0] * len(solved.tags))
    assert "tag 0: warn: one photo only: nothing tells whether it is right" in caplog.text


def test_two_photos_that_disagree_fail_the_tag() -> None:
    of = scene(10, n_photos=2)
    photos = with_photo(of, 0, localize_wrongly(np.random.default_rng(10), of, 0, distance_m=0.5))
    solved = solve(of, photos)
    assert judge(solved.tags[0]) == "fail"
    assert len(rejected(solved, photos)) == 1


def test_photos_that_are_all_off_raise_the_scale_and_the_covariance_and_lose_none() -> None:
    off, still = scene(11, n_photos=8, warp_m=0.01), scene(11, n_photos=8)
    moved, stood = solve(off), solve(still)
    assert moved.scale > 2.5
    assert rejected(moved, off.photos) == {}
    assert np.trace(moved.tags[0].covariance[3:, 3:]) > 4 * np.trace(stood.tags[0].covariance[3:, 3:])
    error = MAP_FROM_TAG.inv() * moved.tags[0].map_from_tag
    assert (np.abs(error.translation) < 4 * np.sqrt(np.diag(moved.tags[0].covariance)[3:])).all()


def test_wrong_matches_do_not_enter_and_noisy_pixels_count_less() -> None:
    of, rng = scene(13, map_sigma_m=0.0005), np.random.default_rng(13)
    cam, photo = of.map_from_cams[0], of.photos[0]
    pixels = PHOTO.project(cam.inv().apply(of.xyz[photo.landmark]))[0]
    pixels = pixels + rng.normal(0, 3.0, pixels.shape)
    pixels[:5] += 40.0
    landmark, seen = _matched(of, pixels, cam)
    assert set(photo.landmark[:5].tolist()).isdisjoint(landmark.tolist())
    assert len(landmark) > 50
    sharp = _matched(of, PHOTO.project(cam.inv().apply(of.xyz[photo.landmark]))[0], cam)[1]
    assert 1.5 < np.median(sharp.whitening[:, 0, 0]) / np.median(seen.whitening[:, 0, 0]) < 4


def _matched(of: Scene, pixels: np.ndarray, cam: Pose):  # type: ignore[no-untyped-def]
    from synthetic_map import make_map

    known = make_map(np.random.default_rng(0), n_landmarks=10)
    known = dataclasses.replace(known, xyz=of.xyz, xyz_covariance=of.covariance)
    inliers = Inliers(of.photos[0].landmark.astype(np.int32), pixels, 1.0)
    return right_matches(inliers, PHOTO, cam, known)


def find(tmp_path: Path, images: list[np.ndarray]) -> list[TagPhoto]:
    photos = []
    for i, image in enumerate(images):
        path = tmp_path / f"{i}.png"
        cv2.imwrite(str(path), image)
        photos.append(Photo(path.name, path, VGA, tmp_path / "camera.toml"))
    return find_tags(tmp_path, photos, {None: SIZE_M}, ("tag36h11",), None)[1]


def at(distance: float, x: float = 0.0) -> Pose:
    return Pose.from_components([x, 0.0, distance], Rotation.from_euler("x", 160, degrees=True))


def test_tags_that_are_too_small_blurred_or_seen_twice_are_rejected_with_the_reason(tmp_path: Path) -> None:
    blurred = cv2.GaussianBlur(render_tag(VGA, at(0.8)), (0, 0), 4.5)
    twice = np.where(np.arange(640) < 320, render_tag(VGA, at(0.9, -0.2)), render_tag(VGA, at(0.9, 0.2))).astype(
        np.uint8
    )
    reasons = {
        p.file: p.reason for p in find(tmp_path, [render_tag(VGA, at(3.8)), blurred, twice, render_tag(VGA, at(0.8))])
    }
    assert reasons["0.png"].startswith("the tag is too small: ")
    assert reasons["0.png"].endswith("px; expected an edge of at least 24 px")
    assert reasons["1.png"].startswith("the tag is blurred by ")
    assert reasons["2.png"] == "the same id is seen twice in the photo"
    assert "3.png" not in reasons


def test_only_unusable_tags_are_an_error_that_says_why(tmp_path: Path) -> None:
    with pytest.raises(TagError, match=r"no tag can be used \(for example tag 2 in 0\.png: the tag is too small: "):
        find(tmp_path, [render_tag(VGA, at(3.8))])


def test_a_photo_without_a_tag_says_when_it_is_blurred(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    grain = rng.integers(0, 255, (480, 640)).astype(np.uint8)
    verdicts = find(tmp_path, [cv2.GaussianBlur(grain, (0, 0), 8.0), grain, render_tag(VGA, at(0.8))])
    assert verdicts[0].reason.startswith("no tag found; the photo is blurred by about ")
    assert verdicts[1].reason == "no tag found"
