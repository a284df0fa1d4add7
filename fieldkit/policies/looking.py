"""Every policy's utilities of candidates in one map."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence

import numpy as np

from fieldkit.errors import PolicyError
from fieldkit.features import feature_name
from fieldkit.learned.checkpoint import Checkpoint, visibility_of
from fieldkit.policies.learned import Learned, open_learned, without_appearance
from fieldkit.policies.scene import Scene, look_at
from fieldkit.policies.table import NOT_RANKED, POLICIES, Array, Policy, available, utility
from fieldkit.protocol import LEARNED, Protocol
from fieldkit.surface import RayCaster
from fieldkit.types import Candidates, Excluded, Reason, SceneMap
from fieldkit.views import HeatMaps, landmark_statistics

log = logging.getLogger(__name__)
Variant = tuple[str, bool | None]


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


def warn_excluded(rows: Sequence[Excluded]) -> None:
    """Log which rows are left out: those that share a reason in one line."""
    for reason in dict.fromkeys(row.reason for row in rows):
        log.warning("excluded %s: %s", ", ".join(row.what for row in rows if row.reason == reason), reason)


def warn_known(checkpoints: Mapping[str, Checkpoint], scenes: Sequence[str]) -> None:
    """Log which learned policies are replayed in scenes that they were trained or validated on, by name."""
    for name, checkpoint in checkpoints.items():
        about = checkpoint.about
        for use, own in (("trained", about.training_scenes), ("validated", about.validation_scenes)):
            known = [scene for scene in scenes if scene in own]
            if known:
                log.warning("%s was %s on %s: its rows there are no test", name, use, ", ".join(known))


def _warn_visibility(learned: Mapping[str, Learned], protocol: Protocol) -> None:
    """Log where a protocol counts other landmarks as seen than a network learned from."""
    here = visibility_of(protocol.candidates, tolerance_voxels=protocol.occlusion.tolerance_voxels)
    for name, policy in learned.items():
        for what, value in policy.about.visibility.items():
            if here.get(what, value) != value:
                log.warning(
                    "%s was trained with %s = %g, the protocol %s has %g: scores may be less sure here",
                    *(name, what, value, protocol.name, here[what]),
                )


class Looker:
    """Compute every policy's utilities of candidates; landmark statistics, rays and networks are made once per map.

    ``checkpoints`` are those of the protocol's learned policies. ``excluded`` are those whose checkpoint is there and
    that this map cannot serve. Raises WeightsError where weights do not fit their network.
    """

    def __init__(
        self, scene_map: SceneMap, protocol: Protocol, *, checkpoints: Mapping[str, Checkpoint] | None = None
    ) -> None:
        self._map = scene_map
        self._protocol = protocol
        self._statistics = landmark_statistics(scene_map)
        self._heat_maps = HeatMaps(scene_map)
        self._rays = None if scene_map.surface is None else RayCaster(scene_map.surface)
        self._uses = tuple(use for use in protocol.occlusion.use if not use or self._rays is not None)
        given = checkpoints or {}
        lacking = {name: without_appearance(scene_map, c) for name, c in given.items()}
        self.excluded = tuple(e for e in lacking.values() if e is not None)
        self._learned = {name: open_learned(c, scene_map) for name, c in given.items() if lacking[name] is None}
        _warn_visibility(self._learned, protocol)

    @property
    def weights(self) -> dict[str, str]:
        """The digests of the checkpoints of the learned policies that score here."""
        return {name: policy.scorer.checkpoint.digest for name, policy in self._learned.items()}

    @property
    def trained_on(self) -> dict[str, tuple[str, ...]]:
        """The scenes that the learned policies which score here were trained or validated on."""
        return {name: policy.about.scenes for name, policy in self._learned.items()}

    def utilities(self, candidates: Candidates) -> dict[Variant, Array]:
        """Return utilities f64[v] per policy and occlusion (None where the policy counts no landmarks).

        Without a surface there are none with the occlusion filter, and none of learned policies without a checkpoint.
        """
        scenes = self._scenes(candidates)
        result: dict[Variant, Array] = {}
        for name in self._protocol.policies:
            if name in NOT_RANKED or (name in LEARNED and name not in self._learned):
                continue
            policy = Policy(self._learned[name], counts_landmarks=True) if name in LEARNED else available(name)
            if policy.counts_landmarks:
                for use in self._uses:
                    result[name, use] = utility(policy, scenes[use])
            else:
                result[name, None] = utility(policy, scenes[False])
        return result

    def reasons(self, candidates: Candidates, utilities: Mapping[Variant, Array]) -> dict[Variant, Reason]:
        """Return for each learned policy the landmarks that made the score of the view it prefers, the first if tied.

        A policy that may choose none of the views has no reason.
        """
        chosen = {v: int(np.argmax(u)) for v, u in utilities.items() if v[0] in self._learned and u.max() > -np.inf}
        scenes = self._scenes(candidates) if chosen else {}
        result = {}
        for (name, use), view in chosen.items():
            landmarks, raised = self._learned[name].raised(scenes[bool(use)], view)
            xyz = self._map.xyz[landmarks].astype(np.float32)
            result[name, use] = Reason(candidates.view_ids[view], xyz, raised)
        return result

    def _scenes(self, candidates: Candidates) -> dict[bool, Scene]:
        return {use: self._scene(candidates, occlusion=use) for use in {False, *self._uses}}

    def _scene(self, candidates: Candidates, *, occlusion: bool) -> Scene:
        voxel_m = self._map.surface.voxel_m if self._map.surface is not None else 0.0
        return look_at(
            self._map,
            self._statistics,
            candidates,
            rules=self._protocol.candidates,
            rays=self._rays if occlusion else None,
            tolerance_m=self._protocol.occlusion.tolerance_voxels * voxel_m,
            heat_maps=self._heat_maps,
        )
