"""What odometry says about motions: records, and logs of them."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.types.columns import Columns, batches
from gpvo.types.sensors import VEHICLES, Array, ImuLog, StereoCamera, Vehicle

_NUMBER = r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?"
_KINDS: dict[str, Any] = {"int": np.int64, "bool": bool, "Status": object, "str": object}

CALIBRATION = "calibration"
"""Cause of what the errors of all motions share: what is not known of the cameras' calibration."""

IMPORTED = "imported"
"""Name of the covariances that somebody else's odometry states of its own motions."""

IMPORTED_POSE = "imported_pose"
"""The same of its poses, where they do not grow as those of an odometry do: a filter's."""


class Status(str, Enum):
    """How far a motion can be trusted. ``start`` marks the first frame, which has no motion yet."""

    START = "start"
    OK = "ok"
    DEGRADED = "degraded"
    LOST = "lost"

    @property
    def severity(self) -> int:
        """0 for ``start`` and ``ok``, 1 for ``degraded``, 2 for ``lost``: the worse of two is the larger."""
        return {"start": 0, "ok": 0, "degraded": 1, "lost": 2}[self.value]


@dataclass(frozen=True)
class VoRecord:
    """What stereo VO knows about one motion, from the frame at ``t_prev_ns`` to the frame at ``t_ns``.

    ``T_prev_cur`` maps points of the current camera to the reference camera. The reference is normally the
    frame before; after a lost frame, or while the vehicle stands still, it may be an older one, so poses
    compound as ``T_world_cam(t_ns) = T_world_cam(t_prev_ns) T_prev_cur``. ``is_reference`` says whether this
    frame is the reference of the next motion.

    Counts are -1 and floats NaN where the producer does not know them. ``covariances`` (6, 6) and ``v_t``
    (3, 3, the thesis' translation-only ``V_T`` [m^2]) are keyed by method, empty where unknown. Covariances are
    of ``T_prev_cur`` as it stands. ``shared`` (6, 6), by cause, are the parts of each of them that all motions have in
    common (``calibration``: what is not known of it). ``imu_*`` are means and standard deviations over the interval
    in IMU axes, None without an IMU.
    """

    t_ns: int
    t_prev_ns: int
    status: Status
    T_prev_cur: Array
    is_reference: bool = True
    reason: str = ""
    n_detected: int = -1
    n_stereo: int = -1
    n_tracked: int = -1
    n_inliers: int = -1
    reproj_rms_px: float = np.nan
    residual_sigma_p_px: float = np.nan  # pointing and matching noise that this motion's residuals show
    residual_sigma_m_px: float = np.nan
    disparity_p10_px: float = np.nan
    disparity_p50_px: float = np.nan
    disparity_p90_px: float = np.nan
    spread_u: float = np.nan  # standard deviation of the inliers' normalised image coordinate (u - cx) / fx
    spread_v: float = np.nan
    log10_condition: float = np.nan  # of the information matrix, lengths scaled by the median depth
    brightness: float = np.nan  # mean grey value, 0..1
    contrast: float = np.nan  # standard deviation of the grey value, 0..1
    sharpness: float = np.nan  # log10 of the variance of the Laplacian, grey values 0..255
    noise_level: float = np.nan  # estimated standard deviation of the image noise, 0..1
    imu_gyro_mean_radps: Array | None = None
    imu_gyro_std_radps: Array | None = None
    imu_acc_mean_mps2: Array | None = None
    imu_acc_std_mps2: Array | None = None
    covariances: Mapping[str, Array] = field(default_factory=dict)
    v_t: Mapping[str, Array] = field(default_factory=dict)
    shared: Mapping[str, Array] = field(default_factory=dict)
    stage_ms: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if type(self.status) is not Status:  # a text is equal to one, but not the same
            object.__setattr__(self, "status", Status(self.status))

    @property
    def dt_s(self) -> float:
        """Duration of the motion [s]; 0 for the first frame."""
        return (self.t_ns - self.t_prev_ns) * 1e-9

    @property
    def inlier_ratio(self) -> float:
        """Inliers over tracked points; NaN where either is unknown or nothing was tracked."""
        return self.n_inliers / self.n_tracked if self.n_tracked > 0 and self.n_inliers >= 0 else np.nan

    @property
    def usable(self) -> bool:
        """Whether there is a measured motion: status ``ok`` or ``degraded``."""
        return self.status in (Status.OK, Status.DEGRADED)

    def with_status(self, status: Status, reason: str) -> VoRecord:
        """The same record with the worse of its own and the given status, and the reason appended."""
        if status.severity <= self.status.severity:
            return self
        return replace(self, status=status, reason="; ".join(filter(None, (self.reason, reason))))


