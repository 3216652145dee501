"""Columns of the run folder's tables: records, truth, IMU and predictions as flat tables and back.

Units stand in the names. A pose is ``p_x_m p_y_m p_z_m`` and ``R_00`` ... ``R_22`` (exact); ``q_x q_y q_z q_w`` repeats
the rotation for people. A 6x6 covariance is its upper triangle, row by row, ``cov_<method>_<i><j>`` with i, j in 0..5
for x, y, z [m] and the rotations about x, y, z [rad]; ``vt_<method>_<i><j>`` is the 3x3 of the translation [m^2];
``stage_<name>_ms`` are times. A null means that the producer did not know.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.geometry import se3
from gpvo.geometry.covariance import scaled_root
from gpvo.types import (
    COUNT_FIELDS,
    FLOAT_FIELDS,
    IMU_FIELDS,
    Array,
    ImuLog,
    Prediction,
    Status,
    StereoTracks,
    TruthLog,
    VoRecord,
)

Columns = dict[str, list[Any]]

_AXES = ("x", "y", "z")
_POSITION = tuple(f"p_{a}_m" for a in _AXES)
_QUATERNION = ("q_x", "q_y", "q_z", "q_w")
_ROTATION = tuple(f"R_{i}{j}" for i in range(3) for j in range(3))
_TWIST = tuple(f"v_{a}_mps" for a in _AXES) + tuple(f"w_{a}_radps" for a in _AXES)
_IMU = {name: "{}_{{}}_{}".format(*name.rsplit("_", 1)) for name in IMU_FIELDS}
_UPPER6 = tuple((i, j) for i in range(6) for j in range(i, 6))
_ALL6 = tuple((i, j) for i in range(6) for j in range(6))
_UPPER3 = tuple((i, j) for i in range(3) for j in range(i, 3))
_METHOD = re.compile(r"(cov|vt)_([A-Za-z][A-Za-z0-9_]*)_00")
_VELOCITY, _GYRO, _ACC = (tuple(p.format(a) for a in _AXES) for p in ("v_{}_mps", "gyro_{}_radps", "acc_{}_mps2"))
_SIGMA6 = tuple(f"{a}_m" for a in _AXES) + tuple(f"r{a}_rad" for a in _AXES)
_SHORT6 = tuple(a.rsplit("_", 1)[0] for a in _SIGMA6)


def pose_columns(T: Array) -> dict[str, NDArray[np.float64]]:
    """(N, 4, 4) poses as columns of length N."""
    T = np.asarray(T, dtype=np.float64).reshape(-1, 4, 4)
    q = se3.rotation_to_quaternion_xyzw(T[:, :3, :3])
    out = {name: T[:, i, 3] for i, name in enumerate(_POSITION)}
    out.update({name: q[:, i] for i, name in enumerate(_QUATERNION)})
    out.update({name: T[:, i // 3, i % 3] for i, name in enumerate(_ROTATION)})
    return out


def poses_from(columns: Mapping[str, NDArray[Any]]) -> Array:
    """(N, 4, 4) poses of :func:`pose_columns`."""
    return se3.from_rt(_stacked(columns, _ROTATION).reshape(-1, 3, 3), _stacked(columns, _POSITION))


_TRACK_COLUMNS = ("t_ns", "track", "u_px", "v_px", "d_px", "is_inlier")


def track_columns(tables: Sequence[StereoTracks]) -> dict[str, NDArray[Any]]:
    """Tables of observations as columns of one."""
    joined = StereoTracks.join(tables)
    columns = (joined.t_ns, joined.track, *joined.uvd.T, joined.is_inlier)
    return dict(zip(_TRACK_COLUMNS, columns, strict=True))


def tracks_from(columns: Mapping[str, NDArray[Any]]) -> StereoTracks:
    """Observations of :func:`track_columns`; a pixel that is not finite is refused."""
    t_ns, track, u, v, d, is_inlier = (columns[name] for name in _TRACK_COLUMNS)
    uvd = np.stack([u, v, d], axis=1).astype(np.float64)
    if not np.isfinite(uvd).all():
        raise ValueError("a pixel is not finite")
    return StereoTracks(np.asarray(t_ns, np.int64), np.asarray(track, np.int64), uvd, np.asarray(is_inlier, bool))


def record_columns(records: Sequence[VoRecord]) -> Columns:
    """Records as columns; methods and stages are the union over the records."""
    out: Columns = {
        "t_ns": [r.t_ns for r in records],
        "t_prev_ns": [r.t_prev_ns for r in records],
        "dt_s": [r.dt_s for r in records],
        "status": [r.status.value for r in records],
        "reason": [r.reason for r in records],
        "is_reference": [r.is_reference for r in records],
    }
    T = np.array([r.T_prev_cur for r in records], dtype=np.float64).reshape(-1, 4, 4)
    out.update({k: list(v) for k, v in pose_columns(T).items()})
    dt = np.array([r.dt_s for r in records])
    twist = se3.log(T) / np.where(dt > 0, dt, np.nan)[:, None]
    out.update({name: _nulls(twist[:, i]) for i, name in enumerate(_TWIST)})
    for name in COUNT_FIELDS:
        out[name] = [v if v >= 0 else None for v in (getattr(r, name) for r in records)]
    out["inlier_ratio"] = _nulls([r.inlier_ratio for r in records])
    for name in FLOAT_FIELDS:
        out[name] = _nulls([getattr(r, name) for r in records])
    for name, pattern in _IMU.items():
        vectors = [getattr(r, name) for r in records]
        for i, axis in enumerate(_AXES):
            out[pattern.format(axis)] = [None if v is None else float(v[i]) for v in vectors]
    _put_matrices(out, "cov", [r.covariances for r in records], _UPPER6)
    _put_matrices(out, "vt", [r.v_t for r in records], _UPPER3)
    for stage in _union(r.stage_ms for r in records):
        out[f"stage_{stage}_ms"] = [r.stage_ms.get(stage) for r in records]
    return out


def records_from(columns: Mapping[str, NDArray[Any]]) -> list[VoRecord]:
    """Records of :func:`record_columns`; nulls come as NaN in float columns.

    Raises KeyError or ValueError where a column is absent or a status unknown.
    """
    T = poses_from(columns)
    n = len(T)
    counts = {c: np.where(np.isnan(f := _float(columns, c, n)), -1, f).astype(np.int64) for c in COUNT_FIELDS}
    floats = {c: _float(columns, c, n) for c in FLOAT_FIELDS}
    imu = {c: np.stack([_float(columns, p.format(a), n) for a in _AXES], 1) for c, p in _IMU.items()}
    imu_known = {c: p.format("x") in columns for c, p in _IMU.items()}
    cov, v_t = _get_matrices(columns, "cov", _UPPER6, 6), _get_matrices(columns, "vt", _UPPER3, 3)
    stages = {c[6:-3]: _float(columns, c, n) for c in columns if c.startswith("stage_") and c.endswith("_ms")}

    def known(k: int) -> dict[str, Any]:
        out: dict[str, Any] = {c: int(v[k]) for c, v in counts.items()}
        out.update({c: float(v[k]) for c, v in floats.items()})
        out.update({c: v[k] if imu_known[c] and not np.isnan(v[k]).all() else None for c, v in imu.items()})
        return out

    return [
        VoRecord(
            t_ns=int(columns["t_ns"][k]),
            t_prev_ns=int(columns["t_prev_ns"][k]),
            status=Status(columns["status"][k]),
            T_prev_cur=T[k],
            is_reference=bool(columns["is_reference"][k]),
            reason=str(columns["reason"][k] or ""),
            **known(k),
            covariances={m: C[k] for m, C in cov.items() if not np.isnan(C[k]).all()},
            v_t={m: C[k] for m, C in v_t.items() if not np.isnan(C[k]).all()},
            stage_ms={s: float(v[k]) for s, v in stages.items() if not np.isnan(v[k])},
        )
        for k in range(n)
    ]


def prediction_columns(predictions: Sequence[Prediction]) -> Columns:
    """Predictions as columns: ``mean_*``, ``cov_total_<i><j>``, ``cov_<part>_<i><j>``, ``bias_tau_*_s``, ...

    ``cov_bias`` is all that persists. Of models with errors of calibration, ``root_calibration_<i><j>`` and
    ``calibration_tau_*_s`` besides; ``nu`` where the tails are heavier than a Gaussian's.
    """
    out: Columns = {
        "t_ns": [p.t_ns for p in predictions],
        "dt_s": [float(p.dt_s) for p in predictions],
        "status": [p.status.value for p in predictions],
        "confidence": [float(p.confidence) for p in predictions],
        "in_domain": [float(p.in_domain) for p in predictions],
    }
    if any(math.isfinite(p.nu) for p in predictions):
        out["nu"] = [p.nu for p in predictions]
    tau = [p.persistent_tau_s for p in predictions]
    for i, axis in enumerate(_SIGMA6):
        out[f"mean_{axis}"] = [float(p.mean[i]) for p in predictions]
    for i, axis in enumerate(_SHORT6):
        out[f"epistemic_var_{axis}"] = [float(p.epistemic[i]) for p in predictions]
        out[f"bias_tau_{axis}_s"] = [float(t[i]) if len(t) else 1.0 for t in tau]
    parts = ({"total": p.covariance, "jitter": p.jitter, "white": p.white, "bias": p.persistent} for p in predictions)
    _put_matrices(out, "cov", list(parts), _UPPER6)
    if any((t[6:] != 1.0).any() for t in tau):
        _put_matrices(out, "root", [{"calibration": _wide(p.persistent_root)[:, 6:]} for p in predictions], _ALL6)
        for i, axis in enumerate(_SHORT6):
            out[f"calibration_tau_{axis}_s"] = [float(t[6 + i]) if len(t) > 6 else 1.0 for t in tau]
    return out


def predictions_from(columns: Mapping[str, NDArray[Any]]) -> list[Prediction]:
    """Predictions of :func:`prediction_columns`.

    A bias without a time constant counts as white. The root of what persists is that of its covariance, to rounding.
    Raises KeyError or ValueError where a column is absent or a status unknown.
    """
    n = len(columns["t_ns"])
    mean = _stacked(columns, (f"mean_{a}" for a in _SIGMA6))
    epistemic = _stacked(columns, (f"epistemic_var_{a}" for a in _SHORT6))
    tau, root = np.ones((n, 12)), np.zeros((n, 6, 12))
    tau[:, :6] = _stacked(columns, (f"bias_tau_{a}_s" for a in _SHORT6))
    if "root_calibration_00" in columns:
        root[:, :, 6:] = _stacked(columns, (f"root_calibration_{i}{j}" for i, j in _ALL6)).reshape(n, 6, 6)
        tau[:, 6:] = _stacked(columns, (f"calibration_tau_{a}_s" for a in _SHORT6))
    cov = _get_matrices(columns, "cov", _UPPER6, 6)
    jitter, bias = (cov.get(part, np.zeros((n, 6, 6))) for part in ("jitter", "bias"))
    white = cov["white"] if "white" in cov else cov["total"] - jitter - bias
    finite = np.isfinite(np.concatenate([bias, root], axis=2)).all(axis=(1, 2))
    usable = np.asarray((tau > 0).all(axis=1) & finite)
    white = np.where(usable[:, None, None], white, white + bias)
    root[~usable], tau[~usable] = 0.0, 1.0
    persistent = np.where(usable[:, None, None], bias, 0.0) - root @ np.swapaxes(root, -1, -2)
    root[:, :, :6] = scaled_root(persistent)
    return [
        Prediction(
            mean=mean[k],
            jitter=jitter[k],
            white=white[k],
            persistent_root=root[k],
            persistent_tau_s=tau[k],
            dt_s=float(columns["dt_s"][k]),
            status=Status(columns["status"][k]),
            t_ns=int(columns["t_ns"][k]),
            epistemic=epistemic[k],
            confidence=float(columns["confidence"][k]),
            in_domain=float(columns["in_domain"][k]),
            nu=float(columns["nu"][k]) if "nu" in columns else math.inf,
        )
        for k in range(n)
    ]


def _wide(root: Array) -> Array:
    """A root (6, P) with columns of zeros up to 12."""
    return np.pad(root, ((0, 0), (0, 12 - root.shape[-1])))


def truth_columns(truth: TruthLog) -> dict[str, NDArray[Any]]:
    """Truth as columns."""
    out = {"t_ns": truth.t_ns, **pose_columns(truth.T_world_cam)}
    if truth.v_world_mps is not None:
        out |= dict(zip(_VELOCITY, truth.v_world_mps.T))
    return out


def velocity_from(columns: Mapping[str, NDArray[Any]]) -> Array | None:
    """Velocities of :func:`truth_columns`, None where there are none."""
    return _stacked(columns, _VELOCITY) if columns.keys() >= set(_VELOCITY) else None


def imu_columns(imu: ImuLog) -> dict[str, NDArray[Any]]:
    """IMU samples as columns."""
    return {"t_ns": imu.t_ns, **dict(zip(_GYRO, imu.gyro_radps.T)), **dict(zip(_ACC, imu.acc_mps2.T))}


def imu_from(columns: Mapping[str, NDArray[Any]]) -> ImuLog:
    """IMU samples of :func:`imu_columns`, without their noise."""
    t_ns = np.asarray(columns["t_ns"], dtype=np.int64)
    return ImuLog(t_ns=t_ns, gyro_radps=_stacked(columns, _GYRO), acc_mps2=_stacked(columns, _ACC))


def _stacked(columns: Mapping[str, NDArray[Any]], names: Iterable[str]) -> Array:
    """(n, len(names)) some of the columns."""
    return np.stack([columns[name] for name in names], axis=-1)


def _nulls(values: Iterable[float]) -> list[float | None]:
    """NaN becomes null."""
    return [None if np.isnan(v) else float(v) for v in values]


def _union(maps: Iterable[Mapping[str, Any]]) -> list[str]:
    seen: dict[str, None] = {}
    for m in maps:
        seen.update(dict.fromkeys(m))
    return list(seen)


def _put_matrices(
    out: Columns, prefix: str, maps: Sequence[Mapping[str, Array]], upper: tuple[tuple[int, int], ...]
) -> None:
    for method in _union(maps):
        for i, j in upper:
            out[f"{prefix}_{method}_{i}{j}"] = [float(m[method][i, j]) if method in m else None for m in maps]


def _get_matrices(
    columns: Mapping[str, NDArray[Any]], prefix: str, upper: tuple[tuple[int, int], ...], size: int
) -> dict[str, Array]:
    out = {}
    for name in columns:
        match = _METHOD.fullmatch(name)
        if match is None or match[1] != prefix:
            continue
        method = match[2]
        C = np.empty((len(columns[name]), size, size))
        for i, j in upper:
            C[:, i, j] = C[:, j, i] = columns[f"{prefix}_{method}_{i}{j}"]
        out[method] = C
    return out


def _float(columns: Mapping[str, NDArray[Any]], name: str, n: int) -> Array:
    """A column as float64; NaN throughout where it is absent."""
    return np.asarray(columns[name], dtype=np.float64) if name in columns else np.full(n, np.nan)
