"""What is written reads back; what is damaged is named; nothing half-written is left."""

from __future__ import annotations

import dataclasses
import signal
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

from fieldkit import protocol, store
from fieldkit.cameras import Camera
from fieldkit.errors import StoreError
from fieldkit.frames import Pose, pose_error, yaw_pose
from fieldkit.types import (
    Candidates,
    Estimate,
    Excluded,
    PlanView,
    Prior,
    Run,
    TagMap,
    TagPhoto,
    TagPose,
    Trial,
    Truth,
    ViewResult,
    VisitPlan,
)

CAMERA = Camera("OPENCV", 4000, 3000, (2900.0, 2900.0, 2000.0, 1500.0, -0.148, 0.11, 0.0, 0.0))
PINHOLE = Camera("PINHOLE", 640, 480, (552.03, 552.03, 320.0, 240.0))
INF = float("inf")


def make_run() -> Run:
    pose = yaw_pose([1.0, 2.0, 0.5], 0.3)
    ok = Estimate(pose, np.eye(6) * 1e-4, 40, 30, "ok", 0.9, {"extract": 0.1, "pnp": 0.02})
    failed = Estimate(None, None, 3, 0, "no_matches", 0.0, {"extract": 0.1})
    prior = Prior("w01", pose, np.eye(6) * 1e-2, 5, 3.25, 7)
    candidates = Candidates(
        "w01", ("a", "b"), ("sweep", "forward"), (pose, pose), PINHOLE, np.array([True, False]), np.array([1.0, 0, 0])
    )
    utilities = {("max", True): np.array([3.0, -np.inf]), ("random", None): np.array([0.0, -np.inf])}
    trial = Trial("s", "w01", "max", True, "a", 1.0, 3.0, "ok", (0.1, 0.2), (INF, INF), (0.01, 0.02), (0.3, 0.04))
    return Run(
        protocol=msgspec.structs.replace(protocol.load("paper_real"), policies=("max",)),
        map_digest="m",
        tags_digest="t",
        recordings=("robot.mcap",),
        sessions=("s",),
        seed=0,
        versions={"numpy": "2"},
        trials=(trial,),
        results=(
            ViewResult("s", "w01", "a", "sweep", 11, ok),
            ViewResult("s", "w01", "b", "forward", 12, failed),
        ),
        truths=(("s", Truth("w01", "a", pose, Pose.identity(), np.eye(6), "tag")),),
        plans=(VisitPlan("s", prior, (0.3, 0.04), candidates, utilities),),
        plan_view=PlanView(np.zeros((3, 3), np.float32), np.ones((2, 3), np.float32)),
        thumbnails={"s/w01/a": b"jpeg"},
        excluded=(Excluded("s/w02", "the tripod tag was never seen"),),
    )


def test_a_run_reads_back(tmp_path: Path) -> None:
    run = make_run()
    store.write_run(tmp_path / "run", run)
    back = store.read_run(tmp_path / "run")
    assert back.protocol == run.protocol
    assert back.thumbnails == run.thumbnails
    assert back.excluded == run.excluded
    np.testing.assert_allclose(
        dataclasses.astuple(back.trials[0])[8], dataclasses.astuple(run.trials[0])[8], rtol=1e-12
    )
    assert back.trials[0].body_error == (INF, INF)
    assert [r.estimate.map_from_cam is None for r in back.results] == [False, True]
    assert back.results[1].estimate.status == "no_matches"
    np.testing.assert_array_equal(back.results[0].estimate.covariance, run.results[0].estimate.covariance)
    assert pose_error(back.truths[0][1].map_from_cam, run.truths[0][1].map_from_cam)[0] == 0
    plan = back.plans[0]
    np.testing.assert_array_equal(plan.utilities["max", True], run.plans[0].utilities["max", True])
    assert plan.candidates.camera == PINHOLE
    assert plan.candidates.allowed.tolist() == [True, False]
    np.testing.assert_array_equal(plan.candidates.forward_in_map, [1.0, 0, 0])


def test_the_seconds_of_building_the_map_are_kept_with_a_run(tmp_path: Path) -> None:
    built = dataclasses.replace(make_run(), map_seconds={"extract": 20.5, "match": 34.25})
    store.write_run(tmp_path / "run", built)
    assert store.read_run(tmp_path / "run").map_seconds == {"extract": 20.5, "match": 34.25}
    store.write_run(tmp_path / "old", make_run())
    assert store.read_run(tmp_path / "old").map_seconds == {}


