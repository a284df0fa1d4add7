"""The model card: what weights were trained on, how they were chosen, and how far their scores can be trusted."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from fieldkit.learned.checkpoint import About
from fieldkit.store.files import atomic_write
from fieldkit.training.calibrating import Reliability
from fieldkit.training.resuming import Epoch
from fieldkit.training.rules import TrainingRules

_SEES = {
    "mlp": "146 numbers of a whole view (histograms of its landmarks)",
    "vpt": "73 numbers per landmark of a view",
    "vpt_appearance": "76 numbers per landmark of a view, three of them its appearance",
    "vpt_dino": "76 numbers per landmark of a view, three of them its appearance",
}


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What the validation scene says of the weights, with or without the occlusion filter.

    ``chosen`` is the share of waypoints whose best view localizes, ``most_visible`` that of the view with the most
    visible landmarks, ``possible`` that of waypoints with any view that localizes.
    """

    occlusion: bool
    views: int
    waypoints: int
    chosen: float
    most_visible: float
    possible: float
    reliability: Reliability


@dataclasses.dataclass(frozen=True)
class SceneCount:
    """A scene that was trained or validated on: its views, and the share that localizes."""

    name: str
    use: str
    views: int
    localized: float


def card_path(out: Path) -> Path:
    """Return where the card of a checkpoint lies: beside it, as markdown."""
    return out.with_suffix(".md")


def write_card(
    out: Path,
    about: About,
    *,
    rules: TrainingRules,
    scenes: Sequence[SceneCount],
    history: Sequence[Epoch],
    verdicts: Sequence[Verdict],
) -> None:
    """Write the card of a checkpoint beside it; the same training gives the same bytes."""
    parts = [_head(out, about), _data(scenes), _settings(rules, history), *(_verdict(v) for v in verdicts), _LIMITS]
    atomic_write(card_path(out), "\n".join(parts))


def _head(out: Path, about: About) -> str:
    return f"""# {out.name}

Scores a candidate view by the probability that it localizes: policy `{about.kind}` of fieldkit. It sees
{_SEES[about.kind]}, computed from the map and the candidate's pose alone.

- local feature of the maps: {about.feature}
- landmarks of a view that are looked at: {"all" if about.landmark_cap is None else f"at most {about.landmark_cap}"}
- appearance: {about.appearance or "none"}
- seed {about.seed}, data {about.dataset_digest[:16]}
- versions: {", ".join(f"{name} {version}" for name, version in about.versions.items())}
"""


def _data(scenes: Sequence[SceneCount]) -> str:
    rows = [f"| {s.name} | {s.use} | {s.views} | {100 * s.localized:.1f} |" for s in scenes]
    return "\n".join(["## Data", "", "| scene | use | views | % that localize |", "|---|---|---|---|", *rows, ""])


def _settings(rules: TrainingRules, history: Sequence[Epoch]) -> str:
    settings = ", ".join(f"{f.name} {getattr(rules, f.name)}" for f in dataclasses.fields(rules))
    kept = (
        "the epoch with the least validation loss" if rules.patience else "the last epoch, whatever the validation loss"
    )
    rows = [
        f"| {i} | {e.loss:.4f} | {e.validation_loss:.4f} | {100 * e.chosen:.2f} |" for i, e in enumerate(history, 1)
    ]
    return "\n".join(
        [
            "## Training",
            "",
            f"Settings: {settings}. Classes weigh the same. Kept: {kept}",
            "(calibrated, with and without the occlusion filter). Chosen well: the best of half of a waypoint's",
            "candidates localizes.",
            "",
            "| epoch | loss | validation loss | % chosen well |",
            "|---|---|---|---|",
            *rows,
            "",
        ]
    )


def _verdict(verdict: Verdict) -> str:
    found = verdict.reliability
    rows = [
        f"| {i / 10:.1f}..{(i + 1) / 10:.1f} | {n} | {said:.3f} | {share:.3f} |"
        for i, (n, said, share) in enumerate(zip(found.views, found.said, found.localized, strict=True))
        if n
    ]
    return "\n".join(
        [
            f"## Validation scene, occlusion filter {'on' if verdict.occlusion else 'off'}",
            "",
            f"{verdict.waypoints} waypoints, {verdict.views} views. The chosen view localizes at "
            f"{100 * verdict.chosen:.1f} % of the waypoints",
            f"(most visible landmarks {100 * verdict.most_visible:.1f} %, best possible "
            f"{100 * verdict.possible:.1f} %).",
            f"Brier score {found.brier:.4f} ({found.brier_of_rate:.4f} by always saying the mean rate), log loss "
            f"{found.log_loss:.4f}.",
            "",
            "| said | views | mean said | localized |",
            "|---|---|---|---|",
            *rows,
            "",
        ]
    )


_LIMITS = """## Limits

Epoch, temperature and bias were chosen on the validation scene, so its figures flatter. The labels are of one camera,
one local feature and rendered scenes; in maps of another feature the order of the views may hold, the probability need
not. A view that sees no landmark has a score, too: that of seeing nothing.
"""
