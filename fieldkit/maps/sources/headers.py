"""Sizes of images by the first bytes of their files, and whether these are whole: told before hours of work."""

from __future__ import annotations

import dataclasses
import re
import struct
import zlib
from pathlib import Path

import cv2

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
    if not whole:
        return "is cut off"
    return found if _intact(path, head) else "is damaged, its content cannot be decoded"


def _intact(path: Path, head: bytes) -> bool:
    """Tell whether a PNG's checksums are right, or a JPEG, which has none, can be decoded at an eighth.

    Garbled pixels are pixels, and of other formats nothing is told.
    """
    if head.startswith(b"\x89PNG"):
        return _png_sums(path)
    return not head.startswith(b"\xff\xd8") or cv2.imread(str(path), cv2.IMREAD_REDUCED_GRAYSCALE_8) is not None


def _png_sums(path: Path) -> bool:
    """Tell whether all critical chunks have their checksum (PNG, third edition, 5.3 and 5.4)."""
    with path.open("rb") as stream:
        stream.seek(8)
        while len(head := stream.read(8)) == 8:
            length, kind = struct.unpack(">I4s", head)
            found = zlib.crc32(stream.read(length), zlib.crc32(kind))
            optional = kind[0] & 0x20
            if stream.read(4) != struct.pack(">I", found) and not optional:
                return False
            if kind == b"IEND":
                return True
    return False


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
