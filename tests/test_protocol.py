"""Protocols: what ships loads, and a mistake is named with its place and a suggestion."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldkit import protocol
from fieldkit.errors import ProtocolError

MINIMAL = """
name = "mine"
policies = ["max", "random"]
[[thresholds]]
position_m = 0.1
rotation_deg = 1.0
"""


def load_text(tmp_path: Path, text: str) -> protocol.Protocol:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    return protocol.load(path)


@pytest.mark.parametrize("name", protocol.known_protocols())
def test_every_shipped_protocol_loads_and_reads_back(name: str) -> None:
    loaded = protocol.load(name)
    assert loaded.name == name
    assert protocol.from_dict(protocol.to_dict(loaded), source="x") == loaded


def test_the_paper_s_thresholds_ship() -> None:
    pairs = [(t.position_m, t.rotation_deg) for t in protocol.load("paper_real").thresholds]
    assert pairs == [(0.25, 2.0), (0.5, 3.5), (1.0, 5.0)]


def test_a_minimal_protocol_takes_the_defaults(tmp_path: Path) -> None:
    assert load_text(tmp_path, MINIMAL).localizer.max_reprojection_px == 12.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("position_m = 0.1", "position_m = -0.1"), r"> 0.*thresholds\[0\].position_m"),
        (
            ("position_m = 0.1", "positon_m = 0.1"),
            r"unknown key 'positon_m' at \$.thresholds.*did you mean 'position_m'",
        ),
        (('"max"', '"maxx"'), r"unknown policy 'maxx'; did you mean 'max'"),
        (('"random"', '"max"'), "listed twice"),
        (('name = "mine"', 'name = "mine"\nfeatur = "sift"'), r"unknown key 'featur' at \$.*did you mean 'feature'"),
        (('name = "mine"', 'name = "mine"\nversion = 2'), "version 2; this fieldkit reads version 1"),
        (('name = "mine"', 'name = "mine'), "not valid TOML"),
        (("rotation_deg = 1.0", 'rotation_deg = "one"'), "Expected `float`, got `str`"),
        (("rotation_deg = 1.0", "rotation_deg = inf"), r"the number at \$.thresholds\[0\].rotation_deg is not finite"),
        (('name = "mine"', 'name = "mine"\nseed = -1'), r">= 0.*seed"),
        (('name = "mine"', 'name = "mine"\nseed = 99999999999'), r"<.*seed"),
        (('"max", "random"', ""), r"length >= 1.*policies"),
        (("rotation_deg = 1.0", "rotation_deg = 1.0\n[occlusion]\nuse = []"), r"length >= 1.*occlusion.use"),
        (("rotation_deg = 1.0", "rotation_deg = 1.0\n[candidates]\nkinds = []"), r"length >= 1.*candidates.kinds"),
        (("rotation_deg = 1.0", "rotation_deg = 1.0\n[candidates]\nmin_distance_m = 9.0"), "expected less than"),
        (
            ("rotation_deg = 1.0", "rotation_deg = 1.0\n[candidates]\nforward_pitch_deg = nan"),
            "not finite|forward_pitch",
        ),
    ],
)
def test_a_mistake_is_named_with_file_and_place(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    with pytest.raises(ProtocolError, match=r"mine\.toml: .*" + message):
        load_text(tmp_path, MINIMAL.replace(*change))


@pytest.mark.parametrize(
    ("bound", "message"),
    [
        ('policy = "max"\nposition_m = 0.2', "not one of the protocol's thresholds"),
        ('policy = "fim"\nposition_m = 0.1', "not one of the protocol's policies"),
        ('policy = "max"\nposition_m = 0.1\nmin_recall = 2.0', "<= 1.0.*min_recall"),
        ('policy = "max"\nposition_m = 0.1\nmin_recall = 0.9\nmax_recall = 0.1', "min_recall exceeds max_recall"),
    ],
)
def test_a_bound_that_cannot_be_checked_is_refused(tmp_path: Path, bound: str, message: str) -> None:
    with pytest.raises(ProtocolError, match=message):
        load_text(tmp_path, f"{MINIMAL}[[expect]]\nrotation_deg = 1.0\n{bound}\n")


def test_a_file_that_is_no_text_is_named(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_bytes(b"\xff\xfe\x00name")
    with pytest.raises(ProtocolError, match=r"mine\.toml: cannot be read as text"):
        protocol.load(tmp_path / "mine.toml")


def test_an_unknown_name_is_refused_with_a_suggestion() -> None:
    with pytest.raises(ProtocolError, match=r"unknown protocol 'paper_reel'.*did you mean 'paper_real'"):
        protocol.load("paper_reel")


def test_a_missing_file_is_named() -> None:
    with pytest.raises(ProtocolError, match=r"nowhere/x\.toml: no such protocol file"):
        protocol.load("nowhere/x.toml")
