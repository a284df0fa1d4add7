"""Figures as inline SVG: cumulative error curves and the map from above. The same run gives the same bytes."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Sequence
from typing import Any, Literal

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.ticker import FuncFormatter, NullFormatter
from numpy.typing import NDArray

from fieldkit.report.palette import style
from fieldkit.report.visits import VisitRows
from fieldkit.scores import ODOMETRY, cumulative, group
from fieldkit.types import Run, Trial

Array = NDArray[np.float64]
SETTINGS: Any = {
    "svg.hashsalt": "fieldkit",
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 11.0,
    "axes.edgecolor": "#9aa4ad",
    "axes.labelcolor": "#33404b",
    "xtick.color": "#5b6771",
    "ytick.color": "#5b6771",
}
# A choice is drawn as an arrow when at least this share of the policy's weight lies on the view.
SHOWN_WEIGHT = 0.3


def curve_svg(run: Run, part: Literal["position", "rotation"], *, name: str) -> str:
    """Draw the share of visits below an error, one step curve per policy; thresholds as vertical lines.

    ``name`` is put before every id of the SVG, so that several figures can stand on one page.
    """
    with matplotlib.rc_context(SETTINGS):
        figure = Figure(figsize=(5.6, 3.7), layout="constrained")
        axes = figure.add_subplot()
        bounds = sorted({t.position_m if part == "position" else t.rotation_deg for t in run.protocol.thresholds})
        unit, scale = ("m", 1.0) if part == "position" else ("deg", math.degrees(1.0))
        curves = {
            variant: cumulative(trials, pose=run.protocol.pose, part=part)
            for variant, trials in group(run.trials, order=run.protocol.policies).items()
        }
        smallest = min((scale * float(errors[0]) for errors, _ in curves.values() if len(errors)), default=bounds[0])
        low, high = float(np.clip(smallest / 1.5, bounds[0] / 300, bounds[0] / 8)), bounds[-1] * 2.5
        for (policy, occlusion), (errors, share) in curves.items():
            shown = np.clip(scale * errors, low, None)
            how = style(policy, occlusion)
            (line,) = axes.step(
                [low, *shown, max(high, *shown, low)], [0.0, *(100 * share), 100 * (share[-1] if len(share) else 0.0)],
                where="post", color=how.colour, linewidth=1.8, solid_capstyle="butt",
            )  # fmt: skip
            if how.dash:
                line.set_dashes(how.dash)
        for bound in bounds:
            axes.axvline(bound, color="#c3ccd4", linewidth=0.9, zorder=0)
        axes.set(xscale="log", xlim=(low, high), ylim=(0, 103), xlabel=f"{part} error ({unit}, logarithmic)")
        axes.set_ylabel("visits (%)")
        _plain_ticks(axes, low, high)
        axes.grid(axis="y", color="#edf0f3", linewidth=0.8)
        axes.spines[["top", "right"]].set_visible(False)
        return svg_text(figure, name=name, label=f"Cumulative {part} error per policy")


def _plain_ticks(axes: Axes, low: float, high: float) -> None:
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    steps = (1, 2, 5) if high < 150 * low else (1,)
    ticks = [step * 10.0**d for d in decades for step in steps if low <= step * 10.0**d <= high]
    axes.set_xticks(ticks)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.tick_params(which="minor", length=0)


def plan_svg(run: Run, visits: Sequence[VisitRows], *, name: str) -> str:
    """Draw the map from above: landmarks, mapping cameras, waypoints at prior and truth, chosen directions.

    Parallel arrows of one waypoint are policies that chose the same view; a cross at the tip is a failed estimate.
    Priors are drawn with their 95 % ellipse.
    """
    low, high = _extent(run, [p for visit in visits for p in _positions(visit)])
    span = np.maximum(high - low, 1e-3)
    width = 9.6
    # The labels of the axes take 0.8 inches of the width and 0.6 of the height.
    height = float(np.clip((width - 0.8) * span[1] / span[0], 2.6, 9.0)) + 0.6
    with matplotlib.rc_context(SETTINGS):
        figure = Figure(figsize=(width, height), layout="constrained")
        axes = figure.add_subplot()
        landmarks, cameras = run.plan_view.landmarks, run.plan_view.cameras
        axes.scatter(landmarks[:, 0], landmarks[:, 1], s=1.1, color="#aab4bc", linewidths=0, rasterized=True, zorder=1)
        axes.scatter(cameras[:, 0], cameras[:, 1], s=10, marker="^", color="#7fb3d9", linewidths=0, rasterized=True)
        length = _arrow_length(visits, span)
        for visit in visits:
            _draw_waypoint(axes, visit, several=len(run.sessions) > 1)
            _draw_choices(axes, visit, order=run.protocol.policies, length=length)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x in the map (m)", ylabel="y in the map (m)")
        axes.set_aspect("equal")
        axes.spines[["top", "right"]].set_visible(False)
        return svg_text(figure, name=name, label="Map from above with waypoints and chosen directions")


def _positions(visit: VisitRows) -> list[Array]:
    return [p.translation[:2] for p in (visit.plan.prior.map_from_body, visit.map_from_body) if p is not None]


def _extent(run: Run, positions: Sequence[Array]) -> tuple[Array, Array]:
    clouds = [np.asarray(c, dtype=np.float64)[:, :2] for c in (run.plan_view.cameras,) if len(c)]
    if len(run.plan_view.landmarks):
        # A few landmarks triangulated far away would shrink the room to a dot.
        clouds.append(np.percentile(run.plan_view.landmarks[:, :2].astype(np.float64), [2, 98], axis=0))
    if positions:
        clouds.append(np.asarray(positions))
    points = np.vstack(clouds) if clouds else np.zeros((1, 2))
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.06 * max(float((high - low).max()), 0.5)
    return low - margin, high + margin


def _arrow_length(visits: Sequence[VisitRows], span: Array) -> float:
    points = np.array([_positions(visit)[-1] for visit in visits])
    length = 0.11 * float(span.max())
    if len(points) < 2:
        return length
    gaps = np.linalg.norm(points[:, None] - points[None], axis=2)[~np.eye(len(points), dtype=bool)]
    return float(
        np.clip(0.45 * np.median(gaps[gaps > 0], axis=0) if (gaps > 0).any() else length, 0.06 * span.max(), length)
    )


def _draw_waypoint(axes: Axes, visit: VisitRows, *, several: bool) -> None:
    plan, true = visit.plan, visit.map_from_body
    prior = plan.prior.map_from_body
    here = prior.translation[:2]
    turn = prior.rotation.as_matrix()
    spread = (turn @ plan.prior.covariance[3:, 3:] @ turn.T)[:2, :2]
    values, vectors = np.linalg.eigh(spread)
    # 5.991: the 95 % quantile of the chi-square distribution with two degrees of freedom
    wide, high = 2 * np.sqrt(5.991 * np.maximum(values[::-1], 0.0))
    angle = math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))
    axes.add_patch(Ellipse(tuple(here), wide, high, angle=angle, fill=False, edgecolor="#14181c", lw=0.7, alpha=0.6))
    axes.plot(*here, marker="s", markersize=5.5, color="white", markeredgecolor="#14181c", zorder=6)
    at = here
    if true is not None:
        at = true.translation[:2]
        axes.plot(*zip(here, at, strict=True), color="#14181c", linewidth=0.9, zorder=5)
        axes.plot(*at, marker="o", markersize=5.5, color="#14181c", zorder=7)
    label = f"{plan.session} {plan.prior.visit}" if several else plan.prior.visit
    axes.annotate(
        label,
        (float(at[0]), float(at[1])),
        xytext=(7, -13),
        textcoords="offset points",
        fontsize=10,
        color="#14181c",
        zorder=8,
        parse_math=False,
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 0.8},
    )


def _draw_choices(axes: Axes, visit: VisitRows, *, order: Sequence[str], length: float) -> None:
    base = _positions(visit)[-1]
    planned = dict(zip(visit.plan.candidates.view_ids, visit.plan.candidates.map_from_cam, strict=True))
    for view, trials in _chosen_views(visit, order).items():
        truth = visit.truths.get(view)
        map_from_cam = planned.get(view) if truth is None else truth.map_from_cam
        if map_from_cam is None:
            continue
        forward = map_from_cam.rotation.as_matrix()[:2, 2]
        reach = float(np.linalg.norm(forward))
        if reach < 0.05:
            continue
        direction = forward / reach
        side = np.array([-direction[1], direction[0]])
        for i, trial in enumerate(trials):
            offset = side * (i - (len(trials) - 1) / 2) * 0.085 * length
            _arrow(axes, base + offset + 0.16 * length * direction, length * direction, trial)


def _arrow(axes: Axes, start: Array, along: Array, trial: Trial) -> None:
    how = style(trial.policy, trial.occlusion)
    end = start + along
    failed = not math.isfinite(trial.cam_error[0])
    line: tuple[float, tuple[float, ...]] | str = (0.0, how.dash) if how.dash else "-"
    axes.plot(*zip(start, end, strict=True), color=how.colour, linewidth=1.6, linestyle=line, zorder=4)
    if failed:
        axes.plot(*end, marker="x", markersize=5, markeredgewidth=1.5, color=how.colour, zorder=4)
        return
    angle = math.degrees(math.atan2(along[1], along[0]))
    axes.plot(*end, marker=(3, 0, angle - 90), markersize=5, color=how.colour, linewidth=0, zorder=4)


def _chosen_views(visit: VisitRows, order: Sequence[str]) -> dict[str, list[Trial]]:
    views: dict[str, list[Trial]] = {}
    for (policy, _), trials in group(visit.trials, order=order).items():
        for trial in trials:
            if policy != ODOMETRY and trial.view and trial.weight >= SHOWN_WEIGHT:
                views.setdefault(trial.view, []).append(trial)
    return views


def svg_text(figure: Figure, *, name: str, label: str) -> str:
    """Return a figure as SVG whose ids begin with a name, without what differs from run to run."""
    stream = io.StringIO()
    figure.savefig(stream, format="svg", dpi=200, metadata={"Date": None})
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = text.replace('xlink:href="#', f'xlink:href="#{name}-').replace("url(#", f"url(#{name}-")
    return _open(text, label=label)


def _open(text: str, *, label: str) -> str:
    """Let the page's style decide the size, and say what the picture shows to those who cannot see it."""
    end = text.index(">")
    attributes = re.sub(r' (width|height)="[^"]*"', "", text[len("<svg") : end])
    return f'<svg role="img" aria-label="{label}"{attributes}{text[end:]}'
