"""Distances between tags against a tape measure: sigma, verdicts, the scale that they mean, and bad input."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fieldkit.checks import TagName, Tape, check_distances, parse_tag
from fieldkit.cli import main
from fieldkit.errors import TagError
from fieldkit.frames import Pose, exp
from fieldkit.store import write_tags
from fieldkit.types import TagMap, TagPose


def tag(tag_id: int, xyz: list[float], *, visit: str | None = None, sigma_m: float = 0.003) -> TagPose:
    turned = Pose.from_components(np.array(xyz), Rotation.from_euler("xyz", [0.3 * tag_id, 0.2, 0.1]))
    covariance = np.diag([1e-6] * 3 + [sigma_m**2] * 3)
    return TagPose(tag_id, "tag36h11", 0.1365, turned, covariance, 6, 0.1, visit=visit)


def lab(*, scale: float = 1.0) -> TagMap:
    places = [(1, [0, 0, 1.0], None), (2, [4.0, 0, 1.2], "w01"), (2, [4.0, 5.0, 1.2], "w02"), (3, [0, 6.0, 0.8], None)]
    tags = tuple(tag(i, (scale * np.array(xyz)).tolist(), visit=visit) for i, xyz, visit in places)
    return TagMap(tags, (), "map", path="tags.toml")


def between(tags: TagMap, a: str, b: str) -> float:
    ends = [tags.find(n.id, visit=n.visit) for n in (parse_tag(a), parse_tag(b))]
    assert None not in ends
    return float(np.linalg.norm(ends[0].map_from_tag.translation - ends[1].map_from_tag.translation))  # type: ignore[union-attr]


def tape(a: str, b: str, metres: float) -> Tape:
    return Tape(parse_tag(a), parse_tag(b), metres)


def test_a_true_distance_passes_with_the_sigma_of_both_tags_and_the_tape() -> None:
    (check,), scale = check_distances(lab(), [tape("1", "3", between(lab(), "1", "3"))], tape_sigma_m=0.004)
    assert check.verdict == scale.verdict == "pass"
    assert check.sigma_m == pytest.approx(math.sqrt(2 * 0.003**2 + 0.004**2))
    assert check.difference_m == pytest.approx(0.0, abs=1e-12)


def test_the_sigma_is_what_distances_of_drawn_tags_scatter_by(rng: np.random.Generator) -> None:
    a, b = tag(1, [0, 0, 1]), tag(2, [2, 1, 1.5])
    spread = np.diag([1e-4] * 3 + [0.01**2, 0.002**2, 0.004**2])
    tags = TagMap(tuple(TagPose(t.id, t.family, t.size_m, t.map_from_tag, spread, 6, 0.1) for t in (a, b)), (), "map")
    (check,), _ = check_distances(tags, [tape("1", "2", 2.3)], tape_sigma_m=1e-6)
    noise = rng.multivariate_normal(np.zeros(6), spread, (2, 4000))
    drawn = [
        np.linalg.norm((a.map_from_tag * exp(m)).translation - (b.map_from_tag * exp(n)).translation)
        for m, n in zip(*noise, strict=True)
    ]
    assert check.sigma_m == pytest.approx(float(np.std(drawn)), rel=0.05)


def test_a_scale_error_is_found_and_all_distances_agree_on_it() -> None:
    tapes = [tape(a, b, between(lab(), a, b)) for a, b in (("1", "3"), ("1", "2@w01"), ("2@w01", "2@w02"))]
    checks, scale = check_distances(lab(scale=1.02), tapes)
    assert [c.verdict for c in checks] == ["fail"] * 3
    assert (scale.error, scale.verdict) == (pytest.approx(0.02), "fail")
    assert scale.sigmas < 0.1
    assert 0.0001 < scale.sigma < min(c.sigma_share for c in checks)


def test_a_moved_tag_is_told_from_a_wrong_scale() -> None:
    tapes = [tape(a, b, between(lab(), a, b)) for a, b in (("1", "3"), ("1", "2@w01"))]
    tapes.append(tape("2@w01", "2@w02", between(lab(), "2@w01", "2@w02") + 0.1))
    checks, scale = check_distances(lab(), tapes)
    assert [c.verdict for c in checks] == ["pass", "pass", "fail"]
    assert scale.verdict == "fail"
    assert scale.sigmas > 4


def test_what_is_off_by_little_is_to_be_measured_again_and_what_is_near_says_little() -> None:
    distance = between(lab(), "1", "3")
    (check,), _ = check_distances(lab(), [tape("1", "3", distance + 0.015)])
    assert (check.verdict, check.reason) == ("warn", "off by 3.2 sigma: measure again")
    (check,), scale = check_distances(lab(), [tape("1", "3", distance)], tape_sigma_m=0.1)
    assert (check.verdict, scale.verdict) == ("warn", "warn")
    assert check.reason.startswith("too coarse: 2 sigma are 3.3 %")


def test_a_tag_is_named_by_its_id_where_it_has_one_place() -> None:
    moved_once = TagMap(lab().tags[:2], (), "map")
    (check,), _ = check_distances(moved_once, [tape("1", "2", 4.0)])
    assert check.map_m == pytest.approx(between(lab(), "1", "2@w01"))
    assert parse_tag("3@w 2") == TagName(3, "w 2")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("1", "9", 2.0), r"tags\.toml: has no tag 9; expected one of 1, 2@w01, 2@w02, 3; correct the id"),
        (("1", "2", 2.0), r"tags\.toml: tag 2 has a pose per visit; expected one of 2@w01, 2@w02; name the visit"),
        (("1", "2@w7", 2.0), r"tag 2@w7 has a pose per visit; expected one of 2@w01, 2@w02"),
        (("1", "1", 2.0), r"--distance 1 1: is the same tag twice; expected two tags"),
        (("1", "3", 0.0), r"--distance 1 3 0: no distance between two tags; expected metres, 0.05 to 1000"),
        (("1", "3", math.nan), r"no distance between two tags"),
        (("1", "x", 2.0), r"--distance: 'x' is no tag; expected an id \(3\), or an id and a visit \(3@w02\)"),
        (("1", "3@", 2.0), r"'3@' is no tag"),
    ],
)
def test_bad_distances_are_named(words: tuple[str, str, float], message: str) -> None:
    with pytest.raises(TagError, match=message):
        check_distances(lab(), [tape(*words)])


def test_the_command_prints_json_and_fails_with_status_3(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_tags(tmp_path / "tags.toml", lab())
    true = between(lab(), "1", "3")
    for metres, status, verdict in ((true, 0, "pass"), (true * 1.01, 3, "fail")):
        words = ["tags", "check", str(tmp_path / "tags.toml"), "--distance", "1", "3", str(metres), "--json"]
        with pytest.raises(SystemExit) as stop:
            main(words)
        said = json.loads(capsys.readouterr().out)
        assert stop.value.code == status
        assert said["distances"][0]["verdict"] == said["scale"]["verdict"] == verdict
    with pytest.raises(SystemExit) as stop:
        main(["tags", "check", str(tmp_path / "tags.toml")])
    assert stop.value.code == 1
    assert "nothing to check; expected --distance" in capsys.readouterr().err
