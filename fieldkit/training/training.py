"""`train`: from dataset folders to a checkpoint and its card, one arrow per step."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import TrainingError
from fieldkit.learned.checkpoint import About, Checkpoint, Reduction, visibility_of, write_checkpoint
from fieldkit.learned.scoring import APPEARANCE_WIDTH
from fieldkit.maps import appearance_path, known_appearances
from fieldkit.store import digest, library_versions
from fieldkit.store.datasets import map_path, scene_path, shard_path
from fieldkit.store.files import plain, refuse_existing
from fieldkit.training.calibrating import Calibration, chosen_share, fit_calibration, reliability
from fieldkit.training.card import SceneCount, Verdict, card_path, write_card
from fieldkit.training.examples import Examples, Progress, SceneFolder, Split, find_scenes, read_examples, split_scenes
from fieldkit.training.fitting import Fitted, Material, fit, machine
from fieldkit.training.inputs import HistogramInputs, Inputs, TokenInputs
from fieldkit.training.reducing import fit_reduction
from fieldkit.training.resuming import alone, forget_state, state_path
from fieldkit.training.rules import APPEARANCE_OF, TrainingRules
from fieldkit.views import TOKEN_WIDTH

if TYPE_CHECKING:
    import torch

Array = NDArray[np.float64]
SUFFIX = ".safetensors"
_LIBRARIES = ("fieldkit", "numpy", "torch")


@dataclasses.dataclass(frozen=True)
class TrainingReport:
    """What was trained: where it lies, the epochs done and the one kept, and what the validation scene says."""

    path: Path
    card: Path
    training: tuple[str, ...]
    validation: str
    epochs: int
    best: int
    calibrations: tuple[Calibration, Calibration]
    verdicts: tuple[Verdict, ...]


def train(
    datasets: Sequence[Path],
    out: Path,
    *,
    rules: TrainingRules | None = None,
    validate: str | None = None,
    tests: Sequence[Path] = (),
    force: bool = False,
    progress: Progress | None = None,
) -> TrainingReport:
    """Train a learned policy on dataset folders and write its checkpoint and its card.

    One scene is kept to validate on, ``validate`` or the one of median difficulty; ``tests`` are datasets whose scenes
    must not be among them. The same data, rules, machine and number of torch's threads give the same bytes, and a
    killed training goes on where it was when it is called again. Raises DatasetError, StoreError or MapError for data
    that cannot be used, TrainingError for scenes, labels or an unfinished training that do not fit, or while another
    training makes the same checkpoint, and StoreError when ``out`` is in the way.
    """
    rules, out = (rules or TrainingRules()).settled(), Path(out)
    _refuse_out(out, force=force)
    split = split_scenes(find_scenes(datasets), validate=validate, tests=tests)
    with alone(out):
        # Another training may have ended in between
        _refuse_out(out, force=force)
        return _train(split, rules, out, force=force, progress=progress)


def _train(split: Split, rules: TrainingRules, out: Path, *, force: bool, progress: Progress | None) -> TrainingReport:
    """Do what `train` says, once it is known what is trained on and that nobody else does it."""
    _refuse_without_appearance(split, rules)
    scenes = [read_examples(s, progress=progress) for s in (*split.training, split.validation)]
    _refuse_one_class(split, scenes)
    reduction = _reduction(scenes[:-1], rules)
    training, validation = (_inputs(part, rules, reduction, progress) for part in (scenes[:-1], scenes[-1:]))
    material = Material(training, validation, scenes[-1].waypoint)
    data = _data_digest(split, APPEARANCE_OF.get(rules.model))
    key = digest(data, repr(rules), repr(sorted(_versions().items())), repr(machine()))
    fitted = fit(lambda: _network(rules), material, rules=rules, out=out, key=key, force=force, progress=progress)
    filtered, unfiltered = (fit_calibration(odds, scenes[-1].label) for odds in fitted.log_odds)
    about = _about(split, rules, fitted, (filtered, unfiltered), data=data)
    verdicts = (
        _verdict(scenes[-1], fitted.log_odds[0], filtered, occlusion=True),
        _verdict(scenes[-1], fitted.log_odds[1], unfiltered, occlusion=False),
    )
    counts = [_count(s, "training") for s in scenes[:-1]] + [_count(scenes[-1], "validation")]
    write_checkpoint(out, Checkpoint(about, fitted.weights, reduction))
    write_card(out, about, rules=rules, scenes=counts, history=fitted.history, verdicts=verdicts)
    forget_state(out)
    return TrainingReport(
        path=out,
        card=card_path(out),
        training=about.training_scenes,
        validation=split.validation.name,
        epochs=len(fitted.history),
        best=fitted.best + 1,
        calibrations=(filtered, unfiltered),
        verdicts=verdicts,
    )


def _refuse_out(out: Path, *, force: bool) -> None:
    """Raise where the files to write are there already, and no unfinished training has begun to write them."""
    if out.suffix != SUFFIX:
        raise TrainingError(f"{out}: expected a name that ends in {SUFFIX}", hint=f"give --out {out.stem}{SUFFIX}")
    if not state_path(out).is_file():
        for path in (out, card_path(out)):
            refuse_existing(path, force=force, kind="file")


def _versions() -> dict[str, str]:
    return {name: version for name, version in library_versions().items() if name in _LIBRARIES}


def _about(
    split: Split, rules: TrainingRules, fitted: Fitted, calibrations: tuple[Calibration, Calibration], *, data: str
) -> About:
    filtered, unfiltered = calibrations
    done = {"rules": plain(dataclasses.asdict(rules)), "epochs": len(fitted.history), "best": fitted.best + 1}
    views = split.validation.rules
    return About(
        kind=rules.model,
        feature=views.feature,
        landmark_cap=rules.cap,
        training_scenes=tuple(s.name for s in split.training),
        validation_scenes=(split.validation.name,),
        dataset_digest=data,
        seed=rules.seed,
        temperature=filtered.temperature,
        bias=filtered.bias,
        temperature_unfiltered=unfiltered.temperature,
        bias_unfiltered=unfiltered.bias,
        appearance=APPEARANCE_OF.get(rules.model),
        visibility=visibility_of(views.candidates, tolerance_voxels=views.tolerance_voxels),
        training={**done, **machine()},
        versions=_versions(),
    )


def _refuse_one_class(split: Split, scenes: Sequence[Examples]) -> None:
    """Raise TrainingError where all training views or all validation views have one label."""
    for use, own in (("training", scenes[:-1]), ("validation", scenes[-1:])):
        labels = np.concatenate([s.label for s in own])
        if not labels.size or labels.all() or not labels.any():
            every = (*split.training, split.validation)
            folders = sorted({str(s.folder) for s in every if s.name in [e.scene for e in own]})
            what = "has no view" if not labels.size else f"every view {'localizes' if labels.all() else 'fails'}"
            raise TrainingError(
                f"{', '.join(folders)}: in the {use} scene{'s' if len(own) > 1 else ''} "
                f"{', '.join(e.scene for e in own)} {what}; expected views of both labels",
                hint="choose other scenes, or make a dataset of more waypoints",
            )


def _network(rules: TrainingRules) -> torch.nn.Module:
    """Return a network with random weights as large as ReLU layers need (He et al., ICCV 2015).

    With torch's own, smaller ones what passes the MLP's nine layers hardly depends on the view at first.
    """
    from torch import nn

    from fieldkit.learned.networks import Mlp, Vpt

    if rules.model != "mlp":
        return Vpt(tokens=TOKEN_WIDTH + (APPEARANCE_WIDTH if rules.model in APPEARANCE_OF else 0))
    network = Mlp()
    for layer in network.modules():
        if isinstance(layer, nn.Linear | nn.Conv1d):
            nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
            assert layer.bias is not None
            nn.init.zeros_(layer.bias)
    return network


def _refuse_without_appearance(split: Split, rules: TrainingRules) -> None:
    """Raise TrainingError for a scene whose map lacks the appearance that a model takes."""
    network = APPEARANCE_OF.get(rules.model)
    if network is None:
        return
    for scene in (*split.training, split.validation):
        folder = map_path(scene.folder, scene.entry)
        if network not in known_appearances(folder):
            raise TrainingError(
                f"{folder}: has no appearance of its landmarks by {network}, which {rules.model} takes; expected it",
                hint=f"add it: sim-bridge dataset with the same options and --appearance {network}",
            )


def _reduction(scenes: Sequence[Examples], rules: TrainingRules) -> Reduction | None:
    """Return how the appearance that a model takes becomes numbers, None where it takes none."""
    network = APPEARANCE_OF.get(rules.model)
    return None if network is None else fit_reduction([s.appearance[network] for s in scenes])


def _inputs(
    scenes: Sequence[Examples], rules: TrainingRules, reduction: Reduction | None, progress: Progress | None
) -> Inputs:
    if rules.model == "mlp":
        return HistogramInputs(scenes, rules, progress=progress)
    network = APPEARANCE_OF.get(rules.model, "")
    reduced = () if reduction is None else tuple(reduction(s.appearance[network]) for s in scenes)
    return TokenInputs(scenes, rules, appearance=reduced)


def _data_digest(split: Split, network: str | None) -> str:
    """Return the digest of all views, of the appearance that is used, and of which scenes are trained on."""

    def told(scene: SceneFolder) -> str:
        shards = (shard_path(scene.folder, scene.name, w) for w in scene.entry.waypoints)
        seen = [] if network is None else [appearance_path(map_path(scene.folder, scene.entry), network)]
        return digest(scene_path(scene.folder, scene.name), *shards, *seen)

    return digest(*(told(s) for s in split.training), "validation", told(split.validation))


def _count(scene: Examples, use: str) -> SceneCount:
    return SceneCount(scene.scene, use, len(scene.label), float(np.mean(scene.label)))


def _verdict(scene: Examples, odds: Array, calibration: Calibration, *, occlusion: bool) -> Verdict:
    visible = np.array([len(scene.view(i, occlusion=occlusion).landmark) for i in range(len(scene.label))], dtype=float)
    return Verdict(
        occlusion=occlusion,
        views=len(scene.label),
        waypoints=len(np.unique(scene.waypoint)),
        chosen=chosen_share(odds, scene.label, scene.waypoint),
        most_visible=chosen_share(visible, scene.label, scene.waypoint),
        possible=float(np.mean([scene.label[scene.waypoint == w].any() for w in np.unique(scene.waypoint)])),
        reliability=reliability(calibration.apply(odds), scene.label),
    )
