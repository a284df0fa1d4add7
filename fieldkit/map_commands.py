"""The commands about maps: build, import, export, inspect."""

from __future__ import annotations

import logging
import shlex
from pathlib import Path
from typing import Literal

from tyro.conf import Positional
from tyro.conf import UseAppendAction as Repeated

from fieldkit.console import ProgressBars, print_json, print_mapping

# Heavy rooms are imported inside the commands, as in fieldkit.cli

_log = logging.getLogger(__name__)


def map_build(
    source: Positional[Path],
    *,
    out: Path,
    feature: str = "sift",
    matcher: Literal["nearest", "lightglue"] = "nearest",
    retrieval: Literal["own", "efficientnet", "dinov2"] = "own",
    appearance: Literal["none", "efficientnet", "dinov2"] = "none",
    weights: Path | None = None,
    poses: Literal["slam", "known", "none"] = "slam",
    scale: Literal["auto", "slam", "tags", "depth"] = "auto",
    size_m: Repeated[tuple[str, ...]] = (),
    family: Repeated[tuple[str, ...]] = (),
    voxel_m: float = 0.04,
    force: bool = False,
) -> None:
    """Build a metric map: SfM landmarks from the images; scale and frame from SLAM poses, tags or depth; a surface.

    A build that was interrupted goes on when the same command is given again.

    Args:
        source: mapping folder (rig.toml) or image folder (images/, camera.toml, poses.txt, depth/)
        out: map folder to write
        feature: local feature of landmarks: sift, sift_l2, akaze, aliked, aliked_n16, aliked_t16, xfeat, superpoint
        matcher: how pairs of mapping images are matched: nearest neighbours, or lightglue (aliked, aliked_n16; slow)
        retrieval: by what images to be localized find mapping images: descriptors of their landmarks, or a network's
        appearance: network whose view of the landmarks the map keeps, for the policies with appearance
        weights: folder where the weights of networks are looked for first
        poses: slam gives scale, frame and gravity; known takes the poses as they are; none does not read them
        scale: from what; auto takes tags where --size-m is given, else calibrated depth images, else SLAM
        size_m: edge in m of the black square of AprilTags in the mapping images, or ID:SIZE; may be repeated
        family: tag family, by default tag36h11; may be repeated
        voxel_m: edge length of a voxel of the surface
        force: replace an existing map
    """
    from fieldkit import maps
    from fieldkit.calibrate import parse_sizes
    from fieldkit.features.appearance import open_appearance

    options = maps.MapOptions(
        matcher=matcher,
        retrieval=retrieval,
        weights=weights,
        poses=poses,
        scale=scale,
        tag_sizes_m=parse_sizes(size_m) if size_m else {},
        tag_families=family or ("tag36h11",),
        voxel_m=voxel_m,
    )
    if appearance != "none":
        # Weights that are missing are missed before hours of work
        open_appearance(appearance, weights=weights)
    try:
        with ProgressBars() as progress:
            built = maps.build_map(source, out, feature=feature, force=force, options=options, progress=progress)
    except KeyboardInterrupt:
        _log.warning("%s: interrupted; the same command goes on where it stopped", out)
        raise
    for warning in built.warnings:
        _log.warning("%s: %s", source, warning)
    if appearance != "none":
        _add_appearance(out, source, network=appearance, weights=weights)
    print_mapping(maps.map_info(out), title=f"{out}: {built.n_registered} of {built.n_images} images registered")


def _add_appearance(
    out: Path, source: Path, *, network: Literal["efficientnet", "dinov2"], weights: Path | None
) -> None:
    """Add its appearance to a map that was just built; where that stops, the same command would refuse the map."""
    from fieldkit import maps

    try:
        with ProgressBars() as progress:
            maps.add_appearance(out, source, network=network, weights=weights, progress=progress)
    except BaseException:
        _log.warning(
            "%s: the map is done, without its appearance; add it with %s", out, _adding(out, source, network, weights)
        )
        raise


def _adding(out: Path, source: Path, network: str, weights: Path | None) -> str:
    """Return the command that adds a network's view to a map."""
    options = ["--source", str(source)]
    options += [] if network == "efficientnet" else ["--network", network]
    options += [] if weights is None else ["--weights", str(weights)]
    return f"`{shlex.join(['fieldkit', 'map', 'appearance', str(out), *options])}`"


