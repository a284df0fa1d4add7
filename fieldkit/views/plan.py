"""A map as it is drawn from above."""

from __future__ import annotations

import numpy as np

from fieldkit.types import PlanView, SceneMap

PLAN_LANDMARKS = 6000


def plan_view(scene_map: SceneMap, *, seed: int) -> PlanView:
    """Thin a map to what is drawn from above: up to 6000 landmarks, chosen by the seed, and all mapping cameras."""
    rng = np.random.default_rng(seed)
    keep = np.sort(rng.permutation(len(scene_map.xyz))[:PLAN_LANDMARKS])
    cameras = np.array([p.translation for p in scene_map.map_from_image], dtype=np.float32).reshape(-1, 3)
    return PlanView(scene_map.xyz[keep].astype(np.float32), cameras)
