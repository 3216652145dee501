"""Trajectory scores against evo, consistency scores against draws, paired comparisons."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from gpvo.errors import GpvoError
from gpvo.filters import metrics
from gpvo.filters.policies import ConstantPolicy, GeometricPolicy, LearnedPolicy
from gpvo.filters.run import FuseOptions, fuse_flight
from gpvo.filters.study import Constants, Study, fit_scalars, make_policies, study, table
from gpvo.geometry import se3
from gpvo.types import Status, VoRecord
from synthetic_flights import FORWARD_CAMERA, ErrorLaw, synthetic_flight, with_geometric


def test_ate_agrees_with_evo() -> None:
    evo = pytest.importorskip("evo.core.metrics")
    from evo.core.trajectory import PosePath3D

    rng = np.random.default_rng(0)
    truth = np.cumsum(rng.standard_normal((60, 3)), axis=0)
    estimate = truth @ se3.so3_exp(np.array([0.3, -1.0, 2.0])).T + [4, 5, 6] + 0.1 * rng.standard_normal((60, 3))
    eye = np.tile([1.0, 0, 0, 0], (60, 1))
    a, b = PosePath3D(estimate, eye), PosePath3D(truth, eye)
    a.align(b)
    ape = evo.APE(evo.PoseRelation.translation_part)
    ape.process_data((b, a))
    assert metrics.ate_rmse(estimate, truth) == pytest.approx(ape.get_statistic(evo.StatisticsType.rmse), rel=1e-9)


def test_nees_of_honest_and_of_overconfident_states() -> None:
    rng = np.random.default_rng(1)
    A = rng.standard_normal((3, 3))
    C = np.tile(A @ A.T * 1e-4, (20000, 1, 1))
    error = rng.standard_normal((20000, 3)) @ np.linalg.cholesky(C[0]).T
    assert metrics.position_nees(np.zeros((20000, 3)), error, C).mean() == pytest.approx(1.0, abs=0.03)
    R = se3.so3_exp(error)
    assert metrics.attitude_nees(np.tile(np.eye(3), (20000, 1, 1)), R, C / 4).mean() == pytest.approx(4.0, abs=0.15)


def test_constants_are_tuned_on_flights_with_truth() -> None:
    flights = [synthetic_flight(seed, duration_s=4) for seed in (1, 2)]
    blind = replace(flights[0], truth_valid=np.zeros(len(flights[0].records), bool))
    constants, options = Constants(np.full(6, 1e-4), 0.05), FuseOptions(history_s=0.0)
    assert fit_scalars([blind, flights[1]], constants, options) == fit_scalars(flights[1:], constants, options)
    with pytest.raises(GpvoError, match="no run has ground truth"):
        fit_scalars([blind], constants, options)


def test_scores_are_of_the_camera_at_the_end_and_count_the_noise_of_truth_in() -> None:
    flight, rng, sigma = synthetic_flight(3, duration_s=4), np.random.default_rng(0), (0.1, 0.02)
    run = fuse_flight(flight, LearnedPolicy())
    assert flight.T_world_cam is not None
    np.testing.assert_allclose(run.T_world_cam, run.T_world_imu @ FORWARD_CAMERA, atol=1e-12)
    truth = flight.T_world_cam[:, :3, 3]
    error = np.linalg.norm(run.T_world_cam[:, :3, 3] - truth, axis=1)
    assert run.scores.final_error_m == pytest.approx(error[-1])
    path_m = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    assert run.scores.drift_percent == pytest.approx(100 * error[-1] / path_m)
    noisy = flight.T_world_cam.copy()  # but for the poses of the start
    noisy[5:, :3, 3] += sigma[0] * rng.standard_normal((len(noisy) - 5, 3))
    noisy[5:, :3, :3] = noisy[5:, :3, :3] @ se3.so3_exp(sigma[1] * rng.standard_normal((len(noisy) - 5, 3)))
    scores = fuse_flight(replace(flight, T_world_cam=noisy, truth_sigma=sigma), LearnedPolicy()).scores
    # The mean of 76 times three squares scatters by 9 %: four of that, as the filter knows its place far better.
    for found in (scores.nees_position, scores.nees_attitude):
        assert found == pytest.approx(1.0, abs=0.4)


def test_the_error_of_an_attitude_is_in_the_axes_of_the_body() -> None:
    R, turn = se3.so3_exp(np.array([0.3, -1.2, 0.8])), se3.so3_exp(np.array([0.0, 0.0, 0.5]))
    nees = metrics.attitude_nees(R[None], (R @ turn)[None], np.diag([1e-6, 1e-6, 1.0])[None])
    assert nees == pytest.approx(0.25 / 3)


def test_divergence() -> None:
    assert metrics.diverged(np.array([0.0, np.nan]), 10.0)
    assert metrics.diverged(np.array([0.0, 3.0]), 10.0)
    assert not metrics.diverged(np.array([0.0, 3.0]), 100.0)


def test_constant_widens_over_lost_frames_and_scales_by_block() -> None:
    policy = ConstantPolicy(np.arange(1.0, 7.0), 0.05, np.array([[2.0, 0.5]]))
    one = VoRecord(50_000_000, 0, Status.OK, np.eye(4))
    np.testing.assert_allclose(np.diagonal(policy.noise(one, None).white[0]), [2, 4, 6, 2, 2.5, 3])
    four = VoRecord(200_000_000, 0, Status.OK, np.eye(4))
    np.testing.assert_allclose(policy.noise(four, None).white, 4 * policy.noise(one, None).white)


def test_tuned_scalars_find_the_noise_they_were_made_with() -> None:
    law = ErrorLaw(jitter=np.full(6, 1e-9), bias=np.full(6, 1e-9), white=np.array([8e-3] * 3 + [8e-4] * 3))
    flights = [synthetic_flight(s, duration_s=6, imu_hz=50, law=law) for s in range(3)]
    wrong = Constants(law.white**2 * 64.0, 0.05)
    translation, _ = fit_scalars(flights, wrong)
    # The optimum is broad: it must have moved towards 1/64, not have hit it.
    assert translation < 0.3


def test_study_tells_a_better_policy_and_leaves_out_what_cannot_run() -> None:
    law = ErrorLaw(burst_factor=10.0)
    flights = [
        replace(synthetic_flight(s, duration_s=8, imu_hz=50, law=law), name=f"my-last-flight-twin{s}") for s in range(6)
    ]
    square = np.mean([np.diagonal(p.covariance) for f in flights for p in f.predictions.values()], axis=0)
    names = ("constant", "constant_best", "triangulation", "learned")
    policies = make_policies(Constants(square, 0.05), names=names, learned=True)
    assert policies["constant_best"] is None
    result = study(flights, policies)
    compared = result.compare("learned", "constant")
    assert compared.gain_percent > 0
    assert "learned less constant" in str(compared)
    assert set(result.scores["triangulation"]) == {None}
    text = table(result)
    assert all(f.name in text for f in flights)
    assert "nan" not in text
    assert all(len(line) <= 80 for line in text.splitlines() if not line.startswith("ATE m on"))


@pytest.mark.parametrize("share, flown", [(0.4, ["learned", "triangulation"]), (0.6, ["learned"])])
def test_a_policy_is_left_out_that_is_silent_on_more_than_half_of_the_motions(share: float, flown: list[str]) -> None:
    flight = with_geometric(synthetic_flight(3, duration_s=4), 1e-4 * np.eye(6))
    silent = int(share * len(flight.records))
    records = [replace(r, covariances={}) if i < silent else r for i, r in enumerate(flight.records)]
    policies = {"learned": LearnedPolicy(), "triangulation": GeometricPolicy("triangulation")}
    seen: list[str] = []
    result = study([replace(flight, records=records)], policies, on_run=lambda _, fused: seen.append(fused.policy))
    assert seen == flown
    assert (result.scores["triangulation"] == (None,)) == ("triangulation" not in flown)


def test_a_run_without_truth_has_not_said_that_it_held() -> None:
    """One run diverged, one did not, of one no truth tells, and in one the policy could not run."""
    told = fuse_flight(synthetic_flight(0, duration_s=4), ConstantPolicy(np.full(6, 1e-5), 0.05)).scores
    runs = [replace(told, diverged=d) for d in (True, False, None)]
    of_all = Study(("a", "b", "c", "d"), {"constant": (*runs, None), "learned": (runs[2], None, None, None)})
    np.testing.assert_array_equal(of_all.column("constant", "diverged"), [1.0, 0.0, np.nan, np.nan])
    assert of_all.diverged("constant") == 1
    assert of_all.diverged("learned") is None


def test_columns_hold_numbers_of_any_size() -> None:
    told = fuse_flight(synthetic_flight(0, duration_s=2), ConstantPolicy(np.full(6, 1e-5), 0.05)).scores
    gone = replace(told, ate_rmse_m=8.5e9, final_error_m=7.4e21, nees_position=6e8, nis_dof=123456.0)
    row = table(Study(("a",), {"constant": (gone,)})).splitlines()[1]
    assert len(row) <= 80
    assert [float(v) for v in row.split()[1:3]] == [pytest.approx(8.5e9, rel=0.1), pytest.approx(7.4e21, rel=0.1)]


def test_a_record_costs_two_kilobytes_in_each_run() -> None:
    """Of a day's flight the filter's own states would fill the memory: each is ten times as large."""
    C = 1e-4 * np.eye(6)
    flights = [replace(with_geometric(synthetic_flight(3, duration_s=s), C), imu=None, T_imu_cam=None) for s in (5, 25)]
    policies = [ConstantPolicy(np.full(6, 1e-5), 0.05, name=str(k)) for k in range(6)]
    fuse_flight(flights[0], policies[0])  # caches are filled
    peak = []
    for flight in flights:
        tracemalloc.start()
        kept = [fuse_flight(flight, policy) for policy in policies]
        peak.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    more = len(flights[1].records) - len(flights[0].records)
    assert (peak[1] - peak[0]) / more < 2000 * len(kept)