def frequent_reasons(reasons: Sequence[str]) -> list[str]:
    """The three most frequent of the reasons of motions, empty for ``ok`` ones, each with its count, where more than a
    twentieth have any; their numbers are left out."""
    count = Counter(part for reason in reasons for part in {*re.sub(_NUMBER, "N", reason).split("; ")} if part)
    is_worth = sum(map(bool, reasons)) > 0.05 * len(reasons)
    return [f"{reason} ({n})" for reason, n in count.most_common(3)] if is_worth else []


@dataclass(frozen=True, eq=False)
class StoredRecords(Columns[VoRecord]):
    """N records as columns, a fifth of what they take as objects.

    ``columns``: the fields of a record by name, (N,), (N, 4, 4) or (N, 3), an IMU's NaN throughout where there is none.
    ``covariances`` and ``shared`` (N, 21) and ``v_t`` (N, 6), upper triangles, and ``stage_ms`` (N,): NaN where a
    record has none.
    """

    columns: Mapping[str, NDArray[Any]]
    covariances: Mapping[str, Array] = field(default_factory=dict)
    v_t: Mapping[str, Array] = field(default_factory=dict)
    shared: Mapping[str, Array] = field(default_factory=dict)
    stage_ms: Mapping[str, Array] = field(default_factory=dict)

    @classmethod
    def of(cls, records: Iterable[VoRecord]) -> StoredRecords:
        """Records as they come, few of them as objects at a time; those that are stored already, as they are."""
        if isinstance(records, StoredRecords):
            return records
        return cls.join([cls._of_all(some) for some in batches(records)])

    @classmethod
    def _of_all(cls, records: list[VoRecord]) -> StoredRecords:
        def column(name: str, kind: str) -> NDArray[Any]:
            shape = {"T_prev_cur": (4, 4)} | dict.fromkeys(IMU_FIELDS, (3,))
            values = [np.full(3, np.nan) if (v := getattr(r, name)) is None else v for r in records]
            return np.array(values, _KINDS.get(kind, np.float64)).reshape(len(records), *shape.get(name, ()))

        log, (i, j), (k, m) = VoLog(records), np.triu_indices(6), np.triu_indices(3)
        stages = dict.fromkeys(stage for r in records for stage in r.stage_ms)
        return cls(
            {f.name: column(f.name, str(f.type)) for f in fields(VoRecord) if not str(f.type).startswith("Mapping")},
            {method: log.covariance(method)[:, i, j] for method in log.methods},
            {method: log.v_t(method)[:, k, m] for method in log.v_t_methods},
            {cause: log.shared(cause)[:, i, j] for cause in log.causes},
            {stage: np.array([r.stage_ms.get(stage, np.nan) for r in records]) for stage in stages},
        )

    def made(self, k: int) -> VoRecord:
        """Record k."""
        known: dict[str, Any] = {
            name: column.item(k) if column.ndim == 1 else _unless_nan(column[k])
            for name, column in self.columns.items()
        }
        for name, place in (("covariances", _PLACE_6), ("v_t", _PLACE_3), ("shared", _PLACE_6)):
            stated = getattr(self, name)
            known[name] = {m: C[k][place] for m, C in stated.items() if _unless_nan(C[k]) is not None}
        stage_ms = {s: ms for s, column in self.stage_ms.items() if (ms := column.item(k)) == ms}
        return VoRecord(**known, stage_ms=stage_ms)


def _places(n: int) -> NDArray[np.int64]:
    """(n, n) which element of an upper triangle, row by row, stands where in the symmetric matrix."""
    i, j = np.triu_indices(n)
    out = np.zeros((n, n), dtype=np.int64)
    out[i, j] = out[j, i] = np.arange(len(i))
    return out


_PLACE_3, _PLACE_6 = _places(3), _places(6)


