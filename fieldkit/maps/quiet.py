"""COLMAP's log goes to stderr, where a command's own words stand."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import pycolmap


@contextlib.contextmanager
def quiet_colmap() -> Iterator[None]:
    """Silence COLMAP's log below errors while it works, and put the old level back."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value + 1
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before