def test_a_run_is_never_overwritten_without_force(tmp_path: Path) -> None:
    store.write_run(tmp_path / "run", make_run())
    with pytest.raises(StoreError, match="exists already; give --force"):
        store.write_run(tmp_path / "run", make_run())
    store.write_run(tmp_path / "run", dataclasses.replace(make_run(), seed=5), force=True)
    assert store.read_run(tmp_path / "run").seed == 5
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_force_never_replaces_a_folder_of_something_else(tmp_path: Path) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter1.txt").write_text("three years of work")
    with pytest.raises(StoreError, match=r"thesis: holds no run\.json, so --force does not replace it"):
        store.write_run(tmp_path / "thesis", make_run(), force=True)
    assert (tmp_path / "thesis" / "chapter1.txt").exists()


def test_a_file_cannot_replace_a_folder(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="is a folder; expected a file"):
        store.atomic_write(tmp_path, "text")


def out_of_reach(folder: Path, where: str) -> Path:
    """Return a path at which not even root can write."""
    (folder / "file").write_text("kept")
    (folder / "link").symlink_to(folder / "nowhere")
    places = {"below a file": folder / "file" / "a" / "out", "below a link": folder / "link" / "out"}
    return {**places, "system": Path("/proc/out"), "long name": folder / ("x" * 300)}[where]


REASONS = {
    "below a file": "cannot be written: .*file is a file; expected a folder",
    "below a link": "cannot be written: .*link is a link to nothing; expected a folder",
    "system": "cannot be written: .*; expected a place that can be written to",
}


@pytest.mark.parametrize("where", REASONS)
@pytest.mark.parametrize("kind", ["file", "folder", None])
def test_a_place_that_cannot_be_written_is_refused_before_the_work(tmp_path: Path, where: str, kind: object) -> None:
    path = out_of_reach(tmp_path, where)
    with pytest.raises(StoreError, match=f"out: {REASONS[where]}; choose another --out"):
        store.refuse_existing(path, force=True, kind=kind)
    with pytest.raises(StoreError, match=f"out: {REASONS[where]}"), store.atomic_folder(path):
        pytest.fail("the work began")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "link"]


@pytest.mark.parametrize("where", [*REASONS, "long name"])
def test_a_file_or_a_cache_that_cannot_be_written_is_one_line(tmp_path: Path, where: str) -> None:
    path = out_of_reach(tmp_path, where)
    with pytest.raises(StoreError, match=f"{path.name}: cannot be written: .*; expected .*; choose another --out"):
        store.atomic_write(path, "text")
    with pytest.raises(StoreError, match=f"{path.name}: cannot be written: "):
        store.EstimateCache(path).put("a", make_run().results[0].estimate)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "link"]


