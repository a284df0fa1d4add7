"""`build_map`: from a SOURCE folder to a map folder, one arrow per step."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import cast

import numpy as np
import pycolmap
from numpy.typing import NDArray

import fieldkit
from fieldkit.errors import MapError, SurfaceError
from fieldkit.features import Extractor, Features, feature_name, open_extractor
from fieldkit.features.appearance import Appearance, open_appearance
from fieldkit.features.matchers import PairMatcher, open_matcher
from fieldkit.features.used import weight_files
from fieldkit.frames import Pose
from fieldkit.maps.io import (
    AlignmentEntry,
    MapFile,
    SurfaceEntry,
    content_digest,
    write_features,
    write_map_file,
)
from fieldkit.maps.landmarks import LandmarkRules, good_landmarks, model_arrays
from fieldkit.maps.metric.align import Alignment, Similarity
from fieldkit.maps.metric.choosing import look_for_tags, refuse_unscaled
from fieldkit.maps.metric.depth import depth_views
from fieldkit.maps.options import MapOptions, Progress
from fieldkit.maps.record import write_record
from fieldkit.maps.sources.checking import check_images, content
from fieldkit.maps.sources.source import MapSource, SourceImage, read_depth, read_image, without_poses
from fieldkit.maps.sources.streamrecorder import open_source
from fieldkit.maps.stages import Stages, resumed, shares
from fieldkit.maps.structure.pairs import Pair, choose_pairs, match_pairs
from fieldkit.maps.structure.placing import Matched, place_images
from fieldkit.maps.structure.plausible import plausible_matches
from fieldkit.maps.structure.sfm import threads
from fieldkit.maps.structure.strays import strays
from fieldkit.maps.whole import FILE, write_global
from fieldkit.store import atomic_folder, digest, library_versions
from fieldkit.store.files import refuse_existing
from fieldkit.surface import fuse_depth, read_ply, write_ply
from fieldkit.types import Surface

# Pairs whose matches are kept together: what a killed process loses at most
_SHARE = 500


@dataclasses.dataclass(frozen=True)
class MapReport:
    """What became of a SOURCE: counts, alignment, seconds per step, and what a user should know."""

    path: str
    digest: str
    n_images: int
    n_registered: int
    n_landmarks: int
    alignment: Alignment
    has_surface: bool
    seconds: Mapping[str, float]
    warnings: tuple[str, ...]


def build_map(
    source: Path | MapSource,
    out: Path,
    *,
    feature: str = "sift",
    force: bool = False,
    options: MapOptions | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> MapReport:
    """Build a map folder from a rig folder or an image folder: features, SfM, metric frame, landmarks, surface.

    SfM starts from the images; SLAM poses only rule out matches between places that look alike. What gives scale,
    frame and gravity afterwards is for ``options`` to say; poses that are known are taken as they are.
    The same source and seed give the same map, whatever the number of processors, and however often the build was
    killed: finished stages are kept in ``.<out>.building`` beside ``out``, and the same command goes on from them.
    ``progress(step, done, total)`` is called along the way. Raises MapError when the source is incomplete, too few
    images register, or nothing gives a metric frame, and StoreError when ``out`` is in the way; nothing is left behind.
    """
    options, out, feature = MapOptions() if options is None else options, Path(out), feature_name(feature)
    tell: Progress = progress or (lambda step, done, total: None)
    refuse_existing(out, force=force, marker="map.toml", kind="folder")
    walk = source if isinstance(source, MapSource) else open_source(Path(source))
    refuse_unscaled(walk, options)
    check_images(walk)
    extractor, matcher, appearance = _opened(feature, options)
    walk = without_poses(walk) if options.poses == "none" else walk
    with resumed(out, _key(walk, feature, options, seed)) as stages:
        with stages.timed("tags") if options.tag_sizes_m else contextlib.nullcontext():
            tags = look_for_tags(walk, options, progress=tell)
        with stages.timed("extract"):
            features = _extract_all(walk, extractor, stages, options, tell)
        with stages.timed("match"):
            found = _match_all(walk, features, matcher, stages, options, seed, tell)
        placing = place_images(dataclasses.replace(found, tags=tags), stages, options, seed=seed, progress=tell)
        with stages.timed("align"):
            model, alignment = placing.model, placing.alignment
            mapped, left_out = _placed(walk, model, placing.sfm_poses, alignment)
            n_landmarks = _finish_model(walk, model, alignment.map_from_sfm, options.landmarks)
        with stages.timed("surface"):
            surface, missing = _surface(walk, mapped, stages, options, tell)
        counts = (len(walk.images), len(mapped), n_landmarks)
        told = (*walk.notes, *found.disbelieved, *placing.warnings, *left_out, *missing)
        with stages.timed("write"), atomic_folder(out, force=force, marker="map.toml") as folder:
            _write(folder, walk, model, features, mapped, surface)
            _write_global(folder, walk, mapped, appearance, options, tell)
            made = content_digest(folder)
            places = alignment_entry(alignment), _surface_entry(surface, options)
            write_map_file(folder, MapFile(1, made, feature, *counts, *places))
            _write_record(folder, stages, options, told)
    return MapReport(str(out), made, *counts, alignment, surface is not None, dict(stages.seconds), told)


def _opened(feature: str, options: MapOptions) -> tuple[Extractor, PairMatcher, Appearance | None]:
    """Open all networks before any work: weights that are missing are told at once."""
    extractor = open_extractor(
        feature, weights=options.weights, max_keypoints=options.max_keypoints, max_side_px=options.max_image_size
    )
    matcher = open_matcher(feature, options.matcher, ratio=options.ratio, weights=options.weights)
    if options.retrieval == "own":
        return extractor, matcher, None
    return extractor, matcher, open_appearance(options.retrieval, weights=options.weights)


def _key(walk: MapSource, feature: str, options: MapOptions, seed: int) -> str:
    """Return the digest of all that a map is made of, by which a build knows its own stages."""
    networks = weight_files(feature, matcher=options.matcher, retrieval=options.retrieval, folder=options.weights)
    said = repr(options), repr((seed, library_versions()))
    return digest(feature, *said, *networks, *_program(), *content(walk))


def _program() -> list[Path]:
    """Return fieldkit's own files: its version alone does not tell one state of a checkout from the next."""
    return sorted(Path(fieldkit.__file__).parent.rglob("*.py"))


