"""Mean and spread of the IMU over a motion; pieces of time are merged without keeping samples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from gpvo.types import Array, ImuLog, VoRecord


@dataclass(frozen=True)
class ImuMoments:
    """``n`` samples, their mean and variance (6,): gyro [rad/s], then accelerometer [m/s^2], in IMU axes."""

    n: int
    mean: Array
    variance: Array

    @classmethod
    def of(cls, imu: ImuLog | None) -> ImuMoments:
        """Of a piece of a log, which may be missing or empty."""
        if imu is None or len(imu.t_ns) == 0:
            return cls(0, np.zeros(6), np.zeros(6))
        samples = np.hstack([imu.gyro_radps, imu.acc_mps2])
        return cls(len(samples), samples.mean(0), samples.var(0))

    @classmethod
    def of_record(cls, record: VoRecord) -> ImuMoments:
        """What a record says of the IMU over its motion, as one sample with that spread; NaN where it knows none."""
        unknown = np.full(3, np.nan)

        def joined(*fields: Array | None) -> Array:
            return np.concatenate([unknown if field is None else field for field in fields])

        mean = joined(record.imu_gyro_mean_radps, record.imu_acc_mean_mps2)
        return cls(1, mean, joined(record.imu_gyro_std_radps, record.imu_acc_std_mps2) ** 2)

    def with_later(self, other: ImuMoments) -> ImuMoments:
        """Of both pieces together (T. Chan, G. Golub, R. LeVeque, "Algorithms for computing the sample variance"
        (1983)): however long a reference is kept, no sample need be."""
        if self.n == 0 or other.n == 0:
            return other if self.n == 0 else self
        n, off = self.n + other.n, other.mean - self.mean
        share = other.n / n
        variance = (1.0 - share) * self.variance + share * other.variance + share * (1.0 - share) * off**2
        return ImuMoments(n, self.mean + share * off, variance)

    def fields(self) -> dict[str, Any]:
        """Fields of a record that describe the IMU over the motion; empty without samples."""
        if self.n == 0:
            return {}
        deviation = np.sqrt(self.variance)
        return {
            "imu_gyro_mean_radps": self.mean[:3],
            "imu_gyro_std_radps": deviation[:3],
            "imu_acc_mean_mps2": self.mean[3:],
            "imu_acc_std_mps2": deviation[3:],
        }
