"""Policies rank candidate views from the map and the candidate poses: no image, no estimate, no truth reaches them."""

from fieldkit.policies.table import POLICIES, Policy, available, utility
from fieldkit.policies.scene import Scene, look_at

__all__ = ["POLICIES", "Policy", "Scene", "available", "look_at", "utility"]
