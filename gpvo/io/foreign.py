"""Other people's odometry: a trajectory, CSV or bag of another VO as records of relative motions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import compress, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import SourceError, counted, printable
from gpvo.geometry import covariance as transport
from gpvo.geometry import se3
from gpvo.geometry.covariance import variances
from gpvo.geometry.se3 import T_FLU_OPTICAL
from gpvo.io.bag_messages import covariances_of, frame_name, read_poses
from gpvo.io.bag_reader import ODOMETRY_TYPE, POSE_TYPES, is_bag, open_bag, topics_of
from gpvo.io.foreign_csv import POSITIONS_ALONE, Table, column_names, is_tum, read_table
from gpvo.io.stamps import check_interval, is_number, text_lines
from gpvo.io.trajectory import REMOVE, Trajectory, check_growing, check_unit, read_kitti_poses, read_times, read_tum
from gpvo.stats.consistency import SEEN, seen_axes
from gpvo.types import COUNT_FIELDS, FLOAT_FIELDS, Array

FORMATS = ("tum", "kitti", "csv", "bag")
COVARIANCE_AXES = ("auto", "world", "body", "mixed")
PLACES = {
    "cam": np.eye(4),
    "body": T_FLU_OPTICAL,
    "frd": se3.from_rt(se3.R_FRD_FLU, np.zeros(3)) @ T_FLU_OPTICAL,
}
"""Where the camera sits on what poses may be of."""
# What a step adds to a variance, beyond rounding: of the variance, and of the least that is seen.
_GROWS, _GROWS_SEEN = 1e-6, 1e-3
GROWING = 0.95  # share of the steps in which the covariance of poses grows, if it is that of errors that add up
_NAMED = 12  # columns in a remark
MIXED_AXES = "the rotation's covariances are read as in the body's axes, as OpenVINS has them (--covariance-axes)"
NONE_STATED = "its covariances are NaN or not positive definite and were left out"


def is_optical(frame_id: str) -> bool:
    """Whether a frame of ROS is a camera's, x right and z ahead, by its name (REP 103)."""
    return "optical" in frame_id.lower()


def moving_frame(message: Any) -> str:
    """The name of the frame whose pose a message holds; without a child frame, its one frame, mostly the world."""
    return str(getattr(message, "child_frame_id", message.header.frame_id))


@dataclass(frozen=True)
class ForeignLog:
    """Poses of another odometry, with what else it said.

    ``covariance`` (N, 6, 6) or None: NaN where unknown, house order, axes of the moving frame. ``covariance_of``:
    ``"motion"`` from the row before, ``"pose"`` since the start. ``columns``: further fields of the records, (N,).
    ``topic``: of a bag, and ``frame_id`` the name that its messages give to the frame whose poses they hold;
    ``body``: the same where it is a body's and not the world's, else ``base_link``.
    ``is_counted``: its stamps are its rows' numbers at a rate that was given, so that another log's rows must be the
    same. ``other_topics``: of a bag, those with poses that were not read.
    """

    path: Path
    trajectory: Trajectory
    covariance: Array | None = None
    covariance_of: str = "motion"
    columns: Mapping[str, Array] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    topic: str | None = None
    frame_id: str | None = None
    body: str = "base_link"
    is_counted: bool = False
    other_topics: tuple[str, ...] = ()

    @property
    def frame(self) -> str:
        """Whose poses these probably are, ``cam`` or ``body``.

        The frame of a ROS message is a FLU body's unless its name says optical (REP 103); a file says nothing, and
        most hold a camera's.
        """
        return "cam" if self.topic is None or is_optical(self.frame_id or "") else "body"

    @property
    def t_ns(self) -> NDArray[np.int64]:
        """(N,) stamps."""
        return self.trajectory.t_ns

    def shifted(self, seconds: float) -> ForeignLog:
        """The same log with its stamps moved by ``seconds``."""
        moved = Trajectory(self.t_ns + round(seconds * 1e9), self.trajectory.T_world_body)
        return replace(self, trajectory=moved)

    def rows(self, keep: NDArray[np.bool_]) -> ForeignLog:
        """The rows ``keep`` (N,). Of a motion over rows that are left out, no covariance is stated."""
        cov = self.covariance
        if cov is not None and self.covariance_of == "motion":
            cov = np.where(np.append(True, keep[:-1])[:, None, None], cov, np.nan)
        poses = Trajectory(self.t_ns[keep], self.trajectory.T_world_body[keep])
        columns = {name: values[keep] for name, values in self.columns.items()}
        return replace(self, trajectory=poses, covariance=None if cov is None else cov[keep], columns=columns)

    def seen_from(self, T_body_cam: Array) -> ForeignLog:
        """The same log for a camera that sits at ``T_body_cam`` (4, 4) on the body it describes."""
        cov = self.covariance
        if cov is not None:
            cov = transport.change_body(se3.inverse(T_body_cam), cov)
        poses = Trajectory(self.t_ns, self.trajectory.T_world_body @ T_body_cam)
        return replace(self, trajectory=poses, covariance=cov)


