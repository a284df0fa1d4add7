"""One self-contained HTML page about one or several runs: no image, bag or map is opened, nothing is loaded."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from fieldkit import __version__
from fieldkit.errors import ReportError
from fieldkit.report.page import chapter, thumbnail_key
from fieldkit.store import atomic_write, refuse_existing
from fieldkit.types import Run

__all__ = ["render", "thumbnail_key", "write_report"]


def write_report(runs: Sequence[Run], out: Path, *, force: bool = False) -> None:
    """Write the report of runs to an HTML file; each run is a chapter, runs are never pooled.

    Raises ReportError when there is no run, StoreError when ``out`` is a folder, or exists and ``force`` is not set.
    The page is made before the file is touched: a failure leaves the old file.
    """
    refuse_existing(out, force=force, kind="file")
    atomic_write(out, render(runs))


def render(runs: Sequence[Run]) -> str:
    """Return the page as text; the same runs give the same page. Raises ReportError when there is no run."""
    if not runs:
        raise ReportError("no run to report; expected at least one run folder", hint="make one with `fieldkit replay`")
    environment = Environment(
        loader=PackageLoader("fieldkit.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    chapters = [chapter(run, i) for i, run in enumerate(runs)]
    return environment.get_template("template.html.j2").render(chapters=chapters, version=__version__)
