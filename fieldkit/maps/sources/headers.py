"""Sizes of images by the first bytes of their files: what cannot be mapped is told before hours of work."""

from __future__ import annotations

import dataclasses
import re
import struct
from pathlib import Path

_START_OF_FRAME = frozenset({*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC})
# Trailers behind the end of a JPEG, such as previews, end like one themselves
_TAIL_BYTES = 1 << 16


@dataclasses.dataclass(frozen=True)
class ImageHeader:
    """Width and height in pixels as stored, and bits per sample where the format says so."""

    width: int
    height: int
    bits: int


def read_header(path: Path) -> ImageHeader | str:
    """Read the size of a JPEG, PNG, PGM or BMP file; return what is wrong with it in a few words where it has none."""
    try:
        with path.open("rb") as stream:
            head = stream.read(1 << 16)
            size = stream.seek(0, 2)
            stream.seek(max(size - _TAIL_BYTES, 0))
            tail = stream.read()
    except OSError as error:
        return f"cannot be read: {error.strerror}"
    if not size:
        return "is empty"
    found, whole = None, True
    try:
        if head.startswith(b"\x89PNG\r\n\x1a\n"):
            found, whole = ImageHeader(*struct.unpack(">IIB", head[16:25])), b"IEND" in tail
        elif head.startswith(b"\xff\xd8"):
            found, whole = _jpeg(path), b"\xff\xd9" in tail
        elif head.startswith(b"BM"):
            width, height = struct.unpack("<ii", head[18:26])
            found, whole = ImageHeader(width, abs(height), 8), size >= struct.unpack("<I", head[2:6])[0]
        elif head[:2] in (b"P2", b"P3", b"P5", b"P6"):
            found = _pnm(head)
            n_bytes = 0 if found is None else found.width * found.height * found.bits // 8
            whole = head[:2] in (b"P2", b"P3") or size >= n_bytes * (3 if head[:2] == b"P6" else 1)
    except struct.error:
        found = None
    if found is None or not (found.width > 0 and found.height > 0):
        return "cannot be read as an image"
    return found if whole else "is cut off"


def _jpeg(path: Path) -> ImageHeader | None:
    """Walk the segments to the start of the frame; a thumbnail in a segment is skipped with it."""
    with path.open("rb") as stream:
        stream.read(2)
        while (marker := stream.read(2)) and len(marker) == 2 and marker[0] == 0xFF:
            if marker[1] == 0xFF:
                stream.seek(-1, 1)
            elif marker[1] in _START_OF_FRAME:
                _, bits, height, width = struct.unpack(">HBHH", stream.read(7))
                return ImageHeader(width, height, bits)
            elif marker[1] != 0x01 and not 0xD0 <= marker[1] <= 0xD8:
                (length,) = struct.unpack(">H", stream.read(2))
                stream.seek(length - 2, 1)
    return None


def _pnm(head: bytes) -> ImageHeader | None:
    words = re.sub(rb"#[^\n]*", b" ", head[2:1024]).split(maxsplit=3)[:3]
    if len(words) < 3 or not all(w.isdigit() for w in words):
        return None
    width, height, most = map(int, words)
    return ImageHeader(width, height, 8 if most < 256 else 16)
