"""Photos in a second map: what the two agree on, what contradicts, and the scale between them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import scipy.linalg
from calibration_scenes import aim
from test_calibrate import SIZE_M, Wall, build, wall_photos

from fieldkit.calibrate.second import PlacedPhotos, SecondLook, check_in_second_map, compare
from fieldkit.errors import TagError
from fieldkit.frames import Array, Pose, exp, yaw_pose
from fieldkit.tag_tables import print_second, second_json

__all__ = ["wall_photos"]

SECOND_FROM_FIRST = yaw_pose([0.3, -0.2, 0.05], 0.2)
FILES = [f"{i}.jpg" for i in range(12)]


def look(seed: int, *, scale: float = 1.0, noise: float = 1.0, moved: Pose | None = None) -> SecondLook:
    """Compare twelve photos whose poses err by their covariances (times ``noise``); ``moved`` is wrong in one map."""
    rng = np.random.default_rng(seed)
    covariance: Array = np.diag([math.radians(0.1) ** 2] * 3 + [0.004**2] * 3)
    first, second = [], []
    for i in range(len(FILES)):
        true = aim(rng)
        errors = rng.normal(0, noise, (2, 6)) * np.sqrt(np.diag(covariance))
        there = SECOND_FROM_FIRST * true
        there = Pose.from_components(scale * there.translation, there.rotation)
        if moved is not None and i == 5:
            there = there * moved
        first.append(true * exp(errors[0]))
        second.append(there * exp(errors[1]))
    every = scipy.linalg.block_diag(*[covariance] * len(FILES))
    return compare(FILES, PlacedPhotos(tuple(first), every), PlacedPhotos(tuple(second), every))


def test_maps_that_agree_pass_whatever_their_frames() -> None:
    looks = [look(seed) for seed in range(12)]
    assert {one.verdict for one in looks} == {"pass"}
    assert np.mean([one.spread for one in looks]) == pytest.approx(1.0, abs=0.1)
    assert looks[0].offset[1] == pytest.approx(0.2, abs=0.01)
    assert np.mean([(one.scale[0] / one.scale[1]) ** 2 for one in looks]) < 2.5


def test_another_scale_is_found_within_its_sigma() -> None:
    found = look(1, scale=1.05)
    assert found.scale[0] == pytest.approx(0.05, abs=3 * found.scale[1])
    assert found.scale[1] < 0.01
    assert found.verdict == "warn"


def test_a_photo_that_is_wrong_in_one_map_is_named_and_does_not_pull() -> None:
    wrong, right = look(2, moved=exp([0.1, 0, 0, 0.5, 0, 0])), look(2)
    assert [p.file for p in wrong.photos if not p.agrees] == ["5.jpg"]
    assert wrong.photos[5].position_m == pytest.approx(0.5, abs=0.05)
    assert wrong.verdict == "warn"
    assert wrong.spread == pytest.approx(right.spread, abs=0.2)


def test_what_photos_of_a_map_are_wrong_by_together_does_not_excuse_one_of_them() -> None:
    rng, n = np.random.default_rng(4), len(FILES)
    own: Array = np.diag([math.radians(0.1) ** 2] * 3 + [0.004**2] * 3)
    true = [aim(rng) for _ in range(n)]
    by_shift = np.concatenate([np.vstack([np.zeros((3, 3)), p.rotation.as_matrix().T]) for p in true])
    shared = np.kron(np.eye(n), own) + 0.05**2 * by_shift @ by_shift.T
    quiet = PlacedPhotos(tuple(true), np.kron(np.eye(n), own))

    def shifted(photo: int | None) -> SecondLook:
        wrong = exp([0.0, 0, 0, 0.04, 0, 0])
        moved = [p * exp(rng.normal(0, np.sqrt(np.diag(own)))) for p in true]
        return compare(
            FILES, quiet, PlacedPhotos(tuple(p * wrong if i == photo else p for i, p in enumerate(moved)), shared)
        )

    # 4 cm are within the 5 cm that all may be off by together, but not for one photo alone
    assert [p.file for p in shifted(3).photos if not p.agrees] == ["3.jpg"]
    assert shifted(None).spread == pytest.approx(1.0, abs=0.35)


def test_errors_beyond_their_covariance_fail() -> None:
    assert look(3, noise=4.0).verdict == "fail"


def test_photos_are_compared_with_a_map_of_another_feature(
    wall_photos: Wall, capsys: pytest.CaptureFixture[str]
) -> None:
    second = dataclasses.replace(
        build(wall_photos.texture, np.random.default_rng(7), feature="akaze"), digest="other", path="akaze.map"
    )
    found = check_in_second_map(wall_photos.folder, wall_photos.scene_map, second, sizes_m={None: SIZE_M})
    assert found.features == ("sift", "akaze")
    assert found.verdict == "pass"
    assert len([p for p in found.photos if p.agrees]) >= 5
    assert abs(found.scale[0]) < 0.01
    assert ("bare.png", "akaze.map") in found.lost
    print_second(found)
    assert "bare.png" in capsys.readouterr().out
    assert second_json(found)["verdict"] == "pass"


def test_the_same_map_is_no_check(wall_photos: Wall) -> None:
    with pytest.raises(TagError, match=r"wall\.map: is the map that is checked; expected another; build one"):
        check_in_second_map(wall_photos.folder, wall_photos.scene_map, wall_photos.scene_map, sizes_m={None: SIZE_M})
