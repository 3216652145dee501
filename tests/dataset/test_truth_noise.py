"""The noise of the truth itself: found beside odometry that is noisier than it, in its kind, and never where there is
none; and errors drawn without it, which are as large as odometry's own.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gpvo.dataset.build import TrainingSet, build, build_run
from gpvo.dataset.errors import MotionErrors, interpolate_truth, motion_errors
from gpvo.dataset.noiseless import _Chain, drawn_without_noise, without_noise
from gpvo.dataset.table import read_sets, write_sets
from gpvo.dataset.truth_noise import (
    TruthNoise,
    estimate_truth_noise,
    made_from_odometry,
    of_errors,
    rates_of,
    telling_distance_m,
)
from gpvo.errors import SourceError
from gpvo.evaluation import panels
from gpvo.evaluation.evaluate import evaluate_run
from gpvo.evaluation.flights import constants_of
from gpvo.evaluation.verdict import verdict
from gpvo.geometry import se3
from gpvo.io.run import write_run
from gpvo.io.run_read import Run, read_run
from gpvo.learning.config import TrainConfig
from gpvo.learning.methods import score
from gpvo.learning.train import _scored, train_sets
from gpvo.stats.consistency import rms
from gpvo.stats.series import moving_sums
from gpvo.types import Status, TruthLog, VoLog, VoRecord

DATA = Path(__file__).parents[2] / "data"
FLIGHTS = ("tunnel-1", "tunnel-2", "tunnel-3", "tunnel-4", "unseen")
TRIALS = 15


@pytest.fixture(scope="module")
def flights() -> list[Run]:
    return [read_run(DATA / name) for name in FLIGHTS]


def noisy(truth: TruthLog, seed: int, sigma_m: float, sigma_rad: float, jitter_s: float = 0.0) -> TruthLog:
    """The truth with white noise on its poses, told at stamps that are off by ``jitter_s``."""
    rng = np.random.default_rng(seed)
    late = np.rint(1e9 * jitter_s * rng.standard_normal(len(truth.t_ns))).astype(np.int64)
    T, _ = interpolate_truth(truth, np.clip(truth.t_ns + late, truth.t_ns[0], truth.t_ns[-1]))
    xi = rng.standard_normal((len(T), 6)) * np.repeat([sigma_m, sigma_rad], 3)
    return TruthLog(truth.t_ns, T @ se3.exp(xi))


def estimates(flights: list[Run], *noise: float) -> list[TruthNoise]:
    """In TRIALS, of the flights in turn."""
    found = []
    for seed in range(TRIALS):
        run = flights[seed % len(flights)]
        assert run.truth is not None
        found.append(estimate_truth_noise(motion_errors(run.log, noisy(run.truth, seed, *noise)), run.log))
    return found


def usual(noise: TruthNoise, run: Run) -> np.ndarray:
    """(6,) of its poses."""
    T_true, known = interpolate_truth(run.truth, run.log.t_ns)
    return noise.usual(rates_of(T_true, run.log.t_ns, known))


@pytest.mark.parametrize("sigma_m,sigma_rad", [(0.003, 0.0004), (0.03, 0.003)])
def test_white_noise_is_found_in_size(flights, sigma_m, sigma_rad):
    """Odometry's own errors are 2 to 14 mm per motion. Each estimate of 200 frames scatters by about 6 %."""
    found = estimates(flights, sigma_m, sigma_rad)
    relative = np.array([n.sigma for n in found]) / np.repeat([sigma_m, sigma_rad], 3)
    assert (relative > 0).mean() > 0.9
    assert 0.9 < np.sqrt((relative[relative > 0] ** 2).mean()) < 1.1
    assert sum(n.jitter_s > 0 for n in found) <= 1  # the vehicle's speed has nothing to do with it


