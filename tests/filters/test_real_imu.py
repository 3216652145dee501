"""The filter on a real IMU (TUM-VI room1): true motions with a known error stand in for VO."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gpvo.dataset.errors import interpolate_truth
from gpvo.filters.policies import LearnedPolicy
from gpvo.filters.run import Flight, fuse_flight
from gpvo.filters.sanity import check_flight
from gpvo.filters.start import vertical_in_world
from gpvo.geometry import se3
from gpvo.io import open_source
from gpvo.types import Status, VoRecord

from motion_errors import prediction

SIGMA = np.array([5e-3] * 3 + [3e-3] * 3)


@pytest.fixture(scope="module")
def flight() -> Flight:
    folder = os.environ.get("GPVO_DATA")
    if not folder:
        pytest.skip("GPVO_DATA is not set: no real data")
    source = open_source(Path(folder) / "tumvi_room1_60")
    assert source.truth is not None
    t_ns = np.arange(source.truth.t_ns[100], source.truth.t_ns[100] + 30 * 10**9, 50_000_000)
    T, valid = interpolate_truth(source.truth, t_ns)
    rng = np.random.default_rng(0)
    records, predictions = [VoRecord(int(t_ns[0]), int(t_ns[0]), Status.START, np.eye(4))], {}
    C, zero = np.diag(SIGMA**2), np.zeros((6, 6))
    for k in range(1, len(t_ns)):
        t = int(t_ns[k])
        T_est = se3.inverse(T[k - 1]) @ T[k] @ se3.exp(SIGMA * rng.standard_normal(6))
        records.append(VoRecord(t, int(t_ns[k - 1]), Status.OK, T_est))
        predictions[t] = prediction(t, zero, C, zero, np.inf, dt_s=0.05)
    return Flight("room1", records, source.imu, source.mounting.T_imu_cam, T, valid, predictions)


def test_real_imu_passes_the_checks_and_wrong_ones_do_not(flight: Flight) -> None:
    assert check_flight(flight) == []
    imu = flight.imu
    assert imu is not None
    wrong = {
        "acc_unit": replace(imu, acc_mps2=imu.acc_mps2 / 9.80665),
        "gyro_unit": replace(imu, gyro_radps=np.degrees(imu.gyro_radps)),
        "gyro_axes": replace(imu, gyro_radps=imu.gyro_radps[:, [1, 2, 0]], acc_mps2=imu.acc_mps2[:, [1, 2, 0]]),
        "acc_axes": replace(imu, acc_mps2=imu.acc_mps2[:, [1, 2, 0]]),
    }
    for kind, changed in wrong.items():
        assert kind in {f.kind for f in check_flight(replace(flight, imu=changed)) if f.fatal}, kind


def test_vertical_of_the_truth(flight: Flight) -> None:
    assert flight.imu is not None
    t_ns = np.array([r.t_ns for r in flight.records])
    assert np.arccos(vertical_in_world(flight.imu, t_ns, flight.T_world_imu, 0.05)[0][2]) < np.radians(0.5)


def test_the_filter_follows(flight: Flight) -> None:
    run = fuse_flight(flight, LearnedPolicy())
    assert run.scores is not None
    assert not run.scores.diverged
    assert run.scores.final_error_m < 1.5
    assert 0.2 < run.scores.nees_position < 4.0
    # The truth's own attitude noise is in the innovations too.
    assert 0.7 < run.scores.nis_dof < 2.5
