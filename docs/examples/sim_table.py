"""Print the simulation table of a run on a dataset as Markdown: recall, paired comparisons, distance to the best view.

``python docs/examples/sim_table.py DATASET RUN --learned vpt --heuristics max angle``, where RUN was written by
``fieldkit replay DATASET``, and the policies (heuristics with and without the occlusion filter) are those that
were best in the training and validation scenes. With ``--repeatable`` the candidates that succeeded are localized
again, so that best possible is also told without its luck (minutes). ``--curves FILE.png`` draws the cumulative errors,
``--reliability FILE.png`` what learned policies said and what came.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fieldkit import scores
from fieldkit.dataset import SourceWaypoint
from fieldkit.dataset.worker import views_key
from fieldkit.errors import FieldkitError, WeightsError
from fieldkit.features import open_extractor
from fieldkit.frames import pose_error
from fieldkit.localize import Localizer, Query
from fieldkit.maps import load_map
from fieldkit.protocol import LEARNED, Threshold
from fieldkit.report.palette import style
from fieldkit.store import read_run
from fieldkit.store.datasets import DatasetRules, Shard, map_path, read_dataset, read_scene, read_scene_shard, row_pose
from fieldkit.training import reliability
from fieldkit.types import Run, Trial
from sim_bridge.dataset import SceneOptions, SceneSource
from sim_bridge.stage.lookouts import LookoutOptions

Array = NDArray[np.float64]
Labels = NDArray[np.bool_]
Pair = tuple[scores.Variant, scores.Variant]
MARGIN = 0.03
JUDGED = (0.1, 1.0)
# The paper's second table is of these keypoints.
PAPER_FEATURE = "superpoint"


def repeatable(dataset: Path, run: Run) -> Labels:
    """Return for every visit of a run whether a candidate succeeds a second time, too, with new noise.

    The candidates that succeeded are drawn and localized again, nearest first, until one of them succeeds again.
    """
    head, found = read_dataset(dataset), {}
    for name in head.scenes:
        entry = read_scene(dataset, name)
        shards = [read_scene_shard(dataset, entry, w) for w in entry.waypoints]
        options = SceneOptions(
            seed=head.source["seed"],
            lookouts=LookoutOptions(count=head.source["lookouts"]["count"], views=head.source["lookouts"]["views"]),
        )
        source = SceneSource(name, options)
        if views_key(source, head.rules) != entry.views_key:
            sys.exit(f"{dataset}: {name} was not made with the standard sensors and changes; expected these")
        localizer = Localizer(load_map(map_path(dataset, entry)), head.rules.localizer, seed=head.rules.seed)
        waypoints = {w.id: w for w in source.waypoints()}
        for s in shards:
            found[name, s.waypoint] = _succeeds_again(s, source, waypoints[s.waypoint], localizer, head.rules)
    return np.array([found[p.session, p.prior.visit] for p in run.plans])


def _succeeds_again(
    shard: Shard, source: SceneSource, waypoint: SourceWaypoint, localizer: Localizer, rules: DatasetRules
) -> bool:
    for i in np.argsort(shard.error[:, 0], kind="stable"):
        if not shard.label[i] or shard.kinds[i] not in rules.candidates.kinds:
            continue
        image = source.shoot(waypoint, waypoint.views[i], repeat=1)
        estimate = localizer.localize_query(Query(image, waypoint.camera))
        if scores.inside(pose_error(estimate.map_from_cam, row_pose(shard.truth[i])), rules.label):
            return True
    return False


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table."""
    return "\n".join(f"| {' | '.join(line)} |" for line in (head, ["---"] * len(head), *rows))


def recall_table(run: Run) -> str:
    """Return recall with its interval per policy, and what could not be run."""
    found = scores.table(run)
    lines = [markdown(found.header, found.rows), found.caption]
    lines += [f"Not run: {e.what}: {e.reason}" for e in run.excluded]
    if run.protocol.feature != PAPER_FEATURE:
        lines.append(f"Not run: {PAPER_FEATURE}: {_why_not(PAPER_FEATURE)}")
    return "\n\n".join(lines)


def _why_not(feature: str) -> str:
    """Say why there is no table of a feature: its weights are not to be had, or nobody made the dataset."""
    try:
        open_extractor(feature)
    except WeightsError as error:
        return error.message
    return f"its weights are here, the dataset is not; make it with sim-bridge dataset --feature {feature}"


