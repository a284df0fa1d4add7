"""A tag's position and its uncertainty, drawn to scale: from above and from the side."""

from __future__ import annotations

import math
from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from fieldkit.report.figures import SETTINGS, svg_text
from fieldkit.types import Array, TagPhoto, TagPose

INK, PALE, GOOD, BAD = "#14181c", "#9aa4ad", "#17415f", "#b3261e"
# Photos further away than so many times the reach of those that were used are not drawn, but counted
FAR = 1.5


def tag_svg(tag: TagPose, photos: Sequence[TagPhoto], *, name: str) -> str:
    """Draw a tag's position with its 2 sigma ellipse in mm, and where every photo by itself has it.

    From above: x and y of the map. From the side: along the tag's own normal on the floor, and z. Both have one scale.
    """
    centre, turn = tag.map_from_tag.translation, tag.map_from_tag.rotation.as_matrix()
    covariance = turn @ tag.covariance[3:, 3:] @ turn.T
    normal = turn[:, 2].copy()
    normal[2] = 0.0
    length = float(np.linalg.norm(normal))
    normal = normal / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
    up = np.array([0.0, 0.0, 1.0])
    views = (
        ("from above", np.stack([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), ("x in the map (mm)", "y in the map (mm)")),
        ("from the side", np.stack([normal, up]), ("along the tag's normal (mm)", "height (mm)")),
    )
    seen = [(p.used, 1e3 * (np.array(p.position_m) - centre)) for p in photos if p.position_m is not None]
    reach = _reach(1e6 * covariance, [at for used, at in seen if used])
    with matplotlib.rc_context(SETTINGS):
        figure = Figure(figsize=(7.6, 3.6), layout="constrained")
        axes = figure.subplots(1, 2)
        for (title, onto, labels), ax in zip(views, axes, strict=True):
            _draw(ax, onto, 1e6 * covariance, turn, seen, reach)
            ax.set_title(title, fontsize=11, color="#33404b")
            ax.set(xlabel=labels[0], ylabel=labels[1])
        return svg_text(figure, name=name, label=f"Position of tag {tag.id} with its 2 sigma ellipse")


def _reach(covariance: Array, used: Sequence[Array]) -> float:
    wide = 2 * math.sqrt(max(float(np.linalg.eigvalsh(covariance)[-1]), 1e-6))
    far = max((float(np.abs(at).max()) for at in used), default=0.0)
    return 1.15 * max(wide, far)


def two_sigma(covariance: Array) -> tuple[float, float, float]:
    """Return the long and the short diameter of the 2 sigma ellipse of a 2x2 covariance, and its turn in deg."""
    values, vectors = np.linalg.eigh(covariance)
    short, long = 4 * np.sqrt(np.maximum(values, 0.0))
    return float(long), float(short), math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))


def _draw(
    axes: Axes, onto: Array, covariance: Array, turn: Array, seen: Sequence[tuple[bool, Array]], reach: float
) -> None:
    """Draw onto the plane of two rows (2, 3); everything in mm about the tag's centre."""
    # The paper is seen edge on along the axis of it that lies in the picture
    across = max((onto @ turn[:, 0], onto @ turn[:, 1]), key=lambda axis: float(np.linalg.norm(axis)))
    if float(np.linalg.norm(onto @ turn[:, 2])) > 0.5:
        axes.plot(*(np.outer(across, [-2 * reach, 2 * reach])), color=PALE, linewidth=3.0, alpha=0.5, zorder=1)
    wide, high, angle = two_sigma(onto @ covariance @ onto.T)
    axes.add_patch(Ellipse((0.0, 0.0), wide, high, angle=angle, facecolor=GOOD, alpha=0.18, edgecolor="none", zorder=2))
    axes.add_patch(Ellipse((0.0, 0.0), wide, high, angle=angle, fill=False, edgecolor=GOOD, linewidth=1.4, zorder=3))
    axes.plot(0.0, 0.0, marker="+", markersize=9, color=INK, zorder=5)
    outside = 0
    for used, at in seen:
        x, y = onto @ at
        if max(abs(x), abs(y)) > FAR * reach:
            outside += 1
            continue
        marker, colour = ("o", INK) if used else ("x", BAD)
        axes.plot(x, y, marker=marker, markersize=4.5, color=colour, linewidth=0, alpha=0.75, zorder=4)
    limit = FAR * reach if any(not used for used, _ in seen) else reach
    axes.set(xlim=(-limit, limit), ylim=(-limit, limit))
    axes.set_aspect("equal")
    axes.grid(color="#edf0f3", linewidth=0.8)
    if outside:
        note = f"{outside} rejected outside"
        axes.annotate(note, (0.02, 0.97), xycoords="axes fraction", va="top", fontsize=9, color=BAD)
    axes.spines[["top", "right"]].set_visible(False)
