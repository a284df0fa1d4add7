"""How right scale and gravity of a map are, by what it was aligned to, and with wrong SLAM positions: `make bench`.

Rendered mapping walks of training scenes with AprilTags of 0.25 m on a wall and on tripods. Each is mapped once; the
model, moved into a frame and scale of its own, is aligned anew by every source, so that wrong positions cost no build.
Truth is that of the renderer: scale and z axis of the similarity between the aligned and the true mapping cameras.
30 % of the frames' SLAM poses are made wrong: each by itself, by metres and tens of degrees, or one block of
consecutive frames by one jump, as after a wrong relocalization. Nothing here passes or fails.

    python tests/bench/test_map_accuracy.py OUT room:0 room:1 office:0 [--whole]
"""

from __future__ import annotations

import dataclasses
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from fieldkit.frames import Pose, exp
from fieldkit.maps import MapOptions, build_map, fit_gauge, load_map
from fieldkit.maps.metric.align import Alignment, umeyama
from fieldkit.maps.metric.choosing import find_frame
from fieldkit.maps.metric.tagged import find_tags
from fieldkit.maps.sources.source import MapSource, read_source, without_poses
from fieldkit.store import read_tum, write_rig, write_tum
from fieldkit.tags import TagDetection
from sim_bridge.mapping import mapper
from sim_bridge.scenes import make_blueprint
from sim_bridge.scenes.changes import STANDARD_CHANGES, make_worlds
from sim_bridge.sensors import STANDARD
from sim_bridge.stage import staging

Array = NDArray[np.float64]
SCENES = ("room:0", "room:1", "room:2")
SIZE_M = 0.25
WRONG, DRAWS = 0.3, 5
UNKNOWN = Rotation.from_rotvec([0.4, -1.3, 0.8])


def mapping(folder: Path, scene: str, seed: int) -> Path:
    """Render a mapping walk with tags into a SOURCE, its truth beside it."""
    if (folder / "truth.txt").is_file():
        return folder
    worlds = make_worlds(make_blueprint(scene, seed), STANDARD_CHANGES, seed=seed)
    options = staging.StageOptions(tag_size_m=SIZE_M)
    stage = staging.set_stage(worlds.both, options, rng=np.random.default_rng([seed, 4]))
    world = staging.set_in(worlds.mapped, stage).scene
    stations = mapper.walk(world, mapper.WalkOptions(), rng=np.random.default_rng([seed, 1]))
    folder.mkdir(parents=True)
    write_rig(folder / "rig.toml", mapper.hololens_rig(STANDARD.mapping))
    write_tum(folder / "slam_poses.txt", [(s.frame, s.slam_from_rig) for s in stations])
    true = []
    for name, world_from_cam, data in mapper.images(
        world, stations, STANDARD.mapping, rng=np.random.default_rng([seed, 2])
    ):
        write(folder / "images" / name, data)
        true.append((name, world_from_cam))
    for name, data in mapper.depths(world, stations, STANDARD.mapping_depth, rng=np.random.default_rng([seed, 3])):
        write(folder / "depth" / name, data)
    write_tum(folder / "truth.txt", true)
    return folder


def write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


@dataclasses.dataclass(frozen=True)
class Built:
    """A source, its model in an unknown frame, the images' poses there and the true ones, and the tags they show."""

    walk: MapSource
    model: pycolmap.Reconstruction
    poses: Mapping[int, Pose]
    true: Mapping[int, Pose]
    tags: Mapping[int, Sequence[TagDetection]]

    def aligned(self, walk: MapSource, options: MapOptions) -> Alignment:
        """Align the model anew."""
        tags = self.tags if options.tag_sizes_m else {}
        return find_frame(walk, self.model, self.poses, options, tags=tags, seed=0)[0]

    def errors(self, alignment: Alignment) -> tuple[float, float]:
        """Return the relative error of the scale, and the angle between the map's z axis and the true one (deg)."""
        found = {i: alignment.map_from_sfm.pose(p) for i, p in self.poses.items()}
        centres, truth = (np.stack([side[i].translation for i in found]) for side in (found, self.true))
        turns = Rotation.concatenate([found[i].rotation * self.true[i].rotation.inv() for i in found])
        up = turns.mean().apply([0.0, 0.0, 1.0])
        return 1.0 / umeyama(centres, truth).scale - 1.0, float(np.degrees(np.arccos(min(up[2], 1.0))))


