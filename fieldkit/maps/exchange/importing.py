"""`import_map`: a COLMAP or hloc model becomes a map folder: metric frame, landmarks, descriptors, surface."""

from __future__ import annotations

import dataclasses
import itertools
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import MapError
from fieldkit.features import Features, feature_name
from fieldkit.frames import Pose
from fieldkit.maps.build import MapReport, alignment_entry, build_map
from fieldkit.maps.colmap import model_folder, read_model, write_model
from fieldkit.maps.exchange.describing import database_descriptors, hloc_descriptors, image_descriptors, refuse_missing
from fieldkit.maps.exchange.import_frame import FrameOptions, metric_alignment, posed_walk
from fieldkit.maps.exchange.meshes import ForeignMesh, fit_mesh
from fieldkit.maps.io import (
    MapFile,
    SurfaceEntry,
    content_digest,
    positive,
    read_map_file,
    write_features,
    write_map_file,
)
from fieldkit.maps.landmarks import LandmarkRules, Model, good_landmarks
from fieldkit.maps.metric.align import Alignment, Similarity
from fieldkit.maps.metric.choosing import worst
from fieldkit.maps.options import MapOptions, Progress
from fieldkit.maps.record import write_record
from fieldkit.maps.sources.source import MapSource
from fieldkit.store import atomic_folder, library_versions, refuse_existing
from fieldkit.surface import write_ply
from fieldkit.types import Surface


@dataclasses.dataclass(frozen=True)
class ImportOptions:
    """Where a model's frame, descriptors and surface come from.

    ``features`` is hloc's features.h5, ``database`` COLMAP's; without either descriptors are extracted from the images.
    ``retriangulate`` keeps cameras and poses alone: landmarks are found anew, by any feature.
    Raises MapError when the scale is not positive or more than one source is given for one thing.
    """

    feature: str = "sift"
    frame: FrameOptions = dataclasses.field(default_factory=FrameOptions)
    features: Path | None = None
    database: Path | None = None
    mesh: ForeignMesh | None = None
    landmarks: LandmarkRules = dataclasses.field(default_factory=LandmarkRules)
    weights: Path | None = None
    retriangulate: bool = False

    def __post_init__(self) -> None:
        frame = self.frame
        if frame.scale is not None:
            positive("scale", frame.scale)
        for first, second, given in (
            ("poses", "scale", (frame.poses, frame.scale)),
            ("features", "database", (self.features, self.database)),
        ):
            if None not in given:
                raise MapError(f"--{first} and --{second} are both given; expected one", hint="leave one of them away")
        if self.retriangulate and any(v is not None for v in (self.features, self.database, self.mesh)):
            raise MapError(
                "--retriangulate finds features of its own; expected neither --features, --database nor --mesh",
                hint="for a mesh import the new map again: --scale 1 --features NEW.map/features.h5 --mesh MESH",
            )


