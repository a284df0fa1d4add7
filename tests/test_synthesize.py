"""Synthesized sessions: what is in the folder, and that the scene was seen as the truth says."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fieldkit.bags import LAYOUTS, open_recording
from fieldkit.bags.content import collect, stamp_ns
from fieldkit.bags.files import BagFile
from fieldkit.cameras import camera_from_info
from fieldkit.errors import StoreError
from fieldkit.frames import Pose, Trajectory, pose_error
from fieldkit.store import read_camera, read_photos, read_rig, read_session, read_tags, read_tum
from fieldkit.tags import tag_corners
from fieldkit.types import Frame, Recording, Visit
from sim_bridge import cli, robot, synthesize
from sim_bridge.errors import SynthesisError
from sim_bridge.mapping import mapper, photographer
from sim_bridge.mesh import Scene
from sim_bridge.recording import recorder, schedule
from sim_bridge.scenes import SCENES, make_blueprint, make_scene
from sim_bridge.scenes.changes import STANDARD_CHANGES, find_changes, make_worlds
from sim_bridge.sensors import STANDARD, load_sensors
from sim_bridge.stage import staging
from sim_bridge.stage.paths import floor_graph
from sim_bridge.synthesize import SessionOptions, generator

# A robot in a hurry makes short recordings.
FAST = schedule.ScheduleOptions(speed_m_s=1.5, turn_rad_s=3.0, arm_rad_s=4.0)
TINY = SessionOptions(
    walk=mapper.WalkOptions(stations=2),
    stage=staging.StageOptions(waypoints=2, truth_sightings=10, start_places=4, tripod_places=1),
    photos=photographer.PhotoOptions(start_photos=3, tripod_photos=2, scale=0.25),
    schedule=dataclasses.replace(FAST, start_images=3, sweep_yaws=6, sweep_pitches_deg=(0.0, 20.0), drive_images=1),
)
# As little as a session can be.
LEAST = SessionOptions(
    walk=mapper.WalkOptions(stations=1),
    stage=staging.StageOptions(waypoints=1, truth_sightings=2, start_places=1, tripod_places=1),
    photos=photographer.PhotoOptions(start_photos=1, tripod_photos=1, scale=0.1),
    schedule=dataclasses.replace(FAST, start_images=1, sweep_yaws=3, sweep_pitches_deg=(0.0,), drive_images=0),
)
SEED = 1


@pytest.fixture(scope="module")
def room() -> Scene:
    return make_scene("room", SEED)


@pytest.fixture(scope="module")
def stage(room: Scene) -> staging.Stage:
    return staging.set_stage(room, TINY.stage, rng=generator(SEED, 4))


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("sessions") / "tiny"
    synthesize.synthesize("room", out, seed=SEED, formats=("mcap", "ros1", "ros2"), options=TINY)
    return out


@pytest.fixture(scope="module")
def recording(session: Path) -> Recording:
    return open_recording(session / "robot.mcap")


def picture(path: Path, *, flags: int) -> np.ndarray:
    image = cv2.imread(str(path), flags)
    assert image is not None
    return np.asarray(image)


def truth_of(session: Path) -> dict[str, Pose]:
    return dict(read_tum(session / "truth" / "view_poses.txt"))


def body_track(session: Path) -> Trajectory:
    rows = read_tum(session / "truth" / "body_poses.txt")
    return Trajectory(np.array([int(t) for t, _ in rows]), tuple(p for _, p in rows), "world", "body")


def starts_of(recording: Recording) -> Iterator[tuple[str, list[Frame]]]:
    for start in recording.starts:
        assert start.visit is not None
        yield start.visit, [f for f in recording.frames if start.t_begin_ns <= f.t_ns <= start.t_end_ns]


def test_the_mapping_folder_is_complete(session: Path) -> None:
    mapping = session / "mapping"
    names = [name for name, _ in read_tum(session / "truth" / "mapping_poses.txt")]
    images = sorted(p.relative_to(mapping / "images").as_posix() for p in (mapping / "images").rglob("*.jpg"))
    frames = [name for name, _ in read_tum(mapping / "slam_poses.txt")]
    assert images == sorted(names) == sorted(f"{cam}/{f}.jpg" for cam in ("lf", "ll", "rf", "rr") for f in frames)
    assert sorted(p.stem for p in (mapping / "depth").iterdir()) == frames
    for camera in read_rig(mapping / "rig.toml").cameras:
        image = picture(mapping / "images" / camera.name / "000000.jpg", flags=cv2.IMREAD_UNCHANGED)
        assert image.shape == (camera.camera.height, camera.camera.width) == (640, 480)


def test_mapped_depth_is_that_of_the_scene_at_the_true_pose(session: Path, room: Scene) -> None:
    rig = read_rig(session / "mapping" / "rig.toml")
    assert rig.depth is not None
    truth = dict(read_tum(session / "truth" / "mapping_poses.txt"))
    lf = next(c for c in rig.cameras if c.name == "lf")
    world_from_cam = truth["lf/000001.jpg"] * lf.rig_from_cam.inv() * rig.depth.rig_from_cam
    stored = picture(session / "mapping" / "depth" / "000001.png", flags=cv2.IMREAD_UNCHANGED)
    depth = stored[::16, ::16] / 1000.0
    rows, columns = np.indices(depth.shape) * 16 + 0.5
    rays = rig.depth.camera.unproject(np.column_stack([columns.ravel(), rows.ravel()]))
    exact = room.intersect(world_from_cam.translation, world_from_cam.rotation.apply(rays))
    exact = (exact / np.linalg.norm(rays, axis=1)).reshape(depth.shape)
    seen = depth > 0
    assert seen.mean() > 0.5
    assert np.median(np.abs(depth[seen] / exact[seen] - 1.0)) < 0.005


def test_the_photos_list_names_each_photo_its_camera_and_visit(session: Path) -> None:
    photos = read_photos(session / "photos" / "photos.toml")
    poses = [name for name, _ in read_tum(session / "truth" / "photo_poses.txt")]
    assert [p.file for p in photos] == poses
    assert [p.visit for p in photos] == [None] * 3 + ["w01"] * 2 + ["w02"] * 2
    assert all((session / "photos" / p.file).is_file() for p in photos)
    assert {p.camera for p in photos} == {"camera.toml"}


def test_the_full_photo_camera_has_twelve_megapixels_and_distortion() -> None:
    camera = photographer.camera(photographer.PhotoOptions())
    assert camera.width * camera.height == 12_000_000
    assert not camera.is_pinhole


def corner_shifts(image: np.ndarray, expected_px: np.ndarray) -> np.ndarray:
    """Shifts (4, 2) in pixels from projected tag corners to the sub-pixel corners that OpenCV finds next to them."""
    start = (expected_px - 0.5).astype(np.float32).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
    found = cv2.cornerSubPix(image, start.copy(), (3, 3), (-1, -1), criteria)
    return np.asarray(found - start).reshape(-1, 2)


def test_every_photo_shows_its_tag_where_the_truth_says(session: Path) -> None:
    camera = read_camera(session / "photos" / "camera.toml")
    tags = read_tags(session / "truth" / "tags.toml")
    poses = dict(read_tum(session / "truth" / "photo_poses.txt"))
    for photo in read_photos(session / "photos" / "photos.toml"):
        tag = next(t for t in tags.tags if t.visit == photo.visit)
        corners = tag.map_from_tag.apply(tag_corners(tag.size_m))
        pixels, inside = camera.project(poses[photo.file].inv().apply(corners))
        image = picture(session / "photos" / photo.file, flags=cv2.IMREAD_GRAYSCALE)
        assert inside.all()
        assert np.median(np.linalg.norm(corner_shifts(image, pixels), axis=1)) < 0.5


def test_every_start_and_truth_image_shows_its_tag_where_the_truth_says(session: Path, recording: Recording) -> None:
    tags, truth = read_tags(session / "truth" / "tags.toml"), truth_of(session)
    shown: list[tuple[int, str | None, Frame]] = [
        (1, None, frame) for _, frames in starts_of(recording) for frame in frames
    ]
    for visit in recording.visits:
        assert visit.truth_tag_id is not None
        shown += [(visit.truth_tag_id, visit.id, v.frame) for v in visit.views if v.kind == "truth"]
    for tag_id, visit_id, frame in shown:
        tag = tags.find(tag_id, visit=visit_id)
        assert tag is not None
        in_cam = truth[str(frame.t_ns)].inv().apply(tag.map_from_tag.apply(tag_corners(tag.size_m)))
        pixels, inside = frame.camera.project(in_cam)
        assert inside.all()
        shifts = corner_shifts(cv2.cvtColor(frame.read(), cv2.COLOR_RGB2GRAY), pixels)
        # Motion blur pulls the corners of a tag inwards, but not to one side.
        assert np.linalg.norm(shifts.mean(axis=0)) < 0.4
        assert np.median(np.linalg.norm(shifts, axis=1)) < (1.5 if visit_id is None else 0.7)


def kinds(visit: Visit, kind: str) -> int:
    return sum(v.kind == kind for v in visit.views)


def test_each_visit_has_its_views_and_names_the_next(recording: Recording) -> None:
    assert [(v.id, v.next, v.truth_tag_id) for v in recording.visits] == [("w01", "w02", 2), ("w02", None, 3)]
    for visit in recording.visits:
        found = (kinds(visit, "stowed"), kinds(visit, "forward"), kinds(visit, "sweep"), kinds(visit, "truth"))
        assert found == (1, 1, 12, 10)


def test_the_robot_starts_at_the_start_tag_before_every_visit(recording: Recording) -> None:
    assert [visit for visit, _ in starts_of(recording)] == ["w01", "w02"]
    for start, visit in zip(recording.starts, recording.visits, strict=True):
        assert start.t_end_ns < visit.t_begin_ns
    assert all(len(frames) == 3 for _, frames in starts_of(recording))


def test_tripod_tags_are_seen_near_and_at_a_slant(session: Path, recording: Recording) -> None:
    tags, truth = read_tags(session / "truth" / "tags.toml"), truth_of(session)
    for visit in recording.visits:
        assert visit.truth_tag_id is not None
        tag = tags.find(visit.truth_tag_id, visit=visit.id)
        assert tag is not None
        for view in (v for v in visit.views if v.kind == "truth"):
            x, y, z = tag.map_from_tag.inv().apply(truth[str(view.frame.t_ns)].translation)
            assert np.sqrt(x * x + y * y + z * z) < 1.2
            assert 19.0 < np.degrees(np.arctan2(np.hypot(x, y), z)) < 46.0


def test_kinematics_at_the_stamp_give_almost_the_true_camera_pose(session: Path, recording: Recording) -> None:
    body, truth, errors = body_track(session), truth_of(session), []
    for view in (v for visit in recording.visits for v in visit.views):
        frame = view.frame
        assert frame.body_from_cam is not None
        errors.append(pose_error(body.at(frame.t_ns) * frame.body_from_cam, truth[str(frame.t_ns)]))
    distance, angle = np.array(errors).T
    assert 0.0003 < np.median(distance) < distance.max() < 0.008
    assert 0.03 < np.degrees(np.median(angle)) < np.degrees(angle.max()) < 0.6


def messages(path: Path, topic: str) -> list[Any]:
    return [message.value for message in BagFile(path).messages([topic])]


def test_depth_beside_every_image_is_that_of_the_scene(
    session: Path, recording: Recording, stage: staging.Stage
) -> None:
    layout, body = LAYOUTS["generic"], body_track(session)
    sent = messages(session / "robot.mcap", layout.depth_compressed)
    tf = collect(BagFile(session / "robot.mcap"), layout).tf
    assert [stamp_ns(message.header) for message in sent] == [frame.t_ns for frame in recording.frames]
    for message in sent[3::9]:
        t_ns = stamp_ns(message.header)
        assert (message.header.frame_id, message.format) == (layout.depth_frame, "16UC1; png compressed")
        depth = cv2.imdecode(np.asarray(message.data), cv2.IMREAD_UNCHANGED)[::8, ::8] / 1000.0
        rows, columns = np.indices(depth.shape) * 8 + 0.5
        rays = robot.DEPTH_CAMERA.unproject(np.column_stack([columns.ravel(), rows.ravel()]))
        world_from_cam = body.at(t_ns) * tf.lookup(layout.body_frame, layout.depth_frame, t_ns=t_ns)
        exact = stage.scene.intersect(world_from_cam.translation, world_from_cam.rotation.apply(rays))
        exact = (exact / np.linalg.norm(rays, axis=1)).reshape(depth.shape)
        seen = depth > 0
        assert seen.mean() > 0.3
        assert np.median(np.abs(depth[seen] / exact[seen] - 1.0)) < 0.02


def test_the_depth_camera_has_its_own_camera_info(session: Path) -> None:
    layout = LAYOUTS["generic"]
    infos = messages(session / "robot.mcap", layout.depth_info)
    found = {camera_from_info(i.width, i.height, i.k, i.d, distortion_model=i.distortion_model) for i in infos}
    assert [(c.width, c.height, c.model) for c in found] == [(224, 171, "PINHOLE")]
    assert next(iter(found)).params == pytest.approx(robot.DEPTH_CAMERA.params)


def test_joint_states_are_the_joints_of_tf(session: Path) -> None:
    layout = LAYOUTS["generic"]
    bag = BagFile(session / "robot.mcap")
    content = collect(bag, layout)
    for t_ns, angles in content.joints[::50]:
        arm = robot.joints([angles[name] for name in layout.arm_joints])
        in_body = content.tf.lookup(layout.body_frame, layout.arm_frames[-1], t_ns=t_ns)
        assert pose_error(in_body, robot.body_from_wrist(arm)) == pytest.approx((0.0, 0.0), abs=1e-6)


def test_image_stamps_lie_between_the_samples_of_tf_and_odometry(session: Path, recording: Recording) -> None:
    stamps = {f.t_ns for f in recording.frames}
    assert stamps.isdisjoint(int(t) for t in recording.odometry.t_ns)
    assert np.diff(recording.odometry.t_ns).max() < 60_000_000


def test_odometry_drifts_while_the_robot_drives(session: Path, recording: Recording) -> None:
    body = body_track(session)
    for start, visit in zip(recording.starts, recording.visits, strict=True):
        times = (start.t_end_ns, visit.t_begin_ns)
        true = body.at(times[0]).inv() * body.at(times[1])
        believed = recording.odometry.at(times[0]).inv() * recording.odometry.at(times[1])
        distance, _ = pose_error(believed, true)
        assert 0.001 < distance < 0.3 * np.linalg.norm(true.translation)


def test_all_formats_hold_the_same_session(session: Path, recording: Recording) -> None:
    for name in ("robot.bag", "robot"):
        other = open_recording(session / name)
        assert [f.t_ns for f in other.frames] == [f.t_ns for f in recording.frames]
        assert other.starts == recording.starts
        for a, b in zip(recording.frames, other.frames, strict=True):
            assert a.camera == b.camera == robot.ARM_CAMERA
            assert np.array_equal(a.read(), b.read())
            assert a.body_from_cam is not None
            assert b.body_from_cam is not None
            assert np.array_equal(a.body_from_cam.as_matrix(), b.body_from_cam.as_matrix())


def test_no_camera_stands_inside_or_behind_anything(stage: staging.Stage) -> None:
    plan = schedule.plan_session(stage, TINY.schedule, stage_options=TINY.stage, rng=generator(SEED, 7))
    for shot in plan.shots:
        body = plan.world_from_body(shot.t_s)
        camera = (body * robot.body_from_camera(plan.joints(shot.t_s))).translation
        shoulder = body.apply(robot.SHOULDER_M)
        assert staging.clear_around(stage.scene, camera, radius_m=0.05)
        assert stage.scene.intersect(shoulder, camera - shoulder)[0] > np.linalg.norm(camera - shoulder)
    for photo in photographer.plan_photos(stage, TINY.photos, rng=generator(SEED, 5)):
        assert staging.sees(
            stage.scene, photo.world_from_cam, photographer.camera(TINY.photos), photo.tag, margin_px=5.0
        )


def test_the_robot_never_drives_into_anything(stage: staging.Stage) -> None:
    plan = schedule.plan_session(stage, TINY.schedule, stage_options=TINY.stage, rng=generator(SEED, 7))
    assert stage.scene.free_floor(plan.body.values[:, :2], TINY.stage.drive_radius_m - 0.02).all()


def test_one_start_serves_a_whole_session_in_the_other_mode(stage: staging.Stage) -> None:
    options = dataclasses.replace(TINY.schedule, starts="once")
    plan = schedule.plan_session(stage, options, stage_options=TINY.stage, rng=generator(SEED, 7))
    starts = [e for _, e in plan.events if e["event"] == "start_begin"]
    assert [("visit" in e, e["tag_id"]) for e in starts] == [(False, stage.start_tag.id)]
    begins = [(t, e["visit"]) for t, e in plan.events if e["event"] == "visit_begin"]
    assert [visit for _, visit in begins] == [w.id for w in stage.waypoints]
    for (t_s, _), waypoint in zip(begins, stage.waypoints, strict=True):
        position, rotation = pose_error(plan.world_from_body(t_s), waypoint.world_from_body)
        assert position < 1e-6
        assert rotation < 1e-6
    assert stage.scene.free_floor(plan.body.values[:, :2], TINY.stage.drive_radius_m - 0.02).all()


def digests(folder: Path) -> dict[str, str]:
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def test_the_same_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("once", "again"):
        synthesize.synthesize("room", tmp_path / name, seed=SEED, formats=("mcap", "ros1", "ros2"), options=LEAST)
    assert digests(tmp_path / "again") == digests(tmp_path / "once")


def test_session_toml_names_the_recording(session: Path) -> None:
    found = read_session(session / "session.toml")
    assert (found.session, found.recording, found.layout) == ("room-1", "robot.mcap", "generic")
    assert found.visit == ()


def test_a_session_stores_its_sensors_and_changes(session: Path) -> None:
    assert load_sensors(str(session / "sensors.toml")) == STANDARD
    assert find_changes(str(session / "changes.toml")) == STANDARD_CHANGES
    assert "[[change]]" in (session / "truth" / "changes.toml").read_text()


def test_what_is_staged_has_room_before_and_after_the_changes() -> None:
    worlds = make_worlds(make_blueprint("room", SEED), STANDARD_CHANGES, seed=SEED)
    stage = staging.set_stage(worlds.both, TINY.stage, rng=generator(SEED, 4))
    bodies = np.array([w.world_from_body.translation[:2] for w in stage.waypoints])
    tripods = np.array([w.tag.world_from_tag.translation[:2] for w in stage.waypoints])
    for world in (worlds.mapped, worlds.visited):
        assert world.free_floor(bodies, TINY.stage.waypoint_radius_m).all()
        assert world.free_floor(tripods, 0.12).all()
        graph = floor_graph(staging.set_in(world, stage).scene, TINY.stage.drive_radius_m)
        assert graph.connects([stage.world_from_start.translation[:2], *bodies])


def test_an_interrupted_synthesis_leaves_nothing(tmp_path: Path) -> None:
    too_near = dataclasses.replace(LEAST, photos=dataclasses.replace(LEAST.photos, distance_m=(0.2, 0.3)))
    with pytest.raises(SynthesisError, match="places from which tag 1 can be photographed"):
        synthesize.synthesize("room", tmp_path / "new", seed=SEED, options=too_near)
    assert list(tmp_path.iterdir()) == []


def test_an_existing_session_is_kept(session: Path) -> None:
    before = digests(session)
    with pytest.raises(StoreError, match="exists already"):
        synthesize.synthesize("room", session, seed=SEED, options=TINY)
    assert digests(session) == before


def test_force_does_not_replace_a_folder_that_is_no_session(tmp_path: Path) -> None:
    (tmp_path / "letters.txt").write_text("dear")
    with pytest.raises(StoreError, match=r"holds no session\.toml, so --force does not replace it"):
        synthesize.synthesize("room", tmp_path, seed=SEED, options=TINY, force=True)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--scene", "rom"], f"sim-bridge: unknown scene 'rom'; did you mean 'room'? known: {', '.join(SCENES)}"),
        (["--layout", "nao"], f"sim-bridge: unknown layout 'nao'; known: {', '.join(LAYOUTS)}"),
        (["--waypoints", "0"], "sim-bridge: --waypoints 0: expected 1..20; choose another number"),
        (["--seed", "-3"], "sim-bridge: seed -3; expected 0 or more; choose another seed"),
    ],
)
def test_a_mistake_is_one_line_and_exit_1(
    words: list[str], line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main(["synthesize", "--out", str(tmp_path / "s"), *words])
    assert end.value.code == 1
    assert capsys.readouterr().err == line + "\n"


def test_the_recordings_have_the_names_that_the_session_folder_promises() -> None:
    assert recorder.RECORDINGS == {"mcap": "robot.mcap", "ros1": "robot.bag", "ros2": "robot"}
