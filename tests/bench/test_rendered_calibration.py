"""How accurate tag calibration is through rendered photos, maps built from images, and localization: `make bench`.

Five sessions of the demo's room with five tags each, 12 photos of 12 megapixels of every tag, of which the first 8 that
are localized count; tags with fewer than 4 do not. Each session has its own map, built from its own mapping walk. Truth
is that of the renderer, after one rigid fit of the map to the mapping cameras, as in `fieldkit judge`. Nothing here
passes or fails.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from calibration_table import Outcome, errors, table

from fieldkit.calibrate import calibrate_photos
from fieldkit.calibrate.adjustment import Corners, FixedLandmarks, State, adjust
from fieldkit.calibrate.geometry import Poses
from fieldkit.calibrate.locating import LocatedPhoto, locate
from fieldkit.calibrate.photos import find_tags, list_photos
from fieldkit.calibrate.solving import SolvedTag, place_photos, solve_tags
from fieldkit.frames import Pose, exp, log, mean_pose
from fieldkit.maps import MapWarp, build_map, fit_gauge, load_map, map_warp
from fieldkit.store import read_tags, read_tum
from fieldkit.tags import solve, tag_corners
from fieldkit.types import SceneMap
from sim_bridge.mapping.photographer import PhotoOptions
from sim_bridge.recording.schedule import ScheduleOptions
from sim_bridge.stage.staging import StageOptions
from sim_bridge.synthesize import SessionOptions, synthesize

Array = NDArray[np.float64]
SEEDS, SIZE_M, DRAWS = range(5), 0.1365, 200
TAKEN, COUNTED, ENOUGH = 12, 8, 4
SIZES = {None: SIZE_M}


@dataclasses.dataclass(frozen=True)
class Trial:
    """One tag: its photos as localized, the map that they are in, and where tag and cameras truly are in it."""

    photos: tuple[LocatedPhoto, ...]
    xyz: Array
    covariance: Array
    warp: MapWarp
    map_from_tag: Pose
    map_from_cams: tuple[Pose, ...]


def session(folder: Path, seed: int, photos: PhotoOptions, *, waypoints: int = 4) -> Path:
    """Synthesize a session of the demo's room and build its map beside it."""
    if not (folder / "lab.map" / "map.toml").is_file():
        options = SessionOptions(
            photos=photos, stage=StageOptions(waypoints=waypoints), schedule=ScheduleOptions(starts="once")
        )
        synthesize("room", folder / "session", seed=seed, options=options)
        build_map(folder / "session" / "mapping", folder / "lab.map")
    return folder


def trials(folder: Path) -> list[Trial]:
    """Localize a session's photos and return them tag by tag."""
    scene_map = load_map(folder / "lab.map")
    truth, photos = folder / "session" / "truth", folder / "session" / "photos"
    map_from_world = fit_gauge(scene_map, dict(read_tum(truth / "mapping_poses.txt"))).world_from_map.inv()
    cams = dict(read_tum(truth / "photo_poses.txt"))
    shots, _ = find_tags(photos, list_photos(photos, None), SIZES, ("tag36h11",), None)
    located, _ = locate(shots, scene_map, None, None)
    warp = map_warp(scene_map)
    found = [
        of_tag(
            [p for p in located if [d.id for d in p.detections] == [tag.id]][:COUNTED],
            scene_map,
            warp,
            map_from_world * tag.map_from_tag,
            {name: map_from_world * pose for name, pose in cams.items()},
        )
        for tag in read_tags(truth / "tags.toml").tags
    ]
    return [t for t in found if len(t.photos) >= ENOUGH]


def of_tag(
    photos: Sequence[LocatedPhoto], scene_map: SceneMap, warp: MapWarp, tag: Pose, cams: dict[str, Pose]
) -> Trial:
    cams_of = tuple(cams[p.file] for p in photos)
    return Trial(tuple(photos), scene_map.xyz, scene_map.xyz_covariance, warp, tag, cams_of)


def displaced(rng: np.random.Generator, trial: Trial, index: int) -> Trial:
    """Localize a photo wrongly by 0.3 to 2 m: its landmarks, and so the photo, are elsewhere, all else fits."""
    direction = rng.normal(size=3)
    direction *= rng.uniform(0.3, 2.0) / np.linalg.norm(direction)
    photo = trial.photos[index]
    centre = Pose.from_translation(trial.map_from_tag.translation)
    wrong = centre * exp([*rng.normal(0, math.radians(5), 3), *direction]) * centre.inv()
    rows = len(trial.xyz) + np.arange(len(photo.landmark))
    turn = wrong.rotation.as_matrix()
    own = (3 * photo.landmark[:, None] + np.arange(3)).ravel()
    turns = scipy.sparse.block_diag([turn] * len(rows))
    pulls = scipy.sparse.csr_array(scipy.sparse.vstack([trial.warp.pulls, turns @ trial.warp.pulls[own]]))
    moved = dataclasses.replace(photo, map_from_cam=wrong * photo.map_from_cam, landmark=rows)
    return dataclasses.replace(
        trial,
        photos=tuple(moved if i == index else p for i, p in enumerate(trial.photos)),
        xyz=np.concatenate([trial.xyz, wrong.apply(trial.xyz[photo.landmark])]),
        covariance=np.concatenate([trial.covariance, turn @ trial.covariance[photo.landmark] @ turn.T]),
        warp=dataclasses.replace(trial.warp, pulls=pulls),
    )