def import_map(
    model_path: Path,
    out: Path,
    *,
    images: Path | None = None,
    options: ImportOptions | None = None,
    force: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> MapReport:
    """Make a map folder of a COLMAP model (binary or text, any version; also as hloc leaves it in ``sfm/``).

    Keypoints that observe no landmark are left out. ``images`` is needed where descriptors are extracted. Raises
    MapError when the model, its descriptors, images, poses or mesh cannot be used, or its scale is unknown, and
    StoreError when ``out`` is in the way; nothing is left behind.
    """
    options = ImportOptions() if options is None else options
    tell: Progress = progress or (lambda step, done, total: None)
    options = dataclasses.replace(options, feature=feature_name(options.feature))
    refuse_existing(Path(out), force=force, marker="map.toml", kind="folder")
    seconds, start = {}, time.perf_counter()
    folder = model_folder(model_path)
    found = read_model(folder)
    _refuse_useless(folder, found, images, options)
    alignment, warnings = metric_alignment(folder, found, images, options.frame, seed=seed, progress=tell)
    model = _in_map(found, alignment.map_from_sfm)
    if options.retriangulate:
        assert images is not None
        rebuilt = _rebuilt(posed_walk(folder, model, images), out, options, force=force, seed=seed, progress=tell)
        return _judged(rebuilt, alignment, warnings)
    model = _landmarks_of(folder, model, options.landmarks)
    seconds["read"], start = time.perf_counter() - start, time.perf_counter()
    descriptors = _descriptors(model, images, options, tell)
    warnings += _described(folder, model, descriptors)
    seconds["describe"], start = time.perf_counter() - start, time.perf_counter()
    surface, doubts = (None, []) if options.mesh is None else fit_mesh(options.mesh, model)
    warnings += doubts if surface is not None else ["no mesh: the map has no surface, and occlusion cannot be computed"]
    seconds["surface"], start = time.perf_counter() - start, time.perf_counter()
    counts = len(found.image_names), len(model.image_names), len(model.xyz)
    with atomic_folder(Path(out), force=force, marker="map.toml") as work:
        write_landmark_map(work, model, descriptors, surface)
        digest = content_digest(work)
        write_map_file(
            work, MapFile(1, digest, options.feature, *counts, alignment_entry(alignment), _surface_entry(surface))
        )
        write_record(work, seconds, versions=library_versions(), options=repr(options), told=warnings)
    seconds["write"] = time.perf_counter() - start
    return MapReport(str(out), digest, *counts, alignment, surface is not None, seconds, tuple(warnings))


def _rebuilt(
    walk: MapSource, out: Path, options: ImportOptions, *, force: bool, seed: int, progress: Progress
) -> MapReport:
    """Find landmarks anew from images whose poses are the model's."""
    building = MapOptions(poses="known", weights=options.weights, landmarks=options.landmarks)
    return build_map(walk, out, feature=options.feature, force=force, options=building, seed=seed, progress=progress)


def _judged(rebuilt: MapReport, framed: Alignment, warnings: list[str]) -> MapReport:
    """Say in the map that its poses are as good as what gave the model its frame, and no better than they fit.

    map.toml is not part of what the digest covers.
    """
    alignment = dataclasses.replace(
        framed,
        verdict=worst(framed.verdict, rebuilt.alignment.verdict),
        reprojection_px=rebuilt.alignment.reprojection_px,
        match_share=rebuilt.alignment.match_share,
    )
    path = Path(rebuilt.path)
    write_map_file(path, msgspec.structs.replace(read_map_file(path), alignment=alignment_entry(alignment)))
    return dataclasses.replace(rebuilt, alignment=alignment, warnings=(*warnings, *rebuilt.warnings))


def _refuse_useless(folder: Path, model: Model, images: Path | None, options: ImportOptions) -> None:
    empty = not len(model.xyz) and not options.retriangulate
    if not model.image_names or empty or (not len(model.observation_landmark) and not options.retriangulate):
        raise MapError(
            f"{folder}: {len(model.image_names)} registered images, {len(model.xyz)} points; expected both",
            hint="a model without points can be triangulated first: `colmap point_triangulator`",
        )
    if len(set(model.image_names)) < len(model.image_names):
        twice = next(n for n in model.image_names if model.image_names.count(n) > 1)
        raise MapError(f"{folder}: two images are called {twice}; expected one", hint="rename one of them")
    if images is not None:
        refuse_missing(images, model)
    elif options.features is None and options.database is None:
        raise MapError(
            f"{folder}: a model has no descriptors; expected the images to extract them from, or the features",
            hint="give --images DIR, or --features features.h5 of hloc, or --database database.db of COLMAP",
        )


def _in_map(model: Model, map_from_sfm: Similarity) -> Model:
    poses: tuple[Pose, ...] = tuple(map_from_sfm.pose(p) for p in model.map_from_image)
    return dataclasses.replace(model, xyz=map_from_sfm.points(model.xyz), map_from_image=poses)


def _landmarks_of(folder: Path, model: Model, rules: LandmarkRules) -> Model:
    """Keep the points that are landmarks; raises MapError when there is none."""
    good = good_landmarks(model, rules)
    if not good.any():
        raise MapError(
            f"{folder}: none of {len(model.xyz)} points is seen by {rules.min_images} images from "
            f"{rules.min_distance_m:g}..{rules.max_distance_m:g} m",
            hint="check the scale: --scale is metres per unit of the model",
        )
    return keep_landmarks(model, good)


def keep_landmarks(model: Model, kept: NDArray[np.bool_]) -> Model:
    """Return a model with the points bool[n] only, numbered anew from 1, and only the keypoints that observe them.

    ``observation_keypoint`` still counts the original keypoints.
    """
    number = np.cumsum(kept) - 1
    rows = kept[model.observation_landmark]
    return dataclasses.replace(
        model,
        xyz=model.xyz[kept],
        point_ids=np.arange(1, int(kept.sum()) + 1),
        observation_landmark=number[model.observation_landmark[rows]].astype(np.int32),
        observation_image=model.observation_image[rows],
        observation_keypoint=model.observation_keypoint[rows],
        observation_px=model.observation_px[rows],
    )


def _descriptors(model: Model, images: Path | None, options: ImportOptions, tell: Progress) -> NDArray[Any]:
    if options.features is not None:
        return hloc_descriptors(options.features, model, feature=options.feature)
    if options.database is not None:
        return database_descriptors(options.database, model, feature=options.feature)
    assert images is not None
    return image_descriptors(images, model, feature=options.feature, progress=tell, weights=options.weights)


def _described(folder: Path, model: Model, descriptors: NDArray[Any]) -> list[str]:
    """Say how many landmarks have a descriptor; raises MapError when hardly any has."""
    filled = descriptors.any(axis=1)
    share = len(np.unique(model.observation_landmark[filled])) / len(model.xyz)
    if share < 0.1:
        raise MapError(
            f"{folder}: {100 * share:.0f} % of {len(model.xyz)} landmarks have keypoints of the feature within a "
            "pixel; expected a model that was made with this feature",
            hint="give --feature with the model's own, or --features or --database",
        )
    return [] if share > 0.9 else [f"{100 * share:.0f} % of the landmarks have a descriptor; the others match nothing"]


def write_landmark_map(folder: Path, model: Model, descriptors: NDArray[Any], surface: Surface | None) -> None:
    """Write sparse/, features.h5 and surface.ply with the keypoints that observe landmarks; no map.toml."""
    bounds = np.searchsorted(model.observation_image, np.arange(len(model.image_names) + 1))
    parts = [slice(int(a), int(b)) for a, b in itertools.pairwise(bounds)]
    pixels = [model.observation_px[part] for part in parts]
    keypoint = np.concatenate([np.arange(len(p), dtype=np.int32) for p in pixels])
    write_model(folder / "sparse", dataclasses.replace(model, observation_keypoint=keypoint), pixels)
    features = {}
    for name, part in zip(model.image_names, parts, strict=True):
        ones = np.ones(part.stop - part.start, dtype=np.float32)
        features[name] = Features(model.observation_px[part], ones, ones, descriptors[part])
    sizes = {n: (c.width, c.height) for n, c in zip(model.image_names, model.image_cameras, strict=True)}
    write_features(folder / "features.h5", features, sizes)
    if surface is not None:
        write_ply(folder / "surface.ply", surface)


def _surface_entry(surface: Surface | None) -> SurfaceEntry | None:
    return None if surface is None else SurfaceEntry(surface.voxel_m, surface.voxel_m, "surface.ply")
