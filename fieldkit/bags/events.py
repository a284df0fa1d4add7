"""What belongs to which waypoint: from the events in a recording, or from session.toml beside it."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeVar

import msgspec

from fieldkit.errors import BagError, suggestion
from fieldkit.store import SessionFile
from fieldkit.types import VIEW_KINDS, Start, ViewKind

T = TypeVar("T")
KNOWN_EVENTS = ("start_begin", "start_end", "visit_begin", "visit_end", "view")


@dataclasses.dataclass(frozen=True)
class ViewMark:
    """A view that somebody announced: its visit, id, kind, and the header stamp of its image."""

    visit: str
    id: str
    kind: ViewKind
    t_ns: int
    repeat: int = 0


@dataclasses.dataclass(frozen=True)
class VisitMark:
    """The interval of a visit, where it goes next, and its tripod tag."""

    id: str
    t_begin_ns: int
    t_end_ns: int
    next: str | None = None
    truth_tag_id: int | None = None


@dataclasses.dataclass(frozen=True)
class Marks:
    """Starts, visits in the order of time, and views in the order of their stamps."""

    starts: tuple[Start, ...] = ()
    visits: tuple[VisitMark, ...] = ()
    views: tuple[ViewMark, ...] = ()
    warnings: tuple[str, ...] = ()


class _Event(msgspec.Struct, frozen=True):
    event: str
    v: int = 1
    t_ns: int | None = None
    visit: str | int | None = None
    view: str | int | None = None
    kind: str = "sweep"
    tag_id: int | None = None
    next: str | int | None = None
    repeat: int = 0


def find_marks(messages: Sequence[tuple[int, str]], session: SessionFile | None, *, path: Path, t_end_ns: int) -> Marks:
    """Read JSON events (time in the bag in ns, text); a table of session.toml replaces the events of its kind.

    An interval left open ends at the next begin, or at ``t_end_ns``. Events of unknown kind, and texts that are no
    JSON object with an "event", are counted in the warnings. Where session.toml lists visits but no views, its
    visits take the views that the events announce within their intervals. Raises BagError for a known event that
    lacks a key, a visit that begins twice, a view of a visit that never begins, or a session.toml that contradicts
    itself.
    """
    told = _from_session(session, path) if session else Marks()
    replaced = {"start": bool(told.starts), "visit": bool(told.visits), "view": bool(told.views)}
    events, ignored = _decode(messages, path, skip=frozenset(kind for kind, given in replaced.items() if given))
    reader = _Reader(path)
    for t_ns, event in events:
        reader.take(t_ns, event)
    heard = reader.finish(t_end_ns)
    notes = [f"{n} events of unknown kind {kind!r} were ignored" for kind, n in sorted(ignored.items())]
    views = _views_within(told.visits, heard.views) if told.visits else heard.views
    marks = Marks(
        told.starts or heard.starts,
        told.visits or heard.visits,
        told.views or views,
        (*told.warnings, *notes, *heard.warnings),
    )
    _check_views(marks, path)
    return marks


def _views_within(visits: Sequence[VisitMark], views: Sequence[ViewMark]) -> tuple[ViewMark, ...]:
    return tuple(
        dataclasses.replace(view, visit=visit.id)
        for view in views
        for visit in visits
        if visit.t_begin_ns <= view.t_ns <= visit.t_end_ns
    )


def _from_session(session: SessionFile, path: Path) -> Marks:
    _check_session(session, path)
    starts = tuple(Start(s.tag_id, s.t_begin_ns, s.t_end_ns, s.visit) for s in session.start)
    visits = tuple(VisitMark(v.id, v.t_begin_ns, v.t_end_ns, v.next, v.truth_tag_id) for v in session.visit)
    views = tuple(ViewMark(v.visit, v.id, v.kind, v.t_ns, v.repeat) for v in session.view)
    warnings = tuple(
        f"session.toml: start = {v.start!r} of visit {v.id} is not used; name the visit in its [[start]]"
        for v in session.visit
        if v.start is not None
    )
    return Marks(starts, _by_time(visits), tuple(sorted(views, key=lambda v: v.t_ns)), warnings)


def _check_session(session: SessionFile, path: Path) -> None:
    def refuse(what: str, expected: str, hint: str) -> BagError:
        return BagError(f"{path}: session.toml has {what}; expected {expected}", hint=hint)

    if not session.session.strip():
        raise refuse("an empty session name", "a name", "give the session a name of its own")
    names = {"visit": [v.id for v in session.visit], "view": [v.id for v in session.view]}
    for kind, ids in names.items():
        if any(not name.strip() for name in ids):
            raise refuse(f"a {kind} with an empty id", "a name", f"give every {kind} an id")
    twice = _first_twice(v.id for v in session.visit)
    if twice is not None:
        raise refuse(f"visit {twice!r} twice", "every visit once", "rename one of them, or remove it")
    pair = _first_twice((v.visit, v.id) for v in session.view)
    if pair is not None:
        what = f"view {pair[1]!r} of visit {pair[0]!r} twice"
        raise refuse(what, "every view of a visit once", "rename one of them, or remove it")
    intervals = [(f"visit {v.id!r}", v.t_begin_ns, v.t_end_ns) for v in session.visit]
    intervals += [(f"start {number}", s.t_begin_ns, s.t_end_ns) for number, s in enumerate(session.start, start=1)]
    for name, begin, end in intervals:
        if end < begin:
            what = f"{name} that ends at {end} ns, before it begins at {begin} ns"
            raise refuse(what, "t_begin_ns <= t_end_ns", "correct the times; both are bag time in ns")


def _first_twice(items: Iterable[T]) -> T | None:
    return next((item for item, count in Counter(items).items() if count > 1), None)


def _by_time(visits: Iterable[VisitMark]) -> tuple[VisitMark, ...]:
    return tuple(sorted(visits, key=lambda v: v.t_begin_ns))


def _check_views(marks: Marks, path: Path) -> None:
    known = [v.id for v in marks.visits]
    for view in marks.views:
        if view.visit not in known:
            raise BagError(
                f"{path}: view {view.id} belongs to visit {view.visit!r}, which never begins; expected one of "
                f"{', '.join(known) or 'none'}",
                hint="write a session.toml beside the recording",
            )


def _decode(
    messages: Sequence[tuple[int, str]], path: Path, *, skip: frozenset[str]
) -> tuple[list[tuple[int, _Event]], Counter[str]]:
    events: list[tuple[int, _Event]] = []
    ignored: Counter[str] = Counter()
    for log_ns, text in messages:
        try:
            raw = msgspec.json.decode(text.encode())
        except (msgspec.DecodeError, UnicodeEncodeError):
            raw = None
        kind = raw.get("event") if isinstance(raw, dict) else None
        if kind not in KNOWN_EVENTS:
            ignored[kind if isinstance(kind, str) else "(not an event)"] += 1
            continue
        if kind.split("_")[0] in skip:
            continue
        try:
            event = msgspec.convert(raw, _Event, strict=False)
        except msgspec.ValidationError as error:
            raise BagError(f"{path}: event {text[:200]}: {error}", hint="correct it in a session.toml") from error
        if event.v > 1:
            raise BagError(f"{path}: event of version {event.v}; expected 1", hint="use a newer fieldkit")
        events.append((log_ns if event.t_ns is None else event.t_ns, event))
    events.sort(key=lambda item: item[0])
    return events, ignored


class _Reader:
    """Turns events in the order of time into intervals and views."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.warnings: list[str] = []
        self._visits: dict[str, VisitMark] = {}
        self._starts: list[Start] = []
        self._open_visits: list[str] = []
        self._open_starts: list[int] = []
        self._views: dict[tuple[str, str], ViewMark] = {}

    def take(self, t_ns: int, event: _Event) -> None:
        visit = None if event.visit is None else str(event.visit)
        match event.event:
            case "visit_begin":
                self._begin_visit(t_ns, event, self._need(event, "visit", visit))
            case "visit_end":
                self._end_visit(t_ns, self._need(event, "visit", visit))
            case "start_begin":
                self._open_starts.append(len(self._starts))
                self._starts.append(Start(event.tag_id, t_ns, -1, visit))
            case "start_end":
                self._end_start(t_ns, event.tag_id)
            case "view":
                self._view(t_ns, event, self._need(event, "visit", visit))

    def finish(self, t_end_ns: int) -> Marks:
        times = sorted([v.t_begin_ns for v in self._visits.values()] + [s.t_begin_ns for s in self._starts])

        def closed(t_begin_ns: int, what: str) -> int:
            end = next((t for t in times if t > t_begin_ns), max(t_end_ns, t_begin_ns))
            self.warnings.append(f"{what} has no end; it ends at the next begin or with the recording ({end} ns)")
            return end

        for name in self._open_visits:
            mark = self._visits[name]
            self._visits[name] = dataclasses.replace(mark, t_end_ns=closed(mark.t_begin_ns, f"visit {name}"))
        for index in self._open_starts:
            start = self._starts[index]
            what = "start" if start.tag_id is None else f"start at tag {start.tag_id}"
            self._starts[index] = dataclasses.replace(start, t_end_ns=closed(start.t_begin_ns, what))
        views = sorted(self._views.values(), key=lambda v: v.t_ns)
        return Marks(tuple(self._starts), _by_time(self._visits.values()), tuple(views), tuple(self.warnings))

    def _need(self, event: _Event, key: str, value: T | None) -> T:
        if value is None or value == "":
            raise BagError(
                f"{self.path}: event {event.event} without {key!r}; expected it in the JSON",
                hint="write a session.toml beside the recording",
            )
        return value

    def _begin_visit(self, t_ns: int, event: _Event, visit: str) -> None:
        mark = VisitMark(visit, t_ns, -1, None if event.next is None else str(event.next), event.tag_id)
        if visit in self._visits:
            if self._visits[visit].t_begin_ns == t_ns:
                return
            raise BagError(
                f"{self.path}: visit {visit!r} begins twice, at {self._visits[visit].t_begin_ns} and {t_ns} ns; "
                "expected every visit once",
                hint="write a session.toml beside the recording that says which one counts",
            )
        self._visits[visit] = mark
        self._open_visits.append(visit)

    def _end_visit(self, t_ns: int, visit: str) -> None:
        if visit not in self._open_visits:
            self.warnings.append(f"visit {visit} ends at {t_ns} ns without being open; ignored")
            return
        self._open_visits.remove(visit)
        self._visits[visit] = dataclasses.replace(self._visits[visit], t_end_ns=t_ns)

    def _end_start(self, t_ns: int, tag_id: int | None) -> None:
        index = next((i for i in reversed(self._open_starts) if tag_id in (None, self._starts[i].tag_id)), None)
        if index is None:
            self.warnings.append(f"start_end at {t_ns} ns without an open start; ignored")
            return
        self._open_starts.remove(index)
        self._starts[index] = dataclasses.replace(self._starts[index], t_end_ns=t_ns)

    def _view(self, t_ns: int, event: _Event, visit: str) -> None:
        name = str(self._need(event, "view", event.view))
        kind = next((k for k in VIEW_KINDS if k == event.kind), None)
        if kind is None:
            raise BagError(
                f"{self.path}: view {name} of visit {visit} has kind {event.kind!r}",
                hint=suggestion(event.kind, list(VIEW_KINDS)),
            )
        mark = ViewMark(visit, name, kind, t_ns, event.repeat)
        before = self._views.setdefault((visit, name), mark)
        if before != mark:
            self.warnings.append(f"view {name} of visit {visit} was announced again at {t_ns} ns; the first one counts")