@pytest.mark.parametrize("noise", [(0.0, 0.0, 0.02), (0.003, 0.0004, 0.01)])
def test_jitter_of_stamps_is_told_from_white_noise(flights, noise):
    """At about 1 m/s; the camera looks ahead."""
    found = estimates(flights, *noise)
    jitter_s = np.array([n.jitter_s for n in found])
    assert (jitter_s > 0).mean() > 0.9
    assert np.sqrt((jitter_s**2).mean()) == pytest.approx(noise[2], rel=0.1)
    assert np.median([n.sigma[2] for n in found]) <= 1.1 * noise[0]


def test_jitter_of_stamps_shows_along_the_way(flights):
    """20 ms at about 1 m/s; the camera looks ahead."""
    found = np.array([usual(n, run) for n, run in zip(estimates(flights, 0.0, 0.0, 0.02), flights * TRIALS)])
    assert (found[:, 2] > 0).mean() > 0.9
    assert 0.015 < np.median(found[:, 2]) < 0.03
    assert np.median(found[:, 2]) > 5 * np.median(found[:, 1])


def test_no_noise_is_found_where_there_is_none(flights):
    for run in flights:
        assert run.truth is not None
        assert not estimate_truth_noise(motion_errors(run.log, run.truth), run.log)
        assert without_noise(run.log, run.truth)[0] is run.truth


@pytest.mark.parametrize("what", ["jitter", "scale"])
def test_errors_of_odometry_are_not_blamed_on_the_truth(flights, what):
    """Noise that two motions share, which looks like the truth's in the errors alone; motions 10 % too long."""
    false_alarms = 0
    for seed, run in enumerate(flights * 2):
        rng, T = np.random.default_rng(seed), run.log.T_prev_cur
        jitter = se3.exp(rng.standard_normal((len(T) + 1, 6)) * np.repeat([0.02, 0.002], 3))
        wrong = se3.inverse(jitter[:-1]) @ T @ jitter[1:] if what == "jitter" else se3.exp(1.1 * se3.log(T))
        log = VoLog([replace(r, T_prev_cur=t) for r, t in zip(run.log, wrong)], run.log.camera)
        found = estimate_truth_noise(motion_errors(log, run.truth), log)
        false_alarms += int((found.sigma > 0).sum()) + 6 * (found.jitter_s > 0)
    assert false_alarms <= 2  # of 60 axes


@pytest.mark.parametrize("shake", [0.01, 0.03])
def test_shaking_that_odometry_smooths_away_is_no_noise_of_the_truth(flights, shake):
    """Poses swing within four frames; odometry averages three motions, and so lacks part of it."""
    for seed, run in enumerate(flights):
        rng, window = np.random.default_rng(seed), np.hanning(9) / np.linalg.norm(np.hanning(9))
        white = rng.standard_normal((len(run.truth.t_ns), 6)) * np.repeat([shake, 0.1 * shake], 3)
        swing = np.stack([np.convolve(axis, window, "same") for axis in white.T], axis=1)
        truth = TruthLog(run.truth.t_ns, run.truth.T_world_cam @ se3.exp(swing))
        T = interpolate_truth(truth, run.log.t_ns)[0]
        motions = se3.log(se3.inverse(T[:-1]) @ T[1:])
        smooth = np.stack([np.convolve(axis, [0.25, 0.5, 0.25], "same") for axis in motions.T], axis=1)
        smooth += rng.standard_normal(smooth.shape) * np.repeat([2e-3, 3e-4], 3)
        first, *others = run.log
        records = [first, *(replace(r, T_prev_cur=t) for r, t in zip(others, se3.exp(smooth), strict=True))]
        log = VoLog(records, run.log.camera)
        assert not estimate_truth_noise(motion_errors(log, truth), log)


def test_the_truth_tells_over_a_distance(flights):
    run = flights[4]
    T_true, known = interpolate_truth(run.truth, run.log.t_ns)
    distances = [telling_distance_m(run.log, T_true, known, np.repeat([s, 0.0], 3)) for s in (0.0, 1e-4, 0.008, 10.0)]
    assert distances[:2] == [0.0, 0.0]
    assert 0.1 < distances[2] < 30.0
    assert np.isinf(distances[3])


