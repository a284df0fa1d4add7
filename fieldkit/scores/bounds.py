"""Thresholds, and errors against them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import ScoreError, suggestion
from fieldkit.protocol import Threshold
from fieldkit.types import Trial

Array = NDArray[np.float64]
PoseName = Literal["cam", "body"]


def _thresholds(*pairs: tuple[float, float]) -> tuple[Threshold, ...]:
    return tuple(Threshold(position_m, rotation_deg) for position_m, rotation_deg in pairs)


# Thresholds (m, deg) that others report, for comparison with their tables; all are taken as strict.
PRESETS: dict[str, tuple[Threshold, ...]] = {
    "visuallocalization": _thresholds((0.25, 2.0), (0.5, 5.0), (5.0, 10.0)),
    "actloc": _thresholds((0.05, 0.4), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0)),
    "lamar": _thresholds((0.1, 1.0), (1.0, 5.0)),
    "paper_real": _thresholds((0.25, 2.0), (0.5, 3.5), (1.0, 5.0)),
    "paper_sim": _thresholds((0.025, 1.0), (0.05, 1.0), (0.075, 1.0), (0.1, 1.0), (0.25, 2.0), (1.0, 5.0)),
}


def preset(name: str) -> tuple[Threshold, ...]:
    """Return the thresholds of a preset; raises ScoreError for an unknown name."""
    if name not in PRESETS:
        raise ScoreError(f"unknown preset {name!r}", hint=suggestion(name, list(PRESETS)))
    return PRESETS[name]


def tightest(thresholds: Sequence[Threshold]) -> Threshold:
    """Return the threshold with the smallest position bound, and among those the smallest rotation bound."""
    return min(thresholds, key=lambda t: (t.position_m, t.rotation_deg))


def excess(error: tuple[float, float], threshold: Threshold) -> float:
    """Return the larger of both errors (m, rad) in units of the threshold; below 1 is inside."""
    return max(error[0] / threshold.position_m, math.degrees(error[1]) / threshold.rotation_deg)


def inside(error: tuple[float, float], threshold: Threshold) -> bool:
    """Tell whether an error (m, rad) is strictly below both bounds of a threshold."""
    return error[0] < threshold.position_m and math.degrees(error[1]) < threshold.rotation_deg


def error_of(trial: Trial, *, pose: PoseName) -> tuple[float, float]:
    """Return a trial's error (m, rad) of the camera or of the body."""
    return trial.cam_error if pose == "cam" else trial.body_error
