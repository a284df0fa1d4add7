"""Nothing under the GPL is installed by fieldkit: it is Apache-2.0 and is meant to be used anywhere."""

from __future__ import annotations

import importlib.metadata
import re

import pytest
from packaging.requirements import Requirement


def dependencies(name: str, *, extras: frozenset[str] = frozenset()) -> set[str]:
    """Return the names of all distributions that a distribution needs at run time, directly or not."""
    found: set[str] = set()
    todo = [(name, extras)]
    while todo:
        current, wanted = todo.pop()
        for text in importlib.metadata.requires(current) or []:
            requirement = Requirement(text)
            active = (
                any(requirement.marker.evaluate({"extra": e}) for e in (*wanted, "")) if requirement.marker else True
            )
            if active and requirement.name.lower() not in found:
                found.add(requirement.name.lower())
                todo.append((requirement.name, frozenset(requirement.extras)))
    return found


def licence(name: str) -> str:
    """Return what a distribution says of its licence: expression, classifiers, and the first line of the text."""
    metadata = importlib.metadata.metadata(name)
    classifiers = [c for c in metadata.get_all("Classifier") or [] if c.startswith("License")]
    stated = (metadata.get("License-Expression") or metadata.get("License") or "").strip()
    return " | ".join([*stated.splitlines()[:1], *classifiers])


@pytest.mark.parametrize("name", sorted(dependencies("fieldkit")))
def test_a_dependency_s_licence_is_compatible(name: str) -> None:
    said = licence(name)
    assert not re.search(r"(?<!L)\bA?GPL|GNU (Affero )?General Public", said), f"{name}: {said}"


def test_the_dependencies_are_found() -> None:
    assert {"numpy", "pycolmap", "contourpy", "llvmlite"} <= dependencies("fieldkit")
