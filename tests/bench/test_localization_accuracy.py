"""How good localization is on rendered queries of the training scenes, and how fast.

    sim-bridge dataset --scenes office lobby shop laboratory workshop --waypoints 100 --views 50 --out build/training
    python tests/bench/test_localization_accuracy.py build/training [own|foreign|exhaustive|speed ...]

The maps and their gauges are those of a dataset folder (a few views of it are enough: they are rendered again); `make
bench` runs this where the variable LOCALIZATION_DATASET names one. Truth is the renderer's, after one rigid fit of the
map to the mapping cameras, as in `fieldkit judge`. Furniture was moved since mapping. Nothing here passes or fails.
"""

from __future__ import annotations

import dataclasses
import math
import os
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fieldkit import maps
from fieldkit.frames import Pose, log, pose, pose_error
from fieldkit.localize import Localizer, Query
from fieldkit.protocol import LocalizerRules
from fieldkit.store.datasets import MAPS_FOLDER, read_gauge, read_scene
from fieldkit.types import Array, Estimate, Image, SceneMap
from sim_bridge.dataset import SceneOptions, SceneSource
from sim_bridge.stage.lookouts import LookoutOptions

SCENES = ("office", "lobby", "shop", "laboratory", "workshop")
# Poses further off than this are of another place, or of a thing that was moved
FAR_M = 0.5


@dataclasses.dataclass(frozen=True)
class Shot:
    """A rendered query and its true world_from_cam."""

    query: Query
    world_from_cam: Pose


def shots(scene: str, count: int) -> Iterator[Shot]:
    """Yield queries at random directions of random waypoints of a scene, the same for the same count."""
    source = SceneSource(scene, SceneOptions(lookouts=LookoutOptions(count=100, views=50)))
    rng = np.random.default_rng(7)
    waypoints = source.waypoints()
    for i in rng.integers(0, len(waypoints), count):
        sweep = [v for v in waypoints[i].views if v.kind == "sweep"]
        view = sweep[int(rng.integers(0, len(sweep)))]
        image: Image = source.shoot(waypoints[i], view)
        yield Shot(Query(image, waypoints[i].camera), view.world_from_cam)


def scene_map(dataset: Path, scene: str) -> tuple[SceneMap, Pose]:
    """Return a scene's map, and map_from_world."""
    folder = dataset / MAPS_FOLDER / read_scene(dataset, scene).map
    gauge = read_gauge(folder)
    return maps.load_map(folder), pose(gauge.position_m, gauge.quaternion_xyzw).inv()


@dataclasses.dataclass
class Outcomes:
    """Estimates of queries, and their true map_from_cam."""

    estimates: list[Estimate] = dataclasses.field(default_factory=list)
    truths: list[Pose] = dataclasses.field(default_factory=list)

    def errors(self) -> Array:
        """Return f64[n, 2]: m and rad, inf where not localized."""
        pairs = zip(self.estimates, self.truths, strict=True)
        return np.array([pose_error(e.map_from_cam, t) for e, t in pairs])

    def recall(self, position_m: float, rotation_deg: float) -> float:
        """Return the share of queries within both."""
        errors = self.errors()
        return float(((errors[:, 0] < position_m) & (errors[:, 1] < math.radians(rotation_deg))).mean())

    def nees(self) -> Array:
        """Return f64[n, 3] of poses nearer than FAR_M: normalised error squared by degrees of freedom, of all six, of
        rotation, of position."""
        rows = []
        for e, t in zip(self.estimates, self.truths, strict=True):
            if e.map_from_cam is None or e.covariance is None:
                continue
            d, c = log(e.map_from_cam.inv() * t), e.covariance
            if np.linalg.norm(d[3:]) < FAR_M:
                parts = (slice(0, 6), slice(0, 3), slice(3, 6))
                rows.append([d[p] @ np.linalg.solve(c[p, p], d[p]) / len(d[p]) for p in parts])
        return np.array(rows).reshape(-1, 3)


