"""The velocity that an IMU carries on: true to what it says of itself, and of no harm where the IMU is wrong."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from gpvo.geometry import se3
from gpvo.io import open_source
from gpvo.runner import steps
from gpvo.sim.points import simulate_points
from gpvo.types import STANDARD_GRAVITY_MPS2, ImuLog, ImuMoments, Status
from gpvo.vo.config import make_config
from gpvo.vo.felt import Felt

SIGMA_MPS = 0.03


def at_each_frame(source) -> Iterator[tuple[float, ImuMoments, np.ndarray]]:
    """Length of the step [s], the IMU's moments over it, and the true velocity (6,) of the camera in its axes."""
    t_ns, T, imu = source.truth.t_ns, source.truth.T_world_cam, source.imu
    for k in range(1, len(t_ns)):
        dt_s = (t_ns[k] - t_ns[k - 1]) * 1e-9
        over = (imu.t_ns > t_ns[k - 1]) & (imu.t_ns <= t_ns[k])
        piece = ImuMoments.of(ImuLog(imu.t_ns[over], imu.gyro_radps[over], imu.acc_mps2[over]))
        yield dt_s, piece, se3.log(se3.inverse(T[k - 1]) @ T[k]) / dt_s


def flown(scenario: str, seed: int, tmp_path, duration_s: float):
    return open_source(simulate_points(scenario, seed, duration_s=duration_s).save(tmp_path / f"{scenario}_{seed}.npz"))


def test_five_seconds_blind_it_is_as_wrong_as_it_says(tmp_path):
    """12 flights: the mean of the errors' squares over the stated variance is within three of its standard deviations,
    sqrt(2 / 36) for independent axes; it allows for errors of clock and scale that these IMUs do not have, so down to
    0.1. That the IMU is right it has begun to believe."""
    rng, squared, last_mps, proven = np.random.default_rng(0), [], [], []
    for seed in range(12):
        source = flown("street" if seed % 2 else "tunnel-clean", seed, tmp_path, 25.0)
        felt, blind_s, done = Felt(se3.inverse(source.mounting.T_imu_cam)), 0.0, 0.0
        for dt_s, piece, truth in at_each_frame(source):
            done += dt_s
            felt.carry(dt_s, piece)
            if done < 12.0:
                felt.see(truth + SIGMA_MPS * np.eye(6)[:3].T @ rng.standard_normal(3), SIGMA_MPS, 0.0, leapt=False)
            elif (blind_s := blind_s + dt_s) >= 5.0:
                break
        off_mps = felt.expected() - truth[:3]
        squared.append((off_mps @ off_mps) / (3 * felt.P[0, 0]))
        proven.append(felt.proven)
        last_mps.append(np.linalg.norm(off_mps))
    assert 0.1 < np.mean(squared) < 1 + 3 * np.sqrt(2 / 36)
    assert np.median(last_mps) < 0.5
    assert np.median(proven) > 0.5  # at first 0


def test_another_velocity_is_carried_like_its_own(tmp_path):
    source = flown("tunnel-clean", 3, tmp_path, 12.0)
    felt, another = Felt(se3.inverse(source.mounting.T_imu_cam)), None
    for k, (dt_s, piece, truth) in enumerate(at_each_frame(source)):
        carry = felt.carry(dt_s, piece)
        another = truth if k <= 100 else carry(another)
        if k <= 100:
            felt.see(truth, SIGMA_MPS, 0.0, leapt=k == 100)  # from then on it is that velocity
    assert np.allclose(felt.expected(), another[:3], atol=1e-9)


NOISE = np.concatenate([np.full(3, 1e-4), np.full(3, 1e-2)])


@pytest.mark.parametrize(
    "imu",
    [
        ImuMoments.of(None),
        ImuMoments(20, np.array([0, 0, 0, np.nan, 0, 0]), NOISE),
        ImuMoments(20, np.array([0, 0, 35.0, 0, 0, 9.8]), NOISE),
        ImuMoments(20, np.array([0, 0, 0, 0, 0, 1e300]), NOISE),
        ImuMoments(20, np.array([0, 0, 0, 0, 0, 9.8]), np.zeros(6)),
    ],
    ids=["no samples", "no accelerometer", "a gyro out of range", "a force out of range", "a stuck one"],
)
def test_without_samples_that_can_be_nothing_is_known(imu):
    felt = Felt(np.eye(4))
    felt.carry(0.1, ImuMoments(20, np.array([0, 0, 0, 0, 0, 9.8]), NOISE))
    felt.see(np.zeros(6), SIGMA_MPS, 0.0, leapt=False)
    assert felt.reach_mps(suspicious=False) < 2.0
    felt.carry(0.1, imu)
    assert felt.reach_mps(suspicious=False) == np.inf
    felt.see(np.ones(6) * 0.1, SIGMA_MPS, 0.0, leapt=False)
    assert np.allclose(felt.expected(), 0.1)


