"""Which landmarks made a learned policy prefer a view: the map from above, coloured."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fieldkit.report.figures import SETTINGS, svg_text
from fieldkit.report.palette import style
from fieldkit.types import Array, PlanView, Reason, VisitPlan

RAISED, LOWERED, INK, PALE = "#17798a", "#c2410c", "#14181c", "#c3ccd4"
# Size of a panel in inches
_SIDE = 3.1


def reasons_svg(plan: VisitPlan, view: PlanView, *, order: Sequence[str], name: str) -> str | None:
    """Draw for each learned policy what the score of the view that it prefers rests on; None without such a policy.

    Dots are the landmarks that were asked for, at their place from above: their area is how much leaving out just this
    one changes the log-odds, in units of the policy's largest change there. Lines bound what the camera sees. A column
    is a policy, without occlusion above with.
    """
    shown = sorted(plan.reasons.items(), key=lambda item: (bool(item[0][1]), order.index(item[0][0])))
    if not shown:
        return None
    low, high = _extent(plan, [reason for _, reason in shown])
    columns = len({policy for (policy, _), _ in shown})
    rows = math.ceil(len(shown) / columns)
    with matplotlib.rc_context(SETTINGS | {"font.size": 9.0}):
        figure = Figure(figsize=(_SIDE * columns, (_SIDE + 0.35) * rows), layout="constrained")
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes, ((policy, occlusion), reason) in zip(panels, shown, strict=False):
            how = style(policy, occlusion)
            score = float(plan.utilities[policy, occlusion][plan.candidates.view_ids.index(reason.view)])
            axes.scatter(*view.landmarks[:, :2].T, s=0.8, color=PALE, linewidths=0, rasterized=True, zorder=1)
            _draw_dots(axes, reason)
            _draw_view(axes, plan, reason.view, float(np.linalg.norm(high - low)))
            axes.set_title(
                f"{how.label}: view {reason.view}, score {score:.2f}", fontsize=9.5, color=how.colour, parse_math=False
            )
            axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xticks=[], yticks=[])
            axes.set_aspect("equal")
            _draw_metre(axes, low, high)
        for axes in panels[len(shown) :]:
            axes.set_visible(False)
        return svg_text(figure, name=name, label=f"Landmarks on which learned scores at {plan.prior.visit} rest")


def strongest(reasons: Mapping[tuple[str, bool | None], Reason]) -> tuple[tuple[str, str], ...]:
    """Return in words, per policy, how many landmarks raised the score of its view, and how many lowered it."""
    rows = []
    for (policy, occlusion), reason in reasons.items():
        up, down = int((reason.raised > 0).sum()), int((reason.raised < 0).sum())
        half = _half(reason.raised)
        words = f"{up} landmarks raised it, {down} lowered it"
        rows.append((style(policy, occlusion).label, f"{words}; {half} make half of what raised it" if half else words))
    return tuple(rows)


def _half(raised: np.ndarray) -> int:
    """Return how many of the landmarks that raised a score most make half of the sum of what raised it."""
    gains = np.sort(raised[raised > 0])[::-1]
    return int(np.searchsorted(np.cumsum(gains), gains.sum() / 2)) + 1 if len(gains) else 0


def _draw_dots(axes: Axes, reason: Reason) -> None:
    largest = float(np.abs(reason.raised).max(initial=0.0))
    share = np.abs(reason.raised) / largest if largest > 0 else np.zeros(len(reason.raised))
    weakest_first = np.argsort(share, kind="stable")
    colours = np.where(reason.raised > 0, RAISED, LOWERED)[weakest_first]
    x, y = reason.landmarks[weakest_first, :2].T
    axes.scatter(
        x, y, s=2.0 + 34.0 * share[weakest_first], c=colours.tolist(), alpha=0.75,
        linewidths=0, rasterized=True, zorder=3,
    )  # fmt: skip


def _draw_view(axes: Axes, plan: VisitPlan, view: str, reach: float) -> None:
    """Draw the camera at the prior, and the left and right edge of what it sees."""
    candidates = plan.candidates
    map_from_cam = candidates.map_from_cam[candidates.view_ids.index(view)]
    here = map_from_cam.translation[:2]
    middle = candidates.camera.centre_px[1]
    edges = candidates.camera.unproject([[0.0, middle], [candidates.camera.width, middle]])
    for ray in map_from_cam.rotation.apply(edges):
        along = ray[:2] / max(float(np.linalg.norm(ray[:2])), 1e-9)
        axes.plot(*zip(here, here + reach * along, strict=True), color=INK, linewidth=0.7, alpha=0.55, zorder=2)
    axes.plot(*here, marker="s", markersize=4.5, color="white", markeredgecolor=INK, zorder=5)


def _draw_metre(axes: Axes, low: Array, high: Array) -> None:
    """Draw one metre into the lower left corner: the panels have no axes."""
    x, y = low + 0.05 * (high - low)
    axes.plot([x, x + 1.0], [y, y], color=INK, linewidth=1.6, solid_capstyle="butt", zorder=4)
    axes.annotate("1 m", (x, y), xytext=(0, 3), textcoords="offset points", fontsize=8.5, color=INK, zorder=4)


def _extent(plan: VisitPlan, reasons: Sequence[Reason]) -> tuple[Array, Array]:
    """Return a square about the prior and nearly all landmarks that were asked for: the panels have one scale."""
    here = plan.prior.map_from_body.translation[None, :2]
    seen = np.concatenate([here, *(r.landmarks[:, :2].astype(np.float64) for r in reasons)])
    reach = max(float(np.percentile(np.abs(seen - here).max(axis=1), 98)) * 1.08, 1.0)
    return here[0] - reach, here[0] + reach
