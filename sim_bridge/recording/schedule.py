"""What the robot does when: drive from the start tag to each waypoint, look around, drive back."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from fieldkit.frames import Pose
from fieldkit.types import ViewKind
from sim_bridge import robot
from sim_bridge.stage.paths import SPACING_M, Track, TrackBuilder, floor_graph, headings, plan_path
from sim_bridge.stage.staging import Stage, StageOptions, Waypoint, clear_around, looking_at

Array = NDArray[np.float64]

LOOKAHEAD_M = 1.5
_LAG_STEP_S = 0.01


@dataclasses.dataclass(frozen=True)
class ScheduleOptions:
    """What is looked at, and how fast things move.

    ``starts`` "each": every waypoint is reached from the start tag, as in the paper; "once": the robot sees the start
    tag at the beginning and then goes from waypoint to waypoint. The arm follows its commands with a lag (the time in
    which what is left shrinks to a third), so a little speed remains after ``settle_s``; and it never stands quite
    still: every joint sways slowly by ``sway_deg`` and trembles by ``tremor_deg``.
    """

    starts: Literal["each", "once"] = "each"
    start_images: int = 8
    sweep_yaws: int = 8
    sweep_pitches_deg: tuple[float, ...] = (-6.0, 20.0)
    drive_images: int = 2
    speed_m_s: float = 0.6
    turn_rad_s: float = 0.9
    arm_rad_s: float = 1.4
    settle_s: float = 0.35
    lag_s: float = 0.06
    sway_deg: float = 0.12
    tremor_deg: float = 0.008


@dataclasses.dataclass(frozen=True)
class Shot:
    """An image to take: when (s), and the view of a visit that it is, if any."""

    t_s: float
    visit: str | None = None
    view: str | None = None
    kind: ViewKind | None = None


@dataclasses.dataclass(frozen=True)
class Schedule:
    """The motion of body (x, y, yaw) and arm (six joints) over time, the images, and the events.

    ``sway`` f64[2,3,6] is what the arm moves by itself: amplitude, rate (rad/s) and phase of two waves per joint.
    """

    body: Track
    arm: Track
    shots: tuple[Shot, ...]
    events: tuple[tuple[float, dict[str, Any]], ...]
    end_s: float
    sway: Array

    def world_from_body(self, t_s: float) -> Pose:
        """Return the true pose of the body at a time."""
        x, y, yaw = self.body.at(t_s)[0]
        return robot.standing([x, y], yaw)

    def joints(self, t_s: float) -> robot.ArmJoints:
        """Return the true joints at a time: where the arm has come, and the little it sways."""
        amplitude, rate, phase = np.moveaxis(self.sway, 1, 0)
        return robot.joints(self.arm.at(t_s)[0] + (amplitude * np.sin(rate * t_s + phase)).sum(axis=0))


def plan_session(
    stage: Stage, options: ScheduleOptions, *, stage_options: StageOptions, rng: np.random.Generator
) -> Schedule:
    """Plan a session: for each waypoint from the start tag and back, or one start and then all waypoints in turn."""
    planner = _Planner(stage, options, stage_options.drive_radius_m, rng)
    planner.wait(1.0)
    for index, waypoint in enumerate(stage.waypoints):
        if options.starts == "each":
            planner.look_at_start_tag(waypoint.id)
        elif index == 0:
            planner.look_at_start_tag(None)
        planner.drive_to(index)
        planner.look_around(index)
        planner.leave(index)
    planner.wait(0.5)
    waves = ((options.sway_deg, (0.4, 0.9)), (options.tremor_deg, (5.0, 9.0)))
    return planner.schedule(np.stack([_wave(*wave, rng=rng) for wave in waves]))


def _wave(degrees: float, hertz: tuple[float, float], *, rng: np.random.Generator) -> Array:
    """Return amplitudes, rates and phases (3, 6) of a wave in every joint."""
    count = len(robot.JOINTS)
    amplitude = np.radians(degrees) * rng.uniform(0.5, 1.0, count)
    return np.stack([amplitude, 2 * np.pi * rng.uniform(*hertz, count), rng.uniform(0.0, 2 * np.pi, count)])


def lagging(track: Track, lag_s: float, *, end_s: float) -> Track:
    """Return a track that follows another one with a lag: a first-order low pass, sampled a hundred times a second."""
    times: Array = np.arange(int(np.ceil(end_s / _LAG_STEP_S)) + 1, dtype=np.float64) * _LAG_STEP_S
    wanted = track.at(times)
    if lag_s <= 0.0:
        return Track(times, wanted)
    keep = float(np.exp(-_LAG_STEP_S / lag_s))
    values, _ = lfilter([1.0 - keep], [1.0, -keep], wanted, axis=0, zi=keep * wanted[:1])
    return Track(times, values)


class _Planner:
    """Collects body and arm motion, images and events; body and arm take turns, so one clock serves both."""

    def __init__(self, stage: Stage, options: ScheduleOptions, radius_m: float, rng: np.random.Generator) -> None:
        self._stage, self._options, self._rng, self._radius_m = stage, options, rng, radius_m
        self._graph = floor_graph(stage.scene, radius_m)
        self._body = TrackBuilder(_flat(stage.world_from_start))
        self._arm = TrackBuilder(robot.STOWED.as_array())
        self._shots: list[Shot] = []
        self._events: list[tuple[float, dict[str, Any]]] = []

    @property
    def _now(self) -> float:
        return max(self._body.t_s, self._arm.t_s)

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        end = self._now + seconds
        self._body.hold_until(end)
        self._arm.hold_until(end)

    def schedule(self, sway: Array) -> Schedule:
        """Return what was planned."""
        self.wait(0.0)
        arm = lagging(self._arm.build(), self._options.lag_s, end_s=self._now)
        return Schedule(self._body.build(), arm, tuple(self._shots), tuple(self._events), self._now, sway)

    def look_at_start_tag(self, visit: str | None) -> None:
        """Stand before the start tag while the arm moves slowly around the direction to it; for one visit or all."""
        tag, count = self._stage.start_tag, self._options.start_images
        named = {} if visit is None else {"visit": visit}
        centre = looking_at(self._stage.world_from_start, tag.world_from_tag.translation).as_array()
        swing = np.radians([6.0, 0.0, 0.0, 0.0, 3.0, 0.0]) * self._rng.uniform(0.7, 1.0) * self._rng.choice([-1.0, 1.0])
        self._reach(centre - swing)
        self.wait(self._options.settle_s)
        self._event("start_begin", tag_id=tag.id, **named)
        self.wait(0.1)
        begin, seconds = self._now, 0.3 * count
        self._arm.move(centre + swing, seconds=seconds)
        self._body.hold_until(self._now)
        for k in range(count):
            self._shots.append(Shot(begin + seconds * (k + self._rng.uniform(0.2, 0.8)) / count))
        self.wait(0.1)
        self._event("start_end", tag_id=tag.id, **named)
        self._reach(robot.STOWED.as_array())
        self.wait(0.2)

    def drive_to(self, index: int) -> None:
        """Drive from the start, or from the waypoint before, to a waypoint, the arm stowed."""
        once = self._options.starts == "once" and index > 0
        origin = self._stage.waypoints[index - 1].world_from_body if once else self._stage.world_from_start
        self._drive(_flat(origin), _flat(self._stage.waypoints[index].world_from_body))

    def leave(self, index: int) -> None:
        """Stow the arm and drive back to the start where the next visit begins there."""
        self._reach(robot.STOWED.as_array())
        if index + 1 < len(self._stage.waypoints) and self._options.starts == "each":
            waypoint = self._stage.waypoints[index]
            self._drive(_flat(waypoint.world_from_body), _flat(self._stage.world_from_start))

    def look_around(self, index: int) -> None:
        """Take the views of a waypoint: stowed, forward, the sweep, and the tripod tag."""
        waypoint = self._stage.waypoints[index]
        following = self._stage.waypoints[index + 1].id if index + 1 < len(self._stage.waypoints) else None
        self.wait(0.4)
        more = {} if following is None else {"next": following}
        self._event("visit_begin", visit=waypoint.id, tag_id=waypoint.tag.id, **more)
        self._view(waypoint, "stowed", "stowed", robot.STOWED)
        self._view(waypoint, "forward", "forward", robot.looking(self._forward_yaw(index), 0.0))
        for k, arm in enumerate(sweep_arms(self._options)):
            self._view(waypoint, f"s{k:02d}", "sweep", arm)
        for k, arm in enumerate(waypoint.truth_arms):
            self._view(waypoint, f"t{k:02d}", "truth", arm)
        self.wait(0.2)
        self._event("visit_end", visit=waypoint.id)

    def _view(self, waypoint: Waypoint, view: str, kind: ViewKind, arm: robot.ArmJoints) -> None:
        self._reach(arm.as_array())
        self.wait(self._options.settle_s + self._rng.uniform(0.0, 0.05))
        self._shots.append(Shot(self._now, waypoint.id, view, kind))
        self.wait(0.1)

    def _reach(self, arm: Array) -> None:
        """Move the arm; it starts and stops smoothly, so the peak speed is one and a half times the mean."""
        self._arm.hold_until(self._now)
        travel = float(np.abs(arm - self._arm.values).max())
        self._arm.move(arm, seconds=max(1.5 * travel / self._options.arm_rad_s, 0.3))
        self._body.hold_until(self._now)

    def _drive(self, start: Array, goal: Array) -> None:
        path = plan_path(self._stage.scene, self._graph, (start[:2], goal[:2]), radius_m=self._radius_m)
        yaws = headings(path)
        yaws += 2 * np.pi * np.round((self._body.values[2] - yaws[0]) / (2 * np.pi))
        self._turn_body(yaws[0])
        begin = self._now
        seconds = 1.5 * len(path) * SPACING_M / self._options.speed_m_s
        self._body.follow(np.column_stack([path, yaws]), seconds=seconds)
        self._arm.hold_until(self._now)
        self._shoot_while_driving(begin, seconds)
        self._turn_body(goal[2] + 2 * np.pi * np.round((yaws[-1] - goal[2]) / (2 * np.pi)))

    def _shoot_while_driving(self, begin_s: float, seconds: float) -> None:
        """Take a few images on the way, where the stowed hand, ahead of the body, does not reach over furniture."""
        count, track = self._options.drive_images, self._body.build()
        for k in range(count):
            t_s = begin_s + seconds * (k + self._rng.uniform(0.3, 0.7)) / count
            x, y, yaw = track.at(t_s)[0]
            hand = (robot.standing([x, y], yaw) * robot.body_from_camera(robot.STOWED)).translation
            if clear_around(self._stage.scene, hand, radius_m=0.1):
                self._shots.append(Shot(t_s))

    def _turn_body(self, yaw: float) -> None:
        x, y, before = self._body.values
        self._body.hold_until(self._now)
        self._body.move([x, y, yaw], seconds=max(1.5 * abs(yaw - before) / self._options.turn_rad_s, 0.3))
        self._arm.hold_until(self._now)

    def _forward_yaw(self, index: int) -> float:
        """Return the arm's yaw towards the path to the next waypoint; at the last one, the way the robot arrived.

        Behind the robot, where sh0 does not reach, it is the nearest that it reaches.
        """
        here = self._stage.waypoints[index].world_from_body
        if index + 1 < len(self._stage.waypoints):
            goal = self._stage.waypoints[index + 1].world_from_body.translation[:2]
            ends = (here.translation[:2], goal)
            path = plan_path(self._stage.scene, self._graph, ends, radius_m=self._radius_m)
            target = path[min(int(LOOKAHEAD_M / SPACING_M), len(path) - 1)]
            step = target - here.translation[:2]
        else:
            before = self._stage.waypoints[index - 1].world_from_body if index else self._stage.world_from_start
            step = here.translation[:2] - before.translation[:2]
        wanted = robot.looking(float(np.arctan2(step[1], step[0])) - _flat(here)[2], 0.0).sh0
        return float(np.clip(wanted, *robot.SH0_RANGE_RAD))

    def _event(self, event: str, **values: Any) -> None:
        self._events.append((self._now, {"event": event, **values}))


def sweep_arms(options: ScheduleOptions) -> list[robot.ArmJoints]:
    """Return the arm poses of the sweep: all that sh0 reaches at every pitch, rows staggered, back and forth."""
    low, high = robot.SH0_RANGE_RAD
    step = min(2 * np.pi / options.sweep_yaws, (high - low) / (options.sweep_yaws - 0.5))
    arms = []
    for row, pitch in enumerate(options.sweep_pitches_deg):
        yaws = low + step * (np.arange(options.sweep_yaws) + 0.5 * (row % 2))
        arms += [robot.looking(float(yaw), np.radians(pitch)) for yaw in (yaws if row % 2 == 0 else yaws[::-1])]
    return arms


def _flat(body: Pose) -> Array:
    """Return x, y and yaw of an upright body."""
    forward = body.rotation.apply([1.0, 0.0, 0.0])
    return np.array([*body.translation[:2], np.arctan2(forward[1], forward[0])])
