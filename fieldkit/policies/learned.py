"""Learned policies: the probability that a view localizes, by a network trained on other buildings."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import PolicyError, WeightsError
from fieldkit.learned.checkpoint import About, Checkpoint, read_checkpoint
from fieldkit.learned.scoring import Scorer
from fieldkit.policies.scene import Scene
from fieldkit.protocol import LEARNED
from fieldkit.types import Excluded, SceneMap
from fieldkit.views import SeenLandmarks, landmark_tokens, seen_landmarks, thinned, view_histograms

log = logging.getLogger(__name__)
Array = NDArray[np.float64]
Floats = NDArray[np.float32]
SUFFIX = ".safetensors"
# As many landmarks of a view are left out one by one to see what its score rests on.
_ASKED = 512
_GIVE = "train it with `fieldkit train`, and name the file with --policy-weights"


def shipped_weights() -> Path:
    """Return the folder of the weights that come with fieldkit."""
    return Path(__file__).parent / "weights"


def shipped(name: str) -> Checkpoint:
    """Read the shipped weights of a learned policy; raises PolicyError when there are none."""
    refuse_unshipped(name)
    return _checkpoint(shipped_weights() / f"{name}{SUFFIX}", name)


def refuse_unshipped(name: str) -> None:
    """Raise PolicyError when a learned policy has no shipped weights."""
    if not _is_shipped(name):
        raise PolicyError(f"policy {name!r} has no weights in this version", hint=_GIVE)


def _is_shipped(name: str) -> bool:
    return (shipped_weights() / f"{name}{SUFFIX}").is_file()


def find_checkpoints(
    names: Sequence[str], *, given: Sequence[Path] = ()
) -> tuple[dict[str, Checkpoint], tuple[Excluded, ...]]:
    """Return the checkpoints of those policies among ``names`` that are learned, and which of them have none.

    ``given`` are checkpoints of any name or folders of them; each says itself which policy it is of, and goes before
    what is shipped. Raises WeightsError when one is missing or damaged, two are of one policy, or none is of ``names``.
    """
    own = _given([Path(path) for path in given])
    wanted = [name for name in names if name in LEARNED]
    if given and not any(name in own for name in wanted):
        named = ", ".join(str(path) for path in given)
        raise WeightsError(
            f"{named}: has weights of {', '.join(own)}; expected those of one that the protocol names: "
            f"{', '.join(wanted) or 'it has no learned policy'}",
            hint="check --policy-weights and the protocol's policies",
        )
    found: dict[str, Checkpoint] = {}
    missing: list[Excluded] = []
    for name in wanted:
        if name in own:
            found[name] = own[name]
        elif _is_shipped(name):
            found[name] = shipped(name)
        else:
            missing.append(Excluded(name, f"has no weights in this version; {_GIVE}"))
    return found, tuple(missing)


def _given(paths: Sequence[Path]) -> dict[str, Checkpoint]:
    """Return the checkpoints of files and folders by policy."""
    result: dict[str, Checkpoint] = {}
    for file in (file for path in paths for file in _files(path)):
        checkpoint = read_checkpoint(file)
        kind = checkpoint.about.kind
        if kind in result:
            raise WeightsError(
                f"{file}: is of the policy {kind}, as {result[kind].path} is; expected one",
                hint="name the file that is meant",
            )
        result[kind] = checkpoint
    return result


def _files(path: Path) -> list[Path]:
    if not path.exists():
        raise WeightsError(f"{path}: no such file; expected a checkpoint or a folder of them", hint="check the path")
    files = sorted(path.glob(f"*{SUFFIX}")) if path.is_dir() else [path]
    if not files:
        raise WeightsError(f"{path}: holds no *{SUFFIX}; expected checkpoints", hint="check the path")
    return files


def _checkpoint(path: Path, name: str) -> Checkpoint:
    checkpoint = read_checkpoint(path)
    if checkpoint.about.kind != name:
        raise WeightsError(f"{path}: is of the policy {checkpoint.about.kind}; expected {name}", hint="install again")
    return checkpoint


def without_appearance(scene_map: SceneMap, checkpoint: Checkpoint) -> Excluded | None:
    """Say why a map cannot serve a checkpoint: it lacks the appearance of its landmarks; None where it can."""
    network = checkpoint.about.appearance
    if network is None or network in scene_map.appearance:
        return None
    return Excluded(
        checkpoint.about.kind,
        f"{scene_map.path} lacks the appearance {network} of its landmarks; add it: "
        f"`fieldkit map appearance {scene_map.path} --source IMAGES --network {network}`",
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Learned:
    """A learned policy with its weights in a map: the probability that a view localizes.

    ``appearance`` f32[n, 3] of the map's landmarks, reduced, where the policy uses it.
    """

    scorer: Scorer
    appearance: Floats | None = None

    @property
    def about(self) -> About:
        """What the weights were trained on, and how they score."""
        return self.scorer.checkpoint.about

    def __call__(self, scene: Scene) -> Array:
        """Return the score of each view, f64[v] in 0..1, -inf where not allowed."""
        allowed = np.flatnonzero(scene.candidates.allowed)
        seen = self._seen(scene)
        result = np.full(len(seen), -np.inf)
        features = [self._features(scene, seen[i]) for i in allowed]
        result[allowed] = self.scorer.scores(
            features, visible=[seen[i].visible for i in allowed], filtered=scene.filtered
        )
        return result

    def raised(self, scene: Scene, view: int) -> tuple[NDArray[np.int32], Floats]:
        """Return landmarks int32[k] of a view, and how much each raised its score, f32[k].

        That is the view's log-odds to localize, minus those if just this landmark were not seen: negative for one
        that lowered the score. Where a view sees more landmarks than are scored, the next one takes its place. Of a
        view with more than 512 landmarks to score, 512 are asked for.
        """
        whole = seen_landmarks(scene.visible, scene.candidates, statistics=scene.statistics)[view]
        seen = self._thinned(whole)
        asked = np.flatnonzero(np.isin(seen.landmark, thinned(seen, cap=_ASKED).landmark))
        everything = self._features(scene, seen)
        if self.about.kind == "mlp":
            without = [self._features(scene, seen.without(int(i))) for i in asked]
        else:
            spare = self._features(scene, self._next(whole, seen))
            without = [np.concatenate([np.delete(everything, i, axis=0), spare]) for i in asked]
        visible = [seen.visible, *(len(asked) * [seen.visible - 1])]
        log_odds = self.scorer.log_odds([everything, *without], visible=visible, filtered=scene.filtered)
        return seen.landmark[asked], (log_odds[0] - log_odds[1:]).astype(np.float32)

    def _seen(self, scene: Scene) -> list[SeenLandmarks]:
        """Return what each view sees, no more than the weights were trained to look at."""
        views = seen_landmarks(scene.visible, scene.candidates, statistics=scene.statistics)
        return [self._thinned(seen) for seen in views]

    def _thinned(self, seen: SeenLandmarks) -> SeenLandmarks:
        cap = self.about.landmark_cap
        return seen if cap is None else thinned(seen, cap=cap)

    def _next(self, whole: SeenLandmarks, kept: SeenLandmarks) -> SeenLandmarks:
        """Return the one landmark that would be kept if one of those kept were not there; none where all are kept."""
        more = thinned(whole, cap=len(kept.landmark) + 1)
        return more.rows(np.flatnonzero(~np.isin(more.landmark, kept.landmark)))

    def _features(self, scene: Scene, seen: SeenLandmarks) -> Floats:
        camera = scene.candidates.camera
        if self.about.kind == "mlp":
            return view_histograms(seen, scene.statistics, camera=camera)
        return landmark_tokens(
            seen, scene.statistics, heat_maps=scene.heat_maps, camera=camera, appearance=self.appearance
        )


def open_learned(checkpoint: Checkpoint, scene_map: SceneMap) -> Learned:
    """Open a checkpoint for a map, with a warning where the map has other features than it was trained with.

    Raises WeightsError where the weights do not fit their network, PolicyError where the map lacks appearance.
    """
    about = checkpoint.about
    lacking = without_appearance(scene_map, checkpoint)
    if lacking is not None:
        raise PolicyError(f"policy {lacking.what!r}: {lacking.reason}")
    if about.feature != scene_map.feature:
        log.warning(
            "%s: made with feature %s; the weights of %s were trained with %s: scores may be less sure here",
            scene_map.path,
            scene_map.feature,
            about.kind,
            about.feature,
        )
    scorer = Scorer(checkpoint)
    if about.appearance is None:
        return Learned(scorer)
    assert checkpoint.reduction is not None
    return Learned(scorer, checkpoint.reduction(scene_map.appearance[about.appearance]))


def score_shipped(name: str, scene: Scene) -> Array:
    """Return the scores of a shipped policy that uses no appearance; f64[v], -inf where not allowed."""
    return Learned(Scorer(shipped(name)))(scene)
