"""Why a view was preferred: the figure of all learned policies, its words, and reasons that do not fit their run."""

from __future__ import annotations

import dataclasses
import io
import itertools
import json
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest
from matplotlib.text import Text
from synthetic_run import make_run

from fieldkit import store
from fieldkit.errors import StoreError
from fieldkit.protocol import LEARNED
from fieldkit.report import render
from fieldkit.report.palette import COLOURS
from fieldkit.report.reasons import LOWERED, RAISED, reasons_figure, strongest
from fieldkit.types import Reason, VisitPlan

ORDER = ("max", *LEARNED)
DOTS = {"raised": RAISED, "lowered": LOWERED}
# Colours of light as those see them who lack one kind of cones: Machado, Oliveira and Fernandes 2009, severity 1
SEEN = {
    "all": np.eye(3),
    "no red": np.array([[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]]),
    "no green": np.array([[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]]),
    "no blue": np.array([[1.256, -0.077, -0.179], [-0.078, 0.931, 0.148], [0.005, 0.691, 0.304]]),
}


def reason(plan: VisitPlan, view: str, *, ahead: float = 3.0, count: int = 60) -> Reason:
    """Landmarks about a place ``ahead`` m from the prior, a third of which lowered the score."""
    rng = np.random.default_rng(len(view))
    here = plan.prior.map_from_body.translation + [ahead, 0.0, 0.0]
    raised = np.abs(rng.normal(size=count)) * np.where(np.arange(count) % 3 == 0, -1, 1)
    return Reason(view, (here + rng.normal(size=(count, 3))).astype(np.float32), raised.astype(np.float32))


def explained(*policies: str, view: str | None = None) -> VisitPlan:
    """A plan with reasons of policies, with and without occlusion."""
    plan = make_run(0, n_visits=1).plans[0]
    if view is not None:
        names = (view, *plan.candidates.view_ids[1:])
        plan = dataclasses.replace(plan, candidates=dataclasses.replace(plan.candidates, view_ids=names))
    variants = [(policy, occlusion) for policy in policies for occlusion in (False, True)]
    views = itertools.cycle(plan.candidates.view_ids[:3])
    values = np.linspace(0.2, 0.9, len(plan.candidates.view_ids))
    return dataclasses.replace(
        plan,
        utilities={**plan.utilities, **dict.fromkeys(variants, values)},
        reasons={variant: reason(plan, next(views)) for variant in variants},
    )


@pytest.mark.parametrize("policies", [LEARNED[:1], LEARNED[:3], LEARNED])
def test_all_words_lie_inside_the_figure_and_apart(policies: tuple[str, ...]) -> None:
    plan = explained(*policies, view="sweep of the upper arm, twelfth")
    figure = reasons_figure(plan, make_run(0).plan_view, order=ORDER)
    assert figure is not None
    figure.draw_without_rendering()
    words = [t for t in figure.findobj(Text) if t.get_text() and t.get_visible()]
    titles = [axes.title for axes in figure.axes]
    assert all(title.get_text().count("\n") == 1 for title in titles)
    assert {"raised the score", "lowered it", "map", "prior"} <= {t.get_text() for t in words}
    for text in words:
        box = text.get_window_extent()
        assert figure.bbox.x0 <= box.x0 < box.x1 <= figure.bbox.x1, text.get_text()
        assert figure.bbox.y0 <= box.y0 < box.y1 <= figure.bbox.y1, text.get_text()
    boxes = [title.get_window_extent() for title in titles]
    assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))


def test_panels_are_filled_by_the_prior_and_its_landmarks_at_one_scale() -> None:
    plan = explained("mlp", "vpt")
    near = reason(plan, plan.candidates.view_ids[0], ahead=-1.0)
    plan = dataclasses.replace(plan, reasons={**plan.reasons, ("mlp", False): near})
    figure = reasons_figure(plan, make_run(0).plan_view, order=ORDER)
    assert figure is not None
    here = plan.prior.map_from_body.translation[:2]
    sides = set()
    for axes, variant in zip(figure.axes, [("mlp", False), ("vpt", False), ("mlp", True), ("vpt", True)], strict=True):
        low, high = np.transpose([axes.get_xlim(), axes.get_ylim()])
        shown = plan.reasons[variant].landmarks[:, :2]
        assert ((low < here) & (here < high)).all()
        assert ((low < shown) & (shown < high)).all(axis=1).mean() > 0.9
        sides.add(tuple(np.round(high - low, 9)))
    ((width, height),) = sides
    assert 0.5 <= width / height <= 2.0
    # Three metres ahead and their scatter: a square about the prior would be more than ten metres wide
    assert width < 8.0


