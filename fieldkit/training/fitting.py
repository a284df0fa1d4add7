"""Fit a network to labelled views: epoch by epoch, the same whether it was killed in between or not."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fieldkit.training.calibrating import chosen_share, fit_calibration, log_loss
from fieldkit.training.inputs import Inputs
from fieldkit.training.resuming import Epoch, State, read_state, write_state
from fieldkit.training.rules import TrainingRules

if TYPE_CHECKING:
    import torch

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]
# Share of all steps in which the learning rate rises, and what it ends with as a share of the highest
_WARM_UP, _LAST_RATE = 0.1, 0.01
_SCORED_AT_ONCE = 64


@dataclasses.dataclass(frozen=True, eq=False)
class Material:
    """Views to train on and views to choose by; ``waypoint`` int32[v] of the latter."""

    training: Inputs
    validation: Inputs
    waypoint: NDArray[np.int32]


@dataclasses.dataclass(frozen=True, eq=False)
class Fitted:
    """The weights of the best epoch, its number, what every epoch came to, and the validation views' log-odds.

    ``log_odds`` f64[2, v]: with and without the occlusion filter.
    """

    weights: dict[str, NDArray[Any]]
    best: int
    history: tuple[Epoch, ...]
    log_odds: Array


def fit(
    make: Callable[[], torch.nn.Module],
    material: Material,
    *,
    rules: TrainingRules,
    out: Path,
    key: str,
    force: bool = False,
    progress: Progress | None = None,
) -> Fitted:
    """Fit a network; after every epoch its state is kept beside ``out``, from which the same call goes on.

    With ``force`` the state of another training there is replaced, else it raises TrainingError.
    Classes weigh the same, whatever their numbers. The epoch with the least loss in the validation scene is kept,
    and without patience the last one, so that this scene chooses nothing.
    """
    import torch

    device = torch.device(str(machine()["device"]))
    with _repeatable(rules.seed):
        network = make().to(device)
        optimizer = torch.optim.AdamW(network.parameters(), lr=rules.learning_rate, weight_decay=rules.weight_decay)
        state = read_state(out, key=key, force=force)
        if state is not None:
            _restore(network, optimizer, state)
        history, best, kept = ((), 0, None) if state is None else (state.history, state.best, dict(state.kept))
        assert rules.epochs is not None
        waits = rules.patience or rules.epochs
        while len(history) < rules.epochs and len(history) - best <= waits:
            loss = _train(network, optimizer, material.training, rules=rules, epoch=len(history), progress=progress)
            odds = _log_odds(network, material.validation)
            now = Epoch(loss, *_judged(odds, material))
            history = (*history, now)
            if kept is None or not rules.patience or now.validation_loss < history[best].validation_loss:
                best, kept = len(history) - 1, _arrays(network.state_dict())
            write_state(out, State(_arrays(network.state_dict()), _moments(optimizer), kept, best, history), key=key)
            if progress is not None:
                progress(_told(rules, history, best), len(history), rules.epochs)
        assert kept is not None
        network.load_state_dict({name: _tensor(value) for name, value in kept.items()})
        return Fitted(kept, best, history, _log_odds(network, material.validation))


def _told(rules: TrainingRules, history: tuple[Epoch, ...], best: int) -> str:
    now = history[-1]
    return (
        f"train {rules.model} | loss {now.loss:.3f}, validation {now.validation_loss:.3f}, "
        f"kept {history[best].validation_loss:.3f} of epoch {best + 1}"
    )


def machine() -> dict[str, str | int]:
    """Return on what torch computes here: sums in another order have other last bits, and training multiplies them."""
    import torch

    return {"device": "cuda" if torch.cuda.is_available() else "cpu", "threads": torch.get_num_threads()}


@contextlib.contextmanager
def _repeatable(seed: int) -> Iterator[None]:
    """Make torch repeat itself inside; its state outside stays as it is."""
    import torch

    before = torch.are_deterministic_algorithms_enabled(), torch.is_deterministic_algorithms_warn_only_enabled()
    benchmark = torch.backends.cudnn.benchmark
    with torch.random.fork_rng():
        torch.use_deterministic_algorithms(True, warn_only=True)
        torch.backends.cudnn.benchmark = False
        torch.manual_seed(seed)
        try:
            yield
        finally:
            torch.use_deterministic_algorithms(before[0], warn_only=before[1])
            torch.backends.cudnn.benchmark = benchmark


def _train(
    network: torch.nn.Module,
    optimizer: torch.optim.Optimizer,
    inputs: Inputs,
    *,
    rules: TrainingRules,
    epoch: int,
    progress: Progress | None,
) -> float:
    """Go once over all views in random order; return the mean loss. All chance comes from seed and epoch."""
    import torch

    assert rules.epochs is not None
    assert rules.batch is not None
    epochs, batch = rules.epochs, rules.batch
    rng = np.random.default_rng([rules.seed, epoch])
    torch.manual_seed(int(rng.integers(2**31)))
    device = next(network.parameters()).device
    order = rng.permutation(len(inputs.label))
    occluded = rng.random(len(order)) < rules.occluded
    # Batch normalisation knows nothing of a single view: what is left over waits for another epoch.
    batches = [b for b in np.array_split(order, max(len(order) // batch, 1)) if len(b) > 1]
    share = float(np.mean(inputs.label))
    network.train()
    total = 0.0
    for number, views in enumerate(batches):
        _set_rate(optimizer, rules, (epoch * len(batches) + number) / (epochs * len(batches)))
        arrays = inputs.varied(views, occluded[views], rng)
        label = _tensor(inputs.label[views]).to(device)
        logits = network(*(_tensor(a).to(device) for a in arrays))
        weight = torch.where(label, 0.5 / share, 0.5 / (1.0 - share))
        loss = torch.nn.functional.binary_cross_entropy_with_logits(
            logits[:, 1] - logits[:, 0], label.to(logits.dtype), weight=weight.to(logits.dtype)
        )
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        total += float(loss.detach())
        if progress is not None:
            progress(f"epoch {epoch + 1} | loss {total / (number + 1):.3f}", number + 1, len(batches))
    return total / len(batches)


def _set_rate(optimizer: torch.optim.Optimizer, rules: TrainingRules, done: float) -> None:
    """Set the learning rate when a share ``done`` of all steps is done: up in a line, down as a cosine."""
    if done < _WARM_UP:
        factor = (done + 1e-3) / (_WARM_UP + 1e-3)
    else:
        fall = (done - _WARM_UP) / (1.0 - _WARM_UP)
        factor = _LAST_RATE + (1.0 - _LAST_RATE) * 0.5 * (1.0 + math.cos(math.pi * fall))
    for group in optimizer.param_groups:
        group["lr"] = rules.learning_rate * factor


def _log_odds(network: torch.nn.Module, inputs: Inputs) -> Array:
    """Return log-odds f64[2, v] with and without the occlusion filter."""
    import torch

    device = next(network.parameters()).device
    result = np.empty((2, len(inputs.label)))
    network.eval()
    with torch.inference_mode():
        for row, occlusion in enumerate((True, False)):
            for start in range(0, len(inputs.label), _SCORED_AT_ONCE):
                views = np.arange(start, min(start + _SCORED_AT_ONCE, len(inputs.label)))
                arrays = inputs.plain(views, occlusion=occlusion)
                logits = network(*(_tensor(a).to(device) for a in arrays)).double()
                result[row, views] = (logits[:, 1] - logits[:, 0]).cpu().numpy()
    return result


def _judged(odds: Array, material: Material) -> tuple[float, float]:
    """Return the loss of the validation views once their probabilities are calibrated, and how well views are chosen.

    The loss tells epochs apart better than the choices at a scene's hundred waypoints, which chance decides.
    """
    label = material.validation.label
    calibrated = [fit_calibration(row, label).log_odds(row) for row in odds]
    half = max(int(np.bincount(material.waypoint).max()) // 2, 1)
    chosen = float(np.mean([chosen_share(row, label, material.waypoint, of=half) for row in odds]))
    return float(np.mean([log_loss(row, label) for row in calibrated])), chosen


def _tensor(values: NDArray[Any]) -> torch.Tensor:
    """Return an array as a tensor in memory of torch's own: of other alignment the same sums have other last bits."""
    import torch

    return torch.from_numpy(values).clone()


def _arrays(tensors: dict[str, torch.Tensor]) -> dict[str, NDArray[Any]]:
    return {name: value.detach().cpu().numpy().copy() for name, value in tensors.items()}


def _moments(optimizer: torch.optim.Optimizer) -> dict[str, NDArray[Any]]:
    """Return what the optimizer remembers of every parameter, by its number and the name of what it is."""
    found = optimizer.state_dict()["state"]
    return {
        f"{number}.{name}": value.detach().cpu().numpy().copy()
        for number, values in found.items()
        for name, value in values.items()
    }


def _restore(network: torch.nn.Module, optimizer: torch.optim.Optimizer, state: State) -> None:
    network.load_state_dict({name: _tensor(value) for name, value in state.network.items()})
    moments: dict[int, dict[str, torch.Tensor]] = {}
    for key, value in state.optimizer.items():
        number, _, name = key.partition(".")
        moments.setdefault(int(number), {})[name] = _tensor(value)
    optimizer.load_state_dict(optimizer.state_dict() | {"state": moments})
