"""The rule of selection: chance does not pass for more than its share, a steady gain passes, the simplest stays."""

from __future__ import annotations

import numpy as np
from gpvo.learning.rows import significant_gain, simplest_sufficient


def test_chance_passes_as_often_as_a_t_beyond_its_standard_error_and_a_steady_gain_always() -> None:
    rng = np.random.default_rng(0)
    # P(t_7 > 1) = 0.175; 2,000 trials: standard error 0.0085.
    assert 0.14 < np.mean([significant_gain(rng.standard_normal(8)) for _ in range(2000)]) < 0.21
    assert all(significant_gain(1.0 + 0.5 * rng.standard_normal(8)) for _ in range(100))
    assert not significant_gain(np.ones(1))


def test_the_simplest_that_is_not_significantly_worse_is_chosen() -> None:
    rng = np.random.default_rng(1)
    shared = rng.standard_normal(10)
    noise = 0.01 * rng.standard_normal((2, 10))
    losses = {"simple": shared + 1.0, "middle": shared + noise[0], "rich": shared - 0.001 + noise[1]}
    assert simplest_sufficient(losses) == "middle"
    assert simplest_sufficient({"simple": shared[:1], "rich": shared[:1] - 5.0}) == "simple"