def comparison_table(run: Run, pairs: Sequence[Pair], thresholds: Sequence[Threshold]) -> str:
    """Return policies against others, per threshold; p is corrected for the rows of this table."""
    rows = [
        [
            f"{c.a[0]} - {c.b[0]}",
            "yes" if c.a[1] else "no",
            _words(c.threshold),
            f"{100 * c.difference:+.1f}",
            f"{100 * c.interval[0]:+.1f} .. {100 * c.interval[1]:+.1f}",
            f"{c.n_a_only:.1f} / {c.n_b_only:.1f}",
            f"{c.p:.4f}",
            f"{c.p_corrected:.4f}",
            scores.verdict(c, margin=MARGIN),
        ]
        for c in scores.compare(run.trials, pairs, thresholds=thresholds, pose=run.protocol.pose, seed=run.seed)
    ]
    head = ["difference", "occlusion", "threshold", "points", "95 %", "only a / only b", "p", "p (Holm)", "verdict"]
    return markdown(head, rows)


def _words(threshold: Threshold) -> str:
    return f"{threshold.position_m:g} m / {threshold.rotation_deg:g} deg"


def distance_table(run: Run, pairs: Sequence[Pair], bound: Threshold, again: Labels | None) -> str:
    """Return which share of the distance from the heuristic to the best possible view the learned policy covers.

    ``again`` says which visits have a candidate that succeeds a second time, in the order of the run's plans.
    """
    groups = scores.group(run.trials)
    lucky = _hits(run, groups, (scores.BEST_POSSIBLE, None), bound)
    bests = {"lucky": lucky} | ({} if again is None else {"repeatable": again.astype(np.float64)})
    rows = []
    for pair in pairs:
        ours, theirs = (_hits(run, groups, variant, bound) for variant in pair)
        cells = [_share(ours, theirs, best, seed=run.seed) for best in bests.values()]
        named = [f"{policy} {100 * hits.mean():.1f}" for (policy, _), hits in zip(pair, (ours, theirs), strict=True)]
        rows.append(["yes" if pair[0][1] else "no", *named, *cells])
    names = [f"of the distance to {100 * best.mean():.1f} ({name}) [95 %]" for name, best in bests.items()]
    return markdown(["occlusion", "learned", "heuristic", *names], rows)


def _hits(
    run: Run, groups: Mapping[scores.Variant, Sequence[Trial]], variant: scores.Variant, bound: Threshold
) -> Array:
    """Return per visit, in the order of the plans, how much of a variant's choice is inside a threshold."""
    found = scores.hits(groups[variant], bound, pose=run.protocol.pose)
    return np.array([found.get((p.session, p.prior.visit), 0.0) for p in run.plans])


def _share(ours: Array, theirs: Array, best: Array, *, seed: int) -> str:
    """Return (ours - theirs) / (best - theirs) in % with the interval of 10,000 draws of visits."""
    drawn = np.random.default_rng(seed).integers(0, len(ours), (10_000, len(ours)))
    gain, room = (ours - theirs)[drawn].mean(axis=1), (best - theirs)[drawn].mean(axis=1)
    low, high = (
        np.percentile(gain[room > 0] / room[room > 0], [2.5, 97.5]) if (room > 0).any() else (math.nan, math.nan)
    )
    share = (ours - theirs).sum() / (best - theirs).sum() if best.sum() > theirs.sum() else math.nan
    return f"{100 * share:.0f} % [{100 * low:.0f}, {100 * high:.0f}]"


def said_and_true(dataset: Path, run: Run) -> dict[scores.Variant, tuple[Array, Labels]]:
    """Return by learned policy the probability it gave to every candidate, and whether that localized."""
    head, labels = read_dataset(dataset), {}
    for name in head.scenes:
        entry = read_scene(dataset, name)
        for waypoint in entry.waypoints:
            shard = read_scene_shard(dataset, entry, waypoint)
            labels[name, waypoint] = dict(zip(shard.view_ids, shard.label.tolist(), strict=True))
    found: dict[scores.Variant, tuple[list[float], list[bool]]] = {}
    for plan in run.plans:
        own = labels[plan.session, plan.prior.visit]
        for variant, utilities in plan.utilities.items():
            if variant[0] not in LEARNED:
                continue
            said, true = found.setdefault(variant, ([], []))
            for view, utility in zip(plan.candidates.view_ids, utilities, strict=True):
                if math.isfinite(utility):
                    said.append(float(utility))
                    true.append(own[view])
    return {variant: (np.array(said), np.array(true)) for variant, (said, true) in found.items()}


def reliability_table(found: Mapping[scores.Variant, tuple[Array, Labels]]) -> str:
    """Return how well the probabilities hold: Brier score, that of always saying the mean rate, calibration error."""
    rows = []
    for (policy, occlusion), (said, true) in found.items():
        r = reliability(said, true)
        off = np.abs(np.subtract(r.said, r.localized)) @ np.array(r.views) / max(sum(r.views), 1)
        numbers = (f"{r.brier:.3f}", f"{r.brier_of_rate:.3f}", f"{r.log_loss:.3f}", f"{100 * off:.1f} %")
        rows.append([policy, "yes" if occlusion else "no", str(len(said)), *numbers])
    return markdown(["policy", "occlusion", "views", "Brier", "of the mean rate", "log loss", "off by, mean"], rows)


