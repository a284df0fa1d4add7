"""What an interrupted build has finished, kept beside its output until the map stands."""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import io
import json
import os
import shutil
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import FieldkitError, StoreError
from fieldkit.store.files import saving

T = TypeVar("T")
Arrays = Mapping[str, NDArray[np.generic]]

_KEY, _SECONDS, _LOCK = "key.txt", "seconds.json", "lock"


@dataclasses.dataclass(frozen=True)
class Stages:
    """The folder of a build that goes on: results of its stages by name, and the seconds that each took so far.

    Every result is read back from the folder, whether this process made it or one before: what comes next cannot
    tell, and so the map's bytes do not either.
    """

    folder: Path
    seconds: dict[str, float]

    def arrays(self, name: str, make: Callable[[], Arrays]) -> dict[str, NDArray[np.generic]]:
        """Return named arrays, made if they are not there yet or not whole."""
        path = self.folder / f"{name}.npz"
        found = _read_arrays(path)
        if found is None:
            stream = io.BytesIO()
            np.savez(stream, allow_pickle=False, **dict(make()))
            self.put(f"{name}.npz", lambda part: part.write_bytes(stream.getvalue()))
            found = _read_arrays(path)
            assert found is not None
        return found

    def put(self, name: str, write: Callable[[Path], object]) -> Path:
        """Return the path of a file or folder; what ``write`` makes takes its name once it is whole."""
        path = self.folder / name
        if not path.exists():
            part = path.with_name(f"{path.name}.part")
            with saving(path):
                path.parent.mkdir(parents=True, exist_ok=True)
                _remove(part)
                write(part)
                _flush(part)
                os.replace(part, path)
        return path

    @contextlib.contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the seconds of a stage, to those of the processes before."""
        start = time.perf_counter()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start
        part = self.folder / f"{_SECONDS}.part"
        with saving(self.folder):
            part.write_text(json.dumps(self.seconds))
            os.replace(part, self.folder / _SECONDS)


@contextlib.contextmanager
def resumed(out: Path, key: str) -> Iterator[Stages]:
    """Yield the stages of building ``out``; those of another ``key`` are thrown away.

    The folder ``.<name>.building`` beside ``out`` vanishes when the map is built, and when the source is at fault.
    After anything else, such as a kill or a full disk, it stays, and the same command goes on. Raises StoreError while
    another process builds the same map.
    """
    folder = out.parent / f".{out.name}.building"
    with saving(out):
        folder.mkdir(parents=True, exist_ok=True)
        lock = (folder / _LOCK).open("w")
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise StoreError(
                f"{out}: another process is building it; expected one at a time",
                hint="wait for it, or choose another --out",
            ) from error
        if not (folder / _KEY).is_file() or (folder / _KEY).read_text(encoding="utf-8") != key:
            with saving(out):
                for entry in folder.iterdir():
                    if entry.name != _LOCK:
                        _remove(entry)
                (folder / _KEY).write_text(key, encoding="utf-8")
        try:
            yield Stages(folder, _read_seconds(folder / _SECONDS))
        except FieldkitError as error:
            if not isinstance(error, StoreError):
                shutil.rmtree(folder, ignore_errors=True)
            raise
        shutil.rmtree(folder, ignore_errors=True)


def shares(items: Sequence[T], count: int) -> Iterator[tuple[int, Sequence[T]]]:
    """Yield (number, items) of shares of ``count`` items; the last may be smaller."""
    for number, first in enumerate(range(0, len(items), count)):
        yield number, items[first : first + count]


def _read_arrays(path: Path) -> dict[str, NDArray[np.generic]] | None:
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as content:
            return {name: content[name] for name in content.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        path.unlink()
        return None


def _read_seconds(path: Path) -> dict[str, float]:
    try:
        return {str(k): float(v) for k, v in json.loads(path.read_text(encoding="utf-8")).items()}
    except (OSError, ValueError, AttributeError, TypeError):
        return {}


def _flush(path: Path) -> None:
    """Have the content on disk before the name: a machine that loses power would leave names without content."""
    for file in (f for f in path.rglob("*") if f.is_file()) if path.is_dir() else [path]:
        with file.open("rb") as stream:
            os.fsync(stream.fileno())


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
