"""The commands about tags that need neither photos nor a map: sheets to print, files of other tools."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from rich.console import Console
from tyro.conf import Positional, arg
from tyro.conf import UseAppendAction as Repeated

from fieldkit.console import cells, make_table, print_json

if TYPE_CHECKING:
    from fieldkit.tags.formats import Imported
    from fieldkit.types import Excluded

# Heavy rooms are imported inside the commands, as in fieldkit.cli

_Format = Literal["apriltag_ros", "tagslam", "spot"]
_log = logging.getLogger(__name__)


def tags_sheet(
    *,
    ids: Annotated[tuple[int, ...], arg(aliases=("--id",))],
    size_m: float,
    out: Path,
    family: str = "tag36h11",
    paper: str = "a4",
    force: bool = False,
) -> None:
    """Write tags to print: a PDF at true scale, one tag per page, with a ruler to check the print.

    Args:
        ids: ids of the tags
        size_m: edge length of the black square in m
        out: PDF to write
        family: tag36h11, tag36h10, tag25h9 or tag16h5
        paper: a4, a3, a2, letter or tabloid
        force: replace an existing file
    """
    from fieldkit import store
    from fieldkit.tags.sheets import write_sheets

    store.refuse_existing(out, force=force, kind="file")
    write_sheets(out, ids, size_m=size_m, family=family, paper=paper)
    _log.info("wrote %s: print it at 100 %% and check the ruler", out)


def tags_import(
    file: Positional[Path],
    *,
    format: Annotated[_Format, arg(name="from", aliases=("--format",))],
    out: Path,
    map: Path | None = None,
    family: str = "tag36h11",
    frame: str | None = None,
    size_m: Repeated[tuple[str, ...]] = (),
    sigma_m: float | None = None,
    sigma_deg: float | None = None,
    json: bool = False,
    force: bool = False,
) -> None:
    """Turn another tool's tag file into tags.toml; the frame of that file is taken for the map's.

    Args:
        file: tags.yaml of apriltag_ros, tagslam.yaml or poses.yaml of TagSLAM, JSON of Spot's fiducials
        format: the tool that wrote the file
        out: tags.toml to write
        map: map folder in whose frame the poses are; replay needs it
        family: family of the tags, where the file does not say
        frame: bundle (apriltag_ros), body (tagslam) or frame (spot; vision when not given) to take
        size_m: edge length of the black square in m where the file has none, or ID:SIZE for one tag; may be repeated
        sigma_m: standard deviation of the positions per axis in m, in place of the file's
        sigma_deg: standard deviation of the rotations per axis in deg, in place of the file's
        json: print JSON
        force: replace an existing file
    """
    from fieldkit import maps, store
    from fieldkit.calibrate import parse_sizes
    from fieldkit.tags.formats import ImportOptions, import_tags

    store.refuse_existing(out, force=force, kind="file")
    options = ImportOptions(
        family=family,
        frame=frame,
        sizes_m=parse_sizes(size_m) if size_m else {},
        sigma_m=sigma_m,
        sigma_deg=sigma_deg,
        map_digest="" if map is None else str(maps.map_info(map)["digest"]),
    )
    found = import_tags(file, format, options=options)
    store.write_tags(out, found.tags)
    if map is None:
        _log.warning("%s: belongs to no map; import it with --map before a replay", out)
    for warning in found.warnings:
        _log.warning("%s: %s", file, warning)
    _log_left_out(file, found.left_out)
    _print_imported(out, found, json=json)


def _print_imported(out: Path, found: Imported, *, json: bool) -> None:
    if json:
        left_out = [{"what": e.what, "reason": e.reason} for e in found.left_out]
        tags = [
            {"id": t.id, "family": t.family, "size_m": t.size_m, "position_m": t.map_from_tag.translation,
             "quaternion_xyzw": t.map_from_tag.rotation.as_quat(canonical=True)}
            for t in found.tags.tags
        ]  # fmt: skip
        print_json({"version": 1, "tags": tags, "left_out": left_out, "warnings": found.warnings})
        return
    table = make_table("tag", "family", "size m", "x m", "y m", "z m", title=f"{out}: {len(found.tags.tags)} tags")
    for t in found.tags.tags:
        position = [f"{v:.3f}" for v in t.map_from_tag.translation]
        table.add_row(*cells([t.id, t.family, f"{t.size_m:g}", *position]))
    Console().print(table)


def _log_left_out(path: Path, left_out: Sequence[Excluded]) -> None:
    """Log one line per reason."""
    for reason in dict.fromkeys(item.reason for item in left_out):
        what = ", ".join(item.what for item in left_out if item.reason == reason)
        _log.warning("%s: left out: %s: %s", path, what, reason)


def tags_export(
    tags: Positional[Path],
    *,
    format: Annotated[_Format, arg(name="to", aliases=("--format",))],
    out: Path,
    force: bool = False,
) -> None:
    """Write the tags of tags.toml as another tool's file, in the map frame.

    Args:
        tags: tags.toml
        format: the tool that is to read the file
        out: file to write
        force: replace an existing file
    """
    from fieldkit import store
    from fieldkit.tags.formats import export_tags

    store.refuse_existing(out, force=force, kind="file")
    loaded = store.read_tags(tags)
    written = export_tags(loaded, format, out=out)
    for tag in loaded.tags:
        if tag.verdict == "fail":
            _log.warning("%s: tag %d is exported though its verdict is fail", tags, tag.id)
    _log_left_out(tags, written.left_out)
    _log.info("wrote %s: %d tags", out, len(loaded.tags) - len(written.left_out))
