"""Before flight: does a model fit this camera, this rate and these conditions?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpvo.dataset.build import observe
from gpvo.io.run_read import Run
from gpvo.online.predictor import Predictor

_RATE = 0.2
_CAMERA = 0.25
_ENOUGH_INSIDE = 0.9


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


def check(predictor: Predictor, run: Run) -> Check:
    """Compare a run (a few seconds of the vehicle's own) with what a model was trained on."""
    problems = [*_camera_problems(predictor, run), *_rate_problems(predictor, run)]
    records, X = observe(run.log, predictor.features, predictor.target)
    usable = np.array([r.usable for r in records], dtype=bool)
    missing = [
        n
        for n, known in zip(predictor.features, np.isfinite(X[usable]).mean(axis=0) if usable.any() else [])
        if known < 0.5
    ]
    if missing:
        problems.append(f"the run lacks features the model needs: {', '.join(missing)}")
    place = predictor.model.locate(X[usable], np.array([r.dt_s for r in records])[usable])
    inside = float((place.in_domain > 0.5).mean()) if usable.any() else 0.0
    beyond = predictor.model.domain.outside(X[usable]).mean(axis=0) if usable.any() else np.zeros(X.shape[1])
    order = np.argsort(-beyond, kind="stable")[:3]
    farthest = tuple((predictor.features[i], float(beyond[i])) for i in order if beyond[i] > 0)
    if inside < _ENOUGH_INSIDE:
        problems.append(f"only {100 * inside:.0f} % of the frames lie inside the training domain")
    return Check(len(run.log), int(usable.sum()), inside, farthest, tuple(problems))


def _camera_problems(predictor: Predictor, run: Run) -> list[str]:
    trained, here = predictor.camera, run.log.camera
    if trained is None or here is None:
        return []
    out = []
    for name, a, b in (
        ("baseline", trained.baseline_m, here.baseline_m),
        ("focal length over image width", trained.fx_px / trained.width, here.fx_px / here.width),
    ):
        if abs(b / a - 1.0) > _CAMERA:
            out.append(f"{name} is {b:.4g}, the model was trained with {a:.4g}")
    return out


def _rate_problems(predictor: Predictor, run: Run) -> list[str]:
    steps = [r.dt_s for r in run.log if r.usable]
    if not steps or predictor.target != "frame":
        return []
    here, trained = 1.0 / float(np.median(steps)), 1.0 / predictor.model.dt_s
    return (
        []
        if abs(here / trained - 1.0) <= _RATE
        else [f"the rate is {here:.3g} Hz, the model was trained at {trained:.3g} Hz"]
    )
