"""Columns of the run folder's tables: records, truth, IMU and predictions as flat tables and back.

Units stand in the names. A pose is ``p_x_m p_y_m p_z_m`` and ``R_00`` ... ``R_22`` (exact); ``q_x q_y q_z q_w`` repeats
the rotation for people. A 6x6 covariance is its upper triangle, row by row, ``cov_<method>_<i><j>`` with i, j in 0..5
for x, y, z [m] and the rotations about x, y, z [rad]; ``vt_<method>_<i><j>`` is the 3x3 of the translation [m^2],
``shared_<cause>_<i><j>`` the part of every ``cov`` that all motions have in common;
``stage_<name>_ms`` are times. A null means that the producer did not know.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.geometry import se3
from gpvo.geometry.covariance import from_upper, scaled_root, upper
from gpvo.types import (
    COUNT_FIELDS,
    FLOAT_FIELDS,
    IMU_FIELDS,
    Array,
    ImuLog,
    ImuNoise,
    Prediction,
    Status,
    StereoTracks,
    StoredPredictions,
    StoredRecords,
    TruthLog,
    VoLog,
    VoRecord,
    field_names,
)

SCHEMA = 1
Columns = dict[str, Any]

_AXES = ("x", "y", "z")
_POSITION = tuple(f"p_{a}_m" for a in _AXES)
_QUATERNION = ("q_x", "q_y", "q_z", "q_w")
_ROTATION = tuple(f"R_{i}{j}" for i in range(3) for j in range(3))
_TWIST = tuple(f"v_{a}_mps" for a in _AXES) + tuple(f"w_{a}_radps" for a in _AXES)
_IMU = {name: "{}_{{}}_{}".format(*name.rsplit("_", 1)) for name in IMU_FIELDS}
_ALL6 = tuple((i, j) for i in range(6) for j in range(6))
_METHOD = re.compile(r"(cov|vt|shared)_([A-Za-z][A-Za-z0-9_]*)_00")
_VELOCITY, _GYRO, _ACC = (tuple(p.format(a) for a in _AXES) for p in ("v_{}_mps", "gyro_{}_radps", "acc_{}_mps2"))
_NOISE = ("sigma_translation_m", "sigma_rotation_rad")
_SIGMA6 = tuple(f"{a}_m" for a in _AXES) + tuple(f"r{a}_rad" for a in _AXES)
_SHORT6 = tuple(a.rsplit("_", 1)[0] for a in _SIGMA6)


def pose_columns(T: Array) -> dict[str, NDArray[np.float64]]:
    """(N, 4, 4) poses as columns of length N."""
    T = np.asarray(T, dtype=np.float64).reshape(-1, 4, 4)
    R = T[:, :3, :3]
    numbers = (*T[:, :3, 3].T, *se3.rotation_to_quaternion_xyzw(R).T, *R.reshape(-1, 9).T)
    return dict(zip((*_POSITION, *_QUATERNION, *_ROTATION), numbers, strict=True))


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
    log = VoLog(records)
    dt_s = log.column("dt_s")
    out: Columns = {
        "t_ns": log.t_ns,
        "t_prev_ns": log.column("t_prev_ns"),
        "dt_s": dt_s,
        "status": [r.status.value for r in records],
        "reason": [r.reason for r in records],
        "is_reference": log.column("is_reference"),
        **pose_columns(log.T_prev_cur),
        **dict(zip(_TWIST, (se3.log(log.T_prev_cur) / np.where(dt_s > 0, dt_s, np.nan)[:, None]).T)),
    }
    for name in COUNT_FIELDS:
        out[name] = [v if v >= 0 else None for v in log.column(name)]
    out |= {name: log.column(name) for name in ("inlier_ratio", *FLOAT_FIELDS)}
    for name, pattern in _IMU.items():
        vectors = np.array([np.full(3, np.nan) if v is None else v for v in (getattr(r, name) for r in records)])
        out |= dict(zip(map(pattern.format, _AXES), vectors.T))
    out |= _matrix_columns("cov", {m: log.covariance(m) for m in log.methods})
    out |= _matrix_columns("vt", {m: log.v_t(m) for m in log.v_t_methods})
    out |= _matrix_columns("shared", {cause: log.shared(cause) for cause in log.causes})
    for stage in dict.fromkeys(stage for r in records for stage in r.stage_ms):
        out[f"stage_{stage}_ms"] = [r.stage_ms.get(stage) for r in records]
    return out


def records_from(columns: Mapping[str, NDArray[Any]]) -> StoredRecords:
    """Records of :func:`record_columns`; nulls come as NaN in float columns.

    Raises KeyError or ValueError where a column is absent or a status unknown.
    """
    T = poses_from(columns)
    n = len(T)
    return StoredRecords(
        columns={
            **{c: np.array([int(t) for t in columns[c].tolist()], dtype=np.int64) for c in ("t_ns", "t_prev_ns")},
            "status": _objects(map(Status, columns["status"].tolist()), n),
            "T_prev_cur": T,
            "is_reference": np.array([bool(b) for b in columns["is_reference"].tolist()], dtype=bool),
            "reason": _objects((str(reason or "") for reason in columns["reason"].tolist()), n),
            **{c: np.where(np.isnan(f := _float(columns, c, n)), -1, f).astype(np.int64) for c in COUNT_FIELDS},
            **{c: _float(columns, c, n) for c in FLOAT_FIELDS},
            **{c: np.stack([_float(columns, p.format(a), n) for a in _AXES], 1) for c, p in _IMU.items()},
        },
        covariances=_matrices_from(columns, "cov", 6),
        v_t=_matrices_from(columns, "vt", 3),
        shared=_matrices_from(columns, "shared", 6),
        stage_ms={c[6:-3]: _float(columns, c, n) for c in columns if c.startswith("stage_") and c.endswith("_ms")},
    )


def _objects(values: Iterable[Any], n: int) -> NDArray[Any]:
    return np.fromiter(values, dtype=object, count=n)


def prediction_columns(predictions: Iterable[Prediction]) -> Columns:
    """Predictions as columns: ``mean_*``, ``cov_total_<i><j>``, ``cov_<part>_<i><j>``, ``bias_tau_*_s``, ...

    ``cov_bias`` is all that persists. Of models with errors of calibration, ``root_calibration_<i><j>`` and
    ``calibration_tau_*_s`` besides; ``nu`` where the tails are heavier than a Gaussian's.
    """
    stored = StoredPredictions.of(predictions)
    of, errors = stored.columns, stored.batch(slice(None))
    out: Columns = {name: of[name] for name in ("t_ns", "dt_s")}
    out["status"] = [status.value for status in of["status"]]
    out |= {name: of[name] for name in ("confidence", "in_domain")}
    if np.isfinite(of["nu"]).any():
        out["nu"] = of["nu"]
    tau = of["persistent_tau_s"]
    out |= {f"mean_{axis}": errors.mean[:, i] for i, axis in enumerate(_SIGMA6)}
    for i, axis in enumerate(_SHORT6):
        out |= {f"epistemic_var_{axis}": of["epistemic"][:, i], f"bias_tau_{axis}_s": tau[:, i]}
    parts = {"total": errors.covariance, "jitter": errors.jitter, "white": errors.white, "bias": errors.persistent}
    out |= _matrix_columns("cov", parts)
    if (tau[:, 6:] != 1.0).any():
        out |= {f"root_calibration_{i}{j}": errors.persistent_root[:, i, 6 + j] for i, j in _ALL6}
        out |= {f"calibration_tau_{axis}_s": tau[:, 6 + i] for i, axis in enumerate(_SHORT6)}
    return out


def predictions_from(columns: Mapping[str, NDArray[Any]]) -> StoredPredictions:
    """Predictions of :func:`prediction_columns`.

    A bias without a time constant counts as white, an error without ``nu``, as a lost one's, as Gaussian. The root of
    what persists is that of its covariance, to rounding.
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
    cov = {part: from_upper(C, 6) for part, C in _matrices_from(columns, "cov", 6).items()}
    jitter, bias = (cov.get(part, np.zeros((n, 6, 6))) for part in ("jitter", "bias"))
    white = cov["white"] if "white" in cov else cov["total"] - jitter - bias
    finite = np.isfinite(np.concatenate([bias, root], axis=2)).all(axis=(1, 2))
    usable = np.asarray((tau > 0).all(axis=1) & finite)
    white = np.where(usable[:, None, None], white, white + bias)
    root[~usable], tau[~usable] = 0.0, 1.0
    persistent = np.where(usable[:, None, None], bias, 0.0) - root @ np.swapaxes(root, -1, -2)
    root[:, :, :6] = scaled_root(persistent)
    return StoredPredictions(
        {
            "mean": mean,
            "jitter": jitter,
            "white": white,
            "persistent_root": root,
            "persistent_tau_s": tau,
            "status": _objects(map(Status, columns["status"].tolist()), n),
            "t_ns": np.array([int(t) for t in columns["t_ns"].tolist()], dtype=np.int64),
            "epistemic": epistemic,
            **{name: np.asarray(columns[name], dtype=np.float64) for name in ("dt_s", "confidence", "in_domain")},
            # Null in the chunks of a run that hold nothing but lost motions.
            "nu": np.where(np.isnan(nu := _float(columns, "nu", n)), np.inf, nu),
        }
    )


