"""The scenes as view sources of `fieldkit.dataset`: mapped as they were, looked at as they have become."""

from __future__ import annotations

import dataclasses
import functools
import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from fieldkit.dataset import (
    DatasetRules,
    Progress,
    SceneCount,
    SourceView,
    SourceWaypoint,
    add_appearances,
    count_scenes,
    make_dataset,
    open_weights,
)
from fieldkit.errors import suggestion
from fieldkit.frames import Pose, exp
from fieldkit.store import digest, write_rig, write_tum
from fieldkit.types import Array, Image
from sim_bridge import robot
from sim_bridge.errors import SynthesisError
from sim_bridge.importing import MeshOptions, import_scene, is_mesh
from sim_bridge.mapping import mapper
from sim_bridge.mesh import Scene
from sim_bridge.rendering import render
from sim_bridge.scenes import SCENES, make_blueprint
from sim_bridge.scenes.blueprint import Blueprint
from sim_bridge.scenes.changes import STANDARD_CHANGES, ChangeOptions, find_changes, mapped_scene, visited_scene
from sim_bridge.scenes.light import unlit
from sim_bridge.sensors import STANDARD, Motion, Sensors, bent, encode, expose, load_sensors
from sim_bridge.stage.lookouts import Lookout, LookoutOptions, find_lookouts

# Raised when the same blueprint and options give other mapping images, or other views, than before.
MAPPING_VERSION, VIEWS_VERSION = 5, 1


@dataclasses.dataclass(frozen=True)
class PriorNoise:
    """Standard deviations of the prior at a waypoint, about what odometry loses on ten metres.

    ``position_m`` along each horizontal axis, ``height_m`` along the vertical; ``tilt_deg`` about each horizontal axis.
    """

    position_m: float = 0.10
    height_m: float = 0.01
    yaw_deg: float = 1.5
    tilt_deg: float = 0.2

    @property
    def sigmas(self) -> Array:
        """Standard deviations (6,): rotation in rad, then translation in m, in the body's frame."""
        tilt, yaw = np.radians(self.tilt_deg), np.radians(self.yaw_deg)
        return np.array([tilt, tilt, yaw, self.position_m, self.position_m, self.height_m])


@dataclasses.dataclass(frozen=True)
class SceneOptions:
    """How a scene is mapped and looked at; the same options and seed give the same bytes.

    ``tremor_deg_s`` is the standard deviation of the standing robot's turning about each axis of the camera.
    """

    seed: int = 0
    walk: mapper.WalkOptions = dataclasses.field(default_factory=mapper.WalkOptions)
    lookouts: LookoutOptions = dataclasses.field(default_factory=LookoutOptions)
    prior: PriorNoise = dataclasses.field(default_factory=PriorNoise)
    sensors: Sensors = STANDARD
    changes: ChangeOptions | None = STANDARD_CHANGES
    kinematics: robot.KinematicOptions = dataclasses.field(default_factory=robot.KinematicOptions)
    tremor_deg_s: float = 1.2


