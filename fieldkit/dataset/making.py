"""Make a dataset: scenes x waypoints x views, localized and stored as features and labels, by worker processes."""

from __future__ import annotations

import contextlib
import dataclasses
import multiprocessing
import os
import pickle
import re
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from multiprocessing import connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import msgspec

from fieldkit.dataset import worker
from fieldkit.dataset.folder import WORK_FOLDER, enter, own, settle, tidy
from fieldkit.dataset.source import ViewSource
from fieldkit.errors import DatasetError
from fieldkit.features import feature_kind, feature_name
from fieldkit.features.weights import WEIGHTS, find_weights
from fieldkit.store import library_versions
from fieldkit.store.datasets import MAPS_FOLDER, DatasetFile, DatasetRules, scene_path
from fieldkit.store.files import plain

# One thread each: as many processes as asked for share the machine. What has its own count of threads, as maps have,
# is told in the worker.
ONE_THREAD = dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclasses.dataclass(frozen=True)
class Progress:
    """How far a dataset is: what each worker does, how many ``unit`` are done and in all, and seconds since the start.

    ``images_s`` are the images localized per second since the first map was there.
    """

    what: tuple[str, ...]
    done: int
    total: int
    images_s: float | None
    seconds: float
    seconds_left: float | None
    unit: str = "waypoints"


@dataclasses.dataclass
class _Scene:
    name: str
    source: bytes
    opened: bool = False
    todo: list[str] = dataclasses.field(default_factory=list)
    total: int = 0


@dataclasses.dataclass
class _Lane:
    """A worker process and what it is at."""

    process: BaseProcess
    pipe: connection.Connection
    scene: _Scene | None = None
    busy: str = ""
    making: bool = False


def make_dataset(
    sources: Sequence[ViewSource],
    out: Path,
    *,
    described: Mapping[str, Any],
    rules: DatasetRules | None = None,
    workers: int = 1,
    force: bool = False,
    progress: Callable[[Progress], None] | None = None,
) -> None:
    """Make the dataset folder ``out``, or go on with one that was made with the same settings.

    A killed run goes on where it was; the bytes do not depend on kills or the number of ``workers``. ``described``
    are the options of the sources as plain values: they are stored, and have to agree with those of an existing
    folder. ``force`` makes the shards of these ``sources`` again that were made otherwise and keeps the maps that still
    fit; other scenes of the folder stay, or the settings have to be theirs. Raises DatasetError or StoreError where
    the folder cannot be used, or a scene cannot be read or mapped, FeatureError for an unknown feature, and
    WeightsError, before any work, when the weights of a network's feature are not found.
    """
    rules, out = rules or DatasetRules(), Path(out)
    rules = msgspec.structs.replace(rules, feature=feature_name(rules.feature))
    names = [s.name for s in sources]
    if not names or len(set(names)) < len(names):
        raise DatasetError(f"scenes are {', '.join(names) or 'none'}; expected each once", hint="name a scene once")
    for name in names:
        if not re.fullmatch(r"\w[\w.-]*", name) or name == MAPS_FOLDER:
            raise DatasetError(f"scene {name!r}: cannot name a folder of the dataset", hint="give it another name")
    if workers < 1:
        raise DatasetError(f"{workers} workers; expected at least 1", hint="choose another number")
    needed = feature_kind(rules.feature).weights
    if needed is not None:
        find_weights(WEIGHTS[needed])
    with own(out):
        head = DatasetFile(1, tuple(names), rules, plain(dict(described)), library_versions())
        plan = settle(out, head, force=force)
        scenes = [_Scene(s.name, pickle.dumps(s)) for s in sources]
        unknown = [s for s in scenes if force or not scene_path(out, s.name).is_file()]
        try:
            tidy(out, plan.head.scenes)
            with _workers(min(workers, 64), out, rules) as lanes:
                foreman = _Foreman(scenes, lanes, progress)
                # All sources are read before anything is written: one that cannot be used leaves no trace.
                enter(out, plan, foreman.check(unknown))
                foreman.run()
        finally:
            shutil.rmtree(out / WORK_FOLDER, ignore_errors=True)


@contextlib.contextmanager
def _workers(count: int, out: Path, rules: DatasetRules) -> Iterator[list[_Lane]]:
    context = multiprocessing.get_context("spawn")
    lanes: list[_Lane] = []
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        for number in range(count):
            ours, theirs = context.Pipe()
            process = context.Process(
                target=worker.serve, args=(theirs, out, rules), name=f"dataset-{number + 1}", daemon=True
            )
            process.start()
            theirs.close()
            lanes.append(_Lane(process, ours))
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.__setitem__(name, value)
    try:
        yield lanes
        for lane in lanes:
            lane.pipe.close()
        for lane in lanes:
            lane.process.join(10.0)
    finally:
        # Nothing that a worker leaves behind matters: what it writes is written whole or not at all.
        for lane in lanes:
            lane.process.kill()
            lane.process.join()


