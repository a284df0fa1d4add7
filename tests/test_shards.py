"""Shards are refused, by their file's name, where they are not what was documented or lie where another belongs."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_source import make

from fieldkit import protocol
from fieldkit.dataset import count_scenes, replay_datasets
from fieldkit.errors import FieldkitError, StoreError
from fieldkit.store.datasets import read_shard, shard_path, write_shard

PAPER = protocol.load("paper_sim")
Arrays = dict[str, Any]


def head(**changes: Any) -> Callable[[Arrays], None]:
    """Return what changes entries of a head; functions change what is there."""

    def change(arrays: Arrays) -> None:
        entries = json.loads(bytes(arrays["head"]))
        for name, value in changes.items():
            entries[name] = value(entries[name]) if callable(value) else value
        arrays["head"] = np.frombuffer(json.dumps(entries).encode(), np.uint8)

    return change


def values(name: str, change: Callable[[Any], Any]) -> Callable[[Arrays], None]:
    """Return what replaces an array by what ``change`` makes of it."""
    return lambda arrays: arrays.update({name: change(arrays[name].copy())})


def put(index: Any, value: Any) -> Callable[[Any], Any]:
    def change(array: Any) -> Any:
        array[index] = value
        return array

    return change


FAULTS: list[tuple[Callable[[Arrays], Any], str]] = [
    (values("estimate", lambda a: a[:4]), r"estimate is float64 of shape \(4, 7\); expected float64 of shape \(5, 7\)"),
    (values("prior", lambda a: a[:3]), r"prior is float64 of shape \(3,\)"),
    (values("label", lambda a: a.astype(np.int64)), r"label is int64 .* expected bool"),
    (values("starts", lambda a: a[:-1]), r"starts is int64 of shape \(5,\); expected int64 of shape \(6,\)"),
    (values("starts", put(1, -1)), r"starts do not divide the landmarks"),
    (values("prior", put(slice(None), np.nan)), r"prior is not finite or has no unit quaternion"),
    (values("truth", put(0, np.nan)), r"truth is not finite"),
    (values("candidate", put((slice(None), slice(3, 7)), 0.0)), r"candidate .* no unit quaternion"),
    (values("covariance", put((0, 0, 0), np.inf)), r"covariance is not finite"),
    (values("error", put((0, 0), np.nan)), r"error and status contradict"),
    (values("uv_px", put((0, 0), np.nan)), r"uv_px is not finite"),
    (values("landmark", put(0, -1)), r"landmark is negative"),
    (values("repeat_view", put(0, 5)), r"repeat_view or repeat_number is out of range; expected 0\.\.4"),
    (values("repeat_error", put(0, np.nan)), r"repeat_error is nan"),
    (lambda arrays: arrays.pop("estimate"), r"not a readable shard"),
    (head(status=["ok"]), r"5 views, 5 kinds and 1 status"),
    (head(status=["no_pose"] * 5), r"estimate and status contradict"),
    (head(kinds=["bogus"] * 5), r"Invalid enum value 'bogus' - at `\$\.kinds\[0\]`"),
    (head(views=lambda v: [v[1], *v[1:]]), r"view 's0' is there twice"),
    (head(camera=["NOPE", 1, 2, 3]), r"unknown camera model 'NOPE'"),
    (head(camera=[]), r"not a readable shard"),
    (head(version="x"), r"\$\.version"),
    (head(version=2), r"version 2; this fieldkit reads version 1; update fieldkit"),
    (head(waypoint="w7"), r"is of tiny/w7; expected tiny/w0, as the file is named"),
    (head(scene="hall"), r"is of hall/w0; expected tiny/w0"),
    (head(key="0"), r"was made with other settings than tiny"),
]


@pytest.fixture
def damaged(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "set"))


def damage(out: Path, fault: Callable[[Arrays], Any]) -> Path:
    path = shard_path(out, "tiny", "w0")
    with np.load(path) as archive:
        arrays = dict(archive)
    fault(arrays)
    np.savez_compressed(path, **arrays)
    return path


@pytest.mark.parametrize(("fault", "message"), FAULTS, ids=[message for _, message in FAULTS])
def test_a_damaged_shard_is_named_wherever_it_is_read(
    fault: Callable[[Arrays], Any], message: str, damaged: Path
) -> None:
    damage(damaged, fault)
    with pytest.raises(StoreError, match=rf"tiny/w0\.npz: .*{message}"):
        count_scenes(damaged)


def test_replay_and_resume_refuse_the_shard_of_another_waypoint(damaged: Path) -> None:
    shutil.copy(shard_path(damaged, "tiny", "w1"), shard_path(damaged, "tiny", "w0"))
    message = r"tiny/w0\.npz: is of tiny/w1; expected tiny/w0.*; remove it and finish the dataset"
    with pytest.raises(StoreError, match=message):
        replay_datasets([damaged], protocol=PAPER, out=damaged / "run")
    assert not (damaged / "run").exists()
    with pytest.raises(FieldkitError, match=message):
        make(damaged)
    shard_path(damaged, "tiny", "w0").unlink()
    make(damaged)
    assert count_scenes(damaged)[0].waypoints == 3


def test_a_view_that_failed_has_no_pose_and_is_read_again(damaged: Path) -> None:
    path = shard_path(damaged, "tiny", "w0")
    shard = read_shard(path)
    failed = dataclasses.replace(
        shard,
        status=("no_matches", *shard.status[1:]),
        **{n: put(0, np.nan)(getattr(shard, n).copy()) for n in ("estimate", "covariance")},
        error=put(0, np.inf)(shard.error.copy()),
        label=put(0, False)(shard.label.copy()),
    )
    write_shard(path, failed)
    assert read_shard(path).status[0] == "no_matches"
    write_shard(path, dataclasses.replace(failed, label=put(0, True)(shard.label.copy())))
    with pytest.raises(StoreError, match=r"label and status contradict"):
        read_shard(path)
