"""Twins as filters take them: on a path that a vehicle can fly, with an IMU of this path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gpvo.filters.propagation import DEFAULT_IMU_NOISE
from gpvo.filters.run import Flight, vertical_in_world
from gpvo.filters.start import StartSigmas
from gpvo.geometry import se3
from gpvo.sim.imu import ImuModel, measured_imu
from gpvo.sim.recorded import smooth_path
from gpvo.twin.gap import restated
from gpvo.types import TruthLog


def on_smooth_path(twin: Flight, seed: Sequence[int]) -> Flight:
    """A twin as filters take it. Its path, as odometry found it, jitters as no vehicle does: its motions keep their
    errors on the path smoothed. And the run's IMU flew another: readings become those of this path, upright by the
    run's IMU, with that one's rate, the noise that it states, and biases as large as filters expect."""
    imu, t_ns = twin.imu, np.array([r.t_ns for r in twin.records], np.int64)
    assert twin.T_world_cam is not None
    T_world_imu, t_s = twin.T_world_imu, (t_ns - t_ns[0]) * 1e-9
    if imu is not None:
        up = vertical_in_world(imu, t_ns, T_world_imu)
        tilt = np.cross(up, [0.0, 0.0, 1.0])
        turn = np.arctan2(np.linalg.norm(tilt), up[2]) * tilt / max(float(np.linalg.norm(tilt)), 1e-12)
        T_world_imu = se3.exp(np.append(np.zeros(3), turn)) @ T_world_imu
    path = smooth_path(t_s, T_world_imu)
    T_world_cam = se3.from_rt(path.attitude(t_s), path.position(t_s))
    if twin.T_imu_cam is not None:
        T_world_cam = T_world_cam @ twin.T_imu_cam
    before, after = TruthLog(t_ns, twin.T_world_cam), TruthLog(t_ns, T_world_cam)
    records = [restated(r, before, onto=after) for r in twin.records]
    flown = replace(twin, records=records, T_world_cam=T_world_cam)
    if imu is None:
        return flown
    sigmas, noise = StartSigmas(), imu.noise or DEFAULT_IMU_NOISE
    model = ImuModel(noise, bias_gyro_radps=sigmas.gyro_bias_radps, bias_acc_mps2=sigmas.acc_bias_mps2)
    motion = path.motion(1e9 / float(np.median(np.diff(np.unique(imu.t_ns)))))
    return replace(flown, imu=measured_imu(motion, model, np.random.default_rng(seed), int(t_ns[0]))[0])