def run(localizer: Localizer, map_from_world: Pose, taken: Sequence[Shot]) -> Outcomes:
    estimates = list(localizer.localize_many([s.query for s in taken]))
    return Outcomes(estimates, [map_from_world * s.world_from_cam for s in taken])


def trimmed(values: Array) -> Array:
    """Return the mean without the largest 2 %."""
    return np.asarray(np.sort(values, axis=0)[: math.ceil(0.98 * len(values))].mean(axis=0))


def own(dataset: Path, count: int = 400) -> str:
    """Return the table of queries in the maps of their own scenes."""
    lines = ["scene | queries | localized | 0.1 m 1 deg | median mm | NEES/dof all, rot, pos | beyond 99.9 % | far off"]
    every = []
    for scene in SCENES:
        known, map_from_world = scene_map(dataset, scene)
        found = run(Localizer(known), map_from_world, list(shots(scene, count)))
        nees, errors = found.nees(), found.errors()
        every.append(nees)
        near = errors[np.isfinite(errors[:, 0])]
        far = (near[:, 0] >= FAR_M).sum()
        shown = " ".join(f"{v:.2f}" for v in trimmed(nees))
        recall, median_mm = 100 * found.recall(0.1, 1.0), 1e3 * np.median(near[:, 0])
        beyond = 100 * (6 * nees[:, 0] > 22.46).mean()
        lines.append(
            f"{scene} | {count} | {len(near)} | {recall:.1f} % | {median_mm:.1f} | {shown} | {beyond:.1f} % | {far}"
        )
    shown = " ".join(f"{v:.2f}" for v in trimmed(np.concatenate(every)))
    return "\n".join([*lines, f"all | | | | | {shown} | |"])


