"""What a sequence looks like to the odometry, and how a path becomes one.

A source is an iterable of frames that are already rectified, with what the data set knows beside them. Packages
outside gpvo add sources through the entry point group ``gpvo.sources``: a class with the same constructor and the
class method ``recognises(path) -> bool``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import SourceError, counted, plugins, printable
from gpvo.types import ImuLog, Mounting, StereoCamera, StereoFrame, TrackFrame, TruthLog

_EXTREME = 0.002  # share of a picture's samples at either end that tell nothing of its range


@dataclass
class SourceReport:
    """What was found wrong while reading; filled as the frames are drawn.

    ``frames``: pairs handed out. ``missing``: stamps that only one camera has, or whose file is not there.
    ``unreadable``: files that are no image or of another size. ``duplicate``: stamps seen before. ``out_of_order``:
    stamps before an earlier one. ``gaps``: intervals of more than 1.75 times the usual one. ``notes``: in words.
    """

    frames: int = 0
    missing: int = 0
    unreadable: int = 0
    duplicate: int = 0
    out_of_order: int = 0
    gaps: int = 0
    notes: list[str] = field(default_factory=list)

    def note(self, text: str) -> None:
        """Add a remark once, and no more than fifty of them."""
        text = printable(text)
        if text not in self.notes and len(self.notes) < 50:
            self.notes.append(text)

    def count(self, what: str, text: str, n: int = 1) -> None:
        """Count ``n`` more of ``what``, the name of a count, with a remark."""
        setattr(self, what, getattr(self, what) + n)
        self.note(text)

    def __str__(self) -> str:
        names = ("missing", "unreadable", "duplicate", "out_of_order", "gaps")
        bad = [f"{getattr(self, n)} {n.replace('_', '-')}" for n in names if getattr(self, n)]
        return counted(self.frames, "frame") + (f" ({', '.join(bad)})" if bad else "")


class Depth:
    """Depth of 16-bit images: ``bits``, the lower ones of the 16 that samples fill, and ``most``, the largest sample so
    far. ``refused``: what is wrong with images whose samples are of another kind, empty where there were none.

    ``span``: the samples that become 0 and 255, where a picture stands on an offset that is larger than its own range,
    as those of thermal cameras do, of which 256 steps of all bits would leave almost nothing; else None. It is twice as
    wide as the first such picture, and widens for later ones, so that grey values of a scene rarely change.

    Raises SourceError where ``bits`` is not from 8 to 16.
    """

    def __init__(self, bits: int = 16) -> None:
        if not 8 <= bits <= 16:
            raise SourceError(f"images of {bits} bits are not possible", cure="give 8 to 16")
        self.bits, self.most, self.refused = bits, 0, ""
        self.span: tuple[float, float] | None = None

    def to8(self, samples: NDArray[np.uint16]) -> NDArray[np.uint8]:
        """Samples (H, W) in 8 bit."""
        self.most = max(self.most, int(samples.max(initial=0)))
        self._widen(samples)
        if self.span is not None:
            low, high = self.span
            grey = (samples.astype(np.float32) - low) * (255 / (high - low))
            return np.asarray(np.clip(np.rint(grey), 0, 255), dtype=np.uint8)
        # Rounded, not cut: cutting would darken by half a step.
        shift = self.bits - 8
        half = (1 << shift) >> 1
        return np.asarray(np.minimum((samples.astype(np.uint32) + half) >> shift, 255), dtype=np.uint8)

    def _widen(self, samples: NDArray[np.uint16]) -> None:
        """Let the span hold the picture, but for its most extreme samples and blank ones, of a border."""
        shown = samples[:: 1 + samples.shape[0] // 128, :: 1 + samples.shape[1] // 128]
        shown = np.sort(shown[shown > 0])
        if len(shown) == 0:
            return
        low, high = (float(shown[int(share * (len(shown) - 1))]) for share in (_EXTREME, 1 - _EXTREME))
        if self.span is None and not 0 < high - low < min(low, (1 << self.bits) / 8):
            return
        if self.span is not None and high - low > 2 * (self.span[1] - self.span[0]):
            return  # the sun, or a picture that was read badly: it would leave nothing of all others
        if self.span is None or low < self.span[0] or high > self.span[1]:
            margin = max(high - low, 256 - (high - low)) / 2  # of half its range, and no finer than a sample's step
            least, most = self.span or (low, high)
            self.span = min(least, low - margin), max(most, high + margin)

    def doubt(self) -> str:
        """What the samples say against ``bits``, or how they were spread; empty for nothing."""
        if self.refused:
            return self.refused
        if self.most >> self.bits:
            held = f"samples reach {self.most}, more than {self.bits} bits hold"
            return f"{held}: brighter ones are clipped (--bits {self.most.bit_length()})"
        likely, said = next(n for n in (8, 10, 12, 16) if self.most < 1 << n), []
        if self.span is not None:
            low, high = (min(max(round(s), 0), 65535) for s in self.span)
            said.append(f"the samples of 16-bit images keep to a small range: {low} to {high} are spread over 8 bits")
        if self.most and likely < self.bits == 16:
            reach = f"the samples of 16-bit images reach only {self.most}"
            said.append(f"{reach}: are these {likely} bits (--bits {likely})?")
        return "; ".join(said)


@runtime_checkable
class Source(Protocol):
    """A stereo sequence, rectified, or stereo tracks.

    ``kind``: ``"images"`` yields :class:`StereoFrame` (8 bit, rectified), ``"tracks"`` yields :class:`TrackFrame`.
    ``mask`` (H, W) is True where the rectified left image shows something, None for everywhere. ``truth`` is of the
    rectified left camera. ``calibration`` describes the raw rig, for the run folder. ``span_ns``: first and last stamp
    expected. ``len`` is the number of pairs expected, exact unless frames turn out to be bad.
    """

    name: str
    path: Path
    format: str
    kind: Literal["images", "tracks"]
    camera: StereoCamera
    mask: NDArray[np.bool_] | None
    mounting: Mounting
    imu: ImuLog | None
    truth: TruthLog | None
    report: SourceReport
    calibration: dict[str, Any] | None
    span_ns: tuple[int, int]

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[StereoFrame | TrackFrame]: ...


# Order of the guesses: the strictest test first; bags may lie in a sequence's folder. Modules are imported when asked.
BUILT_IN: dict[str, str] = {
    "tracks": "gpvo.io.tracks:TracksSource",
    "euroc": "gpvo.io.datasets:EurocSource",
    "kitti": "gpvo.io.datasets:KittiSource",
    "folder": "gpvo.io.folder:FolderSource",
    "rosbag": "gpvo.io.bags:BagSource",
}


@cache
def source_kinds() -> dict[str, Callable[[], Any]]:
    """Names of all sources with a loader of each class, those of other packages after the built-in ones.

    A package joins with ``[project.entry-points."gpvo.sources"]`` and ``name = "package.module:Class"``; the class
    follows :class:`Source` and is built from a path. A built-in name cannot be taken over.
    """
    return plugins("gpvo.sources", BUILT_IN)


def guess(path: str | Path) -> str:
    """Name of the source that recognises a path.

    Raises SourceError where the path does not exist, is empty, or nothing recognises it.
    """
    p = existing(Path(path))
    if p.is_dir() and not any(p.iterdir()):
        raise SourceError("the folder is empty", where=p, cure="give the folder that holds the sequence")
    if p.is_file() and p.stat().st_size == 0:
        raise SourceError("the file is empty", where=p)
    for name, load in source_kinds().items():
        if load().recognises(p):
            return name
    if (p / "run.json").is_file():
        cure = "gpvo evaluate, train and fuse take runs as they are"
        raise SourceError("is a run, not a sequence", where=p, cure=cure)
    if runs := sorted(inside.parent.name for inside in p.glob("*/run.json")):
        more = f" and {len(runs) - 3} more" if len(runs) > 3 else ""
        raise SourceError(f"holds runs, not a sequence: {', '.join(runs[:3])}{more}", where=p, cure="give one of them")
    raise SourceError(
        "not recognised as a stereo sequence",
        where=p,
        cure="known are EuRoC/ASL (mav0/), KITTI (calib.txt, image_0/, or image_00/data/), ROS bags (.bag, .db3, .mcap,"
        " or a folder of those of one recording), image pairs with a camchain.yaml (left/ right/, cam0/ cam1/, infra1/"
        " infra2/, or left, right at one end of the names of two folders or of images), and tracks (.npz); name one"
        " with --source; poses alone are for 'gpvo import'",
    )


def existing(path: Path) -> Path:
    """The same path. Raises SourceError where it is no file or folder: a pipe or a device cannot be gone back in."""
    if not (path.is_file() or path.is_dir()):
        raise SourceError("is a pipe or a device" if path.exists() else "no such file or folder", where=path)
    return path


def open_source(path: str | Path, kind: str | None = None, **options: Any) -> Source:
    """Open a sequence; ``kind`` overrides the guess, ``options`` go to the source.

    Options of all image sources: ``hfov_deg`` and ``size`` of the rectified view, ``mask_left``, ``mask_right``
    (image files), ``calibration`` (a file in place of the one found), ``bits`` (depth of 16-bit images' samples),
    ``prefetch`` (decode ahead in a thread). Raises SourceError or CalibrationError: one line that names the file and
    the cure.
    """
    kinds = source_kinds()
    if kind is not None and kind not in kinds:
        raise SourceError(f"unknown source '{kind}'", cure=f"choose one of {', '.join(kinds)}")
    name = guess(path) if kind is None else kind
    try:
        return kinds[name]()(existing(Path(path)), **options)
    except TypeError as error:
        if "unexpected keyword argument" not in str(error):
            raise
        option = str(error).split("'")[1]
        flag = {"tolerance_s": "pair-tolerance"}.get(option, option.replace("_", "-"))
        raise SourceError(f"the source '{name}' has no option '{option}' (--{flag})", where=path) from None
