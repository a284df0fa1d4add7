"""Open a recording of any format as one frozen noun, or say in one line what it lacks."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fieldkit.bags.checking import covariance_warnings, odometry_faults
from fieldkit.bags.content import Content, collect
from fieldkit.bags.correcting import correct
from fieldkit.bags.events import Marks, ViewMark, find_marks
from fieldkit.bags.files import BagFile, Place
from fieldkit.bags.images import decode_image
from fieldkit.bags.layouts import LAYOUTS, ROBOT, Layout, detect_layout, find_layout, fit_layout
from fieldkit.bags.tagged import detection_topics, tag_frames
from fieldkit.cameras import Camera
from fieldkit.errors import BagError, FrameError
from fieldkit.frames import Pose, Trajectory
from fieldkit.odometry import summarize_faults
from fieldkit.store import Corrections, SessionFile, read_session
from fieldkit.types import Frame, Image, Recording, View, Visit

NEAREST_NS = 50_000_000
SESSION_FILE = "session.toml"


@dataclasses.dataclass(frozen=True)
class Source:
    """An opened bag with the session.toml that belongs to it, if there is one, and the session's name."""

    bag: BagFile
    session: SessionFile | None
    name: str


def open_recording(
    path: Path | str, *, layout: str | Layout | None = None, corrections: Corrections | None = None
) -> Recording:
    """Read a recording: .bag, .mcap, a ROS 2 folder, or a folder whose session.toml names one of these.

    The layout is the one given, else that of session.toml, else the one that fits the topics. Images stay in the
    bag until a frame's ``read()``. The same content gives the same recording in every format: frames are ordered by
    header stamp, equal stamps as in the bag. ``corrections`` take the place of what it states of camera, hand and
    stamps. Raises BagError for whatever is missing or does not fit, naming topics or frames.
    """
    source = open_source(path)
    bag = source.bag
    chosen = choose_layout(source, layout=layout)
    if bag.n_messages == 0:
        raise BagError(f"{bag.path}: no message in it; expected a recording", hint="record it again")
    if chosen is None:
        raise BagError(_no_layout(bag), hint="remap the topics, or pass a Layout that names them")
    _require_topics(bag, chosen, corrections)
    content = collect(bag, chosen)
    corrected = correct(bag, content, corrections, layout=chosen)
    _require_content(bag, chosen, content)
    faults = odometry_faults(content)
    marks = find_marks(content.events, source.session, path=bag.path, t_end_ns=content.last_ns)
    if not marks.visits:
        raise BagError(
            f"{bag.path}: no visit in it; expected visit_begin events on {chosen.events}, or [[visit]] in a "
            f"{SESSION_FILE} beside it",
            hint=f"write {SESSION_FILE}",
        )
    odometry, repeated = content.odometry.trajectory(parent=chosen.odom_frame, child=chosen.body_frame)
    frames, unreached = make_frames(bag, content, camera_frame=chosen.camera_frame, body_frame=odometry.child)
    tagged, tag_notes = tag_frames(bag, content, camera_frame=chosen.camera_frame, body_frame=odometry.child)
    _require_frames(bag, frames or tagged, tag_notes)
    visits, notes = join_views(bag.path, marks, frames or tagged)
    _require_tf(bag.path, visits, content, unreached)
    check_sizes(bag, content, frames)
    warnings = [*general_warnings(bag, content, repeated), *corrected, *marks.warnings, *notes]
    warnings += _tf_warnings(frames, unreached)
    warnings += [*session_warnings(visits, odometry, content), *tag_notes, *summarize_faults(faults)]
    warnings += covariance_warnings(content, chosen.reference)
    return Recording(
        name=source.name,
        path=str(path),
        layout=chosen.name,
        frames=frames,
        odometry=odometry,
        starts=marks.starts,
        visits=visits,
        reference=reference(content, odometry.child),
        warnings=tuple(warnings),
        reference_covariance=content.reference.covariance(),
        tag_frames=tagged,
        odometry_faults=faults,
    )


