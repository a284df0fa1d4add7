"""Global descriptors of mapping images by a network, for retrieval: global.h5 of a map folder, as hloc writes it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import MapError, suggestion
from fieldkit.features.appearance import APPEARANCES

FILE = "global.h5"
Floats = NDArray[np.float32]


def write_global(path: Path, network: str, vectors: Mapping[str, Floats]) -> None:
    """Write unit vectors f32[w] by image name, and which network made them."""
    with h5py.File(path, "w", libver="v110") as file:
        file.attrs["network"] = network
        for name in sorted(vectors):
            file.create_group(name).create_dataset("global_descriptor", data=vectors[name])


def read_global(path: Path, names: Sequence[str]) -> tuple[str, Floats] | None:
    """Return the network's name and unit vectors f32[k, w] of images, None where there is no such file.

    Raises MapError when the file is damaged, lacks an image, or is of a network that is unknown here.
    """
    if not path.is_file():
        return None
    try:
        with h5py.File(path, "r") as file:
            network = str(file.attrs["network"])
            rows = [np.asarray(file[name]["global_descriptor"], dtype=np.float32) for name in names]
    except (OSError, KeyError) as error:
        raise MapError(
            f"{path}: cannot be read: {error}; expected a global descriptor of every image", hint="build the map again"
        ) from error
    if network not in APPEARANCES:
        raise MapError(f"{path}: made by network {network!r}", hint=suggestion(network, list(APPEARANCES)))
    width = APPEARANCES[network].whole_width
    if any(row.shape != (width,) for row in rows):
        raise MapError(f"{path}: not all descriptors are of width {width} of {network!r}", hint="build the map again")
    return network, np.stack(rows) if rows else np.zeros((0, width), dtype=np.float32)