def test_evaluate_says_so_and_counts_it_in(flights):
    run = replace(flights[4], truth=noisy(flights[4].truth, 1, 0.03, 0.0))
    found = evaluate_run(run)
    assert 0.025 < found.truth_sigma[:3].mean() < 0.035
    lines = " ".join(verdict(found).lines)
    assert "The truth itself has an estimated noise of 3" in lines
    assert "on its worst axis" in lines  # the table gives the mean of the axes
    assert "its source states none" in lines
    assert "outweighs the odometry's errors on this run" in lines
    c, clean = (evaluate_run(r).consistency["triangulation"] for r in (run, flights[4]))
    assert c.nees_dof["translation"].mean > 3 * clean.nees_dof["translation"].mean
    # What the truth adds outweighs what is stated, and counted in it is no surprise.
    assert 0.7 < c.nees_dof_truth_noise["translation"] < 1.3


def measured(truth: TruthLog, seed: int, sigma_mps: float, *, where: str) -> TruthLog:
    """The truth with its velocities, where positions or velocities err by ``sigma_mps`` for about two seconds."""
    rng, t_s = np.random.default_rng(seed), (truth.t_ns - truth.t_ns[0]) * 1e-9
    decay = np.exp(-np.median(np.diff(t_s)) / 2.0)
    wrong = np.zeros((len(t_s), 3))
    wrong[0] = rng.standard_normal(3)
    for k in range(1, len(t_s)):
        wrong[k] = decay * wrong[k - 1] + np.sqrt(1 - decay**2) * rng.standard_normal(3)
    v_world = np.gradient(truth.T_world_cam[:, :3, 3], t_s, axis=0)
    if where == "velocities":
        return replace(truth, v_world_mps=v_world + sigma_mps * wrong)
    T = truth.T_world_cam.copy()
    T[:, :3, 3] += np.cumsum(sigma_mps * wrong * np.gradient(t_s)[:, None], axis=0)
    return replace(truth, T_world_cam=T, v_world_mps=v_world)


def test_positions_that_drift_are_told_by_the_velocities_beside_them(flights, tmp_path):
    drift, z2, innocent = [], [], []
    for seed, run in enumerate(flights):
        drifting = replace(run, truth=measured(run.truth, seed, 0.1, where="positions"))
        found = evaluate_run(drifting).consistency["triangulation"].one_second
        drift.append(found.truth_drift_m)
        z2.append(found.z2_truth_noise[:3])
        alone = replace(drifting.truth, v_world_mps=None)
        unknown = evaluate_run(replace(run, truth=alone)).consistency["triangulation"].one_second
        assert unknown.truth_drift_m == (0.0, 0.0, 0.0)
        assert max(unknown.z2_truth_noise[:3]) > 5 * max(found.z2_truth_noise[:3])
        for draw in range(4):
            wrong = replace(run, truth=measured(run.truth, 100 * draw + seed, 0.1, where="velocities"))
            innocent += evaluate_run(wrong).consistency["triangulation"].one_second.truth_drift_m
    # Over a second an error of 0.1 m/s that lasts for two makes 0.09 m.
    assert np.sqrt(np.mean(np.square(drift))) == pytest.approx(0.09, rel=0.3)
    assert 0.4 < np.mean(z2) < 1.5
    # One of fifteen at most, over five flights, three axes and four draws each; of 180 such values it is 7 %.
    assert np.count_nonzero(innocent) <= len(innocent) / 15
    write_run(tmp_path / "run", run.log, truth=drifting.truth)
    np.testing.assert_array_equal(read_run(tmp_path / "run").truth.v_world_mps, drifting.truth.v_world_mps)


