"""The folder of a dataset: what force takes away, what a failure leaves, whose files are removed, and who may work."""

from __future__ import annotations

import dataclasses
import fcntl
import shutil
from pathlib import Path
from typing import Any, TextIO

import msgspec
import pytest
from tiny_source import RULES, SOURCE, TinySource, content, make

from fieldkit import maps, protocol
from fieldkit.dataset import count_scenes, folder, replay_datasets
from fieldkit.dataset.worker import map_key
from fieldkit.errors import DatasetError, FieldkitError, StoreError
from fieldkit.store.datasets import read_dataset, read_scene, scene_path, write_dataset

PAPER = protocol.load("paper_sim")
ANNEX = dataclasses.replace(SOURCE, name="annex", count=2)


@pytest.fixture(scope="module")
def both(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of two scenes: the same room under two names, so that one map is made."""
    out = Path(shutil.copytree(whole, tmp_path_factory.mktemp("both") / "set"))
    for made in list((out / "maps").iterdir()):
        ending = made.name.removeprefix(f"tiny-{map_key(SOURCE, RULES)[:16]}")
        other = out / "maps" / f"annex-{map_key(ANNEX, RULES)[:16]}{ending}"
        shutil.copytree(made, other) if made.is_dir() else shutil.copy(made, other)
    make(out, ANNEX)
    return out


@pytest.fixture
def pair(both: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(both, tmp_path / "set"))


def written(out: Path) -> dict[str, int]:
    """Return when each file was written: a file made again has another time."""
    return {str(p.relative_to(out)): p.stat().st_mtime_ns for p in out.rglob("*") if p.is_file()}


def test_force_makes_only_the_named_scenes_again_that_were_made_otherwise(pair: Path) -> None:
    before = written(pair)
    make(pair, ANNEX, force=True)
    assert written(pair) == before
    make(pair, dataclasses.replace(ANNEX, noise=9.0), force=True)
    after = written(pair)
    assert {name for name in before if after[name] != before[name]} == {
        f"annex/{name}" for name in ("scene.toml", "w0.npz", "w1.npz")
    }
    assert [row.scene for row in count_scenes(pair)] == ["tiny", "annex"]


def test_force_does_not_change_the_settings_under_scenes_that_are_not_named(pair: Path) -> None:
    before = content(pair)
    other = msgspec.structs.replace(RULES, repeats=1)
    with pytest.raises(DatasetError, match=r"set: tiny was made with other settings: rules\.repeats is 2; now .* 1;"):
        make(pair, ANNEX, force=True, rules=other)
    assert content(pair) == before


def test_a_source_that_cannot_be_used_leaves_everything_as_it_was(pair: Path, tmp_path: Path) -> None:
    before = content(pair)
    wide = dataclasses.replace(SOURCE, name="wide", count=99)
    for bad in ((SOURCE, wide), (dataclasses.replace(ANNEX, count=99),)):
        with pytest.raises(DatasetError, match=r"20 places; expected at least 99; ask for fewer waypoints"):
            make(pair, *bad, force=len(bad) == 1)
        assert content(pair) == before
    with pytest.raises(DatasetError, match=r"wide: 20 places"):
        make(tmp_path / "new", SOURCE, wide)
    assert {p.name for p in tmp_path.iterdir()} == {"set"}


def test_settings_bind_once_a_scene_is_there_and_scenes_once_they_are_named_or_made(pair: Path) -> None:
    head = read_dataset(pair)
    write_dataset(pair, msgspec.structs.replace(head, scenes=("tiny", "gone", "annex")))
    make(pair, ANNEX)
    assert read_dataset(pair) == head
    for scene in head.scenes:
        shutil.rmtree(pair / scene)
    other = msgspec.structs.replace(RULES, repeats=0)
    make(pair, ANNEX, rules=other)
    assert (read_dataset(pair).scenes, read_dataset(pair).rules) == (("annex",), other)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (dataclasses.replace(SOURCE, fault="twins"), r"view w0/s3 is there twice"),
        (dataclasses.replace(SOURCE, count=0), r"scene 'tiny': has no waypoint"),
    ],
)
def test_waypoints_and_views_are_there_once(source: TinySource, message: str, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=message):
        make(tmp_path / "set", source)
    assert not list(tmp_path.iterdir())


def test_only_files_that_a_run_left_half_written_are_removed(pair: Path) -> None:
    left = [
        ".dataset.toml.abcd_123",
        "tiny/.w0.npz.00000000",
        "tiny/.scene.toml.zzzzzzzz",
        "maps/.a.gauge.toml.abcdefgh",
    ]
    mine = [".git.ignore", "maps/.mine.txt", "tiny/.notes.md", "tiny/.w0.npz.Xy12Zw", "maps/.folder.kept/file"]
    before = content(pair)
    for name in left + mine:
        (pair / name).parent.mkdir(exist_ok=True)
        (pair / name).write_text("x")
    folder.tidy(pair, ("tiny", "annex"))
    assert set(content(pair)) == set(before) | set(mine)


def test_a_map_without_its_gauge_is_not_taken_away(pair: Path, tmp_path: Path) -> None:
    out = tmp_path / "other"
    shutil.copytree(pair / "maps", out / "maps")
    next(out.glob("maps/tiny-*.gauge.toml")).unlink()
    before = content(out)
    with pytest.raises(DatasetError, match=r"tiny-\w+\.map: has no tiny-\w+\.gauge\.toml beside it"):
        make(out)
    assert {name: data for name, data in content(out).items() if name != "dataset.toml"} == before


def test_a_gauge_that_is_no_pose_is_named(pair: Path) -> None:
    gauge = next(pair.glob("maps/tiny-*.gauge.toml"))
    text = gauge.read_text()
    for old, new in (("rms_m = ", "rms_m = nan # "), ("quaternion_xyzw = [", "quaternion_xyzw = [\n    0.0,")):
        gauge.write_text(text.replace(old, new))
        with pytest.raises(StoreError, match=r"\.gauge\.toml: "):
            replay_datasets([pair], protocol=PAPER, out=pair / "run")
    assert not (pair / "run").exists()


def test_a_lock_on_a_file_that_is_gone_is_no_lock(pair: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lock, flock = pair / ".lock", fcntl.flock
    others: list[TextIO] = []

    def late(stream: Any, how: int) -> None:
        """Lock after the run before has ended and another has begun."""
        if not others:
            lock.unlink()
            others.append(lock.open("w"))
            flock(others[0], fcntl.LOCK_EX)
        flock(stream, how)

    monkeypatch.setattr(fcntl, "flock", late)
    with pytest.raises(DatasetError, match=r"set: another run is making it"), folder.own(pair):
        pass
    others[0].close()
    assert lock.is_file()
    with folder.own(pair):
        assert lock.is_file()
    assert not lock.exists()


def test_a_map_is_the_same_for_any_number_of_threads(both: Path, tmp_path: Path) -> None:
    (tmp_path / "mapping").mkdir()
    SOURCE.write_mapping(tmp_path / "mapping")
    options = maps.MapOptions(n_threads=3, keep_record=False)
    maps.build_map(tmp_path / "mapping", tmp_path / "made.map", options=options)
    assert content(tmp_path / "made.map") == content(both / "maps" / read_scene(both, "tiny").map)
    assert repr(maps.MapOptions(n_threads=3)) == repr(maps.MapOptions())
    with pytest.raises(FieldkitError, match=r"n_threads is 0; expected a positive number"):
        maps.MapOptions(n_threads=0)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (r'"w0"', "", r"\$\.waypoints"),
        ('"w0"', '"w1"', r"names a waypoint twice"),
        ('"w0"', '"../w0"', r"names '\.\./w0'"),
        ('name = "annex"', 'name = "tiny"', r"names the scene 'tiny'"),
    ],
)
def test_a_scene_toml_that_cannot_be_is_refused_before_anything_is_written(
    old: str, new: str, message: str, pair: Path
) -> None:
    file = scene_path(pair, "annex")
    text = file.read_text().replace(old, new)
    file.write_text(text if new else text[: text.index("waypoints")] + "waypoints = []\n")
    with pytest.raises(StoreError, match=rf"annex/scene\.toml: .*{message}"):
        replay_datasets([pair], protocol=PAPER, out=pair / "run")
    assert not (pair / "run").exists()
