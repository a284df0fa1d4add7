"""Several images at once: most of a query is compiled code that lets other threads run."""

from __future__ import annotations

import concurrent.futures
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

Given = TypeVar("Given")
Made = TypeVar("Made")


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
