"""Reading run folders: finished ones, killed ones, and refusing damaged ones."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import CalibrationError, SourceError, counted, printable
from gpvo.files import read_json, read_toml
from gpvo.geometry.covariance import LARGEST, are_semidefinite, variances
from gpvo.io import run_table
from gpvo.io.parquet import count_rows, read_blocks, read_columns
from gpvo.io.run_table import SCHEMA
from gpvo.types import (
    Array,
    ByStamp,
    ImuLog,
    Mounting,
    Prediction,
    StereoCamera,
    StereoTracks,
    StoredPredictions,
    StoredRecords,
    TruthLog,
    Vehicle,
    VoLog,
    field_names,
)

T = TypeVar("T")

_AT_ONCE = 5_000
_MAKE = "make one with 'gpvo run' of images, or 'gpvo import' of poses"
_LARGEST = 1e12  # No mean or variance that a model states is larger [m, rad, m^2, rad^2].


@dataclass(frozen=True)
class Run:
    """A run folder in memory. ``meta`` is ``run.json``; ``meta["complete"]`` is False for a run that broke off.

    ``settings``: ``config.toml``, those of gpvo's own odometry; empty if the folder does not say.
    """

    path: Path
    name: str
    log: VoLog
    truth: TruthLog | None
    imu: ImuLog | None
    mounting: Mounting
    predictions: Sequence[Prediction]
    meta: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)

    @property
    def predictions_of_motions(self) -> ByStamp:
        """What is stored, by time stamp, but for predictions over windows of motions."""
        stored = ByStamp.of(self.predictions)
        return stored.only(self.log.t_ns[stored.rows_of(self.log) >= 0].tolist())

    def __str__(self) -> str:
        parts = [counted(len(self.log), "record")]
        parts += [word for word, has in (("truth", self.truth), ("imu", self.imu)) if has is not None]
        parts += [counted(len(self.predictions), "prediction")] if self.predictions else []
        return f"{self.name}: {', '.join(parts)}"


def is_run(path: str | Path) -> bool:
    """Whether a path looks like a run folder."""
    p = Path(path)
    return (p / "run.json").is_file() and ((p / "vo_log.parquet").is_file() or (p / "chunks").is_dir())


def read_run(path: str | Path | Run) -> Run:
    """Read a run folder; for a killed run, what its complete chunks hold. A run that is read already is returned.

    Raises SourceError if it is not a run folder, is newer than this version, or a file in it is damaged.
    """
    if isinstance(path, Run):
        return path
    p = Path(path)
    if not p.is_dir():
        what = "is a file, not a run folder" if p.exists() else "no such run folder"
        cure = f"give its folder, {p.parent}" if is_run(p.parent) else _MAKE
        raise SourceError(what, where=p, cure=cure)
    if not (p / "run.json").is_file():
        raise SourceError("is not a run folder: it lacks run.json", where=p, cure=_MAKE)
    meta = read_meta(p)
    camera, mounting = _read_rig(p / "rig.json")
    log = _read_log(p, camera, _vehicle_of(meta, p / "run.json"))
    stated = [read_predictions(part) for part in _parts(p, "predictions")]
    return Run(
        path=p,
        name=_file_name(meta.get("name")) or _file_name(p.resolve().name),
        log=log,
        truth=_read_truth(p / "truth.parquet"),
        imu=_read_beside(p / "imu.parquet", run_table.imu_from),
        mounting=mounting,
        predictions=StoredPredictions.join(stated) if stated else [],
        meta=meta,
        settings=read_toml(p / "config.toml") if (p / "config.toml").is_file() else {},
    )


def read_meta(path: Path) -> dict[str, Any]:
    """``run.json`` of a run folder. Raises SourceError where it is newer than this version, or damaged."""
    file = path / "run.json"
    meta = read_json(file, as_is=_PATHS)
    schema = meta.get("schema")
    if not isinstance(schema, int) or schema > SCHEMA:
        raise SourceError(f"has schema {schema!r}, this gpvo reads {SCHEMA}", where=file, cure="upgrade")
    for holder, kinds in ((meta, _META), (meta.get("twin") or None, _TWIN)):
        wrong = [key for key, holds in kinds.items() if isinstance(holder, dict) and not holds(holder.get(key))]
        if wrong:
            raise SourceError(f"is damaged: its '{wrong[0]}' cannot be", where=file)
    return meta


def _file_name(name: object) -> str:
    """A run's name, of which files beside other runs' are named: never a path that leads elsewhere."""
    text = re.sub(r"[/\\]", "_", printable(name or ""))
    return "" if text in (".", "..") else text


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and value >= 0


def _are_numbers(values: Iterable[Any]) -> bool:
    return all(isinstance(v, int | float) for v in values)


def _is_gap(value: Any) -> bool:
    if not value:
        return value is None
    return isinstance(value, dict) and all(
        isinstance(v := value.get(key), list) and _are_numbers(v) for key in ("ratio", "spread")
    )


_PATHS = ("options", "model")
"""Keys of ``run.json`` under which paths stand: another spelling of these would lead elsewhere, or nowhere."""
_META: dict[str, Callable[[Any], bool]] = {
    **dict.fromkeys(("twin", "options", "vehicle"), lambda v: v is None or isinstance(v, dict)),
    "frames": lambda v: v is None or _is_count(v),
}
_TWIN: dict[str, Callable[[Any], bool]] = {
    **dict.fromkeys(("of", "tolerance_name"), lambda v: isinstance(v, str)),
    **dict.fromkeys(("seed", "replicate"), _is_count),
    "tolerance": lambda v: isinstance(v, dict) and _are_numbers(v.values()),
    "gap": _is_gap,
}
"""What is read of ``run.json``, and of what it says of a twin."""


def read_predictions(path: str | Path) -> StoredPredictions:
    """Predictions of a Parquet file. Raises SourceError where it is damaged or holds something else."""
    p = Path(path)
    predictions = StoredPredictions.join(_read_table(p, run_table.predictions_from), count_rows(p))
    if not predictions:
        return predictions
    of = predictions.columns
    numbers = np.column_stack([of[name] for name in ("mean", "dt_s", "confidence", "in_domain")])
    if not np.isfinite(numbers).all():
        raise SourceError("holds a prediction that is not finite", where=p)
    covariance = of["jitter"] + of["white"] + of["persistent_root"] @ np.swapaxes(of["persistent_root"], 1, 2)
    if max(np.abs(numbers).max(), variances(covariance).max()) > _LARGEST:
        raise SourceError(f"holds a prediction beyond {_LARGEST:g}", where=p, cure="make it again with 'gpvo predict'")
    if not (of["nu"] > 2.0).all():
        raise SourceError("holds a prediction without a second moment: its 'nu' is not above 2", where=p)
    _check_covariances(covariance, "predicted covariance", p)
    for part in ("jitter", "white"):
        _check_covariances(of[part], f"covariance '{part}'", p, semi=True)
    return predictions


def read_tracks(path: str | Path) -> StereoTracks:
    """What odometry saw during a run, in order of time.

    Raises SourceError where the run folder holds no tracks, or they are damaged.
    """
    p = Path(path)
    parts = _parts(p, "tracks")
    if not parts:
        text = "holds no tracks: poses alone show neither structure nor pixel noise"
        cure = "run the sequence again with 'gpvo run --keep-tracks'; an imported log has none"
        raise SourceError(text, where=p, cure=cure)
    return StereoTracks.join([piece for part in parts for piece in _read_table(part, run_table.tracks_from)])


def _vehicle_of(meta: dict[str, Any], path: Path) -> Vehicle:
    """What carried the camera; any vehicle where an older run does not say."""
    known = meta.get("vehicle") or {}
    with _guarded(path):
        vehicle = Vehicle(**{k: float(v) for k, v in known.items()})
    if not all(v > 0 for v in vars(vehicle).values()):
        raise SourceError("its vehicle cannot move: its largest accelerations are not above 0", where=path)
    return vehicle


@contextmanager
def _guarded(path: Path) -> Iterator[None]:
    """Turns a missing or malformed column, or a camera that cannot be, into one line."""
    try:
        yield
    except KeyError as error:
        raise SourceError(f"lacks the column {error}", where=path, cure="was it made by gpvo?") from None
    except (AttributeError, ValueError, TypeError, OverflowError) as error:
        raise SourceError(f"is malformed: {error}", where=path) from None
    except CalibrationError as problem:
        raise SourceError(problem.what, where=path) from None


def table_of(kind: str) -> str:
    """The file of a table that is written in chunks, ``chunks/KIND_000000.parquet`` and so on."""
    return "vo_log.parquet" if kind == "log" else f"{kind}.parquet"


def _parts(path: Path, kind: str) -> list[Path]:
    """The joined table of a run folder, else the chunks of a run that never closed."""
    joined = path / table_of(kind)
    return [joined] if joined.is_file() else sorted((path / "chunks").glob(f"{kind}_*.parquet"))


def _read_table(path: Path, table_from: Callable[[dict[str, NDArray[Any]]], T]) -> Iterator[T]:
    """A table in pieces, as it need not fit into memory as it is stored."""
    with _guarded(path):
        yield from map(table_from, read_blocks(path))


def _read_log(path: Path, camera: StereoCamera | None, vehicle: Vehicle) -> VoLog:
    parts = _parts(path, "log")
    if not parts:
        text = "holds no records: the run broke off before its first chunk"
        raise SourceError(text, where=path, cure="run the sequence again")
    pieces = (piece for part in parts for piece in _read_table(part, run_table.records_from))
    log = VoLog(StoredRecords.join(pieces, sum(map(count_rows, parts))), camera, vehicle)
    check_log(log, path / "vo_log.parquet")
    return log


def check_log(log: VoLog, path: Path) -> None:
    """Raise SourceError where stamps, motions or covariances of a log read from ``path`` cannot be."""
    t = log.t_ns
    if len(t) == 0:
        raise SourceError("holds no records", where=path)
    if (np.diff(t) <= 0).any():
        raise SourceError("its stamps do not increase", where=path, cure="run the sequence again")
    t_prev = log.column("t_prev_ns")
    if (~np.isin(t_prev, t) | (t_prev > t))[1:].any():
        raise SourceError("a record starts from a frame that is not in it", where=path, cure="run the sequence again")
    checked = dict.fromkeys(log.methods, 0)
    for first in range(0, len(t), _AT_ONCE):
        part = log.rows(slice(first, first + _AT_ONCE))
        _check_poses(part.T_prev_cur, path, first)
        shared = part.shared_by_all
        _check_covariances(shared, "shared covariance", path, semi=True, first=first)
        for method in checked:
            C = part.covariance(method)
            stated = part.usable & ~np.isnan(C).all(axis=(1, 2))
            C = C[stated]
            _check_covariances(C, f"{method} covariance", path, first=checked[method])
            if shared.any():
                less = f"{method} covariance, less what is shared,"
                _check_covariances(C - shared[stated], less, path, semi=True, first=checked[method])
            checked[method] += len(C)


def _check_covariances(C: Array, what: str, path: Path, *, semi: bool = False, first: int = 0) -> None:
    good = are_semidefinite(C)  # up to rounding: a sum of stored parts is rounded otherwise than its writer's
    good &= semi | (variances(C) > 1 / LARGEST).all(axis=1)
    if not good.all():
        word = "positive semidefinite" if semi else "positive definite"
        raise SourceError(f"its {what} number {first + int(np.flatnonzero(~good)[0]) + 1} is not {word}", where=path)


def _check_poses(T: Array, path: Path, first: int = 0) -> None:
    R = T[:, :3, :3]
    with np.errstate(invalid="ignore", over="ignore"):
        good = np.isfinite(T).all(axis=(1, 2))
        good &= np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2)) < 1e-6
    if not good.all():
        raise SourceError(f"row {first + int(np.flatnonzero(~good)[0])} holds no rigid motion", where=path)


def _read_rig(path: Path) -> tuple[StereoCamera | None, Mounting]:
    if not path.is_file():
        return None, Mounting()
    document = read_json(path)

    def pose(key: str) -> Array | None:
        if document.get(key) is None:
            return None
        T = np.asarray(document[key], dtype=np.float64)
        if T.shape != (4, 4):
            raise ValueError(f"{key} has shape {T.shape}")
        _check_poses(T[None], path)
        return T

    with _guarded(path):
        raw = document.get("camera")
        camera = None if raw is None else StereoCamera(**{k: raw[k] for k in field_names(StereoCamera)})
        body = document.get("body", "base_link")
        if not (isinstance(body, str) and 0 < len(body) <= 256):
            raise ValueError("body is not the name of a frame")
        return camera, Mounting(pose("T_body_cam"), pose("T_imu_cam"), printable(body))


def _read_truth(path: Path) -> TruthLog | None:
    truth = _read_beside(path, run_table.truth_from)
    if truth is not None:
        _check_poses(truth.T_world_cam, path)
        if truth.v_world_mps is not None and not np.isfinite(truth.v_world_mps).all():
            raise SourceError("holds a velocity that is not finite", where=path)
    return truth


def _read_beside(path: Path, made: Callable[[dict[str, NDArray[Any]], dict[str, str]], T]) -> T | None:
    """What was recorded beside the motions; None where nothing was."""
    if not path.is_file():
        return None
    columns, metadata = read_columns(path)
    with _guarded(path):
        return made(columns, metadata)
