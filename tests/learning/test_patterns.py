"""Wrong calibrations: found where flights have them, and not where they have none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gpvo.learning.patterns import Patterns, learn_patterns
from gpvo.learning.rows import Rows
from gpvo.online.base import TWIST_COLUMNS
from gpvo.online.division import of_calibration
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from small_model import small_model, training_sets

SIGMA = np.repeat([1e-3, 1e-4], 3)
COUPLED = np.zeros((2, 6, 6))
"""Two ways to be wrong: a scale, and a tilt that goes with two velocities."""
COUPLED[0, [0, 1, 2], [0, 1, 2]] = 3e-4
COUPLED[1, 4, 2], COUPLED[1, 0, 2], COUPLED[1, 1, 5] = 3e-5, -4e-4, 2e-4


def _flights(
    count: int, patterns: np.ndarray, seed: int, slow: tuple[int, ...] = (), longest: int = 1
) -> tuple[Rows, np.ndarray]:
    """Rows of flights of 1500 motions that turn around often, hardly moving along the ``slow`` axes; the K of each.

    One motion in three lasts up to ``longest`` times as long as the others.
    """
    rng = np.random.default_rng(seed)
    template, sets, K = training_sets([0], n=1501)[0], [], []
    place = [template.columns.index(c) for c in TWIST_COLUMNS]
    for k in range(count):
        n = len(template)
        twist = np.repeat(rng.standard_normal((n // 50 + 1, 6)), 50, axis=0)[:n]
        twist[:, list(slow)] *= 1e-6
        K.append(np.einsum("p,pic->ic", rng.standard_normal(len(patterns)), patterns))
        X = template.X.copy()
        X[:, place] = twist
        steps = np.where(np.arange(n) % 3 == 0, rng.integers(1, longest, n, endpoint=True), 1)
        Y = SIGMA * rng.standard_normal((n, 6)) + steps[:, None] * twist @ K[-1].T
        dt_s = template.dt_s * steps
        t_ns = template.t_ns[0] + np.round(np.cumsum(dt_s) * 1e9).astype(np.int64)
        sets.append(replace(template, name=f"flight{k}", X=X, Y=Y, dt_s=dt_s, t_ns=t_ns))
    return Rows.stack(sets), np.array(K)


def _spread(patterns: np.ndarray) -> np.ndarray:
    return np.einsum("pic,pjd->icjd", patterns, patterns)


def _patterns(rows: Rows, error: np.ndarray | None = None) -> Patterns | None:
    error = rows.error if error is None else error
    return learn_patterns(rows, error, np.broadcast_to(SIGMA**2, error.shape), rows.group % 3)


@pytest.mark.parametrize("longest", [1, 4])
def test_the_patterns_have_the_covariance_of_the_flights(longest):
    """Of 40 flights, each element by its usual deviation, to a tenth; and each flight's own errors are found."""
    rows, K = _flights(40, COUPLED, 0, longest=longest)
    found = _patterns(rows)
    unit = np.sqrt(np.einsum("pic,pic->ic", COUPLED, COUPLED)) + SIGMA[:, None] / 10.0
    drawn, got = (_spread(p) / unit[:, :, None, None] / unit for p in (K / np.sqrt(len(K)), found.usual))
    np.testing.assert_allclose(got, drawn, atol=0.1)
    twist = rows.select(TWIST_COLUMNS) * rows.steps[:, None]
    truth = np.einsum("nic,nc->ni", np.repeat(K, len(rows.sets[0]), axis=0), twist)
    left = ((found.error - truth) ** 2).mean(axis=0) / (truth**2).mean(axis=0).clip(0.03 * SIGMA**2)
    assert (left < 0.1).all()


def test_of_no_wrong_calibration_there_is_next_to_nothing():
    rows, _ = _flights(12, np.zeros((1, 6, 6)), 1)
    found = _patterns(rows)
    stated = np.einsum("nip,nip->ni", *2 * [np.einsum("pic,nc->nip", found.usual, rows.select(TWIST_COLUMNS))])
    assert (stated.mean(axis=0) < 0.02 * SIGMA**2).all()


def test_patterns_without_a_fold_do_not_know_its_flights():
    rows, _ = _flights(6, COUPLED, 2)
    found = _patterns(rows)
    other = _patterns(rows, np.where(rows.group[:, None] % 3 == 0, 3.0 * rows.error, rows.error))
    np.testing.assert_allclose(_spread(other.without[0]), _spread(found.without[0]), rtol=1e-3, atol=1e-12)
    assert not np.allclose(_spread(other.without[1]), _spread(found.without[1]), rtol=1e-2, atol=1e-12)


def test_what_goes_with_errors_of_the_velocity_is_no_pattern():
    """Along the slow axes odometry's velocity is little but its own error."""
    rows, _ = _flights(8, COUPLED, 3, slow=(0, 5))
    found = _patterns(rows)
    assert not found.usual[:, :, [0, 5]].any()
    assert found.usual[:, :, [1, 2]].any()


def test_few_flights_tell_nothing_of_how_calibrations_differ():
    rows, _ = _flights(3, COUPLED, 4)
    assert _patterns(rows) is None


def test_a_scale_error_is_the_same_over_a_distance_however_long_motions_last():
    """1 % of 30 m, in motions of a usual duration, of five, and of ten."""
    model = small_model().predictor().model
    scale = np.zeros((6, 6, 6))
    scale[0, 2, 2] = 0.01 * model.dt_s
    division = replace(model.division, calibration_patterns=scale, calibration_tau_s=np.full(6, 1e6))
    twist = np.array([[0.0, 0.0, 1.0, 0.0, 0.0, 0.0]])
    for steps in (1, 5, 10):
        motions = round(30.0 / model.dt_s / steps)
        variance = np.full((1, 6), (1e3 * scale[0, 2, 2] * steps) ** 2)
        root = division.split(variance, twist, None, np.array([float(steps)])).persistent_root[0, 2, 6:]
        assert np.linalg.norm(motions * root) == pytest.approx(0.3, rel=1e-3)


unit = st.floats(-1.0, 1.0)


@settings(max_examples=50, deadline=None)
@given(arrays(np.float64, (6, 6, 6), elements=unit), arrays(np.float64, (4, 6), elements=unit), st.floats(1e-3, 1e3))
def test_calibration_takes_no_more_than_the_variance_and_turns_around_with_the_motion(patterns, twist, scale):
    variance = np.full((4, 6), scale)
    root, rest = of_calibration(variance, patterns, twist)
    np.testing.assert_allclose((root**2).sum(axis=-1) + rest, variance)
    assert (rest > 0.0).all()
    back, same = of_calibration(variance, patterns, -twist)
    np.testing.assert_allclose(back, -root)
    np.testing.assert_allclose(same, rest)


def test_an_unknown_velocity_brings_nothing():
    variance, twist = np.ones((1, 6)), np.array([[np.nan, 1.0, 0.0, 0.0, 0.0, 0.0]])
    root, _ = of_calibration(variance, np.ones((6, 6, 6)), twist)
    np.testing.assert_allclose((root**2).sum(axis=-1), 6.0 / 7.0)
