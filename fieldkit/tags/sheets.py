"""Sheets to print tags: PDF at true scale, with a ruler that tells whether the printer kept it."""

from __future__ import annotations

import dataclasses
import io
import itertools
import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from reportlab.lib.units import inch, mm
from reportlab.pdfgen.canvas import Canvas

from fieldkit.errors import TagError, suggestion
from fieldkit.store.files import atomic_write
from fieldkit.tags.drawing import DRAWN_FAMILIES, draw_tag

# Paper -> width and height in mm, upright; from small to large within each standard
PAPERS: dict[str, tuple[float, float]] = {
    "a4": (210.0, 297.0),
    "a3": (297.0, 420.0),
    "a2": (420.0, 594.0),
    "letter": (215.9, 279.4),
    "tabloid": (279.4, 431.8),
}
_INCH_PAPERS = ("letter", "tabloid")
# What printers leave blank, and the room for text above and below the tag, in mm
MARGIN_MM = 6.0
HEADER_MM = 22.0
FOOTER_MM = 61.0
# White around the black square, in cells; the detector needs one
QUIET_CELLS = 1.0
# Below this a cell is a few dots of a printer
SMALLEST_CELL_MM = 0.5

_INK, _GREY, _PALE = (0.10, 0.11, 0.13), (0.42, 0.44, 0.47), (0.80, 0.81, 0.83)
_X, _Y, _Z = (0.80, 0.16, 0.16), (0.13, 0.53, 0.20), (0.15, 0.36, 0.75)


@dataclasses.dataclass(frozen=True)
class _Page:
    """Where things are on a sheet, in mm from the lower left corner: the black square's lower left and its edge."""

    width: float
    height: float
    left: float
    bottom: float
    edge: float
    cell: float
    inches: bool


def write_sheets(path: Path, ids: Sequence[int], *, size_m: float, family: str, paper: str) -> None:
    """Write a PDF with one tag per page, at true scale; ``size_m`` is the edge length of the black square.

    Raises TagError for a family without a closed black square, an unknown paper, an id that the family does not have or
    that is given twice, a size that is no length, and a tag that does not fit the paper with its quiet margin, ruler
    and text.
    """
    if paper not in PAPERS:
        raise TagError(f"unknown paper {paper!r}", hint=suggestion(paper, list(PAPERS)))
    if not ids:
        raise TagError("no tag id was given; expected one or more", hint="give --ids")
    twice = [str(i) for i, n in Counter(ids).items() if n > 1]
    if twice:
        raise TagError(f"tag {', '.join(twice)} is given twice; expected every id once", hint="correct --ids")
    if family not in DRAWN_FAMILIES:
        raise TagError(f"cannot draw tag family {family!r} on a sheet", hint=suggestion(family, list(DRAWN_FAMILIES)))
    drawn = [draw_tag(family, tag_id, cell_px=1, border_cells=0) == 0 for tag_id in ids]
    page = _layout(size_m, family=family, paper=paper)
    buffer = io.BytesIO()
    # invariant: the same call gives the same bytes
    canvas = Canvas(buffer, pagesize=(page.width * mm, page.height * mm), invariant=1, pageCompression=1)
    canvas.setTitle(f"{family} {', '.join(map(str, ids))}, {_length(1e3 * size_m)} mm")
    canvas.setCreator("fieldkit tags sheet")
    canvas.setViewerPreference("PrintScaling", "None")
    for tag_id, black in zip(ids, drawn, strict=True):
        _header(canvas, page, family, tag_id)
        _tag(canvas, page, black.tolist())
        _centre_marks(canvas, page)
        _dimension(canvas, page)
        _footer(canvas, page, family, tag_id)
        canvas.showPage()
    canvas.save()
    atomic_write(path, buffer.getvalue())


def _layout(size_m: float, *, family: str, paper: str) -> _Page:
    cells = DRAWN_FAMILIES[family]
    edge = 1e3 * size_m
    if not math.isfinite(edge) or edge < SMALLEST_CELL_MM * cells:
        raise TagError(
            f"a tag of {size_m} m cannot be printed; expected at least {SMALLEST_CELL_MM * cells / 1e3} m",
            hint="give --size-m in metres",
        )
    largest = largest_mm(family, paper)
    if edge > largest:
        fitting = [name for name in PAPERS if largest_mm(family, name) >= edge]
        same = [name for name in fitting if (name in _INCH_PAPERS) == (paper in _INCH_PAPERS)]
        hint = f"take --paper {(same or fitting)[0]}" if fitting else "give --size-m in metres, for a tag that fits a2"
        raise TagError(
            f"a {family} tag of {_length(edge)} mm does not fit {paper}; expected at most {largest:.1f} mm",
            hint=hint,
        )
    width, height = PAPERS[paper]
    bottom = FOOTER_MM + (height - HEADER_MM - FOOTER_MM - edge) / 2
    return _Page(width, height, (width - edge) / 2, bottom, edge, edge / cells, paper in _INCH_PAPERS)