STEP_S = 0.1


def set_off(gravity_mps2: float = STANDARD_GRAVITY_MPS2) -> tuple[Felt, float]:
    """Ten seconds at rest, then off at 2 m/s^2 along z while the image shows rest: the filter as soon as it contradicts
    that, after three seconds at most, and how fast the vehicle is by then [m/s]."""
    felt, mps = Felt(np.eye(4)), 0.0
    for k in range(130):
        push = 2.0 * (k >= 100)
        mps += push * STEP_S
        force = [0.0, -gravity_mps2, push]
        felt.carry(STEP_S, ImuMoments(20, np.concatenate([np.zeros(3), force]), NOISE))
        if felt.contradicted(np.zeros(6), 0.0) is not None:
            break
        felt.see(np.zeros(6), SIGMA_MPS, 0.0, leapt=False)
    return felt, mps


def test_an_image_that_stays_behind_is_contradicted_by_the_true_velocity():
    felt, mps = set_off()
    alone_mps = felt.contradicted(np.zeros(6), 0.0)
    assert alone_mps is not None
    assert mps < 4.0  # half of it might be felt wrongly, and a metre per second besides
    assert np.allclose(alone_mps, [0.0, 0.0, mps], atol=0.5)


def test_an_image_that_moves_as_much_as_was_felt_is_not():
    """Whichever way: then the IMU's axes are another's."""
    felt, mps = set_off()
    for way in np.eye(6)[:3]:
        assert felt.contradicted(mps * way, 0.0) is None
        assert felt.contradicted(-mps * way, 0.0) is None


def test_an_image_too_noisy_to_tell_is_not():
    felt, mps = set_off()
    assert felt.contradicted(np.zeros(6), 0.0, 0.5 * SIGMA_MPS) is not None
    assert felt.contradicted(np.zeros(6), 0.0, 0.5 * mps) is None


def test_what_cannot_be_gravity_contradicts_nothing():
    for gravity_mps2 in (0.0, 1.0, 1.62):
        assert set_off(gravity_mps2)[0].contradicted(np.zeros(6), 0.0) is None


FAULTS: dict[str, Callable[[ImuLog], ImuLog]] = {
    "upside down": lambda imu: replace(imu, acc_mps2=-imu.acc_mps2),
    "gyro in deg/s": lambda imu: replace(imu, gyro_radps=np.rad2deg(imu.gyro_radps)),
    "in g": lambda imu: replace(imu, acc_mps2=imu.acc_mps2 / 9.81),
    "without gravity": lambda imu: replace(imu, acc_mps2=imu.acc_mps2 - [0, 0, 9.81]),
    "axes renamed": lambda imu: replace(
        imu, gyro_radps=imu.gyro_radps[:, [1, 2, 0]], acc_mps2=imu.acc_mps2[:, [1, 2, 0]]
    ),
    "50 ms late": lambda imu: replace(imu, t_ns=imu.t_ns + 50_000_000),
    "spikes": lambda imu: replace(
        imu,
        acc_mps2=imu.acc_mps2 + 100.0 * (np.arange(len(imu.t_ns)) % 700 == 500)[:, None],
        gyro_radps=imu.gyro_radps + 20.0 * (np.arange(len(imu.t_ns)) % 700 == 500)[:, None],
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_wrong_imu_does_not_make_good_motions_doubtful(fault, tmp_path):
    """A flight that is ``ok`` without an IMU stays so, whatever its IMU says."""
    source = flown("tunnel-clean", 1, tmp_path, 10.0)
    source.imu = FAULTS[fault](source.imu)
    ok = [step.record.status is Status.OK for step in steps(source, make_config())][1:]
    assert np.mean(ok) > 0.98
