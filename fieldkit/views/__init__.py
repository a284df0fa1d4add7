"""Candidate views at the prior, and what each of them would see: map and geometry only, never an image."""

from fieldkit.views.candidates import forward_directions, recorded_candidates
from fieldkit.views.features import (
    ANGLE_SLACK_RAD,
    HISTOGRAM_WIDTH,
    TOKEN_WIDTH,
    SeenLandmarks,
    landmark_tokens,
    seen_in_shard,
    seen_landmarks,
    thinned,
    view_histograms,
)
from fieldkit.views.plan import PLAN_LANDMARKS, plan_view
from fieldkit.views.statistics import HEAT_CELLS, HeatMaps, landmark_statistics
from fieldkit.views.visible import Visibility, visibility

__all__ = [
    "ANGLE_SLACK_RAD",
    "HEAT_CELLS",
    "HISTOGRAM_WIDTH",
    "PLAN_LANDMARKS",
    "TOKEN_WIDTH",
    "HeatMaps",
    "SeenLandmarks",
    "Visibility",
    "forward_directions",
    "landmark_statistics",
    "landmark_tokens",
    "plan_view",
    "recorded_candidates",
    "seen_in_shard",
    "seen_landmarks",
    "thinned",
    "view_histograms",
    "visibility",
]