def _unless_nan(v: Array) -> Array | None:
    """Itself; None where it is NaN throughout."""
    return None if math.isnan(v.item(0)) and np.isnan(v).all() else v


@dataclass(frozen=True)
class VoLog:
    """All records of a run, in time order, with the camera that made them (None for imported poses), and what carried
    it."""

    records: Sequence[VoRecord]
    camera: StereoCamera | None = None
    vehicle: Vehicle = VEHICLES["any"]

    def __len__(self) -> int:
        return len(self.records)

    def __iter__(self) -> Iterator[VoRecord]:
        return iter(self.records)

    def _each(self, name: str) -> NDArray[Any] | list[Any]:
        if isinstance(self.records, StoredRecords):
            return self.records.columns[name]
        return [getattr(r, name) for r in self.records]

    def column(self, name: str) -> NDArray[Any]:
        """One scalar attribute of every record (``"t_ns"``, ``"dt_s"``, ``"n_inliers"``, ...) as an array (N,)."""
        if name == "dt_s":
            return np.asarray((self.t_ns - self.column("t_prev_ns")) * 1e-9)
        return np.array(self._each(name) if name in _FIELDS else [getattr(r, name) for r in self.records])

    @property
    def t_ns(self) -> NDArray[np.int64]:
        """(N,) stamps of the frames."""
        return np.array(self._each("t_ns"), dtype=np.int64)

    @property
    def T_prev_cur(self) -> Array:
        """(N, 4, 4) motions; identity for the first frame."""
        return np.array(self._each("T_prev_cur"), dtype=np.float64).reshape(-1, 4, 4)

    @property
    def statuses(self) -> list[Status]:
        """(N,) those of the records."""
        return list(self._each("status"))

    @property
    def usable(self) -> NDArray[np.bool_]:
        """(N,) whether each record holds a measured motion."""
        return np.array([s in (Status.OK, Status.DEGRADED) for s in self.statuses], dtype=bool)

    @property
    def lost(self) -> NDArray[np.bool_]:
        """(N,) whether each record is lost."""
        return np.array([s is Status.LOST for s in self.statuses], dtype=bool)

    @property
    def parent(self) -> NDArray[np.int64]:
        """(N,) index of the frame each motion starts from; -1 for the first."""
        stamps = self.t_ns.tolist()
        index = {t: k for k, t in enumerate(stamps)}
        pairs = zip(self.column("t_prev_ns").tolist(), stamps)
        return np.array([-1 if before == t else index[before] for before, t in pairs], dtype=np.int64)

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the geometric covariance methods present, in first-seen order."""
        return self._names("covariances")

    @property
    def v_t_methods(self) -> tuple[str, ...]:
        """The same of ``V_T``."""
        return self._names("v_t")

    @property
    def causes(self) -> tuple[str, ...]:
        """The same of the errors that motions share."""
        return self._names("shared")

    def _names(self, of: str) -> tuple[str, ...]:
        if isinstance(self.records, StoredRecords):
            known = {m: ~np.isnan(C).all(axis=1) for m, C in getattr(self.records, of).items()}
            return tuple(sorted((m for m in known if known[m].any()), key=lambda m: int(known[m].argmax())))
        return tuple(dict.fromkeys(method for record in self.records for method in getattr(record, of)))

    def covariance(self, method: str) -> Array:
        """(N, 6, 6) of one method; NaN where a record has none."""
        return self._matrices("covariances", method, _PLACE_6)

    def v_t(self, method: str) -> Array:
        """(N, 3, 3) ``V_T`` by one method [m^2], in axes of the reference camera; NaN where a record has none."""
        return self._matrices("v_t", method, _PLACE_3)

    def shared(self, cause: str) -> Array:
        """(N, 6, 6) part of every covariance that motions have in common by one cause; NaN where a record has none."""
        return self._matrices("shared", cause, _PLACE_6)

    @property
    def shared_by_all(self) -> Array:
        """(N, 6, 6) the same by all causes together; zero where a record has none."""
        total = np.zeros((len(self), 6, 6))
        for cause in self.causes:
            part = self.shared(cause)
            total += np.where(np.isnan(part).all(axis=(1, 2), keepdims=True), 0.0, part)
        return total

    def _matrices(self, of: str, method: str, place: NDArray[np.int64]) -> Array:
        """(N, n, n) of one method; ``place`` (n, n) of their elements in an upper triangle."""
        if isinstance(self.records, StoredRecords):
            missing = np.full((len(self), place.max() + 1), np.nan)
            return np.asarray(getattr(self.records, of).get(method, missing)[:, place])
        missing = np.full(place.shape, np.nan)
        return np.array([getattr(r, of).get(method, missing) for r in self.records]).reshape(-1, *place.shape)

    def judged_as(self, records: Iterable[VoRecord]) -> VoLog:
        """The log with the statuses and reasons of ``records``, which are otherwise its own, in their order."""
        if not isinstance(self.records, StoredRecords):
            return replace(self, records=list(records))
        said = np.array([(r.status, r.reason) for r in records], dtype=object).reshape(-1, 2)
        columns = {**self.records.columns, "status": said[:, 0], "reason": said[:, 1]}
        return replace(self, records=replace(self.records, columns=columns))

    def rows(self, keep: NDArray[np.bool_] | slice) -> VoLog:
        """A part of the records: those marked (N,), or a stretch."""
        if not isinstance(self.records, StoredRecords):
            return replace(self, records=[self.records[k] for k in np.arange(len(self))[keep].tolist()])
        maps = (getattr(self.records, f.name) for f in fields(StoredRecords))
        return replace(self, records=StoredRecords(*({name: c[keep] for name, c in m.items()} for m in maps)))

    def trajectory(self, T_prev_cur: Array | None = None) -> Array:
        """(N, 4, 4) ``T_first_cam``: the motions compounded, never corrected by a model; or others (N, 4, 4) in their
        place."""
        T, parent = self.T_prev_cur if T_prev_cur is None else T_prev_cur, self.parent
        out = np.empty_like(T)
        for k in range(len(T)):
            out[k] = T[k] if parent[k] < 0 else out[parent[k]] @ T[k]
        return out


@dataclass(frozen=True)
class ImuMoments:
    """Mean and spread of the IMU over a motion; pieces of time are merged without keeping samples.

    ``n`` samples, their mean and variance (6,): gyro [rad/s], then accelerometer [m/s^2], in IMU axes.
    """

    n: int
    mean: Array
    variance: Array

    @classmethod
    def of(cls, imu: ImuLog | None) -> ImuMoments:
        """Of a piece of a log, which may be missing or empty."""
        if imu is None or len(imu.t_ns) == 0:
            return cls(0, np.zeros(6), np.zeros(6))
        samples = np.hstack([imu.gyro_radps, imu.acc_mps2])
        return cls(len(samples), samples.mean(0), samples.var(0))

    @classmethod
    def of_record(cls, record: VoRecord) -> ImuMoments:
        """What a record says of the IMU over its motion, as one sample with that spread; NaN where it knows none."""
        known = [np.full(3, np.nan) if (v := getattr(record, name)) is None else v for name in IMU_FIELDS]
        return cls(1, np.concatenate(known[::2]), np.concatenate(known[1::2]) ** 2)

    def with_later(self, other: ImuMoments) -> ImuMoments:
        """Of both pieces together (T. Chan, G. Golub, R. LeVeque, "Algorithms for computing the sample variance"
        (1983)): however long a reference is kept, no sample need be."""
        if self.n == 0 or other.n == 0:
            return other if self.n == 0 else self
        n, off = self.n + other.n, other.mean - self.mean
        share = other.n / n
        variance = (1.0 - share) * self.variance + share * other.variance + share * (1.0 - share) * off**2
        return ImuMoments(n, self.mean + share * off, variance)

    def fields(self) -> dict[str, Any]:
        """Fields of a record that describe the IMU over the motion; empty without samples."""
        if self.n == 0:
            return {}
        deviation = np.sqrt(self.variance)
        return dict(zip(IMU_FIELDS, (self.mean[:3], deviation[:3], self.mean[3:], deviation[3:])))


_FIELDS = frozenset(f.name for f in fields(VoRecord))
COUNT_FIELDS = tuple(f.name for f in fields(VoRecord) if f.default == -1)
FLOAT_FIELDS = tuple(f.name for f in fields(VoRecord) if f.type == "float")
IMU_FIELDS = tuple(f.name for f in fields(VoRecord) if f.name.startswith("imu_"))
"""Fields of a record that are counts, plain numbers, and vectors (3,) of an IMU."""
