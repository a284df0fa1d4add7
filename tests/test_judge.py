"""The judge: a known transform is found and taken out, and what does not belong together is refused."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic_map import make_map, write_map
from synthetic_run import make_run

from fieldkit import maps, store
from fieldkit.errors import FieldkitError, JudgeError
from fieldkit.frames import Pose, exp, pose_error, yaw_pose
from fieldkit.judge import fit_gauge, judge, nearest_distance, trimmed_mean
from fieldkit.surface import write_ply
from fieldkit.types import Run, SceneMap, Surface, TagMap, TagPose

WORLD_FROM_MAP = yaw_pose([12.0, -7.0, 1.5], 2.1)
COVARIANCE = np.diag([4e-6] * 3 + [1e-4] * 3)
TAG = TagPose(3, "tag36h11", 0.1365, yaw_pose([1.0, 2.0, 0.5], 0.4), COVARIANCE, 6, 0.3)
# Moved by 3 cm along one axis, of which the covariance makes three sigmas.
OFF = Pose.from_translation([0.03, 0.0, 0.0])


@dataclasses.dataclass(frozen=True)
class Lab:
    """A session's folder with nothing but its truth, and what was estimated in a map that stands elsewhere."""

    session: Path
    map: Path
    tags: Path
    run: Path

    @property
    def truth(self) -> Path:
        return self.session / "truth"

    def judge(self) -> dict[str, Any]:
        return judge(self.session, map_path=self.map, tags_path=self.tags, run_path=self.run)


