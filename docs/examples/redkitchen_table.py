"""Localize the 7-Scenes red kitchen with every feature and print recall, errors and seconds as a markdown table.

Blocks of 100 frames: even ones make the map, odd ones are localized in it. `--split interleaved` maps every second
frame instead; its queries are near duplicates of mapping images. The images of a map are aligned to the truth by a
similarity first, so that only the localization is judged. There are two truths: the given poses (of KinectFusion, which
drift by some centimetres and two degrees), and the poses of one COLMAP SfM over all frames.

    python docs/examples/redkitchen_table.py DATA --out build/redkitchen_table
"""

from __future__ import annotations

import dataclasses
import json
import re
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap
import tyro
from numpy.typing import NDArray
from redkitchen import BLOCK, COLOUR, read_poses, write_source
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from fieldkit import store
from fieldkit.errors import FieldkitError, WeightsError
from fieldkit.features import read_image
from fieldkit.frames import Pose, pose_error
from fieldkit.localize import Localizer, Query
from fieldkit.maps import MapOptions, build_map, load_map
from fieldkit.protocol import LocalizerRules
from fieldkit.types import Estimate, SceneMap

Array = NDArray[np.float64]
Poses = Mapping[int, Pose]

# A feature, and after a plus sign the matcher, of the map and of the queries.
FEATURES = ("sift", "sift_l2", "akaze", "aliked", "aliked+lightglue", "xfeat", "superpoint")
# (m, rad) within which a query counts as localized.
LIMITS = ((0.05, np.radians(5.0)), (0.10, np.radians(1.0)))
STAGES = ("extract", "retrieve", "match", "pnp")
# A position that is 3 cm off and a rotation that is 1 deg off count alike in the alignment: the truth is no better.
SIGMA_M, SIGMA_RAD = 0.03, np.radians(1.0)


@dataclasses.dataclass(frozen=True)
class Row:
    """One feature: landmarks of its map, seconds per query and stage (medians), and what the queries' poses are off,
    against either truth: share within each of LIMITS, median m and rad, queries without a pose."""

    feature: str
    n_landmarks: int
    seconds: Mapping[str, float]
    queries_per_s: float
    given: Mapping[str, float]
    one_sfm: Mapping[str, float]


@dataclasses.dataclass(frozen=True)
class Options:
    """Which frames make the map, whether SfM places them or their given poses are kept, and where weights are."""

    split: Literal["blocks", "interleaved"]
    poses: Literal["slam", "known"]
    weights: Path | None