def _extract_all(
    walk: MapSource, extractor: Extractor, stages: Stages, options: MapOptions, tell: Progress
) -> list[Features]:
    def make(image: SourceImage) -> dict[str, NDArray[np.generic]]:
        found = extractor.extract(read_image(image, colour=extractor.kind.colour))
        return {
            "keypoints": found.keypoints_px,
            "scores": found.scores,
            "scales": found.scales,
            "descriptors": found.descriptors,
        }

    def one(index: int) -> Features:
        stored = stages.arrays(f"features/{index:06d}", lambda: make(walk.images[index]))
        keypoints, scores, scales = (stored[name].astype(np.float32) for name in ("keypoints", "scores", "scales"))
        return Features(keypoints, scores, scales, cast(NDArray[np.uint8], stored["descriptors"]))

    found = []
    with ThreadPoolExecutor(options.n_threads or threads()) as pool:
        for done, result in enumerate(pool.map(one, range(len(walk.images))), start=1):
            found.append(result)
            tell("extract", done, len(walk.images))
    return found


def _match_all(
    walk: MapSource,
    features: list[Features],
    matcher: PairMatcher,
    stages: Stages,
    options: MapOptions,
    seed: int,
    tell: Progress,
) -> Matched:
    """Match the chosen pairs of images and keep what SLAM's poses allow; say so where SLAM is not believed."""
    n_similar = matcher.n_similar if options.n_similar is None else options.n_similar
    chosen = stages.arrays(
        "pairs",
        lambda: {
            "pairs": np.array(
                choose_pairs(walk.images, features, seed=seed, n_similar=n_similar, n_neighbours=options.n_neighbours),
                dtype=np.int64,
            ).reshape(-1, 2)
        },
    )["pairs"]
    pairs: list[Pair] = [(int(a), int(b)) for a, b in chosen]
    matches: list[NDArray[np.uint32]] = []
    for number, share in shares(pairs, _SHARE):
        before = len(matches)

        def told(done: int, before: int = before) -> None:
            tell("match", before + done, len(pairs))

        make = functools.partial(_matched, walk, share, features, matcher, told, options.n_threads or threads())
        stored = stages.arrays(f"matches/{number:06d}", make)
        borders = np.concatenate([[0], np.cumsum(stored["count"].astype(np.int64))])
        matches += [stored["matches"][a:b].astype(np.uint32) for a, b in itertools.pairwise(borders)]
        tell("match", len(matches), len(pairs))
    found = Matched(walk, features, pairs, matches)
    return found if options.slam is None else _plausible(found, options)


def _matched(
    walk: MapSource,
    pairs: Sequence[Pair],
    features: list[Features],
    matcher: PairMatcher,
    tell: Callable[[int], None],
    n_threads: int,
) -> dict[str, NDArray[np.generic]]:
    sizes = [(image.camera.width, image.camera.height) for image in walk.images]
    made = match_pairs(pairs, features, sizes=sizes, matcher=matcher, progress=tell, n_threads=n_threads)
    return {"count": np.array([len(m) for m in made]), "matches": np.concatenate(made)}


def _plausible(found: Matched, options: MapOptions) -> Matched:
    assert options.slam is not None
    plausible = plausible_matches(found.walk.images, found.features, found.pairs, found.matches, rules=options.slam)
    share = sum(map(len, plausible)) / max(sum(map(len, found.matches)), 1)
    if share < options.slam.least_share:
        told = f"the poses fit {100 * share:.0f} % of the matches: not used to rule out the others"
        return dataclasses.replace(found, disbelieved=(told,))
    return dataclasses.replace(found, matches=plausible)


