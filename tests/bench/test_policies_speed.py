"""How long learned policies take to rank a hundred candidates, in parts: features of views, and their scores.

    python tests/bench/test_policies_speed.py

A synthetic room with 50,000 landmarks of 40 images; random weights, which cost what trained ones do. Seconds are the
smallest of several rounds, by the clock and in brackets of processors together; OMP_NUM_THREADS says how many threads
torch takes. Nothing here passes or fails.
"""

from __future__ import annotations

import dataclasses
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

# The tests are no package: their helpers are found from here when this file is run by itself.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from seeded_weights import seeded
from synthetic_map import looking, room_points
from test_policies import make_map

from fieldkit.cameras import Camera
from fieldkit.learned.scoring import Scorer
from fieldkit.policies import Learned, Scene, look_at
from fieldkit.protocol import CandidateRules
from fieldkit.types import Candidates, SceneMap
from fieldkit.views import (
    HeatMaps,
    landmark_statistics,
    landmark_tokens,
    seen_landmarks,
    thinned,
    view_histograms,
)

CAMERA = Camera("PINHOLE", 640, 480, (552.03, 552.03, 320.0, 240.0))
CAPS = (128, 256, 512)
ROUNDS = 7


def big_map() -> SceneMap:
    """Return a room of 50,000 landmarks; every mapping image observed a sixth of them, at random pixels."""
    rng = np.random.default_rng(0)
    angles = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    mapping = [looking(np.array([np.cos(a), 0.7 * np.sin(a), 1.6]), a + 0.3) for a in angles]
    full = make_map(room_points(rng, 50_000), mapping)
    keep = np.flatnonzero((full.observation_landmark + full.observation_image) % 6 == 0)
    return dataclasses.replace(
        full,
        observation_landmark=full.observation_landmark[keep],
        observation_image=full.observation_image[keep],
        observation_px=rng.uniform([0, 0], [640, 480], (len(keep), 2)).astype(np.float32),
    )


def hundred() -> Candidates:
    """Return a hundred directions at one place."""
    rng = np.random.default_rng(1)
    poses = tuple(
        looking(np.array([0.5, 0.3, 0.8]), yaw, pitch)
        for yaw, pitch in zip(
            np.linspace(0, 2 * np.pi, 100, endpoint=False), rng.uniform(-0.17, 0.78, 100), strict=True
        )
    )
    names = tuple(map(str, range(100)))
    return Candidates("w", names, ("sweep",) * 100, poses, CAMERA, np.ones(100, dtype=bool))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene()


def make_scene() -> Scene:
    """Return the policies' input, with what is made once per map made already."""
    scene_map = big_map()
    known, heat_maps = landmark_statistics(scene_map), HeatMaps(scene_map)
    heat_maps.counts(np.arange(3))
    return look_at(scene_map, known, hundred(), rules=CandidateRules(), heat_maps=heat_maps)


def policy(kind: str, cap: int | None) -> Learned:
    """Return a policy of random weights."""
    return Learned(Scorer(seeded(kind, landmark_cap=cap)))


@pytest.mark.parametrize(("kind", "cap"), [("mlp", None), *(("vpt", cap) for cap in CAPS)])
def test_from_visible_landmarks_to_scores(benchmark: Any, scene: Scene, kind: str, cap: int | None) -> None:
    chosen = policy(kind, cap)
    benchmark.pedantic(lambda: chosen(scene), rounds=ROUNDS, warmup_rounds=1)


def seconds(work: Callable[[], Any]) -> tuple[np.ndarray, Any]:
    """Return the smallest time of a call after a first one, by the clock and of processors, and what it returns."""
    result, times = work(), []
    for _ in range(ROUNDS):
        begin = np.array([time.perf_counter(), time.process_time()])
        result = work()
        times.append(np.array([time.perf_counter(), time.process_time()]) - begin)
    return np.min(times, axis=0), result


def words(times: np.ndarray) -> str:
    """Return both times."""
    return f"{times[0]:.3f} ({times[1]:.3f})"


def table() -> str:
    """Return the seconds of every part as a table."""
    scene_map = big_map()
    known = landmark_statistics(scene_map)
    made, heat_maps = seconds(lambda: _made(scene_map))
    looked, scene = seconds(lambda: look_at(scene_map, known, hundred(), rules=CandidateRules(), heat_maps=heat_maps))
    found, views = seconds(lambda: seen_landmarks(scene.visible, scene.candidates, statistics=known))
    counts = [s.visible for s in views]
    lines = [
        f"50,000 landmarks, {len(scene_map.observation_px)} observations; in view {min(counts)}..{max(counts)}, "
        f"median {statistics.median(counts):.0f}",
        f"once per map: heat maps {words(made)} s",
        f"for every policy: visible landmarks {words(looked)} s (no occlusion filter); for learned ones: their angles "
        f"{words(found)} s",
        "",
        "| policy | cap | features s | scores s | features to choice s |",
        "|---|---|---|---|---|",
    ]
    histograms, inputs = seconds(lambda: [view_histograms(s, known, camera=CAMERA) for s in views])
    scorer = Scorer(seeded("mlp"))
    scored, _ = seconds(lambda: int(np.argmax(scorer.scores(inputs))))
    lines.append(f"| mlp | - | {words(histograms)} | {words(scored)} | {words(histograms + scored)} |")
    for cap in CAPS:
        scorer = Scorer(seeded("vpt", landmark_cap=cap))
        made, inputs = seconds(
            lambda cap=cap: [  # type: ignore[misc]
                landmark_tokens(thinned(s, cap=cap), known, heat_maps=heat_maps, camera=CAMERA) for s in views
            ]
        )
        scored, _ = seconds(
            lambda scorer=scorer, inputs=inputs: int(np.argmax(scorer.scores(inputs, visible=counts)))  # type: ignore[misc]
        )
        lines.append(f"| vpt | {cap} | {words(made)} | {words(scored)} | {words(made + scored)} |")
    return "\n".join(lines)


def _made(scene_map: SceneMap) -> HeatMaps:
    heat_maps = HeatMaps(scene_map)
    heat_maps.counts(np.arange(3))
    return heat_maps


if __name__ == "__main__":
    print(table())  # noqa: T201
