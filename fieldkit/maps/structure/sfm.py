"""Structure from motion by COLMAP with known intrinsics, seeded and single threaded so that it repeats bit for bit."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from fieldkit.errors import MapError
from fieldkit.features import Features
from fieldkit.frames import Pose
from fieldkit.maps.quiet import quiet_colmap
from fieldkit.maps.sources.source import SourceImage
from fieldkit.maps.structure.pairs import Pair
from fieldkit.maps.structure.rigs import write_cameras

# Below this number of verified matches a pair is not used (COLMAP's own bound).
_MIN_MATCHES = 15
# Pairs that are verified between two tellings of progress
_SHARE = 500

Progress = Callable[[str, int, int], None]


def write_database(
    path: Path,
    images: Sequence[SourceImage],
    features: Sequence[Features],
    pairs: Sequence[Pair],
    matches: Sequence[NDArray[np.uint32]],
) -> None:
    """Write rigs, cameras, images (id = index + 1), keypoints and matches into a new COLMAP database."""
    with contextlib.closing(pycolmap.Database.open(path)) as database, pycolmap.DatabaseTransaction(database):
        write_cameras(database, images)
        for i, found in enumerate(features, start=1):
            database.write_keypoints(i, found.keypoints_px.astype(np.float32))
        for (a, b), found_matches in zip(pairs, matches, strict=True):
            if len(found_matches) >= _MIN_MATCHES:
                database.write_matches(a + 1, b + 1, found_matches)


def verify_geometry(path: Path, *, seed: int, n_threads: int = -1, with_pose: bool = False) -> int:
    """Verify all matches of a database by two-view geometry; return the number of pairs that hold.

    Pairs are shared among ``n_threads`` threads, -1 for all processors; what is found does not depend on it. The
    relative pose of each pair is found too when asked for.
    """
    sharing = pycolmap.GeometricVerifierOptions()
    sharing.num_threads = n_threads
    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers = _MIN_MATCHES
    options.detect_watermark = False
    options.compute_relative_pose = with_pose
    options.ransac.random_seed = seed
    options.ransac.num_threads = 1
    pycolmap.geometric_verification(path, sharing, two_view_geometry_options=options)
    with contextlib.closing(pycolmap.Database.open(path)) as database:
        return int(database.num_verified_image_pairs())


def write_verified(
    path: Path,
    images: Sequence[SourceImage],
    features: Sequence[Features],
    pairs: Sequence[Pair],
    matches: Sequence[NDArray[np.uint32]],
    *,
    seed: int,
    n_threads: int = -1,
    progress: Progress = lambda step, done, total: None,
) -> int:
    """Write a COLMAP database with matches and their verified geometry; return the number of pairs that hold.

    Pairs are verified in shares, each in a database of its own: COLMAP tells nothing while it works on one.
    """
    write_database(path, images, features, pairs, matches)
    found: list[tuple[int, int, pycolmap.TwoViewGeometry]] = []
    progress("verify", 0, len(pairs))
    with tempfile.TemporaryDirectory(prefix="fieldkit-sfm-") as folder, quiet_colmap():
        for first in range(0, len(pairs), _SHARE):
            rows = slice(first, first + _SHARE)
            share = Path(folder) / f"{first}.db"
            write_database(share, images, features, pairs[rows], matches[rows])
            verify_geometry(share, seed=seed, n_threads=n_threads)
            found += _geometries(share)
            share.unlink()
            progress("verify", min(first + _SHARE, len(pairs)), len(pairs))
        with contextlib.closing(pycolmap.Database.open(path)) as database:
            with pycolmap.DatabaseTransaction(database):
                for a, b, geometry in found:
                    database.write_two_view_geometry(a, b, geometry)
            return int(database.num_verified_image_pairs())


def relative_poses(
    images: Sequence[SourceImage],
    features: Sequence[Features],
    pairs: Sequence[Pair],
    matches: Sequence[NDArray[np.uint32]],
    *,
    seed: int,
    n_threads: int = -1,
    progress: Progress = lambda step, done, total: None,
) -> list[Pose | None]:
    """Return b_from_a of every pair (a, b) by its matches alone, up to scale; None where they give none."""
    found: dict[Pair, Pose] = {}
    with tempfile.TemporaryDirectory(prefix="fieldkit-sfm-") as folder, quiet_colmap():
        for first in range(0, len(pairs), _SHARE):
            rows = slice(first, first + _SHARE)
            share = Path(folder) / f"{first}.db"
            write_database(share, images, features, pairs[rows], matches[rows])
            verify_geometry(share, seed=seed, n_threads=n_threads, with_pose=True)
            for a, b, geometry in _geometries(share):
                if (b_from_a := geometry.cam2_from_cam1) is not None:
                    pose = Pose.from_matrix(np.vstack([b_from_a.matrix(), [0.0, 0.0, 0.0, 1.0]]))
                    found[a - 1, b - 1], found[b - 1, a - 1] = pose, pose.inv()
            share.unlink()
            progress("compare pairs", min(first + _SHARE, len(pairs)), len(pairs))
    return [found.get(pair) for pair in pairs]


def _geometries(path: Path) -> list[tuple[int, int, pycolmap.TwoViewGeometry]]:
    """Return the verified pairs of a database by their images' ids."""
    with contextlib.closing(pycolmap.Database.open(path)) as database:
        found = zip(*database.read_two_view_geometries(), strict=True)
        return [(*pycolmap.pair_id_to_image_pair(pair_id), geometry) for pair_id, geometry in found]


