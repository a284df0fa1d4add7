"""`build_map`: from a SOURCE folder to a map folder, one arrow per step."""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from fieldkit.errors import MapError, SurfaceError
from fieldkit.features import Features, extract, feature_kind
from fieldkit.frames import Pose
from fieldkit.maps.align import Alignment, Similarity, align_to_slam
from fieldkit.maps.io import (
    AlignmentEntry,
    MapFile,
    SurfaceEntry,
    content_digest,
    positive,
    write_features,
    write_map_file,
)
from fieldkit.maps.landmarks import LandmarkRules, good_landmarks, model_arrays
from fieldkit.maps.metric import depth_scale, depth_views, with_depth_scale
from fieldkit.maps.pairs import Pair, choose_pairs, match_pairs
from fieldkit.maps.plausible import SlamRules, plausible_matches, plausible_pairs
from fieldkit.maps.sfm import reconstruct, relative_poses, threads
from fieldkit.maps.source import DepthFrame, MapSource, along_axis, read_image
from fieldkit.maps.strays import contradicting, strays
from fieldkit.maps.streamrecorder import open_source
from fieldkit.store import atomic_folder
from fieldkit.store.files import refuse_existing
from fieldkit.surface import fuse_depth, write_ply
from fieldkit.types import Surface

Progress = Callable[[str, int, int], None]

# A few misplaced images are left out; of more than this share the rest is bent too, and SfM starts again.
_FOLDED = 0.05


@dataclasses.dataclass(frozen=True)
class MapOptions:
    """Settings of map building; the defaults suit 50..500 images of rooms.

    ``scale`` "auto" refines the scale of the SLAM poses by the depth images where there are any; "slam" does not.
    ``slam`` says how far SLAM's poses are trusted to rule out matches; None takes all matches. ``n_threads`` is by
    default the number of processors; it does not change the map, and is no part of what the options are told by.
    Raises MapError when a length or a count is not positive.
    """

    max_keypoints: int = 2048
    max_image_size: int | None = 1600
    ratio: float = 0.8
    n_similar: int = 20
    n_neighbours: int = 3
    min_registered: float = 0.5
    landmarks: LandmarkRules = dataclasses.field(default_factory=LandmarkRules)
    scale: Literal["auto", "slam"] = "auto"
    slam: SlamRules | None = dataclasses.field(default_factory=SlamRules)
    voxel_m: float = 0.04
    truncation_voxels: float = 3.5
    max_depth_m: float = 6.0
    n_threads: int | None = dataclasses.field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name in ("voxel_m", "truncation_voxels", "max_depth_m", "ratio", "max_keypoints"):
            positive(name, getattr(self, name))
        if self.n_threads is not None:
            positive("n_threads", self.n_threads)


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


