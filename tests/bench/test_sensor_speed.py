"""How fast the sensors are: `make bench`. Nothing here passes or fails by time."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from sim_bridge import robot
from sim_bridge.sensors import STANDARD, Motion, encode, expose, sense_depth


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    noise = np.random.default_rng(0).integers(0, 255, (480, 640, 3)).astype(np.uint8)
    return np.asarray(cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 3), noise, 20, 235, cv2.NORM_MINMAX))


@pytest.mark.parametrize("blur_px", [0, 1, 5, 20])
def test_expose_and_encode(benchmark: Any, picture: np.ndarray, blur_px: int) -> None:
    sensor, rng = STANDARD.hand, np.random.default_rng(1)
    # The longest exposure; a brighter picture is exposed more shortly and blurs less.
    assert sensor.exposure is not None
    turning = blur_px / (robot.ARM_CAMERA.focal_px[0] * sensor.exposure.longest_s)
    motion = Motion(np.array([0.0, turning, 0.0]), np.zeros(3))

    def shoot() -> bytes:
        return encode(expose(picture, sensor, camera=robot.ARM_CAMERA, motion=motion, rng=rng), sensor)

    benchmark.pedantic(shoot, rounds=10, warmup_rounds=1)


def test_sense_depth(benchmark: Any) -> None:
    depth, rng = np.full((480, 640), 2.0, np.float32), np.random.default_rng(1)

    def sense() -> np.ndarray:
        return sense_depth(depth, STANDARD.hand_depth, camera=robot.ARM_CAMERA, rng=rng)

    benchmark.pedantic(sense, rounds=10, warmup_rounds=1)