def open_source(path: Path | str) -> Source:
    """Open a bag, or the one that a folder's session.toml names; raises BagError when it cannot be read."""
    given = Path(path)
    session_path = given / SESSION_FILE
    if not (given.is_dir() and session_path.is_file()):
        beside = given.parent / SESSION_FILE
        session = read_session(beside) if beside.is_file() else None
        if session is not None and (beside.parent / session.recording).resolve() != given.resolve():
            session = None
        return Source(BagFile(given), session, given.stem if session is None else session.session)
    session = read_session(session_path)
    recording = given / session.recording
    if not recording.exists():
        raise BagError(
            f"{session_path}: recording {session.recording!r} does not exist in {given}; expected the bag's name",
            hint="correct the line `recording`",
        )
    return Source(BagFile(recording), session, session.session)


def choose_layout(source: Source, *, layout: str | Layout | None) -> Layout | None:
    """Return the layout given, else that of session.toml, else the one that fits the topics, else None."""
    wanted = layout if layout is not None else source.session.layout if source.session else None
    if wanted is None:
        return detect_layout(source.bag.topics)
    try:
        return fit_layout(find_layout(wanted) if isinstance(wanted, str) else wanted, source.bag.topics)
    except BagError as error:
        raise BagError(f"{source.bag.path}: {error.message}", hint=error.hint) from error


def make_frames(
    bag: BagFile, content: Content, *, camera_frame: str, body_frame: str
) -> tuple[tuple[Frame, ...], list[str]]:
    """Return a frame per image in the order of stamps, and why tf did not reach the body, per frame without it."""
    by_frame: dict[str, list[int]] = {}
    for index, image in enumerate(content.images):
        by_frame.setdefault(image.frame or camera_frame, []).append(index)
    reached: dict[int, Pose | FrameError] = {}
    for name, indices in by_frame.items():
        stamps = [content.images[i].t_ns - content.late_ns for i in indices]
        reached |= zip(indices, content.tf.lookup_all(body_frame, name, t_ns=stamps), strict=True)
    frames, unreached = [], []
    for index, image in enumerate(content.images):
        camera, found = content.camera_at(image.t_ns), reached[index]
        if isinstance(found, FrameError):
            unreached.append(found.message)
        read = functools.partial(read_image, bag, image.place, camera)
        body_from_cam, late_ns = None if isinstance(found, FrameError) else found, content.late_ns
        frames.append(Frame(image.t_ns - late_ns, camera, body_from_cam, read, late_ns=late_ns))
    return tuple(frames), unreached


def read_image(bag: BagFile, place: Place, camera: Camera) -> Image:
    """Fetch and decode one image; raises BagError when it cannot be decoded or is not of the camera's size."""
    message = bag.message(place)
    try:
        image = decode_image(message)
    except ValueError as error:
        hint = "record another encoding, or leave this image out"
        raise BagError(f"{bag.path}: image at {place.log_ns} ns: {error}", hint=hint) from error
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise BagError(_wrong_size(bag.path, (width, height), camera), hint=_SIZE_HINT)
    return image


def check_sizes(bag: BagFile, content: Content, frames: Sequence[Frame]) -> None:
    """Compare images with their CameraInfo: uncompressed ones all, compressed ones the first of every camera."""
    checked: set[Camera] = set()
    for image, frame in zip(content.images, frames, strict=True):
        camera = frame.camera
        if image.size is not None and image.size != (camera.width, camera.height):
            raise BagError(_wrong_size(bag.path, image.size, camera), hint=_SIZE_HINT)
        if image.size is None and camera not in checked:
            checked.add(camera)
            frame.read()


def reference(content: Content, body_frame: str) -> Trajectory | None:
    """Return map_from_body of the reference topic, or None without one."""
    if not content.reference.samples:
        return None
    return content.reference.trajectory(parent="map", child=body_frame)[0]


