"""The command line: every command is a plain typed function that a notebook can call too."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import tyro
from rich.console import Console
from rich.table import Table
from tyro.conf import Positional
from tyro.conf import UseAppendAction as Repeated

from fieldkit.check_commands import tags_check
from fieldkit.console import ProgressBars, cells, log_handler, make_table, print_json, print_mapping
from fieldkit.errors import FieldkitError, ReplayError
from fieldkit.localize_commands import localize
from fieldkit.map_commands import map_appearance, map_build, map_compact, map_export, map_import, map_info
from fieldkit.tag_commands import tags_export, tags_import, tags_sheet
from fieldkit.tag_tables import print_second, print_tags, second_json, tags_json
from fieldkit.train_commands import train

# Heavy rooms are imported inside the commands: `fieldkit report` must not wait for SfM, cameras and bags to load.


def inspect(recording: Positional[Path], *, layout: str | None = None, json: bool = False) -> None:
    """Say what a recording holds and what it lacks.

    Args:
        recording: bag file, ROS 2 bag folder, or session folder
        layout: names of topics and frames; found by itself when not given
        json: print JSON
    """
    from fieldkit.bags import inspect_recording

    found = inspect_recording(recording, layout=layout)
    print_json(found) if json else print_mapping(found, title=str(recording))


def tags_calibrate(
    photos: Positional[Path],
    *,
    map: Path,
    out: Path,
    size_m: Repeated[tuple[str, ...]],
    camera: Path | None = None,
    check_map: Path | None = None,
    family: Repeated[tuple[str, ...]] = (),
    detector: Literal["pupil", "opencv"] | None = None,
    weights: Path | None = None,
    json: bool = False,
    force: bool = False,
) -> int:
    """Find the poses of AprilTags in a map from photos of them; exit with 3 when --check-map contradicts the map.

    Args:
        photos: folder with photos, and photos.toml where cameras or visits differ
        map: map folder
        out: tags.toml to write
        size_m: edge length of the black square in m, or ID:SIZE for one tag; may be repeated
        camera: camera.toml of the photos, where photos.toml names none
        check_map: another map of the place, such as one of another feature: compare where it localizes the photos
        family: tag family, by default tag36h11; may be repeated
        detector: what finds the tags; by default pupil, and opencv for tag36h10
        weights: folder where the weights of networks are looked for first
        json: print JSON
        force: replace an existing file
    """
    from fieldkit import store
    from fieldkit.calibrate import calibrate_photos, check_in_second_map, parse_sizes, refuse_same_map
    from fieldkit.features.weights import weights_first_in
    from fieldkit.maps import load_map

    store.refuse_existing(out, force=force, kind="file")
    sizes_m, families, second = parse_sizes(size_m), family or ("tag36h11",), None
    scene_map = load_map(map)
    other = None if check_map is None else load_map(check_map)
    if other is not None:
        refuse_same_map(scene_map, other)
    with ProgressBars() as progress, weights_first_in(weights):
        tags = calibrate_photos(
            photos, scene_map, camera=camera, sizes_m=sizes_m, families=families, detector=detector, progress=progress
        )
        if other is not None:
            second = check_in_second_map(
                photos,
                scene_map,
                other,
                camera=camera,
                sizes_m=sizes_m,
                families=families,
                detector=detector,
                progress=progress,
            )
    store.write_tags(out, tags)
    contradicted = 3 if second is not None and second.verdict == "fail" else 0
    if json:
        print_json(tags_json(tags) | ({} if second is None else {"second_map": second_json(second)}))
        return contradicted
    print_tags(tags)
    if second is not None:
        print_second(second)
    for photo in tags.photos:
        if not photo.used:
            logging.getLogger(__name__).warning("%s: not used: %s", photo.file, photo.reason)
    return contradicted


def replay(
    recordings: Positional[tuple[Path, ...]],
    *,
    out: Path,
    map: Path | None = None,
    tags: Path | None = None,
    camera: Path | None = None,
    hand: Path | None = None,
    protocol: str = "paper_real",
    weights: Path | None = None,
    policy_weights: Repeated[tuple[Path, ...]] = (),
    force: bool = False,
) -> int:
    """Replay recordings through every policy of a protocol; print the recall table, exit with 3 on a missed bound.

    Args:
        recordings: bag files, ROS 2 bag folders, or session folders; or dataset folders, which have their own maps
        out: run folder to write
        map: map folder of the recordings
        tags: tags.toml; not needed where a reference topic gives start and truth
        camera: camera.toml to use in place of what the recordings state, as of `tags check --refine-camera`
        hand: hand.toml to use in place of what the recordings state, as of `tags check --refine-hand`
        protocol: name of a protocol, or a .toml file
        weights: folder where the weights of networks are looked for first
        policy_weights: checkpoint of a learned policy, or a folder of them, to use in place of what fieldkit ships; may
            be repeated
        force: replace an existing run
    """
    from fieldkit import protocol as protocols
    from fieldkit.features.weights import weights_first_in
    from fieldkit.store import is_dataset

    rules = protocols.load(protocol)
    sets = [r for r in recordings if is_dataset(r)]
    theirs = {"--map": map, "--tags": tags, "--camera": camera, "--hand": hand}
    _refuse_mixture(recordings, sets, {name: path for name, path in theirs.items() if path is not None})
    with ProgressBars() as progress, weights_first_in(weights):
        if sets:
            from fieldkit.dataset import replay_datasets

            run = replay_datasets(
                sets, protocol=rules, out=out, policy_weights=policy_weights, force=force, progress=progress
            )
        else:
            from fieldkit.replay import replay as replay_recordings

            assert map is not None
            run = replay_recordings(
                recordings,
                map_path=map,
                tags_path=tags,
                camera_path=camera,
                hand_path=hand,
                protocol=rules,
                out=out,
                policy_weights=policy_weights,
                force=force,
                progress=progress,
            )
    _print_recall(run, preset=None)
    return _missed_bounds(run)


def _refuse_mixture(recordings: Sequence[Path], sets: Sequence[Path], given: Mapping[str, Path]) -> None:
    """Raise ReplayError where one does not exist, recordings lack a map, or datasets come with what is not theirs."""
    missing = next((r for r in recordings if not r.exists()), None)
    if missing is not None:
        raise ReplayError(f"{missing}: no such file; expected a recording or a dataset", hint="check the path")
    other = next((r for r in recordings if r not in sets), None)
    if sets and (other is not None or given):
        what = f"{other} is none" if other is not None else f"{' and '.join(given)} given, too"
        hint = "replay datasets alone: they hold their own maps, cameras and poses"
        raise ReplayError(
            f"{sets[0]}: is a dataset; {what}; expected datasets only, without options of recordings", hint=hint
        )
    if not sets and "--map" not in given:
        raise ReplayError(f"{other}: no map was given; expected --map with the map of its scene", hint="give --map")


def score(run: Positional[Path], *, preset: str | None = None, json: bool = False) -> int:
    """Print the recall table of a run; exit with 3 when a bound of the protocol is missed.

    Args:
        run: run folder
        preset: thresholds of another benchmark in place of the protocol's
        json: print JSON
    """
    from fieldkit import scores, store
    from fieldkit.trust import trust

    loaded = store.read_run(run)
    if json:
        print_json(scores.score_dict(loaded, thresholds=None if preset is None else scores.preset(preset)))
    else:
        _print_recall(loaded, preset=preset)
        for item in loaded.excluded:
            logging.getLogger(__name__).warning("excluded %s: %s", item.what, item.reason)
        trusted = trust(loaded, thresholds=None if preset is None else scores.preset(preset))
        if trusted is not None and trusted.warning:
            logging.getLogger(__name__).warning("%s: %s", loaded.path, trusted.warning)
    return _missed_bounds(loaded)


def report(runs: Positional[tuple[Path, ...]], *, out: Path, force: bool = False) -> None:
    """Write one self-contained HTML page about one or more runs.

    Args:
        runs: run folders
        out: report.html to write
        force: replace an existing file
    """
    from fieldkit import store
    from fieldkit.report import write_report

    write_report([store.read_run(run) for run in runs], out, force=force)
    logging.getLogger(__name__).info("wrote %s", out)


def judge(
    session: Positional[Path], *, map: Path, tags: Path | None = None, run: Path | None = None, json: bool = False
) -> None:
    """Compare a synthesized session's truth with what was estimated, after one rigid fit of the map.

    Args:
        session: folder that `sim-bridge synthesize` wrote
        map: map folder
        tags: tags.toml
        run: run folder
        json: print JSON
    """
    from fieldkit.judge import judge as judge_session

    found = judge_session(session, map_path=map, tags_path=tags, run_path=run)
    if json:
        print_json(found)
        return
    console = Console()
    for title in ("gauge", "map", "estimates"):
        if found[title].get("n", 1):
            print_mapping(found[title], title=title)
    for title, keys in (("tags", ("id", "visit")), ("priors", ("visit",))):
        if found[title]:
            table = make_table(*keys, "position m", "rotation deg", "nees", title=title)
            for entry in found[title]:
                numbers = [f"{entry['position_m']:.4f}", f"{entry['rotation_deg']:.3f}", f"{entry['nees']:.1f}"]
                table.add_row(*cells([*(entry[k] or "-" for k in keys), *numbers]))
            console.print(table)
    if found["truths"]:
        console.print(_truth_table(found["truths"]))


def _truth_table(entries: Sequence[dict[str, Any]]) -> Table:
    """Return the errors of the truth, a row per visit; every view is in the JSON."""
    table = make_table("visit", "views", "largest position m", "largest rotation deg", title="truths")
    for visit in dict.fromkeys(e["visit"] for e in entries):
        rows = [e for e in entries if e["visit"] == visit]
        position, rotation = (max(e[key] for e in rows) for key in ("position_m", "rotation_deg"))
        table.add_row(*cells([visit, len(rows), f"{position:.4f}", f"{rotation:.3f}"]))
    return table


COMMANDS: dict[str, Callable[..., Any]] = {
    "inspect": inspect,
    "localize": localize,
    "replay": replay,
    "score": score,
    "report": report,
    "train": train,
    "judge": judge,
}
GROUPS: dict[str, dict[str, Callable[..., Any]]] = {
    "map": {
        "build": map_build,
        "import": map_import,
        "export": map_export,
        "info": map_info,
        "compact": map_compact,
        "appearance": map_appearance,
    },
    "tags": {
        "sheet": tags_sheet,
        "calibrate": tags_calibrate,
        "check": tags_check,
        "import": tags_import,
        "export": tags_export,
    },
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line: exit 0 done, 1 a user's mistake in one line, 2 usage, 3 a missed bound."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s", handlers=[log_handler()])
    try:
        sys.exit(_dispatch(words))
    except FieldkitError as error:
        print(f"fieldkit: {error}", file=sys.stderr)
        sys.exit(1)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except KeyboardInterrupt:
        print("fieldkit: interrupted", file=sys.stderr)
        sys.exit(130)


def _dispatch(words: Sequence[str]) -> int:
    config = (tyro.conf.FlagCreatePairsOff,)
    if words and words[0] in GROUPS:
        group = GROUPS[words[0]]
        result = tyro.extras.subcommand_cli_from_dict(group, prog=f"fieldkit {words[0]}", args=words[1:], config=config)
    else:
        groups = "; ".join(f"fieldkit {group} {', '.join(commands)}" for group, commands in GROUPS.items())
        described = (
            f"Which way should the robot look to know where it is, and how sure are we? More commands: {groups}."
        )
        result = tyro.extras.subcommand_cli_from_dict(
            COMMANDS, prog="fieldkit", description=described, args=list(words), config=config
        )
    return int(result or 0)


def _print_recall(run: Any, *, preset: str | None) -> None:
    from fieldkit import scores

    content = scores.table(run, thresholds=None if preset is None else scores.preset(preset))
    table = Table(*content.header, caption=content.caption)
    for row in content.rows:
        table.add_row(*row)
    Console(width=max(140, Console().width)).print(table)


def _missed_bounds(run: Any) -> int:
    """Log every [[expect]] bound that a run misses and return the exit status."""
    from fieldkit import scores

    misses = scores.check_expect(run)
    for miss in misses:
        logging.getLogger(__name__).error("%s: %s", run.path or run.protocol.name, miss)
    return 3 if misses else 0


if __name__ == "__main__":
    main()
