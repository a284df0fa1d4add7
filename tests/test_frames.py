"""Laws of poses, covariances and trajectories."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fieldkit import frames
from fieldkit.errors import FrameError
from fieldkit.frames import Pose


def random_pose(rng: np.random.Generator, *, scale: float = 1.0) -> Pose:
    return Pose.from_components(rng.normal(size=3) * scale, Rotation.from_rotvec(rng.normal(size=3) * scale))


def test_exp_and_log_are_inverse(rng: np.random.Generator) -> None:
    d = rng.normal(size=6) * 0.5
    np.testing.assert_allclose(frames.log(frames.exp(d)), d, atol=1e-12)


def test_adjoint_carries_a_perturbation_to_the_other_side(rng: np.random.Generator) -> None:
    a_from_b, d = random_pose(rng), rng.normal(size=6) * 1e-6
    left = a_from_b * frames.exp(d)
    right = frames.exp(frames.adjoint(a_from_b) @ d) * a_from_b
    np.testing.assert_allclose(left.as_matrix(), right.as_matrix(), atol=1e-11)


def test_composed_covariance_is_the_one_of_samples(rng: np.random.Generator) -> None:
    a_from_b, b_from_c = random_pose(rng), random_pose(rng)
    roots = [np.diag(rng.uniform(0.5, 2.0, 6)) * 1e-3 for _ in range(2)]
    samples = np.array(
        [
            frames.log(
                (a_from_b * b_from_c).inv()
                * (a_from_b * frames.exp(roots[0] @ rng.normal(size=6)))
                * (b_from_c * frames.exp(roots[1] @ rng.normal(size=6)))
            )
            for _ in range(4000)
        ]
    )
    expected = frames.compose_covariance(roots[0] @ roots[0].T, b_from_c, roots[1] @ roots[1].T)
    np.testing.assert_allclose(samples.T @ samples / len(samples), expected, atol=0.08 * np.abs(expected).max())


def test_inverse_covariance_twice_is_the_covariance(rng: np.random.Generator) -> None:
    pose, covariance = random_pose(rng), np.diag(rng.uniform(1, 2, 6))
    back = frames.inverse_covariance(pose.inv(), frames.inverse_covariance(pose, covariance))
    np.testing.assert_allclose(back, covariance, atol=1e-9)


def test_mean_with_covariances_weighs_by_information(rng: np.random.Generator) -> None:
    centre = random_pose(rng)
    near, far = centre * frames.exp([0, 0, 0, 0.1, 0, 0]), centre * frames.exp([0, 0, 0, -0.9, 0, 0])
    mean, covariance = frames.mean_pose([near, far], covariances=[np.eye(6), 9 * np.eye(6)])
    np.testing.assert_allclose(frames.log(centre.inv() * mean), np.zeros(6), atol=1e-9)
    np.testing.assert_allclose(covariance, 0.9 * np.eye(6), atol=1e-9)


def test_no_pose_has_no_mean() -> None:
    with pytest.raises(FrameError, match="at least one"):
        frames.mean_pose([])


def test_a_missing_estimate_is_infinitely_wrong() -> None:
    assert frames.pose_error(None, Pose.identity()) == (np.inf, np.inf)


def test_pose_error_does_not_depend_on_the_frame_of_the_map(rng: np.random.Generator) -> None:
    estimate, truth, shift = (random_pose(rng) for _ in range(3))
    np.testing.assert_allclose(
        frames.pose_error(shift * estimate, shift * truth), frames.pose_error(estimate, truth), rtol=1e-9
    )


def test_a_skewed_matrix_is_projected_to_the_nearest_rotation() -> None:
    skewed = np.eye(4)
    skewed[:3, :3] *= 0.9997
    assert frames.pose_error(frames.pose_from_matrix(skewed), Pose.identity())[1] < 1e-12


@pytest.mark.parametrize("quaternion", [[0, 0, 0, 0], [0, 0, 0, 2], [np.nan, 0, 0, 1]])
def test_a_quaternion_that_is_no_rotation_is_refused(quaternion: list[float]) -> None:
    with pytest.raises(FrameError, match="unit quaternion"):
        frames.pose([0, 0, 0], quaternion)


class TestTrajectory:
    def make(self) -> frames.Trajectory:
        poses = tuple(frames.yaw_pose([x, 0, 0], 0.1 * x) for x in (0.0, 1.0, 2.0, 9.0))
        times = np.array([0, 100, 200, 10**9], dtype=np.int64)
        return frames.Trajectory(times, poses, "odom", "body")

    def test_interpolates_between_samples(self) -> None:
        pose = self.make().at(150)
        np.testing.assert_allclose(pose.translation, [1.5, 0, 0])
        np.testing.assert_allclose(pose.rotation.as_rotvec(), [0, 0, 0.15])

    def test_returns_the_sample_itself_at_its_time(self) -> None:
        trajectory = self.make()
        assert trajectory.at(200) is trajectory.poses[2]

    @pytest.mark.parametrize(("t_ns", "what"), [(-1, "outside"), (10**9 + 1, "outside"), (5000, "gap")])
    def test_refuses_to_guess(self, t_ns: int, what: str) -> None:
        with pytest.raises(FrameError, match=f"odom_from_body at {t_ns} ns: .*{what}"):
            self.make().at(t_ns)
