"""The transform buffer: composition over any tree, interpolation, and refusal where it would have to guess."""

from __future__ import annotations

import numpy as np
import pytest

from fieldkit.bags import TfBuffer
from fieldkit.errors import FrameError
from fieldkit.frames import Pose, exp, interpolate, pose, pose_error, position_quaternion

SECOND = 1_000_000_000


def random_pose(rng: np.random.Generator) -> Pose:
    return exp(rng.normal(size=6))


def put(buffer: TfBuffer, parent: str, child: str, a_from_b: Pose, *, t_ns: int | None = None) -> None:
    xyz, quaternion = position_quaternion(a_from_b)
    if t_ns is None:
        buffer.add_static(parent, child, xyz, quaternion)
    else:
        buffer.add(parent, child, t_ns, position_m=xyz, quaternion_xyzw=quaternion)


def assert_same(a: Pose, b: Pose) -> None:
    assert max(pose_error(a, b)) < 1e-12


def test_lookups_compose_and_invert_over_a_random_tree(rng: np.random.Generator) -> None:
    buffer, root_from = TfBuffer(), {"f0": Pose.identity()}
    for i in range(1, 12):
        parent, step = f"f{rng.integers(i)}", random_pose(rng)
        put(buffer, parent, f"f{i}", step, t_ns=None if i % 2 else 5)
        root_from[f"f{i}"] = root_from[parent] * step
    for a in root_from:
        for b in root_from:
            assert_same(buffer.lookup(a, b, t_ns=5), root_from[a].inv() * root_from[b])


