"""Checks with what a lab has: a tape measure between tags, and an arm that sweeps its camera over them."""

from fieldkit.checks.arm import CONTRADICTION_HINT, ArmCheck, Finding, Refined, check_arm, refine_arm
from fieldkit.checks.distances import (
    TAPE_SIGMA_M,
    DistanceCheck,
    ScaleCheck,
    TagName,
    Tape,
    check_distances,
    parse_tag,
)
from fieldkit.checks.parameters import require_positive
from fieldkit.checks.sweeps import Sweep, find_sweep

__all__ = [
    "CONTRADICTION_HINT",
    "TAPE_SIGMA_M",
    "ArmCheck",
    "DistanceCheck",
    "Finding",
    "Refined",
    "ScaleCheck",
    "Sweep",
    "TagName",
    "Tape",
    "check_arm",
    "check_distances",
    "find_sweep",
    "parse_tag",
    "refine_arm",
    "require_positive",
]