def draw_curves(run: Run, path: Path) -> None:
    """Draw the share of visits below a position error, per policy: with the occlusion filter, and without."""
    figure = Figure(figsize=(11.0, 4.4), layout="constrained")
    both = figure.subplots(1, 2, sharey=True)
    groups = scores.group(run.trials, order=run.protocol.policies)
    for axes, use in zip(both, (True, False), strict=True):
        for (policy, occlusion), trials in groups.items():
            if occlusion in (None, use):
                errors, share = scores.cumulative(trials, pose=run.protocol.pose, part="position")
                axes.step(errors, 100 * share, where="post", color=style(policy, None).colour, label=policy)
        for bound in run.protocol.thresholds:
            axes.axvline(bound.position_m, color="#c3ccd4", linewidth=0.8, zorder=0)
        title = "occlusion filter" if use else "no occlusion filter"
        axes.set(xscale="log", xlim=(1e-3, 2.5), ylim=(0, 100), xlabel="position error (m)", title=title)
    both[0].set_ylabel("waypoints (%)")
    both[1].legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.savefig(path, dpi=110)


def draw_reliability(found: Mapping[scores.Variant, tuple[Array, Labels]], path: Path) -> None:
    """Draw what was said against what localized, in ten bins per learned policy; areas are numbers of views."""
    figure = Figure(figsize=(9.0, 5.0), layout="constrained")
    both = figure.subplots(1, 2, sharey=True)
    for axes, use in zip(both, (True, False), strict=True):
        axes.plot([0, 1], [0, 1], color="#c3ccd4", linewidth=1.0, zorder=0)
        for (policy, occlusion), (said, true) in found.items():
            if occlusion is use:
                r = reliability(said, true)
                there = np.array(r.views) > 0
                x, y, n = np.array(r.said)[there], np.array(r.localized)[there], np.array(r.views)[there]
                axes.plot(x, y, color=style(policy, None).colour, label=policy)
                axes.scatter(x, y, s=120 * n / n.max() + 4, color=style(policy, None).colour)
        title = "occlusion filter" if use else "no occlusion filter"
        axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="said to localize", title=title, aspect="equal")
    both[0].set_ylabel("localized")
    both[0].legend(frameon=False)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("--learned", default="vpt")
    parser.add_argument("--heuristics", nargs=2, default=("max", "angle"), help="with and without the filter")
    parser.add_argument("--repeatable", action="store_true")
    parser.add_argument("--curves", type=Path)
    parser.add_argument("--reliability", type=Path)
    args = parser.parse_args()
    try:
        report(args, read_run(args.run))
    except FieldkitError as error:
        sys.exit(str(error))


def report(args: argparse.Namespace, run: Run) -> None:
    """Print the tables of a run."""
    if set(run.sessions) != set(read_dataset(args.dataset).scenes):
        sys.exit(
            f"{args.run}: is of {', '.join(run.sessions)}; expected the scenes of {args.dataset}, as replayed from it"
        )
    print(recall_table(run), end="\n\n")
    chosen = zip((True, False), args.heuristics, strict=True)
    declared = [((args.learned, occlusion), (heuristic, occlusion)) for occlusion, heuristic in chosen]
    known = scores.learned_pairs(run.trials)
    for pair in declared:
        if pair not in known:
            sys.exit(f"{args.run}: has no rows to compare {pair[0][0]} with {pair[1][0]}; expected both, each way")
    judged = [t for t in run.protocol.thresholds if (t.position_m, t.rotation_deg) == JUDGED]
    if not judged or scores.BEST_POSSIBLE not in run.protocol.policies:
        sys.exit(
            f"{args.run}: has no {JUDGED[0]:g} m / {JUDGED[1]:g} deg or no best possible; expected a run of paper_sim"
        )
    others = [t for t in run.protocol.thresholds if t not in judged]
    print("Declared before the run:", comparison_table(run, declared, judged), sep="\n\n", end="\n\n")
    print("At the other thresholds:", comparison_table(run, declared, others), sep="\n\n", end="\n\n")
    rest = [p for p in known if p not in declared]
    print("Every other pair:", comparison_table(run, rest, judged), sep="\n\n", end="\n\n")
    print(
        "Intervals draw waypoints within these scenes anew; they do not say how much other buildings differ.",
        end="\n\n",
    )
    print(distance_table(run, declared, judged[0], repeatable(args.dataset, run) if args.repeatable else None))
    found = said_and_true(args.dataset, run)
    if found:
        print("", reliability_table(found), sep="\n")
    if found and args.reliability is not None:
        draw_reliability(found, args.reliability)
    if args.curves is not None:
        draw_curves(run, args.curves)


if __name__ == "__main__":
    main()
