"""The versions of the libraries that a result depends on."""

from __future__ import annotations

import importlib.metadata

LIBRARIES = (
    "fieldkit",
    "numpy",
    "scipy",
    "opencv-contrib-python-headless",
    "pycolmap",
    "pupil-apriltags",
    "rosbags",
    "torch",
    "kornia",
)


def library_versions() -> dict[str, str]:
    """Return the installed versions by name; "unknown" for what is not installed as a package."""
    return {name: _version(name) for name in LIBRARIES}


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "unknown"
