"""What is stated about the error of a motion: by odometry, or as a model's prediction."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from gpvo.types.columns import Columns, batches
from gpvo.types.records import Status, VoLog
from gpvo.types.sensors import Array

_SAME_S = 1e-6
_MOST_PERSISTENT = 12
_Error = TypeVar("_Error", bound="MotionError")


@dataclass(frozen=True, kw_only=True)
class MotionError:
    """What is stated about the error of a motion, or of many along leading axes: ``T_true = T_est Exp(-xi)``.

    The error ``xi`` has the mean ``mean`` (..., 6) [m, rad], in ``cam``, per motion and not per second, and three parts
    that differ in how they accumulate (see :mod:`gpvo.accumulation`):

    * ``jitter`` (..., 6, 6): covariance of the pixel noise of the two frames, half of it each; a frame shares its own
      with the motion before and the motion after, with opposite sign.
    * ``white`` (..., 6, 6): covariance of what is independent from motion to motion.
    * ``persistent_root`` L (..., 6, P): the error ``L u`` of one vector u that all motions share. Its elements are
      first-order Gauss-Markov, of unit variance and time constants ``persistent_tau_s`` (P,). Models have P = 12: six
      of the bias, then six of errors of calibration, whose L changes sign with the motion.

    ``dt_s`` (...): duration. ``status``: of the motion, one for all of a batch; of a ``lost`` one nothing was measured.
    ``nu``: degrees of freedom of the Student-t that the error of one motion has, ``covariance`` being its second
    moment; infinite for a Gaussian. Filters use the covariance.
    """

    mean: Array
    jitter: Array
    white: Array
    persistent_root: Array
    persistent_tau_s: Array
    dt_s: float | Array = 0.0
    status: Status = Status.OK
    nu: float = math.inf

    @classmethod
    def independent(
        cls, covariance: Array, mean: Array | None = None, *, dt_s: float | Array = 0.0, status: Status = Status.OK
    ) -> MotionError:
        """An error (..., 6, 6) that has nothing to do with that of any other motion; ``mean`` (..., 6) or zero."""
        C = np.array(covariance, dtype=np.float64)  # a copy: whoever gives it may write the next one there
        return MotionError(
            mean=np.zeros(C.shape[:-1]) if mean is None else np.array(np.broadcast_to(mean, C.shape[:-1])),
            jitter=np.zeros(C.shape),
            white=C,
            persistent_root=np.zeros((*C.shape[:-1], 0)),
            persistent_tau_s=np.zeros(0),
            dt_s=dt_s,
            status=status,
        )

    @cached_property
    def persistent(self) -> Array:
        """(..., 6, 6) covariance of the part that persists."""
        return np.asarray(self.persistent_root @ np.swapaxes(self.persistent_root, -1, -2))

    @cached_property
    def covariance(self) -> Array:
        """(..., 6, 6) of all parts together."""
        return np.asarray(self.jitter + self.white + self.persistent)

    @property
    def lost(self) -> bool:
        """Whether nothing was measured: the motion is a guess, and its error shares nothing with its neighbours'."""
        return self.status is Status.LOST

    @property
    def sigma(self) -> Array:
        """(..., 6) standard deviation per axis [m, m, m, rad, rad, rad]."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1)))

    def extended(self, cls: type[_Error], **more: Any) -> _Error:
        """The same statement as a class with ``more`` fields; what was worked out of it is kept."""
        out = object.__new__(cls)
        out.__dict__.update(vars(self), **more)
        return out

    def row(self: _Error, k: Any) -> _Error:
        """Row k, or the rows that an index chooses, of a batch along its first axis; by ``None`` a batch of one."""
        chosen = object.__new__(type(self))
        for name, value in vars(self).items():
            batched = isinstance(value, np.ndarray) and value.ndim and name != "persistent_tau_s"
            chosen.__dict__[name] = value[k] if batched else value
        return chosen


@dataclass(frozen=True, kw_only=True)
class Prediction(MotionError):
    """A model's prediction of the error of a motion, or of many.

    ``t_ns``: stamp of the frame where the motion ends (0 where rows have none). ``epistemic`` (..., 6) is the share of
    each variance that comes from being away from the training data, already inside ``covariance``. ``confidence`` and
    ``in_domain`` (...) are in [0, 1].
    """

    t_ns: int = 0
    epistemic: Array
    confidence: float | Array
    in_domain: float | Array

    @property
    def measured(self) -> bool:
        """Of a single one: whether the motion was measured, so that its inputs tell of the conditions."""
        return bool(self.dt_s > 0) and not self.lost


@dataclass(frozen=True, eq=False)
class StoredPredictions(Columns[Prediction]):
    """N predictions as columns, a fifth of what they take as objects.

    ``columns``: the fields of a prediction by name, (N, ...); of what persists, 12 columns of roots.
    """

    columns: Mapping[str, NDArray[Any]]

    @classmethod
    def of(cls, predictions: Iterable[Prediction]) -> StoredPredictions:
        """Predictions as they come: a thousand at a time are objects."""
        if isinstance(predictions, StoredPredictions):
            return predictions
        parts = dict[str, list[NDArray[Any]]]()
        for some in batches(predictions):
            columns = {f.name: [getattr(p, f.name) for p in some] for f in fields(Prediction)}
            columns["persistent_root"] = [_wide(root, 0.0) for root in columns["persistent_root"]]
            columns["persistent_tau_s"] = [_wide(tau_s, 1.0) for tau_s in columns["persistent_tau_s"]]
            for name, values in columns.items():
                parts.setdefault(name, []).append(_column(name, values))
        # The parts of a column are let go once it is joined: two of each would be what a long run takes at most.
        joined = {name: np.concatenate(parts.pop(name)) for name in tuple(parts)}
        tau_s = joined["persistent_tau_s"]
        if len(tau_s) and (tau_s == tau_s[0]).all():  # as of one model
            joined["persistent_tau_s"] = np.broadcast_to(tau_s[0].copy(), tau_s.shape)
        return cls(joined)

    def made(self, k: int) -> Prediction:
        """Prediction k."""
        of_one = {name: column.item(k) if column.ndim == 1 else column[k] for name, column in self.columns.items()}
        return Prediction(**of_one)

    def batch(self, rows: NDArray[np.int64] | slice) -> MotionError:
        """Some of them as one, of one time constant each and of no status."""
        names = ("mean", "jitter", "white", "persistent_root", "persistent_tau_s", "dt_s")
        of: dict[str, Any] = {name: self.columns[name][rows] for name in names}
        return MotionError(**of)


_SHAPES = {"persistent_root": (6, _MOST_PERSISTENT), "persistent_tau_s": (_MOST_PERSISTENT,)}
_SHAPES |= dict.fromkeys(("mean", "epistemic"), (6,)) | dict.fromkeys(("jitter", "white"), (6, 6))


def _column(name: str, values: list[Any]) -> NDArray[Any]:
    """One field of N predictions, (N, ...) also where N is zero."""
    kind = {"t_ns": np.int64, "status": object}.get(name, np.float64)
    return np.array(values, dtype=kind).reshape(len(values), *_SHAPES.get(name, ()))


def _wide(persistent: Array, fill: float) -> Array:
    """Roots (6, P) or time constants (P,) of what persists, filled up to 12 of them."""
    out = np.full((*persistent.shape[:-1], _MOST_PERSISTENT), fill)
    out[..., : persistent.shape[-1]] = persistent
    return out


class ByStamp(Mapping[int, Prediction]):
    """The ``stored`` predictions of ``rows``, by the stamp where their motion ends, in order; each is made when it is
    asked for."""

    def __init__(self, stored: StoredPredictions, rows: Mapping[int, int]) -> None:
        self.stored, self._rows = stored, rows

    @classmethod
    def of(cls, predictions: Iterable[Prediction]) -> ByStamp:
        """All of them, kept as columns."""
        stored = StoredPredictions.of(predictions)
        return cls(stored, dict(zip(stored.columns["t_ns"].tolist(), range(len(stored)))))

    def only(self, t_ns: Iterable[int]) -> ByStamp:
        """Those of some stamps."""
        return ByStamp(self.stored, {t: self._rows[t] for t in t_ns})

    def rows_of(self, log: VoLog) -> NDArray[np.int64]:
        """(N,) row of ``stored`` for each motion of a log; -1 where nothing is said of it, or of a window of motions
        that ends there alone."""
        row = np.array([self._rows.get(t, -1) for t in log.t_ns.tolist()], dtype=np.int64)
        said = row >= 0
        said[said] = np.abs(self.stored.columns["dt_s"][row[said]] - log.column("dt_s")[said]) < _SAME_S
        return np.where(said, row, -1)

    def __getitem__(self, t_ns: int) -> Prediction:
        return self.stored.made(self._rows[t_ns])

    def __iter__(self) -> Iterator[int]:
        return iter(self._rows)

    def __len__(self) -> int:
        return len(self._rows)