@pytest.mark.parametrize("digits", [5, 9])
def test_a_truth_that_is_the_odometry_with_its_drift_taken_out_judges_nothing(flights, digits):
    """As a graph of poses does that closes a loop: the drift, 3 % of the path here, is spread over the motions."""
    run, drift = flights[0], se3.exp(np.array([3e-4, -1e-4, 3e-3, 2e-5, 1e-4, -2e-5]))
    poses = np.array([np.linalg.matrix_power(drift, k) for k in range(len(run.log))]) @ run.log.trajectory()
    poses[:, :3, 3] = np.round(poses[:, :3, 3], digits)
    assert not any(made_from_odometry(motion_errors(r.log, r.truth), r.log) for r in flights)
    bent = replace(run, truth=TruthLog(run.log.t_ns, poses))
    assert made_from_odometry(motion_errors(bent.log, bent.truth), bent.log)
    found = verdict(evaluate_run(bent))
    assert not found.judged
    assert "was the truth made from odometry" in found.headline


def test_a_jittering_stamp_moves_a_pose_along_its_way():
    """Poses of a smooth path, read at wrong times: the covariance of what they are off, at three paces."""
    rng, noise = np.random.default_rng(0), TruthNoise(np.repeat([0.0], 6), 0.004)
    for pace in (0.1, 1.0, 10.0):
        rate = pace * np.array([0.1, -0.2, 1.0, 0.05, 0.3, -0.1])
        off = se3.log(se3.exp(rate * 0.004 * rng.standard_normal((20_000, 1))))
        C = noise.of_poses(rate[None])[0]
        sigma = np.sqrt(np.diagonal(C))
        scale = np.outer(sigma, sigma)
        np.testing.assert_allclose(off.T @ off / len(off) / scale, C / scale, atol=0.05)
        assert noise.usual(rate[None]) == pytest.approx(sigma)


def test_the_error_of_a_motion_holds_the_noise_of_the_poses_at_its_ends(flights):
    run = flights[0]
    errors = motion_errors(run.log, run.truth)
    of_poses = np.random.default_rng(0).uniform(1.0, 9.0, len(run.log))[:, None, None] * np.eye(6)
    carry = se3.adjoint(se3.inverse(errors.T_true))
    begins = np.searchsorted(run.log.t_ns, run.log.column("t_prev_ns"))[errors.index]
    expected = of_poses[errors.index] + carry @ of_poses[begins] @ np.swapaxes(carry, 1, 2)
    np.testing.assert_allclose(of_errors(errors, run.log, of_poses), expected, rtol=1e-12, atol=1e-12)


def test_errors_are_drawn_by_the_size_that_geometry_gives_them():
    """Seeing is bad for a second in every two; the truth's noise lies between the errors of both."""
    rng, n = np.random.default_rng(0), 2000
    sigma = np.where(np.arange(n) % 20 < 10, 1e-3, 2e-2)
    xi = sigma[:, None] * rng.standard_normal((n, 6))
    records, T = [VoRecord(0, 0, Status.START, np.eye(4))], [np.eye(4)]
    for k in range(n):
        moved = se3.exp(np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0]))
        T.append(T[-1] @ moved)
        stated = {"triangulation": sigma[k] ** 2 * np.eye(6)}
        times = (k + 1) * 10**8, k * 10**8
        records.append(VoRecord(*times, Status.OK, moved @ se3.exp(xi[k]), covariances=stated))
    noise = TruthNoise(np.full(6, 5e-3))
    told = TruthLog(np.arange(n + 1) * 10**8, np.array(T) @ se3.exp(5e-3 * rng.standard_normal((n + 1, 6))))
    log = VoLog(records)
    drawn, raw = (motion_errors(log, truth).xi for truth in (drawn_without_noise(log, told, noise), told))
    assert rms(drawn[sigma == 2e-2]) == pytest.approx(2e-2, rel=0.1)
    assert rms(drawn[sigma == 1e-3]) == pytest.approx(1.2e-3, rel=0.25)
    assert rms(raw[sigma == 1e-3]).min() > 5e-3


