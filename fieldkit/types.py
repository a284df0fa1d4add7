"""The nouns that the rooms hand to each other: frozen, without I/O."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from fieldkit.cameras import Camera
from fieldkit.frames import Pose, Trajectory

if TYPE_CHECKING:
    from fieldkit.protocol import Protocol

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


@dataclasses.dataclass(frozen=True)
class TagBounds:
    """What a calibrated tag's pass, warn and fail are.

    Fail: of several photos no two agree; the edge that the map's scale shows contradicts the given one by
    ``size_sigmas`` and by more than ``fail_size_share``; or all photos of the tag are rejected at their other tags.
    Warn: a standard deviation per axis exceeds ``warn_sigma_m`` or ``warn_sigma_rad``, fewer than ``enough_photos``
    agree, more than ``rejected_share`` of the photos are rejected, its tilt is open, or its size is off by more than
    ``size_share``.
    """

    warn_sigma_m: float = 0.01
    warn_sigma_rad: float = math.radians(0.5)
    enough_photos: int = 3
    rejected_share: float = 1 / 3
    size_sigmas: float = 4.0
    size_share: float = 0.005
    fail_size_share: float = 0.03


TAG_BOUNDS = TagBounds()


@dataclasses.dataclass(frozen=True)
class TagPhoto:
    """What became of one photo of a tag: ``reason`` is empty when it was used; sigma is its deviation in sigmas.

    ``flipped``: by itself the photo prefers the tag's other planar solution, which the others exclude. ``position_m``
    is where the photo by itself has the tag in the map, ``offset`` how far (m, rad) that is from the result,
    ``without`` how far the result moves without the photo, ``rms_px`` what remains in its corners. None where the
    photo does not tell.
    """

    file: str
    tag_id: int
    used: bool
    reason: str = ""
    visit: str | None = None
    ambiguity: float = 0.0
    sigma: float = 0.0
    flipped: bool = False
    rms_px: float | None = None
    position_m: tuple[float, float, float] | None = None
    offset: tuple[float, float] | None = None
    without: tuple[float, float] | None = None


@dataclasses.dataclass(frozen=True)
class TagPose:
    """A tag in the map: map_from_tag, its 6x6 covariance, edge length of the black square, and how it was found.

    ``leave_one_out``: by how much (m, rad) the pose moves at most without one of its photos. ``size_from_map``: the
    edge (m) that the map's scale shows, and its standard deviation. None where nothing tells. ``reason`` says what
    the verdict rests on, where it is not "pass".
    """

    id: int
    family: str
    size_m: float
    map_from_tag: Pose
    covariance: Array
    n_photos: int
    rms_px: float
    visit: str | None = None
    verdict: Literal["pass", "warn", "fail"] = "pass"
    leave_one_out: tuple[float, float] | None = None
    size_from_map: tuple[float, float] | None = None
    reason: str = ""


@dataclasses.dataclass(frozen=True)
class TagMap:
    """All tags of a session in the map with digest ``map_digest``; a tag that is moved has one pose per visit."""

    tags: tuple[TagPose, ...]
    photos: tuple[TagPhoto, ...]
    map_digest: str
    digest: str = ""
    path: str = ""

    def find(self, tag_id: int, *, visit: str | None = None) -> TagPose | None:
        """Return the tag's pose for a visit, else its pose for every visit, else None."""
        for wanted in (visit, None):
            for tag in self.tags:
                if tag.id == tag_id and tag.visit == wanted:
                    return tag
        return None

    def photos_of(self, tag: TagPose) -> list[TagPhoto]:
        """Return the photos of a tag; one that has the same place at every visit has those of every visit."""
        return [p for p in self.photos if p.tag_id == tag.id and tag.visit in (None, p.visit)]


@dataclasses.dataclass(frozen=True)
class Surface:
    """A triangle mesh in the map frame: vertices float[n, 3] in m, faces int[m, 3]; the voxel size it was made with."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    voxel_m: float


@dataclasses.dataclass(frozen=True)
class SceneMap:
    """Landmarks in the metric, gravity aligned map frame, who saw them from where, and their descriptors.

    Landmarks (n): ``xyz`` f64[n, 3] in m; ``xyz_covariance`` f64[n, 3, 3] in m^2.
    Mapping images (k): ``image_names``, ``image_cameras``, ``map_from_image`` poses (camera in the map).
    Observations (o), sorted by image: ``observation_landmark`` int32[o], ``observation_image`` int32[o],
    ``observation_px`` f32[o, 2].
    Descriptors (d): ``descriptors`` uint8 or float32[d, width], ``descriptor_landmark`` int32[d],
    ``descriptor_image`` int32[d]; a compact map has one per landmark.
    """

    path: str
    digest: str
    feature: str
    xyz: Array
    xyz_covariance: Array
    image_names: tuple[str, ...]
    image_cameras: tuple[Camera, ...]
    map_from_image: tuple[Pose, ...]
    observation_landmark: NDArray[np.int32]
    observation_image: NDArray[np.int32]
    observation_px: NDArray[np.float32]
    descriptors: NDArray[np.uint8] | NDArray[np.float32]
    descriptor_landmark: NDArray[np.int32]
    descriptor_image: NDArray[np.int32]
    surface: Surface | None = None


@dataclasses.dataclass(frozen=True)
class LandmarkStatistics:
    """From where mapping saw each landmark (n), as the paper's features and policies need it.

    Distances in m. ``*_angle_rad``: smallest and largest angle between the viewing ray and the principal axis of the
    observing images (camera frame). ``mean_direction`` f64[n, 3]: unit mean of the directions landmark -> camera;
    ``spread_rad``: largest angle between it and an observing direction (Davison and Murray 2002, at the landmark).
    """

    min_distance_m: Array
    max_distance_m: Array
    min_angle_rad: Array
    max_angle_rad: Array
    mean_direction: Array
    spread_rad: Array
    n_observations: NDArray[np.int32]


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

    ``status`` is "ok" or the reason of the failure: no_features, no_matches, few_inliers, no_pose.
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
class VisitPlan:
    """What was known at a visit before looking: prior, candidates, and every policy's utility per candidate.

    ``utilities`` maps (policy, occlusion) to f64[v]; -inf is not allowed, never nan.
    """

    session: str
    prior: Prior
    prior_error: tuple[float, float]
    candidates: Candidates
    utilities: Mapping[tuple[str, bool | None], Array]


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
