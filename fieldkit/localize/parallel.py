"""Several images at once: most of a query is compiled code that lets other threads run."""

from __future__ import annotations

import concurrent.futures
import os
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

Given = TypeVar("Given")
Made = TypeVar("Made")


def default_threads() -> int:
    """Return how many images are localized at once where nobody says: as many as there are processors, at most 8."""
    return min(len(os.sched_getaffinity(0)), 8)


def in_threads(work: Callable[[Given], Made], items: Iterable[Given], *, threads: int) -> Iterator[Made]:
    """Yield the results of ``work`` in the order of ``items``, of which few are taken ahead."""
    if threads <= 1:
        yield from map(work, items)
        return
    waiting: list[concurrent.futures.Future[Made]] = []
    with concurrent.futures.ThreadPoolExecutor(threads) as pool:
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) > 2 * threads:
                yield waiting.pop(0).result()
        for future in waiting:
            yield future.result()