def foreign(dataset: Path, count: int = 750, feature_maps: Sequence[str] = SCENES) -> str:
    """Return how many queries of one scene are localized in the map of another, by confidence."""
    sure, right, total = [], [], 0
    rules = LocalizerRules(min_confidence=0.0)
    for number, scene in enumerate(SCENES):
        taken = list(shots(scene, count))
        other = feature_maps[(number + 1) % len(feature_maps)]
        known, _ = scene_map(dataset, other)
        found = Localizer(known, rules).localize_many([s.query for s in taken])
        sure += [e.confidence for e in found if e.map_from_cam is not None]
        total += len(taken)
        known, map_from_world = scene_map(dataset, scene)
        mine = run(Localizer(known, rules), map_from_world, taken[: count // 3])
        errors = mine.errors()
        good = (errors[:, 0] < 0.25) & (errors[:, 1] < math.radians(2.0))
        right += [e.confidence for e, g in zip(mine.estimates, good, strict=True) if g]
    rows = ["min_confidence | false poses | per 1000 | right poses lost"]
    for bound in (0.0, 0.05, 0.25, 0.5, 0.75, 0.95):
        false, lost = sum(c >= bound for c in sure), sum(c < bound for c in right)
        rows.append(f"{bound} | {false} of {total} | {1e3 * false / total:.2f} | {lost} of {len(right)}")
    return "\n".join(rows)


def exhaustive(dataset: Path, scene: str = "office", count: int = 200) -> str:
    """Return the recall with retrieval and with all mapping images."""
    known, map_from_world = scene_map(dataset, scene)
    taken, rows = list(shots(scene, count)), ["retrieved | 0.1 m 1 deg | 0.25 m 2 deg"]
    for top_k in (20, len(known.image_names)):
        found = run(Localizer(known, LocalizerRules(top_k=top_k)), map_from_world, taken)
        rows.append(f"{top_k} | {100 * found.recall(0.1, 1.0):.1f} % | {100 * found.recall(0.25, 2.0):.1f} %")
    return "\n".join(rows)


def crowded(known: SceneMap, *, images: int = 500, landmarks: int = 100_000) -> SceneMap:
    """Return a map with so many images and landmarks: each landmark several times, with descriptors of its own."""
    rng = np.random.default_rng(0)
    seen = known.observation_image < images
    own = known.descriptor_image < images
    copies = -(-landmarks // len(known.xyz))
    described = known.descriptors[own].astype(np.float32)
    values, owners, owned, observed, by = [], [], [], [], []
    for copy in range(copies):
        change = np.zeros(1) if copy == 0 else rng.permuted(described, axis=1)
        values.append(np.clip(described if copy == 0 else change, 0, 255).astype(known.descriptors.dtype))
        owners.append(known.descriptor_landmark[own] + copy * len(known.xyz))
        owned.append(known.descriptor_image[own])
        observed.append(known.observation_landmark[seen] + copy * len(known.xyz))
        by.append(known.observation_image[seen])
    order = np.argsort(np.concatenate(by), kind="stable")
    return dataclasses.replace(
        known,
        xyz=np.tile(known.xyz, (copies, 1)),
        xyz_covariance=np.tile(known.xyz_covariance, (copies, 1, 1)),
        image_names=known.image_names[:images],
        image_cameras=known.image_cameras[:images],
        map_from_image=known.map_from_image[:images],
        observation_landmark=np.concatenate(observed)[order].astype(np.int32),
        observation_image=np.concatenate(by)[order].astype(np.int32),
        observation_px=np.tile(known.observation_px[seen], (copies, 1))[order],
        descriptors=np.concatenate(values),
        descriptor_landmark=np.concatenate(owners).astype(np.int32),
        descriptor_image=np.concatenate(owned).astype(np.int32),
    )


def speed(dataset: Path, scene: str = "office", count: int = 100) -> str:
    """Return seconds per stage and queries per second, of a map of 500 images and 100,000 landmarks."""
    known = crowded(scene_map(dataset, scene)[0])
    taken = [s.query for s in shots(scene, count)]
    localizer = Localizer(known)
    list(localizer.localize_many(taken[:4]))
    rows = [f"{len(known.image_names)} images, {len(known.xyz)} landmarks, {len(known.descriptors)} descriptors"]
    for what in ("one by one", "many"):
        begin, cpu = time.perf_counter(), time.process_time()
        if what == "many":
            found = list(localizer.localize_many(taken))
        else:
            found = [localizer.localize(q.image, q.camera) for q in taken]
        took, cpu = time.perf_counter() - begin, time.process_time() - cpu
        stages = ", ".join(
            f"{s} {1e3 * float(np.median([e.seconds[s] for e in found if s in e.seconds])):.0f}"
            for s in ("extract", "retrieve", "match", "pnp")
        )
        rows.append(f"{what}: {count / took:.1f} queries/s, {1e3 * cpu / count:.0f} ms of one core each; ms: {stages}")
    return "\n".join(rows)


TABLES = {"own": own, "foreign": foreign, "exhaustive": exhaustive, "speed": speed}


@pytest.mark.benchmark(group="localize")
@pytest.mark.parametrize("table", list(TABLES))
def test_localization_on_training_scenes(benchmark: Any, capsys: pytest.CaptureFixture[str], table: str) -> None:
    if "LOCALIZATION_DATASET" not in os.environ:
        pytest.skip("LOCALIZATION_DATASET names no dataset folder of the training scenes")
    dataset = Path(os.environ["LOCALIZATION_DATASET"])
    text = benchmark.pedantic(lambda: TABLES[table](dataset), rounds=1, iterations=1)
    with capsys.disabled():
        print(f"\n{text}")  # noqa: T201


if __name__ == "__main__":
    for name in sys.argv[2:] or list(TABLES):
        head, _, number = name.partition(":")
        more = {"count": int(number)} if number else {}
        print(f"{head}\n{TABLES[head](Path(sys.argv[1]), **more)}\n", flush=True)  # type: ignore[arg-type]  # noqa: T201
