"""What every test may need: the seeded generator and the folder of real data."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder with real data beside the checkout; its absence skips, but fails in CI."""
    if not SHARED_DATA.is_dir():
        if os.environ.get("CI") == "true":
            pytest.fail(f"{SHARED_DATA} is absent; CI runs with the real data beside the checkout")
        pytest.skip("the folder of real data (../shared/data) is absent")
    return SHARED_DATA


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of the tiny source, made by one worker without a break; nothing may be changed in it."""
    from tiny_source import make

    out = tmp_path_factory.mktemp("whole") / "set"
    make(out)
    return out