def largest_mm(family: str, paper: str) -> float:
    """Return the edge length in mm of the largest tag of a family that fits a paper."""
    width, height = PAPERS[paper]
    room = min(width - 2 * MARGIN_MM, height - HEADER_MM - FOOTER_MM)
    return room / (1 + 2 * QUIET_CELLS / DRAWN_FAMILIES[family])


def _length(value_mm: float) -> str:
    return f"{value_mm:.2f}".rstrip("0").rstrip(".")


def _tag(canvas: Canvas, page: _Page, black: list[list[bool]]) -> None:
    """Fill the black cells as one path: a viewer that smooths edges then shows no seams between them."""
    canvas.setFillGray(0.0)
    path = canvas.beginPath()
    for row, cells in enumerate(black):
        column = 0
        for is_black, run in itertools.groupby(cells):
            length = len(list(run))
            if is_black:
                x, y = page.left + column * page.cell, page.bottom + page.edge - (row + 1) * page.cell
                path.rect(x * mm, y * mm, length * page.cell * mm, page.cell * mm)
            column += length
    canvas.drawPath(path, stroke=0, fill=1, fillMode=1)


def _text(
    canvas: Canvas, x: float, y: float, text: str, *, size: float = 8, bold: bool = False, align: str = "left",
    colour: tuple[float, float, float] = _INK,
) -> None:  # fmt: skip
    canvas.setFillColorRGB(*colour)
    canvas.setFont("Helvetica-Bold" if bold else "Helvetica", size)
    draw = {"left": canvas.drawString, "centre": canvas.drawCentredString, "right": canvas.drawRightString}[align]
    draw(x * mm, y * mm, text)


def _line(
    canvas: Canvas, x0: float, y0: float, x1: float, y1: float, *, width: float = 0.5,
    colour: tuple[float, float, float] = _GREY,
) -> None:  # fmt: skip
    canvas.setStrokeColorRGB(*colour)
    canvas.setLineWidth(width)
    canvas.line(x0 * mm, y0 * mm, x1 * mm, y1 * mm)


def _arrow(
    canvas: Canvas, x0: float, y0: float, x1: float, y1: float, *, head: float = 2.2, width: float = 0.5,
    colour: tuple[float, float, float] = _GREY,
) -> None:  # fmt: skip
    """Draw an arrow along x or y, its tip at the end point."""
    length = math.hypot(x1 - x0, y1 - y0)
    ux, uy = (x1 - x0) / length, (y1 - y0) / length
    bx, by = x1 - head * ux, y1 - head * uy
    _line(canvas, x0, y0, bx, by, width=width, colour=colour)
    canvas.setFillColorRGB(*colour)
    path = canvas.beginPath()
    path.moveTo(x1 * mm, y1 * mm)
    path.lineTo((bx - 0.38 * head * uy) * mm, (by + 0.38 * head * ux) * mm)
    path.lineTo((bx + 0.38 * head * uy) * mm, (by - 0.38 * head * ux) * mm)
    path.close()
    canvas.drawPath(path, stroke=0, fill=1)


def _header(canvas: Canvas, page: _Page, family: str, tag_id: int) -> None:
    left, right, top = MARGIN_MM + 6, page.width - MARGIN_MM - 6, page.height - MARGIN_MM
    _text(canvas, left, top - 9, f"{family} \u00b7 id {tag_id}", size=19, bold=True)
    _text(canvas, right, top - 9, f"{_length(page.edge)} mm", size=19, bold=True, align="right")
    # Which way is up, for whoever hangs it
    middle = page.width / 2
    _arrow(canvas, middle - 8, top - 10, middle - 8, top - 4, head=2.6, width=0.9)
    _text(canvas, middle - 5, top - 8.5, "this side up", size=8, colour=_GREY)


def _centre_marks(canvas: Canvas, page: _Page) -> None:
    """Draw four short marks that point at the tag's centre, for a tape measure, where the printer reaches."""
    x, y = page.left + page.edge / 2, page.bottom + page.edge / 2
    reach = page.edge / 2 + QUIET_CELLS * page.cell
    for dx, dy in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        end_x, end_y = x + dx * (reach + 2.2), y + dy * (reach + 2.2)
        if MARGIN_MM <= end_x <= page.width - MARGIN_MM:
            _line(canvas, x + dx * (reach + 0.2), y + dy * (reach + 0.2), end_x, end_y, width=0.5)


