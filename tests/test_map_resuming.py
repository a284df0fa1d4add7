"""A build that was killed goes on where it stopped, and nobody can tell from the map."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tiny_source import content
from tiny_walk import write_walk

from fieldkit.errors import MapError, StoreError
from fieldkit.maps import MapOptions, build_map
from fieldkit.maps.stages import Stages, resumed

KILLED = """
import os, signal, sys
from pathlib import Path
from fieldkit.maps import MapOptions, build_map
source, out, step, count = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], int(sys.argv[4])
def progress(what, done, total):
    if what == step and done >= count:
        os.kill(os.getpid(), signal.SIGKILL)
build_map(source, out, force=True, options=MapOptions(max_keypoints=500, n_threads=1), progress=progress)
"""
OPTIONS = MapOptions(max_keypoints=500, n_threads=1)


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("walk") / "source"
    write_walk(folder, n=12)
    return folder


@pytest.fixture(scope="module")
def undisturbed(source: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """All bytes of the map that is built in one go."""
    out = tmp_path_factory.mktemp("undisturbed") / "lab.map"
    build_map(source, out, options=OPTIONS)
    return lasting(out)


def lasting(out: Path) -> dict[str, bytes]:
    """Return the files of a map without the one that says how long it took."""
    return {name: data for name, data in content(out).items() if name != "build.json"}


def kill(source: Path, out: Path, step: str, count: int) -> None:
    done = subprocess.run([sys.executable, "-c", KILLED, source, out, step, str(count)], check=False, timeout=120)
    assert done.returncode == -signal.SIGKILL


def test_a_build_killed_twice_goes_on_and_gives_the_same_bytes(
    source: Path, undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    out = tmp_path / "lab.map"
    kill(source, out, "extract", 5)
    assert not out.exists()
    kept = {p.name for p in (tmp_path / ".lab.map.building" / "features").glob("*.npz")}
    assert {"000000.npz", "000001.npz", "000002.npz"} <= kept
    kill(source, out, "reconstruct", 6)
    assert not out.exists()
    steps: list[str] = []
    report = build_map(source, out, options=OPTIONS, progress=lambda step, done, total: steps.append(step))
    assert "verify" not in steps
    assert steps.count("match") == 1
    assert lasting(out) == undisturbed
    assert [p.name for p in tmp_path.iterdir()] == ["lab.map"]
    assert json.loads((out / "build.json").read_text())["seconds"]["verify"] > 0
    assert report.seconds["verify"] > 0


def test_a_build_with_other_settings_starts_over_and_an_old_map_stays_until_then(
    source: Path, undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    out = tmp_path / "lab.map"
    build_map(source, out, options=MapOptions(max_keypoints=400, n_threads=1))
    old = content(out)
    assert lasting(out) != undisturbed
    kill(source, out, "surface", 3)
    assert content(out) == old
    steps: list[str] = []
    again = MapOptions(max_keypoints=400, n_threads=1)
    build_map(source, out, force=True, options=again, progress=lambda step, done, total: steps.append(step))
    assert "verify" in steps
    assert lasting(out) == {k: v for k, v in old.items() if k != "build.json"}
    assert [p.name for p in tmp_path.iterdir()] == ["lab.map"]


def test_stages_of_another_key_are_thrown_away_and_those_of_a_mistake_too(tmp_path: Path) -> None:
    def once(value: float, key: str, *, error: type[BaseException] | None = None) -> float:
        with resumed(tmp_path / "lab.map", key) as stages:
            found = float(stages.arrays("a/b", lambda: {"x": np.array([value])})["x"][0])
            if error is not None:
                raise error("halt")
            return found

    for error in (KeyboardInterrupt, StoreError):
        with pytest.raises(error):
            once(1.0, "first", error=error)
    assert once(2.0, "first") == 1.0
    with pytest.raises(KeyboardInterrupt):
        once(3.0, "first", error=KeyboardInterrupt)
    assert once(4.0, "second") == 4.0
    with pytest.raises(MapError):
        once(5.0, "second", error=MapError)
    assert not list(tmp_path.iterdir())


def test_a_cut_off_stage_is_made_again_and_half_a_stage_is_none(tmp_path: Path) -> None:
    stages = Stages(tmp_path, {})
    stages.arrays("x", lambda: {"x": np.arange(3)})
    (tmp_path / "x.npz").write_bytes(b"PK\x03\x04 cut off")
    assert stages.arrays("x", lambda: {"x": np.arange(4)})["x"].tolist() == [0, 1, 2, 3]

    def fail(part: Path) -> None:
        part.mkdir()
        (part / "database.db-journal").write_text("old")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stages.put("pairs", fail)
    made = stages.put("pairs", lambda part: part.mkdir())
    assert not list(made.iterdir())


def test_two_processes_do_not_build_one_map(tmp_path: Path) -> None:
    out = tmp_path / "lab.map"
    refused = pytest.raises(StoreError, match="another process is building it")
    with resumed(out, "key"), refused, resumed(out, "key"):
        pass
