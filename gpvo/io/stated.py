"""A file of stated motions: an odometry's poses, and the covariance that it states of each motion. Plain text.

A header, then a line per frame: the eight TUM columns, and the 21 upper-right elements, row by row, of the covariance
of the motion from the frame before, in the axes of this frame. A 30th column, if there is one, is the stamp of another
frame that the motion starts from. The first frame and lost motions have ``nan`` in place of the covariance.
Tangent: translation then rotation, right perturbation, m and rad.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gpvo.errors import SourceError
from gpvo.files import write_text
from gpvo.geometry import se3
from gpvo.geometry.covariance import from_upper, is_positive_definite, upper
from gpvo.io.stamps import ns_to_seconds_text, seconds_text_to_ns, text_lines
from gpvo.io.trajectory import Trajectory, read_tum_with, tum_line
from gpvo.types import IMPORTED, Array, Status, VoLog, VoRecord

HEADER = "# gpvo-stated 1"
_LINES = (
    HEADER,
    "# poses T_world_cam, then the covariance of the motion from the frame before: 21 numbers, upper right, by rows",
    "# tangent: translation, rotation [m, rad]; right perturbation, axes of this frame; lost motions: nan",
    "# t tx ty tz qx qy qz qw c00 c01 c02 c03 c04 c05 c11 ... c55 t_from",
)


def write_stated(path: Path, log: VoLog, T_world_cam: Array, covariance: Array) -> None:
    """Poses (N, 4, 4) of a log's frames and covariances (N, 6, 6) of its motions, NaN where unknown; whole or not at
    all."""
    lines = (
        f"{tum_line(r.t_ns, T)} {' '.join(f'{c:.9g}' for c in upper(C))} {ns_to_seconds_text(r.t_prev_ns)}"
        for r, T, C in zip(log, T_world_cam, covariance, strict=True)
    )
    write_text(path, "\n".join([*_LINES, *lines]) + "\n", "ascii")


def read_stated(path: Path) -> VoLog:
    """The file's motions as records, their covariance under ``imported``; those without one are ``lost``.

    Raises SourceError, naming file and line: another format, a wrong number of columns, a covariance that is not
    positive definite.
    """
    lines = (text for _, text in text_lines(path))
    if not next(lines, "").startswith(HEADER):
        raise SourceError("holds no stated motions", where=path, cure=f"its first line must be '{HEADER}'")
    columns = next((len(line.split()) for line in lines if not line.startswith("#")), 0)
    behind = 22 if columns == 30 else 21
    trajectory, rest = read_tum_with(path, behind)
    t_ns = trajectory.t_ns
    index = {int(t): k for k, t in enumerate(t_ns)}
    records = [VoRecord(int(t_ns[0]), int(t_ns[0]), Status.START, np.eye(4))]
    for k in range(1, len(t_ns)):
        start = k - 1 if behind == 21 else index.get(_stamp(path, rest[k][21]), k)
        if start >= k:
            raise SourceError(f"the motion that ends at {rest[k][21]} s starts from no frame before", where=path)
        records.append(_record(path, trajectory, start, k, rest[k][:21]))
    return VoLog(records)


def _stamp(path: Path, text: str) -> int:
    try:
        return seconds_text_to_ns(text)
    except ValueError as error:
        raise SourceError(str(error), where=path) from None


def _record(path: Path, trajectory: Trajectory, start: int, end: int, elements: Sequence[str]) -> VoRecord:
    T, t_ns = trajectory.T_world_body, trajectory.t_ns
    try:
        C = from_upper(np.array([float(c) for c in elements]), 6)
    except ValueError:
        raise SourceError(f"the covariance at {t_ns[end] * 1e-9:.9f} s holds no numbers", where=path) from None
    lost = bool(np.isnan(C).all())
    if not lost and not is_positive_definite(C):
        raise SourceError(f"the covariance at {t_ns[end] * 1e-9:.9f} s is not positive definite", where=path)
    return VoRecord(
        t_ns=int(t_ns[end]),
        t_prev_ns=int(t_ns[start]),
        status=Status.LOST if lost else Status.OK,
        T_prev_cur=se3.inverse(T[start]) @ T[end],
        covariances={} if lost else {IMPORTED: C},
    )
