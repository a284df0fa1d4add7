"""Where every mapping image was: SfM from verified matches, in one piece, and unfolded where SLAM contradicts it."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from fieldkit.errors import MapError
from fieldkit.features import Features
from fieldkit.frames import Pose
from fieldkit.maps.metric.align import Alignment
from fieldkit.maps.metric.choosing import find_frame
from fieldkit.maps.options import MapOptions, Progress, SlamRules
from fieldkit.maps.quiet import quiet_colmap
from fieldkit.maps.sources.source import MIN_POSES, MapSource
from fieldkit.maps.stages import Stages
from fieldkit.maps.structure.known import match_share, triangulate
from fieldkit.maps.structure.pairs import Pair
from fieldkit.maps.structure.plausible import plausible_pairs
from fieldkit.maps.structure.sfm import reconstruct, relative_poses, threads, write_verified
from fieldkit.maps.structure.strays import folded
from fieldkit.tags import TagDetection

# A few misplaced images are left out; of more than this share the rest is bent too, and SfM starts again.
_FOLDED = 0.05
_NAMES = 4


@dataclasses.dataclass(frozen=True)
class Matched:
    """What SfM starts from, and the tags that images show.

    ``disbelieved`` says why SLAM's poses ruled out nothing, if they did not.
    """

    walk: MapSource
    features: Sequence[Features]
    pairs: Sequence[Pair]
    matches: Sequence[NDArray[np.uint32]]
    disbelieved: tuple[str, ...] = ()
    tags: Mapping[int, Sequence[TagDetection]] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Placing:
    """A model with its poses sfm_from_cam, its alignment, and how many images are not where SLAM saw them.

    Those where SLAM is what leaps do not count.
    """

    model: pycolmap.Reconstruction
    sfm_poses: Mapping[int, Pose]
    alignment: Alignment
    warnings: Sequence[str]
    contradicting: int


def place_images(found: Matched, stages: Stages, options: MapOptions, *, seed: int, progress: Progress) -> Placing:
    """Place all images that hang together; where a map folds, again without the pairs that contradict SLAM.

    Raises MapError when too few images can be placed, or nothing gives them a metric frame.
    """
    placing = place_once(found, stages, options, seed=seed, progress=progress)
    if options.poses == "known" or options.slam is None or found.disbelieved:
        return placing
    if placing.contradicting <= _FOLDED * len(placing.sfm_poses):
        return placing
    less = unfolded(found, options.slam, stages, options, seed=seed, progress=progress)
    again = place_once(less, stages, options, seed=seed, progress=progress, name="unfolded")
    return max(placing, again, key=lambda p: len(p.sfm_poses) - p.contradicting)


def place_once(
    found: Matched, stages: Stages, options: MapOptions, *, seed: int, progress: Progress, name: str = "all"
) -> Placing:
    """Verify the matches, reconstruct or triangulate, and find the metric frame; ``name`` tells two runs apart."""
    walk = found.walk
    n_threads = options.n_threads or threads()

    def verify(folder: Path) -> None:
        folder.mkdir()
        write_verified(
            folder / "database.db",
            walk.images,
            found.features,
            found.pairs,
            found.matches,
            seed=seed,
            n_threads=n_threads,
            progress=progress,
        )

    def grow(database: Path) -> Sequence[pycolmap.Reconstruction]:
        try:
            if options.poses == "known":
                progress("triangulate", 0, 1)
                model = triangulate(database, walk.images)
                progress("triangulate", 1, 1)
                return [model]
            return reconstruct(database, walk.images, seed=seed, progress=progress)
        except MapError as error:
            raise MapError(f"{walk.path}: {error.message}", hint=error.hint) from error

    with stages.timed("verify"):
        database = stages.put(f"pairs-{name}", verify) / "database.db"
    with stages.timed("reconstruct"):
        folder = stages.put(f"models-{name}", lambda part: _write_models(part, grow(database)))
        with quiet_colmap():
            model = pycolmap.Reconstruction(folder / "0")
        poses, pieces = _registered(walk, model, folder, options)
    share = match_share(database, walk.images) if options.poses == "known" else 1.0
    with stages.timed("align"):
        alignment, warnings = find_frame(walk, model, poses, options, tags=found.tags, seed=seed, match_share=share)
        mapped = {i: alignment.map_from_sfm.pose(p) for i, p in poses.items()}
        far = folded(walk.images, mapped, threshold_m=alignment.threshold_m)
    return Placing(model, poses, alignment, (*pieces, *warnings), len(far))


def unfolded(
    found: Matched, rules: SlamRules, stages: Stages, options: MapOptions, *, seed: int, progress: Progress
) -> Matched:
    """Leave out the pairs of images whose own relative poses contradict SLAM's."""

    def compare() -> dict[str, NDArray[np.generic]]:
        relative = relative_poses(
            found.walk.images,
            found.features,
            found.pairs,
            found.matches,
            seed=seed,
            n_threads=options.n_threads or threads(),
            progress=progress,
        )
        return {"kept": plausible_pairs(found.walk.images, found.pairs, relative, rules=rules)}

    with stages.timed("verify"):
        kept = stages.arrays("kept", compare)["kept"].astype(bool).tolist()
    return dataclasses.replace(
        found,
        pairs=list(itertools.compress(found.pairs, kept)),
        matches=list(itertools.compress(found.matches, kept)),
    )