def guess_format(path: Path) -> str:
    """``tum``, ``kitti``, ``csv`` or ``bag`` by ending and first line.

    Raises SourceError where the path is missing or like none of them.
    """
    if not path.exists():
        raise SourceError("no such file", where=path)
    if is_bag(path):
        return "bag"
    if path.is_dir():
        raise SourceError("is a folder, not a log", where=path, cure="name the trajectory file or the bag")
    comments, data = list[str](), ""
    for _, data in islice(text_lines(path), 50):
        if not data.startswith("#"):
            break
        comments.append(data)
        data = ""
    words = data.split()
    if "," in data or ";" in data or not all(map(is_number, words)):
        return "csv"
    if (names := column_names(comments, len(words))) and not is_tum(names):
        return "csv"
    if len(words) in (8, 12):
        return "tum" if len(words) == 8 else "kitti"
    cure = "TUM has 8 numbers a line, KITTI 12, CSV a header; see --format"
    if len(words) == 4:
        cure += f"; {POSITIONS_ALONE}"
    raise SourceError("does not look like a trajectory file", where=path, cure=cure)


_READ_BY = {
    "--map": ("csv",), "--topic": ("bag",), "--covariance-of motion": ("csv",), "--covariance-axes": ("csv", "bag")
}  # fmt: skip
_MOST_COUNTED = 2**31


def read_foreign(
    path: str | Path,
    kind: str | None = None,
    *,
    mapping: Mapping[str, str] | None = None,
    topic: str | None = None,
    times: str | Path | None = None,
    rate_hz: float | None = None,
    covariance_of: str | None = None,
    covariance_axes: str = "auto",
    complete: bool = False,
) -> ForeignLog:
    """Read another odometry's log, or a ground truth.

    Raises SourceError: one line that names the file, the place and the cure.

    Parameters
    ----------
    kind : one of :data:`FORMATS`, by default guessed.
    mapping : for CSV, column -> target (:mod:`gpvo.io.foreign_csv`).
    topic : for bags, the topic of poses; by default the only one, an Odometry first.
    times, rate_hz : for KITTI poses, which have no stamps: a file with a line of seconds each, or the rate.
    covariance_of : what covariance columns of a CSV are of, ``"pose"`` (default) or ``"motion"``.
    complete : refuse rows of a CSV, or messages of a bag, without a pose, as of a ground truth; else they are counted.
    covariance_axes : of covariances: of the ``"world"``, as in ROS, the ``"body"``, or ``"mixed"``: those of the
        rotation alone the body's, as in most filters; ``"auto"``: body for those of motions, of poses mixed for columns
        of OpenVINS' names, else world.
    """
    p = Path(path)
    name = kind or guess_format(p)
    if name not in FORMATS:
        raise SourceError(f"unknown format '{name}'", cure=f"choose one of {', '.join(FORMATS)}")
    if covariance_of not in (None, "pose", "motion") or covariance_axes not in COVARIANCE_AXES:
        raise SourceError(f"covariances are of pose or motion, in axes {' or '.join(COVARIANCE_AXES)}", where=p)
    if not p.exists():
        raise SourceError("no such file", where=p)
    asked = (mapping, topic, covariance_of == "motion", covariance_axes != "auto")
    for (option, formats), is_asked in zip(_READ_BY.items(), asked, strict=True):
        if is_asked and name not in formats:
            cure = "leave it out, or name the format with --format or --truth-format"
            raise SourceError(f"{option} has no effect on this file ({name})", where=p, cure=cure)
    if name == "tum":
        return ForeignLog(p, read_tum(p))
    if name == "kitti":
        trajectory, is_counted = _read_kitti(p, times, rate_hz)
        return ForeignLog(p, trajectory, is_counted=is_counted)
    if name == "csv":
        return _from_table(p, read_table(p, mapping or {}), covariance_of or "pose", covariance_axes, complete)
    return _read_bag(p, topic, covariance_axes, complete)


