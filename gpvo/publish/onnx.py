"""The predictor as an ONNX graph in double precision, any number of rows at a time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gpvo.errors import require
from gpvo.files import replacing
from gpvo.online.base import motion_noise, positions
from gpvo.online.division import LEAST_LEFT, LN_FASTEST, PARTS
from gpvo.online.estimate import DURATIONS_S, LEAST_VAR, LN_LARGEST, ErrorModel
from gpvo.online.stored import LARGEST
from gpvo.types import Array

OPSET = 17
_INT64 = 7  # TensorProto.INT64
_USUAL_DURATIONS = tuple(zip(("GreaterOrEqual", "LessOrEqual"), DURATIONS_S, strict=True))


def to_onnx(model: ErrorModel, path: Path, *, metadata: dict[str, str] | None = None) -> None:
    """Write the graph.

    Inputs, all double: ``features`` (N, d), NaN where missing; ``geometry`` (N, 6, 6), NaN where unknown; ``dt_s``
    (N,). Outputs: ``mean`` (N, 6), ``covariance`` (N, 6, 6), its parts ``jitter``, ``white``, ``bias``, the root
    ``calibration_root`` of what a wrong calibration makes of the bias, ``epistemic`` (N, 6), ``in_domain``,
    ``confidence``, ``distance`` (N,). ``metadata``: stored beside the feature names; the degrees of freedom ``nu``, 0
    for a Gaussian, are among it. Raises MissingExtraError without the package onnx.

    It is for motions that were measured: the error of a lost one is far larger, and depends on how fast the vehicle
    was, which the graph does not know.
    """
    require("onnx")
    import onnx

    graph = _Graph(onnx)
    _predict(graph, model)
    shapes: dict[str, list[Any]] = {"features": ["N", len(model.columns)], "geometry": ["N", 6, 6], "dt_s": ["N"]}
    square: dict[str, list[Any]] = {name: ["N", 6, 6] for name in ("covariance", *PARTS, "calibration_root")}
    scalar: dict[str, list[Any]] = {name: ["N"] for name in ("in_domain", "confidence", "distance")}
    outputs: dict[str, list[Any]] = {"mean": ["N", 6], **square, "epistemic": ["N", 6], **scalar}
    names = {"features": ",".join(model.columns), **(metadata or {})}
    blob = graph.serialise(shapes, outputs, names)
    with replacing(path) as temporary:
        temporary.write_bytes(blob)


class _Graph:
    """Collects nodes and constants; every method returns the name of a value."""

    def __init__(self, onnx: Any) -> None:
        self._onnx = onnx
        self._nodes: list[Any] = []
        self._constants: list[Any] = []
        self.dt = "dt_s"

    def constant(self, value: ArrayLike, dtype: type = np.float64) -> str:
        name = f"c{len(self._constants)}"
        self._constants.append(self._onnx.numpy_helper.from_array(np.asarray(value, dtype=dtype), name))
        return name

    def __call__(self, op: str, *inputs: ArrayLike, out: str | None = None, **attributes: Any) -> str:
        """One node; numbers and arrays become constants."""
        name = out or f"v{len(self._nodes)}"
        named = [i if isinstance(i, str) else self.constant(i) for i in inputs]
        # Named, as older versions of ONNX Runtime name what they fuse by it.
        self._nodes.append(self._onnx.helper.make_node(op, named, [name], name=name, **attributes))
        return name

    def add(self, *values: str | float, out: str | None = None) -> str:
        total = values[0]
        for i, value in enumerate(values[1:], 2):
            total = self("Add", total, value, out=out if i == len(values) else None)
        return str(total)

    def sum(self, value: str, axis: int) -> str:
        return self("ReduceSum", value, self.constant([axis], np.int64), keepdims=0)

    def take(self, value: str, indices: ArrayLike, axis: int) -> str:
        return self("Gather", value, self.constant(indices, np.int64), axis=axis)

    def expand(self, value: str, axis: int) -> str:
        return self("Unsqueeze", value, self.constant([axis], np.int64))

    def known(self, value: str) -> str:
        """Where a feature is there: not NaN, not infinite, not beyond all measure."""
        return self("Less", self("Abs", value), LARGEST)

    def outer(self, value: str) -> str:
        return self("Mul", self.expand(value, 2), self.expand(value, 1))

    def serialise(self, inputs: dict[str, list[Any]], outputs: dict[str, list[Any]], metadata: dict[str, str]) -> bytes:
        helper, double = self._onnx.helper, self._onnx.TensorProto.DOUBLE
        graph = helper.make_graph(
            self._nodes,
            "gpvo",
            [helper.make_tensor_value_info(name, double, shape) for name, shape in inputs.items()],
            [helper.make_tensor_value_info(name, double, shape) for name, shape in outputs.items()],
            self._constants,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=8)
        model.producer_name = "gpvo"
        helper.set_model_props(model, metadata)
        self._onnx.checker.check_model(model)
        return bytes(model.SerializeToString(deterministic=True))


def _predict(g: _Graph, model: ErrorModel) -> None:
    """The whole graph; line by line ``ErrorModel.estimate``."""
    g.dt = g("Where", g("And", *(g(op, "dt_s", s) for op, s in _USUAL_DURATIONS)), "dt_s", model.dt_s)
    base, plain = (g("Max", _base(g, model, theta), LEAST_VAR) for theta in (model.base.theta, model.base.theta_plain))
    inside, distance, in_domain = _locate(g, model, base)
    log_ratio, spread = _log_ratio(g, model, g.take(inside, model.inputs, axis=1))
    log_noise = g("Max", g("Min", g("Add", log_ratio, g("Mul", spread, 0.5)), LN_LARGEST), -LN_LARGEST)
    near = g.expand(in_domain, 1)
    growth = g.expand(g("Pow", g("Add", distance, 1.0), float(model.outside_power[0])), 1)
    known = g("Mul", base, g("Exp", g("Sub", log_noise, g("Mul", spread, 0.5))))
    short = g("Max", g("Sub", model.high, log_noise), 0.0)
    cautious = g("Add", log_noise, g("Mul", g("Sub", 1.0, near), short))
    more = g("Mul", g("Sub", 1.0, near), g("Max", g("Sub", plain, base), 0.0))
    noise = g("Mul", g("Add", base, more), g("Exp", cautious))
    total = g("Mul", noise, growth)
    factor = g.constant(model.factor)
    variance = _within(g, g("Mul", total, factor), _limit(g, model))
    g("Mul", variance, g("Sub", 1.0, g("Div", known, total)), out="epistemic")
    root, rest = _of_calibration(g, model, variance)
    sigmas = [g("Sqrt", g("Mul", rest, share)) for share in _shares(g, model, rest)]
    each = zip(PARTS, sigmas, _correlations(g, model), strict=True)
    jitter, white, bias = (g("Mul", g.outer(sigma), R, out=None if name == "bias" else name) for name, sigma, R in each)
    # Not a product with the transpose: ONNX Runtime, to 1.23 at least, fuses these into one that it lacks for doubles.
    square = g("Einsum", root, root, equation="nij,nkj->nik")
    parts = [jitter, white, g("Add", bias, square, out="bias")]
    covariance = g.add(*parts, out="covariance")
    ln_det = g.add(*(g("Log", pivot) for pivot in _pivots(g, covariance)))
    g("Mul", base, 0.0, out="mean")
    precision = g("Exp", g("Div", g("Sub", model.typical_ln_det[0], ln_det), 12.0))
    g("Mul", g("Min", precision, 1.0), in_domain, out="confidence")


def _locate(g: _Graph, model: ErrorModel, base: str) -> tuple[str, str, str]:
    domain = model.domain
    by_velocity, by_acceleration = (g.constant(m / domain.scale**2) for m in motion_noise(model.columns))
    squared_dt = g.expand(g("Mul", g.dt, g.dt), 1)
    noise = g.add(g("MatMul", base, by_velocity), g("Div", g("MatMul", base, by_acceleration), squared_dt))
    known = g.add(g("Div", noise, squared_dt), 1.0)
    u = g("Div", g("Sub", "features", domain.centre), domain.scale)
    present = g.known("features")
    u = g("Where", present, u, 0.0)
    inside = g("Min", g("Max", u, domain.low), domain.high)
    away = g("Sub", u, g("Min", g("Max", u, domain.least), domain.most))
    charged = g("Where", present, 0.0, g.constant(domain.charge_of_missing))
    beyond = g.sum(g("Add", g("Div", g("Mul", away, away), known), charged), 1)
    white = g("MatMul", inside, domain.whitening)
    joint = g("Max", g("Sub", g("Sqrt", g.sum(g("Mul", white, white), 1)), float(domain.radius[0])), 0.0)
    squared = g("Add", beyond, g("Mul", joint, joint))
    distance = g("Sqrt", squared, out="distance")
    return inside, distance, g("Exp", g("Mul", squared, -0.5), out="in_domain")


def _log_ratio(g: _Graph, model: ErrorModel, inputs: str) -> tuple[str, str]:
    """Log of the variance over the base, and the variance of that log; ``ProjectedGP.evaluate``."""
    gp = model.gp
    u = g("Div", g("Sub", inputs, gp.centre), gp.lengthscale)
    cross = g("MatMul", u, gp.points.T)
    norms = g("Mul", g.expand(g.sum(g("Mul", u, u), 1), 1), 0.5)
    k = g("Exp", g("Min", g("Sub", g("Sub", cross, norms), 0.5 * (gp.points**2).sum(1)), 0.0))
    z = g("MatMul", k, gp.projection.T)
    explained = g("MatMul", g("Mul", z, z), gp.reduction.T)
    mean = g("Add", g("MatMul", z, gp.weights.T), gp.offset)
    return mean, g("Max", g("Sub", gp.signal_var, explained), 0.0)


def _limit(g: _Graph, model: ErrorModel) -> str:
    """(N, 6): no motion is more wrong than VO's and the usual one are long."""
    at = positions(model.columns, model.base.columns)[:6]
    rate = g.take("features", at, axis=1)
    rate = g("Where", g.known(rate), rate, model.absent[:6])
    dt = g.expand(g.dt, 1)
    moved = g("Mul", g("Add", g("Mul", rate, rate), model.velocities.usual_rate_var), g("Mul", dt, dt))
    return g("MatMul", moved, np.kron(np.eye(2), np.ones((3, 3))))


