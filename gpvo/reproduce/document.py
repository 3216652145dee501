"""The result as scripts read it: rows, sensitivity, targets; what could not be computed is None."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from gpvo.reproduce.bounds import load_bounds
from gpvo.reproduce.experiments import Experiment, Published
from gpvo.reproduce.run import Cell
from gpvo.reproduce.scores import Pooled, Scores, score
from gpvo.reproduce.store import Store

RATIO = (0.7, 1.5)
MAGNITUDE_BELOW, VECTOR_UP_TO = 0.7, 1.0
_RESIDUAL_TABLES = ("4.3", "4.6")


def scores_of(cells: Sequence[Cell], store: Store) -> dict[Cell, Scores]:
    """Scores of every cell; cells that share their bounds share the work."""
    made: dict[str, Scores] = {}
    out = {}
    for cell in cells:
        path = cell.job.path(store)
        if path.name not in made:
            made[path.name] = score(load_bounds(path))
        out[cell] = made[path.name]
    return out


def rows(scores: Mapping[Cell, Scores]) -> list[dict[str, Any]]:
    """One entry per experiment and mode, in the order of the cells."""
    out: dict[tuple[str, str], dict[str, Any]] = {}
    for cell, found in scores.items():
        e = cell.experiment
        row = out.setdefault((e.key, cell.mode), {**head(e), "mode": cell.mode, "seeds": found.flights, "ways": {}})
        row["ways"][cell.way] = way(found)
    return list(out.values())


def head(e: Experiment) -> dict[str, Any]:
    """What a row says of itself."""
    return {
        "key": e.key,
        "table": e.table,
        "title": e.title,
        "method": e.method,
        "sigma_px": list(e.sigma_px) if e.method == "pointing_matching" else None,
        "warning": e.warning,
        "stands_in": e.stands_in,
        "thesis": None if e.published is None else published(e.published),
    }


def published(p: Published) -> dict[str, float | None]:
    """The thesis' figures, and their ratios."""
    return {
        "rmse_m": p.rmse_m,
        "final_error_m": p.final_m,
        "predicted_final_error_m": p.predicted_m,
        "ratio": p.predicted_m / p.final_m,
        "residual_m": p.residual_m,
        "residual_over_rmse": None if p.residual_m is None else p.residual_m / p.rmse_m,
    }


def way(s: Scores) -> dict[str, Any]:
    """One way of one row."""
    return {
        "seeds": s.flights,
        "rmse_m": s.rmse_m.value,
        "rmse_interval_m": _interval(s.rmse_m),
        "final_error_m": s.final_m.value,
        "final_error_interval_m": _interval(s.final_m),
        "predicted_final_error_m": s.predicted_m.value,
        "ratio": s.ratio.value,
        "ratio_interval": _interval(s.ratio),
        "vector_residual_m": s.vector_m.value,
        "vector_over_rmse": s.vector_over_rmse.value,
        "vector_over_rmse_interval": _interval(s.vector_over_rmse),
        "magnitude_residual_m": s.magnitude_m.value,
        "magnitude_over_rmse": s.magnitude_over_rmse.value,
        "magnitude_over_rmse_interval": _interval(s.magnitude_over_rmse),
        "coverage_3_sigma": s.coverage,
    }


def _interval(p: Pooled) -> list[float] | None:
    return None if p.low is None or p.high is None else [p.low, p.high]


def targets(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """What is asked of the full model, row by row, and whether it is met; None where too few seeds tell."""
    out = []
    for row in rows:
        found = row["ways"].get("full")
        if found is None or row["warning"]:
            continue
        low_high = found["ratio_interval"]
        inside = RATIO[0] <= found["ratio"] <= RATIO[1]
        contains = None if low_high is None else low_high[0] <= 1.0 <= low_high[1]
        out.append(_target(row, f"predicted over actual in [{RATIO[0]}, {RATIO[1]}]", found["ratio"], inside))
        out.append(_target(row, "its interval contains 1", found["ratio"], contains))
        if row["table"] in _RESIDUAL_TABLES:
            m, v = found["magnitude_over_rmse"], found["vector_over_rmse"]
            out.append(_target(row, f"magnitude residual below {MAGNITUDE_BELOW} of RMSE", m, m < MAGNITUDE_BELOW))
            # A model without a mean leaves the error as it is: rounding must not fail it.
            out.append(_target(row, "vector residual not above RMSE", v, v <= VECTOR_UP_TO + 1e-9))
    return out


def _target(row: Mapping[str, Any], what: str, value: float, met: bool | None) -> dict[str, Any]:
    return {"key": row["key"], "mode": row["mode"], "target": what, "value": value, "met": met}
