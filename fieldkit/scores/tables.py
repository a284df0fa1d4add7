"""Scores as values for machines, as a table, and against what a protocol expects."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

from fieldkit.protocol import Threshold
from fieldkit.scores.comparing import Comparison, compare, learned_pairs
from fieldkit.scores.summary import group, summarize_run
from fieldkit.trust import open_shares, open_words, trust, trust_dict, truths_of
from fieldkit.types import Run


@dataclasses.dataclass(frozen=True)
class Table:
    """A table of strings: a caption that says what is counted, one header cell per column, and the rows."""

    caption: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def score_dict(run: Run, *, thresholds: Sequence[Threshold] | None = None) -> dict[str, Any]:
    """Return the values of ``fieldkit score --json``: fractions, m and deg, null for an infinite median."""
    chosen = run.protocol.thresholds if thresholds is None else thresholds
    truths, groups = truths_of(run), group(run.trials)
    return {
        "version": 1,
        "protocol": run.protocol.name,
        "pose": run.protocol.pose,
        "thresholds": [{"position_m": t.position_m, "rotation_deg": t.rotation_deg} for t in chosen],
        "policies": [
            {
                "name": s.policy,
                "occlusion": s.occlusion,
                "n": s.n,
                "recall": list(s.recall),
                "interval": [list(pair) for pair in s.interval],
                "median_position_m": _finite(s.median[0]),
                "median_rotation_deg": _finite(math.degrees(s.median[1])),
                "open": list(
                    open_shares(groups[s.policy, s.occlusion], truths, thresholds=chosen, pose=run.protocol.pose)
                ),
            }
            for s in summarize_run(run, thresholds=chosen)
        ],
        "comparisons": [_comparison_dict(c) for c in _comparisons(run, chosen)],
        "truth": trust_dict(trust(run, thresholds=chosen)),
        "in_sample": {name: list(scenes) for name, scenes in in_sample(run).items()},
    }


def _comparisons(run: Run, thresholds: Sequence[Threshold]) -> tuple[Comparison, ...]:
    pairs = learned_pairs(run.trials)
    return compare(run.trials, pairs, thresholds=thresholds, pose=run.protocol.pose, seed=run.seed)


def _comparison_dict(found: Comparison) -> dict[str, Any]:
    return {
        "a": found.a[0],
        "b": found.b[0],
        "occlusion": found.a[1],
        "threshold": {"position_m": found.threshold.position_m, "rotation_deg": found.threshold.rotation_deg},
        "n": found.n,
        "n_a_only": found.n_a_only,
        "n_b_only": found.n_b_only,
        "difference": found.difference,
        "interval": list(found.interval),
        "p": found.p,
        "p_corrected": found.p_corrected,
    }


def check_expect(run: Run) -> list[str]:
    """Return one line per missed ``[[expect]]`` bound of the protocol; a policy without a row is a miss.

    A bound that does not say ``occlusion`` holds for every variant of its policy.
    """
    misses = []
    summaries = summarize_run(run)
    for bound in run.protocol.expect:
        where = f"{bound.policy} at {bound.position_m:g} m / {bound.rotation_deg:g} deg"
        rows = [s for s in summaries if s.policy == bound.policy and bound.occlusion in (None, s.occlusion)]
        if not rows:
            misses.append(f"{where}: no row in this run; expected recall {bound.min_recall:g} .. {bound.max_recall:g}")
        column = run.protocol.thresholds.index(Threshold(bound.position_m, bound.rotation_deg))
        for row in rows:
            value = row.recall[column]
            if not bound.min_recall - 1e-12 <= value <= bound.max_recall + 1e-12:
                misses.append(
                    f"{where}{_occlusion_words(row.occlusion)}: recall {value:.4f} of {row.n} visits; "
                    f"expected {bound.min_recall:g} .. {bound.max_recall:g}"
                )
    return misses


def table(run: Run, *, thresholds: Sequence[Threshold] | None = None) -> Table:
    """Return the recall table as strings: recall and 95 % interval in % per threshold, then median errors."""
    chosen = run.protocol.thresholds if thresholds is None else thresholds
    pose = "camera" if run.protocol.pose == "cam" else "body"
    columns = [f"{t.position_m:g} m / {t.rotation_deg:g} deg" for t in chosen]
    rows = []
    for s in summarize_run(run, thresholds=chosen):
        cells = [
            f"{100 * value:.1f} [{100 * low:.0f}, {100 * high:.0f}]"
            for value, (low, high) in zip(s.recall, s.interval, strict=True)
        ]
        median = [format_number(s.median[0]), format_number(math.degrees(s.median[1]))]
        occlusion = "-" if s.occlusion is None else "yes" if s.occlusion else "no"
        rows.append((s.policy, occlusion, str(s.n), *cells, *median))
    trusted = trust(run, thresholds=chosen)
    caption = f"Recall in % of visits, {pose} pose strictly inside both bounds [Wilson 95 %]; failures count."
    known = [f"{name} was trained or validated on {', '.join(scenes)}" for name, scenes in in_sample(run).items()]
    caption += f" No test: {'; '.join(known)}." if known else ""
    return Table(
        caption=caption if trusted is None else f"{caption} {open_words(trusted, chosen)}",
        header=("policy", "occlusion", "n", *columns, "median m", "median deg"),
        rows=tuple(rows),
    )


def in_sample(run: Run) -> dict[str, tuple[str, ...]]:
    """Return by learned policy the scenes of a run that it was trained or validated on: its rows there are no test."""
    known = {name: tuple(s for s in run.sessions if s in scenes) for name, scenes in run.trained_on.items()}
    return {name: scenes for name, scenes in known.items() if scenes}


def format_number(value: float) -> str:
    """Return a number with three significant digits, or "failed" when it is infinite."""
    return f"{value:.3g}" if math.isfinite(value) else "failed"


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _occlusion_words(occlusion: bool | None) -> str:
    return "" if occlusion is None else " with occlusion" if occlusion else " without occlusion"