def _within(g: _Graph, variance: str, limit: str) -> str:
    ratio = g("Min", g("Div", variance, limit), 1e8)
    limited = g("Div", g("Mul", limit, ratio), g("Sqrt", g("Add", g("Mul", ratio, ratio), 1.0)))
    return g("Max", limited, LEAST_VAR)


def _base(g: _Graph, model: ErrorModel, theta: Array) -> str:
    domain = model.domain
    at = positions(model.columns, model.base.columns)
    columns = g.take("features", at, axis=1)
    columns = g("Where", g.known(columns), columns, model.absent)
    dt = g.expand(g.dt, 1)
    moved = [g("Mul", g.take(columns, part, axis=1), dt) for part in ([0, 1, 2], [3, 4, 5])]
    squared = [g.expand(g.sum(g("Mul", part, part), 1), 1) for part in moved]
    terms = [g("Mul", squared[i], theta[:, 2 + i]) for i in range(2)]
    if len(at) >= 12:
        least = g.constant((domain.centre + domain.scale * domain.low)[at][6:])
        known = g("Exp", g("Min", g("Max", g.take(columns, np.arange(6, len(at)), axis=1), least), LN_LARGEST))
        geometry = g.take(known, np.arange(6), axis=1)
        terms.append(g("Mul", geometry, theta[:, 0]))
        if len(at) > 12:
            noise = g.take(known, [6], axis=1)
            at_residual = g("Mul", geometry, g("Mul", noise, noise))
            terms.append(g("Mul", at_residual, theta[:, 4]))
    return g.add(*terms, g.constant(theta[:, 1]))


