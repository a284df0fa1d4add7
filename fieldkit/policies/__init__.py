"""Policies rank candidate views from the map and the candidate poses: no image, no estimate, no truth reaches them."""

from fieldkit.policies.looking import Looker, check_map, unfiltered
from fieldkit.policies.scene import Scene, look_at
from fieldkit.policies.table import NOT_RANKED, POLICIES, Array, Policy, available, utility

__all__ = [
    "NOT_RANKED",
    "POLICIES",
    "Array",
    "Looker",
    "Policy",
    "Scene",
    "available",
    "check_map",
    "look_at",
    "unfiltered",
    "utility",
]
