"""VO log and ground truth to a training set, by replaying the online features over the log; and how training sets are
split: by sequence, or by time block where there are too few sequences, never by random rows."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from gpvo.dataset.clock import estimate_time_offset, on_clock_of_log
from gpvo.dataset.doubtful import false_motions, in_waits, odd_stretches
from gpvo.dataset.errors import (
    MAX_GAP_S,
    motion_targets,
    position_targets,
    require_attitude,
    steps_of_slow_truth,
)
from gpvo.dataset.hand_eye import align_frames, windowed_motions
from gpvo.dataset.noiseless import without_noise
from gpvo.dataset.truth_noise import TruthNoise, of_stamps
from gpvo.errors import NO_TRUTH, GpvoError
from gpvo.io.run_read import Run, read_run
from gpvo.online.base import RESIDUAL_COLUMN, positions
from gpvo.online.features import resolve
from gpvo.online.observer import Observer, Window
from gpvo.online.predictor import Predictor
from gpvo.online.slip import REASON, SlipDetector, flag_slips
from gpvo.types import Array, Prediction, Status, StereoCamera, TruthLog, VoLog, VoRecord
from gpvo.vo.config import VoConfig

T = TypeVar("T")

MIN_ROWS = 30
MIN_SEQUENCES = 3
BLOCKS = 6


@dataclass(frozen=True)
class TrainingSet:
    """Features and targets of one sequence, n rows in time order.

    ``X`` (n, d) features ``columns``, NaN where unknown. ``Y`` (n, 6) errors [m, rad], or (n, 3) residuals of a
    position. ``covariances`` (n, 6, 6) and ``v_t`` (n, 3, 3) by method. ``counts``: frames, lost, slips (lost by
    plausibility alone, also in ``lost``), frames without truth, those whose truth moves at rest or jumps, and those in
    odd stretches. ``lost_xi`` (m, 6): errors of the slips that have truth; ``lost_jump`` (m, 6): their distance from
    the motion expected.
    ``odometry``: settings of gpvo's own odometry, empty if another one made the log. Where the truth is noisy, ``Y`` is
    without its noise (:mod:`gpvo.dataset.noiseless`); ``told`` (n, 6) are the errors by the truth as it is, by which a
    model is judged, and ``truth_noise`` (n, 6, 6) is the covariance of what it adds to them. Else both are None.
    """

    name: str
    columns: tuple[str, ...]
    X: Array
    Y: Array
    t_ns: NDArray[np.int64]
    dt_s: Array
    covariances: Mapping[str, Array]
    v_t: Mapping[str, Array]
    counts: Mapping[str, int]
    camera: StereoCamera | None = None
    target: str = "frame"
    lost_xi: Array = field(default_factory=lambda: np.zeros((0, 6)))
    lost_jump: Array = field(default_factory=lambda: np.zeros((0, 6)))
    odometry: Mapping[str, Any] = field(default_factory=dict)
    told: Array | None = None
    truth_noise: Array | None = None

    def __len__(self) -> int:
        return len(self.X)

    def select(self, names: Sequence[str]) -> Array:
        """(n, len(names)) some of the columns."""
        return self.X[:, positions(self.columns, names)]

    def rows(self, keep: NDArray) -> TrainingSet:
        """A part of the rows."""
        return self.over([self], lambda arrays: arrays[0][keep])

    @classmethod
    def over(cls, sets: Sequence[TrainingSet], made: Callable[[list[NDArray[Any]]], NDArray[Any]]) -> TrainingSet:
        """The first set with other rows: each array of a row per motion is ``made`` of those of all the sets, alike."""
        changed: dict[str, Any] = {n: made([getattr(s, n) for s in sets]) for n in ("X", "Y", "t_ns", "dt_s")}
        for name in ("told", "truth_noise"):
            if getattr(sets[0], name) is not None:
                changed[name] = made([getattr(s, name) for s in sets])
        for name in ("covariances", "v_t"):
            changed[name] = {m: made([getattr(s, name)[m] for s in sets]) for m in getattr(sets[0], name)}
        return replace(sets[0], **changed)

    def supported(self) -> set[str]:
        """Columns that the log knows in at least 95 of 100 rows."""
        known = np.isfinite(self.X).mean(axis=0) >= 0.95
        return {c for c, k in zip(self.columns, known) if k}

    def digest(self) -> str:
        """SHA-256 of the rows."""
        sha = hashlib.sha256(repr((self.name, self.columns, self.target, self.X.shape)).encode())
        stated = (self.covariances[m] for m in sorted(self.covariances))
        told = [a for a in (self.told, self.truth_noise) if a is not None]
        for array in (self.X, self.Y, self.t_ns, self.dt_s, *stated, *told):
            sha.update(np.ascontiguousarray(array).tobytes())
        return sha.hexdigest()


def observe(log: VoLog, names: Sequence[str], target: str = "frame") -> tuple[Sequence[VoRecord], Array]:
    """Replay a log: the records as flight judges (or joins) them and their features (N, d)."""
    observer, X = Observer(names, target, log.camera, log.vehicle), bytearray()

    def seen() -> Iterator[VoRecord]:
        for record, x in filter(None, map(observer.step, log)):
            X.extend(x.tobytes())
            yield record

    judged = log.judged_as(seen()) if Window.of(target) is None else replace(log, records=list(seen()))
    return judged.records, np.frombuffer(X).reshape(len(judged.records), len(names))


def build(
    log: VoLog,
    truth: TruthLog | None,
    *,
    name: str,
    columns: Sequence[str] | None = None,
    target: str = "frame",
    waits: str = "drop",
    odd: str = "keep",
    exact: bool = False,
    where: object = None,
) -> TrainingSet:
    """The training set of one run. Frames that are lost or lack truth are left out and counted.

    ``columns``: by default all of ``full`` and the residual. ``waits``: "drop" leaves out, and counts, what falls into
    waits in which the truth moves, or its jumps (:func:`gpvo.dataset.doubtful.false_motions`); "keep" learns from
    them. ``odd``: the same of stretches in which odometry and truth differ far more than elsewhere
    (:func:`gpvo.dataset.doubtful.odd_stretches`). ``exact``: the truth is simulated. Raises GpvoError where nothing is
    left to learn from, which names ``where``, by default ``name``.
    """
    Window.of(target)  # refuses an unknown one before any work
    for what, way in (("waits", waits), ("odd stretches", odd)):
        if way not in ("drop", "keep"):
            raise GpvoError(f"unknown treatment of {what}: '{way}'", cure="drop or keep")
    names = tuple(columns or (*resolve("full"), RESIDUAL_COLUMN))
    if truth is None or len(truth.t_ns) < 2:
        raise GpvoError("has no ground truth to learn from", where=where or name, cure=NO_TRUTH)
    if target != "position":
        require_attitude(log, truth, where or name)
        _require_one_unit(log, truth, where or name)
    records, X = observe(log, names, target)
    seen, noise = VoLog(records), TruthNoise()
    if target == "position":
        (Y, known), told = position_targets(log, seen.usable, truth), None
    else:
        drawn, noise = (truth, noise) if exact else without_noise(log, truth)
        (Y, known), (told, _) = (motion_targets(records, t) for t in (drawn, truth))
    with_truth = int(known.sum())
    if waits == "drop":
        known &= ~in_waits(seen, false_motions(log, truth))
    moves_at_rest = with_truth - int(known.sum())
    is_odd = known & in_waits(seen, [s.t_ns for s in odd_stretches(log, truth)])
    if odd == "drop":
        known &= ~is_odd
    _require_rows(int(known.sum()), seen, log, truth, where or name)
    kept = seen.rows(known)
    n_lost, slips, jumps = lost_of(log)
    as_if, has = motion_targets([replace(r, status=Status.OK) for r in slips], truth)
    return TrainingSet(
        name=name,
        columns=names,
        X=X[known],
        Y=Y[known],
        t_ns=kept.t_ns,
        dt_s=kept.column("dt_s"),
        covariances={m: kept.covariance(m) for m in kept.methods},
        v_t={m: kept.v_t(m) for m in kept.v_t_methods},
        counts={
            "frames": len(log),
            "lost": n_lost,
            "slips": len(slips),
            "without_truth": int(seen.usable.sum()) - with_truth,
            "truth_moves_at_rest": moves_at_rest,
            "odd": int(is_odd.sum()),
        },
        camera=log.camera,
        target=target,
        lost_xi=as_if[has],
        lost_jump=jumps[has],
        told=told[known] if told is not None and noise else None,
        truth_noise=of_stamps(noise, log, truth, kept.column("t_prev_ns"), kept.t_ns) if noise else None,
    )


def _require_rows(known: int, seen: VoLog, log: VoLog, truth: TruthLog, where: object) -> None:
    """Raise GpvoError, naming ``where``, for too few motions with truth, ``known``, of those ``seen`` in the log."""
    if known >= MIN_ROWS:
        return
    what = f"only {known} of {max(len(log) - 1, 0)} motions have ground truth"
    inside = int(((log.t_ns >= truth.t_ns[0]) & (log.t_ns <= truth.t_ns[-1])).sum())
    if (measured := int(seen.usable.sum())) < MIN_ROWS:
        what = f"only {measured} of {max(len(log) - 1, 0)} motions were measured"
        cure = "give a longer sequence, or one in which odometry is lost less often"
    elif inside >= MIN_ROWS and (steps_s := steps_of_slow_truth(truth, log.t_ns)) and steps_s[0] > MAX_GAP_S:
        cure = (
            f"the truth's poses come every {steps_s[0]:.2g} s: give one whose poses are at most {MAX_GAP_S:g} s apart"
        )
    else:
        cure = "check that log and truth share one clock"
    raise GpvoError(f"{what}, {MIN_ROWS} are needed", where=where, cure=cure)


_MOST_SCALE = 3.0  # less than a metre has feet
_ALIKE = 0.5  # squared correlation of the motions


def _require_one_unit(log: VoLog, truth: TruthLog, where: object) -> None:
    """Raise GpvoError, naming ``where``, for motions of a second that are another size by odometry than by truth. Of
    two that are noisy, the sum of products over that of squares underrates the scale by the noise of either; motions
    that hardly go together, as noise and the rounding of a truth at rest, are not one motion in two units."""
    a, b = (T[:, :3, 3] for T in windowed_motions(log, truth)[:2])
    own, true, both = float((a**2).sum()), float((b**2).sum()), float((a * b).sum())
    if _MOST_SCALE * min(own, true) < both and both**2 > _ALIKE * own * true:
        raise GpvoError(
            f"the odometry's motions are {np.sqrt(own / true):.2g} times as large as the truth's",
            where=where,
            cure="give both in metres",
        )


def lost_of(log: VoLog) -> tuple[int, list[VoRecord], Array]:
    """How many records are lost, those that are so for their motion alone, and the distance (m, 6) of each such motion
    from the expected one. From the log itself: windows leave lost frames out before they become records."""
    detector, n_lost, slips, jumps = SlipDetector(log.vehicle), 0, [], []
    for record in log.records:
        judged = detector.step(record)
        n_lost += judged.status is Status.LOST
        if judged.status is Status.LOST and REASON in judged.reason and detector.expected is not None:
            slips.append(judged)
            jumps.append(detector.jump(judged.T_prev_cur, judged.dt_s))
    return n_lost, slips, np.array(jumps).reshape(-1, 6)


def build_run(
    run: Run | str | Path, *, align: str = "none", time_offset_s: float | None = 0.0, **how: Any
) -> TrainingSet:
    """The training set of a run or its folder. ``align``, ``time_offset_s``: see :func:`aligned`; ``how``: further
    arguments of :func:`build`, as ``columns``, ``target``, ``waits`` and ``odd``."""
    run = aligned(read_run(run), align, time_offset_s)[0]
    rows = build(run.log, run.truth, name=run.name, exact=bool(run.meta.get("twin")), where=run.path, **how)
    return replace(rows, odometry=that_matter(run.settings))


_INDIFFERENT = ("seed", "max_acceleration_mps2", "max_turn_radps2")


def that_matter(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Of the settings of gpvo's own odometry, those that its errors depend on; empty if another one made a log."""
    if "preset" not in settings:
        return {}
    # What is None, estimated from the residuals, is left out of a run's file.
    known = {"sigma_p_px": None, "sigma_m_px": None, **settings}
    names = [f.name for f in fields(VoConfig) if f.name in known and f.name not in _INDIFFERENT]
    return {name: list(v) if isinstance(v := known[name], tuple) else v for name in names}


