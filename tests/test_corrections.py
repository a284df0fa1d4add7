"""A refined camera, its place in the hand and the latency of its stamps take the place of what a recording states."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
import struct
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from bag_samples import CAMERA, HAND_FROM_CAM, Options, body_from_hand, jpeg, picture, rewritten, stamp, write_sample
from rosbags.typesys.store import Typestore
from test_bad_input import fails
from test_detections import OLD_DETECTION, header, ros_pose, with_types
from test_main_line import PAPER, SAMPLE, TIMES, rows
from test_tagged import Extra, detections, extended
from transcode import transcode

from fieldkit import store
from fieldkit.bags import LAYOUTS, RecordingWriter, open_arm, open_recording
from fieldkit.errors import BagError, StoreError
from fieldkit.frames import Pose, exp, interpolate, pose, pose_error
from fieldkit.replay import replay
from fieldkit.report import write_report
from fieldkit.store import Corrections, Hand
from fieldkit.store.inputs import SessionStart, SessionView, SessionVisit
from fieldkit.types import Run, ViewKind

RULES = msgspec.structs.replace(PAPER, policies=("max", "best_possible"))
LATE_NS = 40_000_000
WRONG_HAND = exp((0.02, -0.03, 0.02, 0.02, -0.01, 0.02))
VIEWS: dict[str, ViewKind] = {"s12": "sweep", "s13": "sweep", "s14": "sweep", "t00": "truth", "t02": "truth"}


@dataclasses.dataclass(frozen=True)
class Lab:
    """One visit of the sample as it was recorded, the same with wrong statements, and files that say what is right."""

    right: Path
    wrong: Path
    camera: Path
    hand: Path

    def replay(self, recording: Path, out: Path, **options: Any) -> Run:
        return replay(
            [recording], map_path=SAMPLE / "lab.map", tags_path=SAMPLE / "tags.toml", protocol=RULES, out=out, **options
        )


def shorten(path: Path, *, late_ns: int = 0) -> Path:
    """Leave few images of the start and few views of the first visit, by a session.toml; return its folder."""
    recording = open_recording(path)
    first, start = recording.visits[0], recording.starts[0]
    views = {v.id: v.frame.t_ns for v in first.views if v.id in VIEWS}
    begin_ns, end_ns = views["s12"] - late_ns, views["t02"] - late_ns
    visit = SessionVisit("w01", begin_ns, end_ns, "w02", first.truth_tag_id)
    standing = SessionStart(start.t_begin_ns, start.t_begin_ns + 1_200_000_000, start.tag_id)
    marks = tuple(SessionView("w01", name, t_ns, VIEWS[name]) for name, t_ns in views.items())
    session = store.SessionFile("s", path.name, start=(standing,), visit=(visit,), view=marks)
    store.write_session(path.parent / "session.toml", session)
    return path.parent


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    folder = tmp_path_factory.mktemp("lab")
    source = SAMPLE / "session" / "robot.mcap"
    right = transcode(source, folder / "right", "mcap")
    arm = open_arm(right)
    camera = arm.frames[0].camera
    assert arm.kinematics.mount is not None
    parent, hand = arm.kinematics.mount
    longer = dataclasses.replace(camera, params=(1.03 * camera.params[0], 1.03 * camera.params[1], *camera.params[2:]))
    wrong = transcode(source, folder / "wrong", "mcap", camera=longer, hand_from_cam=hand * WRONG_HAND, late_ns=LATE_NS)
    store.write_camera(folder / "camera.toml", camera)
    store.write_hand(folder / "hand.toml", Hand(parent, "arm_camera", hand, latency=(LATE_NS / 1e9, 0.002)))
    return Lab(shorten(right), shorten(wrong, late_ns=LATE_NS), folder / "camera.toml", folder / "hand.toml")


@pytest.fixture(scope="module")
def right(lab: Lab) -> Run:
    return lab.replay(lab.right, lab.right.parent / "run_right")


@pytest.fixture(scope="module")
def left_over(lab: Lab) -> str:
    """What a replay that could not be finished leaves of its estimates; of the hand nothing was known to it."""
    out = lab.right.parent / "run_corrected"

    def block(what: str, done: int, total: int) -> None:
        out.mkdir()
        (out / "mine.txt").touch()

    with pytest.raises(StoreError, match="exists already"):
        lab.replay(lab.wrong, out, camera_path=lab.camera, progress=block)
    shutil.rmtree(out)
    return (out.parent / ".run_corrected.estimates.jsonl").read_text()


@pytest.fixture(scope="module")
def corrected(lab: Lab, left_over: str) -> Run:
    out = lab.right.parent / "run_corrected"
    return lab.replay(lab.wrong, out, camera_path=lab.camera, hand_path=lab.hand)


def best(run: Run) -> float:
    return min(t.cam_error[0] for t in run.trials if t.policy == "best_possible")


def test_with_corrections_prior_truth_candidates_and_estimates_are_those_of_a_right_recording(
    lab: Lab, right: Run, corrected: Run
) -> None:
    folder = lab.right.parent
    for table in ("trials.csv", "truth.csv", "priors.csv", "candidates.csv"):
        assert (folder / "run_corrected" / table).read_bytes() == (folder / "run_right" / table).read_bytes(), table
    without = (*TIMES, "t_ns")
    one, other = (rows(folder / name / "estimates.csv", without=without) for name in ("run_right", "run_corrected"))
    assert one == other
    # Whoever joins estimates with images does so by the header stamps
    assert [r.t_ns for r in corrected.results] == [r.t_ns + LATE_NS for r in right.results]
    assert {p.candidates.camera for p in corrected.plans} == {store.read_camera(lab.camera)}


def test_without_corrections_they_are_not(tmp_path: Path, lab: Lab, right: Run) -> None:
    run = lab.replay(lab.wrong, tmp_path / "run")
    assert best(right) < 0.01 < best(run)
    assert run.corrections == ()
    true = {(t.visit, t.view): t.map_from_cam for _, t in right.truths}
    assert min(pose_error(t.map_from_cam, true[t.visit, t.view])[0] for _, t in run.truths) > 0.01
    assert pose_error(run.plans[0].prior.map_from_body, right.plans[0].prior.map_from_body)[0] > 0.01


def test_run_and_report_say_which_files_were_applied(tmp_path: Path, lab: Lab, right: Run, corrected: Run) -> None:
    folder = lab.right.parent
    told = json.loads((folder / "run_corrected" / "run.json").read_text())["corrections"]
    assert told == [
        {"kind": "camera", "path": str(lab.camera), "digest": store.digest(lab.camera)},
        {"kind": "hand", "path": str(lab.hand), "digest": store.digest(lab.hand)},
    ]
    assert store.read_run(folder / "run_corrected").corrections == corrected.corrections
    assert json.loads((folder / "run_right" / "run.json").read_text())["corrections"] == []
    write_report([corrected], tmp_path / "report.html")
    assert f"hand: {lab.hand} ({store.digest(lab.hand)})" in (tmp_path / "report.html").read_text()


def test_a_replay_that_goes_on_with_other_corrections_takes_no_estimate_over(
    lab: Lab, left_over: str, corrected: Run
) -> None:
    assert left_over.count('"key"') == len(corrected.results) == 3
    times = [r["s_extract"] for r in rows(lab.right.parent / "run_corrected" / "estimates.csv")]
    assert not any(time in left_over for time in times)


# The small sample: body, a hand that tf moves, and the camera fixed to it


def said(hand_from_cam: Pose = HAND_FROM_CAM, *, parent: str = "hand", child: str = "arm_camera") -> Hand:
    return Hand(parent, child, hand_from_cam)


def test_kinematics_and_odometry_are_taken_when_the_image_was(tmp_path: Path) -> None:
    late = dataclasses.replace(said(), latency=(0.04, 0.001))
    path = write_sample(tmp_path, "mcap")
    as_stated, corrected = open_recording(path), open_recording(path, corrections=Corrections(hand=late))
    assert [f.t_ns + 40_000_000 for f in corrected.frames] == [f.t_ns for f in as_stated.frames]
    assert [f.stamp_ns for f in corrected.frames] == [f.stamp_ns for f in as_stated.frames]
    assert [v.frame.stamp_ns for v in corrected.visits[0].views] == [v.frame.t_ns for v in as_stated.visits[0].views]
    first, second = (f.body_from_cam for f in corrected.frames[:2])
    assert first is None
    assert second is not None
    expected = interpolate(body_from_hand(0), body_from_hand(1), 0.6) * HAND_FROM_CAM
    assert max(pose_error(second, expected)) < 1e-9


@pytest.mark.parametrize("layout", ["spot_ros1", "spot_ros2"])
def test_hand_from_cam_is_replaced_for_images_alone(tmp_path: Path, layout: str) -> None:
    path = write_sample(tmp_path, "ros1", Options(layout=layout))
    name = LAYOUTS[layout].named("spot").camera_frame
    moved = HAND_FROM_CAM * WRONG_HAND
    recording = open_recording(path, corrections=Corrections(hand=said(moved, child=f"/{name}")))
    for step, frame in enumerate(recording.frames):
        assert frame.body_from_cam is not None
        assert max(pose_error(frame.body_from_cam, body_from_hand(step) * moved)) < 1e-9


def write_arm(path: Path, static: list[tuple[str, str, Pose]], moving: tuple[str, str]) -> Path:
    """Write three images with fixed transforms and one that moves."""
    with RecordingWriter(path, format="mcap") as writer:
        writer.tf_static(static)
        for step in range(3):
            writer.tf(stamp(step), [(*moving, body_from_hand(step))])
            writer.camera_info(stamp(step), CAMERA)
            writer.image(stamp(step), jpeg(picture(step)))
    return path


def test_a_chain_of_fixed_transforms_becomes_the_one_that_is_given(tmp_path: Path, rng: np.random.Generator) -> None:
    one, two, three, given = (exp(rng.normal(size=6)) for _ in range(4))
    static = [("hand", "mount", one), ("mount", "arm_camera", two), ("mount", "depth", three)]
    path = write_arm(tmp_path / "chain.mcap", static, ("body", "hand"))
    arm = open_arm(path, corrections=Corrections(hand=said(given)))
    for step, frame in enumerate(arm.frames):
        assert frame.body_from_cam is not None
        assert max(pose_error(frame.body_from_cam, body_from_hand(step) * given)) < 1e-9
    # What hangs beside the camera stays where it is
    assert max(pose_error(arm.kinematics.tf.lookup("hand", "depth", t_ns=stamp(1)), one * three)) < 1e-9


def test_a_transform_that_tf_has_the_other_way_round_is_replaced_too(tmp_path: Path, rng: np.random.Generator) -> None:
    stated, given = (exp(rng.normal(size=6)) for _ in range(2))
    path = write_arm(tmp_path / "up.mcap", [("arm_camera", "hand", stated)], ("hand", "body"))
    arm = open_arm(path, corrections=Corrections(hand=said(given)))
    for step, frame in enumerate(arm.frames):
        assert frame.body_from_cam is not None
        assert max(pose_error(frame.body_from_cam, body_from_hand(step).inv() * given)) < 1e-9


def test_a_camera_serves_recordings_whose_camera_info_is_unusable_or_missing(tmp_path: Path) -> None:
    other = dataclasses.replace(CAMERA, params=(55.0, 55.0, *CAMERA.params[2:]))
    path = write_sample(tmp_path, "mcap", Options(without=frozenset({"camera_info"})))
    recording = open_recording(path, corrections=Corrections(camera=other))
    assert {f.camera for f in recording.frames} == {other}
    assert {f.camera for f in open_arm(path, corrections=Corrections(camera=other)).frames} == {other}
    with pytest.raises(BagError, match="no camera_info in layout"):
        open_recording(path, corrections=Corrections(hand=said()))
    (tmp_path / "other").mkdir()
    stated, unusable = write_sample(tmp_path / "other", "mcap"), tmp_path / "unusable.mcap"
    focal = struct.pack("<d", CAMERA.params[0])
    rewritten(stated, unusable, lambda topic, data: data.replace(focal, bytes(8)) if "info" in topic else data)
    with pytest.raises(BagError, match=r"/arm_camera/camera_info: .*give its camera\.toml \(--camera\)"):
        open_recording(unusable)
    assert {f.camera for f in open_recording(unusable, corrections=Corrections(camera=other)).frames} == {other}


def test_recorded_detections_keep_their_pixels_and_get_the_corrected_camera_and_time(tmp_path: Path) -> None:
    other = dataclasses.replace(CAMERA, params=(60.0, 60.0, *CAMERA.params[2:]))
    late = dataclasses.replace(said(), latency=(0.04, 0.001))
    frames = {}
    for name, make in (("corners", detections()), ("poses", pose_detections)):
        (tmp_path / name).mkdir()
        path = extended(tmp_path / name, {"image"}, make)
        given = Corrections(other, late)
        frames[name] = [open_recording(path, corrections=c).tag_frames for c in (Corrections(), given)]
        assert [f.t_ns for f in open_arm(path, corrections=given).frames] == [f.t_ns for f in frames[name][1]]
    for stated_frames, corrected_frames in frames.values():
        for one, new in zip(stated_frames, corrected_frames, strict=True):
            assert (new.camera, new.t_ns, new.stamp_ns) == (other, one.t_ns - 40_000_000, one.t_ns)
            for before, after in zip(one.tags or (), new.tags or (), strict=True):
                np.testing.assert_array_equal(before.corners_px, after.corners_px)
    assert sum(len(f.tags or ()) for f in frames["poses"][1]) == 41


def pose_detections(types: Typestore) -> Extra:
    """Return messages of a detector that tells poses alone: a pixel that it saw went through the stated camera."""
    kind = "apriltags_ros/msg/AprilTagDetectionArray"
    with_types(types, OLD_DETECTION)
    rows: Extra = []
    for step in range(41):
        stamped = types.types["geometry_msgs/msg/PoseStamped"](
            header(types, stamp(step), "arm_camera"), ros_pose(types, pose([0.02, 0.01, 1.0], [1.0, 0.0, 0.0, 0.0]))
        )
        found = [types.types["apriltags_ros/msg/AprilTagDetection"](7, 0.2, stamped)]
        rows.append((stamp(step), "/tags", kind, types.types[kind](header(types, stamp(step), "arm_camera"), found)))
    return rows


def test_hand_toml_reads_back(tmp_path: Path) -> None:
    hand = Hand("hand", "arm_camera", HAND_FROM_CAM, np.eye(6), (0.0412, 0.0025))
    store.write_hand(tmp_path / "hand.toml", hand)
    back = store.read_hand(tmp_path / "hand.toml")
    assert (back.parent, back.child, back.latency) == ("hand", "arm_camera", (0.0412, 0.0025))
    store.write_hand(tmp_path / "hand.toml", said())
    assert "latency" not in (tmp_path / "hand.toml").read_text()
    assert store.read_hand(tmp_path / "hand.toml").latency is None


HAND_FILE = """version = 1
parent = "hand"
child = "arm_camera"
position_m = [0.1, 0.0, 0.0]
quaternion_xyzw = [0.0, 0.0, 0.0, 1.0]
"""
CAMERA_FILE = """version = 1
model = "PINHOLE"
width = 64
height = 48
params = [50.0, 50.0, 32.0, 24.0]
"""


@pytest.mark.parametrize(
    ("option", "text", "message"),
    [
        ("camera", None, r"camera\.toml: no such file; expected camera\.toml with version, .*; check the path"),
        ("hand", None, r"hand\.toml: no such file; expected hand\.toml with parent, .*; check the path"),
        ("camera", CAMERA_FILE.replace("version = 1", "version = 2"), r"version 2; this fieldkit reads version 1"),
        ("hand", HAND_FILE.replace("version = 1", "version = 2"), r"hand\.toml: version 2; this fieldkit reads"),
        ("camera", CAMERA_FILE + "focal = 552.0\n", r"camera\.toml: .*unknown field `focal`.*; expected camera\.toml"),
        ("hand", HAND_FILE + "frame = 'x'\n", r"hand\.toml: .*unknown field `frame`.*; expected hand\.toml"),
        ("hand", HAND_FILE + "latency_s = 0.04\n", r"hand\.toml: latency_s 0\.04 .*; expected both, in s and below 1"),
        (
            "hand",
            HAND_FILE + "latency_s = 40.0\nlatency_sigma_s = 2.0\n",
            r"hand\.toml: latency_s 40.*in s and below 1",
        ),
    ],
)
def test_a_file_of_corrections_that_cannot_be_read_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str, text: str | None, message: str
) -> None:
    path = tmp_path / f"{option}.toml"
    if text is not None:
        path.write_text(text)
    words = [SAMPLE / "session", "--map", SAMPLE / "lab.map", "--tags", SAMPLE / "tags.toml"]
    line = fails(capsys, "replay", *words, "--out", tmp_path / "run", f"--{option}", path)
    assert re.search(message, line), line
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("option", "text", "message"),
    [
        (
            "camera",
            CAMERA_FILE.replace("64", "128").replace("48", "96"),
            r"camera\.toml: is for images of 128x96; expected 64x48, the resolution of those in .*robot\.mcap; ",
        ),
        (
            "hand",
            HAND_FILE.replace('"hand"', '"hnd"'),
            r"hand\.toml: its parent 'hnd' is no frame of tf in .*robot\.mcap; expected one of them; did you mean",
        ),
        (
            "hand",
            HAND_FILE.replace("arm_camera", "camera"),
            r"hand\.toml: its child 'camera' is no frame of tf in .*; ",
        ),
        (
            "hand",
            HAND_FILE.replace('"hand"', '"body"').replace("arm_camera", "hand"),
            r"its child is 'hand'; expected the frame of the images in .*robot\.mcap, arm_camera; ",
        ),
        (
            "hand",
            HAND_FILE.replace('"hand"', '"body"'),
            r"tf moves 'hand' in 'body' in .*robot\.mcap; expected a transform from 'body' to 'arm_camera' that never",
        ),
    ],
)
def test_a_correction_that_does_not_fit_the_recording_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str, text: str, message: str
) -> None:
    recording, path = write_sample(tmp_path, "mcap"), tmp_path / f"{option}.toml"
    path.write_text(text)
    line = fails(capsys, "tags", "check", SAMPLE / "tags.toml", "--recording", recording, f"--{option}", path)
    assert re.search(message, line), line
    with pytest.raises(BagError, match=message):
        open_recording(recording, corrections=store.read_corrections(**{option: path}))


def test_a_correction_that_does_not_fit_leaves_no_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "camera.toml"
    path.write_text(CAMERA_FILE.replace("64", "640").replace("48", "480"))
    words = [write_sample(tmp_path, "mcap"), "--map", SAMPLE / "lab.map", "--tags", SAMPLE / "tags.toml"]
    line = fails(capsys, "replay", *words, "--out", tmp_path / "out" / "run", "--camera", path)
    assert "camera.toml: is for images of 640x480; expected 64x48" in line
    assert not (tmp_path / "out").exists()


def test_corrections_without_a_recording_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "camera.toml"
    path.write_text(CAMERA_FILE)
    words = ["tags", "check", SAMPLE / "tags.toml", "--camera", path, "--distance", "1", "2", "3.0"]
    assert "tags.toml: nothing to check; expected --recording; " in fails(capsys, *words)


def test_a_hand_that_does_not_carry_the_camera_is_refused(tmp_path: Path) -> None:
    static = [("hand", "arm_camera", HAND_FROM_CAM), ("hand", "finger", Pose.identity())]
    path = write_arm(tmp_path / "side.mcap", static, ("body", "hand"))
    with pytest.raises(BagError, match=r"parent 'finger' does not carry 'arm_camera' .* and the images: body, hand; "):
        open_arm(path, corrections=Corrections(hand=said(parent="finger")))
