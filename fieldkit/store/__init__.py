"""Nouns on disk: text files that others read, content digests, and writing that leaves the old or the new."""

from fieldkit.store.corrections import Corrections, read_corrections
from fieldkit.store.datasets import is_dataset
from fieldkit.store.files import (
    atomic_folder,
    atomic_write,
    digest,
    plain_json,
    read_json,
    read_toml,
    refuse_existing,
    write_toml,
)
from fieldkit.store.inputs import (
    Hand,
    PhotoEntry,
    Rig,
    RigCamera,
    SessionFile,
    read_camera,
    read_hand,
    read_photos,
    read_rig,
    read_session,
    read_tum,
    write_camera,
    write_hand,
    write_photos,
    write_rig,
    write_session,
    write_tum,
)
from fieldkit.store.runs import EstimateCache, read_run, write_run
from fieldkit.store.tags import read_tags, write_tags
from fieldkit.store.versions import library_versions

__all__ = [
    "Corrections",
    "EstimateCache",
    "Hand",
    "PhotoEntry",
    "Rig",
    "RigCamera",
    "SessionFile",
    "atomic_folder",
    "atomic_write",
    "digest",
    "is_dataset",
    "library_versions",
    "plain_json",
    "read_camera",
    "read_corrections",
    "read_hand",
    "read_json",
    "read_photos",
    "read_rig",
    "read_run",
    "read_session",
    "read_tags",
    "read_toml",
    "read_tum",
    "refuse_existing",
    "write_camera",
    "write_hand",
    "write_photos",
    "write_rig",
    "write_run",
    "write_session",
    "write_tags",
    "write_toml",
    "write_tum",
]
