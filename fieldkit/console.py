"""What the command line prints: tables, JSON, progress bars and log lines."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any

from rich.console import Console
from rich.logging import RichHandler
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from fieldkit.store import plain_json


def log_handler() -> logging.Handler:
    """Return the handler of log lines; away from a terminal every message is one plain line."""
    console = Console(stderr=True)
    if console.is_terminal:
        return RichHandler(console=console, show_time=False, show_path=False, markup=False)
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(levelname)s %(message)s"))
    return handler


class ProgressBars:
    """Progress bars on stderr, one per step; a step is called as (what, done, total).

    What stands behind " | " in ``what`` may change from call to call.
    """

    def __init__(self) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        self._progress = Progress(*columns, console=Console(stderr=True))
        self._steps: dict[str, Any] = {}

    def __enter__(self) -> Callable[[str, int, int], None]:
        return self._update

    def __exit__(self, *_: object) -> None:
        # Stopping one that never started would print an empty line before a mistake's one line
        if self._steps:
            self._progress.stop()

    def _update(self, what: str, done: int, total: int) -> None:
        # Shown from the first step on: a mistake that is found before it stays one line.
        self._progress.start()
        step = what.split(" | ")[0]
        if step not in self._steps:
            self._steps[step] = self._progress.add_task(what, total=total)
        self._progress.update(self._steps[step], completed=done, total=total, description=what)


def cells(values: Sequence[object]) -> list[str]:
    """Return the cells of a table row as text, in which brackets are brackets."""
    return [escape(str(v)) for v in values]


def make_table(*header: str, title: str | None = None) -> Table:
    """Return an empty table with its title on the left; what names a row is never cut."""
    table = Table(*header, title=title, title_justify="left")
    if table.columns:
        table.columns[0].no_wrap = True
    return table


def print_json(values: Any) -> None:
    """Print JSON without NaN or Infinity on stdout."""
    print(plain_json(values), end="")


def print_mapping(values: dict[str, Any], *, title: str) -> None:
    """Print plain values as a table of names, and every list of records as a table of its own."""
    console = Console(width=max(120, Console().width))
    records = {k: v for k, v in values.items() if isinstance(v, list) and v and isinstance(v[0], dict)}
    table = Table("", "", show_header=False, title=escape(title), title_justify="left")
    for key, value in _flat({k: v for k, v in values.items() if k not in records}):
        table.add_row(*cells([key, _text(value)]))
    console.print(table)
    for key, rows in records.items():
        listed = make_table(*rows[0], title=key)
        for row in rows:
            listed.add_row(*cells([_text(row.get(column)) for column in rows[0]]))
        console.print(listed)


def _text(value: Any) -> str:
    if value is None or value == []:
        return "-"
    if isinstance(value, dict):
        return ", ".join(f"{k}: {_text(v)}" for k, v in value.items())
    if isinstance(value, list):
        return "\n".join(_text(v) for v in value)
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def _flat(values: dict[str, Any], *, prefix: str = "") -> list[tuple[str, Any]]:
    rows: list[tuple[str, Any]] = []
    for key, value in values.items():
        rows += _flat(value, prefix=f"{prefix}{key}.") if isinstance(value, dict) else [(prefix + key, value)]
    return rows
