"""A worker process of a dataset: opens one scene at a time, makes its map where there is none, and its shards."""

from __future__ import annotations

import dataclasses
import functools
import os
import pickle
import shutil
import signal
import tempfile
import threading
import traceback
from collections.abc import Callable, Sequence
from multiprocessing import connection, parent_process
from pathlib import Path

import cv2

from fieldkit import maps
from fieldkit.dataset.folder import WORK_FOLDER
from fieldkit.dataset.looking import Studio
from fieldkit.dataset.source import SourceWaypoint, ViewSource
from fieldkit.errors import DatasetError, FieldkitError
from fieldkit.frames import pose, position_quaternion
from fieldkit.store import digest
from fieldkit.store.datasets import (
    MAPS_FOLDER,
    DatasetRules,
    GaugeFile,
    SceneFile,
    gauge_path,
    is_plain,
    read_gauge,
    read_scene,
    read_scene_shard,
    scene_path,
    shard_path,
    write_gauge,
    write_scene,
    write_shard,
)
from fieldkit.store.files import saving

Tell = Callable[[str, int, int], None]
# A map's cameras may lie off the true ones (rms) by this share of the bound within which a view counts as localized.
MOST_WARP = 0.5


@dataclasses.dataclass(frozen=True)
class Check:
    """Read the source of a scene, and write nothing; answered by `Checked`."""

    scene: str
    source: bytes


@dataclasses.dataclass(frozen=True)
class Checked:
    """The source of a scene can be used; the key of what would be made of it."""

    views_key: str


@dataclasses.dataclass(frozen=True)
class Open:
    """Open a scene: make its map and scene.toml where they are missing; answered by `Opened`."""

    scene: str
    source: bytes


@dataclasses.dataclass(frozen=True)
class Opened:
    """The waypoints of a scene in order, and those whose shards are there already."""

    waypoints: tuple[str, ...]
    done: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Make:
    """Make the shard of a waypoint of a scene; answered by `Made`."""

    scene: str
    source: bytes
    waypoint: str


@dataclasses.dataclass(frozen=True)
class Made:
    """A shard was written: how many images were localized for it."""

    images: int


@dataclasses.dataclass(frozen=True)
class Step:
    """How far a long step of `Open` is."""

    what: str
    done: int
    total: int


@dataclasses.dataclass(frozen=True)
class Failed:
    """What went wrong: one line of a mistake, or the traceback of a defect."""

    line: str | None
    trace: str


def serve(pipe: connection.Connection, out: Path, rules: DatasetRules) -> None:
    """Answer requests until the pipe is closed; the process ends with the one that started it, however that ended."""
    # Ctrl-C reaches every process of a terminal; the one that started this one decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    cv2.setNumThreads(1)
    tempfile.tempdir = str(out / WORK_FOLDER)
    desk: Desk | None = None
    while True:
        try:
            request = pipe.recv()
        except EOFError:
            return
        try:
            if desk is None or desk.source_bytes != request.source:
                # The scene before goes before the next one comes: both would need twice the memory.
                desk = None
                desk = Desk(request.source, out, rules, lambda *step: pipe.send(Step(*step)))
            match request:
                case Check():
                    pipe.send(desk.checked())
                case Open():
                    pipe.send(desk.opened())
                case Make():
                    pipe.send(desk.make(request.waypoint))
        except FieldkitError as error:
            pipe.send(Failed(f"{request.scene}: {error}", ""))
        except OSError as error:
            place = f"{os.fsdecode(error.filename)}: " if error.filename else f"{out}: "
            line = f"{place}{error.strerror or error}; the same command goes on from here once that is put right"
            pipe.send(Failed(line, ""))
        except Exception:
            pipe.send(Failed(None, traceback.format_exc()))


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


class Desk:
    """One scene: its source and its waypoints, and once it is opened its map and its localizer."""

    def __init__(self, source_bytes: bytes, out: Path, rules: DatasetRules, tell: Tell) -> None:
        self.source_bytes = source_bytes
        self._source: ViewSource = pickle.loads(source_bytes)
        self._out, self._rules, self._tell = out, rules, tell
        tell(f"{self._source.name}: scene", 0, 1)
        self._key = views_key(self._source, rules)
        waypoints = tuple(self._source.waypoints())
        _refuse_waypoints(self._source.name, waypoints)
        self._waypoints = {w.id: w for w in waypoints}

    def checked(self) -> Checked:
        """Return the key of the scene's views."""
        return Checked(self._key)

    def opened(self) -> Opened:
        """Return the waypoints, and which of them are done, after having read these."""
        name = self._source.name
        assert self._studio
        entry = read_scene(self._out, name)
        done = tuple(w for w in self._waypoints if shard_path(self._out, name, w).is_file())
        for waypoint in done:
            read_scene_shard(self._out, entry, waypoint)
        return Opened(tuple(self._waypoints), done)

    @functools.cached_property
    def _studio(self) -> Studio:
        """The scene with its map; both are written where they are missing."""
        out, name, rules = self._out, self._source.name, self._rules
        key = map_key(self._source, rules)
        folder = out / MAPS_FOLDER / f"{name}-{key[:16]}.map"
        # Asked before the map is made, which takes minutes.
        _refuse_other(out, name, mapping_key=key, views_key=self._key)
        gauge = build_scene_map(self._source, folder, rules, self._tell)
        _refuse_folded(folder, gauge, rules)
        scene_map = maps.load_map(folder)
        studio = Studio(self._source, scene_map, gauge, rules)
        entry = SceneFile(1, name, key, self._key, folder.name, scene_map.digest, tuple(self._waypoints))
        if not scene_path(out, name).is_file():
            write_scene(out, entry)
        elif read_scene(out, name) != entry:
            raise DatasetError(
                f"{folder}: was made again and is another map now; expected the one that {out / name} was localized in",
                hint=f"remove {out / name} to make the views again",
            )
        return studio

    def make(self, waypoint: str) -> Made:
        """Make the shard of a waypoint and write it."""
        chosen: SourceWaypoint = self._waypoints[waypoint]
        shard = self._studio.shard(chosen, key=self._key)
        write_shard(shard_path(self._out, self._source.name, waypoint), shard)
        return Made(len(shard.view_ids) + len(shard.repeat_view))


