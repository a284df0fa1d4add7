"""Sheets: what is on the paper is the tag that was asked for, at its true size, the right way up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pypdfium2
import pytest

from fieldkit.cameras import Camera
from fieldkit.cli import main
from fieldkit.errors import TagError
from fieldkit.frames import Array
from fieldkit.tags import TagDetection, detect
from fieldkit.tags.sheets import PAPERS, largest_mm, write_sheets
from fieldkit.types import Image

DPI = 200
MM_PER_PX = 25.4 / DPI


def render(path: Path, page: int = 0) -> Image:
    picture = pypdfium2.PdfDocument(path)[page].render(scale=DPI / 72, grayscale=True).to_numpy()
    return np.ascontiguousarray(picture.reshape(picture.shape[:2]))


def find(image: Image, family: str) -> TagDetection:
    height, width = image.shape
    (found,) = detect(
        image, Camera("PINHOLE", width, height, (width, width, width / 2, height / 2)), families=(family,)
    )
    return found


def edges_mm(found: TagDetection) -> Array:
    return np.linalg.norm(found.corners_px - np.roll(found.corners_px, -1, axis=0), axis=1) * MM_PER_PX


def ruler_mm(image: Image) -> float:
    """Measure from the middle of the ruler's first long mark to the middle of its last."""
    dark = image[-int(30 / MM_PER_PX) :] < 128
    base = max(range(len(dark)), key=lambda row: dark[row, : image.shape[1] // 2].sum())
    above = 255.0 - image[len(image) - len(dark) + base - int(4.4 / MM_PER_PX)].astype(float)
    start = dark[base].argmax()
    above[start + dark[base, start:].argmin() + 3 :] = 0.0
    marks = np.flatnonzero(above > 30)
    first, last = (m[np.abs(m - e) < 6] for m, e in ((marks, marks[0]), (marks, marks[-1])))
    middles = [float(np.average(m, weights=above[m])) for m in (first, last)]
    return (middles[1] - middles[0]) * MM_PER_PX


@pytest.mark.parametrize(
    ("family", "tag_id", "size_m", "paper", "length_mm"),
    [
        ("tag36h11", 7, 0.1365, "a4", 100.0),
        ("tag36h11", 586, 0.2, "a3", 100.0),
        ("tag25h9", 0, 0.03, "letter", 101.6),
        ("tag16h5", 29, 0.1, "tabloid", 101.6),
        ("tag36h10", 5, 0.146, "letter", 101.6),
    ],
)
def test_a_print_has_the_tag_upright_at_its_size_and_a_true_ruler(
    tmp_path: Path, family: str, tag_id: int, size_m: float, paper: str, length_mm: float
) -> None:
    write_sheets(tmp_path / "tag.pdf", [tag_id], size_m=size_m, family=family, paper=paper)
    image = render(tmp_path / "tag.pdf")
    assert tuple(np.array(image.shape[::-1]) * MM_PER_PX) == pytest.approx(PAPERS[paper], abs=0.2)
    found = find(image, family)
    assert found.id == tag_id
    assert edges_mm(found) == pytest.approx([1e3 * size_m] * 4, abs=0.2)
    bottom_left, bottom_right, top_right, _ = found.corners_px
    assert (bottom_right - bottom_left) * MM_PER_PX == pytest.approx([1e3 * size_m, 0.0], abs=0.2)
    assert (top_right - bottom_right) * MM_PER_PX == pytest.approx([0.0, -1e3 * size_m], abs=0.2)
    assert ruler_mm(image) == pytest.approx(length_mm, abs=0.2)


def test_every_page_says_what_it_is(tmp_path: Path) -> None:
    write_sheets(tmp_path / "tags.pdf", [3, 1], size_m=0.1365, family="tag36h11", paper="a4")
    document = pypdfium2.PdfDocument(tmp_path / "tags.pdf")
    assert len(document) == 2
    for page, tag_id in zip(document, (3, 1), strict=True):
        text = page.get_textpage().get_text_range()
        for said in (
            f"tag36h11 \u00b7 id {tag_id}",
            "136.5 mm",
            "size_m = 0.1365: the outer edge of the black",
            "100 mm",
        ):
            assert said in text
        assert "x to the right, y up, z out of the paper" in text


@pytest.mark.parametrize("paper", PAPERS)
def test_the_largest_tag_of_a_paper_keeps_its_white_margin(tmp_path: Path, paper: str) -> None:
    size_m = (largest_mm("tag36h11", paper) - 1e-6) / 1e3
    write_sheets(tmp_path / "tag.pdf", [0], size_m=size_m, family="tag36h11", paper=paper)
    image = render(tmp_path / "tag.pdf")
    found = find(image, "tag36h11")
    low, high = found.corners_px.min(axis=0), found.corners_px.max(axis=0)
    cell = (high - low) / 8
    x0, y0, x1, y1 = np.round([*(low - cell + 1), *(high + cell - 1)]).astype(int)
    around = image[y0:y1, x0:x1].copy()
    inner_x, inner_y = np.ceil(cell).astype(int) - 3
    around[inner_y:-inner_y, inner_x:-inner_x] = 255
    assert around.min() == 255


def test_the_same_call_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.pdf", "b.pdf"):
        write_sheets(tmp_path / name, [1], size_m=0.1, family="tag36h11", paper="a4")
    assert (tmp_path / "a.pdf").read_bytes() == (tmp_path / "b.pdf").read_bytes()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"size_m": 0.2}, r"tag of 200 mm does not fit a4; expected at most 158\.4 mm; take --paper a3"),
        ({"size_m": 0.2, "paper": "letter"}, r"does not fit letter; expected at most .* mm; take --paper tabloid"),
        ({"size_m": 0.3}, "take --paper a2"),
        ({"size_m": 136.5}, "tag of 136500 mm does not fit a4; .*give --size-m in metres"),
        ({"size_m": 0.001}, "cannot be printed; expected at least 0.004 m"),
        ({"size_m": float("nan")}, "cannot be printed"),
        ({"paper": "a5"}, "unknown paper 'a5'; did you mean 'a"),
        ({"family": "tagStandard41h12"}, "cannot draw tag family 'tagStandard41h12'"),
        ({"ids": [1, 587]}, r"has no tag 587; expected an id in 0\.\.586"),
        ({"ids": [1, 2, 1]}, "tag 1 is given twice"),
        ({"ids": []}, "no tag id"),
    ],
)
def test_a_sheet_that_cannot_be_is_refused_and_nothing_is_written(
    tmp_path: Path, changes: dict[str, object], message: str
) -> None:
    options = {"ids": [1], "size_m": 0.1365, "family": "tag36h11", "paper": "a4", **changes}
    with pytest.raises(TagError, match=message):
        write_sheets(tmp_path / "tag.pdf", options.pop("ids"), **options)
    assert list(tmp_path.iterdir()) == []


def test_the_command_writes_a_page_per_id_and_keeps_what_exists(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["tags", "sheet", "--ids", "1", "2", "--size-m", "0.05", "--out", str(tmp_path / "tags.pdf")]
    with pytest.raises(SystemExit, match=r"^0$"):
        main(words)
    before = (tmp_path / "tags.pdf").read_bytes()
    with pytest.raises(SystemExit, match=r"^1$"):
        main(words)
    assert "tags.pdf: exists already; give --force" in capsys.readouterr().err
    assert (tmp_path / "tags.pdf").read_bytes() == before
    assert len(pypdfium2.PdfDocument(tmp_path / "tags.pdf")) == 2
