"""Every policy's utilities of candidates in one map."""

from __future__ import annotations

from fieldkit.errors import PolicyError
from fieldkit.features import feature_name
from fieldkit.policies.scene import Scene, look_at
from fieldkit.policies.table import NOT_RANKED, POLICIES, Array, available, utility
from fieldkit.protocol import Protocol
from fieldkit.surface import RayCaster
from fieldkit.types import Candidates, Excluded, SceneMap
from fieldkit.views import landmark_statistics


def check_map(scene_map: SceneMap, protocol: Protocol) -> None:
    """Raise PolicyError when a map cannot serve a protocol: another feature, or no surface for any of its rows."""
    if scene_map.feature != feature_name(protocol.feature):
        raise PolicyError(
            f"{scene_map.path}: made with feature {scene_map.feature!r}; the protocol {protocol.name} expects "
            f"{protocol.feature!r}",
            hint=f"build the map with --feature {protocol.feature}, or change the protocol",
        )
    if unfiltered(scene_map, protocol) is not None and False not in protocol.occlusion.use:
        raise PolicyError(
            f"{scene_map.path}: has no surface; expected surface.ply, since the protocol {protocol.name} asks for the "
            "occlusion filter alone",
            hint="build the map with depth images, or set occlusion.use = [false] in the protocol",
        )


def unfiltered(scene_map: SceneMap, protocol: Protocol) -> Excluded | None:
    """Say why a map cannot serve a protocol's rows with the occlusion filter; None where it can, or has not to."""
    counting = [p for p in protocol.policies if p in POLICIES and POLICIES[p].counts_landmarks]
    if not counting or True not in protocol.occlusion.use or scene_map.surface is not None:
        return None
    return Excluded(
        f"{', '.join(counting)} with occlusion",
        f"{scene_map.path} has no surface: nothing tells which landmarks are hidden; build the map with depth images",
    )


class Looker:
    """Compute every policy's utilities of candidates; landmark statistics and rays are made once per map."""

    def __init__(self, scene_map: SceneMap, protocol: Protocol) -> None:
        self._map = scene_map
        self._protocol = protocol
        self._statistics = landmark_statistics(scene_map)
        self._rays = None if scene_map.surface is None else RayCaster(scene_map.surface)
        self._uses = tuple(use for use in protocol.occlusion.use if not use or self._rays is not None)

    def utilities(self, candidates: Candidates) -> dict[tuple[str, bool | None], Array]:
        """Return utilities f64[v] per policy and occlusion (None where the policy counts no landmarks).

        Without a surface there are none with the occlusion filter.
        """
        scenes = {use: self._scene(candidates, occlusion=use) for use in {False, *self._uses}}
        result: dict[tuple[str, bool | None], Array] = {}
        for name in self._protocol.policies:
            if name in NOT_RANKED:
                continue
            policy = available(name)
            if policy.counts_landmarks:
                for use in self._uses:
                    result[name, use] = utility(policy, scenes[use])
            else:
                result[name, None] = utility(policy, scenes[False])
        return result

    def _scene(self, candidates: Candidates, *, occlusion: bool) -> Scene:
        voxel_m = self._map.surface.voxel_m if self._map.surface is not None else 0.0
        return look_at(
            self._map,
            self._statistics,
            candidates,
            rules=self._protocol.candidates,
            rays=self._rays if occlusion else None,
            tolerance_m=self._protocol.occlusion.tolerance_voxels * voxel_m,
        )