def test_a_place_that_is_lost_during_the_work_is_named_and_nothing_is_left(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    out = tmp_path / "deep" / "out"
    with pytest.raises(StoreError, match="out: cannot be written: No such file"), store.atomic_folder(out) as work:
        work.rmdir()
    assert list((tmp_path / "deep").iterdir()) == []


def test_a_dangling_link_counts_as_existing(tmp_path: Path) -> None:
    link = tmp_path / "out"
    link.symlink_to(tmp_path / "nowhere")
    with pytest.raises(StoreError, match="out: exists already"):
        store.refuse_existing(link, force=False)
    with pytest.raises(StoreError, match=r"out: holds no run\.json"):
        store.write_run(link, make_run(), force=True)
    with store.atomic_folder(link, force=True) as work:
        (work / "new.txt").write_text("new")
    assert not link.is_symlink()
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_file_takes_no_folder_s_place_and_a_folder_no_file_s(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    with pytest.raises(StoreError, match="folder: is a folder; expected a file"):
        store.refuse_existing(tmp_path / "folder", force=True, kind="file")
    with pytest.raises(StoreError, match="file: is a file; expected a folder"):
        store.refuse_existing(tmp_path / "file", force=True, kind="folder")
    store.refuse_existing(tmp_path / "file", force=True, kind="file")
    store.refuse_existing(tmp_path / "folder", force=False, kind="folder")
    with pytest.raises(StoreError, match="has no name of its own"):
        store.refuse_existing(Path("."), force=False)


def test_a_cache_that_cannot_be_read_is_named_and_garbage_is_ignored(tmp_path: Path) -> None:
    (tmp_path / "cache").mkdir()
    with pytest.raises(StoreError, match="cache: is a folder; expected a file"):
        store.EstimateCache(tmp_path / "cache").get("a")
    (tmp_path / "garbage").write_bytes(b"\xff\xfe\n5\n[]\n{}\n")
    assert store.EstimateCache(tmp_path / "garbage").get("a") is None


def test_a_disk_that_fills_up_is_one_line_and_leaves_nothing(tmp_path: Path) -> None:
    code = f"""
import resource
from pathlib import Path
from fieldkit import errors, store
resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))
import signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
try:
    with store.atomic_folder(Path({str(tmp_path / "out")!r})) as work:
        (work / "new.bin").write_bytes(bytes(20_000))
except errors.StoreError as error:
    print(error)
"""
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "out: cannot be written: File too large; expected room for all of it" in found.stdout
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_process_left_of_a_folder_is_removed(tmp_path: Path) -> None:
    code = f"""
import os, signal
from pathlib import Path
from fieldkit import store
with store.atomic_folder(Path({str(tmp_path / "out")!r})) as work:
    (work / "half.txt").write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -signal.SIGKILL
    (tmp_path / ".out.notes").mkdir()
    assert len(list(tmp_path.iterdir())) == 2
    with store.atomic_folder(tmp_path / "out") as mine, store.atomic_folder(tmp_path / "other"):
        assert sorted(p.name for p in tmp_path.iterdir() if p.name.startswith(".out")) == [".out.notes", mine.name]


def test_a_folder_that_fails_half_way_leaves_the_old_one(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "old.txt").write_text("old")

    def fail_half_way() -> None:
        with store.atomic_folder(tmp_path / "out", force=True) as work:
            (work / "new.txt").write_text("new")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_half_way()
    assert [p.name for p in tmp_path.iterdir()] == ["out"]
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["old.txt"]


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        ("trials.csv", ("0.1", "none"), r"trials\.csv: line 2: could not convert"),
        ("trials.csv", ("utility", "use"), r"trials\.csv: lacks the columns utility"),
        ("trials.csv", (",max,", ",fim,"), r"trials\.csv: has no row of max at s/w01; expected every policy"),
        ("estimates.csv", ("sweep", "swoop"), r"estimates\.csv: line 2: unknown kind of view 'swoop'"),
        ("run.json", ('"version": 1', '"version": 2'), r"run\.json: version 2; this fieldkit reads version 1"),
        ("run.json", ('"seed"', '"sed"'), r"run\.json: .*unknown field `sed`.*did you mean 'seed'"),
    ],
)
def test_a_damaged_run_is_named(tmp_path: Path, file: str, change: tuple[str, str], message: str) -> None:
    store.write_run(tmp_path / "run", make_run())
    path = tmp_path / "run" / file
    path.write_text(path.read_text().replace(*change))
    with pytest.raises(StoreError, match=message):
        store.read_run(tmp_path / "run")


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"not a run folder; expected run\.json"):
        store.read_run(tmp_path)


def test_tags_read_back(tmp_path: Path) -> None:
    covariance = np.diag([1e-6, 2e-6, 3e-6, 1e-4, 2e-4, 3e-4])
    tag = TagPose(2, "tag36h11", 0.1365, yaw_pose([1, 2, 3], 0.4), covariance, 6, 0.3, visit="w01", verdict="warn")
    photo = TagPhoto("a.jpg", 2, False, "not localized", "w01", 0.1, 4.0)
    store.write_tags(tmp_path / "tags.toml", TagMap((tag,), (photo,), "digest"))
    back = store.read_tags(tmp_path / "tags.toml")
    assert back.photos == (photo,)
    assert back.map_digest == "digest"
    np.testing.assert_array_equal(back.tags[0].covariance, covariance)
    assert pose_error(back.tags[0].map_from_tag, tag.map_from_tag)[0] == 0
    assert back.find(2, visit="w01") is back.tags[0]
    assert back.find(2, visit="w02") is None


def test_what_a_calibration_found_out_reads_back_and_may_be_missing(tmp_path: Path) -> None:
    plain = TagPose(2, "tag36h11", 0.1365, yaw_pose([1, 2, 3], 0.4), np.eye(6), 6, 0.3)
    full = dataclasses.replace(plain, id=3, leave_one_out=(0.002, 0.01), size_from_map=(0.1371, 0.0002))
    photo = TagPhoto("a.jpg", 3, True, flipped=True)
    path = tmp_path / "tags.toml"
    store.write_tags(path, TagMap((plain, full), (photo,), "digest"))
    back = store.read_tags(path)
    assert back.photos == (photo,)
    assert (back.tags[0].leave_one_out, back.tags[0].size_from_map) == (None, None)
    assert back.tags[1].leave_one_out == pytest.approx((0.002, 0.01))
    assert back.tags[1].size_from_map == (0.1371, 0.0002)
    path.write_text(path.read_text().replace("flipped = true\n", ""))
    assert not store.read_tags(path).photos[0].flipped


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("size_m = 0.1365", "size_m = -1.0"), "> 0"),
        (("size_m", "sise_m"), "sise_m"),
        (("family", "familly"), "familly"),
        (("version = 1", "version = 3"), "version 3"),
    ],
)
def test_a_wrong_tag_file_is_named(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    tag = TagPose(2, "tag36h11", 0.1365, yaw_pose([1, 2, 3], 0.4), np.eye(6), 6, 0.3)
    path = tmp_path / "tags.toml"
    store.write_tags(path, TagMap((tag,), (), "digest"))
    path.write_text(path.read_text().replace(*change))
    with pytest.raises(StoreError, match=rf"tags\.toml: .*{message}"):
        store.read_tags(path)


def test_a_camera_reads_back_and_a_wrong_one_is_named(tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    store.write_camera(path, CAMERA)
    assert store.read_camera(path) == CAMERA
    path.write_text(path.read_text().replace("OPENCV", "OPENCW"))
    with pytest.raises(StoreError, match=r"camera\.toml: unknown camera model 'OPENCW'.*did you mean 'OPENCV'"):
        store.read_camera(path)
    with pytest.raises(StoreError, match=r"none\.toml: no such file; expected camera\.toml"):
        store.read_camera(tmp_path / "none.toml")


def test_a_rig_reads_back(tmp_path: Path) -> None:
    rig = store.Rig((store.RigCamera("lf", PINHOLE, yaw_pose([0.1, 0, 0], 0.2)),))
    store.write_rig(tmp_path / "rig.toml", rig)
    back = store.read_rig(tmp_path / "rig.toml")
    assert back.cameras[0].camera == PINHOLE
    assert back.depth is None
    assert pose_error(back.cameras[0].rig_from_cam, rig.cameras[0].rig_from_cam)[0] == 0


def test_tum_poses_read_back_and_a_wrong_line_is_named(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    store.write_tum(path, [("lf/000001.jpg", yaw_pose([1, 2, 3], 0.4))])
    name, pose = store.read_tum(path)[0]
    assert name == "lf/000001.jpg"
    assert pose_error(pose, yaw_pose([1, 2, 3], 0.4))[0] < 1e-8
    path.write_text("# a comment\na 1 2 3 0 0 0 1\nb 1 2 3 0 0 0\n")
    with pytest.raises(StoreError, match=r"poses\.txt: line 3: 7 fields; expected"):
        store.read_tum(path)


def test_the_cache_survives_a_line_that_a_kill_cut_off(tmp_path: Path) -> None:
    run = make_run()
    cache = store.EstimateCache(tmp_path / "cache.jsonl")
    for key, result in zip("ab", run.results, strict=True):
        cache.put(key, result.estimate)
    with cache.path.open("a") as stream:
        stream.write('{"key": "c", "pose": [1.0, 2')
    again = store.EstimateCache(cache.path)
    assert again.get("b").status == "no_matches"
    np.testing.assert_array_equal(again.get("a").covariance, run.results[0].estimate.covariance)
    assert again.get("c") is None
    again.put("d", run.results[1].estimate)
    assert store.EstimateCache(cache.path).get("d").status == "no_matches"


def test_json_has_no_nan_or_infinity() -> None:
    assert store.plain_json({"a": [np.float64("inf"), float("nan"), 1.5]}).split() == [
        "{", '"a":', "[", "null,", "null,", "1.5", "]", "}",
    ]  # fmt: skip
