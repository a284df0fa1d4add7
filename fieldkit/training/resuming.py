"""What a training keeps after every epoch, so that a killed one goes on: beside the checkpoint that is being made."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import StoreError, TrainingError
from fieldkit.store.files import atomic_write, convert, locked, plain, saving

Tensors = Mapping[str, NDArray[Any]]
_KEY = "fieldkit-training"
WHAT = "the state of an unfinished training"


class Epoch(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What one pass over the training views came to.

    ``loss`` of training, ``validation_loss`` with calibrated probabilities, and ``chosen``: the share of validation
    waypoints whose best view of half of the candidates localizes, with and without the occlusion filter in equal parts.
    """

    loss: float
    validation_loss: float
    chosen: float


class _Head(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    version: Literal[1]
    key: str
    best: int
    history: tuple[Epoch, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class State:
    """After an epoch: network, optimizer, the best network so far, and what the epochs came to."""

    network: Tensors
    optimizer: Tensors
    kept: Tensors
    best: int
    history: tuple[Epoch, ...]


def state_path(out: Path) -> Path:
    """Return where the state of an unfinished training of a checkpoint lies."""
    return out.with_name(f".{out.name}.training")


@contextlib.contextmanager
def alone(out: Path) -> Iterator[None]:
    """Hold a checkpoint that is being made: two trainings at once would write one's card beside the other's weights."""
    path = out.with_name(f".{out.name}.lock")
    with saving(out):
        stream = locked(path)
    if stream is None:
        raise TrainingError(f"{out}: another training is making it", hint="wait for it, or give another --out")
    with stream:
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def write_state(out: Path, state: State, *, key: str) -> None:
    """Write the state beside a checkpoint that is not there yet."""
    from safetensors.numpy import save

    head = _Head(1, key, state.best, state.history)
    parts = {"network": state.network, "optimizer": state.optimizer, "kept": state.kept}
    tensors = {
        f"{part}/{name}": np.asarray(v, order="C") for part, values in parts.items() for name, v in values.items()
    }
    atomic_write(state_path(out), save(tensors, metadata={_KEY: json.dumps(plain(head))}))


def read_state(out: Path, *, key: str, force: bool = False) -> State | None:
    """Read the state of an unfinished training, None where there is none.

    Raises TrainingError when it is damaged, of another version, or of a training with other settings or data; with
    ``force`` such a one counts as none.
    """
    try:
        return _read(out, key=key)
    except TrainingError:
        if not force:
            raise
        return None


def _read(out: Path, *, key: str) -> State | None:
    from safetensors import SafetensorError, safe_open

    path = state_path(out)
    if not path.is_file():
        return None
    again = "give --force to start over, or choose another --out"
    try:
        with safe_open(path, framework="numpy") as file:
            head = convert(json.loads((file.metadata() or {})[_KEY]), _Head, path=path, what=WHAT)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except StoreError as error:
        raise TrainingError(error.message, hint=again) from error
    except (SafetensorError, OSError, ValueError, TypeError, KeyError) as error:
        raise TrainingError(f"{path}: cut off or damaged ({error}); expected {WHAT}", hint=again) from error
    if head.key != key:
        raise TrainingError(
            f"{path}: is of a training with other settings, data or program; expected the same",
            hint=f"give the settings that it was started with, or {again}",
        )
    parts: dict[str, dict[str, NDArray[Any]]] = {"network": {}, "optimizer": {}, "kept": {}}
    for name, value in tensors.items():
        part, _, rest = name.partition("/")
        parts.get(part, {})[rest] = value
    return State(**parts, best=head.best, history=head.history)


def forget_state(out: Path) -> None:
    """Remove the state of a training that is finished or not wanted any more."""
    with saving(state_path(out)):
        state_path(out).unlink(missing_ok=True)
