"""IMU samples of an ASL folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from gpvo.errors import SourceError
from gpvo.io.stamps import growing, integer_ns, text_lines
from gpvo.types import ImuLog, ImuNoise


def read_imu_csv(
    path: Path,
    *,
    shift_s: float = 0.0,
    noise: ImuNoise | None = None,
    remark: Callable[[str], None] | None = None,
) -> ImuLog:
    """EuRoC's ``data.csv``: stamp [ns], gyro xyz [rad/s], accelerometer xyz [m/s^2], in that order.

    ``shift_s``: ``t_imu = t_cam + shift``, taken off so that the stamps are of the camera's clock. Lines that repeat
    or go back in time are dropped, which ``remark`` is told. Raises SourceError, naming file and line.
    """
    stamps: list[int] = []
    rows: list[list[float]] = []
    for number, text in text_lines(path):
        if text.startswith("#"):
            continue
        try:
            fields = text.split(",")
            stamps.append(integer_ns(fields[0].strip()))
            rows.append([float(f) for f in fields[1:7]])
            if len(rows[-1]) != 6 or not np.isfinite(rows[-1]).all():
                raise ValueError
        except ValueError:
            raise SourceError(f"line {number}: expected t[ns] and six finite numbers, gyro first", where=path) from None
    if not stamps:
        raise SourceError("holds no IMU samples", where=path)
    return make_imu(np.array(stamps, dtype=np.int64), np.array(rows), shift_s=shift_s, noise=noise, remark=remark)


def make_imu(
    t_ns: np.ndarray,
    gyro_acc: np.ndarray,
    *,
    shift_s: float = 0.0,
    noise: ImuNoise | None = None,
    remark: Callable[[str], None] | None = None,
) -> ImuLog:
    """An :class:`ImuLog` of samples (N, 6), gyro first; those that repeat or go back in time are dropped."""
    keep = growing(t_ns)
    if remark is not None and not keep.all():
        remark(f"{int((~keep).sum())} of {len(t_ns)} IMU samples repeat or go back in time: dropped")
    t = t_ns[keep] - round(shift_s * 1e9)
    return ImuLog(t_ns=t, gyro_radps=gyro_acc[keep, :3], acc_mps2=gyro_acc[keep, 3:], noise=noise)