def test_rates_are_those_of_an_even_motion_also_at_gaps():
    twist, t_ns = np.array([1.0, 0.2, -0.1, 0.0, 0.1, 0.4]), np.arange(9) * 100_000_000
    T = se3.exp(np.arange(9)[:, None] * 0.1 * twist)
    known = np.array([1, 1, 1, 0, 1, 0, 1, 1, 0], dtype=bool)
    rates = rates_of(T, t_ns, known)
    told = np.array([1, 1, 1, 0, 0, 0, 1, 1, 0], dtype=bool)  # the fifth has no neighbour, three are not known
    np.testing.assert_allclose(rates, told[:, None] * twist, atol=1e-9)


def test_poses_are_drawn_from_their_posterior():
    """Against the dense conditional Gaussian, for a keyframe from which a motion ends that leads nowhere."""
    rng, n = np.random.default_rng(1), 5
    start, end = np.array([0, 1, 1, 3]), np.array([1, 2, 3, 4])
    T = se3.exp(rng.normal(0.0, 0.3, (n, 6)))
    xi = rng.normal(0.0, 0.02, (len(start), 6))
    T_true = se3.inverse(T[start]) @ T[end]
    errors = MotionErrors(end, xi, T_true, T_true @ se3.exp(xi), np.full(len(end), 0.1))
    root = rng.normal(0.0, 0.02, (n, 6, 6))
    prior = root @ np.swapaxes(root, 1, 2) + 1e-5 * np.eye(6)
    W = np.linalg.inv(np.array([np.diag(rng.uniform(1e-5, 1e-3, 6)) for _ in start]))
    G = np.zeros((len(start), 6, n, 6))  # y = e - G n
    for m, (p, k) in enumerate(zip(start, end)):
        G[m, :, k], G[m, :, p] = np.eye(6), -se3.adjoint(se3.inverse(errors.T_true[m]))
    information = np.zeros((n, 6, n, 6))
    information[range(n), :, range(n)] = np.linalg.inv(prior)
    information = information.reshape(6 * n, -1) + np.einsum("mika,mij,mjlb->kalb", G, W, G).reshape(6 * n, -1)
    C = np.linalg.inv(information)
    mean = -C @ np.einsum("mika,mij,mj->ka", G, W, errors.xi).ravel()
    chain = _Chain(errors, start, end, prior, np.ones((len(start), 6)))
    draws = np.array([chain._given(W, rng).ravel() for _ in range(5_000)])
    sigma = np.sqrt(np.diagonal(C))
    np.testing.assert_allclose((draws.mean(axis=0) - mean) / sigma, 0.0, atol=0.06)
    np.testing.assert_allclose(np.cov(draws.T) / np.outer(sigma, sigma), C / np.outer(sigma, sigma), atol=0.08)


@pytest.mark.parametrize(
    ("noise", "within"),
    [((0.0, 0.0, 0.02), (0.75, 1.25)), ((0.003, 0.0004, 0.0), (0.75, 1.25)), ((0.03, 0.003, 0.0), (0.5, 3.5))],
)
def test_errors_without_the_truths_noise_are_as_large_as_odometrys_own(flights, noise, within):
    """Of ten flights, over one motion and over ten: the geometric mean of the sizes by axis over those by the exact
    truth. Noise that makes errors ten times as large leaves less to tell, but never makes them smaller by half."""
    raw, single, ten = [], [], []
    for seed in range(10):
        run = flights[seed % len(flights)]
        own, told = motion_errors(run.log, run.truth), noisy(run.truth, seed, *noise)
        drawn = motion_errors(run.log, without_noise(run.log, told)[0])
        np.testing.assert_array_equal(drawn.index, own.index)
        raw.append(rms(motion_errors(run.log, told).xi) / rms(own.xi))
        single.append(rms(drawn.xi) / rms(own.xi))
        ten.append(rms(moving_sums(drawn.xi, 10)) / rms(moving_sums(own.xi, 10)))
    raw, single, ten = (np.exp(np.mean(np.log(x), axis=0)) for x in (raw, single, ten))
    assert raw.max() > 2.5
    assert (within[0] < single).all()
    assert (single < within[1]).all()
    assert (within[0] < ten).all()
    assert (ten < within[1]).all()


