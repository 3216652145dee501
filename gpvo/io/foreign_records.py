"""Records of relative motions from the poses of another odometry; are its covariances of poses or of motions?."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.geometry import covariance as transport
from gpvo.geometry import se3
from gpvo.io.foreign import ForeignLog
from gpvo.types import COUNT_FIELDS, IMPORTED, IMPORTED_POSE, Array, Status, VoRecord

GAP_STEPS = 10  # Logs of keyframes are irregular, but not by so much.
UNKNOWN_RAD = 1.0
_LEAST_MOTIONS, _SLOW, _TIMES_SEEN = 50, 0.02, 3.0  # what covariances of poses are told by


def to_records(log: ForeignLog) -> tuple[list[VoRecord], list[str]]:
    """Records of the motions between the rows of a log of the camera, and remarks for the user.

    A covariance of motions becomes the method ``imported``. One of poses becomes the growth from row to row, if that
    is positive definite for nearly all rows, as for an odometry that adds up its errors; a filter's is not, and stays
    as it is under the name ``imported_pose``, which is of the pose, not of one motion. Across a gap in the log the
    odometry was lost, whatever it says when it is there again; and of a motion whose turn it does not know to a radian
    about any axis it knows nothing (as RTAB-Map says by a variance of 9999: introlab/rtabmap_ros, issue 80).
    """
    T = log.trajectory.T_world_body
    motions = se3.inverse(T[:-1]) @ T[1:]
    name, cov, notes = _motion_covariances(log, motions)
    t = log.t_ns
    gaps = _after_gaps(t)
    unknown = _stated_unknown(cov) - {0, *gaps} if cov is not None and name == IMPORTED else set()
    lost = {**dict.fromkeys(gaps, "gap in the log"), **dict.fromkeys(unknown, "stated as unknown")}
    if gaps:
        notes = [*notes, f"motions that count as lost, over gaps of more than {GAP_STEPS} usual steps: {len(gaps)}"]
    if unknown:
        notes = [*notes, f"motions that count as lost, as their covariance says that they are unknown: {len(unknown)}"]
    records = [VoRecord(int(t[0]), int(t[0]), Status.START, np.eye(4), **_fields(log, 0))]
    for k, motion in enumerate(motions, 1):
        stated: dict[str, Any] = {}
        if cov is not None and transport.is_positive_definite(cov[k]):
            stated = {"covariances": {name: cov[k]}, "v_t": {}}
        status = Status.LOST if k in lost else Status.OK
        record = VoRecord(int(t[k]), int(t[k - 1]), status, motion, reason=lost.get(k, ""), **stated, **_fields(log, k))
        records.append(record)
    return records, [*log.notes, *notes]


def _stated_unknown(covariance: Array) -> set[int]:
    """Rows whose rotation is stated as unknown about every axis; an odometry in the plane knows its heading."""
    variances = np.diagonal(covariance, axis1=1, axis2=2)[:, 3:]
    return set(np.flatnonzero((variances > UNKNOWN_RAD**2).all(axis=1)).tolist())


def _after_gaps(t_ns: NDArray[np.int64]) -> set[int]:
    """Rows that follow an interval far beyond the usual one."""
    steps = np.diff(t_ns)
    return set() if len(steps) == 0 else set((np.flatnonzero(steps > GAP_STEPS * np.median(steps)) + 1).tolist())


def _fields(log: ForeignLog, k: int) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for name, values in log.columns.items():
        if np.isfinite(values[k]):
            out[name] = int(values[k]) if name in COUNT_FIELDS else float(values[k])
    return out


def _motion_covariances(log: ForeignLog, motions: Array) -> tuple[str, Array | None, list[str]]:
    """Name and (N, 6, 6) covariances by row, None where the log has none."""
    if log.covariance is None:
        return "", None, []
    C = transport.symmetrise(log.covariance)
    if log.covariance_of == "motion":
        return IMPORTED, C, _if_of_poses(C[1:], motions)
    A = se3.adjoint(se3.inverse(motions))
    growth = np.full_like(C, np.nan)
    growth[1:] = transport.symmetrise(C[1:] - A @ C[:-1] @ np.swapaxes(A, -1, -2))
    share = float(np.mean([transport.is_positive_definite(g) for g in growth[1:]])) if len(motions) else 0.0
    if share >= 0.95:
        return IMPORTED, growth, []
    note = (
        f"the covariances are of poses and grow in {100 * share:.0f} % of the steps only, as a filter's do: kept as"
        " 'imported_pose' and scored as such by gpvo evaluate"
    )
    return IMPORTED_POSE, C, [note]


def _if_of_poses(C: Array, motions: Array) -> list[str]:
    """A remark where covariances (N, 6, 6) that are said to be of motions (N, 4, 4) look like those of poses: they
    change slowly, and state many times the noise that shows in the motions.

    The second difference of a velocity has six times its white noise, and the vehicle's own jerk besides.
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
