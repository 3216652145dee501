"""Flights made of smooth curves with a VO error of known law: what a filter can be proved on.

No images and no points: the path is a sum of sines, so the IMU's readings are exact derivatives, and VO's error is
drawn as jitter, white and bias parts with stated covariances. A *regime* scales them frame by frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from gpvo.filters.run import Flight
from gpvo.geometry import se3
from gpvo.types import STANDARD_GRAVITY_MPS2, Array, ImuLog, ImuNoise, Prediction, Status, VoRecord
from numpy.typing import NDArray

FORWARD_CAMERA = np.array([[0.0, 0, 1, 0.1], [-1, 0, 0, 0.02], [0, -1, 0, -0.03], [0, 0, 0, 1]])
MEMS = ImuNoise(2e-4, 2e-3, 2e-5, 5e-4)


@dataclass(frozen=True)
class ErrorLaw:
    """Standard deviations per motion [m, m, m, rad, rad, rad] of VO's error in its three parts, in the calm regime.

    ``burst_factor`` multiplies them in ``burst_share`` of the flight, in pieces of ``burst_s`` seconds.
    """

    jitter: Array = field(default_factory=lambda: np.array([4e-3, 4e-3, 8e-3, 8e-4, 8e-4, 8e-4]))
    white: Array = field(default_factory=lambda: np.array([2e-3, 2e-3, 4e-3, 4e-4, 4e-4, 4e-4]))
    bias: Array = field(default_factory=lambda: np.array([1e-3, 1e-3, 2e-3, 1e-4, 1e-4, 1e-4]))
    bias_tau_s: float = 10.0
    burst_factor: float = 1.0
    burst_share: float = 0.2
    burst_s: float = 2.0


@dataclass(frozen=True)
class Events:
    """Accidents of a flight [s from its start]: darkness (frames lost) and frozen images, (begin, end) each."""

    dark: tuple[float, float] | None = None
    frozen: tuple[float, float] | None = None


def smooth_path(t: Array, rng: np.random.Generator, speed: float = 2.0) -> tuple[Array, Array, Array, Array]:
    """Position, acceleration (N, 3), attitude ``R_world_imu`` (N, 3, 3) and body rate (N, 3) along one curve.

    A walk forward with sideways, vertical and angular swings of a few hertz at most.
    """
    frequency = rng.uniform([0.05, 0.1, 0.1], [0.2, 0.3, 0.4], (4, 3)) * 2 * np.pi
    phase = rng.uniform(0, 2 * np.pi, (4, 3))
    amplitude = rng.uniform(0.2, 1.0, (4, 3)) * np.array([1.0, 0.8, 0.3]) / 4 * speed
    angle = frequency[None] * t[:, None, None] + phase[None]
    position = (amplitude * np.sin(angle)).sum(1)
    position[:, 0] += speed * t
    acceleration = -(amplitude * frequency**2 * np.sin(angle)).sum(1)

    # Roll, pitch, yaw as sines; rates by the exact kinematic relation of Z-Y-X angles.
    f_rpy = rng.uniform(0.05, 0.35, (2, 3)) * 2 * np.pi
    p_rpy = rng.uniform(0, 2 * np.pi, (2, 3))
    a_rpy = rng.uniform(0.3, 1.0, (2, 3)) * np.array([0.15, 0.15, 0.6]) / 2
    arg = f_rpy[None] * t[:, None, None] + p_rpy[None]
    rpy, rate = (a_rpy * np.sin(arg)).sum(1), (a_rpy * f_rpy * np.cos(arg)).sum(1)
    sr, cr, sp, cp = np.sin(rpy[:, 0]), np.cos(rpy[:, 0]), np.sin(rpy[:, 1]), np.cos(rpy[:, 1])
    omega = np.stack(
        [rate[:, 0] - sp * rate[:, 2], cr * rate[:, 1] + sr * cp * rate[:, 2], -sr * rate[:, 1] + cr * cp * rate[:, 2]],
        axis=1,
    )
    zero = np.zeros_like(t)
    axes = [se3.so3_exp(np.stack(v, axis=1)) for v in ((zero, zero, rpy[:, 2]), (zero, rpy[:, 1], zero))]
    R = axes[0] @ axes[1] @ se3.so3_exp(np.stack([rpy[:, 0], zero, zero], axis=1))
    return position, acceleration, R, omega


def synthetic_flight(
    seed: int,
    *,
    duration_s: float = 60.0,
    rate_hz: float = 20.0,
    imu_hz: float = 200.0,
    law: ErrorLaw | None = None,
    events: Events | None = None,
    imu_noise: ImuNoise = MEMS,
    turn_on: tuple[float, float] = (0.03, 2e-3),
    knowledge_error: float = 0.0,
) -> Flight:
    """A flight with IMU, VO log, truth and predictions that know the law.

    ``turn_on``: standard deviations of the IMU's initial biases [m/s^2, rad/s]. ``knowledge_error``: the predicted
    standard deviations are off by a log-normal factor of this spread, frame by frame.
    """
    law, events = law or ErrorLaw(), events or Events()
    rng = np.random.default_rng(seed)
    t_imu = np.arange(0, round(duration_s * imu_hz) + 1) / imu_hz
    every = round(imu_hz / rate_hz)
    position, acceleration, R, omega = smooth_path(t_imu, rng)
    force = (np.swapaxes(R, 1, 2) @ (acceleration + [0, 0, STANDARD_GRAVITY_MPS2])[:, :, None])[:, :, 0]
    imu = _noisy_imu(t_imu, omega, force, imu_noise, turn_on, rng)
    T_world_cam = se3.from_rt(R, position)[::every] @ FORWARD_CAMERA
    t_ns = imu.t_ns[::every]
    scale = regime(len(t_ns), rate_hz, law, rng)
    records, predictions = _vo(t_ns, T_world_cam, scale, law, events, knowledge_error, rng)
    return Flight(
        f"synthetic-{seed:03d}",
        records,
        imu,
        FORWARD_CAMERA,
        T_world_cam,
        np.ones(len(t_ns), bool),
        {p.t_ns: p for p in predictions},
    )


def regime(n: int, rate_hz: float, law: ErrorLaw, rng: np.random.Generator) -> Array:
    """(n,) factor on the standard deviations: 1, and ``burst_factor`` in pieces that fill ``burst_share``."""
    piece = max(1, round(law.burst_s * rate_hz))
    pieces = int(np.ceil(n / piece))
    chosen = rng.permutation(pieces)[: round(law.burst_share * pieces)]
    scale = np.ones(pieces)
    scale[chosen] = law.burst_factor
    return np.repeat(scale, piece)[:n]


def _noisy_imu(
    t: Array, omega: Array, force: Array, noise: ImuNoise, turn_on: tuple[float, float], rng: np.random.Generator
) -> ImuLog:
    dt = t[1] - t[0]

    def channel(clean: Array, density: float, walk: float, first: float) -> Array:
        bias = first * rng.standard_normal(3) + np.cumsum(walk * np.sqrt(dt) * rng.standard_normal(clean.shape), axis=0)
        return clean + bias + density / np.sqrt(dt) * rng.standard_normal(clean.shape)

    gyro = channel(omega, noise.gyro_density_radps_sqrthz, noise.gyro_walk_radps2_sqrthz, turn_on[1])
    acc = channel(force, noise.acc_density_mps2_sqrthz, noise.acc_walk_mps3_sqrthz, turn_on[0])
    return ImuLog(np.round(t * 1e9).astype(np.int64) + 10**18, gyro, acc, noise)


def _vo(
    t_ns: NDArray[np.int64],
    T_world_cam: Array,
    scale: Array,
    law: ErrorLaw,
    events: Events,
    knowledge_error: float,
    rng: np.random.Generator,
) -> tuple[list[VoRecord], list[Prediction]]:
    """Records relative to the last reference, with the error ``Exp(-n_ref) T Exp(n_cur) Exp(b + w)``."""
    seconds = (t_ns - t_ns[0]) * 1e-9
    jitter = np.sqrt(0.5) * law.jitter * scale[:, None] * rng.standard_normal((len(t_ns), 6))
    beta = rng.standard_normal(6)
    records = [VoRecord(int(t_ns[0]), int(t_ns[0]), Status.START, np.eye(4))]
    predictions: list[Prediction] = []
    reference = 0
    for k in range(1, len(t_ns)):
        phi = np.exp(-(seconds[k] - seconds[k - 1]) / law.bias_tau_s)
        beta = phi * beta + np.sqrt(1 - phi**2) * rng.standard_normal(6)
        t, t_ref = int(t_ns[k]), int(t_ns[reference])
        if _inside(seconds[k], events.dark):
            records.append(VoRecord(t, t_ref, Status.LOST, np.eye(4), is_reference=False, reason="dark"))
            continue
        T = se3.inverse(T_world_cam[reference]) @ T_world_cam[k]
        persistent = law.bias * scale[k] * beta + law.white * scale[k] * rng.standard_normal(6)
        T_est = se3.exp(-jitter[reference]) @ T @ se3.exp(jitter[k]) @ se3.exp(persistent)
        if _inside(seconds[k], events.frozen):
            T_est = se3.exp(1e-3 * law.jitter * rng.standard_normal(6))
        known = scale[k] * np.exp(knowledge_error * rng.standard_normal())
        parts = {name: np.diag((getattr(law, name) * known) ** 2) for name in ("jitter", "white")}
        records.append(VoRecord(t, t_ref, Status.OK, T_est))
        predictions.append(
            Prediction(
                mean=np.zeros(6),
                jitter=parts["jitter"],
                white=parts["white"],
                persistent_root=np.diag(law.bias * known),
                persistent_tau_s=np.full(6, law.bias_tau_s),
                dt_s=(t - t_ref) * 1e-9,
                t_ns=t,
                epistemic=np.zeros(6),
                confidence=1.0,
                in_domain=1.0,
            )
        )
        reference = k
    return records, predictions


def _inside(t: float, span: tuple[float, float] | None) -> bool:
    return span is not None and span[0] <= t < span[1]


def with_geometric(flight: Flight, covariance: Array, name: str = "triangulation") -> Flight:
    """The same flight whose records carry ``covariance`` (6, 6) under a geometric method's name."""
    records = [replace(r, covariances={**r.covariances, name: covariance}) if r.usable else r for r in flight.records]
    return replace(flight, records=records)
