"""What a reader is told about tags: in the report, the table and JSON, and files that cannot be right."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic_run import make_run
from test_report import read

from fieldkit import store
from fieldkit.errors import StoreError
from fieldkit.frames import Pose
from fieldkit.report import render
from fieldkit.report.tag_figures import two_sigma
from fieldkit.tag_tables import print_tags, tags_json
from fieldkit.types import TAG_BOUNDS, Run, TagMap, TagPhoto, TagPose

UPRIGHT = Pose.from_components([2.0, 1.0, 1.2], Rotation.from_euler("x", 90, degrees=True))
COVARIANCE = np.diag([1e-6] * 3 + [0.002**2, 0.001**2, 0.004**2])


def photo(file: str, tag_id: int, *, used: bool = True, reason: str = "", away_m: float = 0.003) -> TagPhoto:
    return TagPhoto(
        file, tag_id, used, reason, ambiguity=0.12, sigma=1.4, rms_px=0.31, position_m=(2.0 + away_m, 1.0, 1.2),
        offset=(away_m, math.radians(0.2)), without=(0.0015, math.radians(0.05)) if used else None,
    )  # fmt: skip


def tags(name: str = "a.jpg") -> TagMap:
    good = TagPose(
        1, "tag36h11", 0.1365, UPRIGHT, COVARIANCE, 3, 0.27, leave_one_out=(0.0015, math.radians(0.05)),
        size_from_map=(0.1368, 0.0004),
    )  # fmt: skip
    bad = TagPose(
        2, "tag36h11", 0.1365, UPRIGHT, COVARIANCE, 1, 0.3, visit="w01", verdict="fail",
        reason="no two of its 2 photos agree",
    )  # fmt: skip
    photos = [photo(name, 1), photo("b.jpg", 1, away_m=-0.002), photo("c.jpg", 1)]
    wrong = photo(
        "d.jpg", 2, used=False, reason="disagrees with the others by 9.1 sigma (40.0 cm, 2.0 deg)", away_m=0.4
    )
    photos += [dataclasses.replace(p, visit="w01") for p in (photo("e.jpg", 2), wrong)]
    photos.append(TagPhoto("f.jpg", -1, used=False, reason="no tag found"))
    return TagMap((good, bad), tuple(photos), "map")


@pytest.fixture(scope="module")
def run() -> Run:
    return dataclasses.replace(make_run(0, n_visits=1), tags=tags())


def test_the_page_shows_verdicts_reasons_and_their_bounds(run: Run) -> None:
    page = render([run])
    assert "fail</span>: no two of its 2 photos agree" in page
    assert f"{1e3 * TAG_BOUNDS.warn_sigma_m:g} mm" in page
    assert f"{math.degrees(TAG_BOUNDS.warn_sigma_rad):g}°" in page
    for words in ("2.0 / 1.0 / 4.0", "136.8 ± 0.4 mm (136.5 given)", "1.5 mm, 0.05°", "3.0 mm, 0.20°", "1 of 2"):
        assert words in page
    assert "not used: disagrees with the others by 9.1 sigma" in page
    assert "<strong>f.jpg</strong>: no tag found" in page
    assert page.count('aria-label="Position of tag') == 2


def test_the_page_with_tags_is_balanced_loads_nothing_and_is_the_same_again(run: Run) -> None:
    page = render([run, run])
    reader = read(page)
    assert reader.open == []
    assert len(reader.ids) == len(set(reader.ids))
    assert not re.search(r"@import|url\((?!#)", page)
    assert render([run, run]) == page


def test_file_names_of_photos_are_escaped() -> None:
    evil = '<script>alert("x")</script>'
    page = render([dataclasses.replace(make_run(0, n_visits=1), tags=tags(evil))])
    assert "<script" not in page
    assert "&lt;script&gt;" in page


def test_a_run_without_tags_has_no_section_about_them() -> None:
    assert 'aria-label="Tags"' not in render([make_run(0, n_visits=1)])


def test_the_tags_of_a_run_survive_its_folder(run: Run, tmp_path: Path) -> None:
    store.write_run(tmp_path / "run", run)
    again = store.read_run(tmp_path / "run")
    assert again.tags is not None
    texts = [read(render([r])).texts for r in (again, dataclasses.replace(run, path=str(tmp_path / "run")))]
    assert texts[0] == texts[1]


def test_the_ellipse_has_the_covariance_s_axes(rng: np.random.Generator) -> None:
    turn = math.radians(float(rng.uniform(-80, 80)))
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    wide, high, angle = two_sigma(rotation @ np.diag([9.0, 4.0]) @ rotation.T)
    assert (wide, high) == pytest.approx((12.0, 8.0))
    assert math.sin(math.radians(angle) - turn) == pytest.approx(0.0, abs=1e-9)


def test_table_and_json_show_the_diagnostics(capsys: pytest.CaptureFixture[str]) -> None:
    print_tags(tags())
    table = capsys.readouterr().out
    for words in ("3 of 3", "0.1368 +- 0.0004", "1.5 mm 0.05 deg", "at most 10 mm and 0.5 deg"):
        assert words in table
    values = json.loads(store.plain_json(tags_json(tags())))
    assert values["tags"][0]["leave_one_out_m"] == 0.0015
    assert values["tags"][1]["reason"] == "no two of its 2 photos agree"
    assert values["photos"][0]["offset_deg"] == pytest.approx(0.2)
    assert values["photos"][4]["without_m"] is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c * np.where(np.eye(6) > 0, [1, 1, 1, 1, 1, -1], 1), "covariance is not positive definite"),
        (lambda c: c + 0.9e-5 * (np.eye(6, k=1) + np.eye(6, k=-1)), "covariance is not positive definite"),
        (lambda c: c + 1e-7 * np.eye(6, k=2), "covariance is not symmetric; expected 36 numbers, row-major"),
        (lambda c: c * np.inf, "covariance is not finite"),
    ],
)
def test_a_covariance_that_cannot_be_one_is_named_with_its_tag(tmp_path: Path, change: object, message: str) -> None:
    first, second = tags().tags
    with np.errstate(invalid="ignore"):
        broken = dataclasses.replace(second, covariance=change(COVARIANCE))  # type: ignore[operator]
    store.write_tags(tmp_path / "tags.toml", dataclasses.replace(tags(), tags=(first, broken)))
    with pytest.raises(StoreError, match=rf"tags\.toml: tag\[1\] \(id 2\): {message}.*; correct the file"):
        store.read_tags(tmp_path / "tags.toml")


def test_a_tag_that_is_known_exactly_has_a_covariance_of_zeros(tmp_path: Path) -> None:
    exact = dataclasses.replace(tags().tags[0], covariance=np.zeros((6, 6)))
    store.write_tags(tmp_path / "tags.toml", TagMap((exact,), (), "map"))
    assert not store.read_tags(tmp_path / "tags.toml").tags[0].covariance.any()
