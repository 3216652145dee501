"""Long flights: flat memory, and every covariance positive definite.

``GPVO_LONG_STEPS`` predictions, by default 20,000, and a tenth as many steps of the filter.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest
from gpvo.filters.policies import LearnedPolicy
from gpvo.filters.run import FuseOptions, begin, make_filter
from gpvo.filters.timeline import Timeline
from gpvo.geometry.covariance import are_covariances
from gpvo.online.predictor import Predictor
from gpvo.types import VoRecord
from synthetic_flights import synthetic_flight
from synthetic_runs import make_run

STEPS = int(os.environ.get("GPVO_LONG_STEPS", "20000"))
MODEL = Path(__file__).parents[2] / "models" / "tunnel.gpvo"
READINGS, GROWTH_MB = 10, 10.0


def flat(steps: int, step: Callable[[int], np.ndarray]) -> None:
    """Take the steps, each of which states a covariance; no growth after the first of ten readings."""
    resident_mb, stated = [], []
    for k in range(steps):
        stated.append(step(k))
        if len(stated) == 1000 or k == steps - 1:
            assert are_covariances(np.array(stated)).all(), k
            stated = []
        if (k + 1) % (steps // READINGS) == 0:
            resident_mb.append(psutil.Process().memory_info().rss / 1e6)
    assert max(resident_mb[1:]) - resident_mb[0] < GROWTH_MB, resident_mb


def later(r: VoRecord, shift_ns: int) -> VoRecord:
    return replace(r, t_ns=r.t_ns + shift_ns, t_prev_ns=r.t_prev_ns + shift_ns)


@pytest.mark.slow
def test_predictions() -> None:
    records = list(make_run(50, n=500)[0])[1:]
    lap_ns = records[-1].t_ns - records[0].t_prev_ns
    predictor = Predictor.load(MODEL)

    def step(k: int) -> np.ndarray:
        lap, at = divmod(k, len(records))
        said = predictor.step(later(records[at], lap * lap_ns))
        assert said is not None
        return said.covariance

    flat(STEPS, step)


@pytest.mark.slow
def test_steps_of_the_filter() -> None:
    """Lap after lap of one flight; where a lap begins, attitude and velocity are suddenly others."""
    flight = synthetic_flight(3, duration_s=30.0)
    records, imu, options = flight.records, flight.imu, FuseOptions()
    assert imu is not None
    start, gravity = begin(flight, options)
    filter = make_filter(flight, start, gravity, 1, options)
    timeline = Timeline(filter, records[0].t_ns, LearnedPolicy())
    each = (len(imu.t_ns) - 1) // (len(records) - 1)
    lap_ns = records[-1].t_ns + (records[1].t_ns - records[0].t_ns) - records[0].t_ns

    def step(k: int) -> np.ndarray:
        lap, at = divmod(k, len(records))
        for i in range(max(0, (at - 1) * each + 1), at * each + 1):
            timeline.add_imu(imu.t_ns[i] + lap * lap_ns, imu.gyro_radps[i], imu.acc_mps2[i])
        record = later(records[at], lap * lap_ns)
        said = flight.predictions.get(records[at].t_ns)
        timeline.add_vo(record, None if said is None else replace(said, t_ns=record.t_ns))
        R, C = timeline.filter.x.R_world_imu[0], timeline.filter.covariance[0].copy()
        assert np.abs(R @ R.T - np.eye(3)).max() < 1e-12
        return C

    flat(STEPS // 10, step)
    assert timeline.counts["used"] > 0.8 * (STEPS // 10)
