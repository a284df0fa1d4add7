"""The command line of the simulator; every command is a plain typed function."""

from __future__ import annotations

import dataclasses
import logging
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from fieldkit.bags.writing import BagFormat
from fieldkit.errors import FieldkitError

if TYPE_CHECKING:
    from fieldkit.dataset import Progress
    from sim_bridge.importing import MeshOptions

# The simulator itself is imported inside the command: --help must not wait for a compiler.


def synthesize(
    *,
    out: Path,
    scene: str = "room",
    seed: int = 0,
    format: tuple[BagFormat, ...] = (),
    layout: str = "generic",
    waypoints: int = 4,
    starts: Literal["each", "once"] = "each",
    stations: int | None = None,
    quality: int | None = None,
    sensors: str = "standard",
    without: tuple[str, ...] = (),
    lens: Literal["none", "radtan", "fisheye"] | None = None,
    changes: str = "standard",
    unit: Literal["m", "cm", "mm"] | None = None,
    up: Literal["z", "y"] | None = None,
    force: bool = False,
) -> None:
    """Synthesize a session: mapping walk, photos of tags, robot recording, and the truth.

    Args:
        out: session folder to write
        scene: name of a scene, or a mesh of a building: a .glb, .obj or .ply file
        seed: the same seed gives the same bytes
        format: one or more formats of the recording; all hold the same images; by default the layout's own: ros1 for
            spot_ros1, else mcap
        layout: names of topics and frames: generic, or those of a driver, spot_ros1 or spot_ros2
        waypoints: number of waypoints, each with a tripod tag
        starts: each waypoint reached from the start tag, as in the paper, or once for the whole session
        stations: number of places at which the mapping rig takes its images; by default one per m2 of
            floor that can be seen, at most 150
        quality: JPEG quality of the arm camera's images, 1 to 100; by default that of its sensor
        sensors: what the sensors add: standard, ideal (nothing), or a TOML file like a session's sensors.toml
        without: effects to switch off: lens, exposure, vignetting, noise, blur, jpeg, depth_noise, depth_holes
        lens: distortion of the arm's camera; by default that of its sensor
        changes: what changes between the mapping walk and the robot's visit: standard, none, or a TOML file like a
            session's changes.toml; a mesh does not change
        unit: unit of a mesh; by default it has to look like metres
        up: axis of a mesh that points up; by default it has to look like z
        force: replace an existing folder
    """
    from sim_bridge.errors import SynthesisError
    from sim_bridge.mapping.lenses import refuse_lenses
    from sim_bridge.recording.recorder import own_format
    from sim_bridge.scenes.changes import find_changes
    from sim_bridge.sensors import load_sensors, with_lens, with_quality
    from sim_bridge.sensors import without as switched_off
    from sim_bridge.synthesize import SessionOptions
    from sim_bridge.synthesize import synthesize as write_session

    limits = (
        ("waypoints", waypoints, 1, 20),
        ("stations", 2 if stations is None else stations, 2, 999),
        ("quality", 90 if quality is None else quality, 1, 100),
    )
    for name, value, low, high in limits:
        if not low <= value <= high:
            raise SynthesisError(f"--{name} {value}: expected {low}..{high}", hint="choose another number")
    for effect, given in (("jpeg", quality is not None and "--quality"), ("lens", lens is not None and "--lens")):
        if given and effect in without:
            raise SynthesisError(f"{given} sets what --without {effect} switches off", hint="leave one of them out")
    chosen = load_sensors(sensors) if lens is None else with_lens(load_sensors(sensors), lens)
    chosen = switched_off(chosen if quality is None else with_quality(chosen, quality), without)
    refuse_lenses(chosen, where=sensors)
    standard = SessionOptions()
    options = dataclasses.replace(
        standard,
        walk=dataclasses.replace(standard.walk, stations=stations),
        stage=dataclasses.replace(standard.stage, waypoints=waypoints),
        schedule=dataclasses.replace(standard.schedule, starts=starts),
        recorder=dataclasses.replace(standard.recorder, layout=layout),
        sensors=chosen,
        changes=find_changes(changes),
        mesh=_mesh_options((scene,), unit=unit, up=up),
    )
    begin = time.monotonic()
    write_session(scene, out, seed=seed, formats=format or (own_format(layout),), options=options, force=force)
    logging.getLogger(__name__).info("%s written in %.0f s", out, time.monotonic() - begin)


