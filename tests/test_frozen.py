"""The scenes, sensors, walk and places of the published figures stay as they were when these were measured.

A difference is no defect, but it makes the tables in docs/scenes.md (and all that is trained on these scenes) void.
Who means it makes the figures again and writes the new digests: `python tests/test_frozen.py`. The renderer and the
localizer are not frozen: they may become better, and `tests/test_render.py` says what of them has to stay.
"""

from __future__ import annotations

import ast
import hashlib
import json
from pathlib import Path
from typing import Any

from sim_bridge.dataset import SceneOptions

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
    found = {path.relative_to(ROOT).as_posix(): digest(path.read_text(encoding="utf-8")) for path in paths}
    return {"options": sha(repr(SceneOptions())), **found}


def digest(source: str) -> str:
    """Return a digest of what a module does: comments, docstrings and line breaks do not count."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            node.body = node.body[1:] or [ast.Pass()]
    return sha(repr(plain(tree)))


def plain(node: Any) -> Any:
    """Return a syntax tree as lists, without empty fields: newer versions of Python have more of them."""
    if isinstance(node, ast.AST):
        fields = [(name, plain(value)) for name, value in ast.iter_fields(node) if value not in (None, [])]
        return [type(node).__name__, *fields]
    return [plain(item) for item in node] if isinstance(node, list) else node


def sha(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def test_scenes_and_sensors_are_those_of_the_published_figures() -> None:
    assert digests() == json.loads(FROZEN.read_text(encoding="utf-8"))


def test_a_digest_notices_numbers_and_overlooks_comments() -> None:
    source = "def height():\n    return 2.7\n"
    assert digest('"""Doc."""\n\n\ndef height():\n    """More."""\n    # why\n    return 2.7\n') == digest(source)
    assert digest(source.replace("2.7", "2.8")) != digest(source)


if __name__ == "__main__":
    FROZEN.write_text(json.dumps(digests(), indent=1) + "\n", encoding="utf-8")
