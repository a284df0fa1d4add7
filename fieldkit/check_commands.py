"""The command that checks tags, and what sees them, with what a lab has."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from tyro.conf import Positional
from tyro.conf import UseAppendAction as Repeated

from fieldkit.console import cells, make_table, print_json
from fieldkit.errors import TagError

if TYPE_CHECKING:
    from fieldkit.checks import DistanceCheck, ScaleCheck
    from fieldkit.types import TagMap

# Heavy rooms are imported inside the commands, as in fieldkit.cli

_log = logging.getLogger(__name__)


def tags_check(
    tags: Positional[Path],
    *,
    distance: Repeated[tuple[tuple[str, str, float], ...]] = (),
    tape_sigma_m: float = 0.002,
    json: bool = False,
) -> int:
    """Check tags with a tape measure; exit with 3 when a check fails.

    Args:
        tags: tags.toml
        distance: two tags (3, or 3@w02 for its place at a visit) and the metres between their centres; may be repeated
        tape_sigma_m: standard deviation of the tape measure in m
        json: print JSON
    """
    from fieldkit import store

    loaded = store.read_tags(tags)
    if not distance:
        raise TagError(f"{tags}: nothing to check; expected --distance A B METRES", hint="measure between two tags")
    checks, scale = _distances(loaded, distance, tape_sigma_m=tape_sigma_m)
    if json:
        print_json({"version": 1, **_distances_json(checks, scale)})
    else:
        _print_distances(checks, scale)
    return 3 if "fail" in (scale.verdict, *(c.verdict for c in checks)) else 0


def _distances(
    tags: TagMap, distances: tuple[tuple[str, str, float], ...], *, tape_sigma_m: float
) -> tuple[tuple[DistanceCheck, ...], ScaleCheck]:
    from fieldkit.checks import Tape, check_distances, parse_tag

    tapes = [Tape(parse_tag(a), parse_tag(b), metres) for a, b, metres in distances]
    return check_distances(tags, tapes, tape_sigma_m=tape_sigma_m)


def _print_distances(checks: tuple[DistanceCheck, ...], scale: ScaleCheck) -> None:
    table = make_table("tags", "tape m", "map m", "difference mm", "sigma mm", "%", "sigma %", "verdict", "why")
    for c in checks:
        names = f"{c.tape.a} to {c.tape.b}"
        lengths = [f"{c.tape.measured_m:.3f}", f"{c.map_m:.4f}"]
        millimetres = [f"{1e3 * c.difference_m:+.1f}", f"{1e3 * c.sigma_m:.1f}"]
        shares = [f"{100 * c.share:+.2f}", f"{100 * c.sigma_share:.2f}"]
        table.add_row(*cells([names, *lengths, *millimetres, *shares, c.verdict, c.reason]))
    console = Console(width=max(120, Console().width))
    console.print(table)
    spread = f"; the distances differ from one scale by {scale.sigmas:.1f} sigma" if len(checks) > 1 else ""
    words = f"{100 * scale.error:+.2f} % (sigma {100 * scale.sigma:.2f} %){spread}"
    console.print(f"scale error of the map that this would mean: {words}: {scale.verdict}", markup=False)


def _distances_json(checks: tuple[DistanceCheck, ...], scale: ScaleCheck) -> dict[str, Any]:
    rows = [
        {
            "a": str(c.tape.a),
            "b": str(c.tape.b),
            "tape_m": c.tape.measured_m,
            "map_m": c.map_m,
            "difference_m": c.difference_m,
            "sigma_m": c.sigma_m,
            "difference_percent": 100 * c.share,
            "sigma_percent": 100 * c.sigma_share,
            "verdict": c.verdict,
            "reason": c.reason,
        }
        for c in checks
    ]
    whole = {
        "error_percent": 100 * scale.error,
        "sigma_percent": 100 * scale.sigma,
        "spread_sigmas": scale.sigmas,
        "verdict": scale.verdict,
    }
    return {"distances": rows, "scale": whole}
