"""What training can be told."""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

from fieldkit.errors import TrainingError

ModelName = Literal["mlp", "vpt", "vpt_appearance", "vpt_dino"]
# The network whose view of the landmarks a model takes
APPEARANCE_OF: dict[str, str] = {"vpt_appearance": "efficientnet", "vpt_dino": "dinov2"}


@dataclasses.dataclass(frozen=True)
class TrainingRules:
    """Settings of a training; those that the defaults leave open depend on the model (`settled`).

    ``epochs`` passes over the training views at most, and ``patience`` of them without a smaller loss in the
    validation scene end it early; with 0 all are done and the last one is kept. Every step takes ``batch`` views; the
    learning rate rises to ``learning_rate`` and falls as a cosine. ``occluded`` is the share of the views that are
    shown without the landmarks behind the surface, the others with all: one network serves both. ``cap``: landmarks
    of a view that are looked at, at most; ``drawn``: of how many it learns at most, others each time, which is cheaper
    and keeps it from learning by heart. ``jitter`` scales the noise that is put on landmarks, see
    `fieldkit.training.inputs`. Raises TrainingError where a value cannot be used.
    """

    model: ModelName = "vpt"
    seed: int = 0
    epochs: int | None = None
    patience: int = 3
    batch: int | None = None
    learning_rate: float = 1e-3
    weight_decay: float = 0.01
    cap: int | None = None
    drawn: int | None = None
    occluded: float = 0.9
    jitter: float = 1.0

    def __post_init__(self) -> None:
        counts = {
            "epochs": self.epochs,
            "batch": self.batch,
            "cap": self.cap,
            "drawn": self.drawn,
        }
        for name, value in counts.items():
            if value is not None and value < (2 if name == "batch" else 1):
                raise TrainingError(f"{name} is {value}; expected a positive number", hint=f"give another {name}")
        if self.patience < 0:
            raise TrainingError(f"patience is {self.patience}; expected 0 or more", hint="give another patience")
        if self.model == "mlp" and (self.cap, self.drawn) != (None, None):
            raise TrainingError(
                "the model mlp takes all landmarks; expected no cap", hint="leave --cap and --drawn out"
            )
        if not 0 <= self.seed < 2**31:
            raise TrainingError(f"seed is {self.seed}; expected 0..{2**31 - 1}", hint="give another seed")
        sizes = {"learning_rate": self.learning_rate, "weight_decay": self.weight_decay, "jitter": self.jitter}
        for name, size in sizes.items():
            if not (math.isfinite(size) and size >= 0):
                raise TrainingError(f"{name} is {size:g}; expected 0 or more", hint=f"give another {name}")
        if not 0 <= self.occluded <= 1:
            raise TrainingError(f"occluded is {self.occluded:g}; expected a share", hint="choose 0..1")

    def settled(self) -> TrainingRules:
        """Return the rules with what was left open filled in."""
        whole = self.model == "mlp"
        return dataclasses.replace(
            self,
            epochs=_given(self.epochs, 8),
            batch=_given(self.batch, 400 if whole else 64),
            cap=None if whole else _given(self.cap, 256),
            drawn=None if whole else min(_given(self.drawn, 64), _given(self.cap, 256)),
        )


def _given(value: int | None, default: int) -> int:
    return default if value is None else value
