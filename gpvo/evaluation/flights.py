"""Runs as filters take them: with what is predicted of them, the truth's noise, and constants from their errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gpvo.dataset.build import predictions_of
from gpvo.dataset.doubtful import without_wandering_truth
from gpvo.dataset.errors import interpolate_truth, motion_errors, require_attitude
from gpvo.dataset.noiseless import without_noise
from gpvo.errors import GpvoError
from gpvo.filters.propagation import DEFAULT_IMU_NOISE
from gpvo.filters.run import Flight
from gpvo.filters.sanity import require_sane
from gpvo.filters.start import StartSigmas, slope_sigma, tilt_of, vertical_in_world
from gpvo.filters.study import Constants
from gpvo.geometry import se3
from gpvo.io.run import Run
from gpvo.online.predictor import Predictor
from gpvo.twin.gap import restated
from gpvo.types import TruthLog

_POSITION_BASELINES = 2e-3  # how exact a start is at most, beside the baseline


def flight_of(run: Run, predictor: Predictor | None = None, *, use_imu: bool = True) -> Flight:
    """A run as the filters take it, with the model's predictions, else those stored in the run; a twin on a
    path that a vehicle can fly, with an IMU of this path.

    Raises GpvoError where there is an IMU but nobody says how it sits to the camera, the truth has no attitude, or the
    run is empty.
    """
    if len(run.log) < 2:
        raise GpvoError(f"holds {len(run.log)} records: nothing to fuse", where=run.path)
    imu = run.imu if use_imu else None
    if imu is not None and run.mounting.T_imu_cam is None:
        cure = (
            "run it with --calibration CAMCHAIN, Kalibr's file with T_cam_imu, or a bag whose /tf_static joins IMU and "
            "camera; or fuse it with --no-imu"
        )
        raise GpvoError("has an IMU, but nothing says where it sits on the camera", where=run.path, cure=cure)
    poses = valid = None
    truth_sigma = (0.0, 0.0)
    if run.truth is not None:
        require_attitude(run.log, run.truth, run.path)
        truth_sigma = (run.truth.sigma_translation_m, run.truth.sigma_rotation_rad)
        poses, valid = interpolate_truth(run.truth, run.log.t_ns)
        if not valid.any():
            raise GpvoError("ground truth and frames do not overlap in time", where=run.path)
    flight = Flight(
        name=run.name,
        records=run.log.records,
        imu=imu,
        T_imu_cam=run.mounting.T_imu_cam if imu is not None else None,
        T_world_cam=poses,
        truth_valid=valid,
        predictions=predictions_of(run, predictor),
        truth_sigma=truth_sigma,
    )
    if about := run.meta.get("twin"):
        require_sane(flight)
        return on_smooth_path(flight, (about["seed"], about["replicate"], 31))
    return flight


def start_sigmas(runs: Sequence[Run]) -> StartSigmas:
    """Initial covariance that is no smaller than the noise of the truth it starts from, as poses or as their slope; of
    a tiny rig the position is as exact as beside any baseline."""
    baseline_m = min((r.log.camera.baseline_m for r in runs if r.log.camera), default=np.inf)
    sigmas = StartSigmas()
    sigmas = replace(sigmas, position_m=min(sigmas.position_m, _POSITION_BASELINES * baseline_m))
    for truth, log in ((r.truth, r.log) for r in runs if r.truth and len(r.log) > 1):
        noise_m, noise_rad = truth.sigma_translation_m, truth.sigma_rotation_rad
        velocity_mps = slope_sigma(noise_m, float(np.median(np.diff(log.t_ns))) * 1e-9)
        least = {"position_m": noise_m, "velocity_mps": velocity_mps, "tilt_rad": noise_rad, "yaw_rad": noise_rad}
        sigmas = replace(sigmas, **{name: max(getattr(sigmas, name), sigma) for name, sigma in least.items()})
    return sigmas


def constants_of(runs: Sequence[Run]) -> Constants:
    """Per-axis mean squares of the motions' errors over training runs, each run with equal weight, without the noise of
    their truth."""
    squares, dt = [], []
    for run in runs:
        if run.truth is None:
            raise GpvoError("has no ground truth to train a constant on", where=run.path)
        require_attitude(run.log, run.truth, run.path)
        truth = run.truth if run.meta.get("twin") else without_noise(run.log, run.truth)[0]
        errors = motion_errors(without_wandering_truth(run.log, run.truth), truth)
        if not len(errors.index):
            raise GpvoError("has no motion with ground truth at both ends", where=run.path)
        squares.append((errors.xi**2).mean(axis=0))
        dt.append(float(np.median(errors.dt_s)))
    return Constants(np.mean(squares, axis=0), float(np.median(dt)))


def constants_in(predictor: Predictor) -> Constants | None:
    """The constants that a model file carries, None where it has none."""
    covariance = predictor.arrays.get("method.constant")
    if covariance is None or covariance.shape != (6, 6):
        return None
    best = predictor.header.get("constant_best")
    scalars = None if best is None else (float(best[0]), float(best[1]))
    return Constants(np.diagonal(covariance).copy(), predictor.model.dt_s, scalars)


def on_smooth_path(twin: Flight, seed: Sequence[int]) -> Flight:
    """A twin as filters take it. Its path, as odometry found it, jitters as no vehicle does: its motions keep their
    errors on the path smoothed. And the run's IMU flew another: readings become those of this path, upright by the
    run's IMU, with that one's rate, the noise that it states, and biases as large as filters expect."""
    # Only twins need the simulator.
    from gpvo.sim.imu import ImuModel, measured_imu
    from gpvo.sim.paths import smooth_path

    imu, t_ns = twin.imu, np.array([r.t_ns for r in twin.records], np.int64)
    assert twin.T_world_cam is not None
    T_world_imu, t_s = twin.T_world_imu, (t_ns - t_ns[0]) * 1e-9
    if imu is not None:
        up, _ = vertical_in_world(imu, t_ns, T_world_imu, StartSigmas().acc_bias_mps2)
        off_rad, axis = tilt_of(up)
        T_world_imu = se3.exp(np.append(np.zeros(3), -off_rad * axis)) @ T_world_imu
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