def built(folder: Path, scene: str) -> Built:
    """Render and map a scene once ("name:seed"), below ``folder``."""
    name, seed = scene.split(":")
    source, out = mapping(folder / f"{name}-{seed}" / "mapping", name, int(seed)), folder / f"{name}-{seed}" / "lab.map"
    if not (out / "map.toml").is_file():
        build_map(source, out)
    walk, scene_map, model = read_source(source), load_map(out), pycolmap.Reconstruction(out / "sparse")
    model.transform(pycolmap.Sim3d(2.7, pycolmap.Rotation3d(UNKNOWN.as_quat()), np.array([3.0, -1.0, 7.0])))
    row = {image.name: i for i, image in enumerate(walk.images)}
    moved = {
        row[name]: Pose.from_components(UNKNOWN.apply(2.7 * p.translation) + [3.0, -1.0, 7.0], UNKNOWN * p.rotation)
        for name, p in zip(scene_map.image_names, scene_map.map_from_image, strict=True)
    }
    true = {row[name]: pose for name, pose in read_tum(source / "truth.txt") if name in row}
    tags = find_tags(walk, {None: SIZE_M}, ("tag36h11",), progress=lambda done: None)
    return Built(walk, model, dict(sorted(moved.items())), true, tags)


def wrong(walk: MapSource, *, block: bool, rng: np.random.Generator) -> MapSource:
    """Return the walk with wrong SLAM poses of 30 % of the frames."""
    off = wrong_frames(sorted({image.frame for image in walk.images}), block=block, rng=rng)
    images = tuple(
        dataclasses.replace(im, slam_from_cam=off[im.frame] * im.slam_from_cam)
        if im.frame in off and im.slam_from_cam is not None
        else im
        for im in walk.images
    )
    return dataclasses.replace(walk, images=images)


def wrong_frames(frames: Sequence[str], *, block: bool, rng: np.random.Generator) -> dict[str, Pose]:
    """Return what 30 % of the frames' SLAM poses are moved by: all by one jump, or each by itself."""
    count = round(WRONG * len(frames))
    first = int(rng.integers(0, len(frames) - count + 1))
    chosen = frames[first : first + count] if block else list(rng.choice(frames, count, replace=False))
    jump = exp([*rng.normal(0, 0.02, 2), rng.normal(0, 0.4), *rng.normal(0, 1.5, 3) * (1, 1, 0.1)])
    return {f: jump if block else exp([*rng.normal(0, 0.4, 3), *rng.normal(0, 2.0, 3)]) for f in chosen}


def rows(place: Built) -> Iterator[tuple[str, str, float, float, str]]:
    """Yield (source, SLAM poses, scale error, gravity error in deg, verdict)."""
    walk, sizes = place.walk, {None: SIZE_M}
    bare = dataclasses.replace(walk, depth=(), depth_camera=None)
    ways = {
        "slam": (walk, MapOptions(scale="slam")),
        "slam + depth": (walk, MapOptions(scale="depth")),
        "slam + tags": (walk, MapOptions(scale="tags", tag_sizes_m=sizes)),
        "depth": (without_poses(walk), MapOptions(poses="none", scale="depth")),
        "tags + depth": (without_poses(walk), MapOptions(poses="none", scale="tags", tag_sizes_m=sizes)),
        "tags": (without_poses(bare), MapOptions(poses="none", scale="tags", tag_sizes_m=sizes)),
    }
    for name, (source, options) in ways.items():
        found = place.aligned(source, options)
        yield name, "as tracked" if options.poses == "slam" else "none", *place.errors(found), told(found)
    for kind in ("scattered", "one jump"):
        for draw in range(DRAWS):
            rng = np.random.default_rng([draw, kind == "one jump"])
            source = wrong(walk, block=kind == "one jump", rng=rng)
            for name in ("slam", "slam + depth"):
                found = place.aligned(source, ways[name][1])
                yield name, f"30 % wrong, {kind}", *place.errors(found), told(found)


def told(a: Alignment) -> str:
    sigma = "" if a.scale_sigma is None else f", scale +- {100 * a.scale_sigma:.2f} %"
    return f"{a.verdict} {a.n_used}/{a.n_total} rms {1000 * a.rms_m:.1f} mm, up by {a.gravity_from}{sigma}"


