"""The model without a mean that lies in the file beside the one with it."""

from __future__ import annotations

import numpy as np
from gpvo.online.estimate import WITHOUT_MEAN, arrays_without_mean
from gpvo.online.predictor import Predictor
from small_model import small_model
from synthetic_runs import make_run


def test_the_other_model_speaks_where_no_mean_is_taken_off() -> None:
    trained = small_model()
    plain = arrays_without_mean(trained.arrays)
    other = {f"{WITHOUT_MEAN}{name}": array for name, array in plain.items() if name.startswith("basis.")}
    other[f"{WITHOUT_MEAN}factor"] = 1.01 * plain["factor"]
    arrays = {**trained.arrays, **other}
    one = Predictor(plain, trained.header)
    two = Predictor(arrays, trained.header, with_mean=False)
    for record in list(make_run(51, n=40)[0])[1:]:
        a, b = one.step(record), two.step(record)
        assert a is not None
        assert b is not None
        np.testing.assert_allclose(b.covariance, 1.01 * a.covariance, rtol=1e-4)
        np.testing.assert_allclose(b.mean, a.mean, atol=1e-15)


def test_a_model_that_uses_no_mean_is_one_and_the_same() -> None:
    trained = small_model()
    arrays = {n: a for n, a in trained.arrays.items() if not n.startswith(WITHOUT_MEAN)}
    assert arrays_without_mean(arrays).keys() == arrays.keys()
