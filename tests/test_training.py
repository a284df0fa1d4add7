"""Training: splits by scene, weights that repeat themselves and resume, probabilities that hold, mistakes in a line."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from tiny_views import relabel, write_views

from fieldkit.cli import main
from fieldkit.errors import DatasetError, FieldkitError, TrainingError
from fieldkit.learned.checkpoint import read_checkpoint
from fieldkit.learned.scoring import Scorer
from fieldkit.maps import load_map
from fieldkit.maps.appearance import write_appearance
from fieldkit.store.datasets import (
    map_path,
    read_dataset,
    read_scene,
    read_shard,
    shard_path,
    write_dataset,
    write_shard,
)
from fieldkit.training import (
    TrainingRules,
    chosen_share,
    find_scenes,
    fit_calibration,
    read_examples,
    reliability,
    split_scenes,
    train,
)
from fieldkit.training.inputs import HistogramInputs, TokenInputs
from fieldkit.training.reducing import fit_reduction
from fieldkit.training.resuming import Epoch, State, read_state, state_path, write_state
from fieldkit.views import landmark_tokens, view_histograms

QUICK = TrainingRules("vpt", epochs=3, cap=24, drawn=16, batch=24)


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of three scenes; nothing may be changed in it."""
    return write_views(tmp_path_factory.mktemp("views") / "set")


@pytest.fixture
def own(views: Path, tmp_path: Path) -> Path:
    """The same dataset, to be changed."""
    return Path(shutil.copytree(views, tmp_path / "set"))


class Killed(Exception):
    """What ends a training in these tests."""


def kill_after(epochs: int):  # type: ignore[no-untyped-def]
    def progress(what: str, done: int, total: int) -> None:
        if what.startswith("train ") and done == epochs:
            raise Killed

    return progress


@pytest.mark.parametrize("model", ["mlp", "vpt"])
def test_the_same_seed_gives_the_same_bytes_also_after_a_kill(views: Path, tmp_path: Path, model: str) -> None:
    rules = QUICK if model == "vpt" else TrainingRules("mlp", epochs=3, batch=24)
    train([views], tmp_path / "whole" / "x.safetensors", rules=rules)
    broken = tmp_path / "broken" / "x.safetensors"
    for epochs in (1, 2):
        with pytest.raises(Killed):
            train([views], broken, rules=rules, progress=kill_after(epochs))
    assert state_path(broken).is_file()
    assert not broken.exists()
    train([views], broken, rules=rules)
    for name in ("x.safetensors", "x.md"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "broken" / name).read_bytes()
    assert not state_path(broken).exists()
    train([views], tmp_path / "other.safetensors", rules=dataclasses.replace(rules, seed=1))
    assert (tmp_path / "other.safetensors").read_bytes() != broken.read_bytes()


def test_a_trained_network_chooses_views_that_localize_in_a_scene_it_never_saw(views: Path, tmp_path: Path) -> None:
    rules = TrainingRules("mlp", epochs=30, patience=30, batch=16)
    report = train([views], tmp_path / "x.safetensors", rules=rules, validate="b")
    filtered = report.verdicts[0]
    assert filtered.chosen > 0.8
    assert filtered.reliability.brier < 0.8 * filtered.reliability.brier_of_rate
    scorer = Scorer(read_checkpoint(report.path))
    scene = read_examples(next(s for s in find_scenes([views]) if s.name == "b"))
    histograms = HistogramInputs([scene], QUICK).plain(np.arange(len(scene.label)), occlusion=True)[0]
    scores = scorer.scores(list(np.asarray(histograms, dtype=np.float32)))
    assert chosen_share(scores, scene.label, scene.waypoint) == pytest.approx(filtered.chosen)
    assert np.mean((scores - scene.label) ** 2) == pytest.approx(filtered.reliability.brier, abs=1e-5)


@pytest.fixture
def nothing_to_learn(own: Path, rng: np.random.Generator) -> Path:
    """A dataset whose validation scene c has labels by chance."""
    for path in sorted((own / "c").glob("*.npz")):
        shard = read_shard(path)
        write_shard(path, dataclasses.replace(shard, label=rng.random(len(shard.label)) < 0.5))
    return own


