"""Add to a dataset's maps what a network of appearance sees at their landmarks."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from fieldkit import maps
from fieldkit.dataset.folder import WORK_FOLDER, own, tidy
from fieldkit.dataset.source import ViewSource
from fieldkit.dataset.worker import map_key
from fieldkit.errors import DatasetError
from fieldkit.features.appearance import open_appearance
from fieldkit.store.datasets import map_path, read_dataset, read_scene


def open_weights(network: str, *, weights: Path | None = None) -> None:
    """Find and read a network's weights, to miss them before hours of work; raises WeightsError without."""
    open_appearance(network, weights=weights)


def add_appearances(
    sources: Sequence[ViewSource],
    out: Path,
    *,
    network: str,
    weights: Path | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> None:
    """Add a network's view of the landmarks to the maps of a dataset's scenes that lack it.

    A dataset keeps no mapping images: the sources write them again, the same as before. Maps, features and labels stay
    as they are. Raises what `fieldkit.maps.add_appearance` raises, and DatasetError when a source is not what a scene's
    map was made from, or another run holds the folder.
    """
    out = Path(out)
    with own(out):
        rules = read_dataset(out).rules
        tidy(out, tuple(s.name for s in sources))
        try:
            for source in sources:
                entry = read_scene(out, source.name)
                folder = map_path(out, entry)
                if entry.mapping_key != map_key(source, rules):
                    raise DatasetError(
                        f"{folder}: was made from another version of the scene {source.name!r}; expected the same",
                        hint="make the dataset again, or use the version that made it",
                    )
                if network not in maps.known_appearances(folder):
                    _add(source, folder, out / WORK_FOLDER, network=network, weights=weights, progress=progress)
        finally:
            shutil.rmtree(out / WORK_FOLDER, ignore_errors=True)


def _add(
    source: ViewSource,
    folder: Path,
    work: Path,
    *,
    network: str,
    weights: Path | None,
    progress: Callable[[str, int, int], None] | None,
) -> None:
    with tempfile.TemporaryDirectory(dir=work) as name:
        if progress is not None:
            progress(f"{source.name}: mapping images", 0, 1)
        source.write_mapping(Path(name))

        def tell(what: str, done: int, total: int) -> None:
            if progress is not None:
                progress(f"{source.name}: {what}", done, total)

        maps.add_appearance(folder, Path(name), network=network, weights=weights, progress=tell)