def box(low: list[float], high: list[float]) -> Surface:
    """Return the six sides of a box."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [f for a, b, c, d in sides for f in ((a, b, c), (a, c, d))]
    return Surface(low + corners * (np.array(high) - low), np.array(faces, dtype=np.int32), 0.05)


def write_truth(truth: Path, scene_map: SceneMap, run: Run) -> None:
    named = zip(scene_map.image_names, scene_map.map_from_image, strict=True)
    store.write_tum(truth / "mapping_poses.txt", [(name, WORLD_FROM_MAP * p) for name, p in named])
    true_tag = dataclasses.replace(TAG, map_from_tag=WORLD_FROM_MAP * TAG.map_from_tag)
    store.write_tags(truth / "tags.toml", TagMap((true_tag,), (), "world"))
    true = {(t.visit, t.view): WORLD_FROM_MAP * t.map_from_cam for _, t in run.truths}
    store.write_tum(truth / "view_poses.txt", [(str(r.t_ns), true[r.visit, r.view]) for r in run.results])
    body = run.plans[0].prior.map_from_body
    store.write_tum(truth / "body_poses.txt", [(str(t), WORLD_FROM_MAP * body * OFF) for t in (0, 2_000_000_000)])


@pytest.fixture
def lab(tmp_path: Path, rng: np.random.Generator) -> Lab:
    """One visit; tag and prior are 3 cm off, the truth of the views is exact."""
    made = Lab(tmp_path / "session", tmp_path / "lab.map", tmp_path / "tags.toml", tmp_path / "run")
    write_map(made.map, make_map(rng, n_landmarks=200, n_images=12))
    scene_map = maps.load_map(made.map)
    tag = dataclasses.replace(TAG, map_from_tag=TAG.map_from_tag * OFF)
    store.write_tags(made.tags, TagMap((tag,), (), scene_map.digest))
    run = dataclasses.replace(make_run(n_visits=1), map_digest=scene_map.digest)
    store.write_run(made.run, run)
    write_truth(made.truth, scene_map, run)
    return made


def test_errors_are_those_that_were_made_after_the_map_s_own_place_is_taken_out(lab: Lab) -> None:
    found, run = lab.judge(), store.read_run(lab.run)
    assert found["gauge"]["rms_m"] < 1e-6
    assert found["map"]["gravity_deg"] < 1e-4
    for part in ("tags", "priors"):
        assert len(found[part]) == 1
        assert found[part][0]["position_m"] == pytest.approx(0.03, abs=1e-6)
        assert found[part][0]["rotation_deg"] < 1e-4
    assert found["tags"][0]["nees"] == pytest.approx(9.0, rel=1e-3)
    assert len(found["truths"]) == len(run.truths) == 14
    assert max(e["position_m"] for e in found["truths"]) < 1e-6
    failed = [r for r in run.results if r.estimate.map_from_cam is None]
    assert (found["estimates"]["n"], found["estimates"]["failed"]) == (14, len(failed))
    true = {(t.visit, t.view): t.map_from_cam for _, t in run.truths}
    errors = [
        np.inf if (pose := r.estimate.map_from_cam) is None else pose_error(pose, true[r.visit, r.view])[0]
        for r in run.results
    ]
    assert found["estimates"]["median_position_m"] == pytest.approx(np.median(errors), abs=1e-6)


def test_every_entry_has_the_keys_of_a_tag_s_and_a_session_without_a_run_has_every_part(lab: Lab) -> None:
    found = lab.judge()
    for part in ("tags", "priors", "truths"):
        for entry in found[part]:
            assert set(entry) >= {"id", "visit", "position_m", "rotation_deg", "nees"}
    assert [(e["id"], e["visit"]) for e in found["priors"]] == [("w01", "w01")]
    bare = judge(lab.session, map_path=lab.map, tags_path=None)
    assert set(bare) == set(found)
    assert bare["tags"] == bare["priors"] == bare["truths"] == []
    assert set(bare["estimates"]) == set(found["estimates"])
    assert (bare["estimates"].pop("n"), bare["estimates"].pop("failed")) == (0, 0)
    assert set(bare["estimates"].values()) == {None}


def change(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def rename_stamp(path: Path, new: str) -> None:
    """Give the second line of TUM poses another stamp."""
    lines = path.read_text().splitlines()
    lines[1] = " ".join([new, *lines[1].split()[1:]])
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda lab, digest: change(lab.tags, digest, "a" * 32),
         r"tags\.toml: calibrated in the map a{12}; expected \w{12}, .*; calibrate the tags in this map"),
        (lambda lab, digest: change(lab.run / "run.json", digest, "b" * 32),
         r"run: replayed in the map b{12}; expected \w{12}, .*; replay the session in this map"),
        (lambda lab, digest: rename_stamp(lab.truth / "view_poses.txt", "7"),
         r"view_poses\.txt: has no pose at 1000000000 ns, the view 01 of w01; expected .*; judge a run of this"),
        (lambda lab, digest: rename_stamp(lab.truth / "view_poses.txt", "1.5"),
         r"view_poses\.txt: the stamp '1\.5' is no whole number; expected nanoseconds"),
        (lambda lab, digest: rename_stamp(lab.truth / "body_poses.txt", "later"),
         r"body_poses\.txt: the stamp 'later' is no whole number; expected nanoseconds"),
        (lambda lab, digest: rename_stamp(lab.truth / "body_poses.txt", "9" * 30), r"the stamp '9{30}' is no"),
        (lambda lab, digest: rename_stamp(lab.truth / "body_poses.txt", "5"),
         r"body_poses\.txt: no pose at 1000000000 ns, the prior of w01: .*; judge a run of this session"),
        (lambda lab, digest: change(lab.tags, "id = 3", "id = 4"), r"truth/tags\.toml: has no tag 4"),
        (lambda lab, digest: (lab.truth / "mapping_poses.txt").write_text(""), r"shares 0 images with the session"),
    ],
)  # fmt: skip
def test_what_does_not_belong_together_is_one_line(lab: Lab, damage: object, message: str) -> None:
    damage(lab, maps.load_map(lab.map).digest)  # type: ignore[operator]
    with pytest.raises(JudgeError, match=message):
        lab.judge()


def test_a_folder_without_truth_is_refused(tmp_path: Path, lab: Lab) -> None:
    with pytest.raises(FieldkitError, match=r"has no truth/ folder"):
        judge(tmp_path, map_path=lab.map, tags_path=None)


def test_the_gauge_is_the_rigid_transform_and_scale_is_only_measured(rng: np.random.Generator) -> None:
    scene_map = make_map(rng)
    world_from_map = exp(rng.normal(size=6))
    pairs = list(zip(scene_map.image_names, scene_map.map_from_image, strict=True))
    exact = fit_gauge(scene_map, {name: world_from_map * p for name, p in pairs})
    assert max(pose_error(exact.world_from_map, world_from_map)) < 1e-9
    assert exact.max_m < 1e-9
    assert abs(exact.scale_error) < 1e-9
    # A world 2 % smaller than the map: the map is 2 % too large, and the rest of it stays as residual.
    shrunk = {name: world_from_map * Pose.from_components(p.translation / 1.02, p.rotation) for name, p in pairs}
    found = fit_gauge(scene_map, shrunk)
    assert found.scale_error == pytest.approx(0.02, abs=1e-9)
    assert pose_error(found.world_from_map, world_from_map)[1] < 1e-6
    centres = np.stack([p.translation for _, p in pairs])
    spread = np.linalg.norm(centres - centres.mean(axis=0), axis=1)
    assert found.rms_m == pytest.approx((1 - 1 / 1.02) * np.sqrt(np.mean(spread**2)), rel=1e-6)
    assert found.max_m == pytest.approx((1 - 1 / 1.02) * spread.max(), rel=1e-6)


def test_distances_to_a_box_are_exact(rng: np.random.Generator) -> None:
    low, high = np.array([-1.0, 0.0, 0.5]), np.array([2.0, 1.0, 1.5])
    points = rng.uniform(low - 0.5, high + 0.5, size=(200, 3))
    outside = np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0.0), axis=1)
    inside = np.minimum(points - low, high - points).min(axis=1)
    expected = np.where(outside > 0, outside, np.maximum(inside, 0.0))
    assert 20 < (outside == 0).sum() < 180
    found = nearest_distance(box([-1.0, 0.0, 0.5], [2.0, 1.0, 1.5]), points, rng=rng)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_the_landmark_error_is_the_distance_to_the_true_surface(lab: Lab) -> None:
    room = box([-3.0, -2.0, -1.0], [3.0, 2.0, 4.0])
    write_ply(lab.truth / "surface.ply", dataclasses.replace(room, vertices=WORLD_FROM_MAP.apply(room.vertices)))
    assert judge(lab.session, map_path=lab.map, tags_path=None)["map"]["landmark_median_m"] < 1e-5


def test_the_trimmed_mean_leaves_out_the_largest_share() -> None:
    assert trimmed_mean([]) is None
    assert trimmed_mean([5.0]) == 5.0
    assert trimmed_mean([6.0] * 99 + [1e9]) == 6.0
