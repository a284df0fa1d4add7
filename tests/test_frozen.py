"""What the published figures rest on stays as it was when they were measured: scenes, sensors, walk, places, changes.

A difference is no defect, but it makes the tables in docs/scenes.md (and all that is trained on these scenes) void.
Who means it makes the figures again and writes the new digests: `python tests/test_frozen.py`.
"""

from __future__ import annotations

import ast
import hashlib
import json
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FROZEN = Path(__file__).with_suffix(".json")
PATTERNS = (
    "scenes/*.py",
    "sensors/*.py",
    "robot/*.py",
    "mapping/mapper.py",
    "stage/tours.py",
    "stage/lookouts.py",
    "stage/paths.py",
)


def digests() -> dict[str, str]:
    paths = sorted(path for pattern in PATTERNS for path in (ROOT / "sim_bridge").glob(pattern))
    return {path.relative_to(ROOT).as_posix(): digest(path.read_text(encoding="utf-8")) for path in paths}


def digest(source: str) -> str:
    """Return a digest of what a module does: comments, docstrings and line breaks do not count."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            node.body = node.body[1:] or [ast.Pass()]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()[:16]


def test_scenes_and_sensors_are_those_of_the_published_figures() -> None:
    assert digests() == json.loads(FROZEN.read_text(encoding="utf-8"))


def test_a_digest_notices_numbers_and_overlooks_comments() -> None:
    plain = "def height():\n    return 2.7\n"
    assert digest('"""Doc."""\n\n\ndef height():\n    """More."""\n    # why\n    return 2.7\n') == digest(plain)
    assert digest(plain.replace("2.7", "2.8")) != digest(plain)


if __name__ == "__main__":
    FROZEN.write_text(json.dumps(digests(), indent=1) + "\n", encoding="utf-8")
