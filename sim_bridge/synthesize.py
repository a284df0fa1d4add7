"""Synthesize a whole session: mapping walk, photos of tags, robot recording, and the truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh

from fieldkit.bags.writing import BagFormat
from fieldkit.errors import suggestion
from fieldkit.store import (
    PhotoEntry,
    SessionFile,
    atomic_folder,
    write_camera,
    write_photos,
    write_rig,
    write_session,
    write_tags,
    write_tum,
)
from fieldkit.store.files import refuse_existing
from fieldkit.types import TagMap, TagPose
from sim_bridge.errors import SynthesisError
from sim_bridge.importing import MeshOptions, import_scene, is_mesh
from sim_bridge.mapping import mapper, photographer
from sim_bridge.mesh import Scene
from sim_bridge.recording import recorder, schedule
from sim_bridge.scenes import make_blueprint
from sim_bridge.scenes.changes import STANDARD_CHANGES, ChangeOptions, Worlds, make_worlds, write_changes
from sim_bridge.sensors import STANDARD, Sensors, write_sensors
from sim_bridge.stage import staging


@dataclasses.dataclass(frozen=True)
class SessionOptions:
    """What a session is made of."""

    walk: mapper.WalkOptions = dataclasses.field(default_factory=mapper.WalkOptions)
    stage: staging.StageOptions = dataclasses.field(default_factory=staging.StageOptions)
    photos: photographer.PhotoOptions = dataclasses.field(default_factory=photographer.PhotoOptions)
    schedule: schedule.ScheduleOptions = dataclasses.field(default_factory=schedule.ScheduleOptions)
    recorder: recorder.RecorderOptions = dataclasses.field(default_factory=recorder.RecorderOptions)
    sensors: Sensors = STANDARD
    changes: ChangeOptions | None = STANDARD_CHANGES
    mesh: MeshOptions = dataclasses.field(default_factory=MeshOptions)


def synthesize(
    scene: str,
    out: Path,
    *,
    seed: int = 0,
    formats: Sequence[BagFormat] = ("mcap",),
    options: SessionOptions | None = None,
    force: bool = False,
) -> None:
    """Write a session folder; the same scene, seed and options give the same bytes.

    ``scene`` is the name of a scene or the path of a mesh; nothing changes in a mesh between mapping and visit.

    The recordings of all formats hold the same images, bit for bit. Raises SynthesisError for an unknown scene,
    format or layout, a mesh that is no building, or a scene without room for the session, and StoreError when the
    folder exists and ``force`` is not set.
    """
    chosen, out = options or SessionOptions(), Path(out)
    for wanted in formats or ("none",):
        if wanted not in recorder.RECORDINGS:
            raise SynthesisError(f"unknown format {wanted!r}", hint=suggestion(wanted, list(recorder.RECORDINGS)))
    recorder.check_layout(chosen.recorder.layout)
    if seed < 0:
        raise SynthesisError(f"seed {seed}; expected 0 or more", hint="choose another seed")
    refuse_existing(out, force=force, marker="session.toml", kind="folder")
    imported = is_mesh(scene)
    changes = None if imported else chosen.changes
    worlds = _imported(scene, chosen.mesh) if imported else make_worlds(make_blueprint(scene, seed), changes, seed=seed)
    # Tags, tripods and the robot's ways have to fit the world that is photographed and the one that is visited.
    stage = staging.set_stage(worlds.both, chosen.stage, rng=generator(seed, 4))
    before, after = (staging.set_in(world, stage) for world in (worlds.mapped, worlds.visited))
    with atomic_folder(out, force=force, marker="session.toml") as folder:
        write_sensors(folder / "sensors.toml", chosen.sensors)
        write_changes(folder, changes, worlds)
        _write_mapping(folder, worlds.mapped, chosen, seed=seed)
        _write_photos(folder, before, chosen, seed=seed)
        _write_robot(folder, after, chosen, formats, seed=seed)
        _write_surface(folder / "truth" / "surface.ply", worlds.mapped)
        _write_tags(folder / "truth" / "tags.toml", stage)
        recording = recorder.RECORDINGS[formats[0]]
        layout = chosen.recorder.layout
        name = Path(scene).stem if imported else scene
        write_session(folder / "session.toml", SessionFile(f"{name}-{seed}", recording, layout=layout))


def _imported(path: str, options: MeshOptions) -> Worlds:
    """Return a mesh as all three worlds: nobody has said what in it can move, so nothing changes."""
    scene = import_scene(Path(path), options)
    return Worlds(scene, scene, scene)


def generator(seed: int, part: int) -> np.random.Generator:
    """Return the generator of one part of a session, independent of what the other parts draw."""
    return np.random.default_rng([seed, part])


def _write_mapping(folder: Path, scene: Scene, options: SessionOptions, *, seed: int) -> None:
    stations = mapper.walk(scene, options.walk, rng=generator(seed, 1))
    mapping, sensors = folder / "mapping", options.sensors
    write_rig(mapping / "rig.toml", mapper.hololens_rig(sensors.mapping))
    write_tum(mapping / "slam_poses.txt", [(s.frame, s.slam_from_rig) for s in stations])
    truth = []
    for name, world_from_cam, data in mapper.images(scene, stations, sensors.mapping, rng=generator(seed, 2)):
        _write(mapping / "images" / name, data)
        truth.append((name, world_from_cam))
    for name, data in mapper.depths(scene, stations, sensors.mapping_depth, rng=generator(seed, 3)):
        _write(mapping / "depth" / name, data)
    write_tum(folder / "truth" / "mapping_poses.txt", truth)


def _write_photos(folder: Path, stage: staging.Stage, options: SessionOptions, *, seed: int) -> None:
    sensor = options.sensors.photos
    planned = photographer.plan_photos(stage, options.photos, sensor=sensor, rng=generator(seed, 5))
    write_camera(folder / "photos" / photographer.CAMERA_FILE, photographer.camera(options.photos, sensor))
    entries = [PhotoEntry(p.file, photographer.CAMERA_FILE, p.tag.visit) for p in planned]
    write_photos(folder / "photos" / "photos.toml", entries)
    taken = photographer.photos(stage.scene, planned, options.photos, sensor=sensor, rng=generator(seed, 6))
    for photo, data in taken:
        _write(folder / "photos" / photo.file, data)
    write_tum(folder / "truth" / "photo_poses.txt", [(p.file, p.world_from_cam) for p in planned])


def _write_robot(
    folder: Path, stage: staging.Stage, options: SessionOptions, formats: Sequence[BagFormat], *, seed: int
) -> None:
    plan = schedule.plan_session(stage, options.schedule, stage_options=options.stage, rng=generator(seed, 7))
    sensed = recorder.sense(stage, plan, options.recorder, sensors=options.sensors, rng=generator(seed, 8))
    for name in dict.fromkeys(formats):
        path = folder / recorder.RECORDINGS[name]
        recorder.write_recording(path, sensed, format=name, layout=options.recorder.layout)
    truth = folder / "truth"
    write_tum(truth / "body_poses.txt", [(str(t_ns), pose) for t_ns, pose in sensed.world_from_body])
    write_tum(truth / "view_poses.txt", [(str(image.t_ns), image.world_from_cam) for image in sensed.images])


def _write_tags(path: Path, stage: staging.Stage) -> None:
    exact = np.zeros((6, 6))
    tags = tuple(
        TagPose(tag.id, staging.FAMILY, tag.size_m, tag.world_from_tag, exact, 0, 0.0, visit=tag.visit)
        for tag in stage.tags
    )
    write_tags(path, TagMap(tags, (), "world"))


def _write_surface(path: Path, scene: Scene) -> None:
    mesh = trimesh.Trimesh(scene.vertices, scene.faces, process=False, validate=False)
    _write(path, mesh.export(file_type="ply"))


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
