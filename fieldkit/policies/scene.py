"""What a policy may know: candidates at the prior, the landmarks each would see, and how mapping saw those."""

from __future__ import annotations

import dataclasses

from fieldkit.protocol import CandidateRules
from fieldkit.surface import RayCaster
from fieldkit.types import Candidates, LandmarkStatistics, SceneMap
from fieldkit.views import Visibility, visibility


@dataclasses.dataclass(frozen=True)
class Scene:
    """The input of every policy: v candidates, their visible landmarks, and the statistics of all n landmarks."""

    candidates: Candidates
    visible: Visibility
    statistics: LandmarkStatistics


def look_at(
    scene_map: SceneMap,
    statistics: LandmarkStatistics,
    candidates: Candidates,
    *,
    rules: CandidateRules,
    rays: RayCaster | None = None,
    tolerance_m: float = 0.0,
) -> Scene:
    """Make a policy's input from a map; with ``rays`` the landmarks behind the surface are dropped."""
    seen = visibility(scene_map, candidates, rules=rules, rays=rays, tolerance_m=tolerance_m)
    return Scene(candidates, seen, statistics)