def aligned(run: Run, align: str = "none", time_offset_s: float | None = 0.0) -> tuple[Run, float]:
    """The run with its truth on the clock of the log, to whose stamps ``time_offset_s`` is added, and that offset; None
    estimates it (:func:`gpvo.dataset.clock.estimate_time_offset`). Unless ``align`` is "none", also in the frame of the
    log, as motions of a second agree best (:func:`gpvo.dataset.hand_eye.align_frames`). One without truth is as it is.

    Raises GpvoError for another word, or where nothing tells it.
    """
    truth, offset_s = run.truth, time_offset_s
    if truth is None:
        return run, 0.0
    try:
        if offset_s is None:
            offset_s = estimate_time_offset(run.log, truth)
        if offset_s:
            truth = on_clock_of_log(truth, offset_s)
        if align != "none":
            fixed = align_frames(flag_slips(run.log), truth, align)
            truth = replace(truth, T_world_cam=fixed.in_log_frame(truth.T_world_cam))
    except GpvoError as error:
        raise GpvoError(error.what, where=run.path, cure=error.cure) from None
    return replace(run, truth=truth), offset_s


def predictions_of(run: Run, predictor: Predictor | None) -> Mapping[int, Prediction]:
    """By time stamp, what a model predicts of the motions of a run, or without one what is stored with the run.

    Raises ModelError where the model predicts something else than the error of a motion.
    """
    return run.predictions_of_motions if predictor is None else predictor.require_motions().replay(run.log)


