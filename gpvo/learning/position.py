"""The thesis' model: GP of the position residual on velocity and feature count, isotropic, constant noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from gpvo.dataset.build import TrainingSet
from gpvo.dataset.splits import leave_one_out
from gpvo.learning.config import TrainConfig, supported_columns
from gpvo.learning.methods import METHODS
from gpvo.learning.regressors import get_regressor
from gpvo.learning.scores import average, empty
from gpvo.learning.train import TrainedModel, training_digest, versions
from gpvo.online.features import THESIS, resolve, units
from gpvo.online.position import PositionPredictor
from gpvo.online.projected import NoisyGP
from gpvo.stats.consistency import coverage, crps_gaussian


def train_position(sets: Sequence[TrainingSet], config: TrainConfig, *, judge: bool = True) -> TrainedModel:
    """Learn residuals (n, 3) [m]; ``features="auto"`` means the thesis' own."""
    arrays, header = _fit(sets, config)
    folds: list[dict[str, Any]] = []
    if judge and len(sets) > 1:
        for held_out, others in leave_one_out(list(sets)):
            predictor = PositionPredictor(*_fit(others, config))
            methods = {m: empty() for m in METHODS} | {"gp_thesis": _score(predictor, held_out)}
            folds.append(
                {"held_out": held_out.name, "rows": len(held_out), "lost": held_out.counts["lost"], "methods": methods}
            )
    mean = {m: average([f["methods"][m] for f in folds]) if folds else empty() for m in METHODS}
    table = {
        "schema": 1,
        "model": None,
        "features": header["features"],
        "folds": folds,
        "mean": mean,
        "comparison": None,
    }
    header["scores"] = {f["held_out"]: f["methods"] for f in folds}
    return TrainedModel(arrays, header, table, sets)


def _fit(sets: Sequence[TrainingSet], config: TrainConfig) -> tuple[dict[str, Any], dict[str, Any]]:
    wanted = THESIS if config.features == "auto" else resolve(config.features)
    names = supported_columns(sets, wanted) or THESIS[:3]
    X, Y = np.concatenate([s.select(names) for s in sets]), np.concatenate([s.Y for s in sets])
    known = np.isfinite(X).all(axis=1)
    X, Y = X[known], Y[known]
    centre, scale = X.mean(axis=0), np.maximum(X.std(axis=0), 1e-9)
    options = {} if config.regressor in ("exact", "sklearn") else {"inducing": config.inducing}
    name = "sparse" if config.regressor == "auto" else config.regressor
    fitted = get_regressor(name, n_rows=len(X), isotropic=True, **options).fit(
        (X - centre) / scale, Y, seed=config.seed
    )
    gp = NoisyGP(fitted.gp, np.log(fitted.hyper.noise_var))
    arrays = {**gp.to_arrays("basis."), "feature.centre": centre, "feature.scale": scale}
    cameras = [s.camera for s in sets if s.camera is not None]
    header: dict[str, Any] = {
        "model_schema": 1,
        "target": "position",
        "horizon": "from the first frame",
        "frame": "first camera",
        "features": list(names),
        "units": list(units(names)),
        "camera": asdict(cameras[0]) if cameras else None,
        "training_domain": {n: [float(x.min()), float(x.max())] for n, x in zip(names, X.T)},
        "sequences": [{"name": s.name, "rows": len(s), **s.counts} for s in sets],
        "versions": versions(),
        "training_digest": training_digest(sets),
        "config": config.settings(),
    }
    return arrays, header


def _score(predictor: PositionPredictor, s: TrainingSet) -> dict[str, Any]:
    mean, sigma = predictor.predict(s.select(predictor.features))
    residual = s.Y - mean
    squared = ((residual / sigma) ** 2).mean(axis=1)
    out = empty()
    out["nees_dof"]["translation"], out["nees_dof_median"]["translation"] = (
        float(squared.mean()),
        float(np.median(squared)),
    )
    out["coverage"] = {str(k + 1): float(c) for k, c in enumerate(coverage(residual, sigma))}
    out["crps"]["translation_m"] = float(crps_gaussian(residual, sigma).mean())
    out["rmse_raw"]["translation_m"] = float(np.sqrt((s.Y**2).sum(1).mean()))
    out["rmse_corrected"]["translation_m"] = float(np.sqrt((residual**2).sum(1).mean()))
    return out
