"""The command line of the simulator; every command is a plain typed function."""

from __future__ import annotations

import dataclasses
import logging
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import tyro

from fieldkit.bags.writing import BagFormat
from fieldkit.errors import FieldkitError

# The simulator itself is imported inside the command: --help must not wait for a compiler.


def synthesize(
    *,
    out: Path,
    scene: str = "room",
    seed: int = 0,
    format: tuple[BagFormat, ...] | None = None,
    layout: str = "generic",
    waypoints: int = 4,
    starts: Literal["each", "once"] = "each",
    stations: int = 54,
    quality: int = 90,
    force: bool = False,
) -> None:
    """Synthesize a session: mapping walk, photos of tags, robot recording, and the truth.

    Args:
        out: session folder to write
        scene: name of a scene
        seed: the same seed gives the same bytes
        format: one or more formats of the recording; all hold the same images; by default the layout's own: ros1 for
            spot_ros1, else mcap
        layout: names of topics and frames: generic, or those of a driver, spot_ros1 or spot_ros2
        waypoints: number of waypoints, each with a tripod tag
        starts: each waypoint reached from the start tag, as in the paper, or once for the whole session
        stations: number of places at which the mapping rig takes its images
        quality: JPEG quality of the arm camera's images, 1 to 100
        force: replace an existing folder
    """
    from sim_bridge.errors import SynthesisError
    from sim_bridge.recording.recorder import own_format
    from sim_bridge.sensors import with_quality
    from sim_bridge.synthesize import SessionOptions
    from sim_bridge.synthesize import synthesize as write_session

    limits = (("waypoints", waypoints, 1, 20), ("stations", stations, 2, 999), ("quality", quality, 1, 100))
    for name, value, low, high in limits:
        if not low <= value <= high:
            raise SynthesisError(f"--{name} {value}: expected {low}..{high}", hint="choose another number")
    standard = SessionOptions()
    options = dataclasses.replace(
        standard,
        walk=dataclasses.replace(standard.walk, stations=stations),
        stage=dataclasses.replace(standard.stage, waypoints=waypoints),
        schedule=dataclasses.replace(standard.schedule, starts=starts),
        recorder=dataclasses.replace(standard.recorder, layout=layout),
        sensors=with_quality(standard.sensors, quality),
    )
    begin = time.monotonic()
    write_session(scene, out, seed=seed, formats=format or (own_format(layout),), options=options, force=force)
    logging.getLogger(__name__).info("%s written in %.0f s", out, time.monotonic() - begin)


COMMANDS = {"synthesize": synthesize}


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
