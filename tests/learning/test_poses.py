"""How much of the motions' errors adds up, by the poses of paths that turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import pytest
from gpvo.accumulation import PoseError
from gpvo.geometry import se3
from gpvo.geometry.covariance import scaled_root
from gpvo.learning.poses import Poses, Windows, added_factor, windows_of, with_added

from motion_errors import motion_error

PHI, LASTING = 0.9, 0.99
BOTH = np.repeat([PHI, LASTING], 6)
SHARE = np.repeat([[0.6], [0.3], [0.1]], 6, axis=1)


def _covariances(rng: np.random.Generator, n: int) -> np.ndarray:
    """(n, 3, 6, 6) of parts whose deviations change and whose correlations do not."""
    A = rng.standard_normal((3, 6, 6))
    sigma = np.exp(0.3 * rng.standard_normal((n, 3, 6)))
    return sigma[..., None] * (A @ np.swapaxes(A, 1, 2)) * sigma[..., None, :]


def test_what_is_stated_of_a_pose_is_what_adds_up_along_a_path():
    rng = np.random.default_rng(0)
    n = 14
    T, parts = se3.exp(0.3 * rng.standard_normal((n, 6))), _covariances(rng, n)
    root = rng.standard_normal((n, 6, 1)) * rng.standard_normal((6, 6))
    whole = np.concatenate([scaled_root(parts[:, 2]), root], axis=-1)
    windows = Windows.of([[np.arange(n)]], n, T)
    stated = Poses.over(windows, np.zeros((n, 6)), parts[:, 0], parts[:, 1], whole, BOTH)
    pose = PoseError()
    tau_s, lasting_s = np.split(-1.0 / np.log(BOTH), 2)
    for T_prev_cur, (jit, white, bias), L in zip(T, parts, root):
        pose = pose.after(T_prev_cur, motion_error(jit, white, bias, tau_s, L, lasting_s, dt_s=1.0))
    np.testing.assert_allclose((stated.jitter + stated.added)[0], pose.covariance, rtol=1e-9)


@dataclass
class Motions:
    """A flight: motions, their errors, and what is stated of these."""

    T_prev_cur: np.ndarray
    error: np.ndarray
    jitter: np.ndarray
    white: np.ndarray
    root: np.ndarray

    def rows(self, some: slice) -> Motions:
        return Motions(*(getattr(self, f.name)[some] for f in fields(self)))


def _flight(rng: np.random.Generator, n: int, added: float) -> Motions:
    """A path of gentle turns. White and bias have ``added`` times the stated variance, the jitter has the rest."""
    T = se3.exp(rng.normal([0.0, 0.0, 0.5, 0.0, 0.05, 0.0], 0.02, (n, 6)))
    jitter, white, bias = np.sqrt(with_added(SHARE, added)[:, 0])
    frames = rng.standard_normal((n + 1, 6)) * jitter / np.sqrt(2.0)
    slow = np.empty((n, 6))
    state = rng.standard_normal(6)
    for k in range(n):
        state = PHI * state + np.sqrt(1.0 - PHI**2) * rng.standard_normal(6)
        slow[k] = state
    back = se3.adjoint(se3.inverse(T)) @ frames[:-1, :, None]
    error = frames[1:] - back[..., 0] + white * rng.standard_normal((n, 6)) + bias * slow
    jitter, white, bias = (np.tile(share * np.eye(6), (n, 1, 1)) for share in SHARE[:, 0])
    return Motions(T, error, jitter, white, np.concatenate([np.sqrt(bias), np.zeros((n, 6, 6))], axis=-1))


def _factor(flights: Sequence[Motions]) -> float:
    every = [np.concatenate([getattr(f, name.name) for f in flights]) for name in fields(Motions)]
    ends = np.cumsum([len(f.error) for f in flights])
    chains = [[rows] for rows in np.split(np.arange(ends[-1]), ends[:-1])]
    windows = windows_of(chains, every[0])
    return added_factor([Poses.over(w, *every[1:], BOTH) for w in windows], SHARE)


def test_right_parts_stay_as_they_are():
    """Ten trials of twelve flights: within 15 % in each, within 5 % in the middle."""
    found = []
    for trial in range(10):
        rng = np.random.default_rng(trial)
        found.append(_factor([_flight(rng, 600, 1.0) for _ in range(12)]))
    np.testing.assert_allclose(found, 1.0, atol=0.15)
    assert np.median(found) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("truth", [0.6, 1.5])
def test_the_factor_is_found_as_far_as_flights_show_it(truth):
    """Of few flights a part, of many nearly all: on a log scale, by 64 flights at least 85 % and at most 115 %."""
    rng = np.random.default_rng(0)
    flights = [_flight(rng, 600, truth) for _ in range(64)]
    part = [np.log(_factor(flights[:n])) / np.log(truth) for n in (2, 8, 64)]
    assert 0.0 < part[0] < part[1] < part[2]
    assert part[2] == pytest.approx(1.0, abs=0.15)


def test_a_flight_cut_in_two_says_more_and_a_longer_one_does_not():
    """Flights are what is counted: windows of one flight share its calibration."""
    rng = np.random.default_rng(3)
    flights = [_flight(rng, 1200, 0.5) for _ in range(4)]
    cut = [f.rows(half) for f in flights for half in (slice(0, 600), slice(600, 1200))]
    assert _factor(cut) < _factor(flights) < 1.0


def test_what_flights_do_not_agree_on_is_chance():
    """Half of them say that too much is stated, half that too little; of all six the likeliest factor is 0.88."""
    rng = np.random.default_rng(4)
    flights = [_flight(rng, 600, 0.4 if i % 2 else 1.6) for i in range(6)]
    assert _factor(flights) == 1.0
    assert _factor(flights[::2]) > 1.0


def test_too_little_changes_nothing():
    rng = np.random.default_rng(2)
    short, long = _flight(rng, 9, 0.5), _flight(rng, 600, 0.5)
    assert added_factor([], SHARE) == 1.0
    assert _factor([short, short]) == 1.0
    assert _factor([long]) == 1.0
    assert _factor([long, long, short]) < 1.0


def test_shares_still_sum_to_one():
    np.testing.assert_allclose(with_added(SHARE, 0.7).sum(axis=0), 1.0)
    np.testing.assert_allclose(with_added(SHARE, 0.7)[1:], 0.7 * SHARE[1:])
