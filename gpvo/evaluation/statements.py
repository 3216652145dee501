"""What each method states about every motion of a run: one table of covariances per METHOD."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np

from gpvo.accumulation import with_shared
from gpvo.geometry import se3
from gpvo.geometry.covariance import where_stated
from gpvo.learning.methods import simple_covariances
from gpvo.learning.thesis import ThesisModel
from gpvo.online.features import FeatureStream
from gpvo.types import IMPORTED_POSE, Array, ByStamp, MotionError, Prediction, Status, VoLog

if TYPE_CHECKING:
    from gpvo.online.predictor import Predictor

T = TypeVar("T")
_NOTHING = np.eye(6) * 1e-6  # covariance of a motion before anything was said of one
_AT_ONCE = 1000


@dataclass(frozen=True)
class Statement:
    """One method over the N records of a log: ``mean`` (N, 6); ``covariance`` (N, d, d), d = 6, or 3 where the method
    speaks of the translation alone; NaN where it says nothing. ``errors``: N for accumulation, None for d = 3."""

    method: str
    mean: Array
    covariance: Array
    errors: Sequence[MotionError] | None

    @property
    def nu(self) -> float:
        """Stated degrees of freedom of a motion's error: the fewest of all, infinite for Gaussian ones."""
        return min((e.nu for e in self.errors or ()), default=math.inf)

    @property
    def dof(self) -> int:
        """3 or 6."""
        return int(self.covariance.shape[-1])


def statements(
    log: VoLog,
    predictions: Mapping[int, Prediction] | None = None,
    predictor: Predictor | None = None,
    further: Iterable[Statement] = (),
) -> Sequence[Statement]:
    """All methods that can be stated of this log, and ``further`` ones. Each is made whenever it is asked for, as all
    of a long run would fill the memory; only that of the thesis' model is kept.

    Geometric ones from its records, each with its translation-only ``_vt``; ``constant``, ``_scaled`` and
    ``gp_thesis`` from the model file (null where it holds none); ``base`` from the model with its GP held at its mean
    function; ``learned`` from predictions by stamp.
    """
    arrays = predictor.arrays if predictor is not None else {}
    names = {m: np.zeros((0, 6, 6)) for m in log.methods if m != IMPORTED_POSE}
    makers: list[Callable[[], Statement]] = [
        partial(_simple, log, arrays, method) for method in simple_covariances(arrays, names, names, 0)
    ]
    kept = list(further)
    if "thesis.scale" in arrays and predictor is not None and predictor.target == "frame":
        makers.append(cache(partial(gp_statement, log, ThesisModel.of_file(arrays))))  # the others are quick
    if predictions and predictor is not None:
        makers.append(partial(predicted_statement, "base", log, predictor.base().replay(log)))
    if predictions:
        makers.append(partial(predicted_statement, "learned", log, predictions))
    return _Rows(lambda k: makers[k]() if k < len(makers) else kept[k - len(makers)], len(makers) + len(kept))


def _simple(log: VoLog, arrays: Mapping[str, Any], name: str) -> Statement:
    """One of :func:`simple_covariances` over the log."""
    method, is_vt = name.removesuffix("_scaled").removesuffix("_vt"), name.endswith("_vt")
    stated = {} if is_vt or name == "constant" else {method: where_stated(log.covariance(method))}
    C = simple_covariances(arrays, stated, {method: _translation_alone(log, method)} if is_vt else {}, len(log))[name]
    if name == "constant":
        C = C * _frames_bridged(log)[:, None, None]
    elif name != method and not is_vt:
        # The scale was fitted to measured motions; what is said of a lost one is no pixel noise and stands.
        C = np.where(log.usable[:, None, None], C, stated[method])
    if is_vt or name == "constant" or not log.causes:
        return plain_statement(log, name, C)
    return plain_statement(log, name, C, simple_covariances(arrays, {method: log.shared_by_all}, {}, len(log))[name])


def _frames_bridged(log: VoLog) -> Array:
    """(N,) one, and one more for each lost frame that a motion bridges: a constant is said of the motion of a frame."""
    lost = np.cumsum(log.lost)
    start = np.maximum(log.parent, 0)
    return 1.0 + np.where(log.usable, lost - lost[start], 0)


