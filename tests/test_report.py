"""The report: self-contained, escaped, deterministic, complete, and readable by a real browser."""

from __future__ import annotations

import dataclasses
import html
import json
import math
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest
from synthetic_run import make_run

from fieldkit import report, store
from fieldkit.errors import ReportError, StoreError
from fieldkit.report import render, thumbnail_key, write_report
from fieldkit.report.page import _provenance
from fieldkit.scores import summarize_run, table
from fieldkit.types import Excluded, PlanView, Run

VOID = {"meta", "link", "img", "br"}
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.fixture(scope="module")
def run() -> Run:
    return make_run(0)


@pytest.fixture(scope="module")
def page(run: Run) -> str:
    return render([run])


class Reader(HTMLParser):
    """Collects ids, references, visible text per tag, and checks that tags are balanced."""

    def __init__(self) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.references: list[str] = []
        self.texts: list[str] = []
        self.tags: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag not in VOID:
            self.open.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            if name in ("src", "href", "xlink:href", "srcset", "action", "data"):
                self.references.append(value or "")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


def read(page: str) -> Reader:
    reader = Reader()
    reader.feed(page)
    reader.close()
    return reader


def test_page_is_one_balanced_document_with_unique_ids(run: Run) -> None:
    reader = read(render([run, run]))
    assert reader.open == []
    assert len(reader.ids) == len(set(reader.ids))
    assert reader.tags.count("html") == reader.tags.count("body") == 1


def test_page_loads_nothing(page: str) -> None:
    reader = read(page)
    assert {r.split(",")[0] for r in reader.references if not r.startswith("#")} == {
        "data:", "data:image/jpeg;base64", "data:image/png;base64",
    }  # fmt: skip
    assert "script" not in reader.tags
    assert not re.search(r"@import|url\((?!#)", page)
    assert "default-src 'none'" in page


def test_every_reference_inside_the_page_has_its_target(page: str) -> None:
    reader = read(page)
    wanted = {r[1:] for r in reader.references if r.startswith("#")} | set(re.findall(r"url\(#([^)]+)\)", page))
    assert wanted
    assert wanted <= set(reader.ids)


def test_same_run_gives_the_same_page(run: Run, page: str) -> None:
    assert render([make_run(0)]) == page


def test_stored_run_gives_the_same_table_and_page(run: Run, page: str, tmp_path: Path) -> None:
    store.write_run(tmp_path / "run", run)
    again = store.read_run(tmp_path / "run")
    assert table(again).rows == table(run).rows
    assert read(render([again])).texts == read(render([dataclasses.replace(run, path=str(tmp_path / "run"))])).texts


def test_page_states_every_recall_with_its_interval(run: Run, page: str) -> None:
    text = re.sub(r"\s+", " ", html.unescape(re.sub(r"<[^>]+>", " ", page)))
    for summary in summarize_run(run):
        for value, (low, high) in zip(summary.recall, summary.interval, strict=True):
            assert f"{100 * value:.1f} [{100 * low:.0f}, {100 * high:.0f}]" in text


def test_page_states_the_seconds_of_map_and_views(run: Run) -> None:
    estimated = dataclasses.replace(run.results[0].estimate, seconds={"extract": 0.05, "pnp": 0.0125})
    results = (dataclasses.replace(run.results[0], estimate=estimated),)
    timed = dataclasses.replace(run, map_seconds={"verify": 12.0}, results=results)
    told = _provenance(timed)
    assert ("Seconds of building the map", "verify 12") in told
    assert dict(told)["Localizer"].startswith("feature sift, matcher nearest, top 20 retrieved, ")
    assert ("Time per view", "extract 50 (50), pnp 12 (12) ms: median (95th percentile)") in told
    untimed = _provenance(dataclasses.replace(run, results=()))
    assert {("Seconds of building the map", "not known"), ("Time per view", "not known")} <= set(untimed)


def test_best_of_each_column_is_marked_and_is_never_the_oracle(run: Run, page: str) -> None:
    rows = [s for s in summarize_run(run) if s.policy != "best_possible"]
    best = sum(r == max(s.recall[i] for s in rows) for row in rows for i, r in enumerate(row.recall))
    assert page.count('class="recall best"') == best > 0
    oracle = page[page.index("<tfoot>") : page.index("</tfoot>")]
    assert "best possible" in oracle
    assert 'class="recall best"' not in oracle


def test_every_waypoint_lists_every_policy(run: Run, page: str) -> None:
    variants = len({(t.policy, t.occlusion) for t in run.trials})
    for plan in run.plans:
        section = page[page.index(f"Waypoint {plan.prior.visit}</h3>") :]
        section = section[: section.index("<details>")]
        assert section.count('class="chip"') >= variants
        assert f"{plan.prior_error[0]:.3f} m, {math.degrees(plan.prior_error[1]):.2f}°" in section
        assert "tag; median sigma 0.008 m, 0.20°" in section


def test_policies_that_chose_the_same_view_share_its_picture(run: Run, page: str) -> None:
    # More than three tied views are summed up as an expectation, without pictures.
    shown = {(t.visit, t.view) for t in run.trials if t.policy != "odometry" and t.weight > 0.3}
    assert page.count("data:image/jpeg;base64") == len(shown)