def _dimension(canvas: Canvas, page: _Page) -> None:
    """Draw the measured edge below the tag, outside its quiet margin."""
    quiet = page.bottom - QUIET_CELLS * page.cell
    y, x0, x1 = quiet - 5.5, page.left, page.left + page.edge
    for x in (x0, x1):
        _line(canvas, x, quiet - 2.5, x, y - 1.5, width=0.35)
    middle = (x0 + x1) / 2
    label = f"{_length(page.edge)} mm"
    half = canvas.stringWidth(label, "Helvetica-Bold", 9) / mm / 2 + 2
    if page.edge > 2 * half + 14:
        _arrow(canvas, middle - half, y, x0, y, width=0.35)
        _arrow(canvas, middle + half, y, x1, y, width=0.35)
        _text(canvas, middle, y - 1.1, label, size=9, bold=True, align="centre")
    else:
        _arrow(canvas, x0 - 8, y, x0, y, width=0.35)
        _arrow(canvas, x1 + 8, y, x1, y, width=0.35)
        _text(canvas, middle, y - 5, label, size=9, bold=True, align="centre")


def _footer(canvas: Canvas, page: _Page, family: str, tag_id: int) -> None:
    left, right = MARGIN_MM + 6, page.width - MARGIN_MM - 6
    top = MARGIN_MM + 41
    _line(canvas, left, top, right, top, width=0.4, colour=_PALE)
    _axes(canvas, left + 1, top - 22)
    x, y = left + 38, top - 6
    _text(canvas, x, y, f"AprilTag {family}, id {tag_id}", size=9, bold=True)
    lines = (
        f"size_m = {page.edge / 1e3:.6g}: the outer edge of the black square, between the arrows above.",
        "Tag frame: origin at the centre, where the marks point; x to the right, y up, z out of the paper.",
        "Print at 100 % (actual size, no fit to page), on stiff matt paper. Keep the white margin.",
        "Where the ruler is off, measure the black square and state what you measured.",
    )
    for i, line in enumerate(lines):
        _text(canvas, x, y - 5 - 4.1 * i, line, size=7.6, colour=_INK if i < 2 else _GREY)
    _ruler(canvas, page, left + 1, MARGIN_MM + 5)


def _axes(canvas: Canvas, x: float, y: float) -> None:
    """Draw the axes of the tag frame on a small black square."""
    edge, reach = 14.0, 13.0
    canvas.setFillColorRGB(*_PALE)
    canvas.rect(x * mm, y * mm, edge * mm, edge * mm, stroke=0, fill=1)
    cx, cy = x + edge / 2, y + edge / 2
    _arrow(canvas, cx, cy, cx + reach, cy, head=2.6, width=1.3, colour=_X)
    _arrow(canvas, cx, cy, cx, cy + reach - 0.5, head=2.6, width=1.3, colour=_Y)
    canvas.setStrokeColorRGB(*_Z)
    canvas.setFillColorRGB(1, 1, 1)
    canvas.setLineWidth(1.2)
    canvas.circle(cx * mm, cy * mm, 1.5 * mm, stroke=1, fill=1)
    canvas.setFillColorRGB(*_Z)
    canvas.circle(cx * mm, cy * mm, 0.55 * mm, stroke=0, fill=1)
    _text(canvas, cx + reach + 1, cy - 1, "x", size=9, bold=True, colour=_X)
    _text(canvas, cx + 1.6, cy + reach - 2.4, "y", size=9, bold=True, colour=_Y)
    _text(canvas, cx - 4.6, cy - 4.2, "z", size=9, bold=True, colour=_Z)


def _ruler(canvas: Canvas, page: _Page, x: float, y: float) -> None:
    """Draw a ruler of 100 mm, or of 4 in where paper is sold by the inch; its ends are the outermost marks' middles."""
    step, count, major, middle = (inch / 16, 64, 16, 8) if page.inches else (mm, 100, 10, 5)
    length = count * step
    canvas.setStrokeColorRGB(*_INK)
    canvas.setLineCap(0)
    canvas.setLineWidth(0.6)
    canvas.line(x * mm, y * mm, x * mm + length, y * mm)
    for i in range(count + 1):
        height = 5.0 if i % major == 0 else 3.6 if i % middle == 0 else 2.2
        canvas.setLineWidth(0.35 if i % major else 0.6)
        canvas.line(x * mm + i * step, y * mm, x * mm + i * step, (y + height) * mm)
        if i % major == 0:
            number = i // major if page.inches else i
            _text(canvas, x + i * step / mm, y + 6.2, str(number), size=7, align="centre")
    end = x + length / mm
    whole = "4 in (101.6 mm)" if page.inches else "100 mm"
    _text(canvas, end + 5, y + 3.0, f"This ruler is {whole} long", size=7.6, bold=True)
    _text(canvas, end + 5, y - 0.6, "where the print is true to scale.", size=7.6, colour=_GREY)