def _from_table(path: Path, table: Table, covariance_of: str, axes: str, complete: bool) -> ForeignLog:
    notes = [*table.notes]
    if axes == "auto" and covariance_of == "motion":
        axes = "body"
    elif axes == "auto" and (axes := table.covariance_axes) == "mixed":
        notes.append(MIXED_AXES)
    c = table.columns
    pose = np.stack([c[n] for n in ("p_x", "p_y", "p_z", "q_x", "q_y", "q_z", "q_w")], axis=1)
    known: NDArray[np.bool_] = np.asarray(np.isfinite(pose).all(axis=1))
    if not known.any():
        raise SourceError("holds no complete pose", where=path)
    if complete and not known.all():
        line = table.lines[int(np.argmin(known))]
        raise SourceError(f"line {line} holds NaN or infinity", where=path, cure=REMOVE)
    lines = list(compress(table.lines, known))
    t, pose = table.t_ns[known], pose[known]
    check_growing(path, t, lines)
    check_unit(path, pose[:, 3:], lines)
    trajectory = Trajectory(t, se3.from_quaternion(pose[:, :3], pose[:, 3:]))
    cov = _table_covariance(c, known)
    if cov is not None:
        if covariance_of == "pose":
            notes += other_axes(trajectory.T_world_body, cov, axes)
        cov = into_body(trajectory.T_world_body, cov, axes)
        still = still_axes(trajectory.T_world_body)
        stated = np.array([f"cov_{i}{i}" in c for i in range(6)])
        planar = (stated | still).all() and stated[3:].any()  # of the position alone, it says nothing of the motion
        cov = definite_in_plane(cov, still) if planar else None
    lost = int((~known).sum())
    return ForeignLog(
        path,
        trajectory,
        cov,
        covariance_of,
        _features(path, c, known, lines),
        (*notes, *((f"left out: {counted(lost, 'row')} without a pose",) if lost else ()), *_unused(table, cov)),
    )


def _features(
    path: Path, columns: Mapping[str, Array], known: NDArray[np.bool_], lines: Sequence[int]
) -> dict[str, Array]:
    """Those of the rows with a pose, which are these ``lines``. Raises SourceError for a count that is none."""
    out = {name: columns[name][known] for name in (*COUNT_FIELDS, *FLOAT_FIELDS) if name in columns}
    for name, values in out.items():
        beyond = np.isfinite(values) & (np.abs(values) >= _MOST_COUNTED)
        if name in COUNT_FIELDS and beyond.any():
            k = int(beyond.argmax())
            raise SourceError(f"line {lines[k]}: {values[k]:g} is no count ({name})", where=path)
    return out


