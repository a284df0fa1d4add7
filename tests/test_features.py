"""Local and global features: where keypoints lie, that they repeat, and that matching is exact."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from fieldkit.errors import FeatureError
from fieldkit.features import FEATURES, extract, feature_name, read_grey, read_image, to_grey
from fieldkit.features.matching import match_groups, match_pair
from fieldkit.features.sift import root_sift
from fieldkit.features.vlad import global_descriptor, train_vocabulary


def blob(cx: float, cy: float, *, sigma: float = 5.0, size: tuple[int, int] = (128, 96)) -> np.ndarray:
    """Render a bright spot whose centre is (cx, cy) in COLMAP pixels."""
    y, x = np.mgrid[: size[1], : size[0]] + 0.5
    return np.rint(60 + 150 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * sigma**2))).astype(np.uint8)


def texture(rng: np.random.Generator, size: tuple[int, int] = (320, 240)) -> np.ndarray:
    noise = rng.normal(size=(size[1], size[0])).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 3.0)
    return np.clip(127 + 60 * smooth / smooth.std(), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("feature", ["sift", "sift_l2", "akaze"])
@pytest.mark.parametrize("centre", [(50.5, 40.5), (51.0, 40.75), (60.3, 44.1)])
def test_a_spot_is_found_at_its_centre_in_colmap_pixels(centre: tuple[float, float], feature: str) -> None:
    found = extract(blob(*centre), feature=feature)
    assert len(found) > 0
    np.testing.assert_allclose(found.keypoints_px.mean(axis=0), centre, atol=0.06)


def test_a_large_image_is_reduced_and_its_keypoints_come_back_without_a_shift() -> None:
    found = extract(blob(903.3, 611.7, sigma=30.0, size=(1800, 1200)), max_side_px=600)
    strongest = found.keypoints_px[0]
    np.testing.assert_allclose(strongest, (903.3, 611.7), atol=0.3)
    assert 45 < found.scales[0] < 60


def test_keypoints_are_the_strongest_in_order_and_repeat_exactly(rng: np.random.Generator) -> None:
    image = texture(rng)
    first, second = extract(image, max_keypoints=100), extract(image, max_keypoints=100)
    assert len(first) == 100
    assert (np.diff(first.scores) <= 0).all()
    assert first.scores[-1] >= np.sort(extract(image).scores)[::-1][100]
    np.testing.assert_array_equal(first.keypoints_px, second.keypoints_px)
    np.testing.assert_array_equal(first.descriptors, second.descriptors)


def test_descriptors_are_eight_bit_and_of_length_512(rng: np.random.Generator) -> None:
    found = extract(texture(rng))
    assert found.descriptors.dtype == np.uint8
    assert found.descriptors.shape[1] == FEATURES["sift"].width
    np.testing.assert_allclose(np.linalg.norm(found.descriptors.astype(float), axis=1), 512, rtol=0.03)


def test_akaze_s_descriptors_are_unit_vectors_and_repeat_exactly(rng: np.random.Generator) -> None:
    image = texture(rng)
    first, second = (extract(image, feature="akaze", max_keypoints=100) for _ in range(2))
    assert first.descriptors.shape == (100, FEATURES["akaze"].width)
    np.testing.assert_allclose(np.linalg.norm(first.descriptors, axis=1), 1.0, rtol=1e-5)
    assert (np.diff(first.scores) <= 0).all()
    np.testing.assert_array_equal(first.descriptors, second.descriptors)
    assert len(extract(np.full((96, 128), 90, np.uint8), feature="akaze")) == 0


def test_colour_is_reduced_to_grey(rng: np.random.Generator) -> None:
    grey = texture(rng)
    np.testing.assert_array_equal(
        extract(np.repeat(grey[:, :, None], 3, axis=2)).keypoints_px, extract(grey).keypoints_px
    )


def test_an_image_without_texture_has_no_keypoints() -> None:
    found = extract(np.full((60, 80), 128, dtype=np.uint8))
    assert len(found) == 0
    assert found.descriptors.shape == (0, 128)


def test_an_unknown_feature_is_named_with_a_suggestion() -> None:
    with pytest.raises(FeatureError, match=r"unknown feature 'sfit'; did you mean 'sift'\?"):
        extract(np.zeros((8, 8), dtype=np.uint8), feature="sfit")


@pytest.mark.parametrize("shape", [(0, 4), (4, 4, 4), (4,)])
def test_an_array_that_is_no_image_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(FeatureError, match="expected uint8"):
        extract(np.zeros(shape, dtype=np.uint8))


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_file_and_the_same_image_in_a_recording_have_the_same_grey(
    tmp_path: Path, rng: np.random.Generator, suffix: str
) -> None:
    path = tmp_path / f"a{suffix}"
    assert cv2.imwrite(str(path), rng.integers(0, 256, (40, 60, 3), dtype=np.uint8))
    stored = cv2.imdecode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(read_grey(path), to_grey(stored[:, :, ::-1]))
    assert cv2.imwrite(str(path), rng.integers(0, 256, (40, 60), dtype=np.uint8))
    np.testing.assert_array_equal(read_grey(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))


def test_a_missing_or_damaged_image_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FeatureError, match=r"nothing\.jpg: no such file"):
        read_grey(tmp_path / "nothing.jpg")
    (tmp_path / "broken.jpg").write_bytes(b"\xff\xd8\xff not an image")
    with pytest.raises(FeatureError, match=r"broken\.jpg: cannot be read as an image"):
        read_grey(tmp_path / "broken.jpg")


def test_colour_files_are_read_as_rgb_and_grey_ones_repeated(tmp_path: Path) -> None:
    red = np.zeros((6, 8, 3), np.uint8)
    red[:, :, 2] = 200
    cv2.imwrite(str(tmp_path / "red.png"), red)
    np.testing.assert_array_equal(read_image(tmp_path / "red.png", colour=True)[0, 0], [200, 0, 0])
    np.testing.assert_array_equal(read_image(tmp_path / "red.png", colour=False), read_grey(tmp_path / "red.png"))
    cv2.imwrite(str(tmp_path / "grey.png"), red[:, :, 2])
    np.testing.assert_array_equal(read_image(tmp_path / "grey.png", colour=True), np.full((6, 8, 3), 200))


def test_rootsift_is_a_name_of_sift_and_lowe_s_sift_has_the_same_keypoints(rng: np.random.Generator) -> None:
    image = texture(rng)
    assert feature_name("rootsift") == "sift"
    root, lowe = extract(image, feature="rootsift"), extract(image, feature="sift_l2")
    np.testing.assert_array_equal(root.keypoints_px, lowe.keypoints_px)
    assert lowe.descriptors.dtype == np.uint8
    np.testing.assert_allclose(np.linalg.norm(lowe.descriptors.astype(float), axis=1), 512, rtol=0.03)
    np.testing.assert_array_equal(root.descriptors, root_sift(lowe.descriptors.astype(np.float32)))


def test_neighbours_that_are_not_alike_enough_are_no_match() -> None:
    first, second = np.eye(4, dtype=np.float32), np.eye(4, dtype=np.float32)
    second[2] = [0.0, 0.6, 0.8, 0.0]
    assert [tuple(p) for p in match_pair(first, second, ratio=1.0)] == [(0, 0), (1, 1), (2, 2), (3, 3)]
    kept = match_pair(first, second, ratio=1.0, min_cosine=0.9)
    assert [tuple(p) for p in kept] == [(0, 0), (1, 1), (3, 3)]


def brute_force_pairs(a: np.ndarray, b: np.ndarray, ratio: float) -> list[tuple[int, int]]:
    distance = ((a[:, None].astype(float) - b[None].astype(float)) ** 2).sum(axis=2)
    pairs = []
    for i in range(len(a)):
        j = int(distance[i].argmin())
        row, column = np.sort(distance[i]), np.sort(distance[:, j])
        if distance[:, j].argmin() == i and row[0] < ratio**2 * row[1] and column[0] < ratio**2 * column[1]:
            pairs.append((i, j))
    return pairs


@pytest.mark.parametrize("ratio", [0.8, 1.0])
def test_pairs_are_mutual_and_pass_the_ratio_in_both_images(rng: np.random.Generator, ratio: float) -> None:
    a = rng.integers(0, 120, size=(60, 128)).astype(np.uint8)
    b = np.clip(a[rng.permutation(60)[:50]] + rng.integers(-40, 40, size=(50, 128)), 0, 255).astype(np.uint8)
    found = [(int(i), int(j)) for i, j in match_pair(a, b, ratio=ratio)]
    assert found == brute_force_pairs(a, b, ratio)
    assert len(found) > 20


def test_a_landmark_does_not_compete_with_itself_but_with_others(rng: np.random.Generator) -> None:
    base = rng.integers(0, 120, size=(3, 128)).astype(np.uint8)
    near = base.copy()
    near[:, 0] += 2
    stored = np.concatenate([base, near, base[2:] + np.uint8(1)])
    groups = np.array([7, 8, 9, 7, 8, 9, 4], dtype=np.int32)
    query, landmark, distance = match_groups(base, stored, groups, ratio=0.8)
    np.testing.assert_array_equal(query, [0, 1, 2])
    np.testing.assert_array_equal(landmark, [7, 8, 9])
    np.testing.assert_array_equal(distance, [0, 0, 0])
    blurred = base + np.uint8(1)
    query, landmark, _ = match_groups(blurred, stored, groups, ratio=0.8)
    assert 9 not in landmark[query == 2], "landmarks 9 and 4 look alike: the third query is ambiguous"


def test_of_several_queries_a_landmark_keeps_the_nearest(rng: np.random.Generator) -> None:
    base = rng.integers(0, 120, size=(2, 128)).astype(np.uint8)
    queries = np.stack([base[0] + np.uint8(3), base[0], base[1]])
    query, landmark, _ = match_groups(queries, base, np.array([0, 1], dtype=np.int32), ratio=0.8)
    np.testing.assert_array_equal(query, [1, 2])
    np.testing.assert_array_equal(landmark, [0, 1])


def test_images_of_the_same_texture_have_similar_global_descriptors(rng: np.random.Generator) -> None:
    images = [texture(rng) for _ in range(3)]
    features = [extract(i).descriptors for i in images]
    shifted = extract(np.roll(images[1], 15, axis=1)).descriptors
    vocabulary = train_vocabulary(np.concatenate(features), seed=0, size=16)
    similarity = [float(global_descriptor(vocabulary, f) @ global_descriptor(vocabulary, shifted)) for f in features]
    assert int(np.argmax(similarity)) == 1
    assert similarity[1] > max(similarity[0], similarity[2]) + 0.3
    np.testing.assert_allclose(np.linalg.norm(global_descriptor(vocabulary, shifted)), 1.0, atol=1e-6)


def test_the_vocabulary_follows_from_the_seed(rng: np.random.Generator) -> None:
    descriptors = rng.integers(0, 255, size=(500, 128)).astype(np.uint8)
    first, again = (train_vocabulary(descriptors, seed=1, size=8).centres for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert (first != train_vocabulary(descriptors, seed=2, size=8).centres).any()
