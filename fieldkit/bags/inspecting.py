"""Say what is in a recording, as far as it can be read: made for recordings that cannot be replayed yet."""

from __future__ import annotations

import dataclasses
from collections import Counter
from pathlib import Path
from typing import Any

from fieldkit.bags.checking import covariance_warnings, odometry_elsewhere, odometry_faults
from fieldkit.bags.content import Content, collect
from fieldkit.bags.events import Marks, find_marks
from fieldkit.bags.files import BagFile
from fieldkit.bags.layouts import LAYOUTS, Layout
from fieldkit.bags.reading import (
    check_sizes,
    choose_layout,
    general_warnings,
    join_views,
    make_frames,
    open_source,
    session_warnings,
)
from fieldkit.bags.tagged import detection_topics, tag_frames
from fieldkit.errors import BagError
from fieldkit.odometry import summarize_faults
from fieldkit.types import Frame, Visit


def inspect_recording(path: Path | str, *, layout: str | Layout | None = None) -> dict[str, Any]:
    """Return what a recording holds and lacks as a dict for JSON; times in ns and s.

    Keys: version, path, name, format, duration_s, n_messages, layout (None when none fits), topics, images, depth,
    odometry, joint_states, reference, detections, starts, visits, warnings, missing. Raises BagError only for a file
    cannot be opened or is damaged.
    """
    source = open_source(path)
    bag = source.bag
    found = choose_layout(source, layout=layout)
    used = found or LAYOUTS["generic"]
    content = collect(bag, used)
    missing = [] if found else [f"layout: none of {', '.join(LAYOUTS)} fits; looked for the topics of generic"]
    marks = Marks()
    try:
        marks = find_marks(content.events, source.session, path=bag.path, t_end_ns=content.last_ns)
    except BagError as error:
        missing.append(str(error))
    if content.camera_error is not None:
        missing.append(str(content.camera_error))
    missing += _missing(bag, used, content, marks)
    warnings = list(marks.warnings)
    odometry, repeated = content.odometry.trajectory(parent=used.odom_frame, child=used.body_frame)
    warnings += [*general_warnings(bag, content, repeated), *covariance_warnings(content, used.reference)]
    warnings += summarize_faults(odometry_faults(content)) if len(odometry) else odometry_elsewhere(bag, content)
    frames: tuple[Frame, ...] = ()
    visits: tuple[Visit, ...] = ()
    unreached: list[str] = []
    tagged: tuple[Frame, ...] = ()
    if content.cameras:
        frames, unreached = make_frames(bag, content, camera_frame=used.camera_frame, body_frame=odometry.child)
        tagged, notes = tag_frames(bag, content, camera_frame=used.camera_frame, body_frame=odometry.child)
        warnings += notes
        visits = _visits(bag, content, marks, frames or tagged, missing=missing)
    if visits and len(odometry):
        warnings += session_warnings(visits, odometry, content)
    if unreached:
        warnings.append(f"tf does not reach the camera in {len(unreached)} images; the first: {unreached[0]}")
    return {
        "version": 1,
        "path": str(path),
        "name": source.name,
        "format": bag.format,
        "duration_s": bag.duration_ns / 1e9,
        "n_messages": bag.n_messages,
        "layout": None if found is None else found.name,
        "topics": [{"name": n, "type": t.type, "count": t.count} for n, t in sorted(bag.topics.items())],
        "images": _images(content, frames, n_unreached=len(unreached)),
        "depth": _depth(bag, used),
        "odometry": {"count": len(odometry), "parent": odometry.parent, "child": odometry.child},
        "joint_states": {
            "count": len(content.joints),
            "names": sorted({name for _, angles in content.joints for name in angles}),
        },
        "reference": {"count": len(content.reference.samples)},
        "detections": _detections(bag, tagged),
        "starts": [dataclasses.asdict(start) for start in marks.starts],
        "visits": _visit_rows(marks, visits),
        "warnings": warnings,
        "missing": missing,
    }


def _missing(bag: BagFile, layout: Layout, content: Content, marks: Marks) -> list[str]:
    alone = "; tag detections alone leave nothing to localize" if detection_topics(bag) else ""
    needed: list[tuple[object, str]] = [
        (content.images, f"images on {layout.compressed} or {layout.image}{alone}"),
        (content.cameras, f"camera_info on {layout.camera_info}"),
        (content.tf.frames, f"tf on {layout.tf} or {layout.tf_static}"),
        (content.odometry.samples, f"odometry on {layout.odometry}"),
        (marks.visits, f"visits: events on {layout.events}, or [[visit]] in a session.toml beside the recording"),
        (marks.starts, f"starts: events on {layout.events}, or [[start]] in a session.toml beside the recording"),
    ]
    return [what for values, what in needed if not values]


def _visits(
    bag: BagFile, content: Content, marks: Marks, frames: tuple[Frame, ...], *, missing: list[str]
) -> tuple[Visit, ...]:
    try:
        if frames:
            if content.images:
                check_sizes(bag, content, frames)
            return join_views(bag.path, marks, frames)[0]
    except BagError as error:
        missing.append(str(error))
    return ()


def _images(content: Content, frames: tuple[Frame, ...], *, n_unreached: int) -> dict[str, Any]:
    sizes = Counter(f"{frame.camera.width}x{frame.camera.height} {frame.camera.model}" for frame in frames)
    return {
        "topic": content.image_topic,
        "count": len(content.images),
        "with_tf": len(frames) - n_unreached,
        "without_tf": n_unreached,
        "cameras": dict(sizes),
    }


def _detections(bag: BagFile, tagged: tuple[Frame, ...]) -> dict[str, Any]:
    ids = Counter(tag.id for frame in tagged for tag in frame.tags or ())
    topics = [{"name": name, "count": bag.topics[name].count} for name in detection_topics(bag)]
    return {"topics": topics, "tags": {str(tag_id): count for tag_id, count in sorted(ids.items())}}


def _depth(bag: BagFile, layout: Layout) -> dict[str, Any]:
    counts = {t: bag.topics[t].count if t in bag.topics else 0 for t in (layout.depth, layout.depth_compressed)}
    topic = max(counts, key=lambda t: counts[t])
    info = bag.topics[layout.depth_info].count if layout.depth_info in bag.topics else 0
    return {"topic": topic if counts[topic] else None, "count": counts[topic], "camera_info": info}


def _visit_rows(marks: Marks, visits: tuple[Visit, ...]) -> list[dict[str, Any]]:
    reached = {visit.id: sum(view.frame.body_from_cam is not None for view in visit.views) for visit in visits}
    return [
        {
            "id": mark.id,
            "t_begin_ns": mark.t_begin_ns,
            "t_end_ns": mark.t_end_ns,
            "next": mark.next,
            "truth_tag_id": mark.truth_tag_id,
            "views": dict(Counter(view.kind for view in marks.views if view.visit == mark.id)),
            "views_with_tf": reached.get(mark.id, 0),
        }
        for mark in marks.visits
    ]
