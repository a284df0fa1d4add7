"""Meshes of one's own: what is read, what becomes of colours and textures, and every refusal in one line."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from mesh_files import HEIGHT_M, LENGTH_M, WIDTH_M, coloured, hall, painted, saved, shell, table
from PIL import Image

from fieldkit.cameras import Camera
from sim_bridge import cli
from sim_bridge.aim import aim
from sim_bridge.dataset import DatasetOptions, make_scenes
from sim_bridge.errors import SynthesisError
from sim_bridge.importing import MeshOptions, import_scene
from sim_bridge.importing.colours import GREY
from sim_bridge.mesh import Scene
from sim_bridge.rendering import render

CAMERA = Camera("PINHOLE", 160, 120, (120.0, 120.0, 80.0, 60.0))


def looking_north(scene: Scene, *, yaw_deg: float = 90.0) -> np.ndarray:
    return render(scene, CAMERA, aim([3.0, 1.5, 1.4], np.radians(yaw_deg))).rgb


@pytest.fixture
def room(tmp_path: Path) -> Path:
    return saved(tmp_path / "room.glb", [*painted(shell()), table()])


@pytest.mark.parametrize("kind", ["glb", "obj"])
def test_textures_lie_as_they_were_drawn(tmp_path: Path, kind: str) -> None:
    seen = looking_north(import_scene(saved(tmp_path / f"room.{kind}", painted(shell()))))
    # The north wall's corners run from the east: seen from inside, its texture reads from right to left.
    assert seen[20, 120].tolist() == [250, 0, 0]
    assert seen[20, 40].tolist() == [0, 250, 0]
    assert seen[85, 120].tolist() == [0, 0, 250]
    assert seen[85, 40].tolist() == [250, 250, 250]


@pytest.mark.parametrize("kind", ["glb", "obj", "ply"])
def test_vertex_colours_are_seen(tmp_path: Path, kind: str) -> None:
    # glTF's colours are linear: these are 200, 120, 40 encoded.
    stored = (147, 48, 5) if kind == "glb" else (200, 120, 40)
    seen = looking_north(import_scene(saved(tmp_path / f"room.{kind}", coloured(shell(), stored))))
    assert np.abs(seen[20:80, 20:140].astype(int) - (200, 120, 40)).max() <= 3


def test_vertex_colours_beside_a_plain_material_are_seen(tmp_path: Path) -> None:
    parts = shell()
    for part in parts:
        part.visual = trimesh.visual.TextureVisuals(material=trimesh.visual.material.PBRMaterial(name="plain"))
        part.visual.vertex_attributes["color"] = np.tile((147, 48, 5, 255), (4, 1)).astype(np.uint8)
    seen = looking_north(import_scene(saved(tmp_path / "room.glb", parts)))
    assert np.abs(seen[20:80, 20:140].astype(int) - (200, 120, 40)).max() <= 3


def test_colours_change_evenly_between_vertices(tmp_path: Path) -> None:
    parts = coloured(shell(), (250, 0, 0))
    # Red at the north wall's east end, blue at its west end.
    parts[3].visual.vertex_colors[[1, 2]] = (0, 0, 250, 255)
    seen = looking_north(import_scene(saved(tmp_path / "room.ply", parts)))[50].astype(int)
    assert (np.diff(seen[40:120, 0]) >= -1).all()
    assert (np.diff(seen[40:120, 2]) <= 1).all()
    assert seen[100, 0] - seen[60, 0] > 40


def test_textures_repeat_outside_of_their_image(tmp_path: Path) -> None:
    parts = painted(shell())
    for part in parts:
        part.visual.uv = 10.0 * part.visual.uv - 3.0
    scene = import_scene(saved(tmp_path / "room.obj", parts))
    wall = looking_north(scene)[10:90, 10:150]
    blue, red = (wall[..., 2] > 200) & (wall[..., 0] < 50), (wall[..., 0] > 200) & (wall[..., 2] < 50)
    assert 0.15 < blue.mean() < 0.35
    assert 0.15 < red.mean() < 0.35
    stripes = cv2.connectedComponents(red.astype(np.uint8))[0] - 1
    assert stripes > 15


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1000.0), ("cm", 100.0)])
def test_another_unit_is_refused_until_it_is_said(tmp_path: Path, unit: str, factor: float) -> None:
    parts = painted(shell())
    for part in parts:
        part.apply_scale(factor)
    path = saved(tmp_path / "room.glb", parts)
    with pytest.raises(SynthesisError, match=rf"room.glb: .* m, too large .*expected metres.*--unit {unit}") as error:
        import_scene(path)
    assert "\n" not in str(error.value)
    scene = import_scene(path, MeshOptions(unit=unit))  # type: ignore[arg-type]
    assert np.allclose(scene.bounds[1], [LENGTH_M, WIDTH_M, HEIGHT_M])


def test_y_up_is_refused_until_it_is_said(tmp_path: Path) -> None:
    parts = painted(shell())
    for part in parts:
        part.apply_transform([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    path = saved(tmp_path / "room.glb", parts)
    with pytest.raises(SynthesisError, match=r"room.glb: y seems to be up.*expected z up; give --up y"):
        import_scene(path)
    scene = import_scene(path, MeshOptions(up="y"))
    assert np.allclose(scene.bounds[1], [LENGTH_M, WIDTH_M, HEIGHT_M])
    assert scene.free_floor([(3.0, 2.5)], 0.36).all()


def test_points_without_faces_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "scan.ply"
    trimesh.PointCloud(np.random.default_rng(0).uniform(0, 5, (50, 3))).export(path)
    with pytest.raises(SynthesisError, match=r"scan.ply: a mesh without faces \(50 points\); expected triangles"):
        import_scene(path)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("kind", ["ply", "glb", "obj"])
def test_vertices_that_are_no_numbers_are_refused(tmp_path: Path, kind: str, value: float) -> None:
    mesh = trimesh.util.concatenate(coloured(shell(), (9, 9, 9)))
    mesh.vertices[3, 1] = value
    path = tmp_path / f"room.{kind}"
    mesh.export(path)
    with pytest.raises(SynthesisError, match=rf"room.{kind}: .*1 of \d+ vertices are not finite; expected numbers"):
        import_scene(path)


def test_missing_textures_are_grey_and_said_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = saved(tmp_path / "room.obj", painted(shell()))
    for image in tmp_path.glob("*.png"):
        image.unlink()
    with caplog.at_level(logging.WARNING):
        scene = import_scene(path)
    assert len([r for r in caplog.records if "room.obj: no texture for" in r.getMessage()]) == 1
    wall = looking_north(scene)[20:80, 20:140]
    assert np.ptp(wall) == 0
    assert 100 < wall.mean() < 200


@pytest.mark.parametrize("kind", ["obj", "ply"])
def test_what_names_a_file_that_is_not_there_is_grey_and_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, kind: str
) -> None:
    path = tmp_path / f"room.{kind}"
    room = trimesh.util.concatenate(shell())
    if kind == "obj":
        saved(path, painted([room]))
        for material in tmp_path.glob("*.mtl"):
            material.unlink()
    else:
        rows = [f"{x} {y} {z} {u} {v}" for (x, y, z), (u, v) in zip(room.vertices, room.visual.uv, strict=True)]
        properties = "".join(f"property float {name}\n" for name in "xyzst")
        path.write_text(
            f"ply\nformat ascii 1.0\ncomment TextureFile gone.png\nelement vertex {len(rows)}\n{properties}"
            f"element face {len(room.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
            + "\n".join(rows + [f"3 {a} {b} {c}" for a, b, c in room.faces])
        )
    with caplog.at_level(logging.WARNING):
        scene = import_scene(path)
    assert len([r for r in caplog.records if f"room.{kind}: no texture for 1 of 1" in r.getMessage()]) == 1
    assert (looking_north(scene)[20:80, 20:140] == GREY[0]).all()


@pytest.mark.parametrize("kind", ["obj", "ply"])
def test_text_in_an_older_encoding_is_read(tmp_path: Path, kind: str, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / f"room.{kind}"
    if kind == "ply":
        saved(path, coloured(shell(), (200, 120, 40)))
        path.write_bytes(path.read_bytes().replace(b"comment", "comment Büro,".encode("latin-1"), 1))
    else:
        saved(path, painted(shell(), Image.new("RGB", (8, 8), (200, 120, 40))))
        for text in (path, tmp_path / "material.mtl"):
            content = text.read_text().replace("mtl paint", "mtl türkis")
            text.write_bytes(f"# Büro\n{content}".encode("latin-1"))
    with caplog.at_level(logging.WARNING):
        seen = looking_north(import_scene(path))
    assert np.abs(seen[20:80, 20:140].astype(int) - (200, 120, 40)).max() <= 3
    assert not caplog.records


@pytest.mark.parametrize("number", [-7, 7])
def test_a_face_with_a_vertex_that_does_not_exist_is_refused(tmp_path: Path, number: int) -> None:
    path = tmp_path / "room.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        f"0 0 0\n9 0 0\n0 9 0\n3 0 1 {number}\n"
    )
    with pytest.raises(SynthesisError, match=rf"room.ply: a face has vertex {number} of 3; expected 0..2; repair"):
        import_scene(path)


@pytest.mark.parametrize("far", ["1e9", "inf"])
def test_texture_coordinates_that_cannot_be_meant_are_refused(tmp_path: Path, far: str) -> None:
    path = saved(tmp_path / "room.obj", painted(shell()))
    lines = path.read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("vt"))
    lines[first] = f"vt {far} {far}"
    path.write_text("\n".join(lines))
    expected = r"room.obj: \d of 10 faces repeat their texture up to (1e\+09|inf) times; expected 1000 at most; repair"
    with pytest.raises(SynthesisError, match=expected):
        import_scene(path)


def test_extensions_that_are_no_list_do_not_matter(room: Path) -> None:
    data = room.read_bytes()
    length = int.from_bytes(data[12:16], "little")
    header = json.dumps({**json.loads(data[20 : 20 + length]), "extensionsRequired": None}).encode()
    header += b" " * (-len(header) % 4)
    rest = data[20 + length :]
    sizes = [(n).to_bytes(4, "little") for n in (20 + len(header) + len(rest), len(header))]
    room.write_bytes(data[:8] + sizes[0] + sizes[1] + data[16:20] + header + rest)
    assert import_scene(room).free_floor([(1.5, 2.5)], 0.36).all()


@pytest.mark.parametrize("kind", ["glb", "obj", "ply"])
def test_a_file_that_cannot_be_read_is_named(tmp_path: Path, kind: str) -> None:
    # Reading it fails whoever asks, even one who may read everything.
    (tmp_path / f"room.{kind}").symlink_to("/proc/self/mem")
    with pytest.raises(SynthesisError, match=rf"room.{kind}: cannot be read .*; .*") as error:
        import_scene(tmp_path / f"room.{kind}")
    assert "\n" not in str(error.value)


def test_two_meshes_of_one_name_are_both_named(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        saved(tmp_path / folder / "room.ply", [hall(4.0, 3.0, 2.6)])
    scenes = [str(tmp_path / folder / "room.ply") for folder in ("a", "b")]
    (tmp_path / "set").write_text("a file")
    with pytest.raises(SynthesisError, match=r"a/room.ply, .*b/room.ply: both are named 'room'.*rename one"):
        make_scenes(scenes, tmp_path / "set", options=DatasetOptions())


@pytest.mark.parametrize("command", [["synthesize", "--scene"], ["dataset", "--scenes"]])
@pytest.mark.parametrize("flag", [["--unit", "mm"], ["--up", "y"]])
def test_how_to_read_a_mesh_is_refused_without_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: list[str], flag: list[str]
) -> None:
    # Where nothing can be written nothing would be made, either.
    (tmp_path / "out").write_text("a file")
    with pytest.raises(SystemExit, match="1"):
        cli.main([*command, "office", "--out", str(tmp_path / "out"), *flag])
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert f"{' '.join(flag)}: no scene is a mesh (office)" in said[0]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("room.stl", b"solid", r"unknown kind of mesh '.stl'; expected .glb, .obj, .ply"),
        ("room.glb", b"no mesh at all", r"cannot be read as GLB"),
        ("room.ply", b"", r"cannot be read as PLY|without faces"),
        ("gone.obj", None, r"no such file"),
    ],
)
def test_files_that_are_no_meshes_end_in_one_line_and_leave_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, content: bytes | None, message: str
) -> None:
    path, out = tmp_path / name, tmp_path / "session"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SystemExit, match="1"):
        cli.main(["synthesize", "--scene", str(path), "--out", str(out)])
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert name in said[0]
    with pytest.raises(SynthesisError, match=message):
        import_scene(path)
    assert not out.exists()
