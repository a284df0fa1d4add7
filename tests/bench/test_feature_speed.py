"""Milliseconds of every feature for one image of 640x480, and of LightGlue for one pair.

python -m pytest tests/bench/test_feature_speed.py --benchmark-enable --benchmark-only
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from fieldkit.errors import WeightsError
from fieldkit.features import FEATURES, Extractor, open_extractor, read_image
from fieldkit.features.appearance import APPEARANCES, open_appearance
from fieldkit.features.lightglue import LightGlue

SIZE = (640, 480)


def photo() -> np.ndarray:
    image = read_image(Path(__file__).parents[2] / "docs" / "room.jpg", colour=True)[:720]
    return np.asarray(cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA))


def opened(feature: str, max_keypoints: int) -> Extractor:
    try:
        return open_extractor(feature, max_keypoints=max_keypoints)
    except WeightsError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("max_keypoints", [1024, 2048])
@pytest.mark.parametrize("feature", list(FEATURES))
def test_extraction(benchmark: BenchmarkFixture, feature: str, max_keypoints: int) -> None:
    extractor = opened(feature, max_keypoints)
    found = benchmark.pedantic(extractor.extract, args=(photo(),), rounds=5, warmup_rounds=1)
    benchmark.extra_info["keypoints"] = len(found)


def test_lightglue(benchmark: BenchmarkFixture) -> None:
    extractor, network = opened("aliked", 1024), LightGlue("aliked")
    first, second = extractor.extract(photo()), extractor.extract(np.roll(photo(), 20, axis=1))
    benchmark.pedantic(network.match, args=(first, SIZE, second, SIZE), rounds=3, warmup_rounds=1)


@pytest.mark.parametrize("name", list(APPEARANCES))
def test_appearance(benchmark: BenchmarkFixture, name: str) -> None:
    try:
        appearance = open_appearance(name)
    except WeightsError as error:
        pytest.skip(str(error))
    benchmark.pedantic(appearance.whole, args=(photo(),), rounds=5, warmup_rounds=1)