def _unused(table: Table, covariance: Array | None) -> tuple[str, ...]:
    """A remark on columns that state an uncertainty, or a feature, and that nothing reads."""
    notes = []
    if table.unused:
        more = f" and {len(table.unused) - _NAMED} more" if len(table.unused) > _NAMED else ""
        named = ", ".join(table.unused[:_NAMED]) + more
        notes.append(f"columns not used: {named}; --map COLUMN=NAME takes a variance (cov_00) or a count (n_inliers)")
    if covariance is None and any(c.startswith("cov_") for c in table.columns):
        absent = ", ".join(f"cov_{i}{i}" for i in range(6) if f"cov_{i}{i}" not in table.columns)
        notes.append(f"the covariance is not used: it has no {absent}; --map COLUMN=NAME names them")
    return tuple(notes)


def _table_covariance(columns: Mapping[str, Array], known: NDArray[np.bool_]) -> Array | None:
    """(N, 6, 6) of the covariance columns; what is not stated is zero, what is not finite NaN. None where none is."""
    if not any(f"cov_{i}{i}" in columns for i in range(6)):
        return None
    C = np.zeros((int(known.sum()), 6, 6))
    for i, j in np.ndindex(6, 6):
        column = columns.get(f"cov_{i}{j}", columns.get(f"cov_{j}{i}"))
        if column is not None:
            C[:, i, j] = column[known]
    return np.where(np.isfinite(C), C, np.nan)


def into_body(T_world_body: Array, covariance: Array, axes: str) -> Array:
    """Covariances (..., 6, 6) of poses (..., 4, 4) in ``axes``, of :data:`COVARIANCE_AXES`, turned into those of the
    moving frame; ``auto``: from the world's."""
    if axes == "body":
        return covariance
    of_rotation = np.eye(3) if axes == "mixed" else None
    return se3.rotate_covariance(np.swapaxes(T_world_body[..., :3, :3], -1, -2), covariance, of_rotation)


def other_axes(T_world_body: Array, covariance: Array, axes: str) -> list[str]:
    """A remark where covariances (N, 6, 6) of poses (N, 4, 4) grow from row to row, as those of errors that add up do,
    in other axes than those that they are read in."""
    motions, shares = se3.inverse(T_world_body[:-1]) @ T_world_body[1:], dict[str, float]()
    for name in COVARIANCE_AXES[1:] if len(motions) else ():
        added = transport.growth(transport.symmetrise(into_body(T_world_body, covariance, name)), motions)
        shares[name] = float(transport.are_covariances(added[1:]).mean())
    best = max(shares, key=lambda name: shares[name], default=axes)
    if shares.get(best, 0.0) < GROWING or shares[axes if axes != "auto" else "world"] >= GROWING:
        return []
    return [f"the covariances grow from row to row only if they are in other axes than read: --covariance-axes {best}"]


def still_axes(T_world_body: Array) -> NDArray[np.bool_]:
    """(6,) along and about which of the body's axes poses (N, 4, 4) never move."""
    still = np.ones(6, dtype=bool)
    still[seen_axes(se3.log(se3.inverse(T_world_body[:-1]) @ T_world_body[1:]))] = False
    return still


def definite_in_plane(covariance: Array, still: NDArray[np.bool_], variance: Array | None = None) -> Array:
    """Covariances (N, 6, 6), those that are not definite filled in on axes that are ``still`` (6,), but not all, and of
    which nothing is stated.

    A robot in a plane has three such axes; drivers state zero for them, or a constant, which does not grow. They get
    ``variance`` (N, 6), by default their own, but at least ``SEEN`` squared.
    """
    own = variances(covariance)
    variance = own if variance is None else variance
    empty = still & ~still.all() & (own <= np.maximum(_GROWS * variance, _GROWS_SEEN * SEEN**2))
    filled = np.where(empty[:, :, None] | empty[:, None], 0.0, covariance)
    filled += empty[:, None] * np.eye(6) * np.maximum(np.where(empty, variance, 1.0), SEEN**2)[:, None]
    good = np.array([transport.is_positive_definite(C) for C in transport.symmetrise(covariance)], dtype=bool)
    return np.where(good[:, None, None], covariance, filled)


