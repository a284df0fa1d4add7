"""What is installed is what stands in the checkout."""

from __future__ import annotations

import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_every_package_is_installed() -> None:
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    found = [
        ".".join(p.parent.relative_to(ROOT).parts)
        for top in ("fieldkit", "sim_bridge")
        for p in (ROOT / top).rglob("__init__.py")
    ]
    assert sorted(stated) == sorted([*found, "fieldkit._protocols"])
