"""Recordings under the names of real drivers: every layout in every format is read as the same session."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from test_synthesize import LEAST, SEED

from fieldkit.bags import LAYOUTS, BagFormat, inspect_recording, open_recording
from fieldkit.frames import pose_error
from sim_bridge.recording import recorder, schedule
from sim_bridge.scenes import make_scene
from sim_bridge.stage import staging
from sim_bridge.synthesize import generator


@pytest.fixture(scope="module")
def sensed() -> dict[str, recorder.Sensed]:
    """The shortest visit, as the robot of every layout senses it."""
    stage = staging.set_stage(make_scene("room", SEED), LEAST.stage, rng=generator(SEED, 4))
    plan = schedule.plan_session(stage, LEAST.schedule, stage_options=LEAST.stage, rng=generator(SEED, 7))
    plan = dataclasses.replace(plan, shots=plan.shots[:6])
    return {
        name: recorder.sense(stage, plan, recorder.RecorderOptions(layout=name), rng=generator(SEED, 8))
        for name in LAYOUTS
    }


@pytest.mark.parametrize("format", list(recorder.RECORDINGS))
def test_every_layout_in_every_format_is_read_as_the_same_session(
    tmp_path: Path, sensed: dict[str, recorder.Sensed], format: BagFormat
) -> None:
    opened = {}
    for name in LAYOUTS:
        recorder.write_recording(
            tmp_path / name / recorder.RECORDINGS[format], sensed[name], format=format, layout=name
        )
        opened[name] = open_recording(tmp_path / name / recorder.RECORDINGS[format])
    generic = opened["generic"]
    for name, other in opened.items():
        assert (other.layout, other.warnings) == (name, ())
        assert (other.starts, [v.id for v in other.visits]) == (generic.starts, ["w01"])
        for a, b in zip(generic.frames, other.frames, strict=True):
            assert (a.t_ns, a.camera) == (b.t_ns, b.camera)
            assert np.array_equal(a.read(), b.read())
            assert a.body_from_cam is not None
            assert b.body_from_cam is not None
            # Encoder noise, and a wrist that one driver gives as one transform and the other as six.
            assert pose_error(a.body_from_cam, b.body_from_cam)[0] < 0.005


@pytest.mark.parametrize("layout", list(LAYOUTS))
def test_inspect_counts_joints_and_depth_of_every_layout(
    tmp_path: Path, sensed: dict[str, recorder.Sensed], layout: str
) -> None:
    format, said = recorder.own_format(layout), sensed[layout]
    path = tmp_path / recorder.RECORDINGS[format]
    recorder.write_recording(path, said, format=format, layout=layout)
    found = inspect_recording(path)
    assert (found["layout"], found["missing"], found["warnings"]) == (layout, [], [])
    assert (found["depth"]["count"], found["depth"]["camera_info"]) == (len(said.images), len(said.images))
    assert found["joint_states"]["count"] == found["odometry"]["count"] == len(said.states)
    assert len(found["joint_states"]["names"]) == 6
    rate = len(said.states) / found["duration_s"]
    assert rate == pytest.approx(recorder.STATE_HZ[layout], rel=0.05)


def test_names_are_those_of_the_real_drivers() -> None:
    ros1, ros2 = LAYOUTS["spot_ros1"], LAYOUTS["spot_ros2"].named("rex")
    assert (ros1.arm_joints[0], ros1.arm_frames) == ("arm_joint1", ("link_wr1",))
    assert (ros1.depth, ros1.depth_frame, ros1.odom_frame) == ("/spot/depth/hand/image", "hand_depth_sensor", "vision")
    assert (ros2.arm_joints[5], ros2.arm_frames[5]) == ("rex/arm_wr1", "rex/arm_link_wr1")
    assert (ros2.depth, ros2.depth_frame) == ("/rex/depth/hand/image", "rex/hand_depth_sensor")


def test_a_layout_s_own_format_is_that_of_its_driver() -> None:
    assert {name: recorder.own_format(name) for name in LAYOUTS} == {
        "generic": "mcap",
        "spot_ros1": "ros1",
        "spot_ros2": "mcap",
    }
