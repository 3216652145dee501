"""Before flight: does a model fit this camera, this rate and these conditions?"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.dataset.build import observe, that_matter
from gpvo.errors import GpvoError
from gpvo.io.run_read import Run
from gpvo.online.guard import camera_problems
from gpvo.online.predictor import Predictor
from gpvo.types import Array, VoLog, VoRecord

_RATE, _ROWS, _AT_ONCE = 0.2, 8, 10_000
ENOUGH_INSIDE = 0.8
"""A model fits a run if at least this share of its frames lies in the training domain; in a vehicle's next flight of
the same kind, a tenth may lie outside."""


@dataclass(frozen=True)
class Check:
    """``in_domain``: share of usable frames in the training domain. ``problems``: one line each, none if it fits."""

    frames: int
    usable: int
    in_domain: float
    farthest: tuple[tuple[str, float], ...]
    problems: tuple[str, ...]

    @property
    def fits(self) -> bool:
        """Whether nothing was found."""
        return not self.problems

    @property
    def misfits(self) -> tuple[str, ...]:
        """The problems besides unknown conditions, of which ``in_domain`` speaks."""
        return self.problems[:-1] if self.in_domain < ENOUGH_INSIDE else self.problems


def check(predictor: Predictor, run: Run) -> Check:
    """Compare a run (a few seconds of the vehicle's own) with what a model was trained on."""
    problems = [*camera_problems(predictor.camera, run.log.camera), *odometry_problems(predictor, run.settings)]
    problems += rate_problems(predictor, (r for r in run.log if r.usable))
    twin, known = run.meta.get("twin") or {}, predictor.header.get("simulated_truth") or []
    if any(s.get("of") == twin.get("of") and s.get("seed") == twin.get("seed") for s in known if twin):
        problems.append(f"it learned from these very twins of {twin['of']}: judge it by others, with another --seed")
    records, X = observe(run.log, predictor.features, predictor.target)
    if not twin and _learned_from(predictor, X):
        problems.append("it learned from this very run, which says nothing about others: judge it by another")
    seen = VoLog(records)
    X = X[seen.usable]
    missing = [n for n, lacks in zip(predictor.features, _mean(~np.isfinite(X))) if lacks > 0.5]
    if missing:
        problems.append(f"the run lacks features the model needs: {', '.join(missing)}")
    dt_s, at = seen.column("dt_s")[seen.usable], range(0, len(X), _AT_ONCE)
    places = [predictor.model.locate(X[k : k + _AT_ONCE], dt_s[k : k + _AT_ONCE]).in_domain > 0.5 for k in at]
    inside = float(_mean(np.concatenate(places or [np.zeros(0, bool)])))
    beyond = _mean(predictor.model.domain.outside(X))
    order = np.argsort(-beyond, kind="stable")[:3]
    farthest = tuple((predictor.features[i], float(beyond[i])) for i in order if beyond[i] > 0)
    if inside < ENOUGH_INSIDE:
        problems.append(f"only {100 * inside:.0f} % of the frames lie inside the training domain")
    return Check(len(run.log), len(X), inside, farthest, tuple(problems))


def warn_of_misfits(model: Path | None, predictor: Predictor | None, run: Run) -> tuple[str, ...]:
    """Warn of each problem that :func:`check` finds, and return its misfits. ``model``: the file, to name it; without
    one, the model of the predictions that are stored with the run, see :func:`predictor_of`."""
    predictor = predictor or predictor_of(run)
    if predictor is None:
        return ()
    found = check(predictor, run)
    for problem in found.problems:
        warnings.warn(
            f"{'the model' if model is None else model.name} does not fit {run.name}: {problem}", stacklevel=2
        )
    return found.misfits


def predictor_of(run: Run) -> Predictor | None:
    """The model of the predictions that are stored with a run; None where its file is gone, or is another now."""
    path = run.meta.get("model")
    if not run.predictions or not isinstance(path, str):
        return None
    try:
        found = Predictor.load(path)
    except GpvoError:
        return None
    return found if found.digest == run.meta.get("model_digest") else None


def _learned_from(predictor: Predictor, X: Array) -> bool:
    """Whether most rows that the model file keeps of one of its training sequences are among these features (N, d)."""
    kept, sequence = predictor.arrays.get("sample.X"), predictor.arrays.get("sample.sequence")
    if kept is None or sequence is None:  # an older file
        return False
    here, there = ([row.tobytes() for row in np.nan_to_num(rows).astype(np.float32)] for rows in (X, kept))
    both = set(here) & set(there)
    known = np.array([row in both for row in there])
    enough = len(both) >= _ROWS  # a vehicle at rest has the same few rows in every run
    return enough and any(known[sequence == s].mean() > 0.5 for s in np.unique(sequence))


def _mean(rows: NDArray[Any]) -> Array:
    """Over rows (n, ...), 0 where there are none."""
    return np.asarray(rows.mean(axis=0) if len(rows) else np.zeros(rows.shape[1:]))


def odometry_problems(predictor: Predictor, settings: Mapping[str, Any]) -> list[str]:
    """Whether gpvo's own odometry, with these ``settings``, is what a model was trained on; a line if not."""
    trained = predictor.header.get("odometry") or {}
    here = that_matter(settings)
    if here and predictor.camera is None:
        return ["the model was trained on another odometry's poses, not on images"]
    unread = {k for k, method in _COVARIANCE.items() if not any(method in name for name in predictor.features)}
    other = [
        f"{k} is {_word(v)}, not {_word(trained[k])}"
        for k, v in here.items()
        if k in trained and trained[k] != v and k not in unread
    ]
    return [f"the model was trained on odometry with other settings: {'; '.join(other)}"] if other else []


# The covariance that a setting is for: it does not matter to a model that reads another.
_COVARIANCE = {"sigma_px": "triangulation", "sigma_p_px": "pointing_matching", "sigma_m_px": "pointing_matching"}


def _word(value: object) -> object:
    """As a user gives it."""
    return "auto" if value is None else value


def rate_problems(predictor: Predictor, records: Iterable[VoRecord]) -> list[str]:
    """Whether motions, or at least frames, come at the rate that a model was trained at; one line if neither does.

    A motion spans several frames where odometry keeps its reference, as at rest.
    """
    times = [(r.t_ns, r.dt_s) for r in records]
    if len(times) < 2 or predictor.target != "frame":
        return []
    t_ns, dt_s = zip(*times)
    trained = 1.0 / predictor.model.dt_s
    of_motions, of_frames = (1.0 / float(np.median(s)) for s in (dt_s, 1e-9 * np.diff(t_ns)))
    if any(abs(rate / trained - 1.0) <= _RATE for rate in (of_motions, of_frames)):
        return []
    return [f"the rate is {of_frames:.3g} Hz, the model was trained at {trained:.3g} Hz"]