def check_same_rows(truth: ForeignLog, log: ForeignLog) -> None:
    """Refuse a truth whose rows, where only their numbers are stamps, cannot be those of the log.

    Raises SourceError, naming both counts.
    """
    if truth.is_counted and log.is_counted and len(truth.t_ns) != len(log.t_ns):
        text = f"holds {counted(len(truth.t_ns), 'pose')} for the {len(log.t_ns)} of {log.path.name}"
        cure = "with --rate-hz both must have a line per frame; else give --times, or TUM files with stamps"
        raise SourceError(text, where=truth.path, cure=cure)


def _read_kitti(path: Path, times: str | Path | None, rate_hz: float | None) -> tuple[Trajectory, bool]:
    """Poses with their stamps, and whether these were counted off at the rate."""
    T = read_kitti_poses(path)
    if times is None and rate_hz is None and (path.parent / "times.txt").is_file():
        times = path.parent / "times.txt"
    if times is not None:
        t = read_times(times)
        if len(t) != len(T):
            raise SourceError(f"holds {counted(len(t), 'stamp')} for the {len(T)} poses of {path.name}", where=times)
        check_growing(Path(times), t, list(range(1, len(t) + 1)))
        check_interval(t, times, lambda _: "the file of --times holds seconds", is_stated=True)
    elif rate_hz is not None:
        if not 1e-3 <= rate_hz <= 1e5:
            cure = "give --rate-hz from 0.001 to 100000"
            raise SourceError(f"a rate of {rate_hz:g} Hz is not possible", where=path, cure=cure)
        t = np.rint(np.arange(len(T)) * (1e9 / rate_hz)).astype(np.int64)
    else:
        raise SourceError("KITTI poses have no stamps", where=path, cure="give --times FILE or --rate-hz RATE")
    return Trajectory(t, T), times is None


def _read_bag(path: Path, topic: str | None, axes: str, complete: bool) -> ForeignLog:
    with open_bag(path) as reader:
        odometry, poses = (list(topics_of(reader, kinds)) for kinds in ((ODOMETRY_TYPE,), POSE_TYPES))
    if topic is None:
        wanted = odometry or poses
        if len(wanted) != 1:
            found = ", ".join(wanted) or "none"
            raise SourceError(f"which topic? (poses on: {found})", where=path, cure="name one with --topic")
        topic = wanted[0]
    notes: list[str] = []
    t, T, read = read_poses(path, topic, notes.append, complete=complete)
    frame, child = moving_frame(read[0]), frame_name(getattr(read[0], "child_frame_id", ""))
    others = tuple(name for name in poses if name != topic)
    log = ForeignLog(path, Trajectory(t, T), topic=topic, frame_id=frame, other_topics=others)
    if child and not is_optical(child):
        log = replace(log, body=printable(child[:256]))
    stated = (covariances_of(read, name) for name in ("twist", "pose"))
    twist, pose = (None if C is None else np.where(np.isfinite(C), C, np.nan) for C in stated)
    still = still_axes(T)
    twist = None if twist is None else definite_in_plane(twist, still)
    remarks = [] if pose is None else other_axes(T, pose, axes)
    pose = None if pose is None else definite_in_plane(into_body(T, pose, axes), still)
    of_poses = pose is not None and _looks_stated(pose)
    if twist is not None and _looks_stated(twist):
        # Of the velocity in the child frame over the step that ends at the stamp.
        dt = np.concatenate([[np.nan], np.diff(t) * 1e-9])
        notes += ["the covariances of its velocities are used, those of its poses are not"] * of_poses
        return replace(log, covariance=twist * dt[:, None, None] ** 2, notes=tuple(notes))
    if of_poses:
        return replace(log, covariance=pose, covariance_of="pose", notes=(*notes, *remarks))
    return replace(log, notes=(*notes, *([] if pose is None else [NONE_STATED])))


def _looks_stated(covariance: Array) -> bool:
    """Whether most are: a dead reckoning begins without any uncertainty, and some odometries begin with zeros."""
    return bool(transport.are_covariances(transport.symmetrise(covariance)).mean() > 0.5)