def dataset(
    *,
    scenes: tuple[str, ...],
    out: Path,
    seed: int = 0,
    waypoints: int = 100,
    views: int = 50,
    workers: int = 2,
    sensors: str = "standard",
    changes: str = "standard",
    feature: str = "sift",
    repeats: int = 0,
    repeat_share: float = 0.1,
    unit: Literal["m", "cm", "mm"] | None = None,
    up: Literal["z", "y"] | None = None,
    appearance: Literal["efficientnet", "dinov2"] | None = None,
    force: bool = False,
) -> None:
    """Make a dataset: many views of scenes, localized in maps of them; features and labels are stored, no images.

    A killed run goes on with the same command. Replay it with `fieldkit replay OUT --protocol paper_sim --out RUN`.

    Args:
        scenes: names of scenes, or meshes of buildings: .glb, .obj or .ply files; they join those that OUT holds
        out: dataset folder to write, or to go on with
        seed: the same seed gives the same bytes
        waypoints: places per scene
        views: directions per place, besides the stowed and the forward view
        workers: processes; their number does not change the result
        sensors: standard, ideal, or a sensors.toml
        changes: what changes between mapping and robot: standard, none, or a changes.toml
        feature: the feature of maps and views: sift, aliked, ...
        repeats: further localizations with new noise, of a share of the views
        repeat_share: share of the views that are localized again
        unit: unit of the meshes; by default they have to look like metres
        up: axis of the meshes that points up; by default it has to look like z
        appearance: network whose view of the landmarks is added to the maps, for training vpt_appearance or vpt_dino;
            also to a dataset that is made already
        force: make the views of these scenes again where they were made otherwise; maps that still fit are kept, and
            scenes of OUT that are not named stay: settings other than theirs are refused
    """
    from sim_bridge.dataset import DatasetOptions, make_scenes
    from sim_bridge.mapping.lenses import refuse_lenses
    from sim_bridge.sensors import load_sensors

    refuse_lenses(load_sensors(sensors), where=sensors)
    mesh = _mesh_options(scenes, unit=unit, up=up)
    options = DatasetOptions(seed, waypoints, views, sensors, changes, repeats, repeat_share, mesh, feature, appearance)
    made = make_scenes(scenes, out, options=options, workers=workers, force=force, progress=_ProgressLines())
    for row in made:
        again = "" if not row.repeats else f", {row.repeats} repeats: {100 * row.flipped:.1f} % change the label"
        print(
            f"{row.scene}: {row.waypoints} of {row.planned} waypoints, {row.views} views, "
            f"{100 * row.localized:.1f} % localize{again}"
        )


def _mesh_options(
    scenes: tuple[str, ...], *, unit: Literal["m", "cm", "mm"] | None, up: Literal["z", "y"] | None
) -> MeshOptions:
    """Return how meshes are to be read; raises SynthesisError where that is said and there is none."""
    from sim_bridge.errors import SynthesisError
    from sim_bridge.importing import MeshOptions, is_mesh

    for flag, value in (("unit", unit), ("up", up)):
        if value is not None and not any(is_mesh(scene) for scene in scenes):
            raise SynthesisError(
                f"--{flag} {value}: no scene is a mesh ({', '.join(scenes)}); expected a .glb, .obj or .ply file",
                hint=f"leave --{flag} out, or give a mesh's path",
            )
    return MeshOptions(up=up, unit=unit)


class _ProgressLines:
    """Log how far a dataset is, every few seconds."""

    def __init__(self, *, every_s: float = 5.0) -> None:
        self._every_s, self._last = every_s, -every_s

    def __call__(self, at: Progress) -> None:
        if at.seconds - self._last < self._every_s:
            return
        self._last = at.seconds
        left = "" if at.seconds_left is None else f", {at.seconds_left / 60:.1f} min left"
        speed = "preparing" if at.images_s is None else f"{at.images_s:.1f} views/s"
        where = ", ".join(at.what)
        logging.getLogger(__name__).info("%d of %d %s, %s%s | %s", at.done, at.total, at.unit, speed, left, where)


def export(
    session: tyro.conf.Positional[Path],
    *,
    to: Literal["streamrecorder"],
    out: Path,
    names: Literal["underscores", "spaces"] = "underscores",
    force: bool = False,
) -> None:
    """Export the mapping walk of a session in the form that other tools read.

    Args:
        session: session folder that sim-bridge synthesized
        to: streamrecorder: folders like those that StreamRecorder makes of a HoloLens 2
        out: folder to write
        names: VLC_LF as in the paper's recordings, or VLC LF as the device writes it
        force: replace an existing export
    """
    from sim_bridge.mapping.streamrecorder import export_streamrecorder

    counts = export_streamrecorder(session, out, separator="_" if names == "underscores" else " ", force=force)
    logging.getLogger(__name__).info("%s: %s", out, ", ".join(f"{n} {count}" for n, count in counts.items()))


COMMANDS: dict[str, Callable[..., None]] = {"synthesize": synthesize, "dataset": dataset, "export": export}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line: exit 0 done, 1 a user's mistake in one line, 2 usage."""
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        tyro.extras.subcommand_cli_from_dict(
            COMMANDS,
            prog="sim-bridge",
            description="Make sessions from rendered scenes: no robot needed.",
            args=words,
            config=(tyro.conf.FlagCreatePairsOff,),
        )
    except FieldkitError as error:
        print(f"sim-bridge: {error}", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        print("sim-bridge: interrupted", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
