"""Policies rank candidate views from the map and the candidate poses: no image, no estimate, no truth reaches them."""

from fieldkit.policies.learned import Learned, find_checkpoints, open_learned
from fieldkit.policies.looking import Looker, check_map, unfiltered, warn_excluded, warn_known
from fieldkit.policies.scene import Scene, look_at
from fieldkit.policies.table import NOT_RANKED, POLICIES, Array, Policy, available, utility

__all__ = [
    "NOT_RANKED",
    "POLICIES",
    "Array",
    "Learned",
    "Looker",
    "Policy",
    "Scene",
    "available",
    "check_map",
    "find_checkpoints",
    "look_at",
    "open_learned",
    "unfiltered",
    "utility",
    "warn_excluded",
    "warn_known",
]
