"""The order of a walk: by the numbers in the names of its frames, wherever it is asked for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fieldkit.cameras import Camera
from fieldkit.features import Features
from fieldkit.frames import Pose
from fieldkit.maps.options import SlamRules
from fieldkit.maps.sources.order import walk_order
from fieldkit.maps.sources.source import SourceImage
from fieldkit.maps.structure.plausible import plausible_matches
from fieldkit.maps.structure.strays import strays

CAMERA = Camera("PINHOLE", 320, 240, (240.0, 240.0, 160.0, 120.0))
LEVEL = Rotation.from_euler("x", -90, degrees=True)


def at(x: float) -> Pose:
    return Pose.from_components([x, 0.0, 1.5], LEVEL)


def walk(names: list[str]) -> list[SourceImage]:
    """Return images a metre apart, in the order of ``names``."""
    return [SourceImage(f"{n}.jpg", Path(), CAMERA, "", n, at(float(k))) for k, n in enumerate(names)]


def features(*places_px: tuple[float, float]) -> Features:
    ones, descriptors = np.ones(len(places_px), np.float32), np.zeros((len(places_px), 128), np.uint8)
    return Features(np.array(places_px, np.float32).reshape(-1, 2), ones, ones, descriptors)


def ordered(*names: str) -> list[str]:
    images = walk(list(names))
    return [images[i].frame for i in walk_order(images, range(len(images)))]


def test_numbers_count_by_their_value_and_names_of_equal_length_as_text() -> None:
    assert ordered("frame10", "frame9", "frame100", "frame1") == ["frame1", "frame9", "frame10", "frame100"]
    assert ordered("b2", "a10", "a9", "7") == ["7", "a9", "a10", "b2"]
    assert ordered("1_10", "10_1", "0010", "0009") == sorted(["1_10", "10_1", "0010", "0009"])
    assert ordered("f01", "f1") == ordered("f1", "f01")


def test_a_misplaced_image_is_held_against_those_before_and_after_it() -> None:
    images = walk([f"frame{k}" for k in range(11)])
    mapped = {k: at(1.5 if k == 10 else float(k)) for k in range(11)}
    assert strays(images, mapped, threshold_m=0.05) == [10]


def test_drift_grows_with_the_way_between_frames_not_between_their_names() -> None:
    images = walk([f"frame{k}" for k in range(11)])
    # A point 2 m ahead of frame9, and one 15 deg above where frame10 would see it: too much for the drift of a metre.
    seen = [*[features()] * 9, features((160.0, 120.0)), features((40.0, 184.0))]
    rules = SlamRules(position_m=0.01, drift_per_m=0.1)
    found = plausible_matches(images, seen, [(9, 10)], [np.zeros((1, 2), np.uint32)], rules=rules)
    assert len(found[0]) == 0
