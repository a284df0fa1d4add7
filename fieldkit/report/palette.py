"""Colours and words that table, curves, plan and waypoints share."""

from __future__ import annotations

import dataclasses

COLOURS: dict[str, str] = {
    "stowed": "#8c6239",
    "forward": "#2f6fb0",
    "odometry": "#7a5ba6",
    "random": "#8f979d",
    "max": "#d1495b",
    "angle": "#e08e1b",
    "fim": "#3a8f55",
    "mlp": "#c05fa8",
    "vpt": "#159aa8",
    "vpt_dino": "#1f4e79",
    "vpt_appearance": "#85144b",
    "best_possible": "#14181c",
}
# SVG dash lengths, which matplotlib takes in line widths and the page's legend in pixels.
DASHES: dict[bool | None, tuple[float, ...]] = {None: (), True: (), False: (3.2, 1.8)}
ORACLE_DASH = (1.0, 1.6)


@dataclasses.dataclass(frozen=True)
class Style:
    """How a policy's variant is drawn: label, colour, and dash pattern (empty for a solid line)."""

    label: str
    colour: str
    dash: tuple[float, ...]


def style(policy: str, occlusion: bool | None) -> Style:
    """Return the style of a policy with (True), without (False) or irrespective of (None) the occlusion filter."""
    words = {None: "", True: " + occlusion", False: ""}[occlusion]
    dash = ORACLE_DASH if policy == "best_possible" else DASHES[occlusion]
    return Style(policy.replace("_", " ") + words, COLOURS.get(policy, "#555555"), dash)