def gp_statement(log: VoLog, model: ThesisModel) -> Statement:
    """What a GP of the thesis says of the motions that were measured."""
    stream = FeatureStream(model.columns, log.camera)
    mean, covariance = model.predict(np.array([stream.step(r) for r in log]).reshape(-1, len(model.columns)))
    usable = log.usable[:, None]
    stated = plain_statement(log, "gp_thesis", np.where(usable[:, None], covariance, np.nan))
    return replace(stated, mean=np.where(usable, mean, 0.0))


def plain_statement(log: VoLog, method: str, covariance: Array, shared: Array | None = None) -> Statement:
    """A method without a mean: covariances (N, 6, 6), NaN where it says nothing, (N, 6, 6) of it ``shared``
    by all motions and the rest independent; or (N, 3, 3) of translations alone, which do not add up to poses."""
    mean = np.broadcast_to(np.zeros(6), (len(log), 6))
    if covariance.shape[-1] == 3:
        return Statement(method, mean, covariance, None)
    # A motion that nobody vouches for enters the sum with what was said of the one before.
    usable, vouched = log.usable, np.where(np.isfinite(covariance).all(axis=(1, 2)), np.arange(len(log)), -1)
    source, dt_s = np.maximum.accumulate(vouched), log.column("dt_s")
    T = np.zeros((0, 4, 4)) if shared is None else log.T_prev_cur

    def held(k: int) -> MotionError:
        return MotionError.independent(_NOTHING if source[k] < 0 else covariance[source[k]], dt_s=float(dt_s[k]))

    def some(block: int) -> MotionError:
        assert shared is not None
        rows = slice(block * _AT_ONCE, (block + 1) * _AT_ONCE)
        known = np.where((usable & (vouched >= 0))[rows, None, None], shared[rows], 0.0)
        C = np.where(source[rows, None, None] < 0, _NOTHING, covariance[source[rows]])
        return with_shared(C, known, T[rows], dt_s=dt_s[rows])

    return Statement(method, mean, covariance, _Rows(held if shared is None else _of_blocks(some), len(log)))


def _of_blocks(made: Callable[[int], MotionError]) -> Callable[[int], MotionError]:
    """Row k of batches of a thousand, the last few of which are kept: windows ask for the same motions many times."""
    kept = lru_cache(maxsize=4)(made)
    return lambda k: kept(k // _AT_ONCE).row(k % _AT_ONCE)


@dataclass(frozen=True)
class _Rows(Sequence[T], Generic[T]):
    """N items, each ``made`` when it is asked for: as objects, those of a long run would fill the memory."""

    made: Callable[[int], T]
    n: int

    def __len__(self) -> int:
        return self.n

    def __getitem__(self, k: Any) -> Any:
        if not -self.n <= k < self.n:
            raise IndexError(k)
        return self.made(k % self.n)


def _translation_alone(log: VoLog, method: str) -> Array:
    """(N, 3, 3) covariance of the translation."""
    # V_T is in the axes of the reference camera, the error in those of the current one.
    R = log.T_prev_cur[:, :3, :3]
    return where_stated(np.swapaxes(R, 1, 2) @ log.v_t(method) @ R)


def predicted_statement(method: str, log: VoLog, predictions: Mapping[int, Prediction]) -> Statement:
    """What a model predicts, by stamp; a motion that it says nothing of is taken to be like the one before."""
    given = predictions if isinstance(predictions, ByStamp) else ByStamp.of(predictions.values())
    dt_s, statuses, row = log.column("dt_s"), log.statuses, given.rows_of(log)
    mean, covariance = np.zeros((len(log), 6)), np.full((len(log), 6, 6), np.nan)
    is_own = (row >= 0) & np.array([status is not Status.START for status in statuses], bool)
    own = np.flatnonzero(is_own)
    for some in np.array_split(own, len(own) // _AT_ONCE + 1):
        batch = given.stored.batch(row[some])
        mean[some], covariance[some] = batch.mean, batch.covariance
    source = np.maximum.accumulate(np.where(is_own, np.arange(len(log)), -1))
    nothing = MotionError.independent(_NOTHING)

    def held(k: int) -> MotionError:
        error = nothing if source[k] < 0 else given.stored.made(int(row[source[k]]))
        return replace(error, status=error.status if is_own[k] else statuses[k], dt_s=float(dt_s[k]) or error.dt_s)

    return Statement(method, mean, covariance, _Rows(held, len(log)))


def corrected(log: VoLog, mean: Array) -> Array:
    """(N, 4, 4) ``T_first_cam`` of the log with the predicted ``mean`` (N, 6) taken off each motion."""
    return log.trajectory(log.T_prev_cur @ se3.exp(-mean))