def general_warnings(bag: BagFile, content: Content, repeated: int) -> list[str]:
    """Say what was skipped in the bag, with counts."""
    warnings = [f"{n} messages of unknown type {kind} were skipped" for kind, n in sorted(bag.unknown.items())]
    warnings += [f"{n} {what} were skipped" for what, n in sorted(content.refused.items())]
    if repeated:
        warnings.append(f"{repeated} odometry messages repeat an earlier stamp; the first of each counts")
    return warnings


def session_warnings(visits: Sequence[Visit], odometry: Trajectory, content: Content) -> list[str]:
    """Say what is odd about the visits: no view, no odometry at a view, an arm that moves under a standing camera."""
    warnings = [f"visit {visit.id} has no view" for visit in visits if not visit.views]
    for visit in visits:
        begin, end = int(odometry.t_ns[0]), int(odometry.t_ns[-1])
        outside = sum(not begin <= view.frame.t_ns <= end for view in visit.views)
        if outside:
            warnings.append(f"visit {visit.id}: {outside} views lie outside of the odometry {begin} .. {end} ns")
        if _frozen(visit, content):
            warnings.append(f"visit {visit.id}: the camera stands still in tf while arm joints move; tf may be frozen")
    return warnings


def _frozen(visit: Visit, content: Content) -> bool:
    # An early driver of Spot kept sending the stowed pose of the hand camera
    views = [v.frame for v in visit.views if v.frame.body_from_cam is not None]
    stamps = np.array([t for t, _ in content.joints], dtype=np.int64)
    if len(views) < 2 or not len(stamps):
        return False
    angles: dict[str, list[float]] = {}
    for frame in views:
        nearest = int(np.argmin(np.abs(stamps - frame.t_ns)))
        for name, angle in content.joints[nearest][1].items():
            angles.setdefault(name, []).append(angle)
    moved = any(max(values) - min(values) > 0.1 for values in angles.values())
    poses = [f.body_from_cam.as_matrix() for f in views if f.body_from_cam is not None]
    return moved and all(np.allclose(p, poses[0], atol=1e-4) for p in poses)


def _require_topics(bag: BagFile, layout: Layout, corrections: Corrections | None) -> None:
    def count(*topics: str) -> int:
        return sum(bag.topics[t].count for t in topics if t in bag.topics)

    where = f"; the bag has {topic_list(bag)}"
    hint = "record the topic, or name the layout that has it in a session.toml"
    needed: dict[str, tuple[str, ...]] = {
        "image": (layout.compressed, layout.image, *detection_topics(bag)),
        "camera_info": (layout.camera_info,),
        "tf": (layout.tf, layout.tf_static),
        "odometry": (layout.odometry,),
    }
    if corrections is not None and corrections.camera is not None:
        del needed["camera_info"]
    for what, topics in needed.items():
        if not count(*topics):
            raise BagError(
                f"{bag.path}: no {what} in layout {layout.name!r}; expected messages on {' or '.join(topics)}{where}",
                hint=hint,
            )


def _require_content(bag: BagFile, layout: Layout, content: Content) -> None:
    found: dict[str, tuple[object, str, str]] = {
        "image": (content.images or detection_topics(bag), content.image_topic, "sensor_msgs/Image or CompressedImage"),
        "camera_info": (content.has_camera, layout.camera_info, "sensor_msgs/CameraInfo"),
        "tf": (content.tf.frames, f"{layout.tf} or {layout.tf_static}", "tf2_msgs/TFMessage"),
        "odometry": (content.odometry.samples, layout.odometry, "nav_msgs/Odometry with finite poses"),
    }
    if content.camera_error is not None:
        raise content.camera_error
    for what, (values, topic, kind) in found.items():
        if not values:
            raise BagError(
                f"{bag.path}: no usable {what} on {topic}; expected {kind}", hint="see `fieldkit inspect` for its types"
            )


