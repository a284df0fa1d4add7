"""Files that are written whole or not at all, strict reading, and digests of content."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import json
import math
import os
import re
import shutil
import socket
import tempfile
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, TextIO, TypeVar

import msgspec
import numpy as np
import tomli_w

from fieldkit.errors import StoreError, suggestion

T = TypeVar("T", bound=msgspec.Struct)

# What a file system says that has no more room, or has broken, whatever is written.
_DISK_ERRORS = frozenset({errno.ENOSPC, errno.EFBIG, errno.EDQUOT, errno.EROFS, errno.EIO})


@contextlib.contextmanager
def saving(path: Path) -> Iterator[None]:
    """Turn what the file system says against writing ``path`` into a StoreError that names it."""
    try:
        yield
    except IsADirectoryError as error:
        raise StoreError(f"{path}: is a folder; expected a file", hint="choose another --out") from error
    except OSError as error:
        # The names of temporary files say nothing; a folder above does.
        above = None if error.filename is None else Path(os.fsdecode(error.filename))
        place = f" ({above})" if above in Path(path).parents else ""
        raise StoreError(
            f"{path}: cannot be written: {error.strerror or error}{place}; expected a place that can be written to",
            hint="choose another --out",
        ) from error


def locked(path: Path) -> TextIO | None:
    """Return the file ``path``, made if need be and locked until it is closed; None while another process holds it."""
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        stream = path.open("w")
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Its last holder may have removed it meanwhile
            if os.path.samestat(os.fstat(stream.fileno()), os.stat(path)):
                return stream
        except FileNotFoundError:
            pass
        except BlockingIOError:
            stream.close()
            return None
        stream.close()


def atomic_write(path: Path, data: bytes | str) -> None:
    """Write a file so that a reader or a killed process finds the old content or the new, never a part.

    Raises StoreError when it cannot be written.
    """
    path = Path(path)
    content = data.encode("utf-8") if isinstance(data, str) else data
    with saving(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(handle, "wb") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            os.chmod(name, 0o644)
            os.replace(name, path)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise


@contextlib.contextmanager
def atomic_folder(path: Path, *, force: bool = False, marker: str | None = None) -> Iterator[Path]:
    """Yield an empty folder beside ``path`` that takes its place on success and vanishes on failure.

    What a killed process left of the same folder is removed first. Raises StoreError as `refuse_existing` does, which
    is asked again before the folder is replaced, when the folder cannot be made, or when the disk is full.
    """
    path = Path(path)
    refuse_existing(path, force=force, marker=marker, kind="folder")
    with saving(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_leftovers(path)
        work = Path(tempfile.mkdtemp(dir=path.parent, prefix=f"{_own_prefix(path)}{os.getpid()}."))
    try:
        try:
            yield work
        except OSError as error:
            if error.errno not in _DISK_ERRORS:
                raise
            raise StoreError(
                f"{path}: cannot be written: {error.strerror}; expected room for all of it",
                hint="make room, or choose another --out",
            ) from error
        refuse_existing(path, force=force, marker=marker, kind="folder")
        with saving(path):
            work.chmod(0o755)
            _replace(work, path)
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _own_prefix(path: Path) -> str:
    return f".{path.name}.{re.sub(r'[^A-Za-z0-9-]', '-', socket.gethostname())}-"


def _remove_leftovers(path: Path) -> None:
    """Remove unfinished folders of ``path`` whose process, on this host, is no more."""
    prefix = _own_prefix(path)
    for found in path.parent.iterdir():
        pid = found.name.removeprefix(prefix).split(".")[0] if found.name.startswith(prefix) else ""
        if pid.isdecimal() and not _runs(int(pid)):
            shutil.rmtree(found, ignore_errors=True)


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def _replace(work: Path, path: Path) -> None:
    if not os.path.lexists(path):
        work.rename(path)
        return
    # A folder cannot replace a full one in one step: the old one is kept aside until the new one stands.
    old = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}.old.")) / path.name
    path.rename(old)
    try:
        work.rename(path)
    except BaseException:
        old.rename(path)
        raise
    finally:
        shutil.rmtree(old.parent, ignore_errors=True)


def refuse_existing(
    path: Path, *, force: bool, marker: str | None = None, kind: Literal["file", "folder"] | None = None
) -> None:
    """Raise StoreError when ``path`` cannot be written, or something stands there that may not be replaced.

    Asked before the work starts, so that nobody waits for a result that has no place. An empty folder may be replaced
    by a folder. With ``force`` anything of the same ``kind`` may be that holds the file ``marker``, by which a folder
    of the same sort is known: a mistyped --out never wipes a folder of something else.
    """
    path = Path(path)
    if path.name in ("", ".."):
        raise StoreError(f"{path}: has no name of its own; expected a new name", hint="choose another --out")
    with saving(path):
        if not os.path.lexists(path):
            _refuse_parent(path)
            return
        if kind is not None and path.exists() and path.is_dir() != (kind == "folder"):
            found = "folder" if path.is_dir() else "file"
            raise StoreError(f"{path}: is a {found}; expected a {kind}", hint="choose another --out")
        if path.is_dir() and not any(path.iterdir()):
            _refuse_parent(path)
            return
        if not force:
            raise StoreError(f"{path}: exists already", hint="give --force to replace it, or choose another --out")
        if marker is not None and not (path / marker).is_file():
            raise StoreError(
                f"{path}: holds no {marker}, so --force does not replace it", hint="remove it, or choose another --out"
            )
        _refuse_parent(path)


def _refuse_parent(path: Path) -> None:
    """Raise StoreError or OSError when nothing can be made in the nearest folder above ``path`` that exists."""
    above = path.parent
    while not os.path.lexists(above):
        above = above.parent
    if not above.is_dir():
        found = "a file" if above.exists() else "a link to nothing"
        raise StoreError(
            f"{path}: cannot be written: {above} is {found}; expected a folder", hint="choose another --out"
        )
    # Trying is the only test that also knows read-only disks and folders in which not even root may write. The file
    # has no name, where the file system can do that, and is gone when it is closed.
    with tempfile.TemporaryFile(dir=above):
        pass


def digest(*parts: bytes | str | Path) -> str:
    """Return the SHA-256 (hex, 32 digits) of byte strings, texts and files in the order given."""
    total = hashlib.sha256()
    for part in parts:
        if isinstance(part, Path):
            with part.open("rb") as stream:
                while block := stream.read(1 << 20):
                    total.update(block)
        else:
            total.update(part.encode("utf-8") if isinstance(part, str) else part)
        total.update(b"\0")
    return total.hexdigest()[:32]


def read_text(path: Path, *, what: str) -> str:
    """Read a text file; raises StoreError when it is missing, not readable, or not text."""
    try:
        return Path(path).read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise StoreError(f"{path}: no such file; expected {what}", hint="check the path") from error
    except (OSError, UnicodeDecodeError) as error:
        raise StoreError(f"{path}: cannot be read as text; expected {what}", hint="check the file") from error


def read_toml(path: Path, struct: type[T], *, what: str) -> T:
    """Read a TOML file into a struct; unknown keys, wrong types and newer versions raise StoreError with the place."""
    text = read_text(path, what=what)
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise StoreError(f"{path}: not valid TOML: {error}; expected {what}", hint="correct the file") from error
    return convert(values, struct, path=Path(path), what=what)


def read_json(path: Path, struct: type[T], *, what: str) -> T:
    """Read a JSON file into a struct, as strictly as `read_toml`."""
    try:
        values = json.loads(read_text(path, what=what))
    except json.JSONDecodeError as error:
        raise StoreError(f"{path}: not valid JSON: {error}; expected {what}", hint="correct the file") from error
    return convert(values, struct, path=Path(path), what=what)


def convert(values: Any, struct: type[T], *, path: Path, what: str) -> T:
    """Check plain values against a struct; errors name the file and the place inside it."""
    version = values.get("version", 1) if isinstance(values, dict) else 1
    if isinstance(version, int) and version > 1:
        raise StoreError(f"{path}: version {version}; this fieldkit reads version 1", hint="update fieldkit")
    if isinstance(version, int) and version < 1:
        raise StoreError(f"{path}: version {version}; this fieldkit reads version 1", hint="make it again")
    try:
        return msgspec.convert(values, struct)
    except msgspec.ValidationError as error:
        unknown = re.match(r"Object contains unknown field `(.+?)`", str(error))
        if unknown and " - at " not in str(error):
            hint = suggestion(unknown.group(1), list(struct.__struct_fields__))
        else:
            hint = "correct the file"
        raise StoreError(f"{path}: {error}; expected {what}", hint=hint) from error


def write_toml(path: Path, values: Any) -> None:
    """Write a struct or plain values as TOML, without keys that are None."""
    atomic_write(path, tomli_w.dumps(_without_none(plain(values))))


def plain(values: Any) -> Any:
    """Turn structs, arrays and numpy numbers into plain values."""

    def hook(value: Any) -> Any:
        if isinstance(value, np.ndarray | np.generic):
            return value.tolist()
        raise TypeError(f"cannot store {type(value)}")

    return msgspec.to_builtins(values, enc_hook=hook)


def plain_json(values: Any) -> str:
    """Return JSON text without NaN or Infinity: such numbers become null."""
    return json.dumps(_finite(plain(values)), indent=1, allow_nan=False) + "\n"


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _without_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without_none(v) for k, v in value.items() if v is not None}
    if isinstance(value, list | tuple):
        return [_without_none(v) for v in value]
    return value
