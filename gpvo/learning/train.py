"""Training: the model from all sequences, and the table of what it would have predicted for each one left out."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo import __version__
from gpvo.dataset.build import MIN_ROWS, MIN_SEQUENCES, TrainingSet, leave_out
from gpvo.errors import GpvoError, ModelError
from gpvo.files import read_json, write_json
from gpvo.geometry.covariance import variances
from gpvo.io.run_read import Run
from gpvo.io.snapshot import code_digest
from gpvo.learning.config import TrainConfig
from gpvo.learning.fit import NONE, Learned, fit_model
from gpvo.learning.methods import METHODS, average, empty, method_arrays, score, simple_covariances, stated_and_actual
from gpvo.learning.regressors.numerics import fixed_threads
from gpvo.learning.rows import checked, of_target
from gpvo.learning.sample import draw_sample
from gpvo.learning.thesis import ThesisModel, fit_thesis
from gpvo.online import modelfile
from gpvo.online.estimate import ErrorModel
from gpvo.online.features import AXES, THESIS, known_columns, resolve
from gpvo.online.predictor import Predictor
from gpvo.parallel import map_jobs
from gpvo.stats.consistency import nees, seen_axes
from gpvo.stats.series import Interval, sequence_bootstrap
from gpvo.types import Array, Prediction

OnFit = Callable[[int, int], None]
"""Told how many fits of a training are done, of how many."""
MOST_FOLDS = 24
"""More runs than this are left out in so many parts: a fit for each of hundreds would take days."""
JUDGED_BLOCKS = 3
"""Parts of a single sequence that are left out in turn."""
SLIP_MEDIANS, SLIP_SIGMAS = 20.0, 5.0
"""A translation error longer than so many medians of its sequence counts as a slip in the report; if it was not called
one, only if it is also so many sigma longer than stated: an expected error is noise."""


@dataclass(frozen=True)
class TrainedModel:
    """``arrays`` and ``header`` are the model file; ``table`` the document of the command (see :func:`train_table`)."""

    arrays: Mapping[str, NDArray[Any]]
    header: dict[str, Any]
    table: dict[str, Any] = field(default_factory=dict)
    sets: Sequence[TrainingSet] = ()

    def predictor(self) -> Predictor:
        """The predictor of this model, without a detour through a file."""
        return Predictor(self.arrays, self.header)


def train(
    runs: Iterable[Run | str | Path], config: TrainConfig | None = None, *, on_fit: OnFit = lambda done, total: None
) -> TrainedModel:
    """Learn from runs with ground truth, or their folders, and judge by leaving each run out, or parts of many;
    :func:`gpvo.learning.store.save_model` writes the result.

    ``on_fit`` is called with how many fits are done, of how many, for progress bars. Raises GpvoError if a run has no
    truth, or the runs do not belong together.
    """
    config = config or TrainConfig()
    several = [runs] if isinstance(runs, str | Path | Run) else runs
    return train_sets([config.rows_of(r) for r in several], config, on_fit=on_fit)


# On one thread: sums split otherwise round otherwise, and the same rows must give the same bytes on any machine.
@fixed_threads(1)
def train_sets(
    sets: Sequence[TrainingSet], config: TrainConfig, *, judge: bool = True, on_fit: OnFit = lambda done, total: None
) -> TrainedModel:
    """The same from training sets. ``judge`` False leaves the table out."""
    if config.target == "position":
        return _train_position(of_target(sets, config.target), config, judge, on_fit)
    sets = checked(sets, config.target)
    table = train_table(sets, config, on_fit) if judge else {}
    learned, thesis = fit_model(sets, config), fit_thesis(sets, seed=config.seed)
    sample = draw_sample(sets, learned.model.columns, learned.model.base.method)
    arrays = {**learned.arrays, **method_arrays(sets), **sample.to_arrays(), **thesis.to_arrays()}
    header = _header(sets, config, learned, table)
    document = {"schema": 1, "model": None, "features": header["features"], **table}
    return _loadable(TrainedModel(arrays, header, document, sets))


def _loadable(trained: TrainedModel) -> TrainedModel:
    """Itself; GpvoError, one line, where its file would be refused."""
    try:
        trained.predictor()
    except ModelError as problem:
        raise GpvoError(
            f"no model explains errors that differ so much from run to run, or so much from what is stated:"
            f" {problem.what}",
            cure="'gpvo evaluate RUN' shows where odometry and truth differ; are all in metres?",
        ) from None
    return trained


def unseen_axes(sets: Sequence[TrainingSet]) -> list[str]:
    """The axes on which a training has filled in errors, because log and truth never differ there."""
    seen = seen_axes(np.concatenate([s.Y for s in sets]))
    return [name for k, name in enumerate(AXES) if k not in seen]


def train_table(
    sets: Sequence[TrainingSet], config: TrainConfig, on_fit: OnFit = lambda done, total: None
) -> dict[str, Any]:
    """``folds`` (a sequence left out, all methods), ``mean`` over them, and ``comparison`` with the best scaled row.

    Each sequence is judged by what did not learn from it: from all others, or from those in other parts where there are
    more than :data:`MOST_FOLDS`. For a single sequence, blocks of time are left out: they say less, and have no
    intervals; see ``folds_are``.
    """
    folds = _folds(sets if len(sets) > 1 else time_blocks(sets[0]), config, on_fit)
    if not folds:
        return {"folds": [], "folds_are": None, "mean": {m: empty() for m in METHODS}, "comparison": None}
    mean = {m: average([f["methods"][m] for f in folds]) for m in METHODS}
    comparison = _compare(folds, mean)
    if len(sets) == 1:  # blocks of one flight are no sample of flights
        for name in ("nll_per_dim_difference", "learned_less_base"):
            comparison[name] |= {"low": None, "high": None}
    return {
        "folds": folds,
        "folds_are": "sequences" if len(sets) > 1 else "time blocks",
        "mean": mean,
        "comparison": comparison,
    }


def _folds(parts: Sequence[TrainingSet], config: TrainConfig, on_fit: OnFit) -> list[dict[str, Any]]:
    """Each part's line of the table, from a fit without it; none of a part alone."""
    jobs = [(held_out, train_on, config) for held_out, train_on in leave_out(parts, MOST_FOLDS) if train_on]
    done, total = count(1), len(jobs) + 1  # and the model itself
    on_fit(0, total)
    judged = map_jobs(
        _kept_fold,
        jobs,
        jobs=config.jobs,
        backend=config.backend,
        scheduler=config.scheduler,
        on_done=lambda: on_fit(next(done), total),
    )
    return [judged[k % len(jobs)][k // len(jobs)] for k in range(len(parts) if jobs else 0)]


def time_blocks(s: TrainingSet) -> list[TrainingSet]:
    """A sequence in ``JUDGED_BLOCKS`` consecutive parts; a single part if it is short."""
    if len(s) < JUDGED_BLOCKS * 2 * MIN_ROWS:
        return [s]
    counts = {**s.counts, "lost": 0, "slips": 0, "truth_moves_at_rest": 0, "odd": 0}
    bare = replace(s, counts=counts, lost_xi=np.zeros((0, 6)), lost_jump=np.zeros((0, 6)))
    rows = np.array_split(np.arange(len(s)), JUDGED_BLOCKS)
    return [replace(bare.rows(r), name=f"{s.name}, part {k + 1}") for k, r in enumerate(rows)]


def _kept_fold(
    held_out: Sequence[TrainingSet], train_on: Sequence[TrainingSet], config: TrainConfig
) -> list[dict[str, Any]]:
    """A fold, from ``config.keep`` if an interrupted training has left it there."""
    if config.keep is None:
        return _fold(held_out, train_on, config)
    model = fold_model(held_out, train_on, config, config.keep)
    path = model.with_suffix(".json")
    if not path.is_file():
        write_json(path, {"folds": _fold(held_out, train_on, config, model)})
    return list(read_json(path)["folds"])


def fold_model(
    held_out: Sequence[TrainingSet], train_on: Sequence[TrainingSet], config: TrainConfig, keep: str
) -> Path:
    """Where a training in progress keeps the model that has not learned from some sequences; its scores lie beside
    it."""
    sha = hashlib.sha256(repr((code_digest(), versions(), config.settings(), len(held_out))).encode())
    for s in (*held_out, *train_on):
        sha.update(repr((s.digest(), s.counts, s.camera)).encode() + s.lost_xi.tobytes() + s.lost_jump.tobytes())
    return Path(keep) / f"{sha.hexdigest()}.gpvo"


@fixed_threads(1)
def _fold(
    held_out: Sequence[TrainingSet], train_on: Sequence[TrainingSet], config: TrainConfig, model: Path | None = None
) -> list[dict[str, Any]]:
    """All methods fitted without some sequences and scored on each of these; the fitted ones go into the file
    ``model``."""
    if config.target == "position":
        return _position_fold(held_out, _fit_position(train_on, config))
    arrays, thesis = method_arrays(train_on), fit_thesis(train_on, seed=config.seed)
    learned = fit_model(train_on, config)
    if model is not None:
        fitted = {**learned.arrays, **arrays, **thesis.to_arrays()}
        modelfile.save(model, fitted, _header(train_on, config, learned, {}))
    return [_judged(s, arrays, thesis, learned) for s in held_out]


def _judged(
    held_out: TrainingSet, arrays: Mapping[str, Array], thesis: ThesisModel, learned: Learned
) -> dict[str, Any]:
    """A line of the table: what each method states of a sequence that none of them has learned from, and its scores."""
    simple = simple_covariances(arrays, held_out.covariances, held_out.v_t, len(held_out))
    stated: dict[str, tuple[Any, ...]] = {name: (np.zeros_like(held_out.Y), C) for name, C in simple.items()}
    stated["gp_thesis"] = thesis.predict(held_out.select(thesis.columns))
    estimate, of_base = (estimate_set(model, held_out) for model in (learned.model, learned.base))
    stated["learned"] = (estimate.mean, estimate.covariance, estimate.nu)
    stated["base"] = (of_base.mean, of_base.covariance, of_base.nu)
    methods = {name: _scored(held_out, *stated[name]) if name in stated else empty() for name in METHODS}
    return {
        "held_out": held_out.name,
        "rows": len(held_out),
        "lost": held_out.counts["lost"],
        "truth_moves_at_rest": held_out.counts.get("truth_moves_at_rest", 0),
        "odd": held_out.counts.get("odd", 0),
        "methods": methods,
        "in_domain": float(np.mean(estimate.in_domain > 0.5)),
        "stated_and_actual": stated_and_actual(held_out.Y, estimate.mean, estimate.covariance),
        "slips": _slips(held_out, estimate, learned, arrays["method.constant"]),
        "choices": learned.choices,
    }


def _scored(s: TrainingSet, mean: Array, covariance: Array, nu: float = math.inf) -> dict[str, Any]:
    """Scores by the truth as it is told, its noise added to what is stated."""
    if s.told is None or s.truth_noise is None:
        return score(s.Y, mean, covariance, nu, seen_axes(s.Y))
    d = covariance.shape[-1]
    return score(s.told, mean, covariance + s.truth_noise[:, :d, :d], nu, seen_axes(s.told))


def estimate_set(model: ErrorModel, s: TrainingSet) -> Prediction:
    """The online predictor's own arithmetic over the rows of a sequence."""
    return model.estimate(s.select(model.columns), s.covariances.get(model.base.method or ""), s.dt_s)


def _slips(s: TrainingSet, estimate: Prediction, learned: Learned, constant: Array) -> dict[str, Any]:
    """Gross errors caught, and those missed although unexpected; good motions flagged; and NEES/dof including the
    caught ones."""
    length, lost_length = (np.linalg.norm(xi[:, :3], axis=1) for xi in (s.Y, s.lost_xi))
    stated = np.sqrt(np.trace(estimate.covariance[:, :3, :3], axis1=1, axis2=2))
    gross = (length > SLIP_MEDIANS * np.median(length)) & (length > SLIP_SIGMAS * stated)
    gross_lost = lost_length > SLIP_MEDIANS * np.median(length)
    dt_s = learned.model.dt_s
    rate_var = variances(estimate.covariance).mean(axis=0) / dt_s**2
    velocities = learned.model.velocities
    lost = [velocities.lost_covariance(dt_s, dt_s, dt_s, np.zeros(6), rate_var, jump) for jump in s.lost_jump]
    learned_all = np.concatenate(
        [nees(s.Y - estimate.mean, estimate.covariance), nees(s.lost_xi, np.reshape(lost, (-1, 6, 6)))]
    )
    constant_all = nees(np.concatenate([s.Y, s.lost_xi]), constant)
    return {
        "caught": int(gross_lost.sum()),
        "missed": int(gross.sum()),
        "falsely_flagged": int((~gross_lost).sum()),
        "nees_dof_with_slips": {"learned": float(learned_all.mean() / 6), "constant": float(constant_all.mean() / 6)},
    }


def _compare(folds: Sequence[dict[str, Any]], mean: Mapping[str, Any]) -> dict[str, Any]:
    """Mean NLL of ``learned`` minus that of the best other row and of ``base``, with paired bootstrap intervals over
    the sequences."""
    scored = {m: mean[m]["nll_per_dim"] for m in METHODS if mean[m]["nll_per_dim"] is not None}
    rivals = {m: v for m, v in scored.items() if m not in ("base", "learned")}
    best = min(rivals, key=rivals.__getitem__)
    return {
        "rival": best,
        "best_row": min(scored, key=scored.__getitem__),
        "nll_per_dim_difference": paired_nll(folds, "learned", best).document(),
        "learned_less_base": paired_nll(folds, "learned", "base").document(),
    }


def paired_nll(folds: Sequence[dict[str, Any]], method: str, rival: str) -> Interval:
    """Bootstrap over sequences of the difference in NLL per dimension, ``method`` minus ``rival``."""
    pairs = [(f["methods"][method]["nll_per_dim"], f["methods"][rival]["nll_per_dim"]) for f in folds]
    return sequence_bootstrap(np.array([a - b for a, b in pairs if a is not None and b is not None]))


def versions() -> dict[str, str]:
    """Versions of gpvo and of the packages on which the numbers depend."""
    return {"gpvo": __version__, **{name: version(name) for name in ("numpy", "scipy", "torch")}}


def training_digest(sets: Sequence[TrainingSet]) -> str:
    """SHA-256 over the rows of all sequences."""
    return hashlib.sha256("".join(sorted(s.digest() for s in sets)).encode()).hexdigest()


def header_of_sets(
    sets: Sequence[TrainingSet], config: TrainConfig, columns: Sequence[str], reach: tuple[Array, Array],
    folds: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:  # fmt: skip
    """What the header of every kind of model says about its training; ``reach``: least and largest value (d,) of each
    feature."""
    low, high = reach
    cameras = [s.camera for s in sets if s.camera is not None]
    return {
        "model_schema": 1,
        "target": config.target,
        "camera": asdict(cameras[0]) if cameras else None,
        "odometry": {k: v for k, v in sets[0].odometry.items() if all((k, v) in s.odometry.items() for s in sets)},
        "sequences": [{"name": s.name, "rows": len(s), **s.counts} for s in sets],
        "versions": versions(),
        "training_digest": training_digest(sets),
        "config": config.settings(),
        "features": list(columns),
        "units": [known_columns()[name] for name in columns],
        "training_domain": {n: [lo, hi] for n, lo, hi in zip(columns, low.tolist(), high.tolist())},
        "scores": {f["held_out"]: f["methods"] for f in folds},
    }


def _header(
    sets: Sequence[TrainingSet], config: TrainConfig, learned: Learned, table: Mapping[str, Any]
) -> dict[str, Any]:
    model = learned.model
    return {
        **header_of_sets(sets, config, model.columns, model.domain.reach, table.get("folds", [])),
        "frame": "cam",
        "tangent": "translation then rotation, right perturbation, m and rad",
        "horizon": "one motion" if config.target == "frame" else config.target,
        "inputs": [] if learned.choices["inputs"] == NONE else [model.columns[i] for i in model.inputs],
        "base_method": model.base.method,
        "dt_s": model.dt_s,
        "rate_hz": 1.0 / model.dt_s,
        "choices": learned.choices,
        "calibration": learned.calibration,
        "by_few_sequences": len(sets) < MIN_SEQUENCES,
        "comparison": table.get("comparison"),
    }


def _train_position(sets: Sequence[TrainingSet], config: TrainConfig, judge: bool, on_fit: OnFit) -> TrainedModel:
    """The thesis' model of positions: a GP of the residuals (n, 3) [m] on velocity and feature count, isotropic;
    ``features="auto"`` means these."""
    model = _fit_position(sets, config)  # before the folds: a regressor may refuse so many rows
    folds = _folds(sets, config, on_fit) if judge else []
    X = np.concatenate([s.select(model.columns) for s in sets])
    X = X[np.isfinite(X).all(axis=1)]
    header = {
        **header_of_sets(sets, config, model.columns, (X.min(axis=0), X.max(axis=0)), folds),
        "horizon": "from the first frame",
        "frame": "first camera",
    }
    mean = {m: average([f["methods"][m] for f in folds]) if folds else empty() for m in METHODS}
    table = {"schema": 1, "model": None, "features": header["features"], "folds": folds, "mean": mean}
    return TrainedModel(model.to_arrays(), header, {**table, "comparison": None}, sets)


def _position_fold(held_out: Sequence[TrainingSet], of_others: ThesisModel) -> list[dict[str, Any]]:
    folds: list[dict[str, Any]] = []
    for s in held_out:
        stated = of_others.predict(s.select(of_others.columns))
        methods: dict[str, Any] = {m: empty() for m in METHODS} | {"gp_thesis": score(s.Y, *stated)}
        folds.append({"held_out": s.name, "rows": len(s), "lost": s.counts["lost"], "methods": methods})
    return folds


def _fit_position(sets: Sequence[TrainingSet], config: TrainConfig) -> ThesisModel:
    columns = THESIS if config.features == "auto" else resolve(config.features)
    regressor = "sparse" if config.regressor == "auto" else config.regressor
    return fit_thesis(sets, columns, regressor, shared=True, seed=config.seed, inducing=config.inducing)
