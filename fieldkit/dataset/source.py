"""Where the views of a dataset come from: a simulator, or anything else that knows the true poses."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

from fieldkit.cameras import Camera
from fieldkit.frames import Pose
from fieldkit.types import Array, Image, ViewKind


@dataclasses.dataclass(frozen=True)
class SourceView:
    """A view at a waypoint: body_from_cam as the kinematics tell, and the true world_from_cam."""

    id: str
    kind: ViewKind
    body_from_cam: Pose
    world_from_cam: Pose


@dataclasses.dataclass(frozen=True)
class SourceWaypoint:
    """A place where the robot looks around: the true body, the body that it believes in, and the views.

    ``prior_covariance`` is 6x6 (right perturbation, rotation first). ``next`` is the id of the waypoint that it goes
    to from here.
    """

    id: str
    world_from_body: Pose
    world_from_prior: Pose
    prior_covariance: Array
    camera: Camera
    views: tuple[SourceView, ...]
    next: str | None = None


class ViewSource(Protocol):
    """A scene that can be mapped and looked at. It is pickled to be used in worker processes.

    What it returns depends on its own settings and the arguments alone, never on the order of calls.
    """

    @property
    def name(self) -> str:
        """Name of the scene: a folder of the dataset, and a session of runs."""

    @property
    def mapping_key(self) -> str:
        """Digest of all that the mapping data depend on."""

    @property
    def views_key(self) -> str:
        """Digest of all that waypoints and images depend on."""

    def write_mapping(self, folder: Path) -> Mapping[str, Pose]:
        """Write a SOURCE of `maps.build_map` into an empty folder; return world_from_cam by image name."""

    def waypoints(self) -> Sequence[SourceWaypoint]:
        """Return the waypoints in the order in which the robot visits them."""

    def shoot(self, waypoint: SourceWaypoint, view: SourceView, *, repeat: int = 0) -> Image:
        """Return the image of a view, uint8[h, w] or RGB; every ``repeat`` has noise of its own."""