def map_import(
    model: Positional[Path],
    *,
    out: Path,
    images: Path | None = None,
    feature: str = "sift",
    weights: Path | None = None,
    poses: Path | None = None,
    scale: float | None = None,
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = "z",
    size_m: Repeated[tuple[str, ...]] = (),
    family: Repeated[tuple[str, ...]] = (),
    depth: Path | None = None,
    depth_camera: Path | None = None,
    features: Path | None = None,
    database: Path | None = None,
    mesh: Path | None = None,
    mesh_transform: Path | None = None,
    mesh_unit: Literal["m", "cm", "mm", "ft", "in"] = "m",
    mesh_up: Literal["y", "z"] = "z",
    mesh_voxel_m: float | None = None,
    min_images: int = 4,
    retriangulate: bool = False,
    force: bool = False,
) -> None:
    """Make a map of a COLMAP or hloc model: metric frame, landmarks with descriptors, and a mesh as surface.

    Args:
        model: COLMAP model, binary or text, such as sparse/0 or hloc's sfm
        out: map folder to write
        images: folder that the model's image names start from
        feature: local feature of the descriptors
        weights: folder where the weights of networks are looked for first
        poses: TUM poses of the model's images, z up: give scale and frame
        scale: metres per unit of the model, where there are no poses: 1 for a metric model
        up: axis of the model that points up, with --scale
        size_m: edge length in m of the AprilTags in the images, or ID:SIZE for one tag; may be repeated
        family: tag family, by default tag36h11; may be repeated
        depth: folder of the images' depth images, 16-bit mm, which give the scale
        depth_camera: camera.toml of the depth images
        features: features.h5 with which hloc made the model; by default descriptors are extracted from the images
        database: COLMAP database with which the model was made
        mesh: PLY, OBJ, GLB or STL file as surface
        mesh_transform: file with map_from_mesh: a 4x4 matrix or a TUM line
        mesh_unit: unit of the mesh
        mesh_up: axis of the mesh that points up
        mesh_voxel_m: resolution of the mesh; by default its median edge, within 0.01..0.10 m
        min_images: images that have to see a point to make it a landmark
        retriangulate: keep the model's cameras and poses only, and find landmarks by --feature anew
        force: replace an existing map
    """
    from fieldkit import maps
    from fieldkit.calibrate import parse_sizes

    meshed = None if mesh is None else maps.ForeignMesh(mesh, mesh_transform, mesh_unit, mesh_up, mesh_voxel_m)
    sizes_m = parse_sizes(size_m) if size_m else {}
    frame = maps.FrameOptions(poses, scale, up, sizes_m, family or ("tag36h11",), depth, depth_camera)
    rules = maps.LandmarkRules(min_images=min_images)
    options = maps.ImportOptions(feature, frame, features, database, meshed, rules, weights, retriangulate)
    with ProgressBars() as progress:
        built = maps.import_map(model, out, images=images, options=options, force=force, progress=progress)
    for warning in built.warnings:
        _log.warning("%s: %s", model, warning)
    print_mapping(maps.map_info(out), title=f"{out}: {built.n_landmarks} landmarks of {built.n_registered} images")


def map_export(
    path: Positional[Path],
    *,
    to: Literal["colmap", "hloc", "tum"],
    out: Path,
    force: bool = False,
) -> None:
    """Write a map as a COLMAP model, as hloc's model and features, or as TUM poses of its images.

    Args:
        path: map folder
        to: tool or format
        out: folder to write
        force: replace an existing export
    """
    from fieldkit import maps

    written = maps.export_map(path, out, to=to, force=force)
    _log.info(
        "wrote %s: %d images, %d landmarks: %s", out, written.n_images, written.n_landmarks, ", ".join(written.files)
    )


def map_info(path: Positional[Path], *, json: bool = False) -> None:
    """Say what a map holds and how well it was aligned, with a warning where its files are not those of its digest.

    Args:
        path: map folder
        json: print JSON
    """
    from fieldkit import maps

    found = maps.map_info(path)
    print_json(found) if json else print_mapping(found, title=str(path))
    if (doubt := maps.changed(path)) is not None:
        _log.warning("%s", doubt)


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


def map_appearance(
    path: Positional[Path],
    *,
    source: Path,
    network: Literal["efficientnet", "dinov2"] = "efficientnet",
    weights: Path | None = None,
    force: bool = False,
) -> None:
    """Add to a map what a network of appearance sees at its landmarks, as the policies with appearance need it.

    Args:
        path: map folder
        source: folder with the mapping images from which the map was built
        network: network of appearance
        weights: folder where the weights of networks are looked for first
        force: replace what the map has of this network
    """
    from fieldkit import maps

    with ProgressBars() as progress:
        maps.add_appearance(path, source, network=network, weights=weights, force=force, progress=progress)
    print_mapping(maps.map_info(path), title=str(path))
