"""Checkpoints of learned policies: one safetensors file with weights and, in its header, all that scoring needs."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import StoreError, WeightsError
from fieldkit.features.appearance import APPEARANCES
from fieldkit.learned.batches import FULL_VIEW
from fieldkit.protocol import CandidateRules
from fieldkit.store.files import atomic_write, convert, digest, plain
from fieldkit.views.features import normalisation

Floats = NDArray[np.float32]
Kind = Literal["mlp", "vpt", "vpt_dino", "vpt_appearance"]
Temperature = Annotated[float, msgspec.Meta(ge=0.01, le=100)]
_KEY, _NETWORK, _APPEARANCE = "fieldkit", "network.", "appearance."
WHAT = "a checkpoint of a learned policy, as `fieldkit train` writes it"


def constants() -> dict[str, float]:
    """Return by name the constants of what a network is given: it only understands those it was trained with."""
    return normalisation() | {"full_view": FULL_VIEW}


def visibility_of(rules: CandidateRules, *, tolerance_voxels: float) -> dict[str, float]:
    """Return by name what decides which landmarks a view sees: other ones are not those that a network learned from."""
    return {
        "candidates.min_distance_m": rules.min_distance_m,
        "candidates.max_distance_m": rules.max_distance_m,
        "occlusion.tolerance_voxels": tolerance_voxels,
    }


class About(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the header of a checkpoint says.

    ``feature``, ``training_scenes``, ``validation_scenes``, ``dataset_digest`` and ``seed``: what the weights were
    trained on, and with. ``landmark_cap``: how many landmarks of a view are scored at most (None: all).
    ``normalisation``: the constants of the features; ``visibility``: by which landmarks counted as seen, by the names
    of the protocol (`visibility_of`), empty where that is not known. The score is the probability of the log-odds
    (second logit - first) / ``temperature`` + ``bias``, or of those named ``_unfiltered`` where
    hidden landmarks are not left out: as many visible ones then say less. ``appearance`` names the network of
    appearance, ``training`` are settings and results of the training as plain values.
    """

    version: Literal[1] = 1
    kind: Kind
    feature: Annotated[str, msgspec.Meta(min_length=1)]
    landmark_cap: Annotated[int, msgspec.Meta(ge=1)] | None
    training_scenes: tuple[str, ...]
    validation_scenes: tuple[str, ...]
    dataset_digest: str
    seed: int
    temperature: Temperature = 1.0
    bias: float = 0.0
    temperature_unfiltered: Temperature = 1.0
    bias_unfiltered: float = 0.0
    appearance: str | None = None
    normalisation: dict[str, float] = msgspec.field(default_factory=constants)
    visibility: dict[str, float] = {}
    training: dict[str, Any] = {}
    versions: dict[str, str] = {}

    @property
    def scenes(self) -> tuple[str, ...]:
        """The scenes whose views had a part in the weights or in what they are taken to mean."""
        return (*self.training_scenes, *self.validation_scenes)


@dataclasses.dataclass(frozen=True, eq=False)
class Reduction:
    """How appearance becomes three numbers in 0..1: mean f32[w], components f32[3, w], low and high f32[3]."""

    mean: Floats
    components: Floats
    low: Floats
    high: Floats

    def __call__(self, vectors: NDArray[np.floating]) -> Floats:
        """Reduce vectors [n, w] to f32[n, 3]: projected, ``low`` becomes 0 and ``high`` 1, the rest is cut off."""
        if not len(vectors):
            return np.zeros((0, len(self.low)), dtype=np.float32)
        projected = (np.asarray(vectors, dtype=np.float32) - self.mean) @ self.components.T
        scaled = (projected - self.low) / np.maximum(self.high - self.low, 1e-9)
        return np.asarray(np.clip(scaled, 0.0, 1.0), dtype=np.float32)


@dataclasses.dataclass(frozen=True, eq=False)
class Checkpoint:
    """Weights by the names of the network's state, what they were trained on, and how appearance is reduced.

    ``digest`` is that of the file, empty before it is written.
    """

    about: About
    weights: Mapping[str, NDArray[Any]]
    reduction: Reduction | None = None
    path: str = ""
    digest: str = ""


