"""How fast scenes are drawn and sensed: `make bench`. Nothing here passes or fails by time.

`extra_info` of each benchmark has the figures: frames per second, cost against the number of triangles, peak memory.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import resource
import time
from multiprocessing.synchronize import Barrier
from typing import Any

import numpy as np
import pytest

from fieldkit.frames import Pose
from sim_bridge import robot
from sim_bridge.aim import aim
from sim_bridge.mesh import Scene
from sim_bridge.rendering import render, render_depth
from sim_bridge.scenes import make_scene
from sim_bridge.sensors import STANDARD, Motion, bent, effects, encode, expose, sense_depth

FRAMES = 60
# The arm sweeps while it shoots.
MOTION = Motion(np.array([0.02, 0.15, 0.0]), np.array([0.05, 0.0, 0.02]))


def views(scene: Scene, count: int) -> list[Pose]:
    """Draw poses of the hand over free floor: every direction, pitch -10..45 degrees."""
    rng = np.random.default_rng(0)
    x0, y0, x1, y1 = scene.floor_bounds
    poses: list[Pose] = []
    while len(poses) < count:
        xy, z = rng.uniform([x0, y0], [x1, y1]), rng.uniform(0.6, 1.1)
        if scene.free_floor(xy, 0.4)[0]:
            yaw, pitch = rng.uniform(-np.pi, np.pi), np.radians(rng.uniform(-10.0, 45.0))
            poses.append(aim([*xy, z], yaw, pitch_rad=pitch))
    return poses


def shoot(scene: Scene, pose: Pose, rng: np.random.Generator) -> int:
    """Take a colour and a depth image as the recorder does; return the bytes of both."""
    camera, depth_camera = bent(robot.ARM_CAMERA, STANDARD.hand), robot.DEPTH_CAMERA
    seen = render(scene, camera, pose)
    image = expose(seen.rgb, STANDARD.hand, camera=camera, rng=rng, motion=MOTION, depth_m=seen.depth_m)
    exact = render_depth(scene, depth_camera, pose)
    depth = sense_depth(exact, STANDARD.hand_depth, camera=depth_camera, rng=rng)
    return len(encode(image, STANDARD.hand)) + len(effects.depth_png(depth, far_m=65.0))


def work(scene: Scene | str, barrier: Barrier, results: Any) -> None:
    """Shoot FRAMES images in a process of its own; report seconds, those of its own core, and peak memory in MB."""
    made = make_scene(scene, 0) if isinstance(scene, str) else scene
    poses, rng = views(made, FRAMES), np.random.default_rng(1)
    shoot(made, poses[0], rng)
    barrier.wait()
    begin, own = time.perf_counter(), time.process_time()
    for pose in poses:
        shoot(made, pose, rng)
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    results.put((time.perf_counter() - begin, time.process_time() - own, peak_mb))


def in_processes(scene: Scene | str, count: int) -> list[tuple[float, float, float]]:
    context = multiprocessing.get_context("spawn")
    barrier, results = context.Barrier(count), context.Queue()
    crew = [context.Process(target=work, args=(scene, barrier, results)) for _ in range(count)]
    for member in crew:
        member.start()
    found = [results.get(timeout=600) for _ in crew]
    for member in crew:
        member.join()
    return found


@pytest.fixture(scope="module")
def office() -> Scene:
    return make_scene("office", 0)


@pytest.fixture
def one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let processes started from here compute on one thread each."""
    for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        monkeypatch.setenv(name, "1")


@pytest.mark.parametrize("processes", [1, 2])
def test_frames_of_the_office(benchmark: Any, office: Scene, processes: int, one_thread: None) -> None:
    found = benchmark.pedantic(lambda: in_processes(office, processes), rounds=1)
    slowest, own = max(item[0] for item in found), sum(item[1] for item in found)
    benchmark.extra_info["frames_per_s"] = processes * FRAMES / slowest
    # What a machine that does nothing else would give, should this one be busy.
    benchmark.extra_info["core_ms_per_frame"] = 1e3 * own / (processes * FRAMES)