COLUMNS_OF: dict[str, Callable[[Any], Columns]] = {
    "log": record_columns, "predictions": prediction_columns, "tracks": track_columns
}  # fmt: skip
"""By kind, how rows of the tables that are written in chunks become columns."""


def truth_table(truth: TruthLog) -> tuple[Columns, dict[str, str]]:
    """Truth as columns, and its noise as their file's metadata."""
    out = {"t_ns": truth.t_ns, **pose_columns(truth.T_world_cam)}
    if truth.v_world_mps is not None:
        out |= dict(zip(_VELOCITY, truth.v_world_mps.T))
    return out, {"schema": str(SCHEMA), **{name: repr(float(getattr(truth, name))) for name in _NOISE}}


def truth_from(columns: Mapping[str, NDArray[Any]], metadata: Mapping[str, str]) -> TruthLog:
    """Truth of :func:`truth_table`."""
    sigma_t, sigma_r = (float(metadata.get(name, 0.0)) for name in _NOISE)
    v_world = _stacked(columns, _VELOCITY) if columns.keys() >= set(_VELOCITY) else None
    return TruthLog(_stamps(columns), poses_from(columns), sigma_t, sigma_r, v_world)


def imu_table(imu: ImuLog) -> tuple[Columns, dict[str, str]]:
    """IMU samples as columns, and their noise, if it is known, as their file's metadata."""
    noise = {} if imu.noise is None else {"noise": json.dumps(asdict(imu.noise))}
    samples = zip((*_GYRO, *_ACC), (*imu.gyro_radps.T, *imu.acc_mps2.T))
    return {"t_ns": imu.t_ns, **dict(samples)}, {"schema": str(SCHEMA), **noise}


