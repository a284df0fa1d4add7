"""Learned scores: the paper's networks, checkpoints that are whole or refused, scores that depend on nothing else."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.numpy import save_file
from seeded_weights import seeded

from fieldkit.errors import WeightsError
from fieldkit.learned.batches import FULL_VIEW, padded
from fieldkit.learned.checkpoint import Checkpoint, Reduction, read_checkpoint, write_checkpoint
from fieldkit.learned.networks import Mlp, Vpt
from fieldkit.learned.scoring import Scorer


def weights_of(network: torch.nn.Module) -> int:
    return sum(p.numel() for p in network.parameters())


def test_the_networks_have_the_paper_s_number_of_weights() -> None:
    assert weights_of(Mlp()) == 181_546
    assert weights_of(Vpt()) == 159_170
    assert weights_of(Vpt(tokens=76)) == 159_170 + 3 * 128


@pytest.mark.parametrize("network", [Mlp(), Vpt(), Vpt(tokens=76)], ids=["mlp", "vpt", "vpt_appearance"])
def test_every_parameter_is_trained(network: torch.nn.Module) -> None:
    torch.manual_seed(0)
    network.train()
    if isinstance(network, Mlp):
        logits = network(torch.rand(64, 146))
    else:
        logits = network(torch.rand(16, 12, network.embedding[0].in_features), torch.full((16, 12), 3.0))
    torch.nn.functional.cross_entropy(logits, torch.arange(len(logits)) % 2).backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert bool((parameter.grad != 0).any()), name


def vpt() -> Vpt:
    network = Vpt()
    network.load_state_dict({k: torch.from_numpy(np.array(v)) for k, v in seeded("vpt").weights.items()})
    return network.eval()


@pytest.fixture
def views(rng: np.random.Generator) -> list[np.ndarray]:
    return [rng.random((n, 73), dtype=np.float32) for n in (17, 0, 40, 3, 40, 1)]


def test_the_order_of_landmarks_changes_nothing(views: list[np.ndarray], rng: np.random.Generator) -> None:
    scorer = Scorer(seeded("vpt"))
    shuffled = [v[rng.permutation(len(v))] for v in views]
    np.testing.assert_allclose(scorer.log_odds(shuffled), scorer.log_odds(views), atol=1e-5)


def test_a_weight_is_the_shorthand_of_filling_up_with_zeros(views: list[np.ndarray]) -> None:
    tokens, weight = padded(views, visible=[len(v) for v in views], width=73)
    filled = np.zeros((len(views), FULL_VIEW, 73), np.float32)
    for row, view in zip(filled, views, strict=True):
        row[: len(view)] = view
    with torch.inference_mode():
        short = vpt()(torch.from_numpy(tokens), torch.from_numpy(weight))
        long = vpt()(torch.from_numpy(filled))
    np.testing.assert_allclose(short, long, atol=1e-4)
    assert np.ptp(short.numpy(), axis=0).min() > 0.01


def test_kept_landmarks_stand_for_those_that_are_alike(rng: np.random.Generator) -> None:
    few = rng.random((20, 73), dtype=np.float32)
    scorer = Scorer(seeded("vpt"))
    alike = scorer.log_odds([np.repeat(few, 15, axis=0)])
    np.testing.assert_allclose(scorer.log_odds([few], visible=[300]), alike, atol=1e-4)
    assert abs(scorer.log_odds([few])[0] - alike[0]) > 0.01


def test_a_full_view_is_not_filled_up() -> None:
    tokens, weight = padded([np.ones((8, 73), np.float32)], visible=[5000], width=73)
    assert tokens.shape == (1, 8, 73)
    assert weight.tolist() == [[FULL_VIEW / 8] * 8]


@pytest.mark.parametrize("kind", ["mlp", "vpt"])
def test_scores_do_not_depend_on_the_other_views(kind: str, views: list[np.ndarray], rng: np.random.Generator) -> None:
    scorer = Scorer(seeded(kind))
    inputs = views if kind == "vpt" else list(rng.random((6, 146), dtype=np.float32))
    together = scorer.scores(inputs)
    alone = np.concatenate([scorer.scores([v]) for v in inputs])
    np.testing.assert_allclose(together, alone, atol=1e-6)
    assert len(set(together.round(6).tolist())) > 3
    assert ((together > 0) & (together < 1)).all()
    assert scorer.scores([]).shape == (0,)


def test_many_views_of_many_landmarks_are_scored_in_several_batches(rng: np.random.Generator) -> None:
    scorer = Scorer(seeded("vpt"))
    many = [rng.random((600, 73), dtype=np.float32) for _ in range(5)]
    np.testing.assert_allclose(scorer.scores(many)[2], scorer.scores(many[2:3])[0], atol=1e-6)


def test_temperature_and_bias_change_the_log_odds_only(views: list[np.ndarray]) -> None:
    plain = Scorer(seeded("vpt")).log_odds(views)
    other = Scorer(seeded("vpt", temperature=2.0, bias=-0.5))
    # Log-odds are rounded to five digits
    np.testing.assert_allclose(other.log_odds(views), plain / 2.0 - 0.5, atol=1.1e-5)
    np.testing.assert_allclose(other.scores(views), 1 / (1 + np.exp(-(plain / 2.0 - 0.5))), atol=1.1e-5)
    unfiltered = Scorer(seeded("vpt", temperature_unfiltered=4.0, bias_unfiltered=1.0)).log_odds(views, filtered=False)
    np.testing.assert_allclose(unfiltered, plain / 4.0 + 1.0, atol=1.1e-5)


def test_scores_that_are_no_numbers_are_refused(views: list[np.ndarray]) -> None:
    found = seeded("vpt")
    huge = {k: v * np.float32(1e20) if v.dtype == np.float32 else v for k, v in found.weights.items()}
    with pytest.raises(WeightsError, match="gives scores that are not finite"):
        Scorer(dataclasses.replace(found, weights=huge)).scores(views)


def test_scoring_leaves_the_threads_of_torch_as_they_are(views: list[np.ndarray]) -> None:
    before = torch.get_num_threads(), torch.is_grad_enabled()
    Scorer(seeded("vpt")).scores(views)
    assert (torch.get_num_threads(), torch.is_grad_enabled()) == before


@pytest.mark.parametrize("kind", ["mlp", "vpt", "vpt_appearance"])
def test_a_checkpoint_is_read_as_it_was_written(kind: str, tmp_path: Path) -> None:
    made = seeded(kind, temperature=1.7, training={"epochs": 3, "learning_rate": 1e-3})
    for name in ("a", "b"):
        write_checkpoint(tmp_path / name, made)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    found = read_checkpoint(tmp_path / "a")
    assert found.about == made.about
    assert found.weights.keys() == made.weights.keys()
    for name, value in made.weights.items():
        np.testing.assert_array_equal(found.weights[name], value)
    assert (found.reduction is None) == (made.reduction is None)
    assert found.digest == read_checkpoint(tmp_path / "b").digest != ""


def test_appearance_becomes_three_numbers_in_0_to_1(rng: np.random.Generator) -> None:
    low, high = np.float32([0, -1, 0]), np.float32([1, 1, 2])
    reduce = Reduction(np.float32([1, 0, 0, 0]), np.eye(3, 4, dtype=np.float32), low, high)
    reduced = reduce(np.float32([[1.5, 0, 1, 9], [-5, 7, 7, 0]]))
    np.testing.assert_allclose(reduced, [[0.5, 0.5, 0.5], [0, 1, 1]])
    assert reduce(np.zeros((0, 4), np.float16)).shape == (0, 3)


def rewritten(path: Path, *, about: dict[str, Any] | None = None, tensors: dict[str, Any] | None = None) -> Path:
    """Write a seeded checkpoint with other values in its header, or other tensors (None takes one out)."""
    write_checkpoint(path, seeded("vpt"))
    with safe_open(path, framework="numpy") as file:
        header = json.loads(file.metadata()["fieldkit"])
        content = {k: file.get_tensor(k) for k in file.keys()} | (tensors or {})  # noqa: SIM118
    header |= about or {}
    kept = {k: v for k, v in content.items() if v is not None}
    save_file(kept, path, metadata={"fieldkit": json.dumps({k: v for k, v in header.items() if v is not None})})
    return path


@pytest.mark.parametrize(
    ("about", "message"),
    [
        ({"version": 2}, "version 2; this fieldkit reads version 1; update fieldkit"),
        ({"kindd": "vpt"}, "unknown field `kindd`"),
        ({"kind": "vit"}, "Invalid enum value 'vit'"),
        ({"feature": None}, "missing required field `feature`"),
        ({"temperature": 0.0}, "Expected `float` >= 0.01"),
        ({"landmark_cap": 0}, ">= 1"),
        ({"bias": float("nan")}, "has temperatures and biases 1, nan"),
        ({"normalisation": {"full_distance_m": 8.0}}, "features with full_angle_deg None; this version computes"),
        ({"appearance": "efficientnet"}, "is a vpt with the appearance efficientnet; expected vpt_appearance"),
        ({"kind": "vpt_dino", "appearance": "efficientnet"}, "is a vpt_dino with the appearance efficientnet"),
        ({"kind": "vpt_dino"}, "is a vpt_dino without appearance; expected mlp or vpt"),
        ({"kind": "vpt_dino", "appearance": "dinov2"}, "its reduction of appearance has the shapes {}"),
    ],
)
def test_a_header_that_does_not_fit_is_refused(about: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(WeightsError) as caught:
        read_checkpoint(rewritten(tmp_path / "odd.safetensors", about=about))
    assert message in str(caught.value)
    assert str(tmp_path / "odd.safetensors") in str(caught.value)


@pytest.mark.parametrize(
    ("tensors", "message"),
    [
        ({"network.joint.bias": None}, "no 'joint.bias' in it"),
        ({"network.joint.bias": np.zeros(127, np.float32)}, r"'joint.bias' is \[127\]; expected \[128\]"),
        ({"network.joint.bias": np.full(128, np.nan, np.float32)}, "values that are not finite"),
        ({"network.more": np.zeros(3, np.float32)}, "'more' is no part of Vpt"),
        ({"more": np.zeros(3, np.float32)}, "holds 'more'"),
    ],
)
def test_weights_that_do_not_fit_the_network_are_refused(tensors: dict[str, Any], message: str, tmp_path: Path) -> None:
    path = rewritten(tmp_path / "odd.safetensors", tensors=tensors)
    with pytest.raises(WeightsError, match=message):
        Scorer(read_checkpoint(path))


def test_a_file_that_is_cut_off_missing_or_none_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "vpt.safetensors"
    with pytest.raises(WeightsError, match="no such file"):
        read_checkpoint(path)
    write_checkpoint(path, seeded("vpt"))
    whole = path.read_bytes()
    for length in (0, 5, 500, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(WeightsError, match="cut off or damaged"):
            read_checkpoint(path)
    save_file({"a": np.zeros(2, np.float32)}, path)
    with pytest.raises(WeightsError, match="has no 'fieldkit' in its header"):
        read_checkpoint(path)


def test_a_reduction_of_other_shapes_is_refused(tmp_path: Path) -> None:
    made = seeded("vpt_appearance")
    assert made.reduction is not None
    odd = dataclasses.replace(made, reduction=dataclasses.replace(made.reduction, low=np.zeros(2, np.float32)))
    write_checkpoint(tmp_path / "odd", odd)
    with pytest.raises(WeightsError, match=r"reduction of appearance has the shapes .*'low': \(2,\)"):
        read_checkpoint(tmp_path / "odd")
    narrow = dataclasses.replace(
        made.reduction, mean=np.zeros(50, np.float32), components=np.zeros((3, 50), np.float32)
    )
    write_checkpoint(tmp_path / "odd", dataclasses.replace(made, reduction=narrow))
    with pytest.raises(WeightsError, match=r"reduction of appearance has the shapes .*\(3, 50\).*\(3, 112\)"):
        read_checkpoint(tmp_path / "odd")
    plain = Checkpoint(msgspec.structs.replace(seeded("vpt").about), seeded("vpt").weights, made.reduction)
    write_checkpoint(tmp_path / "odd", plain)
    with pytest.raises(WeightsError, match=r"expected finite .* it uses no appearance"):
        read_checkpoint(tmp_path / "odd")


def test_a_checkpoint_is_read_and_replays_are_ready_without_torch(tmp_path: Path) -> None:
    write_checkpoint(tmp_path / "vpt.safetensors", seeded("vpt"))
    code = (
        "import sys, pathlib\n"
        "import fieldkit.cli, fieldkit.replay, fieldkit.dataset, fieldkit.policies\n"
        "from fieldkit.learned.checkpoint import read_checkpoint\n"
        f"read_checkpoint(pathlib.Path({str(tmp_path / 'vpt.safetensors')!r}))\n"
        "assert not {'torch', 'kornia'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
