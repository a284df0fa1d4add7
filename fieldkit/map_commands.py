"""The commands about maps: build, import, export, inspect."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from fieldkit.console import ProgressBars, print_json, print_mapping

# Heavy rooms are imported inside the commands, as in fieldkit.cli

_log = logging.getLogger(__name__)


def map_build(
    source: Positional[Path],
    *,
    out: Path,
    feature: str = "sift",
    matcher: Literal["nearest", "lightglue"] = "nearest",
    weights: Path | None = None,
    scale: Literal["auto", "slam"] = "auto",
    voxel_m: float = 0.04,
    force: bool = False,
) -> None:
    """Build a metric map: SfM landmarks from the images, frame and scale from SLAM poses, surface from depth.

    Args:
        source: mapping folder (rig.toml) or image folder (images/, camera.toml, poses.txt, depth/)
        out: map folder to write
        feature: local feature of landmarks: sift, sift_l2, akaze, aliked, xfeat, superpoint
        matcher: how pairs of mapping images are matched: nearest neighbours, or lightglue (aliked only, slow)
        weights: folder where the weights of networks are looked for first
        scale: auto refines the SLAM poses' scale by calibrated depth images; slam does not
        voxel_m: edge length of a voxel of the surface
        force: replace an existing map
    """
    from fieldkit import maps

    options = maps.MapOptions(matcher=matcher, weights=weights, scale=scale, voxel_m=voxel_m)
    with ProgressBars() as progress:
        built = maps.build_map(source, out, feature=feature, force=force, options=options, progress=progress)
    for warning in built.warnings:
        _log.warning("%s: %s", source, warning)
    print_mapping(maps.map_info(out), title=f"{out}: {built.n_registered} of {built.n_images} images registered")


def map_info(path: Positional[Path], *, json: bool = False) -> None:
    """Say what a map holds and how well it was aligned.

    Args:
        path: map folder
        json: print JSON
    """
    from fieldkit import maps

    found = maps.map_info(path)
    print_json(found) if json else print_mapping(found, title=str(path))


def map_compact(path: Positional[Path], *, out: Path, force: bool = False) -> None:
    """Write a small copy of a map: one descriptor per landmark, 8 bit, and a thinned surface.

    Args:
        path: map folder
        out: map folder to write
        force: replace an existing map
    """
    from fieldkit import maps

    maps.compact_map(path, out, force=force)
    print_mapping(maps.map_info(out), title=str(out))
