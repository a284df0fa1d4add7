"""What belongs to which waypoint: events in the recording, and session.toml over events."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from bag_samples import (
    Options,
    default_events,
    stamp,
    write_sample,
)

from fieldkit.bags import open_recording
from fieldkit.errors import BagError


def test_view_without_its_stamp_takes_the_nearest_image_with_a_warning(tmp_path: Path) -> None:
    events = [(t + 20_000_000 if e["event"] == "view" else t, e) for t, e in default_events()]
    recording = open_recording(write_sample(tmp_path, "mcap", Options(events=tuple(events))))
    assert recording.visits[0].views[1].frame.t_ns == stamp(12)
    assert "view 1 of visit w01: nearest image is 20.0 ms away" in recording.warnings


def with_event(*events: tuple[int, dict[str, Any]]) -> Options:
    return Options(events=(*default_events(), *events))


@pytest.mark.parametrize(
    ("event", "message"),
    [
        (
            (stamp(60), {"event": "view", "visit": "w02", "view": "9"}),
            r"view 9 of visit w02 has no image at \d+ ns; the nearest is 2\.000 s away, expected at most 0\.050 s",
        ),
        (
            (stamp(30), {"event": "view", "visit": "w9", "view": "9"}),
            r"view 9 belongs to visit 'w9', which never begins; expected one of w01, w02; write a session\.toml",
        ),
        ((stamp(30), {"event": "view", "visit": "w02"}), "event view without 'view'"),
        ((stamp(30), {"event": "visit_begin"}), "event visit_begin without 'visit'"),
        ((stamp(30), {"event": "visit_begin", "visit": ""}), "event visit_begin without 'visit'"),
        ((stamp(30), {"event": "visit_begin", "visit": "w01"}), r"visit 'w01' begins twice, at \d+ and \d+ ns"),
        (
            (stamp(30), {"event": "view", "visit": "w02", "view": "9", "kind": "swep"}),
            "view 9 .* kind 'swep'; did you mean 'sweep'",
        ),
        ((stamp(30), {"event": "start_begin", "tag_id": "one"}), r"event .*Expected `int \| null`.*at `\$\.tag_id`"),
        ((stamp(30), {"event": "visit_end", "visit": "w02", "v": 2}), "event of version 2; expected 1"),
    ],
)
def test_wrong_event_is_one_line_with_the_path(tmp_path: Path, event: tuple[int, dict[str, Any]], message: str) -> None:
    path = write_sample(tmp_path, "mcap", with_event(event))
    with pytest.raises(BagError, match=f"^{re.escape(str(path))}: {message}"):
        open_recording(path)


def test_odd_events_are_counted_and_open_intervals_closed(tmp_path: Path) -> None:
    events = [
        *(e for e in default_events() if e[1] not in ({"event": "visit_end", "visit": "w02"},)),
        (stamp(30), {"event": "coffee"}),
        (stamp(31), {"event": "coffee"}),
        (stamp(33), {"event": "view", "visit": "w02", "view": "0"}),
        (stamp(33), {"event": "visit_end", "visit": "w01"}),
        (stamp(33), {"event": "start_end", "tag_id": 1}),
    ]
    recording = open_recording(write_sample(tmp_path, "mcap", Options(events=tuple(events))))
    text = "\n".join(recording.warnings)
    assert recording.visits[1].t_end_ns == stamp(40)
    assert "2 events of unknown kind 'coffee' were ignored" in text
    assert "visit w02 has no end" in text
    assert "view 0 of visit w02 was announced again" in text
    assert "visit w01 ends at" in text
    assert "start_end at" in text


def test_start_without_a_tag_is_kept_for_the_reference_topic(tmp_path: Path) -> None:
    path = write_sample(tmp_path, "mcap", with_event((stamp(7), {"event": "start_begin", "visit": "w01"})))
    start = open_recording(path).starts[1]
    assert (start.tag_id, start.visit, start.t_end_ns) == (None, "w01", stamp(10))


VISIT = f"""
[[visit]]
id = "a"
t_begin_ns = {stamp(8)}
t_end_ns = {stamp(20)}
truth_tag_id = 5
"""
VIEW = f"""
[[view]]
visit = "a"
id = "one"
t_ns = {stamp(9)}
kind = "forward"
repeat = 1
"""
SESSION = f"""
version = 1
session = "lab"
recording = "robot.mcap"
[[start]]
tag_id = 7
t_begin_ns = {stamp(0)}
t_end_ns = {stamp(3)}
{VISIT}{VIEW}"""


def test_session_file_overrides_events_and_names_the_session(tmp_path: Path) -> None:
    twice = with_event((stamp(30), {"event": "visit_begin", "visit": "w01"}))
    path = write_sample(tmp_path, "mcap", twice)
    (tmp_path / "session.toml").write_text(SESSION)
    for way in (path, tmp_path):
        recording = open_recording(way)
        assert (recording.name, [v.id for v in recording.visits], recording.starts[0].tag_id) == ("lab", ["a"], 7)
        view = recording.visits[0].views[0]
        assert (view.id, view.kind, view.repeat, view.frame.t_ns) == ("one", "forward", 1, stamp(9))


def test_session_file_of_another_recording_is_left_alone(tmp_path: Path) -> None:
    path = write_sample(tmp_path, "mcap", name="second")
    (tmp_path / "session.toml").write_text(SESSION)
    assert open_recording(path).name == "second"
    with pytest.raises(BagError, match=r"session\.toml: recording 'robot\.mcap' does not exist in "):
        open_recording(tmp_path)


def test_session_file_without_visits_leaves_the_events_and_gives_the_layout(tmp_path: Path) -> None:
    write_sample(tmp_path, "ros2")
    (tmp_path / "session.toml").write_text('version = 1\nsession = "lab"\nrecording = "robot"\nlayout = "generic"\n')
    recording = open_recording(tmp_path)
    assert (recording.name, len(recording.visits), recording.layout) == ("lab", 2, "generic")


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ('session = "lab"', 'session = " "', "an empty session name; expected a name; give the session"),
        ('id = "a"', 'id = ""', "a visit with an empty id; expected a name; give every visit"),
        ('id = "one"', 'id = ""', "a view with an empty id; expected a name; give every view"),
        ("[[view]]", VISIT + "[[view]]", "visit 'a' twice; expected every visit once; rename"),
        ("[[view]]", VIEW + "[[view]]", "view 'one' of visit 'a' twice; expected every view of a visit once; rename"),
        (
            f"t_end_ns = {stamp(20)}",
            f"t_end_ns = {stamp(7)}",
            f"visit 'a' that ends at {stamp(7)} ns, before it begins at {stamp(8)} ns; expected t_begin_ns <= t_end_ns",
        ),
        (
            f"t_end_ns = {stamp(3)}",
            f"t_end_ns = {stamp(0) - 1}",
            f"start 1 that ends at {stamp(0) - 1} ns, before it begins at {stamp(0)} ns; expected t_begin_ns <= ",
        ),
    ],
)
def test_session_file_that_contradicts_itself_is_refused(tmp_path: Path, before: str, after: str, message: str) -> None:
    path = write_sample(tmp_path, "mcap")
    assert SESSION.count(before) == 1
    (tmp_path / "session.toml").write_text(SESSION.replace(before, after))
    with pytest.raises(BagError, match=f"^{re.escape(str(path))}: session.toml has {re.escape(message)}") as caught:
        open_recording(tmp_path)
    assert "\n" not in str(caught.value)


def test_visits_that_share_the_ids_of_their_views_are_fine(tmp_path: Path) -> None:
    write_sample(tmp_path, "mcap")
    second = (VISIT + VIEW).replace('"a"', '"b"')
    (tmp_path / "session.toml").write_text(SESSION + second)
    assert [[v.id for v in visit.views] for visit in open_recording(tmp_path).visits] == [["one"], ["one"]]


def test_visits_of_a_session_file_take_the_views_announced_within_them(tmp_path: Path) -> None:
    write_sample(tmp_path, "mcap")
    (tmp_path / "session.toml").write_text(
        'version = 1\nsession = "lab"\nrecording = "robot.mcap"\n'
        f'[[visit]]\nid = "A"\nt_begin_ns = {stamp(10)}\nt_end_ns = {stamp(15)}\ntruth_tag_id = 2\n'
    )
    (visit,) = open_recording(tmp_path).visits
    assert visit.id == "A"
    assert [v.id for v in visit.views] == ["0", "1", "2"]
