"""Odometry messages to hand to other people's readers."""

from __future__ import annotations

import numpy as np
import pytest
from gpvo.geometry import se3
from gpvo.geometry.se3 import R_FLU_OPTICAL
from gpvo.publish.odometry import Odometry, OdometryBuilder, messages
from synthetic_flights import ErrorLaw, Events, synthetic_flight


@pytest.fixture(scope="session")
def odometry() -> list[Odometry]:
    """Four seconds at 20 Hz with a tilted camera off the body's origin, and half a second of darkness."""
    flight = synthetic_flight(2, duration_s=4, law=ErrorLaw(burst_factor=10.0), events=Events(dark=(2.0, 2.5)))
    mount = se3.from_rt(R_FLU_OPTICAL @ se3.so3_exp(np.array([0.1, 0.2, 0.05])), np.array([0.4, 0.1, -0.2]))
    return list(messages(flight.records, lambda r: flight.predictions.get(r.t_ns), OdometryBuilder(mount)))