def flipped(trial: Trial, index: int) -> Trial:
    """Put a photo's corners where the other planar solution has them."""
    photo = trial.photos[index]
    (detection,) = photo.detections
    other = solve(detection, photo.camera, SIZE_M).alternative
    assert other is not None
    corners = photo.camera.project(other.apply(tag_corners(SIZE_M)))[0]
    shown = dataclasses.replace(photo, detections=(dataclasses.replace(detection, corners_px=corners),))
    return dataclasses.replace(trial, photos=tuple(shown if i == index else p for i, p in enumerate(trial.photos)))


def flippable(photo: LocatedPhoto) -> bool:
    return solve(photo.detections[0], photo.camera, SIZE_M).alternative is not None


def run(trial: Trial, seed: int, *, spoil: bool) -> Outcome:
    rng = np.random.default_rng([seed, int(spoil)])
    given, wrong = trial, set[int]()
    if spoil:
        order = [int(i) for i in rng.permutation(len(trial.photos))]
        for i in order[:2]:
            given = displaced(rng, given, i)
        both = [i for i in order[2:] if flippable(trial.photos[i])]
        given = flipped(given, both[0])
        wrong = {*order[:2], both[0]}
    tag = calibrated(given)
    good = [p for i, p in enumerate(trial.photos) if i not in wrong]
    alone = calibrated(dataclasses.replace(trial, photos=tuple(good))) if spoil else tag
    error = log(tag.map_from_tag.inv() * trial.map_from_tag)
    rejected = {s.sighted.photo for s in tag.sightings if not s.used}
    named = rejected | {s.sighted.photo for s in tag.sightings if s.flipped}
    return Outcome(
        errors(tag.map_from_tag, trial.map_from_tag),
        errors(alone.map_from_tag, trial.map_from_tag),
        errors(plain_mean(given), trial.map_from_tag),
        rng.normal(size=(DRAWS, 6)) @ np.linalg.cholesky(crb(trial, wrong)).T,
        error / np.sqrt(np.diag(tag.covariance)),
        float(error @ np.linalg.solve(tag.covariance, error)) / 6,
        len(wrong - named),
        len(rejected - wrong),
    )


def calibrated(trial: Trial) -> SolvedTag:
    (tag,) = solve_tags(trial.photos, trial.xyz, trial.covariance, sizes_m=SIZES, warp=trial.warp).tags
    return tag


def crb(trial: Trial, left_out: set[int]) -> Array:
    """Return the Cramer-Rao bound on the tag's covariance: inverse information of the good photos, at the truth.

    Noise of keypoints and landmarks is what their residuals show; errors that all landmarks share are in it.
    """
    good = [i for i in range(len(trial.photos)) if i not in left_out]
    photos = [trial.photos[i] for i in good]
    fixed, _ = place_photos(photos, trial.xyz, trial.covariance, trial.warp)
    corners = Corners.of([(i, 0, p.camera, d) for i, p in enumerate(photos) for d in p.detections])
    cams = Poses.of([trial.map_from_cams[i] for i in good])
    state = State(cams, Poses.of([trial.map_from_tag]), np.array([SIZE_M]))
    at_truth = FixedLandmarks(cams, fixed.normal, 0.0)
    return adjust(at_truth, corners, state, used=np.ones(len(corners), dtype=bool), iterations=0).tag_covariance(0)


def plain_mean(trial: Trial) -> Pose:
    """Return the mean of what each photo has by itself: as it is localized, and its better planar solution."""
    return mean_pose([p.map_from_cam * solve(p.detections[0], p.camera, SIZE_M).cam_from_tag for p in trial.photos])[0]


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> list[Trial]:
    folder = tmp_path_factory.mktemp("rendered")
    options = PhotoOptions(start_photos=TAKEN, tripod_photos=TAKEN)
    return [t for seed in SEEDS for t in trials(session(folder / str(seed), seed, options))]


@pytest.mark.benchmark(group="tags")
def test_accuracy_through_rendered_photos(
    benchmark: Any, capsys: pytest.CaptureFixture[str], rendered: list[Trial]
) -> None:
    spoilt = [t for t in rendered if len(t.photos) == COUNTED]

    def both() -> dict[str, list[Outcome]]:
        return {
            f"clean, {len(rendered)} tags": [run(t, i, spoil=False) for i, t in enumerate(rendered)],
            f"2 localized wrongly, 1 flipped, {len(spoilt)} tags": [
                run(t, i, spoil=True) for i, t in enumerate(spoilt)
            ],
        }

    rows = benchmark.pedantic(both, rounds=1, iterations=1)
    with capsys.disabled():
        print("\n" + table(rows))  # noqa: T201


@pytest.mark.benchmark(group="tags")
def test_calibrate_twenty_photos_of_24_megapixels(benchmark: Any, tmp_path: Path) -> None:
    folder = session(tmp_path, 0, PhotoOptions(start_photos=14, tripod_photos=6, scale=math.sqrt(2.0)), waypoints=1)
    photos, scene_map = folder / "session" / "photos", folder / "lab.map"
    found = benchmark.pedantic(
        lambda: calibrate_photos(photos, load_map(scene_map), sizes_m=SIZES), rounds=3, warmup_rounds=1
    )
    assert len(found.photos) == 20