@dataclasses.dataclass(frozen=True)
class SceneSource:
    """A named scene as a view source; whatever is costly is made at its first use."""

    name: str
    options: SceneOptions

    def __getstate__(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)

    @functools.cached_property
    def _blueprint(self) -> Blueprint:
        return make_blueprint(self.name, self.options.seed)

    @functools.cached_property
    def _scene(self) -> Scene:
        return visited_scene(self._blueprint, self.options.changes, seed=self.options.seed)

    def _mapped(self) -> Scene:
        return mapped_scene(self._blueprint, seed=self.options.seed)

    def _shape(self) -> Scene:
        return unlit(self._blueprint)

    def _digest(self) -> str:
        return blueprint_digest(self._blueprint)

    @functools.cached_property
    def _lookouts(self) -> tuple[Lookout, ...]:
        return find_lookouts(self._scene, self.options.lookouts, rng=_generator(self.options.seed, 21))

    @functools.cached_property
    def _stations(self) -> tuple[mapper.Station, ...]:
        return mapper.walk(self._shape(), self.options.walk, rng=_generator(self.options.seed, 1))

    @functools.cached_property
    def mapping_key(self) -> str:
        """Digest of the scene, of the walk, and of all else that the mapping depends on."""
        o = self.options
        sensors = (o.sensors.mapping, o.sensors.mapping_depth)
        places = [
            s.world_from_rig.as_matrix().tobytes() + s.slam_from_rig.as_matrix().tobytes() for s in self._stations
        ]
        return digest(self._digest(), repr((MAPPING_VERSION, o.seed, o.walk, sensors)), *places)

    @functools.cached_property
    def views_key(self) -> str:
        """Digest of the changed scene, of the places and directions, and of all else that images depend on."""
        o = self.options
        arms = [[arm for *_, arm in lookout.arms] for lookout in self._lookouts]
        bodies = [lookout.world_from_body.as_matrix().tobytes() for lookout in self._lookouts]
        return digest(scene_digest(self._scene), repr((VIEWS_VERSION, o, arms)), *bodies)

    def write_mapping(self, folder: Path) -> Mapping[str, Pose]:
        """Write the mapping walk through the scene as it was; return world_from_cam by image name."""
        sensors, seed, stations = self.options.sensors, self.options.seed, self._stations
        scene = self._mapped()
        write_rig(folder / "rig.toml", mapper.hololens_rig(sensors.mapping))
        write_tum(folder / "slam_poses.txt", [(s.frame, s.slam_from_rig) for s in stations])
        true = {}
        for name, world_from_cam, data in mapper.images(scene, stations, sensors.mapping, rng=_generator(seed, 2)):
            _write(folder / "images" / name, data)
            true[name] = world_from_cam
        for name, data in mapper.depths(scene, stations, sensors.mapping_depth, rng=_generator(seed, 3)):
            _write(folder / "depth" / name, data)
        return true

    @functools.cached_property
    def _arm(self) -> robot.Kinematics:
        return robot.assembled(self.options.kinematics, rng=_generator(self.options.seed, 25))

    def waypoints(self) -> Sequence[SourceWaypoint]:
        """Return the waypoints of a round trip through the scene as it has become."""
        return tuple(self._waypoint(lookout, number) for number, lookout in enumerate(self._lookouts))

    def _waypoint(self, lookout: Lookout, number: int) -> SourceWaypoint:
        sigmas = self.options.prior.sigmas
        error = sigmas * np.random.default_rng([self.options.seed, 22, number]).standard_normal(6)
        rng = np.random.default_rng([self.options.seed, 24, number])
        views = tuple(
            SourceView(
                name,
                kind,
                robot.body_from_camera(self._arm.measured(arm, rng=rng)),
                lookout.world_from_body * self._arm.body_from_camera(arm),
            )
            for name, kind, arm in lookout.arms
        )
        return SourceWaypoint(
            id=lookout.id,
            world_from_body=lookout.world_from_body,
            world_from_prior=lookout.world_from_body * exp(error).inv(),
            prior_covariance=np.diag(sigmas**2),
            camera=bent(robot.ARM_CAMERA, self.options.sensors.hand),
            views=views,
            next=lookout.next,
        )

    def shoot(self, waypoint: SourceWaypoint, view: SourceView, *, repeat: int = 0) -> Image:
        """Render a view and add what the hand's camera adds."""
        rng = np.random.default_rng([self.options.seed, 23, repeat, *f"{waypoint.id}/{view.id}".encode()])
        turning = np.radians(self.options.tremor_deg_s) * rng.standard_normal(3)
        sensor, camera = self.options.sensors.hand, waypoint.camera
        shot = render(self._scene, camera, view.world_from_cam).rgb
        exposed = expose(shot, sensor, camera=camera, rng=rng, motion=Motion(turning, np.zeros(3)))
        return _decoded(encode(exposed, sensor))


@dataclasses.dataclass(frozen=True)
class MeshSource(SceneSource):
    """A mesh of one's own as a view source; nothing changes in it between the mapping walk and the visit."""

    path: str
    mesh: MeshOptions

    @functools.cached_property
    def _scene(self) -> Scene:
        return import_scene(Path(self.path), self.mesh)

    def _mapped(self) -> Scene:
        return self._scene

    def _shape(self) -> Scene:
        return self._scene

    def _digest(self) -> str:
        return scene_digest(self._scene)


@dataclasses.dataclass(frozen=True)
class DatasetOptions:
    """What is asked for of every scene: places, directions, sensors and changes by name or file, and repeats.

    ``mesh`` says how the meshes among the scenes are to be read, ``feature`` with which feature they are mapped and
    views are localized. ``appearance`` names a network whose view of the landmarks is added to the maps; it changes
    nothing else.
    """

    seed: int = 0
    waypoints: int = 100
    views: int = 50
    sensors: str = "standard"
    changes: str = "standard"
    repeats: int = 0
    repeat_share: float = 0.1
    mesh: MeshOptions = dataclasses.field(default_factory=MeshOptions)
    feature: str = "sift"
    appearance: str | None = None