def _refuse_waypoints(name: str, waypoints: Sequence[SourceWaypoint]) -> None:
    """Raise DatasetError where a source has nothing to look at, or names it so that it cannot be told apart."""
    ids = [w.id for w in waypoints]
    twice = [f"waypoint {i!r}" for i in ids if ids.count(i) > 1 or not is_plain(i)]
    for waypoint in waypoints:
        views = [v.id for v in waypoint.views]
        twice += [f"view {waypoint.id}/{v}" for v in views if views.count(v) > 1]
    if twice:
        raise DatasetError(f"scene {name!r}: {twice[0]} is there twice, or no file can be named so; expected each once")
    if not ids or not all(w.views for w in waypoints):
        raise DatasetError(f"scene {name!r}: has no waypoint, or one without a view; expected some of both")


def _refuse_other(out: Path, name: str, **keys: str) -> None:
    """Raise DatasetError when the shards of a scene were made from another state of it."""
    if not scene_path(out, name).is_file():
        return
    entry = read_scene(out, name)
    if any(getattr(entry, which) != key for which, key in keys.items()):
        raise DatasetError(
            f"{out / name}: was made from another version of the scene {name!r}; expected the same scene and program",
            hint="give --force to make it again (maps that still fit are kept), or choose another --out",
        )


def _refuse_folded(folder: Path, gauge: maps.Gauge, rules: DatasetRules) -> None:
    """Raise DatasetError for a map so far from the world that its labels would tell about the map, not the views."""
    most_m = MOST_WARP * rules.label.position_m
    if gauge.rms_m > most_m:
        raise DatasetError(
            f"{folder}: its cameras lie {gauge.rms_m:.2f} m (rms) off the true ones after a rigid fit, up to "
            f"{gauge.max_m:.2f} m; expected at most {most_m:.2f} m rms: places that look alike may be one in it",
            hint="make the scene's places differ more, or map it from more places",
        )


def map_key(source: ViewSource, rules: DatasetRules) -> str:
    """Return the digest of all that a map depends on."""
    return digest(source.mapping_key, rules.feature, repr(maps.MapOptions()))


def views_key(source: ViewSource, rules: DatasetRules) -> str:
    """Return the digest of all that the shards of a scene depend on."""
    return digest(map_key(source, rules), source.views_key, repr(rules))


def build_scene_map(source: ViewSource, path: Path, rules: DatasetRules, tell: Tell) -> maps.Gauge:
    """Make the map of a source at ``path`` where there is none; return the gauge between map and world.

    The gauge needs the true mapping poses, which are not kept: it is stored beside the map, and before it.
    """
    if path.is_dir():
        if not gauge_path(path).is_file():
            raise DatasetError(
                f"{path}: has no {gauge_path(path).name} beside it; expected it, too: how the map lies in the world",
                hint="put it there, or remove the map to make it again",
            )
        return _read_gauge(path)
    with saving(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f"{source.name}-"))
    try:
        tell(f"{source.name}: mapping images", 0, 1)
        (work / "mapping").mkdir()
        true = source.write_mapping(work / "mapping")
        maps.build_map(
            work / "mapping",
            work / path.name,
            feature=rules.feature,
            # As many maps as workers may be made at once; the number of threads does not change a map. A dataset's
            # bytes repeat, and seconds do not.
            options=maps.MapOptions(n_threads=1, keep_record=False),
            progress=lambda step, done, total: tell(f"{source.name}: map, {step}", done, total),
        )
        gauge = maps.fit_gauge(maps.load_map(work / path.name), true)
        position, quaternion = position_quaternion(gauge.world_from_map)
        write_gauge(
            path,
            GaugeFile(1, tuple(position), tuple(quaternion), gauge.rms_m, gauge.max_m, gauge.scale_error),
        )
        with saving(path):
            (work / path.name).rename(path)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return _read_gauge(path)


def _read_gauge(path: Path) -> maps.Gauge:
    entry = read_gauge(path)
    return maps.Gauge(pose(entry.position_m, entry.quaternion_xyzw), entry.rms_m, entry.max_m, entry.scale_error)