def test_peak_memory_of_a_worker_that_makes_the_office(benchmark: Any, one_thread: None) -> None:
    found = benchmark.pedantic(lambda: in_processes("office", 1), rounds=1)
    benchmark.extra_info["peak_mb"] = found[0][2]


@pytest.mark.parametrize("draw", [render, render_depth])
def test_draw_the_office(benchmark: Any, office: Scene, draw: Any) -> None:
    poses = views(office, 20)
    benchmark.pedantic(lambda: [draw(office, robot.ARM_CAMERA, pose) for pose in poses], rounds=3, warmup_rounds=1)
    benchmark.extra_info["ms_per_frame"] = 1e3 * benchmark.stats.stats.min / len(poses)


def subdivided(scene: Scene) -> Scene:
    """Cut every face into four of the same surface."""
    corners = [[[2, 0, 0], [1, 1, 0], [1, 0, 1]], [[1, 1, 0], [0, 2, 0], [0, 1, 1]]]
    weights = 0.5 * np.array([*corners, [[1, 0, 1], [0, 1, 1], [0, 0, 2]], [[1, 1, 0], [0, 1, 1], [1, 0, 1]]])
    count = 4 * len(scene.faces)
    vertices = np.einsum("kcj,mjx->mkcx", weights, scene.vertices[scene.faces]).reshape(-1, 3)
    return dataclasses.replace(
        scene,
        vertices=vertices,
        faces=np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
        uv=np.einsum("kcj,mjx->mkcx", weights, scene.uv).reshape(-1, 3, 2).astype(np.float32),
        shade=np.einsum("kcj,mj->mkc", weights, scene.shade).reshape(-1, 3).astype(np.float32),
        texture=np.repeat(scene.texture, 4),
        closed=np.repeat(scene.closed, 4),
    )


def repeated(scene: Scene, side: int) -> Scene:
    """Lay side * side copies of a scene beside each other, each behind walls of its own."""
    step = scene.bounds[1] - scene.bounds[0] + 0.1
    shifts = [np.array([i * step[0], j * step[1], 0.0]) for i in range(side) for j in range(side)]
    faces = [scene.faces + k * len(scene.vertices) for k in range(len(shifts))]
    return dataclasses.replace(
        scene,
        vertices=np.concatenate([scene.vertices + shift for shift in shifts]),
        faces=np.concatenate(faces).astype(np.int32),
        uv=np.tile(scene.uv, (len(shifts), 1, 1)),
        shade=np.tile(scene.shade, (len(shifts), 1)),
        texture=np.tile(scene.texture, len(shifts)),
        closed=np.tile(scene.closed, len(shifts)),
    )


@pytest.mark.parametrize("kind", ["finer", "more rooms"])
def test_cost_against_triangles(benchmark: Any, kind: str) -> None:
    """From 36 thousand to about 3 million triangles: ms per frame, and both as multiples of the smallest scene."""
    room = make_scene("room", 0)
    poses = views(room, 10)
    grown = room
    table = []
    for step, side in enumerate((1, 2, 4, 9)):
        if step > 0:
            grown = subdivided(grown) if kind == "finer" else repeated(room, side)
        render(grown, robot.ARM_CAMERA, poses[0])
        begin = time.perf_counter()
        for pose in poses:
            render(grown, robot.ARM_CAMERA, pose)
        table.append((len(grown.faces), 1e3 * (time.perf_counter() - begin) / len(poses)))
    last, pose = grown, poses[1]
    benchmark.pedantic(lambda: render(last, robot.ARM_CAMERA, pose), rounds=3)
    for triangles, ms in table:
        growth = f"{triangles / table[0][0]:.1f} x triangles: {ms / table[0][1]:.2f} x time"
        benchmark.extra_info[str(triangles)] = f"{ms:.1f} ms per frame; {growth}"
