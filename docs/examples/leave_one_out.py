"""Train a policy as often as a dataset has scenes, each time without one, and print how well it chooses there.

``python docs/examples/leave_one_out.py DATASET --model vpt --out FOLDER`` prints Markdown. The scene left out chooses
nothing: all epochs are done, and the last one is kept. With ``--waypoints 25`` only so many of every training scene's
waypoints are learned from, with ``--scenes 2`` only so many scenes: the learning curve. What was trained stays in
FOLDER, and the same command goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from fieldkit.store.datasets import MAPS_FOLDER, read_dataset, read_scene, shard_path, write_dataset, write_scene
from fieldkit.training import TrainingReport, TrainingRules, train


def part(dataset: Path, out: Path, *, scenes: Sequence[str], waypoints: int | None = None) -> Path:
    """Make a dataset of some scenes of another, with so many of their waypoints, evenly spread; files are linked."""
    out.mkdir(parents=True, exist_ok=True)
    maps = out / MAPS_FOLDER
    if not maps.is_symlink():
        maps.symlink_to(os.path.relpath(dataset / MAPS_FOLDER, out))
    for name in scenes:
        entry = read_scene(dataset, name)
        count = min(waypoints or len(entry.waypoints), len(entry.waypoints))
        chosen = [entry.waypoints[i] for i in np.linspace(0, len(entry.waypoints) - 1, count).round().astype(int)]
        write_scene(out, msgspec.structs.replace(entry, waypoints=tuple(chosen)))
        for waypoint in chosen:
            link = shard_path(out, name, waypoint)
            if not link.is_symlink():
                link.symlink_to(os.path.relpath(shard_path(dataset, name, waypoint), link.parent))
    write_dataset(out, msgspec.structs.replace(read_dataset(dataset), scenes=tuple(scenes)))
    return out


def subsets(scenes: Sequence[str], size: int, *, rng: np.random.Generator) -> list[str]:
    """Return ``size`` of the scenes by chance, in their order."""
    return [scenes[i] for i in sorted(rng.choice(len(scenes), size, replace=False))]


def chosen(dataset: Path, out: Path, held_out: str, *, rules: TrainingRules, args: argparse.Namespace) -> list[float]:
    """Train without a scene and return the share of its waypoints whose chosen view localizes, in %: filter, none."""
    result = out / f"{held_out}.json"
    if not result.is_file():
        others = [n for n in read_dataset(dataset).scenes if n != held_out]
        rng = np.random.default_rng([args.seed, read_dataset(dataset).scenes.index(held_out)])
        learned = subsets(others, min(args.scenes or len(others), len(others)), rng=rng)
        whole = part(dataset, out / held_out / "whole", scenes=[held_out])
        small = part(dataset, out / held_out / "small", scenes=learned, waypoints=args.waypoints)
        weights = out / held_out / f"{args.model}.safetensors"
        report = train([small, whole], weights, rules=rules, validate=held_out, force=weights.is_file())
        result.write_text(json.dumps(told(report)), encoding="utf-8")
    return [float(v) for v in json.loads(result.read_text(encoding="utf-8"))]


def told(report: TrainingReport) -> list[float]:
    """Return what the card says of the chosen views, with and without the occlusion filter, in %."""
    return [100.0 * v.chosen for v in report.verdicts]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--model", default="vpt")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--waypoints", type=int, help="of every training scene; by default all")
    parser.add_argument("--scenes", type=int, help="to train on; by default all but one")
    parser.add_argument("--epochs", type=int)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    rules = TrainingRules(args.model, epochs=args.epochs, seed=args.seed, patience=0)
    names = read_dataset(args.dataset).scenes
    size = f"s{args.scenes or len(names) - 1}-w{args.waypoints or 'all'}-e{args.epochs or 'all'}-seed{args.seed}"
    folder = args.out / f"{args.model}-{size}"
    found = [chosen(args.dataset, folder, n, rules=rules, args=args) for n in names]
    print(f"| {args.model}, {size} | mean | {' | '.join(names)} |")
    print("|---" * (len(names) + 2) + "|")
    for occlusion, row in zip(("filter", "no filter"), zip(*found, strict=True), strict=True):
        print(f"| {occlusion} | {' | '.join(f'{v:.1f}' for v in itertools.chain([np.mean(row)], row))} |")


if __name__ == "__main__":
    main()
