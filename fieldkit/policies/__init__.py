"""Policies rank candidate views from the map and the candidate poses: no image, no estimate, no truth reaches them."""

from fieldkit.policies.scene import Scene, look_at
from fieldkit.policies.table import NOT_RANKED, POLICIES, Array, Policy, available, utility

__all__ = ["NOT_RANKED", "POLICIES", "Array", "Policy", "Scene", "available", "look_at", "utility"]
