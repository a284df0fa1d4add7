"""What networks are trained on: the landmarks that their policy takes, with the noise that is documented, no more."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from seeded_weights import seeded
from tiny_views import write_views

from fieldkit.learned.scoring import open_network
from fieldkit.maps import load_map
from fieldkit.policies import Scene, open_learned
from fieldkit.store.datasets import map_path, read_scene_shard, row_pose
from fieldkit.training import TrainingRules, find_scenes, read_examples
from fieldkit.training.examples import Examples, SceneFolder
from fieldkit.training.inputs import Arrays, HistogramInputs, TokenInputs, _mirror, _mirrored
from fieldkit.types import Candidates
from fieldkit.views import TOKEN_WIDTH, Visibility

Floats = NDArray[np.float32]
FEW = 8
FULL_VIEW = 1024


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[SceneFolder, ...]:
    """Two scenes of two waypoints with twelve views each."""
    return find_scenes([write_views(tmp_path_factory.mktemp("views") / "set", ("a", "b"), waypoints=2)])


@pytest.fixture(scope="module")
def scenes(folders: tuple[SceneFolder, ...]) -> list[Examples]:
    return [read_examples(folder) for folder in folders]


def rules(**changes: float) -> TrainingRules:
    return TrainingRules("vpt", **({"cap": 4096, "drawn": 4096} | changes)).settled()  # type: ignore[arg-type]


def everything(scenes: list[Examples]) -> NDArray[np.int64]:
    return np.arange(sum(len(s.label) for s in scenes))


def floats(arrays: Arrays) -> list[Floats]:
    return [np.asarray(a, dtype=np.float32) for a in arrays]


def numbers_visible(scenes: list[Examples], *, occlusion: bool) -> NDArray[np.int64]:
    return np.array(
        [len(s.view(i, occlusion=occlusion).landmark) for s in scenes for i in range(len(s.label))], dtype=np.int64
    )


def scene_of_policies(folder: SceneFolder, examples: Examples, *, occlusion: bool) -> Scene:
    """Return the views of a scene's first waypoint as a policy is given them."""
    scene_map = load_map(map_path(folder.folder, folder.entry))
    shard = read_scene_shard(folder.folder, folder.entry, folder.entry.waypoints[0])
    poses = tuple(row_pose(row) for row in shard.candidate)
    seen = [examples.view(i, occlusion=occlusion) for i in range(len(poses))]
    visible = Visibility(
        tuple(s.landmark for s in seen),
        tuple(p.inv().apply(scene_map.xyz[s.landmark]) for p, s in zip(poses, seen, strict=True)),
        tuple(s.uv_px for s in seen),
    )
    allowed = np.ones(len(poses), dtype=bool)
    candidates = Candidates("w0", shard.view_ids, shard.kinds, poses, shard.camera, allowed)  # type: ignore[arg-type]
    return Scene(candidates, visible, examples.statistics, examples.heat_maps, occlusion)


@pytest.mark.parametrize("occlusion", [True, False])
def test_a_view_is_validated_on_the_landmarks_that_the_policy_takes(
    folders: tuple[SceneFolder, ...], scenes: list[Examples], occlusion: bool
) -> None:
    checkpoint = seeded("vpt", landmark_cap=FEW)
    policy = open_learned(checkpoint, load_map(map_path(folders[1].folder, folders[1].entry)))
    expected = policy(scene_of_policies(folders[1], scenes[1], occlusion=occlusion))
    views = len(scenes[0].label) + np.arange(len(expected))
    assert (numbers_visible(scenes, occlusion=occlusion)[views] > FEW).sum() >= 4
    arrays = TokenInputs(scenes, rules(cap=FEW)).plain(views, occlusion=occlusion)
    assert arrays[0].shape[1] == FEW + 1
    with torch.inference_mode():
        logits = open_network(checkpoint)(*map(torch.from_numpy, arrays)).double().numpy()
    np.testing.assert_allclose(1 / (1 + np.exp(logits[:, 0] - logits[:, 1])), expected, atol=1e-5)
    assert np.ptp(expected) > 1e-3


