"""Fitting: what is trained and what is kept apart, how fast, what a class weighs, and which calibration is whose."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from tiny_views import write_views

from fieldkit.learned.checkpoint import Checkpoint, read_checkpoint
from fieldkit.learned.networks import Mlp, Vpt
from fieldkit.learned.scoring import Scorer
from fieldkit.store.datasets import read_shard, write_shard
from fieldkit.training import TrainingRules, find_scenes, fit_calibration, read_examples, reliability, train
from fieldkit.training.fitting import Fitted, Material, fit
from fieldkit.training.inputs import Arrays, HistogramInputs, TokenInputs
from fieldkit.views import view_histograms

QUICK = TrainingRules("mlp", epochs=10, patience=0, batch=8, learning_rate=3e-3)


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of two scenes of two waypoints with twelve views each; nothing may be changed in it."""
    return write_views(tmp_path_factory.mktemp("views") / "set", ("a", "b"), waypoints=2)


@pytest.fixture(scope="module")
def trained(views: Path, tmp_path_factory: pytest.TempPathFactory) -> Checkpoint:
    """An MLP trained on a and validated on b."""
    out = tmp_path_factory.mktemp("trained") / "x.safetensors"
    return read_checkpoint(train([views], out, rules=QUICK, validate="b").path)


def test_the_labels_of_the_validation_scene_teach_the_network_nothing(
    views: Path, trained: Checkpoint, tmp_path: Path
) -> None:
    own = Path(shutil.copytree(views, tmp_path / "set"))
    for path in sorted((own / "b").glob("*.npz")):
        shard = read_shard(path)
        write_shard(path, dataclasses.replace(shard, label=np.arange(len(shard.label)) == 0))
    found = read_checkpoint(train([own], tmp_path / "x.safetensors", rules=QUICK, validate="b").path)
    assert found.about.bias != trained.about.bias
    assert found.weights.keys() == trained.weights.keys()
    for name, value in trained.weights.items():
        np.testing.assert_array_equal(found.weights[name], value, err_msg=name)


def test_each_calibration_is_fitted_to_its_own_log_odds(views: Path, trained: Checkpoint) -> None:
    scene = read_examples(find_scenes([views])[1])
    neutral = {"temperature": 1.0, "bias": 0.0, "temperature_unfiltered": 1.0, "bias_unfiltered": 0.0}
    about = trained.about
    scorer = Scorer(dataclasses.replace(trained, about=msgspec.structs.replace(about, **neutral)))
    found = []
    for filtered in (True, False):
        seen = [scene.view(i, occlusion=filtered) for i in range(len(scene.label))]
        histograms = [view_histograms(s, scene.statistics, camera=scene.camera) for s in seen]
        found.append(fit_calibration(scorer.log_odds(histograms, filtered=filtered), scene.label))
    assert abs(found[0].bias - found[1].bias) > 0.1
    assert (about.temperature, about.bias) == pytest.approx(dataclasses.astuple(found[0]), abs=0.02)
    assert (about.temperature_unfiltered, about.bias_unfiltered) == pytest.approx(
        dataclasses.astuple(found[1]), abs=0.02
    )


@pytest.mark.parametrize("model", ["mlp", "vpt"])
def test_a_training_moves_every_parameter(model: str, views: Path, tmp_path: Path) -> None:
    scene = read_examples(find_scenes([views])[0])
    cap = None if model == "mlp" else 16
    rules = TrainingRules(model, epochs=2, patience=0, batch=8, weight_decay=0.0, cap=cap).settled()  # type: ignore[arg-type]
    inputs = HistogramInputs([scene], rules) if model == "mlp" else TokenInputs([scene], rules)
    start: dict[str, NDArray[np.float32]] = {}

    def make() -> torch.nn.Module:
        network = Mlp() if model == "mlp" else Vpt()
        start.update({name: p.detach().numpy().copy() for name, p in network.named_parameters()})
        return network

    fitted = fit(make, Material(inputs, inputs, scene.waypoint), rules=rules, out=tmp_path / "x", key="k")
    assert len(start) > 10
    for name, value in start.items():
        assert (fitted.weights[name] != value).any(), name


@dataclasses.dataclass(eq=False)
class Numbers:
    """Views that show one number each."""

    shown: NDArray[np.float64]
    label: NDArray[np.bool_]

    def plain(self, views: NDArray[np.int64], *, occlusion: bool) -> Arrays:
        return (self.shown[views],)

    def varied(self, views: NDArray[np.int64], occlusion: NDArray[np.bool_], rng: np.random.Generator) -> Arrays:
        return (self.shown[views],)


class Slope(torch.nn.Module):
    """A network of one weight, which it multiplies with what it sees; it remembers the weight of every step."""

    def __init__(self, start: float) -> None:
        super().__init__()
        self.slope = torch.nn.Parameter(torch.tensor(start, dtype=torch.float64))
        self.steps: list[float] = []

    def forward(self, shown: torch.Tensor) -> torch.Tensor:
        if self.training:
            self.steps.append(self.slope.item())
        return torch.stack([torch.zeros_like(shown), self.slope * shown], dim=1)


def fit_slope(network: Slope, numbers: Numbers, rules: TrainingRules, out: Path) -> Fitted:
    material = Material(numbers, numbers, np.zeros(len(numbers.label), dtype=np.int32))
    return fit(lambda: network, material, rules=rules, out=out, key="k")


@pytest.mark.parametrize("localizing", [10, 30])
def test_a_network_that_sees_nothing_says_even_odds_however_many_views_localize(
    localizing: int, tmp_path: Path
) -> None:
    rules = dataclasses.replace(QUICK, epochs=25, batch=40, learning_rate=0.1, weight_decay=0.0)
    fitted = fit_slope(Slope(0.3), Numbers(np.ones(40), np.arange(40) < localizing), rules, tmp_path / "x")
    assert abs(fitted.weights["slope"]) < 0.1


def test_the_learning_rate_rises_in_a_tenth_of_all_steps_and_falls_to_a_hundredth(tmp_path: Path) -> None:
    # What is wrong by far is pushed back evenly, and then every step of AdamW is as long as its learning rate
    rules = dataclasses.replace(QUICK, epochs=5, batch=2, learning_rate=0.01, weight_decay=0.0)
    label = np.arange(40) % 2 == 0
    network = Slope(-20.0)
    fitted = fit_slope(network, Numbers(np.where(label, 1.0, -1.0), label), rules, tmp_path / "x")
    rates = np.diff([*network.steps, float(fitted.weights["slope"])])
    assert len(rates) == 100
    assert rates.argmax() == 10
    assert rates[10] == pytest.approx(0.01, rel=1e-4)
    assert rates[0] == pytest.approx(0.0001, rel=0.05)
    assert rates[-1] == pytest.approx(0.0001, rel=0.05)
    assert (np.diff(rates[:11]) > 0).all()
    assert (np.diff(rates[10:]) < 0).all()
    # Half of the cosine's fall at half of its way
    assert rates[55] == pytest.approx(0.00505, rel=1e-3)


def test_the_brier_score_is_held_against_that_of_always_saying_the_rate() -> None:
    found = reliability(np.array([0.9, 0.3, 0.2, 0.0]), np.array([True, False, False, False]))
    assert found.brier == pytest.approx((0.01 + 0.09 + 0.04 + 0.0) / 4)
    assert found.brier_of_rate == pytest.approx((0.75**2 + 3 * 0.25**2) / 4)
