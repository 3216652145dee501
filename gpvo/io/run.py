"""The run folder: everything later stages need, so that nothing reopens the source.

``vo_log.parquet`` (columns in :mod:`gpvo.io.run_table`), ``trajectory.tum`` (raw VO, never corrected), ``rig.json``,
``truth.parquet``, ``imu.parquet``, ``predictions.parquet``, ``tracks.parquet`` (what odometry saw) if available,
``config.toml``, ``run.json``. During a run, finished chunks of records lie in ``chunks/``; closing the run joins them.
An interrupted run can be read from its chunks, and resumes from the last of them.
"""

from __future__ import annotations

import platform
import shutil
import time
from collections import Counter, OrderedDict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime, timezone
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from gpvo import __version__
from gpvo.errors import SourceError
from gpvo.files import digest_of_file, write_json, write_toml
from gpvo.geometry.covariance import are_covariances, are_semidefinite, from_upper, upper
from gpvo.io import run_folder, run_table
from gpvo.io.parquet import RowGroup, join_tables, write_blocks, write_table
from gpvo.io.run_folder import is_finished as is_finished
from gpvo.io.run_read import Run as Run
from gpvo.io.run_read import read_predictions as read_predictions
from gpvo.io.run_read import read_run as read_run
from gpvo.io.run_read import read_tracks as read_tracks
from gpvo.io.run_read import table_of
from gpvo.io.run_table import SCHEMA
from gpvo.io.snapshot import save_snapshot
from gpvo.io.trajectory import tum_line
from gpvo.types import Array, ImuLog, Mounting, Prediction, StereoCamera, StereoTracks, TruthLog, VoLog, VoRecord
from gpvo.types.columns import batches

PREDICTIONS = (b"cov_total_00", "file of predictions")
_POSES = 20_000  # that came or served last, as possible starts of later motions


