"""Which landmarks made a learned policy prefer a view: the map from above, coloured."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from fieldkit.report.figures import SETTINGS, svg_text
from fieldkit.report.palette import style
from fieldkit.types import Array, PlanView, Reason, VisitPlan

RAISED, LOWERED, INK, PALE = "#17798a", "#c2410c", "#14181c", "#c3ccd4"
# Width of a panel in inches, and what title and legend add to the height
_SIDE, _TITLE, _LEGEND = 3.1, 0.5, 0.4
# Letters of a view's name in a title
_LONGEST = 18
_SETTINGS: Any = SETTINGS | {"font.size": 9.0}


def reasons_svg(plan: VisitPlan, view: PlanView, *, order: Sequence[str], name: str) -> str | None:
    """Draw for each learned policy what the score of the view that it prefers rests on; None without such a policy.

    Dots are the landmarks that were asked for, at their place from above: their area is how much leaving out just this
    one changes the log-odds, in units of the policy's largest change there. Lines bound what the camera sees. A column
    is a policy, without occlusion above with.
    """
    with matplotlib.rc_context(_SETTINGS):
        figure = reasons_figure(plan, view, order=order)
        label = f"Landmarks on which learned scores at {plan.prior.visit} rest"
        return None if figure is None else svg_text(figure, name=name, label=label)


def reasons_figure(plan: VisitPlan, view: PlanView, *, order: Sequence[str]) -> Figure | None:
    """Return the figure that `reasons_svg` writes, to be drawn with its settings; None without reasons."""
    shown = sorted(plan.reasons.items(), key=lambda item: (bool(item[0][1]), order.index(item[0][0])))
    if not shown:
        return None
    frames = _frames(plan, [reason for _, reason in shown])
    sides = frames[0][1] - frames[0][0]
    columns = len({policy for (policy, _), _ in shown})
    rows = math.ceil(len(shown) / columns)
    height = _SIDE * float(sides[1] / sides[0])
    figure = Figure(figsize=(_SIDE * columns, (height + _TITLE) * rows + _LEGEND), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, (variant, reason), (low, high) in zip(panels, shown, frames, strict=False):
        how = style(*variant)
        score = float(plan.utilities[variant][plan.candidates.view_ids.index(reason.view)])
        axes.scatter(*view.landmarks[:, :2].T, s=0.8, color=PALE, linewidths=0, rasterized=True, zorder=1)
        _draw_dots(axes, reason)
        _draw_view(axes, plan, reason.view, float(np.linalg.norm(sides)))
        title = f"{how.label}\nview {_short(reason.view)}, score {score:.2f}"
        axes.set_title(title, fontsize=9.5, color=how.colour, parse_math=False)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xticks=[], yticks=[])
        axes.set_aspect("equal")
        _draw_metre(axes, low, high)
    for axes in panels[len(shown) :]:
        axes.set_visible(False)
    _draw_legend(figure, columns)
    return figure


def strongest(reasons: Mapping[tuple[str, bool | None], Reason]) -> tuple[tuple[str, str], ...]:
    """Return in words, per policy, how many of the landmarks asked for raised the score of its view or lowered it."""
    rows = []
    for (policy, occlusion), reason in reasons.items():
        up, down = int((reason.raised > 0).sum()), int((reason.raised < 0).sum())
        half = _half(reason.raised)
        words = f"{len(reason.raised)} landmarks asked for: {up} raised it, {down} lowered it"
        half_words = f"; {half} {'makes' if half == 1 else 'make'} half of what raised it" if half else ""
        rows.append((style(policy, occlusion).label, words + half_words))
    return tuple(rows)


def _short(view: str) -> str:
    """Return a view's name as long as a title has room for."""
    return view if len(view) <= _LONGEST else f"{view[: _LONGEST - 1]}…"


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


def _draw_legend(figure: Figure, columns: int) -> None:
    """Say below the panels what the colours are."""
    handles = [
        Line2D([], [], color=RAISED, marker="o", markersize=6, linestyle="none", label="raised the score"),
        Line2D([], [], color=LOWERED, marker="o", markersize=6, linestyle="none", label="lowered it"),
        Line2D([], [], color=PALE, marker="o", markersize=3, linestyle="none", label="map"),
        Line2D([], [], color="white", marker="s", markersize=4.5, markeredgecolor=INK, linestyle="none", label="prior"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4 if columns > 1 else 2, frameon=False)


def _frames(plan: VisitPlan, reasons: Sequence[Reason]) -> list[tuple[Array, Array]]:
    """Return the corners of what each panel shows: nearly all its landmarks that were asked for, and the prior.

    All panels have one size, and so one scale; no side is longer than twice the other.
    """
    here = plan.prior.map_from_body.translation[:2]
    boxes = []
    for reason in reasons:
        asked = reason.landmarks[:, :2].astype(np.float64)
        corners = np.vstack([here, np.percentile(asked, [1, 99], axis=0) if len(asked) else here])
        boxes.append((corners.min(axis=0), corners.max(axis=0)))
    sides = np.max([high - low for low, high in boxes], axis=0)
    # A margin, and never less than two metres: a frame of nothing has no scale
    longest = max(1.14 * float(sides.max()), 2.0)
    sides = np.maximum(sides + 0.14 * float(sides.max()), [longest / 2, longest / 2])
    return [((low + high - sides) / 2, (low + high + sides) / 2) for low, high in boxes]
