"""The model for filters, which lies in the file beside the one that predicts."""

from __future__ import annotations

import numpy as np
from gpvo.geometry.covariance import turn_first_root
from gpvo.online.for_filter import BASE, FOR_FILTER, arrays_for_filter
from gpvo.online.predictor import Predictor
from small_model import small_model
from synthetic_runs import make_run


def test_a_filter_has_the_model_fitted_without_a_mean() -> None:
    trained = small_model()
    plain = arrays_for_filter(trained.arrays)
    other = {f"{FOR_FILTER}{name}": array for name, array in plain.items() if name.startswith("basis.")}
    other[f"{FOR_FILTER}factor"] = 1.01 * plain["factor"]
    arrays = {**trained.arrays, **other}
    one = Predictor(plain, trained.header)
    two = Predictor(arrays, trained.header, for_filter=True)
    for record in list(make_run(51, n=40)[0])[1:]:
        a, b = one.step(record), two.step(record)
        assert a is not None
        assert b is not None
        np.testing.assert_allclose(b.covariance, 1.01 * a.covariance, rtol=1e-4)


def test_the_model_for_filters_has_a_part_of_calibration_of_its_own_or_none() -> None:
    patterns, other = np.ones((6, 6, 6)), np.full((6, 6, 6), 2.0)
    own = {f"{FOR_FILTER}basis.centre": np.zeros(3)}
    kept = arrays_for_filter({"calibration_patterns": patterns, f"{FOR_FILTER}steady_mean": np.zeros(6)})
    assert kept["calibration_patterns"] is patterns
    assert "calibration_patterns" not in arrays_for_filter({"calibration_patterns": patterns, **own})
    own[f"{FOR_FILTER}calibration_patterns"] = other
    assert arrays_for_filter({"calibration_patterns": patterns, **own})["calibration_patterns"] is other


def test_a_steady_mean_is_the_root_of_the_covariance_times_the_noise() -> None:
    trained = small_model()
    c = np.array([0.0, 0.0, -0.1, 0.0, 0.2, 0.0])
    one = Predictor(trained.arrays, trained.header)
    two = Predictor({**trained.arrays, f"{FOR_FILTER}steady_mean": c}, trained.header, for_filter=True)
    plain = Predictor({**trained.arrays, f"{FOR_FILTER}steady_mean": 0.0 * c}, trained.header, for_filter=True)
    seen = 0
    for record in list(make_run(51, n=40)[0])[1:]:
        usual, a, b = one.step(record), plain.step(record), two.step(record)
        assert usual is not None
        assert a is not None
        assert b is not None
        np.testing.assert_array_equal(a.covariance, b.covariance)
        off = np.linalg.solve(turn_first_root(b.covariance), b.mean - a.mean)
        noise = off[4] / 0.2
        np.testing.assert_allclose(off, c * noise, atol=1e-12)
        seen += bool(noise > 0)
    assert seen > 30


def test_files_without_a_model_for_filters_are_read() -> None:
    trained = small_model()
    arrays = {n: a for n, a in trained.arrays.items() if not n.startswith((FOR_FILTER, BASE)) and n != "steady_mean"}
    assert arrays_for_filter(arrays).keys() == arrays.keys()
    assert not Predictor(arrays, trained.header, for_filter=True).model.steady_mean.any()
