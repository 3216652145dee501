"""The mean that filters take off, against errors drawn with a known one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gpvo.geometry.covariance import turn_first_root
from gpvo.learning.config import TrainConfig
from gpvo.learning.fit import fit_model
from gpvo.learning.rows import Rows
from gpvo.learning.steadymean import steady_mean
from small_model import training_sets


@pytest.mark.parametrize("lean", [(0.0, 0.0, -0.15, 0.0, 0.3, 0.0), (0.0,) * 6])
def test_the_mean_that_errors_were_drawn_with_is_found_and_no_other(lean: tuple[float, ...]) -> None:
    sets = training_sets(range(8), n=400)
    model = fit_model(sets, TrainConfig(features="velocity,rotation,n_inliers")).model
    rows, rng, c = Rows.stack(sets), np.random.default_rng(0), np.array(lean)
    variance = np.exp(rng.normal(-9.0, 1.0, (len(rows.error), 1))) * np.ones(6)
    X = rows.select(model.columns)
    covariance = model.split(variance * model.factor, X, rows.geometry(model.base.method)).covariance
    noise = model.residual_px(model.domain.locate(X).inside)[:, None]
    z = rng.standard_normal((len(X), 6)) + c * noise
    error = (turn_first_root(covariance) @ z[:, :, None])[:, :, 0]
    found = steady_mean(replace(rows, error=error), model, variance)
    np.testing.assert_array_equal(found != 0.0, c != 0.0)
    np.testing.assert_allclose(found, c, atol=4.0 / np.sqrt((noise**2).sum()))


def test_one_flight_shows_no_mean_that_holds_for_another() -> None:
    sets = training_sets([0], n=400)
    learned = fit_model(sets, TrainConfig(features="velocity,rotation,n_inliers"))
    assert learned.choices["steady_mean"] == [0.0] * 6