def imu_from(columns: Mapping[str, NDArray[Any]], metadata: Mapping[str, str]) -> ImuLog:
    """IMU samples of :func:`imu_table`."""
    known = json.loads(metadata.get("noise", "null"))
    noise = None if known is None else ImuNoise(**{name: float(known[name]) for name in field_names(ImuNoise)})
    return ImuLog(_stamps(columns), _stacked(columns, _GYRO), _stacked(columns, _ACC), noise)


def _stamps(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.int64]:
    t = np.asarray(columns["t_ns"], dtype=np.int64)
    if (np.diff(t) <= 0).any():
        raise ValueError("stamps do not increase")
    return t


def _stacked(columns: Mapping[str, NDArray[Any]], names: Iterable[str]) -> Array:
    """(n, len(names)) some of the columns."""
    return np.stack([columns[name] for name in names], axis=-1)


def _elements(prefix: str, method: str, n: int) -> list[str]:
    """Columns of the elements of symmetric (n, n) matrices, in the order of :func:`gpvo.geometry.covariance.upper`."""
    return [f"{prefix}_{method}_{i}{j}" for i, j in zip(*np.triu_indices(n))]


def _matrix_columns(prefix: str, matrices: Mapping[str, Array]) -> dict[str, Array]:
    """The elements of symmetric (N, n, n) matrices by method."""
    named = (zip(_elements(prefix, method, C.shape[-1]), upper(C).T) for method, C in matrices.items())
    return dict(chain.from_iterable(named))


def _matrices_from(columns: Mapping[str, NDArray[Any]], prefix: str, n: int) -> dict[str, Array]:
    """(N, n (n + 1) / 2) upper triangles of symmetric (n, n) matrices by method, of :func:`_matrix_columns`."""
    found = (_METHOD.fullmatch(name) for name in columns)
    methods = [match[2] for match in found if match is not None and match[1] == prefix]
    return {m: _stacked(columns, _elements(prefix, m, n)).astype(np.float64) for m in methods}


def _float(columns: Mapping[str, NDArray[Any]], name: str, n: int) -> Array:
    """A column as float64; NaN throughout where it is absent."""
    return np.asarray(columns[name], dtype=np.float64) if name in columns else np.full(n, np.nan)