class _Foreman:
    """Hands out the work: a worker stays with its scene, opens the next one, or helps where most is left."""

    def __init__(self, scenes: list[_Scene], lanes: list[_Lane], progress: Callable[[Progress], None] | None) -> None:
        self._scenes, self._lanes, self._progress = scenes, lanes, progress
        self._waiting: list[_Scene] = []
        self._ask: type[worker.Check | worker.Open] = worker.Check
        self._keys: dict[str, str] = {}
        self._begin = time.monotonic()
        self._images = self._made = 0
        self._first_shard: float | None = None

    def check(self, scenes: Sequence[_Scene]) -> Mapping[str, str]:
        """Have the sources of scenes read; return their views keys."""
        self._waiting, self._ask = list(scenes), worker.Check
        self._work()
        return self._keys

    def run(self) -> None:
        """Work until every shard of every scene is there."""
        self._waiting, self._ask = list(self._scenes), worker.Open
        self._work()

    def _work(self) -> None:
        while True:
            for lane in self._lanes:
                if not lane.busy:
                    self._hand_out(lane)
            busy = [lane for lane in self._lanes if lane.busy]
            if not busy:
                return
            self._tell()
            ends = {lane.pipe: lane for lane in busy}
            for pipe in connection.wait(list(ends), timeout=1.0):
                lane = ends[pipe]  # type: ignore[index]
                self._receive(lane)

    def _hand_out(self, lane: _Lane) -> None:
        scene = lane.scene
        if scene is None or not scene.todo:
            if self._waiting:
                # A worker that has read this scene already need not read it again.
                scene = next((s for s in self._waiting if s is lane.scene), self._waiting[0])
                self._waiting.remove(scene)
                lane.scene, lane.busy = scene, scene.name
                self._send(lane, self._ask(scene.name, scene.source))
                return
            # A second worker pays the opening of a scene: not for a shard or two.
            left = [s for s in self._scenes if len(s.todo) > 2]
            if not left:
                return
            scene = max(left, key=lambda s: len(s.todo))
        lane.scene = scene
        waypoint = scene.todo.pop(0)
        lane.busy, lane.making = f"{scene.name}/{waypoint}", True
        self._send(lane, worker.Make(scene.name, scene.source, waypoint))

    def _send(self, lane: _Lane, request: worker.Check | worker.Open | worker.Make) -> None:
        try:
            lane.pipe.send(request)
        except OSError as error:
            raise self._died(lane) from error

    def _receive(self, lane: _Lane) -> None:
        try:
            answer = lane.pipe.recv()
        except (EOFError, OSError) as error:
            raise self._died(lane) from error
        match answer:
            case worker.Step(what, done, total):
                lane.busy = f"{what} {done}/{total}" if total > 1 else what
                return
            case worker.Failed(line, trace):
                if line is None:
                    raise RuntimeError(f"a worker of the dataset failed at {lane.busy}:\n{trace}")
                raise DatasetError(line)
            case worker.Checked(key):
                assert lane.scene is not None
                self._keys[lane.scene.name] = key
            case worker.Opened(waypoints, done):
                assert lane.scene is not None
                lane.scene.todo = [w for w in waypoints if w not in set(done)]
                lane.scene.total, lane.scene.opened = len(waypoints), True
            case worker.Made(images):
                self._images += images
                self._made += 1
        lane.busy, lane.making = "", False

    def _died(self, lane: _Lane) -> DatasetError:
        lane.process.join(5.0)
        return DatasetError(
            f"the worker at {lane.busy} ended with status {lane.process.exitcode}; expected it to go on",
            hint="see the lines above, free memory or disk, and give the same command: it goes on from here",
        )

    def _tell(self) -> None:
        if self._progress is None:
            return
        now = time.monotonic()
        if self._first_shard is None and any(lane.making for lane in self._lanes):
            self._first_shard = now
        opened = [s for s in self._scenes if s.opened]
        left = sum(len(s.todo) for s in opened) + sum(lane.making for lane in self._lanes)
        total = sum(s.total for s in opened)
        # Scenes that are not open yet are taken to be as large as the others.
        closed = (len(self._scenes) - len(opened)) * (total / len(opened) if opened else 0.0)
        at_work = 0.0 if self._first_shard is None else now - self._first_shard
        speed = self._images / at_work if self._images and at_work > 0.0 else None
        remaining = (left + closed) * at_work / self._made if self._made else None
        what = tuple(lane.busy for lane in self._lanes if lane.busy)
        self._progress(Progress(what, total - left, round(total + closed), speed, now - self._begin, remaining))
