"""The folder of a dataset: held by one run at a time, its settings, and what a killed run left in it."""

from __future__ import annotations

import contextlib
import dataclasses
import re
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TextIO

import msgspec

from fieldkit.errors import DatasetError, StoreError
from fieldkit.store import refuse_existing
from fieldkit.store.datasets import (
    DATASET_FILE,
    MAPS_FOLDER,
    SCENE_FILE,
    DatasetFile,
    is_dataset,
    read_dataset,
    read_scene,
    scene_path,
    write_dataset,
)
from fieldkit.store.files import locked, plain, saving

LOCK_FILE, WORK_FOLDER = ".lock", ".work"
# What a kill leaves of a file that was being written: a dot, the file's name, and eight letters of tempfile's.
_LEFT = r"\.({})\.[a-z0-9_]{{8}}"


@contextlib.contextmanager
def own(out: Path) -> Iterator[None]:
    """Hold the folder alone: two runs at once would do the same work twice. What was not there and stays empty goes."""
    if not is_dataset(out) and not _holds_only_maps(out):
        # A folder of something else: no --force replaces it, so none is asked for.
        refuse_existing(out, force=True, marker=DATASET_FILE, kind="folder")
    new = not out.exists()
    with _locked(out):
        try:
            yield
        finally:
            # Still locked: who opened this file meanwhile finds another one, or none, in its place, and asks again.
            with contextlib.suppress(OSError):
                (out / LOCK_FILE).unlink()
                if new:
                    out.rmdir()


def _locked(out: Path) -> TextIO:
    """Return the lock file, locked; raises DatasetError when another run holds it."""
    with saving(out):
        stream = locked(out / LOCK_FILE)
    if stream is None:
        raise DatasetError(f"{out}: another run is making it", hint="wait for it, or end it")
    return stream


def _holds_only_maps(out: Path) -> bool:
    """Tell whether a folder holds what a run leaves that was killed at once, or maps that were put there."""
    return out.is_dir() and {p.name for p in out.iterdir()} <= {LOCK_FILE, MAPS_FOLDER, WORK_FOLDER}


@dataclasses.dataclass(frozen=True)
class Plan:
    """What dataset.toml will say, whether it does already, and the scenes that may be made again.

    They are made again where their views keys are others now, or, with ``whatever``, in any case.
    """

    head: DatasetFile
    written: bool = False
    again: tuple[str, ...] = ()
    whatever: bool = False


def settle(out: Path, now: DatasetFile, *, force: bool) -> Plan:
    """Hold what is asked for against the dataset that is there; writes nothing.

    A scene belongs to a dataset once it has a scene.toml: others are forgotten unless they are named again, and their
    settings do not bind. Raises DatasetError when settings differ, unless ``force`` may redo all scenes of the dataset.
    """
    if not is_dataset(out):
        return Plan(now)
    before = read_dataset(out)
    again = tuple(name for name in now.scenes if force and name in before.scenes)
    made = [name for name in before.scenes if scene_path(out, name).is_file()]
    if not made:
        return Plan(now, again=again)
    difference = _difference(before, now)
    if difference is not None and not force:
        raise DatasetError(
            f"{out}: was made with other settings: {difference}",
            hint="give --force to make the scenes named again (maps that still fit are kept), or choose another --out",
        )
    others = [name for name in made if name not in now.scenes]
    if difference is not None and others:
        raise DatasetError(
            f"{out}: {', '.join(others)} was made with other settings: {difference}; expected the same for all scenes",
            hint="name all its scenes to make them again, or choose another --out",
        )
    kept = tuple(name for name in before.scenes if name in now.scenes or name in made)
    head = msgspec.structs.replace(now, scenes=(*kept, *(n for n in now.scenes if n not in kept)))
    written = difference is None and head.scenes == before.scenes
    return Plan(head, written, again, whatever=before.versions != now.versions)


def enter(out: Path, plan: Plan, keys: Mapping[str, str]) -> None:
    """Write dataset.toml as planned, after the scenes that are made again were taken away; the maps stay.

    ``keys`` are the views keys of these scenes as they are now.
    """
    with saving(out):
        for name in plan.again:
            if plan.whatever or _views_key(out, name) != keys[name]:
                _remove(out, name)
    if not plan.written:
        write_dataset(out, plan.head)


def _views_key(out: Path, scene: str) -> str | None:
    """Return the key that the shards of a scene were made with; None where that is not known any more."""
    try:
        return read_scene(out, scene).views_key
    except StoreError:
        return None


def _remove(out: Path, scene: str) -> None:
    """Remove a scene in one step, so that a kill leaves all of it or nothing."""
    if (out / scene).is_dir():
        (out / scene).rename(out / WORK_FOLDER / scene)
        shutil.rmtree(out / WORK_FOLDER / scene)


def tidy(out: Path, scenes: tuple[str, ...]) -> None:
    """Make an empty folder for work, and remove files that a kill left half written; what is not a run's own stays."""
    own = {out: DATASET_FILE, out / MAPS_FOLDER: r".+\.gauge\.toml"}
    own |= {out / name: rf"{SCENE_FILE}|.+\.npz" for name in scenes}
    with saving(out):
        shutil.rmtree(out / WORK_FOLDER, ignore_errors=True)
        (out / WORK_FOLDER).mkdir()
        for folder, names in own.items():
            for left in folder.glob(".*"):
                if re.fullmatch(_LEFT.format(names), left.name) and left.is_file():
                    left.unlink()


def _difference(before: DatasetFile, now: DatasetFile) -> str | None:
    """Return the first setting that differs between two datasets with its values, or None."""
    old, new = (_leaves({"rules": h.rules, "source": h.source, "versions": h.versions}) for h in (before, now))
    for key in {**old, **new}:
        if old.get(key) != new.get(key):
            return f"{key} is {old.get(key, 'not set')}; now it would be {new.get(key, 'not set')}"
    return None


def _leaves(values: Any, *, prefix: str = "") -> dict[str, Any]:
    """Return nested plain values by their dotted places; what is None is as good as missing."""
    result: dict[str, Any] = {}
    for key, value in plain(values).items():
        if isinstance(value, dict):
            result |= _leaves(value, prefix=f"{prefix}{key}.")
        elif value is not None:
            result[prefix + key] = list(value) if isinstance(value, tuple) else value
    return result
