"""Learned policies in a map and in a replay: which weights are taken, what is left out by name, and why a view wins."""

from __future__ import annotations

import dataclasses
import logging
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from seeded_weights import seeded, write_seeded
from test_policies import look, make_candidates, make_map, wall
from tiny_source import SOURCE

from fieldkit import policies, protocol, scores, store
from fieldkit.dataset import replay_datasets
from fieldkit.errors import MapError, PolicyError, WeightsError
from fieldkit.features.appearance import APPEARANCES
from fieldkit.learned.checkpoint import visibility_of, write_checkpoint
from fieldkit.learned.scoring import Scorer
from fieldkit.maps import add_appearance, compact_map, load_map
from fieldkit.maps.appearance import write_appearance
from fieldkit.policies import learned
from fieldkit.protocol import OcclusionRules, Protocol, Threshold
from fieldkit.report import render
from fieldkit.store.datasets import map_path, read_dataset, read_scene
from fieldkit.types import Candidates, SceneMap
from fieldkit.views import landmark_tokens, seen_landmarks, thinned

PAPER = protocol.load("paper_sim")
NAMES = ("random", "max", "mlp", "vpt", "vpt_appearance", "vpt_dino", "best_possible")
RULES = Protocol("p", (Threshold(0.1, 1.0),), NAMES, occlusion=OcclusionRules(use=(False,)))