def _correlations(g: _Graph, model: ErrorModel) -> list[str]:
    """Of each part (N, 6, 6)."""
    weight = float(model.division.geometry_weight[0])
    flat = g("Reshape", "geometry", g.constant([-1, 36], np.int64))
    both = g("Mul", g("Add", "geometry", g("Transpose", "geometry", perm=[0, 2, 1])), 0.5)
    own = g("Div", both, g.outer(g("Sqrt", g.take(flat, np.arange(6) * 7, axis=1))))
    pivots = _pivots(g, g("Add", own, 1e-6 * np.eye(6)))
    definite = g("Cast", g("Greater", g("Concat", *(g.expand(p, 1) for p in pivots), axis=1), 0.0), to=_INT64)
    definite = g("Equal", g("ReduceMin", definite, axes=[1], keepdims=0), g.constant(1, np.int64))
    known = g.expand(g.expand(definite, 1), 1)
    own = g("Mul", g("Where", known, own, 0.0), weight)
    out = []
    for i, R in enumerate(model.division.correlation):
        typical = g.constant(R)
        mixed = g("Add", own, R * (1.0 - weight)) if weight > 0 and i < 2 else typical
        chosen = g("Mul", g("Where", known, mixed, typical), 1.0 - 1e-6)
        out.append(g("Add", chosen, 1e-6 * np.eye(6)))
    return out


