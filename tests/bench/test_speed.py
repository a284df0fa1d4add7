"""How fast the parts are: `make bench`. Nothing here passes or fails by time."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import pytest

from fieldkit import maps, policies, protocol
from fieldkit.bags import open_recording
from fieldkit.frames import Pose
from fieldkit.localize import Localizer
from fieldkit.protocol import CandidateRules
from fieldkit.replay import replay
from fieldkit.surface import RayCaster
from fieldkit.types import Candidates, Recording, SceneMap
from fieldkit.views import landmark_statistics
from sim_bridge.rendering import render
from sim_bridge.scenes import make_scene

SAMPLE = Path(__file__).resolve().parents[2] / "data_samples" / "room"


@pytest.fixture(scope="module")
def scene_map() -> SceneMap:
    return maps.load_map(SAMPLE / "lab.map")


@pytest.fixture(scope="module")
def recording() -> Recording:
    return open_recording(SAMPLE / "session")


@pytest.fixture(scope="module")
def candidates(recording: Recording, scene_map: SceneMap) -> Candidates:
    """A hundred directions at a mapping camera's position."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    first, base = scene_map.map_from_image[0], recording.frames[0].camera
    poses = tuple(
        Pose.from_components(first.translation, Rotation.from_rotvec([0, 0, yaw]) * first.rotation)
        for yaw in np.linspace(0, 2 * np.pi, 100, endpoint=False)
    )
    return Candidates("w", tuple(map(str, range(100))), ("sweep",) * 100, poses, base, np.ones(100, dtype=bool))


def test_localize_a_view(benchmark: Any, recording: Recording, scene_map: SceneMap) -> None:
    localizer = Localizer(scene_map)
    images = [(v.frame.read(), v.frame.camera) for v in recording.visits[0].views[:8]]
    turn = itertools.cycle(images)
    benchmark.pedantic(lambda: localizer.localize(*next(turn)), rounds=16, warmup_rounds=2)


@pytest.mark.parametrize("occlusion", [False, True])
def test_rank_a_hundred_candidates(
    benchmark: Any, scene_map: SceneMap, candidates: Candidates, occlusion: bool
) -> None:
    known = landmark_statistics(scene_map)
    rays = RayCaster(scene_map.surface) if occlusion and scene_map.surface is not None else None

    def rank() -> None:
        scene = policies.look_at(scene_map, known, candidates, rules=CandidateRules(), rays=rays, tolerance_m=0.08)
        policies.utility(policies.available("fim"), scene)

    benchmark.pedantic(rank, rounds=5, warmup_rounds=1)


def test_render_a_view(benchmark: Any, recording: Recording) -> None:
    scene, camera = make_scene("room", 0), recording.frames[0].camera
    from scipy.spatial.transform import Rotation

    level = Rotation.from_matrix([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    pose = Pose.from_components([*scene.walk_xy[0], 0.7], level)
    benchmark.pedantic(lambda: render(scene, camera, pose), rounds=10, warmup_rounds=1)


def test_replay_the_sample(benchmark: Any, tmp_path: Path) -> None:
    def once(out: Path) -> None:
        replay(
            [SAMPLE / "session"],
            map_path=SAMPLE / "lab.map",
            tags_path=SAMPLE / "tags.toml",
            protocol=protocol.load("paper_real"),
            out=out,
        )

    numbers = itertools.count()
    benchmark.pedantic(lambda: once(tmp_path / str(next(numbers))), rounds=1)