def divide(numbers: Sequence[int], split: str) -> tuple[list[int], list[int]]:
    """Return the frame numbers of the map and of the queries."""
    if split == "interleaved":
        return list(numbers[0::2]), list(numbers[1::2])
    return [n for n in numbers if (n // BLOCK) % 2 == 0], [n for n in numbers if (n // BLOCK) % 2]


def align(poses: Poses, truth: Poses) -> dict[int, Pose]:
    """Move poses into the truth's frame by the similarity that fits positions and rotations of their common frames.

    Least squares with soft L1; frames without a counterpart are moved along.
    """
    common = sorted(poses.keys() & truth.keys())
    centres, wanted = (np.array([p[n].translation for n in common]) for p in (poses, truth))
    turns, wanted_turns = (Rotation.concatenate([p[n].rotation for n in common]) for p in (poses, truth))
    a, b = np.median(centres, axis=0), np.median(wanted, axis=0)
    scale = np.sqrt(((wanted - b) ** 2).sum() / ((centres - a) ** 2).sum())
    turn = (wanted_turns * turns.inv()).mean()

    def moved(x: Array, points: Array) -> Array:
        return np.asarray(np.exp(x[0]) * Rotation.from_rotvec(x[1:4]).apply(points) + x[4:])

    def residuals(x: Array) -> Array:
        rotation = (wanted_turns.inv() * Rotation.from_rotvec(x[1:4]) * turns).as_rotvec() / SIGMA_RAD
        return np.concatenate([(moved(x, centres) - wanted).ravel() / SIGMA_M, rotation.ravel()])

    start = np.concatenate([[np.log(scale)], turn.as_rotvec(), b - scale * turn.apply(a)])
    x = least_squares(residuals, start, loss="soft_l1").x
    rotation = Rotation.from_rotvec(x[1:4])
    return {n: Pose.from_components(moved(x, p.translation), rotation * p.rotation) for n, p in poses.items()}


def judge(found: Mapping[int, Pose | None], truth: Poses) -> dict[str, float]:
    """Return shares within LIMITS, median errors (m, rad), and how many have no pose (infinitely off)."""
    errors = np.array([pose_error(pose, truth[n]) for n, pose in found.items()])
    within = {f"within_{i}": float(np.mean((errors <= limit).all(axis=1))) for i, limit in enumerate(LIMITS)}
    median_m, median_rad = np.median(errors, axis=0)
    return within | {"m": float(median_m), "rad": float(median_rad), "failed": float(np.isinf(errors[:, 0]).sum())}


def one_sfm(data: Path, numbers: Sequence[int]) -> dict[int, Pose]:
    """Reconstruct all frames at once by COLMAP (its own SIFT, all pairs, fixed intrinsics): sfm_from_cam by number."""
    names = [f"frame-{n:06d}.color.jpg" for n in numbers]
    reader = pycolmap.ImageReaderOptions(
        camera_model=COLOUR.model, camera_params=",".join(str(p) for p in COLOUR.params)
    )
    options = pycolmap.IncrementalPipelineOptions()
    options.ba_refine_focal_length = options.ba_refine_principal_point = options.ba_refine_extra_params = False
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    options.random_seed, options.extract_colors = 0, False
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = 4096
    with tempfile.TemporaryDirectory(prefix="redkitchen-") as folder:
        database, images, cpu = Path(folder) / "database.db", data / "frames", pycolmap.Device.cpu
        one = pycolmap.CameraMode.SINGLE
        pycolmap.extract_features(
            database,
            images,
            names,
            camera_mode=one,
            reader_options=reader,
            extraction_options=extraction,
            device=cpu,
        )
        pycolmap.match_exhaustive(database, device=cpu)
        models = pycolmap.incremental_mapping(database, images, Path(folder) / "models", options=options)
    model = max(models.values(), key=lambda m: m.num_reg_images())
    poses = {}
    for image_id in model.reg_image_ids():
        image = model.image(image_id)
        matrix = np.vstack([image.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]])
        poses[int(re.findall(r"\d+", image.name)[0])] = Pose.from_matrix(matrix).inv()
    return poses


def cached_sfm(data: Path, out: Path, given: Poses) -> dict[int, Pose]:
    """Return the poses of the SfM over all frames, in the frame of the given poses; they are kept in a file."""
    file = out / "one_sfm.txt"
    if not file.is_file():
        store.write_tum(file, [(f"{n:06d}", pose) for n, pose in sorted(one_sfm(data, sorted(given)).items())])
    return align({int(name): pose for name, pose in store.read_tum(file)}, given)


def localize_all(localizer: Localizer, data: Path, queries: Sequence[int]) -> tuple[list[Estimate], float]:
    """Localize the queries one by one, then again in two threads; return the estimates and queries per second."""
    asked = [
        Query(read_image(data / "frames" / f"frame-{n:06d}.color.jpg", colour=localizer.colour), COLOUR)
        for n in queries
    ]
    localizer.localize(asked[0].image, COLOUR)
    estimates = [localizer.localize(query.image, query.camera) for query in asked]
    start = time.perf_counter()
    again = list(localizer.localize_many(asked, threads=2))
    return estimates, len(again) / (time.perf_counter() - start)


def judge_both(
    scene_map: SceneMap, found: Mapping[int, Pose | None], truths: tuple[Poses, Poses]
) -> list[dict[str, float]]:
    """Judge the queries against both truths; they are moved along with the map's own images, which are aligned."""
    mapped = {int(Path(n).stem): p for n, p in zip(scene_map.image_names, scene_map.map_from_image, strict=True)}
    posed = {n: p for n, p in found.items() if p is not None}
    judged = []
    for truth in truths:
        moved = align({**mapped, **posed}, {n: p for n, p in truth.items() if n in mapped})
        judged.append(judge({n: moved.get(n) for n in found}, truth))
    return judged


def evaluate(feature: str, data: Path, out: Path, *, options: Options, truths: tuple[Poses, Poses]) -> Row:
    """Build the feature's map, unless it is there, localize all queries and judge them against both truths."""
    given, _ = truths
    mapping, queries = divide(sorted(given), options.split)
    source, folder = out / options.split / "source", out / options.split / options.poses / f"{feature}.map"
    name, _, chosen = feature.partition("+")
    matcher: Literal["nearest", "lightglue"] = "lightglue" if chosen else "nearest"
    if not source.is_dir():
        write_source(data, source, {n: given[n] for n in mapping})
    if not folder.is_dir():
        made = MapOptions(matcher=matcher, poses=options.poses, weights=options.weights)
        build_map(source, folder, feature=name, options=made)
    scene_map = load_map(folder)
    localizer = Localizer(scene_map, LocalizerRules(matcher=matcher), weights=options.weights)
    estimates, rate = localize_all(localizer, data, queries)
    found = {n: e.map_from_cam for n, e in zip(queries, estimates, strict=True)}
    seconds = {s: float(np.median([e.seconds.get(s, 0.0) for e in estimates])) for s in STAGES}
    seconds["total"] = float(np.median([sum(e.seconds.values()) for e in estimates]))
    return Row(feature, len(scene_map.xyz), seconds, rate, *judge_both(scene_map, found, truths))


def line(row: Row) -> str:
    """Return a row of the table: ms, percent, cm and deg."""
    cells = [row.feature, f"{row.n_landmarks:,}"]
    cells += [f"{1e3 * row.seconds[s]:.0f}" for s in (*STAGES, "total")] + [f"{row.queries_per_s:.1f}"]
    for judged in (row.given, row.one_sfm):
        cells.append(" / ".join(f"{100 * judged[f'within_{i}']:.0f}" for i in range(len(LIMITS))))
        cells.append(f"{100 * judged['m']:.2f} cm, {np.degrees(judged['rad']):.2f}°")
    return "| " + " | ".join([*cells, f"{row.given['failed']:.0f}"]) + " |"


HEADER = (
    "| feature | landmarks | extract | retrieve | match | pnp | ms per query | queries/s "
    "| given: 5 cm/5° / 10 cm/1°, % | median | one SfM: % | median | no pose |\n" + "|---" * 13 + "|"
)


def main(
    data: tyro.conf.Positional[Path],
    *,
    out: Path,
    features: tuple[str, ...] = FEATURES,
    split: Literal["blocks", "interleaved"] = "blocks",
    poses: Literal["slam", "known"] = "slam",
    weights: Path | None = None,
) -> None:
    """Print one row per feature; maps and the SfM over all frames are kept in ``out`` and used again.

    Args:
        data: folder with frames/ and poses/
        out: folder for maps and poses
        features: features to compare
        split: which frames make the map
        poses: slam: SfM from the images, aligned to the given poses; known: landmarks triangulated from these
        weights: folder where the weights of networks are looked for first
    """
    out.mkdir(parents=True, exist_ok=True)
    given = read_poses(data)
    truths = given, cached_sfm(data, out, given)
    options = Options(split, poses, weights)
    print(HEADER, flush=True)
    rows = []
    for feature in features:
        try:
            rows.append(evaluate(feature, data, out, options=options, truths=truths))
            print(line(rows[-1]), flush=True)
        except WeightsError as error:
            print(f"| {feature} | {error.message} |" + " |" * 11, flush=True)
    text = json.dumps([dataclasses.asdict(row) for row in rows], indent=1)
    store.atomic_write(out / split / poses / "rows.json", text + "\n")


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except FieldkitError as error:
        raise SystemExit(f"redkitchen_table: {error}") from None