def leave_out(items: Sequence[T], folds: int | None = None) -> Iterator[tuple[list[T], list[T]]]:
    """Items held out together, with all the others: each once, and alone, or in ``folds`` parts where they are more.

    Part k holds every ``folds``-th item from the k-th on.
    """
    n = min(len(items), folds or len(items))
    for k in range(n):
        yield list(items[k::n]), [other for i, other in enumerate(items) if i % n != k]


def group_labels(lengths: Sequence[int]) -> tuple[NDArray[np.int64], str]:
    """Labels (sum of lengths,) of the groups that cross-validation leaves out, and what they are.

    Sequences, or with fewer than three of them ``BLOCKS`` blocks of consecutive rows of each.
    """
    if len(lengths) >= MIN_SEQUENCES:
        return np.repeat(np.arange(len(lengths)), lengths), "sequences"
    labels = [i * BLOCKS + np.arange(n) * BLOCKS // max(n, 1) for i, n in enumerate(lengths)]
    return np.concatenate(labels).astype(np.int64), "time blocks"


def group_folds(groups: NDArray, max_folds: int) -> NDArray[np.int64]:
    """(n,) fold of each row: no group is split, and folds are of similar size (largest group first, to the smallest
    fold).

    With one group alone: ``max_folds`` blocks of consecutive rows.
    """
    _, label, count = np.unique(np.asarray(groups), return_inverse=True, return_counts=True)
    n = len(label)
    if len(count) < 2:
        return np.minimum(np.arange(n) * max_folds // max(n, 1), max_folds - 1).astype(np.int64)
    n_folds = min(max_folds, len(count))
    load, fold_of = np.zeros(n_folds), np.zeros(len(count), dtype=np.int64)
    for group in np.argsort(-count, kind="stable"):
        fold_of[group] = np.argmin(load)
        load[fold_of[group]] += count[group]
    return fold_of[label]
