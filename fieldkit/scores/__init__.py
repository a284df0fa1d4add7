"""What every policy is worth: trials, recall with intervals, medians, bounds.

A policy's choice at a visit is a distribution over views: tied views share the weight, so the outcome of
`random` is its exact expectation. A failed estimate has infinite errors and stays in the denominator.

Best possible has one row per allowed candidate. For curves and medians its weight lies on the view that
minimises ``max(e_position / t_position, e_rotation / t_rotation)`` at the protocol's tightest threshold, for the
pose (camera or body) that the protocol scores. For recall a visit counts as a hit when any of its rows is inside
both thresholds.
"""

from fieldkit.scores.bounds import PRESETS, PoseName, error_of, excess, inside, preset, tightest
from fieldkit.scores.comparing import Comparison, Variant, compare, holm, learned_pairs, verdict
from fieldkit.scores.summary import (
    Summary,
    cumulative,
    group,
    hits,
    recall,
    summarize,
    summarize_run,
    weighted_median,
    wilson,
)
from fieldkit.scores.tables import Table, check_expect, format_number, in_sample, score_dict, table
from fieldkit.scores.trials import NO_CANDIDATE, ODOMETRY, make_trials
from fieldkit.trust import BEST_POSSIBLE

__all__ = [
    "BEST_POSSIBLE",
    "NO_CANDIDATE",
    "ODOMETRY",
    "PRESETS",
    "Comparison",
    "PoseName",
    "Summary",
    "Table",
    "Variant",
    "check_expect",
    "compare",
    "cumulative",
    "error_of",
    "excess",
    "format_number",
    "group",
    "hits",
    "holm",
    "in_sample",
    "inside",
    "learned_pairs",
    "make_trials",
    "preset",
    "recall",
    "score_dict",
    "summarize",
    "summarize_run",
    "table",
    "tightest",
    "verdict",
    "weighted_median",
    "wilson",
]