def test_moving_transform_is_interpolated_between_samples_in_any_order_of_arrival(rng: np.random.Generator) -> None:
    buffer, first, second = TfBuffer(), random_pose(rng), random_pose(rng)
    put(buffer, "body", "hand", second, t_ns=SECOND // 2)
    put(buffer, "body", "hand", first, t_ns=0)
    assert_same(buffer.lookup("body", "hand", t_ns=SECOND // 8), interpolate(first, second, 0.25))
    assert_same(buffer.lookup("body", "hand", t_ns=SECOND // 2), second)


def test_many_times_at_once_give_what_each_gives_alone(rng: np.random.Generator) -> None:
    buffer = TfBuffer()
    put(buffer, "hand", "camera", random_pose(rng))
    for i in range(20):
        put(buffer, "body", "hand", random_pose(rng), t_ns=i * SECOND // (2 if i > 10 else 5))
    stamps = [int(t) for t in rng.integers(-SECOND, 11 * SECOND, size=50)]
    together = buffer.lookup_all("body", "camera", t_ns=stamps)
    assert {type(found) for found in together} == {Pose, FrameError}
    for t_ns, found in zip(stamps, together, strict=True):
        if isinstance(found, FrameError):
            with pytest.raises(FrameError) as alone:
                buffer.lookup("body", "camera", t_ns=t_ns)
            assert str(alone.value) == str(found)
        else:
            assert_same(buffer.lookup("body", "camera", t_ns=t_ns), found)


def test_static_transform_holds_at_every_time_and_the_last_one_counts(rng: np.random.Generator) -> None:
    buffer, new = TfBuffer(), random_pose(rng)
    put(buffer, "hand", "camera", random_pose(rng))
    put(buffer, "hand", "camera", new)
    for t_ns in (0, 7, 10**18):
        assert_same(buffer.lookup("hand", "camera", t_ns=t_ns), new)


def test_first_of_equal_stamps_counts(rng: np.random.Generator) -> None:
    buffer, first = TfBuffer(), random_pose(rng)
    put(buffer, "a", "b", first, t_ns=3)
    put(buffer, "a", "b", random_pose(rng), t_ns=3)
    assert_same(buffer.lookup("a", "b", t_ns=3), first)


@pytest.mark.parametrize("t_ns", [-1, SECOND // 2 + 1])
def test_extrapolation_is_refused_and_names_the_frames(t_ns: int) -> None:
    buffer = TfBuffer()
    for t in (0, SECOND // 2):
        put(buffer, "link1", "link2", Pose.identity(), t_ns=t)
    put(buffer, "link2", "camera", Pose.identity())
    with pytest.raises(FrameError, match=r"'link1' from 'link2'.*outside of its samples 0\.000 \.\. 0\.500 s"):
        buffer.lookup("link1", "camera", t_ns=t_ns)


def test_gap_of_more_than_half_a_second_is_refused() -> None:
    buffer = TfBuffer()
    for t in (0, SECOND // 2, SECOND + 1):
        put(buffer, "a", "b", Pose.identity(), t_ns=t)
    buffer.lookup("a", "b", t_ns=SECOND // 4)
    with pytest.raises(FrameError, match=r"'a' from 'b' at 0\.750 s: in a gap of 0\.50 s; at most 0\.50 s"):
        buffer.lookup("a", "b", t_ns=3 * SECOND // 4)


def test_gap_above_the_common_frame_does_not_matter(rng: np.random.Generator) -> None:
    buffer, expected = TfBuffer(), random_pose(rng)
    put(buffer, "odom", "body", random_pose(rng), t_ns=0)
    put(buffer, "body", "hand", expected)
    assert_same(buffer.lookup("body", "hand", t_ns=99 * SECOND), expected)


def test_frames_that_are_not_connected_are_named_with_their_roots() -> None:
    buffer = TfBuffer()
    put(buffer, "odom", "body", Pose.identity())
    put(buffer, "hand", "camera", Pose.identity())
    with pytest.raises(
        FrameError, match=r"'camera' \(below 'hand'\) with 'body' \(below 'odom'\); frames: body, camera"
    ):
        buffer.lookup("body", "camera", t_ns=0)
    with pytest.raises(FrameError, match=r"'lens' \(below 'lens'\)"):
        buffer.lookup("body", "lens", t_ns=0)
    with pytest.raises(FrameError, match="frames: none"):
        TfBuffer().lookup("a", "b", t_ns=0)


def test_loop_is_refused() -> None:
    buffer = TfBuffer()
    for parent, child in (("a", "b"), ("b", "c"), ("c", "a")):
        put(buffer, parent, child, Pose.identity())
    with pytest.raises(FrameError, match="loop: c below b below a below c"):
        buffer.lookup("a", "c", t_ns=0)


def test_leading_slash_of_ros_1_names_the_same_frame(rng: np.random.Generator) -> None:
    buffer, expected = TfBuffer(), random_pose(rng)
    put(buffer, "/body", "/hand", expected, t_ns=1)
    assert_same(buffer.lookup("body", "/hand", t_ns=1), expected)
    assert buffer.frames == ("body", "hand")


def test_frame_that_changes_its_parent_follows_the_one_of_that_time(rng: np.random.Generator) -> None:
    buffer, on_table, in_hand = TfBuffer(), random_pose(rng), random_pose(rng)
    for t in (0, 1, 2):
        put(buffer, "table", "cup", on_table, t_ns=t)
    for t in (5, 6, 7):
        put(buffer, "hand", "cup", in_hand, t_ns=t)
    assert_same(buffer.lookup("table", "cup", t_ns=1), on_table)
    assert_same(buffer.lookup("hand", "cup", t_ns=6), in_hand)
    with pytest.raises(FrameError, match="does not connect"):
        buffer.lookup("table", "cup", t_ns=6)


@pytest.mark.parametrize(
    ("position", "quaternion"),
    [
        ((np.nan, 0, 0), (0, 0, 0, 1)),
        ((np.inf, 0, 0), (0, 0, 0, 1)),
        ((0, 0, 0), (0, 0, 0, 0)),
        ((0, 0, 0), (0, 0, 0, np.nan)),
    ],
)
def test_impossible_numbers_are_refused(position: tuple[float, ...], quaternion: tuple[float, ...]) -> None:
    with pytest.raises(FrameError, match=r"'a' from 'b'.*expected finite numbers and a unit quaternion"):
        TfBuffer().add("a", "b", 0, position_m=position, quaternion_xyzw=quaternion)
    with pytest.raises(FrameError, match="a frame below itself"):
        TfBuffer().add_static("a", "/a", [0, 0, 0], [0, 0, 0, 1])


def test_lookup_agrees_with_poses_given_by_hand() -> None:
    buffer = TfBuffer()
    put(buffer, "body", "mast", pose([1, 0, 0], [0, 0, np.sqrt(0.5), np.sqrt(0.5)]))
    put(buffer, "mast", "camera", pose([2, 0, 0], [0, 0, 0, 1]))
    np.testing.assert_allclose(buffer.lookup("body", "camera", t_ns=0).translation, [1, 2, 0], atol=1e-15)
    np.testing.assert_allclose(buffer.lookup("camera", "body", t_ns=0).translation, [-2, 1, 0], atol=1e-15)