def test_failures_are_shown_with_their_reason(run: Run, page: str) -> None:
    failed = {t.visit for t in run.trials if t.status == "few_inliers" and t.weight > 0.4}
    assert failed
    assert page.count('<tr class="failed">') >= len(failed)
    assert "failed: few inliers" in page


def test_page_states_provenance_and_exclusions(run: Run, page: str) -> None:
    for words in (run.map_digest, run.tags_digest, "paper_real, version 1", "body in the map", "tripod tag"):
        assert words in page
    assert "<strong>visit w99</strong>: tripod tag 2 was not seen" in page


def test_names_from_files_are_escaped_everywhere() -> None:
    evil = '<script>alert("$x$")</script>&'
    run = make_run(0, visits=[evil, "w02"])
    run = dataclasses.replace(run, path=f"build/{evil}", recordings=(evil,), excluded=(Excluded(evil, evil),))
    page = render([run])
    assert "script" not in read(page).tags
    assert "<script" not in page
    assert "&lt;script&gt;alert(" in page


def test_several_runs_are_chapters_with_their_own_rows(run: Run) -> None:
    other = dataclasses.replace(make_run(1, n_visits=3, name="paper_sim"), path="build/other")
    page = render([run, other])
    assert page.count("<tfoot>") == 2
    assert '<a href="#r1">other</a>' in page


def test_run_without_a_scored_visit_still_says_why(run: Run) -> None:
    empty = dataclasses.replace(run, trials=(), plans=(), results=(), truths=(), thumbnails={})
    page = render([empty])
    assert "No waypoint was scored" in page
    assert "tripod tag 2 was not seen" in page


def test_run_without_pictures_and_landmarks_is_drawn(run: Run) -> None:
    nothing = run.plan_view.landmarks[:0]
    bare = dataclasses.replace(run, thumbnails={}, plan_view=PlanView(nothing, nothing))
    assert "Map from above" in render([bare])


def test_existing_file_is_kept_unless_forced(run: Run, page: str, tmp_path: Path) -> None:
    out = tmp_path / "report.html"
    out.write_text("old")
    with pytest.raises(StoreError, match=r"report\.html: exists already; give --force"):
        write_report([run], out)
    assert out.read_text() == "old"
    write_report([run], out, force=True)
    assert out.read_text(encoding="utf-8") == page


def test_report_that_fails_half_way_leaves_the_old_file(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "report.html"
    out.write_text("old")
    torn_trial = dataclasses.replace(run.trials[0], cam_error=None)  # type: ignore[arg-type]
    torn = dataclasses.replace(run, trials=(torn_trial, *run.trials[1:]))
    with pytest.raises(TypeError):
        write_report([torn], out, force=True)
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
    assert out.read_text() == "old"


def test_no_run_and_a_folder_as_output_are_errors(run: Run, tmp_path: Path) -> None:
    with pytest.raises(ReportError, match="no run to report; expected at least one run folder"):
        write_report([], tmp_path / "report.html")
    with pytest.raises(StoreError, match="is a folder; expected a file"):
        write_report([run], tmp_path)


def test_thumbnails_are_found_by_session_visit_and_view() -> None:
    assert thumbnail_key("s1", "w01", "07") == "s1/w01/07"


def test_report_imports_no_heavy_library() -> None:
    code = (
        "import sys, fieldkit.report; print([m for m in ('torch', 'cv2', 'pycolmap', 'rosbags') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_template_is_package_data() -> None:
    assert Path(report.__file__).with_name("template.html.j2").is_file()


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine (apt-get install chromium)")
def test_browser_loads_the_page_without_errors_or_requests(page: str, tmp_path: Path) -> None:
    clean = browse(page, tmp_path / "clean")
    assert clean == ([], [])
    # The same two detectors see a page that does what ours must not.
    bad = page.replace("default-src 'none'", "default-src *").replace("img-src data:", "img-src *")
    bad = bad.replace("</body>", '<img src="http://127.0.0.1:9/x.png" alt=""><script>undefined_thing()</script></body>')
    console, requests = browse(bad.replace("style-src", "script-src 'unsafe-inline'; style-src"), tmp_path / "bad")
    assert any("undefined_thing" in line for line in console)
    assert requests == ["http://127.0.0.1:9/x.png"]


def browse(page: str, folder: Path) -> tuple[list[str], list[str]]:
    """Load a page in headless chromium; return its console messages and the requests that the page made."""
    folder.mkdir()
    file, log = folder / "report.html", folder / "net.json"
    file.write_text(page, encoding="utf-8")
    command = [
        str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
        "--disable-background-networking", "--disable-component-update", "--disable-sync", "--enable-logging=stderr",
        f"--user-data-dir={folder / 'profile'}", f"--log-net-log={log}", "--window-size=1280,1000",
        f"--screenshot={folder / 'page.png'}", file.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert (folder / "page.png").stat().st_size > 10_000
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    events = json.loads(log.read_text(encoding="utf-8"))["events"]
    started = [e["params"] for e in events if "url" in e.get("params", {}) and "initiator" in e.get("params", {})]
    # The browser's own traffic has no page as its initiator.
    mine = {p["url"] for p in started if p["initiator"] != "not an origin" and p["url"].startswith(("http", "ws"))}
    return console, sorted(mine)