@pytest.fixture(autouse=True)
def nothing_shipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of shipped weights, empty whatever is shipped."""
    folder = tmp_path / "shipped"
    monkeypatch.setattr(learned, "shipped_weights", lambda: folder)
    return folder


@pytest.fixture
def scene_map(rng: np.random.Generator) -> SceneMap:
    xyz = rng.uniform([-4, -4, -1], [4, 4, 1], (400, 3))
    mapping = [look([*rng.uniform(-2, 2, 2), 0], yaw) for yaw in (0, 70, 140, 210, 280)]
    made = make_map(xyz, mapping)
    return dataclasses.replace(made, observation_px=rng.uniform([0, 0], [640, 480], (2000, 2)).astype(np.float32))


@pytest.fixture
def candidates() -> Candidates:
    """Eight views of which the fourth sees nothing and the last may not be chosen."""
    poses = [look([0.2, 0.1, 0], yaw) for yaw in range(0, 320, 45)]
    poses[3] = look([60, 0, 0], 0)
    return make_candidates(*poses, kinds=(*["sweep"] * 7, "stowed"))


def with_appearance(scene_map: SceneMap, network: str = "efficientnet") -> SceneMap:
    width = APPEARANCES[network].dense_width
    vectors = np.random.default_rng(1).normal(size=(len(scene_map.xyz), width)).astype(np.float16)
    return dataclasses.replace(scene_map, appearance={network: vectors})


@pytest.mark.parametrize("kind", ["mlp", "vpt", "vpt_appearance"])
def test_every_allowed_view_has_a_score_also_one_that_sees_nothing(
    kind: str, scene_map: SceneMap, candidates: Candidates
) -> None:
    look_at = policies.Looker(with_appearance(scene_map), RULES, checkpoints={kind: seeded(kind)})
    values = look_at.utilities(candidates)[kind, False]
    assert values[7] == -np.inf
    assert ((values[:7] > 0) & (values[:7] < 1)).all()
    assert len(set(values[:7].round(6).tolist())) > 3


@pytest.mark.parametrize("kind", ["mlp", "vpt"])
def test_views_with_and_without_the_filter_are_calibrated_each_in_its_own_way(
    kind: str, scene_map: SceneMap, candidates: Candidates
) -> None:
    # A surface that hides nothing: what the two rows say differs by their calibrations only
    known = dataclasses.replace(scene_map, surface=wall(50.0))
    rules = msgspec.structs.replace(RULES, occlusion=OcclusionRules(use=(False, True)))
    plain = policies.Looker(known, rules, checkpoints={kind: seeded(kind)})
    numbers = {"temperature": 2.0, "bias": -0.5, "temperature_unfiltered": 4.0, "bias_unfiltered": 1.0}
    looker = policies.Looker(known, rules, checkpoints={kind: seeded(kind, **numbers)})
    neutral, found = plain.utilities(candidates), looker.utilities(candidates)
    raw = log_odds_of(neutral[kind, False][:7])
    np.testing.assert_array_equal(neutral[kind, True], neutral[kind, False])
    np.testing.assert_allclose(log_odds_of(found[kind, True][:7]), raw / 2.0 - 0.5, atol=2e-5)
    np.testing.assert_allclose(log_odds_of(found[kind, False][:7]), raw / 4.0 + 1.0, atol=2e-5)
    for filtered, temperature in ((True, 2.0), (False, 4.0)):
        scene = plain._scene(candidates, occlusion=filtered)
        raised = [policies.open_learned(seeded(kind, **n), known).raised(scene, 0)[1] for n in ({}, numbers)]
        np.testing.assert_allclose(raised[1], raised[0] / temperature, atol=2e-5)
        assert np.ptp(raised[0]) > 1e-3


def log_odds_of(scores: np.ndarray) -> np.ndarray:
    return np.asarray(np.log(scores / (1.0 - scores)))


def test_the_landmarks_that_are_scored_stand_for_all_that_a_view_sees(
    scene_map: SceneMap, candidates: Candidates
) -> None:
    checkpoint = seeded("vpt", landmark_cap=16)
    looker = policies.Looker(scene_map, RULES, checkpoints={"vpt": checkpoint})
    scene, scorer = looker._scene(candidates, occlusion=False), Scorer(checkpoint)
    seen = [thinned(s, cap=16) for s in seen_landmarks(scene.visible, candidates, statistics=scene.statistics)][:7]
    visible = [len(i) for i in scene.visible.landmarks[:7]]
    assert sum(n > 16 for n in visible) >= 5
    tokens = [landmark_tokens(s, scene.statistics, heat_maps=scene.heat_maps, camera=candidates.camera) for s in seen]
    values = looker.utilities(candidates)["vpt", False][:7]
    np.testing.assert_allclose(values, scorer.scores(tokens, visible=visible), atol=1e-5)
    assert np.abs(values - scorer.scores(tokens)).max() > 1e-3


def test_appearance_counts_where_it_is_used(scene_map: SceneMap, candidates: Candidates) -> None:
    found = []
    for known in (with_appearance(scene_map), dataclasses.replace(with_appearance(scene_map), digest="other")):
        turned = {k: v[::-1] for k, v in known.appearance.items()} if known.digest == "other" else known.appearance
        looker = policies.Looker(
            dataclasses.replace(known, appearance=turned),
            RULES,
            checkpoints={k: seeded(k) for k in ("vpt", "vpt_appearance")},
        )
        found.append(looker.utilities(candidates))
    np.testing.assert_array_equal(found[0]["vpt", False], found[1]["vpt", False])
    assert np.abs(found[0]["vpt_appearance", False][:7] - found[1]["vpt_appearance", False][:7]).max() > 1e-4


def test_the_same_map_and_candidates_give_the_same_bits(scene_map: SceneMap, candidates: Candidates) -> None:
    once, again = (
        policies.Looker(scene_map, RULES, checkpoints={"vpt": seeded("vpt")}).utilities(candidates)["vpt", False]
        for _ in range(2)
    )
    np.testing.assert_array_equal(once, again)


def test_a_map_of_another_feature_is_scored_with_a_warning(
    scene_map: SceneMap, candidates: Candidates, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    other = dataclasses.replace(scene_map, feature="aliked")
    values = policies.Looker(other, RULES, checkpoints={"mlp": seeded("mlp")}).utilities(candidates)
    assert "lab.map: made with feature aliked; the weights of mlp were trained with sift" in caplog.text
    assert ("mlp", False) in values


def test_a_map_without_appearance_leaves_the_policy_out_by_name(scene_map: SceneMap, candidates: Candidates) -> None:
    checkpoints = {k: seeded(k) for k in ("vpt", "vpt_appearance")}
    looker = policies.Looker(scene_map, RULES, checkpoints=checkpoints)
    assert [e.what for e in looker.excluded] == ["vpt_appearance"]
    assert "lacks the appearance efficientnet" in looker.excluded[0].reason
    command = f"`fieldkit map appearance {scene_map.path} --source IMAGES --network efficientnet`"
    assert looker.excluded[0].reason.endswith(f"add it: {command}")
    dino = policies.Looker(scene_map, RULES, checkpoints={"vpt_dino": seeded("vpt_dino")}).excluded[0]
    assert dino.reason.endswith("--network dinov2`")
    assert {name for name, _ in looker.utilities(candidates)} == {"random", "max", "vpt"}
    with pytest.raises(PolicyError, match=r"vpt_appearance.*lacks the appearance efficientnet"):
        policies.open_learned(seeded("vpt_appearance"), scene_map)


def test_a_file_or_a_folder_of_weights_goes_before_what_is_shipped(tmp_path: Path, nothing_shipped: Path) -> None:
    write_seeded(nothing_shipped, "mlp", "vpt", seed=1)
    mine = tmp_path / "mine.safetensors"
    write_checkpoint(mine, seeded("vpt", seed=2))
    write_seeded(tmp_path / "folder", "mlp", seed=3)
    given_and_seeds = (
        ([], (1, 1)),
        ([mine], (1, 2)),
        ([tmp_path / "folder"], (3, 1)),
        ([mine, tmp_path / "folder"], (3, 2)),
    )
    for given, seeds in given_and_seeds:
        found, missing = policies.find_checkpoints(NAMES, given=given)
        assert (found["mlp"].about.seed, found["vpt"].about.seed) == seeds
        assert [e.what for e in missing] == ["vpt_appearance", "vpt_dino"]
        assert "has no weights in this version" in missing[0].reason


def test_shipped_weights_rank_without_a_replay(
    nothing_shipped: Path, scene_map: SceneMap, candidates: Candidates
) -> None:
    statistics = policies.Looker(scene_map, RULES)._statistics
    scene = policies.look_at(scene_map, statistics, candidates, rules=RULES.candidates)
    with pytest.raises(PolicyError, match="policy 'vpt' has no weights in this version; train it"):
        policies.available("vpt")
    write_seeded(nothing_shipped, "vpt")
    values = policies.utility(policies.available("vpt"), scene)
    expected = policies.Looker(scene_map, RULES, checkpoints={"vpt": seeded("vpt")}).utilities(candidates)
    np.testing.assert_array_equal(values, expected["vpt", False])


def test_weights_that_are_not_meant_are_refused(tmp_path: Path, nothing_shipped: Path) -> None:
    folder = write_seeded(tmp_path / "folder", "vpt")
    with pytest.raises(WeightsError, match=r"folder: has weights of vpt; expected those of one .*: mlp"):
        policies.find_checkpoints(("max", "mlp"), given=[folder])
    with pytest.raises(WeightsError, match="it has no learned policy"):
        policies.find_checkpoints(("max",), given=[folder])
    shutil.copy(folder / "vpt.safetensors", folder / "vpt_old.safetensors")
    with pytest.raises(
        WeightsError, match=r"vpt_old\.safetensors: is of the policy vpt, as \S+vpt\.safetensors is; expected one"
    ):
        policies.find_checkpoints(("vpt",), given=[folder])
    with pytest.raises(WeightsError, match="no such file"):
        policies.find_checkpoints(("vpt",), given=[tmp_path / "none"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(WeightsError, match=r"empty: holds no \*\.safetensors; expected checkpoints"):
        policies.find_checkpoints(("vpt",), given=[tmp_path / "empty"])
    write_checkpoint(nothing_shipped / "mlp.safetensors", seeded("vpt"))
    with pytest.raises(WeightsError, match=r"mlp\.safetensors: is of the policy vpt; expected mlp"):
        policies.find_checkpoints(("mlp",))


@pytest.mark.parametrize(("kind", "cap"), [("mlp", None), ("vpt", 64), ("vpt", 16), ("vpt_appearance", 64)])
def test_the_landmarks_that_raised_a_score_most_carry_it(
    kind: str, cap: int | None, scene_map: SceneMap, candidates: Candidates
) -> None:
    known, checkpoint = with_appearance(scene_map), seeded(kind, landmark_cap=cap)
    policy = policies.open_learned(checkpoint, known)
    looker = policies.Looker(known, RULES, checkpoints={kind: checkpoint})
    scene = looker._scene(candidates, occlusion=False)

    def log_odds(without: np.ndarray) -> float:
        """Score the first view as if some landmarks of the map could not be seen from it."""
        keep = [~np.isin(i, without) for i in scene.visible.landmarks]
        parts = [
            tuple(values[k] for values, k in zip(getattr(scene.visible, f.name), keep, strict=True))
            for f in dataclasses.fields(scene.visible)
        ]
        score = policy(dataclasses.replace(scene, visible=type(scene.visible)(*parts)))[0]
        return float(np.log(score / (1 - score)))

    landmarks, raised = policy.raised(scene, 0)
    assert set(landmarks) <= set(scene.visible.landmarks[0])
    assert len(landmarks) == min(cap or 512, len(scene.visible.landmarks[0])) > 10
    everything = log_odds(np.zeros(0, int))
    order = np.argsort(raised)
    assert everything - log_odds(landmarks[order[-1:]]) == pytest.approx(float(raised.max()), abs=2e-5)
    assert everything - log_odds(landmarks[order[:1]]) == pytest.approx(float(raised.min()), abs=2e-5)
    top, bottom = landmarks[order[-6:]], landmarks[order[:6]]
    assert log_odds(top) < everything < log_odds(bottom)


def test_a_view_that_sees_nothing_rests_on_no_landmark(scene_map: SceneMap, candidates: Candidates) -> None:
    for kind in ("mlp", "vpt"):
        looker = policies.Looker(scene_map, RULES, checkpoints={kind: seeded(kind)})
        only = dataclasses.replace(candidates, allowed=np.arange(8) == 3)
        values = looker.utilities(only)
        reason = looker.reasons(only, values)[kind, False]
        assert reason.view == "3"
        assert reason.landmarks.shape == (0, 3)
        none = dataclasses.replace(candidates, allowed=np.zeros(8, bool))
        assert looker.reasons(none, looker.utilities(none)) == {}


def test_a_dataset_is_replayed_with_learned_rows_and_names_those_it_cannot_have(whole: Path, tmp_path: Path) -> None:
    weights = write_seeded(tmp_path / "weights", "mlp", "vpt", "vpt_appearance")
    rules = msgspec.structs.replace(PAPER, policies=NAMES)
    replay_datasets([whole], protocol=rules, policy_weights=[weights], out=tmp_path / "run")
    run = store.read_run(tmp_path / "run")
    rows = {(s.policy, s.occlusion) for s in scores.summarize_run(run)}
    assert {("mlp", False), ("mlp", True), ("vpt", False), ("vpt", True)} <= rows
    assert not {"vpt_appearance", "vpt_dino"} & {policy for policy, _ in rows}
    reasons = {e.what: e.reason for e in run.excluded}
    assert "lacks the appearance efficientnet" in reasons["vpt_appearance"]
    assert "has no weights" in reasons["vpt_dino"]
    assert run.weights == {k: policies.find_checkpoints([k], given=[weights])[0][k].digest for k in ("mlp", "vpt")}
    for plan in run.plans:
        values = plan.utilities["vpt", True]
        assert (np.isfinite(values) == plan.candidates.allowed).all()


def test_the_table_of_a_run_compares_the_declared_policies(whole: Path, tmp_path: Path) -> None:
    weights = write_seeded(tmp_path / "w", "mlp", training_scenes=("tiny",))
    rules = msgspec.structs.replace(PAPER, policies=("random", "max", "angle", "mlp", "best_possible"))
    run = replay_datasets([whole], protocol=rules, out=tmp_path / "run", policy_weights=[weights])
    named = [("mlp", True), ("max", True)]
    script = Path(__file__).parents[1] / "docs" / "examples" / "sim_table.py"
    command = [sys.executable, str(script), str(whole), str(tmp_path / "run")]
    pictures = [tmp_path / "curves.png", tmp_path / "said.png"]
    wanted = ["--learned", "mlp", "--curves", str(pictures[0]), "--reliability", str(pictures[1])]
    done = subprocess.run([*command, *wanted], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    declared, _, others = done.stdout.partition("Declared before the run:")[2].partition("At the other thresholds:")
    assert declared.count("| mlp - max | yes | 0.1 m / 1 deg |") == declared.count("| mlp - angle | no |") == 1
    assert others.count("| mlp - max | yes |") == 5
    assert others.count("| mlp - max | no | 0.1 m / 1 deg |") == 1
    shares = {n: 100 * scores.recall(scores.group(run.trials)[n], Threshold(0.1, 1.0), pose="cam") for n in named}
    assert f"| yes | mlp {shares['mlp', True]:.1f} | max {shares['max', True]:.1f} |" in done.stdout
    assert "No test: mlp was trained or validated on tiny." in done.stdout
    assert "Not run: superpoint" in done.stdout
    assert all(p.stat().st_size > 1000 for p in pictures)
    refused = subprocess.run([*command, "--learned", "vpt"], capture_output=True, text=True, check=False)
    assert refused.returncode == 1
    assert "has no rows to compare vpt with max; expected both, each way" in refused.stderr


def test_a_run_that_lost_rows_is_still_told_from_one_without_weights(whole: Path, tmp_path: Path) -> None:
    rules = msgspec.structs.replace(PAPER, policies=("max", "mlp"))
    replay_datasets([whole], protocol=rules, out=tmp_path / "run")
    assert [e.what for e in store.read_run(tmp_path / "run").excluded] == ["mlp"]
    trials = tmp_path / "run" / "trials.csv"
    trials.write_text("".join(line for line in trials.read_text().splitlines(True) if ",max," not in line))
    with pytest.raises(store.runs.StoreError, match="has no row of max"):
        store.read_run(tmp_path / "run")


def test_why_a_view_was_preferred_is_kept_and_drawn(scene_map: SceneMap, tmp_path: Path) -> None:
    from synthetic_run import make_run

    run = make_run(0, n_visits=2)
    rng, reasons = np.random.default_rng(0), {}
    for k, variant in enumerate([("mlp", False), ("vpt", True)]):
        around = run.plans[0].prior.map_from_body.translation + rng.normal(size=(40, 3))
        raised = rng.normal(size=40).astype(np.float32)
        view = run.plans[0].candidates.view_ids[k]
        reasons[variant] = policies.looking.Reason(view, around.astype(np.float32), raised)
    plan = dataclasses.replace(run.plans[0], reasons=reasons)
    run = dataclasses.replace(run, plans=(plan, *run.plans[1:]), weights={"mlp": "5eed"})
    store.write_run(tmp_path / "run", run)
    found = store.read_run(tmp_path / "run")
    assert found.weights == {"mlp": "5eed"}
    assert found.plans[1].reasons == {}
    for variant, reason in reasons.items():
        kept = found.plans[0].reasons[variant]
        assert kept.view == reason.view
        np.testing.assert_array_equal(kept.landmarks, reason.landmarks)
        np.testing.assert_array_equal(kept.raised, reason.raised)
    page = render([found])
    assert page.count("Why: the landmarks on which the learned scores rest") == 1
    up = int((reasons["mlp", False].raised > 0).sum())
    assert f"40 landmarks asked for: {up} raised it, {40 - up} lowered it" in page
    whole = (tmp_path / "run" / "reasons.npz").read_bytes()
    (tmp_path / "run" / "reasons.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(store.runs.StoreError, match=r"reasons\.npz"):
        store.read_run(tmp_path / "run")


def test_rows_in_scenes_that_a_policy_was_trained_on_are_no_test(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    known = seeded("mlp", training_scenes=("office", "shop"), validation_scenes=("lobby",))
    policies.warn_known({"mlp": known}, ["clinic"])
    assert not caplog.text
    policies.warn_known({"mlp": known}, ["shop", "clinic", "lobby"])
    assert "mlp was trained on shop: its rows there are no test" in caplog.text
    assert "mlp was validated on lobby" in caplog.text


def test_a_run_keeps_on_which_scenes_its_policies_were_trained(whole: Path, tmp_path: Path) -> None:
    weights = write_seeded(tmp_path / "w", "mlp", training_scenes=("tiny", "office"))
    run = replay_datasets([whole], protocol=RULES, out=tmp_path / "run", policy_weights=[weights])
    again = store.read_run(tmp_path / "run")
    assert again.trained_on == run.trained_on == {"mlp": ("tiny", "office", "shop")}
    assert scores.in_sample(again) == {"mlp": ("tiny",)}
    assert "No test: mlp was trained or validated on tiny." in scores.table(again).caption
    assert scores.score_dict(again)["in_sample"] == {"mlp": ["tiny"]}
    elsewhere = dataclasses.replace(again, trained_on={"mlp": ("office",)})
    assert "No test" not in scores.table(elsewhere).caption


def test_a_protocol_that_sees_farther_than_training_is_told(
    scene_map: SceneMap, caplog: pytest.LogCaptureFixture
) -> None:
    near = visibility_of(RULES.candidates, tolerance_voxels=RULES.occlusion.tolerance_voxels)
    far = msgspec.structs.replace(RULES, candidates=msgspec.structs.replace(RULES.candidates, max_distance_m=8.0))
    for rules in (RULES, far):
        policies.Looker(scene_map, rules, checkpoints={"mlp": seeded("mlp", visibility=near)})
    assert [r.message for r in caplog.records] == [
        "mlp was trained with candidates.max_distance_m = 5, the protocol p has 8: scores may be less sure here"
    ]


def test_appearance_is_added_beside_a_map_and_belongs_to_it(whole: Path, tmp_path: Path) -> None:
    entry = read_scene(whole, read_dataset(whole).scenes[0])
    lab = Path(shutil.copytree(map_path(whole, entry), tmp_path / "lab.map"))
    before = load_map(lab)
    vectors = np.full((len(before.xyz), APPEARANCES["efficientnet"].dense_width), 0.5, np.float16)
    write_appearance(lab, "efficientnet", vectors, digest=before.digest)
    after = load_map(lab)
    assert after.digest == before.digest
    np.testing.assert_array_equal(after.appearance["efficientnet"], vectors)
    compact_map(lab, tmp_path / "small.map")
    np.testing.assert_array_equal(load_map(tmp_path / "small.map").appearance["efficientnet"], vectors)
    for bad, digest in ((vectors, "other"), (vectors[1:], before.digest), (vectors * np.nan, before.digest)):
        write_appearance(lab, "efficientnet", bad, digest=digest)
        known = load_map(lab)
        with pytest.raises(MapError, match=r"appearance-efficientnet\.npz: .*; expected"):
            known.appearance["efficientnet"]


def test_appearance_needs_the_images_of_the_map(whole: Path, tmp_path: Path) -> None:
    entry = read_scene(whole, read_dataset(whole).scenes[0])
    lab = Path(shutil.copytree(map_path(whole, entry), tmp_path / "lab.map"))
    source = tmp_path / "source"
    source.mkdir()
    SOURCE.write_mapping(source)
    (source / "images" / "03.png").rename(source / "images" / "other.png")
    with pytest.raises(MapError, match=r"source: has no image '03\.png' of the map .*lab\.map"):
        add_appearance(lab, source)
    (source / "images" / "other.png").rename(source / "images" / "03.png")
    add_appearance(lab, source)
    known = load_map(lab)
    found = known.appearance["efficientnet"].astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=2e-3)
    # Landmarks of one wall are seen by the same network at different places: they differ, yet not at random.
    assert 0.0 < np.ptp(found @ found[0]) < 1.0
    cv2.imwrite(str(source / "images" / "05.png"), np.zeros((100, 80), np.uint8))
    with pytest.raises(MapError, match=r"05\.png: is 80x100; expected 320x240"):
        add_appearance(lab, source, force=True)