def test_counts_are_told_to_be_of_those_asked_for() -> None:
    plan = explained("vpt")
    assert strongest(plan.reasons)[0] == (
        "vpt",
        f"60 landmarks asked for: 40 raised it, 20 lowered it; {_half(plan)} make half of what raised it",
    )
    run = make_run(0, n_visits=1)
    page = " ".join(render([dataclasses.replace(run, plans=(plan,))]).split())
    assert "Of the landmarks that a view sees at most 512 are asked for, and no more than the policy looks at." in page


def _half(plan: VisitPlan) -> int:
    gains = sorted((v for v in plan.reasons["vpt", False].raised if v > 0), reverse=True)
    return next(n for n in range(len(gains) + 1) if sum(gains[:n]) >= sum(gains) / 2)


def test_the_policy_with_appearance_has_a_colour_of_its_own_for_all_eyes() -> None:
    def lab(colour: str, seen: np.ndarray) -> np.ndarray:
        part = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
        light = seen @ np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
        to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
        x, y, z = np.cbrt(to_xyz @ np.clip(light, 0, 1) / [0.9505, 1.0, 1.089])
        return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])

    others = {name: colour for name, colour in COLOURS.items() if name != "vpt_appearance"}
    for seen in SEEN.values():
        mine = lab(COLOURS["vpt_appearance"], seen)
        away = {what: np.linalg.norm(mine - lab(c, seen)) for what, c in (others | DOTS).items()}
        assert min(away.values()) > 15, away
        assert np.linalg.norm(lab(RAISED, seen) - lab(LOWERED, seen)) > 15


@pytest.mark.parametrize(
    ("key", "rows", "wrong"),
    [
        ({"view": "nowhere"}, None, "view 'nowhere' is no candidate; expected one of candidates.csv"),
        ({"policy": "vpt"}, None, "vpt without occlusion has no utilities in this run; expected"),
        ({"occlusion": None}, None, "has no utilities in this run; expected"),
        ({"policy": "gaze"}, None, "gaze without occlusion has no utilities in this run; expected"),
        ({"visit": "w99"}, None, "s1/w99: is no visit of this run; expected one of priors.csv"),
        ({}, [[0.0, 1.0, float("nan"), 0.5]], "holds numbers that are not finite; expected landmarks"),
        ({}, [[0.0, 1.0, 0.0, float("inf")]], "holds numbers that are not finite; expected landmarks"),
        ({}, [0.0, 1.0, 0.0], "cannot reshape"),
        ({}, [["a", "b", "c", "d"]], "Cannot cast"),
    ],
)
def test_reasons_that_do_not_fit_the_run_are_refused_in_one_line(
    tmp_path: Path, key: dict[str, Any], rows: list[Any] | None, wrong: str
) -> None:
    run = make_run(0, n_visits=2)
    plan = run.plans[0]
    lacking = {variant: values for variant, values in plan.utilities.items() if variant[0] != "vpt"}
    plan = dataclasses.replace(plan, utilities=lacking)
    store.write_run(tmp_path / "run", dataclasses.replace(run, plans=(plan, *run.plans[1:])))
    policy, occlusion = next(v for v in plan.utilities if v[1] is not None and not v[1])
    fitting = {
        "session": plan.session, "visit": plan.prior.visit, "policy": policy, "occlusion": occlusion,
        "view": plan.candidates.view_ids[0],
    }  # fmt: skip

    def write(named: dict[str, Any], content: Any) -> None:
        stream = io.BytesIO()
        np.savez(stream, allow_pickle=False, **{quote(json.dumps(list(named.values())), safe=""): np.asarray(content)})
        (tmp_path / "run" / "reasons.npz").write_bytes(stream.getvalue())

    write(fitting, [[0.0, 1.0, 0.0, 0.5]])
    assert (policy, occlusion) in store.read_run(tmp_path / "run").plans[0].reasons
    write(fitting | key, [[0.0, 1.0, 0.0, 0.5]] if rows is None else rows)
    with pytest.raises(StoreError, match=r"reasons\.npz.*replay the recording again") as caught:
        store.read_run(tmp_path / "run")
    assert wrong in str(caught.value)
    assert "\n" not in str(caught.value)
