"""What a robot recorded: frames, views, visits, and what is wrong with its odometry."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fieldkit.cameras import Camera
from fieldkit.frames import Pose, Trajectory

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
ViewKind = Literal["sweep", "stowed", "forward", "truth"]
VIEW_KINDS: tuple[ViewKind, ...] = ("sweep", "stowed", "forward", "truth")


@dataclasses.dataclass(frozen=True, eq=False)
class SeenTag:
    """A tag that a detector on the robot saw: corners f64[4, 2] in COLMAP pixels, from bottom-left counter-clockwise.

    ``family`` and ``sigma_px`` (noise per coordinate) are None where the recording does not tell them.
    """

    id: int
    family: str | None
    corners_px: Array
    sigma_px: float | None = None


@dataclasses.dataclass(frozen=True)
class Frame:
    """One image of the robot's arm camera: when it was taken, camera, kinematics, and the image read on demand.

    ``t_ns`` is the header stamp less the known latency ``late_ns``. ``read()`` returns uint8[h, w] (grey) or
    uint8[h, w, 3] (RGB). ``body_from_cam`` is None where tf does not reach, ``tags`` (found while recording) where
    the image itself is to be searched.
    """

    t_ns: int
    camera: Camera
    body_from_cam: Pose | None
    read: Callable[[], Image]
    tags: tuple[SeenTag, ...] | None = None
    late_ns: int = 0

    @property
    def stamp_ns(self) -> int:
        """The header stamp."""
        return self.t_ns + self.late_ns


@dataclasses.dataclass(frozen=True)
class View:
    """One recorded direction of the arm camera at a waypoint."""

    id: str
    kind: ViewKind
    frame: Frame
    repeat: int = 0


@dataclasses.dataclass(frozen=True)
class Start:
    """An interval in which the robot stands where it knows its pose; ``visit`` names the only visit that it serves.

    ``tag_id`` is the start tag that it sees there; None where the recording's reference topic gives the start pose.
    """

    tag_id: int | None
    t_begin_ns: int
    t_end_ns: int
    visit: str | None = None


@dataclasses.dataclass(frozen=True)
class Visit:
    """One waypoint: its interval, its views, the tripod tag that gives the truth, and the next waypoint."""

    id: str
    t_begin_ns: int
    t_end_ns: int
    views: tuple[View, ...]
    next: str | None = None
    truth_tag_id: int | None = None


@dataclasses.dataclass(frozen=True)
class OdometryFault:
    """Something wrong with odometry from ``t_begin_ns`` to ``t_end_ns``: what kind, and a sentence with numbers.

    ``excess`` is by how much (m, rad) a jump exceeds what its neighbours say.
    """

    kind: Literal["gap", "jump", "order", "repeat", "rate", "latency", "offset"]
    t_begin_ns: int
    t_end_ns: int
    message: str
    excess: tuple[float, float] = (0.0, 0.0)


@dataclasses.dataclass(frozen=True)
class Recording:
    """A recorded session: everything that replay needs, images on demand.

    ``frames`` all images of the arm camera in the order of their stamps. ``odometry`` is odom_from_body.
    ``reference`` is map_from_body from a pose topic (motion capture, total station, another system) or None, and
    ``reference_covariance`` f64[n, 6, 6] what the topic says of its samples (right perturbation) or None.
    ``tag_frames`` are recorded tag detections, frames without an image; ``odometry_faults`` what is wrong, and when.
    """

    name: str
    path: str
    layout: str
    frames: tuple[Frame, ...]
    odometry: Trajectory
    starts: tuple[Start, ...]
    visits: tuple[Visit, ...]
    reference: Trajectory | None = None
    warnings: tuple[str, ...] = ()
    reference_covariance: Array | None = None
    tag_frames: tuple[Frame, ...] = ()
    odometry_faults: tuple[OdometryFault, ...] = ()

    def reference_covariance_at(self, t_ns: int) -> Array | None:
        """Return the covariance that the topic states at a time, the larger one of its neighbours between, or None."""
        if self.reference is None or self.reference_covariance is None:
            return None
        right = int(np.searchsorted(self.reference.t_ns, t_ns))
        exact = right < len(self.reference.t_ns) and int(self.reference.t_ns[right]) == t_ns
        near = self.reference_covariance[right if exact else max(right - 1, 0) : right + 1]
        largest: Array = near[int(np.argmax(np.trace(near, axis1=1, axis2=2)))]
        return largest
