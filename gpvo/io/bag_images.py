"""Images of ROS messages, and the pairing of two image topics as they stream by."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gpvo.errors import printable
from gpvo.io.bag_reader import stamp_ns
from gpvo.io.images import Image8, decode_stored, to_grey8
from gpvo.io.source import Depth, SourceReport
from gpvo.io.stamps import PAIR_TOLERANCE_S, no_pair, reach_ns, steps_ns

# OpenCV names the pattern by its second row and column.
_BAYER = {
    "bayer_rggb": cv2.COLOR_BayerBG2GRAY,
    "bayer_bggr": cv2.COLOR_BayerRG2GRAY,
    "bayer_gbrg": cv2.COLOR_BayerGR2GRAY,
    "bayer_grbg": cv2.COLOR_BayerGB2GRAY,
}
_CHANNELS = {"mono": (1, True), "rgb": (3, False), "bgr": (3, True), "rgba": (4, False), "bgra": (4, True)}
_CHANNELS |= dict.fromkeys(_BAYER, (1, True))
# Names of sensor_msgs/image_encodings.hpp: (type, channels, blue first)
_ENCODINGS: dict[str, tuple[str, int, bool]] = {}
for _bits in (8, 16):
    _ENCODINGS |= {f"{name}{_bits}": (f"u{_bits // 8}", *kind) for name, kind in _CHANNELS.items()}
    _ENCODINGS |= {f"{_bits}uc{n}": (f"u{_bits // 8}", n, True) for n in (1, 3, 4)}
# Of YUV the brightness alone: (bytes from one to the next, first of them); where it is a plane, it comes first.
_LUMA = {
    **dict.fromkeys(("uyvy", "yuv422"), (2, 1)),
    **dict.fromkeys(("yuyv", "yuv422_yuy2"), (2, 0)),
    **dict.fromkeys(("nv12", "nv21", "nv24"), (1, 0)),
}
# Pairs arrive within a few messages of one another; beyond that a message has lost its partner.
_WAITING = 12
_ENOUGH = 8  # intervals, of both cameras, that tell the usual one


def decode_message(message: Any, depth: Depth | None = None) -> Image8 | None:
    """A sensor_msgs Image or CompressedImage as (H, W) uint8; None where it is damaged or of unknown encoding."""
    if hasattr(message, "encoding"):
        name, (pixels, bgr) = str(message.encoding).lower(), _raw_pixels(message)
    else:
        # Of image_transport, "bayer_rggb8; png compressed": it compresses the mosaic of a colour filter as it is.
        name, bgr = str(message.format).partition(";")[0].strip().lower(), True
        pixels = decode_stored(np.asarray(message.data, dtype=np.uint8))
    if pixels is None:
        return None
    pattern = _BAYER.get(name.rstrip("0123456789"))
    if pattern is not None and pixels[0, 0].size == 1:
        pixels = np.asarray(cv2.cvtColor(pixels, pattern))
    return to_grey8(pixels, bgr=bgr, depth=depth)


def encoding_of(message: Any) -> str:
    """What an Image or CompressedImage says that its pixels are."""
    return printable(getattr(message, "encoding", getattr(message, "format", "?")))


def _raw_pixels(message: Any) -> tuple[NDArray[Any] | None, bool]:
    """Pixels (H, W, channels) of an Image, None as above, and whether blue comes first."""
    raw, name = np.asarray(message.data, dtype=np.uint8), str(message.encoding).lower()
    stride, first = _LUMA.get(name, (1, 0))
    kind, channels, bgr = ("u1", 1, True) if name in _LUMA else _ENCODINGS.get(name, ("", 0, True))
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * channels * int(kind[1:] or 0) * stride
    if not 0 < height <= 16384 or not 0 < width <= 16384 or not 0 < row <= step or len(raw) < height * step:
        return None, bgr
    packed = np.ascontiguousarray(raw[: height * step].reshape(height, step)[:, first:row:stride])
    pixels: NDArray[Any] = packed.view((">" if message.is_bigendian else "<") + kind)
    return pixels.astype(kind, copy=False).reshape(height, width, channels), bgr


class PairQueue:
    """Pairs the messages of two image topics as they come in, by stamps at most :func:`reach_ns` apart. Where the
    tolerance might join neighbours, the first ones wait until the interval is known.

    A message that finds no partner among the next dozen is counted as missing; so are those it was overtaken by.
    ``nearest_ns``: the closest that two stamps of both sides ever were.
    """

    def __init__(self, left: str, tolerance_ns: int, report: SourceReport) -> None:
        self._left, self._tolerance_ns, self._report = left, tolerance_ns, report
        self._waiting: dict[bool, deque[tuple[int, Any]]] = {True: deque(), False: deque()}
        self._stamps: dict[bool, deque[int]] = {side: deque(maxlen=_WAITING) for side in (True, False)}
        self._is_sure = tolerance_ns <= PAIR_TOLERANCE_S * 1e9
        self.nearest_ns: float = np.inf

    def push(self, topic: str, message: Any) -> list[tuple[int, Any, Any]]:
        """(left stamp, left message, right message) of the pairs that this message completes."""
        is_left, t = topic == self._left, stamp_ns(message)
        own, others = self._waiting[is_left], self._waiting[not is_left]
        self.nearest_ns = min([self.nearest_ns, *(abs(s - t) for s, _ in others)])
        self._stamps[is_left].append(t)
        own.append((t, message))
        self._is_sure = self._is_sure or len(steps_ns(*self._stamps.values())) >= _ENOUGH
        pairs = self._matched() if self._is_sure else []
        if len(own) > _WAITING:
            _drop(own, 1, self._report)
        return pairs

    def _matched(self) -> list[tuple[int, Any, Any]]:
        reach, out = reach_ns(self._tolerance_ns, *self._stamps.values()), []
        left, right = self._waiting[True], self._waiting[False]
        while found := next(((i, j) for i, (s, _) in enumerate(left) for j, (t, _) in enumerate(right)
                             if abs(s - t) <= reach), None):  # fmt: skip
            for queue, before in zip((left, right), found):
                _drop(queue, before, self._report)
            out.append((*left.popleft(), right.popleft()[1]))
        return out

    def end(self) -> list[tuple[int, Any, Any]]:
        """The pairs among what waits; what stays alone is counted as missing, and forgotten."""
        pairs = self._matched()
        for queue in self._waiting.values():
            _drop(queue, len(queue), self._report)
        return pairs


def pair_streams(
    stream: Iterable[tuple[str, Any]], left: str, tolerance_ns: int, report: SourceReport, where: object
) -> Iterator[tuple[int, Any, Any]]:
    """(left stamp, left message, right message) of a whole recording: :class:`PairQueue`. Images without a stamp are
    counted as missing.

    Raises SourceError at the end, where no message found a partner.
    """
    queue = PairQueue(left, tolerance_ns, report)
    for topic, message in stream:
        if stamp_ns(message) == 0:
            report.count("missing", f"an image on '{topic}' carries no stamp")
        else:
            yield from queue.push(topic, message)
    yield from queue.end()
    if tolerance_ns < queue.nearest_ns < np.inf:
        raise no_pair(tolerance_ns, int(queue.nearest_ns), where)


def _drop(queue: deque[tuple[int, Any]], count: int, report: SourceReport) -> None:
    for _ in range(count):
        report.count("missing", f"no partner for the image at {queue.popleft()[0]} ns")