class _Clock:
    """Seconds per step."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, step: str) -> None:
        now = time.perf_counter()
        self.seconds[step] = self.seconds.get(step, 0.0) + now - self._last
        self._last = now


def build_map(
    source: Path,
    out: Path,
    *,
    feature: str = "sift",
    force: bool = False,
    options: MapOptions | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> MapReport:
    """Build a map folder from a rig folder or an image folder: features, SfM, metric frame, landmarks, surface.

    SfM starts from the images; SLAM poses only rule out matches between places that look alike. They give scale, frame
    and gravity afterwards, and depth images refine the scale.
    The same source and seed give the same map, whatever the number of processors.
    ``progress(step, done, total)`` is called along the way. Raises MapError when the source is incomplete, too few
    images register, or the poses do not fit, and StoreError when ``out`` is in the way; nothing is left behind.
    """
    options = MapOptions() if options is None else options
    tell: Progress = progress or (lambda step, done, total: None)
    feature_kind(feature)
    refuse_existing(Path(out), force=force, marker="map.toml", kind="folder")
    clock = _Clock()
    walk = open_source(Path(source))
    features = _extract_all(walk, feature, options, tell)
    clock.lap("extract")
    pairs, matches, disbelieved = _match_all(walk, features, options, seed, tell)
    clock.lap("match")
    found = _Matched(walk, features, pairs, matches)
    placing = _place(found, options, seed, tell)
    if options.slam is not None and not disbelieved and placing.contradicting > _FOLDED * len(placing.sfm_poses):
        again = _place(_unfolded(found, options.slam, options, seed), options, seed, tell)
        placing = max(placing, again, key=lambda p: len(p.sfm_poses) - p.contradicting)
    clock.lap("reconstruct")
    model, sfm_poses, alignment, warnings = placing.model, placing.sfm_poses, placing.alignment, placing.warnings
    mapped, left_out = _placed(walk, model, sfm_poses, alignment)
    n_landmarks = _finish_model(walk, model, alignment.map_from_sfm, options.landmarks)
    clock.lap("align")
    surface, missing = _surface(walk, mapped, options, tell)
    clock.lap("surface")
    counts = (len(walk.images), len(mapped), n_landmarks)
    with atomic_folder(Path(out), force=force, marker="map.toml") as folder:
        _write(folder, walk, model, features, mapped, surface)
        digest = content_digest(folder)
        places = _alignment_entry(alignment), _surface_entry(surface, options)
        write_map_file(folder, MapFile(1, digest, feature, *counts, *places))
    clock.lap("write")
    told = (*walk.notes, *disbelieved, *warnings, *left_out, *missing)
    return MapReport(str(out), digest, *counts, alignment, surface is not None, clock.seconds, told)


def _extract_all(walk: MapSource, feature: str, options: MapOptions, tell: Progress) -> list[Features]:
    def one(index: int) -> Features:
        image = walk.images[index]
        grey = read_image(image)
        if grey.shape != (image.camera.height, image.camera.width):
            raise MapError(
                f"{image.file}: is {grey.shape[1]}x{grey.shape[0]}; its camera says "
                f"{image.camera.width}x{image.camera.height}",
                hint="give every camera images of one size",
            )
        return extract(grey, feature=feature, max_keypoints=options.max_keypoints, max_side_px=options.max_image_size)

    found = []
    with ThreadPoolExecutor(options.n_threads or threads()) as pool:
        for done, result in enumerate(pool.map(one, range(len(walk.images))), start=1):
            found.append(result)
            tell("extract", done, len(walk.images))
    return found


def _match_all(
    walk: MapSource, features: list[Features], options: MapOptions, seed: int, tell: Progress
) -> tuple[list[Pair], list[NDArray[np.uint32]], list[str]]:
    """Return pairs, their matches as far as SLAM's poses allow them, and a warning where SLAM is not believed."""
    pairs = choose_pairs(
        walk.images, features, seed=seed, n_similar=options.n_similar, n_neighbours=options.n_neighbours
    )
    matches = match_pairs(
        pairs,
        features,
        ratio=options.ratio,
        progress=lambda n: tell("match", n, len(pairs)),
        n_threads=options.n_threads or threads(),
    )
    if options.slam is None:
        return pairs, matches, []
    plausible = plausible_matches(walk.images, features, pairs, matches, rules=options.slam)
    share = sum(map(len, plausible)) / max(sum(map(len, matches)), 1)
    if share < options.slam.least_share:
        return pairs, matches, [f"SLAM's poses fit {100 * share:.0f} % of the matches: not used to rule out the others"]
    return pairs, plausible, []


@dataclasses.dataclass(frozen=True)
class _Matched:
    """What SfM starts from."""

    walk: MapSource
    features: Sequence[Features]
    pairs: Sequence[Pair]
    matches: Sequence[NDArray[np.uint32]]


@dataclasses.dataclass(frozen=True)
class _Placing:
    """A model with its poses sfm_from_cam, its alignment, and how many images are not where SLAM saw them."""

    model: pycolmap.Reconstruction
    sfm_poses: Mapping[int, Pose]
    alignment: Alignment
    warnings: Sequence[str]
    contradicting: int


def _place(found: _Matched, options: MapOptions, seed: int, tell: Progress) -> _Placing:
    walk = found.walk
    model = reconstruct(
        walk.images,
        found.features,
        found.pairs,
        found.matches,
        seed=seed,
        progress=tell,
        n_threads=options.n_threads or threads(),
    )
    poses = _registered(walk, model, options)
    alignment, warnings = _align(walk, model, poses, options, seed)
    mapped = {i: alignment.map_from_sfm.pose(p) for i, p in poses.items()}
    far = contradicting(walk.images, mapped, threshold_m=alignment.threshold_m)
    return _Placing(model, poses, alignment, warnings, len(far))


def _unfolded(found: _Matched, rules: SlamRules, options: MapOptions, seed: int) -> _Matched:
    """Leave out the pairs of images whose own relative poses contradict SLAM's."""
    relative = relative_poses(
        found.walk.images,
        found.features,
        found.pairs,
        found.matches,
        seed=seed,
        n_threads=options.n_threads or threads(),
    )
    kept = plausible_pairs(found.walk.images, found.pairs, relative, rules=rules)
    return dataclasses.replace(
        found,
        pairs=list(itertools.compress(found.pairs, kept)),
        matches=list(itertools.compress(found.matches, kept)),
    )


def _registered(walk: MapSource, model: pycolmap.Reconstruction, options: MapOptions) -> dict[int, Pose]:
    """Return sfm_from_cam by image index; raises MapError when too few images are in the model."""
    poses = {}
    for image_id in model.reg_image_ids():
        matrix = np.vstack([model.image(image_id).cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]])
        poses[image_id - 1] = Pose.from_matrix(matrix).inv()
    if len(poses) < max(3, options.min_registered * len(walk.images)):
        raise MapError(
            f"{walk.path}: {len(poses)} of {len(walk.images)} images registered; expected at least half, and 3",
            hint="map in one connected walk with overlapping sharp images; check images and cameras of the others",
        )
    return dict(sorted(poses.items()))


