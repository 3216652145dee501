"""The rule of selection: chance does not pass for more than its share, a steady gain passes, the simplest stays; and
what there is to select from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gpvo.cli.learn import _tell
from gpvo.learning.basefit import learn_domain
from gpvo.learning.config import TrainConfig, base_candidates, candidates, guarded, lacking
from gpvo.learning.fit import BETWEEN, choose_base, choose_inputs
from gpvo.learning.rows import Rows, significant_gain, simplest_sufficient
from gpvo.learning.train import TrainedModel
from small_model import training_sets


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


def _with(sets, **columns):
    """Some columns, by name, at one value throughout."""
    out = []
    for s in sets:
        X = s.X.copy()
        for name, value in columns.items():
            X[:, s.columns.index(name)] = value
        out.append(replace(s, X=X))
    return out


def test_a_feature_that_never_varied_is_no_input_but_tells_other_surroundings() -> None:
    sets = _with(training_sets(range(2), n=60), n_inliers=200.0)
    assert "n_inliers" in guarded(sets, TrainConfig())
    assert not any("n_inliers" in inputs for inputs in candidates(sets, TrainConfig()).values())
    place = learn_domain(sets[0].select(("n_inliers",))).locate(np.array([[200.0], [195.0], [100.0], [15.0]]))
    np.testing.assert_allclose(place.distance, [0.0, 0.25, 5.0, 9.25])


def test_a_covariance_of_some_axes_alone_is_no_base() -> None:
    """The log of a rotation stated as exactly known is no number."""
    sets = training_sets(range(2), n=60)
    whole = base_candidates(sets)
    method = next(m for m, _ in whole if m is not None)
    assert method not in [m for m, _ in base_candidates(_with(sets, **{f"ln_var_{method}_rx": np.nan}))]


def test_what_one_sequence_lacks_and_others_know_is_named(capsys) -> None:
    sets, config = training_sets(range(3), n=60), TrainConfig()
    assert lacking(sets, config) == {}
    poor = _with(sets[:1], n_inliers=np.nan, inlier_ratio=np.nan)
    assert lacking([*poor, *sets[1:]], config) == {sets[0].name: ["counts"]}
    assert lacking([*poor, *sets[1:]], TrainConfig(features="velocity")) == {}
    assert lacking(poor, config) == {}
    _tell(TrainedModel({}, {"target": "frame"}, sets=[*poor, *sets[1:]]), config)
    said = capsys.readouterr().err
    assert f"{sets[0].name} holds no counts, as other runs do" in " ".join(said.split())
    assert said.count("gpvo:") == 1


@pytest.mark.parametrize("told", [True, False])
def test_inputs_tell_how_noisy_a_sequence_is_where_sequences_left_out_show_it(told: bool) -> None:
    """Errors ten times as large in some runs as in others were told by no input, though runs with large errors had few
    inliers: left out, the best were ten times better in sigma than was said."""
    sets = []
    for s, level in zip(training_sets(range(6), n=200, geometry=False), [0.3, 1.0, 3.0] * 2, strict=True):
        X = s.X.copy()
        X[:, s.columns.index("n_inliers")] /= level**2 if told else 1.0
        sets.append(replace(s, X=X, Y=s.Y * level))
    rows = Rows.stack(sets)
    chosen, _, losses = choose_inputs(rows, *choose_base(rows), TrainConfig(features="n_inliers,ln_turn_rate"))
    assert chosen.endswith(BETWEEN) is told
    if told:
        assert losses[chosen] < losses[chosen.removesuffix(BETWEEN)] - 0.3