def test_the_landmarks_learned_from_stand_for_all_that_a_view_sees(scenes: list[Examples]) -> None:
    inputs, views = TokenInputs(scenes, rules(drawn=FEW, jitter=0.0)), everything(scenes)
    visible = numbers_visible(scenes, occlusion=False)
    assert (visible > FEW).sum() > 10
    rng = np.random.default_rng(0)
    tokens, weight = floats(inputs.varied(views, np.zeros(len(views), dtype=bool), rng))
    kept = np.minimum(visible, FEW)
    for row, (few, many) in enumerate(zip(kept, visible, strict=True)):
        np.testing.assert_allclose(weight[row, :few], many / few, rtol=1e-6)
        assert weight[row, few] == FULL_VIEW - many
        assert not weight[row, few + 1 :].any()
    # The next time it learns from others: neither mirror nor landmark changes how near mapping saw one
    other, _ = floats(inputs.varied(views, np.zeros(len(views), dtype=bool), rng))
    first, second = (np.sort(t[visible > 2 * FEW, :FEW, 1]) for t in (tokens, other))
    assert len(first) > 10
    assert (first != second).any(axis=1).all()


def varied_and_plain(
    inputs: HistogramInputs | TokenInputs, scenes: list[Examples], rng: np.random.Generator
) -> tuple[list[Floats], list[Floats]]:
    """Return views as they are learned, every third without those behind the surface, and the same as scored."""
    views = everything(scenes)
    occlusion = views % 3 == 0
    parts = [floats(inputs.plain(views[k : k + 1], occlusion=bool(use))) for k, use in enumerate(occlusion)]
    varied, plain = floats(inputs.varied(views, occlusion, rng)), []
    for found, rows in zip(varied, zip(*parts, strict=True), strict=True):
        stacked = np.zeros_like(found)
        for k, row in enumerate(rows):
            place: tuple[int | slice, ...] = (k, *map(slice, row.shape[1:]))
            stacked[place] = row[0]
        plain.append(stacked)
    return varied, plain


@pytest.mark.parametrize("kind", ["histograms", "tokens"])
def test_without_jitter_a_view_is_learned_as_it_is_scored_or_in_a_mirror(kind: str, scenes: list[Examples]) -> None:
    whole = rules(jitter=0.0)
    inputs = HistogramInputs(scenes, whole) if kind == "histograms" else TokenInputs(scenes, whole)
    mirrors = set()
    for seed in range(6):
        varied, plain = varied_and_plain(inputs, scenes, np.random.default_rng(seed))
        as_it_is = plain[0]
        if kind == "histograms":
            in_mirror = _mirrored(as_it_is)
        else:
            np.testing.assert_array_equal(varied[1], plain[1])
            in_mirror = as_it_is.copy()
            there = np.any(as_it_is != 0.0, axis=2)
            tokens = in_mirror[there]
            _mirror(tokens)
            in_mirror[there] = tokens
        mirrored = not np.allclose(varied[0], as_it_is, atol=1e-6)
        np.testing.assert_allclose(varied[0], in_mirror if mirrored else as_it_is, atol=1e-6)
        mirrors.add(mirrored)
    assert mirrors == {True, False}


def test_the_noise_on_counts_is_a_third_of_a_count_and_another_on_each(scenes: list[Examples]) -> None:
    (varied,), (plain,) = varied_and_plain(HistogramInputs(scenes, rules()), scenes, np.random.default_rng(0))
    # A mirror leaves what says nothing of left and right, and no noise reaches 0 or 1 from a fifth or four
    off, before = (values[:, [*range(62), *range(136, 146)]] for values in (varied - plain, plain))
    assert not off[before == 0.0].any()
    inside = off[(before > 0.2) & (before < 0.8)]
    assert inside.size > 300
    assert abs(inside.mean()) < 4 * 0.035 / np.sqrt(inside.size)
    assert inside.std() == pytest.approx(0.035, rel=0.15)
    assert np.median(np.std(off, axis=1, where=before > 0.2)) > 0.02


def test_the_noise_on_landmarks_is_the_documented_one_and_another_on_each(scenes: list[Examples]) -> None:
    (varied, _), (plain, weight) = varied_and_plain(TokenInputs(scenes, rules()), scenes, np.random.default_rng(0))
    there = (weight == 1.0) & np.any(plain != 0.0, axis=2)
    after, before = (t[there] for t in (varied, plain))
    for column in (0, 1, 2):
        ratio = np.log(after[:, column] / before[:, column])[(before[:, column] > 0.1) & (before[:, column] < 0.6)]
        assert ratio.size > 100
        assert ratio.std() == pytest.approx(0.1, rel=0.2)
    for column in (3, 4, 5, 6, 8):
        off = (after - before)[(before[:, column] > 0.1) & (before[:, column] < 0.9), column]
        assert off.size > 50
        assert off.std() == pytest.approx(0.02, rel=0.3)
    heat = slice(9, TOKEN_WIDTH)
    assert (after[:, heat] > 0.0).sum() == pytest.approx(0.7 * (before[:, heat] > 0.0).sum(), rel=0.1)