def _of_calibration(g: _Graph, model: ErrorModel, variance: str) -> tuple[str, str]:
    """Its root (N, 6, 6) and what is left of the variance (N, 6); ``gpvo.online.division.of_calibration``."""
    v = g.take("features", positions(model.columns, model.base.columns)[:6], axis=1)
    patterns = np.transpose(model.division.calibration_patterns, (2, 1, 0)).reshape(6, 36)
    lasted = g("Mul", g("Where", g.known(v), v, 0.0), g.expand(g("Div", g.dt, model.dt_s), 1))
    flat = g("MatMul", lasted, patterns)
    root = g("Reshape", flat, g.constant([-1, 6, 6], np.int64))
    left = g("Div", variance, g("Add", variance, g.sum(g("Mul", root, root), 2)))
    rest = g("Mul", variance, g("Max", left, LEAST_LEFT))
    return g("Mul", root, g.expand(g("Sqrt", left), 2), out="calibration_root"), rest


def _shares(g: _Graph, model: ErrorModel, variance: str) -> list[str]:
    """Of jitter, white and bias (N, 6); line by line ``gpvo.online.division.divide`` and ``ln_faster``."""
    v = g.take("features", positions(model.columns, model.base.columns)[:3], axis=1)
    there = g.known(v)
    known = g("Equal", g("ReduceMin", g("Cast", there, to=_INT64), axes=[1]), g.constant(1, np.int64))
    v = g("Where", there, v, 0.0)
    speed = g("Sqrt", g.expand(g.sum(g("Mul", v, v), 1), 1))
    ratio = g("Sub", g("Log", g("Max", speed, 1e-9)), model.division.ln_speed)
    faster = g("Where", known, g("Max", g("Min", ratio, LN_FASTEST), 0.0), 0.0)
    by_speed = g("Mul", faster, model.division.growth[0])
    above = g("Mul", g("Sub", g("Log", variance), model.division.level), model.division.growth[1])
    by_noise = g("Max", g("Min", above, 60.0), -60.0)
    jitter = g.constant(model.division.share[0])
    white = g("Mul", g("Exp", by_speed), model.division.share[1])
    bias = g("Mul", g("Exp", g("Add", by_speed, by_noise)), model.division.share[2])
    whole = g.add(jitter, white, bias)
    return [g("Div", part, whole) for part in (jitter, white, bias)]


def _pivots(g: _Graph, matrices: str) -> list[str]:
    """The six pivots (N,) of matrices (N, 6, 6) by Cholesky's method, of successive Schur complements: the factors of
    the determinant, all positive where a matrix is positive definite."""
    rest, pivots = matrices, []
    for size in range(6, 0, -1):
        pivot = g.take(g.take(rest, [0], axis=2), [0], axis=1)
        pivots.append(g("Reshape", pivot, g.constant([-1], np.int64)))
        if size > 1:
            others = np.arange(1, size)
            lower, right = g.take(rest, others, axis=1), g.take(g.take(rest, [0], axis=1), others, axis=2)
            below, block = g.take(lower, [0], axis=2), g.take(lower, others, axis=2)
            rest = g("Sub", block, g("Div", g("MatMul", below, right), pivot))
    return pivots
