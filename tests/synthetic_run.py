"""A seeded run without images, bag or map: a room, waypoints in it, views, estimates with noise, and failures."""

from __future__ import annotations

import dataclasses
import io

import numpy as np
from PIL import Image, ImageDraw
from scipy.spatial.transform import Rotation

from fieldkit import protocol as protocols
from fieldkit.cameras import Camera
from fieldkit.frames import Pose, exp, pose_error, yaw_pose
from fieldkit.protocol import Protocol
from fieldkit.scores import make_trials
from fieldkit.types import (
    Candidates,
    Estimate,
    Excluded,
    PlanView,
    Prior,
    Run,
    Truth,
    ViewKind,
    ViewResult,
    VisitPlan,
)  # fmt: skip

CAMERA = Camera("PINHOLE", 640, 480, (552.0, 552.0, 320.0, 240.0))
KINDS: tuple[ViewKind, ...] = (*(["sweep"] * 12), "stowed", "forward")
VIEWS = (*(f"{i:02d}" for i in range(12)), "stowed", "forward")
CAM_AXES = Rotation.from_matrix([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclasses.dataclass(frozen=True)
class VisitInputs:
    """What `make_trials` takes for one visit."""

    plan: VisitPlan
    results: dict[str, ViewResult]
    truths: dict[str, Truth]


def body_from_cam(index: int) -> Pose:
    """The arm's pose for a view: 12 sweep directions on a circle, then stowed and forward."""
    yaw = index * np.pi / 6 if index < 12 else 0.0
    pitch = -0.25 if index % 2 else 0.0
    rotation = Rotation.from_euler("ZY", [yaw, pitch]) * CAM_AXES
    return Pose.from_components([0.3 * np.cos(yaw), 0.3 * np.sin(yaw), 0.6], rotation)


def make_visit(
    rng: np.random.Generator, visit: str, *, session: str = "s1", fail: float = 0.25, protocol: Protocol | None = None
) -> VisitInputs:
    """Make one visit with random place, prior, estimates and utilities; ``fail`` is the share of failed views."""
    map_from_body = yaw_pose([*rng.uniform([-3, -2], [3, 2]), 0.3], rng.uniform(-np.pi, np.pi))
    prior = map_from_body * exp(rng.normal(size=6) * [0, 0, 0.03, 0.1, 0.1, 0.005])
    arms = [body_from_cam(i) for i in range(len(VIEWS))]
    covariance = np.diag([4e-6] * 3 + [2e-5] * 3)
    truths = {
        v: Truth(visit, v, map_from_body * arm, arm, covariance, "tag") for v, arm in zip(VIEWS, arms, strict=True)
    }
    results = {}
    for i, view in enumerate(VIEWS):
        noise = exp(rng.normal(size=6) * 10 ** rng.uniform(-3.0, -0.4))
        failed = bool(rng.random() < fail)
        estimate = Estimate(
            None if failed else truths[view].map_from_cam * noise, None if failed else covariance,
            int(rng.integers(200, 300)), 0 if failed else int(rng.integers(12, 200)),
            "few_inliers" if failed else "ok", 0.0 if failed else 0.9, {"extract": 0.05, "pnp": 0.01},
        )  # fmt: skip
        results[view] = ViewResult(session, visit, view, KINDS[i], 1_000_000_000 * i, estimate)
    allowed = np.array([k == "sweep" for k in KINDS])
    candidates = Candidates(
        visit, VIEWS, KINDS, tuple(prior * arm for arm in arms), CAMERA, allowed, np.array([1.0, 0, 0])
    )
    rules = protocol or protocols.load("paper_real")
    plan = VisitPlan(
        session, Prior(visit, prior, np.diag([1e-6, 1e-6, 1e-3, 0.01, 0.01, 1e-6]), 10**9, 6.4, 12),
        pose_error(prior, map_from_body), candidates, make_utilities(rng, rules, allowed),
    )  # fmt: skip
    return VisitInputs(plan, results, truths)


def make_utilities(
    rng: np.random.Generator, protocol: Protocol, allowed: np.ndarray
) -> dict[tuple[str, bool | None], np.ndarray]:
    """Make utilities of every ranking policy of a protocol: counts as integers, so that ties happen."""
    utilities: dict[tuple[str, bool | None], np.ndarray] = {}
    for name in protocol.policies:
        if name in ("odometry", "best_possible"):
            continue
        if name in ("stowed", "forward"):
            utilities[name, None] = np.where([k == name for k in KINDS], 0.0, -np.inf)
        elif name == "random":
            utilities[name, None] = np.where(allowed, 0.0, -np.inf)
        else:
            for occlusion in (False, True):
                values = rng.integers(0, 12, len(VIEWS)).astype(float)
                utilities[name, occlusion] = np.where(allowed, values, -np.inf)
    return utilities


def make_run(seed: int = 0, *, n_visits: int = 6, name: str = "paper_real", visits: list[str] | None = None) -> Run:
    """Make a whole run: trials by the real `make_trials`, thumbnails, a room to draw, and one exclusion."""
    rng = np.random.default_rng(seed)
    protocol = protocols.load(name)
    names = visits or [f"w{i:02d}" for i in range(1, n_visits + 1)]
    inputs = [make_visit(rng, visit, protocol=protocol) for visit in names]
    return Run(
        protocol=protocol,
        map_digest="3f6d" * 16,
        tags_digest="a1b2" * 16,
        recordings=("session/robot.mcap",),
        sessions=("s1",),
        seed=seed,
        versions={"fieldkit": "0.1.0", "numpy": np.__version__},
        trials=tuple(t for i in inputs for t in make_trials(i.plan, i.results, i.truths, protocol=protocol)),
        results=tuple(r for i in inputs for r in i.results.values()),
        truths=tuple(("s1", t) for i in inputs for t in i.truths.values()),
        plans=tuple(i.plan for i in inputs),
        plan_view=room(rng),
        thumbnails={f"s1/{i.plan.prior.visit}/{v}": picture(f"{v}", k) for k, i in enumerate(inputs) for v in VIEWS},
        excluded=(Excluded("visit w99", "tripod tag 2 was not seen"),),
        path="build/run",
    )


def room(rng: np.random.Generator) -> PlanView:
    """Landmarks on four walls and two boxes, and mapping cameras on an oval walk."""
    side, along = rng.integers(0, 4, 3000), rng.uniform(-1, 1, 3000)
    x = np.select([side == 0, side == 1], [np.full(3000, -4.0), np.full(3000, 4.0)], 4 * along)
    y = np.select([side == 2, side == 3], [np.full(3000, -3.0), np.full(3000, 3.0)], 3 * along)
    walls = np.column_stack([x, y, rng.uniform(0, 2.5, 3000)]) + rng.normal(size=(3000, 3)) * 0.01
    box = rng.uniform([0.5, -0.3, 0], [1.5, 0.3, 1], (500, 3))
    angle = np.linspace(0, 2 * np.pi, 60)
    cameras = np.column_stack([2.8 * np.cos(angle), 1.9 * np.sin(angle), np.full(60, 1.6)])
    return PlanView(np.vstack([walls, box]).astype(np.float32), cameras.astype(np.float32))


def picture(text: str, shade: int) -> bytes:
    """A small JPEG with a text on it."""
    image = Image.new("RGB", (160, 120), (60 + 25 * shade, 90, 140))
    ImageDraw.Draw(image).text((60, 50), text, fill="white")
    stream = io.BytesIO()
    image.save(stream, "JPEG", quality=80)
    return stream.getvalue()