def make_scenes(
    scenes: Sequence[str],
    out: Path,
    *,
    options: DatasetOptions,
    workers: int = 2,
    force: bool = False,
    progress: Callable[[Progress], None] | None = None,
) -> tuple[SceneCount, ...]:
    """Make a dataset of scenes by name or path of a mesh, or go on with it, and count what it holds.

    Raises SynthesisError for an unknown scene or a number out of range, and what `make_dataset` raises.
    """
    limits = (("waypoints", 1, 9999), ("views", 1, 999), ("seed", 0, 2**31 - 1), ("repeats", 0, 999))
    for name, low, high in limits:
        if not low <= getattr(options, name) <= high:
            raise SynthesisError(
                f"--{name} {getattr(options, name)}: expected {low}..{high}", hint="choose another number"
            )
    if not 0.0 < options.repeat_share <= 1.0:
        raise SynthesisError(f"--repeat-share {options.repeat_share:g}: expected more than 0, at most 1")
    for name in scenes:
        if not is_mesh(name) and name not in SCENES:
            raise SynthesisError(f"unknown scene {name!r}", hint=suggestion(name, list(SCENES)))
        if is_mesh(name) and not Path(name).is_file():
            raise SynthesisError(f"{name}: no such file; expected a mesh", hint="check the path")
    _check_names(scenes)
    chosen = SceneOptions(
        seed=options.seed,
        lookouts=LookoutOptions(count=options.waypoints, views=options.views),
        sensors=load_sensors(options.sensors),
        changes=find_changes(options.changes),
    )
    rules = DatasetRules(feature=options.feature, repeats=options.repeats, repeat_share=options.repeat_share)
    sources = [_source(name, chosen, options.mesh) for name in scenes]
    if options.appearance is not None:
        open_weights(options.appearance)
    make_dataset(
        sources,
        out,
        described=json.loads(json.dumps(dataclasses.asdict(chosen), default=msgspec.to_builtins)),
        rules=rules,
        workers=workers,
        force=force,
        progress=progress,
    )
    if options.appearance is not None:
        add_appearances(sources, out, network=options.appearance, progress=_told(progress))
    return count_scenes(out)


def _told(progress: Callable[[Progress], None] | None) -> Callable[[str, int, int], None] | None:
    """Return what tells steps of one scene after the other as progress of a dataset whose views are all there."""
    if progress is None:
        return None
    begin = time.monotonic()

    def tell(what: str, done: int, total: int) -> None:
        progress(Progress((what,), done, total, None, time.monotonic() - begin, None, "images"))

    return tell


def _check_names(scenes: Sequence[str]) -> None:
    """Raise SynthesisError where two scenes, one of them a mesh, would have the same name in the dataset."""
    known: dict[str, str] = {}
    for scene in scenes:
        name = Path(scene).stem if is_mesh(scene) else scene
        other = known.setdefault(name, scene)
        if other != scene:
            raise SynthesisError(
                f"{other}, {scene}: both are named {name!r}; expected scenes of different names",
                hint="rename one of the meshes",
            )


def _source(name: str, options: SceneOptions, mesh: MeshOptions) -> SceneSource:
    if is_mesh(name):
        return MeshSource(Path(name).stem, dataclasses.replace(options, changes=None), name, mesh)
    return SceneSource(name, options)


def blueprint_digest(blueprint: Blueprint) -> str:
    """Return the digest of everything that a blueprint holds."""
    parts: list[bytes | str] = [repr((blueprint.floor_bounds, blueprint.walk_xy.tolist()))]
    for quad in blueprint.quads:
        parts.append(quad.corners.tobytes() + quad.normal.tobytes() + np.asarray(quad.uv).tobytes())
        parts.append(repr((quad.texture, quad.cell_m, quad.solid, quad.closed, quad.glow, quad.thing)))
    for texture in blueprint.textures:
        parts += [repr(texture.shape), np.ascontiguousarray(texture).tobytes()]
    for block in blueprint.blocks:
        parts += [np.asarray(block.corners_xy).tobytes(), repr(block.thing)]
    for thing in blueprint.things:
        parts += [repr((thing.name, thing.kind)), thing.world_from_thing.as_matrix().tobytes()]
    for lamp in blueprint.lamps:
        parts += [lamp.points.tobytes(), np.asarray(lamp.normal).tobytes(), repr((lamp.power, lamp.group))]
    return digest(*parts)


def scene_digest(scene: Scene) -> str:
    """Return the digest of everything that is seen of a scene, or stands in the way."""
    arrays = (scene.vertices, scene.faces, scene.uv, scene.texture, scene.closed, scene.shade, scene.blocks)
    parts = [np.ascontiguousarray(a).tobytes() for a in (*arrays, *scene.textures)]
    return digest(repr([a.shape for a in scene.textures]), *parts)


def _decoded(jpeg: bytes) -> Image:
    """Return the RGB image of a JPEG file, as a reader of recordings would."""
    bgr = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert bgr is not None
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _generator(seed: int, part: int) -> np.random.Generator:
    """Return the generator of one part, independent of what the other parts draw."""
    return np.random.default_rng([seed, part])


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
