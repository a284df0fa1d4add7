"""The command that trains a learned policy."""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path
from typing import Literal

from tyro.conf import Positional
from tyro.conf import UseAppendAction as Repeated

from fieldkit.console import ProgressBars, cells, make_table, print_json

# Heavy rooms are imported inside the command, as in fieldkit.cli

_log = logging.getLogger(__name__)


def _logged(what: str, done: int, total: int) -> None:
    """Tell every epoch in a line: bars that nobody sees would tell nothing until the end."""
    if what.startswith("train "):
        _log.info("epoch %d of %d: %s", done, total, what.partition(" | ")[2])


def train(
    datasets: Positional[tuple[Path, ...]],
    *,
    out: Path,
    model: Literal["mlp", "vpt", "vpt_appearance", "vpt_dino"] = "vpt",
    validate: str | None = None,
    test: Repeated[tuple[Path, ...]] = (),
    seed: int = 0,
    epochs: int | None = None,
    patience: int = 3,
    cap: int | None = None,
    drawn: int | None = None,
    json: bool = False,
    force: bool = False,
) -> None:
    """Train a learned policy on datasets of `sim-bridge dataset`; write its weights and, beside them, a model card.

    A training that was interrupted goes on when the same command is given again.

    Args:
        datasets: dataset folders, finished and made with the same settings
        out: .safetensors file to write
        model: mlp, vpt, or with the appearance of landmarks vpt_appearance (EfficientNet) or vpt_dino (DINOv2)
        validate: scene by which epoch and temperature are chosen; by default the one of median difficulty
        test: dataset of test scenes: none of them may be trained or validated on; may be repeated
        seed: seed of weights, order and variations
        epochs: how often the training views are gone over at most
        patience: epochs without a smaller loss in the validation scene that end it early; 0 keeps the last epoch
        cap: landmarks of a view that are looked at, at most; by default 256
        drawn: landmarks of a view that it learns from at a time, at most; by default 64
        json: print JSON
        force: replace existing files
    """
    from rich.console import Console

    from fieldkit.training import TrainingRules
    from fieldkit.training import train as train_policy

    rules = TrainingRules(model=model, seed=seed, epochs=epochs, patience=patience, cap=cap, drawn=drawn)
    try:
        with ProgressBars() as bars:
            progress = bars if Console(stderr=True).is_terminal else _logged
            report = train_policy(
                datasets, out, rules=rules, validate=validate, tests=test, force=force, progress=progress
            )
    except KeyboardInterrupt:
        _log.warning("%s: interrupted; the same command goes on where it stopped", out)
        raise
    _log.info("wrote %s and %s", report.path, report.card)
    if json:
        print_json(dataclasses.asdict(report) | {"path": str(report.path), "card": str(report.card)})
        return
    table = make_table(
        "occlusion", "chosen", "most visible", "possible", "Brier", title=f"validation: {report.validation}"
    )
    for verdict in report.verdicts:
        shares = (verdict.chosen, verdict.most_visible, verdict.possible)
        brier = f"{verdict.reliability.brier:.4f}"
        table.add_row(*cells(["on" if verdict.occlusion else "off", *(f"{100 * s:.1f} %" for s in shares), brier]))
    Console().print(table)
