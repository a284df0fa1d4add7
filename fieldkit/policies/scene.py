"""What a policy may know: candidates at the prior, the landmarks each would see, and how mapping saw those."""

from __future__ import annotations

import dataclasses

from fieldkit.protocol import CandidateRules
from fieldkit.surface import RayCaster
from fieldkit.types import Candidates, LandmarkStatistics, SceneMap
from fieldkit.views import HeatMaps, Visibility, visibility


@dataclasses.dataclass(frozen=True)
class Scene:
    """The input of every policy: v candidates, their visible landmarks, and how mapping saw all n landmarks.

    ``filtered`` tells whether landmarks behind the surface were left out.
    """

    candidates: Candidates
    visible: Visibility
    statistics: LandmarkStatistics
    heat_maps: HeatMaps
    filtered: bool


def look_at(
    scene_map: SceneMap,
    statistics: LandmarkStatistics,
    candidates: Candidates,
    *,
    rules: CandidateRules,
    rays: RayCaster | None = None,
    tolerance_m: float = 0.0,
    heat_maps: HeatMaps | None = None,
) -> Scene:
    """Make a policy's input from a map; with ``rays`` the landmarks behind the surface are dropped.

    ``heat_maps`` of the map, where they were made already, spare making them again.
    """
    seen = visibility(scene_map, candidates, rules=rules, rays=rays, tolerance_m=tolerance_m)
    return Scene(candidates, seen, statistics, heat_maps or HeatMaps(scene_map), rays is not None)
