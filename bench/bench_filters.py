"""Cost of the filter: one IMU sample, one VO update, one published message. CPU time, median of repeats."""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import cycle

import numpy as np
from gpvo.filters.measurement import Gate
from gpvo.filters.policies import LearnedPolicy
from gpvo.filters.run import FuseOptions, begin, fuse_flight, make_filter
from gpvo.publish.odometry import OdometryBuilder
from gpvo.types import MotionError
from tests.filters.synthetic_flights import synthetic_flight

from bench import Rows, median_s, row


def _microseconds(call: Callable[[], object], number: int) -> float:
    """CPU time of a call, from seven times so many."""

    def many(_: int) -> None:
        for _ in range(number):
            call()

    return 1e6 * median_s(many, 7, warm_up=1, clock=time.process_time) / number


def run() -> Rows:
    """Measure on this machine."""
    flight = synthetic_flight(0, duration_s=4)
    start, gravity = begin(flight, FuseOptions())
    filter = make_filter(flight, start, gravity, 1, FuseOptions())
    gyro, acc = np.array([[0.1, 0.2, 0.3]]), np.array([[0.1, 0.2, 9.8]])
    sample = _microseconds(lambda: filter.propagate_imu(0.005, gyro, acc, gyro, acc), 500)

    eye = np.eye(6)[None]
    noise = MotionError(
        mean=np.zeros((1, 6)),
        jitter=eye * 1e-4,
        white=eye * 1e-4,
        persistent_root=1e-2 * np.eye(6, 12)[None],
        persistent_tau_s=np.ones(12),
    )
    gate = Gate(on_fail="accept")

    def update() -> None:
        filter.decay_bias(0.05, noise.persistent_tau_s)
        filter.update_motion(np.eye(4), noise, gate)
        filter.clone(measured=True)

    vo = _microseconds(update, 200)
    builder = OdometryBuilder()
    log = cycle(flight.records[1:])

    def publish() -> None:
        nonlocal builder
        record = next(log)
        if record is flight.records[1]:
            builder = OdometryBuilder()
        builder.step(record, flight.predictions[record.t_ns])

    message = _microseconds(publish, 60)

    before = time.process_time()
    fuse_flight(flight, LearnedPolicy())
    whole = (time.process_time() - before) / 4.0
    return {
        "filter_imu_sample": row(sample, "us", "limit", 150.0),
        "filter_vo_update": row(vo, "us", "limit", 500.0),
        "filter_second_of_flight": row(whole * 1e3, "ms of CPU per s (200 Hz IMU, 20 Hz VO)"),
        "publish_message": row(message, "us"),
    }


if __name__ == "__main__":
    for name, found in run().items():
        print(f"{name:<28}{found['value']:>10.1f} {found['unit']}")
