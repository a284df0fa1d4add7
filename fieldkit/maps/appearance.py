"""What networks of appearance see at a map's landmarks: appearance-NETWORK.npz beside the map's other files.

It may be added to a map at any time: the map's digest does not count it, and the file names the map that it is of.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import MapError
from fieldkit.features.appearance import APPEARANCES
from fieldkit.store import atomic_write

Halves = NDArray[np.float16]


def appearance_path(map_folder: Path, network: str) -> Path:
    """Return where the appearance of a map's landmarks by a network lies."""
    return Path(map_folder) / f"appearance-{network}.npz"


def known_appearances(map_folder: Path) -> tuple[str, ...]:
    """Return the networks whose view of the landmarks a map folder has."""
    return tuple(network for network in APPEARANCES if appearance_path(map_folder, network).is_file())


def write_appearance(map_folder: Path, network: str, vectors: Halves, *, digest: str) -> None:
    """Write vectors f16[n, width] of all landmarks of the map with a digest."""
    stream = io.BytesIO()
    np.savez_compressed(stream, allow_pickle=False, map_digest=np.array(digest), vectors=vectors)
    atomic_write(appearance_path(map_folder, network), stream.getvalue())


class Appearances(Mapping[str, Halves]):
    """Vectors f16[count, width] of a map's landmarks by network, each read when it is first asked for.

    A file that is damaged, or is not of the map with this digest and number of landmarks, raises MapError then: whoever
    needs no appearance never meets it. ``map_folder`` has to stay while vectors may be asked for.
    """

    def __init__(self, map_folder: Path, *, digest: str, count: int) -> None:
        self._folder, self._digest, self._count = Path(map_folder), digest, count
        self._names = known_appearances(self._folder)
        self._known: dict[str, Halves] = {}

    def __getitem__(self, network: str) -> Halves:
        """Return vectors f16[count, width]; raises KeyError for a network whose view the map lacks."""
        if network not in self._names:
            raise KeyError(network)
        if network not in self._known:
            self._known[network] = _read(self._folder, network, digest=self._digest, count=self._count)
        return self._known[network]

    def __contains__(self, network: object) -> bool:
        """Tell by the names of files alone."""
        return network in self._names

    def __iter__(self) -> Iterator[str]:
        """Go through the networks' names."""
        return iter(self._names)

    def __len__(self) -> int:
        """Return how many networks' views the map has."""
        return len(self._names)


def _read(map_folder: Path, network: str, *, digest: str, count: int) -> Halves:
    path = appearance_path(map_folder, network)
    again = f"`fieldkit map appearance {map_folder} --source IMAGES --network {network} --force`"
    hint = f"remove it, or add it again: {again}; in a dataset remove it, then `sim-bridge dataset` adds it again"
    try:
        with np.load(path, allow_pickle=False) as archive:
            made_for, vectors = str(archive["map_digest"]), archive["vectors"]
    except Exception as error:  # numpy, zip and zlib raise many types for damaged files
        raise MapError(f"{path}: cannot be read: {error}; expected the landmarks' appearance", hint=hint) from error
    shape = (count, APPEARANCES[network].dense_width)
    if made_for != digest or vectors.shape != shape or vectors.dtype != np.float16:
        raise MapError(
            f"{path}: {vectors.dtype} of shape {vectors.shape}, of the map {made_for[:12]}; expected float16 of "
            f"shape {shape}, of this map, {digest[:12]}",
            hint=hint,
        )
    if not np.isfinite(vectors).all():
        raise MapError(f"{path}: holds numbers that are not finite; expected unit vectors", hint=hint)
    return np.asarray(vectors)
