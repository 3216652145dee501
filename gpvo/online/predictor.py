"""The predictor that flies: features in, the error's distribution out. Needs only NumPy and safetensors."""

from __future__ import annotations

import copy
import hashlib
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpvo.errors import GpvoError, ModelError
from gpvo.geometry import se3
from gpvo.geometry.covariance import variances
from gpvo.online import modelfile
from gpvo.online.estimate import ErrorModel
from gpvo.online.guard import DEGRADED_BELOW, AdaptiveScale, camera_problems
from gpvo.online.observer import Observer
from gpvo.online.stored import arrays_of_base
from gpvo.types import Array, ByStamp, Prediction, Status, StereoCamera, Vehicle, VoLog, VoRecord

MODEL_SCHEMA = 1
"""Of the arrays and header keys described in :mod:`gpvo.online.modelfile`."""

_NO_MOTION_VAR, _ROUNDING = 1e-12, 1e-9
_REMEMBERED = 512


@dataclass(frozen=True)
class Influence:
    """What one input did: the factor on sigma against its typical value, and how far outside training it lay."""

    feature: str
    value: float
    unit: str
    on_translation: float
    on_rotation: float
    outside: float

    def __str__(self) -> str:
        far = f", {self.outside:.1f} sigma outside the training data" if self.outside > 0 else ""
        value = f"{self.feature} = {self.value:.4g} {self.unit}"
        return f"{value}: sigma x{self.on_translation:.2f} translation, x{self.on_rotation:.2f} rotation{far}"