class RunWriter:
    """Writes a run folder as the records come; use as a context manager.

    Raises SourceError where the folder holds something that is not a run, or a finished one and not ``overwrite``;
    where it cannot be written, or another process writes it.

    Parameters
    ----------
    path : the folder; made if need be. What a killed run left is replaced, anything but a run refused.
    overwrite : whether a finished run in it is replaced: it stays as it is until the new one is whole.
    camera, mounting, truth, imu : what the source knows, None where it does not.
    config : the settings used, for ``config.toml``.
    meta : further keys of ``run.json``, such as ``name``, ``source`` and ``source_format``.
    calibration : the raw rig in plain numbers, for ``rig.json``.
    chunk : records per chunk; a killed run loses at most so many.
    resume : what decides the records beside the source; a run that broke off under the same is resumed: ``kept``
        is what it left, and its records are to be appended again, first of all. None begins anew.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        overwrite: bool = True,
        camera: StereoCamera | None = None,
        mounting: Mounting | None = None,
        truth: TruthLog | None = None,
        imu: ImuLog | None = None,
        config: Mapping[str, Any] | None = None,
        meta: Mapping[str, Any] | None = None,
        calibration: Mapping[str, Any] | None = None,
        chunk: int = 100,
        resume: str | None = None,
    ) -> None:
        self._target = Path(path).resolve()  # "." has no name, and a link would be replaced in place of its folder
        self._meta, self._chunk, self._state = dict(meta or {}), chunk, _State()
        self._lock = run_folder.claim(self._target)
        self.path = run_folder.beside(path, overwrite) if is_finished(self._target) else self._target
        self._chunks, self._resume = self.path / "chunks", resume
        self.kept = None if resume is None else run_folder.take_up(self._chunks, resume)
        if self.kept is not None:
            self._state.chunks, self._state.written = len(self.kept.parts["log"]), self.kept.parts
        try:
            run_folder.prepare(self.path, keep_chunks=self.kept is not None)
            # First of all files: a run that is killed while it begins is known as one, and may be begun anew.
            self._write_meta(complete=False)
            self._chunks.mkdir(exist_ok=True)
            place = mounting or Mounting()
            rig = {"camera": camera and asdict(camera), **vars(place), "calibration": calibration}
            write_json(self.path / "rig.json", {"schema": SCHEMA, **rig})
            if truth is not None:
                write_table(self.path / "truth.parquet", *run_table.truth_table(truth))
            if imu is not None:
                write_table(self.path / "imu.parquet", *run_table.imu_table(imu))
            write_toml(self.path / "config.toml", dict(config or {}))
        except BaseException:
            self._release()
            raise

    def __enter__(self) -> RunWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close(complete=error is None)

    def append(
        self,
        record: VoRecord,
        prediction: Prediction | None = None,
        tracks: StereoTracks | None = None,
        state: Any = None,
    ) -> None:
        """Add one record, what a model predicted for it, and the observations that came with it.

        ``state``: where all stands after it. It is kept with the chunk that ends here, for going on from it. Raises
        ValueError where the stamp does not grow or the record starts from an unknown frame.
        """
        now = self._state
        T_prev = now.poses.get(record.t_prev_ns)
        if now.records_total and record.t_ns <= now.last_t_ns:
            raise ValueError(f"record at {record.t_ns} ns does not follow {now.last_t_ns} ns")
        if now.records_total and T_prev is None:
            raise ValueError(f"record at {record.t_ns} ns starts from {record.t_prev_ns} ns, which is not in the run")
        if T_prev is not None:
            # At rest and in the dark one reference serves for as long as that lasts.
            now.poses.move_to_end(record.t_prev_ns)
        pose = record.T_prev_cur if T_prev is None else T_prev @ record.T_prev_cur
        now.poses[record.t_ns] = pose
        if len(now.poses) > _POSES:
            now.poses.popitem(last=False)
        now.lines.append(tum_line(record.t_ns, pose))
        now.count(record)
        if self.kept is not None and now.records_total <= len(self.kept.records):
            return
        for kind, row in (("log", as_stored(record)), ("predictions", prediction), ("tracks", tracks)):
            if row is not None:
                now.pending.setdefault(kind, []).append(row)
        if len(now.pending["log"]) >= self._chunk:
            self.flush()
            if self._resume is not None:
                save_snapshot(self._chunks / run_folder.STATE, self._resume, (now.chunks, state))

    def note(self, **meta: Any) -> None:
        """Add keys to ``run.json``, written when the run closes."""
        self._meta.update(meta)

    def flush(self) -> None:
        """Write the records so far as one chunk, which survives a kill."""
        state = self._state
        for kind, rows in state.pending.items():
            part = write_table(self._chunks / f"{kind}_{state.chunks:06d}.parquet", run_table.COLUMNS_OF[kind](rows))
            state.written.setdefault(kind, []).append(part)
        if state.lines:  # of a run that is resumed, also those of the records that it left
            with (self.path / "trajectory.tum").open("a", encoding="ascii", newline="\n") as file:
                file.writelines(line + "\n" for line in state.lines)
        state.chunks += bool(state.pending)
        state.pending, state.lines = {}, []

    def close(self, *, complete: bool = True) -> None:
        """Join the chunks and finish ``run.json``; ``complete=False`` leaves a run that broke off in its chunks."""
        replaces = self.path != self._target
        try:
            if complete or not replaces:
                self.flush()
                for kind, parts in self._state.written.items() if complete else ():
                    join_tables(parts, self.path / table_of(kind), {"schema": str(SCHEMA)})
                if complete:
                    shutil.rmtree(self._chunks, ignore_errors=True)
                self._write_meta(complete=complete)
            if complete and replaces:
                run_folder.put_in_place(self.path, self._target)
        finally:
            self._release()

    def _release(self) -> None:
        if self.path != self._target and not (self._chunks / run_folder.STATE).is_file():
            # Where the new run is not whole, the finished one that it was to replace is worth more.
            run_folder.discard(self.path)
        self._lock.release()

    def _write_meta(self, *, complete: bool) -> None:
        state = self._state
        tables = [p for name in run_folder.FILES if complete and (p := self.path / name).is_file()]
        write_json(
            self.path / "run.json",
            {
                "schema": SCHEMA,
                "name": self._target.name,
                **self._meta,
                "complete": complete,
                "frames": state.records_total,
                "statuses": state.statuses,
                "started": state.started,
                "finished": datetime.now(timezone.utc).isoformat(timespec="seconds") if complete else None,
                "wall_s": round(time.monotonic() - state.clock, 3),
                "digests": {p.name: digest_of_file(p) for p in tables},
                "stage_ms_mean": {k: v / max(state.records_total, 1) for k, v in state.stage_ms.items()},
                "versions": {"gpvo": __version__, "python": platform.python_version(), "numpy": np.__version__},
            },
        )


@dataclass
class _State:
    """What the writer carries from record to record; its size does not grow with the run."""

    pending: dict[str, list[Any]] = field(default_factory=dict)  # rows of each table
    lines: list[str] = field(default_factory=list)
    written: dict[str, list[RowGroup]] = field(default_factory=dict)
    poses: OrderedDict[int, Array] = field(default_factory=OrderedDict)
    statuses: Counter[str] = field(default_factory=Counter)
    stage_ms: dict[str, float] = field(default_factory=dict)
    records_total: int = 0
    chunks: int = 0
    last_t_ns: int = 0
    started: str = field(default_factory=lambda: datetime.now(timezone.utc).isoformat(timespec="seconds"))
    clock: float = field(default_factory=time.monotonic)

    def count(self, record: VoRecord) -> None:
        """Add to the sums of ``run.json``."""
        self.records_total += 1
        self.last_t_ns = record.t_ns
        self.statuses[record.status.value] += 1
        for stage, ms in record.stage_ms.items():
            self.stage_ms[stage] = self.stage_ms.get(stage, 0.0) + ms


def write_run(path: str | Path, log: VoLog, *, predictions: Sequence[Prediction] = (), **known: Any) -> None:
    """Write a whole run at once; ``known`` are the keyword arguments of :class:`RunWriter` but ``camera``."""
    by_stamp = {p.t_ns: p for p in predictions}
    with RunWriter(path, camera=log.camera, chunk=1000, **known) as writer:
        for record in log:
            writer.append(record, by_stamp.get(record.t_ns))


def copy_run(
    run: Run, path: str | Path, truth: TruthLog, meta: Mapping[str, Any] | None = None, *, overwrite: bool = True
) -> None:
    """Write a finished run once more, into its own folder or another, with another ground truth; all else is copied.

    ``meta``: further keys of ``run.json``. Raises SourceError where the run broke off, or as :class:`RunWriter` does.
    """
    if run.meta.get("complete") is not True:
        cure = "end it first: the same 'gpvo run' goes on where it stopped"
        raise SourceError("broke off before its end", where=run.path, cure=cure)
    target = Path(path).resolve()
    is_new = not is_finished(target)
    new, lock = run_folder.beside(path, overwrite or is_new), run_folder.claim(target)
    try:
        for folder in (target, new) if is_new else (new,):
            run_folder.prepare(folder, keep_chunks=False)
        for file in (f for name in run_folder.OWN if (f := run.path / name).is_file()):
            shutil.copyfile(file, new / file.name)
        write_table(new / "truth.parquet", *run_table.truth_table(truth))
        digests = run.meta.get("digests") or {}
        digests = digests | {"truth.parquet": digest_of_file(new / "truth.parquet")}
        write_json(new / "run.json", {**run.meta, "name": target.name, **(meta or {}), "digests": digests})
        run_folder.put_in_place(new, target)
    finally:
        run_folder.discard(new)
        lock.release()


def write_predictions(path: str | Path, predictions: Iterable[Prediction]) -> None:
    """Write predictions as they come to a Parquet file of their own, as ``gpvo predict`` does."""
    blocks = map(run_table.prediction_columns, batches(predictions))
    write_blocks(Path(path), blocks, {"schema": str(SCHEMA)}, PREDICTIONS)


def as_stored(record: VoRecord) -> VoRecord:
    """The record as it will be read: covariances by their upper triangles, without those that are none: not finite, or
    not positive definite."""
    C = from_upper(upper(np.array(list(record.covariances.values())).reshape(-1, 6, 6)), 6)
    good = are_covariances(C) if record.usable else np.ones(len(C), bool)
    kept = {name: c for name, c, is_good in zip(record.covariances, C, good) if is_good}
    S = from_upper(upper(np.array(list(record.shared.values())).reshape(-1, 6, 6)), 6)
    shared = dict(zip(record.shared, S)) if kept and are_semidefinite(S).all() else {}
    return replace(record, covariances=kept, shared=shared)
