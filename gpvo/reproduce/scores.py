"""The scores of a row: flights pooled over seeds, beside what the thesis prints and what is asked of the full model.

What could not be computed is None.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.reproduce.bounds import Bounds, BoundsJob
from gpvo.reproduce.experiments import Experiment
from gpvo.reproduce.rows import Cell
from gpvo.reproduce.stages import Store
from gpvo.types import Array

RATIO = (0.7, 1.5)
MAGNITUDE_BELOW, VECTOR_UP_TO = 0.7, 1.0
_RESIDUAL_TABLES = ("4.3", "4.6")
_DRAWS = 4000

Interval = tuple[float, float]


@dataclass(frozen=True)
class Scores:
    """One way of one row [m]; the names are those of ``results.json``.

    Roots of mean squares over the flights, ``*_interval``: 95 % of a bootstrap by flight, None with fewer than three.
    ``ratio``: predicted over actual final error. ``vector``: position error after the predicted mean is taken off;
    ``magnitude``: |error| minus its predicted expectation, the thesis' residual. ``coverage_3_sigma``: share of
    position errors inside, per axis.
    """

    seeds: int
    rmse_m: float
    rmse_interval_m: Interval | None
    final_error_m: float
    final_error_interval_m: Interval | None
    predicted_final_error_m: float
    ratio: float
    ratio_interval: Interval | None
    vector_residual_m: float
    vector_over_rmse: float
    vector_over_rmse_interval: Interval | None
    magnitude_residual_m: float
    magnitude_over_rmse: float
    magnitude_over_rmse_interval: Interval | None
    coverage_3_sigma: float


def score(flights: Sequence[Bounds]) -> Scores:
    """Scores over flights; each flight counts alike."""
    squared_error = np.array([(b.error_m**2).sum(1).mean() for b in flights])
    final, predicted = squared_ends(flights)
    vector = np.array([((b.error_m - b.mean_m) ** 2).sum(1).mean() for b in flights])
    expected = [expected_length(b.mean_m, b.covariance_m2) for b in flights]
    magnitude = np.array([((np.linalg.norm(b.error_m, axis=1) - m) ** 2).mean() for b, m in zip(flights, expected)])
    inside = [(np.abs(b.error_m - b.mean_m) <= 3 * b.sigma_m + 1e-9).mean() for b in flights]
    one = np.ones(len(flights))
    return Scores(
        len(flights),
        *pooled(squared_error, one),
        *pooled(final, one),
        pooled(predicted, one)[0],
        *pooled(predicted, final),
        pooled(vector, one)[0],
        *pooled(vector, squared_error),
        pooled(magnitude, one)[0],
        *pooled(magnitude, squared_error),
        float(np.mean(inside)),
    )


def squared_ends(flights: Sequence[Bounds]) -> tuple[Array, Array]:
    """(n,) squared error of the last position of every flight, and what is expected of it [m^2]."""
    final = np.array([(b.error_m[-1] ** 2).sum() for b in flights])
    return final, np.array([b.predicted_m[-1] ** 2 for b in flights])


def expected_length(mean: Array, covariance: Array) -> Array:
    """E|x| of x ~ N(mean (N, 3), covariance (N, 3, 3)).

    ``E sqrt(q) = (4 pi)^-1/2 int_0^inf t^-3/2 (1 - E exp(-t q)) dt`` for q >= 0, with the Laplace transform of a
    quadratic form of normal variables (A. Mathai, S. Provost, "Quadratic forms in random variables", 1992, theorem
    3.2a.2), by the trapezium rule in ln t.
    """
    values, vectors = np.linalg.eigh(covariance)
    values = np.maximum(values, 0.0)
    along = (np.swapaxes(vectors, 1, 2) @ mean[:, :, None])[:, :, 0] ** 2
    scale = np.maximum(values.sum(1) + along.sum(1), 1e-300)
    values, along = values / scale[:, None], along / scale[:, None]
    u = np.linspace(-32.0, 32.0, 401)
    t = np.exp(u)
    spread = 1.0 + 2.0 * values[:, None, :] * t[:, None]
    log_laplace = -(0.5 * np.log(spread) + along[:, None, :] * t[:, None] / spread).sum(2)
    return np.sqrt(scale) * (-np.expm1(log_laplace) / np.sqrt(t)).sum(1) * (u[1] - u[0]) / np.sqrt(4 * np.pi)


def pooled(above: Array, below: Array) -> tuple[float, Interval | None]:
    """``sqrt(mean(above) / mean(below))`` of squares (n,), with an interval over seeds, drawn in pairs."""

    def root_ratio(above: Array, below: Array) -> Array:
        return np.sqrt(np.asarray(above) / np.maximum(below, 1e-300))

    value = float(root_ratio(above.mean(), below.mean()))
    return value, over_seeds(len(above), lambda pick: root_ratio(above[pick].mean(1), below[pick].mean(1)))


def over_seeds(seeds: int, statistic: Callable[[NDArray[np.int64]], Array]) -> Interval | None:
    """95 % of a statistic (draws,) of drawn seeds (draws, seeds), by a bootstrap; None with fewer than three."""
    if seeds < 3:
        return None
    low, high = np.quantile(statistic(np.random.default_rng(0).integers(0, seeds, (_DRAWS, seeds))), [0.025, 0.975])
    return float(low), float(high)


def rows(cells: Sequence[Cell], store: Store) -> list[dict[str, Any]]:
    """One entry per experiment and mode, in the order of the cells, as scripts read it."""
    made: dict[tuple[BoundsJob, ...], Scores] = {}
    out: dict[tuple[str, str], dict[str, Any]] = {}
    for cell in cells:
        # Cells of several tables share their bounds, and the work.
        found = made.get(cell.jobs) or made.setdefault(cell.jobs, score(cell.load(store)))
        key = (cell.experiment.key, cell.mode)
        row = out.setdefault(key, {**_head(cell.experiment), "mode": cell.mode, "seeds": found.seeds, "ways": {}})
        row["ways"][cell.way] = asdict(found)
    return list(out.values())


def _head(e: Experiment) -> dict[str, Any]:
    """What a row says of itself."""
    return {
        "key": e.key,
        "table": e.table,
        "title": e.title,
        "method": e.method,
        "sigma_px": list(e.sigma_px) if e.method == "pointing_matching" else None,
        "warning": e.warning,
        "stands_in": e.stands_in,
        "thesis": None if e.published is None else e.published.document(),
    }


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