def test_a_training_that_gains_nothing_ends_early(nothing_to_learn: Path, tmp_path: Path) -> None:
    rules = TrainingRules("mlp", epochs=40, patience=2, batch=24, learning_rate=3e-3)
    report = train([nothing_to_learn], tmp_path / "x.safetensors", rules=rules, validate="c")
    assert report.epochs == report.best + rules.patience
    assert report.epochs < 40


def test_without_patience_the_validation_scene_chooses_no_epoch(nothing_to_learn: Path, tmp_path: Path) -> None:
    rules = TrainingRules("mlp", epochs=8, patience=0, batch=24, learning_rate=3e-3)
    report = train([nothing_to_learn], tmp_path / "x.safetensors", rules=rules, validate="c")
    rows = [line.split("|") for line in report.card.read_text().splitlines() if re.match(r"\| \d+ \|", line)]
    assert report.epochs == report.best == len(rows) == 8
    assert float(rows[-1][3]) > min(float(row[3]) for row in rows)


def test_two_trainings_do_not_make_one_checkpoint(own: Path, tmp_path: Path) -> None:
    def start_another(what: str, done: int, total: int) -> None:
        if what.startswith("train "):
            with pytest.raises(TrainingError, match=r"x\.safetensors: another training is making it"):
                train([own], tmp_path / "x.safetensors", rules=dataclasses.replace(QUICK, seed=1))

    train([own], tmp_path / "x.safetensors", rules=dataclasses.replace(QUICK, epochs=1), progress=start_another)
    assert read_checkpoint(tmp_path / "x.safetensors").about.seed == 0
    assert {p.name for p in tmp_path.iterdir()} >= {"x.safetensors", "x.md"}
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


def test_without_a_name_the_scene_of_median_difficulty_validates(own: Path) -> None:
    relabel(own, "a", label=True)
    relabel(own, "b", label=False)
    assert split_scenes(find_scenes([own])).validation.name == "c"
    relabel(own, "c", label=True)
    assert split_scenes(find_scenes([own])).validation.name == "a"


def test_other_appearance_is_other_data(own: Path, tmp_path: Path, rng: np.random.Generator) -> None:
    rules, out = dataclasses.replace(QUICK, model="vpt_appearance"), tmp_path / "x.safetensors"
    with_appearance(own, rng)
    with pytest.raises(Killed):
        train([own], out, rules=rules, progress=kill_after(1))
    with_appearance(own, rng)
    with pytest.raises(TrainingError, match=r"with other settings, data or program"):
        train([own], out, rules=rules)


def test_a_landmark_that_the_map_lacks_is_named(own: Path, tmp_path: Path) -> None:
    path = shard_path(own, "b", "w1")
    shard = read_shard(path)
    write_shard(path, dataclasses.replace(shard, landmark=shard.landmark + 5000))
    with pytest.raises(DatasetError, match=r"w1\.npz: sees the landmark 5\d\d\d; expected less than 150"):
        train([own], tmp_path / "x.safetensors", rules=QUICK)


def test_a_checkpoint_says_what_it_was_trained_on(views: Path, tmp_path: Path) -> None:
    report = train([views], tmp_path / "x.safetensors", rules=QUICK, validate="a")
    about = read_checkpoint(report.path).about
    assert (about.training_scenes, about.validation_scenes) == (("b", "c"), ("a",))
    assert (about.kind, about.feature, about.landmark_cap, about.seed) == ("vpt", "sift", 24, 0)
    assert (about.temperature, about.temperature_unfiltered) == tuple(c.temperature for c in report.calibrations)
    assert (about.bias, about.bias_unfiltered) == tuple(c.bias for c in report.calibrations)
    assert about.bias != about.bias_unfiltered
    card = report.card.read_text()
    assert "| a | validation | 72 |" in card
    assert "Brier score" in card


