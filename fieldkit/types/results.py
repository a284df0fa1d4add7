"""What a replay finds: priors, candidates, truths, estimates, trials, and the run that holds them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from fieldkit.cameras import Camera
from fieldkit.frames import Pose
from fieldkit.types.recordings import ViewKind
from fieldkit.types.tags import TagMap

if TYPE_CHECKING:
    from fieldkit.protocol import Protocol

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Prior:
    """Where the robot believes its body is at a waypoint: pose, 6x6 covariance, metres travelled since the start.

    ``notes`` say what was left out on the way to it.
    """

    visit: str
    map_from_body: Pose
    covariance: Array
    t_ns: int
    travelled_m: float
    n_sightings: int
    notes: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Candidates:
    """The views among which a policy chooses, at the prior: v camera poses, never images, estimates or truth.

    ``allowed`` bool[v]: views that ranking policies may choose (the sweep, unless the protocol says otherwise).
    ``forward_in_map`` unit vector (3,) along the path to the next waypoint, or None where nothing defines it.
    """

    visit: str
    view_ids: tuple[str, ...]
    kinds: tuple[ViewKind, ...]
    map_from_cam: tuple[Pose, ...]
    camera: Camera
    allowed: NDArray[np.bool_]
    forward_in_map: Array | None = None


@dataclasses.dataclass(frozen=True)
class Truth:
    """The true camera pose of a view, its 6x6 covariance, and where it comes from (tag, topic or simulation)."""

    visit: str
    view: str
    map_from_cam: Pose
    body_from_cam: Pose
    covariance: Array
    source: Literal["tag", "topic", "simulation"]

    @property
    def sigma(self) -> tuple[float, float]:
        """Standard deviation of position (m) and rotation (rad): root of the traces of the covariance's blocks."""
        rotation, position = np.trace(self.covariance[:3, :3]), np.trace(self.covariance[3:, 3:])
        return math.sqrt(max(position, 0.0)), math.sqrt(max(rotation, 0.0))


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A localized image: map_from_cam or None, covariance, counts, and seconds per stage.

    ``status`` is "ok" or the reason of the failure: no_features, no_matches, few_inliers, no_pose, low_confidence; of
    an image file also unreadable, other_size. ``confidence`` 0..1 is the probability that the pose is right.
    """

    map_from_cam: Pose | None
    covariance: Array | None
    n_matches: int
    n_inliers: int
    status: str
    confidence: float
    seconds: Mapping[str, float]


@dataclasses.dataclass(frozen=True)
class Trial:
    """What a policy got at a visit: the chosen view, the weight of that choice, and its errors (inf when failed).

    Angles in rad here, in deg on disk. ``occlusion`` is None for policies that do not count landmarks.
    """

    session: str
    visit: str
    policy: str
    occlusion: bool | None
    view: str
    weight: float
    utility: float
    status: str
    cam_error: tuple[float, float]
    body_error: tuple[float, float]
    truth_sigma: tuple[float, float]
    prior_error: tuple[float, float]


@dataclasses.dataclass(frozen=True)
class ViewResult:
    """An estimate with the view that it belongs to."""

    session: str
    visit: str
    view: str
    kind: ViewKind
    t_ns: int
    estimate: Estimate


@dataclasses.dataclass(frozen=True)
class Reason:
    """What a learned score of a view rests on: k landmarks f32[k, 3] (m, in the map), and how much each raised it.

    ``raised`` f32[k]: the view's log-odds to localize, minus those without this one landmark; negative: it lowered it.
    """

    view: str
    landmarks: NDArray[np.float32]
    raised: NDArray[np.float32]


@dataclasses.dataclass(frozen=True)
class VisitPlan:
    """What was known at a visit before looking: prior, candidates, and every policy's utility per candidate.

    ``utilities`` maps (policy, occlusion) to f64[v]; -inf is not allowed, never nan. ``reasons`` are those of learned
    policies, for the view that each prefers.
    """

    session: str
    prior: Prior
    prior_error: tuple[float, float]
    candidates: Candidates
    utilities: Mapping[tuple[str, bool | None], Array]
    reasons: Mapping[tuple[str, bool | None], Reason] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class PlanView:
    """A thinned map to draw from above: landmarks f32[n, 3] and mapping camera positions f32[k, 3]."""

    landmarks: NDArray[np.float32]
    cameras: NDArray[np.float32]


@dataclasses.dataclass(frozen=True)
class Excluded:
    """Something that was left out of the result, and why."""

    what: str
    reason: str


@dataclasses.dataclass(frozen=True)
class Applied:
    """A file whose values took the place of what recordings state, and its digest."""

    kind: Literal["camera", "hand"]
    path: str
    digest: str


@dataclasses.dataclass(frozen=True)
class Run:
    """A finished replay: everything that scoring and the report need, without images, bag or map.

    ``tags`` are those it was replayed with, None where it needed none or an older run does not hold them.
    ``map_seconds`` are those of building the map, per stage, where the map says so. ``weights`` are the digests of the
    learned policies' checkpoints, ``trained_on`` the scenes that they were trained or validated on.
    """

    protocol: Protocol
    map_digest: str
    tags_digest: str
    recordings: tuple[str, ...]
    sessions: tuple[str, ...]
    seed: int
    versions: Mapping[str, str]
    trials: tuple[Trial, ...]
    results: tuple[ViewResult, ...]
    truths: tuple[tuple[str, Truth], ...]
    plans: tuple[VisitPlan, ...]
    plan_view: PlanView
    thumbnails: Mapping[str, bytes]
    excluded: tuple[Excluded, ...] = ()
    path: str = ""
    tags: TagMap | None = None
    corrections: tuple[Applied, ...] = ()
    map_seconds: Mapping[str, float] = dataclasses.field(default_factory=dict)
    weights: Mapping[str, str] = dataclasses.field(default_factory=dict)
    trained_on: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)
