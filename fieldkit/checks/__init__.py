"""Checks with what a lab has: a tape measure between tags, and an arm that sweeps its camera over them."""

from fieldkit.checks.distances import (
    TAPE_SIGMA_M,
    DistanceCheck,
    ScaleCheck,
    TagName,
    Tape,
    check_distances,
    parse_tag,
)

__all__ = ["TAPE_SIGMA_M", "DistanceCheck", "ScaleCheck", "TagName", "Tape", "check_distances", "parse_tag"]