def test_the_same_truth_gives_the_same_draw_and_a_slip_stays_odometrys(flights):
    run = flights[4]
    told, slip = noisy(run.truth, 3, 0.01, 0.001), np.array([0.0, 0.0, 0.5, 0.0, 0.0, 0.0])
    log = VoLog([
        replace(r, T_prev_cur=r.T_prev_cur @ se3.exp(slip)) if k == 100 else r for k, r in enumerate(run.log)
    ], run.log.camera)  # fmt: skip
    first, again = (without_noise(log, told)[0].T_world_cam for _ in range(2))
    np.testing.assert_array_equal(first, again)
    found = motion_errors(log, TruthLog(log.t_ns, first))
    assert found.xi[found.index == 100][0, 2] == pytest.approx(0.5, abs=0.05)


def test_an_absurd_motion_changes_nothing_for_the_others(flights):
    run = flights[4]
    told, far = noisy(run.truth, 3, 0.01, 0.001, 0.01), se3.exp(np.array([0.0, 0.0, 1e100, 0.0, 0.0, 0.0]))
    log = VoLog(
        [replace(r, T_prev_cur=r.T_prev_cur @ far) if k == 100 else r for k, r in enumerate(run.log)], run.log.camera
    )
    found, usual = (without_noise(of, told) for of in (log, run.log))
    assert found[1].jitter_s == pytest.approx(usual[1].jitter_s, rel=0.1)
    np.testing.assert_allclose(found[1].sigma, usual[1].sigma, rtol=0.1)
    assert np.isfinite(found[0].T_world_cam).all()


def test_motions_from_long_ago_and_too_few_of_them_are_no_chain():
    t_ns = np.arange(3000) * 10**8
    records = [VoRecord(int(t), int(t) - 10**8 if k % 7 else 0, Status.OK if k else Status.START, np.eye(4))
               for k, t in enumerate(t_ns)]  # fmt: skip
    truth, noise = TruthLog(t_ns, np.tile(np.eye(4), (3000, 1, 1))), TruthNoise(np.full(6, 1e-3))
    assert np.isfinite(drawn_without_noise(VoLog(records), truth, noise).T_world_cam).all()
    assert drawn_without_noise(VoLog(records[:4]), truth, noise) is truth


def _rows(run: Run, seed: int, *noise: float) -> TrainingSet:
    return build(run.log, noisy(run.truth, seed, *noise), name=run.name)


@pytest.mark.parametrize("noise", [(0.0, 0.0, 0.01), pytest.param((0.005, 0.0005, 0.005), marks=pytest.mark.slow)])
def test_a_model_learns_odometrys_errors_from_a_noisy_truth(flights, noise):
    """Judged by the exact truth of another flight: by jitter alone as good as from exact truth."""
    nll = {}
    noisy_sets = [_rows(run, k, *noise) for k, run in enumerate(flights[:4])]
    for name, sets in {
        "exact": [build_run(run) for run in flights[:4]],
        "noisy": noisy_sets,
        "as told": [replace(s, Y=s.told, told=None, truth_noise=None) for s in noisy_sets],
    }.items():
        predictor = train_sets(sets, TrainConfig(), judge=False).predictor()
        nll[name] = evaluate_run(flights[4], predictor).consistency["learned"].nll_per_dim
    assert nll["noisy"] < nll["as told"] - 0.8
    assert nll["noisy"] < nll["exact"] + (0.1 if noise[0] == 0.0 else 0.7)


