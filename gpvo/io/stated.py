"""A file of stated motions: an odometry's poses, and the covariance that it states of each motion. Plain text.

A header, then a line per frame: the eight TUM columns, and the 21 upper-right elements, row by row, of the covariance
of the motion from the frame before, in the axes of this frame. A 30th column, if there is one, is the stamp of another
frame that the motion starts from. The first frame and lost motions have ``nan`` in place of the covariance.
Tangent: translation then rotation, right perturbation, m and rad.

And the records of another odometry's poses (:func:`to_records`): are its covariances of poses or of motions?
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import SourceError
from gpvo.files import replacing
from gpvo.geometry import se3
from gpvo.geometry.covariance import (
    are_covariances,
    from_upper,
    growth,
    is_positive_definite,
    symmetrise,
    upper,
)
from gpvo.io.foreign import GROWING, NONE_STATED, ForeignLog, definite_in_plane, still_axes
from gpvo.io.stamps import ns_to_seconds_text, text_lines, text_to_ns
from gpvo.io.trajectory import Trajectory, read_tum_with, tum_line
from gpvo.types import COUNT_FIELDS, IMPORTED, IMPORTED_POSE, Array, Status, StoredRecords, VoLog, VoRecord

GAP_STEPS = 10  # Logs of keyframes are irregular, but not by so much.
UNKNOWN_RAD = 1.0
_UNUSUAL_S = 0.99  # between frames: milliseconds that count from zero, read as seconds, look like slow frames
_LEAST_MOTIONS, _SLOW, _TIMES_SEEN = 50, 0.02, 3.0  # what covariances of poses are told by
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
    stamps = zip(log.t_ns.tolist(), log.column("t_prev_ns").tolist(), T_world_cam, upper(covariance), strict=True)
    with (
        replacing(path, (HEADER.encode(), "file of stated motions")) as temporary,
        temporary.open("w", encoding="ascii", newline="\n") as file,
    ):
        file.writelines(f"{line}\n" for line in _LINES)
        for t_ns, t_prev_ns, T, C in stamps:
            stated = " ".join(f"{c:.9g}" for c in C)
            file.write(f"{tum_line(t_ns, T)} {stated} {ns_to_seconds_text(t_prev_ns)}\n")


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

    def records() -> Iterator[VoRecord]:
        yield VoRecord(int(t_ns[0]), int(t_ns[0]), Status.START, np.eye(4))
        for k in range(1, len(t_ns)):
            try:
                start = k - 1 if behind == 21 else index.get(text_to_ns(rest[k][21]), k)
            except ValueError as error:
                raise SourceError(str(error), where=path) from None
            if start >= k:
                raise SourceError(f"the motion that ends at {rest[k][21]} s starts from no earlier frame", where=path)
            yield _record(path, trajectory, start, k, rest[k][:21])

    return VoLog(StoredRecords.of(records()))


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


def to_records(log: ForeignLog) -> tuple[StoredRecords, list[str]]:
    """Records of the motions between the rows of a log of the camera, and remarks for the user.

    A covariance of motions becomes the method ``imported``. One of poses becomes the growth from row to row, if that
    is positive definite for nearly all rows, as for an odometry that adds up its errors; a filter's is not, and stays
    as it is under the name ``imported_pose``, which is of the pose, not of one motion. Across a gap in the log the
    odometry was lost, whatever it says when it is there again; and of a motion whose turn it does not know to a radian
    about any axis it knows nothing (as RTAB-Map says by a variance of 9999: introlab/rtabmap_ros, issue 80). Its pose
    is a placeholder then: the last known one holds, and the motion from there to the next known one is unknown, too.
    """
    T = log.trajectory.T_world_body
    motions = se3.inverse(T[:-1]) @ T[1:]
    name, cov, notes = _motion_covariances(log, motions)
    t, unknown = log.t_ns, set[int]()
    steps = np.diff(t)
    gaps = (np.flatnonzero(steps > GAP_STEPS * np.median(steps)) + 1).tolist() if len(steps) else []
    if cov is not None and name == IMPORTED:
        unstated = is_turn_unknown(cov) & (np.arange(len(T)) > 0)  # before the first row is no motion
        known = np.maximum.accumulate(np.where(unstated, 0, np.arange(len(T))))
        motions = se3.inverse(T[known[:-1]]) @ T[known[1:]]
        unknown = set(np.flatnonzero(unstated | np.append(False, unstated[:-1])).tolist()) - set(gaps)
    lost = {**dict.fromkeys(gaps, "gap in the log"), **dict.fromkeys(unknown, "stated as unknown")}
    if gaps:
        notes.append(f"motions that count as lost, over gaps of more than {GAP_STEPS} usual steps: {len(gaps)}")
    if unknown:
        notes.append(f"motions that count as lost, as their covariance says that they are unknown: {len(unknown)}")
    if cov is not None and (bad := int((np.isfinite(cov).all(axis=(1, 2)) & ~are_covariances(cov))[1:].sum())):
        notes.append(f"left out: {bad} of {len(motions)} covariances, not positive definite")
    if len(steps) and not log.is_counted and (usual_s := float(np.median(steps)) * 1e-9) > _UNUSUAL_S:
        notes.append(
            f"its frames are {usual_s:.3g} s apart as read: are the stamps milliseconds, or numbers of frames?"
        )

    def records() -> Iterator[VoRecord]:
        yield VoRecord(int(t[0]), int(t[0]), Status.START, np.eye(4), **_fields(log, 0))
        for k, motion in enumerate(motions, 1):
            said = _fields(log, k) | {"reason": lost.get(k, "")}
            if cov is not None and is_positive_definite(cov[k]):
                said["covariances"] = {name: cov[k]}
            yield VoRecord(int(t[k]), int(t[k - 1]), Status.LOST if k in lost else Status.OK, motion, **said)

    return StoredRecords.of(records()), [*log.notes, *notes]


def is_turn_unknown(covariance: Array) -> NDArray[np.bool_]:
    """(N,) which of (N, 6, 6) state a rotation that is unknown about every axis, those of no frame included: an
    odometry in a plane knows its heading, however its camera is tilted."""
    known = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
    turn = np.where(known[:, None, None], covariance, 0.0)[:, 3:, 3:]
    return np.asarray(np.linalg.eigvalsh(symmetrise(turn))[:, 0] > UNKNOWN_RAD**2)


def _fields(log: ForeignLog, k: int) -> dict[str, Any]:
    known = {name: values[k] for name, values in log.columns.items() if np.isfinite(values[k])}
    return {name: int(v) if name in COUNT_FIELDS else float(v) for name, v in known.items()}


def _motion_covariances(log: ForeignLog, motions: Array) -> tuple[str, Array | None, list[str]]:
    """Name and (N, 6, 6) covariances by row, None where the log has none, and remarks."""
    if log.covariance is None:
        return "", None, []
    C = symmetrise(log.covariance)
    if not are_covariances(C).any():
        return "", None, [NONE_STATED]
    if log.covariance_of == "motion":
        return IMPORTED, C, _if_of_poses(C[1:], motions)
    added = growth(C, motions)
    still = still_axes(log.trajectory.T_world_body)
    added = definite_in_plane(added, still, np.diagonal(C, axis1=1, axis2=2))
    share = float(are_covariances(added[1:]).mean()) if len(motions) else 0.0
    if share >= GROWING:
        return IMPORTED, added, []
    other = "" if log.topic else " (if they are of single motions, --covariance-of motion)"
    note = (
        f"the covariances are of poses and grow in {100 * share:.0f} % of the steps only, as a filter's do: kept as"
        f" 'imported_pose' and scored as such by gpvo evaluate{other}"
    )
    return IMPORTED_POSE, C, [note]


def _if_of_poses(C: Array, motions: Array) -> list[str]:
    """A remark where covariances (N, 6, 6) that are said to be of motions (N, 4, 4) look like those of poses: they
    change slowly, and state many times the noise in the motions, whose second differences have six times its variance.
    """
    stated = np.trace(C[:, :3, :3], axis1=1, axis2=2)
    known = np.isfinite(stated) & (stated > 0)
    if known.sum() < _LEAST_MOTIONS:
        return []
    change = np.abs(np.diff(np.log(stated[known])))
    seen = float(np.median((np.diff(motions[:, :3, 3], n=2, axis=0) ** 2).sum(axis=1))) / 6.0
    times = float(np.sqrt(np.median(stated[known]) / max(seen, 1e-18)))
    if times < _TIMES_SEEN or not 0 < np.median(change) < _SLOW:
        return []
    return [
        f"the covariances look like those of poses: they change by {100 * np.median(change):.1g} % from row to row and"
        f" state {times:.0f} times the noise that the motions show; if they are, --covariance-of pose"
    ]
