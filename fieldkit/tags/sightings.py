"""What the robot's arm camera sees of tags: sightings, and where the body was at each relative to one time."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from fieldkit.cameras import Camera
from fieldkit.errors import FrameError, TagError
from fieldkit.frames import Array, Pose, Trajectory
from fieldkit.odometry import PlacedTag, jumps_between, travel
from fieldkit.protocol import OdometryNoise
from fieldkit.tags.detect import TagDetection, detect
from fieldkit.tags.fusion import Sighting
from fieldkit.tags.jumps import ARM_COVARIANCE, jump_between, move
from fieldkit.tags.pose import solve
from fieldkit.types import Frame, OdometryFault, Recording, SeenTag, TagPose

# The body has made a step where odometry moved by more than this: less is jitter of a robot that stands
STAND_M, STAND_RAD = 0.01, math.radians(0.5)
# What odometry misses of any step: it does not see the body tilt, and nothing is certain
STEP_FLOOR: Array = np.diag([math.radians(0.05) ** 2] * 3 + [0.0005**2] * 3)
# Corner noise of recorded detections that state none: this, as if seen in so many sightings, and what their own
# residuals say; nothing gets below the floor
MESSAGE_SIGMA_PX, MESSAGE_WEIGHT, MESSAGE_FLOOR_PX = 0.3, 10, 0.05
# Residual of the better planar solution over the other's above which a single image does not tell them apart
DOUBTFUL = 0.5


@dataclasses.dataclass(frozen=True)
class Place:
    """A frame relative to the body at the reference: ref_from_body by odometry, body_from_cam, its stand."""

    frame: Frame
    ref_from_body: Pose
    body_from_cam: Pose
    stand: int

    @property
    def ref_from_cam(self) -> Pose:
        """The camera relative to the body at the reference."""
        return self.ref_from_body * self.body_from_cam


@dataclasses.dataclass(frozen=True)
class BodySighting:
    """A tag in one placed frame."""

    detection: TagDetection
    place: Place


@dataclasses.dataclass(frozen=True)
class BodySightings:
    """Sightings of tags relative to the body at ``t_ns``; how many frames were searched, and what was left out.

    ``places`` are all frames with kinematics and odometry. The body moves between its stands only: ``steps`` holds for
    each stand but the first the body at its begin, ref_from_body, and the 6x6 covariance of the step that led there;
    ``step_means`` (6,) are what odometry says of the steps' errors: not zero where a jump has been taken out.
    """

    t_ns: int
    sightings: tuple[BodySighting, ...]
    places: tuple[Place, ...]
    steps: tuple[tuple[Pose, Array], ...]
    step_means: tuple[Array, ...]
    n_frames: int
    no_kinematics: int
    no_odometry: int
    last_error: str

    @property
    def explanation(self) -> str:
        """Why there is no sighting: counts of the frames and what was wrong with them."""
        parts = [f"{self.n_frames} images searched"]
        if self.no_kinematics:
            parts.append(f"{self.no_kinematics} without a transform from body to camera")
        if self.no_odometry:
            parts.append(f"{self.no_odometry} without odometry ({self.last_error})")
        return ", ".join(parts)

    def of(self, tag: TagPose) -> tuple[BodySighting, ...]:
        """Return the sightings of one tag."""
        return tuple(s for s in self.sightings if (s.detection.id, s.detection.family) == (tag.id, tag.family))


def frames_between(recording: Recording, t_begin_ns: int, t_end_ns: int) -> list[Frame]:
    """Return the images of an interval; recorded tag detections of it where it has no image."""
    for frames in (recording.frames, recording.tag_frames):
        inside = [f for f in frames if t_begin_ns <= f.t_ns <= t_end_ns]
        if inside:
            return inside
    return []


def placed_tags(frames: Sequence[Frame], tags: Sequence[TagPose]) -> list[PlacedTag]:
    """Return each tag relative to the body by each frame alone, where its planar solution is beyond doubt."""
    places = [Place(f, Pose.identity(), f.body_from_cam, 0) for f in frames if f.body_from_cam is not None]
    sizes = {(tag.id, tag.family): tag.size_m for tag in tags}
    found = []
    for seen in _seen(places, tags):
        size_m = sizes[seen.detection.id, seen.detection.family]
        try:
            own = solve(seen.detection, seen.place.frame.camera, size_m)
        except (TagError, np.linalg.LinAlgError):
            continue
        if own.ambiguity < DOUBTFUL:
            body_from_tag = seen.place.body_from_cam * own.cam_from_tag
            found.append(PlacedTag(seen.place.frame.t_ns, seen.detection.id, body_from_tag, own.covariance))
    return found


def body_sightings(
    frames: Sequence[Frame],
    tags: Sequence[TagPose],
    *,
    odometry: Trajectory,
    noise: OdometryNoise,
    faults: Sequence[OdometryFault] = (),
    max_frames: int = 60,
) -> BodySightings:
    """Find tags in frames of a robot that stands or moves little, and place the cameras relative to its body.

    The reference is the body at the last frame with kinematics and odometry. Motion between a frame and the
    reference comes from odometry deltas, never from its absolute pose; a jump among ``faults`` is in the covariance of
    its step with its size. Of more than ``max_frames`` so many are
    searched, evenly spread. Frames whose tags were detected while recording are not searched. A tag that is twice in an
    image is left out of it.
    """
    placed: list[tuple[Frame, Pose, Pose]] = []
    no_kinematics, no_odometry, last_error = 0, 0, ""
    chosen = [frames[i] for i in np.linspace(0, len(frames) - 1, min(len(frames), max_frames)).astype(int)]
    for frame in chosen:
        if frame.body_from_cam is None:
            no_kinematics += 1
            continue
        try:
            placed.append((frame, odometry.at(frame.t_ns), frame.body_from_cam))
        except FrameError as error:
            no_odometry += 1
            last_error = error.message
    if not placed:
        return BodySightings(0, (), (), (), (), len(chosen), no_kinematics, no_odometry, last_error)
    reference = placed[-1][0].t_ns
    stands, begins = _stands([pose for _, pose, _ in placed])
    ref_from_odom = odometry.at(reference).inv()
    places = tuple(
        Place(frame, ref_from_odom * pose, body_from_cam, stand)
        for (frame, pose, body_from_cam), stand in zip(placed, stands, strict=True)
    )
    seen = _seen(places, tags)
    times = [placed[i][0].t_ns for i in begins]
    steps = tuple(
        (
            places[i].ref_from_body,
            travel(odometry, before, places[i].frame.t_ns, noise=noise, faults=faults)[1] + STEP_FLOOR,
        )
        for before, i in zip(times, begins[1:], strict=False)
    )
    means = tuple(np.zeros(6) for _ in steps)
    found = BodySightings(reference, seen, places, steps, means, len(chosen), no_kinematics, no_odometry, last_error)
    jumped = [k for k in range(len(steps)) if jumps_between(faults, times[k], times[k + 1])]
    for before, k, after in zip([-1, *jumped], jumped, [*jumped[1:], len(steps)], strict=False):
        found = _rejoined(found, k, tags, stands=(range(before + 1, k + 1), range(k + 1, after + 1)))
    return found


def _rejoined(
    found: BodySightings, k: int, tags: Sequence[TagPose], *, stands: tuple[Sequence[int], Sequence[int]]
) -> BodySightings:
    """Move all before the jump of step ``k`` to where a tag that is seen in the stands on both sides shows it.

    What odometry says of the step stays as it is: this is where the problem is linear, and takes no information.
    """
    ref_from_begin, covariance = found.steps[k]
    # The tag that more is seen of on the side where less is seen of it
    ranked = [(min(len(_seen_from(found, tag, side)) for side in stands), index) for index, tag in enumerate(tags)]
    count, best = max(ranked, default=(0, 0))
    if not count:
        return found
    before, after = (_seen_from(found, tags[best], side) for side in stands)
    size_m = tags[best].size_m
    error = jump_between(before, after, size_m=size_m, ref_from_begin=ref_from_begin, covariance=covariance)
    moved = move(ref_from_begin, error)
    places = {
        id(p): dataclasses.replace(p, ref_from_body=moved * p.ref_from_body) if p.stand <= k else p
        for p in found.places
    }
    return dataclasses.replace(
        found,
        places=tuple(places.values()),
        sightings=tuple(dataclasses.replace(s, place=places[id(s.place)]) for s in found.sightings),
        steps=tuple((moved * pose if i < k else pose, c) for i, (pose, c) in enumerate(found.steps)),
        step_means=tuple(-error if i == k else mean for i, mean in enumerate(found.step_means)),
    )


def _seen_from(found: BodySightings, tag: TagPose, stands: Sequence[int]) -> list[Sighting]:
    return [
        Sighting(s.detection, s.place.frame.camera, s.place.ref_from_cam, ARM_COVARIANCE)
        for s in found.of(tag)
        if s.place.stand in stands
    ]


def _stands(odom_from_body: Sequence[Pose]) -> tuple[list[int], list[int]]:
    """Return the stand of every pose, and the index at which each stand begins."""
    stands, begins = [], [0]
    for index, pose in enumerate(odom_from_body):
        moved = odom_from_body[begins[-1]].inv() * pose
        if np.linalg.norm(moved.translation) > STAND_M or moved.rotation.magnitude() > STAND_RAD:
            begins.append(index)
        stands.append(len(begins) - 1)
    return stands, begins


def _seen(places: Sequence[Place], tags: Sequence[TagPose]) -> tuple[BodySighting, ...]:
    wanted = {(tag.id, tag.family): tag for tag in tags}
    found = [(d, place) for place in places for d in tags_in(place.frame, list(wanted))]
    known = with_noise([(d, place.frame.camera, wanted[d.id, d.family].size_m) for d, place in found])
    return tuple(BodySighting(d, place) for d, (_, place) in zip(known, found, strict=True))


def tags_in(frame: Frame, wanted: Sequence[tuple[int | None, str]]) -> list[TagDetection]:
    """Return the wanted tags (id, or None for all, and family) of a frame: as recorded, else searched in its image.

    A recorded detection that names no family is the first wanted one of its id. Its ``sigma_px`` is NaN where the
    recording states none, see `with_noise`. A tag that is there twice is left out.
    """
    if frame.tags is None:
        families = tuple(dict.fromkeys(family for _, family in wanted))
        seen = detect(frame.read(), frame.camera, families=families)
        detections = [d for d in seen if (d.id, d.family) in wanted or (None, d.family) in wanted]
    else:
        detections = [d for tag in frame.tags if (d := _recorded(tag, wanted)) is not None]
    keys = [(d.id, d.family) for d in detections]
    return [d for d, key in zip(detections, keys, strict=True) if keys.count(key) == 1]


def _recorded(seen: SeenTag, wanted: Sequence[tuple[int | None, str]]) -> TagDetection | None:
    for tag_id, family in wanted:
        if tag_id in (None, seen.id) and seen.family in (None, family):
            sigma_px = math.nan if seen.sigma_px is None else seen.sigma_px
            return TagDetection(seen.id, family, seen.corners_px, sigma_px)
    return None


def with_noise(found: Sequence[tuple[TagDetection, Camera, float]]) -> list[TagDetection]:
    """Return detections, given with camera and tag size in m; those of unknown noise with what all of them show.

    8 coordinates fit 6 parameters: what remains tells.
    """
    squares, count = MESSAGE_WEIGHT * 2 * MESSAGE_SIGMA_PX**2, MESSAGE_WEIGHT * 2
    for detection, camera, size_m in found:
        if not math.isnan(detection.sigma_px):
            continue
        try:
            own = solve(dataclasses.replace(detection, sigma_px=MESSAGE_SIGMA_PX), camera, size_m)
        except (TagError, np.linalg.LinAlgError):
            continue
        squares, count = squares + 8 * min(own.rms_px, 10 * MESSAGE_SIGMA_PX) ** 2, count + 2
    sigma = max(math.sqrt(squares / count), MESSAGE_FLOOR_PX)
    return [d if not math.isnan(d.sigma_px) else dataclasses.replace(d, sigma_px=sigma) for d, _, _ in found]