def _write_models(folder: Path, models: Sequence[pycolmap.Reconstruction]) -> None:
    """Write the largest model as 0/, and which images are in each."""
    (folder / "0").mkdir(parents=True)
    models[0].write_binary(folder / "0")
    pieces = [sorted(int(i) - 1 for i in model.reg_image_ids()) for model in models]
    (folder / "pieces.json").write_text(json.dumps(pieces), encoding="utf-8")


def _registered(
    walk: MapSource, model: pycolmap.Reconstruction, folder: Path, options: MapOptions
) -> tuple[dict[int, Pose], list[str]]:
    """Return sfm_from_cam by image index, and what of the images is elsewhere.

    Raises MapError when too few images are in the model.
    """
    poses = {}
    for image_id in sorted(model.reg_image_ids()):
        matrix = np.vstack([model.image(image_id).cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]])
        poses[image_id - 1] = Pose.from_matrix(matrix).inv()
    pieces = json.loads((folder / "pieces.json").read_text(encoding="utf-8"))
    others = [left for piece in pieces[1:] if (left := sorted(set(piece) - set(poses)))]
    apart = "".join(f"; {len(left)} others ({_named(walk, left)}) hang together by themselves" for left in others)
    if options.poses == "known":
        posed = f"{walk.n_posed} of {len(walk.images)} images have a pose"
        return poses, [] if walk.n_posed == len(walk.images) else [posed]
    if len(poses) < max(3, options.min_registered * len(walk.images)):
        raise MapError(
            f"{walk.path}: {len(poses)} of {len(walk.images)} images registered{apart}; expected at least half, and 3",
            hint="map in one connected walk with overlapping sharp images, or build a map of each piece"
            if others
            else "map in one connected walk with overlapping sharp images; check images and cameras of the others",
        )
    _refuse_unposed(walk, poses, others)
    missing = [i for i in range(len(walk.images)) if i not in poses]
    if not missing:
        return poses, []
    told = f"{len(poses)} of {len(walk.images)} images registered, without {_named(walk, missing)}{apart}"
    return poses, [f"{told}: add images between the pieces, or map each by itself" if others else told]


def _refuse_unposed(walk: MapSource, placed: Collection[int], others: Sequence[Sequence[int]]) -> None:
    """Raise MapError where SLAM's poses are of a piece that the largest one is not connected with."""

    def posed(piece: Iterable[int]) -> list[int]:
        return [i for i in piece if walk.images[i].slam_from_cam is not None]

    best = max(others, key=lambda piece: len(posed(piece)), default=[])
    if walk.n_posed < MIN_POSES or len(posed(placed)) >= MIN_POSES or len(posed(best)) < MIN_POSES:
        return
    raise MapError(
        f"{walk.path}: the images are in pieces: {len(posed(placed))} of the {len(placed)} in the largest have a SLAM "
        f"pose, but {len(posed(best))} of {len(best)} others ({_named(walk, best)}); expected poses in the largest",
        hint="map the piece with poses by itself, add images between the pieces, or give the largest its poses, too",
    )


def _named(walk: MapSource, chosen: Sequence[int]) -> str:
    more = ", ..." if len(chosen) > _NAMES else ""
    return ", ".join(walk.images[i].name for i in chosen[:_NAMES]) + more
