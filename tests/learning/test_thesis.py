"""The thesis' model and its noisy GPs: arrays survive, wrong shapes are refused."""

from __future__ import annotations

import numpy as np
import pytest
from gpvo.errors import ModelError
from gpvo.learning.thesis import NoisyGP
from gpvo.online.stored import check_arrays
from some_gp import some_gp


def test_arrays_round_trip() -> None:
    rng = np.random.default_rng(3)
    noisy = NoisyGP(some_gp(rng), rng.standard_normal(6))
    again = NoisyGP.from_arrays(noisy.to_arrays("thesis.0."), "thesis.0.")
    X = rng.standard_normal((5, 8))
    for a, b in zip(noisy.predict(X), again.predict(X), strict=True):
        np.testing.assert_array_equal(a, b)


def test_missing_or_misshapen_arrays_are_refused() -> None:
    arrays = NoisyGP(some_gp(np.random.default_rng(0)), np.zeros(6)).to_arrays("thesis.0.")
    check_arrays(arrays)
    with pytest.raises(ModelError, match=r"lacks the array 'thesis\.0\.mean\.points'"):
        NoisyGP.from_arrays({k: v for k, v in arrays.items() if k != "thesis.0.mean.points"}, "thesis.0.")
    for name, values in (
        ("mean.projection", np.zeros((3, 4))),
        ("mean.points", np.zeros(3)),
        ("log_noise_offset", np.zeros(2)),
    ):
        with pytest.raises(ModelError, match=r"'thesis\.0\..*' has shape"):
            check_arrays(arrays | {f"thesis.0.{name}": values})


def test_a_model_without_any_spread_is_refused() -> None:
    with pytest.raises(ModelError, match="thesis.scale"):
        check_arrays({"thesis.scale": np.zeros(3)})
