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
from gpvo.online.features import THESIS, resolve


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


def _fit(sets: Sequence[TrainingSet], config: TrainConfig) -> ThesisModel:
    columns = THESIS if config.features == "auto" else resolve(config.features)
    regressor = "sparse" if config.regressor == "auto" else config.regressor
    return fit_thesis(sets, columns, regressor, shared=True, seed=config.seed, inducing=config.inducing)
