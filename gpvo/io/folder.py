"""A folder of image pairs with a Kalibr camera chain beside them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from gpvo.cameras.kalibr import read_imu_noise
from gpvo.cameras.readers import find_calibration, read_stereo_yaml
from gpvo.errors import CalibrationError, SourceError, counted
from gpvo.io.images import IMAGE_SUFFIXES, FileSource, PairFiles, first_size
from gpvo.io.source import SourceReport
from gpvo.io.stamps import PAIR_TOLERANCE_S, integer_ns, match_nearest, seconds_text_to_ns, tolerance_ns
from gpvo.io.trajectory import UNKNOWN, carry, check_overlap, read_imu_csv, read_times, read_tum

_FOLDERS = (("left", "right"), ("cam0", "cam1"), ("image_left", "image_right"), ("left/data", "right/data"))
_SIDE = re.compile(r"(?P<stem>.*?)[_-]?(?P<side>left|right|cam0|cam1|l|r)$", re.IGNORECASE)
_END = re.compile(r"[_-](left|right|cam0|cam1)$", re.IGNORECASE)
_DIGITS = re.compile(r"\d+(?:\.\d+)?")
_DATE = re.compile(r"(?:19|20)\d\d\D?[01]\d\D?[0-3]\d\D?[0-2]\d\D?[0-5]\d")
# Whole numbers of at least this many digits are nanoseconds since an epoch, not indices.
_STAMP_DIGITS = 13
_EPOCH_S = 1e6  # Behind other numbers, seconds of at least this size are a stamp, smaller ones part of a date.


class FolderSource(FileSource):
    """Pairs in ``left/ right/`` or ``cam0/ cam1/``, or named ``*_left.png *_right.png`` in one folder.

    Stamps are the names in nanoseconds (or decimal seconds), else the lines of ``times.txt`` (seconds) in the order
    of the names, else ``rate_hz`` makes them from the number in the name; those of a pair may differ by
    ``tolerance_s``. ``imu.csv`` (EuRoC columns) and ``truth.tum`` (poses of the left camera as calibrated) are read
    where present.
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
        if not path.is_dir():
            return False
        if any((path / a).is_dir() and (path / b).is_dir() for a, b in _FOLDERS):
            return True
        sides = {m["side"].lower() for f in path.iterdir() if _is_image(f) and (m := _SIDE.match(f.stem))}
        return any({a, b} <= sides for a, b in (("left", "right"), ("cam0", "cam1"), ("l", "r")))


def _is_image(path: Path) -> bool:
    """By its ending; macOS leaves a file ``._NAME`` beside each on foreign disks."""
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")


def _list_pairs(path: Path, rate_hz: float | None, tolerance_s: float, known: SourceReport) -> list[PairFiles]:
    left, right = _find_images(path)
    if not left or not right:
        cure = "left/ and right/ with equal names, or names ending _left, _right"
        raise SourceError("holds no image pairs", where=path, cure=cure)
    stamps = _stamps(path, sorted({*left, *right}), rate_hz, known)
    lists = [[(stamps[key], key) for key in side if key in stamps] for side in (left, right)]
    pairs = match_nearest(lists[0], lists[1], tolerance_ns(tolerance_s), known, path)
    return [PairFiles(t, left[a], right[b]) for t, a, b in pairs]


def _find_images(path: Path) -> tuple[dict[str, Path], dict[str, Path]]:
    """Images of both cameras, keyed by what their names have in common."""
    for a, b in _FOLDERS:
        if (path / a).is_dir() and (path / b).is_dir():
            sides = [path / s / "data" if (path / s / "data").is_dir() else path / s for s in (a, b)]
            # Without a side at their ends: 000012_left and 000012 alike.
            left, right = ({_END.sub("", f.stem): f for f in sorted(s.iterdir()) if _is_image(f)} for s in sides)
            return left, right
    named: tuple[dict[str, Path], dict[str, Path]] = ({}, {})
    for file in sorted(path.iterdir()):
        match = _SIDE.match(file.stem) if _is_image(file) else None
        if match is not None:
            named[match["side"].lower() in ("right", "cam1", "r")][match["stem"]] = file
    return named


def _stamps(path: Path, keys: list[str], rate_hz: float | None, known: SourceReport) -> dict[str, int]:
    numbers = _numbers(keys)
    if len(numbers) == len(keys) and all("." in n or len(n) >= _STAMP_DIGITS for n in numbers.values()):
        try:
            return {k: seconds_text_to_ns(n) if "." in n else integer_ns(n) for k, n in numbers.items()}
        except ValueError as error:
            raise SourceError(f"image names: {error}", where=path, cure="name them by nanoseconds") from None
    times = path / "times.txt"
    if times.is_file():
        return _stamps_by_line(path, keys, numbers, known)
    if rate_hz is not None and 1e-3 <= rate_hz <= 1e5 and len(numbers) == len(keys):
        if max(map(float, numbers.values())) * 1e9 / rate_hz > 9.2e18:
            raise SourceError("the image names hold numbers too large to count frames", where=path)
        return {k: round(float(n) * 1e9 / rate_hz) for k, n in numbers.items()}
    dates = " (dates are not read)" if _DATE.search(keys[0]) else ""
    if rate_hz is not None and not numbers:
        text = f"the last number of names such as '{keys[0]}' does not count the images{dates}"
        cure = "name images by nanoseconds, number them, or add times.txt (seconds, a line per pair)"
        raise SourceError(text, where=path, cure=cure)
    cure = "name images by nanoseconds, add times.txt (seconds, a line per pair), or give --rate-hz"
    raise SourceError(f"the image names are not stamps{dates}, and there is no times.txt", where=path, cure=cure)


def _numbers(keys: list[str]) -> dict[str, str]:
    """The last number of each key that has one; none at all where they do not tell the keys apart, or are parts of
    versions or dates: with a dot, behind other numbers, and too small for seconds since an epoch."""
    found = {k: f for k in keys if (f := _DIGITS.findall(k))}
    numbers = {k: f[-1] for k, f in found.items()}
    is_part = any("." in f[-1] and len(f) > 1 and float(f[-1]) < _EPOCH_S for f in found.values())
    return {} if is_part or 2 * len(set(numbers.values())) < len(numbers) else numbers


def _stamps_by_line(path: Path, keys: list[str], numbers: dict[str, str], known: SourceReport) -> dict[str, int]:
    """Lines of ``times.txt`` by the number in the name (from 0 or 1), so that a missing image shifts nothing."""
    lines = read_times(path / "times.txt")
    if len(numbers) == len(keys):
        index = {k: int(float(n)) for k, n in numbers.items()}
        first = 1 if min(index.values()) == 1 and max(index.values()) == len(lines) else 0
        inside = {k: i - first for k, i in index.items() if 0 <= i - first < len(lines)}
        if len(inside) < len(keys):
            absent = len(keys) - len(inside)
            known.count("missing", f"{counted(absent, 'image')} without a line in times.txt", absent)
        return {k: int(lines[i]) for k, i in inside.items()}
    if len(keys) != len(lines):
        raise SourceError(f"holds {counted(len(lines), 'stamp')} for {len(keys)} images", where=path / "times.txt")
    return {k: int(t) for k, t in zip(keys, lines, strict=True)}
