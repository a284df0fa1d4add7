"""Views and policies on a small synthetic map: what is visible, what is counted, and what cannot matter."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from fieldkit import policies
from fieldkit.cameras import Camera
from fieldkit.errors import PolicyError
from fieldkit.frames import Pose, exp
from fieldkit.protocol import CandidateRules, OcclusionRules, Protocol, Threshold
from fieldkit.surface import RayCaster
from fieldkit.types import Candidates, SceneMap, Surface
from fieldkit.views import HeatMaps, landmark_statistics, visibility

CAMERA = Camera("PINHOLE", 640, 480, (552.03, 552.03, 320.0, 240.0))
RULES = CandidateRules(max_distance_m=5.0)
BODY_FROM_CAM = Rotation.from_matrix([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def look(position_m: list[float], yaw_deg: float, *, pitch_deg: float = 0.0) -> Pose:
    """Return map_from_cam of a camera that looks along a yaw, pitch positive upwards."""
    turn = Rotation.from_euler("ZY", [yaw_deg, -pitch_deg], degrees=True)
    return Pose.from_components(position_m, turn * BODY_FROM_CAM)


def make_map(xyz: np.ndarray, mapping: list[Pose], *, surface: Surface | None = None) -> SceneMap:
    """Make a map in which every mapping camera observed every landmark."""
    n, k = len(xyz), len(mapping)
    return SceneMap(
        path="lab.map",
        digest="digest",
        feature="sift",
        xyz=xyz,
        xyz_covariance=np.tile(np.eye(3) * 1e-6, (n, 1, 1)),
        image_names=tuple(f"{i}.jpg" for i in range(k)),
        image_cameras=(CAMERA,) * k,
        map_from_image=tuple(mapping),
        observation_landmark=np.tile(np.arange(n, dtype=np.int32), k),
        observation_image=np.repeat(np.arange(k, dtype=np.int32), n),
        observation_px=np.zeros((n * k, 2), np.float32),
        descriptors=np.zeros((0, 128), np.uint8),
        descriptor_landmark=np.zeros(0, np.int32),
        descriptor_image=np.zeros(0, np.int32),
        surface=surface,
    )


def make_candidates(*poses: Pose, kinds: tuple[str, ...] = ()) -> Candidates:
    kinds = kinds or ("sweep",) * len(poses)
    names = tuple(str(i) for i in range(len(poses)))
    return Candidates("w", names, kinds, poses, CAMERA, np.array([k == "sweep" for k in kinds]), np.array([1.0, 0, 0]))


@pytest.fixture
def scene_map(rng: np.random.Generator) -> SceneMap:
    """Twenty landmarks ahead (x = 3) and five to the left (y = 3); mapped from the origin and from behind it."""
    ahead = np.column_stack([np.full(20, 3.0), rng.uniform(-0.5, 0.5, (20, 2))])
    left = np.column_stack([rng.uniform(-0.5, 0.5, 5), np.full(5, 3.0), rng.uniform(-0.5, 0.5, 5)])
    mapping = [look([0, 0, 0], 0), look([-1, 0, 0], 0), look([0, 0.5, 0.2], 45)]
    return make_map(np.vstack([ahead, left]), mapping)


def utilities(scene_map: SceneMap, candidates: Candidates, name: str, *, rays: RayCaster | None = None) -> np.ndarray:
    scene = policies.look_at(
        scene_map, landmark_statistics(scene_map), candidates, rules=RULES, rays=rays, tolerance_m=0.05
    )
    return policies.utility(policies.available(name), scene)


def wall(x_m: float) -> Surface:
    corners = np.array([[x_m, -2, -2], [x_m, 2, -2], [x_m, 2, 2], [x_m, -2, 2]], dtype=np.float64)
    return Surface(corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32), voxel_m=0.04)


def test_max_counts_what_the_image_shows(scene_map: SceneMap) -> None:
    candidates = make_candidates(look([0, 0, 0], 0), look([0, 0, 0], 90), look([0, 0, 0], 180))
    assert utilities(scene_map, candidates, "max").tolist() == [20, 5, 0]


def test_landmarks_beyond_the_distance_limit_are_not_counted(scene_map: SceneMap) -> None:
    assert utilities(scene_map, make_candidates(look([-3, 0, 0], 0)), "max").tolist() == [0]


def test_a_wall_hides_what_is_behind_it_only_with_the_filter(scene_map: SceneMap) -> None:
    candidates = make_candidates(look([0, 0, 0], 0), look([0, 0, 0], 90))
    rays = RayCaster(wall(2.0))
    assert utilities(scene_map, candidates, "max").tolist() == [20, 5]
    assert utilities(scene_map, candidates, "max", rays=rays).tolist() == [0, 5]


def test_only_the_rows_with_the_filter_are_filtered(scene_map: SceneMap) -> None:
    known = dataclasses.replace(scene_map, surface=wall(2.0))
    candidates = make_candidates(look([0, 0, 0], 0), look([0, 0, 0], 90))
    found = policies.Looker(known, protocol_with(use=(False, True))).utilities(candidates)
    assert found["max", False].tolist() == [20, 5]
    assert found["max", True].tolist() == [0, 5]


def test_the_surface_that_carries_a_landmark_does_not_hide_it(scene_map: SceneMap) -> None:
    rays = RayCaster(wall(2.97))
    assert utilities(scene_map, make_candidates(look([0, 0, 0], 0)), "max", rays=rays).tolist() == [20]


def test_inside_a_closed_surface_every_utility_ties(scene_map: SceneMap) -> None:
    box = Surface(
        np.array([[x, y, z] for x in (-0.2, 0.2) for y in (-0.2, 0.2) for z in (-0.2, 0.2)]),
        np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
                  [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]], dtype=np.int32),
        voxel_m=0.04,
    )  # fmt: skip
    candidates = make_candidates(look([0, 0, 0], 0), look([0, 0, 0], 90))
    assert utilities(scene_map, candidates, "fim", rays=RayCaster(box)).tolist() == [0, 0]


def test_angle_counts_only_directions_from_which_mapping_saw(scene_map: SceneMap) -> None:
    seen, unseen = look([-0.5, 0, 0], 0), look([3.2, -2.5, 0], 95)
    assert utilities(scene_map, make_candidates(seen, unseen), "max")[1] > 0
    counted = utilities(scene_map, make_candidates(seen, unseen), "angle")
    assert counted[0] >= 15
    assert counted[1] == 0


def test_statistics_are_those_of_the_observing_cameras(scene_map: SceneMap) -> None:
    known = landmark_statistics(scene_map)
    centres = np.array([p.translation for p in scene_map.map_from_image])
    distances = np.linalg.norm(scene_map.xyz[:, None] - centres, axis=2)
    np.testing.assert_allclose(known.min_distance_m, distances.min(axis=1))
    np.testing.assert_allclose(known.max_distance_m, distances.max(axis=1))
    first_axis_angle = np.arctan2(np.linalg.norm(scene_map.xyz[0, 1:]), scene_map.xyz[0, 0])
    assert known.min_angle_rad[0] <= first_axis_angle <= known.max_angle_rad[0]
    assert (known.n_observations == 3).all()


def test_heat_maps_say_where_in_their_images_mapping_saw_a_landmark(scene_map: SceneMap) -> None:
    pixels = np.zeros((75, 2), np.float32)
    seen = scene_map.observation_landmark == 7
    pixels[seen] = [(0.5, 0.5), (639.9, 479.9), (320.0, 100.0)]
    moved = dataclasses.replace(scene_map, observation_px=pixels)
    heat = HeatMaps(moved).counts(np.array([7, 3, 7]))
    assert heat.shape == (3, 8, 8)
    expected = np.zeros((8, 8), np.float32)
    expected[[0, 7, 1], [0, 7, 4]] = 1
    np.testing.assert_allclose(heat[0], expected)
    np.testing.assert_array_equal(heat[2], heat[0])
    assert heat[1, 0, 0] == 3
    assert (heat.sum(axis=(1, 2)) == 3).all()
    assert HeatMaps(moved).counts(np.array([], np.int32)).shape == (0, 8, 8)


def test_the_image_of_another_camera_has_cells_of_its_own_size(scene_map: SceneMap) -> None:
    portrait = Camera("PINHOLE", 480, 640, (552.03, 552.03, 240.0, 320.0))
    pixels = np.full((75, 2), 470.0, np.float32)
    turned = dataclasses.replace(scene_map, image_cameras=(CAMERA, CAMERA, portrait), observation_px=pixels)
    heat = HeatMaps(turned).counts(np.array([0]))[0]
    assert (heat[7, 5], heat[5, 7]) == (2, 1)


class CountingRays(RayCaster):
    """Rays that are counted."""

    count = 0

    def hit_distance(self, origins: ArrayLike, directions: ArrayLike) -> np.ndarray:
        self.count += len(np.asarray(directions))
        return super().hit_distance(origins, directions)


def test_one_ray_is_cast_per_landmark_and_distinct_centre(scene_map: SceneMap) -> None:
    centres = [[0.0, 0.0, 0.0], [0.1, 0.3, 0.0], [1e-12, 0.0, 0.0]]
    turned = [look(c, yaw) for c in centres for yaw in (-10, 0, 10, 20, 80)]
    candidates = make_candidates(*turned)
    plain = visibility(scene_map, candidates, rules=RULES)
    wanted = 0
    for rows in ((*range(5), *range(10, 15)), range(5, 10)):
        wanted += len(np.unique(np.concatenate([plain.landmarks[i] for i in rows])))
    rays = CountingRays(wall(1.5))
    visibility(scene_map, candidates, rules=RULES, rays=rays, tolerance_m=0.05)
    assert rays.count == wanted
    assert wanted < sum(map(len, plain.landmarks)) / 2


def test_a_map_without_surface_serves_all_rows_but_those_with_the_filter(scene_map: SceneMap) -> None:
    protocol = protocol_with(use=(False, True))
    utilities_by = policies.Looker(scene_map, protocol).utilities(make_candidates(look([0, 0, 0], 0)))
    assert set(utilities_by) == {("max", False), ("random", None)}
    policies.check_map(scene_map, protocol)
    missing = policies.unfiltered(scene_map, protocol)
    assert missing is not None
    assert missing.what == "max with occlusion"
    assert "lab.map has no surface" in missing.reason
    with pytest.raises(PolicyError, match="has no surface"):
        policies.check_map(scene_map, protocol_with(use=(True,)))
    whole = dataclasses.replace(scene_map, surface=wall(1.5))
    assert policies.unfiltered(whole, protocol) is None
    assert policies.unfiltered(scene_map, protocol_with(use=(False,))) is None


def protocol_with(*, use: tuple[bool, ...]) -> Protocol:
    return Protocol("p", (Threshold(0.1, 1.0),), ("max", "random"), occlusion=OcclusionRules(use=use))


def test_fisher_information_is_the_trace_of_the_numeric_one(scene_map: SceneMap) -> None:
    map_from_cam, sigma = look([0.3, 0.2, 0.1], 10), 1 / 552.03

    def bearings(d: np.ndarray) -> np.ndarray:
        x = (map_from_cam * exp(d)).inv().apply(scene_map.xyz)
        return x / np.linalg.norm(x, axis=1, keepdims=True)

    step = 1e-6
    jacobian = np.stack([(bearings(step * e) - bearings(-step * e)) / (2 * step) for e in np.eye(6)], axis=-1)
    per_landmark = np.sum(jacobian**2, axis=(1, 2)) / sigma**2
    seen = visibility(scene_map, make_candidates(map_from_cam), rules=RULES).landmarks[0]
    np.testing.assert_allclose(
        utilities(scene_map, make_candidates(map_from_cam), "fim"), [per_landmark[seen].sum()], rtol=1e-6
    )


@pytest.mark.parametrize("name", ["max", "angle", "fim", "random", "forward"])
def test_turning_and_shifting_the_whole_map_changes_no_utility(
    scene_map: SceneMap, name: str, rng: np.random.Generator
) -> None:
    shift = Pose.from_components(rng.normal(size=3) * 10, Rotation.from_rotvec(rng.normal(size=3)))
    moved = dataclasses.replace(
        scene_map,
        xyz=shift.apply(scene_map.xyz),
        map_from_image=tuple(shift * p for p in scene_map.map_from_image),
    )
    candidates = make_candidates(*(look([0.1, 0.2, 0], yaw) for yaw in (0, 20, 90, 200)))
    turned = dataclasses.replace(
        candidates,
        map_from_cam=tuple(shift * p for p in candidates.map_from_cam),
        forward_in_map=shift.rotation.apply([1.0, 0, 0]),
    )
    rays = RayCaster(wall(2.0))
    rays_moved = RayCaster(dataclasses.replace(wall(2.0), vertices=shift.apply(wall(2.0).vertices)))
    np.testing.assert_allclose(
        utilities(moved, turned, name, rays=rays_moved), utilities(scene_map, candidates, name, rays=rays), atol=1e-7
    )


def test_random_ties_the_allowed_views(scene_map: SceneMap) -> None:
    candidates = make_candidates(
        look([0, 0, 0], 0), look([0, 0, 0], 9), look([0, 0, 0], 5), kinds=("sweep", "sweep", "stowed")
    )
    assert utilities(scene_map, candidates, "random").tolist() == [0, 0, -np.inf]


@pytest.mark.parametrize("name", ["stowed", "forward"])
def test_a_recorded_view_is_chosen_by_the_policy_of_its_name_only(scene_map: SceneMap, name: str) -> None:
    candidates = make_candidates(look([0, 0, 0], 0), look([0, 0, 0], 9), kinds=("sweep", name))
    assert utilities(scene_map, candidates, name).tolist() == [-np.inf, 0]
    assert utilities(scene_map, candidates, "max")[1] == -np.inf


def test_without_a_forward_view_the_nearest_to_the_path_is_chosen(scene_map: SceneMap) -> None:
    candidates = make_candidates(look([0, 0, 0], 90), look([0, 0, 0], 10), look([0, 0, 0], -30))
    assert utilities(scene_map, candidates, "forward").argmax() == 1


def test_without_a_stowed_view_nothing_is_allowed(scene_map: SceneMap) -> None:
    assert utilities(scene_map, make_candidates(look([0, 0, 0], 0)), "stowed").tolist() == [-np.inf]


def test_an_unknown_policy_is_refused_with_a_suggestion() -> None:
    with pytest.raises(PolicyError, match="unknown policy 'maxx'; did you mean 'max'"):
        policies.available("maxx")


def test_a_policy_without_weights_says_so() -> None:
    with pytest.raises(PolicyError, match="policy 'vpt_dino' has no weights in this version; train it"):
        policies.available("vpt_dino")


def test_no_policy_is_given_images_estimates_or_truth() -> None:
    names = {f.name for f in dataclasses.fields(policies.Scene)} | {f.name for f in dataclasses.fields(Candidates)}
    assert names == {
        "candidates", "visible", "statistics", "heat_maps", "filtered",
        "visit", "view_ids", "kinds", "map_from_cam", "camera", "allowed", "forward_in_map",
    }  # fmt: skip


def test_another_name_of_a_map_s_feature_is_that_feature(scene_map: SceneMap) -> None:
    rules = Protocol("mine", (Threshold(0.1, 1.0),), ("forward",))
    policies.check_map(scene_map, msgspec.structs.replace(rules, feature="rootsift"))
    with pytest.raises(PolicyError, match="made with feature 'sift'; the protocol mine expects 'aliked'"):
        policies.check_map(scene_map, msgspec.structs.replace(rules, feature="aliked"))
