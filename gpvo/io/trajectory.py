"""Trajectory files, TUM, KITTI and EuRoC CSV, read strictly; what they say carried to the camera, as its truth; and the
IMU samples beside them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gpvo.errors import SourceError, counted
from gpvo.files import replacing
from gpvo.geometry import se3
from gpvo.io.stamps import (
    Stamps,
    astray,
    check_interval,
    check_padding,
    cure_of_end,
    cure_of_number,
    cure_of_seconds,
    cure_of_unit,
    date_to_ns,
    growing,
    integer_ns,
    is_number,
    ns_to_seconds_text,
    text_lines,
    text_to_ns,
)
from gpvo.types import Array, ImuLog, ImuNoise, TruthLog

# Published ground truth is unit to about 1e-4; with three printed decimals to 1e-3. Worse is another column order.
_UNIT_TOLERANCE = 1e-2
FARTHEST_M = 1e9
REMOVE = "remove the line: a gap does no harm"
_REMOVE_OF_KITTI = "KITTI poses have no stamps: remove the line and its stamp from copies, for gpvo import --times"
_MANY = 0.2  # of the stamps: so many repeat only where they are rounded, or every line is there twice
_MANY_FIELDS = 1_000_000  # lines are shorter


@dataclass(frozen=True)
class Trajectory:
    """Poses of one moving frame: ``t_ns`` (N,) int64, strictly growing, and ``T_world_body`` (N, 4, 4)."""

    t_ns: Stamps
    T_world_body: Array

    def __len__(self) -> int:
        return len(self.t_ns)


def read_tum(path: str | Path, *, any_spacing: bool = False) -> Trajectory:
    """TUM lines ``t[s] tx ty tz qx qy qz qw``; ``#`` starts a comment.

    ``any_spacing``: these are waypoints; else stamps whose usual interval is no odometry's are in another unit. Raises
    SourceError, naming file and line: wrong number of fields, NaN, stamps that do not grow, or are no seconds,
    quaternions that are not unit.
    """
    trajectory = read_tum_with(Path(path), 0)[0]
    if not any_spacing:
        check_interval(trajectory.t_ns, path, cure_of_unit, is_stated=True)
    return trajectory


def read_tum_with(path: Path, more: int) -> tuple[Trajectory, list[list[str]]]:
    """TUM lines with ``more`` words behind the pose: the trajectory, and those words line by line.

    Raises SourceError as :func:`read_tum`.
    """
    what = f"{8 + more}: t tx ty tz qx qy qz qw" + (f" and {more} more" if more else "")
    return _read_poses(path, None, range(8 + more, 9 + more), what, text_to_ns, (3, 4, 5, 6))


def read_euroc_csv(path: str | Path) -> Trajectory:
    """EuRoC ground truth ``t[ns], p xyz, q wxyz, ...`` of at least 8 columns.

    Raises SourceError as :func:`read_tum`.
    """
    what = "at least 8: t[ns],px,py,pz,qw,qx,qy,qz"
    return _read_poses(Path(path), ",", range(8, _MANY_FIELDS), what, integer_ns, (4, 5, 6, 3))[0]


def read_kitti_poses(path: str | Path) -> Array:
    """KITTI poses, 12 numbers a line, as (N, 4, 4). Raises SourceError, naming file and line."""
    p = Path(path)
    out = []
    for number, fields in _fields(p, None):
        values = _floats(p, number, fields, _REMOVE_OF_KITTI)
        if len(values) != 12:
            what = f"line {number} holds {counted(len(values), 'number')}, expected 12 (a 3x4 matrix)"
            raise SourceError(what, where=p)
        out.append(values)
    if not out:
        raise SourceError("holds no poses", where=p)
    M = np.array(out).reshape(-1, 3, 4)
    R = M[:, :, :3]
    deviation = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero((deviation > _UNIT_TOLERANCE) | (np.linalg.det(R) < 0))
    if len(bad):
        raise SourceError(f"pose {bad[0] + 1} is not a rigid transform", where=p, cure="12 numbers: rows of [R | t]")
    return se3.orthonormalise(se3.from_rt(R, M[:, :, 3]))


def read_times(path: str | Path) -> Stamps:
    """KITTI's ``times.txt`` (seconds) or ``timestamps.txt`` (dates in UTC) as (N,) nanoseconds, in the order of the
    file; lines of names on top are skipped.

    Raises SourceError, naming file and line.
    """
    p = Path(path)
    stamps: list[int] = []
    for number, fields in _fields(p, None):
        if not stamps and _are_names(fields):
            continue
        try:
            if (date_ns := date_to_ns(" ".join(fields))) is None and len(fields) != 1:
                raise ValueError(f"{counted(len(fields), 'field')}, expected 1")
            stamps.append(text_to_ns(fields[0]) if date_ns is None else date_ns)
        except ValueError as error:
            raise SourceError(f"line {number}: {error}", where=p) from None
    return np.array(stamps, dtype=np.int64)


TUM = (rb"\A-?\d+\.\d{9}( -?\d+\.\d{9}){7}\n", "trajectory")  # as tum_line writes it


def write_tum(path: str | Path, t_ns: Stamps, T_world_body: Array) -> None:
    """Write TUM lines, stamps and values with nine decimals."""
    lines = (tum_line(t, T) + "\n" for t, T in zip(t_ns, T_world_body, strict=True))
    with replacing(Path(path), TUM) as temporary, temporary.open("w", encoding="ascii", newline="\n") as file:
        file.writelines(lines)


def tum_line(t_ns: int, T_world_body: Array) -> str:
    """One TUM line, without the line end."""
    q = se3.rotation_to_quaternion_xyzw(T_world_body[:3, :3])
    return " ".join([ns_to_seconds_text(t_ns), *(f"{v:.9f}" for v in (*T_world_body[:3, 3], *q))])


def _fields(path: Path, separator: str | None) -> Iterator[tuple[int, list[str]]]:
    """Line numbers and fields of the lines that hold something and are no comments."""
    for number, text in text_lines(path):
        if not text.startswith("#"):
            yield number, [f.strip() for f in text.split(separator)]


def _are_names(fields: list[str]) -> bool:
    """Whether a line names columns."""
    return not fields[0][:1].isdigit() and not any(map(is_number, fields))


def _floats(path: Path, number: int, fields: list[str], cure: str = REMOVE) -> list[float]:
    try:
        values = [float(f) for f in fields]
    except ValueError:
        raise SourceError(f"line {number} holds something that is not a number", where=path) from None
    if not all(map(math.isfinite, values)):
        raise SourceError(f"line {number} holds NaN or infinity", where=path, cure=cure)
    if (largest := max(map(abs, values))) > FARTHEST_M:
        raise SourceError(f"line {number} holds {largest:.3g}: no position on Earth", where=path)
    return values


def _read_poses(
    path: Path,
    separator: str | None,
    counts: range,
    what: str,
    stamp: Callable[[str], int],
    q_xyzw: tuple[int, int, int, int],
) -> tuple[Trajectory, list[list[str]]]:
    """Lines of a stamp and the seven numbers of a pose, where ``q_xyzw`` of these are the quaternion; and what follows
    them in each line, up to the least of the ``counts`` of fields that are allowed, ``what`` in words."""
    numbers: list[int] = []
    texts, stamps, poses, behind = list[str](), [], [], []
    for number, fields in _fields(path, separator):
        if len(fields) not in counts:
            cure = cure_of_end(path, number) if numbers and len(fields) < counts.start else None
            others = "'gpvo import', of a log or as --truth of a run, takes CSV, KITTI and bags"
            cure = cure or (None if separator else others)
            held = counted(len(fields), "field")
            raise SourceError(f"line {number} holds {held}, expected {what}", where=path, cure=cure)
        try:
            stamps.append(stamp(fields[0]))
        except ValueError as error:
            cure = cure_of_seconds(fields[0]) if stamp is text_to_ns else None
            cure = cure or cure_of_number(fields[0])
            raise SourceError(f"line {number}: {error}", where=path, cure=cure) from None
        texts.append(fields[0])
        numbers.append(number)
        poses.append(_floats(path, number, fields[1:8]))
        behind.append(fields[8 : counts.start])
    t, data = np.array(stamps, dtype=np.int64), np.array(poses)
    if len(t) == 0:
        raise SourceError("holds no poses", where=path)
    check_padding(texts, path)
    check_growing(path, t, numbers)
    check_unit(path, data[:, q_xyzw], numbers)
    return Trajectory(t, se3.from_quaternion(data[:, :3], data[:, q_xyzw])), behind


def check_growing(path: Path, t_ns: Stamps, lines: list[int]) -> None:
    """Refuse stamps that repeat or go back, naming the line, or the one with the wrong stamp."""
    bad = np.flatnonzero(np.diff(t_ns) <= 0)
    if len(wrong := np.flatnonzero(astray(t_ns))) and wrong[0] <= bad[0] + 1:
        text = f"line {lines[wrong[0]]}: the stamp {ns_to_seconds_text(t_ns[wrong[0]])} s is far from those around it"
        raise SourceError(text, where=path, cure=REMOVE)
    if len(bad):
        k = int(bad[0])
        word = "repeats" if t_ns[k + 1] == t_ns[k] else "goes back"
        text = f"line {lines[k + 1]}: the stamp {ns_to_seconds_text(t_ns[k + 1])} s {word}"
        cure = "sort the file by time and drop repeated lines"
        repeated = len(t_ns) - len(np.unique(t_ns))
        if repeated > _MANY * len(t_ns):
            text += f", as {repeated} of {len(t_ns)} do"
            cure = "they are rounded: write them with all digits, nanoseconds included, or drop repeated lines"
        raise SourceError(text, where=path, cure=cure)


def check_unit(path: Path, q_xyzw: Array, lines: list[int]) -> None:
    """Refuse quaternions whose length is not 1 to a hundredth, naming the line."""
    norm = np.linalg.norm(q_xyzw, axis=1)
    bad = np.flatnonzero(np.abs(norm - 1.0) > _UNIT_TOLERANCE)
    if len(bad):
        text = f"line {lines[int(bad[0])]}: the quaternion has length {norm[bad[0]]:.4f}, not 1"
        raise SourceError(text, where=path, cure="check the order of the columns")


TruthNoise = tuple[float, float]
"""White noise of a truth, per pose and axis: translation [m], rotation [rad]."""
# GPS/INS: a motion between two poses carries sqrt(2) times as much, about 4 mm; measured as the
# fourth difference of vertical and lateral position over seven KITTI drives (1 to 6 mm per motion).
GPS_INS: TruthNoise = (3e-3, 2e-4)
# Optical motion capture at 120 Hz, unfiltered (fourth difference of TUM-VI room 1: 0.09 mm and 0.8 mrad).
MOTION_CAPTURE: TruthNoise = (1e-4, 8e-4)
# Smoothed by a batch estimator with an IMU (EuRoC: below 0.01 mm and 0.1 mrad): its white part is nothing, what
# remains is slow.
BATCH_ESTIMATE: TruthNoise = (0.0, 0.0)
UNKNOWN: TruthNoise = (0.0, 0.0)


def carry(trajectory: Trajectory, T_body_cam: Array, noise: TruthNoise) -> TruthLog:
    """Truth of a body as truth of the camera that sits at ``T_body_cam`` (4, 4) on it.

    The rotation noise acts at the lever arm too; at the decimetres of a head that is far below the translation noise
    and is left out.
    """
    return TruthLog(trajectory.t_ns, trajectory.T_world_body @ T_body_cam, *noise)


def check_overlap(truth: TruthLog, t_ns: Sequence[int] | Stamps, path: Path, more: str = "") -> None:
    """Raise SourceError for a truth that does not overlap frames in time, the first and the last of ``t_ns``; ``more``:
    a further cure."""
    (first, last), (begin, end) = ((int(t[0]), int(t[-1])) for t in (t_ns, truth.t_ns))
    if end < first or begin > last:
        apart_s = max(first - end, begin - last) * 1e-9
        raise SourceError(
            f"the ground truth ({begin * 1e-9:.3f} to {end * 1e-9:.3f} s) does not overlap the frames"
            f" ({first * 1e-9:.3f} to {last * 1e-9:.3f} s): they are {apart_s:.3f} s apart",
            where=path,
            cure="is it the truth of this sequence, and of the same clock?" + more,
        )


def read_imu_csv(path: Path, *, shift_s: float, noise: ImuNoise | None, remark: Callable[[str], None]) -> ImuLog:
    """EuRoC's ``data.csv``: stamp [ns], gyro xyz [rad/s], accelerometer xyz [m/s^2], in that order, as column names on
    top, if any, must say.

    ``shift_s``: ``t_imu = t_cam + shift``, taken off so that the stamps are of the camera's clock. Lines that repeat
    or go back in time are dropped, which ``remark`` is told. Raises SourceError, naming file and line.
    """
    stamps: list[int] = []
    rows: list[list[float]] = []
    for number, fields in _fields(path, ","):
        if not stamps and _are_names(fields):
            if re.match("lin|acc|a_?(rs_s_)?[xyz]", "".join(fields[1:2]).lower()):
                cure = "put the columns of the gyroscope before those of the accelerometer"
                raise SourceError(f"line {number}: '{fields[1]}' comes before the gyroscope", where=path, cure=cure)
            continue
        try:
            stamps.append(integer_ns(fields[0]))
            rows.append([float(f) for f in fields[1:7]])
            if len(rows[-1]) != 6 or not np.isfinite(rows[-1]).all():
                raise ValueError
        except ValueError:
            raise SourceError(f"line {number}: expected t[ns] and six finite numbers, gyro first", where=path) from None
    if not stamps:
        raise SourceError("holds no IMU samples", where=path)
    check_interval(stamps, path, lambda _: "write them as nanoseconds", is_stated=True)
    return make_imu(np.array(stamps, dtype=np.int64), np.array(rows), shift_s=shift_s, noise=noise, remark=remark)


def make_imu(
    t_ns: Stamps, gyro_acc: Array, *, shift_s: float, remark: Callable[[str], None], noise: ImuNoise | None = None
) -> ImuLog:
    """An :class:`ImuLog` of samples (N, 6), gyro first; those that repeat or go back in time are dropped."""
    keep = growing(t_ns)
    if not keep.all():
        remark(f"{int((~keep).sum())} of {len(t_ns)} IMU samples repeat or go back in time: dropped")
    t = t_ns[keep] - round(shift_s * 1e9)
    return ImuLog(t_ns=t, gyro_radps=gyro_acc[keep, :3], acc_mps2=gyro_acc[keep, 3:], noise=noise)
