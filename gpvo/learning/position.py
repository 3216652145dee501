"""Training of the thesis' model of positions: GP of the residual on velocity and feature count, isotropic."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gpvo.dataset.build import TrainingSet, leave_one_out
from gpvo.learning.config import TrainConfig
from gpvo.learning.methods import METHODS, average, empty, score
from gpvo.learning.thesis import ThesisModel, fit_thesis
from gpvo.learning.train import TrainedModel, header_of_sets
from gpvo.online.features import THESIS, known_columns, resolve


def train_position(sets: Sequence[TrainingSet], config: TrainConfig, *, judge: bool = True) -> TrainedModel:
    """Learn residuals (n, 3) [m]; ``features="auto"`` means the thesis' own."""
    model = _fit(sets, config)
    folds: list[dict[str, Any]] = []
    for held_out, others in leave_one_out(list(sets)) if judge and len(sets) > 1 else ():
        fitted = _fit(others, config)
        stated = fitted.predict(held_out.select(fitted.columns))
        methods: dict[str, Any] = {m: empty() for m in METHODS} | {"gp_thesis": score(held_out.Y, *stated)}
        folds.append(
            {"held_out": held_out.name, "rows": len(held_out), "lost": held_out.counts["lost"], "methods": methods}
        )
    names, (low, high) = model.columns, _reach(sets, model)
    header = {
        **header_of_sets(sets, config),
        "horizon": "from the first frame",
        "frame": "first camera",
        "features": list(names),
        "units": [known_columns()[name] for name in names],
        "training_domain": {n: [lo, hi] for n, lo, hi in zip(names, low, high)},
        "scores": {f["held_out"]: f["methods"] for f in folds},
    }
    mean = {m: average([f["methods"][m] for f in folds]) if folds else empty() for m in METHODS}
    table = {"schema": 1, "model": None, "features": list(names), "folds": folds, "mean": mean}
    return TrainedModel(model.to_arrays(), header, {**table, "comparison": None}, sets)


def _fit(sets: Sequence[TrainingSet], config: TrainConfig) -> ThesisModel:
    columns = THESIS if config.features == "auto" else resolve(config.features)
    regressor = "sparse" if config.regressor == "auto" else config.regressor
    return fit_thesis(sets, columns, regressor, shared=True, seed=config.seed, inducing=config.inducing)


def _reach(sets: Sequence[TrainingSet], model: ThesisModel) -> tuple[list[float], list[float]]:
    X = np.concatenate([s.select(model.columns) for s in sets])
    X = X[np.isfinite(X).all(axis=1)]
    return X.min(axis=0).tolist(), X.max(axis=0).tolist()
