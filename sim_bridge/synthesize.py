"""Synthesize a whole session: mapping walk, photos of tags, robot recording, and the truth."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import trimesh

from fieldkit.errors import suggestion
from fieldkit.store import atomic_folder, write_rig, write_tum
from sim_bridge import mapper
from sim_bridge.errors import SynthesisError
from sim_bridge.scene import SCENES, Scene


@dataclasses.dataclass(frozen=True)
class SessionOptions:
    """What a session is made of."""

    walk: mapper.WalkOptions = mapper.WalkOptions()


def synthesize(scene: str, out: Path, *, seed: int = 0, options: SessionOptions | None = None, force: bool = False) -> None:
    """Write a session folder; the same scene, seed and options give the same bytes.

    Raises SynthesisError for an unknown scene and StoreError when the folder exists and ``force`` is not set.
    """
    chosen = options or SessionOptions()
    if scene not in SCENES:
        raise SynthesisError(f"unknown scene {scene!r}", hint=suggestion(scene, list(SCENES)))
    with atomic_folder(Path(out), force=force) as folder:
        room = SCENES[scene](seed)
        _write_mapping(folder, room, chosen.walk, seed=seed)
        _write_surface(folder / "truth" / "surface.ply", room)


def generator(seed: int, part: int) -> np.random.Generator:
    """Return the generator of one part of a session, independent of what the other parts draw."""
    return np.random.default_rng([seed, part])


def _write_mapping(folder: Path, scene: Scene, options: mapper.WalkOptions, *, seed: int) -> None:
    stations = mapper.walk(scene, options, rng=generator(seed, 1))
    mapping = folder / "mapping"
    write_rig(mapping / "rig.toml", mapper.hololens_rig())
    write_tum(mapping / "slam_poses.txt", [(s.frame, s.slam_from_rig) for s in stations])
    truth = []
    for name, world_from_cam, data in mapper.images(scene, stations, options, rng=generator(seed, 2)):
        _write(mapping / "images" / name, data)
        truth.append((name, world_from_cam))
    for name, data in mapper.depths(scene, stations, options, rng=generator(seed, 3)):
        _write(mapping / "depth" / name, data)
    write_tum(folder / "truth" / "mapping_poses.txt", truth)


def _write_surface(path: Path, scene: Scene) -> None:
    mesh = trimesh.Trimesh(scene.vertices, scene.faces, process=False, validate=False)
    _write(path, mesh.export(file_type="ply"))


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