def show(folder: Path, scenes: tuple[str, ...]) -> str:
    """Return a table over scenes: the worst of the draws where there are several."""
    lines = ["scene | source | SLAM poses | scale % | gravity deg | told", "---|---|---|---|---|---"]
    for scene in scenes:
        worst: dict[tuple[str, str], tuple[float, float, str]] = {}
        for name, poses, scale, gravity, said in rows(built(folder, scene)):
            old = worst.get((name, poses), (0.0, 0.0, ""))
            more = abs(scale) > abs(old[0])
            worst[name, poses] = (scale if more else old[0], max(gravity, old[1]), said if more else old[2])
        lines += [f"{scene} | {n} | {p} | {100 * s:+.3f} | {g:.3f} | {t}" for (n, p), (s, g, t) in worst.items()]
    return "\n".join(lines)


def whole(folder: Path, scene: str) -> str:
    """Return a table of whole builds of a scene, where poses rule out no match, or 30 % of them do so wrongly."""
    name, seed = scene.split(":")
    source = mapping(folder / f"{name}-{seed}" / "mapping", name, int(seed))
    true = dict(read_tum(source / "truth.txt"))
    lines = [
        "scene | built with | scale % | gravity deg | cameras rms mm | registered | told",
        "---|---|---|---|---|---|---",
    ]
    ways = {
        "SLAM, 30 % wrong, scattered": MapOptions(),
        "SLAM, 30 % wrong, one jump": MapOptions(),
        "depth alone": MapOptions(poses="none"),
        "tags, and depth for gravity": MapOptions(poses="none", tag_sizes_m={None: SIZE_M}),
    }
    for kind, options in ways.items():
        copy = folder / f"{name}-{seed}" / kind.replace(" ", "-")
        if not (copy / "lab.map").is_dir():
            shutil.copytree(source, copy / "mapping", dirs_exist_ok=True)
            spoil(copy / "mapping", kind)
            report = build_map(copy / "mapping", copy / "lab.map", options=options)
            (copy / "told.txt").write_text("; ".join(report.warnings), encoding="utf-8")
            shutil.rmtree(copy / "mapping")
        scene_map = load_map(copy / "lab.map")
        gauge = fit_gauge(scene_map, true)
        images = zip(scene_map.image_names, scene_map.map_from_image, strict=True)
        turned = Rotation.concatenate([p.rotation * true[n].rotation.inv() for n, p in images]).mean()
        gravity = np.degrees(np.arccos(min(turned.apply([0.0, 0.0, 1.0])[2], 1.0)))
        lines.append(
            f"{scene} | {kind} | {100 * gauge.scale_error:+.3f} | {gravity:.3f} | {1000 * gauge.rms_m:.1f} | "
            f"{len(scene_map.image_names)} | {(copy / 'told.txt').read_text()}"
        )
    return "\n".join(lines)


def spoil(source: Path, kind: str) -> None:
    """Make 30 % of a source's SLAM poses wrong where the kind of build says so."""
    if "wrong" in kind:
        slam = read_tum(source / "slam_poses.txt")
        frames = [frame for frame, _ in slam]
        off = wrong_frames(frames, block="jump" in kind, rng=np.random.default_rng(7))
        write_tum(source / "slam_poses.txt", [(f, off.get(f, Pose.identity()) * p) for f, p in slam])


@pytest.mark.benchmark(group="maps")
def test_scale_and_gravity_by_source(benchmark: Any, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    found = benchmark.pedantic(lambda: show(tmp_path, SCENES), rounds=1, iterations=1)
    with capsys.disabled():
        print("\n" + found)  # noqa: T201


@pytest.mark.benchmark(group="maps")
def test_whole_builds_with_wrong_positions(benchmark: Any, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    found = benchmark.pedantic(lambda: whole(tmp_path, SCENES[0]), rounds=1, iterations=1)
    with capsys.disabled():
        print("\n" + found)  # noqa: T201


if __name__ == "__main__":
    chosen = tuple(a for a in sys.argv[2:] if not a.startswith("--")) or SCENES
    out = Path(sys.argv[1])
    print("\n".join(whole(out, c) for c in chosen) if "--whole" in sys.argv else show(out, chosen))  # noqa: T201