@pytest.mark.parametrize("noise", [(0.0, 0.0, 0.02), (0.02, 0.002, 0.0)])
def test_a_table_of_training_counts_the_truths_noise_in(flights, noise):
    """What odometry's errors show by the exact truth is right beside a noisy one, whose errors are much larger."""
    for k, run in enumerate(flights):
        exact, rows = build_run(run), _rows(run, k, *noise)
        C = np.broadcast_to(np.cov(exact.Y.T), (len(rows), 6, 6))
        found, told = _scored(rows, np.zeros_like(rows.Y), C), score(rows.told, np.zeros_like(rows.Y), C)
        assert 0.6 < found["nees_dof"]["joint"] < 1.5
        assert told["nees_dof"]["joint"] > 3.0
        assert found["nll_per_dim"] < told["nll_per_dim"] - 1.0
        plain = np.zeros_like(exact.Y), np.broadcast_to(C[0], (len(exact), 6, 6))
        assert _scored(exact, *plain) == score(exact.Y, *plain)


def test_rows_of_a_noisy_truth_are_stored_whole(flights, tmp_path):
    noisy_set, exact = _rows(flights[0], 0, 0.01, 0.001), build_run(flights[1])
    write_sets(tmp_path / "rows.parquet", [noisy_set, exact])
    first, second = read_sets(tmp_path / "rows.parquet")
    np.testing.assert_array_equal(first.told, noisy_set.told)
    np.testing.assert_array_equal(first.truth_noise, noisy_set.truth_noise)
    assert first.digest() == noisy_set.digest() != replace(first, told=first.Y).digest()
    assert second.told is second.truth_noise is exact.told is None
    half = noisy_set.rows(np.arange(len(noisy_set)) < 40)
    np.testing.assert_array_equal(half.told, noisy_set.told[:40])
    indefinite = replace(half, truth_noise=half.truth_noise - 1e-3 * np.eye(6))
    for broken in (replace(half, told=None), replace(half, truth_noise=None), indefinite):
        write_sets(tmp_path / "bad.parquet", [broken])
        with pytest.raises(SourceError, match="truth"):
            read_sets(tmp_path / "bad.parquet")


def test_rows_of_twins_and_of_exact_truths_are_as_told(flights):
    run = replace(flights[0], truth=noisy(flights[0].truth, 0, 0.01, 0.001))
    assert build_run(run).told is not None
    assert build_run(replace(run, meta={**run.meta, "twin": {"of": "f"}})).told is None
    for exact in flights:
        assert build_run(exact).told is None


def test_what_is_said_of_a_noisy_truth(flights):
    found = evaluate_run(replace(flights[4], truth=noisy(flights[4].truth, 1, 0.0, 0.0, 0.02)))
    assert 0.017 < found.truth_jitter_s < 0.024
    assert f"its stamps jitter by {1e3 * found.truth_jitter_s:.2g} ms" in " ".join(verdict(found).lines)


def test_pictures_show_errors_beside_what_is_stated_of_both(flights):
    """Odometry's and the truth's: else every honest covariance would seem overconfident."""
    e = evaluate_run(replace(flights[4], truth=noisy(flights[4].truth, 1, 0.02, 0.002)))
    c = e.consistency["triangulation"]
    (over_time,) = panels.nees(e)
    drawn = next(line for line in over_time["lines"] if line["name"] == "triangulation")
    assert np.mean(drawn["y"]) == pytest.approx(c.nees_dof_truth_noise["joint"], rel=0.1)
    assert c.nees_dof["joint"].mean > 3.0 * c.nees_dof_truth_noise["joint"]
    for axis, one in enumerate(panels.errors(e)):
        (band,) = one["bands"]
        assert np.mean(np.subtract(band["high"], band["low"])) > 2 * 3e3 * np.sqrt(2.0) * e.truth_sigma[axis]


def test_constants_of_filters_are_those_of_odometry(flights):
    told = [replace(run, truth=noisy(run.truth, k, 0.0, 0.0, 0.02)) for k, run in enumerate(flights)]
    exact, found = (constants_of(runs).mean_squares for runs in (flights, told))
    raw = np.mean([rms(motion_errors(run.log, run.truth).xi) ** 2 for run in told], axis=0)
    assert (raw / exact).max() > 10.0
    assert np.abs(np.log(found / exact)).max() < np.log(1.6)