def _require_frames(bag: BagFile, frames: Sequence[Frame], notes: Sequence[str]) -> None:
    if not frames:
        raise BagError(
            f"{bag.path}: no image and no tag detection of the arm camera ({'; '.join(notes)}); expected images of it",
            hint="record the arm camera's images, or name its frame in a Layout",
        )


def _require_tf(path: Path, visits: Sequence[Visit], content: Content, unreached: Sequence[str]) -> None:
    views = [view for visit in visits for view in visit.views]
    if views and all(view.frame.body_from_cam is None for view in views):
        raise BagError(
            f"{path}: tf reaches the camera at no view: {unreached[0]}; expected the arm's transforms from the body to "
            "the image's frame on tf at the images' stamps",
            hint="record /tf and /tf_static together with the images",
        )


def join_views(path: Path, marks: Marks, frames: Sequence[Frame]) -> tuple[tuple[Visit, ...], list[str]]:
    """Join every view with the image of its stamp, or the nearest; also return notes on those that were only near."""
    stamps = np.array([f.stamp_ns for f in frames], dtype=np.int64)
    views: dict[str, list[View]] = {mark.id: [] for mark in marks.visits}
    notes = []
    for mark in marks.views:
        index = _nearest(stamps, mark.t_ns)
        distance_ns = abs(int(stamps[index]) - mark.t_ns)
        if distance_ns > NEAREST_NS:
            raise BagError(
                _no_image(path, mark, distance_ns), hint="correct the stamp in a session.toml, or drop the view"
            )
        if distance_ns:
            notes.append(f"view {mark.id} of visit {mark.visit}: nearest image is {distance_ns / 1e6:.1f} ms away")
        views[mark.visit].append(View(mark.id, mark.kind, frames[index], mark.repeat))
    visits = tuple(
        Visit(m.id, m.t_begin_ns, m.t_end_ns, tuple(views[m.id]), m.next, m.truth_tag_id) for m in marks.visits
    )
    return visits, notes


def _nearest(stamps: np.ndarray[tuple[int], np.dtype[np.int64]], t_ns: int) -> int:
    right = int(np.searchsorted(stamps, t_ns))
    near = [i for i in (right, right - 1) if 0 <= i < len(stamps)]
    return min(near, key=lambda i: abs(int(stamps[i]) - t_ns))


def _tf_warnings(frames: Sequence[Frame], unreached: Sequence[str]) -> list[str]:
    if not unreached:
        return []
    return [f"tf does not reach the camera in {len(unreached)} of {len(frames)} images; the first: {unreached[0]}"]


def topic_list(bag: BagFile) -> str:
    """Return the topics of a bag in a few words."""
    names = sorted(bag.topics)
    return ", ".join(names[:12]) + (f" and {len(names) - 12} more" if len(names) > 12 else "") if names else "no topic"


def _no_layout(bag: BagFile) -> str:
    images = [t.replace(ROBOT, "<robot>") for layout in LAYOUTS.values() for t in (layout.compressed, layout.image)]
    return f"{bag.path}: no layout fits; expected images on {', '.join(images)}; the bag has {topic_list(bag)}"


def _no_image(path: Path, mark: ViewMark, distance_ns: int) -> str:
    return (
        f"{path}: view {mark.id} of visit {mark.visit} has no image at {mark.t_ns} ns; the nearest is "
        f"{distance_ns / 1e9:.3f} s away, expected at most {NEAREST_NS / 1e9:.3f} s"
    )


def _wrong_size(path: Path, size: tuple[int, int], camera: Camera) -> str:
    return (
        f"{path}: image is {size[0]}x{size[1]} but its CameraInfo says {camera.width}x{camera.height}; "
        "expected the same size"
    )


_SIZE_HINT = "record the CameraInfo of the resolution that was used"