class Predictor:
    """Predicts the error of VO's motions. One instance per run: it remembers what its features need.

    ``header``: the model file's. ``digest``: of the model file. ``features``: columns, in order.
    """

    def __init__(self, arrays: Mapping[str, NDArray[Any]], header: Mapping[str, Any], digest: str = "") -> None:
        # Arrays whose meaning this version does not know are refused; arrays it does not know are ignored.
        modelfile.check_version("model schema", header.get("model_schema", MODEL_SCHEMA), MODEL_SCHEMA)
        if header.get("target") == "position":
            cure = "use ThesisModel.of_positions, or train with --target frame"
            raise ModelError("this model predicts the residual of a position, not the error of a motion", cure=cure)
        self.header, self.digest, self.arrays = dict(header), digest, dict(arrays)
        try:
            self.features = tuple(header["features"])
            method, target = header["base_method"], header["target"]
            dt_s, camera = float(header["dt_s"]), header["camera"]
            self.camera = None if camera is None else StereoCamera(**camera)
        except (KeyError, TypeError, ValueError) as problem:
            raise ModelError(f"the model's header is incomplete: {problem}") from None
        self.target = str(target)
        self.reset()
        self.model = ErrorModel.of_file(arrays, self.features, method, dt_s)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Predictor:
        """From a model file. Raises ModelError, in one line, if the file cannot be used."""
        if not Path(path).exists():
            raise ModelError("no such model file", where=path, cure="'gpvo train RUN... -o MODEL' makes one")
        blob = modelfile.read(path)  # once: the file may be replaced meanwhile, and the digest is that of these arrays
        arrays, header = modelfile.parse(blob, path)
        try:
            return cls(arrays, header, hashlib.sha256(blob).hexdigest())
        except GpvoError as problem:
            raise ModelError(problem.what, where=Path(path), cure=problem.cure or "train the model again") from None

    def base(self) -> Predictor:
        """The same model with its Gaussian process held at its mean function, the base variance."""
        return Predictor(arrays_of_base(self.arrays), self.header)

    @property
    def scale(self) -> Array:
        """(6,) factor on each standard deviation, learned from late truth; ones before any."""
        return self._adaptive.scale

    def reset(
        self, camera: StereoCamera | None = None, scale: Array | None = None, vehicle: Vehicle | None = None
    ) -> None:
        """Forget the run so far. ``camera``: of the run, if it is not the one the model was trained with; warns if the
        two are far apart. ``scale``: what was learned earlier from late truth on this odometry. ``vehicle``: of the
        run, any by default."""
        for problem in camera_problems(self.camera, camera):
            warnings.warn(f"this is another camera: {problem}", stacklevel=2)
        self._observer = Observer(self.features, self.target, camera or self.camera, vehicle)
        self._adaptive = AdaptiveScale(scale)
        self._last: tuple[VoRecord, Array] | None = None
        self._stated: dict[int, tuple[Array, Array] | None] = {}
        self._rate_var = np.zeros(6)

    def require_motions(self, where: str | PathLike[str] | None = None) -> Predictor:
        """Itself; ModelError, one line, if the model (file ``where``) predicts the error over windows of motions."""
        if self.target != "frame":
            raise ModelError(
                f"this model predicts the error over {self.target}, not that of each motion",
                where=where,
                cure="train with --target frame; gpvo train itself scores the others",
            )
        return self

    def replay(self, log: VoLog) -> ByStamp:
        """Predictions for a recorded run, by time stamp and in order; starts afresh with its camera."""
        self.reset(log.camera, vehicle=log.vehicle)
        return ByStamp.of(p for p in map(self.step, log) if p is not None)

    def predict(
        self, features: ArrayLike, geometry: ArrayLike | None = None, dt_s: ArrayLike | None = None
    ) -> Prediction:
        """The error's distribution for one row of features (d,) or for many (n, d), in the units of the header.

        ``geometry`` (6, 6) or (n, 6, 6): covariance by the model's geometric method, for the correlations; without it
        the training's typical ones. ``dt_s``: duration of the motion(s), by default the training's.
        """
        X = np.asarray(features, dtype=np.float64)
        rows = np.atleast_2d(X)
        if rows.ndim != 2 or rows.shape[1] != len(self.features):
            raise ModelError(
                f"features have shape {X.shape}, the model takes {len(self.features)}: {', '.join(self.features)}"
            )
        G = None if geometry is None else np.asarray(geometry, dtype=np.float64).reshape(-1, 6, 6)
        dt = None if dt_s is None else np.full(len(rows), dt_s, dtype=np.float64)
        out = self.model.estimate(rows, G, dt)
        return out.row(0) if X.ndim == 1 else out

    def step(self, record: VoRecord) -> Prediction | None:
        """Prediction for the next record of a run, in time order; None while a window is not full yet."""
        seen = self._observer.step(record)
        if seen is None:
            return None
        record, x = self._last = seen
        if record.status is Status.START:
            # The first frame has no motion and hence no error.
            return self._unmeasured(record, np.eye(6) * _NO_MOTION_VAR, 1.0, 1.0)
        method = self.model.base.method
        estimate = self.predict(x, record.covariances.get(method or ""), record.dt_s)
        return self._publish(record, estimate)

    def interval(self, prediction: Prediction, level: float = 0.9) -> Array:
        """(6, 2) ends between which each axis' error lies in a share ``level`` of the motions of a new sequence.

        Their width in sigma is the one that covered the training sequences, each left out in turn, whatever the shape
        of the errors' distribution: :func:`gpvo.learning.calibrate.conformal_quantiles`. The header's
        ``interval_guaranteed`` says by axis and level whether there were enough sequences for a guarantee. Raises
        ModelError for a level that the model does not hold.
        """
        calibration = self.header.get("calibration") or {}
        levels = [float(x) for x in calibration.get("interval_levels", ())]
        at = next((i for i, known in enumerate(levels) if abs(known - level) < 1e-3), None)
        if at is None:
            held = ", ".join(f"{x:g}" for x in levels) or "none"
            raise ModelError(f"the model holds no interval at level {level:g}", cure=f"choose one of: {held}")
        width = np.array([axis[at] for axis in calibration["interval_sigmas"]]) * prediction.sigma
        return np.stack([prediction.mean - width, prediction.mean + width], axis=1)

    def observe(self, xi_true: ArrayLike, t_ns: int | None = None) -> None:
        """Late truth: the error (6,) that the motion ending at ``t_ns`` (default: the last) turned out to have.

        Adapts the scale of later predictions, but for NaN axes and lost motions. Raises GpvoError for another shape.
        """
        xi = np.asarray(xi_true, dtype=np.float64)
        if xi.shape != (6,):
            raise GpvoError(f"an error of shape {xi.shape} is not that of a motion", cure="give (6,) [m, rad]")
        stated = self._stated.get(next(reversed(self._stated), -1) if t_ns is None else t_ns)
        if stated is not None:
            self._adaptive.observe(xi - stated[0], stated[1], self.model.degrees_of_freedom)

    def explain(self, record: VoRecord | None = None) -> list[Influence]:
        """Which inputs drove the prediction of ``record`` (default: the last step), strongest first."""
        seen = self._last
        if record is not None and (seen is None or record.t_ns != seen[0].t_ns):
            seen = copy.deepcopy(self._observer).step(record)
        if seen is None:
            raise ModelError("there is no prediction to explain yet", cure="call step with the earlier records")
        x, dt_s = seen[1], seen[0].dt_s
        typical = np.tile(x, (len(x) + 1, 1))
        typical[np.arange(1, len(x) + 1), np.arange(len(x))] = self.model.domain.centre
        ln_sigma = np.log(self.predict(typical, dt_s=dt_s or self.model.dt_s).sigma)
        gain = ln_sigma[0] - ln_sigma[1:]
        outside = self.model.domain.outside(x)
        unit = self.header.get("units") or [""] * len(x)
        on_translation, on_rotation = (np.exp(gain[:, b].mean(1)).tolist() for b in (slice(0, 3), slice(3, 6)))
        order = np.argsort(-np.abs(gain).sum(1), kind="stable")
        columns = self.features, x.tolist(), unit, on_translation, on_rotation, outside.tolist()
        return [Influence(*(column[i] for column in columns)) for i in order]

    def _publish(self, record: VoRecord, prediction: Prediction) -> Prediction:
        """The prediction for a record in flight: the adapted scale, the record's status, and what is lost."""
        t_ns, status, scale = record.t_ns, record.status, self._adaptive.scale
        if status is Status.LOST:
            return self._publish_lost(record, prediction)
        if prediction.in_domain < DEGRADED_BELOW and status is Status.OK:
            status = Status.DEGRADED
        squared = scale[:, None] * scale
        variance = np.diagonal(prediction.covariance) * scale**2
        if record.dt_s > 0:
            self._rate_var = variance / record.dt_s**2
        self._remember(t_ns, (prediction.mean, np.sqrt(variance)))
        return replace(
            prediction,
            jitter=prediction.jitter * squared,
            white=prediction.white * squared,
            persistent_root=prediction.persistent_root * scale[:, None],
            dt_s=record.dt_s,
            status=status,
            t_ns=t_ns,
            epistemic=np.minimum(prediction.epistemic * scale**2, variance),
            confidence=float(prediction.confidence),
            in_domain=float(prediction.in_domain),
        )

    def _publish_lost(self, record: VoRecord, prediction: Prediction) -> Prediction:
        """What was learned from measured motions does not apply to one that was not measured."""
        covariance = self._lost_covariance(record)
        # Its truth says nothing about the scale of measured motions.
        self._remember(record.t_ns, None)
        p = self._unmeasured(record, covariance, 0.0, float(prediction.in_domain))
        epistemic = np.minimum(prediction.epistemic * self._adaptive.scale**2, variances(covariance))
        return replace(p, epistemic=epistemic)

    def _remember(self, t_ns: int, stated: tuple[Array, Array] | None) -> None:
        self._stated[t_ns] = stated
        if len(self._stated) > _REMEMBERED:
            del self._stated[next(iter(self._stated))]

    def _lost_covariance(self, record: VoRecord) -> Array:
        """(6, 6) of a lost motion: what VO gives is the motion expected of the vehicle, or a jump away from it."""
        slip = self._observer.slip
        # A record that is lost because of its stamps has no usable duration.
        dt_s = record.dt_s if record.dt_s > 0 else self.model.dt_s
        known = np.inf, se3.log(record.T_prev_cur) / dt_s, np.zeros(6)
        if slip.expected is not None:
            known = slip.age_s, slip.expected, self._rate_var
        jump = slip.jump(record.T_prev_cur, dt_s)
        C = self.model.velocities.lost_covariance(self.model.dt_s, dt_s, *known, jump)
        # After a jump of kilometres, rounding alone would make it indefinite.
        return C + np.diag(_NO_MOTION_VAR + _ROUNDING * variances(C))

    def _unmeasured(self, record: VoRecord, white: Array, confidence: float, in_domain: float) -> Prediction:
        return Prediction(
            mean=np.zeros(6),
            jitter=np.zeros((6, 6)),
            white=white,
            persistent_root=np.zeros((6, len(self.model.division.persistent_tau_s))),
            persistent_tau_s=self.model.division.persistent_tau_s,
            dt_s=record.dt_s,
            status=record.status,
            t_ns=record.t_ns,
            epistemic=np.zeros(6),
            confidence=confidence,
            in_domain=in_domain,
        )
