"""A folder of image pairs with a Kalibr camera chain beside them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import pairwise
from math import gcd
from pathlib import Path
from typing import Any, TypeVar

from gpvo.cameras.kalibr import read_imu_noise
from gpvo.cameras.readers import SIDES, find_calibration, read_stereo_yaml
from gpvo.errors import CalibrationError, SourceError, counted
from gpvo.io.images import IMAGE_SUFFIXES, FileSource, PairFiles, first_size
from gpvo.io.source import SourceReport
from gpvo.io.stamps import PAIR_TOLERANCE_S, check_padding, integer_ns, match_nearest, text_to_ns, tolerance_ns
from gpvo.io.trajectory import UNKNOWN, carry, check_overlap, read_imu_csv, read_times, read_tum

_PAIRS = (*SIDES, ("l", "r"))
_SIDE = "|".join(side for pair in _PAIRS for side in pair)
# 0012_left, 0012left, left_0012 and left0012, but not cam0012.
_NAMES = (
    re.compile(rf"(?P<stem>.*?)[_-]?(?P<side>{_SIDE})", re.IGNORECASE),
    re.compile(rf"(?P<side>{_SIDE})(?:[_-]|(?<=[a-z])(?=\d))(?P<stem>.+)", re.IGNORECASE),
)
_END = re.compile(r"[_-](left|right|cam0|cam1)$", re.IGNORECASE)
_DIGITS = re.compile(r"\d+(?:\.\d+)?")
_DATE = re.compile(r"(?:19|20)\d\d\D?[01]\d\D?[0-3]\d\D?[0-2]\d\D?[0-5]\d")
# Whole numbers of at least this many digits are nanoseconds since an epoch, not indices.
_STAMP_DIGITS = 13
_EPOCH_S = 1e6  # Behind other numbers, seconds of at least this size are a stamp, smaller ones part of a date.

T = TypeVar("T")


class FolderSource(FileSource):
    """Pairs in two folders, or in one; these, or the images, have their side at either end of their names; sides are
    those of :data:`SIDES`.

    Stamps are the names in nanoseconds (or decimal seconds), else the lines of ``times.txt`` (seconds) in the order
    of the names, else ``rate_hz`` makes them from the number in the name, if it counts the images; those of a pair may
    differ by ``tolerance_s``. ``imu.csv`` (EuRoC columns) and ``truth.tum`` (poses of the left camera as calibrated)
    are read where present.
    """

    format = "folder"

    def __init__(
        self,
        path: Path,
        *,
        calibration: str | Path | None = None,
        rate_hz: float | None = None,
        tolerance_s: float = PAIR_TOLERANCE_S,
        **options: Any,
    ) -> None:
        chain = Path(calibration) if calibration is not None else find_calibration(path)
        if chain is None:
            cure = "put Kalibr's camchain.yaml there or name one with --calibration"
            raise CalibrationError("no calibration beside the images", where=path, cure=cure)
        known = SourceReport()
        pairs = _list_pairs(path, rate_hz, tolerance_s, known)
        first = first_size(pairs, "left")
        rig = read_stereo_yaml(chain, size=None if first is None else first[1])
        super().__init__(path, path.resolve().name, rig, pairs, known, **options)
        if (path / "imu.csv").is_file():
            noise = read_imu_noise(stated) if (stated := path / "imu.yaml").is_file() else None
            shift_s = rig.timeshift_cam_imu_s
            self.imu = read_imu_csv(path / "imu.csv", shift_s=shift_s, noise=noise, remark=self.remark)
        if (path / "truth.tum").is_file():
            self.truth = carry(read_tum(path / "truth.tum"), self.rectifier.T_left_cam, UNKNOWN)
            check_overlap(self.truth, self.span_ns, path / "truth.tum")

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """A folder with a pair of image folders or left and right images."""
        return path.is_dir() and (_named_pair(path) is not None or all(_find_images(path)))


def _is_image(path: Path) -> bool:
    """By its ending; macOS leaves a file ``._NAME`` beside each on foreign disks."""
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")


def _list_pairs(path: Path, rate_hz: float | None, tolerance_s: float, known: SourceReport) -> list[PairFiles]:
    left, right = _find_images(path)
    if not left or not right:
        cure = "left/ and right/ with equal names, or names that begin or end with left, right"
        raise SourceError("holds no image pairs", where=path, cure=cure)
    stamps = _stamps(path, (list(left), list(right)), rate_hz, known)
    lists = [[(stamps[key], key) for key in side if key in stamps] for side in (left, right)]
    pairs = match_nearest(lists[0], lists[1], tolerance_ns(tolerance_s), known, path)
    return [PairFiles(t, left[a], right[b]) for t, a, b in pairs]


def _pair_of(named: dict[str, T]) -> tuple[T, T] | None:
    """What belongs to the left and to the right side, by names of sides in small letters."""
    return next(((named[a], named[b]) for a, b in _PAIRS if a in named and b in named), None)


def _named_pair(path: Path) -> tuple[Path, Path] | None:
    """The folders that are named by their sides."""
    return _pair_of({f.name.lower().removeprefix("image_"): f for f in sorted(path.iterdir()) if f.is_dir()})


def _folder_pair(path: Path) -> tuple[Path, Path] | None:
    """The only two folders with images whose names have a side at one end and are else the same, such as stereo_left
    and stereo_right."""
    folders = [f for f in sorted(path.iterdir()) if f.is_dir() and any(_images_in(f))]
    pairs = [(left[k], right[k]) for left, right in _by_side(folders) for k in left.keys() & right.keys()]
    return pairs[0] if len(pairs) == 1 else None


def _images_in(folder: Path) -> Iterator[Path]:
    """Images in a folder of one camera, or in ``data`` below it."""
    inside = folder / "data" if (folder / "data").is_dir() else folder
    return (f for f in inside.iterdir() if _is_image(f))


def _by_side(paths: list[Path]) -> Iterator[tuple[dict[str, Path], dict[str, Path]]]:
    """Those that are named by the left and by the right side, at either end of their names, by what else these hold."""
    for pattern in _NAMES:
        named: dict[str, dict[str, Path]] = {}
        for path in paths:
            if match := pattern.fullmatch(path.name if path.is_dir() else path.stem):
                named.setdefault(match["side"].lower(), {})[match["stem"]] = path
        if (pair := _pair_of(named)) is not None:
            yield pair


def _find_images(path: Path) -> tuple[dict[str, Path], dict[str, Path]]:
    """Images of both cameras, keyed by what their names have in common."""
    if (pair := _named_pair(path)) is None:
        files = next(_by_side([f for f in sorted(path.iterdir()) if _is_image(f)]), ({}, {}))
        if all(files) or (pair := _folder_pair(path)) is None:
            return files
    # Without a side at their ends: 000012_left and 000012 alike.
    left, right = ({_END.sub("", f.stem): f for f in sorted(_images_in(side))} for side in pair)
    return left, right


def _stamps(
    path: Path, sides: tuple[list[str], list[str]], rate_hz: float | None, known: SourceReport
) -> dict[str, int]:
    """By key: from the names, else ``times.txt``, else the rate."""
    keys = sorted({*sides[0], *sides[1]}, key=_natural)
    numbers, counts, times = _numbers(keys), _counts(sides), path / "times.txt"
    is_stamp = len(numbers) == len(keys) and all("." in n or len(n) >= _STAMP_DIGITS for n in numbers.values())
    if rate_hz is not None and (is_stamp or times.is_file()):
        known.note(f"--rate-hz is not used: the stamps are {'the image names' if is_stamp else 'those of times.txt'}")
    if is_stamp:
        check_padding(list(numbers.values()), path)
        try:
            return {k: text_to_ns(n) if "." in n else integer_ns(n) for k, n in numbers.items()}
        except ValueError as error:
            raise SourceError(f"image names: {error}", where=path, cure="name them by nanoseconds") from None
    if times.is_file():
        return _stamps_by_line(times, counts or {k: i for i, k in enumerate(keys)}, bool(counts), known)
    if rate_hz is not None and 1e-3 <= rate_hz <= 1e5 and counts:
        if max(counts.values()) * 1e9 / rate_hz > 9.2e18:
            raise SourceError("the image names hold numbers too large to count frames", where=path)
        return {k: round(n * 1e9 / rate_hz) for k, n in counts.items()}
    dates = " (dates are not read)" if _DATE.search(keys[0]) else ""
    text, more = f"the image names are not stamps{dates}, and there is no times.txt", ", or give --rate-hz"
    if not counts:
        more = ", or number them for --rate-hz"
        if rate_hz is not None:
            text = f"the last number of names such as '{keys[0]}' does not count the images{dates}"
    cure = f"name images by nanoseconds, add times.txt (seconds, a line per pair){more}"
    raise SourceError(text, where=path, cure=cure)


def _natural(key: str) -> list[int | str]:
    """For the order of names in which numbers count as such: 2 before 10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", key)]


