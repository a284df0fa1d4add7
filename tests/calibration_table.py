"""What trials of tag calibration came to, and the table that the benchmarks print of them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from fieldkit.frames import Array, Pose, pose_error

# Chi-square of 6 degrees of freedom that one trial in a thousand exceeds
OUTLIER_CHI2 = 22.46


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Errors (mm, deg) of the joint solution, of the good photos alone and of the plain mean; what the bound draws.

    ``bound`` f64[d, 6] are draws in rad and m, ``normalised`` f64[6] the errors in standard deviations, ``nees`` is
    per degree of freedom. ``unnamed`` counts wrong photos that are not named, ``lost`` good ones that are rejected.
    """

    joint: tuple[float, float]
    good_alone: tuple[float, float]
    mean: tuple[float, float]
    bound: Array
    normalised: Array
    nees: float
    unnamed: int
    lost: int


def errors(estimate: Pose, true: Pose) -> tuple[float, float]:
    """Return the distance in mm and the angle in deg between two poses."""
    position, angle = pose_error(estimate, true)
    return 1e3 * position, math.degrees(angle)


def figures(outcomes: Sequence[Outcome]) -> dict[str, str]:
    """Return every column's text: medians, root mean squares, and shares of the trials; NEES is 2 % trimmed."""
    joint, alone, mean = (np.array([getattr(o, k) for o in outcomes]) for k in ("joint", "good_alone", "mean"))
    drawn = np.concatenate([o.bound for o in outcomes])
    bound = (
        np.median(1e3 * np.linalg.norm(drawn[:, 3:], axis=1)),
        np.median(np.degrees(np.linalg.norm(drawn[:, :3], axis=1))),
    )
    nees = np.sort([o.nees for o in outcomes])
    over_bound, over_alone = np.median(joint, axis=0) / bound, np.median(joint, axis=0) / np.median(alone, axis=0)
    return {
        "median error": _both(np.median(joint, axis=0)),
        "rms": _both(np.sqrt(np.mean(joint**2, axis=0))),
        "over the bound": f"{over_bound[0]:.2f} {over_bound[1]:.2f}",
        "plain mean": _both(np.median(mean, axis=0)),
        "its rms": _both(np.sqrt(np.mean(mean**2, axis=0))),
        "over good photos alone": f"{over_alone[0]:.3f} {over_alone[1]:.3f}",
        "NEES/6": f"{nees[: math.ceil(0.98 * len(nees))].mean():.2f}",
        "outliers": f"{100 * np.mean(nees > OUTLIER_CHI2 / 6):.1f} %",
        "within 2 sigma": f"{100 * np.mean(np.abs([o.normalised for o in outcomes]) < 2):.1f} %",
        "all wrong named": _share([o.unnamed == 0 for o in outcomes]),
        "no good lost": _share([o.lost == 0 for o in outcomes]),
    }


def table(rows: dict[str, Sequence[Outcome]]) -> str:
    """Return a table in Markdown, one row of figures for every named list of outcomes."""
    found = {name: figures(outcomes) for name, outcomes in rows.items()}
    columns = list(next(iter(found.values())))
    lines = [f"| scenario | {' | '.join(columns)} |", "|---" * (len(columns) + 1) + "|"]
    lines += [f"| {name} | {' | '.join(cells.values())} |" for name, cells in found.items()]
    return "\n".join(lines)


def _both(values: Array) -> str:
    return f"{values[0]:.2f} mm {values[1]:.3f} deg"


def _share(flags: Sequence[bool]) -> str:
    return f"{sum(flags)} of {len(flags)}" if len(flags) < 100 else f"{100 * np.mean(flags):.1f} %"
