"""Checkpoints of learned policies with random weights: they rank views by nothing, but they do rank them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from fieldkit.features.appearance import APPEARANCES
from fieldkit.learned.checkpoint import About, Checkpoint, Reduction, write_checkpoint
from fieldkit.learned.networks import Mlp, Vpt

APPEARANCE = {"vpt_dino": "dinov2", "vpt_appearance": "efficientnet"}


def seeded(kind: str, *, seed: int = 0, **about: Any) -> Checkpoint:
    """Make a checkpoint whose scores differ from view to view: its weights are twice those of a new network."""
    torch.manual_seed(seed)
    network = Mlp() if kind == "mlp" else Vpt(tokens=76 if kind in APPEARANCE else 73)
    weights = {k: (2 * v if v.is_floating_point() else v).numpy() for k, v in network.state_dict().items()}
    reduction = None
    if kind in APPEARANCE:
        rng, width = np.random.default_rng(seed), APPEARANCES[APPEARANCE[kind]].dense_width
        components = rng.normal(size=(3, width)).astype(np.float32)
        reduction = Reduction(np.zeros(width, np.float32), components, *np.float32([[-2.0] * 3, [2.0] * 3]))
    stated = {
        "kind": kind,
        "feature": "sift",
        "landmark_cap": None if kind == "mlp" else 64,
        "training_scenes": ("office", "lobby"),
        "validation_scenes": ("shop",),
        "dataset_digest": "d" * 32,
        "seed": seed,
        "appearance": APPEARANCE.get(kind),
    }
    return Checkpoint(About(**(stated | about)), weights, reduction)


def write_seeded(folder: Path, *kinds: str, **about: Any) -> Path:
    """Write a seeded checkpoint of each kind into a folder and return the folder."""
    for kind in kinds:
        write_checkpoint(folder / f"{kind}.safetensors", seeded(kind, **about))
    return folder
