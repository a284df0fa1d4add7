"""Print how hard the scenes of a dataset are, and how good their maps, as Markdown.

``python docs/examples/scene_figures.py DATASET RUN``, where RUN was written by ``fieldkit replay DATASET --protocol
paper_sim``. The dataset has to be of named scenes and of seed 0: the true surface is made anew.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fieldkit import scores
from fieldkit.frames import Pose
from fieldkit.judge import nearest_distance
from fieldkit.maps import load_map
from fieldkit.protocol import Threshold
from fieldkit.store import read_run
from fieldkit.store.datasets import map_path, read_dataset, read_gauge, read_scene, read_shard, shard_path
from fieldkit.types import Surface, Trial
from sim_bridge.scenes import make_blueprint
from sim_bridge.scenes.changes import mapped_scene

LIMIT = Threshold(0.1, 1.0)
COLUMNS = (
    ("random", None, "random"),
    ("forward", None, "forward"),
    ("max", True, "max"),
    ("angle", True, "angle"),
    ("fim", True, "FIM"),
    ("best_possible", None, "best possible"),
)
SAMPLE = 5000


def map_row(dataset: Path, name: str) -> list[str]:
    """Return the cells on a scene's map: images, landmarks, error of the images' places, distance to the surface."""
    path = map_path(dataset, read_scene(dataset, name))
    scene_map, gauge = load_map(path), read_gauge(path)
    rng = np.random.default_rng(0)
    chosen = rng.permutation(len(scene_map.xyz))[:SAMPLE]
    world_from_map = Pose.from_components(gauge.position_m, Rotation.from_quat(gauge.quaternion_xyzw))
    scene = mapped_scene(make_blueprint(name, 0), seed=0)
    surface = Surface(scene.vertices, scene.faces, voxel_m=0.0)
    distance = nearest_distance(surface, world_from_map.apply(scene_map.xyz[chosen]), rng=rng)
    return [
        str(len(scene_map.image_names)),
        str(len(scene_map.xyz)),
        f"{1e3 * gauge.rms_m:.1f} mm",
        f"{100 * gauge.scale_error:+.3f} %",
        f"{1e3 * np.median(distance):.1f} mm",
    ]


def flips(dataset: Path, name: str) -> tuple[int, int]:
    """Return how many repeated localizations have another label than the first, and how many there are."""
    flipped = total = 0
    for waypoint in read_scene(dataset, name).waypoints:
        shard = read_shard(shard_path(dataset, name, waypoint))
        flipped += int((shard.repeat_label != shard.label[shard.repeat_view]).sum())
        total += len(shard.repeat_view)
    return flipped, total


def recalls(trials: Iterable[Trial]) -> list[str]:
    """Return the share of waypoints in % within 0.1 m and 1 deg, one cell per column."""
    groups = scores.group(trials)
    found = []
    for policy, occlusion, _ in COLUMNS:
        key = next((k for k in groups if k[0] == policy and (occlusion is None or k[1] == occlusion)), None)
        found.append("-" if key is None else f"{100 * scores.recall(groups[key], LIMIT, pose='cam'):.1f}")
    return found


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("run", type=Path)
    args = parser.parse_args()
    names, trials = read_dataset(args.dataset).scenes, read_run(args.run).trials
    rows, flipped = [], []
    for name in names:
        flipped.append(flips(args.dataset, name))
        own = [t for t in trials if t.session.split("/")[-1] == name]
        rows.append([f"`{name}`", *recalls(own), share(*flipped[-1])])
    rows.append(["all", *recalls(trials), share(*(sum(counts) for counts in zip(*flipped, strict=True)))])
    print(table(["scene", *(title for *_, title in COLUMNS), "labels that flip"], rows))
    print()
    head = ["scene", "images", "landmarks", "images' places (rms)", "scale", "landmarks to surface (median)"]
    print(table(head, [[f"`{name}`", *map_row(args.dataset, name)] for name in names]))


def share(part: int, whole: int) -> str:
    """Return a share in %, with the number it is of."""
    return f"{100 * part / whole:.1f} % of {whole}" if whole else "-"


if __name__ == "__main__":
    main()