def write_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint whole or not at all; the same content gives the same bytes."""
    from safetensors.numpy import save

    tensors = {_NETWORK + name: np.array(value, order="C") for name, value in checkpoint.weights.items()}
    if checkpoint.reduction is not None:
        for field in dataclasses.fields(Reduction):
            tensors[_APPEARANCE + field.name] = np.array(getattr(checkpoint.reduction, field.name), order="C")
    header = json.dumps(plain(checkpoint.about), sort_keys=True, allow_nan=False)
    atomic_write(path, save(tensors, metadata={_KEY: header}))


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint without torch.

    Raises WeightsError when the file is missing, cut off, not a checkpoint, of another version, or made with other
    features. Whether the weights fit their network is seen when it is opened.
    """
    from safetensors import SafetensorError, safe_open

    path = Path(path)
    if not path.is_file():
        raise WeightsError(f"{path}: no such file; expected {WHAT}", hint="check the path")
    try:
        with safe_open(path, framework="numpy") as file:
            header = (file.metadata() or {}).get(_KEY)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError, TypeError) as error:
        raise WeightsError(
            f"{path}: no safetensors file, or cut off or damaged ({error}); expected {WHAT}",
            hint="check the path, copy the file again, or train again",
        ) from error
    if header is None:
        raise WeightsError(f"{path}: has no {_KEY!r} in its header; expected {WHAT}", hint="check the path")
    about = _about(header, path)
    weights = {n.removeprefix(_NETWORK): t for n, t in tensors.items() if n.startswith(_NETWORK)}
    reduction = _reduction({n: t for n, t in tensors.items() if n.startswith(_APPEARANCE)}, about, path)
    negative = next((n for n, t in weights.items() if n.endswith("running_var") and (t < 0).any()), None)
    if negative is not None:
        raise WeightsError(f"{path}: {negative!r} holds a negative variance; expected none", hint="copy the file again")
    strange = next((n for n in tensors if not n.startswith((_NETWORK, _APPEARANCE))), None)
    if strange is not None:
        raise WeightsError(f"{path}: holds {strange!r}; expected {WHAT}", hint="train again")
    return Checkpoint(about, weights, reduction, str(path), digest(path))


def _about(header: str, path: Path) -> About:
    try:
        about = convert(json.loads(header), About, path=path, what=WHAT)
    except StoreError as error:
        raise WeightsError(error.message, hint=error.hint) from error
    except (json.JSONDecodeError, RecursionError) as error:
        raise WeightsError(f"{path}: its header is damaged; expected {WHAT}", hint="copy the file again") from error
    numbers = (about.temperature, about.bias, about.temperature_unfiltered, about.bias_unfiltered)
    if not np.isfinite(numbers).all():
        raise WeightsError(
            f"{path}: has temperatures and biases {', '.join(f'{n:g}' for n in numbers)}; expected finite numbers",
            hint="train again",
        )
    now = constants()
    other = next((k for k in sorted({*now, *about.normalisation}) if now.get(k) != about.normalisation.get(k)), None)
    if other is not None:
        raise WeightsError(
            f"{path}: was trained on features with {other} {about.normalisation.get(other)}; this version computes "
            f"them with {now.get(other)}",
            hint="train again, or use the version that trained it",
        )
    fitting = {None: ("mlp", "vpt"), "dinov2": ("vpt_dino",)}.get(about.appearance, ("vpt_appearance",))
    if about.kind not in fitting:
        seen = f"with the appearance {about.appearance}" if about.appearance else "without appearance"
        raise WeightsError(
            f"{path}: is a {about.kind} {seen}; "
            f"expected {' or '.join(fitting)}: no policy stands in for another under its name",
            hint="train again",
        )
    return about


def _reduction(tensors: Mapping[str, NDArray[Any]], about: About, path: Path) -> Reduction | None:
    """Return the reduction of appearance; raises WeightsError where it is missing, superfluous, or has other shapes."""
    if about.appearance is None and not tensors:
        return None
    names = [field.name for field in dataclasses.fields(Reduction)]
    found = {n.removeprefix(_APPEARANCE): t for n, t in tensors.items()}
    shapes = {n: t.shape for n, t in found.items()}
    width = (APPEARANCES[about.appearance].dense_width,) if about.appearance in APPEARANCES else ()
    expected = {"mean": width, "components": (3, *width), "low": (3,), "high": (3,)}
    finite = all(np.issubdtype(t.dtype, np.floating) and np.isfinite(t).all() for t in found.values())
    if about.appearance is None or shapes != expected or not finite:
        raise WeightsError(
            f"{path}: its reduction of appearance has the shapes {shapes}; expected finite {', '.join(names)}, as "
            f"{expected if about.appearance else 'nothing: it uses no appearance'}",
            hint="train again",
        )
    return Reduction(**{n: found[n].astype(np.float32) for n in names})