def _align(
    walk: MapSource, model: pycolmap.Reconstruction, sfm_poses: Mapping[int, Pose], options: MapOptions, seed: int
) -> tuple[Alignment, list[str]]:
    """Return map_from_sfm by the SLAM poses, scaled by depth unless told otherwise, and what a user should know."""
    posed = {i: p for i in sfm_poses if (p := walk.images[i].slam_from_cam) is not None}
    try:
        alignment = align_to_slam([sfm_poses[i] for i in posed], list(posed.values()), seed=seed)
    except MapError as error:
        raise MapError(f"{walk.path}: {error.message}", hint=error.hint) from error
    warnings = []
    if len(sfm_poses) < len(walk.images):
        warnings.append(f"{len(sfm_poses)} of {len(walk.images)} images registered")
    if alignment.verdict != "pass":
        warnings.append(
            f"alignment verdict {alignment.verdict}: {alignment.n_used} of {alignment.n_total} SLAM poses within "
            f"{alignment.threshold_m:.3f} m, rms {alignment.rms_m:.3f} m, gravity {alignment.gravity_deg:.2f} deg"
        )
    if options.scale == "slam":
        return alignment, warnings
    scaled, doubts = _scale_by_depth(walk, model, sfm_poses, alignment)
    return scaled, warnings + doubts


def _scale_by_depth(
    walk: MapSource, model: pycolmap.Reconstruction, sfm_poses: Mapping[int, Pose], alignment: Alignment
) -> tuple[Alignment, list[str]]:
    """Take the metric scale from the depth images where there are any; SLAM's drift is in its scale."""
    if walk.depth_camera is None:
        return alignment, []
    arrays, similarity = model_arrays(model), alignment.map_from_sfm
    scaled = dataclasses.replace(arrays, xyz=similarity.points(arrays.xyz))
    mapped = {i: similarity.pose(p) for i, p in sfm_poses.items()}
    size = (walk.depth_camera.width, walk.depth_camera.height)
    found = depth_scale(walk, scaled, mapped, read=lambda frame: _DepthReader(frame, *size)())
    if found is None:
        return alignment, []
    posed = {i: p for i in sfm_poses if (p := walk.images[i].slam_from_cam) is not None}
    return with_depth_scale(
        alignment,
        found,
        sfm_centres=np.stack([sfm_poses[i].translation for i in posed]),
        slam_centres=np.stack([p.translation for p in posed.values()]),
    )


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
    walk: MapSource, mapped: Mapping[int, Pose], options: MapOptions, tell: Progress
) -> tuple[Surface | None, list[str]]:
    if walk.depth_camera is None:
        return None, ["no depth images: the map has no surface, and occlusion cannot be computed"]
    camera, views = walk.depth_camera, []
    for frame, map_from_depth in depth_views(walk, mapped):
        views.append((map_from_depth, _DepthReader(frame, camera.width, camera.height)))
    if not views:
        return None, ["no depth image belongs to a registered image: the map has no surface"]
    try:
        surface = fuse_depth(
            views,
            camera,
            voxel_m=options.voxel_m,
            truncation_m=options.truncation_voxels * options.voxel_m,
            max_depth_m=options.max_depth_m,
            progress=lambda n: tell("surface", n, len(views)),
        )
    except SurfaceError as error:
        raise SurfaceError(f"{walk.path / 'depth'}: {error.message}", hint=error.hint) from error
    return surface, []


@dataclasses.dataclass(frozen=True)
class _DepthReader:
    frame: DepthFrame
    width: int
    height: int

    def __call__(self) -> NDArray[np.uint16]:
        depth = cv2.imread(str(self.frame.file), cv2.IMREAD_UNCHANGED)
        if depth is None or depth.dtype != np.uint16 or depth.shape != (self.height, self.width):
            raise SurfaceError(
                f"{self.frame.file}: expected a 16-bit PNG of {self.width}x{self.height} in mm",
                hint="check the depth image and the depth camera's size",
            )
        return along_axis(np.asarray(depth, dtype=np.uint16), self.frame)


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


def _alignment_entry(a: Alignment) -> AlignmentEntry:
    return AlignmentEntry(
        a.source, a.map_from_sfm.scale, a.n_used, a.n_total, a.rms_m, a.p95_m, a.gravity_deg, a.verdict
    )


def _surface_entry(surface: Surface | None, options: MapOptions) -> SurfaceEntry | None:
    if surface is None:
        return None
    return SurfaceEntry(surface.voxel_m, options.truncation_voxels * options.voxel_m, "surface.ply")
