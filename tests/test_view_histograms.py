"""The histograms of a view, block by block: in which bin a landmark counts, worked out by hand."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from fieldkit.cameras import Camera
from fieldkit.types import LandmarkStatistics
from fieldkit.views import SeenLandmarks, view_histograms

CAMERA = Camera("PINHOLE", 640, 480, (552.03, 552.03, 320.0, 240.0))
# Where each block begins in the 146 numbers, and how many bins it has
BLOCKS = {
    "smallest distance": (2, 10),
    "largest distance": (12, 10),
    "smallest angle": (22, 10),
    "largest angle": (32, 10),
    "octaves": (42, 10),
    "off mean": (52, 10),
    "cell": (62, 64),
    "u": (126, 10),
    "v": (136, 10),
}


@dataclasses.dataclass(frozen=True)
class Landmark:
    """One landmark: how mapping saw it, and how a view sees it, its place as shares of the image."""

    distances_m: tuple[float, float]
    angles_deg: tuple[float, float]
    distance_m: float
    off_mean_deg: float
    place: tuple[float, float]
    spread_deg: float = 0.0


def counted(landmark: Landmark) -> NDArray[np.int64]:
    """Return int64[146]: the counts in the histograms of a view that sees this landmark only."""
    nearest, farthest = landmark.distances_m
    least, most = np.radians(landmark.angles_deg)
    known = LandmarkStatistics(
        min_distance_m=np.array([nearest]),
        max_distance_m=np.array([farthest]),
        min_angle_rad=np.array([least]),
        max_angle_rad=np.array([most]),
        mean_direction=np.array([[1.0, 0.0, 0.0]]),
        spread_rad=np.radians([landmark.spread_deg]),
        n_observations=np.array([2], dtype=np.int32),
    )
    seen = SeenLandmarks(
        landmark=np.array([0], dtype=np.int32),
        uv_px=np.array([landmark.place], dtype=np.float32) * np.array([CAMERA.width, CAMERA.height], dtype=np.float32),
        distance_m=np.array([landmark.distance_m], dtype=np.float32),
        angle_rad=np.array([0.2], dtype=np.float32),
        off_mean_rad=np.radians([landmark.off_mean_deg]).astype(np.float32),
        visible=1,
    )
    scaled = view_histograms(seen, known, camera=CAMERA).astype(np.float64)
    return np.asarray(np.rint(np.expm1(scaled * np.log(4097))), dtype=np.int64)


# Bins of half a metre, of 6 deg, of 0.4 octaves from -2, of 9 deg, eighths and tenths of the image
FAR = Landmark((1.2, 4.3), (10.0, 40.0), 4.5, 50.0, (0.65, 0.22))  # 4.5 / sqrt(1.2 * 4.3) = 2 ** 0.99
NEAR = Landmark((2.0, 4.0), (20.0, 28.0), 1.0, 65.0, (0.31, 0.83))  # 1 / sqrt(2 * 4) = 2 ** -1.5
BEYOND = Landmark((7.0, 9.0), (70.0, 80.0), 0.5, 150.0, (1.0, 1.0))  # 0.5 / sqrt(7 * 9) = 2 ** -3.99


@pytest.mark.parametrize(
    ("landmark", "expected"),
    [
        pytest.param(FAR, (2, 8, 1, 6, 7, 5, 8 + 5, 6, 2), id="farther than mapping"),
        pytest.param(NEAR, (4, 8, 3, 4, 1, 7, 6 * 8 + 2, 3, 8), id="nearer than mapping"),
        pytest.param(BEYOND, (9, 9, 9, 9, 0, 9, 63, 9, 9), id="beyond all bins"),
    ],
)
def test_a_landmark_counts_in_one_bin_of_every_block(landmark: Landmark, expected: tuple[int, ...]) -> None:
    numbers = counted(landmark)
    found = {name: np.flatnonzero(numbers[start : start + width]).tolist() for name, (start, width) in BLOCKS.items()}
    assert found == {name: [number] for name, number in zip(BLOCKS, expected, strict=True)}
    assert numbers[0] == 1
    assert numbers[2:].sum() == 9


def test_a_landmark_counts_as_seen_from_a_known_direction_inside_the_mapped_range() -> None:
    assert counted(dataclasses.replace(FAR, spread_deg=50.1))[1] == 1
    assert counted(dataclasses.replace(FAR, spread_deg=49.9))[1] == 0