def _placed(
    walk: MapSource, model: pycolmap.Reconstruction, sfm_poses: Mapping[int, Pose], alignment: Alignment
) -> tuple[dict[int, Pose], list[str]]:
    """Return map_from_cam by image index; images that SfM misplaced leave the model, with one warning."""
    mapped = {i: alignment.map_from_sfm.pose(p) for i, p in sfm_poses.items()}
    wrong = strays(walk.images, mapped, threshold_m=alignment.threshold_m)
    for frame_id in sorted({model.image(i + 1).frame_id for i in wrong}):
        model.deregister_frame(frame_id)
    for i in wrong:
        del mapped[i]
    if not wrong:
        return mapped, []
    names = ", ".join(walk.images[i].name for i in wrong[:4])
    return mapped, [f"{len(wrong)} images left out, misplaced where things look alike: {names}"]


def _finish_model(
    walk: MapSource, model: pycolmap.Reconstruction, map_from_sfm: Similarity, rules: LandmarkRules
) -> int:
    """Bring the model into the map frame and take out points that are no landmarks; return how many are left."""
    model.transform(
        pycolmap.Sim3d(
            map_from_sfm.scale, pycolmap.Rotation3d(map_from_sfm.rotation.as_quat()), map_from_sfm.translation
        )
    )
    arrays = model_arrays(model)
    good = good_landmarks(arrays, rules)
    for point_id in arrays.point_ids[~good]:
        model.delete_point3D(int(point_id))
    if not good.any():
        raise MapError(
            f"{walk.path}: none of {len(good)} reconstructed points is seen by {rules.min_images} images "
            f"from {rules.min_distance_m:g}..{rules.max_distance_m:g} m",
            hint="take more overlapping images, and check the unit of the poses (m)",
        )
    return int(good.sum())


def _surface(
    walk: MapSource, mapped: Mapping[int, Pose], stages: Stages, options: MapOptions, tell: Progress
) -> tuple[Surface | None, list[str]]:
    if walk.depth_camera is None:
        return None, ["no depth images: the map has no surface, and occlusion cannot be computed"]
    camera, views = walk.depth_camera, []
    for frame, map_from_depth in depth_views(walk, mapped):
        views.append((map_from_depth, lambda frame=frame: read_depth(frame, camera)))
    if not views:
        return None, ["no depth image belongs to a registered image: the map has no surface"]

    def fuse(path: Path) -> None:
        surface = fuse_depth(
            views,
            camera,
            voxel_m=options.voxel_m,
            truncation_m=options.truncation_voxels * options.voxel_m,
            max_depth_m=options.max_depth_m,
            progress=lambda n: tell("surface", n, len(views)),
        )
        write_ply(path, surface)

    try:
        return read_ply(stages.put("surface.ply", fuse)), []
    except SurfaceError as error:
        raise SurfaceError(f"{walk.path / 'depth'}: {error.message}", hint=error.hint) from error


def _write(
    folder: Path,
    walk: MapSource,
    model: pycolmap.Reconstruction,
    features: list[Features],
    mapped: Mapping[int, Pose],
    surface: Surface | None,
) -> None:
    (folder / "sparse").mkdir()
    model.write_binary(folder / "sparse")
    images = {walk.images[i].name: i for i in mapped}
    write_features(
        folder / "features.h5",
        {name: features[i] for name, i in images.items()},
        {name: (walk.images[i].camera.width, walk.images[i].camera.height) for name, i in images.items()},
    )
    if surface is not None:
        write_ply(folder / "surface.ply", surface)


def _write_global(
    folder: Path,
    walk: MapSource,
    mapped: Mapping[int, Pose],
    appearance: Appearance | None,
    options: MapOptions,
    tell: Progress,
) -> None:
    if appearance is None:
        return
    vectors = {}
    for done, i in enumerate(mapped, start=1):
        vectors[walk.images[i].name] = appearance.whole(read_image(walk.images[i], colour=True))
        tell("describe", done, len(mapped))
    write_global(folder / FILE, options.retrieval, vectors)


def _write_record(folder: Path, stages: Stages, options: MapOptions, told: Sequence[str]) -> None:
    if options.keep_record:
        seconds, versions = dict(stages.seconds), library_versions()
        write_record(folder, seconds, versions=versions, options=repr(options), told=told)


def alignment_entry(a: Alignment) -> AlignmentEntry:
    """Return [alignment] of map.toml."""
    return AlignmentEntry(
        a.source,
        a.map_from_sfm.scale,
        a.n_used,
        a.n_total,
        a.rms_m,
        a.p95_m,
        a.gravity_deg,
        a.verdict,
        scale_sigma=a.scale_sigma,
        gravity_from=a.gravity_from,
        reprojection_px=a.reprojection_px,
        match_share=a.match_share,
    )


def _surface_entry(surface: Surface | None, options: MapOptions) -> SurfaceEntry | None:
    if surface is None:
        return None
    return SurfaceEntry(surface.voxel_m, options.truncation_voxels * options.voxel_m, "surface.ply")
