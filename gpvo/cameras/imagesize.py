"""The size that an image file declares, read from its header, so that nothing too large is ever decoded; decoding."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

MAX_PIXELS = 1 << 25
"""33 megapixels: more than any stereo camera has."""
MAX_SIDE_PX = 16384

_WITHOUT_LENGTH = (0x01, *range(0xD0, 0xD9))  # of JPEG's markers; of those that may stand before a frame

Size = tuple[int, int]


def image_size(raw: bytes | memoryview) -> Size | None:
    """(width, height) in pixels of encoded bytes (PNG, JPEG, BMP, TIFF, PNM, WebP); None where they are none of these
    or damaged before the size."""
    head = bytes(raw[:16])
    reader = next((read for magic, read in _READERS if re.match(magic, head, re.DOTALL)), None)
    try:
        size = None if reader is None else reader(raw)
    except (struct.error, ValueError, IndexError, KeyError):
        return None
    return size if size is not None and min(size) > 0 else None


def is_plausible(size: Size | None) -> bool:
    """Whether an image of this size may be decoded."""
    return size is not None and max(size) <= MAX_SIDE_PX and size[0] * size[1] <= MAX_PIXELS


def decoded(raw: NDArray[np.uint8], *, grey: bool = False) -> NDArray[Any] | None:
    """Encoded bytes as (H, W) or (H, W, channels), blue first, or ``grey`` in 8 bit; None where they are no image, or
    claim to be larger than any.

    As stored, not turned by an Exif orientation: that is what the calibration and the size in the header are of.
    """
    if not (is_plausible(image_size(raw.data)) and is_whole(raw.data)):
        return None
    import cv2

    kind = cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR
    # Whoever asked reports a damaged image; OpenCV (before 4.13, with functions of its own) need not warn as well.
    log: Any = getattr(cv2.utils, "logging", cv2)
    level = log.getLogLevel()
    log.setLogLevel(0)
    try:
        return cv2.imdecode(raw, kind | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        return None
    finally:
        log.setLogLevel(level)


def is_whole(raw: bytes | memoryview) -> bool:
    """Whether the chunks of a PNG lie within the file: decoders make room for what a chunk claims. True for others."""
    if bytes(raw[:4]) != b"\x89PNG":
        return True
    at = 8
    while at + 12 <= len(raw):
        (length,) = struct.unpack(">I", raw[at : at + 4])
        if bytes(raw[at + 4 : at + 8]) == b"IEND":
            return True
        at += 12 + length
    return False


def _jpeg(raw: bytes | memoryview) -> Size | None:
    at = 2
    while True:
        while raw[at] == 0xFF and raw[at + 1] == 0xFF:  # fill bytes
            at += 1
        marker = raw[at + 1]
        if raw[at] == 0xFF and marker in _WITHOUT_LENGTH:
            at += 2
            continue
        (length,) = struct.unpack(">H", raw[at + 2 : at + 4])
        if raw[at] != 0xFF or marker == 0 or length < 2:
            return None  # decoders look for the next marker, wherever it is
        # Start of frame, of any coding; C4, C8 and CC are something else.
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", raw[at + 5 : at + 9])
            return width, height
        at += 2 + length


def _bmp(raw: bytes | memoryview) -> Size:
    (header,) = struct.unpack("<I", raw[14:18])
    width, height = struct.unpack("<HH", raw[18:22]) if header == 12 else struct.unpack("<ii", raw[18:26])
    return width, abs(height)  # a negative height: top row first


def _tiff(raw: bytes | memoryview) -> Size | None:
    order = "<" if raw[0] == 0x49 else ">"
    (at,) = struct.unpack(order + "I", raw[4:8])
    (count,) = struct.unpack(order + "H", raw[at : at + 2])
    found: dict[int, int] = {}
    for entry in range(at + 2, at + 2 + 12 * count, 12):
        tag, kind = struct.unpack(order + "HH", raw[entry : entry + 4])
        if tag in (256, 257):
            if tag in found or kind not in (3, 4):
                return None  # decoders take the first of two; other kinds stand elsewhere in the file
            code, end = ("H", 10) if kind == 3 else ("I", 12)
            (found[tag],) = struct.unpack(order + code, raw[entry + 8 : entry + end])
    return found[256], found[257]


def _pnm(raw: bytes | memoryview) -> Size:
    text = re.sub(rb"#[^\n]*\n", b" ", bytes(raw[2:4096]))
    width, height = text.split(None, 2)[:2]
    return int(width), int(height)


def _webp(raw: bytes | memoryview) -> Size | None:
    kind = bytes(raw[12:16])
    if kind == b"VP8X":
        return 1 + int.from_bytes(raw[24:27], "little"), 1 + int.from_bytes(raw[27:30], "little")
    if kind == b"VP8L":
        bits = int.from_bytes(raw[21:25], "little")
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    width, height = struct.unpack("<HH", raw[26:30])
    return width & 0x3FFF, height & 0x3FFF


_READERS: tuple[tuple[bytes, Callable[[bytes | memoryview], Size | None]], ...] = (
    (rb"\x89PNG\r\n\x1a\n", lambda raw: struct.unpack(">II", raw[16:24])),
    (rb"\xff\xd8\xff", _jpeg),
    (rb"BM", _bmp),
    (rb"II\*\x00|MM\x00\*", _tiff),
    (rb"P[1-6]\s", _pnm),
    (rb"RIFF....WEBP", _webp),
)