def _numbers(keys: list[str]) -> dict[str, str]:
    """The last number of each key that has one; none at all where they do not tell the keys apart, or are parts of
    versions or dates: with a dot, behind other numbers, and too small for seconds since an epoch."""
    found = {k: f for k in keys if (f := _DIGITS.findall(k))}
    numbers = {k: f[-1] for k, f in found.items()}
    is_part = any("." in f[-1] and len(f) > 1 and float(f[-1]) < _EPOCH_S for f in found.values())
    return {} if is_part or 2 * len(set(numbers.values())) < len(numbers) else numbers


def _counts(sides: tuple[list[str], list[str]]) -> dict[str, int]:
    """The last number of each key, where it counts images: the others are the same for all images of a side, and every
    step is a multiple of the smallest, which is 1 behind a date or seconds. Else none at all."""
    found = {k: _DIGITS.findall(k) or ["."] for side in sides for k in side}
    before = [{(*found[k][:-1],) for k in side} for side in sides]
    if any(len(b) > 1 for b in before) or any("." in f[-1] for f in found.values()):
        return {}
    counts = {k: int(f[-1]) for k, f in found.items()}
    places = sorted(set(counts.values()))
    steps = [b - a for a, b in pairwise(places)]
    least, is_timed = min(steps, default=0), any(len(n) > 5 for b in before for other in b for n in other)
    return counts if 2 * len(places) >= len(counts) and gcd(*steps) == least and not (is_timed and least > 1) else {}


def _stamps_by_line(times: Path, places: dict[str, int], is_counted: bool, known: SourceReport) -> dict[str, int]:
    """Lines of ``times.txt`` in order where there are as many, else by the number in the name (from 0 or 1), so that a
    missing image shifts nothing."""
    lines, order = read_times(times), sorted(set(places.values()))
    first = 1 if order[0] == 1 and order[-1] == len(lines) else 0
    at = {i: int(lines[i - first]) for i in order if 0 <= i - first < len(lines)}
    if len(order) == len(lines):
        at = dict(zip(order, lines.tolist(), strict=True))
    elif not is_counted or len(at) < 2:
        cure = "give a line per pair, in the order of their names"
        raise SourceError(f"holds {counted(len(lines), 'stamp')} for {len(order)} images", where=times, cure=cure)
    inside = {k: at[i] for k, i in places.items() if i in at}
    if absent := len(places) - len(inside):
        known.count("missing", f"{counted(absent, 'image')} without a line in times.txt", absent)
    return inside