def reconstruct(
    database: Path, images: Sequence[SourceImage], *, seed: int, progress: Progress
) -> list[pycolmap.Reconstruction]:
    """Reconstruct cameras and points from a verified database: models in SfM's own scale and frame, largest first.

    Intrinsics and the geometry of a rig stay fixed: a rig's images are placed together, and in metres. More than one
    model grows where the images show places that nothing connects. ``progress`` counts what is placed together: images
    of one camera, frames of a rig. Raises MapError when no pair of images is verified or no model grows.
    """
    with contextlib.closing(pycolmap.Database.open(database)) as content:
        n_pairs, n_verified = content.num_matched_image_pairs(), content.num_verified_image_pairs()
        n_frames = content.num_frames()
    if not n_verified:
        raise MapError(
            f"no pair of the {len(images)} images shows the same place ({n_pairs} pairs with matches)",
            hint="take overlapping, textured, sharp images and check the camera's parameters",
        )
    with tempfile.TemporaryDirectory(prefix="fieldkit-sfm-") as folder, quiet_colmap():
        done = 0

        def count() -> None:
            nonlocal done
            done += 1
            progress("reconstruct", min(done + 2, n_frames), n_frames)

        progress("reconstruct", 0, n_frames)
        models = pycolmap.incremental_mapping(
            database, folder, Path(folder) / "models", options=mapping_options(seed), next_image_callback=count
        )
    if not models:
        raise MapError(
            f"no reconstruction grew from {n_verified} verified pairs of {len(images)} images",
            hint="move sideways while mapping (turning on the spot gives no depth) and check the camera's parameters",
        )
    return sorted(models.values(), key=lambda m: (-m.num_reg_images(), -m.num_points3D()))


def mapping_options(seed: int) -> pycolmap.IncrementalPipelineOptions:
    """Return the settings of incremental mapping and of triangulation."""
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = seed
    options.num_threads = 1
    options.extract_colors = False
    options.ba_refine_focal_length = False
    options.ba_refine_principal_point = False
    options.ba_refine_extra_params = False
    options.ba_refine_sensor_from_rig = False
    options.min_model_size = 3
    options.mapper.abs_pose_refine_focal_length = False
    options.mapper.abs_pose_refine_extra_params = False
    # Tighter than COLMAP's defaults: with few pairs per image loose ones let a room bend at its weakest link.
    options.mapper.init_max_error = 2.0
    options.mapper.abs_pose_max_error = 6.0
    options.mapper.filter_max_reproj_error = 3.0
    options.triangulation.merge_max_reproj_error = 3.0
    options.triangulation.complete_max_reproj_error = 3.0
    return options


def threads() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
