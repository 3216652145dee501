"""The time offset between a log and its truth."""

from __future__ import annotations

import numpy as np
import pytest
from gpvo.dataset import clock
from gpvo.dataset.clock import estimate_time_offset
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.types import Status, TruthLog, VoLog, VoRecord

START = 1_403_636_579_763_555_584


def path(s: np.ndarray) -> np.ndarray:
    """(N, 4, 4) poses at the times s [s] of a winding flight that never repeats."""
    t = np.stack([2 * np.sin(0.7 * s), 0.5 * np.sin(1.31 * s), s + 0.5 * np.cos(0.93 * s)], axis=1)
    phi = np.stack([0.3 * np.sin(1.1 * s), 0.5 * np.sin(0.83 * s + 1), 0.2 * np.sin(1.7 * s)], axis=1)
    return se3.from_rt(se3.so3_exp(phi), t)


def log_of(s: np.ndarray, poses: np.ndarray, noise: float = 0.0, seed: int = 0) -> VoLog:
    t = START + np.rint(s * 1e9).astype(np.int64)
    motions = se3.inverse(poses[:-1]) @ poses[1:]
    motions = motions @ se3.exp(noise * np.random.default_rng(seed).normal(size=(len(motions), 6)))
    records = [VoRecord(int(t[0]), int(t[0]), Status.START, np.eye(4))]
    records += [VoRecord(int(t[k + 1]), int(t[k]), Status.OK, M) for k, M in enumerate(motions)]
    return VoLog(records)


def truth_of(s: np.ndarray) -> TruthLog:
    """Truth of another frame of the body, at its own rate."""
    X = se3.exp(np.array([0.05, -0.02, 0.08, 1.0, -0.5, 0.7]))
    return TruthLog(START + np.rint(s * 1e9).astype(np.int64), path(s) @ X)


@pytest.mark.parametrize("offset", [0.0, 0.0314, -0.47, 3.2])
@pytest.mark.parametrize("rate", [10.0, 30.0])
def test_offset_is_found_to_a_fraction_of_a_frame(offset, rate):
    s = np.arange(0, 40, 1 / rate)
    truth = truth_of(np.arange(-5, 50, 0.00833))
    found = estimate_time_offset(log_of(s - offset, path(s), noise=2e-4), truth)
    assert found == pytest.approx(offset, abs=4e-3)


@pytest.mark.parametrize("rate, truth_rate", [(0.8, 20.0), (1.5, 20.0), (2.0, 20.0), (20.0, 1.0), (20.0, 2.0)])
@pytest.mark.parametrize("offset", [0.3, -1.2])
def test_slow_logs_and_truths(rate, truth_rate, offset):
    jitter = np.random.default_rng(2).uniform(-0.01, 0.01, round(60 * rate))
    s = np.arange(0, 60, 1 / rate)[: len(jitter)] + jitter
    truth = truth_of(np.arange(-5, 70, 1 / truth_rate))
    # Straight lines over a second of slow truth are what limits it.
    assert estimate_time_offset(log_of(s - offset, path(s)), truth) == pytest.approx(offset, abs=0.08)


def test_a_log_of_a_day_is_searched_in_longer_steps(monkeypatch):
    """As one of odometry at 200 Hz that lasts for longer than a quarter of an hour: of more samples than are held."""
    monkeypatch.setattr(clock, "_MAX_SAMPLES", 900)
    for offset in (0.0314, -0.47, 3.2):
        s = np.arange(0, 100, 1 / 30)
        found = clock.estimate_time_offset(log_of(s - offset, path(s)), truth_of(np.arange(-5, 110, 0.02)))
        assert found == pytest.approx(offset, abs=4e-3)


@pytest.mark.parametrize("count, rate", [(10, 2.0), (12, 3.0)])
def test_a_few_samples_give_the_offset_to_a_step_or_are_refused(count, rate):
    s = np.arange(count) / rate
    for offset in (0.3, -0.3):
        found = estimate_time_offset(log_of(s - offset, path(s)), truth_of(np.arange(-3, 10, 0.05)))
        assert found == pytest.approx(offset, abs=1 / rate)
    with pytest.raises(GpvoError, match="lasts 2.90 s; 3.25 s are needed"):
        estimate_time_offset(log_of(np.arange(30) / 10, path(np.arange(30) / 10)), truth_of(np.arange(0, 40, 0.01)))


def test_clocks_that_share_nothing():
    s = np.arange(0, 40, 0.05)
    truth = truth_of(np.arange(-20, 60, 0.01))
    assert estimate_time_offset(log_of(s + 1e6, path(s)), truth) == pytest.approx(-1e6, abs=4e-3)


@pytest.mark.parametrize("offset", [7.0, -20.0])
def test_clocks_that_overlap_and_differ_by_much(offset):
    s = np.arange(0, 40, 0.05)
    truth = truth_of(np.arange(-5, 50, 0.01))
    assert estimate_time_offset(log_of(s - offset, path(s)), truth) == pytest.approx(offset, abs=4e-3)


def test_slips_do_not_move_it():
    s = np.arange(0, 40, 0.05)
    poses = path(s)
    poses[300:] = se3.exp(np.array([5.0, -3.0, 9.0, 0.5, 1.0, 0.2])) @ poses[300:]
    truth = truth_of(np.arange(-5, 50, 0.01))
    assert estimate_time_offset(log_of(s - 0.2, poses), truth) == pytest.approx(0.2, abs=5e-3)


def test_truth_with_a_hole():
    s = np.arange(0, 40, 0.05)
    t = np.arange(-5, 50, 0.01)
    truth = truth_of(t[(t < 10) | (t > 22)])
    assert estimate_time_offset(log_of(s - 0.2, path(s)), truth) == pytest.approx(0.2, abs=5e-3)


def test_motions_of_something_else():
    rng = np.random.default_rng(0)
    s = np.arange(0, 40, 0.05)
    other = se3.from_rt(np.tile(np.eye(3), (len(s), 1, 1)), np.cumsum(rng.normal(size=(len(s), 3)), axis=0))
    with pytest.raises(GpvoError, match="do not match"):
        estimate_time_offset(log_of(s, other), truth_of(np.arange(0, 40, 0.01)))
    with pytest.raises(GpvoError, match="too few"):
        estimate_time_offset(log_of(s[:5], path(s[:5])), truth_of(s))


@pytest.mark.parametrize("offset", [0.0, 0.0125, -0.025, 3.2])
@pytest.mark.parametrize("rate", [20.0, 100.0])
def test_noise_of_the_truth_draws_the_offset_to_no_place_between_its_poses(offset, rate):
    """Midway between two noisy poses, their mean has half the noise: no reason to set the clock there."""
    s = np.arange(0, 60, 0.05)
    exact = truth_of(np.arange(-5, 70, 1 / rate))
    noise = np.random.default_rng(3).normal(size=(len(exact.t_ns), 6)) * ([0.01] * 3 + [5e-4] * 3)
    truth = TruthLog(exact.t_ns, exact.T_world_cam @ se3.exp(noise))
    assert estimate_time_offset(log_of(s - offset, path(s), noise=2e-4), truth) == pytest.approx(offset, abs=3e-3)
