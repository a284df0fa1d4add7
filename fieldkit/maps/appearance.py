"""What networks of appearance see at a map's landmarks: appearance-NETWORK.npz beside the map's other files.

It may be added to a map at any time: the map's digest does not count it, and the file names the map that it is of.
"""

from __future__ import annotations

import io
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


def read_appearances(map_folder: Path, *, digest: str, count: int) -> dict[str, Halves]:
    """Return vectors f16[count, width] of the landmarks by network.

    Raises MapError when a file is damaged, or is not of the map with this digest and number of landmarks.
    """
    result = {}
    for network in known_appearances(map_folder):
        path = appearance_path(map_folder, network)
        hint = "remove it, and add it again with `fieldkit map appearance`, in a dataset with `sim-bridge dataset`"
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
        result[network] = vectors
    return result
