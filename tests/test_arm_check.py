"""Hand-eye calibration from recordings of sim_bridge's arm before a tag: what is stated wrongly is found."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
from arm_sweeps import SIZE_M, Stated, Swept, Told, said_mount, sweep, true_correction, write
from bag_samples import Options, write_sample

from fieldkit.bags import open_arm
from fieldkit.checks import ArmCheck, Finding, Sweep, check_arm, find_sweep, refine_arm
from fieldkit.cli import main
from fieldkit.errors import BagError, TagError
from fieldkit.frames import Pose, pose_error
from fieldkit.store import read_camera, read_hand, write_tags
from fieldkit.types import TagMap
from sim_bridge import robot

WRONG = Stated(hand=(0.02, -0.03, 0.015, 0.01, -0.02, 0.02), late_ns=40_000_000, focal=0.03)
SIZES = {None: SIZE_M}


@pytest.fixture(scope="module")
def swept() -> Swept:
    return sweep(3, poses=11)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, swept: Swept) -> Path:
    return write(tmp_path_factory.mktemp("arm") / "wrong.mcap", swept, WRONG)


@pytest.fixture(scope="module")
def wrong(recording: Path) -> ArmCheck:
    return check_arm(find_sweep(open_arm(recording), SIZES))


@pytest.fixture(scope="module")
def messages(tmp_path_factory: pytest.TempPathFactory, swept: Swept) -> Path:
    return write(tmp_path_factory.mktemp("told") / "tags.mcap", swept, WRONG, told=Told())


@pytest.fixture(scope="module")
def ordinary() -> Sweep:
    """An ordinary session, every third image of it."""
    session = open_arm(Path(__file__).parent.parent / "data_samples" / "room" / "session")
    return find_sweep(dataclasses.replace(session, frames=session.frames[::3]), SIZES)


def stated_larger(sweep: Sweep, factor: float) -> Sweep:
    """The same sightings, the tags stated larger than they are."""
    stands = tuple(dataclasses.replace(s, size_m=factor * s.size_m) for s in sweep.stands)
    return dataclasses.replace(sweep, stands=stands)


def size_of(check: ArmCheck) -> Finding:
    return next(f for f in check.findings if f.name == "size of the tags")


def verdicts(check: ArmCheck) -> dict[str, str]:
    return {f.name: f.verdict for f in check.findings}


def expected(swept: Swept, stated: Stated) -> np.ndarray:
    return np.array([*true_correction(swept, stated), stated.late_ns / 1e9, -math.log1p(stated.focal), *np.zeros(7)])


def test_a_wrong_hand_late_stamps_and_a_wrong_focal_length_are_found_within_their_sigma(
    swept: Swept, wrong: ArmCheck
) -> None:
    deviation = (wrong.fit.values - expected(swept, WRONG)) / np.sqrt(np.diag(wrong.fit.covariance))
    assert np.abs(deviation).max() < 3.5
    assert float(np.mean(deviation**2)) < 2.0
    sigmas = {f.name: f.sigma for f in wrong.findings}
    assert sigmas["stamps late by"] < 5.0
    assert sigmas["focal length"] < 0.5
    assert max(sigmas[f"position {axis}"] for axis in "xyz") < 4.0


def test_what_is_stated_wrongly_fails_and_what_is_stated_rightly_passes(wrong: ArmCheck) -> None:
    found = verdicts(wrong)
    off = [f"rotation {axis}" for axis in "xyz"] + ["position y", "position z", "stamps late by", "focal length"]
    assert {found[name] for name in off} == {"fail"}
    assert {found[name] for name in ("fy over fx", "centre x", "centre y", "p1", "p2")} == {"pass"}
    assert wrong.verdict == "fail"
    assert wrong.fit.rms_px[0] > 5.0
    assert wrong.fit.rms_px[1] < 0.7


def test_a_recording_that_states_the_truth_passes(tmp_path: Path, swept: Swept) -> None:
    path = write(tmp_path / "right.mcap", swept, told=Told())
    found = verdicts(check_arm(find_sweep(open_arm(path), SIZES)))
    assert "fail" not in found.values()
    assert list(found.values()).count("pass") >= 14


@pytest.mark.parametrize("factor", [1.05, 1.1, 1.25])
def test_a_wrong_size_of_the_tags_is_found_in_an_ordinary_session_and_nothing_else_is_blamed(
    ordinary: Sweep, factor: float
) -> None:
    check = check_arm(stated_larger(ordinary, factor))
    size = size_of(check)
    assert size.sigma < 0.3
    assert size.deviation == pytest.approx(100 * (1 / factor - 1), abs=3 * size.sigma)
    assert [f.name for f in check.findings if f.verdict == "fail"] == ["size of the tags"]
    assert check.fit.rms_px[1] < 0.4
    assert check.contradiction is None


@pytest.mark.parametrize("factor", [1.5, 1 / 1.5])
def test_a_size_that_is_wrong_by_half_does_not_hide_a_wrong_hand(swept: Swept, wrong: ArmCheck, factor: float) -> None:
    check = check_arm(stated_larger(wrong.sweep, factor))
    size = size_of(check)
    assert size.verdict == "fail"
    assert size.sigma < 0.5
    assert size.deviation == pytest.approx(100 * (1 / factor - 1), abs=3 * size.sigma)
    deviation = (check.fit.values - expected(swept, WRONG)) / np.sqrt(np.diag(check.fit.covariance))
    assert np.abs(deviation).max() < 3.5


def test_a_recording_that_no_arm_explains_contradicts_itself(wrong: ArmCheck, rng: np.random.Generator) -> None:
    sways = Pose.from_translation(rng.normal(0.0, 0.03, (len(wrong.sweep), 3)))
    check = check_arm(dataclasses.replace(wrong.sweep, ref_from_body=sways))
    assert check.contradiction is not None
    assert check.contradiction.startswith(
        "the recording contradicts itself beyond any arm's noise: the arm needs 5 times"
    )
    assert check.verdict == "fail"
    with pytest.raises(TagError, match=r"contradicts itself .* to refine the hand; check size_m of the tags, tf and"):
        refine_arm(check, what="hand")
    assert wrong.contradiction is None


def test_corners_that_are_noisier_than_their_detector_says_do_not_blame_the_camera(
    ordinary: Sweep, rng: np.random.Generator
) -> None:
    noisy = [dataclasses.replace(d, corners_px=d.corners_px + rng.normal(0, 0.3, (4, 2))) for d in ordinary.detections]
    check = check_arm(dataclasses.replace(ordinary, detections=tuple(noisy)))
    assert check.verdict in ("pass", "warn")
    assert 0.2 <= check.fit.noise.corner_px <= 0.4
    assert check.fit.used.mean() > 0.9


def test_camera_and_hand_are_refined_to_what_they_are(swept: Swept, wrong: ArmCheck) -> None:
    refined = refine_arm(wrong, what="hand")
    assert refined.hand_from_cam is not None
    position, angle = pose_error(refined.hand_from_cam, swept.wrist_from_camera)
    assert position < 0.008 < pose_error(said_mount(WRONG), swept.wrist_from_camera)[0]
    assert math.degrees(angle) < 0.3
    camera = refine_arm(wrong, what="camera").camera
    assert camera.focal_px == pytest.approx(robot.ARM_CAMERA.focal_px, rel=0.01)
    assert np.linalg.eigvalsh(refined.covariance).min() > 0


def test_a_driver_that_gives_the_wrist_alone_is_checked_too(tmp_path: Path, swept: Swept, wrong: ArmCheck) -> None:
    path = write(tmp_path / "spot.mcap", swept, WRONG, layout="spot_ros1", told=Told())
    found = find_sweep(open_arm(path), SIZES)
    # The same images, so the same corners as in the other recording
    check = check_arm(dataclasses.replace(found, detections=wrong.sweep.detections))
    deviation = (check.fit.values - expected(swept, WRONG)) / np.sqrt(np.diag(check.fit.covariance))
    assert np.abs(deviation[[0, 1, 2, 6, 7]]).max() < 4.0
    assert verdicts(check)["stamps late by"] == "fail"


def test_recorded_detections_take_the_place_of_images_with_the_noise_that_they_show(
    messages: Path, wrong: ArmCheck
) -> None:
    found = find_sweep(open_arm(messages), SIZES)
    assert len(found) == len(wrong.sweep)
    assert found.detections[0].sigma_px < 0.3
    assert verdicts(check_arm(found))["stamps late by"] == "fail"


@pytest.mark.parametrize("told", [Told(frame="head_camera"), Told(hamming=2)])
def test_detections_of_another_camera_and_doubtful_ones_do_not_count(tmp_path: Path, swept: Swept, told: Told) -> None:
    recording = open_arm(write(tmp_path / "tags.mcap", swept, told=told))
    assert any("of frame 'head_camera', not of the arm camera" in w for w in recording.warnings) == bool(told.frame)
    with pytest.raises(TagError, match=r"tags\.mcap: no image and no detected tag in it; expected images of tags"):
        find_sweep(recording, SIZES)


def test_what_two_detectors_find_in_one_image_counts_once(tmp_path: Path, swept: Swept, messages: Path) -> None:
    twice = find_sweep(open_arm(write(tmp_path / "twice.mcap", swept, told=Told(("/a", "/b")))), SIZES)
    assert len(twice) == len(find_sweep(open_arm(messages), SIZES))


def test_an_arm_that_stands_at_every_image_shows_no_latency(tmp_path: Path) -> None:
    still = sweep(5, poses=9, moving=False)
    check = check_arm(find_sweep(open_arm(write(tmp_path / "still.mcap", still)), SIZES))
    assert verdicts(check)["stamps late by"] == "unknown"
    assert verdicts(check)["rotation z"] == "pass"


def test_a_hand_that_turns_about_one_axis_cannot_be_refined(tmp_path: Path) -> None:
    flat = sweep(6, poses=7, turning=("sh0",))
    check = check_arm(find_sweep(open_arm(write(tmp_path / "flat.mcap", flat)), SIZES))
    assert "unknown" in {verdicts(check)[f"position {axis}"] for axis in "xyz"}
    with pytest.raises(
        TagError, match=r"the sweep does not show .*position .* only, 10 matter.*to refine the hand; turn"
    ):
        refine_arm(check, what="hand")


def test_the_command_says_what_is_wrong_and_writes_what_it_found(
    tmp_path: Path, messages: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_tags(tmp_path / "tags.toml", TagMap((), (), "map"))
    words = ["tags", "check", tmp_path / "tags.toml", "--recording", messages, "--size-m", SIZE_M, "--json"]
    out = ["--refine-camera", tmp_path / "camera.toml", "--refine-hand", tmp_path / "hand.toml"]
    with pytest.raises(SystemExit) as stop:
        main([str(w) for w in (*words, *out)])
    said = json.loads(capsys.readouterr().out)["arm"]
    assert stop.value.code == 3
    assert said["verdict"] == "fail"
    assert said["contradiction"] is None
    assert {f["name"]: f["verdict"] for f in said["findings"]}["focal length"] == "fail"
    assert read_camera(tmp_path / "camera.toml").focal_px == pytest.approx(robot.ARM_CAMERA.focal_px, rel=0.01)
    hand = read_hand(tmp_path / "hand.toml")
    assert (hand.parent, hand.child) == ("arm_link_wr1", "arm_camera")
    assert hand.latency is not None
    late_s, sigma_s = hand.latency
    assert abs(late_s - WRONG.late_ns / 1e9) < 3.5 * sigma_s
    with pytest.raises(SystemExit) as stop:
        main(
            [str(w) for w in (*words, "--camera", out[1], "--hand", out[3], "--refine-hand", tmp_path / "second.toml")]
        )
    again = json.loads(capsys.readouterr().out)["arm"]
    assert stop.value.code == 0
    assert again["rms_px"]["stated"] < 1.0 < said["rms_px"]["stated"]
    assert {f["verdict"] for f in again["findings"] if f["of"] != "tags"} <= {"pass", "unknown"}
    # What is found beyond what was given adds up
    second = read_hand(tmp_path / "second.toml")
    assert second.latency is not None
    assert second.latency[0] == pytest.approx(late_s, abs=sigma_s)
    assert pose_error(second.hand_from_cam, hand.hand_from_cam)[0] < 0.002


def test_an_arm_that_showed_no_latency_leaves_none_in_the_file(wrong: ArmCheck) -> None:
    late = refine_arm(wrong, what="hand").latency
    assert late is not None
    number = [p.name for p in wrong.fit.parameters].index("stamps late by")
    covariance = wrong.fit.covariance.copy()
    covariance[number, number] = (2 * wrong.fit.parameters[number].tolerance) ** 2
    vague = dataclasses.replace(wrong, fit=dataclasses.replace(wrong.fit, covariance=covariance))
    assert refine_arm(vague, what="hand").latency is None


@pytest.mark.parametrize("option", ["--sigmas", "--tape-sigma-m"])
@pytest.mark.parametrize("value", ["nan", "inf", "0", "-1"])
def test_a_sigma_that_is_no_positive_number_is_refused(
    tmp_path: Path, messages: Path, capsys: pytest.CaptureFixture[str], option: str, value: str
) -> None:
    write_tags(tmp_path / "tags.toml", TagMap((), (), "map"))
    with pytest.raises(SystemExit) as stop:
        main(["tags", "check", str(tmp_path / "tags.toml"), "--recording", str(messages), option, value])
    assert stop.value.code == 1
    assert capsys.readouterr().err == f"fieldkit: {option} {value}; expected a finite number above 0\n"


def test_a_recording_without_tags_kinematics_or_sizes_is_named(tmp_path: Path, messages: Path) -> None:
    bare = open_arm(write_sample(tmp_path, "mcap"))
    with pytest.raises(TagError, match=r"robot\.mcap: 0 sightings of tags in .* expected one tag at least 3 times"):
        find_sweep(bare, SIZES)
    with pytest.raises(TagError, match=r"0 sightings of tags in .*sizes are known of tag 77\); sweep the arm"):
        find_sweep(open_arm(messages), {77: 0.1})
    (tmp_path / "b").mkdir()
    path = write_sample(tmp_path / "b", "mcap", Options(without=frozenset({"tf"})))
    with pytest.raises(
        BagError, match=r"robot\.mcap: tf does not connect 'arm_camera'.* expected the arm's transforms"
    ):
        open_arm(path)