def with_appearance(folder: Path, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Give every landmark of a dataset an appearance that differs in three directions more than in others."""
    result = {}
    for scene in find_scenes([folder]):
        scene_map = load_map(map_path(folder, scene.entry))
        vectors = 0.1 * rng.normal(size=(len(scene_map.xyz), 112))
        vectors[:, :3] += (3.0, 2.0, 1.0) * rng.normal(size=(len(vectors), 3))
        result[scene.name] = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
        halves = result[scene.name].astype(np.float16)
        write_appearance(Path(scene_map.path), "efficientnet", halves, digest=scene_map.digest)
    return result


def test_appearance_is_reduced_as_the_training_scenes_tell(own: Path, tmp_path: Path, rng: np.random.Generator) -> None:
    rules = dataclasses.replace(QUICK, model="vpt_appearance")
    with pytest.raises(TrainingError, match=r"a\.map: has no appearance of its landmarks by efficientnet, which"):
        train([own], tmp_path / "x.safetensors", rules=rules, validate="c")
    vectors = with_appearance(own, rng)
    report = train([own], tmp_path / "x.safetensors", rules=rules, validate="c")
    found = read_checkpoint(report.path)
    assert (found.about.kind, found.about.appearance) == ("vpt_appearance", "efficientnet")
    assert found.reduction is not None
    expected = fit_reduction([vectors["a"].astype(np.float16), vectors["b"].astype(np.float16)])
    np.testing.assert_array_equal(found.reduction.components, expected.components)
    np.testing.assert_allclose(np.abs(found.reduction.components[:, :3]), np.eye(3), atol=0.2)
    reduced = found.reduction(vectors["a"])
    assert reduced.min() == 0.0
    assert reduced.max() == 1.0
    assert 0.0 < np.mean(reduced == 0.0) < 0.04
    assert Scorer(found).scores([np.zeros((0, 76), dtype=np.float32)]).shape == (1,)


def test_a_state_comes_back_as_it_was(tmp_path: Path) -> None:
    tensors = {"weight": np.arange(6.0, dtype=np.float32).reshape(2, 3), "count": np.array(7)}
    state = State(tensors, tensors, tensors, 0, (Epoch(0.5, 0.6, 0.7),))
    write_state(tmp_path / "x", state, key="k")
    found = read_state(tmp_path / "x", key="k")
    assert found is not None
    assert (found.best, found.history) == (state.best, state.history)
    for part in (found.network, found.optimizer, found.kept):
        assert {n: (v.shape, v.tobytes()) for n, v in part.items()} == {
            n: (v.shape, v.tobytes()) for n, v in tensors.items()
        }


def test_examples_are_the_features_of_the_shards(views: Path) -> None:
    scene = read_examples(find_scenes([views])[0])
    assert len(scene.label) == 72
    assert 0.0 < scene.label.mean() < 1.0
    for occlusion in (True, False):
        numbers = np.array([0, 71])
        (histograms,) = HistogramInputs([scene], QUICK).plain(numbers, occlusion=occlusion)
        whole = TokenInputs([scene], dataclasses.replace(QUICK, cap=4096))
        tokens, weight = whole.plain(numbers, occlusion=occlusion)
        for row, view in enumerate(numbers):
            seen = scene.view(int(view), occlusion=occlusion)
            assert (not occlusion) or (seen.landmark % 2 == 0).all()
            expected = landmark_tokens(seen, scene.statistics, heat_maps=scene.heat_maps, camera=scene.camera)
            np.testing.assert_array_equal(tokens[row, : len(expected)], expected)
            assert (weight[row, : len(expected)] == 1.0).all()
            np.testing.assert_array_equal(histograms[row], view_histograms(seen, scene.statistics, camera=scene.camera))


def test_views_in_a_mirror_are_those_of_a_mirrored_building(views: Path) -> None:
    from fieldkit.training.inputs import _mirror

    scene = read_examples(find_scenes([views])[0])
    inputs = TokenInputs([scene], QUICK)
    tokens = np.array(inputs.plain(np.arange(4), occlusion=False)[0]).reshape(-1, 73)
    mirrored = tokens.copy()
    _mirror(mirrored)
    heat, other = (t[:, 9:].reshape(-1, 8, 8) for t in (tokens, mirrored))
    np.testing.assert_allclose(mirrored[:, 7], 1.0 - tokens[:, 7])
    np.testing.assert_array_equal(other[..., 0], heat[..., 7])
    _mirror(mirrored)
    np.testing.assert_allclose(mirrored, tokens, atol=1e-6)


def test_histograms_in_a_mirror_are_those_of_mirrored_pixels(views: Path) -> None:
    from fieldkit.training.inputs import _mirrored

    scene = read_examples(find_scenes([views])[0])
    seen = scene.view(3, occlusion=False)
    turned = dataclasses.replace(seen, uv_px=(scene.camera.width, 0.0) - seen.uv_px * (1.0, -1.0))
    plain, mirrored = (view_histograms(s, scene.statistics, camera=scene.camera) for s in (seen, turned))
    np.testing.assert_array_equal(_mirrored(plain[None])[0], mirrored)
    assert (plain != mirrored).any()


def test_a_temperature_and_a_bias_give_back_the_probabilities(rng: np.random.Generator) -> None:
    truth = rng.normal(0.3, 1.5, 20_000)
    label = rng.random(truth.size) < 1.0 / (1.0 + np.exp(-truth))
    found = fit_calibration(3.0 * (truth - 0.7), label)
    assert found.temperature == pytest.approx(3.0, rel=0.08)
    assert found.bias == pytest.approx(0.7, abs=0.08)
    table = reliability(found.apply(3.0 * (truth - 0.7)), label)
    assert sum(table.views) == truth.size
    for views, said, localized in zip(table.views, table.said, table.localized, strict=True):
        assert views == 0 or abs(said - localized) < 5.0 * np.sqrt(0.25 / views)


def test_log_odds_that_tell_nothing_become_the_mean_rate() -> None:
    label = np.arange(100) < 30
    found = fit_calibration(np.zeros(100), label)
    np.testing.assert_allclose(found.apply(np.zeros(100)), 0.3, atol=1e-3)


def test_the_best_of_some_drawn_views_is_the_mean_over_all_draws(rng: np.random.Generator) -> None:
    score, label = rng.integers(0, 5, 8).astype(float), rng.random(8) < 0.5
    waypoint = np.zeros(8, dtype=np.int32)
    draws = []
    for _ in range(20_000):
        drawn = rng.permutation(8)[:3]
        best = drawn[score[drawn] == score[drawn].max()]
        draws.append(label[best].mean())
    assert chosen_share(score, label, waypoint, of=3) == pytest.approx(np.mean(draws), abs=0.015)
    best = score == score.max()
    assert chosen_share(score, label, waypoint) == pytest.approx(label[best].mean())


def test_a_scene_is_trained_on_or_validated_on_but_never_both(views: Path, tmp_path: Path) -> None:
    split = split_scenes(find_scenes([views]), validate="c")
    assert ([s.name for s in split.training], split.validation.name) == (["a", "b"], "c")
    for validate, test, said in [
        ("d", (), r"no scene 'd' to validate on; .*known: a, b, c"),
        ("a", (views,), r"its scene 'a' is one of the test scenes in .*set; expected others"),
    ]:
        with pytest.raises(TrainingError, match=said):
            split_scenes(find_scenes([views]), validate=validate, tests=test)
    with pytest.raises(DatasetError, match=r"hold the scene 'a' twice; expected it once"):
        find_scenes([views, views])
    other = Path(shutil.copytree(views, tmp_path / "other"))
    for name in "abc":
        (other / name).rename(other / f"{name}2")
        text = (other / f"{name}2" / "scene.toml").read_text().replace(f'name = "{name}"', f'name = "{name}2"')
        (other / f"{name}2" / "scene.toml").write_text(text)
    head = read_dataset(other)
    write_dataset(other, type(head)(1, ("a2", "b2", "c2"), head.rules, {}, {}))
    with pytest.raises(TrainingError, match=r"scenes 'a' of .* and 'a2' of .* have the same map"):
        split_scenes(find_scenes([views, other]))


def test_data_that_cannot_be_trained_on_is_named_in_one_line(own: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.safetensors"
    relabel(own, "c", label=False)
    with pytest.raises(TrainingError, match=r"set: in the validation scene c every view fails; expected .*both"):
        train([own], out, rules=QUICK, validate="c")
    aliked = write_views(tmp_path / "aliked", ("d",), seed=5)
    text = (aliked / "dataset.toml").read_text().replace('feature = "sift"', 'feature = "aliked"')
    (aliked / "dataset.toml").write_text(text)
    with pytest.raises(DatasetError, match=r"aliked: was made with feature 'aliked', .*set with 'sift'; expected"):
        train([own, aliked], out, rules=QUICK)
    shard_path(own, "b", read_scene(own, "b").waypoints[2]).unlink()
    with pytest.raises(DatasetError, match=r"set: 1 of 6 waypoints of 'b' are missing, w2 first; .*finish the dataset"):
        train([own], out, rules=QUICK, validate="c")
    with pytest.raises(TrainingError, match=r"one: 1 scene to train and validate on; expected at least two"):
        train([write_views(tmp_path / "one", ("e",))], out, rules=QUICK)
    assert not out.exists()
    assert not state_path(out).exists()


def test_an_unfinished_training_of_something_else_is_not_gone_on_with(views: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.safetensors"
    with pytest.raises(Killed):
        train([views], out, rules=QUICK, progress=kill_after(1))
    before = state_path(out).read_bytes()
    for change, said in [
        ({"seed": 1}, "is of a training with other settings, data or program"),
        ({"cap": 8}, "is of a training with other settings, data or program"),
    ]:
        with pytest.raises(TrainingError, match=said):
            train([views], out, rules=dataclasses.replace(QUICK, **change))
    assert state_path(out).read_bytes() == before
    for content, said in [
        (before[:-100], "cut off or damaged"),
        (before.replace(b'\\"version\\": 1', b'\\"version\\": 2'), "version"),
    ]:
        assert content != before
        state_path(out).write_bytes(content)
        with pytest.raises(TrainingError, match=said):
            train([views], out, rules=QUICK)
    report = train([views], out, rules=QUICK, force=True)
    assert report.path.is_file()
    assert not state_path(out).exists()


def test_what_is_there_is_not_replaced_unless_asked_for(views: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.safetensors"
    (tmp_path / "x.md").write_text("mine")
    with pytest.raises(FieldkitError, match=r"x\.md: .*exists"):
        train([views], out, rules=QUICK)
    train([views], out, rules=QUICK, force=True)
    assert "mine" not in (tmp_path / "x.md").read_text()
    with pytest.raises(TrainingError, match=r"x\.md: expected a name that ends in \.safetensors"):
        train([views], tmp_path / "x.md", rules=QUICK, force=True)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"epochs": 0}, "epochs is 0"),
        ({"cap": 0}, "cap is 0"),
        ({"batch": 1}, "batch is 1"),
        ({"seed": -1}, "seed is -1"),
        ({"learning_rate": float("nan")}, "learning_rate is nan"),
        ({"occluded": 1.5}, "occluded is 1.5"),
        ({"model": "mlp", "cap": 7}, "the model mlp takes all landmarks; expected no cap"),
    ],
)
def test_settings_that_cannot_be_used_are_named(changes: dict[str, float], said: str) -> None:
    with pytest.raises(TrainingError, match=said):
        TrainingRules(**changes)  # type: ignore[arg-type]


def test_the_command_trains_and_says_what_the_validation_scene_says(
    views: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["train", str(views), "--model", "mlp", "--epochs", "2", "--out", str(tmp_path / "x.safetensors")]
    with pytest.raises(SystemExit) as done:
        main([*words, "--validate", "b", "--json"])
    assert done.value.code == 0
    said = json.loads(capsys.readouterr().out)
    assert said["validation"] == "b"
    assert [v["occlusion"] for v in said["verdicts"]] == [True, False]
    for again, code, line in [
        (words, 1, "x.safetensors: exists"),
        (
            [*words, "--force", "--validate", "z"],
            1,
            "no scene 'z' to validate on; expected one of its scenes; known: a, b, c",
        ),
        ([*words, "--force", "--validate", "a"], 0, "validation: a"),
    ]:
        with pytest.raises(SystemExit) as done:
            main(again)
        assert done.value.code == code
        told = capsys.readouterr()
        assert line in (told.err if code else told.out)
